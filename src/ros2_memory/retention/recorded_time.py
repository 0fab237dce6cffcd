"""Measures the time recorded since each recording ended, and which recordings have right dates.

The monotonic clock starts again at every boot, so recorded time is added up and stored in
`.episodic/recorded.jsonl`: a line for each recording, about once a minute while it is written,
with the total recorded time when it last grew. The last line of a recording counts. A recording
without a line counts as recorded when it is first asked about: nothing shows that it is older. A
damaged line is ignored, and named in the log. While the disk fails to read the file, nothing counts
as old and nothing is written: a line that counts from 0 would make its recording old.

The dates of a recording are right if the clock was synchronised while it grew, and went along with
the monotonic clock from its beginning. The dates of a recording without a line are doubtful, unless
there is no file at all, as after a restore: then nothing speaks against any date.
"""

from __future__ import annotations

import math
import threading
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import RECORDED_FILE
from ros2_memory.bag_dir.state_files import RECORDED, Recorded
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable
    from pathlib import Path

SAVE_S: Final = 60.0
"""A crash loses at most so much of the recorded time. Bags are then kept for longer."""
LONGEST_SILENCE_S: Final = 60.0
"""A pause in which nothing reached the disk counts as recorded for at most so long."""
STEP_NS: Final[Ns] = 60 * NS_PER_S
"""If the clock was set by less, dates are right enough to age by."""
_SPARE_LINES: Final = 20_000
_MAX_NAMED: Final = 5

_log = get_logger(__name__)


class RecordedTime:
    """The recorded time of one bag directory, which the caller has locked. Thread-safe.

    The file is first read when a method is called. Recordings are directories relative to the bag
    directory, with forward slashes.
    """

    def __init__(self, bag_dir: Path) -> None:
        self._bag_dir = bag_dir
        self._path = bag_dir / RECORDED_FILE
        self._lock = threading.Lock()
        self._loaded = False
        self._total_s = 0.0
        self._last_grew_s: dict[str, float] = {}
        self._right: frozenset[str] = frozenset()
        self._was_set: set[str] = set()
        # The wall clock minus the monotonic clock when each recording began.
        self._leads: dict[str, Ns] = {}
        self._synchronised = False
        self._has_file = True
        self._unsaved: set[str] = set()
        self._lines = 0
        # When the recordings last grew, and the bytes written until then.
        self._grew: tuple[float, int] | None = None
        self._recording: frozenset[str] = frozenset()
        self._saved_at_s = -math.inf
        self._reported: str | None = None
        self._unread: OSError | None = None

    def note(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float, now: Ns
    ) -> None:
        """Counts the time since the last call, if recordings grew in it.

        Args:
            recordings: the recordings that are being written.
            bytes_written: how much all recordings wrote since the recorder started.
            monotonic_s: the monotonic clock, in seconds.
            now: the wall clock.
        """
        with self._lock:
            self._load()
            before = self._recording, self._right
            self._recording = frozenset(recordings)
            self._count_growth(monotonic_s, bytes_written)
            for name in recordings:
                self._last_grew_s[name] = self._total_s
            self._unsaved |= self._recording
            self._judge_dates(now - ns_from_unix(monotonic_s))
            has_changed = (self._recording, self._right) != before
            # While nothing is recorded the disk may be away.
            if recordings and (has_changed or monotonic_s - self._saved_at_s >= SAVE_S):
                self._saved_at_s = monotonic_s
                self._save()

    def _count_growth(self, now_s: float, bytes_written: int) -> None:
        """Adds the time since recordings last grew to the total, if they grew in it."""
        if not self._recording:
            self._grew = None
            return
        grew_at_s, bytes_then = self._grew or (now_s, bytes_written)
        if self._grew is None or bytes_written != bytes_then:
            self._total_s += min(now_s - grew_at_s, LONGEST_SILENCE_S)
            self._grew = (now_s, bytes_written)

    def since(self, recordings: Iterable[str]) -> dict[str, Ns]:
        """Maps each recording to how long was recorded after it."""
        with self._lock:
            self._load()
            return {
                name: ns_from_unix(self._total_s - self._grew_or_grows_now(name))
                for name in recordings
            }

    def doubtful(self, recordings: Collection[str]) -> frozenset[str]:
        """Returns the recordings whose dates are not known to be right."""
        with self._lock:
            self._load()
            for name in recordings:
                self._grew_or_grows_now(name)
            return frozenset(recordings) - self._right

    def asks_for_clock(self) -> bool:
        """Whether a synchronised clock would prove the dates of a recording that is written now."""
        with self._lock:
            return bool(self._recording - self._right - self._was_set)

    def confirm_clock(self) -> None:
        """Tells the next call of `note` that the clock is synchronised."""
        with self._lock:
            self._synchronised = True

    def _judge_dates(self, lead: Ns) -> None:
        """Updates which of the recordings that are written now have right dates.

        `lead` is the wall clock minus the monotonic clock, which changes when the clock is set.
        """
        synchronised, self._synchronised = self._synchronised, False
        if not self._recording:
            return
        begun = self._recording - self._leads.keys()
        self._leads = {name: self._leads.get(name, lead) for name in self._recording}
        self._was_set &= self._recording
        for name, first_lead in self._leads.items():
            if abs(lead - first_lead) >= STEP_NS:
                self._was_set.add(name)
        right = self._right - begun
        if synchronised:
            right |= self._recording
        self._right = right - self._was_set

    def _grew_or_grows_now(self, name: str) -> float:
        """Returns the total when a recording last grew. A recording without a line gets one."""
        if name not in self._last_grew_s:
            self._last_grew_s[name] = self._total_s
            self._unsaved.add(name)
            if not self._has_file:
                self._right |= {name}
        return self._last_grew_s[name]

    def _load(self) -> None:
        """Reads the file once; where the disk fails, each call tries it again."""
        if self._loaded:
            return
        try:
            last = {row.recording: row for row in self._read_rows()}
        except OSError as error:
            if self._unread is None:
                _log.warning("recorded_time_not_read", path=str(self._path), reason=str(error))
            self._unread = error
            return
        self._loaded, self._unread = True, None
        self._right |= {name for name, row in last.items() if row.clock_right}
        if not last:
            return
        # The greatest is the total: it stays even if its recording is gone.
        newest = max(last.values(), key=attrgetter("recorded_s"))
        # Recordings that grew while the file could not be read come after all of its rows.
        for name in self._last_grew_s:
            self._last_grew_s[name] += newest.recorded_s
        self._total_s += newest.recorded_s
        self._last_grew_s |= {name: row.recorded_s for name, row in last.items()}
        # So that the next save leaves out what is gone.
        self._lines = _SPARE_LINES + len(self._last_grew_s)

    def _read_rows(self) -> list[Recorded]:
        """Returns the rows of the file that are whole.

        Raises:
            OSError: the file cannot be read.
        """
        try:
            lines = [*RECORDED.lines(self._bag_dir)]
        except FileNotFoundError:
            self._has_file = False
            return []
        except ValueError as error:
            _log.warning("recorded_time_not_read", path=str(self._path), reason=str(error))
            return []
        if damaged := [line for line in lines if line.row is None]:
            _log.warning(
                "recorded_time_damaged",
                path=str(self._path),
                lines=[line.number for line in damaged[:_MAX_NAMED]],
                damaged=len(damaged),
                reason=str(damaged[0].error),
            )
        return [line.row for line in lines if line.row is not None]

    def _save(self) -> None:
        names = sorted(self._unsaved)
        try:
            if self._unread is not None:
                raise self._unread
            if self._lines + len(names) > _SPARE_LINES + len(self._last_grew_s):
                self._drop_gone()
                RECORDED.replace(self._bag_dir, self._rows(self._last_grew_s))
                self._lines = len(self._last_grew_s)
            elif names:
                RECORDED.append(self._bag_dir, self._rows(names))
                self._lines += len(names)
        except OSError as error:
            reason = f"{self._path}: {error.strerror or error}"
            if reason != self._reported:
                _log.error("recorded_time_not_kept", reason=reason)
            self._reported = reason
        else:
            self._unsaved.clear()
            self._reported = None

    def _drop_gone(self) -> None:
        """Drops the recordings that are gone, but for those that have the total."""
        self._last_grew_s = {
            name: grew_s
            for name, grew_s in self._last_grew_s.items()
            if grew_s == self._total_s or (self._bag_dir / name).is_dir()
        }
        self._right = self._right.intersection(self._last_grew_s)

    def _rows(self, names: Iterable[str]) -> list[Recorded]:
        return [
            Recorded(name, round(self._last_grew_s[name], 3), name in self._right) for name in names
        ]

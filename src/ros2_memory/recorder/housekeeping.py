"""Keeps the bag directory in order for a recorder: repairs files, saves moments, deletes bags."""

from __future__ import annotations

import shlex
import threading
import time
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.heartbeat import RecorderState, read_heartbeat
from ros2_memory.bag_dir.layout import has_own_name, is_saved
from ros2_memory.bag_dir.state_files import EVERY_TOPIC, Interruption, Loss, append_losses
from ros2_memory.core.directories import is_folder
from ros2_memory.core.errors import BagError, BagVanishedError, EpisodicError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import MCAP, BagState
from ros2_memory.core.text import MAX_NAMED, counted, listed
from ros2_memory.core.timebase import NS_PER_HOUR, Clock, Ns, ms_since, ns_from_unix
from ros2_memory.index.file_state import HELD_BACK
from ros2_memory.recorder.index_manager import SPLITS_OF_PATIENCE, IndexManager
from ros2_memory.retention.clear import remove_if_empty
from ros2_memory.retention.collect import Collected, GarbageCollector
from ros2_memory.retention.delete import remove_emptied
from ros2_memory.retention.repair import Repairer, open_files

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.recorder.background import Background
    from ros2_memory.retention.saved_moments import MomentKeeper
    from ros2_memory.storage.base import BagReader, BagWriter
    from ros2_memory.triggers.screening import Screening
    from ros2_memory.triggers.watch import Triggers

REFRESH_S: Final = 60.0
MOST_REPAIRED_BYTES: Final = 1 << 30
"""A larger file would delay deletion by minutes; `ros2-memory recover` repairs it."""

_MB: Final = 10**6
_LAST_STEPS: Final = 2
"""So many steps of screening a recorder that stops still does."""
_WRITTEN_AT_ONCE: Final = 2
"""So many recordings are written during a rotation."""
_log = get_logger(__name__)


class HouseStatus(NamedTuple):
    """The fields of the heartbeat that a housekeeper sets."""

    age_held: str | None = None
    unshipped: str | None = None
    counted_bytes: int | None = None
    state_bytes: int = 0
    held_back: str | None = None
    failing_rules: tuple[str, ...] = ()


@dataclass(eq=False, repr=False)
class Housekeeping:
    """Repairs, saves and deletes in one bag directory, which its caller has locked.

    The recorder calls it between two ticks, so a call returns at once and the work is done in the
    background: the first scan of a week of bags takes from seconds to minutes. Work that is still
    under way is not begun again.

    Args:
        collector: deletes bags beyond its limits. Bags of other programs that do not count there
            are not repaired either.
        moments: saves moments.
        triggers: the rules' watch over recordings; None without rules.
        screening: excludes messages before splits are served; None if nothing is excluded.
    """

    bag_dir: Path
    reader: BagReader
    writer: BagWriter
    clock: Clock
    collector: GarbageCollector
    moments: MomentKeeper
    _: KW_ONLY
    own: OwnRecordings
    split_duration_s: float
    triggers: Triggers | None = None
    screening: Screening | None = None
    background: Background

    def __post_init__(self) -> None:
        self._limits = self.collector.limits
        self._index = IndexManager(
            self.bag_dir,
            self.reader,
            self.clock,
            refresh_s=REFRESH_S,
            split_duration_s=self.split_duration_s,
        )
        self._repairer = Repairer(self.reader, self.writer, self.bag_dir)
        self._unwritten_for = ns_from_unix(SPLITS_OF_PATIENCE * self.split_duration_s)
        self._tried: set[tuple[Path, int, int]] = set()
        self._out_of_reach = False
        self._collected = Collected()
        self._status = HouseStatus()
        self._unshipped = 0
        self._lock = threading.Lock()
        self._unwritten: list[Loss] = []

    def prepare(self) -> None:
        """Cleans up after an earlier run that was cut short. Call it before anything is recorded.

        Raises:
            OSError: the bag directory or the list of own recordings cannot be read.
        """
        heartbeat, now = read_heartbeat(self.bag_dir).heartbeat, self.clock.now()
        if heartbeat is not None and heartbeat.state is not RecorderState.STOPPED:
            recorded = heartbeat.state not in {RecorderState.STARTING, RecorderState.PAUSED}
            first = min(heartbeat.updated if recorded else heartbeat.since, now)
            if self.triggers is not None:
                self.triggers.note_restart(first, now)
            is_paused = heartbeat.state is RecorderState.PAUSED
            self._note_interruption(first, now, "paused" if is_paused else "unclean")
        if self._limits.keeps_foreign:
            for directory in filter(is_folder, self.bag_dir.iterdir()):
                # A kill came before its directory was listed: nothing shows whose it is.
                if self.own.is_announced(directory):
                    remove_if_empty(directory)
        # A kill may have come between the deletion of a last bag and of its directory.
        directories = (self.bag_dir / name for name in self.own.names())
        self.collector.emptied.update(filter(self.own.owns, directories))

    def make_room(self, free_bytes_wanted: int) -> None:
        """Begins to delete the oldest bags until so much is free, or no bag may be deleted."""
        self._add_unless_under_way("make_room", partial(self._delete_for_room, free_bytes_wanted))

    def is_making_room(self) -> bool:
        """Whether room is being made."""
        return self.background.is_under_way("make_room")

    def apply(self) -> None:
        """Begins to delete bags that exceed the limits, and to repair unfinished files."""
        self._add_unless_under_way("apply", self._collect_and_repair)

    def keep_moments(self) -> None:
        """Begins to save requested and pending moments. Call it about once a second."""
        self._add_unless_under_way("keep_moments", self._save_requested_moments)

    def wait(self) -> None:
        """Waits until nothing is under way."""
        self.background.wait(None)

    def _add_unless_under_way(self, task: str, job: Callable[[], None]) -> None:
        if not self.background.is_under_way(task):
            self.background.add(task, job)

    def _delete_for_room(self, free_bytes_wanted: int) -> None:
        most_free = self._collect_and_report(free_bytes_wanted).most_free
        if most_free is not None and not self._out_of_reach:
            _log.error(
                "room_out_of_reach",
                free_bytes_wanted=free_bytes_wanted,
                most_free_bytes=most_free,
                reason="deleting every bag that may be deleted would not free enough of the disk, "
                "so none was deleted for it: delete other files there, or lower "
                "retention.min_free_gb",
            )
        self._out_of_reach = most_free is not None

    def _collect_and_repair(self) -> None:
        self._collect_and_report()
        if self._repair_unfinished(self._index.snapshot()):
            self._index.refresh()

    def _save_requested_moments(self) -> None:
        """Saves requested and pending moments, and those of rules if a recording began anew."""
        self.moments.open()
        has_restarted = self.triggers is not None and bool(self.triggers.restarts)
        if has_restarted or self.moments.has_work():
            self._save_moments(before_deletion=False)

    def _save_moments(self, *, before_deletion: bool) -> None:
        """Saves pending moments; those of rules if bags may be deleted, or recording restarted."""
        with self._index.undisturbed() as snapshot:
            if self.moments.has_work():
                self.moments.keep(snapshot)
            if before_deletion:
                self.moments.relink_sidecars()
            if self.triggers is not None and (before_deletion or self.triggers.restarts):
                self.triggers.look(snapshot)

    def note_restart(self, first: Ns, how: Interruption) -> None:
        """Writes down that a recording ended unexpectedly, or was paused until now.

        Args:
            first: when the recording last grew (wall time).
            how: a key of `INTERRUPTIONS`.
        """
        now = self.clock.now()
        first = min(first, now)
        if self.triggers is not None and how != "paused":
            self.triggers.note_restart(first, now)
        self._note_interruption(first, now, how)

    def _note_interruption(self, first: Ns, now: Ns, how: Interruption) -> None:
        with self._lock:
            self._unwritten.append(Loss(EVERY_TOPIC, first, now + 1, 0, how))
        self._write_losses()

    def _write_losses(self) -> None:
        """Writes the losses that are noted; if the disk fails they wait for the next call."""
        with self._lock:
            try:
                if self._unwritten:
                    append_losses(self.bag_dir, self._unwritten)
            except OSError as error:
                _log.warning("losses_not_written", reason=error.strerror or str(error))
            else:
                self._unwritten.clear()

    def announce(self, recording: str) -> None:
        """Holds a new recording back until it is screened, if messages are to be excluded.

        Raises:
            RecorderError: the recording cannot be held back.
        """
        if self.screening is not None:
            self.screening.announce(recording)

    def screen(self, live: Collection[str]) -> None:
        """Begins to screen closed splits. Call it from the thread that begins recordings.

        `live` names the recordings that are being written.
        """
        if self.screening is None or self.background.is_under_way("screen"):
            return
        # Planned now: `live` may be out of date when the thread begins.
        try:
            self.background.add("screen", self.screening.plan(live))
        except (EpisodicError, OSError) as error:
            self.background.note_failure("screen", str(error))

    def finish(self) -> None:
        """Screens some more splits of each recording, and waits for all work that is under way."""
        for _ in range(_LAST_STEPS):
            self.background.add("screen", self._screen_rest)
        self.background.wait()

    def _screen_rest(self) -> None:
        if self.screening is not None:
            self.screening.plan(())()

    def status(self) -> HouseStatus:
        """Returns the results of the last pass, and what is held back at this moment."""
        if self.screening is None:
            return self._status
        return self._status._replace(
            held_back=self.screening.problem(),
            failing_rules=self.screening.failing_rules(),
        )

    def excluded_latched(self) -> frozenset[str]:
        """Returns the latched topics whose newest message is excluded."""
        return frozenset() if self.screening is None else self.screening.excluded_latched()

    def note_recorded(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float
    ) -> None:
        """Counts recorded time, by which recordings age if the wall clock is wrong.

        Call it several times a second, with no recordings while nothing is recorded.
        """
        self.collector.recorded.note(recordings, bytes_written, monotonic_s, self.clock.now())

    def _collect_and_report(self, free_bytes_wanted: int | None = None) -> Collected:
        begun = time.perf_counter_ns()
        try:
            self._save_moments(before_deletion=True)
        except (EpisodicError, OSError) as error:
            # Only reported: if it stopped the deletion, the disk would fill.
            _log.error("moments_not_minded", reason=str(error))
        before, collected = self._collected, self._collect(free_bytes_wanted)
        self._collected = collected
        self._status = self._status._replace(
            age_held=self._describe_held(collected.held),
            counted_bytes=collected.total_bytes,
            state_bytes=collected.state_bytes,
        )
        wanted = {} if free_bytes_wanted is None else {"free_bytes_wanted": free_bytes_wanted}
        (_log.info if collected.bags else _log.debug)(
            "retention_applied",
            bags=collected.bags,
            bytes=collected.bytes,
            recordings=collected.recordings,
            carried=collected.carried,
            failed=collected.failed,
            total_bytes=collected.total_bytes,
            state_bytes=collected.state_bytes,
            foreign_bytes=collected.foreign_bytes,
            duration_ms=ms_since(begun),
            **wanted,
        )
        self._report_changes(before, collected)
        self._write_losses()  # there may be room now
        if self.triggers is not None and collected.needed:
            self.triggers.note_deleted(collected.needed)
        return collected

    def _describe_held(self, bags: int) -> str | None:
        if not bags:
            return None
        limit = f"{self._limits.max_age_ns / NS_PER_HOUR:g} h"
        return (
            f"{counted(bags, 'bag is', 'bags are')} older than {limit} "
            "(retention.max_age_h) by date, but not deleted: the clock is not known to be right. "
            "They are deleted when it is synchronised with a time server (timedatectl shows that), "
            f"or when {limit} have been recorded after them"
        )

    def _collect(self, free_bytes_wanted: int | None) -> Collected:
        with self._index.undisturbed(patrolling=True) as snapshot:
            heartbeat = self._index.heartbeat()
            live = heartbeat.recordings if heartbeat else self.own.in_order()[-_WRITTEN_AT_ONCE:]
            known = self._index.known_bags(live, snapshot)
            needed = frozenset[str]()
            try:
                if self.triggers is not None:
                    needed = self.triggers.needed(snapshot)
            except OSError:  # reported when moments were saved
                # Age then deletes no bag. The budget deletes the oldest, or the disk would fill.
                needed = frozenset(bag.file for bag in snapshot.bags)
            collected = self.collector.apply(known, snapshot, needed, free_bytes_wanted)
        if collected.bags or collected.cut:
            self._index.refresh()
        return collected

    def _report_changes(self, before: Collected, collected: Collected) -> None:
        """Reports what a pass deleted unshipped, and the faults that began or ended with it."""
        if collected.unshipped:
            self._report_unshipped(collected.unshipped)
        if collected.held and not before.held:
            _log.warning("age_held", bags=collected.held, reason=self._status.age_held)
        elif before.held and not collected.held:
            _log.info("age_no_longer_held")
        if collected.foreign_bytes and not before.foreign_bytes:
            _log.warning(
                "foreign_bags_kept",
                bytes=collected.foreign_bytes,
                reason="the recorder did not make them, so they are neither deleted nor counted in "
                "the budget; `ros2-memory adopt DIR` takes those of a directory, and "
                "retention.foreign=delete all",
            )
        total, most = collected.total_bytes, self._limits.max_total_bytes
        if before.total_bytes <= most < total:
            state, saved = collected.state_bytes, collected.saved_bytes
            _log.error(
                "budget_not_held",
                total_bytes=total,
                state_bytes=state,
                reason=f"files that are never deleted exceed {most / _MB:.3g} MB: "
                f"state and logs (.episodic, .ros_log) {state / _MB:.3g} MB, saved moments "
                f"{saved / _MB:.3g} MB, memory/, latched/ and open, damaged or newest bags "
                f"{(total - state - saved) / _MB:.3g} MB; raise retention.max_total_gb",
            )

    def _report_unshipped(self, bags: Sequence[str]) -> None:
        self._unshipped += len(bags)
        deleted = counted(self._unshipped, "bag was", "bags were")
        newest = bags[: -MAX_NAMED - 1 : -1]
        sentence = (
            f"since the recorder started, {deleted} deleted unshipped, to make room "
            f"(retention.max_total_gb, min_free_gb): {listed(newest, self._unshipped)}"
        )
        self._status = self._status._replace(unshipped=sentence)
        _log.warning("unshipped_deleted", bags=len(bags), names=[*bags], reason=sentence)

    def _repair_unfinished(self, snapshot: Snapshot) -> int:
        """Repairs files that a crash left unfinished; returns how many."""
        files = [*self._unfinished_files(snapshot)]
        opened = open_files() if files else ()
        repaired = 0
        for path, status in files:
            size = status.st_size
            is_small = size <= MOST_REPAIRED_BYTES
            if is_small and self.collector.measure_free(self.bag_dir) < size:
                continue  # until there is room for the new file beside it
            if (status.st_dev, status.st_ino) in opened:
                continue
            self._tried.add((path, size, status.st_mtime_ns))
            if is_small:
                with suppress(OSError):
                    repaired += self._repair_file(path)
            else:
                reason = (
                    f"{size} bytes are too many to repair while recording: "
                    f"run ros2-memory recover {shlex.quote(str(path))}"
                )
                _log.error("bag_not_repaired", path=str(path), reason=reason)
        return repaired

    def _unfinished_files(self, snapshot: Snapshot) -> Iterator[tuple[Path, os.stat_result]]:
        """Yields the files without an end that no recording of ours writes, unless tried before."""
        paths = [bag.path for bag in snapshot.bags if bag.state is BagState.INCOMPLETE]
        paths += [aside.path for aside in snapshot.damaged]
        paths += [aside.path for aside in snapshot.active if aside.reason == HELD_BACK]
        named = {self.bag_dir / name for name in read_heartbeat(self.bag_dir).recordings}
        for path in paths:
            try:
                status = path.lstat()
            except OSError:
                continue
            if (path, status.st_size, status.st_mtime_ns) in self._tried:
                continue
            if path.suffix != MCAP or path.parent in named or is_saved(self.bag_dir, str(path)):
                continue
            if self._may_repair(path, status):
                yield path, status

    def _may_repair(self, path: Path, status: os.stat_result) -> bool:
        """Whether a file is the recorder's own, or a foreign one that nothing has written lately.

        The heartbeat does not name what other programs write.
        """
        if self._limits.keeps_foreign:
            return self.own.owns_bag(path)
        unchanged_for = abs(self.clock.now() - status.st_mtime_ns)
        return unchanged_for > self._unwritten_for or has_own_name(path.parent.name)

    def _repair_file(self, path: Path) -> bool:
        """Repairs one file and reports the result; returns whether the file was damaged."""
        begun = time.perf_counter_ns()
        try:
            repaired = self._repairer.repair(path)
        except (BagVanishedError, FileNotFoundError):
            return False
        except BagError as error:
            _log.error("bag_not_repaired", path=str(path), reason=error.reason)
            return False
        if repaired is None:
            return False
        if repaired.rewritten is None:
            _log.warning("empty_split_removed", path=str(path), notes=list(repaired.notes))
            # In case all splits of the recording were empty.
            remove_emptied(self.bag_dir, path.parent)
            return True
        _log.warning(
            "bag_repaired",
            path=str(path),
            messages=repaired.rewritten.messages,
            was_bytes=repaired.was_bytes,
            is_bytes=repaired.is_bytes,
            cut_bytes=repaired.rewritten.lost_bytes,
            reason=repaired.rewritten.describe_loss(),
            notes=list(repaired.notes),
            duration_ms=ms_since(begun),
        )
        return True

"""The index of one robot's bags in a lake, as queries need it."""

from __future__ import annotations

import threading
from bisect import bisect_right
from dataclasses import dataclass, field, replace
from datetime import date, timedelta
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple
from zlib import crc32

from ros2_memory.bag_dir.layout import COMPRESSED
from ros2_memory.core.bag_summary import BagSummary, SummarySchema
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from ros2_memory.lake.tables import day_of, end_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.lake.files import Days, Lake, LakeFile
    from ros2_memory.retention.inventory import Foreign

MOST_BAGS: Final = 45_000
"""Bags that are looked at together: a month of minutes, or some years of ten a day."""
_FEWEST_DAYS: Final = 2
"""Days that are looked at together where a time before the newest ones is asked about."""
_MOST_WINDOWS: Final = 6
"""Times before the newest days that stay in memory."""
_TOGETHER: Final = 64
"""Bags of a day whose messages are read together."""
_LOOKS: Final = 4
"""What is known of the lake serves for all robots for this part of the time that it may be old."""


class _Row(NamedTuple):
    """A row of `bags`, as far as it is read; the fields are its columns."""

    bag_id: str
    day: date
    file: str
    size: int
    sha256: str
    made_of: str
    mtime_ns: Ns
    start_ns: Ns
    end_ns: Ns
    summary: str
    counts: bytes


_BAGS: Final = f"SELECT {', '.join(_Row._fields)} FROM bags ORDER BY start_ns, end_ns, bag_id"  # noqa: S608 - constants


class LakeBag(NamedTuple):
    """One bag of a lake.

    Attributes:
        bag_id: its id there.
        day: the day that its rows are under.
        file: the bag, by the path that it had on the robot.
        together: the states by id of the bags of that day that are read together.
    """

    bag_id: str
    day: date
    file: BagFile
    together: dict[str, int]


class _Day(NamedTuple):
    """What the lake has of one day of a robot: its bags, made of the rows of some files."""

    made_of: Sequence[LakeFile]
    bags: list[LakeBag]


@dataclass(frozen=True)
class _Window:
    """Consecutive days of a robot, and what the lake has of them.

    Attributes:
        older: the end of the newest day before them, as a log time; None where there is none.
        days: what is known of each.
        timeline: the bags of all.
        bags: these by their paths.
    """

    older: Ns | None = None
    days: Mapping[date, _Day] = field(default_factory=dict)
    timeline: Timeline = field(default_factory=Timeline)
    bags: Mapping[str, LakeBag] = field(default_factory=dict)


def newest(days: Days, until: date, rows: int, fewest: int) -> tuple[Days, date | None]:
    """Returns the newest days with rows up to one, and the one before them, if there is one.

    They are those of `fewest` days, and more while all have at most `rows` rows.
    """
    order = [*days]
    begin = end = bisect_right(order, until)
    total = 0
    while begin:
        day = order[begin - 1]
        total += sum(file.rows for file in days[day])
        if total > rows and day <= order[end - 1] - timedelta(days=fewest):
            break
        begin -= 1
    found = {day: days[day] for day in order[begin:end]}
    return found, order[begin - 1] if begin else None


class LakeIndex:
    """What a lake has of one robot, as of some seconds ago. Thread-safe.

    It is of the newest days, and of other days where a question is about a time before these. Bags
    have the paths that they had on the robot. Which messages count at a handover was decided when
    they were shipped.

    Args:
        lake: the lake.
        robot: its name there.
        clock: the wall clock.
        refresh_s: how old (s) the index may be.
        days: how many days are looked at together, at least: the newest; more of few bags.
        most_bags: so many bags at most, where that is more days.

    Attributes:
        bag_dir: names no directory.
    """

    def __init__(
        self,
        lake: Lake,
        robot: str,
        clock: Clock,
        *,
        refresh_s: float,
        days: int,
        most_bags: int,
    ) -> None:
        self.bag_dir = Path("/") / robot
        self._lake = lake
        self._robot = robot
        self._clock = clock
        self._refresh_s = refresh_s
        self._fewest_days = days
        self._most_bags = most_bags
        self._lock = threading.Lock()
        self._windows: dict[date, _Window] = {}
        self._snapshot: Snapshot | None = None

    @property
    def published(self) -> Snapshot | None:
        """The index as it is known now."""
        return self._snapshot

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns an index that is not older than it may be; what is not shipped yet is not in it.

        Where `reach` is before the newest days, it is of the days up to that time.

        Raises:
            RefusedError: the lake cannot be read.
        """
        known = self._snapshot
        if known is None or self._clock.now() - known.scanned_at > self._refresh_s * 1e9:
            known = self.refresh()
        if reach is None or known.older is None or reach > known.older:
            return known
        with self._lock:
            # With the next day, in which what lies across midnight goes on.
            window = self._window(day_of(reach) + timedelta(days=1), _FEWEST_DAYS)
        return replace(known, timeline=window.timeline, older=window.older)

    def refresh(self) -> Snapshot:
        """Looks into the lake now; what was just seen there for another robot is not old."""
        with self._lock:
            self._lake.refresh(self._refresh_s / _LOOKS)
            window = self._window(date.max, self._fewest_days)
            timeline = window.timeline
            silent = {name for bag in timeline.bags for name in bag.summary.schema.silent}
            self._snapshot = Snapshot(
                timeline,
                silent_topics=frozenset(silent.difference(timeline.topics())),
                scanned_at=self._clock.now(),
                older=window.older,
            )
            return self._snapshot

    def heartbeat(self) -> Heartbeat | None:
        """Returns None: what a robot's recorder does now is not in a lake."""
        return None

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """Returns None: a lake does not know of retention."""
        del snapshot
        return None

    def bag(self, path: Path) -> LakeBag:
        """Returns the bag of a snapshot that has a path there.

        Raises:
            BagVanishedError: it is not in the lake any more.
        """
        for window in self._windows.values():
            if found := window.bags.get(str(path)):
                return found
        raise BagVanishedError(str(path), "it is not in the lake any more")

    def _window(self, until: date, fewest: int) -> _Window:
        """Returns the newest days up to one; only those are read of which a file is new."""
        window = known = self._windows.get(until, _Window())
        of_robot = self._lake.days("bags", self._robot)
        made_of, day_before = newest(of_robot, until, self._most_bags, fewest)
        days = {
            day: known.days[day]
            for day, files in made_of.items()
            if day in known.days and known.days[day].made_of == files
        }
        if not days.keys() == made_of.keys() == known.days.keys():
            unread = {day: files for day, files in made_of.items() if day not in days}
            days |= self._read(unread, known.bags)
            bags = {bag.file.file: bag for day in made_of for bag in days[day].bags}
            timeline = known.timeline.changed(
                _missing(known.bags, bags), _missing(bags, known.bags)
            )
            window = _Window(None, days, timeline, bags)
        window = replace(window, older=None if day_before is None else end_of(day_before))
        # A new dict: other threads look for the bags of their answers in the old one.
        windows = {day: one for day, one in self._windows.items() if day != until} | {until: window}
        dated = [day for day in windows if day != date.max]
        self._windows = {day: windows[day] for day in (date.max, *dated[-_MOST_WINDOWS:])}
        return window

    def _read(self, made_of: Days, known: Mapping[str, LakeBag]) -> dict[date, _Day]:
        """Returns what the lake has of some days; bags that are known keep path and object."""
        found = self._lake.select(_BAGS, "bags", chain.from_iterable(made_of.values()))
        owners = {path: bag.bag_id for path, bag in known.items()}
        schemas: dict[str, SummarySchema] = {}
        days = {day: _Day(files, []) for day, files in made_of.items()}
        for row in (_Row(**row) for row in found.to_pylist()):
            path = f"{self.bag_dir}/{row.file.removesuffix(COMPRESSED)}"
            # Another bag may have it, whose name was used again.
            if owners.setdefault(path, row.bag_id) != row.bag_id:
                path = f"{path}-{row.bag_id}"
            if row.summary not in schemas:
                schemas[row.summary] = SummarySchema.from_json(row.summary)
            summary = BagSummary.decoded(schemas[row.summary], row.counts)
            # One as large and as old may have other messages.
            state = crc32(f"{row.bag_id} {row.sha256} {row.made_of}".encode())
            span = row.start_ns, row.end_ns
            file = BagFile(path, row.size, row.mtime_ns, BagState.CLOSED, summary, *span, state)
            before = known.get(path)
            if before is not None and before.file == file:
                file = before.file  # what was remembered of it stays
            bags = days[row.day].bags
            together = bags[-1].together if len(bags) % _TOGETHER else {}
            together[row.bag_id] = state
            bags.append(LakeBag(row.bag_id, row.day, file, together))
        return days


def _missing(bags: Mapping[str, LakeBag], others: Mapping[str, LakeBag]) -> list[BagFile]:
    """Returns the files of bags that are not, or not the same, among others."""
    return [
        bag.file
        for path, bag in bags.items()
        if path not in others or others[path].file is not bag.file
    ]

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
    from ros2_memory.retention.foreign import Foreign

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

    @property
    def state(self) -> int:
        """Tells states of a bag apart: one as large and as old may have other messages."""
        return crc32(f"{self.bag_id} {self.sha256} {self.made_of}".encode())


_BAGS: Final = f"SELECT {', '.join(_Row._fields)} FROM bags ORDER BY start_ns, end_ns, bag_id"  # noqa: S608 - constants


class LakeBag(NamedTuple):
    """One bag of a lake.

    Attributes:
        bag_id: its id there.
        day: the day that its rows are under.
        together: the bags of that day that are read together, by their ids: tells the state of each
            apart from others, in which it was another time.
    """

    bag_id: str
    day: date
    together: Mapping[str, int]

    @property
    def state(self) -> int:
        """Tells its state apart from others."""
        return self.together[self.bag_id]


class _Day(NamedTuple):
    """What the lake has of one day of a robot.

    Attributes:
        made_of: the files of its rows.
        bags: its bags, as what they are there, and as files.
    """

    made_of: Sequence[LakeFile]
    bags: Sequence[tuple[LakeBag, BagFile]]


@dataclass(frozen=True)
class _Window:
    """Consecutive days of a robot, and what the lake has of them.

    Attributes:
        older: the end of the newest day before them, as a log time; None where there is none.
        days: what is known of each.
        timeline: the bags of all.
        files: these by their paths, and what they are in the lake.
    """

    older: Ns | None = None
    days: Mapping[date, _Day] = field(default_factory=dict)
    timeline: Timeline = field(default_factory=Timeline)
    files: Mapping[str, tuple[LakeBag, BagFile]] = field(default_factory=dict)


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
        self._newest = _Window()
        self._older: dict[date, _Window] = {}
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
        if reach is not None and known.older is not None and reach <= known.older:
            window = self._window_before(day_of(reach))
            known = replace(known, timeline=window.timeline, older=window.older)
        return known

    def refresh(self) -> Snapshot:
        """Looks into the lake now; what was just seen there for another robot is not old."""
        with self._lock:
            self._lake.refresh(self._refresh_s / _LOOKS)
            self._newest = self._window(date.max, self._fewest_days, self._newest)
            timeline = self._newest.timeline
            silent = {name for bag in timeline.bags for name in bag.summary.schema.silent}
            self._snapshot = Snapshot(
                timeline,
                silent_topics=frozenset(silent.difference(timeline.topics())),
                scanned_at=self._clock.now(),
                older=self._newest.older,
            )
            return self._snapshot

    def heartbeat(self) -> Heartbeat | None:
        """Returns None: what a robot's recorder does now is not in a lake."""
        return None

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """Returns None: a lake does not know of retention."""
        del snapshot
        return None

    def bag(self, path: Path) -> tuple[LakeBag, BagFile]:
        """Returns the bag of a snapshot that has a path there.

        Raises:
            BagVanishedError: it is not in the lake any more.
        """
        for window in (self._newest, *self._older.values()):
            found = window.files.get(str(path))
            if found is not None:
                return found
        raise BagVanishedError(str(path), "it is not in the lake any more")

    def _window_before(self, day: date) -> _Window:
        """Returns the days up to one, with the next, in which what lies across midnight goes on."""
        with self._lock:
            known = self._older.get(day, _Window())
            window = self._window(day + timedelta(days=1), _FEWEST_DAYS, known)
            # A new dict: other threads look for the bags of their answers in the old one.
            others = [each for each in self._older.items() if each[0] != day]
            self._older = dict([*others[1 - _MOST_WINDOWS :], (day, window)])
            return window

    def _window(self, until: date, fewest: int, known: _Window) -> _Window:
        """Returns the newest days up to one; only those are read of which a file is new."""
        of_robot = self._lake.days("bags", self._robot)
        made_of, day_before = newest(of_robot, until, self._most_bags, fewest)
        older = None if day_before is None else end_of(day_before)
        days = {
            day: known.days[day]
            for day, files in made_of.items()
            if day in known.days and known.days[day].made_of == files
        }
        if days.keys() == made_of.keys() == known.days.keys():
            return replace(known, older=older)
        paths = _Paths(known.files)
        days |= self._read({day: made_of[day] for day in made_of if day not in days}, paths)
        files = {bag.file: (here, bag) for day in made_of for here, bag in days[day].bags}
        before = {file: bag for file, (_, bag) in known.files.items()}
        now = {file: bag for file, (_, bag) in files.items()}
        gone = [bag for file, bag in before.items() if now.get(file) is not bag]
        new = [bag for file, bag in now.items() if before.get(file) is not bag]
        return _Window(older, days, known.timeline.changed(gone, new), files)

    def _read(self, made_of: Days, paths: _Paths) -> dict[date, _Day]:
        """Returns what the lake has of some days; known bags stay."""
        found = self._lake.select(_BAGS, "bags", chain.from_iterable(made_of.values()))
        rows: dict[date, list[_Row]] = {day: [] for day in made_of}
        for row in (_Row(**each) for each in found.to_pylist()):
            rows[row.day].append(row)
        schemas: dict[str, SummarySchema] = {}
        days: dict[date, _Day] = {}
        for day, of_day in rows.items():
            bags: list[tuple[LakeBag, BagFile]] = []
            for begin in range(0, len(of_day), _TOGETHER):
                some = of_day[begin : begin + _TOGETHER]
                states = {row.bag_id: row.state for row in some}
                for row in some:
                    name = row.file.removesuffix(COMPRESSED)
                    path = paths.of(f"{self.bag_dir}/{name}", row.bag_id)
                    bag = paths.known(_file(path, row, schemas))
                    bags.append((LakeBag(row.bag_id, day, states), bag))
            days[day] = _Day(made_of[day], bags)
        return days


class _Paths:
    """Gives each bag a path of its own, and bags that are known their objects.

    Args:
        files: those that are known, by their paths.
    """

    def __init__(self, files: Mapping[str, tuple[LakeBag, BagFile]]) -> None:
        self._files = files
        self._taken: dict[str, str] = {}

    def of(self, path: str, bag_id: str) -> str:
        """Returns a path; another one where another bag has it, whose name was used again."""
        known = self._files.get(path)
        first = self._taken.setdefault(path, bag_id if known is None else known[0].bag_id)
        return path if first == bag_id else f"{path}-{bag_id}"

    def known(self, bag: BagFile) -> BagFile:
        """Returns the object that is known of a bag: what was remembered of it stays."""
        known = self._files.get(bag.file)
        return known[1] if known is not None and known[1] == bag else bag


def _file(path: str, row: _Row, schemas: dict[str, SummarySchema]) -> BagFile:
    if row.summary not in schemas:
        schemas[row.summary] = SummarySchema.from_json(row.summary)
    return BagFile(
        path,
        row.size,
        row.mtime_ns,
        BagState.CLOSED,
        BagSummary.decoded(schemas[row.summary], row.counts),
        row.start_ns,
        row.end_ns,
        row.state,
    )

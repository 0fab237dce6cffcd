"""Keeps the tables of a lake small, and forgets a time of a robot in them for good.

Closed days are put into few files; old versions and their files go. pyiceberg drops old versions
from the metadata of tables, but deletes no file. A list of what lies in a store would have files of
other programs, too, also those that they are about to commit. So only files are deleted that this
program recorded when it wrote them: those below a table's own location to which no version, branch
or tag of the table refers.

What is forgotten goes with old versions, files, and late copies. Each bag goes as a whole that has
something of that time, or, where topics are forgotten, something of them: where its file is still
there without the messages, it is shipped again.

Tombstones lie in the lake's state directory and are kept for ever. Each is written durably before
anything is deleted, and again as done when all of it is gone.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import astuple, dataclass, field, replace
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.json_files import Int64, JsonLog
from ros2_memory.core.errors import LakeError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_MS, NS_PER_S, Ns
from ros2_memory.lake.rows import bag_id_of
from ros2_memory.lake.tables import TABLES, day_of, of_bags, of_ids, of_robots, overlapping
from ros2_memory.lake.warehouse import WRITTEN, LakeTables

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from datetime import date
    from pathlib import Path

    from pyiceberg.expressions import BooleanExpression
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.bag_dir.state_files import Forgetting
    from ros2_memory.lake.warehouse import Days
    from ros2_memory.storage.base import BagReader

log = get_logger(__name__)

TOMBSTONES_FILE: Final = "tombstones.jsonl"
_DAY_NS: Final[Ns] = 86_400 * NS_PER_S
FEW_FILES: Final = 3
"""A day of a robot with more files in a table is put together."""
_MOST_BYTES: Final = 128 << 20
"""Of files that are put together at once: their rows are in memory meanwhile."""
_MOST_ROBOTS: Final = 200
"""In one condition: with more names Iceberg rules no file out by them."""


def compact(lake: LakeTables, now: Ns, alive: Callable[[], object] = lambda: None) -> int:
    """Puts each closed day of each robot into one file; returns how many were.

    A day is closed a day after its end. The rows stay the same. One transaction replaces the files
    of many robots, since each writes the table's list of versions again.

    Each day is a condition of its own: a list of days is compared with every file.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    closed = day_of(now - _DAY_NS)
    done = 0
    for name in TABLES:
        for day, robots in _to_compact(lake.days(name), closed):
            alive()
            lake.replace(name, of_robots(robots, day))
            done += len(robots)
    if done:
        log.info("days_compacted", days=done)
    return done


def _to_compact(by_robot: Mapping[str, Days], closed: date) -> Iterator[tuple[date, list[str]]]:
    """Yields what to put together of the days before `closed`: a day, and some of its robots."""
    sizes = sorted(
        (day, robot, size)
        for robot, days in by_robot.items()
        for day, files in days.items()
        if day < closed and len(files) > FEW_FILES
        if (size := sum(file.size for file in files)) <= _MOST_BYTES
    )
    for day, of_day in groupby(sizes, itemgetter(0)):
        robots, total = list[str](), 0
        for _, robot, size in of_day:
            if total + size > _MOST_BYTES or len(robots) == _MOST_ROBOTS:
                yield day, robots
                robots, total = [], 0
            robots.append(robot)
            total += size
        yield day, robots


def expire(lake: LakeTables, until: Ns) -> int:
    """Drops the versions of up to a time, and deletes the files that are left without one.

    The newest version stays, and those that a branch or a tag names. Returns how many files.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    gone: set[str] = set()
    state_dir = lake.location.state_dir
    with lake.location.translated("deleting old files of the lake"):
        tables = [lake.current(name) for name in TABLES]
        for table in tables:
            _drop_versions(table, until)
        recorded = WRITTEN.rows(state_dir)
        outdated = [written.file for written in recorded if written.at < until]
        try:
            for table in tables:
                for file in _unreferenced(table, outdated):
                    with suppress(FileNotFoundError):  # as after a kill
                        table.io.delete(file)
                    gone.add(file)
        finally:
            if gone:
                left = [written for written in recorded if written.file not in gone]
                WRITTEN.replace(state_dir, left)
    if gone:
        log.info("old_files_deleted", files=len(gone))
    return len(gone)


def _drop_versions(table: IcebergTable, until: Ns) -> None:
    """Drops the versions of up to a time, but those that a branch or a tag names."""
    times = {version.snapshot_id: version.timestamp_ms for version in table.metadata.snapshots}
    old = {version for version, time_ms in times.items() if time_ms * NS_PER_MS <= until}
    old -= {ref.snapshot_id for ref in table.metadata.refs.values()}
    if old:
        table.maintenance.expire_snapshots().by_ids([*old]).commit()


def _unreferenced(table: IcebergTable, files: Sequence[str]) -> Sequence[str]:
    """Returns those of some files below a table's location that none of its versions refers to."""
    location = f"{table.location().rstrip('/')}/"
    below = {file for file in files if file.startswith(location) and ".." not in file}
    if not below:
        return ()
    metadata, io, versions = table.metadata, table.io, table.metadata.snapshots
    below -= {table.metadata_location, *(version.manifest_list for version in versions)}
    below -= {statistics.statistics_path for statistics in metadata.statistics}
    manifests = [manifest for version in versions for manifest in version.manifests(io)]
    for path, manifest in {manifest.manifest_path: manifest for manifest in manifests}.items():
        entries = manifest.fetch_manifest_entry(io, discard_deleted=True)
        below -= {path, *(entry.data_file.file_path for entry in entries)}
    return sorted(below)


@dataclass(frozen=True, slots=True)
class Tombstone:
    """Messages of a robot that were forgotten: those of a window (log times, half-open).

    Where there are `topics`, only theirs; where there are `bags`, all of these alone, by their ids.
    `done`: all of it is gone; two that differ in that alone are equal.
    """

    robot: str
    start: Int64
    stop: Int64
    topics: tuple[str, ...] = ()
    bags: tuple[str, ...] = ()
    done: bool = field(default=False, compare=False)

    @property
    def window(self) -> TimeWindow:
        """The time that is forgotten."""
        return TimeWindow(self.start, self.stop)

    @classmethod
    def of(cls, robot: str, forgetting: Forgetting) -> Tombstone:
        """Returns what a robot's bag directory asks for."""
        ids = [bag_id_of(robot, *astuple(bag)) for bag in forgetting.bags]
        return cls(robot, forgetting.start, forgetting.stop, forgetting.topics, tuple(ids))

    def rows(self, first: str, last: str) -> BooleanExpression:
        """Returns the condition on the rows to delete, by their columns of first and last time."""
        if self.bags:
            return of_ids(self.robot, self.bags)
        return overlapping(self.robot, (first, last), self.window, self.topics)

    def forbids(self, reader: BagReader, bag: BagFile, bag_id: str) -> bool:
        """Returns whether a bag of the robot has a message that was forgotten.

        Raises:
            BagError: it cannot be read.
        """
        if self.bags:
            return bag_id in self.bags
        if not self.window.overlaps(bag.start, bag.end):
            return False
        topics = {topic.topic for topic in bag.summary.topics}
        wanted = topics.intersection(self.topics or topics)
        return any(True for _ in reader.records(bag.path, wanted, self.window))


TOMBSTONES: Final = JsonLog(TOMBSTONES_FILE, Tombstone)


def append_tombstone(state_dir: Path, tombstone: Tombstone, *, done: bool) -> None:
    """Appends a tombstone durably, or that it is done.

    Raises:
        LakeError: it cannot be written.
    """
    try:
        TOMBSTONES.append(state_dir, [replace(tombstone, done=done)])
    except OSError as error:
        path = state_dir / TOMBSTONES_FILE
        raise LakeError(f"{path} cannot be written: {error.strerror}") from error


def read_tombstones(state_dir: Path) -> list[Tombstone]:
    """Returns the tombstones, each once; one is done if any line on it says so.

    Raises:
        LakeError: they cannot be read, or a line is damaged: nothing may be shipped then.
    """
    try:
        tombstones = [tombstone for _, tombstone in TOMBSTONES.all_rows(state_dir)]
    except (OSError, ValueError) as error:
        why = "nothing is shipped until it is repaired, since what was forgotten could come back"
        raise LakeError(f"{state_dir / TOMBSTONES_FILE}: {error}; {why}") from error
    done = {tombstone for tombstone in tombstones if tombstone.done}
    return [replace(tombstone, done=tombstone in done) for tombstone in dict.fromkeys(tombstones)]


class Forgotten(NamedTuple):
    """What is gone: how many bags, and files; `kept_by` names tags and branches that keep some."""

    bags: int
    files: int
    kept_by: tuple[str, ...]


def forget_in_lake(lake: LakeTables, tombstone: Tombstone) -> Forgotten:
    """Deletes what a tombstone names, which is written already; killed anywhere, it is done again.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    # `channels` has a row of each bag of which anything is in the lake: it is the first to be
    # committed, and the last from which is deleted.
    bags = _bags_where(lake, "channels", tombstone.rows("first_ns", "last_ns"))
    # In `bags` alone: of which no message counts, and what a killed process was about to replace.
    of_any_topic = replace(tombstone, topics=())
    listed = _bags_where(lake, "bags", of_any_topic.rows("start_ns", "end_ns"))
    if tombstone.topics and listed:
        ids = of_ids(tombstone.robot, {bag_id for *_, bag_id in listed})
        listed -= _bags_where(lake, "channels", ids)
    bags |= listed
    for name in reversed([*TABLES]):
        lake.delete(name, of_bags(bags))
    # The versions before have what was deleted, so they go whatever their age, and the clock says.
    files = expire(lake, MAX_NS)
    metadata = {name: lake.current(name).metadata for name in TABLES}
    kept_by = tuple(
        f"{name}: {ref}"
        for name, of_table in metadata.items()
        for ref, version in of_table.refs.items()
        if version.snapshot_id != of_table.current_snapshot_id
    )
    append_tombstone(lake.location.state_dir, tombstone, done=True)
    log.info("forgotten_in_lake", robot=tombstone.robot, bags=len(bags), files=files)
    return Forgotten(len(bags), files, kept_by)


def _bags_where(
    lake: LakeTables, name: str, condition: BooleanExpression
) -> set[tuple[str, date, str]]:
    """Returns robot, day and id of the bags that have some rows."""
    rows = lake.rows(name, condition, ("robot", "day", "bag_id")).to_pylist()
    return {(row["robot"], row["day"], row["bag_id"]) for row in rows}

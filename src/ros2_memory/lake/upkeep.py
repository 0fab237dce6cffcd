"""Keeps the tables of a lake small, and forgets a time of a robot in them for good.

Closed days are compacted into few files; old versions and their files are deleted. pyiceberg drops
old versions from the metadata of tables, but deletes no file. A listing of the store would also
have files of other programs, even some that are about to be committed. So this program deletes only
files that it recorded when it wrote them, that lie below a table's location, and to which no
version, branch or tag of the table refers.

Forgotten messages go from all versions, files, and copies that are shipped later. A bag with any
forgotten message goes as a whole. If its file is still there without the messages, it is shipped
again.

Tombstones lie in the lake's state directory and are kept for ever. Each is written durably before
anything is deleted, and again as done when all of it is gone.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import astuple, dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.json_files import Int64, JsonLog
from ros2_memory.core.errors import LakeError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_DAY, NS_PER_MS, Ns, utc_day
from ros2_memory.lake.rows import bag_id_of
from ros2_memory.lake.tables import (
    TABLES,
    bags_condition,
    rows_with,
    window_condition,
)
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
FEW_FILES: Final = 3
"""A day of a robot with more files in a table is compacted."""
_MOST_BYTES: Final = 128 << 20
"""Bytes of files that are compacted at once: their rows are in memory meanwhile."""
_MOST_ROBOTS: Final = 200
"""Robots in one condition: Iceberg rules out no file by a longer list."""


def compact(lake: LakeTables, now: Ns, alive: Callable[[], object] = lambda: None) -> int:
    """Rewrites each closed day of each robot as one file; returns how many days that were.

    A day is closed a day after its end. The rows stay the same. One transaction replaces the files
    of many robots, since each one writes the table's list of versions again. It is of one day,
    since Iceberg compares a list of days with every file.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    closed = utc_day(now - NS_PER_DAY)
    done = 0
    for name in TABLES:
        for day, robots in _to_compact(lake.days(name), closed):
            alive()
            lake.replace(name, rows_with(robot=robots, day=[day.isoformat()]))
            done += len(robots)
    if done:
        log.info("days_compacted", days=done)
    return done


def _to_compact(by_robot: Mapping[str, Days], closed: date) -> Iterator[tuple[date, list[str]]]:
    """Yields the days before `closed` that have many files, each with robots to compact at once."""
    sizes: dict[date, dict[str, int]] = {}
    for robot, days in sorted(by_robot.items()):
        for day, files in days.items():
            size = sum(file.size for file in files)
            if day < closed and len(files) > FEW_FILES and size <= _MOST_BYTES:
                sizes.setdefault(day, {})[robot] = size
    for day, of_day in sorted(sizes.items()):
        robots, total = list[str](), 0
        for robot, size in of_day.items():
            if total + size > _MOST_BYTES or len(robots) == _MOST_ROBOTS:
                yield day, robots
                robots, total = [], 0
            robots.append(robot)
            total += size
        yield day, robots


def expire(lake: LakeTables, until: Ns) -> int:
    """Drops the versions up to a time, and deletes the files that no version needs any more.

    The newest version stays, and so do those that a branch or a tag names. Returns how many files
    were deleted.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    gone: set[str] = set()
    state_dir = lake.location.state_dir
    with lake.location.translated("deleting old files of the lake"):
        tables = [table.refresh() for table in lake.tables.values()]
        for table in tables:
            _drop_versions(table, until)
        recorded = WRITTEN.rows(state_dir)
        outdated = [written.file for written in recorded if written.at < until]
        for table in tables:
            for file in _unreferenced(table, outdated):
                with suppress(FileNotFoundError):  # as after a kill
                    table.io.delete(file)
                gone.add(file)
        if gone:
            left = [written for written in recorded if written.file not in gone]
            WRITTEN.replace(state_dir, left)
    if gone:
        log.info("old_files_deleted", files=len(gone))
    return len(gone)


def _drop_versions(table: IcebergTable, until: Ns) -> None:
    """Drops the versions up to a time, except those that a branch or a tag names."""
    times = {version.snapshot_id: version.timestamp_ms for version in table.metadata.snapshots}
    old = {version for version, time_ms in times.items() if time_ms * NS_PER_MS <= until}
    old -= {ref.snapshot_id for ref in table.metadata.refs.values()}
    if old:
        table.maintenance.expire_snapshots().by_ids([*old]).commit()


def _unreferenced(table: IcebergTable, files: Sequence[str]) -> Sequence[str]:
    """Returns the files below a table's location to which none of its versions refers."""
    location = f"{table.location().rstrip('/')}/"
    unreferenced = {file for file in files if file.startswith(location) and ".." not in file}
    if not unreferenced:
        return ()
    metadata, io, versions = table.metadata, table.io, table.metadata.snapshots
    unreferenced -= {table.metadata_location, *(version.manifest_list for version in versions)}
    unreferenced -= {statistics.statistics_path for statistics in metadata.statistics}
    manifests = {
        manifest.manifest_path: manifest
        for version in versions
        for manifest in version.manifests(io)
    }
    for path, manifest in manifests.items():
        entries = manifest.fetch_manifest_entry(io, discard_deleted=True)
        unreferenced -= {path, *(entry.data_file.file_path for entry in entries)}
    return sorted(unreferenced)


@dataclass(frozen=True, slots=True)
class Tombstone:
    """Messages of a robot that were forgotten: those between two log times (half-open).

    Attributes:
        topics: only messages of these topics, if there are any.
        bags: in place of the messages of the time, all of the bags with these ids, if there are
            any.
        done: whether all of it is gone; not compared.
    """

    robot: str
    start: Int64
    stop: Int64
    topics: tuple[str, ...] = ()
    bags: tuple[str, ...] = ()
    done: bool = field(default=False, compare=False)

    @property
    def window(self) -> TimeWindow:
        """The time as a window."""
        return TimeWindow(self.start, self.stop)

    @classmethod
    def of(cls, robot: str, forgetting: Forgetting) -> Tombstone:
        """Returns the tombstone for an entry of a robot's bag directory."""
        ids = [bag_id_of(robot, *astuple(bag)) for bag in forgetting.bags]
        return cls(robot, forgetting.start, forgetting.stop, forgetting.topics, tuple(ids))

    def rows(self, first: str, last: str) -> BooleanExpression:
        """Returns the condition for the rows to delete; `first` and `last` are columns of times."""
        if self.bags:
            return rows_with(robot=[self.robot], bag_id=self.bags)
        return window_condition(self.robot, (first, last), self.window, self.topics)

    def forbids(self, reader: BagReader, bag: BagFile, bag_id: str) -> bool:
        """Returns whether a bag of the robot has a forgotten message.

        Raises:
            BagError: the bag cannot be read.
        """
        if self.bags:
            return bag_id in self.bags
        if not bag.reaches_into(self.window):
            return False
        topics = bag.summary.schema.positions.keys()
        forgotten = topics & {*(self.topics or topics)}
        return next(iter(reader.records(bag.path, forgotten, self.window)), None) is not None


TOMBSTONES: Final = JsonLog(TOMBSTONES_FILE, Tombstone)


def append_tombstone(state_dir: Path, tombstone: Tombstone, *, done: bool) -> None:
    """Appends a tombstone durably.

    Raises:
        LakeError: it cannot be written.
    """
    try:
        TOMBSTONES.append(state_dir, [replace(tombstone, done=done)])
    except OSError as error:
        path = state_dir / TOMBSTONES_FILE
        raise LakeError(f"{path} cannot be written: {error.strerror}") from error


def read_tombstones(state_dir: Path) -> list[Tombstone]:
    """Returns the tombstones, each once. A tombstone is done if any of its lines is.

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
    """How many bags and files were deleted.

    `kept_by` names the tags and branches that still have forgotten messages.
    """

    bags: int
    files: int
    kept_by: tuple[str, ...]


def forget_in_lake(lake: LakeTables, tombstone: Tombstone) -> Forgotten:
    """Writes a tombstone, and deletes the rows that it names, in all versions.

    After a kill it is called again.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    append_tombstone(lake.location.state_dir, tombstone, done=False)
    bags = _bags_to_forget(lake, tombstone)
    # `channels` comes last: while it has a row of a bag, other tables may have some.
    for name in reversed([*TABLES]):
        lake.delete(name, bags_condition(bags))
    # Earlier versions still have the rows, so they go whatever their age is.
    files = expire(lake, MAX_NS)
    kept_by: list[str] = []
    for name, table in lake.tables.items():
        for ref, version in table.metadata.refs.items():
            if version.snapshot_id != table.metadata.current_snapshot_id:
                kept_by.append(f"{name}: {ref}")
    append_tombstone(lake.location.state_dir, tombstone, done=True)
    log.info("forgotten_in_lake", robot=tombstone.robot, bags=len(bags), files=files)
    return Forgotten(len(bags), files, tuple(kept_by))


def _bags_to_forget(lake: LakeTables, tombstone: Tombstone) -> set[tuple[str, date, str]]:
    """Returns robot, day and id of the bags that a tombstone names."""
    bags = _bags_where(lake, "channels", tombstone.rows("first_ns", "last_ns"))
    # A bag without messages that count has rows in `bags` alone, and so has one that a killed
    # process was about to replace. Their topics are not known.
    of_any_topic = replace(tombstone, topics=())
    listed = _bags_where(lake, "bags", of_any_topic.rows("start_ns", "end_ns"))
    if tombstone.topics and listed:
        ids = rows_with(robot=[tombstone.robot], bag_id={bag_id for _, _, bag_id in listed})
        listed -= _bags_where(lake, "channels", ids)
    return bags | listed


def _bags_where(
    lake: LakeTables, name: str, condition: BooleanExpression
) -> set[tuple[str, date, str]]:
    """Returns robot, day and id of the bags with rows in a table that meet a condition."""
    rows = lake.rows(name, condition, ("robot", "day", "bag_id")).to_pylist()
    return {(row["robot"], row["day"], row["bag_id"]) for row in rows}

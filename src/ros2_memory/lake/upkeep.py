"""Keeps the tables of a lake small: closed days in few files, old versions and their files gone.

pyiceberg drops old versions from the metadata of tables, but deletes no file. A list of what lies
in a store would have files of other programs, too, also those that they are about to commit. So
only files are deleted that this program recorded when it wrote them: those below a table's own
location to which no version, branch or tag of the table refers.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

from pyiceberg.manifest import ManifestEntryStatus

from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns
from ros2_memory.lake.files import Partitions
from ros2_memory.lake.tables import TABLES, day_of, of_robots
from ros2_memory.lake.warehouse import WRITTEN

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from datetime import date

    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.lake.warehouse import LakeTables

log = get_logger(__name__)

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

    Raises:
        LakeError: the lake cannot be read or written.
    """
    closed = day_of(now - _DAY_NS)
    done = 0
    for name, table in TABLES.items():
        for day, robots in _to_compact(lake.current(name), closed):
            alive()
            condition = of_robots(robots, day)
            lake.replace(name, condition, table.sorted(lake.rows(name, condition)))
            done += len(robots)
    if done:
        log.info("days_compacted", days=done)
    return done


def _to_compact(table: IcebergTable, closed: date) -> Iterator[tuple[date, list[str]]]:
    """Yields what to put together of the days before `closed`: a day, and some of its robots."""
    sizes = sorted(
        (day, robot, sum(file.size for file in files))
        for robot, days in Partitions().look(table).items()
        for day, files in days.items()
        if day < closed and len(files) > FEW_FILES
    )
    some: dict[str, int] = {}
    last = closed
    for day, robot, size in sizes:
        is_full = sum(some.values()) + size > _MOST_BYTES or len(some) == _MOST_ROBOTS
        if some and (is_full or day != last):
            yield last, [*some]
            some = {}
        if size <= _MOST_BYTES:
            some[robot] = size
        last = day
    if some:
        yield last, [*some]


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
            kept = {ref.snapshot_id for ref in table.metadata.refs.values()}
            old = [
                version.snapshot_id
                for version in table.metadata.snapshots
                if version.snapshot_id not in kept and version.timestamp_ms * NS_PER_MS <= until
            ]
            if old:
                table.maintenance.expire_snapshots().by_ids(old).commit()
                table.refresh()
        recorded = WRITTEN.rows(state_dir)
        own = [written.file for written in recorded if written.at < until]
        try:
            for table in tables:
                below = f"{table.location().rstrip('/')}/"
                files = {file for file in own if file.startswith(below) and ".." not in file}
                for file in sorted(files - _referenced(table)) if files else ():
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


def _referenced(table: IcebergTable) -> set[str]:
    """Returns the files that some version, branch or tag of a table refers to."""
    found = {table.metadata_location}
    found.update(statistics.statistics_path for statistics in table.metadata.statistics)
    for snapshot in table.metadata.snapshots:
        found.add(snapshot.manifest_list)
        for manifest in snapshot.manifests(table.io):
            if manifest.manifest_path not in found:
                found.add(manifest.manifest_path)
                found.update(
                    entry.data_file.file_path
                    for entry in manifest.fetch_manifest_entry(table.io, discard_deleted=False)
                    if entry.status is not ManifestEntryStatus.DELETED
                )
    return found

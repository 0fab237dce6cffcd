"""Keeps the tables of a lake small: closed days in few files, old versions and their files gone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import MAX_NS, NS_PER_MS, NS_PER_S, Ns
from ros2_memory.lake.conditions import of_robots
from ros2_memory.lake.partitions import Partitions
from ros2_memory.lake.tables import TABLES, day_of
from ros2_memory.lake.warehouse import quiet_deletes
from ros2_memory.lake.written_files import delete_unreferenced

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from datetime import date

    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.lake.warehouse import LakeLocation

log = get_logger(__name__)

_DAY_NS: Final[Ns] = 86_400 * NS_PER_S
FEW_FILES: Final = 3
"""A day of a robot with more files in a table is put together."""
_MOST_BYTES: Final = 128 << 20
"""Of files that are put together at once: their rows are in memory meanwhile."""
_MOST_ROBOTS: Final = 200
"""In one condition: with more names Iceberg rules no file out by them."""


def compact(
    location: LakeLocation,
    tables: Mapping[str, IcebergTable],
    now: Ns,
    alive: Callable[[], object] = lambda: None,
) -> int:
    """Puts each closed day of each robot into one file; returns how many were.

    A day is closed a day after its end. The rows stay the same. One transaction replaces the files
    of many robots, since each writes the table's list of versions again.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    closed = day_of(now - _DAY_NS)
    done = 0
    for name, table in tables.items():
        with location.translated(f"putting together the lake's {name}"):
            order = [(each, "ascending") for each in TABLES[name].order]
            for day, robots in _to_compact(table.refresh(), closed):
                alive()
                condition = of_robots(robots, day)
                whole = table.refresh().scan(row_filter=condition).to_arrow()
                with quiet_deletes():
                    table.overwrite(whole.sort_by(order), overwrite_filter=condition)
                done += len(robots)
    if done:
        log.info("days_compacted", days=done)
    return done


def _to_compact(table: IcebergTable, closed: date) -> list[tuple[date, list[str]]]:
    """Returns what to put together of the days before `closed`: a day, and some of its robots."""
    parts = {
        (day, robot): files
        for robot, days in Partitions().look(table).items()
        for day, files in days.items()
        if day < closed
    }
    found: list[tuple[date, list[str]]] = []
    room = 0
    for day, robot in sorted(parts):
        size = sum(each.size for each in parts[day, robot])
        if len(parts[day, robot]) <= FEW_FILES or size > _MOST_BYTES:
            continue
        room -= size
        if not found or found[-1][0] != day or room < 0 or len(found[-1][1]) == _MOST_ROBOTS:
            found.append((day, []))
            room = _MOST_BYTES - size
        found[-1][1].append(robot)
    return found


def expire(location: LakeLocation, tables: Mapping[str, IcebergTable], now: Ns, grace: Ns) -> int:
    """Drops versions that are older than `grace`, and deletes the files that are left without one.

    Without grace all of them, whatever the clock says.

    The newest version stays, and those that a branch or a tag names.

    Returns:
        How many files were deleted.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    until = now - grace if grace else MAX_NS
    with location.translated("deleting old files of the lake"):
        for table in tables.values():
            metadata = table.refresh().metadata
            kept = {each.snapshot_id for each in metadata.refs.values()}
            old = [
                each.snapshot_id
                for each in metadata.snapshots
                if each.snapshot_id not in kept and each.timestamp_ms * NS_PER_MS <= until
            ]
            if old:
                table.maintenance.expire_snapshots().by_ids(old).commit()
            table.refresh()
        files = delete_unreferenced(location.state_dir, tables.values(), until)
    if files:
        log.info("old_files_deleted", files=files)
    return files

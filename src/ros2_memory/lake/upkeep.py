"""Keeps the tables of a lake small: closed days in few files, old versions and their files gone."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, date, datetime
from typing import TYPE_CHECKING, Final

from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import MAX_NS, NS_PER_MS, NS_PER_S, Ns
from ros2_memory.lake.conditions import of_day
from ros2_memory.lake.tables import TABLES, day_of
from ros2_memory.lake.warehouse import quiet_deletes
from ros2_memory.lake.written_files import delete_unreferenced

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.lake.warehouse import LakeLocation

log = get_logger(__name__)

_DAY_NS: Final[Ns] = 86_400 * NS_PER_S
FEW_FILES: Final = 3
"""A day of a robot with more files in a table is put together."""
_MOST_ROWS: Final = 10_000_000
"""Of a day that is put together: they are in memory meanwhile."""


def compact(
    location: LakeLocation,
    tables: Mapping[str, IcebergTable],
    now: Ns,
    alive: Callable[[], object] = lambda: None,
) -> int:
    """Puts each closed day of each robot into one file, in one transaction; returns how many.

    A day is closed a day after its end. The rows stay the same.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    closed = day_of(now - _DAY_NS)
    done = 0
    for name, table in tables.items():
        with location.translated(f"putting together the lake's {name}"):
            files: Counter[tuple[str, date]] = Counter()
            rows: Counter[tuple[str, date]] = Counter()
            for task in table.refresh().scan().plan_files():
                robot, day = task.file.partition[0], _day(task.file.partition[1])
                files[robot, day] += 1
                rows[robot, day] += task.file.record_count
            for (robot, day), many in files.items():
                if day >= closed or many <= FEW_FILES or rows[robot, day] > _MOST_ROWS:
                    continue
                alive()
                condition = of_day(robot, day)
                whole = table.refresh().scan(row_filter=condition).to_arrow()
                order = [(each, "ascending") for each in TABLES[name].order]
                with quiet_deletes():
                    table.overwrite(whole.sort_by(order), overwrite_filter=condition)
                done += 1
    if done:
        log.info("days_compacted", days=done)
    return done


def _day(value: object) -> date:
    """Returns the day of a partition, which is a date or days since the epoch."""
    if isinstance(value, date):
        return value
    return datetime.fromtimestamp(int(str(value)) * 86_400, tz=UTC).date()


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
            kept.add(metadata.current_snapshot_id or 0)
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

"""Keeps the tables of a lake small: closed days in few files, old versions and their files gone."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Final

from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.lake.conditions import of_robots
from ros2_memory.lake.files import Partitions
from ros2_memory.lake.tables import TABLES, day_of

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
    for day, group in groupby(sizes, key=lambda part: part[0]):
        robots: list[str] = []
        room = _MOST_BYTES
        for _, robot, size in group:
            if size > _MOST_BYTES:
                continue
            if robots and (size > room or len(robots) == _MOST_ROBOTS):
                yield day, robots
                robots, room = [], _MOST_BYTES
            robots.append(robot)
            room -= size
        if robots:
            yield day, robots


def expire(lake: LakeTables, until: Ns) -> int:
    """Drops versions of up to a time, and deletes their files; returns how many of these.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    files = lake.expire(until)
    if files:
        log.info("old_files_deleted", files=files)
    return files

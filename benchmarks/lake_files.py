"""`python -m benchmarks.lake_files`: what the lists of a lake's files take, for each file.

One small file of each robot and day in one table, as closed days have.
"""

from __future__ import annotations

import tempfile
import time
import tracemalloc
from datetime import date, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.timebase import NS_PER_S, WallClock
from ros2_memory.lake.tables import TABLES
from ros2_memory.lake.upkeep import expire
from ros2_memory.lake.warehouse import LakeLocation, Partitions

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.lake.tables import Row

TABLE, ROBOTS, DAYS = "things", 500, 6
FILES = ROBOTS * DAYS
DAY = date(2026, 11, 20)


def rows_of(day: int) -> list[Row]:
    """Returns a row of each robot."""
    keys = {"day": DAY + timedelta(days=day), "topic": "/seen", "label": "cup", "first_ns": day}
    return [{**keys, "robot": f"r{n:04}", "bag_id": f"{day:016x}{n:016x}"} for n in range(ROBOTS)]


def spent_us(run: Callable[[], object]) -> float:
    """Returns the processor time of a call (us) for each file."""
    begun = time.process_time()
    run()
    return (time.process_time() - begun) * 1e6 / FILES


def main() -> None:
    """Prints the figures."""
    configure_logging("error", "json")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with LakeLocation(folder.as_uri(), folder / "state").writable() as lake:
            for day in range(DAYS):
                lake.tables[TABLE].append(TABLES[TABLE].to_arrow(rows_of(day)))
            until = WallClock().now() + NS_PER_S
            expire(lake, until)
            table = lake.tables[TABLE].refresh()
            print(f"read: {spent_us(lambda: Partitions().read(table)):.0f} us a file")
            print(f"look for old ones: {spent_us(lambda: expire(lake, until)):.0f} us a file")
            tracemalloc.start()
            known = Partitions()
            known.read(table)
            print(f"in memory: {tracemalloc.get_traced_memory()[0] / FILES:.0f} B a file")
            tracemalloc.stop()
            lists = sum(path.stat().st_size for path in folder.rglob("*-m*.avro"))
            print(f"in the lake: {lists / FILES:.0f} B a file")


if __name__ == "__main__":
    main()

"""`python -m benchmarks.lake_years`: what questions to a lake of years take: few bags, many days.

Robots with two bags of ten seconds a day, whose rows are those of one robot under other names. The
questions are about all days, about a day two years back, and again with so few bags looked at
together that most days are looked at only where a question's end is there.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import shutil
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pyarrow as pa

from benchmarks.bags import ODOM, SCENE, Split, write_split
from benchmarks.digests import made_known
from benchmarks.footprint import resident_mb
from benchmarks.lake import answered, catalog_in, rows_of_world, settings_of
from benchmarks.report import machine
from ros2_memory.bootstrap import build_memory, build_server, query_settings_of, shared_parts
from ros2_memory.core.timebase import NS_PER_S, WallClock
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.lake.engines.duckdb_engine import DuckdbEngine
from ros2_memory.lake.files import Lake
from ros2_memory.lake.memory.robot import LakeRobot
from ros2_memory.lake.tables import TABLES, open_tables, to_arrow

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.context import Memory

_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
_FIRST_S: Final = 1_704_099_600  # 2024-01-01T09:00:00Z
_DAY_S: Final = 86_400
_HOURS: Final = (0, 8)
"""After the first bag of a day."""
_FEW_BAGS: Final = 60


def questions(days: int) -> Mapping[str, tuple[str, Mapping[str, JsonValue]]]:
    """Returns, by words, a tool and its arguments."""
    ever: dict[str, JsonValue] = {"start": _FIRST_S, "end": _FIRST_S + days * _DAY_S}
    first: dict[str, JsonValue] = {"start": _FIRST_S, "end": _FIRST_S + 12 * 3600}
    seen: dict[str, JsonValue] = {
        "topic": SCENE.name,
        "condition_type": "contains",
        "value": "chair",
    }
    return {
        "which robot last saw it": ("find_last_match", seen),
        "which robot last saw it before the second day": (
            "find_last_match",
            {**seen, "before": _FIRST_S + _DAY_S - 1},
        ),
        "that no robot saw": ("find_last_match", {**seen, "value": "elephant"}),
        "metres by robot and weekday, ever": ("trajectory_summary", {**ever, "by": "weekday"}),
        "metres by robot and day, of a month": (
            "trajectory_summary",
            {"start": _FIRST_S, "end": _FIRST_S + 30 * _DAY_S, "by": "day"},
        ),
        "visits to a place, ever": ("visits", {"where": {"x": 0.0, "y": 0.0, "radius_m": 1.0}}),
        "recap of the first day": ("recap", first),
        "recap of all days": ("recap", ever),
        "data_time_range": ("data_time_range", {}),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Makes the lake where it is missing, asks, and prints; 1 where a question has no answer."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lake_years", description=__doc__)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--days", type=int, default=730)
    parser.add_argument("--dir", type=Path, default=_DIR, help="where the lake is kept")
    given = parser.parse_args(argv)
    folder = given.dir / f"lake_years_{given.robots}_{given.days}"
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    os.environ["TZ"] = "UTC"  # the days of the robots
    time.tzset()
    names = [f"r{number:02d}" for number in range(given.robots)]
    if not (folder / "made").is_file():
        _make(folder, names, given.days)
    return asyncio.run(_asked(folder, names, given.days))


def _make(folder: Path, names: Sequence[str], days: int) -> None:
    bags = folder / "bags" / "rec_0000"
    bags.mkdir(parents=True, exist_ok=True)
    # What was begun and not finished would be in the lake twice.
    shutil.rmtree(folder / "files", ignore_errors=True)
    (folder / "lake.sqlite").unlink(missing_ok=True)
    (folder / "places.yaml").write_text("places: {}\n")
    (folder / "labels.yaml").write_text("labels: {}\n")
    for number in range(days * len(_HOURS)):
        day, nth = divmod(number, len(_HOURS))
        at = (_FIRST_S + day * _DAY_S + _HOURS[nth] * 3600) * NS_PER_S
        split = Split(number, bags / f"rec_0000_{number}.mcap", at, number)
        write_split(split, [split], (ODOM, SCENE))
    settings = settings_of(folder, bags.parent)
    memory = build_memory(settings)
    for _ in range(2):  # a busy machine may leave a bag for later
        made_known(memory, settings)
    tables, rows = open_tables(catalog_in(folder), TABLES), rows_of_world(memory)
    for name in names:
        for table in TABLES:
            of_days = [
                to_arrow(TABLES[table], name, day, {f"{name}{bag}": own for bag, own in of.items()})
                for (other, day), of in rows.items()
                if other == table
            ]
            if of_days:
                tables[table].append(pa.concat_tables(of_days))
    (folder / "made").touch()


async def _asked(folder: Path, names: Sequence[str], days: int) -> int:
    settings = settings_of(folder, folder / "none")
    limits, shared = query_settings_of(settings), shared_parts(settings)
    size = sum(each.stat().st_size for each in folder.rglob("*.parquet"))
    files = sum(1 for _ in folder.rglob("*.parquet"))
    print(f"{len(names)} robots, {days} days, {files} files of {size / 1e6:.0f} MB, {machine()}")
    missed = False
    for words, most_bags in (("all days", len(_HOURS) * days), (f"{_FEW_BAGS} bags", _FEW_BAGS)):
        lake = Lake(catalog_in(folder), DuckdbEngine())

        def memory_of(name: str, lake: Lake = lake, most_bags: int = most_bags) -> Memory:
            robot = LakeRobot(
                lake, name, WallClock(), limits, shared.extractor, days=1, most_bags=most_bags
            )
            return robot.memory

        fleet = Fleet(
            [Robot(name, folder, partial(memory_of, name)) for name in names],
            WallClock(),
            shared_map=True,
        )
        dispatcher = build_server(settings, build_memory(settings), fleet=fleet).dispatcher
        print(f"\nlooked at together: {words}")
        missed |= await answered(dispatcher, questions(days), {})
        dispatcher.stop()
        print(f"\nresident: {resident_mb('VmRSS'):.0f} MB")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())

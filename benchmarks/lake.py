"""`python -m benchmarks.lake`: what questions to a lake take: many robots, each with a day.

The rows are of a few home robots' days, told apart by their seed; other robots have the same rows
under names of their own. First the server looks into the lake, as it does when it starts, and then
every half minute. Then each question is asked the first time, and again, of which the fastest
counts.
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

from pyiceberg.catalog.sql import SqlCatalog

from benchmarks.digests import made_known
from benchmarks.footprint import resident_mb
from benchmarks.home.__main__ import made
from benchmarks.home.days import Scale
from benchmarks.home.world import START_S, VISION
from benchmarks.home_week import condition
from benchmarks.report import machine
from ros2_memory.bootstrap import build_memory, build_server, query_settings_of, shared_parts
from ros2_memory.catalogue.store import BagKey
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import WallClock
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.lake.engines.duckdb_engine import DuckdbEngine
from ros2_memory.lake.files import Lake
from ros2_memory.lake.memory.robot import LakeRobot
from ros2_memory.lake.rows import BagContent, bag_id_of, rows_of
from ros2_memory.lake.tables import TABLES, day_of, open_tables, to_arrow

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import date

    from ros2_memory.config import Settings
    from ros2_memory.core.model import BagFile, JsonValue
    from ros2_memory.history.context import Memory
    from ros2_memory.lake.tables import Row
    from ros2_memory.serving.dispatch import Dispatcher

MOST_S: Final = {"find_last_match, which robot last saw it": 1.0, "metres by robot and day": 2.0}
_AGAIN: Final = 3
_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"


def questions() -> Mapping[str, tuple[str, Mapping[str, JsonValue]]]:
    """Returns, by words, a tool and its arguments."""
    day: dict[str, JsonValue] = {"start": START_S, "end": START_S + 86_400}
    hour: dict[str, JsonValue] = {"start": START_S + 8.5 * 3600, "end": START_S + 9.5 * 3600}
    chair = condition(VISION.topic, "contains", "chair")
    return {
        "find_last_match, which robot last saw it": ("find_last_match", chair),
        "find_last_match, that no robot saw": ("find_last_match", {**chair, "value": "elephant"}),
        "metres by robot and day": ("trajectory_summary", {**day, "by": "day"}),
        "find_matches": ("find_matches", chair),
        "find_matches, in a place": ("find_matches", {**chair, "where": "kitchen"}),
        "find_things": ("find_things", {}),
        "find_things, of a label": ("find_things", {"label": "mug"}),
        "visits, all places": ("visits", {}),
        "recap of an hour": ("recap", hour),
        "recap of the day": ("recap", day),
        "data_time_range": ("data_time_range", {}),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Makes the lake where it is missing, asks, and prints; 1 where an aim is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lake", description=__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=3, help="robots whose rows are their own")
    parser.add_argument("--split-s", type=float, default=60.0)
    parser.add_argument("--dir", type=Path, default=_DIR, help="where the lake is kept")
    parser.add_argument("--worlds", type=Path, default=_DIR, help="where worlds are kept")
    given = parser.parse_args(argv)
    folder = given.dir / f"lake_{given.robots}_{given.seeds}_{given.split_s:g}"
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    os.environ["TZ"] = "UTC"  # the days of the robots
    time.tzset()
    names = [f"r{number:02d}" for number in range(given.robots)]
    scales = [
        Scale(seed=seed, days=1, compression=1.0, split_s=given.split_s)
        for seed in range(given.seeds)
    ]
    if not (folder / "made").is_file():
        _make(folder, [made(scale, given.worlds) for scale in scales], names)
    return asyncio.run(_asked(folder, names))


def settings_of(folder: Path, bag_dir: Path) -> Settings:
    """Returns settings for bags, with the places and labels of a folder."""
    return load_settings(
        [
            "deployment=query_only",
            f"recording.bag_dir={bag_dir}",
            f"data.places_file={folder / 'places.yaml'}",
            f"data.labels_file={folder / 'labels.yaml'}",
            "data.now=latest",
            "logging.level=error",
            "server.call_timeout_s=120",
        ],
        {},
    )


def catalog_in(folder: Path) -> SqlCatalog:
    """Returns the catalogue of the lake in a folder, whose files are beside it."""
    (folder / "files").mkdir(exist_ok=True)
    uri = f"sqlite:///{folder.absolute()}/lake.sqlite"
    return SqlCatalog("lake", uri=uri, warehouse=(folder / "files").absolute().as_uri())


def _make(folder: Path, worlds: Sequence[Path], names: Sequence[str]) -> None:
    shutil.rmtree(folder / "files", ignore_errors=True)
    (folder / "lake.sqlite").unlink(missing_ok=True)
    (folder / "files").mkdir(parents=True)
    tables = open_tables(catalog_in(folder), TABLES)
    for file in ("places.yaml", "labels.yaml"):
        shutil.copyfile(worlds[0] / file, folder / file)
    for number, world in enumerate(worlds):
        settings = settings_of(folder, world / "bags")
        memory = build_memory(settings)
        for _ in range(2):  # a busy machine may leave a bag for later
            made_known(memory, settings)
        for (table, day), rows in rows_of_world(memory).items():
            for name in names[number :: len(worlds)]:
                own = {f"{name}{bag_id}": each for bag_id, each in rows.items()}
                tables[table].append(to_arrow(TABLES[table], name, day, own))
    (folder / "made").touch()


def rows_of_world(memory: Memory) -> dict[tuple[str, date], dict[str, list[Row]]]:
    """Returns the rows of all bags by table and day, and by bag."""
    found: dict[tuple[str, date], dict[str, list[Row]]] = {}
    bags = memory.index.snapshot().bags
    known = _numbers(memory, bags)
    for bag, number in zip(bags, known, strict=True):
        if number is None:
            print(f"without a digest, and not in the lake: {bag.path.name}")
            continue
        content = BagContent(bag, bag_id_of("", bag, bag.start), "0" * 64, "made")
        for table, rows in rows_of(memory, content).items():
            if rows:
                found.setdefault((table, day_of(bag.start)), {})[content.bag_id] = rows
    return found


def _numbers(memory: Memory, bags: Sequence[BagFile]) -> Sequence[int | None]:
    if memory.recall is None:
        raise ValueError("the memory has no catalogue")
    bag_dir = memory.recall.bag_dir
    return memory.recall.catalogue.find([BagKey.of(bag, bag_dir) for bag in bags])


async def _asked(folder: Path, names: Sequence[str]) -> int:
    settings = settings_of(folder, folder / "none")
    limits, shared = query_settings_of(settings), shared_parts(settings)
    lake = Lake(catalog_in(folder), DuckdbEngine())

    begun = time.perf_counter()
    memories = {
        name: LakeRobot(lake, name, WallClock(), limits, shared.extractor).memory for name in names
    }
    for each in memories.values():
        each.index.refresh()
    looked_s = time.perf_counter() - begun
    robots = [Robot(name, folder, partial(memories.__getitem__, name)) for name in names]
    fleet = Fleet(robots, WallClock(), shared_map=True)
    dispatcher = build_server(settings, build_memory(settings), fleet=fleet).dispatcher
    size = sum(each.stat().st_size for each in folder.rglob("*.parquet"))
    print(
        f"{len(names)} robots, a day each, {size / 1e6:.0f} MB of Parquet, {machine()}; "
        f"{looked_s:.2f} s to look into the lake"
    )
    missed = await answered(dispatcher, questions(), MOST_S)
    dispatcher.stop()
    print(f"\nresident: {resident_mb('VmRSS'):.0f} MB")
    return int(missed)


async def answered(
    dispatcher: Dispatcher,
    asked: Mapping[str, tuple[str, Mapping[str, JsonValue]]],
    most_s: Mapping[str, float],
) -> bool:
    """Asks the first time and again, prints, and returns whether an aim is missed."""
    print(
        "\n| question | first, s | of the processor, s | again, s | characters | |"
        "\n|---|---|---|---|---|---|"
    )
    missed = False
    for words, (tool, arguments) in asked.items():
        passed: list[float] = []
        busy: list[float] = []
        text = ""
        for _ in range(1 + _AGAIN):
            begun, begun_busy = time.perf_counter(), time.process_time()
            text = (await dispatcher.answer(tool, dict(arguments))).text
            passed.append(time.perf_counter() - begun)
            busy.append(time.process_time() - begun_busy)
        is_late = min(passed[1:]) > most_s.get(words, sys.float_info.max)
        trouble = text[:300] if '"error"' in text or "no answer of" in text else ""
        missed |= is_late or bool(trouble)
        verdict = f"MISSED {trouble}" if is_late or trouble else "ok"
        print(
            f"| {words} | {passed[0]:.2f} | {busy[0]:.2f} | {min(passed[1:]):.3f} | {len(text)} "
            f"| {verdict} |",
            flush=True,
        )
    return missed


if __name__ == "__main__":
    sys.exit(main())

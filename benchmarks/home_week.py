"""`python -m benchmarks.home_week`: how long each tool takes over a week of a home robot.

The map moves all the time (`benchmarks.home`). Every call is asked in a process that has answered
nothing before, twice: the first time with building the memory from the catalogue.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import shutil
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from benchmarks.digests import made_known
from benchmarks.home import asking, messages
from benchmarks.home.__main__ import made, write
from benchmarks.home.days import Scale
from benchmarks.home.things import DAY
from benchmarks.home.world import START_S, VISION
from benchmarks.report import machine
from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.serving.mcp_server import EpisodicServer  # noqa: TC001 - so that forks have it

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.config import Settings
    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.context import Memory

FIRST_S: Final = 2.0
AGAIN_S: Final = 0.2
MOST_SHARE: Final = 0.05
"""Of the bags' bytes, for the catalogue."""
MOST_DEARER: Final = 1.25
_ROUNDS: Final = 5
_SAMPLE: Final = 12
"""Recordings whose digests are timed: evenly spaced over the week."""
_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
_COST: Final = Path(__file__).with_name("digest_cost.py")


class Asked(NamedTuple):
    """One call, in words of its own."""

    words: str
    tool: str
    arguments: Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True)
class Speed:
    """How long a call took; `trouble` is the reply's error, or its notes on what it left out.

    Processor times (`cpu`) hardly depend on what the machine does besides.
    """

    words: str
    first_s: float
    again_s: float
    first_cpu_s: float
    again_cpu_s: float
    characters: int
    trouble: str = ""

    @property
    def reached(self) -> bool:
        """Whether it was answered in time, and wholly."""
        return self.first_s <= FIRST_S and self.again_s <= AGAIN_S and not self.trouble


class Stored(NamedTuple):
    """A column of the catalogue, or all pages of a table: bytes for each bag."""

    table: str
    column: str
    bytes_each: float


def calls(days: int) -> list[Asked]:
    """Returns a call of each tool and argument over a world of so many days."""
    start, end = START_S, START_S + days * DAY
    week: dict[str, JsonValue] = {"start": start, "end": end}
    today: dict[str, JsonValue] = {"start": end - DAY, "end": end}
    begin = max(end - 2 * DAY, start)
    yesterday: dict[str, JsonValue] = {"start": begin, "end": begin + DAY}
    rectangle: JsonValue = {"x": [7, 12], "y": [5, 9]}
    circle: JsonValue = {"x": 6.0, "y": 8.3, "radius_m": 1.0}
    off_dock = condition(messages.DOCKED.topic, "equals", value=False)
    docked: JsonValue = off_dock
    seen = condition(VISION.topic, "contains", "chair")
    bumped = condition(messages.BUMPER.topic, "equals", value=True)
    low = {**condition(messages.BATTERY.topic, "below", 0.3), "field": "percentage"}
    logged = condition("/rosout", "contains", "plan")
    near = condition(messages.ODOM.topic, "near_position", {"x": 3.2, "y": 1.6})
    compared: dict[str, JsonValue] = {
        **today,
        **{f"with_{name}": value for name, value in yesterday.items()},
    }

    def each(name: str, **arguments: JsonValue) -> Iterator[Asked]:
        for by in ("day", "hour", "weekday"):
            yield Asked(f"{name} by {by}", name.split(maxsplit=1)[0], {**arguments, "by": by})

    return [
        Asked("find_things", "find_things", {}),
        Asked("find_things label", "find_things", {"label": "chair"}),
        Asked("find_things, moved", "find_things", {"label": "keys"}),
        Asked("find_things where", "find_things", {"where": "kitchen"}),
        Asked("find_things where {x, y}", "find_things", {"where": rectangle}),
        Asked("find_things of a day", "find_things", {"label": "mug", **yesterday}),
        Asked("find_things min_score", "find_things", {"min_score": 0.5}),
        Asked("compare", "compare", compared),
        Asked("compare where", "compare", {**compared, "where": "living room"}),
        Asked("visits, all places", "visits", {}),
        Asked("visits, all places, a day", "visits", yesterday),
        Asked("visits where", "visits", {"where": "kitchen"}),
        Asked("visits where, a day", "visits", {"where": "kitchen", **today}),
        Asked("visits where {x, y}", "visits", {"where": rectangle}),
        Asked("visits where radius", "visits", {"where": circle}),
        Asked("visits x, y", "visits", {"x": 6.0, "y": 8.3}),
        Asked("visits frame_id=odom", "visits", {"x": 0.0, "y": 0.0, "frame_id": "odom"}),
        Asked("find_matches", "find_matches", seen),
        Asked("find_matches oldest_first", "find_matches", {**seen, "oldest_first": True}),
        Asked("find_matches frame_id=odom", "find_matches", {**seen, "frame_id": "odom"}),
        Asked("find_matches where", "find_matches", {**seen, "where": "study"}),
        Asked("find_matches while", "find_matches", {**bumped, "while": docked}),
        Asked(
            "find_matches where while",
            "find_matches",
            {**seen, "where": "kitchen", "while": docked},
        ),
        Asked("find_matches below", "find_matches", low),
        Asked("find_matches near_position", "find_matches", near),
        Asked("find_matches never", "find_matches", {**seen, "value": "elephant"}),
        *each("find_matches", **seen),
        *each("find_matches where", **seen, where="kitchen"),
        *each("find_matches equals", **off_dock),
        *each("find_matches while", **bumped, **{"while": docked}),
        *each("find_matches below", **low),
        *each("find_matches /rosout", **logged),
        *each("trajectory_summary", **week),
        Asked("trajectory_summary", "trajectory_summary", week),
        Asked(
            "trajectory_summary max_waypoints=0", "trajectory_summary", {**week, "max_waypoints": 0}
        ),
        *each("get_topic_in_range", topic=messages.BATTERY.topic, **week),
        *each(
            "get_topic_in_range fields",
            topic=messages.BATTERY.topic,
            fields=["percentage"],
            **week,
        ),
        *each("get_topic_in_range /odom", topic=messages.ODOM.topic, **week),
        *each(
            "get_topic_in_range /odom fields",
            topic=messages.ODOM.topic,
            fields=["linear_velocity.x"],
            **week,
        ),
        Asked("recap last_s", "recap", {"last_s": 3600}),
        Asked("recap last_s of a day", "recap", {"last_s": DAY}),
        Asked("recap of a day", "recap", yesterday),
        Asked("recap of a week", "recap", week),
        Asked("recap around", "recap", {"around": start + 7.62 * 3600}),
        Asked("memory_status", "memory_status", {}),
        Asked("data_time_range", "data_time_range", {}),
        Asked("list_recorded_topics", "list_recorded_topics", {}),
        Asked("get_position_at", "get_position_at", {"timestamp": end - DAY / 2, "tolerance_s": 5}),
    ]


def condition(topic: str, kind: str, value: JsonValue) -> dict[str, JsonValue]:
    """Returns the arguments of a condition on a topic."""
    return {"topic": topic, "condition_type": kind, "value": value}


def speeds(settings: Settings, asked: Sequence[Asked]) -> Iterator[Speed]:
    """Yields how long each call takes, in a process of its own."""
    forked = multiprocessing.get_context("fork")  # imports are not counted
    for each in asked:
        # A process for each: a pool would let the next call find what this one has cached.
        with forked.Pool(1) as pool:
            yield pool.apply(speed, (settings, each))


def _import_all(settings: Settings, memory: Memory) -> None:
    """Imports what a server and its first call import, so that forks have it."""
    server = build_server(settings, memory)
    asyncio.run(server.dispatcher.answer("get_position_at", {"timestamp": START_S}))


def speed(settings: Settings, asked: Asked) -> Speed:
    """Returns how long a call takes the first time, and again; days are those of the robot."""
    os.environ["TZ"] = "UTC"
    time.tzset()
    times = [_times()]
    memory = build_memory(settings)
    memory.index.refresh()
    server: EpisodicServer = build_server(settings, memory)
    answer = partial(server.dispatcher.answer, asked.tool, dict(asked.arguments))
    reply = asyncio.run(answer()).text
    times.append(_times())
    again = asyncio.run(answer()).text
    times.append(_times())
    begun, first, done = times
    return Speed(
        asked.words,
        first[0] - begun[0],
        done[0] - first[0],
        first[1] - begun[1],
        done[1] - first[1],
        len(reply),
        _trouble(reply) or ("" if reply == again else "another answer the second time"),
    )


def _times() -> tuple[float, float]:
    """Returns seconds that passed, and those of the processor."""
    return time.perf_counter(), time.process_time()


def _trouble(reply: str) -> str:
    parsed = json.loads(reply)
    if not isinstance(parsed, dict):
        return ""
    if "error" in parsed:
        return f"{parsed['error']}: {parsed.get('detail')}"
    partial_notes = ("in time", "not read", "of the bags so far")
    return "; ".join(
        each for each in parsed.get("notes") or () if any(word in each for word in partial_notes)
    )


def stored(catalogue: Path) -> list[Stored]:
    """Returns what the catalogue stores for each bag: content by column, pages by table."""
    found: list[Stored] = []
    with closing(sqlite3.connect(f"{catalogue.as_uri()}?mode=ro", uri=True)) as connection:
        bags = connection.execute("SELECT count(*) FROM bags").fetchone()[0] or 1
        tables = connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite%'"
        ).fetchall()
        for (table,) in tables:
            for _, column, *_ in connection.execute(f"PRAGMA table_info({table})").fetchall():
                size = f"CASE typeof({column}) WHEN 'text' THEN length(CAST({column} AS BLOB))"
                size += f" WHEN 'blob' THEN length({column}) WHEN 'real' THEN 8"
                size += f" WHEN 'integer' THEN 1 + (abs({column}) > 127) * 4 ELSE 0 END"
                # Both names are the database's own.
                asked = f"SELECT total({size}) FROM {table}"  # noqa: S608
                total = connection.execute(asked).fetchone()[0]
                found.append(Stored(table, column, total / bags))
        try:
            rows = connection.execute("SELECT name, sum(pgsize) FROM dbstat GROUP BY name")
            found += [Stored(name, "(pages)", size / bags) for name, size in rows]
        except sqlite3.OperationalError:
            pass  # this SQLite was built without dbstat
    return found


def digest_ms(world: Path, trees: Sequence[Path]) -> list[float]:
    """Returns for each source tree the processor time (ms) of digesting and storing a bag.

    Each digests the same recordings, in turn, in processes of its own; the least of all rounds.
    """
    recordings = sorted(each for each in (world / "bags").iterdir() if each.is_dir())
    spent: list[list[float]] = [[] for _ in trees]
    with tempfile.TemporaryDirectory(dir=world) as temporary:
        sample = Path(temporary) / "bags"
        for each in recordings[:: max(len(recordings) // _SAMPLE, 1)]:
            shutil.copytree(each, sample / each.name)
        for nth in range(_ROUNDS):
            for tree, times in zip(trees, spent, strict=True):
                environment = {
                    **os.environ,
                    "PYTHONPATH": str(tree / "src"),
                    "XDG_CACHE_HOME": f"{temporary}/{tree.name}-{nth}",
                }
                command = [sys.executable, str(_COST), str(sample)]
                told = subprocess.run(
                    command, env=environment, cwd=temporary, check=True, capture_output=True
                )
                times.append(statistics.fmean(json.loads(told.stdout)))
    return [min(times) * 1e3 for times in spent]


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the tables; the exit code is 0 whatever was reached."""
    given = _parser().parse_args(argv)
    scale = Scale(days=given.days, compression=given.compression, split_s=given.split_s)
    if given.world is not None and not (given.world / "bags").is_dir():
        write(scale, given.world)
    world = given.world or made(scale, given.dir)
    settings = asking.settings_for(world, scale.split_s)
    memory = build_memory(settings)
    memory.index.refresh()
    if memory.recall is None:
        raise RuntimeError("the memory has no catalogue")
    begun = time.process_time()
    made_known(memory, settings)
    bags, size = len(memory.index.snapshot().bags), _bytes_of(world / "bags")
    print(machine())
    print(f"{bags} bags of {size / 1e6:.0f} MB; digested in {time.process_time() - begun:.0f} s")
    measured: list[Speed] = []
    if not given.no_speed:
        _import_all(settings, memory)
        print("\n| call | first, s | again, s | processor, s | characters | |")
        print("|---|---|---|---|---|---|")
        chosen = [each for each in calls(scale.days) if given.only in each.words]
        for each in speeds(settings, chosen):
            measured.append(each)
            verdict = "ok" if each.reached else f"MISSED {each.trouble}"
            print(
                f"| {each.words} | {each.first_s:.2f} | {each.again_s:.3f}"
                f" | {each.first_cpu_s:.2f}, {each.again_cpu_s:.3f} | {each.characters}"
                f" | {verdict} |",
                flush=True,
            )
    columns: list[Stored] = []
    catalogue = memory.recall.catalogue.path
    if catalogue is not None:
        memory.recall.catalogue.close()  # which empties the write-ahead log
        columns = stored(catalogue)
        share = catalogue.stat().st_size / size
        print(
            f"\ncatalogue: {catalogue.stat().st_size / bags:.0f} bytes a bag,"
            f" {share:.1%} of the bags ({'ok' if share <= MOST_SHARE else 'MISSED'})"
        )
        print("\n| table | column | bytes a bag |\n|---|---|---|")
        for row in sorted(columns, key=lambda each: (each.table, -each.bytes_each)):
            if row.bytes_each >= 1:
                print(f"| {row.table} | {row.column} | {row.bytes_each:.0f} |")
    costs: list[float] = []
    if given.against is not None:
        costs = digest_ms(world, [Path(__file__).resolve().parents[1], given.against])
        print(
            f"\ndigest of a bag: {costs[0]:.1f} ms, {costs[0] / costs[1]:.2f} times the"
            f" {costs[1]:.1f} ms of {given.against}"
            f" ({'ok' if costs[0] <= MOST_DEARER * costs[1] else 'MISSED'})"
        )
    if given.json is not None:
        facts = {
            "speeds": [{**asdict(each), "reached": each.reached} for each in measured],
            "stored": [each._asdict() for each in columns],
            "digest_ms": costs,
        }
        given.json.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return 0


def _bytes_of(folder: Path) -> int:
    return sum(each.stat().st_size for each in folder.rglob("*.mcap"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.home_week", description=__doc__)
    parser.add_argument("--days", type=int, default=7)
    parser.add_argument("--compression", type=float, default=1.0)
    parser.add_argument("--split-s", type=float, default=60.0)
    parser.add_argument("--dir", type=Path, default=_DIR, help="where worlds are kept")
    parser.add_argument("--world", type=Path, help="a world that lies there, or is written there")
    parser.add_argument("--only", default="", metavar="TEXT", help="only calls named so")
    parser.add_argument("--no-speed", action="store_true", help="ask nothing")
    parser.add_argument(
        "--against", type=Path, metavar="TREE", help="sources to compare the digest's cost with"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    return parser


if __name__ == "__main__":
    sys.exit(main())

"""`python -m benchmarks.lake_robots`: memory and answers of a lake's server, by number of robots.

A few drawn robots are shipped. Of their rows those of many robots are made: each lacks a tenth of
the bags, drawn for it, and its places and metres have noise of its own. The server is started over
these alone. Once it has stored all columns, it is asked by a real client: each question first and
again, then by several clients. Another server is asked the statements of docs/how-to/lake.md.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import itertools
import json
import os
import re
import shutil
import sqlite3
import statistics
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from mcp import Client
from pyiceberg.expressions import AlwaysTrue
from tests.support.served import PROGRAM, serving

from benchmarks import report, timing, worlds
from benchmarks.timing import resident_mb
from ros2_memory.columns.store import FILE
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.lake.tables import TABLES
from ros2_memory.lake.warehouse import LakeLocation

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.model import JsonValue

Asks: TypeAlias = "Mapping[str, tuple[str, dict[str, JsonValue]]]"
Tables: TypeAlias = "dict[str, pa.Table]"

_ROOT: Final = Path(__file__).resolve().parents[1]
_DIR: Final = _ROOT / "build" / "benchmarks"
_PAGE: Final = _ROOT / "docs" / "how-to" / "lake.md"
_LACKING: Final = 0.1
_AT_ONCE: Final = 10
"""Robots whose rows are committed together."""
_NOISE_M: Final = 0.05
_NOISY: Final = ("x", "y", "robot_x", "robot_y", "distance_m")
_PATIENCE_S: Final = 120.0
_PLACE_M: Final = 1.5


def main() -> None:
    """Prints a table for each number of robots."""
    given = _parser().parse_args()
    configure_logging("error", "json")
    seed = int((given.seed or report.commit()).split()[0][:16], 16)
    drawn = [seed + nth for nth in range(given.worlds)]
    folders = [worlds.made(worlds.HOME, each, 1, given.dir) for each in drawn]
    rows = [_shipped(folder, given.bags, given.dir) for folder in folders]
    for robots in given.robots:
        folder = given.dir / f"lake_robots_{robots}"
        shutil.rmtree(folder, ignore_errors=True)
        bags = _make(folder, rows, robots, seed)
        facts = [json.loads((each / "world.json").read_bytes()) for each in folders]
        for asks in (questions(facts), statements()):
            asyncio.run(_measured(folder, asks, (robots, bags), given))


def _shipped(world: Path, bags: int, folder: Path) -> Tables:
    """Returns the rows of the first bags of a world, which are shipped as those of one robot."""
    place = folder / f"{world.name}_shipped"
    shutil.rmtree(place, ignore_errors=True)
    left = bags
    for recording in sorted((world / "bags").iterdir()):
        own = place / "robots" / "drawn" / recording.name
        for bag in sorted(recording.glob("*.mcap"))[:left]:
            own.mkdir(parents=True, exist_ok=True)
            os.link(bag, own / bag.name)
            left -= 1
    facts = json.loads((world / "world.json").read_bytes()) | {"robots": 1, "lake": True}
    (place / "world.json").write_text(json.dumps(facts), encoding="utf-8")
    timing.settings_of(place)
    ran = timing.shipped(place)
    print(f"shipped {bags} bags: {ran.seconds / bags * 1e3:.0f} ms a bag, {ran.peak_mb:.0f} MB")
    with _location(place / "lake").writable() as lake:
        return {name: lake.rows(name, AlwaysTrue()) for name in TABLES}


def _location(folder: Path) -> LakeLocation:
    return LakeLocation(folder.as_uri(), folder / ".ros2-memory")


def _make(folder: Path, rows: Sequence[Tables], robots: int, seed: int) -> int:
    """Writes a lake of so many robots; returns how many bags they have."""
    bags, chance = 0, np.random.default_rng([seed, robots])
    with _location(folder / "lake").writable() as lake:
        for first in range(0, robots, _AT_ONCE):
            some = range(first, min(first + _AT_ONCE, robots))
            made = [_robot(rows[nth % len(rows)], f"r{nth:03}", chance) for nth in some]
            for name, table in TABLES.items():
                whole = pa.concat_tables([each[name] for each in made])
                lake.tables[name].refresh().append(table.sort(whole))
            bags += sum(each["bags"].num_rows for each in made)
    return bags


def _robot(rows: Tables, name: str, chance: np.random.Generator) -> Tables:
    """Returns the rows of a robot that is like another one."""
    ids = rows["bags"]["bag_id"].to_pylist()
    kept = [bag_id for bag_id in ids if chance.random() > _LACKING]
    own = {bag_id: _own_id(bag_id, name) for bag_id in kept}
    return {table: _as_of(found, name, own, chance) for table, found in rows.items()}


def _own_id(bag_id: str, name: str) -> str:
    digest = hashlib.sha256(f"{name} {bag_id}".encode()).hexdigest()
    return f"{bag_id[:16]}{digest[:16]}"


def _as_of(
    rows: pa.Table, name: str, own: Mapping[str, str], chance: np.random.Generator
) -> pa.Table:
    found = rows.filter(pc.is_in(rows["bag_id"], pa.array([*own], pa.large_string())))
    ids = [own[bag_id] for bag_id in found["bag_id"].to_pylist()]
    changed = {"robot": pa.array([name] * found.num_rows), "bag_id": pa.array(ids)}
    for column in {*_NOISY}.intersection(found.column_names):
        noise = pa.array(chance.normal(0.0, _NOISE_M, found.num_rows))
        changed[column] = pc.add(found[column], noise)
    for column, values in changed.items():
        field = found.schema.field(column)
        at = found.schema.get_field_index(column)
        found = found.set_column(at, field, values.cast(field.type))
    return found


def questions(facts: Sequence[Mapping[str, JsonValue]]) -> Asks:
    """Returns what is asked about all robots, by words: a tool and its arguments."""
    start, end = ([cast("float", each[name]) for each in facts] for name in ("start", "end"))
    x, y = (round(value, 2) for value in cast("list[float]", facts[0]["dock"]))
    labels = [set(cast("list[str]", each["labels"])) for each in facts]
    battery = cast("dict[str, str]", facts[0]["topics"])["battery"]
    label = min(set.intersection(*labels) or labels[0])
    seen: dict[str, JsonValue] = {"topic": "*", "condition_type": "contains", "value": label}
    charge: dict[str, JsonValue] = {"topic": battery, "condition_type": "above", "value": 0.0}
    span: dict[str, JsonValue] = {"start": min(start), "end": max(end)}
    return {
        "metres by robot and day": ("trajectory_summary", {**span, "by": "day"}),
        "minutes in a place": ("visits", {"x": x, "y": y, "radius_m": _PLACE_M}),
        "how often": ("find_matches", {**seen, "by": "day"}),
        "how often above a limit": ("find_matches", {**charge, "field": "percentage", "by": "day"}),
        "which robot last saw it": ("find_last_match", seen),
        "where things are": ("find_things", {}),
    }


def statements() -> Asks:
    """Returns the statements of the page about lakes, by their tables, as `questions`."""
    page = re.findall(r"```sql\n(.*?);\n```", _PAGE.read_text("utf-8"), re.DOTALL)
    tables = [re.findall(r"FROM (\w+)", select)[-1] for select in page]
    return {
        f"select from {table}": ("query_lake", {"select": select})
        for table, select in zip(tables, page, strict=True)
    }


class _Heard(NamedTuple):
    """What a client got: after how long (s), and which robots are missing in it, and why."""

    seconds: float
    missing: str


async def _measured(
    folder: Path, asks: Asks, size: tuple[int, int], given: argparse.Namespace
) -> None:
    """Prints what a server takes over a lake of so many robots and bags."""
    nowhere = folder / "robots" / "r000"
    nowhere.mkdir(parents=True, exist_ok=True)
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    overrides = [
        "deployment=fleet",
        f"fleet.robots={{r000: '{nowhere}'}}",
        "fleet.shared_map=true",
        "lake=duckdb",
        f"lake.warehouse='{folder / 'lake'}'",
        *given.set,
    ]
    with serving(nowhere, folder / "log", *overrides, program=PROGRAM) as served:
        pid, url = str(served.process.pid), f"http://127.0.0.1:{served.port}/mcp"
        await _until_stored(folder / "cache", size[1])
        resident = resident_mb("VmRSS", pid)
        print(f"\n{size[0]} robots, {size[1]} bags: {resident:.0f} MB once stored", flush=True)
        async with Client(url, read_timeout_seconds=_PATIENCE_S) as client:
            for words, (tool, arguments) in asks.items():
                first, again = [await _asked(client, tool, arguments) for _ in range(2)]
                peak = resident_mb("VmHWM", pid)
                print(
                    f"  {words}: {first.seconds:.2f} / {again.seconds:.2f} s; {again.missing};"
                    f" {peak:.0f} MB",
                    flush=True,
                )
        heard: dict[str, list[_Heard]] = {words: [] for words in asks}
        until_s = time.monotonic() + given.seconds
        async with asyncio.TaskGroup() as clients:
            for nth in range(given.clients):
                clients.create_task(_client(url, asks, nth, until_s, heard))
        for words, answers in heard.items():
            spent = [answer.seconds for answer in answers] or [0.0]
            missing = dict(Counter(answer.missing for answer in answers))
            print(
                f"  {given.clients} clients, {words}: {statistics.median(spent):.2f} s, "
                f"{max(spent):.2f} s at most; {missing}"
            )
        peak, resident = resident_mb("VmHWM", pid), resident_mb("VmRSS", pid)
        print(f"  resident {resident:.0f} MB, at its peak {peak:.0f} MB", flush=True)


async def _until_stored(cache: Path, bags: int) -> None:
    """Waits until the columns of so many bags are stored."""
    stored = 0
    while stored < bags:
        await asyncio.sleep(1.0)
        stored = sum(map(_bags_in, cache.rglob(FILE)))


def _bags_in(file: Path) -> int:
    """Returns how many bags a store has; none while it is being made."""
    select = "SELECT count(*) FROM bag WHERE size >= 0"
    with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as store:
        try:
            return int(store.execute(select).fetchone()[0])
        except sqlite3.Error:
            return 0


async def _client(
    url: str, asks: Asks, nth: int, until_s: float, heard: dict[str, list[_Heard]]
) -> None:
    """Asks one question after the other, each client from another one on."""
    order = [*asks.items()]
    first = nth % len(order)
    async with Client(url, read_timeout_seconds=_PATIENCE_S) as client:
        for words, (tool, arguments) in itertools.cycle([*order[first:], *order[:first]]):
            if time.monotonic() >= until_s:
                return
            heard[words].append(await _asked(client, tool, arguments))


async def _asked(client: Client, tool: str, arguments: dict[str, JsonValue]) -> _Heard:
    begun = time.monotonic()
    reply = await client.call_tool(tool, arguments)
    seconds = time.monotonic() - begun
    text = "".join(getattr(block, "text", "") for block in reply.content)
    found = cast("dict[str, JsonValue]", json.loads(text))
    if "error" in found:
        return _Heard(seconds, text[:200])
    failed = Counter(cast("dict[str, str]", found.get("robots_failed", {})).values())
    why = ", ".join(f"{count} {code}" for code, count in failed.items())
    return _Heard(seconds, why or "whole")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lake_robots", description=__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[20, 60, 200])
    parser.add_argument("--worlds", type=int, default=2, help="robots whose rows are drawn")
    parser.add_argument("--bags", type=int, default=20, help="of each robot, a minute each")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=120.0, help="for which clients ask")
    parser.add_argument("--seed", metavar="HEX", help="default: the commit's hash")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--dir", type=Path, default=_DIR, help="where lakes are kept")
    return parser


if __name__ == "__main__":
    main()

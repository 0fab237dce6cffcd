"""`python -m benchmarks.fleet`: what a fleet's questions take, and how much memory its server.

Each robot has six hours of a home robot's day, one of a few that are told apart by their seed, as
hard links; and a catalogue of its own that knows all of them. The map moves, things are moved, and
people come in. The questions are asked in a process that has looked through all directories: the
first time, and then again, of which the fastest counts. The aim is one of processor time, which
hardly depends on what the machine does besides.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from benchmarks.footprint import resident_mb
from benchmarks.home.__main__ import made
from benchmarks.home.days import Scale
from benchmarks.home.messages import BATTERY, BUMPER, DOCKED, ODOM
from benchmarks.home.world import START_S, VISION, world_of
from benchmarks.home_week import condition
from benchmarks.report import machine
from ros2_memory.bootstrap import build_memory, build_server, catalogue_paths
from ros2_memory.bootstrap_fleet import build_fleet, robot_settings
from ros2_memory.config import load_settings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.config import Settings
    from ros2_memory.core.model import JsonValue

MOST_S: Final = 1.0
"""Of one core, for a question that was asked before."""
MOST_MB: Final = 1000.0
_AGAIN: Final = 3
_SEEDS: Final = 3
_END_H: Final = 12.0
"""Up to this hour of the day; the six before have three outings."""
_HOUR: Final = START_S + 8.5 * 3600
"""When the hour begins that is asked about."""
_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"


class Took(NamedTuple):
    """Seconds that passed, and those of the processor, first and again; the reply's length."""

    first_s: float
    again_s: float
    first_cpu_s: float
    again_cpu_s: float
    characters: int
    trouble: str


@dataclass(frozen=True)
class Found:
    """What was measured: by the words of a question what it took; memory in MB."""

    bags: int
    looked_s: float
    looked_mb: float
    took: dict[str, Took]
    resident_mb: float
    peak_mb: float


def questions(hours: float) -> Mapping[str, tuple[str, Mapping[str, JsonValue]]]:
    """Returns, by words, a tool and its arguments."""
    end = START_S + _END_H * 3600
    all_of_it: dict[str, JsonValue] = {"start": end - hours * 3600, "end": end}
    hour: dict[str, JsonValue] = {"start": _HOUR, "end": _HOUR + 3600}
    two_hours: dict[str, JsonValue] = {**hour, "with_start": _HOUR - 3600, "with_end": _HOUR}
    chair = condition(VISION.topic, "contains", "chair")
    speed = {**condition(ODOM.topic, "below", -50), "field": "linear_velocity.x"}
    low = {**condition(BATTERY.topic, "below", 0.5), "field": "percentage"}
    bumped = condition(BUMPER.topic, "equals", value=True)
    docked = condition(DOCKED.topic, "equals", value=True)
    return {
        "find_last_match, which robot last saw it": ("find_last_match", chair),
        "find_last_match, that no robot ever saw": (
            "find_last_match",
            {**chair, "value": "elephant"},
        ),
        "find_last_match, a speed that was never reached": ("find_last_match", speed),
        "find_last_match, a battery below a half": ("find_last_match", low),
        "find_matches": ("find_matches", chair),
        "find_matches, of an hour": ("find_matches", {**chair, **hour}),
        "find_matches, oldest_first": ("find_matches", {**chair, "oldest_first": True}),
        "find_matches, of a flag": ("find_matches", bumped),
        "find_matches, in a place": ("find_matches", {**chair, "where": "kitchen"}),
        "find_matches, while docked": ("find_matches", {**chair, "while": docked}),
        "find_matches, by hour": ("find_matches", {**chair, "by": "hour"}),
        "find_things": ("find_things", {}),
        "find_things, of a label": ("find_things", {"label": "mug"}),
        "find_things, in a place": ("find_things", {"where": "kitchen"}),
        "visits, all places": ("visits", {}),
        "visits, to a place": ("visits", {"where": "kitchen"}),
        "compare an hour with the one before": ("compare", two_hours),
        "compare, in a place": ("compare", {**two_hours, "where": "living room"}),
        "recap of an hour": ("recap", hour),
        "recap, of all hours": ("recap", all_of_it),
        "memory_status": ("memory_status", {}),
        "list_recorded_topics": ("list_recorded_topics", {}),
        "data_time_range": ("data_time_range", {}),
        "get_position_at of one robot": (
            "get_position_at",
            {"timestamp": _HOUR + 1800, "tolerance_s": 5, "robot": "r07"},
        ),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Makes the fleet where it is missing, asks, and prints; 1 where an aim is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet", description=__doc__)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--hours", type=int, default=6)
    parser.add_argument("--split-s", type=float, default=60.0)
    parser.add_argument("--dir", type=Path, default=_DIR, help="where worlds are kept")
    parser.add_argument("--only", default="", metavar="TOOL", help="only calls of this tool")
    parser.add_argument("--ask", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(argv)
    folder = given.dir / f"fleet_{given.robots}x{given.hours}_{given.split_s:g}"
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    os.environ["TZ"] = "UTC"  # the days of the robots
    time.tzset()
    if given.ask:
        found = asyncio.run(_asked(_settings(folder), given.hours, given.only))
        print(json.dumps(asdict(found)))
        return 0
    if not (folder / "made").is_file():
        _make(folder, given.dir, given.robots, given.hours, given.split_s)
    words = ["--robots", given.robots, "--hours", given.hours, "--split-s", given.split_s]
    words += ["--dir", given.dir, "--only", given.only]
    program = [sys.executable, "-m", "benchmarks.fleet", "--ask", *map(str, words)]
    done = subprocess.run(program, check=True, stdout=subprocess.PIPE)
    found = Found(**json.loads(done.stdout.splitlines()[-1]))
    return _printed(found, f"{given.robots} robots, {given.hours} h each")


def _overrides(folder: Path) -> list[str]:
    return [
        "deployment=fleet",
        f"fleet.robots={folder}/robots/*/bags",
        f"fleet.places={folder}/robots/*/places.yaml",
        f"data.labels_file={folder}/robots/r00/labels.yaml",
        "data.now=latest",
        "logging.level=error",
        "server.call_timeout_s=120",
    ]


def _settings(folder: Path) -> Settings:
    return load_settings(_overrides(folder), {})


def _make(folder: Path, shared: Path, robots: int, hours: int, split_s: float) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    names = [f"r{number:02d}" for number in range(robots)]
    for number, name in enumerate(names):
        scale = Scale(seed=number % _SEEDS, days=1, compression=1.0, split_s=split_s)
        world, robot = made(scale, shared), folder / "robots" / name
        for recording in world_of(scale).recordings:
            if (_END_H - hours) * 3600 <= recording.start < _END_H * 3600:
                of_it = Path("bags") / recording.name
                shutil.copytree(world / of_it, robot / of_it, copy_function=os.link)
        for file in ("places.yaml", "labels.yaml"):
            shutil.copyfile(world / file, robot / file)
    settings = _settings(folder)
    catalogues = [catalogue_paths(robot_settings(settings, name))[0] for name in names]
    # In a process of its own, whose end completes the catalogue's file.
    index = [sys.executable, "-m", "ros2_memory.cli", "index"]
    for name in names[:_SEEDS]:
        bag_dir = str(settings.fleet.robots[name])
        subprocess.run([*index, "--bag-dir", bag_dir, *_overrides(folder)], check=True)
    for number, other in enumerate(catalogues[_SEEDS:]):
        shutil.copytree(catalogues[number % _SEEDS].parent, other.parent)
    (folder / "made").touch()


async def _asked(settings: Settings, hours: int, only: str) -> Found:
    """Asks every question, or those of one tool."""
    fleet = build_fleet(settings)
    if fleet is None:
        raise ValueError("there are no robots")
    server = build_server(settings, build_memory(settings), fleet=fleet)
    begun = time.perf_counter()
    bags = sum(len(each.memory().index.refresh().bags) for each in fleet.robots.values())
    looked_s, looked_mb = time.perf_counter() - begun, resident_mb("VmRSS")
    took: dict[str, Took] = {}
    for words, (tool, arguments) in questions(hours).items():
        if only not in tool:
            continue
        passed: list[float] = []
        spent: list[float] = []
        text = ""
        for _ in range(1 + _AGAIN):
            begun, cpu = time.perf_counter(), time.process_time()
            text = (await server.dispatcher.answer(tool, dict(arguments))).text
            passed.append(time.perf_counter() - begun)
            spent.append(time.process_time() - cpu)
        is_short = '"error"' in text or "no answer of" in text or "not read" in text
        trouble = text[:300] if is_short else ""
        again = min(passed[1:]), spent[0], min(spent[1:])
        took[words] = Took(passed[0], *again, len(text), trouble)
        print(words, took[words], file=sys.stderr, flush=True)
    server.dispatcher.stop()
    resident, peak = resident_mb("VmRSS"), resident_mb("VmHWM")
    return Found(bags, looked_s, looked_mb, took, resident, peak)


def _printed(found: Found, what: str) -> int:
    print(f"{what}: {found.bags} bags, {machine()}")
    print(f"first look through all directories: {found.looked_s:.1f} s")
    print("\n| question | first, s | again, s | processor, s | characters | |")
    print("|---|---|---|---|---|---|")
    missed = found.resident_mb > MOST_MB
    for words, row in found.took.items():
        each = Took(*row)
        # Python runs one thread at a time: on a machine that does nothing else, no more passes.
        is_late = each.again_cpu_s > MOST_S
        missed |= is_late or bool(each.trouble)
        verdict = f"MISSED {each.trouble}" if is_late or each.trouble else "ok"
        print(
            f"| {words} | {each.first_s:.2f} | {each.again_s:.3f}"
            f" | {each.first_cpu_s:.2f}, {each.again_cpu_s:.3f} | {each.characters} | {verdict} |"
        )
    print(
        f"\nresident: {found.resident_mb:.0f} MB (aim {MOST_MB:.0f}), peak {found.peak_mb:.0f} MB,"
        f" {found.looked_mb:.0f} MB before the first question"
    )
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())

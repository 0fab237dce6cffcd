"""`python -m benchmarks.fleet`: what a fleet's questions take, and how much memory its server.

Each robot has the same hours, as hard links, and a catalogue of its own that knows them all. The
questions are asked in a process that has looked through all directories and answered nothing
else: the first time, and then again, of which the fastest counts. Questions about things are left
out: the detections of these bags are random, as those of no robot are (`benchmarks.home_week` has
them).
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
from typing import TYPE_CHECKING, Final

from benchmarks.bags import END_NS, HOUR, ODOM, SCENE, made
from benchmarks.footprint import resident_mb
from benchmarks.payloads import NEVER_SEEN
from benchmarks.report import machine
from ros2_memory.bootstrap import build_memory, build_server, catalogue_paths
from ros2_memory.bootstrap_fleet import build_fleet, robot_settings
from ros2_memory.config import load_settings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.config import Settings

MOST_S: Final = 1.0
MOST_MB: Final = 1000.0
_AGAIN: Final = 3
_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
_END_S: Final = END_NS / 1e9
_SCENE: Final = {"topic": SCENE.name, "condition_type": "contains"}
QUESTIONS: Final[Mapping[str, tuple[str, Mapping[str, object]]]] = {
    "which robot last saw it": ("find_last_match", {**_SCENE, "value": "scissors"}),
    "never seen by any": ("find_last_match", {**_SCENE, "value": NEVER_SEEN}),
    "a number that was never so low": (
        "find_last_match",
        {
            "topic": ODOM.name,
            "condition_type": "below",
            "field": "linear_velocity.x",
            "value": -50,
        },
    ),
    "when did robots see it, in 10 minutes": (
        "find_matches",
        {**_SCENE, "value": "scissors", "start": _END_S - 600, "end": _END_S},
    ),
    "what happened in 10 minutes": ("recap", {"start": _END_S - 600, "end": _END_S}),
    "can they be trusted": ("memory_status", {}),
    "what is recorded": ("list_recorded_topics", {}),
    "since when": ("data_time_range", {}),
    "where was one robot": ("get_position_at", {"timestamp": _END_S - 60, "robot": "r07"}),
}
"""By words: the tool and its arguments."""


@dataclass(frozen=True)
class Found:
    """What was measured: seconds by the words of a question, the first time first; memory in MB."""

    bags: int
    looked_s: float
    took: dict[str, list[float]]
    unanswered: dict[str, str]
    resident_mb: float
    peak_mb: float


def main(argv: Sequence[str] | None = None) -> int:
    """Makes the fleet where it is missing, asks, and prints; 1 where an aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--hours", type=int, default=6)
    parser.add_argument("--dir", type=Path, default=_DIR)
    parser.add_argument("--ask", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(argv)
    folder = given.dir / f"fleet_{given.robots}x{given.hours}"
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    if given.ask:
        print(json.dumps(asdict(asyncio.run(_asked(_settings(folder))))))
        return 0
    if not (folder / "made").is_file():
        _make(folder, given.dir, given.robots, given.hours)
    words = ["--robots", str(given.robots), "--hours", str(given.hours), "--dir", str(given.dir)]
    program = [sys.executable, "-m", "benchmarks.fleet", "--ask"]
    done = subprocess.run([*program, *words], check=True, stdout=subprocess.PIPE)
    return _printed(
        json.loads(done.stdout.splitlines()[-1]), f"{given.robots} robots, {given.hours} h each"
    )


def _overrides(folder: Path) -> list[str]:
    robots = f"fleet.robots={folder}/robots/*"
    return ["deployment=fleet", robots, "logging.level=error", "server.call_timeout_s=120"]


def _settings(folder: Path) -> Settings:
    return load_settings(_overrides(folder), {})


def _make(folder: Path, shared: Path, robots: int, hours: int) -> None:
    history = made(shared, hours * HOUR)
    shutil.rmtree(folder, ignore_errors=True)
    names = [f"r{number:02d}" for number in range(robots)]
    for name in names:
        shutil.copytree(history.folder, folder / "robots" / name, copy_function=os.link)
    settings = _settings(folder)
    first = robot_settings(settings, names[0])
    # In a process of its own, whose end completes the catalogue's file.
    index = [sys.executable, "-m", "ros2_memory.cli", "index"]
    bag_dir = str(first.recording.bag_dir)
    subprocess.run([*index, "--bag-dir", bag_dir, *_overrides(folder)], check=True)
    catalogue = catalogue_paths(first)[0]
    for name in names[1:]:
        other = catalogue_paths(robot_settings(settings, name))[0]
        shutil.copytree(catalogue.parent, other.parent)
    (folder / "made").touch()


async def _asked(settings: Settings) -> Found:
    """Asks every question."""
    fleet = build_fleet(settings)
    if fleet is None:
        raise ValueError("there are no robots")
    server = build_server(settings, build_memory(settings), fleet=fleet)
    begun = time.perf_counter()
    bags = sum(len(each.memory().index.refresh().bags) for each in fleet.robots.values())
    looked_s = time.perf_counter() - begun
    took: dict[str, list[float]] = {}
    unanswered: dict[str, str] = {}
    for words, (tool, arguments) in QUESTIONS.items():
        for _ in range(1 + _AGAIN):
            begun = time.perf_counter()
            reply = await server.dispatcher.answer(tool, dict(arguments))
            took.setdefault(words, []).append(time.perf_counter() - begun)
        if "no answer of" in reply.text or reply.is_error:
            unanswered[words] = reply.text[:300]
    server.dispatcher.stop()
    resident, peak = resident_mb("VmRSS"), resident_mb("VmHWM")
    return Found(bags, looked_s, took, unanswered, resident, peak)


def _printed(found: Found, what: str) -> int:
    print(f"{what}: {found.bags} bags, {machine()}")
    print(f"first look through all directories: {found.looked_s:.1f} s")
    print(f"{'question':40} {'first':>8} {'again':>8}")
    missed = found.resident_mb > MOST_MB
    for words, (first, *again) in found.took.items():
        late = min(again) > MOST_S
        missed |= late or words in found.unanswered
        mark = "  > 1 s" if late else ""
        print(f"{words:40} {first:8.3f} {min(again):8.3f}{mark}  {found.unanswered.get(words, '')}")
    print(f"resident: {found.resident_mb:.0f} MB (aim {MOST_MB:.0f}), peak {found.peak_mb:.0f} MB")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m benchmarks.one_robot`: what a robot's user waits for, over days of bags of 10 s.

The robot has a localiser that corrects `map -> odom` all the time, a battery, a state and a log
(`bags.ROBOT_TOPICS`). Each question is asked in a process of its own, in which the server has
looked at the bags and answered nothing: the first time, and again. In another process it is asked
once the server has warmed up, which it does after its start while nobody asks. Times are those of
the processor, which hardly depend on what the machine does besides.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import anyio

from benchmarks import ours
from benchmarks.bags import (
    BATTERY,
    ODOM,
    ROBOT_TOPICS,
    ROSOUT,
    SPLIT_NS,
    STATUS,
    made,
    with_idle,
)
from benchmarks.digests import made_known
from benchmarks.footprint import resident_mb
from benchmarks.motion import NOWHERE
from benchmarks.report import machine
from benchmarks.serving import Served
from ros2_memory.bootstrap import build_backfill, build_memory, build_server, shared_parts
from ros2_memory.serving.page.routes import warm_up

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from benchmarks.bags import History
    from ros2_memory.config import Settings
    from ros2_memory.core.model import JsonValue

DAY: Final = 8_640
"""Splits of a day."""
_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"


class Asked(NamedTuple):
    """A call, and within how many ms it is to be answered the first time, and again."""

    words: str
    tool: str
    arguments: Mapping[str, JsonValue]
    first_ms: float
    again_ms: float


class Figure(NamedTuple):
    """A line of the table."""

    words: str
    figure: str
    aim: str = ""


def calls(history: History) -> list[Asked]:
    """Returns the calls over a history, whose end is the newest message."""
    start, end = history.start / 1e9, (history.end - SPLIT_NS // 2) / 1e9
    whole: dict[str, JsonValue] = {"start": start, "end": end}
    middle = (start + end) / 2.0
    nowhere: dict[str, JsonValue] = dict(zip("xy", NOWHERE, strict=True))

    def each(words: str, tool: str, ms: float, **arguments: JsonValue) -> Asked:
        return Asked(words, tool, arguments, ms, ms)

    def found(words: str, topic: str, kind: str, value: JsonValue, **more: JsonValue) -> Asked:
        condition = {"topic": topic, "condition_type": kind, "value": value}
        return each(words, "find_matches", 50.0, **condition, **more)

    speed = "linear_velocity.x"
    return [
        each(
            "transform at a time, map to camera",
            "get_transform_at",
            10.0,
            parent="map",
            child="camera",
            timestamp=middle,
        ),
        found("speed below -50, never", ODOM.name, "below", -50.0, field=speed),
        found("battery below 0.2, never", BATTERY.name, "below", 0.2, field="percentage"),
        found("status equals 'charging', never", STATUS.name, "equals", "charging"),
        found("status equals 'docked', often", STATUS.name, "equals", "docked"),
        found("log of level above 30, never", ROSOUT.name, "above", 30, field="level"),
        found("log contains 'motor stalled', never", ROSOUT.name, "contains", "motor stalled"),
        found("log contains 'missed', often", ROSOUT.name, "contains", "missed"),
        each("trajectory of everything", "trajectory_summary", 50.0, **whole),
        each("recap of an hour", "recap", 15.0, start=middle, end=middle + 3_600.0),
        each("recap of a day", "recap", 150.0, start=end - 86_400.0, end=end),
        each("list_recorded_topics", "list_recorded_topics", 5.0),
        Asked(
            "100 samples of an hour",
            "get_topic_in_range",
            {"topic": ODOM.name, "start": middle, "end": middle + 3_600.0, "max_samples": 100},
            80.0,
            20.0,
        ),
        each("visits in odom, never there", "visits", 100.0, **nowhere, frame_id="odom"),
        each("visits in map, never there", "visits", 200.0, **nowhere),
    ]


def asked(settings: Settings, call: Asked, *, warm: bool) -> tuple[float, float, str]:
    """Returns the ms of a call in a server that knows the bags, of the next one, and the reply."""
    os.environ["TZ"] = "UTC"
    time.tzset()
    memory = build_memory(settings)
    memory.index.refresh()
    dispatcher = build_server(settings, memory).dispatcher
    if warm:  # as a server does while nobody asks
        build_backfill(settings, memory).precompute()
        _wait_until(partial(warm_up, memory, dispatcher))

    def ask() -> tuple[float, str]:
        begun = time.process_time()
        reply = asyncio.run(dispatcher.answer(call.tool, dict(call.arguments))).text
        return (time.process_time() - begun) * 1e3, reply

    first_ms, _ = ask()
    again_ms, reply = ask()
    return first_ms, again_ms, reply


def _wait_until(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.1)


def figure_of(call: Asked, first_ms: float, warm_ms: float, again_ms: float, reply: str) -> Figure:
    """Returns the line of a call, with what its reply has to report."""
    parsed = json.loads(reply)
    notes = (
        [parsed.get(name) for name in ("error", "detail", "notes")]
        if isinstance(parsed, dict)
        else []
    )
    trouble = "; ".join(str(each) for each in notes if each)
    missed = warm_ms > call.first_ms or again_ms > call.again_ms
    aims = " / ".join(f"{each:g}" for each in dict.fromkeys((call.first_ms, call.again_ms)))
    return Figure(
        call.words,
        f"{first_ms:.1f} / {warm_ms:.1f} / {again_ms:.1f} ms",
        f"{aims} ms {'MISSED' if missed else 'ok'} {trouble}".rstrip(),
    )


def started(history: History, rounds: int = 3) -> Iterator[Figure]:
    """Yields what the real server takes until its first answer, and how large it becomes."""
    newest = (history.end - SPLIT_NS // 2) / 1e9
    passed, spent, sizes = [], [], []
    for _ in range(rounds):
        begun = time.perf_counter()
        with Served(history.folder) as server:
            server.ask("get_position_at", {"timestamp": newest})
            passed.append(time.perf_counter() - begun)
            spent.append(server.processor_s())
            sizes.append(server.resident_mb("VmRSS"))
    words = f"exec to first answer over {history.bags} bags"
    yield Figure(words, f"{min(spent):.2f} s of processor, {min(passed):.2f} s passed", "0.5 s")
    yield Figure("resident after it", f"{min(sizes):.0f} MB", "180 MB with a week")


def filled(settings: Settings) -> Iterator[Figure]:
    """Yields what making the bags known takes: memory in this process, and time for each bag."""
    # As the server's helper does it.
    memory = build_memory(settings, shared_parts(settings, cache_mb=8))
    memory.index.refresh()
    waiting = build_backfill(settings, memory).progress().waiting
    before, begun = resident_mb("VmRSS"), time.process_time()
    made_known(memory, settings)
    spent = time.process_time() - begun
    more = resident_mb("VmHWM") - before
    if waiting:
        yield Figure(f"digest of a bag, {waiting} bags", f"{spent * 1e3 / waiting:.1f} ms", "10 ms")
    yield Figure("memory that filling adds", f"{more:.0f} MB", "120 MB")


def exported(history: History) -> Figure:
    """Returns the processor time of an hour as Parquet."""
    last = min(3_600, history.bags * SPLIT_NS // 1_000_000_000)
    with tempfile.TemporaryDirectory(dir=history.folder.parent) as folder:
        program = [sys.executable, "-m", "ros2_memory.cli", "export", "--parquet", folder]
        before = os.times()
        done = subprocess.run(
            [*program, "--bag-dir", str(history.folder), "--last", str(last), "--json"],
            capture_output=True,
            text=True,
            check=True,
        )
    after = os.times()
    spent = after.children_user + after.children_system
    spent -= before.children_user + before.children_system
    rows = json.loads(done.stdout)["messages"]
    return Figure(f"Parquet of {rows} messages", f"{spent:.1f} s", "12 s for 454,000")


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the table; the exit code is 0 whatever was reached."""
    given = _parser().parse_args(argv)
    topics = with_idle(ROBOT_TOPICS, given.topics) if given.topics else ROBOT_TOPICS
    history = made(given.dir, given.bags, topics=topics)
    settings = ours.settings_for(history.folder)
    print(f"{history.bags} bags, {len(topics)} topics\n{machine()}")
    print("\n| what | processor time: first / first once warm / again | aim |\n|---|---|---|")

    def row(figure: Figure) -> None:
        print(f"| {' | '.join(figure)} |", flush=True)

    anyio.run(anyio.sleep, 0)  # a server has imported what runs its calls when it is asked
    forked = multiprocessing.get_context("fork")  # imports are not counted

    def alone(call: Asked) -> Figure:
        # A process for each: a pool would let the next call find what this one has cached.
        measured = []
        for warm in (False, True):
            with forked.Pool(1) as pool:
                measured.append(pool.apply(asked, (settings, call), {"warm": warm}))
        (first_ms, _, _), (warm_ms, again_ms, reply) = measured
        return figure_of(call, first_ms, warm_ms, again_ms, reply)

    with forked.Pool(1) as pool:
        for each in pool.apply(_listed, (settings,)):
            row(each)
    for call in calls(history):
        if given.only in call.words:
            row(alone(call))
    if not given.only:
        for each in started(history):
            row(each)
        row(exported(history))
    return 0


def _listed(settings: Settings) -> list[Figure]:
    return list(filled(settings))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.one_robot", description=__doc__)
    parser.add_argument("--bags", type=int, default=DAY, help="splits of 10 s")
    parser.add_argument("--topics", type=int, help="so many in all, most of them idle")
    parser.add_argument("--only", default="", metavar="TEXT", help="only calls named so")
    parser.add_argument("--dir", type=Path, default=_DIR, help="where bags are kept between runs")
    return parser


if __name__ == "__main__":
    sys.exit(main())

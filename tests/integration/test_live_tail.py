"""A robot drives, and is asked where it was a moment ago: what is being written answers.

Two recorders record the same drive in splits of 4 s: one in a single recording, and one that
rotates.
"""

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import chain, groupby
from pathlib import Path
from typing import Final

import pytest

from ros2_memory.core.timebase import unix_rounded_up
from tests.support.closed_form import position
from tests.support.live_recorder import (
    NS_PER_S,
    Answer,
    LiveRecorder,
    Tick,
    answering,
    answers,
    await_moment,
    bag_files,
    machine,
    ticks,
)
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import publishing_robot
from tests.timing import Watch, driven

HZ: Final = 50.0
SPLIT_S: Final = 4
FRESH_S: Final = 3
DRIVE_S: Final = 14
NEWEST: Final = ("get_position_seconds_ago", {"seconds_ago": 0, "tolerance_s": 60})
A_MOMENT_AGO: Final = ("get_position_seconds_ago", {"seconds_ago": FRESH_S, "tolerance_s": 1})
TRAVELLED: Final = 0.05  # m: how far from the closed form an answer may be
ROUNDED_S: Final = 0.002  # ages are whole milliseconds
NAMES: Final = ("steady", "rotating")


@dataclass
class Drive:
    """What was answered while the robot drove, and what it turned out to have recorded."""

    watch: Watch
    recorders: dict[str, LiveRecorder]
    t0: int = 0
    published: int = 0
    newest: dict[str, list[Answer]] = field(default_factory=dict)
    ago: dict[str, list[Answer]] = field(default_factory=dict)
    recorded: dict[str, list[Tick]] = field(default_factory=dict)
    copies: dict[str, list[list[Tick]]] = field(default_factory=dict)  # of each recording
    files: dict[str, int] = field(default_factory=dict)


@pytest.fixture(scope="module")
def drive(real_recorder: RealRecorder, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return driven(
        lambda watch: drive_once(tmp_path_factory.mktemp("tail"), watch, real_recorder), judge
    )


def judge(drive: Drive) -> None:
    """All that is promised by the clock."""
    for name in NAMES:
        for check in CHECKS:
            check(drive, name)


def drive_once(folder: Path, watch: Watch, real: RealRecorder) -> Drive:
    options = ("--hz", f"{HZ:g}", "--subscribers", "2")
    with (
        machine(folder, real) as site,
        publishing_robot(site.env, folder / "truth.json", *options) as robot,
        ExitStack() as stack,
    ):
        live = "reader.include_active=true"
        served = {
            name: stack.enter_context(answering(site.bag_dir(name), folder / f"{name}.log", live))
            for name in NAMES
        }
        splits = f"recording.split_duration_s={SPLIT_S}"
        drive = Drive(
            watch,
            {
                "steady": site.record("steady", splits),
                "rotating": site.record("rotating", splits, "recording.session_duration_s=6"),
            },
        )
        drive.t0 = robot.t0
        await_moment(drive.t0 + (FRESH_S + 1) * NS_PER_S)
        while time.time_ns() < drive.t0 + DRIVE_S * NS_PER_S:
            for name in NAMES:
                newest, ago = answers(served[name], NEWEST, A_MOMENT_AGO)
                drive.newest.setdefault(name, []).append(newest)
                drive.ago.setdefault(name, []).append(ago)
        drive.published = robot.stop()["/odom"]
        watch.report("the robot", robot.late_s)
        for name, recorder in drive.recorders.items():
            recorder.stop()
            files = bag_files(recorder.bag_dir)
            drive.files[name] = len(files)
            drive.recorded[name] = ticks(files, drive.t0, HZ)
            recordings = groupby(files, key=lambda file: file.parent)
            found = [ticks([*of], drive.t0, HZ, counting=False) for _, of in recordings]
            drive.copies[name] = [*filter(None, found)]
        return drive


def is_asked_often(drive: Drive, name: str) -> None:
    """The questions went over the end of a split."""
    assert drive.files[name] >= DRIVE_S // SPLIT_S
    assert len(drive.newest[name]) >= 5


def is_fresh(drive: Drive, name: str) -> None:
    """What was recorded 3 s before a question is found by it."""
    for told, asked, _ in drive.newest[name]:
        assert "timestamp" in told, told
        recorded = _newest_recorded(drive, name, asked - FRESH_S)
        assert told["timestamp"] >= unix_rounded_up(recorded)


def is_right(drive: Drive, name: str) -> None:
    for told, asked, answered in drive.ago[name]:
        assert "x" in told, told
        now = told["timestamp"] + told["age_s"]
        assert asked - ROUNDED_S <= now <= answered + ROUNDED_S
        x, y = position(told["timestamp"] - drive.t0 / NS_PER_S)
        assert math.hypot(told["x"] - x, told["y"] - y) <= TRAVELLED
        # In a rotation two recordings log one message at times of their own: either may answer.
        found = [
            each.number
            for each in chain.from_iterable(drive.copies[name])
            if abs(told["timestamp"] - each.log_time / NS_PER_S) <= 2e-6  # whole microseconds
        ]
        assert found, told
        then = now - FRESH_S
        # What one of them lost or wrote late need not be known while both still run.
        since, until = then - ROUNDED_S, then + ROUNDED_S
        running = [each for each in drive.copies[name] if each[-1].log_time >= since * NS_PER_S]
        oldest = min(_newest_of_each(running, since))
        newest = max(_newest_of_each(drive.copies[name], until))
        assert oldest <= found[0] <= newest, (told, asked, answered, drive.t0)


def _newest_of_each(recordings: list[list[Tick]], at: float) -> list[int]:
    """The newest message that each recording had received at a moment, if it had any."""
    received = [[t.number for t in each if t.log_time <= at * NS_PER_S] for each in recordings]
    return [max(numbers) for numbers in received if numbers]


def _newest_recorded(drive: Drive, name: str, at: float) -> int:
    """The log time of the newest message at or before a moment (Unix s); 0 without one."""
    times = (t.log_time for t in drive.recorded[name] if t.log_time <= at * NS_PER_S)
    return max(times, default=0)


@pytest.mark.parametrize("name", NAMES)
def test_an_answer_from_what_is_being_written_says_so(drive: Drive, name: str) -> None:
    assert any(told.get("from_active") is True for told, *_ in drive.newest[name])


def is_recorded(drive: Drive, name: str) -> None:
    """Recording goes on as if nobody had asked."""
    numbers = [tick.number for tick in drive.recorded[name]]
    assert numbers == list(range(drive.published))


CHECKS: Final = (is_asked_often, is_fresh, is_right, is_recorded)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_while_it_drives(drive: Drive, name: str, check: Callable[[Drive, str], None]) -> None:
    with drive.watch.excusing():
        check(drive, name)

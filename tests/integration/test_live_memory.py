"""The whole system over real DDS: a robot drives, is recorded, and is asked about while it drives.

Three recorders record the same drive, each with a server of its own: one rotates, one has its
recorder process killed and is restarted later, and one, with splits of 10 s, is killed whole. Of
what rotates a second server answers from what is being written.
"""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.timebase import unix_rounded_up
from tests.support.closed_form import position
from tests.support.live_recorder import (
    NS_PER_S,
    Answer,
    LiveRecorder,
    Machine,
    Tick,
    answering,
    answers,
    await_answerable,
    await_moment,
    bag_files,
    machine,
    ticks,
)
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import Robot, publishing_robot
from tests.support.served import Served
from tests.timing import Watch, driven

HZ = 50.0
AGO_S = 10
FRESH_S = 3
NAMES = ("rotating", "killed", "ten")
NEWEST = ("get_position_seconds_ago", {"seconds_ago": 0, "tolerance_s": 60})
A_MOMENT_AGO = ("get_position_seconds_ago", {"seconds_ago": FRESH_S, "tolerance_s": 1})
TEN_S_AGO = ("get_position_seconds_ago", {"seconds_ago": AGO_S})
TRAVELLED = 0.05  # m: how far from the closed form an answer may be
ROUNDED_S = 0.002  # ages are whole milliseconds


@dataclass
class Drive:
    """What came of it."""

    watch: Watch
    rotating: LiveRecorder
    killed: LiveRecorder
    ten: LiveRecorder
    t0: int = 0
    published: dict[str, int] = field(default_factory=dict)
    positions: dict[str, Answer] = field(default_factory=dict)
    """Replies about 10 s ago, by what had happened before."""
    scissors: dict[str, Any] = field(default_factory=dict)
    topics: list[dict[str, Any]] = field(default_factory=list)
    after: dict[str, Any] = field(default_factory=dict)
    """`data_time_range` of each memory at the end."""
    newest: list[Answer] = field(default_factory=list)
    """Replies about now, from what was being written, and about 3 s ago."""
    ago: list[Answer] = field(default_factory=list)
    copies: list[list[Tick]] = field(default_factory=list)
    """What stands in each recording that was being written then, and when what counts came."""
    recorded: list[int] = field(default_factory=list)


@pytest.fixture(scope="module")
def drive(real_recorder: RealRecorder, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return driven(
        lambda watch: drive_once(tmp_path_factory.mktemp("live"), watch, real_recorder), judge
    )


def judge(drive: Drive) -> None:
    """All that holds where programs run in time: the robot's, the recorders' in a handover."""
    for check in CHECKS.values():
        check(drive)


def drive_once(folder: Path, watch: Watch, real: RealRecorder) -> Drive:
    options = ("--hz", f"{HZ:g}", "--subscribers", "3")
    with (
        machine(folder, real) as site,
        # It is there, and silent, before any of them rotates.
        publishing_robot(site.env, folder / "truth.json", *options) as robot,
        ExitStack() as stack,
    ):
        # Once the robot drives nothing else should be busy starting.
        served = {
            name: stack.enter_context(answering(site.bag_dir(name), folder / f"{name}.log"))
            for name in NAMES
        }
        live = answering(
            site.bag_dir("rotating"), folder / "live.log", "reader.include_active=true"
        )
        served["live"] = stack.enter_context(live)
        short = "recording.split_duration_s=2"
        drive = Drive(
            watch,
            site.record("rotating", short, "recording.session_duration_s=7"),
            site.record("killed", short),
            site.record("ten", "recording.split_duration_s=10"),
        )
        _drive(drive, site, served, robot)
        return drive


def _drive(drive: Drive, site: Machine, served: dict[str, Served], robot: Robot) -> None:
    drive.t0 = robot.t0

    def ask(name: str, what: str) -> None:
        (drive.positions[what],) = answers(served[name], TEN_S_AGO)

    await_moment(drive.t0 + 3 * NS_PER_S)
    drive.killed.kill_child()
    drive.killed.wait_for_subscriptions()
    child_is_back = max(drive.killed.subscribed_all().values())

    await_moment(drive.t0 + 12 * NS_PER_S)
    ask("ten", "12 s, in splits of 10 s")
    ask("rotating", "12 s, in splits of 2 s")
    drive.ten.kill(with_children=False)
    drive.ten = site.record("ten", "recording.split_duration_s=10")

    while time.time_ns() < drive.t0 + 22 * NS_PER_S:
        newest, ago = answers(served["live"], NEWEST, A_MOMENT_AGO)
        drive.newest.append(newest)
        drive.ago.append(ago)
    drive.rotating.wait_for("rotated", 3)
    await_answerable(served["killed"], child_is_back)
    await_moment(child_is_back + 12 * NS_PER_S)
    ask("rotating", "rotations")
    ask("killed", "a killed recorder")
    drive.killed.stop()
    drive.killed = site.record("killed", "recording.split_duration_s=2")
    drive.killed.wait_for_subscriptions()
    ask("killed", "a restart")

    drive.ten.wait_for_subscriptions()
    daemon_is_back = max(drive.ten.subscribed_all().values())
    await_answerable(served["ten"], daemon_is_back)
    await_moment(daemon_is_back + 12 * NS_PER_S)
    ask("ten", "a killed daemon")

    drive.published = robot.stop()
    drive.watch.report("the robot", robot.late_s)
    for recorder in (drive.rotating, drive.killed, drive.ten):
        recorder.stop()
    _look_back(drive, served)


def _look_back(drive: Drive, served: dict[str, Served]) -> None:
    """Asks about the whole drive after its end."""
    files = bag_files(drive.rotating.bag_dir)
    drive.recorded = [tick.log_time for tick in ticks(files, drive.t0, HZ)]
    recordings = groupby(files, key=lambda file: file.parent)
    copies = (ticks([*own], drive.t0, HZ, counting=False) for _, own in recordings)
    drive.copies = [*filter(None, copies)]
    wanted = {"condition_type": "contains", "value": "scissors", "fields": "header.stamp"}
    found = ("find_last_match", {"topic": "/vision/*/scene_objects", **wanted})
    for name in ("rotating", "killed"):
        drive.scissors[name] = answers(served[name], found)[0].reply
    drive.topics = answers(served["rotating"], ("list_recorded_topics", {}))[0].reply
    for name, server in served.items():
        drive.after[name] = answers(server, ("data_time_range", {}))[0].reply


def is_right(what: str, drive: Drive) -> None:
    told, asked, answered = drive.positions[what]
    assert "age_s" in told, told
    now = told["timestamp"] + told["age_s"]  # in whole milliseconds
    assert asked - 0.002 <= now <= answered + 0.002
    x, y = position(now - AGO_S - drive.t0 / NS_PER_S)
    assert math.hypot(told["x"] - x, told["y"] - y) <= TRAVELLED


def is_fresh(drive: Drive) -> None:
    """What was recorded 3 s before a question is found by it."""
    assert len(drive.newest) >= 5
    assert any(told.get("from_active") is True for told, *_ in drive.newest)
    for told, asked, _ in drive.newest:
        assert "timestamp" in told, told
        recorded = max(at for at in drive.recorded if at <= (asked - FRESH_S) * NS_PER_S)
        assert told["timestamp"] >= unix_rounded_up(recorded)


def is_right_while_it_is_written(drive: Drive) -> None:
    for told, asked, answered in drive.ago:
        assert "x" in told, told
        now = told["timestamp"] + told["age_s"]
        assert asked - ROUNDED_S <= now <= answered + ROUNDED_S
        x, y = position(told["timestamp"] - drive.t0 / NS_PER_S)
        assert math.hypot(told["x"] - x, told["y"] - y) <= TRAVELLED
        # In a rotation two recordings log one message at times of their own: either may answer.
        found = [
            each.number
            for each in chain.from_iterable(drive.copies)
            if abs(told["timestamp"] - each.log_time / NS_PER_S) <= 2e-6  # whole microseconds
        ]
        assert found, told
        # What one of them lost or wrote late need not be known while both still run.
        since, until = now - FRESH_S - ROUNDED_S, now - FRESH_S + ROUNDED_S
        running = [each for each in drive.copies if each[-1].log_time >= since * NS_PER_S]
        oldest = min(_newest_of_each(running, since))
        newest = max(_newest_of_each(drive.copies, until))
        assert oldest <= found[0] <= newest, (told, asked, answered, drive.t0)


def _newest_of_each(recordings: list[list[Tick]], at: float) -> list[int]:
    """The newest message that each recording had received at a moment, if it had any."""
    received = [[t.number for t in each if t.log_time <= at * NS_PER_S] for each in recordings]
    return [max(numbers) for numbers in received if numbers]


def counts_once(drive: Drive) -> None:
    assert len(drive.rotating.events("rotated")) >= 3
    assert {row["topic"]: row["count"] for row in drive.topics} == drive.published


def all_answers(name: str, drive: Drive) -> None:
    """A recorder that does not get to close its files is killed in the end."""
    aside = ("active", "damaged", "incomplete", "unread")
    assert {kind: drive.after[name][kind] for kind in aside} == {key: [] for key in aside}


AFTER = (
    "12 s, in splits of 10 s",
    "12 s, in splits of 2 s",
    "rotations",
    "a killed recorder",
    "a restart",
    "a killed daemon",
)
CHECKS: Mapping[str, Callable[[Drive], None]] = {
    **{f"where it was 10 s ago is right after {what}": partial(is_right, what) for what in AFTER},
    "what was recorded 3 s before is found while it is being written": is_fresh,
    "where it was 3 s ago is right while it is being written": is_right_while_it_is_written,
    "over three rotations every message that was sent counts once": counts_once,
    **{
        f"no file of {name} is left without an answer": partial(all_answers, name) for name in NAMES
    },
}


@pytest.mark.parametrize("check", CHECKS)
def test_while_and_after_it_drives(drive: Drive, check: str) -> None:
    with drive.watch.excusing():
        CHECKS[check](drive)


@pytest.mark.parametrize("name", ["rotating", "killed"])
def test_scissors_were_last_seen_when_the_robot_last_published_them(
    drive: Drive, name: str
) -> None:
    # Stamps of the robot are whole milliseconds.
    stamp_ms: float = drive.scissors[name]["value"]["header.stamp"] * 1000
    assert round(stamp_ms) * 10**6 == drive.t0 + 17 * NS_PER_S

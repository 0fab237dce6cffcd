"""Robots in trouble of some kind: it is named, spoils nobody else's rows, and none waits for one.

Of six robots one is damaged, one offline, one goes offline while the server runs, the clock of one
is a year ahead, and the disk of one hangs.
"""

import shutil
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.errors import (
    BusyError,
    EpisodicError,
    InvalidArgumentsError,
    QueryTimeoutError,
)
from ros2_memory.core.timebase import Deadline
from ros2_memory.fleet.replies import Page, RobotReply, merge_replies
from ros2_memory.fleet.robots import FanOut, Fleet, Robot
from ros2_memory.history.context import Call
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.tools.declaration import Tool
from tests.support.bags import set_mtime
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW, SEEN, reply_of, seeded, tools_of, write_robot
from tests.support.memories import memory_of

YEAR_S = 365 * 86_400
ROBOTS = {
    name: seeded(name, shift_s=YEAR_S if name == "ahead" else 0)
    for name in ("well", "ahead", "damaged", "gone", "slow")
}
LAST = {"topic": SEEN, "condition_type": "contains"}
TABLE = {**LAST, "value": "table"}


class Hanging(McapReader):
    """A disk that does not answer until it is released."""

    def __init__(self, released: threading.Event) -> None:
        super().__init__()
        self._released = released

    def summarize(self, path: Path) -> BagSummary:
        self._released.wait()
        return super().summarize(path)


class Six(NamedTuple):
    """The tools of the six robots, and what was answered while `gone` was there."""

    tools: Mapping[str, Tool]
    before: Any

    def reply(self, tool: str, **given: object) -> Any:
        return reply_of(self.tools[tool], given)


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Six]:
    folder, released = tmp_path_factory.mktemp("six"), threading.Event()
    for name, robot in ROBOTS.items():
        write_robot(robot, folder / name)
    broken = folder / "damaged" / "rec" / "rec_1.mcap"
    modified = broken.stat().st_mtime_ns
    broken.write_bytes(b"no bag " * 100)
    set_mtime(broken, modified)
    clock = FixedClock(NOW)

    def robot_of(name: str) -> Robot:
        reader = Hanging(released) if name == "slow" else McapReader()
        return Robot(name, memory_of(folder / name, clock=clock, reader=reader))

    tools = tools_of(Fleet(map(robot_of, (*ROBOTS, "offline")), clock, shared_map=True))
    hung = reply_of(tools["list_frames"], {"robot": "slow"}, Call(Deadline.after(0.2)))
    assert hung["error"] == "timeout"
    before = reply_of(tools["find_matches"], TABLE)
    shutil.rmtree(folder / "gone")
    yield Six(tools, before)
    released.set()


def last_seen(name: str, label: str) -> list[float]:
    """When a robot last saw a label, as far as its bags can be read; the robot ahead comes last."""
    robot = ROBOTS[name]
    until = robot.start_s + 30 if name == "damaged" else robot.end_s + 1
    return [float(at) for at, what in robot.seen if what == label and at < until][-1:]


@pytest.mark.parametrize("label", ["mug", "scissors", "elephant"])
def test_who_last_saw_it_is_told_of_those_whose_bags_were_read(six: Six, label: str) -> None:
    found = six.reply("find_last_match", **LAST, value=label)
    rows = {row["robot_name"]: [row["timestamp"]] for row in found["matches"]}
    truth = {name: last_seen(name, label) for name in ("well", "damaged", "ahead")}
    assert rows == {name: times for name, times in truth.items() if times}
    assert [*rows] == sorted(rows, key=lambda name: (name == "ahead", -rows[name][0]))
    # Of one with a damaged bag "never" would be a claim about what was not searched.
    never = [name for name in ("well", "ahead") if not truth[name]]
    assert found.get("never", []) == never


def test_each_trouble_is_named_with_its_reason_and_spoils_nobody_elses_rows(
    six: Six, tmp_path_factory: pytest.TempPathFactory
) -> None:
    found = six.reply("find_matches", **TABLE, limit=50)
    assert {row["robot_name"] for row in found["sightings"]} == {"well", "ahead", "damaged"}
    for name, words in (
        ("offline", "the bag directory does not exist (yet): check .../"),
        ("gone", "the bag directory does not exist (yet): check .../"),
        ("slow", "did not finish in time"),
        ("ahead", "clock that ran ahead"),
        ("damaged", "rec/rec_1.mcap"),
    ):
        assert any(name in note and words in note for note in found["notes"]), found["notes"]
    codes = {"offline": "refused", "gone": "refused", "slow": "busy"}
    assert found["robots_failed"] == codes
    assert str(tmp_path_factory.getbasetemp()) not in str(found)
    rows = {row["robot_name"]: row for row in six.reply("memory_status")["robots"]}
    assert rows.keys() == {*ROBOTS, "offline"} - {"slow"}
    assert rows["damaged"]["damaged"] == 1
    assert "does not exist" in rows["offline"]["doubts"]
    assert rows["well"]["doubts"] == "no loss or fault was found"


def test_who_goes_offline_was_in_the_answer_before(six: Six) -> None:
    assert any("offline" in note and "gone" not in note for note in six.before["notes"])
    assert "gone" in six.before["by_robot"]


def test_who_cannot_answer_says_so_where_it_is_named(six: Six) -> None:
    for name, error in (("offline", "no_data"), ("gone", "no_data"), ("slow", "busy")):
        assert six.reply("find_matches", **TABLE, robot=name)["error"] == error


def robots(count: int) -> list[Robot]:
    none: Any = None  # no memory is needed
    return [Robot(f"r{number}", none) for number in range(count)]


@pytest.fixture
def released() -> Iterator[threading.Event]:
    """Set at the end, so that no thread of a test outlives it."""
    event = threading.Event()
    yield event
    event.set()


def test_an_error_is_that_of_its_robot_and_a_fault_says_nothing_more() -> None:
    def work(robot: Robot, _call: Call) -> str:
        if robot.name == "r0":
            raise InvalidArgumentsError("no such place")
        if robot.name == "r1":
            raise RuntimeError("secret /home/path")
        return "fine"

    found = FanOut().ask(robots(3), work, Call())
    assert isinstance(found["r0"], InvalidArgumentsError)
    assert isinstance(found["r1"], EpisodicError)
    assert "secret" not in str(found["r1"])
    assert found["r2"] == "fine"


def test_as_many_as_are_asked_at_once_may_hang_and_are_not_asked_again_until_they_are_done(
    released: threading.Event,
) -> None:
    def hangs(robot: Robot, _call: Call) -> str:
        if robot.name in {"r0", "r1"}:
            released.wait()
        return "fine"

    fan_out = FanOut(at_once=2)
    found = fan_out.ask(robots(8), hangs, Call(Deadline.after(0.5))).values()
    assert [*map(type, found)] == [QueryTimeoutError] * 2 + [str] * 6
    again = fan_out.ask(robots(3), lambda *_: "fine", Call()).values()
    assert [*map(type, again)] == [BusyError, BusyError, str]

    released.set()
    for thread in threading.enumerate():
        if thread.name.startswith("robot-r"):
            thread.join()
    assert fan_out.ask(robots(1), lambda *_: "fine", Call()) == {"r0": "fine"}


def test_while_one_of_several_late_questions_hangs_the_robot_is_not_asked_again(
    released: threading.Event,
) -> None:
    fan_out, first_may_end = FanOut(), threading.Event()
    hanging: list[threading.Thread] = []

    def second(_robot: Robot, _call: Call) -> None:
        hanging.append(threading.current_thread())
        released.wait()

    def first(_robot: Robot, _call: Call) -> None:
        hanging.append(threading.current_thread())
        fan_out.ask(robots(1), second, Call(Deadline.after(0.1)))
        first_may_end.wait()

    late = fan_out.ask(robots(1), first, Call(Deadline.after(2)))["r0"]
    assert isinstance(late, QueryTimeoutError)
    first_may_end.set()
    hanging[0].join()
    assert isinstance(fan_out.ask(robots(1), lambda *_: "fine", Call())["r0"], BusyError)
    released.set()
    hanging[1].join()
    assert fan_out.ask(robots(1), lambda *_: "fine", Call()) == {"r0": "fine"}


def test_questions_at_once_to_a_robot_that_answers_run_beside_each_other() -> None:
    fan_out, all_run = FanOut(), threading.Barrier(3)

    def meets(_robot: Robot, _call: Call) -> str:
        all_run.wait(60)
        return "fine"

    with ThreadPoolExecutor(3) as threads:
        answers = threads.map(lambda _: fan_out.ask(robots(1), meets, Call()), range(3))
    assert [*answers] == [{"r0": "fine"}] * 3


def test_a_robot_is_told_when_its_time_is_up() -> None:
    now_s = 0.0

    def heeds(_robot: Robot, call: Call) -> str:
        nonlocal now_s
        assert not call.deadline.expired()
        now_s = 54.0
        assert call.deadline.expired()
        raise QueryTimeoutError("too long", searched_back_to=7)

    call = Call(Deadline.after(60, lambda: now_s))
    error = FanOut().ask(robots(1), heeds, call)["r0"]
    assert not call.deadline.expired()
    assert isinstance(error, QueryTimeoutError)
    assert error.searched_back_to == 7


def test_a_total_that_one_robot_did_not_count_is_not_that_of_the_others() -> None:
    totals = {"red": {"total": 7}, "blue": {"at_least": 5}}
    replies = [
        RobotReply(name, {"sightings": [], **total}, latest=100) for name, total in totals.items()
    ]
    found = merge_replies("find_matches", replies, {}, Page(None, oldest_first=False), 10**6)
    assert (found["at_least"], "total" in found) == (12, False)

"""One question to many robots: none waits for one, and their answers become one reply."""

import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import (
    BusyError,
    EpisodicError,
    InvalidArgumentsError,
    QueryTimeoutError,
)
from ros2_memory.core.timebase import Deadline
from ros2_memory.fleet.robots import FanOut, Robot
from ros2_memory.fleet.tools import Page, RobotReply, merged
from ros2_memory.history.context import Call


def robots(count: int) -> list[Robot]:
    none: Any = None  # no memory is needed
    return [Robot(f"r{number}", Path("bags"), none) for number in range(count)]


@pytest.fixture
def released() -> Iterator[threading.Event]:
    """Set at the end, so that no thread of a test outlives it."""
    event = threading.Event()
    yield event
    event.set()


def test_all_answer_in_their_order_and_what_they_cost_is_the_calls() -> None:
    def work(robot: Robot, call: Call) -> str:
        call.stages.add("read", 5)
        call.used_active = robot.name == "r7"
        return robot.name.upper()

    call = Call()
    found = FanOut().ask(robots(9), work, call)
    assert [*found.items()] == [(f"r{number}", f"R{number}") for number in range(9)]
    assert call.stages.spent == {"read": 45}
    assert call.used_active


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
    found = fan_out.ask(robots(8), hangs, Call(Deadline.after(0.5)))
    assert [isinstance(found[f"r{number}"], QueryTimeoutError) for number in (0, 1)] == [True] * 2
    assert [found[f"r{number}"] for number in range(2, 8)] == ["fine"] * 6

    again = fan_out.ask(robots(3), lambda *_: "fine", Call())
    assert [isinstance(again[f"r{number}"], BusyError) for number in (0, 1)] == [True] * 2
    assert again["r2"] == "fine"

    released.set()
    for thread in threading.enumerate():
        if thread.name.startswith("robot-r"):
            thread.join()
    assert fan_out.ask(robots(1), lambda *_: "fine", Call()) == {"r0": "fine"}


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


def reply_of(tool: str, replies: Sequence[RobotReply], **how: Any) -> dict[str, Any]:
    failures: Mapping[str, EpisodicError] = how.pop("failures", {})
    page = Page(how.pop("limit", None), oldest_first=False)
    found = merged(tool, replies, failures, page, 10**6)
    assert json.loads(json.dumps(found)) == found
    return found


def test_a_total_that_one_robot_did_not_count_is_not_that_of_the_others() -> None:
    found = reply_of(
        "find_matches",
        [
            RobotReply("red", {"sightings": [], "total": 7}, latest=100),
            RobotReply("blue", {"sightings": [], "at_least": 5}, latest=100),
        ],
    )
    assert found["at_least"] == 12
    assert "total" not in found


def test_a_stay_that_goes_on_is_the_newest() -> None:
    replies = [
        RobotReply(name, {"visits": [{"arrived": arrived, "departed": departed}], "total": 1})
        for name, arrived, departed in (("r1", 8.0, 9.0), ("r2", 1.0, None))
    ]
    found = reply_of("visits", replies)["visits"]
    assert [row["robot_name"] for row in found] == ["r2", "r1"]

"""Searches go on where a lake has more days of a robot than are looked at together."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import NoDataError
from ros2_memory.core.timebase import NS_PER_S, Deadline
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.history.context import Call, Memory
from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.queries import find_last_match
from ros2_memory.results import Match
from tests.support.bags import Msg, detections, text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW, SEEN, START_S, reply
from tests.support.lakes import lake_robot, robot_bags, ship

DAY_S = 86_400
DAYS = 7
"""Days ago that the first bag is of; from then on there are two of a day, and none of the third."""


@pytest.fixture(scope="module")
def memory(engine: LakeEngine, tmp_path_factory: pytest.TempPathFactory) -> Memory:
    """A robot of which one day at a time is looked at: it saw a mug, a day later a fork, then cups.

    Its track is of another topic since.
    """
    folder = tmp_path_factory.mktemp("old")
    labels = {DAYS: "mug", DAYS - 1: "fork"}
    for ago in (7, 6, 4, 3, 1, 0):
        at = (START_S - ago * DAY_S) * NS_PER_S
        seen = labels.get(ago, "cup")
        messages: list[Msg] = [detections(at, [seen]), text(at + NS_PER_S, seen)]
        if ago == DAYS:
            messages.append(detections(at + 2, ["spoon"], topic="/vision/old"))
        write_mcap(folder / "bags" / "rec" / f"rec_{DAYS - ago}.mcap", messages)
    ship(folder / "lake", [robot_bags("hall", folder / "bags")], most_bags=9)
    return lake_robot(folder / "lake", engine, days=1, most_bags=1)


@pytest.fixture
def robot(memory: Memory) -> Robot:
    return Robot("hall", Path("/hall"), memory, lake=memory)


def asked(of: Robot, tool: str, label: str, topic: str = SEEN, **more: object) -> Any:
    given = {"topic": topic, "condition_type": "contains", "value": label, **more}
    return reply(Fleet([of], FixedClock(NOW)), tool, given)


def test_what_was_seen_before_the_newest_days_is_found_and_never_is_of_all(robot: Robot) -> None:
    for label, ago in (("cup", 0), ("fork", 6), ("mug", 7), ("elephant", None)):
        found = asked(robot, "find_last_match", label)
        times = [row["timestamp"] for row in found["matches"]]
        assert times == ([] if ago is None else [START_S - ago * DAY_S])
        assert ("never" in found) is (ago is None)
        assert "not looked at" not in str(found)
    before = START_S - 2 * DAY_S
    assert "never" not in asked(robot, "find_last_match", "mug", before=before)
    # A topic of old days alone.
    assert len(asked(robot, "find_last_match", "spoon", "/vision/old")["matches"]) == 1
    assert asked(robot, "find_last_match", "cup", "/vision/old")["never"] == ["hall"]


def test_days_before_are_named_only_where_the_answer_is_of_them(robot: Robot) -> None:
    spans: tuple[tuple[dict[str, Any], bool], ...] = (
        ({}, True),
        ({"start": START_S - DAY_S}, True),
        ({"start": START_S}, False),
        ({"last_s": 60}, False),
        ({"end": START_S - 2 * DAY_S}, True),
    )
    for span, is_noted in spans:
        for name in ({}, {"robot": "hall"}):
            found = asked(robot, "find_matches", "cup", **span, **name)
            assert ("not looked at" in str(found)) is is_noted, span


def test_where_the_time_is_short_it_says_how_far_it_looked(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ros2_memory.queries.READING_S", 0.0)

    def ask(topic: str, memory: Memory, call: Call) -> Match:
        return find_last_match(memory, call, topic, "contains", "mug")

    call = Call(Deadline.after(60))
    found, lake = robot.asked(partial(ask, SEEN), call)
    assert found.found is None
    assert lake is not None
    [note] = lake.notes
    assert note.startswith("the lake has days before ")
    with pytest.raises(NoDataError, match=r"/none.*; the lake has days before "):
        robot.asked(partial(ask, "/none"), Call(Deadline.after(60)))

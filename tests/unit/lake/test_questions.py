"""Questions to a lake are answered as the robots' own memories answer them.

The oracle is a fleet of these memories over the same bags.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ros2_memory.core.errors import EpisodicError, NotShippedError
from ros2_memory.core.timebase import NS_PER_S, iso_local
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.fleet.tools import fleet_tools
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.lake.memory.robot import LakeRobot
from ros2_memory.tools.replies import Replies
from ros2_memory.tools.spec_tools import build_tools
from tests.support.fleets import LENGTH_S, SEEN, START_S, fleet_memory, seeded, write_robot
from tests.support.lake_rows import fill, fleet_of, lake_in, lake_robots
from tests.support.memories import with_store

NAMES = ("attic", "hall", "kitchen")
TOLERANCE_M = 0.06
"""Of the thinned track, and what a robot drives between two of its poses' times."""
ALL: dict[str, object] = {"start": START_S, "end": START_S + 600}
CUT: dict[str, object] = {"start": seeded("hall").start_s + 10, "end": seeded("hall").start_s + 40}
SPOT: dict[str, object] = {"where": {"x": 2.0, "y": 4.0, "radius_m": 1.5}}
MUG: dict[str, object] = {"topic": "/vision/*/*", "condition_type": "contains", "value": "mug"}
QUESTIONS: dict[str, tuple[str, dict[str, object]]] = {
    "things": ("find_things", {}),
    "things of a label": ("find_things", {"label": "table", "limit": 3}),
    "things in a time that cuts bags": ("find_things", CUT),
    "visits": ("visits", SPOT),
    "visits, by hour": ("visits", {**SPOT, "by": "hour"}),
    "metres by day": ("trajectory_summary", {**ALL, "by": "day"}),
    "metres by hour": ("trajectory_summary", {**ALL, "by": "hour"}),
    "metres of one robot": ("trajectory_summary", {**ALL, "robot": "hall"}),
    "recap": ("recap", ALL),
    "sightings by hour": ("find_matches", {**MUG, "by": "hour"}),
    "never": ("find_last_match", {**MUG, "value": "elephant"}),
    "range": ("data_time_range", {}),
    "topics": ("list_recorded_topics", {}),
}


class Robots(NamedTuple):
    """The same robots' memories over their bags, and over a lake."""

    mounted: Fleet
    lake: Fleet
    of_lake: dict[str, LakeRobot]


@pytest.fixture(scope="module")
def memories(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Memory]:
    folder = tmp_path_factory.mktemp("robots")
    found: dict[str, Memory] = {}
    for name in NAMES:
        bag_dir = write_robot(seeded(name), folder / name)
        found[name] = with_store(fleet_memory(bag_dir), bag_dir)
    return found


@pytest.fixture(scope="module")
def robots(
    memories: dict[str, Memory], engine: LakeEngine, tmp_path_factory: pytest.TempPathFactory
) -> Robots:
    catalog = lake_in(tmp_path_factory.mktemp("lake"))
    fill(catalog, memories)
    return asked_both_ways(memories, lake_robots(catalog, engine, [*memories]))


def asked_both_ways(memories: dict[str, Memory], of_lake: dict[str, LakeRobot]) -> Robots:
    over_lake = {name: each.memory for name, each in of_lake.items()}
    return Robots(
        fleet_of(memories, shared_map=True), fleet_of(over_lake, shared_map=True), of_lake
    )


def reply(fleet: Fleet, name: str, given: dict[str, object]) -> Any:
    """The JSON of the reply, be it an error."""
    tools = fleet_tools(build_tools(QuerySettings()), fleet, 10**6)
    [tool] = [each for each in tools if each.name == name]
    replies, call = Replies(Path("/"), 10**6), Call()
    try:
        answer = tool.question(given)(next(iter(fleet.robots.values())).memory(), call)
    except EpisodicError as error:
        return json.loads(replies.error(error).text)
    return json.loads(replies.answer(answer, from_active=False).text)


@pytest.mark.parametrize("words", QUESTIONS)
def test_a_lake_answers_as_the_memories_do(robots: Robots, words: str) -> None:
    tool, given = QUESTIONS[words]
    expected = reply(robots.mounted, tool, given)
    assert "error" not in expected
    found = reply(robots.lake, tool, given)
    for one, other in zip(expected.get("visits", ()), found.get("visits", ()), strict=True):
        # A lake has the poses of the thinned track alone.
        assert other.pop("closest_m") == pytest.approx(one.pop("closest_m"), abs=0.08)
    assert found == expected


def test_the_newest_match_of_each_robot_is_the_same(robots: Robots) -> None:
    expected, found = (reply(each, "find_last_match", MUG) for each in robots[:2])
    assert len(expected["matches"]) == 3
    for one, other in zip(expected["matches"], found["matches"], strict=True):
        [mine], [its] = (each.pop("value")["detections"] for each in (one, other))
        # A lake has no headers: each detection has its own frame.
        del one["frame_id"]
        assert other == one
        assert (its["label"], its["score"]) == (mine["label"], mine["score"])


@pytest.mark.parametrize("more", [{}, SPOT, CUT], ids=["everywhere", "in a place", "in a time"])
def test_sightings_are_the_same_but_for_the_tolerance_of_places(
    robots: Robots, more: dict[str, object]
) -> None:
    given = {**MUG, **more, "limit": 50}
    expected, found = (reply(each, "find_matches", given) for each in robots[:2])
    assert expected["sightings"]
    for one, other in zip(expected["sightings"], found["sightings"], strict=True):
        # The place of the thing is in its message's frame: the lake has no other transforms.
        assert one.pop("place")["frame_id"] == "map"
        assert other.pop("place")["frame_id"] == "base_link"
        for axis in "xy":
            apart = one["robot"].pop(axis) - other["robot"].pop(axis)
            assert abs(apart) <= TOLERANCE_M
    assert found == expected


def test_metres_of_a_time_that_cuts_bags_are_those_of_the_track(robots: Robots) -> None:
    given: dict[str, object] = {**CUT, "robot": "hall", "max_waypoints": 0}
    expected, found = (reply(each, "trajectory_summary", given) for each in robots[:2])
    assert found["distance_m"] == pytest.approx(expected["distance_m"], rel=0.03)


def test_what_the_lake_does_not_hold_is_refused_with_the_remedy(robots: Robots) -> None:
    given: dict[str, object] = {
        "topic": "/is_docked",
        "timestamp": seeded("hall").start_s + LENGTH_S // 2,
        "tolerance_s": 60,
        "robot": "hall",
    }
    refused = reply(robots.lake, "get_topic_at_time", given)
    assert refused["error"] == NotShippedError.code
    assert "lake.messages" in refused["detail"]


def test_chosen_messages_answer_as_those_of_the_bags(
    memories: dict[str, Memory], engine: LakeEngine, tmp_path: Path
) -> None:
    catalog = lake_in(tmp_path)
    fill(catalog, {"hall": memories["hall"]}, ("/is_docked", SEEN))
    over_lake = fleet_of({"hall": lake_robots(catalog, engine, ["hall"])["hall"].memory})
    mounted = fleet_of({"hall": memories["hall"]})
    docked = {"topic": "/is_docked", "condition_type": "equals", "value": True}
    beside = {"value_topic": SEEN, "condition_topic": "/is_docked"}
    for tool, given in (
        ("find_last_match", docked),
        ("find_last_match", {**MUG, "topic": SEEN}),
        ("get_topic_in_range", {"topic": "/is_docked", **ALL}),
        ("get_value_when", {**beside, "condition_type": "equals", "value": True}),
    ):
        found, expected = (reply(each, tool, given) for each in (over_lake, mounted))
        assert "error" not in expected
        for each in (expected, *expected.get("matches", ())):
            each.pop("frame_id", None)  # a lake has no headers
        assert rounded(found) == rounded(expected), tool


def mixed(robots: Robots, *, is_mounted: bool) -> Fleet:
    """The fleet of a server with a lake, and with or without the robots' own memories."""
    mounted = robots.mounted.robots
    both = [
        Robot(name, Path("/") / name, mounted[name].memory, lake=source, is_mounted=is_mounted)
        for name, source in robots.of_lake.items()
    ]
    return Fleet(both, robots.mounted.clock, shared_map=True)


def test_answers_say_up_to_when_each_robot_was_shipped(robots: Robots) -> None:
    fleet = mixed(robots, is_mounted=True)
    asked = {**MUG, "value": "elephant"}
    *_, note = reply(fleet, "find_last_match", asked)["notes"]
    ends = sorted((seeded(name).end_s, name) for name in NAMES)
    times = [f"{name} up to {iso_local(end * NS_PER_S)}" for end, name in ends]
    assert note == f"from the lake, which has what was shipped: {', '.join(times)}"
    alone = reply(fleet, "recap", {**ALL, "robot": "hall"})["notes"]
    end = iso_local(seeded("hall").end_s * NS_PER_S)
    assert f"from the lake, which has what was shipped: hall up to {end}" in alone
    cut = reply(fleet, "trajectory_summary", {**CUT, "robot": "hall"})["notes"]
    assert any("not every pose" in each for each in cut)


def test_a_mounted_memory_answers_what_the_lake_cannot(robots: Robots) -> None:
    docked = {"topic": "/is_docked", "condition_type": "equals", "value": True}
    expected = reply(robots.mounted, "find_last_match", docked)
    assert len(expected["matches"]) == 3
    assert reply(mixed(robots, is_mounted=True), "find_last_match", docked) == expected
    refused = reply(mixed(robots, is_mounted=False), "find_last_match", docked)
    assert (refused["error"], "lake.messages" in refused["detail"]) == ("refused", True)
    # What a robot does now is not in a lake.
    mounted = reply(robots.mounted, "memory_status", {})
    assert reply(mixed(robots, is_mounted=True), "memory_status", {}) == mounted


def rounded(value: object) -> object:
    """A reply whose numbers are as few digits as those of a decoded message."""
    if isinstance(value, dict):
        return {name: rounded(each) for name, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return round(value, 3) if isinstance(value, float) else value

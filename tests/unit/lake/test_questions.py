"""Questions to a lake are answered as the robots' own memories answer them.

The oracle is a fleet of these memories over the same bags.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.timebase import NS_PER_S, iso_local
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.fleet.tools import fleet_tools
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.tools.replies import Replies
from ros2_memory.tools.spec_tools import build_tools
from tests.support.fleets import LENGTH_S, SEEN, fleet_memory, seeded, write_robot
from tests.support.lake_questions import Question, every_question
from tests.support.lake_rows import fill, fleet_of, lake_in, lake_robots
from tests.support.memories import with_store

NAMES = ("attic", "hall", "kitchen")
MUG: dict[str, object] = {"topic": "/vision/*/*", "condition_type": "contains", "value": "mug"}
OF_DIRECTORIES = {"memory_status"}
"""Tools that are about a bag directory, and its recorder."""


class Robots(NamedTuple):
    """The same robots' memories over their bags, and over a lake."""

    mounted: Fleet
    lake: Fleet
    of_lake: dict[str, Memory]


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


def asked_both_ways(memories: dict[str, Memory], of_lake: dict[str, Memory]) -> Robots:
    return Robots(fleet_of(memories, shared_map=True), fleet_of(of_lake, shared_map=True), of_lake)


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


def questions() -> Iterator[Question]:
    """Questions about each robot, and those of them about all that can be asked so."""
    topics = ["/odom", "/tf", "/tf_static", "/is_docked", SEEN]
    for name in NAMES:
        start_s = seeded(name).start_s
        for tool, given in every_question(topics, start_s, start_s + LENGTH_S, "mug", SEEN):
            yield tool, {**given, "robot": name}
            if name == "hall":
                yield tool, given


def test_every_question_is_answered_by_a_lake_as_by_the_bags(robots: Robots) -> None:
    asked = [*questions()]
    tools = {tool.name for tool in build_tools(QuerySettings())}
    assert {tool for tool, _ in asked} == tools - OF_DIRECTORIES
    answered = set()
    for tool, given in asked:
        expected = reply(robots.mounted, tool, given)
        assert reply(robots.lake, tool, given) == expected, (tool, given)
        if "error" not in expected:
            answered.add(tool)
    assert answered == tools - OF_DIRECTORIES


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
    whole = {"start": seeded("hall").start_s, "end": seeded("hall").end_s}
    alone = reply(fleet, "recap", {**whole, "robot": "hall"})["notes"]
    end = iso_local(seeded("hall").end_s * NS_PER_S)
    assert f"from the lake, which has what was shipped: hall up to {end}" in alone


def test_what_a_robot_does_now_is_not_asked_of_a_lake(robots: Robots) -> None:
    mounted = reply(robots.mounted, "memory_status", {})
    assert reply(mixed(robots, is_mounted=True), "memory_status", {}) == mounted

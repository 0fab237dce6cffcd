"""A lake answers as the memories do about robots with noise, a moving map and much that changes."""

from __future__ import annotations

import pytest

from ros2_memory.lake.engines.base import LakeEngine
from tests.support.fleets import fleet_memory
from tests.support.lake_questions import every_question
from tests.support.lake_rows import fill, lake_in, lake_robots, store_columns
from tests.support.memories import with_store
from tests.support.moving_map import BEGIN, S
from tests.support.noisy_robots import LENGTH_S, write_noisy_robot
from tests.unit.lake.test_questions import Robots, asked_both_ways, reply

NAMES = ("attic", "hall")
START_S = BEGIN // S


@pytest.fixture(scope="module")
def robots(engine: LakeEngine, tmp_path_factory: pytest.TempPathFactory) -> Robots:
    folder = tmp_path_factory.mktemp("robots")
    memories = {}
    for name in NAMES:
        bag_dir = write_noisy_robot(name, folder / name)
        memories[name] = with_store(fleet_memory(bag_dir), bag_dir)
    catalog = lake_in(tmp_path_factory.mktemp("lake"))
    fill(catalog, memories)
    of_lake = lake_robots(catalog, engine, NAMES, stores=tmp_path_factory.mktemp("cache"))
    for each in of_lake.values():
        store_columns(each)
    return asked_both_ways(memories, of_lake)


@pytest.mark.parametrize("name", NAMES)
def test_every_question_is_answered_by_a_lake_as_by_the_bags(robots: Robots, name: str) -> None:
    rows = reply(robots.mounted, "list_recorded_topics", {"robot": name})
    topics = [row["topic"] for row in rows]
    assert len(topics) > 5
    answered = 0
    for tool, given in every_question(topics, START_S, START_S + LENGTH_S, "ghost", "/vision/*/*"):
        asked = {**given, "robot": name}
        expected = reply(robots.mounted, tool, asked)
        assert reply(robots.lake, tool, asked) == expected, (tool, asked)
        answered += "error" not in expected
    assert answered > 60

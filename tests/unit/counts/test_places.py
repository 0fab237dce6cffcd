"""Metres, visits and what else is counted, by hour and by place."""

from dataclasses import replace
from pathlib import Path

import pytest

from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.history.context import Memory
from tests.support.memories import asked, memory_of, with_store
from tests.support.moving_map import BEGIN, S, write_moving_map
from tests.support.tables import table

WEST = Place("west", "map", Rectangle(-3.0, 2.0, -3.0, 6.0))
EAST = Place("east", "map", Rectangle(2.0, 8.0, -3.0, 6.0))
START = Place("start", "map", Circle(0.0, 0.0, 0.6))
DOOR = {"start": BEGIN / S, "end": BEGIN / S + 300}


def in_places(memory: Memory, *places: Place) -> Memory:
    return replace(memory, limits=replace(memory.limits, places=places))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("world")
    write_moving_map(folder, 1, seconds=300)
    return folder


@pytest.fixture(scope="module")
def memory(world: Path) -> Memory:
    return in_places(with_store(memory_of(world), world), WEST, EAST, START)


def test_a_place_in_another_one_counts_to_both_and_a_note_says_so(
    memory: Memory, world: Path
) -> None:
    reply = asked(memory, world, "get_topic_in_range", topic="/odom", by="place", **DOOR)
    rows = table(reply)
    assert sum(row["count"] for name, row in rows.items() if name != "all") > 1500
    assert rows["all"]["count"] == 1500
    assert "places overlap: what is in two of them counts to both" in reply["notes"]

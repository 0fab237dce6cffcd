"""Metres, visits and what else is counted, by hour and by place."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.counts.robot import count_path
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from tests.support.bags import odom, write_mcap
from tests.support.memories import asked, memory_of, with_store
from tests.support.moving_map import BEGIN, S, write_moving_map
from tests.support.tables import table

if TYPE_CHECKING:
    from pathlib import Path

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


def test_what_cannot_be_counted_by_place_is_refused(memory: Memory, world: Path) -> None:
    unnamed = asked(in_places(memory), world, "trajectory_summary", by="place", **DOOR)
    assert "needs named places" in unnamed["detail"]
    two = asked(memory, world, "visits", by="place", x=0.0, y=0.0)
    assert "give where in place of x and y" in two["detail"]
    none = asked(in_places(memory), world, "visits", by="day")
    assert "no place is named" in none["detail"]


HOUR = 1_784_001_600 * S  # a whole hour of UTC


def test_hours_without_a_recording_have_no_row_whatever_was_driven_before(tmp_path: Path) -> None:
    drawn = Random(5)
    x = 0.0
    for recording in range(3):
        messages = []
        for step in range(200):
            x += drawn.random() * 0.05
            at = HOUR + recording * 5 * 3600 * S + 1234 * S + step * S // 10
            messages.append(odom(at, x, drawn.random() * 0.01))
        write_mcap(tmp_path / f"{recording}.mcap", messages)
    span = TimeRange(HOUR / S, HOUR / S + 50_000)
    found = count_path(memory_of(tmp_path), Call(), span, "hour")
    begins = [HOUR / S + 1234 + 5 * 3600 * nth for nth in range(3)]
    hours = [datetime.fromtimestamp(at, UTC).astimezone().strftime("%H:00") for at in begins]
    assert [name[-5:] for name, _ in found.rows] == hours

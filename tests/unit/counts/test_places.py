"""Metres, visits and what else is counted, by hour and by place."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.counts.robot import count_path
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.places.visits import visits
from tests.support.bags import odom, write_mcap
from tests.support.memories import asked, memory_of, with_store
from tests.support.moving_map import BEGIN, S, write_moving_map

if TYPE_CHECKING:
    from pathlib import Path

WEST = Place("west", "map", Rectangle(-3.0, 2.0, -3.0, 6.0))
EAST = Place("east", "map", Rectangle(2.0, 8.0, -3.0, 6.0))
START = Place("start", "map", Circle(0.0, 0.0, 0.6))
DOOR = {"start": BEGIN / S, "end": BEGIN / S + 300}
OBJECTS = "/vision/scene/scene_objects"
CUP = {"topic": OBJECTS, "condition_type": "contains", "value": "cup"}


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


def table(reply: Any) -> dict[str, dict[str, Any]]:
    names = reply["columns"][1:]
    rows = {row[0]: dict(zip(names, row[1:], strict=True)) for row in reply["rows"]}
    return {**rows, "all": dict(zip(names, reply["all"], strict=True))}


def test_visits_are_counted_in_each_hour_with_entries_exits_and_minutes(
    memory: Memory, world: Path
) -> None:
    rows = table(asked(memory, world, "visits", where="start", by="hour"))
    alone = visits(memory, Call(), where="start", limit=100)
    whole = rows.pop("all")
    assert (whole["entries"], whole["exits"]) == (4, 4) == (alone.entries, alone.exits)
    assert whole["minutes"] == pytest.approx(alone.duration / S / 60, abs=0.01)
    assert whole["placed_s"] == pytest.approx(299.8, abs=0.5)
    for name in ("entries", "exits", "minutes", "recorded_s"):
        assert sum(row[name] for row in rows.values()) == pytest.approx(whole[name], abs=0.02)


def test_all_named_places_are_counted_at_once(memory: Memory, world: Path) -> None:
    places = visits(memory, Call()).places or ()
    by_place = table(asked(memory, world, "visits", by="place"))
    by_day = table(asked(memory, world, "visits", by="day"))["all"]
    for each in places:
        row = by_place[each.place]
        assert (row["entries"], row["exits"]) == (each.entries, each.exits)
        assert row["minutes"] == pytest.approx(each.duration / S / 60, abs=0.006)
        assert row["recorded_s"] == pytest.approx(each.duration / S, abs=0.06)
        assert by_day[f"{each.place}.minutes"] == row["minutes"]
        assert by_day[f"{each.place}.entries"] == each.entries
    assert by_place["(unknown)"]["recorded_s"] < 0.5


def test_what_is_counted_by_place_is_where_the_robot_was(world: Path) -> None:
    memory = in_places(with_store(memory_of(world), world), WEST, EAST)
    truth = write_moving_map(world, 1, seconds=300)
    west = sum(x <= 2.0 for x, _ in truth.places)
    rows = table(asked(memory, world, "get_topic_in_range", topic="/odom", by="place", **DOOR))
    assert rows["west"]["count"] + rows["east"]["count"] == rows["all"]["count"] == 1500
    assert rows["west"]["count"] == pytest.approx(west, abs=25)
    assert rows["(elsewhere)"]["count"] == rows["(unknown)"]["count"] == 0
    steps = [
        (abs(b[0] - a[0]) ** 2 + abs(b[1] - a[1]) ** 2) ** 0.5
        for a, b in pairwise(truth.places)
        if b[0] <= 2.0
    ]
    driven = table(asked(memory, world, "trajectory_summary", by="place", **DOOR))
    whole = sum(driven[name]["metres"] or 0 for name in driven if name != "all")
    assert whole == pytest.approx(driven["all"]["metres"], abs=0.05)
    # Corrections of the map move odometry too, which is what is measured.
    assert driven["west"]["metres"] == pytest.approx(sum(steps), rel=0.35)
    seen = table(asked(memory, world, "find_matches", by="place", **CUP))
    assert seen["west"]["seconds"] + seen["east"]["seconds"] == pytest.approx(
        seen["all"]["seconds"], abs=0.2
    )
    assert seen["all"]["count"] == 1


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


def test_a_jump_in_the_bag_in_which_a_bin_ends_adds_no_metres(tmp_path: Path) -> None:
    """Drives 1 m/s for 20 s around the full hour, and jumps by 500 m 5 s after it."""
    messages = []
    for step in range(400):
        at = HOUR - 10 * S + step * S // 20
        messages.append(odom(at, step / 20 + (500 if step >= 300 else 0), 0.0))
    write_mcap(tmp_path / "bag.mcap", messages)
    span = TimeRange(HOUR / S - 100, HOUR / S + 100)
    found = count_path(memory_of(tmp_path), Call(), span, "hour")
    column = [name for name, _ in found.columns].index("metres")
    metres = [row[column] for _, row in found.rows if row[column]]
    assert metres == pytest.approx([10.0, 9.9], abs=0.2)
    assert found.all[column] == pytest.approx(19.9, abs=0.2)


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

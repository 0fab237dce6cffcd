"""Sightings while the robot was in a place, or while another topic met a condition; their frame."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import AtTime
from ros2_memory.insights.sightings import find_matches
from ros2_memory.places.visits import visits
from ros2_memory.places.where import WhileCondition
from ros2_memory.queries import position
from tests.support.bags import (
    Msg,
    boolean,
    detections,
    octets,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.memories import asked, each_way, memory_of, with_store
from tests.support.moving_map import BEGIN, S, write_moving_map

CUPS = "/vision/scene/scene_objects"
PLACES = (
    Place("corner", "map", Circle(4.0, 3.0, 0.5)),
    Place("room", "map", Rectangle(-1, 5, -1, 4)),
)


def in_places(memory: Memory) -> Memory:
    return replace(memory, limits=replace(memory.limits, places=PLACES))


def docking(folder: Path, *, changes: bool) -> Memory:
    """Words each second for a minute; docked but from 20 s to 40 s."""
    messages: list[Msg] = [odom(BEGIN, 0.0, 0.0)]
    for second in range(60):
        at = BEGIN + second * S
        messages.append(text(at + S // 2, "hello"))
        docked = not 20 <= second < 40
        if not changes or second in {0, 20, 40}:
            messages.append(boolean(at, docked, topic="/is_docked"))
    write_splits(folder, messages)
    return memory_of(folder)


@pytest.mark.parametrize("changes", [False, True], ids=["each second", "on change"])
@pytest.mark.parametrize("recalls", [False, True], ids=["plain", "catalogue"])
def test_matches_count_while_another_topic_meets_a_condition(
    tmp_path: Path, changes: bool, recalls: bool
) -> None:
    memory = docking(tmp_path, changes=changes)
    memory = with_store(memory, tmp_path) if recalls else memory
    undocked = WhileCondition("/is_docked", "equals", False)
    [found] = find_matches(
        memory, Call(), "/chatter", "contains", "hello", during=(undocked,)
    ).sightings
    assert ((found.first - BEGIN) / S, (found.last - BEGIN) / S) == (20.5, 39.5)
    docked = WhileCondition("/is_docked", "equals", True)
    later, earlier = find_matches(
        memory, Call(), "/chatter", "contains", "hello", during=(docked,)
    ).sightings
    assert [(each.first - BEGIN) / S for each in (earlier, later)] == [0.5, 40.5]


@pytest.mark.parametrize("recalls", [False, True], ids=["plain", "catalogue"])
def test_matches_of_a_topic_with_two_types_count_whichever_came_last(
    tmp_path: Path, recalls: bool
) -> None:
    flags = [boolean(BEGIN + second * S, True, topic="/mixed") for second in range(3)]
    words = [text(BEGIN, "undocked", "/dock"), text(BEGIN + 5 * S, "cup", "/mixed")]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*flags, *words])
    memory = memory_of(tmp_path, recalls=recalls)
    undocked = WhileCondition("/dock", "contains", "undocked")
    [found] = find_matches(
        memory, Call(), "/mixed", "contains", "cup", during=(undocked,)
    ).sightings
    assert found.last == BEGIN + 5 * S


@each_way
@pytest.mark.parametrize(
    ("during", "said"),
    [
        ({"topic": "/odom", "condition_type": "above", "value": 1, "field": "nope"}, "no field"),
        (
            {"topic": "/octets", "condition_type": "equals", "value": 1, "field": "data"},
            "only summarised",
        ),
        ({"topic": "/dock", "condition_type": "equals", "value": "yes"}, "true or false"),
    ],
)
def test_what_no_message_of_another_topic_can_meet_is_refused(
    tmp_path: Path, during: dict[str, object], said: str, *, recalls: bool
) -> None:
    said_then = [
        odom(BEGIN, 0.0, 0.0),
        octets(BEGIN, [1] * 60),
        boolean(BEGIN, True, topic="/dock"),
    ]
    write_mcap(tmp_path / "rec_0.mcap", [*said_then, text(BEGIN + S, "cup")])
    memory = memory_of(tmp_path, recalls=recalls)
    cup = {"topic": "/chatter", "condition_type": "contains", "value": "cup", "while": during}
    for by in ({}, {"by": "hour"}):
        refused = asked(memory, tmp_path, "find_matches", **cup, **by)
        assert said in refused["detail"]


def test_a_condition_is_met_by_messages_of_the_type_that_a_topic_had_before(
    tmp_path: Path,
) -> None:
    before = [odom(BEGIN, 5.0, 0.0, topic="/was"), text(BEGIN + S, "cup")]
    write_mcap(tmp_path / "rec_0.mcap", [*before, text(BEGIN + 9 * S, "now", "/was")])
    during = {"topic": "/was", "condition_type": "above", "value": 1, "field": "position.x"}
    cup = {"topic": "/chatter", "condition_type": "contains", "value": "cup", "while": during}
    assert asked(memory_of(tmp_path), tmp_path, "find_matches", **cup)["total"] == 1


def test_matches_count_while_the_robot_is_in_a_place(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 2, seconds=300)
    memory = in_places(memory_of(tmp_path))
    there = visits(memory, Call(), where="corner", limit=100).visits
    found = find_matches(memory, Call(), CUPS, "contains", "cup", where="corner", limit=100)
    assert len(found.sightings) in {len(there), len(there) - 1}  # some are shorter than a second
    for each in found.sightings:
        assert each.robot is not None
        assert (each.robot.frame_id, each.robot.places) == ("map", ("corner", "room"))
        assert any(
            # A visit begins and ends at poses, between which the robot was inside a little longer.
            (visit.arrived or 0) - S // 2 <= each.first
            and each.last <= (visit.departed or 2**62) + S // 2
            for visit in there
        )
    assert all(after.last < before.first for before, after in pairwise(found.sightings))


def test_the_frame_of_the_robot_is_the_map_or_the_one_asked_for(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 1, seconds=20)
    memory = memory_of(tmp_path)

    def robot(**given: Any) -> str:
        [found] = find_matches(memory, Call(), CUPS, "contains", "cup", limit=1, **given).sightings
        assert found.robot is not None
        return found.robot.frame_id

    assert robot() == "map"
    assert robot(frame_id="odom") == "odom"
    with pytest.raises(InvalidArgumentsError, match="no transform leads there"):
        robot(frame_id="moon")


def test_a_position_is_in_its_own_frame_names_its_place_and_may_be_asked_in_another(
    tmp_path: Path,
) -> None:
    truth = write_moving_map(tmp_path, 1, seconds=60)
    memory = in_places(memory_of(tmp_path))
    at, place = truth.times[150], truth.places[150]
    own = position(memory, Call(), AtTime(at_s=at / S))
    assert (own.pose.frame_id, own.pose.places) == ("odom", ("room",))
    there = position(memory, Call(), AtTime(at_s=at / S), frame_id="map")
    assert there.pose.frame_id == "map"
    assert there.pose.position[:2] == pytest.approx(place, abs=0.05)
    reply = asked(memory, tmp_path, "get_position_at", timestamp=at / S, frame_id="map")
    assert reply["in"] == "room"
    with pytest.raises(InvalidArgumentsError, match="no transform leads there"):
        position(memory, Call(), AtTime(at_s=at / S), frame_id="moon")


@pytest.mark.parametrize("tool", ["find_matches", "find_last_match"])
def test_a_misspelt_field_inside_a_list_that_is_empty_now_is_refused(
    tmp_path: Path, tool: str
) -> None:
    seen = [detections(BEGIN + nth * S, ["cup"]) for nth in range(5)]
    empty = [detections(BEGIN + nth * S, []) for nth in range(5, 9)]
    write_mcap(tmp_path / "rec_0.mcap", [*seen, *empty])
    question: dict[str, Any] = {
        "topic": seen[0].topic,
        "condition_type": "contains",
        "value": "scissors",
    }
    refused = asked(memory_of(tmp_path), tmp_path, tool, field="detections.name", **question)
    assert refused["error"] == "invalid_arguments"
    assert "detections.label" in refused["detail"]
    known = asked(memory_of(tmp_path), tmp_path, tool, field="detections.label", **question)
    assert not (known or {}).get("error")

"""Search in a place, in any of several places, and while other topics meet conditions.

What is expected is counted from the drawn world itself, second by second.
"""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.history.context import Memory
from tests.support.bags import (
    boolean,
    octets,
    odom,
    text,
    write_mcap,
)
from tests.support.examples import examples
from tests.support.memories import asked, each_way, memory_of
from tests.support.moving_map import BEGIN as MAP_BEGIN
from tests.support.moving_map import S
from tests.support.rooms import BEGIN, ROOMS, World, asked_of, bounds, draw, write
from tests.support.tables import table

SECONDS = 400
HELLO = {"topic": "/chatter", "condition_type": "contains", "value": "hello"}
SPAN = {"start": BEGIN, "end": BEGIN + SECONDS}


@pytest.fixture(scope="module")
def world() -> World:
    return draw(3, SECONDS)


@pytest.fixture(scope="module")
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    bags = tmp_path_factory.mktemp("rooms")
    write(world, bags)
    return bags


@pytest.fixture(scope="module")
def memory(folder: Path) -> Memory:
    return asked_of(folder, stored=True)


@settings(max_examples=examples(8))
@example(seed=23, stored=False, rooms=["hall", "kitchen"])  # comes in with the newest pose
@given(
    seed=st.integers(0, 10_000),
    stored=st.booleans(),
    rooms=st.lists(st.sampled_from([*ROOMS]), min_size=2, max_size=3, unique=True),
)
def test_what_happened_in_any_of_several_places_is_what_happened_in_one_of_them(
    seed: int, stored: bool, rooms: list[str]
) -> None:
    world = draw(seed, 150)
    with TemporaryDirectory() as name:
        bags = Path(name)
        write(world, bags)
        memory = asked_of(bags, stored=stored)
        where = ", ".join(rooms)
        runs = world.runs_in(*rooms)
        seen = asked(memory, "find_matches", where=where, limit=100, **HELLO)
        assert [
            (row["first_seen"] - BEGIN, row["last_seen"] - BEGIN, row["count"])
            for row in reversed(seen["sightings"])
        ] == [(run.first, run.last, run.messages) for run in runs]
        visits = asked(memory, "visits", where=where, limit=100)
        assert [row["arrived"] - BEGIN for row in reversed(visits["visits"])] == [
            run.first for run in runs
        ]
        driven = asked(memory, "trajectory_summary", where=where, start=BEGIN, end=BEGIN + 150)
        assert driven["visits"] == len(runs)
        assert driven["distance_m"] == pytest.approx(world.metres_in(*rooms), abs=0.3)
        by_place = table(asked(memory, "visits", where=where, by="place"))
        assert [*by_place] == [*rooms, "(elsewhere)", "(unknown)", "all"]
        for room in rooms:
            own = world.runs_in(room)
            assert by_place[room]["entries"] == sum(run.first > 0 for run in own)
            # A wall is crossed half a second before the first message in the room, and after.
            ends = sum((run.first > 0) + (run.last < 149) for run in own)
            seconds = sum(run.last - run.first for run in own) + ends / 2
            assert by_place[room]["minutes"] == pytest.approx(seconds / 60, abs=0.02)


@pytest.mark.parametrize("tool", ["find_matches", "trajectory_summary", "visits"])
def test_one_table_has_a_row_for_each_place_and_what_was_elsewhere(
    memory: Memory, world: World, tool: str
) -> None:
    given: dict[str, Any] = {**(HELLO if tool == "find_matches" else {}), **SPAN}
    rows = table(asked(memory, tool, by="place", where=bounds("hall", "kitchen"), **given))
    assert [*rows] == ["hall", "kitchen", "(elsewhere)", "(unknown)", "all"]
    named = table(asked(memory, tool, by="place", where=["hall", "kitchen"], **given))
    assert rows == named
    if tool == "trajectory_summary":
        for room in ("hall", "kitchen"):
            assert rows[room]["metres"] == pytest.approx(world.metres_in(room), abs=0.3)
        inside = rows["hall"]["metres"] + rows["kitchen"]["metres"]
        assert inside + rows["(elsewhere)"]["metres"] == pytest.approx(rows["all"]["metres"])
    elif tool == "find_matches":
        for room in ("hall", "kitchen"):
            expected = sum(run.messages for run in world.runs_in(room))
            assert rows[room]["seconds"] == pytest.approx(expected, abs=len(world.runs_in(room)))
        assert rows["(elsewhere)"]["seconds"] > 0


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("hall, attic", 'no place is named "attic"; there are: den, hall, kitchen'),
        ([], "where was []; give the name of a place"),
        (",", 'no place is named ","'),
        (["hall", 5], "give the name of a place"),
        ({"hall": 5, "den": "den"}, 'where: "hall" was 5; give'),
        ({"hall": {"x": [5, 1], "y": [0, 1]}, "den": "den"}, 'where: "hall": x was [5, 1]'),
        ({"hall": {"z": 1}}, 'where: "hall" has no "z"; give'),
        ({"x": 1, "y": 2, "radius": 3}, 'where has no "radius"; give'),
        ({f"p{nth}": {"x": nth, "y": 0, "radius_m": 1} for nth in range(31)}, "more than 30"),
        ({"x": [1, 0], "y": [0, 1]}, "not a range"),
        ({"x": [1, 1], "y": [0, 1]}, "not a range"),  # a line, on which no pose ever is
        ({"x": [0, 1], "y": [0, 1], "radius_m": 1}, "radius_m and a range"),
        (5, "where was 5; give the name"),
    ],
)
def test_what_is_no_place_is_named_with_the_reason_and_what_to_do(
    memory: Memory, where: Any, said: str
) -> None:
    reply = asked(memory, "visits", where=where)
    assert reply["error"] == "invalid_arguments"
    assert said in reply["detail"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"where": "hall", "x": 1.0}, "give either"),
        ({"x": 1.0}, "both"),
        ({"where": "hall", "frame_id": "moon"}, None),
        ({"x": 1.0, "y": 1.0, "frame_id": "moon"}, 'frame_id was "moon"'),
        *(({"x": 0, "y": 0, "radius_m": each}, "radius_m") for each in (0.0, -1.0, math.inf)),
    ],
)
def test_a_place_is_named_once_and_in_a_frame_of_the_robot(
    memory: Memory, given: dict[str, Any], said: str | None
) -> None:
    reply = asked(memory, "visits", **given)
    assert (said is None) == ("error" not in reply)
    assert said is None or said in reply["detail"]


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
        odom(MAP_BEGIN),
        octets(MAP_BEGIN, [1] * 60),
        boolean(MAP_BEGIN, True, topic="/dock"),
    ]
    write_mcap(tmp_path / "rec_0.mcap", [*said_then, text(MAP_BEGIN + S, "cup")])
    memory = memory_of(tmp_path, recalls=recalls)
    cup = {"topic": "/chatter", "condition_type": "contains", "value": "cup", "while": during}
    for by in ({}, {"by": "hour"}):
        refused = asked(memory, "find_matches", **cup, **by)
        assert said in refused["detail"]

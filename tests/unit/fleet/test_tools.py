"""The tools of a fleet: a robot that is named, all of them, and those that a client may ask about.

The oracle is a server of each robot alone.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.errors import (
    InvalidArgumentsError,
)
from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.fleet.merging import ANSWER_FOR_ALL
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.fleet.tools import fleet_tools
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.tools.reply_size import to_json_text
from ros2_memory.tools.spec_tools import build_tools
from tests.support.clocks import FixedClock
from tests.support.fleets import (
    LENGTH_S,
    NOW,
    SEEN,
    START_S,
    fleet_memory,
    fleet_over,
    reply,
    reply_of,
    seeded,
    tools_of,
    write_robot,
)
from tests.support.memories import asked

if TYPE_CHECKING:
    from collections.abc import Callable


NAMES = ("r1", "r2", "r3")
LAST: dict[str, object] = {"topic": "/vision/*", "condition_type": "contains", "value": "mug"}
CALLS: dict[str, dict[str, object]] = {
    "list_recorded_topics": {},
    "data_time_range": {},
    "get_topic_at_time": {"topic": "/is_docked", "timestamp": START_S + 205, "tolerance_s": 200},
    "get_position_at": {"timestamp": START_S + 205, "tolerance_s": 200},
    "list_frames": {},
    "find_last_match": LAST,
    "find_matches": LAST,
    "find_things": {},
    "visits": {"where": {"x": 1, "y": 2, "radius_m": 2}},
    "recap": {"start": START_S, "end": START_S + 300},
    "compare": {
        "start": START_S + 30,
        "end": START_S + 300,
        "with_start": START_S,
        "with_end": START_S + 30,
    },
    "memory_status": {},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    for name in NAMES:
        write_robot(seeded(name), folder / name)
    return folder


def alone(folder: Path, robot: str, name: str, given: dict[str, object]) -> Any:
    """The JSON of the reply of a server of one robot alone."""
    return asked(fleet_memory(folder / robot), folder / robot, name, **given)


@pytest.mark.parametrize("name", CALLS)
def test_a_robot_that_is_named_answers_as_alone_with_its_name(folder: Path, name: str) -> None:
    found = reply(fleet_over(folder, NAMES), name, {**CALLS[name], "robot": "r2"})
    expected = alone(folder, "r2", name, CALLS[name])
    if isinstance(expected, list):
        assert found == [{"robot_name": "r2", **row} for row in expected]
    elif "error" in expected:
        assert found == expected
    else:
        assert found == {"robot_name": "r2", **expected}


def test_each_robots_now_stands_beside_its_ages_where_it_is_the_newest_message(
    folder: Path,
) -> None:
    limits = QuerySettings(now="latest")
    robots = [
        Robot(name, folder / name, partial(fleet_memory, folder / name, limits)) for name in NAMES
    ]
    fleet = Fleet(robots, FixedClock(NOW))
    nows = {name: float(seeded(name).end_s) for name in NAMES}
    assert len({*nows.values()}) > 1
    visited: dict[str, object] = {"where": {"x": 1, "y": 2, "radius_m": 2}}
    last: dict[str, object] = {"last_s": LENGTH_S}
    ago: dict[str, object] = {"seconds_ago": 5}
    for tool, given in (
        ("get_position_seconds_ago", ago),
        ("find_last_match", LAST),
        ("find_matches", LAST),
        ("find_things", {}),
        ("visits", visited),
        ("recap", last),
        ("memory_status", {}),
    ):
        for name, now in nows.items():
            found = reply(fleet, tool, {**given, "robot": name})
            assert found["now"] == now, (tool, found)
    for tool, given in (("find_matches", LAST), ("find_things", {})):
        rest = reply(fleet, tool, given)["by_robot"]
        assert {name: rest[name]["now"] for name in NAMES} == nows, tool
    for row in reply(fleet, "find_last_match", LAST)["matches"]:
        assert row["now"] - row["age_s"] == pytest.approx(row["timestamp"])
    short = tools_of(fleet, max_chars=300)
    for tool, given in (("recap", last), ("memory_status", {})):
        for value in (reply_of(short[tool], given), reply(fleet, tool, given)):
            assert {row["robot_name"]: row["now"] for row in value["robots"]} == nows, tool


@pytest.mark.parametrize("tool", ["find_matches", "find_things", "visits"])
def test_a_robot_that_recorded_nothing_then_is_named_and_the_others_answer(
    tmp_path: Path, tool: str
) -> None:
    for name, shift_s in (("early", 0), ("late", 300)):
        write_robot(replace(seeded(name), start_s=START_S + shift_s), tmp_path / name)
    fleet = fleet_over(tmp_path, ("early", "late"), shared_map=True)
    asked_of: dict[str, dict[str, object]] = {"find_matches": LAST, "visits": {"x": 1, "y": 2}}
    given = asked_of.get(tool, {})
    window = {"start": START_S, "end": START_S + LENGTH_S}
    found = reply(fleet, tool, {**given, **window})
    assert "error" not in found
    [note] = [each for each in found["notes"] if each.startswith("no answer of")]
    assert note.startswith("no answer of late: nothing was recorded between")
    nobody = reply(fleet, tool, {**given, "start": START_S + 200, "end": START_S + 250})
    assert (nobody["error"], nobody["reason"]) == ("no_data", "outside_range")


def test_never_of_a_robot_that_is_named_is_an_object(folder: Path) -> None:
    given = LAST | {"value": "elephant"}
    assert alone(folder, "r1", "find_last_match", given) is None
    found = reply(fleet_over(folder, NAMES), "find_last_match", {**given, "robot": "r1"})
    assert found == {"robot_name": "r1", "timestamp": None, "value": None}


def test_which_robot_last_saw_it_is_the_newest_of_the_answers_of_each(folder: Path) -> None:
    found = reply(fleet_over(folder, NAMES), "find_last_match", LAST)
    each = {name: alone(folder, name, "find_last_match", LAST) for name in NAMES}
    expected = [{"robot_name": name, **row} for name, row in each.items() if row is not None]
    expected.sort(key=lambda row: -row["timestamp"])
    assert found["matches"] == expected
    assert found.get("never", []) == [name for name, row in each.items() if row is None]
    truth = {name: [at for at, what in seeded(name).seen if what == "mug"] for name in NAMES}
    assert {row["robot_name"]: row["timestamp"] for row in found["matches"]} == {
        name: times[-1] for name, times in truth.items() if times
    }


@pytest.mark.parametrize(
    ("name", "rows", "newest", "limit"),
    [
        ("find_matches", "sightings", lambda row: row["last_seen"], 5),
        ("find_things", "things", lambda row: row["last_seen"], 12),
        ("visits", "visits", lambda row: row["departed"] or float("inf"), 10),
    ],
)
def test_rows_of_all_are_the_newest_of_the_rows_of_each(
    folder: Path, name: str, rows: str, newest: Callable[[Any], float], limit: int
) -> None:
    fleet = fleet_over(folder, NAMES, shared_map=True)
    found = reply(fleet, name, CALLS[name])
    each = {robot: alone(folder, robot, name, CALLS[name]) for robot in NAMES}
    times = sorted((newest(row) for one in each.values() for row in one[rows]), reverse=True)
    assert [newest(row) for row in found[rows]] == times[:limit]
    assert found["total"] == sum(one["total"] for one in each.values())
    for row in found[rows]:
        own = {key: value for key, value in row.items() if key not in {"robot_name", "frame_id"}}
        assert own in each[row["robot_name"]][rows]


@pytest.mark.parametrize("oldest_first", [False, True])
@pytest.mark.parametrize("limit", [1, 2, 3])
def test_rows_that_have_no_place_are_left_out_but_count(
    folder: Path, limit: int, oldest_first: bool
) -> None:
    undocked = {"topic": "/is_docked", "condition_type": "equals", "value": False}
    given = {**undocked, "oldest_first": oldest_first}
    found = reply(fleet_over(folder, NAMES), "find_matches", {**given, "limit": limit})
    each = {robot: alone(folder, robot, "find_matches", {**given, "limit": 9}) for robot in NAMES}
    every = [{"robot_name": name, **row} for name in NAMES for row in each[name]["sightings"]]
    every.sort(key=lambda row: row["last_seen"], reverse=not oldest_first)
    assert len(every) == 6
    assert found["sightings"] == every[:limit]
    assert found["more"]
    if oldest_first:
        assert found["total"] == sum(one["total"] for one in each.values())
    assert "notes" not in found


@pytest.mark.parametrize("name", ["compare", "recap", "memory_status", "data_time_range"])
def test_what_is_about_a_robot_is_a_row_of_its_whole_reply(folder: Path, name: str) -> None:
    found = reply(fleet_over(folder, NAMES), name, CALLS[name])
    order = sorted(NAMES, key=lambda robot: (-seeded(robot).end_s, robot))
    assert found["robots"] == [
        {"robot_name": robot, **alone(folder, robot, name, CALLS[name])} for robot in order
    ]


BY: dict[str, object] = {**LAST, "topic": SEEN}


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("trajectory_summary", {"start": START_S, "end": START_S + 600, "by": "day"}),
        ("find_matches", {**BY, "by": "hour"}),
        ("find_matches", {**BY, "value": "", "by": "label"}),
    ],
)
def test_a_table_of_all_has_the_rows_of_each_with_the_robot(
    folder: Path, tool: str, given: dict[str, object]
) -> None:
    found = reply(fleet_over(folder, NAMES), tool, given)
    rows = [dict(zip(found["columns"], row, strict=True)) for row in found["rows"]]
    expected = []
    for name in NAMES:
        own = alone(folder, name, tool, given)
        expected += [
            {"robot_name": name, **dict(zip(own["columns"], row, strict=True))}
            for row in own["rows"]
        ]
        if "all" in own:
            assert found["all"][name] == own["all"]
    assert sorted(rows, key=str) == sorted(expected, key=str)


def test_who_may_ask_about_none_is_told_so(folder: Path) -> None:
    found = reply(fleet_over(folder, NAMES), "memory_status", {}, Call(robots=frozenset()))
    assert found["error"] == "refused"


class TestWhichRobot:
    def test_a_tool_for_one_names_them_and_says_what_to_pass(self, folder: Path) -> None:
        found = reply(fleet_over(folder, NAMES), "get_position_at", {"timestamp": START_S})
        assert found["error"] == "invalid_arguments"
        assert "pass robot, e.g. robot=r1" in found["detail"]
        assert "r1, r2, r3" in found["detail"]

    def test_the_only_one_need_not_be_named(self, folder: Path) -> None:
        found = reply(fleet_over(folder, ("r3",)), "list_frames", {})
        assert found["robot_name"] == "r3"

    def test_several_that_are_named_answer_as_all_do(self, folder: Path) -> None:
        fleet = fleet_over(folder, NAMES)
        some: dict[str, object] = {"robot": "r3, r1"}
        found = reply(fleet, "find_matches", {**LAST, **some})
        assert found == reply(fleet_over(folder, ("r1", "r3")), "find_matches", LAST)
        rows = reply(fleet, "memory_status", some)["robots"]
        assert {row["robot_name"] for row in rows} == {"r1", "r3"}
        for robot, said in (("r1, r9", "no robot"), ("r1, r2", "which robot?")):
            assert said in reply(fleet, "list_frames", {"robot": robot})["detail"]

    @pytest.mark.parametrize("robot", ["../r1", "r4", "", "/", 7, ["r1"], {"r1": 1}])
    def test_a_name_that_is_none_is_refused_whatever_it_is(
        self, folder: Path, robot: object
    ) -> None:
        found = reply(fleet_over(folder, NAMES), "memory_status", {"robot": robot})
        assert found["error"] == "invalid_arguments"
        assert "there is no robot" in found["detail"]

    def test_wrong_arguments_are_refused_before_a_robot_is_asked(self, folder: Path) -> None:
        tool = tools_of(fleet_over(folder, NAMES))["find_last_match"]
        with pytest.raises(InvalidArgumentsError, match="condition_type"):
            tool.question(LAST | {"condition_type": "like"})


class TestMaps:
    @pytest.mark.parametrize(
        ("name", "given"),
        [
            ("find_things", {"where": {"x": 1, "y": 2, "radius_m": 5}}),
            ("find_things", {"where": '{"x": 1, "y": 2, "radius_m": 5}'}),
            ("visits", {"x": 1, "y": 2}),
            (
                "find_last_match",
                {
                    "topic": "/odom",
                    "condition_type": "near_position",
                    "value": {"x": 1, "y": 0},
                },
            ),
        ],
    )
    def test_coordinates_are_asked_of_one_robot_unless_all_share_a_map(
        self, folder: Path, name: str, given: dict[str, object]
    ) -> None:
        refused = reply(fleet_over(folder, NAMES), name, given)
        assert refused["error"] == "invalid_arguments"
        assert "pass robot" in refused["detail"]
        assert "error" not in reply(fleet_over(folder, NAMES), name, {**given, "robot": "r1"})
        assert "error" not in reply(fleet_over(folder, NAMES, shared_map=True), name, given)

    def test_things_near_a_point_are_asked_of_one_robot_and_near_a_thing_of_all(
        self, folder: Path
    ) -> None:
        fleet = fleet_over(folder, NAMES)
        point = reply(fleet, "find_things", {"near": {"x": 1, "y": 2, "radius_m": 1}})
        assert "near has coordinates" in point["detail"]
        assert "error" not in reply(fleet, "find_things", {"near": {"label": "table"}})

    def test_the_same_hours_of_each_day_are_asked_of_one_robot(self, folder: Path) -> None:
        fleet = fleet_over(folder, NAMES)
        asked = {"x": 1, "y": 0, "between": "00:00-23:59"}
        assert "robot" in reply(fleet, "visits", asked)["detail"]
        assert reply(fleet, "visits", {**asked, "robot": "r1"})["windows"]

    def test_a_place_is_that_of_each_robots_own_map(self, folder: Path) -> None:
        centre = {"r1": 1.0, "r2": 500.0}

        def robot(name: str) -> Robot:
            limits = QuerySettings(
                places=(Place("kitchen", "map", Circle(centre[name], 2.0, 9.0)),)
                if name in centre
                else ()
            )
            return Robot(name, folder / name, lambda: fleet_memory(folder / name, limits))

        fleet = Fleet(map(robot, NAMES), FixedClock(NOW))
        found = reply(fleet, "visits", {"where": "kitchen"})
        assert {row["robot_name"] for row in found["visits"]} == {"r1"}
        assert found["by_robot"]["r2"]["total"] == 0
        assert any(note.startswith("no answer of r3: ") for note in found["notes"])

    def test_several_named_places_are_those_of_each_robot_with_a_row_for_each(
        self, folder: Path
    ) -> None:
        def robot(name: str) -> Robot:
            places = (
                Place("kitchen", "map", Rectangle(-9.0, 1.0, -9.0, 99.0)),
                Place("hall", "map", Rectangle(1.0, 9.0, -9.0, 99.0)),
            )
            limits = QuerySettings(places=places)
            return Robot(name, folder / name, lambda: fleet_memory(folder / name, limits))

        fleet = Fleet(map(robot, NAMES), FixedClock(NOW))
        given: dict[str, object] = {"where": "hall, kitchen", "by": "place"}
        found = reply(fleet, "visits", given)
        rows = {(row[0], row[1]) for row in found["rows"]}
        kinds = ("hall", "kitchen", "(elsewhere)", "(unknown)")
        assert rows == {(name, kind) for name in NAMES for kind in kinds}
        names = found["columns"]
        for robot_name in NAMES:
            alone = reply(fleet, "visits", {**given, "robot": robot_name})
            own = [row for row in found["rows"] if row[0] == robot_name]
            minutes = {row[1]: row[names.index("minutes")] for row in own}
            at = alone["columns"].index("minutes")
            assert minutes == {row[0]: row[at] for row in alone["rows"]}
            # It swings about x = 1 from one place to the other, once in 63 s.
            assert minutes["hall"] + minutes["kitchen"] == pytest.approx(59 / 60, abs=0.02)


class TestTrouble:
    def test_a_missing_directory_is_named_and_never_claimed_about(
        self, folder: Path, tmp_path: Path
    ) -> None:
        robots = [
            Robot("r1", folder / "r1", lambda: fleet_memory(folder / "r1")),
            Robot("away", tmp_path / "away", lambda: fleet_memory(tmp_path / "away")),
        ]
        found = reply(Fleet(robots, FixedClock(NOW)), "find_last_match", LAST | {"value": "x"})
        assert found["never"] == ["r1"]
        missing = "the bag directory does not exist (yet): check .../away, from fleet.robots"
        assert found["notes"] == [f"no answer of away: {missing}"]
        assert found["robots_failed"] == {"away": "refused"}
        assert str(tmp_path) not in json.dumps(found)
        status = reply(Fleet(robots, FixedClock(NOW)), "memory_status", {"robot": "away"})
        assert "from fleet.robots" in status["doubts"]

    def test_where_nobody_has_data_the_reason_is_that_of_all(self, folder: Path) -> None:
        found = reply(fleet_over(folder, NAMES), "find_matches", LAST | {"topic": "/none"})
        assert (found["error"], found["reason"]) == ("no_data", "topic_not_recorded")

    def test_what_no_robot_takes_is_one_error(self, folder: Path) -> None:
        found = reply(fleet_over(folder, NAMES), "find_things", {"where": "garden"})
        assert found["error"] == "invalid_arguments"


class TestListing:
    def test_every_tool_has_the_argument_and_those_that_write_are_gone(self) -> None:
        tools = build_tools(QuerySettings(), writing=True)
        named = {each.name: each for each in fleet_tools(tools, fleet_over(Path(), ()), 1000)}
        assert named.keys() == {each.name for each in tools if not each.writes}
        assert named.keys() >= ANSWER_FOR_ALL
        for tool in named.values():
            properties = tool.schema["properties"]
            assert isinstance(properties, dict)
            assert properties["robot"]
        listing: list[Any] = [
            {"name": each.name, "description": each.description, "inputSchema": each.schema}
            for each in named.values()
        ]
        assert len(to_json_text(listing)) <= 20_500

    def test_the_listing_of_a_single_robot_does_not_grow(self) -> None:
        tools = build_tools(QuerySettings(), writing=True)
        before = [replace(each) for each in tools]
        shown = [(each.description, to_json_text(each.schema)) for each in before]
        fleet_tools(tools, fleet_over(Path(), ()), 1000)
        assert [(each.description, to_json_text(each.schema)) for each in tools] == shown
        for _, schema in shown:
            assert '"robot"' not in schema

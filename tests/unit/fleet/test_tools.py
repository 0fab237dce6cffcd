"""The tools of a fleet: a robot that is named, all of them, and those that a client may ask about.

The oracle is a server of each robot alone.
"""

from collections import Counter
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.regions import Circle, Place
from ros2_memory.core.timebase import NS_PER_S as S
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.fleet.tools import ANSWER_FOR_ALL, fleet_tools
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.reply_size import to_json_text
from tests.support.bags import text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.fleets import (
    CALLS,
    LENGTH_S,
    MUG,
    NOW,
    SEEN,
    START_S,
    TOOLS,
    fleet_memory,
    fleet_over,
    reply,
    reply_of,
    seeded,
    tools_of,
    write_robot,
)
from tests.support.memories import asked, clause

NAMES = ("r1", "r2", "r3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    for name in NAMES:
        write_robot(seeded(name), folder / name)
    return folder


@pytest.fixture(scope="module")
def fleet(folder: Path) -> Fleet:
    return fleet_over(folder, NAMES)


def alone(folder: Path, name: str, given: dict[str, object]) -> dict[str, Any]:
    """The replies of servers of one robot alone, by its name."""
    memories = {robot: fleet_memory(folder / robot) for robot in NAMES}
    return {robot: asked(memory, name, **given) for robot, memory in memories.items()}


@pytest.mark.parametrize("name", TOOLS)
def test_a_robot_that_is_named_answers_as_alone_with_its_name(
    folder: Path, fleet: Fleet, name: str
) -> None:
    given, of_robot = CALLS.get(name, {}), {"robot_name": "r2"}
    found = reply(fleet, name, {**given, "robot": "r2"})
    expected = alone(folder, name, given)["r2"]
    if isinstance(expected, list):
        assert found == [of_robot | row for row in expected]
    else:
        assert found == (expected if "error" in expected else of_robot | expected)


def test_each_robots_now_stands_beside_its_ages_where_it_is_the_newest_message(
    folder: Path,
) -> None:
    fleet = fleet_over(folder, NAMES, limits=QuerySettings(now="latest"))
    nows = {name: float(seeded(name).end_s) for name in NAMES}
    assert len({*nows.values()}) > 1
    asks: dict[str, dict[str, object]] = {**CALLS, "recap": {"last_s": LENGTH_S}}
    for tool in (
        "get_position_seconds_ago",
        "find_last_match",
        "find_matches",
        "find_things",
        "visits",
        "recap",
        "memory_status",
    ):
        for name, now in nows.items():
            found = reply(fleet, tool, {**asks.get(tool, {}), "robot": name})
            assert found["now"] == now, (tool, found)
    for tool in ("find_matches", "find_things"):
        rest = reply(fleet, tool, CALLS.get(tool, {}))["by_robot"]
        assert {name: rest[name]["now"] for name in NAMES} == nows, tool
    for row in reply(fleet, "find_last_match", MUG)["matches"]:
        assert row["now"] - row["age_s"] == pytest.approx(row["timestamp"])
        assert row == reply(fleet, "find_last_match", {**MUG, "robot": row["robot_name"]})
    short = tools_of(fleet, max_chars=300)
    for tool in ("recap", "memory_status"):
        for tools in (short, tools_of(fleet)):
            rows = reply_of(tools[tool], asks.get(tool, {}))["robots"]
            assert {row["robot_name"]: row["now"] for row in rows} == nows, tool


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
    given = CALLS.get(name, {})
    found = reply(fleet_over(folder, NAMES, shared_map=True), name, given)
    own = alone(folder, name, given)
    times = sorted((newest(row) for one in own.values() for row in one[rows]), reverse=True)
    assert [newest(row) for row in found[rows]] == times[:limit]
    assert found.get("more", False) is (len(times) > limit)
    for key in {"total", "minutes"} & found.keys():
        assert found[key] == pytest.approx(sum(one[key] for one in own.values()))
    labels = sum((Counter(one.get("labels", {})) for one in own.values()), Counter[str]())
    assert found.get("labels", {}) == labels
    for robot, one in own.items():
        said = found | found["by_robot"].get(robot, {})
        for key in ("frame_id", "there_now", "total", "searched_from", "searched_to"):
            assert said.get(key) == one.get(key), (robot, key)
    for row in found[rows]:
        one = own[row.pop("robot_name")]
        assert row in one[rows]


@pytest.mark.parametrize(("limit", "first"), [(1, True), (2, False), (3, True), (10, False)])
def test_episodes_of_one_robot_and_sightings_of_another_are_on_one_page(
    tmp_path: Path, limit: int, first: bool
) -> None:
    """One robot ends its tasks with an empty text, the other says what is no state."""
    for robot, late, tasks in (
        ("r1", 0, ("tidy", "", "cook", "", "tidy", "")),
        ("r2", 5, ("tidy", "cook it") * 3),
    ):
        at = [(START_S + 20 * nth + late) * S for nth in range(6)]
        said = [text(*each, "/task") for each in zip(at, tasks, strict=True)]
        write_mcap(tmp_path / robot / "rec" / "rec_0.mcap", said)
    wanted = clause("/task", "equals", "tidy")
    fleet = fleet_over(tmp_path, ("r1", "r2"))
    found = reply(fleet, "find_matches", {**wanted, "limit": limit, "oldest_first": first})
    rows = [(row["end"], row["robot_name"]) for row in found["episodes"]]
    rows += [(row["last_seen"], row["robot_name"]) for row in found["sightings"]]
    ends = [(20, "r1"), (100, "r1"), (5, "r2"), (45, "r2"), (85, "r2")]
    every = sorted(((START_S + end, robot) for end, robot in ends), reverse=not first)
    assert sorted(rows, reverse=not first) == every[:limit]
    assert found.get("more", False) == (limit < len(ends))
    assert "episodes" not in str(found["by_robot"])


def test_a_topic_has_one_row_with_the_robots_that_record_it(folder: Path, fleet: Fleet) -> None:
    found = reply(fleet, "list_recorded_topics", {})["topics"]
    own = [*chain.from_iterable(alone(folder, "list_recorded_topics", {}).values())]
    assert {row["topic"] for row in found} == {row["topic"] for row in own}
    newest = [row["last_ts"] for row in found]
    assert newest == sorted(newest, reverse=True)
    for row in found:
        assert {*row.pop("robot_names")} == {*NAMES}
        theirs = [one for one in own if one["topic"] == row["topic"]]
        assert row == {
            **theirs[0],
            "first_ts": min(one["first_ts"] for one in theirs),
            "last_ts": max(one["last_ts"] for one in theirs),
            "count": sum(one["count"] for one in theirs),
        }


@pytest.mark.parametrize(("limit", "oldest_first"), [(1, False), (3, True)])
def test_rows_that_have_no_place_are_left_out_but_count(
    folder: Path, fleet: Fleet, limit: int, oldest_first: bool
) -> None:
    undocked = clause("/is_docked", "equals", False)
    given = {**undocked, "oldest_first": oldest_first}
    found = reply(fleet, "find_matches", {**given, "limit": limit})
    each = alone(folder, "find_matches", {**given, "limit": 9})
    every = [{"robot_name": name, **row} for name in NAMES for row in each[name]["sightings"]]
    every.sort(key=lambda row: row["last_seen"], reverse=not oldest_first)
    assert len(every) == 6
    assert found["sightings"] == every[:limit]
    assert found["more"]
    if oldest_first:
        assert found["total"] == sum(one["total"] for one in each.values())
    assert "notes" not in found


@pytest.mark.parametrize("name", ["compare", "recap", "memory_status", "data_time_range"])
def test_what_is_about_a_robot_is_a_row_of_its_whole_reply(
    folder: Path, fleet: Fleet, name: str
) -> None:
    given = CALLS.get(name, {})
    found, own = reply(fleet, name, given), alone(folder, name, given)
    order = sorted(NAMES, key=lambda robot: (-seeded(robot).end_s, robot))
    assert found["robots"] == [{"robot_name": robot, **own[robot]} for robot in order]


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("trajectory_summary", {"start": START_S, "end": START_S + 600, "by": "day"}),
        ("find_matches", MUG | {"topic": SEEN, "by": "hour"}),
        ("find_matches", MUG | {"topic": SEEN, "value": "", "by": "label"}),
    ],
)
def test_a_table_of_all_has_the_rows_of_each_with_the_robot(
    folder: Path, fleet: Fleet, tool: str, given: dict[str, object]
) -> None:
    found, expected = reply(fleet, tool, given), list[list[Any]]()
    for name, own in alone(folder, tool, given).items():
        assert found["columns"] == ["robot_name", *own["columns"]]
        expected += ([name, *row] for row in own["rows"])
        assert "all" not in own or found["all"][name] == own["all"]
    assert sorted(found["rows"], key=str) == sorted(expected, key=str)


def test_one_robot_of_those_that_may_be_asked_is_named_where_a_tool_is_about_one(
    folder: Path, fleet: Fleet
) -> None:
    found = reply(fleet, "get_position_at", {"timestamp": START_S})
    assert found["error"] == "invalid_arguments"
    assert "pass robot, e.g. robot=r1" in found["detail"]
    assert "r1, r2, r3" in found["detail"]
    never: Any = MUG | {"value": "elephant", "robot": "r1"}
    found = reply(fleet, "find_last_match", never)
    assert found == {"robot_name": "r1", "timestamp": None, "value": None}
    # The only one need not be named.
    assert reply(fleet_over(folder, ("r3",)), "list_frames", {})["robot_name"] == "r3"
    nobody = reply(fleet, "memory_status", {}, Call(robots=frozenset()))
    assert nobody["error"] == "refused"
    with pytest.raises(InvalidArgumentsError, match="condition_type"):
        tools_of(fleet)["find_last_match"].question(MUG | {"condition_type": "like"})


def test_several_that_are_named_answer_as_all_do(folder: Path, fleet: Fleet) -> None:
    found = reply(fleet, "find_matches", MUG | {"robot": "r3, r1"})
    assert found == reply(fleet_over(folder, ("r1", "r3")), "find_matches", MUG)
    rows = reply(fleet, "memory_status", {"robot": "r3, r1"})["robots"]
    assert {row["robot_name"] for row in rows} == {"r1", "r3"}
    for robot, said in (("r1, r9", "no robot"), ("r1, r2", "which robot?")):
        assert said in reply(fleet, "list_frames", {"robot": robot})["detail"]
    assert reply(fleet, "list_frames", {"robot": "r1,r1 "})["robot_name"] == "r1"


NEAR = clause("/odom", "near_position", {"x": 1, "y": 0})


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("find_things", {"where": {"x": 1, "y": 2, "radius_m": 5}}),
        ("find_things", {"where": '{"x": 1, "y": 2, "radius_m": 5}'}),
        ("find_things", {"where": {"den": {"x": 1, "y": 2, "radius_m": 5}}}),
        ("find_things", {"near": {"x": 1, "y": 2, "radius_m": 1}}),
        ("find_things", {"near": {"label shelf": {"x": 1, "y": 2, "radius_m": 1}}}),
        ("visits", {"x": 1, "y": 2}),
        ("find_last_match", NEAR),
        ("find_matches", {**MUG, "while": NEAR}),
    ],
)
def test_coordinates_are_asked_of_one_robot_unless_all_share_a_map(
    folder: Path, fleet: Fleet, name: str, given: dict[str, object]
) -> None:
    refused = reply(fleet, name, given)
    assert refused["error"] == "invalid_arguments"
    assert "has coordinates" in refused["detail"]
    assert "pass robot" in refused["detail"]
    for asked_of in (fleet, fleet_over(folder, NAMES, shared_map=True)):
        one = {} if asked_of.shared_map else {"robot": "r1"}
        assert "error" not in reply(asked_of, name, {**given, **one})
    assert "error" not in reply(fleet, "find_things", {"near": {"label": "table"}})


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("find_things", {"where": {"dock": "dock"}}),
        ("find_things", {"where": '{"dock": "dock", "bench": "dock"}'}),
        ("find_things", {"near": '{"label": "table", "radius_m": 1}'}),
        *(
            ("find_matches", {**MUG, "while": {"condition_type": "contains", **condition}})
            for condition in (
                {"topic": "/near_position_reached", "value": True},
                {"topic": "/is_docked", "value": "near_position"},
            )
        ),
    ],
)
def test_names_and_texts_without_coordinates_are_asked_of_all(
    folder: Path, name: str, given: dict[str, object]
) -> None:
    limits = QuerySettings(places=(Place("dock", "map", Circle(1.0, 2.0, 2.0)),))
    found = reply(fleet_over(folder, NAMES, limits=limits), name, given)
    assert "has coordinates" not in found.get("detail", "")
    assert found.get("reason", "topic_not_recorded") == "topic_not_recorded"


def test_a_place_is_that_of_each_robots_own_map(folder: Path) -> None:
    def robot(name: str, x: float | None) -> Robot:
        places = () if x is None else (Place("kitchen", "map", Circle(x, 2.0, 9.0)),)
        limits = QuerySettings(places=places)
        return Robot(name, fleet_memory(folder / name, limits))

    robots = map(robot, NAMES, (1.0, 500.0, None))
    found = reply(Fleet(robots, FixedClock(NOW)), "visits", {"where": "kitchen"})
    assert {row["robot_name"] for row in found["visits"]} == {"r1"}
    assert found["by_robot"]["r2"]["total"] == 0
    assert any(note.startswith("no answer of r3: ") for note in found["notes"])


def test_every_named_place_of_every_robot_is_listed(folder: Path) -> None:
    places = tuple(Place(f"place {n}", "map", Circle(n, 2.0, 1.0)) for n in range(6))
    found = reply(fleet_over(folder, NAMES, limits=QuerySettings(places=places)), "visits", {})
    assert len(found["places"]) == len(places) * len(NAMES)
    assert "more" not in found


def test_where_nobody_has_an_answer_the_reason_is_that_of_all(fleet: Fleet) -> None:
    found = reply(fleet, "find_matches", MUG | {"topic": "/none"})
    assert found["reason"] == "topic_not_recorded"
    found = reply(fleet, "find_things", {"where": "garden"})
    assert found["error"] == "invalid_arguments"


def test_every_tool_has_the_argument_and_those_that_write_are_gone() -> None:
    tools = build_tools(QuerySettings(), writing=True)
    named = {tool.name: tool for tool in fleet_tools(tools, fleet_over(Path(), ()), 1000)}
    assert named.keys() == {tool.name for tool in tools if not tool.writes}
    assert named.keys() >= ANSWER_FOR_ALL
    assert all(tool.arguments["robot"] for tool in named.values())
    listing: list[Any] = [
        {"name": tool.name, "description": tool.description, "inputSchema": tool.schema}
        for tool in named.values()
    ]
    assert len(to_json_text(listing)) <= 20_500
    # Those of a single robot stay as they are.
    assert not any("robot" in tool.arguments for tool in tools)

"""A lake answers as the bags do about robots that have little in common; and so does SQL.

So do a lake and a robot that have some of the bags each.
"""

import re
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import pytest
from pyiceberg.expressions import AlwaysTrue

from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.memo import Memo
from ros2_memory.core.timebase import iso_local
from ros2_memory.fleet.joined import JoinedIndex
from ros2_memory.fleet.robots import Fleet
from ros2_memory.history.context import Memory, QuerySettings
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.memory import LakeReader
from ros2_memory.lake.shipper import Shipped
from ros2_memory.tools.build import build_tools
from tests.support.clocks import FixedClock
from tests.support.fleets import reply, tools_of
from tests.support.lakes import (
    fleet_of,
    lake_in,
    lake_robots,
    location,
    robot_bags,
    ship,
    store_columns,
)
from tests.support.memories import ROOT, clause, memory_of, with_store
from tests.support.moving_map import BEGIN, S
from tests.support.unlike_robots import DAMAGED, LENGTH_S, ROBOTS, SEEN, YEAR_NS

Question = tuple[str, dict[str, object]]
NOW = BEGIN + 600 * S
MESSAGES = ("/battery_state", "/speech")


OF_DIRECTORIES = {"memory_status"}
"""Tools that are about a bag directory, and its recorder."""


class World(NamedTuple):
    """The robots over their bags, and over a lake; what was shipped, and the folder of the lake.

    `answers` has what was asked of the robots over their bags, by the question.
    """

    mounted: Fleet
    lake: Fleet
    shipped: Shipped
    folder: Path
    answers: dict[str, Any]

    def expected(self, question: Question) -> Any:
        """The answer of the robots over their bags, which is computed once."""
        key = repr(question)
        if key not in self.answers:
            self.answers[key] = reply(self.mounted, *question)
        return self.answers[key]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    folder, lake = tmp_path_factory.mktemp("robots"), tmp_path_factory.mktemp("lake")
    of_robots = [
        robot_bags(name, write(folder / name), messages=MESSAGES) for name, write in ROBOTS.items()
    ]
    shipped = ship(lake, of_robots, most_bags=100)
    for number in DAMAGED:
        (folder / "damaged" / "rec" / f"rec_{number}.mcap").unlink()
    memories = {
        name: with_store(memory_of(folder / name, clock=FixedClock(NOW)), folder / name)
        for name in ROBOTS
    }
    with location(lake).opened() as catalog:
        of_lake = lake_robots(
            Lake(catalog, memory_mb=256),
            [*ROBOTS],
            stores=tmp_path_factory.mktemp("cache"),
            now=NOW,
        )
        for name in ("damaged", "twin"):
            store_columns(of_lake[name])
        mounted, shipped_ones = (
            fleet_of(some, shared_map=True, now=NOW) for some in (memories, of_lake)
        )
        yield World(mounted, shipped_ones, shipped, lake, {})


def test_bags_that_are_damaged_or_left_open_are_counted_named_and_not_shipped(world: World) -> None:
    shipped = world.shipped
    assert (shipped.bags, shipped.waiting, len(shipped.problems)) == (23, 1, len(DAMAGED))
    for number in DAMAGED:
        [problem] = [each for each in shipped.problems if f"rec_{number}.mcap" in each]
        assert problem.startswith("damaged: ")


def _begin_s(name: str) -> float:
    return (BEGIN - (YEAR_NS if name == "behind" else 0)) / S


def about(world: World, name: str) -> list[Question]:
    rows = reply(world.mounted, "list_recorded_topics", {"robot": name})
    topics, begin_s = sorted({row["topic"] for row in rows}), _begin_s(name)
    some = every_question(topics, begin_s, begin_s + LENGTH_S, SEEN[name], "/vision/*/*")
    return [(tool, {**given, "robot": name}) for tool, given in some]


def test_every_question_is_answered_by_a_lake_as_by_the_bags_or_refused(world: World) -> None:
    """Eight at once; those about one robot with a store, and one without, twice in one process."""
    asked = [question for name in ROBOTS for question in about(world, name)]
    for tool, given in about(world, "twin"):
        asked.append((tool, {key: value for key, value in given.items() if key != "robot"}))
    own = [world.expected(question) for question in asked]
    answered = {tool for (tool, _), row in zip(asked, own, strict=True) if "error" not in row}
    assert answered == tools_of(world.mounted).keys() - OF_DIRECTORIES
    again = [question for question in asked if question[1].get("robot") in {"lost", "twin"}]
    for questions in (asked, again):
        with ThreadPoolExecutor(8) as threads:
            found = threads.map(lambda question: reply(world.lake, *question), questions)
        refused = set()
        for question, answer in zip(questions, found, strict=True):
            if "error" in answer and answer["error"] == "not_in_lake":
                refused.add((question[1].get("robot"), question[1]["topic"]))
            else:
                assert answer == world.expected(question), question
        assert refused == {("twin", "/left/image"), ("twin", "/right/image")}


@pytest.fixture(scope="module")
def joined(world: World, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """The robots over a lake that has some of their bags, and over the others.

    Of two of them the lake has the older ones, of the others every second one.
    """
    half, names = tmp_path_factory.mktemp("half"), ("behind", "diver", "lost", "twin")
    for name in names:
        bag_dir = world.mounted.robots[name].memory.index.bag_dir
        bags = sorted(bag_dir.rglob("*.mcap"))
        shipped = bags[:3] if name in {"behind", "twin"} else bags[::2]
        for bag in bags:
            share = half / ("lake" if bag in shipped else "own")
            copy = share / name / bag.relative_to(bag_dir)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(bag, copy)
    ship(half / "rows", [robot_bags(name, half / "lake" / name) for name in names], most_bags=100)
    with location(half / "rows").opened() as catalog:
        lake = Lake(catalog, memory_mb=256)
        of_lake = lake_robots(lake, names, now=NOW, bag_dirs=half / "own")
        own = {name: memory_of(half / "own" / name, clock=FixedClock(NOW)) for name in names}
        both = {name: joined_memory(of_lake[name], own[name]) for name in names}
        yield fleet_of(both, shared_map=True, now=NOW)


def joined_memory(of_lake: Memory, own: Memory) -> Memory:
    index = JoinedIndex(of_lake.index, own.index, own.index.bag_dir)
    assert isinstance(of_lake.reader, LakeReader)
    reader = replace(of_lake.reader, own=own.reader)
    scanner = Scanner(None, index.bag_dir)
    return replace(own, index=index, reader=reader, scanner=scanner, memo=Memo())


def test_every_question_is_answered_by_two_shares_as_by_the_whole_or_refused(
    world: World, joined: Fleet
) -> None:
    answered = 0
    for name in joined.robots:
        for question in about(world, name):
            found = reply(joined, *question)
            if "error" in found and found["error"] == "not_in_lake":
                assert str(question[1]["topic"]).endswith("/image")
            else:
                assert found == world.expected(question), question
                answered += 1
    assert answered > 50 * len(joined.robots)


def test_answers_say_up_to_when_each_robot_was_shipped(world: World) -> None:
    asked = clause("/vision/*/*", "contains", "x")
    robots = [replace(robot, in_lake=True) for robot in world.lake.robots.values()]
    *_, note = reply(Fleet(robots, world.lake.clock), "find_last_match", asked)["notes"]
    latest = {
        name: robot.memory.index.snapshot().latest for name, robot in world.lake.robots.items()
    }
    times = [f"{name} up to {iso_local(latest[name] or 0)}" for name in sorted(latest, key=str)]
    assert note.startswith("from the lake, which has what was shipped: behind up to ")
    assert sorted(note.partition(": ")[2].split(", ")) == times
    # What a robot does now is not asked of a lake.
    status = reply(world.mounted, "memory_status", {})
    mounted = world.mounted.robots
    robots = [replace(robot, own=mounted[robot.name].memory) for robot in robots]
    assert reply(Fleet(robots, world.lake.clock, shared_map=True), "memory_status", {}) == status


def answers_of_the_page(folder: Path) -> list[list[tuple[Any, ...]]]:
    """What the statements of the page about the lake find in the lake of a folder."""
    page = (ROOT / "docs" / "how-to" / "lake.md").read_text()
    lake = Lake(lake_in(folder))
    found = map(lake.query, re.findall(r"```sql\n(.*?);\n```", page, re.DOTALL))
    return [[tuple(row) for row in selected.rows] for selected in found]


def test_statements_of_the_page_about_the_lake_give_what_answers_say(world: World) -> None:
    with location(world.folder).writable() as tables:  # as `ship` puts the files of a day together
        for name in ("bags", "poses", "sightings"):
            tables.replace(name, AlwaysTrue(), tables.rows(name, AlwaysTrue()))
    metres, minutes, often, charge, last, where = answers_of_the_page(world.folder)

    def answer(tool: str, name: str, **given: Any) -> Any:
        return reply(world.mounted, tool, {"robot": name, **given})

    whole = {name: {"start": _begin_s(name), "end": _begin_s(name) + LENGTH_S} for name in ROBOTS}
    driven = {name: answer("trajectory_summary", name, **whole[name]) for name in ROBOTS}
    assert {robot: found for robot, _, found in metres} == {
        name: pytest.approx(one["distance_m"], rel=0.03) for name, one in driven.items()
    }
    there = {"where": {"x": 2.0, "y": 3.0, "radius_m": 1.5}}
    of_map = {name: answer("visits", name, **there, **whole[name]) for name in ROBOTS}
    spent = {robot: float(found) for robot, _, found in minutes}
    for name in ("behind", "damaged", "twin"):
        assert spent[name] == pytest.approx(of_map[name]["minutes"], abs=0.03), name
    assert spent.keys() == {"behind", "damaged", "twin"}
    assert {(robot, thing) for robot, thing, *_ in often} >= set(SEEN.items())
    percentages = [1 - step / 1000 for step in range(0, 5 * LENGTH_S, 25)]
    of_lost = [row[2:] for row in charge if row[0] == "lost"]
    assert of_lost == [pytest.approx((min(percentages), max(percentages)))]
    mug = clause("/vision/*/*", "contains", "mug")
    matches = reply(world.mounted, "find_last_match", mug)["matches"]
    assert [(row[0], round(row[1], 3)) for row in last] == [
        (row["robot_name"], row["timestamp"]) for row in matches
    ]
    assert {row[0] for row in where} == {"behind", "damaged", "twin"}


def every_question(
    topics: Sequence[str], start_s: float, end_s: float, label: str, seen: str
) -> Iterator[Question]:
    """Yields questions about a time with data, some of them at moments that are drawn.

    `label` is what detectors of the topics `seen`, a name or glob, may have seen.
    """
    draw = Random(f"{start_s}")
    whole: dict[str, object] = {"start": start_s, "end": end_s}
    middle = (start_s + end_s) / 2
    cut: dict[str, object] = {"start": middle - 13.3, "end": middle + 9.7}
    spot: dict[str, object] = {"where": {"x": 2.0, "y": 3.0, "radius_m": 1.5}}
    match: dict[str, object] = clause(seen, "contains", label)
    for topic in topics:
        at = {"topic": topic, "timestamp": draw.uniform(start_s, end_s), "tolerance_s": 5}
        yield "get_topic_at_time", at
        yield "get_topic_seconds_ago", {"topic": topic, "seconds_ago": 540, "tolerance_s": 60}
        yield "get_topic_in_range", {"topic": topic, **cut, "max_samples": 4}
        yield "get_topic_in_range", {"topic": topic, **whole, "by": "minute"}
        yield "get_topic_in_last", {"topic": topic, "seconds": 590, "max_samples": 3}
    for each in (start_s + 1, middle, draw.uniform(start_s, end_s)):
        yield "get_position_at", {"timestamp": each}
        yield "get_position_at", {"timestamp": each, "frame_id": "odom"}
        yield "get_velocity_at", {"timestamp": each}
        yield "get_transform_at", {"parent": "map", "child": "base_link", "timestamp": each}
        yield "recap", {"around": each}
    ago: dict[str, object] = {"seconds_ago": 550, "tolerance_s": 60}
    yield "get_position_seconds_ago", ago
    yield "get_velocity_seconds_ago", ago
    yield "get_transform_seconds_ago", {"parent": "map", "child": "odom", "seconds_ago": 550}
    for window in (whole, cut):
        yield "recap", window
        yield "find_things", window
        yield "trajectory_summary", window
        yield "trajectory_summary", {**window, **spot, "max_waypoints": 0}
        yield "visits", {**spot, **window}
        for more in ({}, spot, {"oldest_first": True}, {"by": "hour"}, {"limit": 2}):
            yield "find_matches", {**match, **window, **more}
    yield "trajectory_summary", {**whole, "by": "hour"}
    yield "recent_trajectory_summary", {"seconds": 560}
    yield "compare", {**cut, "with_start": start_s, "with_end": middle}
    yield "find_last_match", match
    yield "find_last_match", {**match, "before": middle}
    yield "find_last_match", {**match, "value": "elephant"}
    yield (
        "get_value_when",
        {
            "value_topic": "/odom",
            "condition_topic": seen,
            "condition_type": "contains",
            "value": label,
        },
    )
    yield "find_things", {"label": label, "limit": 3}
    yield "visits", spot
    yield "visits", {**spot, "by": "hour"}
    yield "visits", {**spot, **whole, "while": match}
    yield "trajectory_summary", {**whole, "while": match}
    for tool in build_tools(QuerySettings()):
        if "required" not in tool.schema and tool.name not in OF_DIRECTORIES:
            yield tool.name, {}

"""Bags of which a lake has some and a robot the others answer as all of them in one directory."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import pytest

from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.memo import Memo
from ros2_memory.fleet.joined import JoinedIndex
from ros2_memory.fleet.robots import Fleet
from ros2_memory.history.context import Memory
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.memory import LakeReader
from tests.support.clocks import FixedClock
from tests.support.fleets import reply
from tests.support.lake_questions import every_question
from tests.support.lakes import (
    fleet_of,
    lake_robots,
    location,
    robot_bags,
    ship,
)
from tests.support.memories import memory_of
from tests.support.moving_map import BEGIN, S
from tests.support.unlike_robots import LENGTH_S, ROBOTS, SEEN, YEAR_NS

NOW = BEGIN + 600 * S
NAMES = ("behind", "diver", "lost", "twin")


class Fleets(NamedTuple):
    """The robots over all of their bags, and over two shares of these."""

    whole: Fleet
    joined: Fleet


def joined_memory(of_lake: Memory, own: Memory) -> Memory:
    index = JoinedIndex(of_lake.index, own.index)
    assert isinstance(of_lake.reader, LakeReader)
    reader = replace(of_lake.reader, own=own.reader)
    scanner = Scanner(None, index.bag_dir)
    return replace(own, index=index, reader=reader, scanner=scanner, memo=Memo())


@pytest.fixture(scope="module")
def fleets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleets]:
    """Of two robots the lake has the older bags, of the others every second one."""
    folder, half = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("half")
    for name in NAMES:
        ROBOTS[name](folder / name)
        bags = sorted((folder / name).rglob("*.mcap"))
        shipped = bags[:3] if name in {"behind", "twin"} else bags[::2]
        for bag in bags:
            share = "lake" if bag in shipped else "own"
            copy = half / share / bag.relative_to(folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(bag, copy)
    ship(half / "rows", [robot_bags(name, half / "lake" / name) for name in NAMES], most_bags=100)
    clock = FixedClock(NOW)
    with location(half / "rows").opened() as catalog:
        lake = Lake(catalog, memory_mb=256, threads=1)
        of_lake = lake_robots(lake, NAMES, now=NOW, bag_dirs=half / "own")
        own = {name: memory_of(half / "own" / name, clock=clock) for name in NAMES}
        joined = {name: joined_memory(of_lake[name], own[name]) for name in NAMES}
        whole = {name: memory_of(folder / name, clock=clock) for name in NAMES}
        yield Fleets(*(fleet_of(some, shared_map=True, now=NOW) for some in (whole, joined)))


@pytest.mark.parametrize("name", NAMES)
def test_every_question_is_answered_by_two_shares_as_by_the_whole_or_refused(
    fleets: Fleets, name: str
) -> None:
    topics = sorted(
        {row["topic"] for row in reply(fleets.whole, "list_recorded_topics", {"robot": name})}
    )
    begin_s = (BEGIN - (YEAR_NS if name == "behind" else 0)) / S
    answered = 0
    for tool, given in every_question(
        topics, begin_s, begin_s + LENGTH_S, SEEN[name], "/vision/*/*"
    ):
        asked = {**given, "robot": name}
        expected, found = (reply(fleet, tool, asked) for fleet in fleets)
        if "error" in found and found["error"] == "not_in_lake":
            assert str(given["topic"]).endswith("/image")
        else:
            assert found == expected, (tool, asked)
            answered += 1
    assert answered > 50

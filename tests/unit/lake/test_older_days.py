"""Searches go on where a lake has more days of a robot than are looked at together."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import NoDataError
from ros2_memory.core.timebase import NS_PER_S, Deadline
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.history.context import Call, Memory
from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.queries import find_last_match, value_when
from ros2_memory.results import Match
from tests.support.bags import Msg, detections, text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW, SEEN, START_S, reply
from tests.support.lake_rows import fill, lake_in, lake_robots
from tests.support.memories import memory_of, with_store

DAY_S = 86_400
DAYS = 7
"""Days ago that the first bag is of; from then on there are two of a day, and none of the third."""


def old_robot(engine: LakeEngine, folder: Path, topics: Sequence[str] = ()) -> Memory:
    """A robot of which one day at a time is looked at: it saw a mug, a day later a fork, then cups.

    Its track is of another topic since.
    """
    labels = {DAYS: "mug", DAYS - 1: "fork"}
    for ago in (7, 6, 4, 3, 1, 0):
        at = (START_S - ago * DAY_S) * NS_PER_S
        seen = labels.get(ago, "cup")
        messages: list[Msg] = [detections(at, [seen]), text(at + NS_PER_S, seen)]
        if ago == DAYS:
            messages.append(detections(at + 2, ["spoon"], topic="/vision/old"))
        write_mcap(folder / "bags" / "rec" / f"rec_{DAYS - ago}.mcap", messages)
    memory = with_store(memory_of(folder / "bags"), folder / "bags")
    catalog = lake_in(folder)
    fill(catalog, {"hall": memory}, topics)
    return lake_robots(catalog, engine, ["hall"], days=1, most_bags=1)["hall"]


def asked(robot: Memory, label: str, topic: str = SEEN, **more: object) -> dict[str, Any]:
    fleet = Fleet([Robot("hall", Path("/hall"), lambda: robot, lake=robot)], FixedClock(NOW))
    given = {"topic": topic, "condition_type": "contains", "value": label, **more}
    found: dict[str, Any] = reply(fleet, "find_last_match", given)
    return found


def test_what_was_seen_before_the_newest_days_is_found(tmp_path: Path, engine: LakeEngine) -> None:
    robot = old_robot(engine, tmp_path)
    for label, ago in (("cup", 0), ("fork", 6), ("mug", 7)):
        found = asked(robot, label)
        [match] = found["matches"]
        assert match["timestamp"] == START_S - ago * DAY_S
        assert "not looked at" not in str(found)
    before = asked(robot, "mug", before=START_S - 2 * DAY_S)
    assert "never" not in before


@pytest.mark.parametrize(
    ("more", "is_noted"),
    [
        ({}, True),
        ({"start": START_S - DAY_S}, True),
        ({"start": START_S}, False),
        ({"last_s": 60}, False),
        ({"end": START_S - 2 * DAY_S}, True),
    ],
)
def test_days_before_are_named_only_where_the_answer_is_of_them(
    tmp_path: Path, engine: LakeEngine, more: dict[str, object], *, is_noted: bool
) -> None:
    robot = old_robot(engine, tmp_path)
    fleet = Fleet([Robot("hall", Path("/hall"), lambda: robot, lake=robot)], FixedClock(NOW))
    given = {"topic": SEEN, "condition_type": "contains", "value": "cup", **more}
    for robot_name in ({}, {"robot": "hall"}):
        found = reply(fleet, "find_matches", {**given, **robot_name})
        assert ("not looked at" in str(found)) is is_noted


def test_never_is_of_all_days(tmp_path: Path, engine: LakeEngine) -> None:
    found = asked(old_robot(engine, tmp_path), "elephant")
    assert found["never"] == ["hall"]
    assert "not looked at" not in str(found)


def test_a_topic_of_old_days_alone_is_searched(tmp_path: Path, engine: LakeEngine) -> None:
    robot = old_robot(engine, tmp_path)
    assert len(asked(robot, "spoon", topic="/vision/old")["matches"]) == 1
    assert asked(robot, "cup", topic="/vision/old")["never"] == ["hall"]


def test_a_value_at_a_match_of_old_days_is_found(tmp_path: Path, engine: LakeEngine) -> None:
    robot = old_robot(engine, tmp_path, ["/chatter"])
    ask = partial(value_when, robot, Call(), "/chatter", SEEN, condition_type="contains")
    found = ask(value="fork")
    assert found.matched is not None
    assert found.matched.sample.time == (START_S - 6 * DAY_S) * NS_PER_S


def test_where_the_time_is_short_it_says_how_far_it_looked(
    tmp_path: Path, engine: LakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = old_robot(engine, tmp_path)
    monkeypatch.setattr("ros2_memory.queries.READING_S", 0.0)
    call = Call(Deadline.after(60))

    def ask(memory: Memory, call: Call) -> Match:
        return find_last_match(memory, call, SEEN, "contains", "mug")

    found, lake = Robot("hall", Path("/hall"), lambda: robot, lake=robot).asked(
        ask, call, lake_first=True
    )
    assert found.found is None
    assert lake is not None
    [note] = lake.notes
    assert note.startswith("the lake has days before ")


def test_what_fails_says_which_days_it_is_of(
    tmp_path: Path, engine: LakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = old_robot(engine, tmp_path)
    monkeypatch.setattr("ros2_memory.queries.READING_S", 0.0)

    def ask(memory: Memory, call: Call) -> Match:
        return find_last_match(memory, call, "/none", "contains", "mug")

    of_lake = Robot("hall", Path("/hall"), lambda: robot, lake=robot)
    with pytest.raises(NoDataError, match=r"/none.*; the lake has days before "):
        of_lake.asked(ask, Call(Deadline.after(60)), lake_first=True)

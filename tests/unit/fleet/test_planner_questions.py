"""What a planner asks about one robot, asked of six of which five are in trouble of some kind.

One is damaged, one offline, one goes offline while the server runs, the clock of one is a year
ahead, and the disk of one hangs. The judges are those of a server that has the one alone.
"""

from __future__ import annotations

import os
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.timebase import Deadline
from ros2_memory.fleet.merging import ANSWER_FOR_ALL
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.history.context import Call, Memory
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.clocks import FixedClock
from tests.support.fleets import START_S, reply_of, seeded, tools_of, write_robot
from tests.support.memories import memory_of, with_store
from tests.support.planner_judges import STARTED_S
from tests.support.planner_questions import QUESTIONS, Planned
from tests.support.planner_world import recorded

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.demo.judges import CallContext
    from ros2_memory.tools.declaration import Tool

WELL = "flat"
IN_TROUBLE = ("ahead", "damaged", "gone", "offline", "slow")
YEAR_S = 365 * 86_400
EARLIER_S = STARTED_S - 7200 - START_S
MUG = {"topic": "/vision/*/scene_objects", "condition_type": "contains", "value": "mug"}
BY_WORDS = {question.words: question for question in QUESTIONS}


class Hanging(McapReader):
    """A disk that does not answer until it is released."""

    def __init__(self, released: threading.Event) -> None:
        super().__init__()
        self._released = released

    def summarize(self, path: Path) -> BagSummary:
        self._released.wait()
        return super().summarize(path)


@dataclass(frozen=True)
class Six:
    """The tools of the six robots, and what was answered while `gone` was there."""

    tools: Mapping[str, Tool]
    asked: CallContext
    before: Any

    def reply(self, tool: str, given: Mapping[str, Any], call: Call | None = None) -> Any:
        return reply_of(self.tools[tool], {**given}, call)


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Six]:
    folder, released = tmp_path_factory.mktemp("six"), threading.Event()
    with recorded(folder / WELL) as world:
        for name in ("ahead", "damaged", "gone", "slow"):
            shift_s = EARLIER_S + (YEAR_S if name == "ahead" else 0)
            write_robot(seeded(name, shift_s=shift_s), folder / name)
        broken = folder / "damaged" / "rec" / "rec_1.mcap"
        modified = broken.stat().st_mtime_ns
        broken.write_bytes(b"no bag " * 100)
        os.utime(broken, ns=(modified, modified))
        clock = FixedClock(world.asked.after)

        def robot(name: str) -> Robot:
            reader = Hanging(released) if name == "slow" else McapReader()

            def build() -> Memory:
                memory = memory_of(folder / name, clock=clock, reader=reader)
                return with_store(memory, folder / name) if name == WELL else memory

            return Robot(name, folder / name, build)

        fleet = Fleet(map(robot, (WELL, *IN_TROUBLE)), clock, shared_map=True)
        tools = tools_of(fleet)
        first = reply_of(tools["list_frames"], {"robot": "slow"}, Call(Deadline.after(0.2)))
        assert first["error"] == "timeout"
        before = reply_of(tools["find_matches"], {**MUG})
        shutil.rmtree(folder / "gone")
        yield Six(tools, world.asked, before)
        released.set()


def of_the_well_one(found: Any) -> Any:
    """What a fleet's reply says of it, as the reply of its own server would."""
    if "robots" in found:
        [row] = [each for each in found["robots"] if each["robot_name"] == WELL]
        return without_name(row)
    if "matches" in found:
        rows = [each for each in found["matches"] if each["robot_name"] == WELL]
        assert bool(rows) != (WELL in found.get("never", []))
        return without_name(rows[0]) if rows else None
    own: dict[str, Any] = {
        key: [without_name(each) for each in value if each["robot_name"] == WELL]
        for key, value in found.items()
        if key in {"sightings", "things", "visits", "places"}
    }
    # Of a row where it differs between robots.
    frames = [row["frame_id"] for rows in own.values() for row in rows if "frame_id" in row]
    frame = {"frame_id": frames[0]} if frames else {}
    if "there_now" in found:
        own["there_now"] = WELL in found["there_now"]
    return {**found, **frame, **found.get("by_robot", {}).get(WELL, {}), **own}


def without_name(row: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key != "robot_name"}


def answers(six: Six, question: Planned) -> list[Any]:
    """What is answered to the steps of a question: of all where a tool answers so, else of one."""
    found: list[Any] = []
    for step in question.steps:
        given = step.arguments(found)
        # The row of a topic adds up what all robots have of it.
        if step.tool in ANSWER_FOR_ALL - {"list_recorded_topics"}:
            found.append(of_the_well_one(six.reply(step.tool, given)))
            continue
        named = six.reply(step.tool, {**given, "robot": WELL})
        if isinstance(named, list):
            assert all(row["robot_name"] == WELL for row in named)
            found.append([without_name(row) for row in named])
        else:
            assert named.get("robot_name", WELL) == WELL
            found.append(without_name(named))
    return found


@pytest.mark.parametrize("words", BY_WORDS)
def test_every_answer_about_the_one_that_is_well_is_right(six: Six, words: str) -> None:
    BY_WORDS[words].judge(answers(six, BY_WORDS[words]), six.asked)


def test_each_trouble_is_named_with_its_reason_and_spoils_nobody_elses_rows(six: Six) -> None:
    found = six.reply("find_matches", {**MUG, "limit": 50})
    assert {row["robot_name"] for row in found["sightings"]} == {"ahead", "damaged"}
    for name, words in (
        ("offline", "does not exist"),
        ("gone", "does not exist"),
        ("slow", "did not finish in time"),
        ("ahead", "clock that ran ahead"),
        ("damaged", "rec/rec_1.mcap"),
    ):
        assert any(name in note and words in note for note in found["notes"]), found["notes"]


def test_who_goes_offline_was_in_the_answer_before(six: Six) -> None:
    assert any("offline" in note and "gone" not in note for note in six.before["notes"])
    assert "gone" in six.before["by_robot"]
    found = six.reply("find_last_match", {**MUG, "value": "elephant"})
    assert {*found["never"]} == {WELL, "ahead"}


@pytest.mark.parametrize(
    ("name", "error"), [("offline", "no_data"), ("gone", "no_data"), ("slow", "busy")]
)
def test_who_cannot_answer_says_so_where_it_is_named(six: Six, name: str, error: str) -> None:
    assert six.reply("find_matches", {**MUG, "robot": name})["error"] == error

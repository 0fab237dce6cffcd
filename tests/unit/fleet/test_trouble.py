"""Six robots of which five are in trouble of some kind: it is named, and spoils nobody else's rows.

One is damaged, one offline, one goes offline while the server runs, the clock of one is a year
ahead, and the disk of one hangs.
"""

import os
import shutil
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.timebase import Deadline
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.history.context import Call
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.tools.declaration import Tool
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW, SEEN, reply_of, seeded, tools_of, write_robot
from tests.support.memories import memory_of

YEAR_S = 365 * 86_400
ROBOTS = {
    name: seeded(name, shift_s=YEAR_S if name == "ahead" else 0)
    for name in ("well", "ahead", "damaged", "gone", "slow")
}
LAST: dict[str, object] = {"topic": SEEN, "condition_type": "contains"}
TABLE = {**LAST, "value": "table"}


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
    """The tools of the six robots in a folder, and what was answered while `gone` was there."""

    folder: Path
    tools: Mapping[str, Tool]
    before: Any

    def reply(self, tool: str, given: Mapping[str, object]) -> Any:
        return reply_of(self.tools[tool], {**given})


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Six]:
    folder, released = tmp_path_factory.mktemp("six"), threading.Event()
    for name, robot in ROBOTS.items():
        write_robot(robot, folder / name)
    broken = folder / "damaged" / "rec" / "rec_1.mcap"
    modified = broken.stat().st_mtime_ns
    broken.write_bytes(b"no bag " * 100)
    os.utime(broken, ns=(modified, modified))
    clock = FixedClock(NOW)

    def robot_of(name: str) -> Robot:
        reader = Hanging(released) if name == "slow" else McapReader()
        return Robot(name, folder / name, memory_of(folder / name, clock=clock, reader=reader))

    tools = tools_of(Fleet(map(robot_of, (*ROBOTS, "offline")), clock, shared_map=True))
    hung = reply_of(tools["list_frames"], {"robot": "slow"}, Call(Deadline.after(0.2)))
    assert hung["error"] == "timeout"
    before = reply_of(tools["find_matches"], {**TABLE})
    shutil.rmtree(folder / "gone")
    yield Six(folder, tools, before)
    released.set()


def last_seen(name: str, label: str) -> list[float]:
    """When a robot last saw a label, as far as its bags can be read; the robot ahead comes last."""
    robot = ROBOTS[name]
    until = robot.start_s + 30 if name == "damaged" else robot.end_s + 1
    return [float(at) for at, what in robot.seen if what == label and at < until][-1:]


@pytest.mark.parametrize("label", ["mug", "scissors", "elephant"])
def test_who_last_saw_it_is_told_of_those_whose_bags_were_read(six: Six, label: str) -> None:
    found = six.reply("find_last_match", {**LAST, "value": label})
    rows = {row["robot_name"]: [row["timestamp"]] for row in found["matches"]}
    truth = {name: last_seen(name, label) for name in ("well", "damaged", "ahead")}
    assert rows == {name: times for name, times in truth.items() if times}
    assert [*rows] == sorted(rows, key=lambda name: (name == "ahead", -rows[name][0]))
    # Of one with a damaged bag "never" would be a claim about what was not searched.
    never = [name for name in ("well", "ahead") if not truth[name]]
    assert found.get("never", []) == never


def test_each_trouble_is_named_with_its_reason_and_spoils_nobody_elses_rows(six: Six) -> None:
    found = six.reply("find_matches", {**TABLE, "limit": 50})
    assert {row["robot_name"] for row in found["sightings"]} == {"well", "ahead", "damaged"}
    for name, words in (
        ("offline", "the bag directory does not exist (yet): check .../"),
        ("gone", "the bag directory does not exist (yet): check .../"),
        ("slow", "did not finish in time"),
        ("ahead", "clock that ran ahead"),
        ("damaged", "rec/rec_1.mcap"),
    ):
        assert any(name in note and words in note for note in found["notes"]), found["notes"]
    codes = {"offline": "refused", "gone": "refused", "slow": "busy"}
    assert found["robots_failed"] == codes
    assert str(six.folder) not in str(found)
    rows = {row["robot_name"]: row for row in six.reply("memory_status", {})["robots"]}
    assert rows.keys() == {*ROBOTS, "offline"} - {"slow"}
    assert rows["damaged"]["damaged"] == 1
    assert "does not exist" in rows["offline"]["doubts"]
    assert rows["well"]["doubts"] == "no loss or fault was found"


def test_who_goes_offline_was_in_the_answer_before(six: Six) -> None:
    assert any("offline" in note and "gone" not in note for note in six.before["notes"])
    assert "gone" in six.before["by_robot"]


@pytest.mark.parametrize(
    ("name", "error"), [("offline", "no_data"), ("gone", "no_data"), ("slow", "busy")]
)
def test_who_cannot_answer_says_so_where_it_is_named(six: Six, name: str, error: str) -> None:
    assert six.reply("find_matches", {**TABLE, "robot": name})["error"] == error

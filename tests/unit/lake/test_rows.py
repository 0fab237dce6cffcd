"""The rows of bags in a lake say what the memory answers about them."""

import math
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.lake.tables import TABLES
from tests.support.bags import Msg, battery, detections, write_mcap
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW, SEEN, seeded, write_robot
from tests.support.lakes import lake_rows, robot_bags, ship
from tests.support.memories import memory_of
from tests.support.unlike_robots import ROBOTS

ROBOT = seeded("kitchen")


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Memory]:
    """A lake with a robot's two bags, and the memory over these."""
    folder = tmp_path_factory.mktemp("lake")
    bags = write_robot(ROBOT, folder / "bags")
    robot = robot_bags("kitchen", bags, FixedClock(NOW), messages=("/is_docked",))
    assert ship(folder / "lake", [robot]).bags == 2
    return folder / "lake", robot.memory


def test_each_detection_is_a_row(lake: tuple[Path, Memory], tmp_path: Path) -> None:
    rows = lake_rows(lake[0], "sightings")
    assert sorted((row["time_ns"], row["label"]) for row in rows) == [
        (at * NS_PER_S, label) for at, label in ROBOT.seen
    ]
    assert {row["topic"] for row in rows} == {SEEN}
    assert {row["robot_frame"] for row in rows} == {"map"}
    assert sum(row["detections"] for row in lake_rows(lake[0], "bags")) == len(rows)
    assert sum(row["count"] for row in lake_rows(lake[0], "things")) == len(rows)
    # It knows which message of its topic has it.
    seen = [detections(at * NS_PER_S, [*labels]) for at, labels in ((1, "ab"), (2, ""), (3, "a"))]
    write_mcap(tmp_path / "bags" / "rec" / "rec_0.mcap", seen)
    ship(tmp_path / "lake", [robot_bags("hall", tmp_path / "bags")])
    found = lake_rows(tmp_path / "lake", "sightings")
    assert sorted((row["message"], row["label"]) for row in found) == [(0, "a"), (0, "b"), (2, "a")]


def test_messages_of_one_time_have_their_own_numbers_beside_one_that_cannot_be_decoded(
    tmp_path: Path,
) -> None:
    def seen(at: int, label: str) -> Msg:
        return detections(at * NS_PER_S, [label])

    spoiled = replace(seen(2, "-"), body=b"\x00\x01\x00\x00\xff")
    messages = [seen(1, "a"), seen(1, "b"), spoiled, seen(2, "c"), seen(2, "d"), seen(3, "e")]
    write_mcap(tmp_path / "bags" / "rec" / "rec_0.mcap", messages)
    ship(tmp_path / "lake", [robot_bags("hall", tmp_path / "bags")])
    found = lake_rows(tmp_path / "lake", "sightings")
    assert sorted((row["message"], row["label"]) for row in found) == [
        (0, "a"),
        (1, "b"),
        (3, "c"),
        (4, "d"),
        (5, "e"),
    ]
    assert [row["undecodable"] for row in lake_rows(tmp_path / "lake", "bags")] == [1]


def test_rows_of_a_bag_are_the_same_whatever_bags_they_are_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And whether their columns are stored."""
    ROBOTS["twin"](tmp_path / "twin")
    found = []
    for together in (1, 3, 64, 0):
        monkeypatch.setattr("ros2_memory.lake.shipper._TOGETHER", together or 64)
        lake, robot = tmp_path / f"lake_{together}", robot_bags("twin", tmp_path / "twin")
        if not together:
            robot = replace(robot, memory=memory_of(tmp_path / "twin"), filling=None)
        ship(lake, [robot], most_bags=100)
        found.append({name: sorted(map(str, lake_rows(lake, name))) for name in TABLES})
    assert len(found[0]["poses"]) > len(found[0]["bags"]) > 3
    assert found[1:] == found[:1] * 3


def test_numbers_of_messages_are_as_they_were_recorded(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bags" / "rec" / "rec_0.mcap", [battery(NOW, math.nan)])
    robot = robot_bags("hall", tmp_path / "bags", messages=["/battery_state"])
    assert ship(tmp_path / "lake", [robot]).bags == 1
    [row] = lake_rows(tmp_path / "lake", "messages")
    assert math.isnan(dict(row["numbers"])["percentage"])


def test_of_large_messages_there_are_the_times_alone_unless_they_are_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = Random(1).randbytes
    image = [Msg("/camera", "sensor_msgs/msg/Image", nth, noise(9)) for nth in (1, 2, 3)]
    scans = [Msg("/scan", "sensor_msgs/msg/LaserScan", nth, noise(2_000)) for nth in range(1, 30)]
    large_once = Msg("/map", "nav_msgs/msg/OccupancyGrid", 1, noise(9_000))
    write_mcap(tmp_path / "bags" / "rec" / "rec_0.mcap", [*image, *scans, large_once])

    def whole(name: str, *messages: str) -> set[str]:
        ship(tmp_path / name, [robot_bags("hall", tmp_path / "bags", messages=messages)])
        rows = lake_rows(tmp_path / name, "channels")
        counts = {row["topic"]: row["messages"] for row in rows}
        assert counts == {"/camera": 3, "/map": 1, "/scan": 29}
        return {row["topic"] for row in rows if row["has_payloads"]}

    assert whole("plain") == {"/map"}
    assert whole("chosen", "/camera") == {"/camera", "/map"}
    # Of more than may be in memory the largest goes.
    monkeypatch.setattr("ros2_memory.lake.rows._MOST_BYTES", 8_000)
    assert whole("short") == set()

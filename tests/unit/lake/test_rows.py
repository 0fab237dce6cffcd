"""The rows of bags in a lake say what the memory answers about them."""

import math
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.lake.tables import TABLES
from tests.support.bags import Msg, battery, detections, odom, text, write_mcap
from tests.support.fleets import NOW, START_S
from tests.support.lakes import lake_rows, robot_bags, ship
from tests.support.memories import memory_of
from tests.support.unlike_robots import ROBOTS


def test_messages_of_one_time_have_their_own_numbers_beside_one_that_cannot_be_decoded(
    tmp_path: Path,
) -> None:
    """And numbers in messages are as they were recorded."""

    def seen(at: int, labels: str) -> Msg:
        return detections(at * NS_PER_S, [*labels])

    spoiled = replace(seen(2, "-"), body=b"\x00\x01\x00\x00\xff")
    messages = [seen(1, "ax"), seen(1, "b"), spoiled, seen(2, "c"), seen(2, ""), seen(3, "e")]
    write_mcap(tmp_path / "bags" / "rec" / "rec_0.mcap", [*messages, battery(NOW, math.nan)])
    ship(tmp_path / "lake", [robot_bags("hall", tmp_path / "bags", messages=["/battery_state"])])
    found = lake_rows(tmp_path / "lake", "sightings")
    numbered = [(0, "a"), (0, "x"), (1, "b"), (3, "c"), (5, "e")]
    assert sorted((row["message"], row["label"]) for row in found) == numbered
    assert [row["undecodable"] for row in lake_rows(tmp_path / "lake", "bags")] == [1]
    [row] = lake_rows(tmp_path / "lake", "messages")
    assert math.isnan(dict(row["numbers"])["percentage"])


def test_rows_of_a_bag_are_the_same_whatever_bags_they_are_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And whether their columns are stored."""
    ROBOTS["twin"](tmp_path / "twin")
    found = []
    for together in (1, 3, 0):
        monkeypatch.setattr("ros2_memory.lake.shipper._TOGETHER", together or 64)
        lake, robot = tmp_path / f"lake_{together}", robot_bags("twin", tmp_path / "twin")
        if not together:
            robot = replace(robot, memory=memory_of(tmp_path / "twin"), filling=None)
        ship(lake, [robot], most_bags=100)
        found.append({name: sorted(map(str, lake_rows(lake, name))) for name in TABLES})
    assert len(found[0]["poses"]) > len(found[0]["bags"]) > 3
    assert found[1:] == found[:1] * 2


@pytest.mark.parametrize("spoiled", [1, 3])
def test_a_pose_that_cannot_be_decoded_costs_its_bag_alone_the_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoiled: int
) -> None:
    """Where messages have too many fields for columns, those of all bags are read at once."""
    monkeypatch.setattr("ros2_memory.columns.plan.MAX_COLUMNS", 3)
    driven = [odom(START_S * NS_PER_S + n * NS_PER_S // 2, n / 2, 0.0) for n in range(80)]
    torn = 20 * spoiled + 7
    driven[torn] = replace(driven[torn], body=driven[torn].payload[:40])
    for nth in range(4):
        own = driven[20 * nth : 20 * nth + 20]
        write_mcap(tmp_path / "bags" / "rec" / f"rec_{nth}.mcap", own)
    assert ship(tmp_path / "lake", [robot_bags("hall", tmp_path / "bags")], most_bags=4).bags == 4
    rows = sorted(lake_rows(tmp_path / "lake", "bags"), key=lambda row: row["bag_id"])
    assert [(row["poses"], row["distance_m"]) for row in rows] == [
        (None, None) if nth == spoiled else (20, 9.5) for nth in range(4)
    ]


@pytest.mark.parametrize("earlier_s", [0, 1200])
def test_bags_beside_one_whose_poses_have_no_position_are_shipped(
    tmp_path: Path, earlier_s: int
) -> None:
    """The robot's places are known, too, where that one lies in no part of theirs."""
    begin = START_S * NS_PER_S
    driven = [odom(begin + n * NS_PER_S // 5, n / 10, 0.0) for n in range(50)]
    said = [text(begin + (n - earlier_s) * NS_PER_S + 7, "x", "/odom") for n in range(10)]
    write_mcap(tmp_path / "bags" / "rec" / "rec_0.mcap", driven)
    write_mcap(tmp_path / "bags" / "other" / "other_0.mcap", said)
    shipped = ship(tmp_path / "lake", [robot_bags("hall", tmp_path / "bags")])
    assert (shipped.bags, shipped.problems) == (2, [])
    rows = lake_rows(tmp_path / "lake", "bags")
    assert {row["recording"]: row["poses"] for row in rows} == {"rec": 50, "other": None}
    placed = {row["topic"] for row in lake_rows(tmp_path / "lake", "poses")}
    assert placed == ({"/odom"} if earlier_s else set())


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

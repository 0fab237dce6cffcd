"""The rows of a bag say what the memory answers about it."""

import math
from collections import Counter
from dataclasses import replace
from datetime import date
from pathlib import Path
from random import Random

import pytest

from ros2_memory.core.model import BagFile
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.recap import recap
from ros2_memory.lake.rows import bag_id_of, made_of, rows_of
from ros2_memory.lake.tables import TABLES, Row, day_of
from tests.support.bags import Msg, detections, write_mcap
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW, SEEN, SeededRobot, seeded, write_robot
from tests.support.lake_rows import shipped
from tests.support.memories import memory_of, with_store

Table = list[dict[str, object]]


def lake_rows(memory: Memory, bag: BagFile, messages: tuple[str, ...] = ()) -> dict[str, Table]:
    """The rows of a bag with names."""
    found = rows_of(memory, bag, shipped("kitchen", bag), messages)
    return {
        name: [{column: row.get(column) for column in TABLES[name].columns} for row in rows]
        for name, rows in found.items()
    }


@pytest.fixture(scope="module")
def robot() -> SeededRobot:
    return seeded("kitchen")


@pytest.fixture(scope="module")
def memory(robot: SeededRobot, tmp_path_factory: pytest.TempPathFactory) -> Memory:
    bag_dir = write_robot(robot, tmp_path_factory.mktemp("bags"))
    return with_store(memory_of(bag_dir, clock=FixedClock(NOW)), bag_dir)


@pytest.fixture(scope="module")
def both(memory: Memory) -> list[dict[str, Table]]:
    return [lake_rows(memory, bag, ("/is_docked",)) for bag in memory.index.snapshot().bags]


def joined(both: list[dict[str, Table]], name: str) -> Table:
    return [row for rows in both for row in rows[name]]


def test_each_detection_is_a_row(robot: SeededRobot, both: list[dict[str, Table]]) -> None:
    rows = joined(both, "sightings")
    assert [(row["time_ns"], row["label"]) for row in rows] == [
        (at * NS_PER_S, label) for at, label in robot.seen
    ]
    assert {row["topic"] for row in rows} == {SEEN}
    assert {row["robot_frame"] for row in rows} == {"map"}
    assert sum(int(str(rows["bags"][0]["detections"])) for rows in both) == len(robot.seen)


def test_a_detection_knows_which_message_of_its_topic_has_it(tmp_path: Path) -> None:
    seen = [detections(at * NS_PER_S, [*labels]) for at, labels in ((1, "ab"), (2, ""), (3, "a"))]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", seen)
    memory = with_store(memory_of(tmp_path), tmp_path)
    rows = lake_rows(memory, memory.index.snapshot().bags[0])["sightings"]
    assert [(row["label"], row["message"]) for row in rows] == [("a", 0), ("b", 0), ("a", 2)]


def test_poses_are_within_their_error_of_what_the_robot_drove(both: list[dict[str, Table]]) -> None:
    poses = [row for row in joined(both, "poses") if row["frame_id"] == "odom"]
    first = min(int(str(row["time_ns"])) for row in poses)
    assert {row["frame_id"] for row in joined(both, "poses")} == {"map", "odom"}
    for row in poses:
        second = (int(str(row["time_ns"])) - first) / NS_PER_S
        x, y = float(str(row["x"])), float(str(row["y"]))
        apart = math.dist((x, y), (math.sin(second / 10) * 3, 0.1 * second))
        assert apart <= float(str(row["error_m"])) + 1e-9


def test_of_large_messages_there_are_the_times_alone_unless_they_are_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = Random(1).randbytes
    image = [Msg("/camera", "sensor_msgs/msg/Image", nth, noise(9_000)) for nth in (1, 2, 3)]
    scans = [Msg("/scan", "sensor_msgs/msg/LaserScan", nth, noise(2_000)) for nth in range(1, 30)]
    large_once = Msg("/map", "nav_msgs/msg/OccupancyGrid", 1, noise(9_000))
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*image, *scans, large_once])
    memory = memory_of(tmp_path)
    [bag] = memory.index.snapshot().bags
    rows = {row["topic"]: row for row in lake_rows(memory, bag)["channels"]}
    assert {topic: row["has_payloads"] for topic, row in rows.items()} == {
        "/camera": False,
        "/map": True,
        "/scan": False,
    }
    assert {topic: row["messages"] for topic, row in rows.items()} == {
        "/camera": 3,
        "/map": 1,
        "/scan": 29,
    }
    chosen = {row["topic"]: row for row in lake_rows(memory, bag, ("/camera",))["channels"]}
    assert chosen["/camera"]["has_payloads"]
    # Of more than may be in memory the largest goes.
    monkeypatch.setattr("ros2_memory.lake.rows._MOST_BYTES", 8_000)
    assert not any(row["has_payloads"] for row in lake_rows(memory, bag)["channels"])


def test_metres_of_a_bag_are_those_of_a_recap_of_it(
    memory: Memory, both: list[dict[str, Table]]
) -> None:
    for rows in both:
        row = rows["bags"][0]
        start, end = (int(str(row[name])) / NS_PER_S for name in ("start_ns", "end_ns"))
        told = recap(memory, Call(), TimeRange(start, end))
        assert row["distance_m"] == pytest.approx(told.distance_m, abs=1e-6)


def test_messages_of_a_chosen_topic_are_whole(both: list[dict[str, Table]]) -> None:
    assert [row["flags"] for row in joined(both, "messages")] == [
        [("value", each)] for each in (False, True, False)
    ]
    assert {row["value"] for row in joined(both, "messages")} == {'{"value":null}'}
    assert not [row for row in joined(both, "messages") if row["undecodable"]]


def test_a_bag_has_one_id_wherever_it_lies(tmp_path: Path) -> None:
    message = detections(NS_PER_S, ["cup"])
    write_mcap(tmp_path / "one" / "rec" / "rec_0.mcap", [message])
    write_mcap(tmp_path / "two" / "moments" / "x" / "rec" / "rec_0.mcap", [message])
    write_mcap(tmp_path / "three" / "rec" / "rec_0.mcap", [replace(message, log_time=2)])
    bags = [memory_of(tmp_path / each).index.snapshot().bags[0] for each in ("one", "two", "three")]
    ids = [bag_id_of("kitchen", bag, bag.start) for bag in bags]
    assert ids[0] == ids[1]
    assert ids[2] != ids[0]
    assert bag_id_of("hall", bags[0], bags[0].start) != ids[0]


def test_what_rows_are_made_of_changes_with_what_counts(memory: Memory) -> None:
    one, two = memory.index.snapshot().bags
    assert made_of(memory, one, "config") == made_of(memory, one, "config")
    assert made_of(memory, one, "config") != made_of(memory, one, "other")
    assert made_of(memory, one, "config") != made_of(memory, one, "config", ["/odom"])
    assert made_of(memory, one, "config") != made_of(memory, two, "config")


def test_arrow_tables_are_sorted_and_carry_the_keys(memory: Memory) -> None:
    bag = memory.index.snapshot().bags[0]
    rows = rows_of(memory, bag, shipped("kitchen", bag))["channels"]
    table = TABLES["channels"].filled([{**rows[0], "bag_id": "b"}, *rows])
    assert table.num_rows == len(rows) + 1
    assert Counter(table["bag_id"].to_pylist()) == {rows[0]["bag_id"]: len(rows), "b": 1}
    assert {*table["robot"].to_pylist()} == {"kitchen"}
    assert {*table["day"].to_pylist()} == {day_of(bag.start)}
    keys = list(zip(*(table[name].to_pylist() for name in TABLES["channels"].order), strict=True))
    assert keys == sorted(keys)
    assert TABLES["poses"].filled([]).num_rows == 0


def test_lone_surrogates_of_a_hostile_bag_are_escaped() -> None:
    row: Row = {
        "robot": "kitchen",
        "bag_id": "a",
        "day": date(2026, 11, 20),
        "topic": "/\udc80",
        "time_ns": 1,
        "value": "bad \udc80",
        "texts": [("\udc80", "\udc81")],
    }
    table = TABLES["messages"].filled([row])
    assert table["value"].to_pylist() == ["bad \\udc80"]
    assert table["topic_key"].to_pylist() == ["\\udc80"]
    assert table["texts"].to_pylist() == [[("\\udc80", "\\udc81")]]

"""What a lake has of a robot's bags is read as its bags are."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random

import numpy as np
import pytest

from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.columns.pack import decompress
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.lake.memory import LakeIndex
from ros2_memory.lake.tables import packed_messages, unpacked_messages
from ros2_memory.lake.upkeep import Tombstone, forget_in_lake
from ros2_memory.storage.base import Channel, Schema
from tests.support import storeys
from tests.support.bags import Msg, detections, odom, text, write_mcap, write_splits
from tests.support.fleets import SEEN, START_S, reply
from tests.support.lakes import (
    fleet_of,
    lake_robot,
    lake_rows,
    location,
    robot_bags,
    ship,
    ship_from,
    store_columns,
    write_bag,
)
from tests.support.memories import asked

AT = START_S * NS_PER_S
EVERYTHING = TimeWindow.everything()
CHANNEL = Channel("/any", "cdr", Schema("any"))


def shipped(folder: Path) -> tuple[Memory, Memory]:
    """The memory over a robot's bags, and over the lake that they were shipped into."""
    robot = robot_bags("hall", folder / "bags")
    assert ship(folder / "lake", [robot]).bags == 2
    return robot.memory, lake_robot(folder / "lake", stores=folder / "cache")


def test_recordings_that_a_handover_joins_are_one_run_of_odometry(tmp_path: Path) -> None:
    handovers = {"one": Handover(next="two"), "two": Handover(previous="one")}
    for number, (name, handover) in enumerate(handovers.items()):
        at = AT + 20 * number * NS_PER_S
        messages = [odom(at + nth * NS_PER_S, nth / 9, 0.0) for nth in range(19)]
        messages.append(detections(at + 5, ["cup"]))
        write_mcap(tmp_path / "bags" / name / f"{name}_0.mcap", messages)
        write_handover(tmp_path / "bags" / name, handover)
    bags, lake = (fleet_of({"hall": memory}) for memory in shipped(tmp_path))
    asked = {"start": START_S, "end": START_S + 60}
    for tool in ("trajectory_summary", "find_things"):
        expected = reply(bags, tool, asked)
        assert "error" not in expected
        assert reply(lake, tool, asked) == expected


def test_places_of_two_storeys_are_told_apart_by_a_lake_as_by_the_bags(tmp_path: Path) -> None:
    write_splits(tmp_path / "bags", storeys.house(), 60)
    robot = robot_bags("hall", tmp_path / "bags")
    ship(tmp_path / "lake", [robot])
    lake = lake_robot(
        tmp_path / "lake", stores=tmp_path / "cache", now=round(storeys.END * NS_PER_S)
    )
    bags = replace(robot.memory, clock=lake.clock)
    for tool, given in (
        ("visits", {}),
        ("visits", {"by": "place"}),
        ("find_things", {"where": "bedroom"}),
        ("recap", {"where": "kitchen", "start": storeys.BEGIN, "end": storeys.END}),
    ):
        of_bags, of_lake = (asked(storeys.with_places(one), tool, **given) for one in (bags, lake))
        assert "error" not in of_bags
        assert of_lake == of_bags
    heights = [row["z"] for row in lake_rows(tmp_path / "lake", "poses")]
    assert (min(heights), max(heights)) == (0.0, storeys.UP_M)
    assert {row["robot_z"] for row in lake_rows(tmp_path / "lake", "sightings")} > {
        0.0,
        storeys.UP_M,
    }


def test_copies_among_images_are_told_by_their_publish_times(tmp_path: Path) -> None:
    for recording, beats in enumerate((range(20), range(10, 30))):
        messages: list[Msg] = []
        for n in beats:
            sent = AT + n * NS_PER_S
            image = Msg("/camera", "sensor_msgs/msg/Image", sent + recording, b"%06d" % n, sent)
            messages += [
                image,
                replace(text(0, f"{n}"), log_time=image.log_time, publish_time=sent),
            ]
        write_mcap(tmp_path / "bags" / f"r{recording}" / f"r{recording}_0.mcap", messages)
    bags, robot = shipped(tmp_path)
    span = {"start": START_S - 1, "end": START_S + 99, "by": "day"}
    for is_stored in (False, True):
        if is_stored:
            store_columns(robot)
        for topic in ("/camera", "/chatter"):
            given = {"topic": topic, **span}
            expected = reply(fleet_of({"hall": bags}), "get_topic_in_range", given)
            assert expected["rows"][0][2] == 30
            assert reply(fleet_of({"hall": robot}), "get_topic_in_range", given) == expected


def test_columns_are_stored_of_what_is_there_and_those_of_forgotten_bags_go(
    tmp_path: Path,
) -> None:
    for number in range(2):
        write_bag(tmp_path / "bags", number)
    bags, robot = shipped(tmp_path)
    filling = store_columns(robot)
    assert filling.store.paths() == ["rec/rec_0.mcap", "rec/rec_1.mcap"]
    given = {"topic": SEEN, "condition_type": "contains", "value": "cup"}
    over_lake, over_bags = fleet_of({"hall": robot}), fleet_of({"hall": bags})
    assert reply(over_lake, "find_matches", given) == reply(over_bags, "find_matches", given)
    first, second = robot.index.snapshot().bags
    with location(tmp_path / "lake").writable() as tables:
        assert forget_in_lake(tables, Tombstone("hall", first.start, first.end)).bags == 1
    assert [*robot.index.refresh().bags] == [second]
    filling.prune(robot.index.refresh().timeline)
    assert filling.store.paths() == ["rec/rec_1.mcap"]


def test_a_bag_that_went_since_the_index_was_read_is_not_taken_for_an_empty_one(
    tmp_path: Path,
) -> None:
    write_bag(tmp_path / "hall", 0)
    ship_from(tmp_path)
    robot = lake_robot(tmp_path / "lake")
    [bag] = robot.index.snapshot().bags
    with location(tmp_path / "lake").writable() as tables:
        forget_in_lake(tables, Tombstone("hall", bag.start, bag.end))
    # As when another robot of the same lake is asked.
    assert isinstance(robot.index, LakeIndex)
    robot.index.lake.refresh()
    for _ in range(2):
        with pytest.raises(BagVanishedError):
            [*robot.reader.records(bag.path, ["/chatter"], EVERYTHING)]


def test_messages_of_one_log_time_keep_the_order_of_the_file(tmp_path: Path) -> None:
    """Those of a topic with two channels, and of several topics."""
    draw, stamped = Random(5), "ros2_vision_interfaces/msg/StampedString"
    kinds = [("/said", "std_msgs/msg/String"), ("/said", stamped), ("/heard", stamped)]
    messages: list[Msg] = []
    for beat in range(40):
        at = AT + beat // 4 * NS_PER_S
        messages += (Msg(*kind, at, draw.randbytes(9), at - 5) for kind in draw.sample(kinds, 2))
        messages.append(text(AT + beat * NS_PER_S + 7, "alone", topic="/alone"))
    write_mcap(tmp_path / "bags" / "r0" / "one_0.mcap", messages)
    on_robot = robot_bags("hall", tmp_path / "bags")
    assert ship(tmp_path / "lake", [on_robot]).bags == 1
    bags, robot = on_robot.memory, lake_robot(tmp_path / "lake")
    [bag], [other] = bags.index.snapshot().bags, robot.index.snapshot().bags
    for topics, newest in product((["/said"], ["/said", "/heard", "/alone"]), (False, True)):
        found = robot.reader.records(other.path, topics, EVERYTHING, newest_first=newest)
        assert [*found] == [*bags.reader.records(bag.path, topics, EVERYTHING, newest_first=newest)]
    # Where no channel shares a log time with another, no place is stored.
    rows = {row["topic"]: row["packed"] for row in lake_rows(tmp_path / "lake", "channels")}
    assert decompress(rows["/alone"])[0] == 1
    assert decompress(rows["/said"])[0] == 2


def test_damaged_and_later_bytes_are_refused() -> None:
    times, none = np.array([1, 2]), np.array([], np.int64)
    data = packed_messages(times, times, [b"ab", b"cd"])
    batch = unpacked_messages(data, CHANNEL)
    assert [batch.payload(nth) for nth in range(2)] == [b"ab", b"cd"]
    assert not unpacked_messages(packed_messages(none, none, []), CHANNEL).log_times.size
    for other in (data[:-3], b"", data[::-1]):
        with pytest.raises(ValueError, match="packed"):
            unpacked_messages(other, CHANNEL)

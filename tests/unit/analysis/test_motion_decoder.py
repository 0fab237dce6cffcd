"""Motion decoded from many messages at once is that of each of them alone."""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING

import pytest

from ros2_memory.analysis.bulk_decode import MotionSample, motion_decoder
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, header, make, odom, quaternion, text, write_mcap
from tests.support.memories import extractor

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.storage.base import Record

T0 = 1_700_000_000 * 10**9


class Counting(McapReader):
    """Counts the messages that are decoded."""

    decoded = 0

    def decode(self, record: Record) -> object:
        self.decoded += 1
        return super().decode(record)


def alone(reader: McapReader, record: Record) -> MotionSample | None:
    """What a message says, decoded; None where it cannot be."""
    try:
        message = reader.decode(record)
    except UndecodableError:
        return None
    twist = extractor().twist(message, record.channel.type)
    speed = None if twist is None else math.hypot(*twist.linear)
    return MotionSample(extractor().pose(message, record.channel.type), speed)


def assert_seen_as_alone(tmp_path: Path, messages: list[Msg]) -> None:
    path = write_mcap(tmp_path / "bag.mcap", messages)
    reader = McapReader()
    topic = messages[0].topic
    records = list(reader.records(path, [topic], TimeWindow.everything()))
    assert len(records) == len(messages)
    decoder = motion_decoder(reader, extractor())
    half = len(records) // 2
    seen = [*decoder.decode(records[:half]), *decoder.decode(records[half:])]
    expected = [alone(reader, record) for record in records]
    # By their text, since NaN is not equal to itself.
    assert [repr(None if isinstance(s, UndecodableError) else s) for s in seen] == [
        repr(each) for each in expected
    ]


@pytest.mark.parametrize("seed", range(8))
def test_poses_are_those_of_the_decoded_messages(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    frames = ["odom"] * 20 + ["map", "a_longer_frame"]
    messages = []
    for n in range(draw.randint(2, 400)):
        x = draw.choice([draw.uniform(-2, 2), draw.uniform(-2, 2), math.nan, 1e300])
        said = odom(T0 + n, x, 1.0, draw.uniform(-3, 3), vx=draw.choice([0.3, math.inf]))
        said.body.header.frame_id = draw.choice(frames)  # type: ignore[attr-defined]
        if draw.random() < 0.05:
            said.body.pose.pose.orientation = quaternion(0.0)  # type: ignore[attr-defined]
            said.body.pose.pose.orientation.w = 0.0  # type: ignore[attr-defined]
        if draw.random() < 0.02:
            said = Msg("/odom", "nav_msgs/msg/Odometry", T0 + n, b"\x00\x01\x00\x00\xff\xff\xff")
        messages.append(said)
    assert_seen_as_alone(tmp_path, messages)


def test_messages_without_a_pose_have_none(tmp_path: Path) -> None:
    assert_seen_as_alone(tmp_path, [text(T0 + n, "no pose") for n in range(120)])


def test_poses_of_another_type_are_found_by_the_same_paths(tmp_path: Path) -> None:
    def stamped(n: int) -> Msg:
        place = make("geometry_msgs/msg/Point", x=float(n), y=0.5, z=0.0)
        pose = make("geometry_msgs/msg/Pose", position=place, orientation=quaternion(0.1 * n))
        body = make("geometry_msgs/msg/PoseStamped", header=header(T0 + n, "map"), pose=pose)
        return Msg("/pose", "geometry_msgs/msg/PoseStamped", T0 + n, body)

    assert_seen_as_alone(tmp_path, [stamped(n) for n in range(150)])


def test_of_many_alike_few_are_decoded(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "bag.mcap", [odom(T0 + n, n / 9, 1.0) for n in range(500)])
    reader = Counting()
    decoder = motion_decoder(reader, extractor())
    records = list(reader.records(path, ["/odom"], TimeWindow.everything()))
    assert len(decoder.decode(records)) == 500
    assert reader.decoded < 10

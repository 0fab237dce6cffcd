"""Messages decoded by a template give what they give one by one."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.analysis.payload_templates import template_for
from ros2_memory.catalogue.digest import Digester
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.insights.sightings import find_matches
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    Msg,
    detections,
    header,
    make,
    odom,
    quaternion,
    text,
    tf,
    transform,
    twist,
    write_mcap,
)
from tests.support.memories import extractor, memory_of

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.core.model import JsonValue
    from ros2_memory.storage.base import CdrLayout, Record

S = 10**9
T0 = 1_700_000_000 * S

ODD = (math.nan, math.inf, -math.inf, 1e300, 0.0)


class OneByOne(McapReader):
    """Tells no layout, so that every message is decoded."""

    def layout(self, record: Record) -> CdrLayout | None:
        return None


def both(path: Path) -> tuple[Digest, Digest]:
    readers = (McapReader(), OneByOne())
    at_once, singly = (Digester(reader, extractor()).digest(path) for reader in readers)
    return at_once, singly


def assert_alike(path: Path) -> None:
    for at_once, singly in zip(*(each.topics for each in both(path)), strict=True):
        assert at_once.topic == singly.topic
        assert at_once.edges == singly.edges
        assert at_once.kept == singly.kept


@pytest.mark.parametrize("seed", range(12))
def test_a_bag_has_the_same_digest_either_way(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    messages: list[Msg] = []
    for n in range(draw.randint(40, 120)):
        at = T0 + n * S // 20
        x = draw.choice([draw.uniform(-2, 2), draw.uniform(-2, 2), math.nan, 90.0])
        messages.append(odom(at, x, 1.0, draw.uniform(-3, 3), vx=draw.choice([0.3, math.nan])))
        child = draw.choice(["base_link", "base_link", "arm"])
        messages.append(tf(at, transform(at, "odom", child, (x, 0.0, 0.0), 0.2)))
        speed = make("geometry_msgs/msg/Twist", **vars(twist(x, 0.1)))
        messages.append(Msg("/cmd_vel", "geometry_msgs/msg/Twist", at, speed))
        labels = draw.choice([["cup"], ["cup", "person"]])
        messages.append(detections(at, labels, at=(x, 0.0, draw.choice([0.0, math.nan]))))
        messages.append(text(at, draw.choice(["a", "b"])))
        if draw.random() < 0.02:
            broken = b"\x00\x01\x00\x00\xff\xff\xff\x7f"
            messages.append(Msg("/chatter", "std_msgs/msg/String", at, broken))
    assert_alike(write_mcap(tmp_path / "bag.mcap", messages))


@pytest.mark.parametrize("seed", range(4))
def test_a_position_is_found_in_the_same_messages_either_way(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    messages: list[Msg] = []
    for n in range(150):
        at = T0 + n * S
        x, y = draw.uniform(-2, 2), draw.choice([0.0, 1.0, *ODD])
        messages.append(odom(at, x, y, vx=0.3))
        labels = draw.choice([["cup"], ["cup", "person"], []])
        messages.append(detections(at, labels, at=(x, 0.5, draw.choice([0.0, math.nan]))))
        child = draw.choice(["base_link", "arm"])
        messages.append(tf(at, transform(at, "odom", child, (x, y, 0.0), 0.2)))
    write_mcap(tmp_path / "a" / "a_0.mcap", messages)
    near: list[JsonValue] = [{"x": 0.3, "y": 0.4}, {"x": 0.0, "y": 1.0, "z": 0.0}]
    far: JsonValue = {"x": 50.0, "y": 0.0}
    for place in (*near, far):
        at_once, singly = (
            # Extractors of their own: what is known of messages is known for an extractor.
            replace(memory_of(tmp_path, reader=reader), extractor=extractor.__wrapped__())
            for reader in (McapReader(), OneByOne())
        )
        found = [
            find_matches(each, Call(), "/*", "near_position", place, limit=200)
            for each in (at_once, singly)
        ]
        assert found[0].sightings == found[1].sightings
        assert found[0].total == found[1].total
        assert bool(found[0].sightings) == (place is not far)


def test_a_transform_that_is_valid_in_some_messages_only_is_not_lost(tmp_path: Path) -> None:
    nowhere = transform(T0, "odom", "base_link", (math.nan, 0.0, 0.0))
    somewhere = transform(T0, "odom", "base_link", (1.0, 0.0, 0.0))
    for first, later in ((nowhere, somewhere), (somewhere, nowhere)):
        messages = [tf(T0 + n, later if n > 5 else first) for n in range(60)]
        path = write_mcap(tmp_path / "bag.mcap", messages)
        assert_alike(path)
        [topic] = both(path)[0].topics
        assert topic.edges is not None
        assert topic.edges.pairs == (("odom", "base_link"),)


def first_record(tmp_path: Path, *messages: Msg) -> tuple[McapReader, Record]:
    path = write_mcap(tmp_path / "bag.mcap", messages)
    reader = McapReader()
    return reader, next(reader.records(path, [messages[0].topic], TimeWindow.everything()))


def test_the_numbers_of_an_odometry_are_found_where_they_lie(tmp_path: Path) -> None:
    reader, record = first_record(tmp_path, odom(T0, 1.5, -2.5, 0.5, vx=0.25))
    template = template_for(reader, extractor(), record)
    assert template is not None
    _, rows = template.matching(record, [record], [0])
    assert template.frame_id == "odom"
    [pose] = template.poses(rows)
    assert pose is not None
    assert pose.position == (1.5, -2.5, 0.0)
    assert pose.orientation == pytest.approx((0.0, 0.0, math.sin(0.25), math.cos(0.25)), abs=1e-12)
    assert template.speeds(rows) == [0.25]


def test_messages_that_differ_in_more_than_numbers_do_not_match_a_template(tmp_path: Path) -> None:
    reader, record = first_record(tmp_path, odom(T0, 1.0, 0.0))
    template = template_for(reader, extractor(), record)
    assert template is not None
    payload = record.payload.replace(b"odom", b"abcd")
    others = [record, record._replace(payload=payload), record._replace(payload=payload[:-8])]
    chosen, rows = template.matching(record, others, [0, 1, 2])
    assert (chosen, len(rows)) == ([0], 1)


def test_a_message_without_a_layout_has_no_template(tmp_path: Path) -> None:
    reader, record = first_record(tmp_path, text(T0, "no numbers in it"))
    assert (
        template_for(reader, extractor(), record._replace(payload=record.payload + b"12345678"))
        is None
    )
    big_endian = record._replace(payload=b"\x00\x00" + record.payload[2:])
    assert reader.layout(big_endian) is None


def test_templates_that_are_remembered_change_no_digest(tmp_path: Path) -> None:
    def bag(name: str, frame: str, x: float) -> Path:
        messages = [
            each
            for n in range(40)
            for at in [T0 + n * S // 20]
            for each in (
                odom(at, x + n / 7, 1.0, n / 10),
                tf(at, transform(at, frame, "base_link", (x, n / 3, 0.0), 0.2)),
                text(at, frame),
            )
        ]
        return write_mcap(tmp_path / name, messages)

    paths = [bag("a.mcap", "odom", 1.0), bag("b.mcap", "moda", 2.0), bag("c.mcap", "odom", 3.0)]
    remembering = Digester(McapReader(), extractor())
    for path in paths:
        alone = Digester(McapReader(), extractor())
        assert remembering.digest(path).topics == alone.digest(path).topics


def test_a_pose_array_has_a_template(tmp_path: Path) -> None:
    def poses(n: int) -> Msg:
        held = [
            make(
                "geometry_msgs/msg/Pose",
                position=make("geometry_msgs/msg/Point", x=float(n), y=float(k), z=0.0),
                orientation=quaternion(0.1),
            )
            for k in range(3)
        ]
        body = make("geometry_msgs/msg/PoseArray", header=header(T0, "map"), poses=held)
        return Msg("/poses", "geometry_msgs/msg/PoseArray", T0 + n, body)

    path = write_mcap(tmp_path / "bag.mcap", [poses(n) for n in range(60)])
    assert_alike(path)


def test_a_message_without_numbers_has_a_template_too(tmp_path: Path) -> None:
    same = [replace(text(T0 + n, "same")) for n in range(60)]
    path = write_mcap(tmp_path / "bag.mcap", same)
    assert_alike(path)

"""Messages written as JSON many at once have the text and the pose of each of them alone."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.bulk_decode import JsonRow, JsonRows
from ros2_memory.core.errors import UndecodableError
from ros2_memory.extract import SchemaExtractor
from ros2_memory.storage.base import Channel, Record, Schema
from ros2_memory.storage.decoding import Decoding
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    Msg,
    battery,
    definition,
    header,
    make,
    odom,
    quaternion,
    text,
    tf,
    transform,
    vector3,
)
from tests.support.examples import examples
from tests.support.memories import extractor

if TYPE_CHECKING:
    from collections.abc import Sequence

T0 = 1_700_000_000 * 10**9
MANY = 40
"""Enough for a template to be looked for, and to pay."""
THINNING = SchemaExtractor({}, max_array_length=3)
"""Shows all fields of a message, and of arrays three values."""
LIKE_A_HOLE = "7390154826180273645991208463517"

number = st.one_of(
    st.floats(), st.floats(-5, 5), st.sampled_from([0.0, -0.0, 0.5, 1e-9, 1e15, 1e300, 2.5e-5])
)
single = st.floats(width=32)
moment = st.integers(0, 2**31 - 1).map(lambda ms: T0 + ms * 1_234_567)


def jointed(ns: int, places: Sequence[float], name: str) -> Msg:
    body = make(
        "sensor_msgs/msg/JointState",
        header=header(ns, "base"),
        name=[name],
        position=np.array(places),
        velocity=np.zeros(0),
        effort=np.array([0.1]),
    )
    return Msg("/joints", "sensor_msgs/msg/JointState", ns, body)


def singles(ns: int, data: Sequence[float]) -> Msg:
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    body = make(
        "std_msgs/msg/Float32MultiArray", layout=layout, data=np.array(data, dtype=np.float32)
    )
    return Msg("/singles", "std_msgs/msg/Float32MultiArray", ns, body)


def magnetic(ns: int, x: float) -> Msg:
    body = make(
        "sensor_msgs/msg/MagneticField",
        header=header(ns, "imu"),
        magnetic_field=vector3(x, 0.0, x),
        magnetic_field_covariance=np.zeros(9),
    )
    return Msg("/magnet", "sensor_msgs/msg/MagneticField", ns, body)


def turned(ns: int, numbers: tuple[float, float, float, float]) -> Msg:
    rotation = quaternion(0.0)
    for name, each in zip("xyzw", numbers, strict=True):
        setattr(rotation, name, each)
    body = make(
        "geometry_msgs/msg/QuaternionStamped", header=header(ns, "m%sp"), quaternion=rotation
    )
    return Msg("/turned", "geometry_msgs/msg/QuaternionStamped", ns, body)


kinds = st.sampled_from(
    [
        st.builds(odom, moment, number, number, st.floats(-5, 5), vx=number),
        st.builds(
            lambda ns, x: tf(ns, transform(ns, "map", "odom", (x, x, 0.0), 0.1)), moment, number
        ),
        st.builds(battery, moment, single),
        st.builds(jointed, moment, st.lists(number, min_size=5, max_size=5), st.just("10 % 'ü\"'")),
        st.builds(jointed, moment, st.tuples(st.sampled_from([0.0, -0.0])), st.just("zero")),
        st.builds(jointed, moment, st.just([0.25] * 2), st.just(f"{LIKE_A_HOLE}0000")),
        st.builds(singles, moment, st.lists(single, min_size=7, max_size=7)),
        st.builds(magnetic, moment, number),
        st.builds(turned, moment, st.tuples(number, number, number, number)),
        st.builds(text, moment, st.sampled_from(["a", "b\\", "ü"])),
    ]
)


def record_of(message: Msg, channels: dict[str, Channel]) -> Record:
    schema = Schema(message.type, "ros2msg", definition(message.type).encode())
    channel = channels.setdefault(message.topic, Channel(message.topic, "cdr", schema))
    return Record(channel, message.log_time, message.log_time, message.payload)


def alone(record: Record, extract: SchemaExtractor) -> JsonRow:
    message, type_name = DECODING.decode(record), record.channel.type
    shown = json_of(extract.shown(message, type_name).value)
    return JsonRow(shown, extract.pose(message, type_name))


def json_of(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


DECODING = Decoding()


def assert_said_as_alone(some: Sequence[Msg]) -> None:
    """Repeated, since what counts is that the numbers differ, not how many do."""
    channels: dict[str, Channel] = {}
    records = [record_of(some[nth % len(some)], channels) for nth in range(MANY)]
    for extract in (extractor(), THINNING):
        rows = JsonRows(McapReader(), extract)
        found = [*rows.of(records[:35]), *rows.of(records[35:])]
        # By their text, since NaN is not equal to itself.
        expected = [alone(record, extract) for record in records]
        assert list(map(repr, found)) == list(map(repr, expected))


@settings(max_examples=examples(60), deadline=None)
@given(data=st.data())
def test_many_say_what_each_says_alone(data: st.DataObject) -> None:
    chosen = [data.draw(kinds) for _ in range(data.draw(st.integers(1, 2)))]
    some = [data.draw(each) for each in chosen for _ in range(data.draw(st.integers(1, 6)))]
    assert_said_as_alone(some)


def test_what_is_written_otherwise_than_most_numbers() -> None:
    nan = float("nan")
    for odd in (
        [jointed(T0, (each,), "zero") for each in (0.0, -0.0)],
        [jointed(T0, (each,), "none") for each in (1.0, nan, -float("inf"))],
        [turned(T0, (0.0, 0.0, 0.0, each)) for each in (1.0, 0.0, nan)],
        [turned(T0, (0.0, 0.7071, 0.0, each)) for each in (0.7071, 0.8)],
        [singles(T0, [each] * 7) for each in (0.1, 1e-7, 3e38)],
    ):
        assert_said_as_alone(odd)


def test_one_that_cannot_be_decoded_says_why_and_spoils_no_other() -> None:
    channels: dict[str, Channel] = {}
    records = [record_of(odom(T0 + n, n / 7, 1.0), channels) for n in range(50)]
    records[20] = records[20]._replace(payload=b"\x00\x01\x00\x00\xff\xff\xff\x7f")
    found = JsonRows(McapReader(), extractor()).of(records)
    assert isinstance(found[20], UndecodableError)
    assert found[20].reason
    others = [each for each in found if isinstance(each, JsonRow)]
    assert [each.pose.position[0] for each in others if each.pose] == [
        n / 7 for n in range(50) if n != 20
    ]


def test_of_many_alike_few_are_decoded() -> None:
    class Counting(McapReader):
        decoded = 0

        def decode(self, record: Record) -> object:
            self.decoded += 1
            return super().decode(record)

    channels: dict[str, Channel] = {}
    records = [record_of(odom(T0 + n, n / 7, 1.0, 0.01 * n), channels) for n in range(200)]
    reader = Counting()
    rows = JsonRows(reader, extractor())
    assert len({each.text for each in rows.of(records) if isinstance(each, JsonRow)}) == 200
    assert reader.decoded < 10

"""Messages as JSON: exactly, and short, thinned and rounded for a reply; and what is converted."""

import json
import math
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.model import JsonValue
from ros2_memory.messages.conversions import ABSENT, descend, view, xyz
from ros2_memory.messages.to_json import (
    MAX_DEPTH,
    ExactJson,
    ReplyJson,
    round_integer,
    round_real,
    round_single,
)
from tests.support import bags
from tests.support.memories import asked, remembered

S = 10**9
T0 = 1_784_000_000 * S


def shown(node: object, limit: int = 50, path: str = "") -> tuple[JsonValue, tuple[str, ...]]:
    rendering = ReplyJson(limit)
    return rendering.value(node, path), rendering.notes


def exact(node: object, limit: int = 50) -> JsonValue:
    return ExactJson(limit).value(node, "")


def test_a_covariance_of_zeros_is_left_out_unless_it_is_asked_for(tmp_path: Path) -> None:
    """Zeros say that it is not known."""
    unknown, known = bags.odom(T0, 1.0), bags.odom(T0 + S, 1.0)
    known.body.pose.covariance[:] = np.arange(36.0)  # type: ignore[attr-defined]
    memory = remembered(tmp_path, [unknown, known])
    ask = partial(asked, memory, "get_topic_at_time", topic="/odom", tolerance_s=0)
    fields = {"fields": ["pose", "pose.covariance[1]"]}
    zeros, numbers = (ask(timestamp=(T0 + n * S) / S, **fields)["value"] for n in (0, 1))
    assert (zeros["pose"].keys(), zeros["pose.covariance.1"]) == ({"pose"}, 0)
    assert (numbers["pose"]["covariance"], numbers["pose.covariance.1"]) == ([*range(36)], 1)


WIDTHS = (np.float16(0.5), np.longdouble(0.5), np.float64(0.5))


@pytest.mark.parametrize(
    ("node", "short", "whole"),
    [
        (math.nan, "null", "NaN"),
        (np.float64(math.inf), "null", "Infinity"),
        (np.array([1.0, math.inf], dtype=np.float32), "[1, null]", "[1.0, Infinity]"),
        *((number, "0.5", "0.5") for number in WIDTHS),
        *((np.array([number]), "[0.5]", "[0.5]") for number in WIDTHS),
        ([np.int32(-3), np.uint64(2**64 - 1)], f"[-3, {2**64 - 1}]", f"[-3, {2**64 - 1}]"),
        (np.float32(0.1), "0.1", "0.10000000149011612"),
        (np.bool_(True), "true", "true"),
        (np.array([[1, 2], [3, 4]]), "[[1, 2], [3, 4]]", "[[1, 2], [3, 4]]"),
        (np.array([[1.5, 2]]), "[[1.5, 2]]", "[[1.5, 2.0]]"),
        # Bytes are numbers while they are few.
        (b"\x01\x02", "[1, 2]", "[1, 2]"),
        (np.arange(50, dtype=np.uint8), str([*range(50)]), str([*range(50)])),
        (np.arange(51, dtype=np.uint8), '{"bytes": 51}', '{"bytes": 51}'),
        (bytes(51), '{"bytes": 51}', '{"bytes": 51}'),
    ],
    ids=count(),
)
def test_values_of_numpy_become_json(node: object, short: str, whole: str) -> None:
    assert (json.dumps(shown(node)[0]), json.dumps(exact(node))) == (short, whole)
    assert shown(node)[1] == ()


def test_nesting_beyond_reason_is_cut_with_a_note() -> None:
    node: object = "deep"
    for _ in range(1000):
        node = [node]
    value, notes = shown(node, path="a")
    assert json.dumps(value).count("[") == MAX_DEPTH
    assert notes == (f"a: parts deeper than {MAX_DEPTH} levels are left out",)
    assert json.dumps(exact(node)).count("[") == MAX_DEPTH


def test_squeezed_long_objects_lose_their_last_entries_with_a_note() -> None:
    rendering = ReplyJson(2, squeeze=2)
    assert rendering.value({"a": {"b": 1, "c": 2, "d": 3}}, "") == {"a": {"b": 1, "c": 2}}
    assert rendering.notes == ("a: the first 2 of 3 entries",)


numbers = st.one_of(
    st.floats(),
    st.integers(),
    st.floats(width=32).map(np.float32),
    st.integers(0, 255).map(np.uint8),
    st.just(10**4000),
)

arrays = st.one_of(
    st.lists(st.floats(width=32), max_size=40).map(lambda v: np.array(v, dtype=np.float32)),
    st.lists(st.floats(), max_size=40).map(lambda v: np.array(v, dtype=np.float64)),
    st.lists(st.integers(0, 255), max_size=40).map(lambda v: np.array(v, dtype=np.uint8)),
    st.lists(st.integers(-128, 127), max_size=40).map(lambda v: np.array(v, dtype=np.int8)),
    st.lists(st.booleans(), max_size=40).map(lambda v: np.array(v, dtype=np.bool_)),
    st.integers(0, 12).map(lambda n: np.full((n, 2, 3), math.nan)),
)

parts = st.one_of(st.floats(), st.just(0.0))

geometry = st.one_of(
    st.builds(bags.vector3, parts, parts, parts),
    st.builds(
        lambda x, y, z, w: bags.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        parts, parts, parts, parts,
    ),
    st.integers(0, 2**62).map(bags.stamp),
)  # fmt: skip

texts = st.text(st.characters(codec=None, exclude_categories=()))

leaves = st.one_of(
    st.none(), st.booleans(), numbers, texts, st.binary(max_size=40), arrays, geometry
)

values = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.lists(inner, max_size=12),
        st.tuples(inner, inner),
        st.dictionaries(texts, inner, max_size=5),
        st.builds(lambda a, b: SimpleNamespace(a=a, b=b), inner, inner),
    ),
)


def longest_list(value: JsonValue) -> int:
    if isinstance(value, list):
        return max([len(value), *(longest_list(one) for one in value)])
    if isinstance(value, dict):
        return max([0, *(longest_list(one) for one in value.values())])
    return 0


@given(values, st.integers(1, 8))
def test_any_message_becomes_strict_json_within_the_limit(node: object, limit: int) -> None:
    value, notes = shown(node, limit)
    text = json.dumps(value, allow_nan=False, ensure_ascii=False)
    assert json.loads(text.encode("utf-8")) == value
    assert longest_list(value) <= limit
    assert len(set(notes)) == len(notes)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_float32_is_read_back_from_what_leaves(number: float) -> None:
    for left in (round_real(number), round_single(np.float32(number))):
        assert isinstance(left, int | float)
        assert np.float32(left) == np.float32(number)


@given(st.integers(1, 99_999), st.integers(2, 6))
def test_a_float32_leaves_as_the_decimal_that_was_written(digits: int, decimals: int) -> None:
    written = digits / 10**decimals
    assert round_real(float(np.float32(written))) == written


@given(st.floats(-360, 360, allow_nan=False))
def test_an_angle_on_the_globe_keeps_a_hundred_millionth_of_a_degree(degrees: float) -> None:
    left = round_real(degrees)
    assert isinstance(left, int | float)
    half_a_float32 = abs(degrees) * 2**-24 if float(np.float32(degrees)) == degrees else 0.0
    assert abs(left - degrees) <= max(1e-8, half_a_float32)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_any_finite_number_keeps_ten_digits_and_a_microsecond(number: float) -> None:
    left = round_real(number)
    assert isinstance(left, int | float)
    if float(np.float32(max(min(number, 1e38), -1e38))) != number:
        assert abs(left - number) <= max(abs(number) * 1e-10, 5e-324)
        assert abs(left - number) <= 5.1e-7


def test_ints_of_64_bits_leave_as_they_are_and_longer_ones_as_floats() -> None:
    assert round_integer(2**64 - 1) == 2**64 - 1
    assert round_integer(-(2**63)) == -(2**63)
    assert round_integer(10**30) == 1e30
    assert round_integer(10**5000) is None


@pytest.mark.parametrize(
    ("encoding", "channels"),
    [
        *(("rgb8", 3), ("bgr16", 3), ("rgba8", 4), ("bgra8", 4), ("mono8", 1), ("16UC1", 1)),
        *(("32FC3", 3), ("bayer_rggb8", 1), ("yuv422", None), ("", None)),
    ],
)
def test_an_image_is_its_size_encoding_and_shape(encoding: str, channels: int | None) -> None:
    image = bags.make(
        "sensor_msgs/msg/Image",
        header=bags.header(0, "camera"),
        height=2,
        width=4,
        encoding=encoding,
        is_bigendian=0,
        step=12,
        data=np.zeros(24, dtype=np.uint8),
    )
    shape = [2, 4, channels] if channels else [2, 4]
    assert view(image, "data") == {"bytes": 24, "encoding": encoding, "shape": shape}


@pytest.mark.parametrize(
    "node", [None, [1.0, 2.0, 3.0], {"x": True, "y": 2.0, "z": 3.0}, {"x": 10**400, "y": 2, "z": 3}]
)
def test_what_is_not_shaped_like_a_point_is_none(node: object) -> None:
    assert xyz(node) is None


def test_the_numbers_of_an_array_are_reached_by_number_and_have_no_fields() -> None:
    scan = SimpleNamespace(ranges=np.array([1.5, 2.5]), none=np.zeros(0))
    assert descend(scan, ("ranges", "1")) == 2.5
    assert descend(scan, ("ranges", "size")) is ABSENT
    assert descend(scan, ("none", "x")) == []

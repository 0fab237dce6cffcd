"""Extracted values as trees over columns: the same leaves as in each extracted value."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.columns.shown import Constant, Node, Shape, numbers
from ros2_memory.columns.values import (
    ROWS,
    Conversion,
    Kind,
    Leaf,
    UnknownShapeError,
    Values,
    placed,
    seconds,
)
from ros2_memory.core.model import JsonValue, Quaternion
from ros2_memory.core.timebase import MAX_NS, MIN_NS, unix_from_ns
from ros2_memory.counts.numbers import numbers_in
from ros2_memory.extract import SchemaExtractor
from ros2_memory.messages.conversions import ANGLES, Summary, euler_of
from tests.support.bags import make
from tests.support.examples import examples
from tests.support.memories import shipped_extractor
from tests.unit.columns.drawn_tables import (
    Drawn,
    drawn_of,
    drawn_tables,
    message,
    paths_of,
)

EXTRACTOR = shipped_extractor()
RANDOM = st.randoms(use_true_random=False)
FULL_PATHS = (
    "header.stamp",
    "header.stamp.sec",
    "pose.pose.orientation",
    "pose.pose.orientation.w",
    "twist.twist.linear.x",
    "transforms.transform.rotation",
    "poses.pose.orientation.w",
    "detections.point",
    "turns",
    "turn.x",
    "data",
    "q",
    "q.0",
    "nothing",
)
ODOMETRY = "nav_msgs/msg/Odometry"


def named_leaves(value: JsonValue, path: str = "") -> Iterator[tuple[str, object]]:
    """The leaves of a value, with their paths; null and NaN, and sizes of arrays, are left out."""
    if isinstance(value, Summary):
        value = {name: part for name, part in value.items() if isinstance(part, str)}
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from named_leaves(inner, f"{path}.{name}" if path else name)
    elif isinstance(value, list):
        for inner in value:
            yield from named_leaves(inner, path)
    elif value is not None and not (isinstance(value, float) and math.isnan(value)):
        yield path, value


def paths_in(node: Node, path: str = "") -> Iterator[tuple[str, Leaf]]:
    """The leaves of a tree, with their paths; sizes of arrays are left out."""
    if isinstance(node, Leaf):
        yield path, node
    elif isinstance(node, dict):
        for name, inner in node.items():
            if not isinstance(node, Summary) or isinstance(inner, Leaf):
                yield from paths_in(inner, f"{path}.{name}" if path else name)
    elif not isinstance(node, Constant):
        for inner in node:
            yield from paths_in(inner, path)


def read_leaves(drawn: Drawn, extractor: SchemaExtractor) -> list[Counter[tuple[str, object]]]:
    """The leaves of each message as the columns hold them."""
    assert drawn.table.definition is not None
    values = Values(drawn.table)
    found: list[Counter[tuple[str, object]]] = [Counter() for _ in drawn.messages]
    shape = Shape(drawn.table.definition, drawn.type, extractor)
    for path, leaf in paths_in(shape.value):
        try:
            column, size = column_of(values, leaf), values.size(leaf.level)
        except UnknownShapeError:
            continue
        if not values.holds_all(leaf):
            continue
        kept, rows = placed(values, leaf.level, np.arange(size), leaf.limits, surely=True)
        for at, row in zip(kept.tolist(), rows.tolist(), strict=True):
            if column[at] == column[at]:
                found[row][path, column[at]] += 1
    return found


def column_of(values: Values, leaf: Leaf) -> Sequence[object]:
    if leaf.kind is Kind.TEXT:
        return values.texts(leaf).values()
    known = values.numbers(leaf)
    if known.exactly is not None:
        return known.exactly(np.arange(len(known.values))).tolist()
    return known.values.tolist()


@pytest.mark.parametrize("limit", [50, 2])
@settings(max_examples=examples(40), deadline=None)
@given(drawn=drawn_tables())
def test_leaves_of_columns_are_those_of_extracted_values(limit: int, drawn: Drawn) -> None:
    extractor = shipped_extractor(limit)
    for message_, found in zip(drawn.messages, read_leaves(drawn, extractor), strict=True):
        expected = Counter(named_leaves(extractor.exact(message_, drawn.type)))
        assert not found - expected
        if not drawn.table.left_out:
            assert not expected - found


@settings(max_examples=examples(90), deadline=None)
@given(drawn_tables(), RANDOM)
def test_numbers_of_a_field_are_those_of_each_message(drawn: Drawn, random: Random) -> None:
    value = EXTRACTOR.exact(drawn.messages[0], drawn.type)
    for field in (random.choice([*paths_of(value), "nothing"]), random.choice(FULL_PATHS)):
        found = numbers(drawn.table, field, EXTRACTOR)
        if found is None:
            continue
        assert found.rows.tolist() == sorted(found.rows.tolist())
        for row, message_ in enumerate(drawn.messages):
            expected = sorted(numbers_in(EXTRACTOR.exact_at(message_, drawn.type, field)))
            own = sorted(found.numbers[found.rows == row].tolist())
            assert own == pytest.approx(expected, abs=found.error, rel=0.0), field


@given(st.lists(st.integers(MIN_NS, MAX_NS) | st.integers(-(2**54), 2**54), min_size=1))
def test_seconds_are_rounded_as_those_of_each_message(times: list[int]) -> None:
    found = seconds(np.array(times, np.int64))
    assert found.tolist() == [unix_from_ns(time) for time in times]


PART = st.sampled_from([0.0, 1.0, -1.0, math.sqrt(0.5), 1e-9, 1e200, math.nan]) | st.floats(-1, 1)
TURNS = st.lists(st.tuples(PART, PART, PART, PART), min_size=1, max_size=20)


def turned(parts: list[Quaternion], error: float) -> list[list[tuple[float, float]]]:
    """Roll, pitch and yaw of quaternions that are off by so much, each with its error."""
    kind = "geometry_msgs/msg/Quaternion"
    table = drawn_of(kind, [make(kind, x=x, y=y, z=z, w=w) for x, y, z, w in parts]).table
    values = Values(table)
    values.error = lambda leaf: error  # type: ignore[method-assign]
    found = []
    for made in (Conversion.ROLL, Conversion.PITCH, Conversion.YAW):
        known = values.numbers(Leaf(ROWS, ("x", "y", "z", "w"), Kind.REAL, made))
        off = np.broadcast_to(known.error, known.values.shape)
        found.append([*zip(known.values.tolist(), off.tolist(), strict=True)])
    return found


@given(TURNS, st.sampled_from([0.0, 1e-6, 1e-4, 1e-3]), st.integers(0, 2**32))
def test_angles_of_rounded_quaternions_are_off_by_less_than_they_say(
    parts: list[Quaternion], error: float, seed: int
) -> None:
    random = Random(seed)
    moved = [
        tuple(part + random.uniform(-error, error) for part in quaternion) for quaternion in parts
    ]
    for name, column in zip(ANGLES, turned(moved, error), strict=True):  # type: ignore[arg-type]
        for quaternion, (value, off) in zip(parts, column, strict=True):
            angles = euler_of(quaternion)
            if angles is not None and math.isfinite(off):
                assert abs(value - angles[name]) <= off


def test_a_mapped_path_that_leads_into_times_is_left_to_the_bag() -> None:
    extractor = SchemaExtractor({ODOMETRY: {"second": "header.stamp.sec"}}, 50)
    table = drawn_of(ODOMETRY, [message(ODOMETRY, Random(1))]).table
    assert numbers(table, "second", extractor) is None

"""What is stored of the numbers of fields: bounds that leave nothing out, and exact sums."""

from __future__ import annotations

import json
import math
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import Beyond, Condition, Equals
from ros2_memory.analysis.field_ranges import (
    MAX_FIELDS,
    FieldRangesBuilder,
    field_named,
    joined,
)
from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.field_columns import encode_field_ranges, field_column, outward
from ros2_memory.catalogue.lookup import FieldBounds
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, battery, command, detections, odom, write_mcap
from tests.support.memories import shipped_extractor
from tests.support.strategies import json_values

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.analysis.field_ranges import FieldRange
    from ros2_memory.core.model import JsonValue

S = 10**9
BEGIN = 1_784_000_000 * S
numbers = st.one_of(
    st.floats(),
    st.integers(-3, 3),
    st.sampled_from([0.1, 0.2, -50.0]),
    st.integers(-(10**400), 10**400),
)
bodies = st.fixed_dictionaries(
    {"x": numbers},
    optional={
        "seen": st.lists(st.fixed_dictionaries({"score": numbers}), max_size=3),
        "a.b": numbers,
        "0": st.dictionaries(st.sampled_from(["x", "1"]), numbers, max_size=2),
    },
)
values = st.lists(st.one_of(bodies, bodies, json_values), min_size=1, max_size=6)
fields = st.sampled_from(["x", "seen.score", "seen.0.score", "seen", "a.b", "0.x", "0", "nothing"])
limits = st.one_of(st.floats(allow_nan=False), st.integers(), st.sampled_from([0.1, 0.2, -50.0]))


@given(st.floats(allow_nan=False), st.sampled_from([-math.inf, math.inf]))
@example(0.0, math.inf)
@example(-0.0, -math.inf)
@example(1e-300, math.inf)
@example(1e-300, -math.inf)
@example(-1e-300, math.inf)
@example(1e39, -math.inf)
@example(-1e39, math.inf)
def test_a_bound_is_the_next_float32_outwards(number: float, towards: float) -> None:
    with np.errstate(over="ignore"):
        near = np.float32(number)
    off = float(near) > number if towards < 0 else float(near) < number
    expected = np.nextafter(near, np.float32(towards)) if off else near
    assert np.float32(outward(number, towards)).tobytes() == np.float32(expected).tobytes()


def ranges_of(some: list[JsonValue]) -> dict[str, FieldRange] | None:
    builder = FieldRangesBuilder()
    for each in some:
        builder.add(each)
    return builder.ranges()


def rows_of(*bags: list[JsonValue]) -> list[tuple[int, str | None, bytes]]:
    packed = [encode_field_ranges(ranges_of(each)) for each in bags]
    return [(7 + number, *each) for number, each in enumerate(packed)]


@given(
    st.lists(values, min_size=1, max_size=4),
    fields,
    st.one_of(st.builds(Beyond, limits, st.booleans()), st.builds(Equals, limits)),
)
@example([[{"x": 0.2}]], "x", Beyond(0.2, above=True))
@example([[{"x": 2**53 + 1}]], "x", Beyond(2**53, above=True))
def test_no_bag_is_ruled_out_that_has_a_match(
    bags: list[list[JsonValue]], field: str, test: Beyond | Equals
) -> None:
    condition = Condition(test, field)
    rows = rows_of(*bags)
    if condition.bounds is None:
        assert isinstance(test, Equals)
        assert test.value in (0, 1)
        return
    known = [row[0] for row in rows]
    bounds = FieldBounds([*known, 99], field_column(rows, field_named(field)))
    possible = bounds.between(*condition.bounds)
    matching = {
        row[0] for row, bag in zip(rows, bags, strict=True) if any(map(condition.matches, bag))
    }
    assert matching <= possible
    assert 99 in possible  # of which nothing is known


def test_a_limit_that_is_never_passed_rules_every_bag_out() -> None:
    rows = rows_of([{"x": 0.0, "y": -60.0}], [{"x": 0.5, "y": 1.0}, {"x": 0.25, "y": 2.0}])
    bounds = FieldBounds([7, 8], field_column(rows, "x"))
    for test, expected in (
        (Beyond(-50, above=False), set()),
        (Beyond(0, above=False), set()),
        (Beyond(0, above=True), {8}),
        (Beyond(0.5, above=True), set()),
        (Beyond(0.25, above=False), {7}),
        (Equals(0.3), {8}),
    ):
        limits = Condition(test, "x").bounds
        assert limits is not None
        assert bounds.between(*limits) == expected


def numbers_of(value: JsonValue, path: str = "") -> list[tuple[str, float]]:
    """Returns the field and the value of each number."""
    if isinstance(value, dict):
        inner = [(joined(path, name), each) for name, each in value.items()]
    elif isinstance(value, list):
        inner = [(path, each) for each in value]
    else:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return []
        is_huge = isinstance(value, int) and abs(value) > sys.float_info.max
        return [(path, math.copysign(math.inf, value > 0 or -1) if is_huge else float(value))]
    return [found for below, each in inner for found in numbers_of(each, below)]


@given(st.lists(values, min_size=1, max_size=4), st.sampled_from(["x", "seen.score", "nothing"]))
def test_sums_and_sizes_are_those_of_all_numbers(bags: list[list[JsonValue]], field: str) -> None:
    column = field_column(rows_of(*bags), field)
    assert column.numbers.tolist() == [7 + number for number in range(len(bags))]
    for row, bag in enumerate(bags):
        found = [number for each in bag for path, number in numbers_of(each) if path == field]
        real = [number for number in found if not math.isnan(number)]
        if real:
            assert column.low[row] <= min(real)
            assert column.high[row] >= max(real)
        if column.size[row] < 0:
            continue
        assert column.size[row] == len(real)
        # Sums of rows are numpy's, which may round once more.
        assert column.total[row] == pytest.approx(math.fsum(real), rel=1e-12, abs=1e-300)
        if column.low[row] == column.high[row]:
            assert {*real} == {column.low[row]}
        if column.each[row]:
            assert len(real) == column.each[row] * len(bag)


def test_fields_that_are_too_many_or_not_known_may_hold_anything() -> None:
    many: JsonValue = {f"f{number}": 1.0 for number in range(MAX_FIELDS + 1)}
    text, packed = encode_field_ranges(ranges_of([many]))
    column = field_column([(1, text, packed), (2, None, b"")], "f0")
    assert (column.low[0], column.high[0]) == (-math.inf, math.inf)
    # Nothing is stored of a topic without a number.
    assert column.low[1] > column.high[1]


def messages() -> list[Msg]:
    found: list[Msg] = []
    for number in range(120):
        at = BEGIN + number * S // 4
        found.append(odom(at, number / 7, -number / 3, number / 50, vx=0.1 * (number % 5)))
        found.append(battery(at + 1, 0.9 - number / 1000))
        found.append(command(at + 2, 0.0))
        found.append(detections(at + 3, ["cup", "fork"][: number % 3], score=number / 200))
    return found


def test_bulk_decoded_messages_have_the_ranges_of_those_decoded_one_by_one(tmp_path: Path) -> None:
    bag = tmp_path / "rec" / "rec_0.mcap"
    write_mcap(bag, messages())
    reader, extractor = McapReader(), shipped_extractor()
    for topic in Digester(reader, extractor, 3.0).digest(bag).topics:
        found = [
            extractor.exact(reader.decode(each), each.channel.type)
            for each in reader.records(bag, [topic.topic], TimeWindow.everything())
        ]
        expected = ranges_of(found)
        assert topic.fields is not None
        assert expected is not None
        assert topic.fields.keys() == expected.keys()
        for path, known in topic.fields.items():
            if known.size is None:
                assert path.startswith("orientation.")
                continue
            assert known._replace(total=0.0) == expected[path]._replace(total=0.0)
            assert known.total == pytest.approx(expected[path].total, rel=1e-12)


def test_ranges_of_odometry_take_few_bytes(tmp_path: Path) -> None:
    bag = tmp_path / "rec" / "rec_0.mcap"
    write_mcap(bag, messages())
    stored = {
        topic.topic: encode_field_ranges(topic.fields)
        for topic in Digester(McapReader(), shipped_extractor(), 3.0).digest(bag).topics
    }
    assert len(stored["/odom"][1]) <= 52
    assert len(stored["/cmd_vel"][1]) == 4
    paths = {path for path, *_ in json.loads(stored["/odom"][0])}
    assert {"position.x", "linear_velocity.x", "orientation.yaw_deg"} <= paths

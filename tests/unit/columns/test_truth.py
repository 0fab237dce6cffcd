"""Conditions over columns, and extracted values as trees: the same as of each decoded message."""

from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import Condition
from ros2_memory.columns.shown import numbers
from ros2_memory.columns.stored import Layout, Topic
from ros2_memory.columns.table import Table
from ros2_memory.columns.truth import ColumnCondition
from ros2_memory.columns.values import (
    TruthValues,
)
from ros2_memory.columns.zones import PartZones, Zones
from ros2_memory.core.model import JsonValue
from ros2_memory.counts.numbers import numbers_in
from ros2_memory.extract import SchemaExtractor
from ros2_memory.messages.conversions import ANGLES
from tests.support.examples import examples
from tests.support.memories import shipped_extractor
from tests.unit.columns.drawn_tables import (
    Drawn,
    condition_on,
    drawn_tables,
    paths_of,
    stored,
)

EXTRACTOR = shipped_extractor()


RANDOM = st.randoms(use_true_random=False)


def compared(found: TruthValues, condition: Condition, values: list[JsonValue]) -> int:
    """Checks what is settled; returns how many rows are not."""
    expected = np.array([condition.matches(value) for value in values])
    assert not (found.surely & found.unsure).any()
    assert found.is_none == (not (found.surely | found.unsure).any())
    wrong = np.flatnonzero((found.surely != expected) & ~found.unsure)
    assert not wrong.size, (condition, values[wrong[0]])
    return int(found.unsure.sum())


def as_part(table: Table) -> PartZones:
    """Returns what is known of a table without reading it, as of the part with the number 0."""

    def zones(path: str) -> Zones:
        zone = table.zone(path)
        known = Zones.of([], []) if zone is None else Zones.of([0], [zone])
        return known.among(np.zeros(1, np.int64))

    layout = Layout.of(table, table.definition)
    topic = Topic(table.channel, layout, lambda _: table.definition)
    return PartZones(topic, np.zeros(1, np.int64), zones)


def judged(
    table: Table,
    condition: Condition,
    values: list[JsonValue],
    extractor: SchemaExtractor = EXTRACTOR,
) -> int:
    """Checks what a table says of each of its rows, and what is ruled out without reading any."""
    column = ColumnCondition(condition, extractor)
    if not np.all(column.may_match(as_part(table))):
        assert not any(map(condition.matches, values)), condition
    return compared(column.truth(table), condition, values)


def values_of(drawn: Drawn, extractor: SchemaExtractor = EXTRACTOR) -> list[JsonValue]:
    return [extractor.exact(message, drawn.type) for message in drawn.messages]


@settings(max_examples=examples(150), deadline=None)
@given(
    drawn_tables(),
    st.sampled_from([None, None, None, 0.0, 1e-4, 0.1]),
    st.sampled_from([50, 50, 2]),
    RANDOM,
)
def test_truth_of_columns_is_that_of_each_message_or_unsure_where_they_were_rounded(
    drawn: Drawn, step: float | None, limit: int, random: Random
) -> None:
    """Also where longer arrays are only summarised."""
    extractor = shipped_extractor(limit)
    values = values_of(drawn, extractor)
    table = drawn.table if step is None else stored(drawn.table, step)
    for _ in range(4):
        judged(table, condition_on(values, random), values, extractor)


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
    *(f"orientation.{angle}" for angle in ANGLES),
)

ODOMETRY = "nav_msgs/msg/Odometry"


@settings(max_examples=examples(150), deadline=None)
@given(
    drawn_tables() | drawn_tables((ODOMETRY,)),
    st.sampled_from([None, None, 1e-6, 1e-4, 1e-3]),
    RANDOM,
)
def test_numbers_of_a_field_are_those_of_each_message_or_off_by_less_than_they_say(
    drawn: Drawn, step: float | None, random: Random
) -> None:
    """Also angles of quaternions that were rounded."""
    table = drawn.table if step is None else stored(drawn.table, step)
    value = EXTRACTOR.exact(drawn.messages[0], drawn.type)
    paths = [*dict.fromkeys(paths_of(value))]
    for field in {*random.sample(paths, min(len(paths), 20)), *FULL_PATHS}:
        found = numbers(table, field, EXTRACTOR)
        if found is None:
            continue
        assert found.rows.tolist() == sorted(found.rows.tolist())
        for row, message_ in enumerate(drawn.messages):
            expected = sorted(numbers_in(EXTRACTOR.exact_at(message_, drawn.type, field)))
            own = sorted(found.numbers[found.rows == row].tolist())
            assert own == pytest.approx(expected, abs=found.error, rel=0.0), field

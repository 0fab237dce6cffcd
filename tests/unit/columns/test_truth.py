"""What columns say of conditions, values, poses, detections and states: as decoded messages do."""

import math
from collections.abc import Sequence
from functools import partial
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import Beyond, Condition, Contains, Equals
from ros2_memory.analysis.facts import LABEL, Facts, State, Word, state_of, stated_by
from ros2_memory.columns.detections import DetectionColumns, Detections, detections_by
from ros2_memory.columns.poses import NoPoseError, PoseColumns
from ros2_memory.columns.shown import numbers
from ros2_memory.columns.stated import StatedColumns
from ros2_memory.columns.stored import Layout, PartZones, Topic, Zones
from ros2_memory.columns.table import Table
from ros2_memory.columns.truth import ColumnCondition
from ros2_memory.columns.values import seconds
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import MAX_NS, MIN_NS, unix_from_ns
from ros2_memory.counts.numbers import numbers_in
from ros2_memory.extract import SchemaExtractor
from ros2_memory.messages.conversions import ANGLES
from ros2_memory.messages.detections import Detection, detections_of
from tests.support.bags import make
from tests.support.examples import examples
from tests.support.memories import shipped_extractor
from tests.unit.columns.drawn_tables import (
    Drawn,
    condition_on,
    drawn_of,
    drawn_tables,
    message,
    paths_of,
    rounded,
    stored,
)

EXTRACTOR = shipped_extractor()
RANDOM = st.randoms(use_true_random=False)


def as_part(table: Table) -> PartZones:
    """Returns what is known of a table without reading it, as of the part with the number 0."""

    def zones(path: str) -> Zones:
        zone = table.zone(path)
        known = Zones.of([], []) if zone is None else Zones.of([0], [zone])
        return known.among(np.zeros(1, np.int64))

    layout = Layout.of(table)
    topic = Topic(table.channel, layout, lambda _: table.definition)
    return PartZones(topic, np.zeros(1, np.int64), zones)


def judged(
    table: Table,
    condition: Condition,
    values: list[JsonValue],
    extractor: SchemaExtractor = EXTRACTOR,
) -> int:
    """Checks what a table says of each of its rows, and what is ruled out without reading any.

    Returns of how many rows it does not say.
    """
    column, expected = ColumnCondition(condition, extractor), [*map(condition.matches, values)]
    assert np.all(column.may_match(as_part(table))) or not any(expected), condition
    found = column.truth(table)
    assert not (found.surely & found.unsure).any()
    assert found.is_none == (not (found.surely | found.unsure).any())
    wrong = np.flatnonzero((found.surely != np.array(expected)) & ~found.unsure)
    assert not wrong.size, (condition, values[wrong[0]])
    return int(found.unsure.sum())


def values_of(drawn: Drawn, extractor: SchemaExtractor = EXTRACTOR) -> list[JsonValue]:
    return [extractor.exact(message, drawn.type) for message in drawn.messages]


SAID = st.sampled_from(
    [
        '{"a": 1, "b": {"a": "x"}}',
        '[{"a": 2}, {"a": true}]',
        '"{\\"a\\": 1}"',
        "x",
        "",
        "[",
        '{"a": [3]}',
    ]
)
PATHS = st.sampled_from(["a", "b.a", "b", "0.a", "1.a", "a.0"])
TESTS = st.sampled_from(
    [Equals(1), Equals("x"), Equals(True), Beyond(1, above=True), Contains("x")]
)


@given(st.lists(st.lists(SAID, max_size=3), min_size=1, max_size=4), PATHS, TESTS)
def test_truth_of_a_field_in_json_is_that_of_each_message(
    said: list[list[str]], path: str, test: Equals | Beyond | Contains
) -> None:
    kind, status = "diagnostic_msgs/msg/KeyValue", "diagnostic_msgs/msg/DiagnosticStatus"
    messages = [
        make(
            status,
            level=0,
            name="",
            message=texts[0] if texts else "",
            hardware_id="",
            values=[make(kind, key="", value=each) for each in texts],
        )
        for texts in said
    ]
    drawn = drawn_of(status, messages)
    values = values_of(drawn)
    for field in (f"message.{path}", f"values.value.{path}", f"values.0.value.{path}"):
        assert not judged(drawn.table, Condition(test, field), values)


@settings(max_examples=examples(150))
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


@settings(max_examples=examples(150))
@given(
    drawn_tables() | drawn_tables(("nav_msgs/msg/Odometry",)),
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
            assert own == pytest.approx(expected, abs=found.errors.max(initial=0.0), rel=0.0), field


LABELLED = (
    "std_msgs/msg/String",
    "ros2_vision_interfaces/msg/VisionDetectionArray",
    "ros2_vision_interfaces/msg/StampedString",
)
DETECTING = (
    *LABELLED,
    "vision_msgs/msg/Detection2DArray",
    "vision_msgs/msg/Detection3DArray",
    "own_msgs/msg/Label",
    "own_msgs/msg/PosedArray",
    "own_msgs/msg/TrackedArray",
    "aruco_opencv_msgs/msg/ArucoDetection",
)
STATING = (
    *LABELLED,
    "std_msgs/msg/Bool",
    "rcl_interfaces/msg/Log",
    "diagnostic_msgs/msg/DiagnosticArray",
    "sensor_msgs/msg/BatteryState",
    "geometry_msgs/msg/Twist",
)
POSED = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/TransformStamped",
    "geometry_msgs/msg/Pose2D",
    "turtlesim/msg/Pose",
    "px4_msgs/msg/VehicleOdometry",
    "px4_msgs/msg/VehicleLocalPosition",
)
SETTLED = (*POSED, "own_msgs/msg/Everything", "own_msgs/msg/Label")


@settings(max_examples=examples(180))
@given(drawn_tables(SETTLED) | drawn_tables())
def test_poses_of_columns_are_those_of_drawn_messages(drawn: Drawn) -> None:
    """Of other types columns settle none that messages do not have."""
    expected = [EXTRACTOR.pose(each, drawn.type) for each in drawn.messages]
    times = drawn.table.log_times
    try:
        found = PoseColumns(EXTRACTOR).of(drawn.table, times, None)
    except NoPoseError:
        assert expected == [None] * len(expected)
        return
    if found is None:
        assert drawn.type not in SETTLED
        return
    assert found.times.tolist() == times.tolist()
    for row, (pose, message_) in enumerate(zip(expected, drawn.messages, strict=True)):
        assert pose is not None
        twist = EXTRACTOR.twist(message_, drawn.type)
        turn = (math.nan,) * 4 if pose.orientation is None else pose.orientation
        speed = math.nan if twist is None else math.hypot(*twist.linear)
        near = partial(pytest.approx, rel=1e-12, nan_ok=True)
        assert found.positions[row].tolist() == near(pose.position, abs=0.51e-4)
        assert [*found.turns[row], found.speeds[row]] == near([*turn, speed], abs=1.02e-4)
        assert found.frames.words[found.frames.codes[row]] == pose.frame_id


@pytest.mark.parametrize("type_name", POSED)
def test_poses_of_rounded_columns_are_the_same_bit_by_bit(type_name: str) -> None:
    draw = Random(type_name)
    drawn = drawn_of(type_name, [message(type_name, draw, is_odd=False) for _ in range(40)])
    whole = PoseColumns(EXTRACTOR).of(drawn.table, drawn.table.log_times, None)
    some = np.array([3, 4, 30])
    table = stored(drawn.table, 1e-4)
    found = PoseColumns(EXTRACTOR).of(table, drawn.table.log_times[some], some)
    assert whole is not None
    assert found is not None
    assert np.array_equal(found.positions, whole.positions[some])
    assert found.frames.values() == whole.rows(some).frames.values()


def detections_in(message: object, type_name: str) -> list[Detection]:
    frame = EXTRACTOR.frame(message)
    found = detections_of(EXTRACTOR.exact(message, type_name))
    return [one if one.frame_id else one._replace(frame_id=frame) for one in found]


def listed(found: Detections, step: float) -> list[tuple[int | str, ...]]:
    """Detections in an order that does not depend on where in a message they are.

    Their numbers are rounded to a multiple of `step`, if it is not 0.
    """
    columns = (
        found.rows.tolist(),
        found.labels.values(),
        found.frames.values(),
        found.ids.values(),
        rounded(found.scores, step).tolist(),
        rounded(found.places, step).tolist(),
    )

    def said(number: float) -> str:
        """A number as a text, so that NaN is NaN; next to zero is zero."""
        return "0" if abs(number) < 1e-12 else f"{number:.12g}"

    rows: list[tuple[int | str, ...]] = []
    for row, label, frame, own_id, score, place in zip(*columns, strict=True):
        where = [said(axis) for axis in place]
        # A point of zeros is not filled in.
        where = [] if {*where} <= {"0", "nan"} else where
        rows.append((row, label, frame if where else "", own_id, said(score), *where))
    return sorted(rows)


def detections_compared(table: Table, messages: Sequence[object], step: float = 0.0) -> bool:
    """Checks what the columns settle, rounded to `step`; returns whether they do."""
    type_name = table.channel.type
    expected = detections_by([detections_in(each, type_name) for each in messages])
    # A point of zeros is none, so that another may be the first where it is rounded to zeros.
    if (np.abs(expected.places) < step).all(axis=1).any():
        return True
    columns = DetectionColumns(EXTRACTOR)
    found = columns.of(table)
    assert columns.may_have_any(table) or not expected.rows.size
    if found is None:
        return False
    assert listed(found.detections, step) == listed(expected, step)
    if found.stamps is not None:
        stamps = [each.header.stamp for each in messages]  # type: ignore[attr-defined]
        assert found.stamps.tolist() == [each.sec * 10**9 + each.nanosec for each in stamps]
    return True


@settings(max_examples=examples(150))
@given(drawn_tables() | drawn_tables(DETECTING))
def test_columns_detect_what_drawn_messages_detect(drawn: Drawn) -> None:
    """Common types need no reading; and are stored but for rounding."""
    is_settled = detections_compared(drawn.table, drawn.messages)
    if drawn.type in DETECTING:
        # An object without a name may hold detections.
        assert is_settled or any(detections_in(each, drawn.type) for each in drawn.messages)
        for step in (0.0, 1e-6):
            detections_compared(stored(drawn.table, step), drawn.messages, step)


def by_row(facts: Facts, rows: set[int]) -> set[tuple[int, Word, float]]:
    """Facts; of several scores of a label in a message the best one, to four digits."""
    best: dict[tuple[int, Word], float] = {}
    cells = zip(facts.rows.tolist(), facts.codes.tolist(), facts.values.tolist(), strict=True)
    for row, code, value in cells:
        key = (row, facts.words[code])
        if row in rows:
            best[key] = max(best.get(key, -math.inf), -math.inf if math.isnan(value) else value)
    return {
        (*key, round(value, 4) if math.isfinite(value) else value) for key, value in best.items()
    }


def states_of(drawn: Drawn) -> list[State | None]:
    values = [EXTRACTOR.exact(message, drawn.type) for message in drawn.messages]
    return [state_of(value, drawn.type) for value in values]


def states_compared(table: Table, drawn: Drawn) -> int | None:
    """Checks what the columns settle; returns how many messages are to be read, None for all."""
    expected = stated_by(table.log_times.tolist(), states_of(drawn))
    found = StatedColumns(EXTRACTOR).of(table)
    if found is None:
        return None
    to_read = found.to_read(None).tolist()
    rows = {*range(len(table))} - {*to_read}
    assert by_row(found.stated.facts, rows) == by_row(expected.facts, rows)
    return len(to_read)


@settings(max_examples=examples(150))
@given(drawn_tables() | drawn_tables(STATING))
def test_columns_state_what_drawn_messages_state(drawn: Drawn) -> None:
    """Nothing is read where columns hold what matters."""
    read = states_compared(drawn.table, drawn)
    if drawn.type in STATING:
        if read is None:  # an object without a name may hold detections
            states = filter(None, states_of(drawn))
            assert any(word.kind == LABEL for state in states for word, _ in state.facts)
        else:
            assert read == 0
        for step in (0.0, 1e-6):  # what may be wrong, rounded, is read
            states_compared(stored(drawn.table, step), drawn)


PLAIN = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/BatteryState",
    "rcl_interfaces/msg/Log",
    "px4_msgs/msg/VehicleOdometry",
    "std_msgs/msg/String",
    "std_msgs/msg/Int64",
    "std_msgs/msg/Float32",
)


@settings(max_examples=examples(60))
@given(drawn_tables(PLAIN), RANDOM)
def test_truth_is_sure_where_columns_hold_the_whole_value(drawn: Drawn, random: Random) -> None:
    values = values_of(drawn)
    for _ in range(4):
        condition = condition_on(values, random)
        unsure = judged(drawn.table, condition, values)
        # JSON by which an element is selected may lose detections of a low score.
        assert unsure == 0 or (condition.min_score > 0 and "=" in (condition.field or ""))


@given(st.lists(st.integers(MIN_NS, MAX_NS) | st.integers(-(2**54), 2**54), min_size=1))
def test_seconds_are_rounded_as_those_of_each_message(times: list[int]) -> None:
    found = seconds(np.array(times, np.int64))
    assert found.tolist() == [unix_from_ns(time) for time in times]

"""What columns say that messages state, detect and where they are: the same as each message."""

import math
import random
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings

from ros2_memory.analysis.facts import LABEL, Facts, State, Word, state_of, stated_by
from ros2_memory.columns.detections import DetectionColumns, Detections, detections_by
from ros2_memory.columns.poses import NoPoseError, PoseColumns
from ros2_memory.columns.stated import StatedColumns
from ros2_memory.columns.table import Table
from ros2_memory.messages.detections import Detection, detections_of
from tests.support.examples import examples
from tests.support.memories import shipped_extractor
from tests.unit.columns.drawn_tables import (
    Drawn,
    drawn_of,
    drawn_tables,
    message,
    rounded,
    stored,
)

EXTRACTOR = shipped_extractor()
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
HALF_STEP = 0.51e-4


def alike(found: float, expected: float, off: float) -> bool:
    if math.isnan(expected) or math.isinf(expected):
        return found == expected or (math.isnan(found) and math.isnan(expected))
    return abs(found - expected) <= max(off, 1e-12 * abs(expected))


def poses_compared(table: Table, drawn: Drawn, off: float) -> bool:
    """Checks what the columns settle; returns whether they do."""
    expected = [EXTRACTOR.pose(each, drawn.type) for each in drawn.messages]
    twists = [EXTRACTOR.twist(each, drawn.type) for each in drawn.messages]
    try:
        found = PoseColumns(EXTRACTOR).of(table, table.log_times, None)
    except NoPoseError:
        assert expected == [None] * len(expected)
        return True
    if found is None:
        return False
    assert found.times.tolist() == table.log_times.tolist()
    for row, (pose, twist) in enumerate(zip(expected, twists, strict=True)):
        assert pose is not None
        for one, other in zip(found.positions[row].tolist(), pose.position, strict=True):
            assert alike(one, other, off)
        turn = (math.nan,) * 4 if pose.orientation is None else pose.orientation
        for one, other in zip(found.turns[row].tolist(), turn, strict=True):
            assert alike(one, other, 2 * off)
        assert found.frames.words[found.frames.codes[row]] == pose.frame_id
        speed = math.nan if twist is None else math.hypot(*twist.linear)
        assert alike(found.speeds[row], speed, 2 * off)
    return True


@settings(max_examples=examples(180), deadline=None)
@given(drawn_tables(SETTLED) | drawn_tables())
def test_poses_of_columns_are_those_of_drawn_messages(drawn: Drawn) -> None:
    """Of other types columns settle none that messages do not have."""
    assert poses_compared(drawn.table, drawn, HALF_STEP) or drawn.type not in SETTLED


@pytest.mark.parametrize("type_name", POSED)
def test_poses_of_rounded_columns_are_the_same_bit_by_bit(type_name: str) -> None:
    draw = random.Random(type_name)
    drawn = drawn_of(type_name, [message(type_name, draw, is_odd=False) for _ in range(40)])
    whole = PoseColumns(EXTRACTOR).of(drawn.table, drawn.table.log_times, None)
    some = np.array([3, 4, 30])
    rounded = PoseColumns(EXTRACTOR).of(
        stored(drawn.table, 1e-4), drawn.table.log_times[some], some
    )
    assert whole is not None
    assert rounded is not None
    assert np.array_equal(rounded.positions, whole.positions[some])
    assert rounded.frames.values() == whole.rows(some).frames.values()


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
        rounded(found.scores, step).tolist(),
        rounded(found.places, step).tolist(),
    )

    def said(number: float) -> str:
        """A number as a text, so that NaN is NaN; next to zero is zero."""
        return "0" if abs(number) < 1e-12 else f"{number:.12g}"

    rows: list[tuple[int | str, ...]] = []
    for row, label, frame, score, place in zip(*columns, strict=True):
        where = [said(axis) for axis in place]
        # A point of zeros is not filled in.
        where = [] if {*where} <= {"0", "nan"} else where
        rows.append((row, label, frame if where else "", said(score), *where))
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
    stamps = [getattr(getattr(each, "header", None), "stamp", None) for each in messages]
    if found.stamps is not None:
        read = [each.sec * 10**9 + each.nanosec for each in stamps if each is not None]
        assert found.stamps.tolist() == read
    return True


@settings(max_examples=examples(150), deadline=None)
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


@settings(max_examples=examples(150), deadline=None)
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

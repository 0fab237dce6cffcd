"""The poses of a table are those of its messages, to what the store keeps of them."""

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings

from ros2_memory.columns.poses import NoPoseError, PoseColumns
from ros2_memory.columns.table import Table
from tests.support.examples import examples
from tests.support.memories import shipped_extractor
from tests.unit.columns.drawn_tables import Drawn, drawn_of, drawn_tables, message, stored

EXTRACTOR = shipped_extractor()
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
HALF_STEP = 0.51e-4


def alike(found: float, expected: float, off: float) -> bool:
    if math.isnan(expected) or math.isinf(expected):
        return found == expected or (math.isnan(found) and math.isnan(expected))
    return abs(found - expected) <= max(off, 1e-12 * abs(expected))


def compared(table: Table, drawn: Drawn, off: float) -> bool:
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


@settings(max_examples=examples(120), deadline=None)
@given(drawn_tables((*POSED, "own_msgs/msg/Everything", "own_msgs/msg/Label")))
def test_poses_of_columns_are_those_of_drawn_messages(drawn: Drawn) -> None:
    assert compared(drawn.table, drawn, HALF_STEP)


@settings(max_examples=examples(60), deadline=None)
@given(drawn_tables())
def test_columns_settle_no_pose_that_messages_do_not_have(drawn: Drawn) -> None:
    compared(drawn.table, drawn, HALF_STEP)


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

"""The simulated robot's closed forms agree with each other and with the flat it drives through."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.demo import robot
from ros2_memory.demo.robot import LAP_M, LAP_S, THINGS, Planar

MOMENTS = st.floats(min_value=-200.0, max_value=10_000.0)
PLANAR = st.builds(
    Planar,
    st.floats(-10.0, 10.0),
    st.floats(-10.0, 10.0),
    st.floats(-3.0, 3.0),
)


def assert_same(one: Planar, other: Planar, *, within: float) -> None:
    assert math.hypot(one.x - other.x, one.y - other.y) < within
    assert abs(robot.wrapped(one.yaw - other.yaw)) < within


@given(MOMENTS)
def test_the_velocity_is_the_derivative_of_the_pose(t: float) -> None:
    step = 1e-4
    before, after = robot.pose(t - step), robot.pose(t + step)
    here = robot.pose(t)
    forward, turning = robot.twist(t)
    rate_x, rate_y = (after.x - before.x) / (2 * step), (after.y - before.y) / (2 * step)
    assert rate_x == pytest.approx(forward * math.cos(here.yaw), abs=1e-3)
    assert rate_y == pytest.approx(forward * math.sin(here.yaw), abs=1e-3)
    assert robot.wrapped(after.yaw - before.yaw) / (2 * step) == pytest.approx(turning, abs=1e-3)


@given(MOMENTS)
def test_after_a_lap_the_robot_is_where_it_was(t: float) -> None:
    assert_same(robot.pose(t), robot.pose(t + LAP_S), within=1e-6)
    assert robot.driven(t + LAP_S) - robot.driven(t) == pytest.approx(LAP_M, abs=1e-6)


@given(st.floats(0.0, 2 * LAP_S), st.floats(0.0, 60.0))
def test_the_way_driven_is_the_integral_of_the_speed(start: float, duration: float) -> None:
    times = np.linspace(start, start + duration, 4001)
    speeds = [abs(robot.twist(float(t))[0]) for t in times]
    length = float(np.trapezoid(speeds, times))
    assert robot.driven(start + duration) - robot.driven(start) == pytest.approx(length, abs=1e-3)


@given(MOMENTS)
def test_what_it_sees_is_where_it_stands_in_the_flat(t: float) -> None:
    here = robot.pose_in_map(t)
    for thing in robot.seen(t):
        x, y, z = THINGS[thing.label]
        there = here.then(Planar(thing.point[0], thing.point[1], 0.0))
        assert (there.x, there.y, thing.point[2]) == pytest.approx((x, y, z), abs=1e-9)
        assert 0.6 < thing.score < 1.0

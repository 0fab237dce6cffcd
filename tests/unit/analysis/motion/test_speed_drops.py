"""Sudden losses of speed, and that cuts into slices change none."""

from __future__ import annotations

import math
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.motion.speed_drops import SLOT_NS, SpeedDrop, speed_drops
from tests.unit.analysis.motion.posed import posed, stood_in

S = 10**9
BEGIN = 1_784_000_000 * S
Pose = tuple[int, tuple[float, float, float], tuple[float, float, float, float]]


def driven(*legs: tuple[float, float, float], rate: int = 20) -> list[Pose]:
    """Poses of a robot that goes for so many seconds at a speed (m/s), and turns by a rate (rad/s).

    Heading and speed change at once.
    """
    poses: list[Pose] = []
    x = y = heading = 0.0
    at = BEGIN
    for lasts_s, speed, turn in legs:
        for _ in range(round(lasts_s * rate)):
            rotation = (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
            poses.append((at, (x, y, 0.0), rotation))
            at += S // rate
            x += speed / rate * math.cos(heading)
            y += speed / rate * math.sin(heading)
            heading += turn / rate
    return poses


def found(poses: list[Pose]) -> list[SpeedDrop]:
    rows = [(at, place) for at, place, _ in poses]
    return [*speed_drops(posed(rows, [turn for *_, turn in poses]))]


def test_a_robot_that_suddenly_slows_down_is_noticed_with_its_speeds() -> None:
    [drop] = found(driven((5.2, 0.5, 0), (2.5, 0.05, 0), (5, 0.5, 0)))
    assert (drop.time - BEGIN) / S == pytest.approx(5.2, abs=0.6)
    assert drop.before_mps == pytest.approx(0.5, abs=0.01)
    assert drop.after_mps == pytest.approx(0.05, abs=0.01)


def test_a_drone_that_sinks_where_it_flew_has_the_speed_at_which_it_sinks() -> None:
    flown = [(BEGIN + n * S // 20, (0.15 * n, 0.0, 30.0)) for n in range(100)]
    sinking = [(BEGIN + n * S // 20, (15.0, 0.0, 30.0 - 0.05 * (n - 100))) for n in range(100, 200)]
    upright = [(0.0, 0.0, 0.0, 1.0)] * 200
    [drop] = speed_drops(posed([*flown, *sinking], upright))
    assert (drop.before_mps, drop.after_mps) == pytest.approx((3.0, 1.0), abs=0.05)


@pytest.mark.parametrize(
    "poses",
    [
        [],
        driven((5, 0.5, 0), (5, 0.4, 0), (5, 0.3, 0), (5, 0.25, 0)),  # slower, not much at a time
        driven((5, 0.5, 0), (2, 0.0, 0.8), (5, 0.5, 0)),  # to turn
        driven((5, 0.1, 0), (2, 0.0, 0), (5, 0.1, 0)),  # hardly moved
        driven((5, 0.5, 0), (0.6, 0.0, 0), (5, 0.5, 0)),  # for a moment
        driven((5, 0.0, 0), (0.5, 0.5, 0), (5, 0.0, 0)),  # moved for a moment
        driven((20, 0.5, 0), (20, 0.0, 0), rate=1),  # too seldom
        [  # a single position is wrong
            (at, (x + 5 * (at == BEGIN + 5 * S), y, z), turn)
            for at, (x, y, z), turn in driven((10, 0.3, 0))
        ],
        [  # the position jumps back
            (at, (x - 0.2 * (at >= BEGIN + 5.2 * S), y, z), turn)
            for at, (x, y, z), turn in driven((10, 0.4, 0))
        ],
    ],
    ids=count(),
)
def test_what_is_no_sudden_loss_of_speed(poses: list[Pose]) -> None:
    assert found(poses) == []


def test_poses_without_orientation_show_some() -> None:
    poses = driven((5, 0.5, 0), (2, 0.0, 0.8))
    assert len(speed_drops(posed((at, place) for at, place, _ in poses))) == 1


@given(
    legs=st.lists(
        st.tuples(
            st.floats(0.3, 6), st.sampled_from([0.0, 0.05, 0.2, 0.5]), st.sampled_from([0.0, 0.5])
        ),
        min_size=1,
        max_size=8,
    ),
    blocks=st.integers(1, 8),
    silent=st.booleans(),
)
def test_slices_of_any_length_change_nothing(
    legs: list[tuple[float, float, float]], blocks: int, silent: bool
) -> None:
    poses = driven(*legs, rate=10)
    if silent:
        poses = [each for each in poses if (each[0] - BEGIN) // SLOT_NS % 17 > 1]
    rows = [(at, place) for at, place, _ in poses]
    turned = posed(rows, [turn for *_, turn in poses])
    assert stood_in(turned, blocks=blocks)[1] == [*speed_drops(turned)]

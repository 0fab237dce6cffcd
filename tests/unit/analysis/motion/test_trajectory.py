from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.motion.trajectory import Trajectory
from ros2_memory.core.timebase import NS_PER_S
from tests.support.strategies import points
from tests.unit.analysis.motion.posed import posed, way_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.analysis.poses import Poses
    from ros2_memory.core.model import Vector3

S = NS_PER_S
START = 1_700_000_000 * S


def driven(positions: Iterable[Vector3], step_ns: int = S) -> Poses:
    """Poses at even steps of log time."""
    return posed((START + nth * step_ns, place) for nth, place in enumerate(positions))


def along_x(*metres: float) -> list[Vector3]:
    return [(x, 0.0, 0.0) for x in metres]


def summarise(poses: Poses, fastest_mps: float = 10.0, at_most: int = 50) -> Trajectory:
    return way_of(poses, fastest_mps).trajectory(at_most)


def path_length(positions: Iterable[Vector3]) -> float:
    return math.fsum(math.dist(a, b) for a, b in pairwise(positions))


def farthest_off(positions: Iterable[Vector3], found: Trajectory) -> float:
    """Distance from the polyline, written independently of the code under test."""
    vertices = np.array([waypoint.position for waypoint in found.waypoints])
    starts, ways = vertices[:-1], np.diff(vertices, axis=0)
    squared = np.maximum((ways * ways).sum(axis=1), 1e-300)
    worst = 0.0
    for p in np.array([*positions]):
        ratios = np.clip(((p - starts) * ways).sum(axis=1) / squared, 0.0, 1.0)
        ends = np.concatenate((starts + ratios[:, None] * ways, vertices))
        worst = max(worst, float(np.linalg.norm(ends - p, axis=1).min()))
    return worst


# Distance and speed


# Of these none is at the origin, where odometry may have begun anew.
elsewhere = points.map(lambda point: (abs(point[0]) + 10, point[1], point[2]))


@given(st.lists(elsewhere, min_size=2, max_size=15))
def test_of_few_poses_the_distance_is_the_plain_length(positions: list[Vector3]) -> None:
    found = summarise(driven(positions), 1e9)
    assert found.totals.distance_m == pytest.approx(path_length(positions), rel=1e-12)
    assert found.totals.jumps == 0
    assert (found.max_speed or 0) >= (found.avg_speed or 0) >= 0


# Jumps and invalid poses


@pytest.mark.parametrize(
    ("x", "drawn"),
    [
        ((0, 1, 2, 102, 103, 104, 5, 6), [(0, 0), (2, 0), (3, 1), (5, 0), (6, 1), (7, 0)]),
        # It stands before and after, and is drawn until it jumps.
        ((*(0.001 * (i % 2) for i in range(9)), 90, 90, 91), [(0, 0), (8, 0), (9, 1), (11, 0)]),
    ],
)
def test_both_ends_of_a_jump_are_drawn_and_nothing_between_them(
    x: tuple[float, ...], drawn: list[tuple[int, int]]
) -> None:
    found = summarise(driven(along_x(*x)))
    assert [((each.time - START) // S, each.jump) for each in found.waypoints] == drawn


# Waypoints


@given(st.lists(points, min_size=1, max_size=60), st.integers(2, 60))
def test_no_pose_is_farther_from_the_waypoints_than_the_stated_error(
    positions: list[Vector3], at_most: int
) -> None:
    poses = driven(positions)
    found = summarise(poses, at_most=at_most)
    assert farthest_off(positions, found) <= found.waypoint_error_m + 1e-7
    assert len(found.waypoints) <= at_most
    assert found.waypoint_error_m <= 0.05 or len(found.waypoints) == at_most or found.totals.jumps
    # They are recorded poses, from the first to the last.
    recorded = dict(zip(poses.times.tolist(), positions, strict=True))
    assert all(recorded[each.time] == each.position for each in found.waypoints)
    times = [each.time for each in found.waypoints]
    assert times == sorted(set(times))
    assert (times[0], times[-1]) == (poses.times[0], poses.times[-1])

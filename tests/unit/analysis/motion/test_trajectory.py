from __future__ import annotations

import math
import random
from itertools import count, pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.motion.odometry import MotionTotals
from ros2_memory.analysis.motion.trajectory import Trajectory
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S
from ros2_memory.history.driven_path import length_notes
from tests.support.strategies import points
from tests.unit.analysis.motion.posed import posed, way_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.poses import Poses
    from ros2_memory.core.model import Vector3

S = NS_PER_S
MS = NS_PER_MS
START = 1_700_000_000 * S


def driven(
    positions: Iterable[Vector3], step_ns: int = S, speeds: Sequence[float] | None = None
) -> Poses:
    """Poses at even steps of log time, with the messages' own speeds where given."""
    rows = ((START + nth * step_ns, place) for nth, place in enumerate(positions))
    return posed(rows, speeds=speeds)


def along_x(*metres: float) -> list[Vector3]:
    return [(x, 0.0, 0.0) for x in metres]


def summarise(
    poses: Poses, fastest_mps: float = 10.0, at_most: int = 50, cuts: Sequence[int] | None = None
) -> Trajectory:
    return way_of(poses, fastest_mps, cuts).trajectory(at_most)


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


def test_a_known_path_has_its_length_duration_and_mean_speed() -> None:
    square: list[Vector3] = [(0, 0, 0), (3, 0, 0), (3, 4, 0), (0, 4, 0), (0, 0, 0)]
    found = summarise(driven(square, 2 * S))
    assert (found.totals.distance_m, found.totals.duration_s, found.poses) == (14.0, 8.0, 5)
    assert (found.avg_speed, found.max_speed, found.max_speed_from) == (1.75, 2.0, "positions")


# Of these none is at the origin, where odometry may have begun anew.
elsewhere = points.map(lambda point: (abs(point[0]) + 10, point[1], point[2]))


@given(st.lists(elsewhere, min_size=2, max_size=15))
def test_of_few_poses_the_distance_is_the_plain_length(positions: list[Vector3]) -> None:
    found = summarise(driven(positions), 1e9)
    assert found.totals.distance_m == pytest.approx(path_length(positions), rel=1e-12)
    assert found.totals.jumps == 0
    assert (found.max_speed or 0) >= (found.avg_speed or 0) >= 0


def test_no_pose_makes_an_empty_trajectory_and_one_a_place_without_a_way() -> None:
    assert summarise(driven([])) == Trajectory(
        MotionTotals(), None, None, "positions", (), 0.0, 0, 0
    )
    found = summarise(driven(along_x(2.0)))
    assert (found.totals.distance_m, found.totals.duration_s, found.avg_speed) == (0.0, 0.0, None)
    assert [waypoint.position for waypoint in found.waypoints] == [(2.0, 0.0, 0.0)]


@pytest.mark.parametrize(
    ("x", "stated", "highest"),
    [
        ((0, 1, 2), [0.5, 1.25, 1.0], (1.25, "twist")),
        ((0, 1, 2), [math.nan, 1.25, math.inf], (1.25, "twist")),
        # A twist that is never set does not make a moving robot stand.
        ((0, 1, 3), [0.0, 0.0, 0.0], (2.0, "positions")),
        ((1, 1, 1), [0.0, 0.0, 0.0], (0.0, "twist")),
    ],
)
def test_the_highest_speed_is_the_messages_own_where_they_state_one(
    x: tuple[float, ...], stated: list[float], highest: tuple[float, str]
) -> None:
    found = summarise(driven(along_x(*x), speeds=stated))
    assert (found.max_speed, found.max_speed_from) == highest


def test_poses_that_arrive_in_a_burst_do_not_make_the_robot_fast() -> None:
    # 1 m/s at 50 Hz; half a second of it is delivered within 25 ms, as after a stalled transport.
    late = START + 125 * 20 * MS
    burst = (
        (late - (125 - i) * MS if 100 <= i < 125 else START + i * 20 * MS, (i * 0.02, 0.0, 0.0))
        for i in range(200)
    )
    found = summarise(posed(burst))
    assert found.totals.jumps == 0
    assert found.totals.distance_m == pytest.approx(199 * 0.02)
    assert (found.max_speed or 9) < 6.0


def test_poses_of_one_moment_are_a_way_and_no_division_by_zero() -> None:
    found = summarise(driven(along_x(0.0, 0.3, 0.6), 0))
    assert (found.totals.distance_m, found.totals.duration_s, found.avg_speed) == (0.6, 0.0, None)
    assert (found.totals.jumps, found.max_speed) == (0, None)


@pytest.mark.parametrize(("poses", "is_known"), [(3, False), (25, False), (26, True)])
def test_poses_within_less_than_half_a_second_say_no_speed(poses: int, is_known: bool) -> None:
    x = along_x(*(n * 0.8 for n in range(poses)))
    measured = summarise(driven(x, 20 * MS), 100.0)
    stated = summarise(driven(x, 20 * MS, [1.5] * poses), 100.0)
    speed = pytest.approx(40.0) if is_known else None
    assert (measured.avg_speed, measured.max_speed) == (speed, speed)
    assert (stated.avg_speed, stated.max_speed) == (speed, 1.5)
    assert any("too short to say how fast" in note for note in length_notes(stated)) != is_known


# Jumps and invalid poses


def test_a_jump_is_left_out_of_distance_and_speed_and_is_counted() -> None:
    found = summarise(driven(along_x(0, 1, 101, 102, 2, 3)))
    assert (found.totals.jumps, found.totals.jumped_m) == (2, 200.0)
    assert (found.totals.distance_m, found.max_speed, found.totals.duration_s) == (3.0, 1.0, 5.0)


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


def test_of_more_jumps_than_can_be_drawn_the_longest_are() -> None:
    jumping = [100.0 * (n % 2) + n * (n == 31) for n in range(60)]
    found = summarise(driven(along_x(*jumping)), at_most=12)
    assert (found.totals.jumps, len(found.waypoints) <= 12) == (59, True)
    jumped = [point.position[0] for point in found.waypoints if point.jump]
    assert len(jumped) == 5
    assert 131.0 in jumped


@pytest.mark.parametrize(
    ("x", "step_ns", "fastest_mps", "jumps"),
    [
        # The plausible speed itself is no jump, and a step is granted the jitter of its arrival.
        ([0.1 * i for i in range(50)], 100 * MS, 1.0, 0),
        ([0.0, 0.99], MS, 10.0, 0),
        ([0.0, 1.01], MS, 10.0, 1),
    ],
    ids=count(),
)
def test_what_is_a_jump(x: list[float], step_ns: int, fastest_mps: float, jumps: int) -> None:
    assert summarise(driven(along_x(*x), step_ns), fastest_mps).totals.jumps == jumps


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pose_that_is_no_place_is_left_out_and_counted(bad: float, axis: int) -> None:
    places = np.array(along_x(0.0, 1.0, 2.0))
    places[1, axis] = bad
    found = summarise(driven(places.tolist()))
    assert (found.poses, found.invalid, found.totals.distance_m) == (2, 1, 2.0)
    assert all(math.isfinite(part) for point in found.waypoints for part in point.position)


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


def test_a_waypoint_carries_its_heading_where_the_pose_has_one() -> None:
    corner: list[Vector3] = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)]
    turns = [(0.0, 0.0, math.sin(0.25), math.cos(0.25)), *[(math.nan,) * 4] * 2]
    found = summarise(posed(((START + n * S, each) for n, each in enumerate(corner)), turns))
    assert [each.yaw_rad for each in found.waypoints] == [pytest.approx(0.5), None, None]


@pytest.mark.parametrize(("noise_m", "poses"), [(0.0, 8_000), (0.05, 12_000)])
def test_a_long_way_is_drawn_within_its_error(noise_m: float, poses: int) -> None:
    draw = random.Random(3)
    positions = [
        (
            5 * math.sin(i / 800) + draw.gauss(0, noise_m),
            5 * math.sin(i / 400) + draw.gauss(0, noise_m),
            draw.gauss(0, noise_m),
        )
        for i in range(poses)
    ]
    found = summarise(driven(positions, 20 * MS), at_most=2000)
    assert found.totals.path_sum_m == pytest.approx(path_length(positions), rel=1e-9)
    assert farthest_off(positions[::37], found) <= found.waypoint_error_m + 1e-9
    assert found.waypoint_error_m < (0.05 if noise_m == 0 else 1.0)

from __future__ import annotations

import math
import random
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.motion.odometry import MotionTotals
from ros2_memory.analysis.motion.trajectory import Trajectory
from ros2_memory.analysis.poses import Poses
from ros2_memory.core.geometry import normalised
from ros2_memory.core.model import Pose, Vector3
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S
from ros2_memory.history.driven_path import length_notes
from tests.support.strategies import points
from tests.unit.analysis.motion.posed import posed, way_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


S = NS_PER_S
MS = NS_PER_MS
START = 1_700_000_000 * S
LIMIT_MPS = 10.0


def driven(
    positions: Iterable[Vector3], step_ns: int = S, speeds: Iterable[float] | None = None
) -> list[tuple[int, Pose, float | None]]:
    """Poses at even steps of log time, with the messages' own speeds where given."""
    stated = iter(speeds) if speeds is not None else None
    return [
        (START + index * step_ns, Pose(position, None), next(stated) if stated else None)
        for index, position in enumerate(positions)
    ]


def along_x(*metres: float) -> list[Vector3]:
    return [(x, 0.0, 0.0) for x in metres]


def summarise(
    poses: Iterable[tuple[int, Pose, float | None]],
    max_plausible_speed_mps: float,
    max_waypoints: int = 50,
    cuts: Sequence[int] | None = None,
) -> Trajectory:
    way = way_of(arrays(poses), max_plausible_speed_mps, cuts)
    return way.trajectory(max_waypoints)


def arrays(poses: Iterable[tuple[int, Pose, float | None]]) -> Poses:
    """These poses as arrays, their quaternions at unit length."""
    rows = [*poses]
    turns = [
        None if each.orientation is None else normalised(each.orientation) for _, each, _ in rows
    ]
    return posed(
        ((time, pose.position) for time, pose, _ in rows),
        [turn or (math.nan,) * 4 for turn in turns] or None,
        [math.nan if speed is None else speed for *_, speed in rows] or None,
    )


def path_length(positions: Iterable[Vector3]) -> float:
    return math.fsum(math.dist(a, b) for a, b in pairwise(positions))


def off_polyline(position: Vector3, vertices: Sequence[Vector3]) -> float:
    """Distance from a polyline, written independently of the code under test."""
    p = np.array(position)
    starts = np.array(vertices[:-1] or vertices)
    ways = np.array(vertices[1:] or vertices) - starts
    squared = np.maximum((ways * ways).sum(axis=1), 1e-300)
    ratios = np.clip(((p - starts) * ways).sum(axis=1) / squared, 0.0, 1.0)
    return float(np.linalg.norm(starts + ratios[:, None] * ways - p, axis=1).min())


def farthest_off(positions: Iterable[Vector3], found: Trajectory) -> float:
    vertices = [waypoint.position for waypoint in found.waypoints]
    return max(off_polyline(position, vertices) for position in positions)


# Distance and speed


def test_a_known_path_has_its_length_duration_and_mean_speed() -> None:
    square: list[Vector3] = [(0, 0, 0), (3, 0, 0), (3, 4, 0), (0, 4, 0), (0, 0, 0)]
    found = summarise(driven(square, 2 * S), LIMIT_MPS)
    assert (found.totals.distance_m, found.totals.duration_s, found.poses) == (14.0, 8.0, 5)
    assert found.avg_speed == 14.0 / 8.0
    assert found.max_speed == 2.0
    assert found.max_speed_from == "positions"


# Of these none is at the origin, where odometry may have begun anew.
elsewhere = points.map(lambda point: (abs(point[0]) + 10, point[1], point[2]))


@given(st.lists(elsewhere, min_size=2, max_size=15))
def test_of_few_poses_the_distance_is_the_plain_length(
    positions: list[Vector3],
) -> None:
    found = summarise(driven(positions), 1e9)
    assert found.totals.distance_m == pytest.approx(path_length(positions), rel=1e-12)
    assert found.totals.jumps == 0
    assert found.max_speed is not None
    assert found.avg_speed is not None
    assert found.max_speed >= found.avg_speed


def test_no_pose_makes_an_empty_trajectory() -> None:
    assert summarise([], LIMIT_MPS) == Trajectory(
        MotionTotals(), None, None, "positions", (), 0.0, 0, 0
    )


def test_one_pose_is_a_place_without_a_way() -> None:
    found = summarise(driven(along_x(2.0)), LIMIT_MPS)
    assert (found.totals.distance_m, found.totals.duration_s, found.avg_speed) == (0.0, 0.0, None)
    assert [waypoint.position for waypoint in found.waypoints] == [(2.0, 0.0, 0.0)]


def test_the_highest_speed_is_the_messages_own_where_they_state_one() -> None:
    found = summarise(driven(along_x(0, 1, 2), speeds=[0.5, 1.25, 1.0]), LIMIT_MPS)
    assert (found.max_speed, found.max_speed_from) == (1.25, "twist")


def test_a_speed_that_is_no_number_is_not_the_highest() -> None:
    found = summarise(driven(along_x(0, 1, 2), speeds=[math.nan, 1.25, math.inf]), LIMIT_MPS)
    assert found.max_speed == 1.25


def test_a_twist_that_is_never_set_does_not_make_a_moving_robot_stand() -> None:
    moved = summarise(driven(along_x(0, 1, 3), speeds=[0.0, 0.0, 0.0]), LIMIT_MPS)
    assert (moved.max_speed, moved.max_speed_from) == (2.0, "positions")
    stood = summarise(driven(along_x(1, 1, 1), speeds=[0.0, 0.0, 0.0]), LIMIT_MPS)
    assert (stood.max_speed, stood.max_speed_from) == (0.0, "twist")


def test_poses_that_arrive_in_a_burst_do_not_make_the_robot_fast() -> None:
    # 1 m/s at 50 Hz; half a second of it is delivered within 25 ms, as after a stalled transport.
    even = [(START + i * 20 * MS, (i * 0.02, 0.0, 0.0)) for i in range(200)]
    late = START + 125 * 20 * MS
    burst = [
        (late - (125 - i) * MS if 100 <= i < 125 else time, position)
        for i, (time, position) in enumerate(even)
    ]
    found = summarise([(time, Pose(position, None), None) for time, position in burst], LIMIT_MPS)
    assert found.totals.jumps == 0
    assert found.totals.distance_m == pytest.approx(199 * 0.02)
    assert found.max_speed is not None
    assert found.max_speed < 6.0


def test_poses_of_one_moment_are_a_way_and_no_division_by_zero() -> None:
    found = summarise(driven(along_x(0.0, 0.3, 0.6), 0), LIMIT_MPS)
    assert (found.totals.distance_m, found.totals.duration_s, found.avg_speed) == (0.6, 0.0, None)
    assert (found.totals.jumps, found.max_speed) == (0, None)


@pytest.mark.parametrize(("count", "is_known"), [(3, False), (25, False), (26, True)])
def test_poses_within_less_than_half_a_second_say_no_speed(count: int, is_known: bool) -> None:
    poses = along_x(*(n * 0.8 for n in range(count)))
    measured = summarise(driven(poses, 20 * MS), 100.0)
    stated = summarise(driven(poses, 20 * MS, [1.5] * count), 100.0)
    speed = pytest.approx(40.0) if is_known else None
    assert (measured.avg_speed, measured.max_speed) == (speed, speed)
    assert (stated.avg_speed, stated.max_speed) == (speed, 1.5)
    assert any("too short to say how fast" in note for note in length_notes(stated)) != is_known


# Jumps and invalid poses


def test_a_jump_is_left_out_of_distance_and_speed_and_is_counted() -> None:
    found = summarise(driven(along_x(0, 1, 101, 102, 2, 3)), LIMIT_MPS)
    assert (found.totals.jumps, found.totals.jumped_m) == (2, 200.0)
    assert found.totals.distance_m == 3.0
    assert found.max_speed == 1.0
    assert found.totals.duration_s == 5.0


def test_both_ends_of_a_jump_are_drawn_and_nothing_between_them() -> None:
    found = summarise(driven(along_x(0, 1, 2, 102, 103, 104, 5, 6)), LIMIT_MPS)
    assert [(point.position[0], point.jump) for point in found.waypoints] == [
        (0.0, False),
        (2.0, False),
        (102.0, True),
        (104.0, False),
        (5.0, True),
        (6.0, False),
    ]


def test_a_robot_that_stands_before_and_after_a_jump_is_drawn_until_it_jumps() -> None:
    poses = driven([*[(0.001 * (i % 2), 0.0, 0.0) for i in range(9)], *along_x(90, 90, 91)])
    found = summarise(poses, LIMIT_MPS)
    assert [(point.time, point.jump) for point in found.waypoints] == [
        (poses[0][0], False),
        (poses[8][0], False),
        (poses[9][0], True),
        (poses[-1][0], False),
    ]


def test_of_more_jumps_than_can_be_drawn_the_longest_are() -> None:
    jumping = [100.0 * (n % 2) + n * (n == 31) for n in range(60)]
    found = summarise(driven(along_x(*jumping)), LIMIT_MPS, 12)
    assert found.totals.jumps == 59
    assert len(found.waypoints) <= 12
    assert sum(point.jump for point in found.waypoints) == 5
    assert 131.0 in [point.position[0] for point in found.waypoints if point.jump]


@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0, 40.0, 90.0]), min_size=2, max_size=40),
    st.integers(1, 38),
)
def test_jumps_are_drawn_alike_pose_by_pose_and_from_parts(steps: list[float], cut: int) -> None:
    poses = driven(along_x(*accumulate(steps)))
    cut = min(cut, len(poses) - 1)
    parts = (poses[:cut], poses[cut:])
    whole = summarise(poses, LIMIT_MPS, 200, cuts=[])
    joined = summarise(poses, LIMIT_MPS, 200, cuts=[cut])
    drawable = all(len(summarise(part, LIMIT_MPS, 200).waypoints) <= 100 for part in parts)
    assert [point.position for point in joined.waypoints if point.jump] == [
        point.position for point in whole.waypoints if point.jump
    ] or not drawable


def test_exactly_the_plausible_speed_is_no_jump() -> None:
    found = summarise(driven(along_x(*(0.1 * i for i in range(50))), 10 * MS * 10), 1.0)
    assert found.totals.jumps == 0


@pytest.mark.parametrize(("step_m", "jumps"), [(0.99, 0), (1.01, 1)])
def test_a_step_is_granted_the_jitter_of_its_arrival(step_m: float, jumps: int) -> None:
    assert summarise(driven(along_x(0.0, step_m), MS), LIMIT_MPS).totals.jumps == jumps


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pose_that_is_no_place_is_left_out_and_counted(bad: float, axis: int) -> None:
    position = [1.0, 0.0, 0.0]
    position[axis] = bad
    poses = driven([(0.0, 0.0, 0.0), (position[0], position[1], position[2]), (2.0, 0.0, 0.0)])
    found = summarise(poses, LIMIT_MPS)
    assert (found.poses, found.invalid, found.totals.distance_m) == (2, 1, 2.0)
    assert all(math.isfinite(part) for point in found.waypoints for part in point.position)


# Waypoints


@given(st.lists(points, min_size=1, max_size=60), st.integers(2, 60))
def test_no_pose_is_farther_from_the_waypoints_than_the_stated_error(
    positions: list[Vector3], at_most: int
) -> None:
    found = summarise(driven(positions), LIMIT_MPS, at_most)
    assert farthest_off(positions, found) <= found.waypoint_error_m + 1e-7
    assert len(found.waypoints) <= at_most
    assert found.waypoint_error_m <= 0.05 or len(found.waypoints) == at_most or found.totals.jumps


@given(st.lists(points, min_size=2, max_size=60))
def test_waypoints_are_recorded_poses_from_the_first_to_the_last(positions: list[Vector3]) -> None:
    poses = driven(positions)
    recorded = {time: pose.position for time, pose, _ in poses}
    found = summarise(poses, LIMIT_MPS).waypoints
    assert all(recorded[waypoint.time] == waypoint.position for waypoint in found)
    times = [waypoint.time for waypoint in found]
    assert times == sorted(set(times))
    assert (times[0], times[-1]) == (poses[0][0], poses[-1][0])


def test_a_waypoint_carries_its_heading_where_the_pose_has_one() -> None:
    x, y, z, w = 0.0, 0.0, math.sin(0.25), math.cos(0.25)
    poses = [
        (START, Pose((0.0, 0.0, 0.0), (2 * x, 2 * y, 2 * z, 2 * w)), None),
        (START + S, Pose((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), None),
        (START + 2 * S, Pose((1.0, 1.0, 0.0), None), None),
    ]
    headings = [waypoint.yaw_rad for waypoint in summarise(poses, LIMIT_MPS).waypoints]
    assert headings == [pytest.approx(0.5), None, None]


# Long ways


def _noisy_laps(count: int, noise_m: float) -> list[Vector3]:
    draw = random.Random(3)
    return [
        (
            5 * math.sin(i / 800) + draw.gauss(0, noise_m),
            5 * math.sin(i / 400) + draw.gauss(0, noise_m),
            draw.gauss(0, noise_m),
        )
        for i in range(count)
    ]


@pytest.mark.parametrize(("noise_m", "count"), [(0.0, 30_000), (0.05, 60_000)])
def test_a_long_way_is_drawn_within_its_error(noise_m: float, count: int) -> None:
    positions = _noisy_laps(count, noise_m)
    found = summarise(driven(positions, 20 * MS), LIMIT_MPS, 2000)
    assert found.totals.path_sum_m == pytest.approx(path_length(positions), rel=1e-9)
    assert farthest_off(positions[::37], found) <= found.waypoint_error_m + 1e-9
    assert found.waypoint_error_m < (0.05 if noise_m == 0 else 1.0)

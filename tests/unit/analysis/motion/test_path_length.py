"""How far, how fast and where a robot drove, by poses with noise, gaps, resets and turns."""

import math
from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.poses import Poses
from ros2_memory.core.model import Vector3
from ros2_memory.core.timebase import NS_PER_S
from tests.support.examples import examples
from tests.support.strategies import points
from tests.unit.analysis.motion.posed import off_line, posed, way_of

S = NS_PER_S
BEGIN = 1_784_000_000 * S

Points = np.ndarray[tuple[int, int], np.dtype[np.float64]]


def line(speed: float, hertz: float, seconds: float) -> Points:
    x = np.arange(round(seconds * hertz) + 1) * speed / hertz
    return np.column_stack([x, 0 * x, 0 * x])


def arc(speed: float, hertz: float, seconds: float) -> Points:
    """With a radius of half a metre."""
    angle = line(speed, hertz, seconds)[:, 0] / 0.5
    return np.column_stack([0.5 * np.sin(angle), 0.5 * (1 - np.cos(angle)), 0 * angle])


def noisy(points: Points, sigma: float, seed: int = 1, axes: int = 3) -> Points:
    off = np.random.default_rng(seed).normal(0.0, sigma, points.shape)
    off[:, axes:] = 0.0
    return points + off


def driven(positions: Iterable[Vector3 | list[float]], hertz: float = 1.0) -> Poses:
    """Poses at even steps of log time."""
    return posed((BEGIN + round(nth * S / hertz), place) for nth, place in enumerate(positions))


@settings(max_examples=examples(40))
@given(
    st.sampled_from([20, 50]),
    st.floats(0.1, 2.0),
    st.integers(1, 40),
    st.integers(0, 10**6),
    st.sampled_from([line, arc]),
    st.sampled_from([0.0, 0.005]),
)
def test_other_cuts_of_a_history_differ_by_a_percent_at_most_and_without_noise_not_at_all(
    hertz: int, speed: float, count: int, seed: int, shape: Callable[..., Points], noise_m: float
) -> None:
    places = noisy(shape(speed, hertz, 60), noise_m, seed)
    poses = driven(places.tolist(), hertz)
    cuts = np.random.default_rng(seed).choice(len(places), count, replace=False).tolist()
    whole, parts = (way_of(poses, 10.0, each).trajectory().totals for each in (None, sorted(cuts)))
    exact = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    expected, off = (whole.distance_m, 0.01) if noise_m else (exact, 1e-9)
    assert parts.distance_m == pytest.approx(expected, rel=off)


@pytest.mark.parametrize("split", [None, 0, 2, -3], ids=["one part", "at it", "after", "before"])
@pytest.mark.parametrize("noise_m", [0.0, 0.003])
@pytest.mark.parametrize(
    ("out_m", "pause_s"), [(3.0, 1.0), (3.0, 0.5), (0.8, 0.1), (10.0, 1.0), (3.0, 3.0)]
)
def test_a_step_back_to_the_origin_that_nothing_near_it_is_like_is_a_reset(
    out_m: float, pause_s: float, noise_m: float, split: int | None
) -> None:
    # 1 m/s at 10 Hz; odometry begins at 0 again, within the time and the speed of driving.
    out, again = line(1.0, 10, out_m), line(1.0, 10, 10)
    poses = noisy(np.concatenate([out, again]), noise_m, axes=2).tolist()
    at = [*np.arange(len(out)) / 10, *(out_m + pause_s + np.arange(len(again)) / 10)]
    rows = [(BEGIN + round(s * S), place) for s, place in zip(at, poses, strict=True)]
    cuts = [] if split is None else [len(out) + split]
    found = way_of(posed(rows), 10.0, cuts).trajectory()
    assert found.totals.distance_m == pytest.approx(out_m + 10, rel=0.02 if noise_m else 1e-9)
    assert found.max_speed == pytest.approx(1.0, rel=0.1)
    assert len(found.totals.resets) == 1


@given(st.lists(points, min_size=1, max_size=60), st.integers(2, 60))
def test_no_pose_is_farther_from_the_waypoints_than_the_stated_error(
    positions: list[Vector3], at_most: int
) -> None:
    poses = driven(positions)
    found = way_of(poses, 10.0).trajectory(at_most)
    way = np.array([each.position for each in found.waypoints])
    assert off_line(way, np.array(positions)).max() <= found.waypoint_error_m + 1e-7
    assert len(found.waypoints) <= at_most
    assert found.waypoint_error_m <= 0.05 or len(found.waypoints) == at_most or found.totals.jumps
    # They are recorded poses, from the first to the last.
    recorded = dict(zip(poses.times.tolist(), positions, strict=True))
    assert all(recorded[each.time] == each.position for each in found.waypoints)
    times = [each.time for each in found.waypoints]
    assert times == sorted(set(times))
    assert (times[0], times[-1]) == (poses.times[0], poses.times[-1])


@given(st.lists(points.map(lambda at: (abs(at[0]) + 10, *at[1:])), min_size=2, max_size=15))
def test_of_few_poses_the_distance_is_the_plain_length(positions: list[Vector3]) -> None:
    """None is at the origin, where odometry may have begun anew."""
    found = way_of(driven(positions), 1e9).trajectory()
    length_m = math.fsum(math.dist(a, b) for a, b in pairwise(positions))
    assert found.totals.distance_m == pytest.approx(length_m, rel=1e-12)
    assert found.totals.jumps == 0
    assert (found.max_speed or 0) >= (found.avg_speed or 0) >= 0

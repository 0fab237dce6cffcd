"""Rotations, paths that are simplified, and regions of the plane."""

import math
from collections.abc import Sequence
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from ros2_memory.core import geometry
from ros2_memory.core.geometry import multiply, normalised, rpy, simplified, slerp
from ros2_memory.core.model import Quaternion, Vector3
from ros2_memory.core.regions import (
    AnyOf,
    Circle,
    Place,
    Polygon,
    Rectangle,
    Region,
    Steps,
    Storey,
    clipped,
    contains,
    places_at,
)
from tests.support.strategies import angles, quaternions, ratios


def about_z(angle: float) -> Quaternion:
    return (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


# Rotations


@given(quaternions, st.floats(1e-3, 1e3))
def test_a_quaternion_of_any_length_is_the_same_rotation(q: Quaternion, scale: float) -> None:
    x, y, z, w = q
    unit = normalised((scale * x, scale * y, scale * z, scale * w))
    assert unit == pytest.approx(q, abs=1e-12)
    assert unit is not None
    assert math.hypot(*unit) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("length", [5e-324, 1e-200, 1e200, 1.7e308])
def test_lengths_whose_square_is_no_float_are_normalised_too(length: float) -> None:
    assert normalised((0.0, length, 0.0, length)) == pytest.approx((0, 0.5**0.5, 0, 0.5**0.5))


@pytest.mark.parametrize(
    "q",
    [
        (0.0, 0.0, 0.0, 0.0),
        (math.nan, 0.0, 0.0, 1.0),
        (0.0, 0.0, 0.0, math.nan),
        (0.0, math.inf, 0.0, 1.0),
    ],
)
def test_what_is_no_rotation_is_none(q: Quaternion) -> None:
    assert normalised(q) is None


@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
def test_angles_below_gimbal_lock_come_back_one_by_one(
    roll: float, pitch: float, heading: float
) -> None:
    q = tuple(Rotation.from_euler("xyz", [roll, pitch, heading]).as_quat())
    assert rpy(q) == pytest.approx((roll, pitch, heading), abs=1e-9)


@given(angles, angles, st.sampled_from([-math.pi / 2, math.pi / 2]))
def test_at_gimbal_lock_roll_is_zero_and_yaw_says_the_rest(
    roll: float, heading: float, pitch: float
) -> None:
    turn = Rotation.from_euler("xyz", [roll, pitch, heading])
    found = rpy(tuple(turn.as_quat()))
    assert found[1] == pytest.approx(pitch, abs=1e-6)
    assert (turn.inv() * Rotation.from_euler("xyz", found)).magnitude() < 1e-6


@given(quaternions, st.floats(0, 1e-4), ratios)
def test_slerp_between_nearly_parallel_rotations_keeps_an_even_speed(
    a: Quaternion, angle: float, ratio: float
) -> None:
    b = multiply(a, about_z(angle))
    expected = multiply(a, about_z(angle * ratio))
    assert slerp(a, b, ratio) == pytest.approx(expected, abs=1e-12)


# Paths


def drawn(
    path: Sequence[Vector3], seconds: Sequence[float], tolerance_m: float, at_most: int
) -> tuple[list[int], float]:
    ends, columns = np.array([0, len(path) - 1]), (np.array(path), np.array(seconds))
    kept, error_m = simplified(*columns, ends, tolerance_m=tolerance_m, at_most=at_most)
    return kept.tolist(), error_m


def _recursive(
    path: Sequence[Vector3], seconds: Sequence[float], start: int, end: int, tolerance_m: float
) -> list[int]:
    """The points between two that are kept, by the textbook's recursion, point by point."""
    a, way = np.array(path[start]), np.array(path[end]) - np.array(path[start])
    squared, lasted = float(way @ way), seconds[end] - seconds[start]
    most, where, reach = 0.0, start, 0.0
    for nth in range(start + 1, end):
        point = np.array(path[nth])
        ratio = min(max(float((point - a) @ way) / squared, 0.0), 1.0) if squared else 0.0
        reach = max(reach, ratio)
        off = float(np.linalg.norm(a + ratio * way - point))
        off = max(off, (reach - ratio) * math.sqrt(squared) / 2)
        if lasted > 0:
            then = a + way * (seconds[nth] - seconds[start]) / lasted
            off = max(off, float(np.linalg.norm(point - then)) / 10)
        if off > most + 1e-12:
            most, where = off, nth
    if most <= tolerance_m:
        return []
    before = _recursive(path, seconds, start, where, tolerance_m)
    return [*before, where, *_recursive(path, seconds, where, end, tolerance_m)]


@pytest.mark.parametrize(("seed", "tolerance_m"), [(0, 0.01), (1, 0.1), (2, 3.0), (3, 0.01)])
def test_a_path_is_simplified_as_by_the_recursion(
    seed: int, tolerance_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many points are looked at together."""
    monkeypatch.setattr(geometry, "_TOGETHER", [1 << 14, 50, 20, 7][seed])
    draw = np.random.default_rng(seed)
    speed = np.repeat(draw.choice([0.0, 0.0, 0.3, -0.3], 30), 10)[:, None]
    turn = np.cumsum(np.repeat(draw.normal(0.0, 0.05, 30), 10))
    steps = speed * np.stack([np.cos(turn), np.sin(turn), 0.1 * np.sin(3 * turn)], 1)
    noise = draw.normal(0.0, 1e-4, (300, 3))
    path = [(x, y, z) for x, y, z in (np.cumsum(steps, axis=0) + noise).tolist()]
    seconds = np.cumsum(draw.exponential(0.2, len(path))).tolist()
    kept, error_m = drawn(path, seconds, tolerance_m, len(path))
    last = len(path) - 1
    assert kept == [0, *_recursive(path, seconds, 0, last, tolerance_m), last]
    assert error_m <= tolerance_m
    # With one vertex fewer the worst intervals are split, and the rest is left as it is.
    fewer, off_m = drawn(path, seconds, tolerance_m, len(kept) - 1)
    assert set(fewer) < set(kept)
    assert off_m > tolerance_m


def test_a_spiral_whose_splits_stay_lopsided_is_simplified_in_bounded_time() -> None:
    path = [(0.99**n, 0.0, float(n % 2) * 0.99**n) for n in range(3000)]
    kept, error_m = drawn(path, [0.0] * len(path), 0.0, len(path))
    assert kept == sorted(set(kept))
    assert error_m == 0.0


HORSESHOE = Polygon(
    ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (3.0, 4.0), (3.0, 1.0), (1.0, 1.0), (1.0, 4.0), (0.0, 4.0))
)


def steps(draw: Random) -> Steps:
    points = np.array([[draw.uniform(-3, 6) for _ in range(3)] for _ in range(301)])
    points[5] = points[4]  # the robot stands
    points[9, :2] = points[8, :2]  # it is in a lift
    points[13, 2] = math.nan
    return Steps(*points[:-1].T, *points[1:].T)


@pytest.mark.parametrize(
    "region",
    [
        Circle(1.0, 2.0, 1.5),
        Rectangle(-1.0, 2.0, 0.0, 3.0),
        HORSESHOE,
        Storey(HORSESHOE, 0.0, 2.0),
        Storey(Circle(1.0, 2.0, 3.0), -math.inf, 1.0),
        AnyOf((Storey(HORSESHOE, 2.0, 4.0), Storey(Rectangle(-1.0, 2.0, 0.0, 3.0), -1.0, 3.0))),
    ],
    ids=lambda each: repr(each)[:12],
)
@pytest.mark.parametrize("seed", range(2))
def test_the_parts_inside_are_those_whose_points_are(region: Region, seed: int) -> None:
    draw = Random(seed)
    path = steps(draw)
    parts = clipped(region, path)
    assert (parts.start <= parts.stop).all()
    for _ in range(500):
        step, share = draw.randrange(len(path.x)), draw.random()
        x = path.x[step] + (path.to_x[step] - path.x[step]) * share
        y = path.y[step] + (path.to_y[step] - path.y[step]) * share
        z = path.z[step] + (path.to_z[step] - path.z[step]) * share
        mine = parts.step == step
        apart = np.abs(np.concatenate((parts.start[mine], parts.stop[mine])) - share)
        if len(apart) and apart.min() < 1e-9:
            continue  # on the border
        inside = bool(((parts.start[mine] <= share) & (share <= parts.stop[mine])).any())
        assert inside == contains(region, x, y, z)


def test_of_places_within_each_other_the_smallest_is_named() -> None:
    kitchen = Place("kitchen", "map", Rectangle(0, 5, 0, 5))
    # The last two reach farther than the kitchen, and have less of the plane.
    bends = Polygon(tuple((x * 1.5, y * 1.5) for x, y in HORSESHOE.corners))
    for region in (Circle(1, 1, 0.5), bends, Circle(2.6, 2.6, 2.7)):
        places = (kitchen, Place("part", "map", region), Place("yard", "odom", region))
        assert places_at(places, {"map": (1.0, 1.0, 0.0)}) == ("part", "kitchen")

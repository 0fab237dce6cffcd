from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp  # type: ignore[import-untyped]

from ros2_memory.core.geometry import (
    IDENTITY,
    _columns,
    _farthest,
    compose,
    distance,
    interpolate,
    invert,
    multiply,
    normalised,
    rotate,
    rpy,
    simplify_to,
    simplifying,
    slerp,
    yaw,
)
from ros2_memory.core.model import Quaternion, Transform, Vector3
from tests.support.strategies import angles, points, quaternions, ratios, transforms

if TYPE_CHECKING:
    from collections.abc import Sequence

paths = st.lists(points, max_size=60)
# On a coarse grid points coincide, lines are straight and loops close.
_cell = st.integers(-4, 4).map(float)
grid_paths = st.lists(st.tuples(_cell, _cell, _cell), max_size=60)
any_paths = st.one_of(paths, grid_paths)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Radians between two rotations, by an independent library."""
    return float((Rotation.from_quat(a).inv() * Rotation.from_quat(b)).magnitude())


def matrix(t: Transform) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    homogeneous = np.eye(4)
    homogeneous[:3, :3] = Rotation.from_quat(t.rotation).as_matrix()
    homogeneous[:3, 3] = t.translation
    return homogeneous


def about_z(angle: float) -> Quaternion:
    return (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


def norm(q: Quaternion) -> float:
    return math.sqrt(sum(part * part for part in q))


# Rotations


@given(quaternions, st.floats(1e-3, 1e3))
def test_a_quaternion_of_any_length_is_the_same_rotation(q: Quaternion, scale: float) -> None:
    x, y, z, w = q
    unit = normalised((scale * x, scale * y, scale * z, scale * w))
    assert unit == pytest.approx(q, abs=1e-12)
    assert unit is not None
    assert norm(unit) == pytest.approx(1.0, abs=1e-15)


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


@given(quaternions)
def test_roll_pitch_and_yaw_are_those_about_the_fixed_axes(q: Quaternion) -> None:
    rebuilt = Rotation.from_euler("xyz", rpy(q))
    assert angle_between(q, tuple(rebuilt.as_quat())) < 1e-6


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
    x, y, z, w = Rotation.from_euler("xyz", [roll, pitch, heading]).as_quat()
    found = rpy((x, y, z, w))
    assert found[1] == pytest.approx(pitch, abs=1e-6)
    assert angle_between((x, y, z, w), tuple(Rotation.from_euler("xyz", found).as_quat())) < 1e-6


def test_exactly_at_gimbal_lock_roll_is_zero() -> None:
    half = 0.5**0.5
    assert rpy((0.0, half, 0.0, half))[0] == 0.0
    assert rpy((-0.5, 0.5, 0.5, 0.5)) == pytest.approx((0.0, math.pi / 2, math.pi / 2))


@given(quaternions)
def test_angles_stay_in_their_ranges(q: Quaternion) -> None:
    roll, pitch, heading = rpy(q)
    assert abs(roll) <= math.pi
    assert abs(pitch) <= math.pi / 2
    assert abs(heading) <= math.pi


@given(angles)
def test_a_heading_survives_its_quaternion(angle: float) -> None:
    turned = yaw(about_z(angle))
    assert math.remainder(turned - angle, math.tau) == pytest.approx(0.0, abs=1e-12)


@given(quaternions, quaternions)
def test_a_product_of_rotations_is_one_after_the_other(a: Quaternion, b: Quaternion) -> None:
    expected = tuple((Rotation.from_quat(a) * Rotation.from_quat(b)).as_quat())
    assert angle_between(multiply(a, b), expected) < 1e-7
    assert norm(multiply(a, b)) == pytest.approx(1.0, abs=1e-14)


@given(quaternions, points)
def test_a_vector_is_turned_as_by_the_rotation_matrix(q: Quaternion, v: Vector3) -> None:
    assert rotate(q, v) == pytest.approx(tuple(Rotation.from_quat(q).apply(v)), abs=1e-9)


# Transforms


@given(transforms, transforms)
def test_composition_is_the_product_of_matrices(a: Transform, b: Transform) -> None:
    assert np.allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=1e-8)


@given(transforms)
def test_inversion_is_the_inverse_matrix(t: Transform) -> None:
    assert np.allclose(matrix(invert(t)), np.linalg.inv(matrix(t)), atol=1e-8)


@given(transforms)
def test_a_transform_and_its_inverse_compose_to_nothing(t: Transform) -> None:
    for both in (compose(t, invert(t)), compose(invert(t), t)):
        assert both.translation == pytest.approx((0.0, 0.0, 0.0), abs=1e-8)
        assert angle_between(both.rotation, IDENTITY.rotation) < 1e-7


@given(transforms)
def test_the_identity_changes_nothing(t: Transform) -> None:
    assert compose(IDENTITY, t) == t
    assert compose(t, IDENTITY) == t


@given(transforms, transforms, transforms)
def test_composition_is_associative(a: Transform, b: Transform, c: Transform) -> None:
    left, right = compose(compose(a, b), c), compose(a, compose(b, c))
    assert np.allclose(matrix(left), matrix(right), atol=1e-7)


@given(quaternions, quaternions, ratios)
def test_slerp_is_the_one_of_an_independent_library(
    a: Quaternion, b: Quaternion, ratio: float
) -> None:
    # Half a turn apart both ways round are the shortest; rounding decides.
    assume(angle_between(a, b) < math.pi - 1e-3)
    expected = Slerp([0, 1], Rotation.from_quat([a, b]))(ratio).as_quat()
    assert angle_between(slerp(a, b, ratio), tuple(expected)) < 1e-6


@given(quaternions, st.floats(0, 1e-4), ratios)
def test_slerp_between_nearly_parallel_rotations_keeps_an_even_speed(
    a: Quaternion, angle: float, ratio: float
) -> None:
    b = multiply(a, about_z(angle))
    expected = multiply(a, about_z(angle * ratio))
    assert slerp(a, b, ratio) == pytest.approx(expected, abs=1e-12)


@given(quaternions, quaternions, ratios)
def test_slerp_stays_a_rotation_whatever_it_is_given(
    a: Quaternion, b: Quaternion, ratio: float
) -> None:
    assert norm(slerp(a, b, ratio)) == pytest.approx(1.0, abs=1e-12)


@given(quaternions, quaternions)
def test_slerp_begins_and_ends_at_its_ends(a: Quaternion, b: Quaternion) -> None:
    assert slerp(a, b, 0.0) == pytest.approx(a, abs=1e-12)
    assert angle_between(slerp(a, b, 1.0), b) < 1e-7


@given(quaternions, quaternions, ratios)
def test_slerp_goes_the_shorter_way(a: Quaternion, b: Quaternion, ratio: float) -> None:
    between = slerp(a, b, ratio)
    whole = angle_between(a, b)
    assert angle_between(a, between) == pytest.approx(ratio * whole, abs=1e-6)
    x, y, z, w = b
    assert angle_between(between, slerp(a, (-x, -y, -z, -w), ratio)) < 1e-6 or whole > 3.14


@given(transforms, transforms, ratios)
def test_an_interpolated_translation_lies_on_the_straight_line(
    a: Transform, b: Transform, ratio: float
) -> None:
    between = interpolate(a, b, ratio)
    expected = np.array(a.translation) * (1 - ratio) + np.array(b.translation) * ratio
    assert between.translation == pytest.approx(tuple(expected), abs=1e-9)
    assert between.rotation == slerp(a.rotation, b.rotation, ratio)


# Paths


def test_a_distance_is_straight_and_in_three_dimensions() -> None:
    assert distance((1.0, 1.0, 1.0), (3.0, 4.0, 7.0)) == 7.0


def simplify(path: Sequence[Vector3], tolerance_m: float) -> list[int]:
    """Without a limit on the vertices."""
    return simplify_to(path, tolerance_m, max(len(path), 2))[0]


def _off_segment(p: Vector3, a: Vector3, b: Vector3) -> float:
    """Distance of a point from a segment, written independently of the code under test."""
    start, along, to = np.array(a), np.array(b) - np.array(a), np.array(p) - np.array(a)
    squared = float(along @ along)
    ratio = 0.0 if squared == 0 else min(1.0, max(0.0, float(to @ along) / squared))
    return float(np.linalg.norm(start + ratio * along - np.array(p)))


def _worst(path: Sequence[Vector3], kept: Sequence[int]) -> float:
    """The largest distance of a dropped point from the kept segment that spans it."""
    return max(
        (
            _off_segment(path[index], path[start], path[end])
            for start, end in pairwise(kept)
            for index in range(start + 1, end)
        ),
        default=0.0,
    )


@given(any_paths, st.floats(0.0, 20.0))
def test_every_dropped_point_lies_within_the_tolerance(
    path: list[Vector3], tolerance_m: float
) -> None:
    kept = simplify(path, tolerance_m)
    assert _worst(path, kept) <= tolerance_m + 1e-9


@given(any_paths, st.floats(0.0, 20.0))
def test_simplifying_keeps_both_ends_and_the_order(path: list[Vector3], tolerance_m: float) -> None:
    kept = simplify(path, tolerance_m)
    assert kept == sorted(set(kept))
    if path:
        assert (kept[0], kept[-1]) == (0, len(path) - 1)


@given(any_paths, st.integers(2, 20))
def test_a_limit_on_vertices_is_kept_and_the_true_deviation_told(
    path: list[Vector3], at_most: int
) -> None:
    kept, error_m = simplify_to(path, 0.05, at_most)
    assert len(kept) <= at_most
    assert error_m == pytest.approx(_worst(path, kept), abs=1e-9)
    assert error_m <= 0.05 or len(kept) == at_most


@given(any_paths, st.floats(0.0, 5.0))
def test_a_limit_that_does_not_bind_changes_nothing(
    path: list[Vector3], tolerance_m: float
) -> None:
    kept, error_m = simplify_to(path, tolerance_m, max(len(path), 2))
    assert kept == simplify_to(path, tolerance_m, 10**6)[0]
    assert error_m <= tolerance_m


@pytest.mark.parametrize("tolerance_m", [0.0, 0.01, 0.1, 3.0])
@pytest.mark.parametrize("seed", range(4))
def test_many_points_are_simplified_as_one_interval_after_the_other_is(
    seed: int, tolerance_m: float
) -> None:
    draw = np.random.default_rng(seed)
    speed = np.repeat(draw.choice([0.0, 0.0, 0.3, -0.3], 60), 20)[:, None]
    turn = np.cumsum(np.repeat(draw.normal(0.0, 0.05, 60), 20))
    steps = speed * np.stack([np.cos(turn), np.sin(turn), 0.1 * np.sin(3 * turn)], 1)
    path = [(x, y, z) for x, y, z in np.cumsum(steps, axis=0).tolist()]
    for seconds in (None, np.cumsum(draw.exponential(0.2, len(path))).tolist()):
        kept, off = simplifying(path, tolerance_m, len(path), seconds)
        found, error_m = simplify_to(path, tolerance_m, len(path), seconds)
        assert found == sorted(kept)
        assert error_m == pytest.approx(off[-1], abs=1e-9)


def test_a_spiral_whose_splits_stay_lopsided_is_simplified_in_bounded_time() -> None:
    path = [(0.99**n, 0.0, float(n % 2) * 0.99**n) for n in range(3000)]
    kept, error_m = simplify_to(path, 0.0, len(path))
    assert kept == sorted(set(kept))
    assert error_m == 0.0


def test_points_too_far_off_to_be_squared_are_simplified_all_the_same() -> None:
    path = [(float(x) * 1e200, 0.0, 0.0) for x in range(300)]
    assert simplify_to(path, 1.0, len(path))[0][0] == 0


def test_a_corner_is_kept_and_a_straight_line_is_not_sampled() -> None:
    path = [(float(x), 0.0, 0.0) for x in range(11)] + [(10.0, float(y), 0.0) for y in range(1, 6)]
    assert simplify(path, 0.01) == [0, 10, 15]


@pytest.mark.parametrize("count", [3, 10])
def test_points_on_a_line_are_dropped_at_any_tolerance(count: int) -> None:
    # Not 0: the foot of a perpendicular is rounded.
    assert simplify([(float(x), 0.0, 0.0) for x in range(count)], 1e-12) == [0, count - 1]


def test_a_long_way_with_one_corner_keeps_that_corner_only() -> None:
    path = [(min(i, 700) * 0.1, max(i - 700, 0) * 0.1, 0.0) for i in range(10_000)]
    assert simplify(path, 0.01) == [0, 700, 9_999]


def test_a_way_out_and_back_keeps_its_turning_point() -> None:
    path = [(float(x), 0.0, 0.0) for x in (0, 1, 2, 3, 2, 1, 0)]
    assert simplify(path, 0.01) == [0, 3, 6]


def test_height_counts_in_a_simplified_path() -> None:
    assert simplify([(0.0, 0.0, 0.0), (1.0, 0.0, 1.0), (2.0, 0.0, 0.0)], 0.1) == [0, 1, 2]


def test_the_fewest_vertices_show_the_largest_features_first() -> None:
    path = [(0.0, 0.0, 0.0), (1.0, 0.1, 0.0), (2.0, 0.0, 0.0), (3.0, 5.0, 0.0), (4.0, 0.0, 0.0)]
    assert simplify_to(path, 0.01, 3)[0] == [0, 3, 4]


def test_fewer_vertices_than_two_are_refused() -> None:
    with pytest.raises(ValueError, match="1 vertices"):
        simplify_to([(0.0, 0.0, 0.0)], 0.05, 1)


@pytest.mark.parametrize("shape", ["zigzag", "arc"])
def test_a_long_path_is_simplified_within_its_tolerance(shape: str) -> None:
    """A zigzag of growing width splits off one point at a time: the lopsided case."""
    count = 20_000
    path = [
        ((-1) ** i * i * 1e-3, i * 1e-3, 0.0)
        if shape == "zigzag"
        else (10 * math.cos(i / 5000), 10 * math.sin(i / 5000), 0.0)
        for i in range(count)
    ]
    kept = simplify(path, 0.05)
    assert _worst(path, kept) <= 0.05 + 1e-9
    assert len(kept) < count / 2 if shape == "zigzag" else len(kept) < 100


_coordinates = st.floats(-1e6, 1e6) | st.sampled_from([0.0, -0.0, 1e200, -1e200])
_anywhere = st.tuples(_coordinates, _coordinates, _coordinates)


@given(st.lists(st.tuples(_cell, _cell, _cell) | _anywhere, min_size=48, max_size=90))
def test_many_points_are_looked_through_as_arrays_with_the_same_result(path: list[Vector3]) -> None:
    last = len(path) - 1
    assert _columns(path) is not None
    assert _farthest(path, _columns(path), 0, last) == _farthest(path, None, 0, last)

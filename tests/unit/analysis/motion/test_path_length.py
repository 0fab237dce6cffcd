"""How far, how fast and where a robot drove, by poses with noise, gaps, resets and turns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.motion.trajectory import Trajectory
from ros2_memory.core.timebase import NS_PER_S
from tests.support.examples import examples
from tests.unit.analysis.motion.posed import posed, way_of

if TYPE_CHECKING:
    from collections.abc import Sequence

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
    draw = np.random.default_rng(seed)
    off = draw.normal(0.0, sigma, points.shape)
    off[:, axes:] = 0.0
    return points + off


def plain_sum(points: Points) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def summarise(points: Points, hertz: float, cuts: Sequence[int] | None = None) -> Trajectory:
    """Measured in slices of the clock, or in parts cut at these poses."""
    rows = [(BEGIN + round(nth * S / hertz), place) for nth, place in enumerate(points.tolist())]
    return way_of(posed(rows), 10.0, cuts).trajectory()


def cuts_of(poses: Points, count: int, seed: int) -> list[int]:
    return sorted(np.random.default_rng(seed).choice(len(poses), count, replace=False).tolist())


@settings(max_examples=examples(30), deadline=None)
@given(
    st.sampled_from([20, 50]),
    st.floats(0.1, 2.0),
    st.integers(1, 40),
    st.integers(0, 10**6),
    st.booleans(),
)
def test_other_cuts_of_a_history_differ_by_half_a_percent_at_most(
    hertz: int, speed: float, count: int, seed: int, curved: bool
) -> None:
    poses = noisy((arc if curved else line)(speed, hertz, 120), 0.005, seed)
    whole = summarise(poses, hertz).totals.distance_m
    assert summarise(poses, hertz, cuts_of(poses, count, seed)).totals.distance_m == pytest.approx(
        whole, rel=0.005
    )


@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 300))
def test_without_noise_any_cuts_give_the_same_length(seed: int, count: int) -> None:
    poses = arc(0.5, 20, 60)
    found = summarise(poses, 20, cuts_of(poses, count, seed))
    assert found.totals.distance_m == pytest.approx(plain_sum(poses), rel=1e-9)


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

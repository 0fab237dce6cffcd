"""Two ways of the robot, against points that are laid along them one by one."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.motion.robot_track import RobotTrack
from ros2_memory.core.model import TimeWindow
from ros2_memory.places.two_paths import (
    PlacedStandstill,
    farthest_apart,
    stood_at,
)
from tests.support.examples import examples

S = 10**9
EVER = TimeWindow.everything()

Vertex = tuple[float, float, float]
"""Seconds, and a place (m)."""


def track(*pieces: Sequence[Vertex]) -> RobotTrack:
    """A track of pieces between which the robot was not seen."""
    every = [vertex for piece in pieces for vertex in piece]
    times, x, y = (np.array(column, np.float64) for column in zip(*every, strict=True))
    begins = [nth == 0 for piece in pieces for nth in range(len(piece))]
    return RobotTrack((times * S).astype(np.int64), x, y, 0 * x, np.array(begins))


def points_of(piece: Sequence[Vertex]) -> list[tuple[float, float]]:
    found = []
    for (_, x, y), (_, to_x, to_y) in zip(piece, [*piece[1:], piece[-1]], strict=True):
        parts = max(1, math.ceil(math.hypot(to_x - x, to_y - y) / 0.03))
        found += [
            (x + (to_x - x) * nth / parts, y + (to_y - y) * nth / parts) for nth in range(parts + 1)
        ]
    return found


ways = st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=5).map(
    lambda each: [(nth * 5.0, x, y) for nth, (x, y) in enumerate(each)]
)


@settings(max_examples=examples(25))
@given(ways, ways)
@example([(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)])
@example([(0.0, 0.0, 0.0), (5.0, 3.0, 0.0)], [(0.0, 1.0, 1.0), (5.0, 1.0, -3.0)])
def test_the_farthest_point_is_as_far_as_any_laid_along_the_way(
    one: list[Vertex], two: list[Vertex]
) -> None:
    found = farthest_apart((track(one), EVER), (track(two), EVER))
    laid = np.array(points_of(one)), np.array(points_of(two))
    for point, own, other in zip(found, laid, laid[::-1], strict=True):
        assert point is not None
        away = np.hypot(*(own[:, None] - other[None]).transpose(2, 0, 1)).min(axis=1)
        assert point.away_m == pytest.approx(float(away.max()), abs=0.16)
        here = np.array(point.place)
        assert np.hypot(*(own - here).T).min() < 0.03
        assert np.hypot(*(other - here).T).min() == pytest.approx(point.away_m, abs=0.03)


stands = st.lists(
    st.builds(
        PlacedStandstill,
        st.floats(0, 3),
        st.floats(0, 3),
        st.integers(0, 10**9),
        st.integers(1, 10**9),
    ),
    max_size=8,
)


@settings(max_examples=examples(40))
@given(stands, stands)
def test_every_standstill_is_of_one_place_and_near_to_it(
    one: list[PlacedStandstill], two: list[PlacedStandstill]
) -> None:
    found = stood_at(one, two)
    for side, given_ones in enumerate((one, two)):
        seconds = sum(at.seconds[side] or 0.0 for at in found)
        assert seconds == pytest.approx(sum(each.duration for each in given_ones) / S)
        for each in given_ones:
            assert min(math.dist(at.place, (each.x, each.y)) for at in found) <= 0.5
    assert {at.place for at in found} <= {(each.x, each.y) for each in (*one, *two)}
    assert [at.seconds for at in stood_at(two, one)] == [at.seconds[::-1] for at in found]

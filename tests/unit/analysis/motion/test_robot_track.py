"""The track of the robot: few vertices, and near every pose at its time."""

import math
from dataclasses import replace
from itertools import combinations_with_replacement, pairwise
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ros2_memory.analysis.motion.robot_track import (
    TOLERANCE_M,
    TOLERANCE_OF_HEIGHT_M,
    TOLERANCE_RAD,
    PartialTrack,
    RobotTrack,
    cut_track,
    joined_tracks,
    partial_track,
    settled_tracks,
    slot_ends,
    track_by,
    track_of,
)
from ros2_memory.core.model import TimeWindow
from tests.support.examples import examples

MS = 10**6
S = 10**9
START = 1_700_000_000 * S


def driven(seed: int) -> list[NDArray[Any]]:
    """Times, x, y, z and headings of who drives on, turns, climbs and stands, at 25 Hz."""
    draw, climbs = Random(seed), Random(-seed - 1)
    at, x, y, z, heading = START, 0.0, 0.0, 0.0, 0.0
    poses = []
    speed, rate, lift = 0.0, 0.0, 0.0
    for _ in range(1500):
        if draw.random() < 0.02:
            speed, rate = draw.choice([(0.0, 0.0), (0.4, 0.0), (0.3, 0.5), (0.0, 1.0)])
        if climbs.random() < 0.01:
            lift = climbs.choice([0.0, 0.0, 0.5, -0.5])
        z += lift * 0.04
        at += 40 * MS + draw.randrange(MS)
        heading += rate * 0.04
        x += speed * 0.04 * math.cos(heading)
        y += speed * 0.04 * math.sin(heading)
        poses.append((at, x, y, z, math.remainder(heading, math.tau)))
    return [*map(np.array, zip(*poses, strict=True))]


@pytest.mark.parametrize("seed", range(3))
def test_every_pose_is_near_the_track_at_its_time(seed: int) -> None:
    times, x, y, z, heading = driven(seed)
    track = track_of(times, x, y, z, heading)
    track_x, track_y, track_z, track_heading = (
        np.interp(times - START, track.times - START, column)
        for column in (track.x, track.y, track.z, track.heading)
    )
    assert np.hypot(track_x - x, track_y - y).max() <= TOLERANCE_M + 0.01
    assert np.abs(track_z - z).max() <= TOLERANCE_OF_HEIGHT_M + 0.05
    off = np.remainder(track_heading - heading + math.pi, math.tau) - math.pi
    assert np.abs(off).max() <= TOLERANCE_RAD + 0.05
    assert {*track.times.tolist()} <= {*times.tolist()}
    assert len(track.times) < len(times) / 3


def same(one: RobotTrack, other: RobotTrack) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name == "heading")
        for name in ("times", "x", "y", "z", "heading", "begins")
    )


@settings(max_examples=examples(40))
@given(
    seed=st.integers(0, 999), cuts=st.lists(st.integers(1, 1499), max_size=6), thins=st.booleans()
)
def test_a_track_does_not_depend_on_how_its_poses_are_cut(
    seed: int, cuts: list[int], thins: bool
) -> None:
    columns = driven(seed)

    def part(begin: int, end: int) -> PartialTrack:
        some = [column[begin:end] for column in columns]
        if thins:
            index = slot_ends(some[0])
            some = [column[index] for column in some]
        times, x, y, z, heading = some
        return partial_track(times, x, y, z, heading)

    whole = track_by(*joined_tracks([[part(0, 1500)]]))
    parts = [part(*ends) for ends in pairwise([0, *sorted({*cuts}), 1500])]
    assert same(track_by(*joined_tracks([parts])), whole)
    assert same(track_by(*joined_tracks([parts[::-1]])), whole)
    middle = len(parts) // 2
    stretches = [*settled_tracks(parts[:middle]), *settled_tracks(parts[middle:])]
    assert same(track_by(*joined_tracks([stretches])), whole)


METRES = st.floats(-50, 50)
STEPS = st.tuples(st.integers(1, 20), METRES, METRES, METRES, st.floats(-1.5, 1.5))
"""Seconds since the pose before, x, y, z and heading."""


@given(st.lists(STEPS, max_size=6))
def test_a_track_that_is_cut_is_where_the_whole_one_is(
    steps: list[tuple[int, float, float, float, float]],
) -> None:
    """In every window whose first and last time are at, just beside or between vertices."""
    rows = np.array(steps).reshape(-1, 5)
    times = START + np.cumsum(rows[:, 0]).astype(np.int64) * S
    track = replace(track_of(times, *rows[:, 1:].T), fastest_mps=2.0)
    vertices = track.times.tolist()
    ends = [at + by for at in vertices for by in (-1, 0, 1, S // 2)] or [START]
    for first, last in combinations_with_replacement(ends, 2):
        found = cut_track(track, TimeWindow(first, last + 1))
        assert found.times.tolist() == times_inside(track, first, last)
        begins = track.pieces[0].tolist()
        assert found.times[found.begins].tolist() == [at for at in begins if first <= at <= last]
        assert found.fastest_mps == track.fastest_mps
        for name in ("x", "y", "z", "heading"):
            whole = getattr(track, name)
            at_s, vertex_s = (found.times - START) / S, (track.times - START) / S
            expected = np.interp(at_s, vertex_s, whole) if len(whole) else whole
            assert getattr(found, name) == pytest.approx(expected, abs=1e-5)


def times_inside(track: RobotTrack, first: int, last: int) -> list[int]:
    """The vertices from the first to the last time, and these two where a piece has them."""
    vertices = {at for at in track.times.tolist() if first <= at <= last}
    pieces = [*zip(*track.pieces, strict=True)]
    ends = {end for end in (first, last) if any(begin <= end <= stop for begin, stop in pieces)}
    return sorted(vertices | ends)

"""The track of the robot: few vertices, and near every pose at its time."""

import math
from itertools import pairwise
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.motion.robot_track import (
    TOLERANCE_M,
    TOLERANCE_RAD,
    PartialTrack,
    RobotTrack,
    joined_tracks,
    partial_track,
    settled_tracks,
    slot_ends,
    track_by,
    track_of,
)
from tests.support.examples import examples

MS = 10**6
S = 10**9
START = 1_700_000_000 * S


def driven(seed: int) -> tuple[list[int], list[float], list[float], list[float]]:
    """Drives on, turns on the spot and stands, at 25 Hz."""
    draw = Random(seed)
    at, x, y, heading = START, 0.0, 0.0, 0.0
    times: list[int] = []
    poses: list[tuple[float, float, float]] = []
    speed, rate = 0.0, 0.0
    for _ in range(1500):
        if draw.random() < 0.02:
            speed, rate = draw.choice([(0.0, 0.0), (0.4, 0.0), (0.3, 0.5), (0.0, 1.0)])
        at += 40 * MS + draw.randrange(MS)
        heading += rate * 0.04
        x += speed * 0.04 * math.cos(heading)
        y += speed * 0.04 * math.sin(heading)
        times.append(at)
        poses.append((x, y, math.remainder(heading, math.tau)))
    xs, ys, headings = ([*column] for column in zip(*poses, strict=True))
    return times, xs, ys, headings


def of(rows: tuple[list[int], list[float], list[float], list[float]]) -> RobotTrack:
    times, x, y, heading = rows
    return track_of(np.array(times, np.int64), np.array(x), np.array(y), np.array(heading))


@pytest.mark.parametrize("seed", range(3))
def test_every_pose_is_near_the_track_at_its_time(seed: int) -> None:
    rows = driven(seed)
    track = of(rows)
    times = np.array(rows[0])
    x, y, heading = (
        np.interp(times - START, track.times - START, column)
        for column in (track.x, track.y, track.heading)
    )
    assert np.hypot(x - np.array(rows[1]), y - np.array(rows[2])).max() <= TOLERANCE_M + 0.01
    off = np.remainder(heading - np.array(rows[3]) + math.pi, math.tau) - math.pi
    assert np.abs(off).max() <= TOLERANCE_RAD + 0.05
    assert {*track.times.tolist()} <= {*rows[0]}
    assert len(track.times) < len(times) / 3


def same(one: RobotTrack, other: RobotTrack) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name == "heading")
        for name in ("times", "x", "y", "heading", "begins")
    )


@settings(max_examples=examples(40), deadline=None)
@given(
    seed=st.integers(0, 999), cuts=st.lists(st.integers(1, 1499), max_size=6), thins=st.booleans()
)
def test_a_track_does_not_depend_on_how_its_poses_are_cut(
    seed: int, cuts: list[int], thins: bool
) -> None:
    columns = [np.array(column) for column in driven(seed)]

    def part(begin: int, end: int) -> PartialTrack:
        some = [column[begin:end] for column in columns]
        if thins:
            index = slot_ends(some[0])
            some = [column[index] for column in some]
        times, x, y, heading = some
        return partial_track(times, x, y, heading)

    whole = track_by(*joined_tracks([[part(0, 1500)]]))
    parts = [part(*ends) for ends in pairwise([0, *sorted({*cuts}), 1500])]
    assert same(track_by(*joined_tracks([parts])), whole)
    assert same(track_by(*joined_tracks([parts[::-1]])), whole)
    middle = len(parts) // 2
    stretches = [*settled_tracks(parts[:middle]), *settled_tracks(parts[middle:])]
    assert same(track_by(*joined_tracks([stretches])), whole)

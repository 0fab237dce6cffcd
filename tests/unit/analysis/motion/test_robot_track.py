"""The track of the robot: few vertices, and near every pose at its time."""

import math
from random import Random

import numpy as np
import pytest

from ros2_memory.analysis.motion.robot_track import (
    TOLERANCE_M,
    TOLERANCE_RAD,
    RobotTrack,
    track_of,
)

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

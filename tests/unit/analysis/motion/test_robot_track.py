"""The track of the robot: few vertices, and near every pose at its time."""

from __future__ import annotations

import math
import zlib
from random import Random

import numpy as np
import pytest

from ros2_memory.analysis.motion.robot_track import (
    TOLERANCE_M,
    RobotTrack,
    decode_track,
    decode_tracks,
    empty_track,
    encode_track,
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


@pytest.mark.parametrize("seed", range(10))
def test_every_pose_is_near_the_track_at_its_time(seed: int) -> None:
    rows = driven(seed)
    track = of(rows)
    times = np.array(rows[0])
    x, y = (np.interp(times, track.times, column) for column in (track.x, track.y))
    off = np.hypot(x - np.array(rows[1]), y - np.array(rows[2]))
    assert off.max() <= track.error_m + 0.001  # it is rounded to milliseconds
    assert track.error_m <= TOLERANCE_M + 0.001
    turned = np.interp(times, track.times, track.heading) - np.array(rows[3])
    assert np.abs(np.remainder(turned + np.pi, 2 * np.pi) - np.pi).max() < 0.2
    assert len(track.times) < 250


@pytest.mark.parametrize("seed", range(10))
def test_a_track_that_is_stored_is_the_same(seed: int) -> None:
    track = of(driven(seed))
    packed = encode_track(track)
    again = decode_track(packed)
    for name in ("times", "x", "y", "heading", "begins"):
        assert np.array_equal(getattr(again, name), getattr(track, name)), name
    assert again.error_m == track.error_m
    assert len(zlib.compress(packed)) < 12 * len(track.times) + 60


def test_tracks_that_are_read_together_are_those_of_each() -> None:
    tracks = [of(driven(seed)) for seed in range(4)]
    tracks[1:1] = [empty_track(), of(([START], [1.0], [2.0], [math.nan]))]
    tracks.append(empty_track())
    packed = [*map(encode_track, tracks)]
    assert [*map(encode_track, decode_tracks(packed))] == packed
    assert decode_tracks([]) == []
    with pytest.raises(ValueError, match="not a track"):
        decode_tracks([*packed, packed[0][:-1]])


def test_a_robot_that_stands_takes_a_few_bytes() -> None:
    times = [START + n * 20 * MS for n in range(3000)]
    track = of((times, [1.0] * 3000, [2.0] * 3000, [0.5] * 3000))
    assert len(track.times) == 2
    assert len(encode_track(track)) < 120


def test_a_long_silence_begins_a_piece() -> None:
    times = [START, START + S, START + 30 * S, START + 31 * S]
    track = of((times, [0.0, 1.0, 2.0, 3.0], [0.0] * 4, [0.0] * 4))
    assert track.begins.tolist() == [True, False, True, False]


def test_an_unknown_heading_stays_unknown() -> None:
    track = of(([START, START + S], [0.0, 1.0], [0.0, 0.0], [math.nan, math.nan]))
    assert np.isnan(decode_track(encode_track(track)).heading).all()


def test_poses_that_are_no_place_are_left_out() -> None:
    track = of(([START, START + S, START + 2 * S], [0.0, math.nan, 1e30], [0.0] * 3, [0.0] * 3))
    assert track.x.tolist() == [0.0]


def test_without_a_pose_there_is_no_track() -> None:
    assert not len(of(([], [], [], [])).times)
    assert not len(decode_track(encode_track(empty_track())).times)


@pytest.mark.parametrize("damaged", [b"x", b"\0" * 60])
def test_other_bytes_are_refused(damaged: bytes) -> None:
    with pytest.raises(ValueError, match=r"not a track|buffer"):
        decode_track(damaged)

"""Tracks as bytes: what comes back is what was stored."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.motion.robot_track import track_part
from ros2_memory.columns.fragments import Fragment
from ros2_memory.columns.tracks import TRACKS
from tests.support.examples import examples

S = 10**9
POSES = st.lists(
    st.tuples(
        st.integers(0, 20 * S),
        st.floats(-2e6, 2e6),
        st.floats(-100, 100),
        st.floats(-math.pi, math.pi) | st.just(math.nan),
    ),
    max_size=60,
)


@settings(max_examples=examples(60))
@given(poses=POSES, begin=st.integers(-(2**62), 2**62), left_out=st.integers(0, 1000))
def test_a_track_comes_back_from_its_bytes(
    poses: list[tuple[int, float, float, float]], begin: int, left_out: int
) -> None:
    steps, xs, ys, headings = zip(*poses, strict=True) if poses else ((), (), (), ())
    times = begin + np.cumsum(np.array(steps, np.int64))
    part = track_part(times, np.array(xs), np.array(ys), np.array(headings), left_out)
    found = TRACKS.load(Fragment.from_bytes(TRACKS.store(part).to_bytes()))
    assert found.left_out == part.left_out
    for name in ("times", "x", "y", "turns", "known", "settled"):
        assert np.array_equal(getattr(found, name), getattr(part, name)), name


def test_a_robot_that_stands_takes_few_bytes() -> None:
    times = np.arange(0, 600 * S, S // 25) + 1_700_000_000 * S
    level = np.ones(times.size)
    assert len(TRACKS.store(track_part(times, level, level, level)).to_bytes()) < 1000

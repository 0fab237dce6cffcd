"""Transforms from columns are those that the messages hold, stored or not, however they are cut."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.history.transforms import frames_over
from ros2_memory.history.view import View
from tests.support.bags import Msg, tf, transform, write_mcap
from tests.support.column_worlds import World
from tests.support.examples import examples

if TYPE_CHECKING:
    from ros2_memory.history.sessions import Session

S = 10**9
T0 = 1_784_000_000 * S
SECONDS = 40


def message(second: int) -> Msg:
    """A robot whose map moves, and edges that tf2 refuses."""
    at = T0 + second * S
    edges = [
        transform(at + 5, "map", "odom", (second / 3, 0.0, 0.0), second / 50),
        transform(at, "/odom", "base", (math.pi * second, -second / 7, 0.0), second / 7),
    ]
    if second % 5 == 0:
        edges += [
            transform(at, "base", "base", (1.0, 0.0, 0.0)),
            transform(at, "base", "gone", (math.nan, 0.0, 0.0)),
        ]
    return tf(at, *edges[second % 2 :])


def world(folder: Path, cuts: list[int]) -> World:
    mounts = {0: 1.0, 25: 2.0}
    for number, (begin, end) in enumerate(pairwise([0, *sorted({*cuts}), SECONDS])):
        messages = [message(second) for second in range(begin, end)]
        # Each split has the static transforms again, as some recorders write them.
        x = max((at, x) for at, x in mounts.items() if at <= begin)[1]
        at = T0 + begin * S
        mount = transform(T0, "base", "camera", (x, 0.0, 0.0))
        messages.append(tf(at, mount, topic="/tf_static"))
        write_mcap(folder / "rec" / f"rec_{number}.mcap", messages)
    return World.of(folder)


def session_of(view: View) -> Session:
    [session] = {view.sessions.of(path) for path in view.snapshot.timeline.recordings("/tf")}
    return session


@settings(max_examples=examples(15), deadline=None)
@given(cuts=st.lists(st.integers(26, SECONDS - 1), max_size=4), stored=st.booleans())
def test_frames_are_the_same_however_a_history_is_cut_and_whatever_is_stored(
    cuts: list[int], stored: bool
) -> None:
    times = np.arange(T0 + 10 * S, T0 + 38 * S, S // 3)
    window = TimeWindow(int(times[0]), int(times[-1]) + 1)
    found = []
    for some in ([25], [25, *cuts]):
        with TemporaryDirectory() as name:
            made = world(Path(name), some)
            if stored and some == [25]:
                made.fill()
            view = View(made.memory, Call())
            poses = frames_over(view, session_of(view), window, "map").poses("camera", times)
            assert poses is not None
            assert poses.valid.all()
            found.append(np.stack([*poses.translation, *poses.rotation]))
    assert (found[0] == found[1]).all()

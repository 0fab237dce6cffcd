"""Which frame places are told in, however much of the history is in the catalogue."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.places.pose_frames import map_placement
from tests.support.memories import memory_of
from tests.support.moving_map import write_moving_map

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map that moves, in fifty bags."""
    folder = tmp_path_factory.mktemp("moving")
    write_moving_map(folder, 1, seconds=100, split_s=2.0)
    return folder


class _Looks:
    """A clock that shows how often it was looked at."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> float:
        self.count += 1
        return self.count


def test_a_map_of_which_it_is_not_known_whether_transforms_lead_there_is_not_denied(
    moving: Path,
) -> None:
    outcomes = set()
    for ticks in range(1, 40, 4):
        # A memory of its own each time: what one call found out, the next knows.
        view = View(memory_of(moving), Call(Deadline.after(ticks, _Looks())))
        try:
            outcomes.add(map_placement(view, "/odom", "map").frame_id)
        except QueryTimeoutError:
            outcomes.add("timeout")
    assert outcomes == {"map", "timeout"}

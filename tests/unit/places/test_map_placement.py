"""Which frame places are told in, however much of the history is in the catalogue."""

from itertools import count
from pathlib import Path

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.places.pose_frames import map_placement
from tests.support.memories import memory_of
from tests.support.moving_map import write_moving_map


def test_a_map_of_which_it_is_not_known_whether_transforms_lead_there_is_not_denied(
    tmp_path: Path,
) -> None:
    write_moving_map(tmp_path, 1, seconds=100, split_s=2.0)
    outcomes = set()
    for looks in range(1, 40, 4):  # how often the clock may be looked at before the time is over
        # A memory of its own each time: what one call found out, the next knows.
        view = View(memory_of(tmp_path), Call(Deadline.after(looks, map(float, count()).__next__)))
        try:
            outcomes.add(map_placement(view, "/odom", "map").frame_id)
        except QueryTimeoutError:
            outcomes.add("timeout")
    assert outcomes == {"map", "timeout"}

"""Of which recording a time of a topic is, where several reach over it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.places.pose_frames import recording_at
from tests.support.bags import odom, write_mcap
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
T0 = 1_700_000_000 * S


def test_a_recording_that_began_with_an_unset_clock_is_not_that_of_each_time(
    tmp_path: Path,
) -> None:
    for name, start in (("a/a_0", S), ("a/a_1", T0 + 500 * S), ("b/b_0", T0)):
        messages = [odom(start + n * S, n, 0) for n in range(10)]
        write_mcap(tmp_path / f"{name}.mcap", messages)
    view = View(memory_of(tmp_path), Call())
    assert recording_at(view, "/odom", T0 + 5 * S) == tmp_path / "b"
    assert recording_at(view, "/odom", T0 + 505 * S) == tmp_path / "a"
    # What is asked of a recording of its own stays with it, as long as that lasts.
    assert recording_at(view, "/odom", T0 + 5 * S, tmp_path / "a") == tmp_path / "a"
    assert recording_at(view, "/odom", T0 + 505 * S, tmp_path / "b") == tmp_path / "a"
    assert recording_at(view, "/odom", T0 + 999 * S) is None

"""What a recorder writes of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat

if TYPE_CHECKING:
    from pathlib import Path


def beat(
    bag_dir: Path, at: int, state: RecorderState = RecorderState.RECORDING, **more: Any
) -> None:
    """Writes what a recorder in a state writes at a time, in which it has been since then."""
    given: dict[str, Any] = {
        "pid": 1,
        "recordings": (),
        "since": at,
        "bytes_written": 0,
        "subscribed": (),
        "silent": (),
        "last_error": None,
        "interval_s": 2.0,
    }
    write_heartbeat(bag_dir, Heartbeat(updated=at, state=state, **(given | more)))

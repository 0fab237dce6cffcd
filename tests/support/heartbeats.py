"""What a recorder writes of itself."""

from pathlib import Path
from typing import Any

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat


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

"""`recorder=none`: bags come from elsewhere, and nothing is written into the bag directory."""

from __future__ import annotations

from ros2_memory.recorder.base import Recorder


class NullRecorder(Recorder):
    """Records nothing, starts nothing and touches no file."""

    def start(self) -> None:
        """Does nothing; `is_running` stays False."""

    def stop(self) -> None:
        """Does nothing."""

    def is_running(self) -> bool:
        """Always False."""
        return False

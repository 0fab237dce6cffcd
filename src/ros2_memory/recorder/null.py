"""The path under which configurations name `NullRecorder`; the class is in `recorder.base`."""

from ros2_memory.recorder.base import NullRecorder

__all__ = ["NullRecorder"]

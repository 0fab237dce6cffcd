"""The bags of the demo's robot at a moment at which somebody asks about it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ros2_memory.core.timebase import ns_from_unix
from ros2_memory.demo.messages import MessageSchedule
from ros2_memory.demo.recording import DemoRecorder
from tests.support.clocks import FixedClock

STARTED_S = 1_784_023_200
"""When the robot started, in Unix seconds: it was on its dock."""
HEARD_AFTER_S = 17
"""Seconds after its start from which on it is recorded."""
ASKED_AT_S = STARTED_S + 240.5


@contextmanager
def recorded(folder: Path) -> Iterator[None]:
    """Three laps of which the last split is open: the robot stands on its dock again."""
    start = ns_from_unix(STARTED_S)
    now = ns_from_unix(ASKED_AT_S)
    timeline = MessageSchedule(start, start + ns_from_unix(HEARD_AFTER_S))
    recorder = DemoRecorder(folder / "flat", timeline, split_duration_s=10.0, clock=FixedClock(now))
    for path in folder.rglob("*.mcap"):
        os.utime(path, ns=(now, now))  # however long it took to write them
    yield
    recorder.stop()

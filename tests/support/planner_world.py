"""The bags of the demo's robot at the moment at which a planner asks about it."""

from __future__ import annotations

import os
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.timebase import ns_from_unix
from ros2_memory.demo.judges import CallContext
from ros2_memory.demo.published_topics import MessageSchedule
from ros2_memory.demo.recording import DemoRecorder
from tests.support.clocks import FixedClock
from tests.support.planner_judges import ASKED_AT_S, HEARD_AFTER_S, STARTED_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@dataclass(frozen=True)
class World:
    """The bags of a robot that is heard still, and what is known of it."""

    folder: Path
    asked: CallContext


@contextmanager
def recorded(folder: Path) -> Iterator[World]:
    """Three laps of which the last split is open: the robot stands on its dock again."""
    start = ns_from_unix(STARTED_S)
    now = ns_from_unix(ASKED_AT_S)
    timeline = MessageSchedule(start, start + ns_from_unix(HEARD_AFTER_S))
    recorder = DemoRecorder(folder / "flat", timeline, split_duration_s=10.0, clock=FixedClock(now))
    recorder.write_until(now)
    for path in folder.rglob("*.mcap"):
        os.utime(path, ns=(now, now))  # however long it took to write them
    yield World(folder, CallContext(timeline, now, now, recorder.closed_ends(now, now)))
    recorder.stop()

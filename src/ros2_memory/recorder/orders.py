"""What a recorder is to record, for how long, and with what."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.recorder.handover.transfer import SUBSCRIBE_TIMEOUT_S

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.timebase import Clock
    from ros2_memory.recorder.process.child import Child
    from ros2_memory.recorder.process.topics import TopicsFile
    from ros2_memory.recorder.reception.reception import Reception
    from ros2_memory.storage.base import BagReader


@dataclass(frozen=True, slots=True)
class Required:
    """An entry of `recording.required`: a name or a glob, and the least messages a second."""

    topic: str
    min_hz: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """What to record, and with what. Durations are in seconds.

    Attributes:
        bag_dir: where recordings are made.
        split_duration_s: how long one bag file is.
        session_duration_s: how long a recording lasts before the next takes over.
        min_free_bytes: what must be free on the disk for recording to continue.
        start_child: starts the `ros2 bag record` of a recording, given its name and directory.
        reader: reads splits that are closed.
        clock: the wall clock.
        topics: the list of topics to record.
        own: the list of recordings that were made here.
        reception: plans how topics are subscribed, and measures how they arrive.
        required: the topics without which recording counts as failed.
        simulated: log times come from a simulated clock.
        advice: says what to do where publishers are subscribed to and not heard.
        subscribe_timeout_s: how long a handover waits for topics (see `handover.transfer`).
    """

    bag_dir: Path
    split_duration_s: float
    session_duration_s: float
    min_free_bytes: int
    start_child: Callable[[str, Path], Child]
    reader: BagReader
    clock: Clock
    topics: TopicsFile
    own: OwnRecordings
    reception: Reception
    required: Sequence[Required] = ()
    simulated: bool = False
    advice: Callable[[], str] = str
    subscribe_timeout_s: float = SUBSCRIBE_TIMEOUT_S

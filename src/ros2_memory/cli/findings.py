"""What `doctor` finds: how bad it is, what was seen, and what to do about it."""

from __future__ import annotations

from enum import IntEnum
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.heartbeat import Heartbeat, read_heartbeat
from ros2_memory.config import NullRecorderNode, Settings

if TYPE_CHECKING:
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Memory
    from ros2_memory.index.snapshot import Snapshot


class Examined(NamedTuple):
    """The robot that a check looks at; `now` is the wall clock's time."""

    settings: Settings
    memory: Memory
    snapshot: Snapshot
    now: Ns

    @property
    def records(self) -> bool:
        """Whether bags are recorded there."""
        return not isinstance(self.settings.recorder, NullRecorderNode)

    @property
    def live(self) -> Heartbeat | None:
        """The heartbeat of a recorder that is at work."""
        heartbeat = read_heartbeat(self.settings.recording.bag_dir).heartbeat
        return heartbeat if heartbeat and heartbeat.is_live(self.now) else None


class Level(IntEnum):
    """How bad a finding is; its value is the exit code."""

    OK = 0
    WARNING = 1
    ERROR = 2


class Finding(NamedTuple):
    """What was seen, and what to do about it; nothing where all is in order.

    `about` is empty where it is the concern of the check.
    """

    level: Level
    seen: str
    do: str | None = None
    about: str = ""


ok: Final = partial(Finding, Level.OK)
warning: Final = partial(Finding, Level.WARNING)
error: Final = partial(Finding, Level.ERROR)

"""What `doctor` finds: how bad it is, what was seen, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from ros2_memory.config import Settings
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Memory
    from ros2_memory.index.snapshot import Snapshot


class Examined(NamedTuple):
    """The robot that a check looks at; `now` is the wall clock's time."""

    settings: Settings
    memory: Memory
    snapshot: Snapshot
    now: Ns


class Level(IntEnum):
    """How bad a finding is; its value is the exit code."""

    OK = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """What was seen, and what to do about it; nothing where all is in order.

    `about` is empty where it is the concern of the check.
    """

    level: Level
    about: str
    seen: str
    do: str | None = None


ok: Final = partial(Finding, Level.OK, "")
warning: Final = partial(Finding, Level.WARNING, "")
error: Final = partial(Finding, Level.ERROR, "")

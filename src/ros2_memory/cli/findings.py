"""What `doctor` finds: how bad it is, what was seen, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Final


class Level(IntEnum):
    """How bad a finding is; its value is the exit code."""

    OK = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """What was seen of one concern, and what to do about it; nothing where all is in order."""

    level: Level
    about: str
    seen: str
    do: str | None = None


in_order: Final = partial(Finding, Level.OK)
warning: Final = partial(Finding, Level.WARNING)
error: Final = partial(Finding, Level.ERROR)

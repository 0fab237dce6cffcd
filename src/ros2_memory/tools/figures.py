"""Times, lengths and angles as replies show them.

Timestamps are Unix seconds, rounded up to whole microseconds so that one fed back finds its own
message; metres to 1e-4, degrees to 1e-2, durations to 1e-3 s. What is not a finite number is null.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ros2_memory.core.timebase import Ns, iso_local, unix_from_ns, unix_rounded_up

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue, Vector3


def moment(at: Ns | None) -> float | None:
    """A moment, if there is one."""
    return None if at is None else unix_rounded_up(at)


def local(at: Ns | None) -> str | None:
    """A moment in the machine's time zone, if there is one."""
    return None if at is None else iso_local(at)


def seconds(duration: Ns) -> float:
    """A duration."""
    return round(unix_from_ns(duration), 3)


def metres(vector: Vector3) -> dict[str, JsonValue]:
    """A point or vector by its axes."""
    return {name: rounded(part, 4) for name, part in zip("xyz", vector, strict=True)}


def degrees(angle: float | None) -> float | None:
    """An angle (rad), if there is one."""
    return None if angle is None else rounded(math.degrees(angle), 2)


def rounded(number: float, places: int) -> float | None:
    """A number that may not be finite."""
    return round(number, places) if math.isfinite(number) else None


def with_notes(reply: dict[str, JsonValue], notes: Sequence[str]) -> dict[str, JsonValue]:
    """A reply with its notes, where there is something to say."""
    return {**reply, "notes": [*notes]} if notes else reply

"""Answers as JSON values: units, rounding, and the parts that several replies share.

Timestamps are Unix seconds, rounded up to whole microseconds so that one that is passed back finds
its own message; metres and metres per second to 1e-4, degrees to 1e-2, durations to 1e-3 s. A
number that is not finite is null. `notes` is there only if there are any. The replies themselves
are in `reply_json_memory`, `reply_json_motion` and `reply_json_topics`, each registered with
`render` for its result.
"""

from __future__ import annotations

import math
from functools import singledispatch
from typing import TYPE_CHECKING

from ros2_memory.core.geometry import normalised, yaw
from ros2_memory.core.timebase import Ns, unix_from_ns, unix_rounded_up

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue, Pose, Vector3
    from ros2_memory.tools.reply_size import JsonObject


@singledispatch
def render(answer: object) -> JsonValue:
    """Returns the JSON value of an answer.

    Raises:
        TypeError: it is no answer of a query.
    """
    raise TypeError(f"{type(answer).__name__} is not an answer")


def moment(at: Ns | None) -> float | None:
    """Returns a time in Unix seconds, if there is one."""
    return None if at is None else unix_rounded_up(at)


def seconds(duration: Ns) -> float:
    """Returns a duration in seconds."""
    return round(unix_from_ns(duration), 3)


def metres(vector: Vector3) -> JsonObject:
    """Returns a point or vector by its axes."""
    return {name: rounded(part, 4) for name, part in zip("xyz", vector, strict=True)}


def degrees(angle: float | None) -> float | None:
    """Returns an angle, given in radians, in degrees, if there is one."""
    return None if angle is None else rounded(math.degrees(angle), 2)


def rounded(number: float, places: int) -> float | None:
    """Returns a rounded number; None if it is not finite."""
    return round(number, places) if math.isfinite(number) else None


def planar_pose(pose: Pose) -> JsonObject:
    """Returns a position and its yaw."""
    unit = None if pose.orientation is None else normalised(pose.orientation)
    return {**metres(pose.position), "yaw_deg": degrees(None if unit is None else yaw(unit))}


def with_notes(
    reply: JsonObject, notes: Sequence[str], age: Ns | None = None, **marks: bool
) -> JsonObject:
    """Returns a reply with the marks that are true, its age and its notes, where there are any."""
    whole = reply | {name: True for name, is_so in marks.items() if is_so}
    if age is not None:
        whole["age_s"] = seconds(age)
    if notes:
        whole["notes"] = [*notes]
    return whole

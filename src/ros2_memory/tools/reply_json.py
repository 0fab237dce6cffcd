"""Answers as JSON values: units, rounding, and the parts that several replies share.

Timestamps are Unix seconds, rounded up to whole microseconds so that one that is passed back finds
its own message; metres and metres per second to 1e-4, degrees to 1e-2, durations to 1e-3 s. A
number that is not finite is null. `notes` is there only if there are any, and `local` only in
replies that span more than half a day (`LocalTimes`). The replies themselves
are in `reply_json_memory`, `reply_json_motion` and `reply_json_topics`, each registered with
`render` for its result.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import singledispatch
from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.errors import NoDataError
from ros2_memory.core.geometry import normalised, yaw
from ros2_memory.core.timebase import NS_PER_S, Ns, local_text, unix_from_ns, unix_rounded_up

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue, Pose, Vector3
    from ros2_memory.tools.reply_size import JsonObject

LOCAL_BEYOND_NS: Final[Ns] = 12 * 3600 * NS_PER_S
"""Shorter spans have no local times."""
ROBOT_NAME: Final = "robot_name"
"""The key of the robot that an answer or a row is of, in a fleet; `robot` is where one was."""
_OF_ALL: Final = ("topic", "type", "frame_id", "parent", "child", "clock")
"""Keys that a reply about several moments has once, where they have the same value at each."""


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


@dataclass(frozen=True, slots=True)
class LocalTimes:
    """Local times beside Unix seconds, for a reply that spans more than half a day.

    Its oldest time is `first`. `last` is now where it counts ages, else its newest time.
    """

    first: Ns | None
    last: Ns | None

    def of(self, start: Ns | None, end: Ns | None = None) -> JsonObject:
        """Returns `local` for a time, or for a stretch whose ends may be unknown; else nothing."""
        first, last = self.first, self.last
        if first is None or last is None or last - first <= LOCAL_BEYOND_NS:
            return {}
        begins, ends = (None if at is None else local_text(at) for at in (start, end))
        if begins is None or ends is None or begins == ends:
            text = begins or (f"- {ends}" if ends else None)
        else:
            day = begins[: -len("00:00:00")]
            text = f"{begins} - {ends.removeprefix(day)}"
        return {} if text is None else {"local": text}


def total(number: int | None, at_least: int) -> JsonObject:
    """Returns how many there are; under another name where not all of them were counted."""
    return {"at_least": at_least} if number is None else {"total": number}


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
    """Returns a position, its yaw, and the named places that it is in."""
    unit = None if pose.orientation is None else normalised(pose.orientation)
    heading = degrees(None if unit is None else yaw(unit))
    return {**metres(pose.position), "yaw_deg": heading, **inside(pose.places)}


def inside(places: Sequence[str]) -> JsonObject:
    """Returns the smallest of the named places that a point is in, and those around it."""
    reply: JsonObject = {"in": places[0]} if places else {}
    return {**reply, "also_in": [*places[1:]]} if places[1:] else reply


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


@render.register(results.AtEach)
def _at_each(answer: results.AtEach) -> JsonObject:
    """Returns one row for each moment; what all rows share is above them, and is not repeated."""
    rows = [row for row in map(render, answer.answers) if isinstance(row, dict)]
    found = [row for row in rows if "error" not in row]
    shared: JsonObject = {
        key: found[0][key]
        for key in _OF_ALL
        if found and key in found[0] and all(row.get(key) == found[0][key] for row in found)
    }
    often = Counter(note for each in answer.answers for note in dict.fromkeys(each.notes))
    common = [note for note, times in often.items() if times > 1]
    explained: set[JsonValue] = set()
    for row, each in zip(rows, answer.answers, strict=True):
        for key in shared.keys() & row.keys():
            del row[key]
        own = [note for note in each.notes if note not in common]
        row.pop("notes", None)
        if own:
            row["notes"] = [*own]
        if "error" in row:
            if row["reason"] in explained:
                del row["detail"]
            explained.add(row["reason"])
    return with_notes({**shared, "results": [*rows]}, common)


@render.register(results.NothingAt)
def _nothing_at(answer: results.NothingAt) -> JsonObject:
    reply: JsonObject = {
        "at": unix_rounded_up(answer.at),
        "error": NoDataError.code,
        "reason": answer.reason.value,
        "detail": answer.detail,
    }
    return with_notes(reply, answer.notes)

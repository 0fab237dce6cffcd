"""The things that a message tells of: what a detector saw, by name, and where where it says so.

A thing is an object with a name under one of `NAMES`: an entry of a list, or the whole message; a
text that is JSON is looked into. Detections of vision_msgs name their best hypothesis. Its place
is a point in metres: `point` or `position`, vision_msgs' pose or the centre of a 3D box. Boxes in
an image are in pixels, and no place.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.model import JsonValue, Vector3

NAMES: Final = ("label", "class_id", "class_name", "class", "object")
LISTS: Final = frozenset({"labels", "class_ids", "objects", "classes"})
"""A list of texts under one of these names is a list of things."""

_PLACES: Final = (
    ("point",),
    ("position",),
    ("pose", "position"),
    ("pose", "pose", "position"),
    ("bbox", "center", "position"),
)
_LONGEST_JSON: Final = 1 << 16
_DEEPEST: Final = 4


class Detection(NamedTuple):
    """Something that was seen: `place` (m) is in `frame_id`, empty where the message names none."""

    label: str
    place: Vector3 | None = None
    frame_id: str = ""


def detections_of(value: JsonValue, frame_id: str = "") -> tuple[Detection, ...]:
    """The things in an extracted value, in order; `frame_id` is the message's own."""
    return tuple(_things(value, frame_id, _DEEPEST))


def depends_on_numbers(value: JsonValue) -> bool:
    """Whether other scores in the same message may give things other names."""
    waiting = [value]
    while waiting:
        held = waiting.pop()
        if isinstance(held, dict):
            results = held.get("results")
            if isinstance(results, list) and len(results) > 1:
                return True
            waiting.extend(held.values())
        elif isinstance(held, list):
            waiting.extend(held)
    return False


def _things(value: JsonValue, frame_id: str, depth: int) -> Iterator[Detection]:
    if depth == 0:
        return
    if isinstance(value, str):
        yield from _things(_from_json(value), frame_id, depth - 1)
    elif isinstance(value, list):
        for each in value:
            if isinstance(each, dict):
                yield from _things(each, frame_id, depth - 1)
    elif isinstance(value, dict):
        thing = _thing(value, frame_id)
        if thing is not None:
            yield thing
        else:
            yield from _within(value, frame_id, depth)


def _within(value: dict[str, JsonValue], frame_id: str, depth: int) -> Iterator[Detection]:
    """The things in the fields of an object that is none itself."""
    frame = _frame(value) or frame_id
    for name, inner in value.items():
        if name in LISTS and isinstance(inner, list):
            yield from (Detection(each) for each in inner if isinstance(each, str) and each)
        yield from _things(inner, frame, depth - 1)


def _thing(value: dict[str, JsonValue], frame_id: str) -> Detection | None:
    """The thing that an object is; None where it is none."""
    frame = _frame(value) or frame_id
    label = _label(value)
    if label is not None:
        return Detection(label, _place(value), frame)
    best = _best_result(value.get("results"))
    if best is None:
        return None
    hypothesis = best.get("hypothesis")
    label = _label(hypothesis if isinstance(hypothesis, dict) else best)
    return None if label is None else Detection(label, _place(best) or _place(value), frame)


def _label(value: dict[str, JsonValue]) -> str | None:
    if "stride" in value:  # a std_msgs/MultiArrayDimension, whose label names an axis
        return None
    for name in NAMES:
        label = value.get(name)
        if isinstance(label, str) and label.strip():
            return label
    return None


def _best_result(results: JsonValue) -> dict[str, JsonValue] | None:
    """The hypothesis of the highest score; the first of several."""
    among = (
        [each for each in results if isinstance(each, dict)] if isinstance(results, list) else []
    )
    return max(among, key=_score, default=None)


def _score(result: dict[str, JsonValue]) -> float:
    hypothesis = result.get("hypothesis")
    score = (hypothesis if isinstance(hypothesis, dict) else result).get("score")
    return score if isinstance(score, int | float) and not math.isnan(score) else -math.inf


def _frame(value: dict[str, JsonValue]) -> str:
    header = value.get("header")
    frame = header.get("frame_id") if isinstance(header, dict) else value.get("frame_id")
    return frame if isinstance(frame, str) else ""


def _place(value: dict[str, JsonValue]) -> Vector3 | None:
    """The first of the points that is one; all zeros is what nobody filled in."""
    for path in _PLACES:
        held: JsonValue = value
        for name in path:
            held = held.get(name) if isinstance(held, dict) else None
        place = _point(held)
        if place is not None and any(place):
            return place
    return None


def _point(value: JsonValue) -> Vector3 | None:
    if isinstance(value, dict):
        parts = [value.get("x"), value.get("y"), value.get("z")]
    elif isinstance(value, list) and len(value) == 3:
        parts = list(value)
    else:
        return None
    x, y, z = (
        float(part) if isinstance(part, int | float) and not isinstance(part, bool) else math.nan
        for part in parts
    )
    return (x, y, z) if all(map(math.isfinite, (x, y, z))) else None


def _from_json(text: str) -> JsonValue:
    """What a text says that is JSON; None for any other."""
    if len(text) > _LONGEST_JSON or text[:1] not in {"[", "{"}:
        return None
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value

"""Reads detections from messages: what a detector saw, by name, and where if the message has that.

A detection is an object with a name under one of the fields of `naming`: an entry of a list, or the
whole message; a list of strings under one of `LISTS_OF_LABELS` is a list of detections. A string
that is JSON is parsed; what it names is a detection if it is in a list, has a score, a place or an
outline, or nothing beside the name: else it is a state. Those of vision_msgs are named by their
best hypothesis. The position is a point in metres, at one of `POSITIONS`, in the frame that the
innermost object around it names. Boxes in an image are in pixels, and give no position. The score
is a number under one of `SCORES`.
"""

from __future__ import annotations

import json
import math
from itertools import product
from operator import is_, itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.text import LABELS, LISTS_OF_LABELS, NAMED_IN_TYPES, looks_like_json
from ros2_memory.messages.conversions import number, triple, xyz

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.core.reply import JsonObject

SCORES: Final = ("score", "confidence", "probability")
NOT_LABELLED: Final = frozenset({"stride"})
"""An object with such a field is a std_msgs/MultiArrayDimension, whose label names an axis."""

POSITIONS: Final = (
    ("point",),
    ("position",),
    ("pose", "position"),
    ("pose", "pose", "position"),
    ("pose", "pose", "pose", "position"),
    ("pose",),
    ("bbox", "center", "position"),
    ("bbox3d", "center", "position"),
    (),  # x, y and z of the object itself
)
_SCORED: Final = frozenset(SCORES)
_SHOWN: Final = frozenset({"box", "z"}.union(*(path[:1] for path in POSITIONS)))
"""What has a score and one of these is something that was seen, and named as such things are."""
_NOTHING: Final = "none"
"""What JSON names so, without a score, is that nothing was seen."""
_NAMED_BY: Final = frozenset(LABELS).union(("name", "category", "id"), *NAMED_IN_TYPES)
"""An object without any of these fields has no name."""
_MAX_JSON_CHARS: Final = 4 << 20
MAX_DEPTH: Final = 7
"""Lists, objects and texts that are JSON around a detection, and it."""


class Detection(NamedTuple):
    """An object that was seen: `place` (m) is in `frame_id`, empty where the message names none.

    `score` is the detector's own, in its own unit; None where it gives none.
    """

    label: str
    place: Vector3 | None = None
    frame_id: str = ""
    score: float | None = None


def detections_of(
    value: JsonValue, frame_id: str = "", depth: int = MAX_DEPTH
) -> tuple[Detection, ...]:
    """Returns the detections in an extracted value, in order; `frame_id` is the message's own.

    They are looked for `depth` lists, objects and texts deep.
    """
    walk = _Walk(None)
    walk.value(value, frame_id, depth)
    return tuple(walk.detections)


def naming(fields: Collection[str]) -> Iterator[str]:
    """Yields which fields name an object that has some fields, the first choice first.

    Of these the first text that is not blank is its name, else the first whole number.
    """
    if not _NAMED_BY.isdisjoint(fields) and NOT_LABELLED.isdisjoint(fields):
        yield from LABELS
        yield from (name for own, name in NAMED_IN_TYPES.items() if own.issubset(fields))
        if not (_SCORED.isdisjoint(fields) or _SHOWN.isdisjoint(fields)):
            yield from ("name", "category", "id")


def without_low_scores(value: JsonValue, min_score: float, depth: int = MAX_DEPTH) -> JsonValue:
    """Returns an extracted value without the detections whose score is below a limit.

    Null takes their place, so that the others keep theirs; in a detection with several hypotheses
    also the place of each that scores less. What has no score stays. A value without any such
    detection is returned as it is. They are looked for as by `detections_of`.
    """
    return _Walk(min_score).value(value, "", depth)


class _Walk:
    """A walk over a value, which collects its detections.

    What it returns is without those whose score is below `least`.
    """

    def __init__(self, least: float | None) -> None:
        self.detections: list[Detection] = []
        self._least = least

    def value(
        self, value: JsonValue, frame: str, depth: int, listed: bool | None = None
    ) -> JsonValue:
        """Returns what is left of a value in a frame.

        `listed`: in JSON, whether it is in a list; None outside of JSON.
        """
        if depth == 0:
            return value
        if isinstance(value, dict):
            return self._object(value, _frame(value) or frame, depth, listed)
        if isinstance(value, str):
            if not looks_like_json(value):  # most are names
                return value
            parsed = _from_json(value)
            kept = self.value(parsed, frame, depth - 1, listed=False)
            return value if kept is parsed else json.dumps(kept, ensure_ascii=False)
        if isinstance(value, list):
            listed = None if listed is None else True
            parts = [
                self.value(element, frame, depth - 1, listed)
                if isinstance(element, dict)
                else element
                for element in value
            ]
            return value if all(map(is_, parts, value)) else parts
        return value

    def _object(self, value: JsonObject, frame: str, depth: int, listed: bool | None) -> JsonValue:
        """Returns what is left of an object that is a detection, or has some in it."""
        label = _label(value)
        if label is None:
            return self._parts(value, frame, depth, listed)
        own = _placed((value,), frame, label, _score(value))
        is_seen = own.score is not None or not _SHOWN.isdisjoint(value)
        if listed is None or is_seen:
            self.detections.append(own)
            return None if self._is_below(value) else value
        # JSON that has a name alone: perhaps a state, of which parts may be detections.
        begin = len(self.detections)
        kept = self._parts(value, frame, depth, listed)
        if label.strip().casefold() != _NOTHING and (listed or _is_alone(value)):
            # It is a detection: what has no score in it belongs to it, and is none of its own.
            inner = self.detections[begin:]
            self.detections[begin:] = [own, *(one for one in inner if one.score is not None)]
        return kept

    def _parts(self, value: JsonObject, frame: str, depth: int, listed: bool | None) -> JsonValue:
        """Returns what is left of an object of which only parts may be detections."""
        best = _best_result(value.get("results"))
        best_label = None if best is None else _label(_hypothesis(best))
        if best is not None and best_label is not None:
            score = _score(_hypothesis(best))
            self.detections.append(_placed((best, value), frame, best_label, score))
            return self._with_hypotheses(value, best)
        fields: JsonObject = {}
        for name, inner in value.items():
            if name in LISTS_OF_LABELS and isinstance(inner, list):
                labels = (element for element in inner if isinstance(element, str) and element)
                self.detections += map(Detection, labels)
            is_leaf = not inner or isinstance(inner, int | float)  # most are: no call for each
            fields[name] = inner if is_leaf else self.value(inner, frame, depth - 1, listed)
        return value if all(map(is_, fields.values(), value.values())) else fields

    def _with_hypotheses(self, value: JsonObject, best: JsonObject) -> JsonValue:
        if self._is_below(_hypothesis(best)):
            return None
        results = value["results"]
        kept: list[JsonValue] = [
            None if isinstance(result, dict) and self._is_below(_hypothesis(result)) else result
            for result in (results if isinstance(results, list) else ())
        ]
        return {**value, "results": kept} if None in kept else value

    def _is_below(self, value: JsonObject) -> bool:
        score = None if self._least is None else _score(value)
        return score is not None and self._least is not None and score < self._least


def _is_alone(value: JsonObject) -> bool:
    """Returns whether an object has nothing beside its name, or lists of numbers or points."""
    others = [part for name, part in value.items() if name not in _NAMED_BY]
    lists = [part for part in others if isinstance(part, list)]
    return not others or any(isinstance(part[0], int | float | list) for part in lists if part)


def _label(value: JsonObject) -> str | None:
    whole = None
    for name in naming(value):
        label = value.get(name)
        if isinstance(label, str) and label.strip():
            return label
        if type(label) is int:  # a boolean is an int
            whole = whole or str(label)
    return whole


def _best_result(results: JsonValue) -> JsonObject | None:
    """Returns the hypothesis of the highest score; the first of several."""
    if not isinstance(results, list):
        return None
    scored = [
        (-math.inf if score is None else score, result)
        for result in results
        if isinstance(result, dict)
        for score in [_score(_hypothesis(result))]
    ]
    return max(scored, key=itemgetter(0), default=(0.0, None))[1]


def _hypothesis(result: JsonObject) -> JsonObject:
    hypothesis = result.get("hypothesis")
    return hypothesis if isinstance(hypothesis, dict) else result


def _score(value: JsonObject) -> float | None:
    for name in SCORES:
        score = number(value.get(name))
        if score is not None and not math.isnan(score):
            return score
    return None


def _frame(value: JsonObject) -> str:
    header = value.get("header")
    frame = header.get("frame_id") if isinstance(header, dict) else value.get("frame_id")
    return frame if isinstance(frame, str) else ""


def _placed(
    objects: Sequence[JsonObject], outer: str, label: str, score: float | None
) -> Detection:
    """Returns a detection at the first valid point of some objects in a frame.

    All zeros means that nobody filled it in.
    """
    for value, path in product(objects, POSITIONS):
        if path and path[0] not in value:
            continue
        node: JsonValue = value
        frame = outer
        for name in path:
            node = node.get(name) if isinstance(node, dict) else None
            frame = (_frame(node) if isinstance(node, dict) else "") or frame
        point = xyz(node) if isinstance(node, dict) else triple(node)
        if point is not None and any(point) and all(map(math.isfinite, point)):
            return Detection(label, point, frame, score)
    return Detection(label, None, outer, score)


def _from_json(text: str) -> JsonValue:
    """Parses a string that is JSON; None for one that is not, or is too long."""
    if len(text) > _MAX_JSON_CHARS:
        return None
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value

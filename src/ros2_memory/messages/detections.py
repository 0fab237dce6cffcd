"""Reads detections from messages: the name of what a detector saw, its place and its score.

- A detection is an object with a name under one of `naming_fields`: an entry of a list, or the
  whole message. A list of strings under one of `LISTS_OF_LABELS` is a list of detections, unless it
  is under `LOOKED_FOR` without another list or object beside it, as of scores.
- An object without a name, but with a list of hypotheses under one of `HYPOTHESES`, is a detection
  that is named by the best of them.
- A string that is JSON is parsed. An object in it is a detection if it is in a list, has a score, a
  place or an outline, or nothing beside its name, nor the message beside the string: else it is a
  state, or the object of a command.
- The place is a point in metres at one of `POSITIONS`, in the frame that the innermost object
  around it names. Boxes in an image are in pixels, and give no place.
- The score is a number under one of `SCORES`, the id a text or a whole number under one of `IDS`.
"""

from __future__ import annotations

import json
import math
from enum import Enum, auto
from itertools import product
from operator import is_
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.text import (
    LABELS,
    LISTS_OF_LABELS,
    LOOKED_FOR,
    NAMED_IN_TYPES,
    looks_like_json,
)
from ros2_memory.messages.conversions import NamedNumber, number, triple

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.core.reply import JsonObject

SCORES: Final = ("score", "confidence", "probability")
IDS: Final = ("id", "tracking_id", "track_id", "object_id", "instance_id")
"""Fields that may tell an object from others of its name, the last choice first."""
HYPOTHESES: Final = ("results", "classification")
"""Fields with the possible classes of an object, in vision_msgs and autoware_perception_msgs."""
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
    ("kinematics", "pose", "position"),
    ("kinematics", "pose_with_covariance", "pose", "position"),
    ("kinematics", "initial_pose_with_covariance", "pose", "position"),
    (),  # x, y and z of the object itself
)
_SCORED: Final = frozenset(SCORES)
_PLACED: Final = frozenset({"box", "z"}.union(*(path[:1] for path in POSITIONS)))
"""Fields that have the place or the outline of an object."""
_NAMES_OF_SEEN: Final = ("name", "category", "id")
"""Fields that name an object which has a score and a place; of any other they say little."""
_NOTHING: Final = "none"
"""The name by which JSON says that nothing was seen, without a score."""
SAYS_ABSENT: Final = {
    **dict.fromkeys(("out_of_stock", "missing", "absent"), True),
    **dict.fromkeys(("in_stock", "present", "visible", "detected"), False),
}
"""Flags of an object, each with the value that says that it was looked for and is not there."""
_NAMED_BY: Final = frozenset(LABELS).union(_NAMES_OF_SEEN, *NAMED_IN_TYPES)
"""An object without any of these fields has no name."""
_NO_CONTENT: Final = frozenset({"header", "stamp", "timestamp", "frame_id"})
"""Fields that a message may have beside its only content."""
_MAX_JSON_CHARS: Final = 4 << 20
MAX_DEPTH: Final = 7
"""How many lists, objects and JSON texts are opened inside each other."""


class Detection(NamedTuple):
    """An object that was seen.

    Attributes:
        label: its name.
        place: in metres, in `frame_id`; None if the message has none.
        frame_id: empty if the message names no frame.
        score: in the detector's own unit; None if it gives none.
        id: what the detector tells it from others by; empty if it does not.
    """

    label: str
    place: Vector3 | None = None
    frame_id: str = ""
    score: float | None = None
    id: str = ""


def detections_of(
    value: JsonValue, frame_id: str = "", depth: int = MAX_DEPTH, *, is_beside: bool = False
) -> tuple[Detection, ...]:
    """Returns the detections in an extracted value, in order.

    Args:
        value: the value.
        frame_id: the frame of the message.
        depth: how many lists, objects and JSON texts inside each other are searched.
        is_beside: whether the value is a text beside other content of its message.
    """
    walk = _Walk(None)
    walk.visit(value, frame_id, depth, _Inside.BESIDE if is_beside else _Inside.MESSAGE)
    return tuple(walk.detections)


def naming_fields(fields: Collection[str]) -> Iterator[str]:
    """Yields which of its fields name an object, the first choice first.

    The first text that is not blank is the name, else the first whole number.
    """
    if not _NAMED_BY.isdisjoint(fields) and NOT_LABELLED.isdisjoint(fields):
        yield from LABELS
        yield from (name for own, name in NAMED_IN_TYPES.items() if own.issubset(fields))
        if not (_SCORED.isdisjoint(fields) or _PLACED.isdisjoint(fields)):
            yield from _NAMES_OF_SEEN


def name_field(value: JsonObject) -> str | None:
    """Returns the first choice among the fields of an object that name it; None if none does."""
    return next((name for name in naming_fields(value) if name in value), None)


def without_low_scores(value: JsonValue, min_score: float, depth: int = MAX_DEPTH) -> JsonValue:
    """Returns an extracted value without the detections whose score is below `min_score`.

    Null replaces each of them, so that the others keep their places in lists. In a detection with
    several hypotheses null also replaces each hypothesis that scores less. A detection without a
    score stays. A value that loses nothing is returned itself.
    """
    return _Walk(min_score).visit(value, "", depth)


class _Inside(Enum):
    """Where a value was found."""

    MESSAGE = auto()
    BESIDE = auto()
    """A text beside other content of its message, or JSON in it."""
    JSON = auto()
    JSON_LIST = auto()


class _Walk:
    """Collects the detections in a value, and removes those whose score is below `min_score`."""

    def __init__(self, min_score: float | None) -> None:
        self.detections: list[Detection] = []
        self._min_score = min_score

    def visit(
        self, value: JsonValue, frame: str, depth: int, inside: _Inside = _Inside.MESSAGE
    ) -> JsonValue:
        """Returns a value without low scores; the value itself if it loses nothing."""
        if depth == 0:
            return value
        if isinstance(value, dict):
            return self._visit_object(value, _frame(value) or frame, depth, inside)
        if isinstance(value, list):
            if inside is not _Inside.MESSAGE:
                inside = _Inside.JSON_LIST
            elements = [
                self.visit(element, frame, depth - 1, inside)
                if isinstance(element, dict)
                else element
                for element in value
            ]
            return value if all(map(is_, elements, value)) else elements
        if isinstance(value, str) and looks_like_json(value):
            parsed = parsed_json(value)
            inside = inside if inside is _Inside.BESIDE else _Inside.JSON
            remaining = self.visit(parsed, frame, depth - 1, inside)
            return value if remaining is parsed else json.dumps(remaining, ensure_ascii=False)
        return value

    def _visit_object(
        self, value: JsonObject, frame: str, depth: int, inside: _Inside
    ) -> JsonValue:
        """Visits an object that may be a detection itself."""
        label = _label(value)
        if label is None:
            return self._visit_parts(value, frame, depth, inside)
        detection = _detection_at((value,), frame, label, _score(value))
        is_seen = detection.score is not None or not _PLACED.isdisjoint(value)
        if inside is _Inside.MESSAGE or is_seen:
            self.detections.append(detection)
            return None if self._is_low(value) else value
        # JSON with a name alone: perhaps a state, whose parts may be detections.
        parts = _Walk(self._min_score)
        remaining = parts._visit_parts(value, frame, depth, inside)
        is_something = label.strip().casefold() != _NOTHING
        is_alone = inside is _Inside.JSON and _has_name_alone(value)
        if is_something and (inside is _Inside.JSON_LIST or is_alone):
            # It is a detection: parts without a score describe it, and are none themselves.
            self.detections.append(detection)
            self.detections += [part for part in parts.detections if part.score is not None]
        else:
            self.detections += parts.detections
        return remaining

    def _visit_parts(self, value: JsonObject, frame: str, depth: int, inside: _Inside) -> JsonValue:
        """Visits an object without a name: one with hypotheses, or with detections inside."""
        field = hypotheses_field(value)
        best = None if field is None else _best_result(value[field])
        best_label = None if best is None else _label(_hypothesis(best))
        if field is not None and best is not None and best_label is not None:
            score = _score(_hypothesis(best))
            self.detections.append(_detection_at((best, value), frame, best_label, score))
            return self._without_low_hypotheses(value, field, best)
        fields: JsonObject = {}
        seen = lists_of_seen(value)
        for name, part in value.items():
            if name in seen and isinstance(part, list):
                labels = (element for element in part if isinstance(element, str) and element)
                self.detections += map(Detection, labels)
            is_leaf = not part or isinstance(part, int | float)  # most are: no call for each
            within = inside
            if inside is _Inside.MESSAGE and isinstance(part, str) and has_more_content(value):
                within = _Inside.BESIDE
            fields[name] = part if is_leaf else self.visit(part, frame, depth - 1, within)
        return value if all(map(is_, fields.values(), value.values())) else fields

    def _without_low_hypotheses(self, value: JsonObject, field: str, best: JsonObject) -> JsonValue:
        """Returns a detection without the low hypotheses in a field; None if `best` is low."""
        if self._is_low(_hypothesis(best)):
            return None
        results = value[field]
        remaining: list[JsonValue] = []
        for result in results if isinstance(results, list) else ():
            is_low = isinstance(result, dict) and self._is_low(_hypothesis(result))
            remaining.append(None if is_low else result)
        return {**value, field: remaining} if None in remaining else value

    def _is_low(self, value: JsonObject) -> bool:
        if self._min_score is None:
            return False
        score = _score(value)
        return score is not None and score < self._min_score


def hypotheses_field(fields: Collection[str]) -> str | None:
    """Returns which of the fields of an object has its hypotheses; None if none has."""
    return next((name for name in HYPOTHESES if name in fields), None)


def lists_of_seen(fields: Mapping[str, object]) -> frozenset[str]:
    """Returns the fields in which an object may list labels of things that were seen."""
    seen = LISTS_OF_LABELS.intersection(fields)
    is_beside = LOOKED_FOR in seen and any(
        isinstance(part, list | dict) and name != LOOKED_FOR and name not in _NO_CONTENT
        for name, part in fields.items()
    )
    return seen if is_beside else seen - {LOOKED_FOR}


def has_more_content(fields: Collection[str]) -> bool:
    """Returns whether an object has more than one field, and a header."""
    return sum(name not in _NO_CONTENT for name in fields) > 1


def _has_name_alone(value: JsonObject) -> bool:
    """Returns whether an object has nothing beside its name, or lists of numbers or points."""
    others = [part for name, part in value.items() if name not in _NAMED_BY]
    lists = [part for part in others if isinstance(part, list)]
    return not others or any(type(part[0]) in {int, float, list} for part in lists if part)


def _label(value: JsonObject) -> str | None:
    """Returns the name of an object that is there: a text before a whole number; else None."""
    said = value.keys() & SAYS_ABSENT.keys()
    if said and any(value[flag] is SAYS_ABSENT[flag] for flag in said):
        return None
    first_number = None
    for name in naming_fields(value):
        label = value.get(name)
        if isinstance(label, str) and label.strip():
            return label
        first_number = first_number or _number_as_text(label)
    return first_number


def _number_as_text(value: JsonValue) -> str | None:
    """Returns the name of a whole number, else its digits; None for another value."""
    if not isinstance(value, int) or isinstance(value, bool):
        return None
    return value.name if isinstance(value, NamedNumber) else str(value)


def _id(value: JsonObject) -> str:
    for name in reversed(IDS):
        word = value.get(name)
        if word is not None and (text := word if isinstance(word, str) else _number_as_text(word)):
            return text
    return ""


def _best_result(results: JsonValue) -> JsonObject | None:
    """Returns the first hypothesis with the highest score; None without hypotheses."""
    best: JsonObject | None = None
    best_score = -math.inf
    for result in results if isinstance(results, list) else ():
        if isinstance(result, dict):
            score = _score(_hypothesis(result))
            if best is None or (score is not None and score > best_score):
                best, best_score = result, -math.inf if score is None else score
    return best


def _hypothesis(result: JsonObject) -> JsonObject:
    """Returns the object with class and score: newer vision_msgs have it inside the result."""
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


def _detection_at(
    objects: Sequence[JsonObject], frame: str, label: str, score: float | None
) -> Detection:
    """Returns a detection at the first valid point of some objects.

    A point of zeros counts as not filled in. `frame` is that of the objects; an object on the path
    to the point may name another. The last object has the id.
    """
    own_id = _id(objects[-1])
    for value, path in product(objects, POSITIONS):
        if path and path[0] not in value:
            continue
        node: JsonValue = value
        point_frame = frame
        for name in path:
            node = node.get(name) if isinstance(node, dict) else None
            if isinstance(node, dict):
                point_frame = _frame(node) or point_frame
        point = triple(tuple(map(node.get, "xyz")) if isinstance(node, dict) else node)
        if point is not None and any(point) and all(map(math.isfinite, point)):
            return Detection(label, point, point_frame, score, own_id)
    return Detection(label, None, frame, score, own_id)


def parsed_json(text: str) -> JsonValue:
    """Parses a string that is JSON; None for one that is not, or is too long."""
    if len(text) > _MAX_JSON_CHARS:
        return None
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value

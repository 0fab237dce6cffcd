"""Conditions on one extracted value, and what a dot-path leads to in it.

A condition is tested on the whole value, before anything in it is downsampled or rounded. NaN and
null match nothing. `refusals` says when no value of some shape can match.
"""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, ClassVar, Final, Literal, TypeAlias, TypeVar, cast

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.text import abbreviate, caseless, looks_like_json
from ros2_memory.messages.conversions import (
    INDEX,
    NamedNumber,
    Selector,
    Summary,
    names_beside,
    names_others,
    segments_of,
    with_dots,
)
from ros2_memory.messages.detections import detections_of, parsed_json, without_low_scores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.extract import SchemaExtractor

T = TypeVar("T")

Scalar: TypeAlias = bool | int | float | str
ConditionType: TypeAlias = Literal[
    "contains", "contains_word", "equals", "above", "below", "near_position"
]
"""Each has an example in `_EXAMPLES`."""

POSITION_KEYS: Final = ("position", "point", "translation")
"""Keys under which a value holds a place; x and y under other keys may be a velocity or an axis."""

# int() refuses texts of thousands of digits.
_WHOLE: Final = re.compile(r"[-+]?\d{1,300}", re.ASCII)
_DECIMAL: Final = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_AXES: Final = {"0": "x", "1": "y", "2": "z"}
"""An array of three numbers may be shown as a point: these indices lead to its axes."""
_POINT: Final = {*_AXES.values()}
_INDICES: Final = re.compile(r"(\.-?\d+)+$")
"""The end of a dot-path that picks an element of a list."""
_EXAMPLES: Final = {
    "contains": 'condition_type "contains", value "scissors"',
    "contains_word": 'condition_type "contains_word", value "pot", which is not in "potato"',
    "equals": 'condition_type "equals", value true',
    "above": 'condition_type "above", value 0.5, field "linear_velocity.x"',
    "below": 'condition_type "below", value 0.2, field "percentage"',
    "near_position": 'condition_type "near_position", value {"x": 1.5, "y": -0.2}',
}
_SINGLE_BELOW: Final = 2**24
"""A float32 represents every whole number below this."""
_EXACT_BELOW: Final = 2**53
"""A float represents every whole number below this."""


@dataclass(frozen=True)
class Contains:
    """Part of a string, or an element of a list.

    A string is found inside any string at any depth (not in the keys), by `caseless`. A boolean is
    found wherever an equal one is. A number is found only in a field, as an element of it: in a
    whole message it would match every size, level and coordinate. The digits of a number are also
    searched as a string.

    With `whole`, the needle is found as whole words: `pot` is in "the pot", not in "potato". Its
    words that begin with a minus must not be there: `knife -butter`. In a string that is JSON, one
    label of its detections may match for itself.
    """

    needle: Scalar
    whole: bool = False

    @cached_property
    def equal(self) -> Equals:
        """The test for an element of a list."""
        return Equals(self.needle)

    @cached_property
    def others(self) -> tuple[str, ...]:
        """The casefolded words that must not be there."""
        words = caseless(_text_of(self.needle) or "").split() if self.whole else []
        return tuple(word[1:] for word in words if word[0] == "-" and len(word) > 1)

    @cached_property
    def folded(self) -> str | None:
        """The needle as casefolded text, without `others`; None if it has no text."""
        text = _text_of(self.needle)
        if text is None or not self.others:
            return None if text is None else caseless(text)
        return " ".join(word for word in caseless(text).split() if word[0] != "-")

    @cached_property
    def boolean(self) -> bool | None:
        """The boolean that matches; None if the needle means no boolean."""
        meant = _meaning(self.needle)
        return meant if isinstance(meant, bool) else None

    @property
    def is_number(self) -> bool:
        """Whether the needle is a number or spells one."""
        meant = _meaning(self.needle)
        return isinstance(meant, int | float) and not isinstance(meant, bool)

    @property
    def is_one_word(self) -> bool:
        """Whether the needle is letters alone, which match inside of any word."""
        return not self.whole and (self.folded or "").isalpha()

    def passes(self, leaf: JsonValue) -> bool:
        """Returns whether a leaf is a string that has the needle, or the boolean that it means.

        A number that is a label has the text of its name.
        """
        if isinstance(leaf, NamedNumber):
            leaf = leaf.name
        if not isinstance(leaf, str):
            return isinstance(leaf, bool) and leaf is self.boolean
        folded = caseless(leaf)
        if not self.whole:
            return self.folded is not None and self.folded in folded
        if not self.folded or not _has_words(folded, self.folded):
            return False
        if not any(_has_words(folded, other) for other in self.others):
            return True
        return any(map(self.passes, _labels_in_json(leaf)))


def _has_words(text: str, words: str) -> bool:
    return re.search(rf"(?<!\w){re.escape(words)}(?!\w)", text) is not None


@dataclass(frozen=True)
class Equals:
    """A boolean, number or string that some leaf of the value is equal to.

    1 and 0 equal true and false. A number equals itself, and the float that a float32 field stores
    in its place. Strings are compared by `caseless`. A string that spells a boolean or a
    number equals that, too, since planners put values in quotes. In a string that is JSON, the
    labels of its detections are compared, too.
    """

    value: Scalar

    @cached_property
    def folded(self) -> str | None:
        """The casefolded text that is equal; None if the value is no text."""
        return caseless(self.value) if isinstance(self.value, str) else None

    @cached_property
    def boolean(self) -> bool | None:
        """The boolean that is equal; None if neither is."""
        meant = _meaning(self.value)
        return bool(meant) if meant is not None and meant in (0, 1) else None

    @cached_property
    def integers(self) -> tuple[int | float, ...]:
        """The number that an integer is compared with; empty if the value means none."""
        meant = _meaning(self.value)
        return () if meant is None else (meant,)

    @cached_property
    def numbers(self) -> tuple[int | float, ...]:
        """The numbers that a float is compared with: the meant one, and as a float32 stores it."""
        return tuple(number for meant in self.integers for number in (meant, stored_as(meant)))

    def passes(self, leaf: JsonValue) -> bool:
        """Returns whether a leaf is equal."""
        if isinstance(leaf, bool):
            return leaf is self.boolean
        if isinstance(leaf, NamedNumber) and self.passes(leaf.name):
            return True
        if isinstance(leaf, int | float):
            numbers = self.numbers if isinstance(leaf, float) else self.integers
            return any(leaf == number for number in numbers)
        if not isinstance(leaf, str) or self.folded is None:
            return False
        folded = caseless(leaf)
        return folded == self.folded or (
            self.folded in folded
            and any(caseless(label) == self.folded for label in _labels_in_json(leaf))
        )


def _labels_in_json(text: str) -> list[str]:
    """Returns the labels of the detections in a text, if it is JSON."""
    return [seen.label for seen in detections_of(text)] if looks_like_json(text) else []


@dataclass(frozen=True, slots=True)
class Beyond:
    """A number above or below a limit, the limit excluded; a boolean is no number.

    What a float32 field stores in place of the limit is excluded, too: 0.2000000030 for 0.2.
    """

    folded: ClassVar[None] = None
    limit: int | float
    above: bool

    @property
    def stored(self) -> float:
        """The limit as a float32 field stores it."""
        return stored_as(self.limit)

    def passes(self, leaf: JsonValue) -> bool:
        """Returns whether a leaf is a number on this side of the limit."""
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            return False
        if isinstance(leaf, float) and leaf == self.stored:
            return False
        return leaf > self.limit if self.above else leaf < self.limit


@dataclass(frozen=True, slots=True)
class NearPosition:
    """A position (m) within `tolerance_m`, inclusive; in the plane if `z` is None.

    Coordinates are in the frame of the message. `frame_id` is the frame that the question names; it
    is not tested here. A position without a finite x and y (and z, if one is asked) never matches.
    """

    folded: ClassVar[None] = None
    x: float
    y: float
    z: float | None
    tolerance_m: float
    frame_id: str | None = None

    def is_near(self, x: float, y: float, z: float) -> bool:
        """Returns whether a position (m) is near; its z may be NaN if none is asked."""
        off_x, off_y, off_z = x - self.x, y - self.y, 0.0 if self.z is None else z - self.z
        # Not `math.dist`, which rounds unlike numpy does for columns.
        return math.sqrt(off_x * off_x + off_y * off_y + off_z * off_z) <= self.tolerance_m


Test: TypeAlias = Contains | Equals | Beyond | NearPosition


@dataclass(frozen=True, slots=True)
class Condition:
    """A test, and the dot-path of the part of the value that it is applied to (None: all of it).

    If `min_score` is above 0, detections of a lower score do not count. `tests_by_type` has the
    tests of types that give a constant another number.
    """

    test: Test
    field: str | None = None
    min_score: float = 0.0
    tests_by_type: tuple[tuple[str, Test], ...] = ()

    def of_type(self, type_name: str, extractor: SchemaExtractor) -> Condition:
        """Returns the condition for a type, whose extracted values may have a shorter field."""
        if self.field is None:
            return self
        path = extractor.own_path(self.field, type_name)
        test = dict(self.tests_by_type).get(type_name, self.test)
        if path == self.field and test is self.test:
            return self
        return replace(self, test=test, field=path, tests_by_type=())

    def is_unstated(self, value: JsonValue) -> bool:
        """Returns whether a value names elements (joints), but not the one that is asked for."""
        return names_others(value, self.field or "")

    @property
    def element(self) -> str:
        """The name of the element that the field asks for: `elbow` of `positions.elbow`."""
        return (self.field or "").partition(".")[2]

    def matches(self, value: JsonValue) -> bool:
        """Returns whether the value, or any target of the field in it, passes the test."""
        if not self._passes(value):
            return False
        # The whole value has to pass, too: columns skip messages by the bounds of whole values.
        counted = self.counted(value)
        return counted is value or self._passes(counted)

    def is_on(self, label: str) -> bool:
        """Returns whether the label of a detection, which may be a number, is what is sought."""
        on_label = Condition(self.test)
        if not isinstance(self.test, Contains | Equals):
            return False
        return on_label.matches(label) or (label.isdecimal() and on_label.matches(int(label)))

    def counted(self, value: JsonValue) -> JsonValue:
        """Returns the value without the detections whose score is too low to count."""
        return value if self.min_score <= 0 else without_low_scores(value, self.least_score)

    @property
    def least_score(self) -> float:
        """The score from which on detections count: the limit, or as a float32 stores it."""
        return min(self.min_score, _float32(self.min_score))

    def _passes(self, value: JsonValue) -> bool:
        targets, test = self.targets(value), self.test
        if isinstance(test, NearPosition):
            points = chain.from_iterable(positions(target) for target in targets)
            return any(test.is_near(*point) for point in points)
        if any(test.passes(leaf) for target in targets for leaf in leaves(target)):
            return True
        if self.field is None or not isinstance(test, Contains):
            return False
        # Elements of nested lists are compared, fields of objects in lists are not.
        elements = chain.from_iterable(leaves(target, in_objects=False) for target in targets)
        return any(map(test.equal.passes, elements))

    def targets(self, value: JsonValue) -> list[JsonValue]:
        """Returns the parts of a value that are tested."""
        return [value] if self.field is None else at_field(value, self.field)

    @property
    def array(self) -> str:
        """The dot-path of the list from which the field picks an element, else the field."""
        return _INDICES.sub("", self.field or "")

    @property
    def looks_at_numbers(self) -> bool:
        """Whether numbers in arrays, which summaries lack, are compared.

        In a whole value, "equals 1" means the boolean true.
        """
        test = self.test
        if isinstance(test, NearPosition) or plain_text(test) is not None:
            return False
        is_number = isinstance(test, Equals) and test.boolean is None
        return self.field is not None or is_number

    @property
    def can_be_refused(self) -> bool:
        """Whether values of some shapes cannot match; see `refusal_for`.

        Not so if a number or boolean may be anywhere in a value: even a text may have it as JSON.
        """
        test = self.test
        return (
            self.field is not None
            or isinstance(test, NearPosition)
            or (isinstance(test, Contains) and test.is_number)
            or (isinstance(test, Equals) and plain_text(test) is not None)
        )


def matched_texts(condition: Condition, value: JsonValue) -> tuple[str, ...]:
    """Returns the texts in a value that meet a condition on texts, each once, in order."""
    test = condition.test
    if not isinstance(test, Contains | Equals):
        return ()
    texts: dict[str, None] = {}
    for target in condition.targets(value):
        # `leaves` goes through a value from its end.
        for leaf in reversed([*leaves(target)]):
            text = leaf.name if isinstance(leaf, NamedNumber) else leaf
            if isinstance(text, str) and test.passes(text):
                texts[text] = None
    return tuple(texts)


def texts_beside(condition: Condition, value: JsonValue) -> tuple[str, ...]:
    """Returns what the objects are called, and say, whose field meets a condition, each once.

    That is what `above` 30 finds in a log, or in one of several nodes of diagnostics.
    """
    holder, _, key = (condition.field or "").rpartition(".")
    on_key = replace(condition, field=key or None)
    found = at_field(value, holder) if holder else [value]
    objects = chain.from_iterable(each if isinstance(each, list) else [each] for each in found)
    said = (
        one.get(name)
        for one in objects
        if isinstance(one, dict) and on_key.matches(one)
        for name in ("name", "msg", "message")
    )
    return tuple(dict.fromkeys(text for text in said if text and isinstance(text, str)))


def parse_condition(
    condition_type: str,
    value: JsonValue,
    tolerance_m: float,
    field: str | None = None,
    min_score: float = 0.0,
) -> Condition:
    """Returns the condition that a planner's arguments describe.

    Args:
        condition_type: a key of `_EXAMPLES`.
        value: a string, number or boolean; for `above` and `below` a number; for `near_position`
            an object with x, y and perhaps z (m).
        tolerance_m: how near `near_position` is.
        field: dot-path of the part that is tested; None or blank for the whole value. `above` and
            `below` need one, since most messages have numbers of many kinds.
        min_score: detections of a lower score do not count.

    Raises:
        InvalidArgumentsError: an argument is invalid; the message says why and gives an example.
    """
    path = with_dots((field or "").strip()) or None
    test = _parse_test(condition_type, value, tolerance_m)
    if isinstance(test, Beyond) and path is None:
        raise InvalidArgumentsError(
            f"'{condition_type}' needs field, the dot-path of the number that is meant;"
            f" for example {_EXAMPLES[condition_type]}"
        )
    return Condition(test, path, min_score)


def at_field(value: T, dot_path: str) -> list[T]:
    """Returns the parts of an extracted value that a dot-path leads to, perhaps none.

    In a list the path goes on in every element: `detections.label` gives all labels. A whole number
    picks one element (negative: from the end): `detections.0.label` gives the first label, and
    `status[name=left].level` the levels of elements with that name. A number picks an axis of a
    point, too. `positions.elbow` of joint states gives the position beside
    `elbow` in the list of names. In a text that is JSON the path goes on, too.
    """
    head, _, name = dot_path.partition(".")
    names = names_beside(value, dot_path)
    path = [head, str(names.index(name))] if name in names else segments_of(dot_path)
    return along(value, path)[-1]


def picked(elements: list[T], segment: str) -> list[T] | None:
    """Returns the elements of a list that a segment picks: by an index, or as a `Selector`.

    None if the segment is the name of a field.
    """
    if INDEX.fullmatch(segment):
        index = int(segment)
        return [elements[index]] if -len(elements) <= index < len(elements) else []
    selector = Selector.of(segment)
    if selector is None:
        return None
    objects = (element for element in elements if isinstance(element, dict))
    return [element for element in objects if selector.accepts(element.get(selector.field))]


def along(
    value: T, path: Sequence[str], pick: Callable[[list[T], str], list[T] | None] = picked
) -> list[list[T]]:
    """Returns the parts that each beginning of a path leads to: first the value, last the targets.

    `pick` returns the elements of a list that a segment picks, as `picked` does.
    """
    nodes = [[value]]
    for segment in path:
        nodes.append([target for node in nodes[-1] for target in _descend(node, segment, pick)])
    return nodes


def positions(value: JsonValue) -> Iterator[Vector3]:
    """Yields the positions (m) in a value, with NaN for a coordinate that is missing or null.

    If the value is an object with x and y, or a list of such, these are the positions. Else it is
    the objects at any depth under `position`, `point` or `translation`.
    """
    for node in points(value, lambda axis: isinstance(axis, int | float | None)):
        yield (as_float(node["x"]), as_float(node["y"]), as_float(node.get("z")))


def points(value: T, is_axis: Callable[[T], bool]) -> Iterator[dict[str, T]]:
    """Yields the objects of `positions`; `is_axis` says whether a node may be a coordinate."""
    own = [*_own_points(value, is_axis)]
    yield from own
    waiting = [] if own else [value]
    while waiting:
        node = waiting.pop()
        if isinstance(node, list):
            waiting.extend(reversed(node))
        elif isinstance(node, dict):
            for key in POSITION_KEYS:
                if key in node:
                    yield from _own_points(node[key], is_axis)
            waiting.extend(reversed(node.values()))


def _parse_test(condition_type: str, value: JsonValue, tolerance_m: float) -> Test:
    if condition_type == "near_position":
        return _parse_near(value, tolerance_m)
    if condition_type not in _EXAMPLES:
        raise InvalidArgumentsError(
            f"condition_type '{condition_type}' is not one of {', '.join(_EXAMPLES)};"
            f" for example {_EXAMPLES['contains']}"
        )
    example = f"for example {_EXAMPLES[condition_type]}"
    if condition_type in {"above", "below"}:
        limit = _meaning(value) if isinstance(value, Scalar) else None
        is_nan = isinstance(limit, float) and math.isnan(limit)
        if limit is None or isinstance(limit, bool) or is_nan:
            raise InvalidArgumentsError(
                f"'{condition_type}' takes a number as value, not {_kind(value)}; {example}"
            )
        return Beyond(limit, above=condition_type == "above")
    if not isinstance(value, bool | int | float | str):
        raise InvalidArgumentsError(
            f"'{condition_type}' takes a text, a number or a boolean as value,"
            f" not {_kind(value)}; {example}"
        )
    if isinstance(value, float) and math.isnan(value):
        raise InvalidArgumentsError(f"the value is NaN, which nothing is equal to; {example}")
    if condition_type == "equals":
        return Equals(value)
    test = Contains(value, whole=condition_type == "contains_word")
    if isinstance(value, str) and not (test.folded or "").strip():
        raise InvalidArgumentsError(
            f"'{condition_type}' takes a text that is not blank; {example}; for any text,"
            " get_topic_in_range with changes lists each that a topic, or one of its fields, held"
        )
    return test


def _parse_near(value: JsonValue, tolerance_m: float) -> NearPosition:
    example = f"for example {_EXAMPLES['near_position']}"
    if not isinstance(value, dict):
        raise InvalidArgumentsError(
            f"'near_position' takes an object with x and y (and z) in metres as value,"
            f" not {_kind(value)}; {example}"
        )
    if unknown := sorted(value.keys() - {"x", "y", "z", "frame_id"}):
        raise InvalidArgumentsError(
            f"'near_position' knows x, y, z and frame_id only, not {abbreviate(unknown)}; {example}"
        )
    x, y = as_float(value.get("x")), as_float(value.get("y"))
    z = None if value.get("z") is None else as_float(value["z"])
    for axis, coordinate in (("x", x), ("y", y), ("z", z)):
        if coordinate is not None and not math.isfinite(coordinate):
            raise InvalidArgumentsError(
                f"'{axis}' of 'near_position' must be a finite number of metres,"
                f" not {_kind(value.get(axis))}; {example}"
            )
    frame_id = value.get("frame_id")
    if frame_id is not None and not (isinstance(frame_id, str) and frame_id.strip()):
        raise InvalidArgumentsError(
            f"'frame_id' of 'near_position' must be the name of a frame, not {_kind(frame_id)};"
            f" {example}"
        )
    return NearPosition(x, y, z, float(tolerance_m), frame_id)


def _kind(value: JsonValue) -> str:
    """Returns a value as an error names it."""
    if isinstance(value, list):
        return "a list"
    return "an object" if isinstance(value, dict) else abbreviate(value)


def _descend(node: T, segment: str, pick: Callable[[list[T], str], list[T] | None]) -> Iterator[T]:
    """Yields the parts of a node that one segment of a dot-path leads to."""
    if isinstance(node, dict):
        if segment in node:
            yield node[segment]
        elif segment in _AXES and node.keys() == _POINT:
            yield node[_AXES[segment]]
    elif isinstance(node, list):
        chosen = pick(node, segment)
        if chosen is not None:
            yield from chosen
            return
        for element in node:
            yield from _descend(element, segment, pick)
    elif isinstance(node, str) and looks_like_json(node):
        yield from _descend(cast("T", parsed_json(node)), segment, pick)


def leaves(value: T, *, in_objects: bool = True) -> Iterator[T]:
    """Yields all parts at any depth that are neither a list nor an object, from the last one on.

    Without `in_objects`, nothing inside an object. Only the texts of a summary are leaves: its
    sizes are no numbers of the array.
    """
    waiting = [value]
    while waiting:
        node = waiting.pop()
        if isinstance(node, list):
            waiting += node
        elif not isinstance(node, dict):
            yield node
        elif in_objects:
            is_summary = isinstance(node, Summary)
            waiting += [
                part for part in node.values() if not (is_summary and isinstance(part, int | list))
            ]


def _own_points(value: T, is_axis: Callable[[T], bool]) -> Iterator[dict[str, T]]:
    """Yields the value, or the elements of a list, that are objects with an x and a y."""
    for node in value if isinstance(value, list) else (value,):
        # A null was NaN, which is a coordinate. Texts and lists are none.
        if isinstance(node, dict) and all(axis in node and is_axis(node[axis]) for axis in "xy"):
            yield node


def as_float(value: JsonValue) -> float:
    """Returns a number as a float; NaN, which is near nothing, for any other value."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _meaning(value: Scalar) -> bool | int | float | None:
    """Returns the boolean or number that a value is or, if it is a string, spells; else None."""
    if not isinstance(value, str):
        return value
    word = caseless(value.strip())
    if word in {"true", "false"}:
        return word == "true"
    if _WHOLE.fullmatch(word):
        return int(word)
    return float(word) if _DECIMAL.fullmatch(word) else None


def _text_of(needle: Scalar) -> str | None:
    """Returns a string as it is, and any other needle as JSON; None for a number too long."""
    if isinstance(needle, str):
        return needle
    try:
        return json.dumps(needle)
    except ValueError:
        return None


def stored_as(number: float) -> float:
    """Returns the number that a float32 field stores in place of this one.

    A number from 2**24 to 2**53 stays as it is: a float32 would round a Unix time to minutes.
    """
    rounded = _float32(number)
    return number if rounded == 0.0 or _SINGLE_BELOW <= abs(number) < _EXACT_BELOW else rounded


def _float32(number: float) -> float:
    """Returns the number rounded to a float32; unchanged if it is beyond the range of one."""
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", number))[0]
    except (OverflowError, struct.error):
        return number
    return rounded


def plain_text(test: Test) -> str | None:
    """Returns the text that a test looks for; None if it looks for a boolean or a number."""
    if isinstance(test, Contains):
        needle = test.needle
    elif isinstance(test, Equals):
        needle = test.value
    else:
        return None
    return needle if isinstance(needle, str) and _meaning(needle) is None else None

"""Conditions on one extracted value.

They are tested on the whole value, before anything in it is downsampled or rounded. NaN and null
match nothing. `refusal_for` says where no value of a shape can match: a search for a field that
the values do not have would find nothing, and the answer "never" would be false.
"""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, starmap
from typing import TYPE_CHECKING, Final, TypeAlias, TypeVar

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.text import abbreviate, caseless, looks_like_json
from ros2_memory.messages.conversions import INDEX, Summary, names_beside
from ros2_memory.messages.detections import detections_of, without_low_scores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.extract import SchemaExtractor

T = TypeVar("T")

Scalar: TypeAlias = bool | int | float | str

POSITION_KEYS: Final = ("position", "point", "translation")
"""Keys under which a value holds a place; x and y under other keys may be a velocity or an axis."""

# Bounded, since int() refuses texts of thousands of digits.
_WHOLE: Final = re.compile(r"[-+]?\d{1,300}", re.ASCII)
_DECIMAL: Final = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_LISTED_PATHS: Final = 16
_AXES: Final = {"0": "x", "1": "y", "2": "z"}
"""An array of three numbers may be shown as a point."""
_POINT: Final = {*_AXES.values()}
_PICKED: Final = re.compile(r"(\.-?\d+)+$")
_EXAMPLES: Final = {
    "contains": 'condition_type "contains", value "scissors"',
    "contains_word": 'condition_type "contains_word", value "pot", which is not in "potato"',
    "equals": 'condition_type "equals", value true',
    "above": 'condition_type "above", value 0.5, field "linear_velocity.x"',
    "below": 'condition_type "below", value 0.2, field "percentage"',
    "near_position": 'condition_type "near_position", value {"x": 1.5, "y": -0.2}',
}
_SINGLE_BELOW: Final = 2**24
"""Whole numbers below this are float32s."""
_EXACT_BELOW: Final = 2**53
"""Whole numbers below this are floats."""
_SIDES: Final = {"above": True, "below": False}
"""Conditions on a number, and whether it is to be above the limit."""


@dataclass(frozen=True)
class Contains:
    """Part of a string, or an element of a list.

    A string is found inside any string at any depth (not in the keys), without regard to case; a
    boolean wherever one is equal. A number is a whole value, never a part of one, and is searched
    only where a field leads (`has_element`): in a whole message every size, level and coordinate
    would match. Elsewhere its digits are searched as a string.

    With `whole` it must stand there as whole words: `pot` is in "the pot", not in "potato". Words
    behind it that begin with a minus must not stand there: `knife -butter`. Of a string that is
    JSON it is enough that this is so of a label of its detections.
    """

    needle: Scalar
    whole: bool = False

    @cached_property
    def equal(self) -> Equals:
        """What an element is compared with."""
        return Equals(self.needle)

    @cached_property
    def others(self) -> tuple[str, ...]:
        """The casefolded words that must not be there."""
        words = caseless(_text_of(self.needle) or "").split() if self.whole else []
        return tuple(word[1:] for word in words if word[0] == "-" and len(word) > 1)

    @cached_property
    def folded(self) -> str | None:
        """The needle as casefolded text; None where no text can contain it."""
        text = _text_of(self.needle)
        if text is None or not self.others:
            return None if text is None else caseless(text)
        return " ".join(word for word in caseless(text).split() if word[0] != "-")

    @cached_property
    def boolean(self) -> bool | None:
        """The boolean that matches; None where none does."""
        meant = _meaning(self.needle)
        return meant if isinstance(meant, bool) else None

    @property
    def is_number(self) -> bool:
        """Whether the needle is a number or spells one."""
        meant = _meaning(self.needle)
        return isinstance(meant, int | float) and not isinstance(meant, bool)

    @property
    def is_one_word(self) -> bool:
        """Whether it is a row of letters that is found wherever a text has it, and no number."""
        return not self.whole and (self.folded or "").isalpha()

    def passes(self, leaf: JsonValue) -> bool:
        """Returns whether a leaf is a string that has the needle, or the boolean that it means."""
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

    1 and 0 equal true and false. A number equals itself, and a float that a float32 field stores of
    it. Strings are compared without regard to case; one that spells a boolean or a number equals
    that too, since planners put values in quotes. Of a string that is JSON the labels of its
    detections are compared, too.
    """

    value: Scalar

    @cached_property
    def folded(self) -> str | None:
        """The casefolded text that is equal; None where no text is."""
        return caseless(self.value) if isinstance(self.value, str) else None

    @cached_property
    def boolean(self) -> bool | None:
        """The boolean that is equal; None where none is."""
        meant = _meaning(self.value)
        return bool(meant) if meant is not None and meant in (0, 1) else None

    @cached_property
    def integers(self) -> tuple[int | float, ...]:
        """The number that an integer is equal to, if any."""
        meant = _meaning(self.value)
        return () if meant is None else (meant,)

    @cached_property
    def numbers(self) -> tuple[int | float, ...]:
        """The numbers that a float is equal to."""
        return tuple(number for meant in self.integers for number in (meant, stored_as(meant)))

    def passes(self, leaf: JsonValue) -> bool:
        """Returns whether a leaf is equal."""
        if isinstance(leaf, bool):
            return leaf is self.boolean
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

    Excluded is also what a float32 field stores of the limit: 0.2 there is 0.2000000030.
    """

    limit: int | float
    above: bool

    @property
    def stored(self) -> float:
        """The limit as a float32 field stores it."""
        return stored_as(self.limit)

    def passes(self, leaf: JsonValue) -> bool:
        """Returns whether a leaf is a number on that side."""
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            return False
        if isinstance(leaf, float) and leaf == self.stored:
            return False
        return leaf > self.limit if self.above else leaf < self.limit


@dataclass(frozen=True, slots=True)
class NearPosition:
    """A position (m) within `tolerance_m`, inclusive; in the plane where `z` is None.

    The frame is the value's own; `frame_id` is what the question says that it is, if it does. A
    position without a finite x and y (and z, where one is asked) never matches.
    """

    x: float
    y: float
    z: float | None
    tolerance_m: float
    frame_id: str | None = None

    def is_near(self, x: float, y: float, z: float) -> bool:
        """Returns whether a position (m) is near; its z may be NaN where none is asked."""
        off_x, off_y, off_z = x - self.x, y - self.y, 0.0 if self.z is None else z - self.z
        # Not `math.dist`: numpy computes the same of columns.
        return math.sqrt(off_x * off_x + off_y * off_y + off_z * off_z) <= self.tolerance_m


Test: TypeAlias = Contains | Equals | Beyond | NearPosition


@dataclass(frozen=True, slots=True)
class Condition:
    """A test, and the dot-path of the part of the value that it is applied to (None: all of it).

    Where `min_score` is above 0, detections of a lower score do not count.
    """

    test: Test
    field: str | None = None
    min_score: float = 0.0

    def of_type(self, type_name: str, extractor: SchemaExtractor) -> Condition:
        """Returns the condition on extracted values of a type, where `field` may be a full path."""
        if self.field is None:
            return self
        path = extractor.own_path(self.field, type_name)
        return self if path == self.field else replace(self, field=path)

    def is_unstated(self, value: JsonValue) -> bool:
        """Returns whether a value says nothing of the field: it names other elements.

        So it is of joint states where several nodes publish those of some joints each.
        """
        names = names_beside(value, self.field or "")
        return bool(names) and self.element not in names

    @property
    def element(self) -> str:
        """The name of an element that the field asks for, where it asks for one."""
        return (self.field or "").partition(".")[2]

    def matches(self, value: JsonValue) -> bool:
        """Returns whether the value, or any target of the field in it, passes the test."""
        if not self._passes(value):
            return False
        # Both have to pass, since a zone map bounds the whole value alone.
        counted = self.counted(value)
        return counted is value or self._passes(counted)

    def counted(self, value: JsonValue) -> JsonValue:
        """Returns what of a value counts; see `without_low_scores`."""
        return value if self.min_score <= 0 else without_low_scores(value, self.least_score)

    @property
    def least_score(self) -> float:
        """The score from which on detections count.

        A limit is met by its float32 rounding, too, which is what most detectors store.
        """
        return min(self.min_score, _float32(self.min_score))

    def _passes(self, value: JsonValue) -> bool:
        targets, test = self.targets(value), self.test
        if isinstance(test, NearPosition):
            return any(starmap(test.is_near, chain.from_iterable(map(positions, targets))))
        for target in targets:
            if any(map(test.passes, leaves(target))):
                return True
        if self.field is None or not isinstance(test, Contains):
            return False
        # Elements of nested lists count as such, too, fields of objects in them do not.
        elements = chain.from_iterable(leaves(target, in_objects=False) for target in targets)
        return any(map(test.equal.passes, elements))

    def targets(self, value: JsonValue) -> list[JsonValue]:
        """Returns the parts of a value that are tested."""
        return [value] if self.field is None else at_field(value, self.field)

    @property
    def array(self) -> str:
        """The dot-path of the list from which the field picks an element, else the field."""
        return _PICKED.sub("", self.field or "")

    @property
    def looks_at_numbers(self) -> bool:
        """Whether numbers in arrays are compared; of a whole value no boolean is meant by them."""
        test = self.test
        if isinstance(test, NearPosition) or _plain_text(test) is not None:
            return False
        is_number = isinstance(test, Equals) and test.boolean is None
        return self.field is not None or is_number

    @property
    def can_be_refused(self) -> bool:
        """Whether some values have a shape that cannot match; see `refusal_for`.

        Not of a number or boolean that any part may equal: as JSON, another message may have one.
        """
        test = self.test
        return (
            self.field is not None
            or isinstance(test, NearPosition)
            or (isinstance(test, Contains) and test.is_number)
            or (isinstance(test, Equals) and _plain_text(test) is not None)
        )


def matched_texts(condition: Condition, value: JsonValue) -> tuple[str, ...]:
    """Returns the texts in a value that meet a condition on texts, each once, in their order."""
    test = condition.test
    if not isinstance(test, Contains | Equals):
        return ()
    # `leaves` goes through a value from its end.
    parts = chain.from_iterable([*leaves(target)][::-1] for target in condition.targets(value))
    return tuple(
        dict.fromkeys(leaf for leaf in parts if isinstance(leaf, str) and test.passes(leaf))
    )


def summarising(field: str | None, value: JsonValue) -> list[Condition]:
    """Returns what messages meet that only summarise an array at or below a field.

    The arrays are found in one value.
    """
    paths = [*_dot_paths(value, "")]
    if field:
        below = (_dot_paths(target, f"{field}.") for target in at_field(value, field))
        paths = [field, *chain.from_iterable(below)]
    arrays = [path for path in dict.fromkeys(paths) if any(map(_is_array, at_field(value, path)))]
    sizes = [f"{path}.{size}" for path in arrays for size in ("bytes", "numbers")]
    return [Condition(Beyond(-1, above=True), size) for size in sizes]


def _is_array(value: JsonValue) -> bool:
    """Whether a value is an array of numbers or booleans, or may be, or the summary of one."""
    if isinstance(value, list):
        return not value or isinstance(value[0], bool | int | float)
    return isinstance(value, Summary)


def parse_condition(
    condition_type: str,
    value: JsonValue,
    tolerance_m: float,
    field: str | None = None,
    min_score: float = 0.0,
) -> Condition:
    """Returns the condition that a planner's arguments describe.

    Args:
        condition_type: one of `_EXAMPLES`.
        value: a string, number or boolean; for `above` and `below` a number; for `near_position`
            an object with x, y and perhaps z.
        tolerance_m: how near `near_position` is.
        field: dot-path in the value that narrows the test; None or blank for all of it. `above`
            and `below` need one: most messages have numbers of many kinds.
        min_score: detections of a lower score do not count.

    Raises:
        InvalidArgumentsError: the sentence says what is wrong and gives an example.
    """
    path = (field or "").strip() or None
    test = _parse_test(condition_type, value, tolerance_m)
    if isinstance(test, Beyond) and path is None:
        raise InvalidArgumentsError(
            f"'{condition_type}' needs field, the dot-path of the number that is meant;"
            f" for example {_EXAMPLES[condition_type]}"
        )
    return Condition(test, path, min_score)


def at_field(value: T, dot_path: str) -> list[T]:
    """Returns what is at a dot-path in an extracted value; empty where there is nothing.

    Over a list the path goes on in every element, unless the segment is a whole number, which
    selects one (negative: from the end); of a point it selects an axis. `detections.label` gives
    every label, `detections.0.label` the first. Of joint states `positions.elbow` is what `names`
    has beside it in each value.
    """
    head, _, name = dot_path.partition(".")
    names = names_beside(value, dot_path)
    is_name = name in names
    return along(value, [head, str(names.index(name))] if is_name else dot_path.split("."))[-1]


def element_at(elements: list[T], index: int) -> list[T]:
    """Returns the element at a place, negative from the end, if there is one."""
    return [elements[index]] if -len(elements) <= index < len(elements) else []


def along(
    value: T, path: Sequence[str], pick: Callable[[list[T], int], list[T]] = element_at
) -> list[list[T]]:
    """Returns what is at each beginning of a path: first the value, last its targets.

    `pick` returns the element of a list at a place.
    """
    nodes = [[value]]
    for segment in path:
        nodes.append([target for node in nodes[-1] for target in _descend(node, segment, pick)])
    return nodes


def positions(value: JsonValue) -> Iterator[Vector3]:
    """Yields the positions (m) in a value, with NaN for a coordinate that is missing or null.

    The value itself where it is an object with x and y, or the elements of a list of those; else
    the objects found at any depth under `position`, `point` or `translation`.
    """
    for node in points(value, lambda axis: isinstance(axis, int | float | None)):
        yield (as_float(node["x"]), as_float(node["y"]), as_float(node.get("z")))


def points(value: T, is_axis: Callable[[T], bool]) -> Iterator[dict[str, T]]:
    """Yields the objects that are the positions in a value.

    `is_axis` returns whether something may be a coordinate.
    """
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
    if condition_type in _SIDES:
        limit = _meaning(value) if isinstance(value, Scalar) else None
        is_nan = isinstance(limit, float) and math.isnan(limit)
        if limit is not None and not isinstance(limit, bool) and not is_nan:
            return Beyond(limit, _SIDES[condition_type])
        raise InvalidArgumentsError(
            f"'{condition_type}' takes a number as value, not {_kind(value)}; {example}"
        )
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
        raise InvalidArgumentsError(f"'{condition_type}' takes a text that is not blank; {example}")
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
    if not (math.isfinite(tolerance_m) and tolerance_m >= 0):
        raise InvalidArgumentsError(
            f"the tolerance must be a finite number of metres, 0 or more, not {tolerance_m}"
        )
    frame_id = value.get("frame_id")
    if frame_id is not None and not (isinstance(frame_id, str) and frame_id.strip()):
        raise InvalidArgumentsError(
            f"'frame_id' of 'near_position' must be the name of a frame, not {_kind(frame_id)};"
            f" {example}"
        )
    return NearPosition(x, y, z, float(tolerance_m), frame_id)


def _kind(value: JsonValue) -> str:
    """Returns a value as a sentence names it."""
    if isinstance(value, list):
        return "a list"
    return "an object" if isinstance(value, dict) else abbreviate(value)


def _descend(node: T, segment: str, pick: Callable[[list[T], int], list[T]]) -> Iterator[T]:
    if isinstance(node, dict):
        if segment in node:
            yield node[segment]
        elif segment in _AXES and node.keys() == _POINT:
            yield node[_AXES[segment]]
    elif isinstance(node, list):
        if INDEX.fullmatch(segment):
            yield from pick(node, int(segment))
        else:
            for element in node:
                yield from _descend(element, segment, pick)


def leaves(value: T, *, in_objects: bool = True) -> Iterator[T]:
    """Yields everything at any depth that is neither a list nor an object.

    Without `in_objects` nothing inside an object: the value itself, or the elements of a list. Of a
    summary its texts: its sizes are not what the array holds.
    """
    waiting = [value]
    while waiting:
        node = waiting.pop()
        if isinstance(node, Summary):
            texts = (part for part in node.values() if not isinstance(part, int | list))
            waiting += texts if in_objects else ()
            continue
        if isinstance(node, dict):
            if in_objects:
                waiting += node.values()
        elif isinstance(node, list):
            waiting += node
        else:
            yield node


def _own_points(value: T, is_axis: Callable[[T], bool]) -> Iterator[dict[str, T]]:
    """Yields the object that a value is, or the elements of a list, that have an x and a y."""
    for node in value if isinstance(value, list) else (value,):
        # Null is a coordinate that was NaN; texts and lists are not coordinates at all.
        if isinstance(node, dict) and all(axis in node and is_axis(node[axis]) for axis in "xy"):
            yield node


def as_float(value: JsonValue) -> float:
    """Returns a number as it is; NaN for anything else, so that it is near nothing."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _meaning(value: Scalar) -> bool | int | float | None:
    """Returns a boolean or number as it is, or the one that a string spells, if any."""
    if not isinstance(value, str):
        return value
    word = caseless(value.strip())
    if word in {"true", "false"}:
        return word == "true"
    if _WHOLE.fullmatch(word):
        return int(word)
    return float(word) if _DECIMAL.fullmatch(word) else None


def _text_of(needle: Scalar) -> str | None:
    """Returns the needle as a string, in JSON's spelling; None for a number too long to spell."""
    if isinstance(needle, str):
        return needle
    try:
        return json.dumps(needle)
    except ValueError:
        return None


def stored_as(number: float) -> float:
    """Returns the number that a float32 field holds where this one was meant.

    Itself where that is another number: from 24 bits on a float32 has no digits after the point,
    and a Unix time would be that of a minute later.
    """
    rounded = _float32(number)
    return number if rounded == 0.0 or _SINGLE_BELOW <= abs(number) < _EXACT_BELOW else rounded


def _float32(number: float) -> float:
    """Returns the number rounded to a float32; itself where a float32 cannot represent it."""
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", number))[0]
    except (OverflowError, struct.error):
        return number
    return rounded


def refusal_for(condition: Condition, value: JsonValue) -> str | None:
    """Returns why no value of this shape can match; None where one may.

    An empty list or a null in the value may be anything in another message, so nothing is refused
    for what would be below it.
    """
    targets = [value]
    if condition.field is not None:
        if _is_unknown_below(value, condition.field):
            return None
        targets = at_field(value, condition.field)
        if not targets:
            paths = ", ".join(_paths(value)) or "none"
            refusal = f"the values have no field {condition.field!r}; their fields are: {paths}"
            named = ", ".join(map(str, names_beside(value, condition.field)[:_LISTED_PATHS]))
            return f"{refusal}; or an element of a list by its name: {named}" if named else refusal
    elif isinstance(condition.test, NearPosition):
        if any(True for _ in positions(value)) or _has_unknown_part(value):
            return None
        return _refusal_for_position(value)
    return _refusal_for_summary(condition, targets) or _refusal_for_kind(condition, targets)


def _refusal_for_position(value: JsonValue) -> str:
    if isinstance(value, dict) and value.keys() >= {"latitude", "longitude"}:
        return (
            "the values give latitude and longitude in degrees, and near_position compares metres: "
            "ask with above or below on field latitude or longitude"
        )
    return (
        "the values have no position: near_position needs a topic that does, "
        "or a field that leads to an object with x and y"
    )


def _refusal_for_summary(condition: Condition, targets: Sequence[JsonValue]) -> str | None:
    """Returns why a number is not known to be in none of these; None where it is, or no number."""
    field = condition.field
    summary = next((target for target in targets if isinstance(target, Summary)), None)
    if field is None or summary is None or _plain_text(condition.test) is not None:
        return None
    keys = ", ".join(f"{field}.{key}" for key in summary)
    return f"field {field!r} is only summarised, and its numbers are not searched: ask about {keys}"


def _refusal_for_kind(condition: Condition, targets: Sequence[JsonValue]) -> str | None:
    """Returns why all of these are of another kind than what is looked for; None where one is."""
    test, field = condition.test, condition.field
    kinds = {type(leaf) for target in targets for leaf in leaves(target)}
    met: set[type] = {str}
    given = ""
    if isinstance(test, Beyond):
        met, given = {int, float}, f"{'above' if test.above else 'below'} compares numbers"
    elif isinstance(test, Contains) and test.is_number:
        are_elements = (leaves(target, in_objects=False) for target in targets if field)
        if str in kinds or not kinds & {int, float} or any(True for _ in chain(*are_elements)):
            return None
        return (
            "the values hold numbers and no text, and contains finds a number only as the value "
            "of a field or as an element of its list: name that in field, or ask with equals"
        )
    elif isinstance(test, Equals) and not isinstance(test.value, str):
        met = {bool, int, float}
        kind = "boolean" if isinstance(test.value, bool) else "number"
        given = f"{abbreviate(test.value)} is a {kind}"
    elif (text := _plain_text(test)) is not None and (field or isinstance(test, Equals)):
        given = f"{abbreviate(text)} is a text"
    if not given or not kinds or kinds & met or any(map(_has_unknown_part, targets)):
        return None
    where = "the values" if field is None else f"the values of field {field!r}"
    name, wanted = ("texts", "a text") if str in kinds else ("numbers", "a number")
    if kinds == {bool}:
        name, wanted = "booleans", "true or false"
    needed = "" if isinstance(test, Beyond) else f": the value must be {wanted}"
    return f"{where} are {name}, and {given}{needed}"


def _plain_text(test: Test) -> str | None:
    """Returns the text that a test looks for, unless it spells a boolean or a number."""
    if isinstance(test, Contains):
        needle = test.needle
    elif isinstance(test, Equals):
        needle = test.value
    else:
        return None
    return needle if isinstance(needle, str) and _meaning(needle) is None else None


def _is_unknown_below(value: JsonValue, dot_path: str) -> bool:
    """Returns whether some beginning of the path leads to an empty list or a null."""
    beginnings = chain.from_iterable(along(value, dot_path.split("."))[:-1])
    return any(target is None or target == [] for target in beginnings)


def shows_field(value: JsonValue, dot_path: str) -> bool:
    """Returns whether others lack what this value lacks; not below an empty list, nor by a name."""
    if _is_unknown_below(value, dot_path):
        return False
    return bool(at_field(value, dot_path)) or not names_beside(value, dot_path)


def _has_unknown_part(value: JsonValue) -> bool:
    if isinstance(value, dict):
        return any(_has_unknown_part(inner) for inner in value.values())
    if isinstance(value, list):
        return not value or any(_has_unknown_part(inner) for inner in value)
    return value is None


def _paths(value: JsonValue) -> list[str]:
    """Returns the dot-paths of a value, outermost first, as many as fit into a sentence."""
    paths = list(dict.fromkeys(_dot_paths(value, "")))
    paths.sort(key=lambda path: path.count("."))
    more = len(paths) - _LISTED_PATHS
    return [*paths[:_LISTED_PATHS], *([f"{more} more"] if more > 0 else [])]


def _dot_paths(value: JsonValue, prefix: str) -> Iterator[str]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield f"{prefix}{name}"
            yield from _dot_paths(inner, f"{prefix}{name}.")
    elif isinstance(value, list):
        for element in value[:1]:
            yield from _dot_paths(element, prefix)

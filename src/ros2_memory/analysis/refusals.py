"""Why no value of some shape can meet a condition.

Without a refusal, a search on a field that the values do not have would find nothing, and the
answer "never" would be false.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.conditions import (
    Beyond,
    Condition,
    Contains,
    Equals,
    NearPosition,
    along,
    at_field,
    leaves,
    plain_text,
    positions,
)
from ros2_memory.core.text import listed, looks_like_json
from ros2_memory.messages.conversions import (
    NamedNumber,
    Selector,
    Summary,
    names_beside,
    segments_of,
    without_selectors,
)
from ros2_memory.messages.detections import parsed_json

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue

_LISTED_PATHS: Final = 16
"""How many dot-paths a sentence lists."""


def refusal_for(condition: Condition, value: JsonValue) -> str | None:
    """Returns why no value of this shape can match; None if one may.

    A field below an empty list or a null is never refused: other messages may have it.
    """
    field, targets = condition.field, [value]
    if field is None and isinstance(condition.test, NearPosition):
        return _refusal_for_position(value)
    if field is not None:
        if _is_unknown_below(value, field):
            return None
        targets = at_field(value, field)
        if not targets and not at_field(value, without_selectors(field)):
            fields = f"{_paths(value, field)}{_hint_on_json(value)}"
            return f"the values have no field {field!r}; their fields are: {fields}"
    return _refusal_for_summary(condition, targets) or _refusal_for_kind(condition, targets)


def _hint_on_json(value: JsonValue) -> str:
    """Returns the fields of the JSON that is all of a value, and how to search it as a text."""
    text = _json_text(value)
    if text is None:
        return ""
    return (
        f", a text of JSON, with {_fields_of_json(text)}: contains and contains_word look for "
        "words in it, and min_score leaves out detections"
    )


def _json_text(value: JsonValue) -> str | None:
    """Returns the text of JSON that is all of a value; None if the value is anything else."""
    text = value.get("value") if isinstance(value, dict) and len(value) == 1 else None
    return text if isinstance(text, str) and looks_like_json(text) else None


def _fields_of_json(text: str) -> str:
    paths = dict.fromkeys(_dot_paths(parsed_json(text), "value."))
    return listed([*paths], at_most=_LISTED_PATHS) or "no fields"


def lack_in_json(field: str, value: JsonValue) -> str | None:
    """Returns that the JSON which is all of a value lacks a field, and its fields; else None.

    Other messages may have the field, so that this is no refusal.
    """
    text = _json_text(value)
    if text is None or not field.startswith("value.") or at_field(value, without_selectors(field)):
        return None
    return f"its newest JSON has no {field}, but {_fields_of_json(text)}"


def lack_of_element(field: str, value: JsonValue) -> str | None:
    """Returns that no element of a list is one that a path selects, and what they say; else None.

    Other messages may have it, so that this is no refusal.
    """
    path = segments_of(field)
    for nth, segment in enumerate(path):
        selector = Selector.of(segment)
        if selector is not None and not along(value, path[: nth + 1])[-1]:
            said = along(value, [*path[:nth], selector.field])[-1]
            named = [part.name if isinstance(part, NamedNumber) else str(part) for part in said]
            others = f", but {listed([*dict.fromkeys(named)])}" if named else ""
            return f"no element of its newest message has {segment[1:-1]}{others}"
    return None


def _refusal_for_position(value: JsonValue) -> str | None:
    if any(True for _ in positions(value)) or _has_unknown_part(value):
        return None
    return (
        "the values have no position in metres: near_position needs a topic that does, or a field "
        "that leads to an object with x and y; above and below compare latitude and longitude"
    )


def _refusal_for_summary(condition: Condition, targets: Sequence[JsonValue]) -> str | None:
    """Returns a refusal if the field is a summarised array, and the test is not on a text."""
    field = condition.field
    summary = next((target for target in targets if isinstance(target, Summary)), None)
    if summary is None or plain_text(condition.test) is not None:
        return None
    keys = ", ".join(f"{field}.{key}" for key in summary)
    return f"field {field!r} is only summarised, and its numbers are not searched: ask about {keys}"


def _refusal_for_kind(condition: Condition, targets: Sequence[JsonValue]) -> str | None:
    """Returns a refusal if all leaves of the targets are of types that the test never takes."""
    parts = chain.from_iterable(map(leaves, targets))
    kinds = {int if isinstance(leaf, NamedNumber) else type(leaf) for leaf in parts}
    wanted = _wanted_kinds(condition, targets)
    if wanted is None or not kinds or kinds & wanted or any(map(_has_unknown_part, targets)):
        return None
    are, example = ("texts", "a text") if str in kinds else ("numbers", "a number")
    if kinds == {bool}:
        are, example = "booleans", "true or false"
    advice = f": the value must be {example}"
    if isinstance(condition.test, Beyond):
        advice = ", and above and below compare numbers"
    elif isinstance(condition.test, Contains) and condition.test.is_number:
        advice = ", which contains looks for in a list or at one field: give field, or use equals"
    where = "the values" if condition.field is None else f"the values of field {condition.field!r}"
    return f"{where} are {are}{advice}"


def _wanted_kinds(condition: Condition, targets: Sequence[JsonValue]) -> frozenset[type] | None:
    """Returns the types of leaves that may pass; None if leaves of any type may."""
    test, has_field = condition.test, condition.field is not None
    if isinstance(test, Beyond):
        return frozenset({int, float})
    if isinstance(test, Equals) and not isinstance(test.value, str):
        return frozenset({bool, int, float})
    if isinstance(test, Contains) and test.is_number:
        elements = chain.from_iterable(leaves(target, in_objects=False) for target in targets)
        return None if has_field and any(True for _ in elements) else frozenset({str})
    is_of_leaves = has_field or isinstance(test, Equals)
    return frozenset({str}) if is_of_leaves and plain_text(test) is not None else None


def shows_field(value: JsonValue, dot_path: str) -> bool:
    """Returns whether a value shows that all values of its type have a field, or lack it.

    One does not if the field lies below an empty list or a null. Nor does one that lacks a named
    element (`positions.elbow`), since several nodes may publish some joints each.
    """
    if _is_unknown_below(value, dot_path) or without_selectors(dot_path) != dot_path:
        return False
    return bool(at_field(value, dot_path)) or not names_beside(value, dot_path)


def summary_conditions(field: str | None, value: JsonValue) -> list[Condition]:
    """Returns conditions, each met by messages that only summarise one array.

    The arrays are those at or below the field in one value; all, without a field.
    """
    paths = [*_dot_paths(value, "")]
    if field:
        below = (_dot_paths(target, f"{field}.") for target in at_field(value, field))
        paths = [field, *chain.from_iterable(below)]
    arrays = [path for path in dict.fromkeys(paths) if any(map(_is_array, at_field(value, path)))]
    sizes = [f"{path}.{size}" for path in arrays for size in ("bytes", "numbers")]
    return [Condition(Beyond(-1, above=True), size) for size in sizes]


def fields_of_constant(constant: str, value: JsonValue) -> list[str]:
    """Returns the dot-paths of the numbers whose names begin a constant: `cause` of `CAUSE_FALL`.

    Of a name of several words the last one is enough: `shore_power_state` of `STATE_OFF`.
    """
    fields: list[str] = []
    for path in dict.fromkeys(_dot_paths(value, "")):
        name = path.rpartition(".")[2]
        words = (name, name.rpartition("_")[2])
        begins = any(constant.lower().startswith(f"{word}_") for word in words)
        if begins and any(map(_is_whole_number, at_field(value, path))):
            fields.append(path)
    return fields


def _is_whole_number(value: JsonValue) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_array(value: JsonValue) -> bool:
    """Returns whether a value is or may be an array of numbers or booleans, or its summary."""
    if isinstance(value, list):
        return not value or isinstance(value[0], bool | int | float)
    return isinstance(value, Summary)


def _is_unknown_below(value: JsonValue, dot_path: str) -> bool:
    """Returns whether the path leads through an empty list, a null, or JSON, which may differ."""
    nodes = chain.from_iterable(along(value, segments_of(dot_path))[:-1])
    return any(node is None or node == [] or _is_json(node) for node in nodes)


def _is_json(value: JsonValue) -> bool:
    return isinstance(value, str) and looks_like_json(value)


def _has_unknown_part(value: JsonValue) -> bool:
    """Returns whether a value is or has an empty list or a null at any depth."""
    if isinstance(value, dict):
        return any(_has_unknown_part(inner) for inner in value.values())
    if isinstance(value, list):
        return not value or any(_has_unknown_part(inner) for inner in value)
    return value is None


def _paths(value: JsonValue, field: str) -> str:
    """Returns the dot-paths of a value, outermost first, as many as fit into a sentence.

    In place of an element with a name, as `field` may give one, they have all such names.
    """
    array = field.partition(".")[0]
    named = [f"{array}.{name}" for name in names_beside(value, field)]
    paths = sorted(dict.fromkeys(_dot_paths(value, "")), key=lambda path: path.count("."))
    listed_paths = [*named, *paths]
    more = len(listed_paths) - _LISTED_PATHS
    shown = [*listed_paths[:_LISTED_PATHS], *([f"{more} more"] if more > 0 else [])]
    return ", ".join(shown) or "none"


def _dot_paths(value: JsonValue, prefix: str) -> Iterator[str]:
    """Yields the dot-paths of all fields; those of a list by its first element."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield f"{prefix}{name}"
            yield from _dot_paths(inner, f"{prefix}{name}.")
    elif isinstance(value, list):
        for element in value[:1]:
            yield from _dot_paths(element, prefix)

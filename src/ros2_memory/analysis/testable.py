"""Whether a condition can be about a topic's values at all.

A search for a field that the values do not have would find nothing, and "never" would be a lie.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.conditions import (
    Condition,
    Contains,
    NearPosition,
    at_field,
    elements,
    leaves,
    positions,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue

_LISTED_PATHS: Final = 16


def can_be_untestable(condition: Condition) -> bool:
    """Whether there are values of a shape that cannot meet the condition."""
    test = condition.test
    return (
        condition.field is not None
        or isinstance(test, NearPosition)
        or (isinstance(test, Contains) and test.is_number)
    )


def untestable(condition: Condition, value: JsonValue) -> str | None:
    """Why no value of this shape can meet the condition; None where one may.

    An empty list or a null in the value could hold anything in another message, so nothing is
    said of what would stand below it.
    """
    if condition.field is not None:
        if _open_below(value, condition.field):
            return None
        targets = at_field(value, condition.field)
        if targets:
            return _numberless(condition, targets)
        told = ", ".join(_paths(value)) or "none"
        return f"the values have no field {condition.field!r}; their fields are: {told}"
    if isinstance(condition.test, NearPosition):
        if any(True for _ in positions(value)) or _has_open_end(value):
            return None
        return _placeless(value)
    return _numberless(condition, [value])


def _placeless(value: JsonValue) -> str:
    if isinstance(value, dict) and value.keys() >= {"latitude", "longitude"}:
        return (
            "the values give latitude and longitude in degrees, and near_position compares metres: "
            "ask with above or below on field latitude or longitude"
        )
    return (
        "the values carry no position: near_position needs a topic that does, "
        "or a field that leads to an object with x and y"
    )


def _numberless(condition: Condition, targets: Sequence[JsonValue]) -> str | None:
    """Why `contains` finds a number in none of these; None where it may, or is asked for a text."""
    test = condition.test
    if not isinstance(test, Contains) or not test.is_number:
        return None
    if condition.field is not None and any(True for each in targets for _ in elements(each)):
        return None
    kinds = {type(leaf) for each in targets for leaf in leaves(each)}
    if str in kinds or not kinds & {int, float}:
        return None
    return (
        "the values hold numbers and no text, and contains finds a number only as the value of a "
        "field or as an element of its list: name that in field, or ask with equals"
    )


def _open_below(value: JsonValue, dot_path: str) -> bool:
    """Whether some beginning of the path leads to an empty list or a null."""
    segments = dot_path.split(".")
    return any(
        target is None or target == []
        for length in range(len(segments))
        for target in (at_field(value, ".".join(segments[:length])) if length else [value])
    )


def _has_open_end(value: JsonValue) -> bool:
    if isinstance(value, dict):
        return any(_has_open_end(each) for each in value.values())
    if isinstance(value, list):
        return not value or any(_has_open_end(each) for each in value)
    return value is None


def _paths(value: JsonValue) -> list[str]:
    """The dot-paths of a value, outermost first, as many as a sentence holds."""
    paths = list(dict.fromkeys(_walk(value, "")))
    paths.sort(key=lambda path: path.count("."))
    more = len(paths) - _LISTED_PATHS
    return [*paths[:_LISTED_PATHS], *([f"{more} more"] if more > 0 else [])]


def _walk(value: JsonValue, prefix: str) -> Iterator[str]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield f"{prefix}{name}"
            yield from _walk(inner, f"{prefix}{name}.")
    elif isinstance(value, list):
        for element in value[:1]:
            yield from _walk(element, prefix)

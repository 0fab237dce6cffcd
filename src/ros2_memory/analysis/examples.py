"""What elements of an empty list have: a message without faults shows which fields a fault has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.messages.conversions import ANGLES, ValueKind, kind_of_type
from ros2_memory.storage.base import Definition, Field

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.core.model import JsonValue

_MOST_FIELDS: Final = 1000
"""Nested types of a few lines can have more fields than fit into memory."""


def with_elements(
    value: JsonValue, definition: Definition, paths: Mapping[str, Sequence[str]]
) -> JsonValue:
    """Returns a whole message, as conditions see it, with an element in each empty list.

    Such an element is an example: it has the fields of its type, not their values.

    Args:
        value: the message.
        definition: of its type.
        paths: where the schema map has each key of the value from; empty if it lacks the type.
    """
    budget = iter(range(_MOST_FIELDS))
    if not paths or not isinstance(value, dict):
        return _filled(value, definition, budget)
    filled = dict(value)
    for name in paths.keys() & value.keys():
        entry = _field_at(definition, paths[name])
        if entry is not None:
            filled[name] = _filled_field(value[name], entry, budget)
    return {name: filled[name] for name in value}


def _field_at(definition: Definition, path: Sequence[str]) -> Field | None:
    """Returns the field that a path of single messages leads to."""
    *above, last = path
    for name in above:
        inner = next((entry.kind for entry in definition.fields if entry.name == name), None)
        if not isinstance(inner, Definition):
            return None
        definition = inner
    return next((entry for entry in definition.fields if entry.name == last), None)


def _filled(value: JsonValue, definition: Definition, budget: Iterator[int]) -> JsonValue:
    if not isinstance(value, dict):
        return value
    filled = dict(value)
    for entry in definition.fields:
        if entry.name in value:
            filled[entry.name] = _filled_field(value[entry.name], entry, budget)
    return filled


def _filled_field(value: JsonValue, entry: Field, budget: Iterator[int]) -> JsonValue:
    if not isinstance(entry.kind, Definition):
        return value
    if entry.length is None:
        return _filled(value, entry.kind, budget)
    if not isinstance(value, list):
        return value
    first = _filled(value[0], entry.kind, budget) if value else _example(entry.kind, budget)
    return [first, *value[1:]]


def _example(kind: str | Definition, budget: Iterator[int]) -> JsonValue:
    """Returns a value of a type, as conditions see it."""
    if not isinstance(kind, Definition):
        return "" if kind in {"string", "wstring"} else False if kind == "bool" else 0
    shown = kind_of_type(kind.type, [field.name for field in kind.fields])
    if shown is ValueKind.TIME:
        return 0
    if shown is ValueKind.QUATERNION:
        return dict.fromkeys(ANGLES, 0)
    example: dict[str, JsonValue] = {}
    for (name, inner, length), _ in zip(kind.fields, budget, strict=False):
        element = _example(inner, budget)
        example[name] = element if length is None else [element]
    return example

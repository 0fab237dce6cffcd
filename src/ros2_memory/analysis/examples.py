"""What elements of an empty list have: a message without faults shows which fields a fault has."""

from __future__ import annotations

from dataclasses import replace
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
    if paths:
        entries = ((name, _field_at(definition, path)) for name, path in paths.items())
        fields = [entry._replace(name=name) for name, entry in entries if entry is not None]
        definition = replace(definition, fields=tuple(fields))
    return _filled(value, definition, iter(range(_MOST_FIELDS)))


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
    for name, kind, length in definition.fields:
        part = value.get(name)
        if not isinstance(kind, Definition):
            continue
        if length is None and isinstance(part, dict):
            filled[name] = _filled(part, kind, budget)
        elif length is not None and isinstance(part, list):
            first = _filled(part[0], kind, budget) if part else _example(kind, budget)
            filled[name] = [first, *part[1:]]
    return filled


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

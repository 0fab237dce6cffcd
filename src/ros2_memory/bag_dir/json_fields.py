"""Checks of values in JSON files that another version, or a person, may have written."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeGuard

from ros2_memory.core.timebase import MAX_NS, MIN_NS

if TYPE_CHECKING:
    from collections.abc import Mapping


def is_integer(value: object, least: int = MIN_NS, most: int = MAX_NS) -> TypeGuard[int]:
    """Returns whether a value is an integer in a range, 64 bits by default; a boolean is none."""
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def integer(
    fields: Mapping[object, object], key: str, least: int = MIN_NS, most: int = MAX_NS
) -> int:
    """Returns the integer under a key.

    Raises:
        ValueError: the value is not an integer in the range.
    """
    value = fields.get(key)
    if not is_integer(value, least, most):
        raise ValueError(f"{key} must be an integer from {least} to {most}")
    return value


def strings(fields: Mapping[object, object], key: str) -> tuple[str, ...]:
    """Returns the strings under a key.

    Raises:
        ValueError: the value is not a list of strings.
    """
    value = fields.get(key)
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{key} must be a list of strings")
    return tuple(value)

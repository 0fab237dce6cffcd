"""Checks of JSON files that another version, or a person, may have written."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, TypeAlias, TypeGuard, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from ros2_memory.core.timebase import MAX_NS, MIN_NS

if TYPE_CHECKING:
    from collections.abc import Mapping

_T = TypeVar("_T")

Int64: TypeAlias = Annotated[int, Field(strict=True, ge=MIN_NS, le=MAX_NS)]
"""An integer of 64 bits, and no boolean."""
Count: TypeAlias = Annotated[int, Field(strict=True, ge=0, le=MAX_NS)]


def json_object(text: str, version: int | None = None) -> dict[object, object]:
    """Returns the JSON object in a text; its `format` must be the version, where one is given.

    Raises:
        ValueError: there is none, or it is of another format.
        RecursionError: the text is nothing but brackets.
    """
    value: object = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("it is not a JSON object")  # noqa: TRY004 - a value in a text
    if version not in {None, value.get("format")}:
        raise ValueError(f"its format is {value.get('format')!r}, and only {version} is known")
    return value


def validated(adapter: TypeAdapter[_T], fields: Mapping[object, object]) -> _T:
    """Returns the value that JSON fields describe; keys of other versions are ignored.

    Raises:
        ValueError: a key is missing or wrong; the sentence names the first one.
    """
    try:
        return adapter.validate_python(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise ValueError(f"{key}: {first['msg']}") from error


def is_integer(value: object) -> TypeGuard[int]:
    """Returns whether a value is an integer of 64 bits; a boolean is not one."""
    return isinstance(value, int) and not isinstance(value, bool) and MIN_NS <= value <= MAX_NS


def integer(fields: Mapping[object, object], key: str) -> int:
    """Returns the integer under a key.

    Raises:
        ValueError: the value is not an integer of 64 bits.
    """
    value = fields.get(key)
    if not is_integer(value):
        raise ValueError(f"{key} must be an integer of 64 bits")
    return value

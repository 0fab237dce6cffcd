"""A message's value in columns: scalars by their dot-paths in maps, and JSON for the rest.

In the JSON every scalar that a map has is null, and all else is in its place. So it is one text
for all messages of a type without lists, which Parquet stores once.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.core.model import JsonValue

    Scalar = str | float | bool
    Found = dict[str, dict[str, Scalar]]

MAPS: Final = ("flags", "integers", "numbers", "texts")
"""The columns of scalars, in the order of a row."""
_LARGEST: Final = 1 << 63
_KIND_OF: Final = {bool: "flags", int: "integers", float: "numbers", str: "texts"}


class TypedValue(NamedTuple):
    """A message as columns: its scalars by dot-path and type, and `rest`, JSON of all else."""

    rest: str
    flags: Mapping[str, Scalar]
    integers: Mapping[str, Scalar]
    numbers: Mapping[str, Scalar]
    texts: Mapping[str, Scalar]


def taken_apart(value: JsonValue) -> TypedValue:
    """Returns a value in columns. Lists stay whole, and so does what has a dot in its name."""
    found: Found = {name: {} for name in MAPS}
    rest = _without_scalars(value, "", found)
    text = json.dumps(rest, ensure_ascii=False, separators=(",", ":"))
    return TypedValue(text, **found)


def _without_scalars(value: JsonValue, path: str, found: Found) -> JsonValue:
    if isinstance(value, dict):
        return {
            name: inner
            if "." in name or not name
            else _without_scalars(inner, f"{path}.{name}" if path else name, found)
            for name, inner in value.items()
        }
    kind = _KIND_OF.get(type(value))
    if kind is None or not path or (kind == "integers" and not _fits(value)):
        return value
    found[kind][path] = value  # type: ignore[assignment]  # `_KIND_OF` has scalars alone
    return None


def _fits(value: object) -> bool:
    return isinstance(value, int) and -_LARGEST <= value < _LARGEST

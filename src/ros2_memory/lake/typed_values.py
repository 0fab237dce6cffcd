"""A message's value in columns: scalars by their dot-paths in maps, and JSON for the rest.

In the JSON every scalar that a map has is null, and all else is in its place. So it is one text
for all messages of a type without lists, which Parquet stores once.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue
    from ros2_memory.lake.tables import Row

    Found = dict[str, list[tuple[str, object]]]

_LARGEST: Final = 1 << 63
_KIND_OF: Final = {bool: "flags", int: "integers", float: "numbers", str: "texts"}


def taken_apart(value: JsonValue) -> Row:
    """Returns a value in columns: its scalars by type and dot-path, and `value`, JSON of all else.

    Lists stay whole, and so does what has a dot in its name.
    """
    found: Found = {name: [] for name in _KIND_OF.values()}
    rest = _without_scalars(value, "", found)
    return {**found, "value": json.dumps(rest, ensure_ascii=False, separators=(",", ":"))}


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
    found[kind].append((path, value))
    return None


def _fits(value: object) -> bool:
    return isinstance(value, int) and -_LARGEST <= value < _LARGEST

"""The only attribute walk: a decoded message of any decoder as named fields.

A message is what rosbags decodes (a dataclass that carries `__msgtype__`, numbers in numpy arrays,
messages in lists) or a plain JSON value. A dot-path walks it: over a list or an array, a segment
that is a number selects an element and any other maps over the elements. Only fields are walked,
never methods or properties of a Python object. Fields are those of the definition here;
`conversions.view` is the step through what a reply shows.
"""

from __future__ import annotations

import dataclasses
import keyword
import re
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

Array: TypeAlias = "np.ndarray[tuple[int, ...], np.dtype[np.generic[object]]]"

ABSENT: Final = object()
"""The result of a step or a path where there is no such field."""

Segments: TypeAlias = tuple[str, ...]

_PATH: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.([A-Za-z][A-Za-z0-9_]*|[0-9]+))*")


@dataclasses.dataclass(frozen=True, slots=True)
class FieldTable:
    """The type of one message class, and its fields: name in the definition to attribute."""

    type: str
    attributes: Mapping[str, str]


def field_table_of(node: object) -> FieldTable | None:
    """Returns the fields of a message; None for a number, a list, a mapping and the like."""
    cls: type = type(node)
    known = field_table_of_class(cls)
    if known is not None or cls.__module__ in {"builtins", "numpy"}:
        return known
    names = {name: name for name in getattr(node, "__dict__", {}) if not name.startswith("_")}
    return FieldTable("", names) if names else None


@lru_cache(maxsize=4096)
def field_table_of_class(cls: type) -> FieldTable | None:
    """Returns the fields of messages of a dataclass; None for another class."""
    if not dataclasses.is_dataclass(cls):
        return None
    attributes = {_ros_name(f.name): f.name for f in dataclasses.fields(cls) if _is_data(f)}
    return FieldTable(str(getattr(cls, "__msgtype__", "")), attributes)


def _is_data(field: dataclasses.Field[object]) -> bool:
    """Whether a dataclass's field is one of the message.

    rosbags imports ClassVar for type checkers only, so that dataclasses takes the constants of a
    definition for fields; the annotation's text still distinguishes them.
    """
    constant = isinstance(field.type, str) and field.type.startswith("ClassVar")
    return not constant and field.name != "structure_needs_at_least_one_member"


def _ros_name(attribute: str) -> str:
    """Returns the definition's name of an attribute: rosbags appends `_` to Python's keywords."""
    bare = attribute.removesuffix("_")
    return bare if keyword.iskeyword(bare) else attribute


def field_of(node: object, name: str) -> object:
    """Returns a field of a message or an entry of a JSON object, unconverted; else ABSENT."""
    if isinstance(node, dict):
        entry: object = node.get(name, ABSENT)
        return entry
    table = field_table_of(node)
    if table is None or name not in table.attributes:
        return ABSENT
    found: object = getattr(node, table.attributes[name], ABSENT)
    return found


def names_of(node: object) -> tuple[str, ...]:
    """Returns the field names of a message or JSON object; of a list, those of its first."""
    while isinstance(node, list | tuple):
        node = node[0] if node else None
    if isinstance(node, dict):
        return tuple(str(name) for name in node)
    table = field_table_of(node)
    return () if table is None else tuple(table.attributes)


def parse_path(path: str) -> Segments | None:
    """Returns the segments of a dot-path (`pose.pose.position`, `poses.0`); None if malformed."""
    return tuple(path.split(".")) if _PATH.fullmatch(path) else None


def descend(
    node: object, segments: Sequence[str], step: Callable[[object, str], object] = field_of
) -> object:
    """Follows a path: null below a null or past the end of a list, ABSENT where no field is.

    Over a list the rest of the path maps over the elements: ABSENT if no element has it, null for
    those that lack it.
    """
    for at, segment in enumerate(segments):
        if node is None or node is ABSENT:
            return node
        if not isinstance(node, list | tuple | np.ndarray):
            node = step(node, segment)
        elif segment.isascii() and segment.isdecimal():
            # An index of ten digits or more is past the end of any list.
            index = int(segment) if len(segment) < 10 else len(node)
            node = node[index] if index < len(node) else None
        else:
            return _each(node, segments[at:], step)
    return node


def _each(
    nodes: Sequence[object] | Array,
    segments: Sequence[str],
    step: Callable[[object, str], object],
) -> object:
    if isinstance(nodes, np.ndarray):
        return ABSENT if nodes.size else []  # numbers have no fields
    found = [descend(node, segments, step) for node in nodes]
    if found and all(node is ABSENT for node in found):
        return ABSENT
    return [None if node is ABSENT else node for node in found]


class Route:
    """A path without lists in it, compiled to an `attrgetter`, which is fast for messages.

    Attributes:
        segments: the names of the fields.
    """

    __slots__ = ("_fast", "segments")

    def __init__(self, *segments: str) -> None:
        self._fast = attrgetter(".".join(segments))
        self.segments = segments

    def of(self, message: object) -> object:
        """Returns what is at the path, of whatever kind; ABSENT or null where there is nothing."""
        try:
            found: object = self._fast(message)
        # JSON objects, and attributes that rosbags renamed.
        except AttributeError:
            found = descend(message, self.segments)
        return found

"""The only attribute walk: a decoded message as named fields, whatever decoder made it.

A message is what rosbags decodes (a dataclass that carries `__msgtype__`, numbers in numpy arrays,
messages in lists) or a plain JSON value. A dot-path walks it: over a list or an array, a segment
that is a number takes an element and any other maps over the elements. Only fields are walked,
never methods or properties of a Python object. Here fields stand as the definition has them;
`views` is the walk through what a reply shows.
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
"""What a step or a path gives where there is no such field."""

Segments: TypeAlias = tuple[str, ...]

_PATH: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.([A-Za-z][A-Za-z0-9_]*|[0-9]+))*")


@dataclasses.dataclass(frozen=True, slots=True)
class FieldTable:
    """The type of one message class and its fields: names in the definition to attributes."""

    type: str
    attributes: Mapping[str, str]


def field_table_of(node: object) -> FieldTable | None:
    """How a message is laid out; None for what is not a message (a number, a list, a mapping)."""
    cls: type = type(node)
    known = field_table_of_class(cls)
    if known is not None or cls.__module__ in {"builtins", "numpy"}:
        return known
    names = {name: name for name in getattr(node, "__dict__", {}) if not name.startswith("_")}
    return FieldTable("", names) if names else None


@lru_cache(maxsize=4096)
def field_table_of_class(cls: type) -> FieldTable | None:
    """How the messages of a dataclass are laid out; None for another class."""
    if not dataclasses.is_dataclass(cls):
        return None
    attributes = {_ros_name(f.name): f.name for f in dataclasses.fields(cls) if _is_data(f)}
    return FieldTable(str(getattr(cls, "__msgtype__", "")), attributes)


def _is_data(field: dataclasses.Field[object]) -> bool:
    """Whether a dataclass's field is one of the message.

    rosbags imports ClassVar for type checkers only, so that dataclasses takes the constants of a
    definition for fields; the annotation's text still tells them.
    """
    constant = isinstance(field.type, str) and field.type.startswith("ClassVar")
    return not constant and field.name != "structure_needs_at_least_one_member"


def _ros_name(attribute: str) -> str:
    """The definition's name of an attribute: rosbags appends `_` to Python's keywords."""
    bare = attribute.removesuffix("_")
    return bare if keyword.iskeyword(bare) else attribute


def field_of(node: object, name: str) -> object:
    """The field of a message or the entry of a JSON object, as it stands; else ABSENT."""
    if isinstance(node, dict):
        entry: object = node.get(name, ABSENT)
        return entry
    layout = field_table_of(node)
    if layout is None or name not in layout.attributes:
        return ABSENT
    found: object = getattr(node, layout.attributes[name], ABSENT)
    return found


def names_of(node: object) -> tuple[str, ...]:
    """The names of the fields of a message or JSON object; of a list, those of its first."""
    while isinstance(node, list | tuple):
        node = node[0] if node else None
    if isinstance(node, dict):
        return tuple(str(name) for name in node)
    layout = field_table_of(node)
    return () if layout is None else tuple(layout.attributes)


def parse_path(path: str) -> Segments | None:
    """The segments of a dot-path (`pose.pose.position`, `poses.0`); None where it is none."""
    return tuple(path.split(".")) if _PATH.fullmatch(path) else None


def descend(
    node: object, segments: Sequence[str], step: Callable[[object, str], object] = field_of
) -> object:
    """What a path leads to: null below a null or past the end of a list, ABSENT off the map.

    Over a list the rest of the path maps over the elements: ABSENT if no element has it, null for
    those that lack it.
    """
    for at, segment in enumerate(segments):
        if node is None or node is ABSENT:
            return node
        if not isinstance(node, list | tuple | np.ndarray):
            node = step(node, segment)
        elif segment.isascii() and segment.isdecimal():
            node = _element(node, segment)
        else:
            return _each(node, segments[at:], step)
    return node


def _element(nodes: Sequence[object] | Array, segment: str) -> object:
    index = int(segment) if len(segment) < 10 else len(nodes)
    if index >= len(nodes):
        return None
    found: object = nodes[index]
    return found


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
    """A path without lists in it, compiled for speed: `of` gives what a message has there."""

    __slots__ = ("_fast", "_segments")

    def __init__(self, *segments: str) -> None:
        self._fast = attrgetter(".".join(segments))
        self._segments = segments

    def of(self, message: object) -> object:
        """The node at the path, ABSENT or null where there is none; its kind is not checked."""
        try:
            found: object = self._fast(message)
        except AttributeError:
            found = descend(message, self._segments)
        return found

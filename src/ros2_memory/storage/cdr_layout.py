"""Finds the numbers in a serialized message, so that thousands alike need not be decoded.

The layout follows from a type's definition and one payload by the rules of CDR (OMG CDR 1.x, as
ROS 2 writes it: a header of 4 bytes, then each primitive aligned to its own size). It holds for
every payload of the same length that has the same bytes outside of the numbers: lengths of texts
and sequences, the texts themselves, integers and booleans are all outside.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import TYPE_CHECKING, ClassVar, Final

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP

from ros2_memory.storage.base import CdrLayout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rosbags.interfaces.typing import FieldDesc, Typesdict

_LITTLE_ENDIAN: Final = b"\x00\x01"
_HEADER_BYTES: Final = 4
_MAX_NUMBERS: Final = 200
# A float128 is not aligned to its own size.
_SIZES: Final[Mapping[str, int]] = {
    str(name): size for name, size in SIZEMAP.items() if name != "float128"
}
_FLOATS: Final = ("float32", "float64")
_TIME: Final = [("sec", "int32"), ("nanosec", "uint32")]

MAX_OBJECTS: Final = 200_000
"""Texts and messages in one message; each is an object when it is decoded."""
_COUNTED_FROM_BYTES: Final = 256 << 10


class _StoppedError(Exception):
    """A walk found more than it counts to, or the payload does not fit its definition."""


def layout_of(definitions: Typesdict, root: str, payload: bytes) -> CdrLayout | None:
    """Returns the layout of payloads like this one; None if they must be decoded."""
    if payload[:2] != _LITTLE_ENDIAN:
        return None
    walk = _NumberWalk(definitions, payload)
    try:
        walk.message(root)
    except (_StoppedError, struct.error):
        return None
    # Writers may pad the end to a multiple of 4.
    if not 0 <= len(payload) - walk.position < 4:
        return None
    return CdrLayout(len(payload), tuple(walk.doubles), tuple(walk.singles), tuple(walk.times))


def holds_too_many(definitions: Typesdict, root: str, payload: bytes) -> bool:
    """Returns whether decoding a payload would make more than `MAX_OBJECTS` objects.

    One byte of it can become an object of a hundred. A payload that does not fit its definition
    is left to decoding, which names the fault.
    """
    if len(payload) < _COUNTED_FROM_BYTES:
        return False
    walk = _ObjectWalk(definitions, payload)
    with suppress(_StoppedError, struct.error, IndexError):
        walk.message(root)
    return walk.objects > MAX_OBJECTS


class _Walk:
    """Goes through the fields of a payload, in either byte order."""

    _skipped: ClassVar[Mapping[str, int]] = _SIZES  # primitives whose arrays are passed in one step

    def __init__(self, definitions: Typesdict, payload: bytes) -> None:
        self._definitions = definitions
        self._payload = payload
        self._length_of = struct.Struct("<I" if payload[1] & 1 else ">I")
        self.position = _HEADER_BYTES

    def message(self, name: str) -> None:
        for _, field in self._definitions[name][1]:
            self._field(field)

    def _field(self, field: FieldDesc) -> None:
        if field[0] == Nodetype.BASE:
            self._primitive(field[1][0])
        elif field[0] == Nodetype.NAME:
            self.message(str(field[1]))
        elif field[0] == Nodetype.ARRAY:
            element, count = field[1]
            self._elements(element, count)
        else:
            self._elements(field[1][0], self._length())

    def _elements(self, element: FieldDesc, count: int) -> None:
        size = self._skipped.get(element[1][0]) if element[0] == Nodetype.BASE else None
        if size is None:
            self._each(element, count)
        elif count:
            self._advance(size, size * count)

    def _each(self, element: FieldDesc, count: int) -> None:
        for _ in range(count):
            self._field(element)

    def _primitive(self, name: str) -> None:
        if name == "string":
            self._advance(1, self._length())
        elif name in _SIZES:
            self._advance(_SIZES[name], _SIZES[name])
        else:
            raise _StoppedError

    def _length(self) -> int:
        at = self._advance(4, 4)
        length: int = self._length_of.unpack_from(self._payload, at)[0]
        return length

    def _advance(self, alignment: int, size: int) -> int:
        """Goes past an aligned value, and returns where it begins."""
        at = self.position + -(self.position - _HEADER_BYTES) % alignment
        self.position = at + size
        if self.position > len(self._payload):
            raise _StoppedError
        return at


class _NumberWalk(_Walk):
    """Collects the offsets of floats, times and durations."""

    _skipped: ClassVar[Mapping[str, int]] = {
        name: size for name, size in _SIZES.items() if name not in _FLOATS
    }

    def __init__(self, definitions: Typesdict, payload: bytes) -> None:
        super().__init__(definitions, payload)
        self.doubles: list[int] = []
        self.singles: list[int] = []
        self.times: list[int] = []

    def message(self, name: str) -> None:
        if _is_time(name, self._definitions[name][1]):
            self.times.append(self._advance(4, 8))
        else:
            super().message(name)

    def _each(self, element: FieldDesc, count: int) -> None:
        if count > _MAX_NUMBERS:
            raise _StoppedError
        super()._each(element, count)

    def _primitive(self, name: str) -> None:
        super()._primitive(name)
        if name in _FLOATS:
            offsets = self.doubles if name == "float64" else self.singles
            offsets.append(self.position - _SIZES[name])
            if len(self.doubles) + len(self.singles) > _MAX_NUMBERS:
                raise _StoppedError


class _ObjectWalk(_Walk):
    """Counts texts and messages."""

    objects = 0

    def message(self, name: str) -> None:
        self._count()
        if not self._definitions[name][1]:
            self._advance(1, 1)
        super().message(name)

    def _primitive(self, name: str) -> None:
        if name == "string":
            self._count()
        super()._primitive(name)

    def _count(self) -> None:
        self.objects += 1
        if self.objects > MAX_OBJECTS:
            raise _StoppedError


def _is_time(name: str, fields: list[tuple[str, FieldDesc]]) -> bool:
    if name not in {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}:
        return False
    return [(each, field[1][0]) for each, field in fields if field[0] == Nodetype.BASE] == _TIME

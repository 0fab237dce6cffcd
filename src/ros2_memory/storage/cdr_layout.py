"""Where the numbers lie in a serialized message, so that thousands alike need not be decoded.

The layout follows from a type's definition and one payload by the rules of CDR (OMG CDR 1.x, as
ROS 2 writes it: a header of 4 bytes, then each primitive aligned to its own size). It holds for
every payload of the same length that has the same bytes outside of the numbers: lengths of texts
and sequences, the texts themselves, whole numbers and booleans are all outside.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

from rosbags.interfaces import Nodetype

from ros2_memory.storage.base import CdrLayout

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict

_LITTLE_ENDIAN: Final = b"\x00\x01"
_HEADER: Final = 4
_MOST_NUMBERS: Final = 200
_SIZES: Final = {
    "bool": 1,
    "byte": 1,
    "char": 1,
    "octet": 1,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "int32": 4,
    "uint32": 4,
    "int64": 8,
    "uint64": 8,
}
_FLOATS: Final = {"float32": 4, "float64": 8}
_TIME: Final = ((("int32", 0), ("uint32", 0)), ("sec", "nanosec"))


MOST_ELEMENTS: Final = 200_000
"""Texts and messages in one message; each is an object when it is decoded."""
_COUNTED_FROM_BYTES: Final = 256 << 10


class _NoLayoutError(Exception):
    """The numbers are too many, or something of the payload is not understood here."""


def layout_of(definitions: Typesdict, root: str, payload: bytes) -> CdrLayout | None:
    """The layout of payloads like this one; None where decoding them is the only way."""
    if payload[:2] != _LITTLE_ENDIAN:
        return None
    walk = _Walk(definitions, payload)
    try:
        walk.message(root)
    except (_NoLayoutError, struct.error):
        return None
    # Writers may pad the end to a multiple of 4.
    if not 0 <= len(payload) - walk.position < 4:
        return None
    return CdrLayout(len(payload), tuple(walk.doubles), tuple(walk.singles), tuple(walk.times))


def holds_too_many(definitions: Typesdict, root: str, payload: bytes) -> bool:
    """Whether decoding a payload would make more objects than memory and patience have room for.

    A byte of it can stand for an object of a hundred. One that does not fit its definition is left
    to decoding, which says so.
    """
    if len(payload) < _COUNTED_FROM_BYTES:
        return False
    walk = _Count(definitions, payload)
    try:
        walk.message(root)
    except _TooManyError:
        return True
    except (_NoLayoutError, struct.error, IndexError):
        return False
    return False


class _Walk:
    def __init__(self, definitions: Typesdict, payload: bytes) -> None:
        self._definitions = definitions
        self._payload = payload
        self.position = _HEADER
        self.doubles: list[int] = []
        self.singles: list[int] = []
        self.times: list[int] = []

    def message(self, name: str) -> None:
        fields = self._definitions[name][1]
        if _is_time(name, fields):
            self._aligned(4)
            self.times.append(self.position)
            self._advance(8)
            return
        for _, field in fields:
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
        if element[0] == Nodetype.BASE and element[1][0] in _SIZES and count:
            size = _SIZES[element[1][0]]
            self._aligned(size)
            self._advance(size * count)
            return
        if count > _MOST_NUMBERS:
            raise _NoLayoutError
        for _ in range(count):
            self._field(element)

    def _primitive(self, name: str) -> None:
        if name == "string":
            self._advance(self._length())
        elif name in _FLOATS:
            self._aligned(_FLOATS[name])
            (self.doubles if name == "float64" else self.singles).append(self.position)
            self._advance(_FLOATS[name])
            if len(self.doubles) + len(self.singles) > _MOST_NUMBERS:
                raise _NoLayoutError
        elif name in _SIZES:
            self._aligned(_SIZES[name])
            self._advance(_SIZES[name])
        else:
            raise _NoLayoutError

    def _length(self) -> int:
        self._aligned(4)
        length: int = struct.unpack_from("<I", self._payload, self.position)[0]
        self._advance(4)
        return length

    def _aligned(self, size: int) -> None:
        self.position += -(self.position - _HEADER) % size

    def _advance(self, size: int) -> None:
        self.position += size
        if self.position > len(self._payload):
            raise _NoLayoutError


class _TooManyError(Exception):
    """More elements than are decoded."""


class _Count(_Walk):
    """Counts texts and messages, whatever the byte order."""

    def __init__(self, definitions: Typesdict, payload: bytes) -> None:
        super().__init__(definitions, payload)
        self._elements_seen = 0
        self._length_of = struct.Struct("<I" if payload[1] & 1 else ">I")

    def message(self, name: str) -> None:
        self._seen()
        fields = self._definitions[name][1]
        if not fields:
            self._advance(1)
        for _, field in fields:
            self._field(field)

    def _elements(self, element: FieldDesc, count: int) -> None:
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            if count:
                size = _SIZES.get(element[1][0]) or _FLOATS.get(element[1][0], 1)
                self._aligned(size)
                self._advance(size * count)
            return
        for _ in range(count):
            self._field(element)

    def _primitive(self, name: str) -> None:
        if name == "string":
            self._seen()
            self._advance(self._length())
        else:
            size = _SIZES.get(name) or _FLOATS.get(name, 1)
            self._aligned(size)
            self._advance(size)

    def _length(self) -> int:
        self._aligned(4)
        length: int = self._length_of.unpack_from(self._payload, self.position)[0]
        self._advance(4)
        return length

    def _seen(self) -> None:
        self._elements_seen += 1
        if self._elements_seen > MOST_ELEMENTS:
            raise _TooManyError


def _is_time(name: str, fields: list[tuple[str, FieldDesc]]) -> bool:
    if name not in {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}:
        return False
    kinds = tuple((field[1][0], 0) for _, field in fields if field[0] == Nodetype.BASE)
    return (kinds, tuple(each for each, _ in fields)) == _TIME

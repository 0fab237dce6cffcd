"""Counts the objects that decoding a message would make, before it is decoded.

By the rules of CDR (OMG CDR 1.x, as ROS 2 writes it: a header of 4 bytes, then each primitive
aligned to its own size).
"""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rosbags.interfaces.typing import FieldDesc, Typesdict

_HEADER_BYTES: Final = 4
# A float128 is not aligned to its own size.
_SIZES: Final[Mapping[str, int]] = {
    str(name): size for name, size in SIZEMAP.items() if name != "float128"
}

MAX_OBJECTS: Final = 200_000
"""Texts and messages in one message; each is an object when it is decoded."""
_COUNTED_FROM_BYTES: Final = 256 << 10


class _StoppedError(Exception):
    """There are more objects than are counted, or the payload does not fit its definition."""


def holds_too_many(definitions: Typesdict, root: str, payload: bytes) -> bool:
    """Returns whether decoding a payload would make more than `MAX_OBJECTS` objects.

    One byte of it can become an object of a hundred. The length that a sequence states counts. A
    payload that does not fit its definition otherwise is left to decoding, which names the fault.
    """
    if len(payload) < _COUNTED_FROM_BYTES:
        return False
    walk = _Walk(definitions, payload)
    with suppress(_StoppedError, struct.error, IndexError):
        walk.message(root)
    return walk.objects > MAX_OBJECTS


class _Walk:
    """Goes through the fields of a payload, in either byte order, and counts texts and messages."""

    def __init__(self, definitions: Typesdict, payload: bytes) -> None:
        self.objects = 0
        self._definitions = definitions
        self._payload = payload
        self._length_of = struct.Struct("<I" if payload[1] & 1 else ">I")
        self._position = _HEADER_BYTES

    def message(self, name: str) -> None:
        self._count()
        fields = self._definitions[name][1]
        if not fields:
            self._advance(1, 1)
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
        size = _SIZES.get(element[1][0]) if element[0] == Nodetype.BASE else None
        if size is None:
            if element[0] == Nodetype.NAME and self.objects + count > MAX_OBJECTS:
                self.objects += count
                raise _StoppedError
            for _ in range(count):
                self._field(element)
        elif count:
            self._advance(size, size * count)

    def _primitive(self, name: str) -> None:
        if name == "string":
            self._count()
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
        at = self._position + -(self._position - _HEADER_BYTES) % alignment
        self._position = at + size
        if self._position > len(self._payload):
            raise _StoppedError
        return at

    def _count(self) -> None:
        self.objects += 1
        if self.objects > MAX_OBJECTS:
            raise _StoppedError

"""Encodes the ranges of a topic's fields, and reads one field of many bags at once.

Which fields there are, and how the range of each is stored, is a text that most bags share; the
numbers of one bag are some bytes. Bounds are float32, rounded outwards, and a field that was 0
throughout takes no byte: which in odometry are most fields of a robot at rest.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.field_ranges import ANYTHING, FieldRange

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

_ZERO, _CONSTANT, _EVEN, _UNEVEN, _BOUNDS, _UNKNOWN = "z", "c", "e", "u", "b", "?"
"""How a range is stored: 0 in every message; one number in every message; bounds and sum, with as
many numbers in every message; those and the count; bounds alone; nothing."""
_NOT_KNOWN: Final = "null"
"""In place of a list of fields."""
_LAYOUTS: Final = {
    _ZERO: np.dtype([]),
    _CONSTANT: np.dtype([("low", "<f8")]),
    _EVEN: np.dtype([("low", "<f4"), ("high", "<f4"), ("total", "<f8")]),
    _UNEVEN: np.dtype([("low", "<f4"), ("high", "<f4"), ("total", "<f8"), ("count", "<u4")]),
    _BOUNDS: np.dtype([("low", "<f4"), ("high", "<f4")]),
    _UNKNOWN: np.dtype([]),
}
_PACKERS: Final = {
    kind: struct.Struct("<" + "".join(layout[name].char for name in layout.names or ()))
    for kind, layout in _LAYOUTS.items()
}
"""As `_LAYOUTS`: for the few numbers of one field numpy is slow."""
_MESSAGES: Final = struct.Struct("<I")
"""How many messages there are, before the numbers of the fields."""
_SINGLE: Final = struct.Struct("<f")
_BITS: Final = struct.Struct("<i")
_EXACT_BELOW: Final = 2.0**53
_MOST_NUMBERS: Final = 2**32


class FieldColumn(NamedTuple):
    """The range of one field in many bags, by row.

    Attributes:
        numbers: of the entries, ascending.
        low: none is less; the least itself where it equals `high`. Above `high` without a number.
        high: none is greater.
        count: how many numbers there are; -1 where that is not known.
        total: their sum; NaN where it is not known.
        each: how many every message has; 0 where that differs or is not known.
    """

    numbers: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    size: NDArray[np.int64]
    total: NDArray[np.float64]
    each: NDArray[np.int64]


def encode_field_ranges(ranges: Mapping[str, FieldRange] | None) -> tuple[str, bytes]:
    """Encodes the ranges of fields as a text that many bags share, and the bytes of this one."""
    if ranges is None:
        return _NOT_KNOWN, b""
    kinds = {path: _kind(each) for path, each in ranges.items()}
    text = json.dumps(
        [[path, kind, ranges[path].each] for path, kind in kinds.items()], separators=(",", ":")
    )
    parts = [_packed(ranges[path], kind) for path, kind in kinds.items()]
    messages = max(
        ((each.size or 0) // each.each for each in ranges.values() if each.each), default=0
    )
    return text, b"".join((_MESSAGES.pack(messages), *parts))


def _kind(found: FieldRange) -> str:
    if found.size is None or found.size >= _MOST_NUMBERS:
        return _UNKNOWN if found[:2] == ANYTHING[:2] else _BOUNDS
    if not found.each:
        return _UNEVEN
    if found.low == found.high and abs(found.low) < _EXACT_BELOW:
        return _CONSTANT if found.low else _ZERO
    return _EVEN


def _packed(found: FieldRange, kind: str) -> bytes:
    packer = _PACKERS[kind]
    if not packer.size:
        return b""
    if kind == _CONSTANT:
        return packer.pack(found.low)
    bounds = outward(found.low, -math.inf), outward(found.high, math.inf)
    if kind == _BOUNDS:
        return packer.pack(*bounds)
    if kind == _EVEN:
        return packer.pack(*bounds, found.total)
    return packer.pack(*bounds, found.total, found.size)


def outward(number: float, towards: float) -> float:
    """Returns a number that a float32 holds, near another and no less towards an infinity."""
    try:
        [near] = _SINGLE.unpack(_SINGLE.pack(number))
    except OverflowError:
        near = math.copysign(math.inf, number)
    beyond = near > number if towards < 0 else near < number
    return _next_single(near, towards) if beyond else near


def _next_single(near: float, towards: float) -> float:
    """Returns the float32 next to another, towards an infinity."""
    [bits] = _BITS.unpack(_SINGLE.pack(near))
    if near:
        bits += 1 if (near > 0) == (towards > 0) else -1  # away from 0, or to it
    else:
        bits = 1 if towards > 0 else 1 - 2**31
    [after] = _SINGLE.unpack(_BITS.pack(bits))
    return float(after)


@dataclass(frozen=True, slots=True)
class _Stored:
    """Where the range of one field lies in the bytes of a bag.

    `is_field`: it is that of the field itself, not of one below it; `whole`: how many bytes a bag
    has.
    """

    kind: str
    each: int
    offset: int
    is_field: bool
    whole: int


@lru_cache(1024)
def _stored(text: str, field: str) -> tuple[_Stored, ...]:
    """Returns where the ranges of a field, and of those below it, lie.

    Raises:
        ValueError: the text is not valid.
    """
    found: list[tuple[str, int, int, bool]] = []
    offset = _MESSAGES.size
    for path, kind, each in json.loads(text):
        if not field or path == field or path.startswith(f"{field}."):
            found.append((kind, int(each), offset, path == field))
        offset += _LAYOUTS[kind].itemsize
    return tuple(_Stored(*each, offset) for each in found)


def field_column(rows: Iterable[tuple[int, str | None, bytes]], field: str) -> FieldColumn:
    """Returns the range of a field, or of all fields below it, from entry, text and bytes of bags.

    Only a range that is stored as one has a total. Where there is no such field, low is above high.
    The text is None of a bag whose topic has no number at all.

    Raises:
        ValueError: the bytes are not those of the text.
    """
    by_text: dict[str | None, list[tuple[int, bytes]]] = {}
    for number, text, packed in rows:
        by_text.setdefault(text, []).append((number, packed))
    parts = [_part(text, some, field) for text, some in by_text.items()]
    if not parts:
        none = np.zeros(0)
        whole = np.zeros(0, np.int64)
        return FieldColumn(whole, none, none, whole, none, whole)
    columns = [np.concatenate(each) for each in zip(*parts, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    return FieldColumn(*(each[order] for each in columns))


def _part(text: str | None, some: Sequence[tuple[int, bytes]], field: str) -> FieldColumn:
    """Returns the column of the bags of one text."""
    size = len(some)
    numbers = np.array([row[0] for row in some], np.int64)
    low, high = np.full(size, np.inf), np.full(size, -np.inf)
    total, count, each = np.full(size, np.nan), np.full(size, -1), np.zeros(size, np.int64)
    if text == _NOT_KNOWN:
        return FieldColumn(numbers, -low, -high, count, total, each)
    places = () if text is None else _stored(text, field)
    if not places:
        return FieldColumn(numbers, low, high, count, total, each)
    packed = np.frombuffer(b"".join(row[1] for row in some), np.uint8).reshape(
        size, places[0].whole
    )

    def values(place: _Stored, name: str) -> NDArray[np.float64]:
        layout = _LAYOUTS[place.kind]
        if name not in (layout.names or ()):
            return np.zeros(size)
        part = packed[:, place.offset : place.offset + layout.itemsize]
        return np.ascontiguousarray(part).view(layout)[:, 0][name].astype(np.float64)

    for place in places:
        below, above = values(place, "low"), values(place, "high")
        if place.kind == _CONSTANT:
            above = below
        elif place.kind == _UNKNOWN:
            below, above = below - np.inf, above + np.inf
        low, high = np.minimum(low, below), np.maximum(high, above)
    [first, *others] = places
    if not others and first.is_field and first.kind not in {_BOUNDS, _UNKNOWN}:
        each[:] = first.each
        messages = np.ascontiguousarray(packed[:, : _MESSAGES.size]).view("<u4")[:, 0]
        uneven = first.kind == _UNEVEN
        count = values(first, "count").astype(np.int64) if uneven else messages * each
        total = low * count if first.kind == _CONSTANT else values(first, "total")
    return FieldColumn(numbers, low, high, count, total, each)

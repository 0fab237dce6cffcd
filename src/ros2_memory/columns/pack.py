"""A column as few bytes that zstd compresses well, and back.

A packed column is the name of a codec, the number of its values, its zone, and bytes. The codec is
two to four words: the type of the values, what whole numbers stand for them, how those are
arranged, and in how many bytes each::

    float64 /10000 delta 1

Types are numpy's (`bool`, `int8` to `uint64`, `float32`, `float64`) and `text`. `constant` as the
second word: there are no bytes, every value is the zone's least, or NaN where it has none.

What whole numbers stand for a value:

    whole       an integer is itself; False is 0
    /n          a float is the whole number divided by n
    rounded     a float's sign, exponent and first 19 bits of its mantissa (20 with the one that is
                not stored: a relative 2**-20), of negative ones complemented: ordered as the values
    bits        likewise all bits: exact, but for the sign of a zero and what a NaN carries
    float32     `bits` of the float32 that equals the float64

How n whole numbers are arranged, once the least is subtracted. `^` is one little-endian number of 8
bytes; `#` are so many planes of as many bytes as numbers: the lowest byte of every number, then the
next (a plane of high bytes hardly varies, so it compresses to nothing)::

    flat    # n               the numbers
    line    ^ slope # n       what is left of them after a line of that slope, less its least
    delta   ^ slope # n-1     differences of neighbours, less the slope
    curve   ^ first # n-2     differences of those differences, after the first one

Differences have a sign: 0, -1, 1, -2, 2 are written 0, 1, 2, 3, 4. Sums start anywhere: the least
of the zone says where. Numbers that are 2**62 apart and more are arranged `plain`: all 8 bytes, and
nothing subtracted.

Texts are `text constant` (one word) or `text`, arrangement and bytes of their codes, whose least is
0. Their bytes begin with the words, the codes follow::

    +----------+---------------+------------------------------+------------------+-------+
    | 4: words | 4: their size | 4 each: length in characters | words in UTF-8,  | codes |
    |          | in bytes      |                              | surrogates pass  |       |
    +----------+---------------+------------------------------+------------------+-------+
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import zstandard

from ros2_memory.columns.steps import EXACT, MOST_RELATIVE, Step
from ros2_memory.columns.table import Column, Numbers, Texts, Zone

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.storage.base import IntArray

FORMAT: Final = 1
"""What bytes mean: to be raised with every change of what this module or `blob` writes."""
MOST_WORDS_BYTES: Final = 4_096
LEVEL: Final = 3

_NOTHING: Final = Zone()
_FAR_APART: Final = 1 << 62
_MOST_MULTIPLES: Final = {4: float(1 << 24), 8: float(1 << 46)}
"""Multiples of a step up to these are fewer bits than the float32 or float64 itself."""
_DECIMALS: Final = (1, 10, 100, 1_000, 10_000, 100_000)
"""Steps, as `Step.per_unit`, that values of a relative exactness often have anyway."""
_SAMPLE: Final = 16


class _Bits(NamedTuple):
    """The bits of a float: as which integer they are read, and how many of them `rounded` drops."""

    integer: str
    magnitude: int
    dropped: int


_BITS: Final = {4: _Bits("<i4", 0x7FFF_FFFF, 4), 8: _Bits("<i8", 0x7FFF_FFFF_FFFF_FFFF, 33)}


@dataclass(frozen=True, slots=True)
class Packed:
    """A packed column.

    Attributes:
        codec: how `data` is read.
        count: how many values there are.
        error: the greatest absolute error of any value once unpacked, as measured; 0.0: exact.
        zone: what is known of the values without unpacking them, before any was rounded.
        data: the bytes, not compressed yet; empty where every value is the zone's least.
    """

    codec: str
    count: int
    error: float
    zone: Zone
    data: bytes


def pack(column: Column, step: Step = EXACT) -> Packed:
    """Returns the column as bytes. `step` counts for floats alone; all others are exact."""
    if isinstance(column, Texts):
        return _pack_texts(column)
    if not len(column):
        return Packed(f"{column.dtype.name} constant", 0, 0.0, _NOTHING, b"")
    if column.dtype.kind == "f":
        return _pack_floats(column, step)
    least, greatest = int(column.min()), int(column.max())
    zone = Zone(least, greatest)
    if least == greatest:
        return Packed(f"{column.dtype.name} constant", len(column), 0.0, zone, b"")
    # Unsigned ones of 2**63 and more wrap around, here and back: no difference is that large.
    arrangement, data = _arranged(column.astype(np.int64), least, greatest)
    return Packed(f"{column.dtype.name} whole {arrangement}", len(column), 0.0, zone, data)


def unpack(codec: str, count: int, least: float | None, data: bytes) -> Column:
    """Returns the column that was packed so, of the same dtype; arrays may be read-only.

    Args:
        codec: `Packed.codec`.
        count: how many values there are.
        least: that of the zone.
        data: `Packed.data`.

    Raises:
        ValueError: there is no such codec, or the bytes are not of it.
    """
    kind, _, rest = codec.partition(" ")
    if kind == "text":
        return _unpack_texts(rest, count, data)
    dtype = np.dtype(kind)
    if rest == "constant":
        return np.full(count, np.nan if least is None and dtype.kind == "f" else least or 0, dtype)
    form, _, arrangement = rest.partition(" ")
    if form == "whole":
        return _whole_numbers(arrangement, count, int(least or 0), data).astype(dtype)
    if form.startswith("/"):
        per_unit = int(form[1:])
        first = round((least or 0.0) * per_unit)
        return (_whole_numbers(arrangement, count, first, data) / per_unit).astype(
            dtype, copy=False
        )
    stored = np.dtype(np.float32) if form == "float32" else dtype
    rounded = form == "rounded"
    lowest = int(_ordered(np.array([least], stored), rounded=rounded)[0])
    whole = _whole_numbers(arrangement, count, lowest, data)
    return _from_ordered(whole, stored, rounded=rounded).astype(dtype, copy=False)


def compressed(data: bytes, level: int = LEVEL) -> bytes:
    """Returns the bytes as a zstd frame that states its size."""
    return zstandard.ZstdCompressor(level=level).compress(data)


def decompressed(data: bytes) -> bytes:
    """Returns what `compressed` was given.

    Raises:
        ValueError: it is no such frame, or a damaged one.
    """
    try:
        return zstandard.decompress(data)
    except zstandard.ZstdError as error:
        raise ValueError(f"packed columns cannot be decompressed: {error}") from error


# Floats


def _pack_floats(column: Numbers, step: Step) -> Packed:
    values = column.astype(np.float64, copy=False)
    zone = _zone_of(values)
    least, greatest = zone.least, zone.greatest
    name = column.dtype.name
    if least == greatest and zone.nulls in {0, len(values)}:
        return Packed(f"{name} constant", len(values), 0.0, zone, b"")
    if least is not None and greatest is not None and not zone.nulls:
        most = max(abs(least), abs(greatest))
        if math.isfinite(most):
            found = _near(column, values, most, step)
            if found is not None:
                return Packed(f"{name} {found.codec}", len(values), found.error, zone, found.data)
    return _exact(column, zone)


class _Near(NamedTuple):
    codec: str
    error: float
    data: bytes


def _near(column: Numbers, values: NDArray[np.float64], most: float, step: Step) -> _Near | None:
    """The values within the step, or nothing where they themselves are smaller."""
    limit = _MOST_MULTIPLES[column.itemsize]
    if step.per_unit:
        return _multiples(column, values, step.per_unit) if most * step.per_unit < limit else None
    if not step.relative:
        return None
    decimal = _decimal(values) if most < limit else 0
    if decimal and most * decimal < limit:
        found = _multiples(column, values, decimal, MOST_RELATIVE)
        if found is not None:
            return found
    whole = _ordered(column, rounded=True)
    back = _from_ordered(whole, column.dtype, rounded=True).astype(np.float64, copy=False)
    # An exponent too large becomes infinite; tiny numbers have no bits to spare.
    errors = np.abs(back - values)
    if not bool((errors <= MOST_RELATIVE * np.abs(values)).all()):
        return None
    arrangement, data = _arranged(whole, int(whole.min()), int(whole.max()))
    return _Near(f"rounded {arrangement}", float(errors.max()), data)


def _multiples(
    column: Numbers, values: NDArray[np.float64], per_unit: int, relative: float = 0.0
) -> _Near | None:
    """The values as multiples of a step; nothing where one is not within the relative error."""
    multiples = np.rint(values * per_unit)
    back = multiples / per_unit
    if column.itemsize == 4:
        back = back.astype(np.float32).astype(np.float64)
    errors = np.abs(back - values)
    if relative and not bool((errors <= relative * np.abs(values)).all()):
        return None
    whole = multiples.astype(np.int64)
    arrangement, data = _arranged(whole, int(whole.min()), int(whole.max()))
    return _Near(f"/{per_unit} {arrangement}", float(errors.max()), data)


def _decimal(values: NDArray[np.float64]) -> int:
    """The coarsest decimal step that some of the values have, nearly; 0 where they have none."""
    sample = values[:: max(1, len(values) // _SAMPLE)]
    scaled = np.multiply.outer(np.array(_DECIMALS, np.float64), sample)
    fits = np.abs(np.rint(scaled) - scaled) <= MOST_RELATIVE * np.abs(scaled)
    rows = fits.all(axis=1)
    nth = int(rows.argmax())
    return _DECIMALS[nth] if rows[nth] else 0


def _exact(column: Numbers, zone: Zone) -> Packed:
    stored, form = column, "bits"
    if column.itemsize == 8:
        with np.errstate(over="ignore"):
            short = column.astype(np.float32)
        if np.array_equal(short, column, equal_nan=True):
            stored, form = short, "float32"
    whole = _ordered(stored)
    arrangement, data = _arranged(whole, int(whole.min()), int(whole.max()))
    codec = f"{column.dtype.name} {form} {arrangement}"
    return Packed(codec, len(column), 0.0, zone, data)


def _zone_of(values: NDArray[np.float64]) -> Zone:
    least, greatest = float(values.min()), float(values.max())
    if not math.isnan(least):
        return Zone(least + 0.0, greatest + 0.0)
    there = values[~np.isnan(values)]
    nulls = len(values) - len(there)
    if not len(there):
        return Zone(nulls=nulls)
    return Zone(float(there.min()) + 0.0, float(there.max()) + 0.0, nulls)


def _ordered(values: Numbers, *, rounded: bool = False) -> IntArray:
    """The bits of floats as integers that are ordered as the floats are; NaN is the greatest."""
    integer, magnitude, dropped = _BITS[values.itemsize]
    same = np.add(values, 0.0, dtype=values.dtype)  # -0.0 becomes 0.0
    missing = np.isnan(same)
    if missing.any():
        same[missing] = np.nan
    bits = same.view(integer).astype(np.int64)
    if rounded:
        bits = (bits + (1 << (dropped - 1))) >> dropped
        magnitude >>= dropped
    return bits ^ ((bits >> 63) & magnitude)


def _from_ordered(
    whole: IntArray, dtype: np.dtype[np.generic[object]], *, rounded: bool
) -> Numbers:
    integer, magnitude, dropped = _BITS[dtype.itemsize]
    if rounded:
        bits = (whole ^ ((whole >> 63) & (magnitude >> dropped))) << dropped
    else:
        bits = whole ^ ((whole >> 63) & magnitude)
    return bits.astype(integer, copy=False).view(dtype)


# Whole numbers


def _arranged(whole: IntArray, least: int, greatest: int) -> tuple[str, bytes]:
    """Whole numbers, at least two and not all equal, as `arrangement width` and bytes.

    Of the arrangements it takes the one whose numbers are nearest to each other on average.
    """
    numbers = whole - _wrapped(least)
    if greatest - least >= _FAR_APART:
        return "plain 8", _planes(numbers, 8)
    steps = numbers[1:] - numbers[:-1]
    curve = steps[1:] - steps[:-1]
    slope = round((int(numbers[-1]) - int(numbers[0])) / len(steps))
    delta, line = steps, numbers
    if slope:
        delta, line = steps - slope, numbers - slope * np.arange(len(numbers))
    costs = (_spread(numbers), _spread(line), _size(delta), _size(curve))
    best = costs.index(min(costs))
    if best == 0:
        return _in_planes("flat", b"", numbers)
    if best == 1:
        return _in_planes("line", struct.pack("<q", slope), line - line.min())
    if best == 2:
        return _in_planes("delta", struct.pack("<q", slope), (delta << 1) ^ (delta >> 63))
    return _in_planes("curve", struct.pack("<q", steps[0]), (curve << 1) ^ (curve >> 63))


def _whole_numbers(arrangement: str, count: int, least: int, data: bytes) -> IntArray:
    """Returns the whole numbers that were arranged; the least of them is `least`."""
    name, _, width = arrangement.partition(" ")
    if name in {"plain", "flat"}:
        return _from_planes(data, 0, count, int(width)) + _wrapped(least)
    first: int = struct.unpack_from("<q", data)[0]
    if name == "line":
        numbers = _from_planes(data, 8, count, int(width))
        numbers += first * np.arange(count)
    elif name in {"delta", "curve"}:
        numbers = np.zeros(count, np.int64)
        ahead = 1 if name == "delta" else 2
        zigzag = _from_planes(data, 8, count - ahead, int(width))
        numbers[ahead:] = (zigzag.view(np.uint64) >> np.uint64(1)).view(np.int64) ^ -(zigzag & 1)
        if name == "delta":
            numbers[1:] += first
        else:
            numbers[1] = first
            np.cumsum(numbers[1:], out=numbers[1:])
        np.cumsum(numbers, out=numbers)
    else:
        raise ValueError(f"packed columns are not arranged {name!r}")
    numbers -= numbers.min()
    numbers += _wrapped(least)
    return numbers


def _wrapped(number: int) -> np.int64:
    """The number of 64 bits, signed or not, as numpy adds and subtracts it."""
    return np.int64(number - (1 << 64) if number >= 1 << 63 else number)


def _spread(numbers: IntArray) -> float:
    """The mean distance from the mean."""
    mean = float(np.add.reduce(numbers, dtype=np.float64)) / len(numbers)
    return float(np.add.reduce(np.abs(numbers - mean))) / len(numbers)


def _size(numbers: IntArray) -> float:
    """The mean absolute value; infinite of none."""
    if not len(numbers):
        return math.inf
    return float(np.add.reduce(np.abs(numbers), dtype=np.float64)) / len(numbers)


def _in_planes(name: str, head: bytes, numbers: IntArray) -> tuple[str, bytes]:
    width = (int(numbers.view(np.uint64).max()).bit_length() + 7) // 8
    return f"{name} {width}", head + _planes(numbers, width)


def _planes(numbers: IntArray, width: int) -> bytes:
    return numbers.astype("<i8", copy=False).view(np.uint8).reshape(-1, 8).T[:width].tobytes()


def _from_planes(data: bytes, start: int, count: int, width: int) -> IntArray:
    numbers = np.zeros((count, 8), np.uint8)
    planes = np.frombuffer(data, np.uint8, count * width, start)
    numbers[:, :width] = planes.reshape(width, count).T
    return numbers.view("<i8").ravel()


# Texts


def _pack_texts(column: Texts) -> Packed:
    codes, words = _in_use(column)
    lengths = np.array([len(word) for word in words], "<u4")
    text = "".join(words).encode("utf-8", "surrogatepass")
    head = struct.pack("<II", len(words), len(text)) + lengths.tobytes() + text
    zone = Zone(words=_folded(words))
    if len(words) <= 1:
        return Packed("text constant", len(codes), 0.0, zone, head if words else b"")
    arrangement, data = _arranged(codes.astype(np.int64), 0, len(words) - 1)
    return Packed(f"text {arrangement}", len(codes), 0.0, zone, head + data)


def _in_use(column: Texts) -> tuple[NDArray[np.uint32], tuple[str, ...]]:
    """The column without words that no row has: whoever forgot the rows forgot their words."""
    used = np.bincount(column.codes, minlength=len(column.words)) > 0
    if used.all():
        return column.codes, column.words
    codes = (np.cumsum(used, dtype=np.uint32) - np.uint32(1))[column.codes]
    return codes, tuple(column.words[nth] for nth in np.flatnonzero(used).tolist())


def _folded(words: tuple[str, ...]) -> str | None:
    if sum(map(len, words)) + len(words) > MOST_WORDS_BYTES:
        return None
    folded = "\n".join(dict.fromkeys(word.casefold() for word in words))
    small = len(folded.encode("utf-8", "surrogatepass")) <= MOST_WORDS_BYTES
    return folded if small else None


def _unpack_texts(arrangement: str, count: int, data: bytes) -> Texts:
    words, end = _words(data)
    if arrangement == "constant":
        return Texts(np.zeros(count, np.uint32), words)
    return Texts(_whole_numbers(arrangement, count, 0, data[end:]).astype(np.uint32), words)


def zone_of_texts(data: bytes) -> Zone:
    """Returns the zone of packed texts from their words alone."""
    return Zone(words=_folded(_words(data)[0]))


def _words(data: bytes) -> tuple[tuple[str, ...], int]:
    """The words, and where they end."""
    if not data:
        return (), 0
    count, size = struct.unpack_from("<II", data)
    begin = 8 + 4 * count
    text = data[begin : begin + size].decode("utf-8", "surrogatepass")
    ends = np.cumsum(np.frombuffer(data, "<u4", count, 8), dtype=np.int64).tolist()
    words = tuple(text[at:stop] for at, stop in zip([0, *ends], ends, strict=False))
    return words, begin + size

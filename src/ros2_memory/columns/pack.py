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
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
import zstandard

from ros2_memory.columns.steps import EXACT, MOST_RELATIVE, Step
from ros2_memory.columns.table import IN_PART, Column, Numbers, Texts, Zone, letters_of
from ros2_memory.core.large_reads import LARGE_BYTES

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.storage.base import IntArray

Floats: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
Values = TypeVar("Values", "IntArray", "Floats")

FORMAT: Final = 16
"""Version of the file. Raise it with every change of its tables and of their bytes."""
MOST_WORDS_BYTES: Final = 4_096
LEVEL: Final = 4
"""Of zstd. A blob of 10 s takes 0.5 ms; level 1 half of that and 7 % more bytes, level 6 0.8 ms and
1 to 10 % fewer."""

_ARRANGEMENTS: Final = ("flat", "line", "delta", "curve")
_CONTAINERS: Final = ("<u1", "<u1", "<u2", "<u4", "<u4", "<u8", "<u8", "<u8", "<u8")
"""For each width in bytes the least unsigned integer that numpy has."""
_FAR_APART: Final = 1 << 62
_AT_ONCE: Final = 1 << 16
"""Values that are packed at once, if it is not one column that has more."""
_MOST_MULTIPLES: Final = {4: float(1 << 24), 8: float(1 << 46)}
"""Multiples of a step up to these are fewer bits than the float32 or float64 itself."""
_DECIMALS: Final = (1, 10, 100, 1_000, 10_000, 100_000)
"""Steps, as `Step.per_unit`, that values of a relative exactness often have anyway."""
_SAMPLE: Final = 16
_LONG_PLANE: Final = 300
_END_BLOCK: Final = zstandard.COMPRESSOBJ_FLUSH_BLOCK


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
        plane: how many bytes each of the planes has that `data` ends with.
    """

    codec: str
    count: int
    error: float
    zone: Zone
    data: bytes
    plane: int = 0


def pack(column: Column, step: Step = EXACT) -> Packed:
    """Returns the column as bytes. `step` counts for floats alone; all others are exact."""
    return pack_columns([(column, step)])[0]


def pack_columns(columns: Sequence[tuple[Column, Step]]) -> list[Packed]:
    """Returns columns as bytes, as `pack` does one.

    What is done for one is done for all at once, one after the other in one array: a bag has some
    sixty short columns, and numpy takes longer to be called than to go through one of them.
    """
    packed: list[Packed] = []
    first = values = 0
    for nth, (column, _) in enumerate(columns):
        values += len(column.codes) if isinstance(column, Texts) else len(column)
        if values > _AT_ONCE:
            packed += _pack_at_once(columns[first : nth + 1])
            first, values = nth + 1, 0
    return packed + _pack_at_once(columns[first:])


def _pack_at_once(columns: Sequence[tuple[Column, Step]]) -> list[Packed]:
    found: dict[int, Packed | _Whole] = {}
    integers: dict[int, Numbers] = {}
    floats: dict[str, dict[int, tuple[Numbers, Step]]] = {}
    for nth, (column, step) in enumerate(columns):
        if isinstance(column, Texts):
            found[nth] = _pack_texts(column)
        elif not len(column):
            found[nth] = Packed(f"{column.dtype.name} constant", 0, 0.0, Zone(), b"")
        elif column.dtype.kind == "f":
            floats.setdefault(column.dtype.str, {})[nth] = (column, step)
        else:
            integers[nth] = column
    if integers:
        found.update(zip(integers, _pack_integers(list(integers.values())), strict=True))
    for some in floats.values():
        found.update(zip(some, _Floats(list(some.values())).packed(), strict=True))
    waiting = [one for one in found.values() if isinstance(one, _Whole)]
    arranged = iter(_arranged(waiting) if waiting else ())
    packed = {nth: next(arranged) if isinstance(one, _Whole) else one for nth, one in found.items()}
    return [packed[nth] for nth in range(len(columns))]


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


def compressed(data: bytes, plane: int = 0) -> bytes:
    """Returns the bytes as a zstd frame that states its size.

    Args:
        data: the bytes.
        plane: `Packed.plane`. Long planes become blocks of their own, with their own codes: a low
            byte is noise where a high one hardly varies.
    """
    compressor = zstandard.ZstdCompressor(level=LEVEL)
    if plane < _LONG_PLANE or len(data) < 2 * plane:
        return compressor.compress(data)
    blocks = compressor.compressobj(size=len(data))
    ends = range(len(data) % plane + plane, len(data) + 1, plane)
    found = []
    for begin, end in pairwise((0, *ends)):
        found += [blocks.compress(data[begin:end]), blocks.flush(_END_BLOCK)]
    return b"".join((*found, blocks.flush()))


def is_large(data: bytes) -> bool:
    """Returns whether `decompressed` returns more than `LARGE_BYTES`; False if it refuses it."""
    try:
        return zstandard.frame_content_size(data) > LARGE_BYTES
    except zstandard.ZstdError:
        return False


def decompressed(data: bytes) -> bytes:
    """Returns what `compressed` was given.

    Raises:
        ValueError: it is no such frame, or a damaged one.
    """
    try:
        return zstandard.decompress(data)
    except zstandard.ZstdError as error:
        raise ValueError(f"packed columns cannot be decompressed: {error}") from error


class _Whole(NamedTuple):
    """A column as whole numbers, not all equal, that are yet to be arranged."""

    form: str
    error: float
    zone: Zone
    head: bytes
    numbers: IntArray
    least: int
    greatest: int


class _InLine:
    """Where columns lie that follow each other in one array. None is empty."""

    def __init__(self, columns: Sequence[Numbers]) -> None:
        self.lengths = np.array([len(column) for column in columns])
        self.stops = np.cumsum(self.lengths)
        self.starts = self.stops - self.lengths

    def parts(self, values: Values) -> list[Values]:
        """Returns the values of each column."""
        bounds = zip(self.starts.tolist(), self.stops.tolist(), strict=True)
        return [values[start:stop] for start, stop in bounds]

    def least(self, values: Values) -> Values:
        """Returns the least value of each column; NaN where it has one."""
        return np.minimum.reduceat(values, self.starts)

    def greatest(self, values: Values) -> Values:
        """Returns the greatest value of each column; NaN where it has one."""
        return np.maximum.reduceat(values, self.starts)

    def means(self, values: Numbers) -> Floats:
        """Returns the mean of each column."""
        means: Floats = np.add.reduceat(values, self.starts, dtype=np.float64) / self.lengths
        return means

    def rows(self, values: Values) -> Values:
        """Returns a value of each column for every row of it."""
        return np.repeat(values, self.lengths)


def _pack_integers(columns: Sequence[Numbers]) -> Iterator[Packed | _Whole]:
    lie = _InLine(columns)
    # Unsigned ones of 2**63 and more wrap around, here and back.
    numbers = np.concatenate(columns, dtype=np.int64, casting="unsafe")
    leasts, greatests = lie.least(numbers).tolist(), lie.greatest(numbers).tolist()
    for nth, (column, part) in enumerate(zip(columns, lie.parts(numbers), strict=True)):
        name = column.dtype.name
        zone = Zone(leasts[nth], greatests[nth])
        if name == "uint64":
            zone = Zone(int(column.min()), int(column.max()))
        least, greatest = int(zone.least or 0), int(zone.greatest or 0)
        if least == greatest:
            yield Packed(f"{name} constant", len(part), 0.0, zone, b"")
        else:
            yield _Whole(f"{name} whole", 0.0, zone, b"", part, least, greatest)


# Floats


class _Floats:
    """Columns of floats of one type."""

    def __init__(self, columns: Sequence[tuple[Numbers, Step]]) -> None:
        self.columns = [column for column, _ in columns]
        self.steps = [step for _, step in columns]
        self.name = self.columns[0].dtype.name
        self.limit = _MOST_MULTIPLES[self.columns[0].itemsize]
        lie = _InLine(self.columns)
        values = np.concatenate(self.columns, dtype=np.float64)
        self.values = lie.parts(values)
        bounds = zip(lie.least(values).tolist(), lie.greatest(values).tolist(), strict=True)
        self.zones = [
            _zone_of(part, least, greatest)
            for part, (least, greatest) in zip(self.values, bounds, strict=True)
        ]
        self.found: dict[int, Packed | _Whole] = {}

    def packed(self) -> list[Packed | _Whole]:
        """Returns each as multiples of its step, else with fewer bits, else as it is."""
        relative, multiples = [], {}
        for nth, (zone, step) in enumerate(zip(self.zones, self.steps, strict=True)):
            count = len(self.columns[nth])
            if zone.least == zone.greatest and zone.nulls in {0, count}:
                self.found[nth] = Packed(f"{self.name} constant", count, 0.0, zone, b"")
            elif zone.nulls or not math.isfinite(self._most(nth)):
                self._exactly(nth)
            elif step.relative:
                relative.append(nth)
            elif step.per_unit and self._most(nth) * step.per_unit < self.limit:
                multiples[nth] = step.per_unit
            else:
                self._exactly(nth)
        if relative:
            multiples |= self._decimals(relative)
        if multiples:
            self._as_multiples(multiples)
        rest = [nth for nth in relative if nth not in self.found]
        if rest:
            self._rounded(rest)
        return [self.found[nth] for nth in range(len(self.columns))]

    def _most(self, nth: int) -> float:
        zone = self.zones[nth]
        return max(abs(zone.least or 0.0), abs(zone.greatest or 0.0))

    def _decimals(self, members: Sequence[int]) -> dict[int, int]:
        """The coarsest decimal step that some values of a column nearly have, where they do."""
        some = [nth for nth in members if self._most(nth) < self.limit]
        if not some:
            return {}
        samples = [self.values[nth][:: max(1, len(self.values[nth]) // _SAMPLE)] for nth in some]
        scaled = np.multiply.outer(np.array(_DECIMALS, np.float64), np.concatenate(samples))
        fit = np.abs(np.rint(scaled) - scaled) <= MOST_RELATIVE * np.abs(scaled)
        fits = np.logical_and.reduceat(fit, _InLine(samples).starts, axis=1)
        found: dict[int, int] = {}
        for nth, column in zip(some, fits.T, strict=True):
            coarsest = _DECIMALS[int(column.argmax())]
            if column.any() and self._most(nth) * coarsest < self.limit:
                found[nth] = coarsest
        return found

    def _as_multiples(self, per_units: Mapping[int, int]) -> None:
        """Takes those of the columns that are multiples of a step, or near enough to them."""
        members = list(per_units)
        lie = _InLine([self.values[nth] for nth in members])
        values = np.concatenate([self.values[nth] for nth in members])
        per_unit = lie.rows(np.array(list(per_units.values()), np.float64))
        multiples = np.rint(values * per_unit)
        back = multiples / per_unit
        if self.name == "float32":
            back = back.astype(np.float32).astype(np.float64)
        forms = {nth: f"/{number}" for nth, number in per_units.items()}
        self._take(forms, values, back, multiples.astype(np.int64))

    def _rounded(self, members: Sequence[int]) -> None:
        """Takes the columns with fewer bits, or as they are: tiny numbers have no bits to spare."""
        columns = np.concatenate([self.columns[nth] for nth in members])
        whole = _ordered(columns, rounded=True)
        back = _from_ordered(whole, columns.dtype, rounded=True)
        values = columns.astype(np.float64, copy=False)
        self._take(dict.fromkeys(members, "rounded"), values, back, whole)
        for nth in members:
            if nth not in self.found:
                self._exactly(nth)

    def _take(
        self, forms: Mapping[int, str], values: Floats, back: Floats, whole: IntArray
    ) -> None:
        """Takes columns that come back so, unless one is relative and off by more than it may."""
        lie = _InLine([self.columns[nth] for nth in forms])
        errors = np.abs(back - values)
        excess = lie.greatest(errors - MOST_RELATIVE * np.abs(values)).tolist()
        worst = lie.greatest(errors).tolist()
        leasts, greatests = lie.least(whole).tolist(), lie.greatest(whole).tolist()
        for row, (nth, part) in enumerate(zip(forms, lie.parts(whole), strict=True)):
            if not self.steps[nth].relative or excess[row] <= 0:
                self.found[nth] = _Whole(
                    f"{self.name} {forms[nth]}",
                    worst[row],
                    self.zones[nth],
                    b"",
                    part,
                    leasts[row],
                    greatests[row],
                )

    def _exactly(self, nth: int) -> None:
        stored, form = self.columns[nth], "bits"
        if stored.itemsize == 8:
            with np.errstate(over="ignore"):
                short = stored.astype(np.float32)
            if np.array_equal(short, stored, equal_nan=True):
                stored, form = short, "float32"
        whole = _ordered(stored)
        least, greatest = int(whole.min()), int(whole.max())
        form = f"{self.name} {form}"
        self.found[nth] = _Whole(form, 0.0, self.zones[nth], b"", whole, least, greatest)


def _zone_of(values: Floats, least: float, greatest: float) -> Zone:
    """The zone of values, by the least and the greatest of them: NaN where there is one."""
    if not math.isnan(least):
        return Zone(least + 0.0, greatest + 0.0)  # -0.0 becomes 0.0
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


def _from_ordered(whole: IntArray, dtype: np.dtype[np.generic[object]], *, rounded: bool) -> Floats:
    integer, magnitude, dropped = _BITS[dtype.itemsize]
    if rounded:
        bits = (whole ^ ((whole >> 63) & (magnitude >> dropped))) << dropped
    else:
        bits = whole ^ ((whole >> 63) & magnitude)
    return bits.astype(integer, copy=False).view(dtype).astype(np.float64, copy=False)


# Whole numbers


def _arranged(columns: Sequence[_Whole]) -> list[Packed]:
    """The columns, each arranged so that its numbers have the fewest bits on average."""
    lie = _InLine([column.numbers for column in columns])
    flat = np.concatenate([column.numbers for column in columns])
    flat -= lie.rows(np.array([_wrapped(column.least) for column in columns]))
    slopes = np.rint((flat[lie.stops - 1] - flat[lie.starts]) / (lie.lengths - 1)).astype(np.int64)
    slope = lie.rows(slopes)
    line = flat - slope * (np.arange(len(flat)) - lie.rows(lie.starts))
    steps = _differences(flat, lie.starts)
    delta = steps - slope
    delta[lie.starts] = 0
    curve = _differences(steps, lie.starts)
    curve[lie.starts + 1] = 0
    around = (flat - lie.rows(lie.means(flat)), line - lie.rows(lie.means(line)), delta, curve)
    bits = np.array([lie.means(_bits_of(numbers)) for numbers in around])
    line -= lie.rows(np.minimum.reduceat(line, lie.starts))
    numbers = (flat, line, (delta << 1) ^ (delta >> 63), (curve << 1) ^ (curve >> 63))
    most = [np.maximum.reduceat(some.view(np.uint64), lie.starts).tolist() for some in numbers]
    found = []
    for nth, (column, which) in enumerate(zip(columns, bits.argmin(axis=0).tolist(), strict=True)):
        start, stop = int(lie.starts[nth]), int(lie.stops[nth])
        name, width, head = _ARRANGEMENTS[which], (most[which][nth].bit_length() + 7) // 8, b""
        left = numbers[which][start + max(0, which - 1) : stop]
        if column.greatest - column.least >= _FAR_APART:
            name, width, left = "plain", 8, flat[start:stop]
        elif which:
            head = struct.pack("<q", steps[start + 1] if name == "curve" else slopes[nth])
        codec = f"{column.form} {name} {width}"
        data = b"".join((column.head, head, byte_planes(left, width)))
        found.append(Packed(codec, stop - start, column.error, column.zone, data, len(left)))
    return found


def _bits_of(numbers: Numbers) -> Numbers:
    """Returns about how many bits each number takes, with its sign."""
    # In single precision and in place: the memory of four such arrays is what takes long.
    sizes = np.abs(numbers.astype(np.float32))
    sizes *= 2
    sizes += 1
    np.log2(sizes, out=sizes)
    return sizes


def _differences(numbers: IntArray, starts: IntArray) -> IntArray:
    """What each number is more than the one before it; 0 of the first of each column."""
    found = np.empty_like(numbers)
    np.subtract(numbers[1:], numbers[:-1], out=found[1:])
    found[starts] = 0
    return found


def _whole_numbers(arrangement: str, count: int, least: int, data: bytes) -> IntArray:
    """Returns the whole numbers that were arranged; the least of them is `least`."""
    name, _, width = arrangement.partition(" ")
    if name in {"plain", "flat"}:
        return np.add(from_planes(data, 0, count, int(width)).astype(np.int64), _wrapped(least))
    first: int = struct.unpack_from("<q", data)[0]
    if name == "line":
        numbers = np.arange(count)
        numbers *= first
        numbers += from_planes(data, 8, count, int(width)).astype(np.int64, copy=False)
    elif name == "delta":
        numbers = np.zeros(count, np.int64)
        numbers[1:] = _signed(from_planes(data, 8, count - 1, int(width)))
        numbers[1:] += first
    elif name == "curve":
        numbers = np.zeros(count, np.int64)
        numbers[1] = first
        numbers[2:] = _signed(from_planes(data, 8, count - 2, int(width)))
        np.cumsum(numbers[1:], out=numbers[1:])
    else:
        raise ValueError(f"packed columns are not arranged {name!r}")
    if name != "line":
        np.cumsum(numbers, out=numbers)
    # Differences wrap around, as those of the packed numbers did.
    lowest: IntArray = numbers.min(keepdims=True)
    numbers += np.subtract(_wrapped(least), lowest)
    return numbers


def _signed(numbers: Numbers) -> Numbers:
    """0, 1, 2, 3, 4 as 0, -1, 1, -2, 2."""
    signs: Numbers = np.negative(np.bitwise_and(numbers, 1).view(f"<i{numbers.itemsize}"))
    halves: Numbers = np.bitwise_xor(np.right_shift(numbers, 1).view(signs.dtype), signs)
    return halves


def _wrapped(number: int) -> np.int64:
    """The number of 64 bits, signed or not, as numpy adds and subtracts it."""
    return np.int64(number - (1 << 64) if number >= 1 << 63 else number)


def byte_planes(numbers: IntArray, width: int) -> bytes:
    """Returns numbers in planes: the lowest byte of each, then the next; so many of their bytes."""
    short = numbers.astype(_CONTAINERS[width], copy=False)
    return short.view(np.uint8).reshape(-1, short.itemsize).T[:width].tobytes()


def from_planes(data: bytes, start: int, count: int, width: int) -> Numbers:
    """Returns the numbers as unsigned ones of the least width that numpy has."""
    dtype = _CONTAINERS[width]
    rows = np.frombuffer(data, np.uint8, count * width, start).reshape(width, count)
    numbers = rows[0].astype(dtype) if width else np.zeros(count, dtype)
    for nth in range(1, width):
        numbers |= rows[nth].astype(dtype) << (8 * nth)
    return numbers


# Texts


def _pack_texts(column: Texts) -> Packed | _Whole:
    codes, words = _in_use(column)
    zone = Zone(words=folded(words))
    if not words:
        return Packed("text constant", 0, 0.0, zone, b"")
    lengths = np.array([len(word) for word in words], "<u4")
    text = "".join(words).encode("utf-8", "surrogatepass")
    head = struct.pack("<II", len(words), len(text)) + lengths.tobytes() + text
    if len(words) == 1:
        return Packed("text constant", len(codes), 0.0, zone, head)
    return _Whole("text", 0.0, zone, head, codes.astype(np.int64), 0, len(words) - 1)


def _in_use(column: Texts) -> tuple[NDArray[np.uint32], tuple[str, ...]]:
    """Returns the codes and words of a column without the words that no row has.

    Words of deleted rows must not stay in the file.
    """
    if len(column.words) <= 1 and len(column.codes):
        return column.codes, column.words
    used = np.bincount(column.codes, minlength=len(column.words)) > 0
    if used.all():
        return column.codes, column.words
    codes = (np.cumsum(used, dtype=np.uint32) - np.uint32(1))[column.codes]
    return codes, tuple(column.words[nth] for nth in np.flatnonzero(used).tolist())


def folded(words: Collection[str]) -> str | None:
    """Returns the words as a zone has them: whole, else what letters are in them, else None.

    JSON with numbers is another text each time, and has few names.
    """
    if sum(map(len, words)) + len(words) <= MOST_WORDS_BYTES:
        whole = "\n".join(dict.fromkeys(word.casefold() for word in words))
        if _is_small(whole):
            return whole
    names: set[str] = set()
    for word in words:
        names.update(letters_of(word.casefold()))
        if len(names) > MOST_WORDS_BYTES // 2:
            return None
    in_part = "\n".join([IN_PART, *sorted(names)])
    return in_part if _is_small(in_part) else None


def _is_small(text: str) -> bool:
    return len(text.encode("utf-8", "surrogatepass")) <= MOST_WORDS_BYTES


def _unpack_texts(arrangement: str, count: int, data: bytes) -> Texts:
    words, end = _words(data)
    if arrangement == "constant":
        return Texts(np.zeros(count, np.uint32), words)
    return Texts(_whole_numbers(arrangement, count, 0, data[end:]).astype(np.uint32), words)


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

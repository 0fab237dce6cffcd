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

How n whole numbers are arranged, once the least is subtracted. `^` is one little-endian number of 8
bytes; `#` are so many planes of as many bytes as numbers: the lowest byte of every number, then the
next (a plane of high bytes hardly varies, so it compresses to nothing)::

    flat    # n               the numbers
    delta   ^ slope # n-1     differences of neighbours, less the slope

Differences have a sign: 0, -1, 1, -2, 2 are written 0, 1, 2, 3, 4. Sums start anywhere: the least
of the zone says where. Numbers that are 2**62 apart and more are `flat`.

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
import threading
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
import zstandard

from ros2_memory.columns.plan import fields_at
from ros2_memory.columns.table import IN_PART, Column, Numbers, Texts, Zone, letters_of
from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.text import caseless, encodable
from ros2_memory.storage.base import Definition

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from ros2_memory.storage.base import IntArray

Floats: TypeAlias = "np.ndarray[tuple[int, ...], np.dtype[np.float64]]"

FORMAT: Final = 46
"""Version of the file. Raise it with every change of its tables, of their bytes, and of the rules
by which fragments are made: only those of sights have a version of their own."""
MOST_WORDS_BYTES: Final = 4_096
LEVEL: Final = 3
"""Of zstd. Level 1 takes four fifths of its time and 2 % more bytes, level 4 a quarter more time
for the same bytes."""

_CONTAINERS: Final = ("<u1", "<u1", "<u2", "<u4", "<u4", "<u8", "<u8", "<u8", "<u8")
"""For each width in bytes the least unsigned integer that numpy has."""
_FAR_APART: Final = 1 << 62
_MOST_MULTIPLES: Final = {4: float(1 << 24), 8: float(1 << 46)}
"""Up to these, multiples of a step take fewer bits than the float32 or float64 itself."""
_DECIMALS: Final = (1, 10, 100, 1_000, 10_000, 100_000)
"""Steps, as `Step.per_unit`, that values of relative exactness are often multiples of."""
_SAMPLE: Final = 16
_LOOKED_AT: Final = 512
"""About how many numbers of a column decide how it is arranged."""


class _Bits(NamedTuple):
    """The bits of a float.

    Attributes:
        integer: the dtype as which they are read.
        magnitude: all bits but the sign.
        dropped: how many of the lowest bits `rounded` drops.
    """

    integer: str
    magnitude: int
    dropped: int


_BITS: Final = {4: _Bits("<i4", 0x7FFF_FFFF, 4), 8: _Bits("<i8", 0x7FFF_FFFF_FFFF_FFFF, 33)}
MOST_RELATIVE: Final = 1e-6


# How exactly floats are stored


@dataclass(frozen=True, slots=True)
class Step:
    """How the values of a column of floats are rounded. Other columns are always exact.

    Attributes:
        per_unit: values become multiples of `1 / per_unit`; 0 if they do not.
        relative: whether each value may change by a millionth (`MOST_RELATIVE`) of itself.
    """

    per_unit: int = 0
    relative: bool = False

    def nearest(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the nearest multiples of an absolute step; a value too large for one stays."""
        with np.errstate(over="ignore", invalid="ignore"):
            multiples = np.rint(values * self.per_unit) / self.per_unit
        return np.where(np.isinf(multiples), values, multiples)


EXACT: Final = Step()
RELATIVE: Final = Step(relative=True)
METRES: Final = Step(per_unit=10_000)
"""0.1 mm."""
RADIANS: Final = Step(per_unit=10_000)
"""0.1 mrad."""
VELOCITY: Final = Step(per_unit=10_000)
"""0.1 mm/s, or 0.1 mrad/s."""
QUATERNION: Final = Step(per_unit=20_000)
"""5e-5. A component then changes by at most 2.5e-5, so a unit quaternion by at most 5e-5, and the
rotation by twice that (its angle is twice that of the quaternion): 0.1 mrad."""
DEGREES: Final = Step(per_unit=1_000_000_000)
"""1e-9 degree: 0.1 mm on the ground."""

_OF_ARRAYS: Final = frozenset({"", "least", "greatest"})
_POINTS: Final = frozenset({"geometry_msgs/msg/Point", "geometry_msgs/msg/Point32"})
_POSES_2D: Final = frozenset({"geometry_msgs/msg/Pose2D", "vision_msgs/msg/Point2D"})
_VECTOR: Final = "geometry_msgs/msg/Vector3"
_QUATERNION: Final = "geometry_msgs/msg/Quaternion"
_JOINTS: Final = {
    "sensor_msgs/msg/JointState": frozenset({"position"}),
    "trajectory_msgs/msg/JointTrajectoryPoint": frozenset({"positions"}),
}
_VELOCITIES: Final = frozenset({"linear", "angular", "linear_velocity", "angular_velocity"})
_PLACES: Final = frozenset(
    {"position", "translation", "point", "points", "location", "origin", "center", "centroid"}
)
_GLOBE: Final = frozenset({"latitude", "longitude"})
_ON_THE_GLOBE: Final = frozenset({"sensor_msgs/msg/NavSatFix", "geographic_msgs/msg/GeoPoint"})
_ANGLES: Final = frozenset({"roll", "pitch", "yaw", "theta", "heading", "azimuth", "angle"})
_ENDS_OF_ANGLES: Final = ("_angle", "_yaw", "_heading")


def step_of(path: str, definition: Definition | None) -> Step:
    """Returns how exactly a column of floats is stored.

    Args:
        path: the field, as `pose.pose.position.x`; of elements `<sequence>.<field>`.
        definition: that of the topic.

    Returns:
        0.1 mm for coordinates of points and for vectors that are named as positions are, 0.1 mrad
        for angles and joints, what keeps rotations within 0.1 mrad for quaternions, 1e-9 degree for
        latitude and longitude and 0.1 mm for the altitude beside them, 0.1 mm/s and 0.1 mrad/s for
        velocities; otherwise a millionth of the value.
    """
    around, _, name = path.rpartition(".")
    if name.isdigit() or name in _OF_ARRAYS:
        around, _, name = around.rpartition(".")
    owner = _type_at(around, definition)
    if owner in _JOINTS and name in _JOINTS[owner]:
        return RADIANS
    if name in "xyz":
        return _axis(name, owner, around.rpartition(".")[2])
    if name == "w" and owner == _QUATERNION:
        return QUATERNION
    if name in _GLOBE:
        return DEGREES
    if owner in _ON_THE_GLOBE and name == "altitude":
        return METRES
    return RADIANS if name in _ANGLES or name.endswith(_ENDS_OF_ANGLES) else RELATIVE


def _type_at(path: str, definition: Definition | None) -> str:
    """Returns the type of the message at a path; "" if it is not known."""
    names = path.split(".") if path else []
    fields = fields_at(definition, names)
    if len(fields) < len(names):
        return ""
    kind = fields[-1].kind if fields else definition
    return kind.type if isinstance(kind, Definition) else ""


def _axis(name: str, owner: str, field: str) -> Step:
    """Returns the step of x, y or z.

    Args:
        name: of the axis.
        owner: the type of the message that has the axis.
        field: the name of the field that has this message.
    """
    if owner == _QUATERNION:
        return QUATERNION
    if owner in _POINTS or (owner in _POSES_2D and name != "z"):
        return METRES
    if owner == _VECTOR and field in _PLACES:
        return METRES
    return VELOCITY if owner == _VECTOR and field in _VELOCITIES else RELATIVE


# Columns as bytes


@dataclass(frozen=True, slots=True)
class Packed:
    """A packed column.

    Attributes:
        codec: how `data` is read.
        count: how many values there are.
        zone: of the values before they were rounded.
        error: the greatest absolute error of an unpacked value, as measured; 0.0 if all are exact.
        data: the bytes, not compressed yet; empty if every value is the zone's least.
    """

    codec: str
    count: int
    zone: Zone
    error: float = 0.0
    data: bytes = b""


def pack(column: Column, step: Step = EXACT) -> Packed:
    """Returns the column as bytes; floats are rounded to `step`."""
    if isinstance(column, Texts):
        return _pack_texts(column)
    if not len(column):
        return Packed(f"{column.dtype.name} constant", 0, Zone())
    return _pack_floats(column, step) if column.dtype.kind == "f" else _pack_integers(column)


def unpack(codec: str, count: int, least: float | None, data: bytes) -> Column:
    """Returns a packed column with its dtype; the array may be read-only.

    Args:
        codec: `Packed.codec`.
        count: `Packed.count`.
        least: `Zone.least`.
        data: `Packed.data`.

    Raises:
        ValueError, TypeError, LookupError, ArithmeticError, struct.error: there is no such codec,
            or the bytes are not of it.
    """
    kind, _, rest = codec.partition(" ")
    if kind == "text":
        return _unpack_texts(rest, count, data)
    dtype = np.dtype(kind)
    if rest == "constant":
        value = np.nan if least is None and dtype.kind == "f" else least or 0
        return np.broadcast_to(np.array(value, dtype), count)  # one value in memory
    form, _, arrangement = rest.partition(" ")
    if form == "whole":
        return _whole_numbers(arrangement, count, int(least or 0), data).astype(dtype)
    if form.startswith("/"):
        per_unit = int(form[1:])
        first = round((least or 0.0) * per_unit)
        return (_whole_numbers(arrangement, count, first, data) / per_unit).astype(
            dtype, copy=False
        )
    is_rounded = form == "rounded"
    lowest = int(_ordered(np.array([least], dtype), rounded=is_rounded)[0])
    whole = _whole_numbers(arrangement, count, lowest, data)
    return _from_ordered(whole, dtype, rounded=is_rounded)


class _Codecs(threading.local):
    """A compressor and a decompressor for each thread: creating them takes longer than a column."""

    def __init__(self) -> None:
        self.compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True)
        self.decompressor = zstandard.ZstdDecompressor()


_CODECS: Final = _Codecs()


def compress(data: bytes) -> bytes:
    """Returns the bytes as a zstd frame that states its size and has a checksum."""
    return _CODECS.compressor.compress(data)


def is_large(data: bytes) -> bool:
    """Returns whether a frame states more than `LARGE_BYTES`; False if it states nothing."""
    try:
        return zstandard.frame_content_size(data) > LARGE_BYTES
    except zstandard.ZstdError:
        return False


def decompress(data: bytes) -> bytes:
    """Returns the content of a zstd frame.

    Raises:
        ValueError: it is no zstd frame, or a damaged one.
    """
    try:
        return _CODECS.decompressor.decompress(data)
    except (zstandard.ZstdError, MemoryError) as error:  # a damaged frame may state any size
        raise ValueError(f"packed columns cannot be decompressed: {error}") from error


def _pack_integers(column: Numbers) -> Packed:
    name, least, greatest = column.dtype.name, int(column.min()), int(column.max())
    zone = Zone(least, greatest)
    if least == greatest:
        return Packed(f"{name} constant", len(column), zone)
    # Unsigned ones of 2**63 and more wrap around, here and back.
    numbers = column.reshape(-1).astype(np.int64) - _wrapped(least)
    return _arrange(f"{name} whole", numbers, zone)


# Floats


@np.errstate(invalid="ignore")  # of signalling NaNs
def _pack_floats(column: Numbers, step: Step) -> Packed:
    """Returns a column as multiples of its step, or with fewer bits, or else exactly."""
    values = column.astype(np.float64, copy=False)
    zone = _zone_of(values)
    if zone.least == zone.greatest and zone.nulls in {0, len(column)}:
        return Packed(f"{column.dtype.name} constant", len(column), zone)
    most, limit = max(abs(zone.low), abs(zone.high)), _MOST_MULTIPLES[column.itemsize]
    if zone.nulls or not math.isfinite(most):
        return _exactly(column, zone)
    name = column.dtype.name
    per_unit = _decimal_step(values) if step.relative and most < limit else step.per_unit
    if per_unit and most * per_unit < limit:
        multiples = np.rint(values * per_unit)
        back = (multiples / per_unit).astype(column.dtype, copy=False)
        errors = np.abs(back.astype(np.float64, copy=False) - values)
        if not step.relative or _are_small(errors, values):
            whole = (multiples - multiples.min()).astype(np.int64)
            return _arrange(f"{name} /{per_unit}", whole, zone, float(errors.max()))
    if step.relative:
        whole = _ordered(column, rounded=True)
        back = _from_ordered(whole, column.dtype, rounded=True)
        errors = np.abs(back.astype(np.float64, copy=False) - values)
        if _are_small(errors, values):
            return _arrange(f"{name} rounded", whole - whole.min(), zone, float(errors.max()))
    return _exactly(column, zone)  # tiny numbers have no bits to spare


def _decimal_step(values: Floats) -> int:
    """Returns the coarsest decimal step that a sample of values are multiples of; 0 if none is."""
    sample = values[:: max(1, len(values) // _SAMPLE)]
    scaled = np.multiply.outer(np.array(_DECIMALS, np.float64), sample)
    fits = (np.abs(np.rint(scaled) - scaled) <= MOST_RELATIVE * np.abs(scaled)).all(axis=1)
    return _DECIMALS[int(fits.argmax())] if fits.any() else 0


def _are_small(errors: Floats, values: Floats) -> bool:
    return not (errors > MOST_RELATIVE * np.abs(values)).any()


def _exactly(column: Numbers, zone: Zone) -> Packed:
    whole = _ordered(column)
    return _arrange(f"{column.dtype.name} bits", whole - whole.min(), zone)


def _zone_of(values: Floats) -> Zone:
    numbers = values
    if math.isnan(values.min()):
        numbers = values[~np.isnan(values)]
        if not len(numbers):
            return Zone(nulls=len(values))
    # -0.0 becomes 0.0
    least, greatest = float(numbers.min()) + 0.0, float(numbers.max()) + 0.0
    return Zone(least, greatest, len(values) - len(numbers))


def _ordered(values: Numbers, *, rounded: bool = False) -> IntArray:
    """Returns the bits of floats as integers that are ordered as the floats are.

    NaN is the greatest, and -0.0 becomes 0.0.

    Args:
        values: float32 or float64.
        rounded: whether the lowest bits of the mantissa are dropped.
    """
    integer, magnitude, dropped = _BITS[values.itemsize]
    canonical = np.add(values, 0.0, dtype=values.dtype)  # -0.0 becomes 0.0
    is_nan = np.isnan(canonical)
    if is_nan.any():
        canonical[is_nan] = np.nan  # one for all: some are negative, or carry bits
    bits = canonical.view(integer).astype(np.int64)
    if rounded:
        half = 1 << (dropped - 1)
        bits = (bits + half) >> dropped
        magnitude >>= dropped
    is_negative = bits >> 63  # as a mask: all bits, or none
    return bits ^ (is_negative & magnitude)


def _from_ordered(
    whole: IntArray, dtype: np.dtype[np.generic[object]], *, rounded: bool
) -> Numbers:
    """Returns the floats that `_ordered` turned into integers."""
    integer, magnitude, dropped = _BITS[dtype.itemsize]
    if rounded:
        bits = (whole ^ ((whole >> 63) & (magnitude >> dropped))) << dropped
    else:
        bits = whole ^ ((whole >> 63) & magnitude)
    return bits.astype(integer, copy=False).view(dtype)


# Whole numbers


def _arrange(
    form: str, flat: IntArray, zone: Zone, error: float = 0.0, head: bytes = b""
) -> Packed:
    """Returns whole numbers arranged flat or as differences, whichever takes fewer bits.

    Args:
        form: the first words of the codec.
        flat: the whole numbers; the least of them is 0.
        zone: of the column.
        error: of the column.
        head: bytes before those of the numbers.
    """
    name, written = "flat", flat
    if int(flat.view(np.uint64).max()) < _FAR_APART:
        slope = np.rint((flat[-1:] - flat[:1]) / (len(flat) - 1)).astype(np.int64)
        delta = np.diff(flat) - slope
        step = max(1, len(flat) // _LOOKED_AT)
        if _bits_of(delta[::step]) < _bits_of(flat[::step] - flat.mean()):
            name, head = "delta", head + struct.pack("<q", slope[0])
            written = unsigned(delta)
    width, planes = in_planes(written)
    return Packed(f"{form} {name} {width}", len(flat), zone, error, head + planes)


def _bits_of(numbers: Numbers) -> float:
    """Returns about how many bits numbers take, with their signs."""
    # In single precision and in place: the memory of four such arrays is what takes long.
    sizes = np.abs(numbers.astype(np.float32))
    sizes *= 2
    sizes += 1
    return float(np.log2(sizes, out=sizes).sum(dtype=np.float64))


def _whole_numbers(arrangement: str, count: int, least: int, data: bytes) -> IntArray:
    """Returns the whole numbers of arranged bytes; the least of them is `least`."""
    name, _, width = arrangement.partition(" ")
    if name == "flat":
        return np.add(from_planes(data, 0, count, int(width)).astype(np.int64), _wrapped(least))
    if name != "delta":
        raise ValueError(f"packed columns are not arranged {name!r}")
    slope: int = struct.unpack_from("<q", data)[0]
    numbers = np.zeros(count, np.int64)
    numbers[1:] = signed(from_planes(data, 8, count - 1, int(width)))
    numbers[1:] += slope
    np.cumsum(numbers, out=numbers)
    # Differences wrap around, as those of the packed numbers did.
    lowest: IntArray = numbers.min(keepdims=True)
    numbers += np.subtract(_wrapped(least), lowest)
    return numbers


def unsigned(numbers: IntArray) -> IntArray:
    """Returns signed numbers coded as 0, 1, 2, 3, 4 for 0, -1, 1, -2, 2."""
    return (numbers << 1) ^ (numbers >> 63)


def signed(numbers: Numbers) -> Numbers:
    """Returns the numbers that `unsigned` coded."""
    signs: Numbers = np.negative(np.bitwise_and(numbers, 1).view(f"<i{numbers.itemsize}"))
    return np.bitwise_xor(np.right_shift(numbers, 1).view(signs.dtype), signs)


def _wrapped(number: int) -> np.int64:
    """Returns a number of 64 bits, signed or not, as an int64 with the same bits."""
    return np.int64(number - (1 << 64) if number >= 1 << 63 else number)


def in_planes(numbers: IntArray) -> tuple[int, bytes]:
    """Returns in how many bytes each number fits that has no sign, and their `byte_planes`."""
    greatest = int(numbers.view(np.uint64).max(initial=0))
    width = (greatest.bit_length() + 7) // 8
    return width, byte_planes(numbers, width)


def byte_planes(numbers: IntArray, width: int) -> bytes:
    """Returns the lowest `width` bytes of numbers: first the lowest of each, then the next ones."""
    short = numbers.astype(_CONTAINERS[width], copy=False)
    return short.view(np.uint8).reshape(-1, short.itemsize).T[:width].tobytes()


def from_planes(data: bytes, start: int, count: int, width: int) -> Numbers:
    """Returns the numbers in `byte_planes`, in the smallest unsigned dtype that has `width` bytes.

    Args:
        data: has the planes.
        start: where they begin in it.
        count: how many numbers there are.
        width: how many bytes each has.
    """
    planes = np.frombuffer(data, np.uint8, count * width, start).reshape(width, count)
    numbers = np.zeros(count, _CONTAINERS[width])
    rows = numbers.view(np.uint8).reshape(count, numbers.itemsize)
    for nth, plane in enumerate(planes):
        rows[:, nth] = plane
    return numbers


# Texts


def _pack_texts(column: Texts) -> Packed:
    if not np.bincount(column.codes, minlength=len(column.words)).all():
        # Words of deleted rows must not stay in the file.
        column = column[np.arange(len(column))]
    codes, words = column.codes, column.words
    zone = Zone(words=zone_words(words))
    if not words:
        return Packed("text constant", 0, zone)
    lengths = np.array([len(word) for word in words], "<u4")
    text = "".join(words).encode("utf-8", "surrogatepass")
    head = struct.pack("<II", len(words), len(text)) + lengths.tobytes() + text
    if len(words) == 1:
        return Packed("text constant", len(codes), zone, data=head)
    return _arrange("text", codes.astype(np.int64), zone, head=head)


def zone_words(words: Collection[str]) -> str | None:
    """Returns the words of a zone: whole ones, or the runs of letters in them, or else None.

    Letters alone serve for JSON with numbers, which differs each time but has few names.
    """
    if sum(map(len, words)) + len(words) <= MOST_WORDS_BYTES:
        whole = "\n".join(dict.fromkeys(caseless(word) for word in words))
        # SQLite takes no text with lone surrogates.
        if _is_small(whole) and encodable(whole) == whole:
            return whole
    names = {name for word in words for name in letters_of(caseless(word))}
    in_part = "\n".join([IN_PART, *sorted(names)])
    return in_part if _is_small(in_part) else None


def _is_small(text: str) -> bool:
    return len(text.encode("utf-8", "surrogatepass")) <= MOST_WORDS_BYTES


def _unpack_texts(arrangement: str, count: int, data: bytes) -> Texts:
    if not data and arrangement == "constant":
        return Texts(np.broadcast_to(np.uint32(0), count), ())
    word_count, size = struct.unpack_from("<II", data)
    begin = 8 + 4 * word_count
    text = data[begin : begin + size].decode("utf-8", "surrogatepass")
    edges = [0, *np.cumsum(np.frombuffer(data, "<u4", word_count, 8), dtype=np.int64).tolist()]
    words = tuple(text[start:stop] for start, stop in pairwise(edges))
    if arrangement == "constant":
        return Texts(np.broadcast_to(np.uint32(0), count), words)
    codes = _whole_numbers(arrangement, count, 0, data[begin + size :])
    return Texts(codes.astype(np.uint32), words)

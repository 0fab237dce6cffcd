"""Many messages of one mould read at once: decoded is one of them, of the others only numbers.

Messages that are the same in all bytes but their numbers decode into the same value with other
numbers in it. Which number of the payload stands where in the value is found out by decoding the
first one with marks in the place of its numbers; a value in which anything but the marks changes,
or which is made of several numbers, has no mould, and its messages are decoded one by one.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.conditions import positions
from ros2_memory.core.model import Pose
from ros2_memory.core.timebase import NS_PER_S, unix_from_ns
from ros2_memory.messages.conversions import ANGLES, unit
from ros2_memory.messages.detections import hangs_on_numbers

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue, Quaternion, Vector3
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, CdrLayout, Record

Numbers: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
Bytes: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.uint8]]"

_FIRST_MARKS: Final = (100_000.5, 900_000)
_OTHER_MARKS: Final = (300_000.25, 800_000)


class Place(NamedTuple):
    """The offsets of a point's coordinates; None for one that is missing."""

    x: int
    y: int
    z: int | None


@dataclass(frozen=True, slots=True)
class PayloadTemplate:
    """What is common to all payloads of a mould, and where the rest lies.

    Attributes:
        fixed: for each byte of the payload whether it is common to all.
        layout: where the numbers lie.
        numbers: offsets of the numbers that stand in the value as they are.
        times: offsets of the times that stand in it, in seconds.
        angles: whether angles in degrees stand in it.
        places: where `near_position` looks.
        position: of the pose that it carries; None without one.
        orientation: the offset of that pose's quaternion (x, y, z, w in a row); None without one.
        frame_id: of that pose.
        velocity: the linear velocity that it states; None without one.
        pairs: the frames of all transforms, valid or not.
    """

    fixed: np.ndarray[tuple[int], np.dtype[np.bool_]]
    layout: CdrLayout
    numbers: tuple[int, ...]
    times: tuple[int, ...]
    angles: bool
    places: tuple[Place, ...]
    position: Place | None
    orientation: int | None
    frame_id: str
    velocity: Place | None
    pairs: frozenset[tuple[str, str]]

    def matching(
        self, first: Record, records: Sequence[Record], among: Sequence[int]
    ) -> tuple[list[int], Bytes]:
        """Which of some records are of this mould, as `first` is, and their payloads as rows."""
        fitting = [
            at
            for at in among
            if len(records[at].payload) == self.layout.size and records[at].channel is first.channel
        ]
        rows = rows_of([records[at] for at in fitting], self.layout.size)
        common = np.frombuffer(first.payload, dtype=np.uint8)[self.fixed]
        like = (rows[:, self.fixed] == common).all(axis=1)
        return [at for at, is_like in zip(fitting, like.tolist(), strict=True) if is_like], rows[
            like
        ]

    def poses(self, rows: Bytes) -> Iterator[Pose | None]:
        """The poses of all rows."""
        if self.position is None:
            return repeat(None, len(rows))
        points, rotations = self.points(rows, self.position), self.rotations(rows)
        return (
            Pose(point, rotation, self.frame_id)
            for point, rotation in zip(points, rotations, strict=True)
        )

    def velocities(self, rows: Bytes) -> Sequence[Vector3 | None]:
        """The linear velocities of all rows."""
        if self.velocity is None:
            return [None] * len(rows)
        return self.points(rows, self.velocity)

    def points(self, rows: Bytes, place: Place) -> list[Vector3]:
        """The points at a place, of all rows; NaN for a coordinate that is missing."""
        xs, ys = (self.column(rows, offset).tolist() for offset in (place.x, place.y))
        if place.z is None:
            return [(x, y, math.nan) for x, y in zip(xs, ys, strict=True)]
        return list(zip(xs, ys, self.column(rows, place.z).tolist(), strict=True))

    def rotations(self, rows: Bytes) -> list[Quaternion | None]:
        """The orientations of all rows, as the extractor gives them."""
        if self.orientation is None:
            return [None] * len(rows)
        parts = [self.column(rows, self.orientation + 8 * part).tolist() for part in range(4)]
        return [unit(numbers) for numbers in zip(*parts, strict=True)]

    def column(self, rows: Bytes, offset: int) -> Numbers:
        """The numbers at an offset, of all rows."""
        size, kind = (8, "<f8") if offset in self.layout.doubles else (4, "<f4")
        part = np.ascontiguousarray(rows[:, offset : offset + size])
        column: Numbers = part.view(kind)[:, 0].astype(np.float64)
        return column

    def seconds(self, rows: Bytes, offset: int) -> list[float]:
        """The times at an offset, as the extracted value has them."""
        whole = np.ascontiguousarray(rows[:, offset : offset + 4]).view("<i4")[:, 0].tolist()
        rest = np.ascontiguousarray(rows[:, offset + 4 : offset + 8]).view("<u4")[:, 0].tolist()
        return [unix_from_ns(s * NS_PER_S + n) for s, n in zip(whole, rest, strict=True)]


class _NoTemplateError(Exception):
    """The value is not the same but for its numbers."""


class _Marked:
    """A message with marks in the place of its numbers, and what becomes of them."""

    def __init__(
        self,
        reader: BagReader,
        extractor: SchemaExtractor,
        record: Record,
        layout: CdrLayout,
        marks: tuple[float, int],
    ) -> None:
        payload = bytearray(record.payload)
        self.offset_of: dict[float, int] = {}
        self.time_of: dict[float, int] = {}
        # Halves and quarters, so that a float32 holds them as they are.
        for number, offset in enumerate((*layout.doubles, *layout.singles)):
            mark = marks[0] + number
            struct.pack_into("<d" if offset in layout.doubles else "<f", payload, offset, mark)
            self.offset_of[mark] = offset
        for number, offset in enumerate(layout.times):
            struct.pack_into("<iI", payload, offset, marks[1] + number, 0)
            self.time_of[float(marks[1] + number)] = offset
        marked = record._replace(payload=bytes(payload))
        type_name = record.channel.type
        self.message = reader.decode(marked)
        self.value = extractor.exact(self.message, type_name)
        self.pose = extractor.pose(self.message, type_name)
        self.twist = extractor.twist(self.message, type_name)
        self.transforms = extractor.transforms(self.message, record.log_time, static=False)

    def orientation(self) -> int | None:
        """The offset of the pose's quaternion; None where it has no orientation."""
        if self.pose is None or self.pose.orientation is None:
            return None
        mark_at = {offset: mark for mark, offset in self.offset_of.items()}
        for offset in mark_at:
            marks = [mark_at.get(offset + 8 * part) for part in range(4)]
            x, y, z, w = marks
            if x is None or y is None or z is None or w is None:
                continue
            if unit((x, y, z, w)) == self.pose.orientation:
                return offset
        raise _NoTemplateError

    def place(self, point: Vector3) -> Place:
        x, y, z = (None if math.isnan(part) else self.offset_of.get(part, -1) for part in point)
        if x is None or y is None or -1 in {x, y, z}:
            raise _NoTemplateError
        return Place(x, y, z)


def template_for(
    reader: BagReader, extractor: SchemaExtractor, record: Record
) -> PayloadTemplate | None:
    """The mould of a message that can be decoded; None where it has none."""
    layout = reader.layout(record)
    if layout is None:
        return None
    one, other = (
        _Marked(reader, extractor, record, layout, marks) for marks in (_FIRST_MARKS, _OTHER_MARKS)
    )
    try:
        return _mould(layout, one, other)
    # Two values that are not even of one shape have leaves that do not pair.
    except (_NoTemplateError, ValueError):
        return None


def _shown_numbers(one: _Marked, other: _Marked) -> tuple[list[int], list[int], bool]:
    """Offsets of the numbers and of the times in the value, and whether angles stand in it.

    Raises:
        _NoMouldError: something else differs.
    """
    numbers: list[int] = []
    times: list[int] = []
    angles = False
    for (key, leaf), (_, again) in zip(_leaves(one.value), _leaves(other.value), strict=True):
        if not isinstance(leaf, float) or not isinstance(again, float):
            if leaf != again:
                raise _NoTemplateError
        elif leaf in one.offset_of and other.offset_of.get(again) == one.offset_of[leaf]:
            numbers.append(one.offset_of[leaf])
        elif leaf in one.time_of and other.time_of.get(again) == one.time_of[leaf]:
            times.append(one.time_of[leaf])
        elif key in ANGLES:
            angles = True
        else:
            raise _NoTemplateError
    return numbers, times, angles


def _fixed(layout: CdrLayout) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """For each byte whether it is none of a number's."""
    fixed = np.ones(layout.size, dtype=np.bool_)
    for offset in (*layout.doubles, *layout.times):
        fixed[offset : offset + 8] = False
    for offset in layout.singles:
        fixed[offset : offset + 4] = False
    return fixed


def _mould(layout: CdrLayout, one: _Marked, other: _Marked) -> PayloadTemplate:
    if hangs_on_numbers(one.value):
        raise _NoTemplateError
    numbers, times, angles = _shown_numbers(one, other)
    places = tuple(one.place(point) for point in positions(one.value))
    pose = None if one.pose is None else one.place(one.pose.position)
    twist = None if one.twist is None else one.place(one.twist.linear)
    orientation = one.orientation()
    if orientation != other.orientation() or (
        orientation is not None and orientation not in layout.doubles
    ):
        raise _NoTemplateError
    if places != tuple(other.place(point) for point in positions(other.value)):
        raise _NoTemplateError
    return PayloadTemplate(
        fixed=_fixed(layout),
        layout=layout,
        numbers=tuple(numbers),
        times=tuple(times),
        angles=angles,
        places=places,
        position=pose,
        orientation=orientation,
        frame_id="" if one.pose is None else one.pose.frame_id,
        velocity=twist,
        pairs=frozenset((each.parent, each.child) for each in one.transforms),
    )


def rows_of(records: Sequence[Record], size: int) -> Bytes:
    """The payloads as rows of bytes; they must all be of this size."""
    rows: Bytes = np.frombuffer(b"".join(each.payload for each in records), dtype=np.uint8).reshape(
        len(records), size
    )
    return rows


def _leaves(value: JsonValue, key: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Everything that is neither list nor object, with the name that it stands under."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, name)
    elif isinstance(value, list):
        for inner in value:
            yield from _leaves(inner, key)
    else:
        yield key, value

"""Where the numbers of a message lie in its payload, and where each goes in its value.

Messages that are equal in all bytes but their numbers decode into equal values with other numbers
in them. Which number of the payload goes where in the value is found by decoding a message with
marks in place of its numbers. A value in which anything but the marks changes, or which is computed
from several numbers, has no template.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from itertools import repeat
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.conditions import positions
from ros2_memory.core.model import Pose
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.messages.conversions import ANGLES, unit
from ros2_memory.messages.detections import depends_on_numbers
from ros2_memory.messages.json_template import Marks

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue, Quaternion, Vector3
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.messages.json_template import JsonTemplate
    from ros2_memory.storage.base import BagReader, CdrLayout, Record, Schema

Numbers: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
Block: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.float64]]"
Times: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.int64]]"
Mask: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.bool_]]"
Bytes: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.uint8]]"

# Halves and quarters, so that a float32 holds them exactly. Two sets of marks: a number of the
# message that happens to equal a mark of one set does not equal that of the other.
_FIRST_MARKS: Final = (100_000.5, 900_000)
_OTHER_MARKS: Final = (300_000.25, 800_000)

_DOUBLE: Final = struct.Struct("<d")
_SINGLE: Final = struct.Struct("<f")
_MAX_KNOWN: Final = 512
_MAX_KNOWN_BYTES: Final = 16 << 10
"""Of the payloads whose templates are remembered."""


class PointOffsets(NamedTuple):
    """The offsets of a point's coordinates in the payload; None for one that is missing."""

    x: int
    y: int
    z: int | None


@dataclass(frozen=True, slots=True)
class PayloadTemplate:
    """What is common to all payloads of a template, and where the numbers are.

    Attributes:
        type_name: of the messages.
        fixed: for each byte of the payload whether it is common to all.
        layout: where the numbers are.
        numbers: offsets of the numbers that are in the value unchanged.
        fields: the offsets of the numbers of each field, which is a dot-path.
        constants: fields of other numbers, which are in every value.
        times: the offsets of the times of each field, which is in seconds in the value.
        angles: fields of angles in degrees, which are computed of several numbers.
        points: the positions that `near_position` tests.
        position: of the pose that the message carries; None without one.
        orientation: the offset of that pose's quaternion (x, y, z, w in a row); None without one.
        frame_id: of that pose.
    """

    type_name: str
    fixed: Mask
    layout: CdrLayout
    numbers: tuple[int, ...]
    fields: tuple[tuple[str, tuple[int, ...]], ...]
    constants: tuple[tuple[str, tuple[int, ...]], ...]
    times: tuple[tuple[str, tuple[int, ...]], ...]
    angles: tuple[str, ...]
    points: tuple[PointOffsets, ...]
    position: PointOffsets | None
    orientation: int | None
    frame_id: str

    def matching(
        self, first: Record, records: Sequence[Record], among: Sequence[int]
    ) -> tuple[list[int], Bytes]:
        """Returns the indices of records that match the template as `first` does, and their rows.

        A row is the payload of one record.
        """
        size, channel = self.layout.size, first.channel
        candidates = [
            at
            for at in among
            if len((record := records[at]).payload) == size and record.channel is channel
        ]
        payloads = b"".join([records[at].payload for at in candidates])
        rows = np.frombuffer(payloads, dtype=np.uint8).reshape(len(candidates), size)
        # Picking the fixed bytes of each row would take several times as long.
        other = rows != np.frombuffer(first.payload, dtype=np.uint8)
        equal = ~(other & self.fixed).any(axis=1)
        if equal.all():
            return candidates, rows
        return [candidates[at] for at in np.flatnonzero(equal).tolist()], rows[equal]

    def poses(self, rows: Bytes) -> Iterable[Pose | None]:
        """Returns the pose of each row."""
        if self.position is None:
            return repeat(None, len(rows))
        points, rotations = self.coordinates(rows, self.position), self._rotations(rows)
        return (
            Pose(point, rotation, self.frame_id)
            for point, rotation in zip(points, rotations, strict=True)
        )

    def coordinates(self, rows: Bytes, point: PointOffsets) -> list[Vector3]:
        """Returns one point of each row; NaN for a coordinate that is missing."""
        xs, ys = (self.column(rows, offset).tolist() for offset in (point.x, point.y))
        if point.z is None:
            return [(x, y, math.nan) for x, y in zip(xs, ys, strict=True)]
        return list(zip(xs, ys, self.column(rows, point.z).tolist(), strict=True))

    def points_in(self, payload: bytes) -> Iterator[Vector3]:
        """Yields the positions in one payload that `near_position` tests, as `positions` does."""
        for point in self.points:
            x, y, z = (
                math.nan if offset is None else self._number(payload, offset) for offset in point
            )
            yield x, y, z

    def _number(self, payload: bytes, offset: int) -> float:
        number: float
        [number] = (_DOUBLE if offset in self.layout.doubles else _SINGLE).unpack_from(
            payload, offset
        )
        return number

    def _rotations(self, rows: Bytes) -> list[Quaternion | None]:
        """Returns the orientation of each row, as the extractor gives it."""
        if self.orientation is None:
            return [None] * len(rows)
        parts = [self.column(rows, self.orientation + 8 * part).tolist() for part in range(4)]
        return [unit(numbers) for numbers in zip(*parts, strict=True)]

    def column(self, rows: Bytes, offset: int) -> Numbers:
        """Returns the number at an offset, of each row."""
        size, number = (8, "<f8") if offset in self.layout.doubles else (4, "<f4")
        part = np.ascontiguousarray(rows[:, offset : offset + size])
        column: Numbers = part.view(number)[:, 0].astype(np.float64)
        return column

    def block(self, rows: Bytes, offsets: Sequence[int]) -> Block:
        """Returns the numbers at some offsets, as a row for each row."""
        step = 8 if offsets[0] in self.layout.doubles else 4
        if len(offsets) > 1 and [*offsets] == [*range(offsets[0], offsets[-1] + 1, step)]:
            part = np.ascontiguousarray(rows[:, offsets[0] : offsets[-1] + step])
            block: Block = part.view("<f8" if step == 8 else "<f4").astype(np.float64)
            return block
        return np.stack([self.column(rows, offset) for offset in offsets], axis=1)

    def nanoseconds(self, rows: Bytes, offset: int) -> Times:
        """Returns the time at an offset, of each row."""
        parts = np.ascontiguousarray(rows[:, offset : offset + 8]).view(
            [("s", "<i4"), ("n", "<u4")]
        )[:, 0]
        times: Times = parts["s"].astype(np.int64) * NS_PER_S + parts["n"]
        return times


class _NoTemplateError(Exception):
    """The value differs by more than its numbers."""


class _Marked:
    """A message with marks in place of its numbers, and what is extracted from it."""

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
        for mark, offset in enumerate((*layout.doubles, *layout.singles)):
            number_format = "<d" if offset in layout.doubles else "<f"
            struct.pack_into(number_format, payload, offset, marks[0] + mark)
            self.offset_of[marks[0] + mark] = offset
        for second, offset in enumerate(layout.times, marks[1]):
            struct.pack_into("<iI", payload, offset, second, 0)
            self.time_of[float(second)] = offset
        type_name = record.channel.type
        self.message = message = reader.decode(record._replace(payload=bytes(payload)))
        self.value = extractor.exact(message, type_name)
        self.pose = extractor.pose(message, type_name)

    def orientation(self) -> int | None:
        """Returns the offset of the pose's quaternion; None where it has no orientation."""
        if self.pose is None or self.pose.orientation is None:
            return None
        return self._offset_of_rotation(self.pose.orientation)

    def _offset_of_rotation(self, rotation: Quaternion) -> int:
        mark_at = {offset: mark for mark, offset in self.offset_of.items()}
        for offset in mark_at:
            x, y, z, w = (mark_at.get(offset + 8 * part, math.nan) for part in range(4))
            if unit((x, y, z, w)) == rotation:
                return offset
        raise _NoTemplateError

    def offsets(self, point: Vector3) -> PointOffsets:
        """Returns the offsets of a point of the value."""
        x, y, z = (None if math.isnan(part) else self.offset_of.get(part, -1) for part in point)
        if x is None or y is None or -1 in {x, y, z}:
            raise _NoTemplateError
        return PointOffsets(x, y, z)

    def points(self) -> tuple[PointOffsets, ...]:
        """Returns the offsets of the positions that `near_position` tests."""
        return tuple(self.offsets(point) for point in positions(self.value))


def template_for(
    reader: BagReader, extractor: SchemaExtractor, record: Record
) -> PayloadTemplate | None:
    """Returns the template of a message that can be decoded; None where it has none."""
    layout = reader.layout(record)
    return None if layout is None else _marked_template(reader, extractor, record, layout)


def json_template_for(
    reader: BagReader,
    extractor: SchemaExtractor,
    record: Record,
    template: PayloadTemplate,
) -> JsonTemplate | None:
    """Returns the JSON of all messages of a template, as a reply shows them; else None."""
    one, other = (
        extractor.json_template(
            each.message, record.channel.type, Marks(each.offset_of, each.time_of)
        )
        for each in _marked(reader, extractor, record, template.layout)
    )
    return one if one == other else None


def _marked(
    reader: BagReader, extractor: SchemaExtractor, record: Record, layout: CdrLayout
) -> tuple[_Marked, _Marked]:
    """Returns a message with marks, and with others."""
    return (
        _Marked(reader, extractor, record, layout, _FIRST_MARKS),
        _Marked(reader, extractor, record, layout, _OTHER_MARKS),
    )


class _KnownTemplate(NamedTuple):
    """A template, or that there is none: of all payloads with these bytes outside the numbers."""

    fixed: Mask
    common: bytes
    template: PayloadTemplate | None


class Templates:
    """Finds templates, and remembers them, since nearly every bag has the same messages."""

    def __init__(self, reader: BagReader, extractor: SchemaExtractor) -> None:
        self._reader = reader
        self._extractor = extractor
        self._known: dict[tuple[Schema, int], list[_KnownTemplate]] = {}
        self._count = 0

    def of(self, record: Record) -> PayloadTemplate | None:
        """Returns the template of a message that can be decoded; None where it has none."""
        met = self._met(record)
        if met is not None:
            return met.template
        layout = self._reader.layout(record)
        if layout is None:
            return None
        template = _marked_template(self._reader, self._extractor, record, layout)
        if layout.size <= _MAX_KNOWN_BYTES:
            if self._count == _MAX_KNOWN:
                self._known, self._count = {}, 0
            fixed = _fixed(layout)
            common = np.frombuffer(record.payload, np.uint8)[fixed].tobytes()
            known_ones = self._known.setdefault((record.channel.schema, layout.size), [])
            known_ones.append(_KnownTemplate(fixed, common, template))
            self._count += 1
        return template

    def known(self, record: Record) -> PayloadTemplate | None:
        """Returns the template of a message; None where `of` was asked of none like it."""
        met = self._met(record)
        return None if met is None else met.template

    def _met(self, record: Record) -> _KnownTemplate | None:
        known = self._known.get((record.channel.schema, len(record.payload)), ())
        payload = np.frombuffer(record.payload, np.uint8)
        for each in known:
            if payload[each.fixed].tobytes() == each.common:
                return each
        return None


def _marked_template(
    reader: BagReader, extractor: SchemaExtractor, record: Record, layout: CdrLayout
) -> PayloadTemplate | None:
    try:
        return _template(record.channel.type, layout, *_marked(reader, extractor, record, layout))
    # Two values of different structure have leaves that do not pair, which zip reports.
    except (_NoTemplateError, ValueError):
        return None


def _fixed(layout: CdrLayout) -> Mask:
    """Returns for each byte of a payload whether it is outside of all numbers."""
    fixed = np.ones(layout.size, dtype=np.bool_)
    for offset in (*layout.doubles, *layout.times):
        fixed[offset : offset + 8] = False
    for offset in layout.singles:
        fixed[offset : offset + 4] = False
    return fixed


def _template(type_name: str, layout: CdrLayout, one: _Marked, other: _Marked) -> PayloadTemplate:
    if depends_on_numbers(one.value):
        raise _NoTemplateError
    found = _numbers_in_value(one, other)
    points, orientation = one.points(), one.orientation()
    if points != other.points() or orientation != other.orientation():
        raise _NoTemplateError
    return PayloadTemplate(
        type_name=type_name,
        fixed=_fixed(layout),
        layout=layout,
        numbers=tuple(offset for offset, _ in found.numbers),
        fields=_by_field((path, offset) for offset, path in found.numbers),
        constants=_by_field(found.constants),
        times=_by_field((path, offset) for offset, path in found.times),
        angles=tuple(dict.fromkeys(found.angles)),
        points=points,
        position=None if one.pose is None else one.offsets(one.pose.position),
        orientation=orientation,
        frame_id="" if one.pose is None else one.pose.frame_id,
    )


def _by_field(found: Iterable[tuple[str, int]]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    by_field: dict[str, list[int]] = {}
    for path, number in found:
        by_field.setdefault(path, []).append(number)
    return tuple((path, tuple(some)) for path, some in by_field.items())


class _Found(NamedTuple):
    """The numbers in a value: offset and field, field and number, offset and field of times."""

    numbers: list[tuple[int, str]]
    constants: list[tuple[str, int]]
    times: list[tuple[int, str]]
    angles: list[str]


def _numbers_in_value(one: _Marked, other: _Marked) -> _Found:
    """Returns which numbers of the payload, and which others, are in the value.

    Raises:
        _NoTemplateError: something else differs.
    """
    found = _Found([], [], [], [])
    for (path, leaf), (_, again) in zip(_leaves(one.value), _leaves(other.value), strict=True):
        if not isinstance(leaf, float) or not isinstance(again, float):
            if leaf != again:
                raise _NoTemplateError
            if isinstance(leaf, int) and not isinstance(leaf, bool):
                found.constants.append((path, leaf))
        elif leaf in one.offset_of and other.offset_of.get(again) == one.offset_of[leaf]:
            found.numbers.append((one.offset_of[leaf], path))
        elif leaf in one.time_of and other.time_of.get(again) == one.time_of[leaf]:
            found.times.append((one.time_of[leaf], path))
        elif path.rpartition(".")[2] in ANGLES:
            found.angles.append(path)
        else:
            raise _NoTemplateError
    return found


def _leaves(value: JsonValue, path: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Yields everything that is neither list nor object, with its field."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, joined(path, name))
    elif isinstance(value, list):
        for inner in value:
            yield from _leaves(inner, path)
    else:
        yield path, value


@lru_cache(4096)
def joined(path: str, name: str) -> str:
    """Returns the dot-path of a key below another."""
    if name.removeprefix("-").isdecimal():
        return path
    plain = name.replace(".", "\0")  # no dot-path leads there
    return f"{path}.{plain}" if path else plain

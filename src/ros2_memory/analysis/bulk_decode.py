"""Decodes many equally laid out messages at once: one of them by rosbags, the others by offset.

Messages that are equal in all bytes but their numbers decode into equal values with other numbers
in them. Which number of the payload goes where in the value is found by decoding the first message
with marks in place of its numbers. A value in which anything but the marks changes, or which is
computed from several numbers, has no template, and its messages are decoded one by one.

`rosbags` needs 7.6 µs to decode an Odometry message; its position by offset takes 0.74 µs
(benchmarks/motion.py).
"""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from ros2_memory.analysis.conditions import positions
from ros2_memory.analysis.field_ranges import joined
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import Pose
from ros2_memory.core.timebase import NS_PER_S, unix_from_ns
from ros2_memory.messages.conversions import ANGLES, unit
from ros2_memory.messages.detections import depends_on_numbers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue, Quaternion, StampedTransform, Vector3
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, CdrLayout, Record

Numbers: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
Block: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.float64]]"
Times: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.int64]]"
Bytes: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.uint8]]"

# Halves and quarters, so that a float32 holds them exactly. Two sets of marks: a number of the
# message that happens to equal a mark of one set does not equal that of the other.
_FIRST_MARKS: Final = (100_000.5, 900_000)
_OTHER_MARKS: Final = (300_000.25, 800_000)

_FEWEST: Final = 32
"""Messages below which decoding them one by one costs no more than finding a template."""
_MIN_MATCHES: Final = 8
"""A template that matches fewer messages costs more than it saves."""
_MAX_TEMPLATES: Final = 8

T = TypeVar("T")


class PointOffsets(NamedTuple):
    """The offsets of a point's coordinates in the payload; None for one that is missing."""

    x: int
    y: int
    z: int | None


class TransformOffsets(NamedTuple):
    """The frames of a transform, and the offsets of its numbers in the payload."""

    parent: str
    child: str
    stamp: int
    numbers: tuple[int, ...]
    """Of x, y, z of the translation and of x, y, z, w of the rotation."""


@dataclass(frozen=True, slots=True)
class PayloadTemplate:
    """What is common to all payloads of a template, and where the numbers are.

    Attributes:
        type_name: of the messages.
        fixed: for each byte of the payload whether it is common to all.
        layout: where the numbers are.
        numbers: offsets of the numbers that are in the value unchanged.
        names: the key of each of these.
        fields: the offsets of the numbers of each field, which is a dot-path.
        constants: fields of other numbers, which are in every value.
        computed: fields of times and angles.
        times: offsets of the times that are in it, in seconds.
        angles: whether angles in degrees are in it.
        points: the positions that `near_position` tests.
        position: of the pose that the message carries; None without one.
        orientation: the offset of that pose's quaternion (x, y, z, w in a row); None without one.
        frame_id: of that pose.
        velocity: the linear velocity that it states; None without one.
        pairs: the frames of all transforms, valid or not.
        transforms: all of them, in order.
    """

    type_name: str
    fixed: np.ndarray[tuple[int], np.dtype[np.bool_]]
    layout: CdrLayout
    numbers: tuple[int, ...]
    names: tuple[str, ...]
    fields: tuple[tuple[str, tuple[int, ...]], ...]
    constants: tuple[tuple[str, tuple[int, ...]], ...]
    computed: tuple[str, ...]
    times: tuple[int, ...]
    angles: bool
    points: tuple[PointOffsets, ...]
    position: PointOffsets | None
    orientation: int | None
    frame_id: str
    velocity: PointOffsets | None
    pairs: frozenset[tuple[str, str]]
    transforms: tuple[TransformOffsets, ...] = ()

    def matching(
        self, first: Record, records: Sequence[Record], among: Sequence[int]
    ) -> tuple[list[int], Bytes]:
        """Returns the indices of records that match the template as `first` does, and their rows.

        A row is the payload of one record.
        """
        candidates = [
            at
            for at in among
            if len(records[at].payload) == self.layout.size and records[at].channel is first.channel
        ]
        payloads = b"".join(records[at].payload for at in candidates)
        rows = np.frombuffer(payloads, dtype=np.uint8).reshape(len(candidates), self.layout.size)
        common = np.frombuffer(first.payload, dtype=np.uint8)[self.fixed]
        equal = (rows[:, self.fixed] == common).all(axis=1)
        return [candidates[at] for at in np.flatnonzero(equal)], rows[equal]

    def poses(self, rows: Bytes) -> Iterable[Pose | None]:
        """Returns the pose of each row."""
        if self.position is None:
            return repeat(None, len(rows))
        points, rotations = self.coordinates(rows, self.position), self._rotations(rows)
        return (
            Pose(point, rotation, self.frame_id)
            for point, rotation in zip(points, rotations, strict=True)
        )

    def speeds(self, rows: Bytes) -> list[float | None]:
        """Returns the linear speed (m/s) that each row states."""
        if self.velocity is None:
            return [None] * len(rows)
        return [math.hypot(*each) for each in self.coordinates(rows, self.velocity)]

    def coordinates(self, rows: Bytes, point: PointOffsets) -> list[Vector3]:
        """Returns one point of each row; NaN for a coordinate that is missing."""
        xs, ys = (self.column(rows, offset).tolist() for offset in (point.x, point.y))
        if point.z is None:
            return [(x, y, math.nan) for x, y in zip(xs, ys, strict=True)]
        return list(zip(xs, ys, self.column(rows, point.z).tolist(), strict=True))

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

    def seconds(self, rows: Bytes, offset: int) -> list[float]:
        """Returns the time at an offset, of each row, as the extracted value has it."""
        return [unix_from_ns(each) for each in self.nanoseconds(rows, offset).tolist()]

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
        message = reader.decode(record._replace(payload=bytes(payload)))
        self.value = extractor.exact(message, type_name)
        self.pose = extractor.pose(message, type_name)
        self.twist = extractor.twist(message, type_name)
        self.transforms = extractor.transforms(message, record.log_time, static=False)

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

    def transform_offsets(self) -> tuple[TransformOffsets, ...]:
        """Returns where the numbers of all transforms are."""
        return tuple(map(self._transform_offsets, self.transforms))

    def _transform_offsets(self, each: StampedTransform) -> TransformOffsets:
        x, y, z = (self.offset_of.get(part, -1) for part in each.transform.translation)
        turn = self._offset_of_rotation(each.transform.rotation)
        stamp = self.time_of.get(unix_from_ns(each.stamp), -1)
        if -1 in {x, y, z, stamp}:
            raise _NoTemplateError
        numbers = (x, y, z, *(turn + 8 * part for part in range(4)))
        return TransformOffsets(each.parent, each.child, stamp, numbers)

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
    if layout is None:
        return None
    one, other = (
        _Marked(reader, extractor, record, layout, marks) for marks in (_FIRST_MARKS, _OTHER_MARKS)
    )
    try:
        return _template(record.channel.type, layout, one, other)
    # Two values of different structure have leaves that do not pair, which zip reports.
    except (_NoTemplateError, ValueError):
        return None


def _template(type_name: str, layout: CdrLayout, one: _Marked, other: _Marked) -> PayloadTemplate:
    if depends_on_numbers(one.value):
        raise _NoTemplateError
    found = _numbers_in_value(one, other)
    angles = any(path.rpartition(".")[2] in ANGLES for path in found.computed)
    by_field: dict[str, list[int]] = {}
    for offset, path in found.numbers:
        by_field.setdefault(path, []).append(offset)
    constants: dict[str, list[int]] = {}
    for path, number in found.constants:
        constants.setdefault(path, []).append(number)
    points, orientation = one.points(), one.orientation()
    if points != other.points() or orientation != other.orientation():
        raise _NoTemplateError
    transforms = one.transform_offsets()
    if transforms != other.transform_offsets():
        raise _NoTemplateError
    fixed = np.ones(layout.size, dtype=np.bool_)
    for offset in (*layout.doubles, *layout.times):
        fixed[offset : offset + 8] = False
    for offset in layout.singles:
        fixed[offset : offset + 4] = False
    return PayloadTemplate(
        type_name=type_name,
        fixed=fixed,
        layout=layout,
        numbers=tuple(offset for offset, _ in found.numbers),
        names=tuple(path.rpartition(".")[2] for _, path in found.numbers),
        fields=tuple((path, tuple(offsets)) for path, offsets in by_field.items()),
        constants=tuple((path, tuple(some)) for path, some in constants.items()),
        computed=tuple(dict.fromkeys(found.computed)),
        times=tuple(found.times),
        angles=angles,
        points=points,
        position=None if one.pose is None else one.offsets(one.pose.position),
        orientation=orientation,
        frame_id="" if one.pose is None else one.pose.frame_id,
        velocity=None if one.twist is None else one.offsets(one.twist.linear),
        pairs=frozenset((each.parent, each.child) for each in one.transforms),
        transforms=transforms,
    )


class _Found(NamedTuple):
    """The numbers in a value: offset and field, field and number, offsets of times, fields."""

    numbers: list[tuple[int, str]]
    constants: list[tuple[str, int]]
    times: list[int]
    computed: list[str]


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
            found.times.append(one.time_of[leaf])
            found.computed.append(path)
        elif path.rpartition(".")[2] in ANGLES:
            found.computed.append(path)
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


class BulkDecoder(Generic[T]):
    """Decodes the messages of one topic in batches; templates found in one serve the next.

    Args:
        decode: decodes one message; may raise UndecodableError.
        template: the template of a message that was decoded; None where it has none.
        apply: what messages decode into, by their template, what its first message decoded into,
            and their payloads as rows.
    """

    def __init__(
        self,
        decode: Callable[[Record], T],
        template: Callable[[Record], PayloadTemplate | None],
        apply: Callable[[PayloadTemplate, T, Sequence[Record], Bytes], Iterable[T]],
    ) -> None:
        self._decode = decode
        self._template = template
        self._apply = apply
        self._known: list[tuple[PayloadTemplate, Record, T]] = []
        self._may_learn = True

    def decode(self, records: Sequence[Record]) -> list[T | UndecodableError]:
        """Returns what each message decodes into, or why it cannot be decoded."""
        found: dict[int, T | UndecodableError] = {}
        rest = deque(range(len(records)))
        for known in self._known:
            rest = self._match(known, records, rest, found)
        while rest:
            record = records[at := rest.popleft()]
            try:
                decoded = self._decode(record)
            except UndecodableError as error:
                # Made anew, since the one that was raised keeps the message by its traceback.
                found[at] = UndecodableError(error.topic, error.type_name, error.reason)
                continue
            found[at] = decoded
            if not self._may_learn or len(rest) < _FEWEST:
                continue
            template, before = self._template(record), len(rest)
            if template is not None:
                rest = self._match((template, record, decoded), records, rest, found)
            # The first template that does not pay is the last one that is looked for.
            self._may_learn = before - len(rest) >= _MIN_MATCHES
            if template is not None and self._may_learn:
                self._known.append((template, record, decoded))
                self._may_learn = len(self._known) < _MAX_TEMPLATES
        return [found[at] for at in range(len(records))]

    def _match(
        self,
        known: tuple[PayloadTemplate, Record, T],
        records: Sequence[Record],
        rest: deque[int],
        found: dict[int, T | UndecodableError],
    ) -> deque[int]:
        """Decodes those of `rest` that match a template; returns the others."""
        template, first, decoded = known
        matched, rows = template.matching(first, records, rest)
        if not matched:
            return rest
        among = [records[at] for at in matched]
        found.update(zip(matched, self._apply(template, decoded, among, rows), strict=True))
        return deque(at for at in rest if at not in found)


class MotionSample(NamedTuple):
    """The pose of one message and the speed that it states; None where it has none."""

    pose: Pose | None
    speed_mps: float | None


def motion_decoder(reader: BagReader, extractor: SchemaExtractor) -> BulkDecoder[MotionSample]:
    """Returns a decoder of poses and speeds of one topic, equal to the extractor's one by one."""

    def decode(record: Record) -> MotionSample:
        return motion_sample(extractor, reader.decode(record), record.channel.type)

    return BulkDecoder(decode, partial(template_for, reader, extractor), _motion_samples)


def motion_sample(extractor: SchemaExtractor, message: object, type_name: str) -> MotionSample:
    """Returns the pose and speed of a decoded message."""
    twist = extractor.twist(message, type_name)
    speed_mps = None if twist is None else math.hypot(*twist.linear)
    return MotionSample(extractor.pose(message, type_name), speed_mps)


def _motion_samples(
    template: PayloadTemplate, _: MotionSample, _records: Sequence[Record], rows: Bytes
) -> Iterable[MotionSample]:
    return map(MotionSample, template.poses(rows), template.speeds(rows))

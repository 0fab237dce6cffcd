"""Encodes digests as the bytes and texts in the catalogue. Exact: floats stay bit by bit.

All integers and floats are little-endian. The layouts belong to the catalogue's schema version.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.odometry import Leg, MotionTotals, NearbyMotion, PoseDigest, TimedPosition
from ros2_memory.analysis.path_length import Creep, End
from ros2_memory.analysis.standstills import ChainDigest, StandstillDigest
from ros2_memory.analysis.topic_events import KnownFlag, ReportedError, Toggle, TopicEvents
from ros2_memory.core.bag_summary import TopicHeader, shared_schema

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.odometry import Vertex
    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import JsonValue

_HEAD: Final = struct.Struct("<qqqqqqBdddddddqdddqddd")
_LEG: Final = struct.Struct("<qdddqdddqqddBdddddddd")
_CREEP: Final = struct.Struct("<ddddddddddd")
_VERTEX: Final = struct.Struct("<qdddd")
_EVENTS: Final = struct.Struct("<qqqqqI")
_MIN_COMPRESSED_BYTES: Final = 256
"""A shorter text is not worth compressing."""
_NOWHERE: Final[Vertex] = (0, (math.nan, math.nan, math.nan), None)


def encode_poses(poses: PoseDigest) -> bytes:
    """Encodes a digest of poses."""
    totals = poses.totals
    legs = [leg for leg in (totals.head, totals.tail) if leg is not None]
    ends = (poses.vertices[0], poses.vertices[-1]) if poses.vertices else (_NOWHERE, _NOWHERE)
    head = _HEAD.pack(
        poses.poses,
        poses.invalid,
        totals.jumps,
        totals.gaps,
        len(totals.resets),
        len(poses.vertices),
        len(legs),
        totals.length_m,
        totals.sum_m,
        totals.jumped_m,
        totals.gap_m,
        math.nan if totals.speed_mps is None else totals.speed_mps,
        math.nan if poses.twist is None else poses.twist,
        poses.error_m,
        *(number for time, position, _ in ends for number in (time, *position)),
    )
    vertices = b"".join(
        _VERTEX.pack(time, *position, turn if isinstance(turn, float) else math.nan)
        for time, position, turn in poses.vertices
    )
    resets = struct.pack(f"<{len(totals.resets)}q", *totals.resets)
    frames = json.dumps(poses.frames).encode()
    return b"".join((head, *map(_encode_leg, legs), resets, vertices, frames))


def _encode_leg(leg: Leg) -> bytes:
    ends = (leg.head,) if leg.still else (leg.head, leg.tail)
    creeps = [end.creep for end in ends]
    flags = leg.still | leg.head.plain << 1 | leg.tail.plain << 2
    for place, creep in enumerate(creeps):
        flags |= (creep is not None) << 3 + place
    packed = _LEG.pack(
        leg.first.time,
        *leg.first.position,
        leg.last.time,
        *leg.last.position,
        leg.poses,
        -1 if leg.period_ns is None else leg.period_ns,
        leg.length_m,
        leg.sum_m,
        flags,
        leg.head.pace_m,
        leg.head.noise_m,
        leg.tail.pace_m,
        leg.tail.noise_m,
        *leg.near_first,
        *leg.near_last,
    )
    return packed + b"".join(
        _CREEP.pack(
            *creep.start,
            *((math.nan,) * 3 if creep.second is None else creep.second),
            creep.middle_m,
            *creep.end,
            creep.reach_m,
        )
        for creep in creeps
        if creep is not None
    )


def decode_poses(packed: bytes) -> PoseDigest:
    """Decodes a digest of poses.

    Raises:
        ValueError: the bytes are not one.
    """
    try:
        return _decode_poses(packed)
    except struct.error as error:
        raise ValueError(f"not a digest of poses: {error}") from error


def encode_standstills(digest: StandstillDigest) -> bytes:
    """Encodes a digest of standstills."""
    chains = [[each.start, each.end, len(each.blocks)] for each in digest.chains]
    head, tail = digest.head, digest.tail
    sizes = json.dumps([len(head), digest.head_until, len(tail), digest.tail_since, chains])
    parts = (sizes.encode(), b"\n", head, tail, *(each.blocks for each in digest.chains))
    return zlib.compress(b"".join(parts))


def decode_standstills(packed: bytes) -> StandstillDigest:
    """Decodes a digest of standstills.

    Raises:
        ValueError: the bytes are not one.
    """
    try:
        sizes, _, body = zlib.decompress(packed).partition(b"\n")
        head, head_until, tail, tail_since, chains = json.loads(sizes)
        at = head + tail
        unpacked = []
        for start, end, size in chains:
            unpacked.append(ChainDigest(start, end, body[at : at + size]))
            at += size
    except (TypeError, zlib.error) as error:
        raise ValueError(f"not a digest of standstills: {error}") from error
    if at != len(body):
        raise ValueError("not a digest of standstills: some of it is missing")
    return StandstillDigest(
        body[:head], head_until, body[head : head + tail], tail_since, tuple(unpacked)
    )


def encode_topic_events(events: TopicEvents) -> bytes:
    """Encodes the events of a topic."""
    counts = (events.first, events.last, events.left_out, events.undecodable, events.beyond)
    # Paths, and times relative to the first message, are equal in many bags: _decode_text caches
    # them.
    known = [
        [each.path for each in events.known],
        [each.at - events.first for each in events.known],
        "".join(str(each.first + 2 * each.last) for each in events.known),
    ]
    rest = json.dumps(
        [events.visible.labels, known, events.toggles, events.errors],
        ensure_ascii=False,
        separators=(",", ":"),
    )
    rows = events.visible.rows
    # A lone surrogate is not valid UTF-8, and JSON of a message may contain one.
    text = rest.encode("utf-8", "surrogatepass")
    shorter = zlib.compress(text) if len(text) > _MIN_COMPRESSED_BYTES else text
    return _EVENTS.pack(*counts, len(rows)) + rows + shorter


def decode_topic_events(packed: bytes) -> TopicEvents:
    """Decodes the events of a topic.

    Raises:
        ValueError: the bytes are not those of any.
    """
    try:
        first, last, left_out, undecodable, beyond, size = _EVENTS.unpack_from(packed)
        end = _EVENTS.size + size
        labels, (paths, after, values), flips, faults = _decode_text(packed[end:])
        known = tuple(
            KnownFlag(path, first + at, value in "13", value in "23")
            for path, at, value in zip(paths, after, values, strict=True)
        )
    except (TypeError, struct.error, zlib.error) as error:
        raise ValueError(f"not the events of a topic: {error}") from error
    seen = IntervalTable(labels, packed[_EVENTS.size : end])
    if not seen.is_sound:
        raise ValueError("not the events of a topic: a label is missing")
    return TopicEvents(first, last, seen, known, flips, faults, left_out, undecodable, beyond)


@lru_cache(2048)
def _decode_text(
    text: bytes,
) -> tuple[
    tuple[str, ...], tuple[list[str], list[int], str], tuple[Toggle, ...], tuple[ReportedError, ...]
]:
    """Decodes labels, flags, toggles and errors; cached, since those of many bags are equal."""
    plain = text if text.startswith(b"[") else zlib.decompress(text)
    labels, (paths, after, values), flips, faults = json.loads(
        plain.decode("utf-8", "surrogatepass")
    )
    return (
        tuple(labels),
        (paths, after, values),
        tuple(Toggle(*each) for each in flips),
        tuple(ReportedError(*each) for each in faults),
    )


def _decode_poses(packed: bytes) -> PoseDigest:
    poses, invalid, jumps, gaps, reset, count, legs, *numbers = _HEAD.unpack_from(packed)
    length_m, sum_m, jumped_m, gap_m, speed_mps, twist, error_m, *_ = numbers
    begin = _HEAD.size
    ends: list[Leg] = []
    for _ in range(legs):
        leg, begin = _decode_leg(packed, begin)
        ends.append(leg)
    resets = struct.unpack_from(f"<{reset}q", packed, begin)
    begin += 8 * len(resets)
    end = begin + count * _VERTEX.size
    vertices: list[Vertex] = [
        (time, (x, y, z), None if math.isnan(heading) else heading)
        for time, x, y, z, heading in _VERTEX.iter_unpack(packed[begin:end])
    ]
    totals = MotionTotals(
        head=ends[0] if ends else None,
        tail=ends[1] if len(ends) > 1 else None,
        length_m=length_m,
        sum_m=sum_m,
        jumps=jumps,
        jumped_m=jumped_m,
        gaps=gaps,
        gap_m=gap_m,
        resets=resets,
        speed_mps=None if math.isnan(speed_mps) else speed_mps,
    )
    return PoseDigest(
        poses=poses,
        invalid=invalid,
        totals=totals,
        twist=None if math.isnan(twist) else twist,
        frames=_frames(packed[end:]),
        vertices=tuple(vertices),
        error_m=error_m,
    )


def _ends(numbers: Sequence[float]) -> tuple[TimedPosition, TimedPosition]:
    first, ax, ay, az, last, bx, by, bz = numbers
    return TimedPosition(int(first), (ax, ay, az)), TimedPosition(int(last), (bx, by, bz))


def _decode_leg(packed: bytes, begin: int) -> tuple[Leg, int]:
    """Returns the leg that begins at a byte, and where it ends."""
    numbers = _LEG.unpack_from(packed, begin)
    poses, period_ns, length_m, sum_m, flags, *paces = numbers[8:]
    begin += _LEG.size
    creeps: list[Creep | None] = [None, None]
    for place in (0, 1):
        if flags >> 3 + place & 1:
            a, b, c, d, e, f, middle_m, g, h, i, reach_m = _CREEP.unpack_from(packed, begin)
            second = None if math.isnan(d) else (d, e, f)
            creeps[place] = Creep((a, b, c), second, middle_m, (g, h, i), reach_m)
            begin += _CREEP.size
    still = bool(flags & 1)
    leg = Leg(
        *_ends(numbers[:8]),
        poses,
        None if period_ns < 0 else period_ns,
        length_m,
        sum_m,
        End(paces[0], paces[1], bool(flags & 2), creeps[0]),
        End(paces[2], paces[3], bool(flags & 4), creeps[0] if still else creeps[1]),
        still,
        near_first=NearbyMotion(paces[4], paces[5]),
        near_last=NearbyMotion(paces[6], paces[7]),
    )
    return leg, begin


@lru_cache(256)
def _frames(text: bytes) -> tuple[str, ...]:
    """Decodes the list of frames, which is equal for nearly all bags."""
    return tuple(json.loads(text))


def encode_schema(schema: SummarySchema) -> str:
    """Encodes a summary schema; equal ones give equal texts."""
    topics: JsonValue = [[*header] for header in schema.topics]
    return json.dumps([topics, [*schema.silent], schema.complete, [*schema.notes], schema.set_back])


def decode_schema(text: str) -> SummarySchema:
    """Decodes a summary schema.

    Raises:
        ValueError: the text is not one.
        TypeError: likewise.
    """
    topics, silent, complete, notes, set_back = json.loads(text)
    headers = (
        TopicHeader(topic, type_name, encoding, bool(latched))
        for topic, type_name, encoding, latched in topics
    )
    return shared_schema(tuple(headers), tuple(silent), bool(complete), tuple(notes), int(set_back))

"""Digests as the bytes and texts that the catalogue keeps, and back. Exact: floats stay bit by bit.

All integers and floats are little-endian. The layouts belong to the catalogue's schema version.
"""

from __future__ import annotations

import json
import math
import struct
import sys
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.model import BagSummary, TopicSummary
from ros2_memory.motion import PoseDigest, Stop

if TYPE_CHECKING:
    from ros2_memory.model import JsonValue
    from ros2_memory.motion import Vertex

_HEAD: Final = struct.Struct("<qqqqddB??qdddqdddqdddqddd")
_VERTEX: Final = struct.Struct("<qdddd")
_NOWHERE: Final = Stop(0, (math.nan, math.nan, math.nan))


def packed_poses(poses: PoseDigest) -> bytes:
    """A digest of poses as bytes."""
    stops = [
        _NOWHERE if stop is None else stop
        for stop in (poses.first, poses.last, poses.anchor, poses.measured_from)
    ]
    head = _HEAD.pack(
        poses.poses,
        poses.invalid,
        poses.jumps,
        len(poses.vertices),
        poses.length_m,
        poses.jumped_m,
        (poses.first is not None) | (poses.anchor is not None) << 1,
        poses.anchored_by_jump,
        poses.twist is not None,
        *chain.from_iterable((stop.time, *stop.position) for stop in stops),
    )
    vertices = b"".join(
        _VERTEX.pack(time, *position, turn if isinstance(turn, float) else math.nan)
        for time, position, turn in poses.vertices
    )
    rest = struct.pack("<ddd", poses.max_speed, poses.twist or 0.0, poses.error_m)
    return head + vertices + rest + json.dumps(poses.frames).encode()


def unpacked_poses(packed: bytes) -> PoseDigest:
    """The digest that these bytes are of.

    Raises:
        ValueError: they are of none.
    """
    try:
        return _unpacked_poses(packed)
    except struct.error as error:
        raise ValueError(f"not a digest of poses: {error}") from error


def _unpacked_poses(packed: bytes) -> PoseDigest:
    poses, invalid, jumps, count, length_m, jumped_m, stands, by_jump, states, *stops = (
        _HEAD.unpack_from(packed)
    )
    first, last, anchor, measured_from = (
        Stop(time, (x, y, z)) for time, x, y, z in zip(*[iter(stops)] * 4, strict=True)
    )
    begin = _HEAD.size
    end = begin + count * _VERTEX.size
    vertices: list[Vertex] = [
        (time, (x, y, z), None if math.isnan(heading) else heading)
        for time, x, y, z, heading in _VERTEX.iter_unpack(packed[begin:end])
    ]
    max_speed, twist, error_m = struct.unpack_from("<ddd", packed, end)
    return PoseDigest(
        poses=poses,
        invalid=invalid,
        first=first if stands & 1 else None,
        last=last if stands & 1 else None,
        length_m=length_m,
        jumps=jumps,
        jumped_m=jumped_m,
        anchor=anchor if stands & 2 else None,
        anchored_by_jump=by_jump,
        max_speed=max_speed,
        measured_from=measured_from if stands & 1 else None,
        twist=twist if states else None,
        frames=tuple(json.loads(packed[end + 24 :])),
        vertices=tuple(vertices),
        error_m=error_m,
    )


def shape_of(summary: BagSummary) -> str:
    """All of a summary but counts and times, which is what nearly all bags share."""
    topics: JsonValue = [
        [each.topic, each.type, each.encoding, each.latched] for each in summary.topics
    ]
    return json.dumps([topics, [*summary.silent], summary.complete, [*summary.notes]])


def counts_of(summary: BagSummary) -> bytes:
    """Count, first and last log time of each topic of a summary, in its order."""
    numbers = [part for each in summary.topics for part in (each.count, each.first, each.last)]
    return struct.pack(f"<{len(numbers)}q", *numbers)


class Shape:
    """A shape parsed once, to be filled for each bag that has it."""

    def __init__(self, text: str) -> None:
        topics, silent, complete, notes = json.loads(text)
        intern = sys.intern
        self._topics = [
            (intern(topic), intern(type_name), intern(encoding), bool(latched))
            for topic, type_name, encoding, latched in topics
        ]
        self._silent = tuple(intern(name) for name in silent)
        self._complete = bool(complete)
        self._notes = tuple(notes)
        self._numbers = struct.Struct(f"<{3 * len(topics)}q")

    def filled(self, counts: bytes) -> BagSummary:
        """The summary of a bag of this shape.

        Raises:
            ValueError: the counts are of another shape.
        """
        try:
            numbers = iter(self._numbers.unpack(counts))
        except struct.error as error:
            raise ValueError(f"not the counts of a bag: {error}") from error
        topics = tuple(
            TopicSummary(topic, type_name, encoding, count, first, last, latched)
            for (topic, type_name, encoding, latched), count, first, last in zip(
                self._topics, numbers, numbers, numbers, strict=True
            )
        )
        return BagSummary(topics, self._silent, self._complete, self._notes)

"""Digests as the bytes and texts that the catalogue keeps, and back. Exact: floats stay bit by bit.

All integers and floats are little-endian. The layouts belong to the catalogue's schema version.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.motion import PoseDigest, Stop
from ros2_memory.presences import Seen
from ros2_memory.standstills import ChainDigest, StandstillDigest
from ros2_memory.stories import Fault, Flip, Known, Story
from ros2_memory.summaries import BagSummary, Heading, shared_shape

if TYPE_CHECKING:
    from ros2_memory.model import JsonValue
    from ros2_memory.motion import Vertex
    from ros2_memory.summaries import Shape

_HEAD: Final = struct.Struct("<qqqqddB??qdddqdddqdddqddd")
_VERTEX: Final = struct.Struct("<qdddd")
_STORY: Final = struct.Struct("<qqqqI")
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


def packed_standstills(digest: StandstillDigest) -> bytes:
    """A digest of standstills as bytes."""
    chains = [[each.start, each.end, len(each.blocks)] for each in digest.chains]
    head, tail = digest.head, digest.tail
    sizes = json.dumps([len(head), digest.head_until, len(tail), digest.tail_since, chains])
    parts = (sizes.encode(), b"\n", head, tail, *(each.blocks for each in digest.chains))
    return zlib.compress(b"".join(parts))


def unpacked_standstills(packed: bytes) -> StandstillDigest:
    """The digest that these bytes are of.

    Raises:
        ValueError: they are of none.
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


def packed_story(story: Story) -> bytes:
    """A story as bytes."""
    counts = (story.first, story.last, story.left_out, story.undecodable)
    rest = json.dumps(
        [story.seen.labels, story.known, story.flips, story.faults],
        ensure_ascii=False,
        separators=(",", ":"),
    )
    rows = story.seen.rows
    # Half a pair of surrogates is no UTF-8, and is kept all the same.
    return _STORY.pack(*counts, len(rows)) + rows + rest.encode("utf-8", "surrogatepass")


def unpacked_story(packed: bytes) -> Story:
    """The story that these bytes are of.

    Raises:
        ValueError: they are of none.
    """
    try:
        first, last, left_out, undecodable, size = _STORY.unpack_from(packed)
        end = _STORY.size + size
        labels, known, flips, faults = _told(packed[end:])
    except (TypeError, struct.error) as error:
        raise ValueError(f"not a story: {error}") from error
    seen = Seen(labels, packed[_STORY.size : end])
    if not seen.is_sound:
        raise ValueError("not a story: it tells of things without a name")
    return Story(first, last, seen, known, flips, faults, left_out, undecodable)


@lru_cache(2048)
def _told(
    text: bytes,
) -> tuple[tuple[str, ...], tuple[Known, ...], tuple[Flip, ...], tuple[Fault, ...]]:
    """What a story says in words: of many bags the same, and asked of an hour again and again."""
    labels, known, flips, faults = json.loads(text.decode("utf-8", "surrogatepass"))
    return (
        tuple(labels),
        tuple(Known(*each) for each in known),
        tuple(Flip(*each) for each in flips),
        tuple(Fault(*each) for each in faults),
    )


def _unpacked_poses(packed: bytes) -> PoseDigest:
    poses, invalid, jumps, count, length_m, jumped_m, stands, by_jump, states, *stops = (
        _HEAD.unpack_from(packed)
    )
    first, last, anchor, measured_from = [
        Stop(stops[at], (stops[at + 1], stops[at + 2], stops[at + 3])) for at in (0, 4, 8, 12)
    ]
    begin = _HEAD.size
    end = begin + count * _VERTEX.size
    isnan = math.isnan
    vertices: list[Vertex] = [
        (time, (x, y, z), None if isnan(heading) else heading)
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
        frames=_frames(packed[end + 24 :]),
        vertices=tuple(vertices),
        error_m=error_m,
    )


@lru_cache(256)
def _frames(text: bytes) -> tuple[str, ...]:
    """The frames that this text lists: those of nearly all bags are the same."""
    return tuple(json.loads(text))


def shape_text(shape: Shape) -> str:
    """A shape as a text, the same for equal ones."""
    topics: JsonValue = [[*heading] for heading in shape.topics]
    return json.dumps([topics, [*shape.silent], shape.complete, [*shape.notes], shape.set_back])


def shape_of_text(text: str) -> Shape:
    """The shape that this text is of.

    Raises:
        ValueError: it is of none.
        TypeError: likewise.
    """
    topics, silent, complete, notes, set_back = json.loads(text)
    headings = (
        Heading(topic, type_name, encoding, bool(latched))
        for topic, type_name, encoding, latched in topics
    )
    return shared_shape(tuple(headings), tuple(silent), bool(complete), tuple(notes), int(set_back))


def filled(shape: Shape, counts: bytes) -> BagSummary:
    """The summary of a bag of this shape.

    Raises:
        ValueError: the counts are of another shape.
    """
    if len(counts) != shape.layout.size:
        raise ValueError(f"not the counts of a bag: {len(counts)} bytes")
    return BagSummary.packed(shape, counts)

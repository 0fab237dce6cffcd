"""Encodes digests as the bytes and texts in the catalogue.

Exact: floats stay bit by bit, but for boxes, which grow. JSON, and packed numbers (little-endian)
where there are many; times count from the first message, so that what happened likewise in two bags
is equal, and `packing` stores it once. The layouts belong to the catalogue's schema version.
"""

from __future__ import annotations

import json
import struct
from dataclasses import fields
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.analysis.motion.odometry import (
    Leg,
    MotionTotals,
    NearbyMotion,
    PoseDigest,
    TimedPosition,
)
from ros2_memory.analysis.motion.path_length import Creep, End
from ros2_memory.analysis.motion.speed_drops import SpeedDrop, SpeedDropDigest
from ros2_memory.analysis.motion.standstills import (
    Box3,
    ChainDigest,
    Standstill,
    StandstillDigest,
    StandstillRun,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.motion.odometry import Vertex
    from ros2_memory.core.model import Vector3


def encode_poses(poses: PoseDigest) -> bytes:
    """Encodes a digest of poses."""
    totals = [getattr(poses.totals, each.name) for each in fields(poses.totals)]
    # Vertices in the same text: the first and the last pose of all are among them.
    vertices = [
        (time, *position, turn if isinstance(turn, float) else None)
        for time, position, turn in poses.vertices
    ]
    parts = [poses.poses, poses.invalid, totals, poses.twist, poses.frames, poses.error_m, vertices]
    return json.dumps(parts, separators=(",", ":")).encode()


def decode_poses(packed: bytes) -> PoseDigest:
    """Decodes a digest of poses.

    Raises:
        ValueError: the bytes are not valid.
    """
    try:
        poses, invalid, driven, twist, frames, error_m, stored = json.loads(packed.decode())
        totals = MotionTotals(*driven)
        totals.head, totals.tail = _decode_leg(totals.head), _decode_leg(totals.tail)
        totals.resets = tuple(totals.resets)
        vertices: list[Vertex] = [(time, (x, y, z), turn) for time, x, y, z, turn in stored]
    except (TypeError, struct.error) as error:
        raise ValueError(f"not a digest of poses: {error}") from error
    return PoseDigest(poses, invalid, totals, twist, tuple(frames), tuple(vertices), error_m)


def encode_standstills(digest: StandstillDigest) -> bytes:
    """Encodes a digest of standstills."""
    chains = [[each.start, each.end, len(each.blocks)] for each in digest.chains]
    head, tail, slowed = digest.head, digest.tail, digest.drops
    drops = [len(slowed.head), len(slowed.tail), slowed.drops]
    sizes = json.dumps([len(head), digest.head_until, len(tail), digest.tail_since, chains, drops])
    blocks = (each.blocks for each in digest.chains)
    parts = (sizes.encode(), b"\n", head, tail, *blocks, slowed.head, slowed.tail)
    return b"".join(parts)


def decode_standstills(packed: bytes) -> StandstillDigest:
    """Decodes a digest of standstills.

    Raises:
        ValueError: the bytes are not valid.
    """
    sizes, _, body = packed.partition(b"\n")
    try:
        head, head_until, tail, tail_since, chains, drops = json.loads(sizes)
        at = head + tail
        unpacked = []
        for start, end, size in chains:
            unpacked.append(ChainDigest(start, end, body[at : at + size]))
            at += size
        first, last, found = drops
        slowed = SpeedDropDigest(
            body[at : at + first],
            body[at + first : at + first + last],
            tuple(SpeedDrop(*each) for each in found),
        )
        at += first + last
    except (TypeError, ValueError) as error:
        raise ValueError(f"not a digest of standstills: {error}") from error
    if at != len(body):
        raise ValueError("not a digest of standstills: some of it is missing")
    return StandstillDigest(
        body[:head], head_until, body[head : head + tail], tail_since, tuple(unpacked), slowed
    )


def encode_standstill_run(run: StandstillRun) -> bytes:
    """Encodes consecutive bags' standstills that are joined."""
    last = () if run.last is None else (run.last,)
    bags = [encode_standstills(each) for each in (*run.lead, *last, *run.trail)]
    kinds = [len(run.lead), len(last), [len(each) for each in bags]]
    head = json.dumps([*kinds, run.found, run.drops])
    return b"".join((head.encode(), b"\n", *bags))


def decode_standstill_run(packed: bytes) -> StandstillRun:
    """Decodes consecutive bags' standstills that are joined.

    Raises:
        ValueError: the bytes are not valid.
    """
    head, _, body = packed.partition(b"\n")
    try:
        leading, ends, sizes, found, drops = json.loads(head)
        edges = [0, *accumulate(sizes)]
        bags = [decode_standstills(body[begin:end]) for begin, end in pairwise(edges)]
        return StandstillRun(
            tuple(bags[:leading]),
            tuple(
                Standstill(start, end, Box3(_decode_vector(low), _decode_vector(high)))
                for start, end, (low, high) in found
            ),
            tuple(SpeedDrop(*each) for each in drops),
            bags[leading] if ends else None,
            tuple(bags[leading + ends :]),
        )
    except (TypeError, IndexError) as error:
        raise ValueError(f"not joined standstills: {error}") from error


def _decode_leg(stored: Leg | None) -> Leg | None:
    """Returns the same leg, with tuples instead of JSON's lists."""
    if stored is None:
        return None
    first, last, poses, period_ns, length_m, sum_m, head, tail, still, *near = stored
    return Leg(
        _decode_pose(*first),
        _decode_pose(*last),
        poses,
        period_ns,
        length_m,
        sum_m,
        _decode_end(*head),
        _decode_end(*tail),
        still,
        *(NearbyMotion(*each) for each in near),
    )


def _decode_pose(time: int, position: Vector3) -> TimedPosition:
    return TimedPosition(time, _decode_vector(position))


def _decode_end(pace_m: float, noise_m: float, plain: bool, creep: Creep | None) -> End:
    if creep is not None:
        start, second, middle_m, end, reach_m = creep
        second = None if second is None else _decode_vector(second)
        creep = Creep(_decode_vector(start), second, middle_m, _decode_vector(end), reach_m)
    return End(pace_m, noise_m, plain, creep)


def _decode_vector(numbers: Vector3) -> Vector3:
    x, y, z = numbers
    return x, y, z


def encode_counts(numbers: bytes) -> bytes:
    """Encodes count, first and last of each topic: the earliest time, then all relative to it.

    Of `last`, how much later than `first` it is.
    """
    table = np.frombuffer(numbers, "<i8").reshape(-1, 3).copy()
    if not table.size:
        return b""
    start = table[:, 1].min()
    table[:, 2] -= table[:, 1]
    table[:, 1] -= start
    return b"".join((start.tobytes(), table.tobytes()))


def decode_counts(
    encoded: Sequence[bytes], topics: int
) -> np.ndarray[tuple[int, int, int], np.dtype[np.int64]]:
    """Decodes count, first and last of each of so many topics, for each bag.

    Raises:
        ValueError: some are not those of so many topics.
    """
    size = 8 * (1 + 3 * topics) if topics else 0
    if any(len(each) != size for each in encoded):
        raise ValueError(f"not the numbers of bags that hold {topics} topics")
    if not size:
        return np.zeros((len(encoded), 0, 3), np.int64)
    rows = np.frombuffer(b"".join(encoded), "<i8").reshape(len(encoded), -1)
    table = rows[:, 1:].reshape(len(encoded), topics, 3).copy()
    table[:, :, 1] += rows[:, :1]
    table[:, :, 2] += table[:, :, 1]
    return table

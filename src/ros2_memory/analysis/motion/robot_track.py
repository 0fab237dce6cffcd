"""The path of the robot in one frame with few vertices, each with its time.

Between two vertices the robot is taken to move evenly; no pose is farther than `error_m` from where
that has it *at its time*. So a track answers where the robot was, and when it entered a region,
which a path that is drawn in space alone does not. Times are whole milliseconds, places whole
millimetres and headings milliradians: a track that is stored and read again is the same.
"""

from __future__ import annotations

import heapq
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.timebase import NS_PER_MS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.frames import Floats, Mask, Times

TOLERANCE_M: Final = 0.05
TOLERANCE_RAD: Final = 0.15
MAX_VERTICES: Final = 512
"""Of one bag; where a path needs more, its error grows."""

_MM: Final = 1000
_GRID_M: Final = 0.001
_MAX_M: Final = 1e6
_HEAD: Final = struct.Struct("<qqqqIf")
_ROW_BYTES: Final = 32
_NOTHING: Final = (0, 0, 0, 0, 0, 0.0)
_NO_HEADING: Final = -(2**40)
_SPLIT_WEIGHT: Final = TOLERANCE_M / TOLERANCE_RAD
"""Metres that count as much as a radian."""


@dataclass(frozen=True, slots=True)
class RobotTrack:
    """Vertices ascending in time.

    Attributes:
        times: log times.
        x: metres.
        y: metres.
        heading: about Z (rad), continuous from vertex to vertex; NaN where it is not known.
        begins: whether a piece begins at the vertex: the robot was not seen between it and the one
            before for longer than `SILENCE_NS`.
        error_m: how far any pose may be from the track at its time.
    """

    times: Times
    x: Floats
    y: Floats
    heading: Floats
    begins: Mask
    error_m: float


def empty_track() -> RobotTrack:
    """Returns a track without a vertex."""
    none = np.zeros(0, np.float64)
    return RobotTrack(np.zeros(0, np.int64), none, none, none, np.zeros(0, np.bool_), 0.0)


def track_of(times: Times, x: Floats, y: Floats, heading: Floats) -> RobotTrack:
    """Returns the track of poses in log-time order; those that are no place are left out."""
    fine = (np.abs(x) < _MAX_M) & (np.abs(y) < _MAX_M)  # false for NaN
    times, x, y, heading = times[fine], x[fine], y[fine], heading[fine]
    if not len(times):
        return empty_track()
    milliseconds = times // NS_PER_MS
    known = np.isfinite(heading)
    turned = np.unwrap(np.where(known, heading, 0.0))
    gaps = np.flatnonzero(np.diff(times) > SILENCE_NS) + 1
    pieces = list(zip([0, *gaps.tolist()], [*gaps.tolist(), len(times)], strict=True))
    table = np.stack((x, y, turned * _SPLIT_WEIGHT))
    kept: list[int] = []
    numbers: list[int] = []
    error_m = 0.0
    room = max(MAX_VERTICES // len(pieces), 2)
    for number, (start, stop) in enumerate(pieces):
        chosen, off = _simplified(times[start:stop], table[:, start:stop], room)
        kept += [start + each for each in chosen]
        numbers += [number] * len(chosen)
        error_m = max(error_m, off)
    # Of several poses of one millisecond the last counts, as the robot is only in one place.
    unique = np.append(np.diff(milliseconds[kept]) > 0, [True])
    index = np.array(kept, np.intp)[unique]
    begins = np.diff(np.array(numbers)[unique], prepend=-1) > 0
    turns = np.where(known[index], np.rint(turned[index] * _MM), _NO_HEADING)
    columns = (np.rint(x[index] * _MM), np.rint(y[index] * _MM), turns)
    return _on_grid(
        [milliseconds[index], *(each.astype(np.int64) for each in columns)],
        begins,
        error_m + _GRID_M,
    )


def _on_grid(columns: Sequence[Times], begins: Mask, error_m: float) -> RobotTrack:
    """Returns the track of columns in milliseconds, millimetres (x, y) and milliradians."""
    milliseconds, x, y, heading = columns
    return RobotTrack(
        milliseconds * NS_PER_MS,
        x / _MM,
        y / _MM,
        np.where(heading == _NO_HEADING, np.nan, heading / _MM),
        begins,
        float(np.float32(error_m)),
    )


def _simplified(times: Times, table: Floats, at_most: int) -> tuple[list[int], float]:
    """Returns the indices of the poses to keep, and how far any other is from these at its time."""
    last = len(times) - 1
    kept = {0, last}
    if last < 2:
        return sorted(kept), 0.0
    seconds = (times - times[0]) * 1e-9
    waiting = [_worst(seconds, table, 0, last)]
    while waiting and -waiting[0][0] > TOLERANCE_M * TOLERANCE_M and len(kept) < at_most:
        _, split, start, end = heapq.heappop(waiting)
        kept.add(split)
        for low, high in ((start, split), (split, end)):
            if high - low > 1:
                heapq.heappush(waiting, _worst(seconds, table, low, high))
    off = float(np.sqrt(-waiting[0][0])) if waiting else 0.0
    return sorted(kept), off


def _worst(seconds: Floats, table: Floats, start: int, end: int) -> tuple[float, int, int, int]:
    """Returns minus the square of the largest error between two poses, where it is, and these."""
    lasted = seconds[end] - seconds[start]
    inner = slice(start + 1, end)
    ratio = (seconds[inner] - seconds[start]) / (lasted or 1.0)
    first = table[:, start : start + 1]
    off = table[:, inner] - first - (table[:, end : end + 1] - first) * ratio
    off *= off
    squared = np.maximum(off[0] + off[1], off[2])
    where = int(squared.argmax())
    return -float(squared[where]), start + 1 + where, start, end


def encode_track(track: RobotTrack) -> bytes:
    """Encodes a track."""
    count = len(track.times)
    if not count:
        return b""
    heading = np.where(np.isnan(track.heading), _NO_HEADING, np.rint(track.heading * _MM))
    columns = (track.times // NS_PER_MS, np.rint(track.x * _MM), np.rint(track.y * _MM), heading)
    rows = np.stack([each.astype(np.int64) for each in columns])
    steps = np.diff(rows, prepend=rows[:, :1], axis=1)
    # Signs in the lowest bit: the higher bytes of small numbers, then, are all zero.
    unsigned = (steps << 1 ^ steps >> 63).astype("<i8")
    planes = unsigned.view(np.uint8).reshape(4, count, 8).transpose(0, 2, 1)
    head = _HEAD.pack(*rows[:, 0].tolist(), count, track.error_m)
    return head + planes.tobytes() + np.packbits(track.begins).tobytes()


def decode_track(packed: bytes) -> RobotTrack:
    """Decodes a track.

    Raises:
        ValueError: the bytes are not valid.
    """
    return decode_tracks([packed])[0]


def decode_tracks(packed: Sequence[bytes]) -> list[RobotTrack]:
    """Decodes tracks, all together: one by one, those of a week take four times as long.

    Raises:
        ValueError: some of the bytes are not valid.
    """
    try:
        heads = [_HEAD.unpack_from(each) if each else _NOTHING for each in packed]
    except struct.error as error:
        raise ValueError(f"not a track: {error}") from error
    counts = [head[4] for head in heads]
    planes: list[NDArray[np.uint8]] = []
    flags: list[bytes] = []
    for each, count in zip(packed, counts, strict=True):
        size, begin = count * _ROW_BYTES, _HEAD.size
        if each and len(each) != begin + size + -(-count // 8):
            raise ValueError(f"not a track: {len(each) - begin} bytes for {count} points")
        if count:
            planes.append(np.frombuffer(each, np.uint8, size, begin).reshape(_ROW_BYTES, count))
        flags.append(each[begin + size :])
    if not planes:
        return [empty_track() for _ in packed]
    whole = np.concatenate(planes, axis=1)
    ordered = whole.reshape(4, 8, -1).transpose(0, 2, 1)
    unsigned = np.ascontiguousarray(ordered).view("<i8")[:, :, 0]
    steps = unsigned >> 1 ^ -(unsigned & 1)
    stops = np.cumsum(counts)
    starts = stops - counts
    # Sums of each track alone: integers, which come back when they overflow.
    sums = np.concatenate((np.zeros((4, 1), np.int64), np.cumsum(steps, axis=1)), axis=1)
    base = np.array([head[:4] for head in heads], np.int64).T - sums[:, starts]
    values = sums[:, 1:] + np.repeat(base, counts, axis=1)
    bits = np.cumsum([0, *map(len, flags[:-1])]) * 8 - starts
    at = np.arange(len(unsigned[0])) + np.repeat(bits, counts)
    begins = np.unpackbits(np.frombuffer(b"".join(flags), np.uint8))[at].astype(np.bool_)
    track = _on_grid([*values], begins, 0.0)
    return [
        RobotTrack(
            track.times[start:stop],
            track.x[start:stop],
            track.y[start:stop],
            track.heading[start:stop],
            track.begins[start:stop],
            float(head[5]),
        )
        for start, stop, head in zip(starts.tolist(), stops.tolist(), heads, strict=True)
    ]

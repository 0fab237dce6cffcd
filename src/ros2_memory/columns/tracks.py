"""The track by the poses of a part as bytes, some 12 for each vertex."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.motion.robot_track import TrackPart
from ros2_memory.columns.pack import compressed, decompressed
from ros2_memory.columns.steps import METRES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.storage.base import IntArray

_HEAD: Final = np.dtype("<i8")


def track_bytes(part: TrackPart) -> bytes:
    """Returns a track as bytes: how many poses were left out, then column by column.

    Columns of numbers are differences from one vertex to the next, their lowest bytes first.
    """
    x, y = (np.rint(column * METRES.per_unit).astype(np.int64) for column in (part.x, part.y))
    flags = part.known + 2 * part.settled.astype(np.uint8)
    head = np.array([len(part.times), part.left_out], _HEAD).tobytes()
    planes = [_planes(column) for column in (part.times, x, y, part.turns)]
    return compressed(b"".join((head, *planes, flags.tobytes())))


def track_from(data: bytes) -> TrackPart:
    """Returns the track that became these bytes.

    Raises:
        ValueError: they are not of a track.
    """
    whole = decompressed(data)
    count, left_out = np.frombuffer(whole, _HEAD, 2).tolist()
    size = 8 * count
    begins = [_HEAD.itemsize * 2 + nth * size for nth in range(5)]
    times, x, y, turns = (_numbers(whole[begin : begin + size], count) for begin in begins[:4])
    flags = np.frombuffer(whole, np.uint8, count, begins[4])
    known, settled = (flags & 1).astype(np.bool_), (flags & 2).astype(np.bool_)
    metres = (x / METRES.per_unit, y / METRES.per_unit)
    return TrackPart(times, *metres, turns, known, settled, left_out)


def _planes(numbers: IntArray) -> bytes:
    steps = np.diff(numbers, prepend=0)
    folded = (steps << 1) ^ (steps >> 63)  # small ones of either sign have high bytes of 0
    return folded.astype("<i8").view(np.uint8).reshape(-1, 8).T.tobytes()


def _numbers(data: bytes, count: int) -> NDArray[np.int64]:
    planes = np.frombuffer(data, np.uint8).reshape(8, count)
    folded = np.ascontiguousarray(planes.T).view("<u8").reshape(count)
    steps = (folded >> np.uint64(1)).astype(np.int64) ^ -(folded & np.uint64(1)).astype(np.int64)
    return np.cumsum(steps)

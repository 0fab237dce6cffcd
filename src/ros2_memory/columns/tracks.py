"""How the track by the poses of a part is stored as a fragment, in some ten bytes for a vertex."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.motion.robot_track import TrackPart, united_parts
from ros2_memory.columns.fragments import Fragment, Kind
from ros2_memory.columns.pack import byte_planes, from_planes, signed
from ros2_memory.columns.steps import METRES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.columns.fragments import Array
    from ros2_memory.storage.base import IntArray


def _fragment(part: TrackPart) -> Fragment:
    x, y = (np.rint(column * METRES.per_unit).astype(np.int64) for column in (part.x, part.y))
    numbers = {"times": part.times, "x": x, "y": y, "turns": part.turns}
    arrays: dict[str, Array] = {name: _planes(column) for name, column in numbers.items()}
    marks = {"known": part.known, "settled": part.settled}
    return Fragment(json.dumps([part.left_out, part.recording]), arrays | marks)


def _track(fragment: Fragment) -> TrackPart:
    times, x, y, turns = (_numbers(fragment.arrays[name]) for name in ("times", "x", "y", "turns"))
    return TrackPart(
        times,
        x / METRES.per_unit,
        y / METRES.per_unit,
        turns,
        fragment.marks("known"),
        fragment.marks("settled"),
        *json.loads(fragment.head),
    )


def _planes(numbers: IntArray) -> Array:
    """Returns the differences from one number to the next, the lowest bytes of all first."""
    steps = np.diff(numbers, prepend=0)
    folded = (steps << 1) ^ (steps >> 63)  # small ones of either sign have high bytes of 0
    return np.frombuffer(byte_planes(folded, 8), np.uint8)


def _numbers(planes: Array) -> IntArray:
    folded = from_planes(planes.tobytes(), 0, planes.size // 8, 8)
    return np.cumsum(signed(folded), dtype=np.int64)


def _joined(found: Sequence[TrackPart]) -> Sequence[TrackPart]:
    by_recording: dict[str, list[TrackPart]] = {}
    for part in found:
        by_recording.setdefault(part.recording, []).append(part)
    return [*map(united_parts, by_recording.values())]


TRACKS: Final = Kind("track", _fragment, _track, _joined)
"""Where the poses of a part have the robot in a frame; joined, those of a recording."""

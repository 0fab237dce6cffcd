"""The poses of a topic as arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ros2_memory.core.arrays import (
    Floats,
    Vectors,
    joined_codes,
    row_sums,
    rows_of,
    run_starts,
    stable_order,
    stacked,
)
from ros2_memory.core.geometry import GIMBAL_LOCK_SINE
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.frames import Edges, FrameTree
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.storage.base import IntArray

_STEP_NS: Final[Ns] = NS_PER_S // 20
"""The least time between two poses by transforms."""
SLOT_NS: Final[Ns] = 2 * NS_PER_S // 5
"""The time over which poses are averaged to find out whether the robot stands."""
REST_NS: Final[Ns] = 15 * NS_PER_S
"""So much time at most shows whether a position wanders at rest."""
_REST_SLOTS: Final = 15
"""So many slots with poses show it: a robot that creeps with 5 cm/s gets farther in them."""
_REST_M: Final = 0.2
"""How far from each other their means may be."""
_ALIKE: Final = 0.5
"""What wanders has steps from slot to slot in other directions: the mean cosine between two is
less. Those of an averaged random walk have 0.2, and those of a straight drive 1."""
_STEPS_OF_DEVIATION: Final = 1.5
"""The standard deviation of a position that wanders, in median steps from slot to slot."""


class FrameCodes(NamedTuple):
    """The frames of poses: `words[code]` for each pose; some words may have no pose."""

    codes: np.ndarray[tuple[int], np.dtype[np.uint32]]
    words: tuple[str, ...]

    def values(self) -> list[str]:
        """Returns the frame of each pose."""
        return [self.words[code] for code in self.codes.tolist()]

    def names(self) -> tuple[str, ...]:
        """Returns the frames of all poses, each once, in order of appearance."""
        used, first = np.unique(self.codes, return_index=True)
        return tuple(self.words[code] for code in used[np.argsort(first)].tolist())


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of the messages of a topic, in order of log time.

    Attributes:
        times: log times (ns).
        positions: rows of x, y and z (m); NaN and infinities as messages have them.
        turns: unit quaternions, as rows of x, y, z, w; NaN without an orientation.
        frames: the frame of each pose; empty if it is not known.
        speeds: the linear speed (m/s) that each message states; NaN if it states none.
    """

    times: IntArray
    positions: Vectors
    turns: Vectors
    frames: FrameCodes
    speeds: Floats

    def __len__(self) -> int:
        """Returns the number of poses."""
        return self.times.size

    def rows(self, which: IntArray | slice[int, int, None]) -> Poses:
        """Returns the poses of some rows, in the order given."""
        return Poses(
            self.times[which],
            self.positions[which],
            self.turns[which],
            FrameCodes(self.frames.codes[which], self.frames.words),
            self.speeds[which],
        )

    def wander_m(self) -> Floats:
        """Returns the standard deviation (m) of each position at rest; 0 where the robot may move.

        At rest, positions stay near for a while, and their steps lead in no direction.
        """
        slots = self.times // SLOT_NS
        begins = run_starts(slots)
        if begins.size < _REST_SLOTS:
            return np.zeros(len(self))
        counts = np.diff(begins, append=len(self))
        means = np.add.reduceat(self.positions - np.rint(self.positions[0]), begins)
        means /= counts[:, None]
        return np.repeat(_slots_wander_m(slots[begins], means), counts)

    def between(self, start: int, stop: int) -> Poses:
        """Returns the poses with log times (ns) in `[start, stop)`."""
        first, end = np.searchsorted(self.times, (start, stop)).tolist()
        return self.rows(slice(first, end))


def _slots_wander_m(slots: IntArray, means: Vectors) -> Floats:
    """Returns the standard deviation (m) of the position in each slot; see `Poses.wander_m`.

    Of the windows of slots around it that show no motion, the one with the longest steps counts.
    """
    windows = sliding_window_view(means, _REST_SLOTS, axis=0)
    sizes = windows.max(axis=2) - windows.min(axis=2)
    steps = np.diff(means, axis=0)
    squares = row_sums(steps * steps)
    lengths = np.sqrt(squares[1:] * squares[:-1])
    # Where a step is zero, nothing wanders.
    cosines = np.ones(lengths.size)
    np.divide(row_sums(steps[1:] * steps[:-1]), lengths, out=cosines, where=lengths > 0)
    is_rest = (
        (slots[_REST_SLOTS - 1 :] - slots[: 1 - _REST_SLOTS] < REST_NS // SLOT_NS)
        & (row_sums(sizes * sizes) <= _REST_M * _REST_M)
        & (sliding_window_view(cosines, _REST_SLOTS - 2).mean(axis=1) < _ALIKE)
    )
    medians = np.median(sliding_window_view(squares, _REST_SLOTS - 1), axis=1)
    of_windows = np.pad(
        np.where(is_rest, _STEPS_OF_DEVIATION * np.sqrt(medians), 0.0), _REST_SLOTS - 1
    )
    wander_m: Floats = sliding_window_view(of_windows, _REST_SLOTS).max(axis=1)
    return wander_m


NO_POSES: Final = Poses(
    np.empty(0, np.int64),
    np.empty((0, 3)),
    np.empty((0, 4)),
    FrameCodes(np.empty(0, np.uint32), ()),
    np.empty(0),
)


def joined_poses(parts: Sequence[Poses]) -> Poses:
    """Returns the poses of all parts, in order of log time; of equal times the earlier part's."""
    parts = [part for part in parts if len(part)]
    if len(parts) < 2:
        return parts[0] if parts else NO_POSES
    codes, words = joined_codes(part.frames for part in parts)
    whole = Poses(
        np.concatenate([part.times for part in parts]),
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.turns for part in parts]),
        FrameCodes(codes.astype(np.uint32), words),
        np.concatenate([part.speeds for part in parts]),
    )
    if (whole.times[1:] >= whole.times[:-1]).all():
        return whole
    return whole.rows(stable_order(whole.times))


def headings(turns: Vectors) -> Floats:
    """Returns the yaw (rad) of unit quaternions, as `geometry.yaw` computes it; NaN of NaN."""
    x, y, z, w = turns.T
    sine = 2 * (w * y - z * x)
    yaws = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    # At gimbal lock only the sum of roll and yaw is known.
    sums = 2 * np.arctan2(z, w)
    sums -= math.tau * np.rint(sums / math.tau)
    return np.where(np.abs(sine) > GIMBAL_LOCK_SINE, sums, yaws)


def placed_body(edges: Edges, child: str, frames: FrameTree, window: TimeWindow) -> Poses:
    """Returns the pose of a body in the target of `frames` at each of its transforms in a window.

    Left out are moments at which no transforms lead to the target.
    """
    of_body = [edge for (_, name), edge in edges.items() if name == child]
    if not of_body:
        return NO_POSES
    body = stacked(of_body)
    body = rows_of(body, window.holding(body.log_times))
    body = rows_of(body, stable_order(body.log_times))
    times = body.log_times
    placed = frames.poses(child, body.stamps if frames.clock == "stamp" else times)
    if placed is None:
        return NO_POSES
    poses = Poses(
        times,
        np.stack(placed.translation, axis=1),
        np.stack(placed.rotation, axis=1),
        FrameCodes(np.zeros(times.size, np.uint32), (frames.target,)),
        np.full(times.size, np.nan),
    )
    return poses.rows(np.flatnonzero(placed.valid))


def positions_apart(times: IntArray) -> IntArray:
    """Returns the positions of ascending times (ns) that are at least `_STEP_NS` apart."""
    last, positions = MIN_NS, list[int]()
    for position, time in enumerate(times.tolist()):
        if time - last >= _STEP_NS:
            last = time
            positions.append(position)
    return np.array(positions, np.int64)

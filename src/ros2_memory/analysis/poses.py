"""The poses of a topic as arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.arrays import (
    Flags,
    Floats,
    Vectors,
    joined_codes,
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
WANDERS_M: Final = 0.02
"""The standard deviation with which the position of a robot at rest may wander, as that of a filter
with a satellite receiver does. This is no noise from pose to pose, which averages out."""
_RESTING_MPS: Final = 0.02
SLOT_NS: Final[Ns] = 2 * NS_PER_S // 5
"""The time over which poses are averaged to find out whether the robot stands."""


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

    def at_rest(self) -> Flags:
        """Returns which poses are of a robot at rest, by the mean speed stated in their slot.

        A speed of 0 shows nothing: some publishers leave the twist out, and the odometry of wheels
        that stand does not wander.
        """
        begins = run_starts(self.times // SLOT_NS)
        sizes = np.diff(begins, append=len(self))
        means_mps = np.add.reduceat(self.speeds, begins) / sizes if len(self) else self.speeds
        return np.repeat((means_mps > 0) & (means_mps <= _RESTING_MPS), sizes)

    def between(self, start: int, stop: int) -> Poses:
        """Returns the poses with log times (ns) in `[start, stop)`."""
        first, end = np.searchsorted(self.times, (start, stop)).tolist()
        return self.rows(slice(first, end))


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

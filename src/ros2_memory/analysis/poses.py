"""The poses of a topic as arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.arrays import Floats, Vectors, joined_codes
from ros2_memory.core.geometry import GIMBAL_LOCK_SINE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.storage.base import IntArray


class FrameCodes(NamedTuple):
    """The frames of poses: `words[code]` for each; there may be words that no pose has."""

    codes: np.ndarray[tuple[int], np.dtype[np.uint32]]
    words: tuple[str, ...]

    def values(self) -> list[str]:
        """Returns the frame of each pose."""
        return [self.words[code] for code in self.codes.tolist()]

    def names(self) -> tuple[str, ...]:
        """Returns the frames that poses have, each once, in order of appearance."""
        used, first = np.unique(self.codes, return_index=True)
        return tuple(self.words[code] for code in used[np.argsort(first)].tolist())


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of the messages of a topic, in order of log time.

    Attributes:
        times: log times (ns).
        positions: x, y and z (m) of each, as a row; NaN and infinities as the message has them.
        turns: unit quaternions x, y, z, w, as rows; NaN where there is no orientation.
        frames: of each; empty where it is not known.
        speeds: the linear speed (m/s) that each message states; NaN where it states none.
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
        """Returns some of them, in the order given."""
        return Poses(
            self.times[which],
            self.positions[which],
            self.turns[which],
            FrameCodes(self.frames.codes[which], self.frames.words),
            self.speeds[which],
        )

    def between(self, start: int, stop: int) -> Poses:
        """Returns those from a log time on, before another (ns)."""
        first, end = np.searchsorted(self.times, (start, stop)).tolist()
        if end - first == len(self):
            return self
        return self.rows(slice(first, end))


NO_POSES: Final = Poses(
    np.empty(0, np.int64),
    np.empty((0, 3)),
    np.empty((0, 4)),
    FrameCodes(np.empty(0, np.uint32), ()),
    np.empty(0),
)


def joined_poses(parts: Sequence[Poses]) -> Poses:
    """Returns poses as one, in order of log time, ties in the order of the parts."""
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
    return whole.rows(np.argsort(whole.times, kind="stable"))


def headings(turns: Vectors) -> Floats:
    """Returns the heading about z (rad) of unit quaternions, as `geometry.yaw` has it; or NaN."""
    x, y, z, w = turns.T
    sine = 2 * (w * y - z * x)
    plain = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    # At gimbal lock only the sum of roll and heading is known.
    both = 2 * np.arctan2(z, w)
    both -= math.tau * np.rint(both / math.tau)
    return np.where(np.abs(sine) > GIMBAL_LOCK_SINE, both, plain)

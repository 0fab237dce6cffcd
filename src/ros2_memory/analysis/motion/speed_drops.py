"""Where the robot suddenly slowed down.

Of every slot of `SLOT_NS`, counted from the epoch, the first pose counts. A robot moves clearly
where it goes `MOVING_MPS` or faster from slot to slot. It slows down suddenly where its speed
falls, from one slot to the next but one, to `FRACTION` of that or less, and stays there for two
slots. A robot that turns meanwhile is taken to do so on purpose: nearly all slow down to turn.

That depends on the first poses of `_ROWS` slots in a row, and slots are counted from the epoch; so
it is the same however a history is cut. Poses that come less often than once a slot, and a position
that jumps for a moment, show no drop.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.poses import Poses, headings
from ros2_memory.core.timebase import NS_PER_S, Ns

SLOT_NS: Final[Ns] = NS_PER_S // 2
MOVING_MPS: Final = 0.15
FRACTION: Final = 0.4
TURNS_RAD: Final = 0.35
_ROWS: Final = 7
"""Slots that decide whether there is a drop at the fourth of them, and none at the third."""


class SpeedDrop(NamedTuple):
    """A sudden loss of speed: when it began, and the speeds (m/s) before and after."""

    time: Ns
    before_mps: float
    after_mps: float


def speed_drops(poses: Poses) -> tuple[SpeedDrop, ...]:
    """Returns where the robot suddenly slowed down, in order."""
    valid = np.flatnonzero(are_places(poses.positions))
    slots = poses.times[valid] // SLOT_NS
    # The first pose of each slot.
    rows = valid[np.flatnonzero(np.diff(slots, prepend=slots[:1] - 1))]
    if rows.size < _ROWS:
        return ()
    times = poses.times[rows]
    places = poses.positions[rows]
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / (np.diff(times) / NS_PER_S)
    # Of two slots: a robot whose position jumps, and is back, gets no farther.
    ahead = np.linalg.norm(places[2:] - places[:-2], axis=1) / ((times[2:] - times[:-2]) / NS_PER_S)
    before = np.minimum(np.minimum(speeds[:-1], speeds[1:]), ahead)
    after = np.maximum(speeds[:-1], speeds[1:])
    falls = (before[:-3] >= MOVING_MPS) & (after[3:] <= FRACTION * before[:-3])
    slots = times // SLOT_NS
    in_a_row = slots[_ROWS - 1 :] - slots[: 1 - _ROWS] < _ROWS
    drops = np.flatnonzero(in_a_row & falls[1:] & ~falls[:-1])
    turned = headings(poses.turns[rows[drops + 6]]) - headings(poses.turns[rows[drops + 2]])
    # Where a heading is not known, it turns no more than others.
    drops = drops[~(np.abs(np.angle(np.exp(1j * turned))) > TURNS_RAD)]
    return tuple(
        SpeedDrop(int(times[at + 3]), float(before[at + 1]), float(after[at + 4]))
        for at in drops.tolist()
    )

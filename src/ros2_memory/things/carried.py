"""Detections of carried things: a thing in a gripper, or on a tray, moves with the robot.

While the robot drives, such a thing stays at one place in the robot's frame, and is at a new one
in the map each time. None of these is a place of the thing: the robot only passed there with it.
A part of the robot that a detector takes for a thing looks the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.analysis.sights import Hit, Look, Spot
from ros2_memory.core.arrays import run_starts
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.analysis.sights import Floats
    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.arrays import Flags

Complexes: TypeAlias = "NDArray[np.complex128]"

_FEWEST: Final = 3
"""Fewer spots in a row may be similar things, each seen from the same side."""
_REACH_MM: Final = 1500.0
"""The farthest that a carried thing is from the origin of the robot's frame."""
_STEP_MM: Final = 300.0
"""From one spot to the next a carried thing moves at least so far in the map, ..."""
_SAME_MM: Final = 200.0
"""... and at most so far in the robot's frame, whose pose is known to a quarter of a cell."""
_PAUSE_NS: Final = 15 * NS_PER_S
_FIXED_SHARE: Final = 0.15
"""A thing stands still if its detections scatter by less than this share of the robot's way.

Those of a carried thing scatter by a third of that way.
"""


def carried_spots(sights: JoinedSights) -> Flags:
    """Returns which spots are of a thing that the robot carried while it drove.

    Their detections follow one another. Others of the label may be in view meanwhile, if they stand
    still or are out of reach.
    """
    spots = sights.spots
    place = spots[:, Spot.X] + 1j * spots[:, Spot.Y]
    ahead, way = _seen_ahead(sights, place)
    stands = (way >= _STEP_MM) & (spots[:, Spot.DEV] < _FIXED_SHARE * way)
    may_be = np.flatnonzero((np.abs(ahead) <= _REACH_MM) & ~stands)
    first, last, label, topic = (
        spots[may_be, name] for name in (Spot.FIRST, Spot.LAST, Spot.LABEL, Spot.TOPIC)
    )
    epoch = sights.epochs[spots[may_be, Spot.SLICE]]
    order = np.lexsort((first, label, topic, epoch))
    before, after = order[:-1], order[1:]
    pause = first[after] - last[before]
    is_step = (pause >= 0) & (pause <= _PAUSE_NS)
    for column in (label, topic, epoch):
        is_step &= column[before] == column[after]
    before, after = may_be[before], may_be[after]
    is_step &= np.abs(place[after] - place[before]) >= _STEP_MM
    is_step &= np.abs(ahead[after] - ahead[before]) <= _SAME_MM
    # Runs of steps: a run of n steps has n + 1 spots.
    edges = np.flatnonzero(np.diff(np.concatenate(([False], is_step, [False]))))
    carried: Flags = np.zeros(len(spots), np.bool_)
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin + 1 >= _FEWEST:
            carried[may_be[order[begin : end + 1]]] = True
    return carried


def _seen_ahead(sights: JoinedSights, place: Complexes) -> tuple[Complexes, Floats]:
    """Returns each spot's place (mm) relative to the robot, x ahead, and how far it went meanwhile.

    A complex number has x and y. NaN where no pose of the robot is known.
    """
    spot, look, n = (sights.hits[sights.hits[:, Hit.LOOK] >= 0, name] for name in Hit)
    x, y, yaw = (sights.looks[look, name] for name in (Look.X, Look.Y, Look.YAW))
    relative = (place[spot] - x - 1j * y) * np.exp(-1j * np.radians(yaw / 10))
    begins = run_starts(spot)
    moved = [np.maximum.reduceat(at, begins) - np.minimum.reduceat(at, begins) for at in (x, y)]
    ahead, way = np.full(len(place), np.nan, np.complex128), np.full(len(place), np.nan)
    ahead[spot[begins]] = np.add.reduceat(n * relative, begins) / np.add.reduceat(n, begins)
    way[spot[begins]] = np.hypot(*moved)
    return ahead, way

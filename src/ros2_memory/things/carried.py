"""Detections of carried things: a thing in a gripper, or on a tray, moves with the robot.

While the robot drives, such a thing stays at one place in the robot's frame, and is at a new one
in the map each time. None of these is a place of the thing: the robot only passed there with it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import NO_YAW, Hit, Look, Spot
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from ros2_memory.analysis.sights import Floats
    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.arrays import Flags

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

    Their detections follow one another, without a detection of that label elsewhere.
    """
    spots = sights.spots
    place = np.stack([spots[:, name] for name in (Spot.X, Spot.Y)], axis=1).astype(np.float64)
    ahead, way = _seen_ahead(sights, place)
    is_near = np.hypot(*ahead.T) <= _REACH_MM
    stands = (way >= _STEP_MM) & (spots[:, Spot.DEV] < _FIXED_SHARE * way)
    may_be = is_near & ~stands & (spots[:, Spot.TOGETHER] == 1)
    first, last, label, topic = (
        spots[:, name] for name in (Spot.FIRST, Spot.LAST, Spot.LABEL, Spot.TOPIC)
    )
    epoch = sights.epochs[spots[:, Spot.SLICE]]
    order = np.lexsort((first, label, topic, epoch))
    before, after = order[:-1], order[1:]
    is_step = may_be[before] & may_be[after] & (first[after] - last[before] <= _PAUSE_NS)
    for column in (label, topic, epoch):
        is_step &= column[before] == column[after]
    is_step &= np.hypot(*(place[after] - place[before]).T) >= _STEP_MM
    is_step &= np.hypot(*(ahead[after] - ahead[before]).T) <= _SAME_MM
    # Runs of steps: a run of n steps has n + 1 spots.
    edges = np.flatnonzero(np.diff(np.concatenate(([False], is_step, [False]))))
    carried: Flags = np.zeros(len(spots), np.bool_)
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin + 1 >= _FEWEST:
            carried[order[begin : end + 1]] = True
    return carried


def _seen_ahead(sights: JoinedSights, place: Floats) -> tuple[Floats, Floats]:
    """Returns each spot's place (mm) relative to the robot, x ahead, and how far it went meanwhile.

    NaN where no pose of the robot is known.
    """
    spot, look, n = (sights.hits[:, name] for name in Hit)
    is_known = look >= 0
    is_known[is_known] = sights.looks[look[is_known], Look.YAW] != NO_YAW
    spot, look, n = (column[is_known] for column in (spot, look, n))
    x, y, yaw = (sights.looks[look, name] for name in (Look.X, Look.Y, Look.YAW))
    heading = np.radians(yaw / 10)
    dx, dy = place[spot, 0] - x, place[spot, 1] - y
    count = len(place)
    ahead, beside = (
        np.cos(heading) * dx + np.sin(heading) * dy,
        np.cos(heading) * dy - np.sin(heading) * dx,
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.bincount(spot, n, count)
        relative = np.stack(
            [np.bincount(spot, n * part, count) / total for part in (ahead, beside)], axis=1
        )
    low, high = np.full((2, count), np.inf), np.full((2, count), -np.inf)
    for axis, column in enumerate((x, y)):
        np.minimum.at(low[axis], spot, column)
        np.maximum.at(high[axis], spot, column)
    return relative, np.hypot(*np.maximum(high - low, 0.0))

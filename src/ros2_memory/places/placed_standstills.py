"""Where the robot stood still, and the places where it stood in two windows.

Both tracks must be in one frame. That frame should be the map, unless odometry went on between the
two windows: after a restart the same coordinates are another place.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.sights import STOREY_MM
from ros2_memory.core.arrays import Flags, Ints, bounds_of
from ros2_memory.core.regions import contains
from ros2_memory.core.timebase import Ns, Span, unix_from_ns
from ros2_memory.results import Pair, StandstillPlace

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.core.model import Vector3
    from ros2_memory.core.regions import Region

SAME_STAND_M: Final = 0.5
"""Standstills so near to each other are at one place."""

_SAMPLES_OF_STAND: Final = 9
"""The place of a standstill is the median of so many samples."""


class PlacedStandstill(NamedTuple):
    """A standstill, its place (m; z is its middle's), its begin (log time) and length (ns)."""

    place: Vector3
    start: Ns
    duration: Ns


def placed_standstills(
    track: RobotTrack, spans: Iterable[Span], region: Region | None = None
) -> Iterator[PlacedStandstill]:
    """Yields standstills with their places on the track; only those in a region, if it is given.

    Standstills outside of the track's pieces are left out.
    """
    ends = bounds_of(spans).T
    if not len(track.times) or not len(ends):
        return
    times = np.linspace(ends[:, 0], ends[:, 1], _SAMPLES_OF_STAND, axis=1).astype(np.int64)
    is_known = _is_known(track, times)
    has_known = is_known.any(axis=1)
    ends, times, is_known = ends[has_known], times[has_known], is_known[has_known]
    *plane, height, _ = track.at(times)
    x_of, y_of = (np.nanmedian(np.where(is_known, axis, np.nan), axis=1) for axis in plane)
    z_of = height[:, _SAMPLES_OF_STAND // 2]
    rows = zip(*(column.tolist() for column in (x_of, y_of, z_of, *ends.T)), strict=True)
    for x, y, z, start, stop in rows:
        if region is None or contains(region, x, y, z):
            yield PlacedStandstill((x, y, z), start, stop - start)


def _is_known(track: RobotTrack, times: Ints) -> Flags:
    """Returns which log times lie in a piece of the track, or within `SILENCE_NS` of one."""
    starts, stops = track.pieces
    piece = np.searchsorted(starts - SILENCE_NS, times, side="right") - 1
    return (piece >= 0) & (times <= stops[piece] + SILENCE_NS)


def stood_at(
    this: Iterable[PlacedStandstill], other: Iterable[PlacedStandstill]
) -> list[StandstillPlace]:
    """Returns the places where the robot stood in two windows, and how long in each.

    A place is where the robot stood longest, and gathers standstills within `SAME_STAND_M` on its
    storey. The names of places are left empty.
    """
    stands = [*((stand, 0) for stand in this), *((stand, 1) for stand in other)]
    stands.sort(key=lambda numbered: (-numbered[0].duration, numbered[0]))
    middles, lasted = np.empty((len(stands), 3)), np.zeros((len(stands), 2), np.int64)
    count = 0
    for stand, window in stands:
        x, y, z = (middles[:count] - stand.place).T
        squared = np.where(np.abs(z) > STOREY_MM / 1000, np.inf, x * x + y * y)
        place = count
        if (squared <= SAME_STAND_M**2).any():
            place = int(squared.argmin())
        else:
            middles[count] = stand.place
            count += 1
        lasted[place, window] += stand.duration
    return [
        StandstillPlace((x, y, z), (), Pair(*map(unix_from_ns, lengths)))
        for (x, y, z), lengths in zip(middles[:count].tolist(), lasted.tolist(), strict=False)
    ]

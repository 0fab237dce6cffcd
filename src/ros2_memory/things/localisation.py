"""When localisation was poor: then a detection is not where it seems to be.

That is while the localiser's covariance is large, and for some seconds before the map jumps under
odometry, which shows that it had been off.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ros2_memory.analysis.sights import AHEAD_MM, Fix, Flags, Ints, Look, Sights, Spot
from ros2_memory.core.timebase import NS_PER_S

_POOR_MM: Final = 600
"""Standard deviation of a point 2 m before the robot."""
_JUMP_MM: Final = 300.0
"""So far the map moves that point in a jump."""
_BEFORE_NS: Final = 5 * NS_PER_S
_NEXT_NS: Final = 4 * NS_PER_S
_NEVER_NS: Final = 3600 * NS_PER_S
_KNOWN_NS: Final = 60 * NS_PER_S
"""What a localiser said holds as long; it says nothing while the robot stands."""


def poorly_localised(sights: Sights) -> tuple[Flags, Flags]:
    """Returns which spots and which looks are of a slice in which localisation was poor."""
    fixes = sights.fixes
    time = fixes[:, Fix.TIME]
    after = np.diff(time, append=time[-1:])
    after[after < 0] = _NEVER_NS  # the next one is of another session
    turn = np.radians((np.diff(fixes[:, Fix.YAW]) + 1800) % 3600 / 10 - 180)
    off = np.hypot(np.diff(fixes[:, Fix.X]), np.diff(fixes[:, Fix.Y])) + AHEAD_MM * np.abs(turn)
    jumped = np.flatnonzero((off > _JUMP_MM) & (after[:-1] <= _NEXT_NS))
    vague = np.flatnonzero(_sigma_said(fixes[:, Fix.SIGMA], after) > _POOR_MM)
    starts = np.concatenate((time[jumped] - _BEFORE_NS, time[vague]))
    stops = np.concatenate((time[jumped + 1], time[vague] + np.minimum(after[vague], _KNOWN_NS)))
    order = np.argsort(starts, kind="stable")
    starts, stops = starts[order], np.maximum.accumulate(stops[order])

    def are_poor(first: Ints, last: Ints) -> Flags:
        before = np.searchsorted(starts, last, side="right")
        poor: Flags = (before > 0) & (np.append(stops, 0)[before - 1] >= first)
        return poor

    spots, looks = sights.spots, sights.looks
    poor_spots = are_poor(spots[:, Spot.FIRST], spots[:, Spot.LAST])
    poor_looks = are_poor(looks[:, Look.FIRST], looks[:, Look.LAST])
    # Whole slices: else a look from beside would miss what a spot that is left out has seen.
    slices = np.union1d(spots[poor_spots, Spot.SLICE], looks[poor_looks, Look.SLICE])
    return np.isin(spots[:, Spot.SLICE], slices), np.isin(looks[:, Look.SLICE], slices)


def _sigma_said(sigma: Ints, after: Ints) -> Ints:
    """Returns the deviation (mm) that the localiser gave last, at each fix; -1 if not known.

    `after` is how long (ns) it is until the next fix.
    """
    is_new = sigma >= 0
    is_new[1:] |= after[:-1] > _KNOWN_NS
    last = np.maximum.accumulate(np.where(is_new, np.arange(len(sigma)), 0))
    return sigma[last]

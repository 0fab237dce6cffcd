"""Places of one label: clusters of the spots at which it was seen, over all time.

Places are what detections scatter around. They are found heaviest first on a grid, and every spot
then belongs to the nearest one, so that two things a metre apart stay two although the noise of
far detections overlaps.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.arrays import distinct_rows

if TYPE_CHECKING:
    from ros2_memory.analysis.sights import Flags, Floats, Ints


_CELL_MM: Final = 100
_PEAK_MM: Final = 300
"""Spots this near to each other make a peak."""
_CLAIM_MM: Final = 600
"""Spots this near to a place are of it before another place is looked for."""
GATE_MM: Final = 900
"""What was seen farther from a place is not of it."""
_HALO_SHARE: Final = 0.1
"""A peak within `GATE_MM` of another one, and lighter than this share of it, is its noise."""
_OWN_SHARE: Final = 0.5
"""But for one that has this share of its weight while it is seen: a thing that came there."""
_MIDDLE: Final = (10, 90)
"""Between these percentiles of its spots: noise of another one may have been there before."""
_SCATTER_MM: Final = 800
_FEW: Final = 25.0
"""So few detections, far away, may scatter as widely."""
_MAX_PLACES: Final = 512
_FULL_WEIGHT: Final = 10
"""A spot of more detections weighs no more: all of one slice share its error of localisation."""


def places_of(x: Ints, y: Ints, n: Ints, slices: Ints) -> Ints:
    """Returns the number of the place of each spot (mm), seen in a slice; -1 of none."""
    weight = np.minimum(n, _FULL_WEIGHT).astype(np.float64)
    cells, cell_of = distinct_rows((x // _CELL_MM, y // _CELL_MM))
    mass = np.bincount(cell_of, weight).astype(np.float64)
    centre = np.stack([np.bincount(cell_of, weight * axis) / mass for axis in (x, y)], axis=1)
    order = np.argsort(-_density(cells, mass), kind="stable")
    spots = _Spots(np.argsort(order, kind="stable")[cell_of], weight, slices)
    peaks = _peaks(centre[order], mass[order], spots)
    if not len(peaks):
        return np.full(len(x), -1, np.int64)
    place, away_squared = _nearest(np.stack((x, y), axis=1).astype(np.float64), peaks)
    place[away_squared > GATE_MM**2] = -1
    return place


class _Spots(NamedTuple):
    """The cell, the weight and the slice of each spot."""

    cell: Ints
    weight: Floats
    slice: Ints

    def share(self, cells: Flags, others: Flags) -> float:
        """Returns the weight of some cells by that of others, while most of it is seen."""
        is_inside = cells[self.cell]
        first, last = np.percentile(self.slice[is_inside], _MIDDLE)
        weight = self.weight * ((self.slice >= first) & (self.slice <= last))
        return float(weight[is_inside].sum() / max(weight[others[self.cell]].sum(), 1.0))


def _peaks(centre: Floats, mass: Floats, spots: _Spots) -> Floats:
    """Returns where the spots are densest, the densest first, `_CLAIM_MM` or more apart.

    `centre` and `mass` are of cells, the densest first.
    """
    is_free = np.ones(len(mass), bool)
    peaks, masses = np.empty((_MAX_PLACES, 2)), np.empty(_MAX_PLACES)
    count = 0
    for cell in range(len(mass)):
        if not is_free[cell]:
            continue
        # The cells before it are claimed.
        peak = _settled(centre[cell:], mass[cell:], is_free[cell:])
        is_claimed = is_free & (_away_squared(centre, peak) <= _CLAIM_MM**2)
        is_claimed[cell] = True
        weight = float(mass[is_claimed].sum())
        is_free[is_claimed] = False
        heavy = peaks[:count][_with_noise_at(peak, weight, peaks[:count], masses[:count])]
        if all(
            weight >= _FEW
            and spots.share(is_claimed, _away_squared(centre, other) <= _CLAIM_MM**2) > _OWN_SHARE
            for other in heavy
        ):
            peaks[count], masses[count] = peak, weight
            count += 1
        if count == _MAX_PLACES:
            break
    return peaks[:count]


def _settled(centre: Floats, mass: Floats, is_free: Flags) -> Floats:
    """Returns where the peak is that the first of some cells lies at: the mean of those near it."""
    peak: Floats = centre[0]
    for _ in range(3):
        near = np.flatnonzero(is_free & (_away_squared(centre, peak) <= _PEAK_MM**2))
        if not len(near):
            break
        # As `numpy.average`, which takes ten times as long for few rows.
        before, peak = peak, mass[near] @ centre[near] / mass[near].sum()
        if (before == peak).all():
            break
    return peak


def _with_noise_at(peak: Floats, weight: float, peaks: Floats, masses: Floats) -> Flags:
    """Returns which peaks are so heavy that one this light may be their noise."""
    away = _away_squared(peaks, peak)
    is_halo = (away <= GATE_MM**2) & (masses > weight / _HALO_SHARE)
    is_scatter = (away <= _SCATTER_MM**2) & (masses + weight < _FEW)
    may_be_noise: Flags = is_halo | is_scatter
    return may_be_noise


def _density(cells: Ints, mass: Floats) -> Floats:
    """Returns for each cell the mass of the cells around it."""
    reach = _PEAK_MM // _CELL_MM
    low = cells.min(axis=0) - reach
    width = int(cells[:, 1].max() - low[1]) + reach + 1
    keys = (cells[:, 0] - low[0]) * width + (cells[:, 1] - low[1])
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    density = np.zeros(len(cells))
    for dx, dy in product(range(-reach, reach + 1), repeat=2):
        if dx * dx + dy * dy <= reach * reach:
            near = keys + dx * width + dy
            row = np.minimum(np.searchsorted(ordered, near), len(ordered) - 1)
            # Whole numbers, whose sums do not depend on their order.
            density += np.where(ordered[row] == near, mass[order[row]], 0.0)
    return density


def _away_squared(points: Floats, middle: Floats) -> Floats:
    dx, dy = points[:, 0] - middle[0], points[:, 1] - middle[1]
    away: Floats = dx * dx + dy * dy  # several times as fast as `numpy.hypot`
    return away


def _nearest(points: Floats, peaks: Floats) -> tuple[Ints, Floats]:
    """Returns the nearest peak of each point, and its squared distance (mm²)."""
    nearest = np.zeros(len(points), np.int64)
    least = np.full(len(points), np.inf)
    for number, peak in enumerate(peaks):
        away = _away_squared(points, peak)
        is_closer = away < least
        nearest[is_closer] = number
        least[is_closer] = away[is_closer]
    return nearest, least

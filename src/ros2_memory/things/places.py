"""Places of labels: where the spots of one label belong together, over all time.

Places are what detections scatter around. They are found heaviest first on a grid, and every spot
then belongs to the nearest one, so that two things a metre apart stay two although the noise of
far detections overlaps.

Where a thing was moved a little (`stays_in`): a sighting is where something was seen in one slice,
the mean of some looks. It has three errors: the noise of each look; the error of localisation that
all looks of a *visit* share; and a bias along the view of the detector. A regression of all visits
on the side of the view and on a step says how large the step is, and how exactly that is known.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import chain, islice, pairwise, product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import running_end
from ros2_memory.analysis.sights import Spot
from ros2_memory.core.arrays import (
    Flags,
    Groups,
    Ints,
    distinct_rows,
    in_ranges,
    places_among,
    range_numbers,
    run_starts,
    stable_order,
)
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.sights import Floats

_CELL_MM: Final = 100
_PEAK_MM: Final = 300
"""Spots this near to each other make a peak."""
_CLAIM_MM: Final = 600
"""A new place claims the spots this near to it before another place is looked for."""
GATE_MM: Final = 900
"""A spot farther from every place belongs to none."""
_HALO_SHARE: Final = 0.1
"""A peak within `GATE_MM` of another one, and lighter than this share of it, is its noise."""
_OWN_SHARE: Final = 0.5
"""A peak that weighs more than this share of the other while it is seen is a thing of its own."""
MIDDLE: Final = (10, 90)
"""A peak is seen between these percentiles of its spots: earlier ones may be another's noise."""
_SCATTER_MM: Final = 800
_FEW: Final = 25.0
"""Fewer detections from far away may scatter over `_SCATTER_MM`."""
MAX_PLACES: Final = 2048
"""The most places of a label: stays are linked with each other, which takes the square of it."""
_FULL_WEIGHT: Final = 10
"""A spot of more detections weighs no more: all of one slice share its error of localisation."""


def places_of(x: Ints, y: Ints, n: Ints, slices: Ints) -> Ints:
    """Returns the number of each spot's place, or -1, for spots (mm) of one label.

    There are at most `MAX_PLACES`. `n` has the detections of each spot, `slices` its slice.
    """
    weight = np.minimum(n, _FULL_WEIGHT).astype(np.float64)
    cells, cell_of = distinct_rows((x // _CELL_MM, y // _CELL_MM))
    mass = np.bincount(cell_of, weight).astype(np.float64)
    centre = np.stack([np.bincount(cell_of, weight * axis) / mass for axis in (x, y)])
    order = stable_order(-_density(cells, mass))
    spots = _Spots(Groups.of(stable_order(order)[cell_of]), weight, slices)
    place, least = np.full(len(x), -1, np.int64), np.full(len(x), np.inf)
    points = _Points(x, y)
    peaks = _peaks(centre[:, order], mass[order], spots)
    for number, peak in enumerate(islice(peaks, MAX_PLACES)):
        near, squared = points.near(peak.x, peak.y, GATE_MM)
        is_nearest = squared < least[near]
        near = near[is_nearest]
        place[near], least[near] = number, squared[is_nearest]
    return place


class _Points:
    """Points of the plane (mm) by their x, so that few are compared: a hall has many places."""

    def __init__(self, x: Ints | Floats, y: Ints | Floats) -> None:
        self._order = stable_order(x)
        self._x, self._y = x[self._order], y[self._order]

    def near(self, x: float, y: float, reach_mm: float) -> tuple[Ints, Floats]:
        """Returns the points within a distance of another one, and their squared distances."""
        beside = slice(*np.searchsorted(self._x, (x - reach_mm, x + reach_mm + 1)).tolist())
        dx, dy = self._x[beside] - x, self._y[beside] - y
        squared = dx * dx + dy * dy
        is_near = squared <= reach_mm**2
        return self._order[beside][is_near], squared[is_near]


class _Spots(NamedTuple):
    """The weight and the slice of each spot, and the spots by their cell."""

    by_cell: Groups
    weight: Floats
    slice: Ints

    def share(self, cells: Ints, others: Ints) -> float:
        """Returns the weight in cells over that in others, while most of the former is seen."""
        own, beside = (self._in_cells(which) for which in (cells, others))
        first, last = np.percentile(self.slice[own], MIDDLE)
        weight, weight_of_others = (
            self.weight[rows][(self.slice[rows] >= first) & (self.slice[rows] <= last)].sum()
            for rows in (own, beside)
        )
        return float(weight / max(weight_of_others, 1.0))

    def _in_cells(self, cells: Ints) -> Ints:
        order, begins, sizes = self.by_cell
        return order[in_ranges(begins[cells], sizes[cells])]


class _Peak(NamedTuple):
    """A peak of density (mm), and the mass of the cells that it claims."""

    x: float
    y: float
    mass: float

    def may_be_noise_of(self, other: _Peak) -> bool:
        """Returns whether another peak is so near, and so much heavier, or both are so light."""
        away_mm = math.dist(self[:2], other[:2])
        is_halo = away_mm <= GATE_MM and other.mass > self.mass / _HALO_SHARE
        return is_halo or (away_mm <= _SCATTER_MM and other.mass + self.mass < _FEW)


def _peaks(centre: Floats, mass: Floats, spots: _Spots) -> Iterator[_Peak]:
    """Yields the peaks of density, the densest first, at least `_CLAIM_MM` apart.

    `centre` and `mass` are of cells, the densest first.
    """
    points, is_free = _Points(*centre), np.ones(len(mass), np.bool_)
    by_tile: dict[tuple[int, int], list[_Peak]] = {}
    for cell in range(len(mass)):
        if not is_free[cell]:
            continue
        at_x, at_y = centre[:, cell].tolist()
        around, _ = points.near(at_x, at_y, _PEAK_MM)
        around = around[is_free[around]]
        x, y = np.average(centre[:, around], axis=1, weights=mass[around]).tolist()
        claimed, _ = points.near(x, y, _CLAIM_MM)
        claimed = claimed[is_free[claimed]]
        is_free[claimed] = False
        peak = _Peak(x, y, float(mass[claimed].sum()))
        column, row = int(x // GATE_MM), int(y // GATE_MM)
        tiles = product((column - 1, column, column + 1), (row - 1, row, row + 1))
        beside = chain.from_iterable(by_tile.get(tile, ()) for tile in tiles)
        hosts = [other for other in beside if peak.may_be_noise_of(other)]
        of_hosts = (points.near(host.x, host.y, _CLAIM_MM)[0] for host in hosts)
        if hosts and peak.mass < _FEW:
            continue
        if any(spots.share(claimed, of_host) <= _OWN_SHARE for of_host in of_hosts):
            continue
        by_tile.setdefault((column, row), []).append(peak)
        yield peak


def _density(cells: Ints, mass: Floats) -> Floats:
    """Returns the mass of the cells around each cell."""
    reach = _PEAK_MM // _CELL_MM
    low = cells.min(axis=0) - reach
    width = int(cells[:, 1].max() - low[1]) + reach + 1
    keys = (cells[:, 0] - low[0]) * width + (cells[:, 1] - low[1])  # ascending, as the cells
    around = [*product(range(-reach, reach + 1), repeat=2)]
    steps = [dx * width + dy for dx, dy in around if dx * dx + dy * dy <= reach * reach]
    row, is_there = places_among(np.array(steps)[:, None] + keys, keys)
    # Whole numbers, whose sums do not depend on their order.
    density: Floats = np.where(is_there, np.append(mass, 0.0)[row], 0.0).sum(axis=0)
    return density


_PAUSE_NS: Final = 60 * NS_PER_S
"""A visit ends where nothing is seen for longer."""
_FEWEST: Final = 3
"""Fewer looks move nothing."""
LEAST_MM: Final = 150.0
"""A step that is shorter is none, however sure it is."""
_SIGMAS: Final = 5.0
"""A step of more standard errors is no chance, although it may be at any of many times."""
_BIAS_MM: Final = 40.0
"""Standard deviation of the bias by side: half of the difference between opposite sides."""
_LOOK_MM: Final = 50.0
"""Usual standard deviation of one look, which the looks at a thing correct."""
_VISIT_MM: Final = 40.0
"""Usual standard deviation of the error that the looks of a visit share; visits correct it."""
_LEAST_VISIT_MM: Final = 20.0
"""The least that is assumed for a thing: a few visits may agree by chance."""
_AT_ONCE: Final = 8_192
"""Sightings that are looked at together: more take more memory, and no less time."""
_USUAL: Final = 8
"""The usual variance weighs as much as this many looks, or differences between visits."""


def visits_of(first: Ints, last: Ints, thing: Ints | int = 0) -> Ints:
    """Returns the number of each sighting's visit. Things are in ascending order."""
    things = np.broadcast_to(thing, len(last))
    latest = running_end(things, last)
    begins = (first[1:] > latest[:-1] + _PAUSE_NS) | (things[1:] != things[:-1])
    return np.concatenate(([0], np.cumsum(begins)))


def stays_in(spots: Ints, n: Ints, side: Floats, thing: Ints) -> list[Ints]:
    """Returns the stay of each sighting of some things, numbered from 0 for each thing.

    Args:
        spots: rows of `Spot`, of each thing at least one, in order of time.
        n: how many looks of each count.
        side: the mean unit vector from the robot to the place; 0 if that is unknown.
        thing: the number of each sighting's thing, in order, without a gap.
    """
    series = _Series.of(spots, n, side, thing)
    begins = run_starts(series.thing)
    variance = _visit_variances(_differences(series))
    stays = np.cumsum(_are_moved(series, variance))
    return np.split(stays - stays[begins][series.thing], begins[1:])


class _Series(NamedTuple):
    """The sightings of all things, prepared for the regression.

    Attributes:
        columns: 1, the side (x, y) and the place (x, y), times the weight of the looks (1/mm²).
        visit: the number of each sighting's visit, counted through all things.
    """

    columns: Floats
    n: Ints
    visit: Ints
    thing: Ints

    @classmethod
    def of(cls, spots: Ints, n: Ints, side: Floats, thing: Ints) -> _Series:
        xy = spots[:, [Spot.X, Spot.Y]]
        sizes = np.bincount(thing)
        begins = np.cumsum(sizes) - sizes
        squares = n * spots[:, Spot.DEV] ** 2 / 2
        looks = np.add.reduceat(n, begins) - sizes + _USUAL
        usual = (np.add.reduceat(squares, begins) + _USUAL * _LOOK_MM**2) / looks
        weight = n * (n - 1 + _USUAL) / (squares + _USUAL * usual[thing])
        place = xy - (np.add.reduceat(xy, begins) / sizes[:, None])[thing]
        columns = np.vstack((np.ones(len(weight)), side.T, place.T)) * weight
        visit = visits_of(spots[:, Spot.FIRST], spots[:, Spot.LAST], thing)
        return cls(columns, n, visit, thing)


def _differences(series: _Series) -> list[Floats]:
    """Returns the variances (mm²) that visits add to each thing, from consecutive visits.

    They ascend. The largest one is left out: the thing may have been moved between those visits.
    """
    starts = run_starts(series.visit)
    sums, thing = np.add.reduceat(series.columns, starts, axis=1), series.thing[starts]
    means = sums / sums[0]
    begins = run_starts(thing)
    equations = np.add.reduceat(_normal_equations(sums, _VISIT_MM**2), begins, axis=2)
    equations = equations.transpose(2, 0, 1)
    fit = np.linalg.solve(equations[:, :, :3] + np.diag(_PRIOR), equations[:, :, 3:])
    off = means[3:] - np.einsum("iv,vij->jv", means[:3], fit[thing])
    by_looks = 1 / sums[0, :-1] + 1 / sums[0, 1:]
    # The median of a squared distance in the plane is 2 ln 2 times the variance of each axis.
    variance = ((np.diff(off) ** 2).sum(axis=0) / (2 * math.log(2)) - by_looks) / 2
    differences = []
    for begin, end in pairwise([*begins, len(thing)]):
        # The last visit's difference is to the next thing.
        differences.append(np.sort(variance[begin : end - 1])[:-1])
    return differences


def _visit_variances(differences: Sequence[Floats]) -> Floats:
    """Returns the variance (mm²) that visits add to each thing."""
    every = np.sort(np.concatenate(differences))
    usual = _shrunk(len(every), _median(every), _VISIT_MM**2)
    sizes = np.array([*map(len, differences)])
    return _shrunk(sizes, np.array([*map(_median, differences)]), usual)


def _median(ordered: Floats) -> float:
    """Returns the median of values in order; 0 for none. `numpy.median` is slower for few."""
    n = len(ordered)
    return float(ordered[(n - 1) // 2] + ordered[n // 2]) / 2 if n else 0.0


def _shrunk(n: Ints | int, median: Floats | float, usual: Floats | float) -> Floats:
    """Returns the median of `n` variances, pulled towards the usual one: the more, the fewer."""
    return np.maximum((n * median + _USUAL * usual) / (n + _USUAL), _LEAST_VISIT_MM**2)


_PRIOR: Final = np.array([1e-12, _BIAS_MM**-2, _BIAS_MM**-2])
"""What is known (1/mm²) of the place, and of the bias by side in x and y, before any look.

Next to nothing is known of the place: just enough for the equations to have a solution.
"""


def _normal_equations(sums: Floats, visit_variance: Floats | float) -> Floats:
    """Returns each visit's part of the normal equations of the regression: 3 x 5 x visits."""
    weight = np.maximum(sums[0], 1e-30)
    added: Floats = sums[:3, None] * sums * (1 / weight / (1 + visit_variance * weight))
    return added


def _are_moved(series: _Series, variance: Floats) -> Flags:
    """Returns before which sightings a thing was moved. `variance` is each thing's, of visits.

    A step splits its thing in two, and each part is looked at again.
    """
    moved = np.zeros(len(series.n), np.bool_)
    begins = run_starts(series.thing).tolist()
    waiting = deque(pairwise([*begins, len(moved)]))
    while waiting:
        spans, size = [], 0
        while waiting and size < _AT_ONCE:
            start, stop = waiting.popleft()
            spans.append((start, stop))
            size += stop - start
        rows = np.concatenate([np.arange(*span) for span in spans])
        number = range_numbers([stop - start for start, stop in spans])
        batch = _Series(series.columns[:, rows], series.n[rows], series.visit[rows], number)
        for span, row in _likeliest_steps(batch, variance[series.thing[rows]]):
            start, stop = spans[span]
            step = int(rows[row])
            moved[step] = True
            waiting += [(start, step), (step, stop)]
    return moved


def _likeliest_steps(series: _Series, variance: Floats) -> Iterator[tuple[int, int]]:
    """Yields each thing with a sure step, and the first sighting after its likeliest one.

    `variance` is that of each sighting's visit.
    """
    begins = run_starts(series.thing)
    looks = np.cumsum(series.n)
    looks_of_others = (looks - series.n)[begins]
    looks_before = looks - looks_of_others[series.thing]
    looks_after = np.add.reduceat(series.n, begins)[series.thing] - looks_before
    at = np.flatnonzero((looks_before >= _FEWEST) & (looks_after >= _FEWEST)) + 1
    if not len(at):
        return
    old, new = _before_and_after(series, begins, at, variance)
    squares = _squared_errors(old, new)
    # For each thing the likeliest step; of equal ones the first.
    order = np.lexsort((at, -squares, series.thing[at]))
    things, first = np.unique(series.thing[at[order]], return_index=True)
    best = order[first]
    is_sure = squares[best] > _SIGMAS**2
    yield from zip(things[is_sure].tolist(), at[best[is_sure]].tolist(), strict=True)


def _squared_errors(old: Floats, new: Floats) -> Floats:
    """Returns the square of each step's length in standard errors; 0 for a step that is too short.

    `old` and `new` are the normal equations before and after the step. The unknowns are the place,
    the bias in x and y, and the step.
    """
    both, of_new = old + new, new[0]
    both[[0, 1, 2], [0, 1, 2]] += _PRIOR[:, None]
    # Three equations and that of the step, with right sides in x and y: eliminate the first three.
    rows = np.insert(both, 3, of_new[:3], axis=1)
    rows = np.concatenate((rows, of_new[None, [0, 1, 2, 0, 3, 4]]))
    for nth in range(3):
        share = rows[nth + 1 :, nth] / rows[nth, nth]
        rows[nth + 1 :] -= share[:, None] * rows[nth]
    weight, *sums = rows[3, 3:]
    length_squared = sum((side / weight) ** 2 for side in sums)
    return np.where(length_squared >= LEAST_MM**2, length_squared * weight, 0.0)


def _before_and_after(
    series: _Series, begins: Ints, at: Ints, variance: Floats
) -> tuple[Floats, Floats]:
    """Returns the normal equations of a thing's visits before and after each step.

    A step may lie within a visit. `begins` has where each thing begins.
    """
    is_start = np.diff(series.visit, prepend=-1) != 0
    is_start[begins] = True
    starts = np.flatnonzero(is_start)
    ends = np.append(starts, len(series.n))
    sums = np.hstack((np.zeros((5, 1)), np.cumsum(series.columns, axis=1)))
    squares = _normal_equations(np.diff(sums[:, ends]), variance[starts])
    until = np.concatenate((np.zeros((3, 5, 1)), np.cumsum(squares, axis=2)), axis=2)
    first = np.searchsorted(starts, begins)
    stop = np.append(first[1:], len(starts))
    visit, thing, own = np.searchsorted(starts, at) - 1, series.thing[at], variance[at]
    here, begin, end = sums[:, at], sums[:, ends[visit]], sums[:, ends[visit + 1]]
    old = until[..., visit] - until[..., first[thing]] + _normal_equations(here - begin, own)
    new = until[..., stop[thing]] - until[..., visit + 1] + _normal_equations(end - here, own)
    return old, new

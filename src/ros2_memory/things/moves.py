"""Where a thing was moved a little: the stays at one place, as steps in a series of sightings.

A sighting is where something was seen in one slice: the mean of some looks. It is off by the noise
of each look; by that of its *visit*, whose looks share their error of localisation; and by the side
that it is seen from, since detectors are biased along their view. A regression of all visits on the
side and on a step says how large the step is, and how exactly that is known.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.sights import Flags, Floats, Ints


_PAUSE_NS: Final = 60 * NS_PER_S
"""A visit ends where nothing is seen for longer."""
_FEWEST: Final = 3
"""Fewer looks move nothing."""
LEAST_MM: Final = 150.0
"""A step that is shorter is none, however sure it is."""
_SIGMAS: Final = 5.0
"""So many standard errors are no chance, although a thing may be moved at any of many times."""
_BIAS_MM: Final = 40.0
"""Standard deviation of the bias by side: half of the difference between opposite sides."""
_LOOK_MM: Final = 50.0
"""Usual standard deviation of one look, which the looks at a thing correct."""
_VISIT_MM: Final = 40.0
"""Usual standard deviation of what the looks of a visit share, which all visits correct."""
_LEAST_VISIT_MM: Final = 20.0
"""That of a thing is taken for no less: a few visits may agree by chance."""
_AT_ONCE: Final = 8_192
"""Sightings that are looked at together: more take more memory, and no less time."""
_USUAL: Final = 8
"""What is usual weighs as much as so many looks, or differences between visits."""


class Sightings(NamedTuple):
    """Sightings of one thing in order of time, at least one.

    Attributes:
        xy: the mean of `n` looks (mm); `dev` is their root mean square distance from it.
        side: the mean of the unit vectors from the robot to it; 0 where that is not known.
        first, last: of the looks (ns).
    """

    xy: Floats
    n: Ints
    dev: Ints | Floats
    side: Floats
    first: Ints
    last: Ints


def visits_of(first: Ints, last: Ints, thing: Ints | int = 0) -> Ints:
    """Returns the number of the visit of each sighting, of things in ascending order."""
    # The latest so far of a thing, as its place among all: these are small numbers.
    order = np.argsort(last, kind="stable")
    rank = np.empty(len(last), np.int64)
    rank[order] = np.arange(len(last))
    offset = np.broadcast_to(thing, len(last)) * len(last)
    latest = last[order][np.maximum.accumulate(rank + offset) - offset]
    begins = (first[1:] > latest[:-1] + _PAUSE_NS) | (offset[1:] != offset[:-1])
    return np.concatenate(([0], np.cumsum(begins)))


def stays_in(things: Sequence[Sightings]) -> list[Ints]:
    """Returns for the sightings of each thing the number of the stay of each, from 0."""
    if not things:
        return []
    series = _Series.of(things)
    begins = np.flatnonzero(np.diff(series.thing, prepend=-1))
    variance = _visit_variances(*_differences(series), len(things))
    stays = np.cumsum(_are_moved(series, variance))
    return np.split(stays - stays[begins][series.thing], begins[1:])


class _Series(NamedTuple):
    """Sightings as rows of 1, the side and the place, by the weight of their looks (1/mm²).

    Of all things, which are numbered; visits are numbered through all of them.
    """

    rows: Floats
    n: Ints
    visit: Ints
    thing: Ints

    @classmethod
    def of(cls, things: Sequence[Sightings]) -> _Series:
        sizes = np.array([len(sightings.n) for sightings in things])
        thing, begins = np.repeat(np.arange(len(things)), sizes), np.cumsum(sizes) - sizes
        xy, n, dev, side, first, last = map(np.concatenate, zip(*things, strict=True))
        squares = n * dev**2 / 2
        looks = np.add.reduceat(n, begins) - sizes + _USUAL
        usual = (np.add.reduceat(squares, begins) + _USUAL * _LOOK_MM**2) / looks
        weight = n * (n - 1 + _USUAL) / (squares + _USUAL * usual[thing])
        place = xy - (np.add.reduceat(xy, begins) / sizes[:, None])[thing]
        rows = np.hstack((np.ones((len(weight), 1)), side, place)) * weight[:, None]
        return cls(rows, n, visits_of(first, last, thing), thing)


def _differences(series: _Series) -> tuple[Floats, Ints]:
    """Returns what visits add to the variance (mm²), by each two of a thing in a row; its number.

    Not by the two that differ most: between these it may have been moved. Ascending for each thing.
    """
    starts = np.flatnonzero(np.diff(series.visit, prepend=-1))
    sums, thing = np.add.reduceat(series.rows, starts), series.thing[starts]
    means = sums / sums[:, :1]
    begins = np.flatnonzero(np.diff(thing, prepend=-1))
    normal = np.add.reduceat(_squares(sums, _VISIT_MM**2), begins)
    fit = np.linalg.solve(normal[:, :3, :3] + np.diag(_PRIOR[:3]), normal[:, :3, 3:])
    off = means[:, 3:] - np.einsum("vi,vij->vj", means[:, :3], fit[thing])
    by_looks = 1 / sums[:-1, 0] + 1 / sums[1:, 0]
    variance = ((np.diff(off, axis=0) ** 2).sum(axis=1) / (2 * math.log(2)) - by_looks) / 2
    is_of_one = thing[1:] == thing[:-1]
    variance, thing = variance[is_of_one], thing[1:][is_of_one]
    order = np.lexsort((variance, thing))
    variance, thing = variance[order], thing[order]
    is_greatest = np.diff(thing, append=-1) != 0
    return variance[~is_greatest], thing[~is_greatest]


def _visit_variances(differences: Floats, thing: Ints, things: int) -> Floats:
    """Returns what visits add to the variance (mm²) of each thing."""
    median = float(np.median(differences)) if len(differences) else 0.0
    usual = _shrunk(len(differences), median, _VISIT_MM**2)
    sizes = np.bincount(thing, minlength=things)
    begins = np.cumsum(sizes) - sizes
    visited = np.flatnonzero(sizes)
    medians = np.zeros(things)
    low = begins[visited] + (sizes[visited] - 1) // 2
    high = begins[visited] + sizes[visited] // 2
    medians[visited] = (differences[low] + differences[high]) / 2
    return _shrunk(sizes, medians, usual)


def _shrunk(n: Ints | int, median: Floats | float, usual: Floats | float) -> Floats:
    """Returns the median of `n` variances, drawn to what is usual the more the fewer they are."""
    return np.maximum((n * median + _USUAL * usual) / (n + _USUAL), _LEAST_VISIT_MM**2)


_PRIOR: Final = np.array([1e-12, _BIAS_MM**-2, _BIAS_MM**-2, 0.0])
"""What is known (1/mm²) before any look of the place, the bias by side in x and y, and the step.

Of the place next to nothing, so that the equations have a solution; of the step nothing.
"""


def _squares(sums: Floats, visit: Floats | float) -> Floats:
    """Returns the squares of visits' means, each by its weight; `visit` is their own variance."""
    weight = np.maximum(sums[:, 0], 1e-30)
    scale = 1 / weight / (1 + visit * weight)
    squares: Floats = sums[:, :, None] * sums[:, None, :] * scale[:, None, None]
    return squares


def _are_moved(series: _Series, variance: Floats) -> Flags:
    """Returns the sightings before which a thing was moved; `variance` of visits is by thing."""
    moved = np.zeros(len(series.n), np.bool_)
    begins = np.flatnonzero(np.diff(series.thing, prepend=-1)).tolist()
    waiting = [*pairwise([*begins, len(moved)])]
    while waiting:
        spans, size = [], 0
        while waiting and size < _AT_ONCE:
            start, stop = waiting.pop()
            spans.append((start, stop))
            size += stop - start
        rows = np.concatenate([np.arange(*span) for span in spans])
        number = np.repeat(np.arange(len(spans)), [stop - start for start, stop in spans])
        batch = _Series(series.rows[rows], series.n[rows], series.visit[rows], number)
        for span, row in _steps(batch, variance[series.thing[rows]]):
            start, stop = spans[span]
            step = int(rows[row])
            moved[step] = True
            waiting += [(start, step), (step, stop)]
    return moved


def _steps(series: _Series, variance: Floats) -> Iterator[tuple[int, int]]:
    """Yields the things with a step, and the first sighting after the likeliest one.

    `variance` is that of the visit of each sighting.
    """
    begins = np.flatnonzero(np.diff(series.thing, prepend=-1))
    looks = np.cumsum(series.n)
    of_others, total = (looks - series.n)[begins], np.add.reduceat(series.n, begins)
    old_looks = looks - of_others[series.thing]
    new_looks = total[series.thing] - old_looks
    at = np.flatnonzero((old_looks >= _FEWEST) & (new_looks >= _FEWEST)) + 1
    if not len(at):
        return
    old, new = _before_and_after(series, begins, at, variance)
    likely = _likelihoods(old, new)
    # Of each thing the likeliest, of equal ones the first.
    order = np.lexsort((at, -likely, series.thing[at]))
    things, first = np.unique(series.thing[at[order]], return_index=True)
    best = order[first]
    is_sure = likely[best] > _SIGMAS**2
    yield from zip(things[is_sure].tolist(), at[best[is_sure]].tolist(), strict=True)


def _likelihoods(old: Floats, new: Floats) -> Floats:
    """Returns for each step, by the squares before and after it, how many standard errors it is.

    Squared; 0 of one that is too short to be any.
    """
    both = old + new
    normal = np.zeros((len(both), 4, 4))
    normal[:, :3, :3] = both[:, :3, :3]
    normal[:, 3, :3] = normal[:, :3, 3] = new[:, 0, :3]
    normal[:, 3, 3] = new[:, 0, 0]
    right = np.concatenate((both[:, :3, 3:], new[:, :1, 3:]), axis=1)
    inverse = np.linalg.inv(normal + np.diag(_PRIOR))
    length_squared = ((inverse @ right)[:, 3] ** 2).sum(axis=1)
    return np.where(length_squared >= LEAST_MM**2, length_squared / inverse[:, 3, 3], 0.0)


def _before_and_after(
    series: _Series, begins: Ints, at: Ints, variance: Floats
) -> tuple[Floats, Floats]:
    """Returns the squares of a thing's visits before and after each step, which may be within one.

    `begins` has where each thing begins.
    """
    is_start = np.diff(series.visit, prepend=-1) != 0
    is_start[begins] = True
    starts = np.flatnonzero(is_start)
    ends = np.append(starts, len(series.n))
    sums = np.vstack((np.zeros((1, 5)), np.cumsum(series.rows, axis=0)))
    squares = _squares(np.diff(sums[ends], axis=0), variance[starts])
    until = np.concatenate((np.zeros((1, 5, 5)), np.cumsum(squares, axis=0)))
    first = np.searchsorted(starts, begins)
    stop = np.append(first[1:], len(starts))
    visit, thing, own = np.searchsorted(starts, at) - 1, series.thing[at], variance[at]
    old = until[visit] - until[first[thing]] + _squares(sums[at] - sums[ends[visit]], own)
    new = until[stop[thing]] - until[visit + 1] + _squares(sums[ends[visit + 1]] - sums[at], own)
    return old, new

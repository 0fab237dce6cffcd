"""Where a thing was moved a little: the stays at one place, as steps in a series of sightings.

A sighting is where something was seen in one bag: the mean of some looks. It is off by the noise of
each look; by that of its *visit*, whose looks share their error of localisation; and by the side
that it is seen from, since detectors are biased along their view. A regression of all visits on the
side and on a step says how large the step is, and how exactly that is known.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.sights import Floats, Ints


_PAUSE_NS: Final = 60 * NS_PER_S
"""A visit ends where nothing is seen for longer."""
_FEWEST: Final = 3
"""Fewer looks move nothing."""
_LEAST_MM: Final = 150.0
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


def visits_of(first: Ints, last: Ints) -> Ints:
    """Returns the number of the visit of each sighting."""
    ends: Ints = np.maximum.accumulate(last)[:-1]
    return np.concatenate(([0], np.cumsum(first[1:] > ends + _PAUSE_NS)))


def stays_in(every: Sequence[Sightings]) -> list[Ints]:
    """Returns for the sightings of each thing the number of the stay of each, from 0."""
    series = [_Series.of(seen) for seen in every]
    differences = [_differences(each) for each in series]
    usual = _variance(np.concatenate([np.zeros(0), *differences]), _VISIT_MM**2)
    return [
        _split(each, _variance(some, usual)) for each, some in zip(series, differences, strict=True)
    ]


class _Series(NamedTuple):
    """Sightings as rows of 1, the side and the place, by the weight of their looks (1/mm²)."""

    rows: Floats
    n: Ints
    visit: Ints

    @classmethod
    def of(cls, seen: Sightings) -> _Series:
        squares = seen.n * seen.dev**2 / 2
        usual = (squares.sum() + _USUAL * _LOOK_MM**2) / (seen.n.sum() - len(seen.n) + _USUAL)
        weight = seen.n * (seen.n - 1 + _USUAL) / (squares + _USUAL * usual)
        place = seen.xy - seen.xy.mean(axis=0)
        rows = np.hstack((np.ones((len(weight), 1)), seen.side, place)) * weight[:, None]
        return cls(rows, seen.n, visits_of(seen.first, seen.last))


def _differences(series: _Series) -> Floats:
    """Returns what visits add to the variance, by each two that follow each other.

    Not by the two that differ most: between these it may have been moved.
    """
    starts = np.flatnonzero(np.diff(series.visit, prepend=-1))
    sums = np.add.reduceat(series.rows, starts)
    means = sums / sums[:, :1]
    normal = _squares(sums, _VISIT_MM**2).sum(axis=0)
    fit = np.linalg.solve(normal[:3, :3] + np.diag(_PRIOR[:3]), normal[:3, 3:])
    off = means[:, 3:] - means[:, :3] @ fit
    by_looks = 1 / sums[:-1, 0] + 1 / sums[1:, 0]
    found = ((np.diff(off, axis=0) ** 2).sum(axis=1) / (2 * math.log(2)) - by_looks) / 2
    return np.sort(found)[:-1]


def _variance(differences: Floats, usual: float) -> float:
    n = len(differences)
    median = float(np.median(differences)) if n else 0.0
    return max((n * median + _USUAL * usual) / (n + _USUAL), _LEAST_VISIT_MM**2)


_PRIOR: Final = np.array([1e-12, _BIAS_MM**-2, _BIAS_MM**-2, 0.0])
"""What is known (1/mm²) before any look of the place, the bias by side in x and y, and the step.

Of the place next to nothing, so that the equations have a solution; of the step nothing.
"""


def _squares(sums: Floats, visit: float) -> Floats:
    """Returns the squares of visits' means, each by its weight; `visit` is their own variance."""
    weight = np.maximum(sums[:, :1, None], 1e-30)
    squares: Floats = sums[:, :, None] * sums[:, None, :] / weight / (1 + visit * weight)
    return squares


def _split(series: _Series, visit: float) -> Ints:
    """Returns the number of the stay of each sighting."""
    stay = np.zeros(len(series.n), np.int64)
    waiting = [(0, len(stay))]
    while waiting:
        start, stop = waiting.pop()
        here = slice(start, stop)
        part = _Series(series.rows[here], series.n[here], series.visit[here])
        at = _step(part, visit)
        if at:
            stay[start + at :] += 1
            waiting += [(start, start + at), (start + at, stop)]
    return stay


def _step(series: _Series, visit: float) -> int:
    """Returns the first sighting after the likeliest step; 0 where there is none."""
    seen = np.cumsum(series.n)
    at = np.flatnonzero((seen >= _FEWEST) & (seen[-1] - seen >= _FEWEST)) + 1
    if not len(at):
        return 0
    old, new = _before_and_after(series, at, visit)
    normal = np.zeros((len(at), 4, 4))
    normal[:, :3, :3] = (old + new)[:, :3, :3]
    normal[:, 3, :3] = normal[:, :3, 3] = new[:, 0, :3]
    normal[:, 3, 3] = new[:, 0, 0]
    right = np.concatenate(((old + new)[:, :3, 3:], new[:, :1, 3:]), axis=1)
    inverse = np.linalg.inv(normal + np.diag(_PRIOR))
    moved = ((inverse @ right)[:, 3] ** 2).sum(axis=1)
    likely = np.where(moved >= _LEAST_MM**2, moved / inverse[:, 3, 3], 0.0)
    best = int(likely.argmax())
    return int(at[best]) if likely[best] > _SIGMAS**2 else 0


def _before_and_after(series: _Series, at: Ints, visit: float) -> tuple[Floats, Floats]:
    """Returns the squares of the visits before and after each step, which may be within a visit."""
    starts = np.flatnonzero(np.diff(series.visit, prepend=-1))
    sums = np.vstack((np.zeros((1, 5)), np.cumsum(series.rows, axis=0)))
    ends = np.append(starts, len(series.n))
    squares = _squares(np.diff(sums[ends], axis=0), visit)
    until = np.concatenate((np.zeros((1, 5, 5)), np.cumsum(squares, axis=0)))
    of = np.searchsorted(starts, at, side="right") - 1
    of -= starts[of] == at
    old = until[of] + _squares(sums[at] - sums[ends[of]], visit)
    new = until[-1] - until[of + 1] + _squares(sums[ends[of + 1]] - sums[at], visit)
    return old, new

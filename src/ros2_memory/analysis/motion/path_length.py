"""How far a robot drove, measured from positions with noise.

The sum of the distances between noisy positions grows with their number, also where the robot is
stationary: 10 mm of noise at 50 Hz add up to 1.1 m a second. So the length of each step is the
slope of a line fitted to the positions around it, over as few of them as the noise allows:

- The noise of each axis is estimated from the positions themselves, by their fourth differences,
  which are nearly zero on a smooth path (difference-based variance estimation: Gasser, Sroka and
  Jennen-Steinmetz, Biometrika 73, 1986; Hall, Kay and Titterington, Biometrika 77, 1990). These are
  averaged by their square roots, so that a corner does not count as noise.
- A least-squares slope over n positions has the variance 12 s^2 / (n (n^2 - 1)). Of the widths 2,
  4, 8, 16 and 32 each step takes the smallest one at which the slopes around it are clear of their
  noise (Lepski's rule: Theory of Probability and its Applications 36, 1991). Width 2 is the plain
  distance of two positions: paths without noise keep their plain length.
- Noise across the path makes a slope longer, by its variance over twice the slope at first order:
  that is subtracted from the square (Gudbjartsson and Patz, Magnetic Resonance in Medicine 34,
  1995).
- Between positions more than 0.25 s apart turns are unknown: they keep their plain length, except
  where they scatter around one place as their noise does (von Neumann's ratio, Annals of
  Mathematical Statistics 12, 1941).
- Where not even the widest slope is clear of the noise for long, the robot stands or creeps: only
  when the mean of 33 positions leaves the last such place by more than the noise, that counts as
  driven.

Noise that is slow, as a drift over seconds, cannot be distinguished from driving and counts as it.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ros2_memory.core.arrays import Flags, Floats, Vectors, row_maxima, row_sums, runs_where

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.core.model import Vector3

FEWEST: Final = 16
"""Positions below which no noise is estimated, and the plain sum is the length."""

_WIDTHS: Final = (2, 4, 8, 16, 32)
_ORDER: Final = 4
_NOISE_SPAN: Final = 32
"""The noise at a position is the mean of so many fourth differences on either side."""
_SLOPE_SPAN: Final = 6
"""The mean square of so many slopes on either side of a step is compared with their noise."""
_CLEAR: Final = 12.0
"""A mean square slope of so many times the variance of a slope is clear of noise."""
_STATIONARY: Final = 9.0
"""The widest slopes of a stationary robot are below so many times their variance.

Slopes of noise alone are above it once in some 10^5 independent windows (chi-square, 3 degrees).
"""
_PLAIN: Final = 0.002
"""If noise adds less than this share, the plain distance of two positions is the length."""
_STATIONARY_STEPS: Final = _WIDTHS[-1]
_MEAN_SPAN: Final = 16
_DENSE_S: Final = 0.25
"""Fourth differences of positions farther apart in time take turns of the robot for noise."""
_SPREAD: Final = (0.6, 2.0)
"""Positions so rare are of one place if they spread by so many times their noise around it."""
_LEFT: Final = 6.0
"""A robot has left a place when it is more than so many standard deviations away."""
_AHEAD: Final = 64
"""The next place is searched in so many positions, then in twice as many, and so on."""
_ROOT_MEAN: Final = (2**0.25 * math.gamma(0.75) / math.sqrt(math.pi)) ** 2
"""The squared mean of the square root of a standard normal variable's magnitude."""
_GROWTH: Final = math.sqrt(math.comb(2 * _ORDER, _ORDER))
"""The standard deviation of a difference of this order, of independent unit noise."""

SPEED_WINDOW_S: Final = 1.0
SPEED_STEPS: Final = 8
_JITTER_S: Final = 0.1
"""The shortest time by which a distance is divided: log times may come in bursts."""
_SLACK_S: Final = 1e-6


class Creep(NamedTuple):
    """The path of a robot that stands or creeps, from place to place.

    Attributes:
        start: the first place (m).
        second: the place after it; None if the robot never clearly left the first one.
        middle_m: length from the second place to the last.
        end: the last place (m).
        reach_m: how far from the last place another one must be to count.
    """

    start: Vector3
    second: Vector3 | None
    middle_m: float
    end: Vector3
    reach_m: float

    @property
    def length_m(self) -> float:
        """Length from the first place to the last."""
        return 0.0 if self.second is None else math.dist(self.start, self.second) + self.middle_m

    def with_place(self, place: Vector3) -> Creep:
        """Returns the creep with one more place, if that is out of reach of the last one."""
        step = math.dist(self.end, place)
        if step <= self.reach_m:
            return self
        if self.second is None:
            return self._replace(second=place, end=place)
        return self._replace(middle_m=self.middle_m + step, end=place)

    def joined(self, later: Creep) -> Creep:
        """Returns this creep continued by a later one."""
        reach_m = max(self.reach_m, later.reach_m)
        whole = self._replace(reach_m=reach_m).with_place(later.start)
        if later.second is None:
            return whole
        step = math.dist(whole.end, later.second)
        if whole.second is None:
            return whole._replace(second=later.second, middle_m=later.middle_m, end=later.end)
        return whole._replace(middle_m=whole.middle_m + step + later.middle_m, end=later.end)


class End(NamedTuple):
    """How a path begins or ends, for joining another to it.

    Attributes:
        pace_m: the length of the step at this end.
        noise_m: the standard deviation of a position.
        plain: whether the step is the plain distance of its positions.
        creep: the creep that reaches this end; its length is not counted yet.
    """

    pace_m: float
    noise_m: float
    plain: bool
    creep: Creep | None


class _StepLengths(NamedTuple):
    """The lengths of the steps of a path.

    Attributes:
        lengths: for each step, its length (m) without noise.
        as_plain: whether it is the plain distance of two positions.
        stationary: whether it is noise of a robot that stands or creeps.
    """

    lengths: Floats
    as_plain: Flags
    stationary: Flags


class Measured(NamedTuple):
    """The measurements of a path in one piece.

    Attributes:
        length_m: its length except for the creeps at its ends.
        sum_m: the sum of the distances between its positions.
        head: how it begins.
        tail: how it ends.
        still: whether the whole path is one creep, which the head and the tail share.
        speed_mps: the highest speed over a second and eight steps; None for too few positions.
        steps_m: the length of each step; they add up to `length_m` and the creeps at the ends.
    """

    length_m: float
    sum_m: float
    head: End
    tail: End
    still: bool
    speed_mps: float | None
    steps_m: Floats


def measure(seconds: Floats, positions: Vectors) -> Measured:
    """Measures the length of a path and the highest speed on it.

    Args:
        seconds: the time of each position (s), ascending.
        positions: rows of x, y and z (m); at least one.
    """
    points = positions - positions[0]
    # An axis on which nothing moves, mostly z, adds nothing.
    varies = points.any(axis=0)
    varies[0] = True
    points = points[:, varies]
    plain = np.sqrt(row_sums(np.diff(points, axis=0) ** 2))
    apart = np.diff(seconds)
    if len(points) < FEWEST:
        total, speed_mps = float(plain.sum()), _sparse_speed(plain, apart)
        ends = [End(step, 0.0, plain=True, creep=None) for step in plain.tolist() or [0.0]]
        return Measured(total, total, ends[0], ends[-1], False, speed_mps, plain)
    noise = _noise(points)
    places = _moving_mean(points, _MEAN_SPAN)
    steps = _steps(points, plain, noise)
    if np.median(apart) > _DENSE_S:
        stationary = steps.stationary & _scatters(points, places, noise)
        steps = _StepLengths(plain, ~stationary, stationary)
    averaged = min(2 * _MEAN_SPAN + 1, len(points))
    reach = _LEFT * math.sqrt(2 / averaged) * row_maxima(noise)
    creeps = {
        (begin, end): _creep(places[begin : end + 1], reach[begin : end + 1], positions[0], varies)
        for begin, end in runs_where(steps.stationary).tolist()
        if end - begin >= min(_STATIONARY_STEPS, len(plain))
    }
    return _measured(seconds, plain, steps, noise, creeps)


def _measured(
    seconds: Floats,
    plain: Floats,
    without_noise: _StepLengths,
    noise: Vectors,
    creeps: Mapping[tuple[int, int], Creep],
) -> Measured:
    """Returns the measurements of a path whose steps in a creep count as that.

    `creeps` have the first step of each, and the one after its last.
    """
    lengths, as_plain, _ = without_noise
    moved, steps, inside_m = lengths.copy(), lengths.copy(), 0.0
    first_creep = last_creep = None
    for (begin, end), creep in creeps.items():
        moved[begin:end] = 0.0
        steps[begin:end] = creep.length_m / (end - begin)
        # Those at the ends are counted once the path is joined.
        if begin == 0:
            first_creep = creep
        if end == len(plain):
            last_creep = creep
        if begin > 0 and end < len(plain):
            inside_m += creep.length_m
    spread = np.sqrt(row_sums(noise**2))
    total = float(plain.sum())
    return Measured(
        total if as_plain.all() else float(moved.sum()) + inside_m,
        total,
        End(float(moved[0]), float(spread[0]), bool(as_plain[0]), first_creep),
        End(float(moved[-1]), float(spread[-1]), bool(as_plain[-1]), last_creep),
        still=first_creep is not None and first_creep is last_creep,
        speed_mps=_highest_speed(seconds, moved),
        steps_m=plain if as_plain.all() else steps,
    )


def _noise(points: Vectors) -> Vectors:
    """Returns the standard deviation (m) of each axis at each position."""
    roots = np.sqrt(np.abs(np.diff(points, _ORDER, axis=0)))
    means = _moving_mean(roots, _NOISE_SPAN) ** 2 / (_ROOT_MEAN * _GROWTH)
    return _extended(means, _ORDER // 2, len(points))


def _steps(points: Vectors, plain: Floats, noise: Vectors) -> _StepLengths:
    """Returns the lengths of steps, each by the narrowest slope that is clear of noise."""
    variance = (noise[1:] ** 2 + noise[:-1] ** 2) / 2
    whole = row_sums(variance)
    lengths = np.zeros(len(plain))
    as_plain = np.zeros(len(plain), dtype=bool)
    unsettled = np.ones(len(plain), dtype=bool)
    energy = share = np.zeros(len(plain))
    for width in _WIDTHS:
        if width > len(points) or not unsettled.any():
            break
        slopes = np.diff(points, axis=0) if width == 2 else _slopes(points, width)
        square = row_sums(slopes**2)
        energy = _moving_mean(square[:, None], _SLOPE_SPAN)[:, 0]
        slope_variance = 12 / (width * (width * width - 1))
        share = slope_variance * whole
        along = row_sums(variance * slopes**2) / np.where(square > 0, square, 1.0)
        across = slope_variance * (whole - along)
        settled = unsettled & (energy >= _CLEAR * share)
        if width == 2:
            as_plain = settled & (share <= 2 * _PLAIN * energy)
        # A step that never settles keeps the length by the widest slope.
        lengths[unsettled] = np.sqrt(np.maximum(square - across, 0.0))[unsettled]
        unsettled &= ~settled
    lengths[as_plain] = plain[as_plain]
    # A wide slope before a sudden start reaches into the steps after it, which count by themselves.
    # So no run may be longer than its plain length.
    for begin, end in runs_where(~as_plain).tolist():
        most, summed = plain[begin:end].sum(), lengths[begin:end].sum()
        if summed > most:
            lengths[begin:end] *= most / summed
    return _StepLengths(lengths, as_plain, unsettled & (energy < _STATIONARY * share))


def _scatters(points: Vectors, places: Vectors, noise: Vectors) -> Flags:
    """Returns whether positions at both ends of a step scatter around a place as noise does."""
    spread = _moving_mean(points**2, _MEAN_SPAN) - places**2
    ratio = row_sums(spread) / np.maximum(row_sums(noise**2), 1e-300)
    low, high = _SPREAD
    around: Flags = (low * low <= ratio) & (ratio <= high * high)
    return around[1:] & around[:-1]


def _slopes(points: Vectors, width: int) -> Vectors:
    """Returns, for each step, the slope of the line fitted to the `width` positions around it.

    Near an end of the path the line is fitted to the first or last positions.
    """
    weights = np.arange(width) - (width - 1) / 2
    weights /= weights @ weights
    fits = np.column_stack([np.correlate(axis, weights, "valid") for axis in points.T])
    return _extended(fits, width // 2 - 1, len(points) - 1)


def _moving_mean(rows: Vectors, span: int) -> Vectors:
    """Returns, for each row, the mean over it and `span` rows to either side.

    Near an end, the mean over the first or last `2 * span + 1` rows.
    """
    width = min(2 * span + 1, len(rows))
    sums = np.zeros((len(rows) + 1, rows.shape[1]))
    np.cumsum(rows, axis=0, out=sums[1:])
    return _extended((sums[width:] - sums[:-width]) / width, span, len(rows))


def _extended(rows: Vectors, before: int, count: int) -> Vectors:
    """Returns `count` rows: the first one repeated `before` times, all, and the last repeated."""
    extended = np.empty((count, rows.shape[1]))
    extended[:before] = rows[0]
    inner = extended[before : before + len(rows)]
    inner[:] = rows[: len(inner)]
    extended[before + len(rows) :] = rows[-1]
    return extended


def _creep(places: Vectors, reach: Floats, origin: Floats, varies: Flags) -> Creep:
    """Returns the creep through mean places: each is out of reach of the one before.

    Args:
        places: the mean places (m), relative to the origin, along the axes that vary.
        reach: for each place, how far noise alone moves it (m).
        origin: x, y and z of the origin (m).
        varies: which of the axes vary.
    """
    left_at, begin, count = [0], 0, _AHEAD
    while begin < len(places):
        ahead = slice(begin, begin + count)
        away = np.sqrt(row_sums((places[ahead] - places[left_at[-1]]) ** 2))
        off = np.flatnonzero(away > reach[ahead])
        begin, count = begin + count, 2 * count
        if off.size:
            left_at.append(ahead.start + int(off[0]))
            begin, count = left_at[-1], _AHEAD
    whole = np.tile(origin, (len(left_at), 1))
    whole[:, varies] += places[left_at]
    path = [(x, y, z) for x, y, z in whole.tolist()]
    middle_m = math.fsum(math.dist(here, there) for here, there in pairwise(path[1:]))
    second = path[1] if len(path) > 1 else None
    return Creep(path[0], second, middle_m, path[-1], float(reach.max()))


def _highest_speed(seconds: Floats, lengths: Floats) -> float:
    """Returns the highest speed (m/s) over windows of a second, and of at least eight steps."""
    # A step far longer than those around it corrects the position: it counts as twice the usual.
    usual = _moving_mean(np.sqrt(lengths)[:, None], SPEED_STEPS)[:, 0] ** 2
    travelled = np.concatenate(([0.0], np.cumsum(np.minimum(lengths, 2 * usual))))
    begin = np.arange(len(lengths) - SPEED_STEPS + 1)
    end = np.searchsorted(seconds, seconds[begin] + SPEED_WINDOW_S - _SLACK_S)
    dense = (end > begin + SPEED_STEPS) & (end < len(seconds))
    begin, end = begin[dense], end[dense]
    sparse_mps = _sparse_speed(lengths, np.diff(seconds))
    if len(begin):
        speeds = (travelled[end] - travelled[begin]) / (seconds[end] - seconds[begin])
        return max(float(speeds.max()), sparse_mps or 0.0)
    if sparse_mps is not None:
        return sparse_mps
    # The path takes less than a second.
    return float(travelled[-1] / max(seconds[-1] - seconds[0], _JITTER_S))


def _sparse_speed(lengths: Floats, apart: Floats) -> float | None:
    """Returns the highest median speed (m/s) of eight steps that take at least a second.

    None if no eight steps do.
    """
    if len(lengths) < SPEED_STEPS:
        return None
    is_long = np.convolve(apart, np.ones(SPEED_STEPS), "valid") >= SPEED_WINDOW_S - _SLACK_S
    if not is_long.any():
        return None
    windows = sliding_window_view(lengths / np.maximum(apart, _JITTER_S), SPEED_STEPS)[is_long]
    return float(np.median(windows, axis=1).max())

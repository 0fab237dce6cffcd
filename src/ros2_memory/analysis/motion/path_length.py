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

from ros2_memory.core.arrays import Flags, Floats, Vectors, row_maxima, row_sums

if TYPE_CHECKING:
    from ros2_memory.core.model import Vector3

FEWEST: Final = 16
"""Positions below which no noise is estimated, and the plain sum is the length."""

_WIDTHS: Final = (2, 4, 8, 16, 32)
_ORDER: Final = 4
_NOISE_SPAN: Final = 32
"""Fourth differences on either side of a position whose mean is the noise there."""
_SLOPE_SPAN: Final = 6
"""Slopes on either side of a step whose mean square is compared with their noise."""
_CLEAR: Final = 12.0
"""A mean square slope is clear of noise from so many times the variance of a slope on."""
_STATIONARY: Final = 9.0
"""The widest slopes below so many times their variance are those of a stationary robot.

Of noise alone they are above it once in some 10^5 independent windows (chi-square, 3 degrees).
"""
_PLAIN: Final = 0.002
"""Where noise adds less than this share, the distance of two positions stays as it is."""
_STATIONARY_STEPS: Final = _WIDTHS[-1]
_MEAN_SPAN: Final = 16
_DENSE_S: Final = 0.25
"""Fourth differences of positions farther apart in time take turns of the robot for noise."""
_SPREAD: Final = (0.6, 2.0)
"""How far positions that far apart spread around a place, in units of their noise."""
_LEFT: Final = 6.0
"""A robot left a place when it is more than so many standard deviations away."""
_AHEAD: Final = 64
"""So many positions are searched at first for the next place, then twice as many."""
_ROOT_MEAN: Final = (2**0.25 * math.gamma(0.75) / math.sqrt(math.pi)) ** 2
"""The squared mean square root of a standard normal variable's magnitude."""
_GROWTH: Final = math.sqrt(math.comb(2 * _ORDER, _ORDER))
"""The standard deviation of a difference of this order of independent unit noise."""

SPEED_WINDOW_S: Final = 1.0
SPEED_STEPS: Final = 8
_JITTER_S: Final = 0.1
_SLACK_S: Final = 1e-6


class Creep(NamedTuple):
    """The path of a robot that stands or creeps: from place to place that it clearly left.

    Attributes:
        start: the first place.
        second: the next one; None where it never left the first.
        middle_m: length from the second place to the last.
        end: the last place.
        reach_m: how far off a place must be to count.
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

    def to(self, place: Vector3) -> Creep:
        """Returns the creep with one more place, if that is off the last one."""
        step = math.dist(self.end, place)
        if step <= self.reach_m:
            return self
        if self.second is None:
            return self._replace(second=place, end=place)
        return self._replace(middle_m=self.middle_m + step, end=place)

    def joined(self, later: Creep) -> Creep:
        """Returns this creep continued by a later one."""
        reach_m = max(self.reach_m, later.reach_m)
        whole = self._replace(reach_m=reach_m).to(later.start)
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


class Measured(NamedTuple):
    """The measurements of a path in one piece.

    Attributes:
        length_m: its length except for the creeps at its ends.
        sum_m: the sum of the distances between its positions.
        head: how it begins.
        tail: how it ends.
        still: whether it is one creep from end to end: that of the head and of the tail.
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


def measured(seconds: Floats, positions: Vectors) -> Measured:
    """Measures the length of a path and the highest speed on it.

    Args:
        seconds: when each position was taken, ascending.
        positions: x, y and z (m) of each as a row; at least one.
    """
    points = positions - positions[0]
    # What is the same everywhere, as z mostly is, adds nothing.
    varies = points.any(axis=0)
    varies[0] = True
    points = points[:, varies]
    plain = np.sqrt(row_sums(np.diff(points, axis=0) ** 2))
    total = float(plain.sum())
    apart = np.diff(seconds)
    if len(points) < FEWEST:
        speed_mps = _sparse_speed(plain, apart)
        ends = [End(step, 0.0, plain=True, creep=None) for step in plain.tolist() or [0.0]]
        return Measured(total, total, ends[0], ends[-1], False, speed_mps, plain)
    noise = _noise(points)
    places = _moving_mean(points, _MEAN_SPAN)
    lengths, as_plain, stationary = _steps(points, plain, noise)
    if np.median(apart) > _DENSE_S:
        stationary &= _scatters(points, places, noise)
        lengths, as_plain = plain, ~stationary
    averaged = min(2 * _MEAN_SPAN + 1, len(points))
    reach = _LEFT * math.sqrt(2 / averaged) * row_maxima(noise)
    moved, steps, inside_m = lengths.copy(), lengths.copy(), 0.0
    before = after = None
    for begin, end in _runs(stationary):
        if end - begin < min(_STATIONARY_STEPS, len(plain)):
            continue
        run = slice(begin, end + 1)
        creep = _creep(places[run], reach[run], positions[0], varies)
        moved[begin:end] = 0.0
        steps[begin:end] = creep.length_m / (end - begin)
        before = creep if begin == 0 else before
        after = creep if end == len(plain) else after
        if begin > 0 and end < len(plain):
            inside_m += creep.length_m
    spread = np.sqrt(row_sums(noise**2))
    head, tail = (
        End(float(moved[at]), float(spread[at]), bool(as_plain[at]), creep)
        for at, creep in ((0, before), (-1, after))
    )
    return Measured(
        total if as_plain.all() else float(moved.sum()) + inside_m,
        total,
        head,
        tail,
        still=before is not None and before is after,
        speed_mps=_highest_speed(seconds, moved),
        steps_m=plain if as_plain.all() else steps,
    )


def _noise(points: Vectors) -> Vectors:
    """Returns the standard deviation of each axis at each position."""
    roots = np.sqrt(np.abs(np.diff(points, _ORDER, axis=0)))
    means = _moving_mean(roots, _NOISE_SPAN) ** 2 / (_ROOT_MEAN * _GROWTH)
    return _extended(means, _ORDER // 2, len(points))


def _steps(points: Vectors, plain: Floats, noise: Vectors) -> tuple[Floats, Flags, Flags]:
    """Returns the length of each step, whether it is the plain one, and whether it is noise."""
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
        of_slope = 12 / (width * (width * width - 1))
        share = of_slope * whole
        along = row_sums(variance * slopes**2) / np.where(square > 0, square, 1.0)
        across = of_slope * (whole - along)
        settled = unsettled & (energy >= _CLEAR * share)
        if width == 2:
            as_plain = settled & (share <= 2 * _PLAIN * energy)
        # A step that never settles keeps the length by the widest slope.
        lengths[unsettled] = np.sqrt(np.maximum(square - across, 0.0))[unsettled]
        unsettled &= ~settled
    lengths[as_plain] = plain[as_plain]
    # A wide slope beside a sudden start counts part of the steps after it, which count already.
    for begin, end in _runs(~as_plain):
        most, summed = plain[begin:end].sum(), lengths[begin:end].sum()
        if summed > most:
            lengths[begin:end] *= most / summed
    return lengths, as_plain, unsettled & (energy < _STATIONARY * share)


def _scatters(points: Vectors, places: Vectors, noise: Vectors) -> Flags:
    """Returns at which steps the positions spread around one place as far as their noise does."""
    spread = _moving_mean(points**2, _MEAN_SPAN) - places**2
    ratio = row_sums(spread) / np.maximum(row_sums(noise**2), 1e-300)
    low, high = _SPREAD
    around: Flags = (low * low <= ratio) & (ratio <= high * high)
    return around[1:] & around[:-1]


def _slopes(points: Vectors, width: int) -> Vectors:
    """Returns for each step the slope of the line fitted to the `width` positions around it.

    Near an end of the path it is fitted to the first or last ones.
    """
    weights = np.arange(width) - (width - 1) / 2
    weights /= weights @ weights
    fits = np.column_stack([np.correlate(axis, weights, "valid") for axis in points.T])
    return _extended(fits, width // 2 - 1, len(points) - 1)


def _moving_mean(rows: Vectors, span: int) -> Vectors:
    """Returns means over each row and `span` ones to either side; over as many at the ends."""
    width = min(2 * span + 1, len(rows))
    sums = np.zeros((len(rows) + 1, rows.shape[1]))
    np.cumsum(rows, axis=0, out=sums[1:])
    return _extended((sums[width:] - sums[:-width]) / width, span, len(rows))


def _extended(rows: Vectors, before: int, count: int) -> Vectors:
    """Returns so many rows: the first also so often before them, the last at their end."""
    extended = np.empty((count, rows.shape[1]))
    extended[:before] = rows[0]
    inner = extended[before : before + len(rows)]
    inner[:] = rows[: len(inner)]
    extended[before + len(rows) :] = rows[-1]
    return extended


def _runs(marks: Flags) -> list[list[int]]:
    """Returns the half-open ranges in which marks are set."""
    edges = np.flatnonzero(np.diff(marks, prepend=False, append=False))
    return edges.reshape(-1, 2).tolist()


def _creep(places: Vectors, reach: Floats, origin: Floats, varies: Flags) -> Creep:
    """Returns which of the places a robot left: was farther from than its noise explains.

    They are relative to an origin, along the axes that vary.
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
    left = [(x, y, z) for x, y, z in whole.tolist()]
    middle_m = math.fsum(math.dist(here, there) for here, there in pairwise(left[1:]))
    second = left[1] if len(left) > 1 else None
    return Creep(left[0], second, middle_m, left[-1], float(reach.max()))


def _highest_speed(seconds: Floats, lengths: Floats) -> float:
    """Returns the highest speed over windows of a second, and of eight steps at least."""
    # A single step far longer than those around it is a correction of the position, not speed.
    usual = _moving_mean(np.sqrt(lengths)[:, None], SPEED_STEPS)[:, 0] ** 2
    travelled = np.concatenate(([0.0], np.cumsum(np.minimum(lengths, 2 * usual))))
    begin = np.arange(len(lengths) - SPEED_STEPS + 1)
    end = np.searchsorted(seconds, seconds[begin] + SPEED_WINDOW_S - _SLACK_S)
    dense = (end > begin + SPEED_STEPS) & (end < len(seconds))
    begin, end = begin[dense], end[dense]
    sparse_mps = _sparse_speed(lengths, np.diff(seconds))
    if len(begin):
        highest = float(
            ((travelled[end] - travelled[begin]) / (seconds[end] - seconds[begin])).max()
        )
        return max(highest, sparse_mps or 0.0)
    if sparse_mps is not None:
        return sparse_mps
    # The path takes less than a second.
    return float(travelled[-1] / max(seconds[-1] - seconds[0], _JITTER_S))


def _sparse_speed(lengths: Floats, apart: Floats) -> float | None:
    """Returns the highest median speed of eight steps that take a second or longer, if any do."""
    if len(lengths) < SPEED_STEPS:
        return None
    long = np.convolve(apart, np.ones(SPEED_STEPS), "valid") >= SPEED_WINDOW_S - _SLACK_S
    if not long.any():
        return None
    windows = sliding_window_view(lengths / np.maximum(apart, _JITTER_S), SPEED_STEPS)[long]
    return float(np.median(windows, axis=1).max())

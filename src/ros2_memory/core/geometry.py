"""Rotations, rigid transforms and paths.

Quaternions are (x, y, z, w) with Hamilton's product, and must be of unit length unless a function
documents otherwise: `normalised` makes them so. A `Transform` is the pose of a child in its parent.
"""

from __future__ import annotations

import heapq
import math
from itertools import count, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.model import Quaternion, Transform, Vector3

Numbers: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
N = TypeVar("N", float, "NDArray[np.float64]")

GIMBAL_LOCK_SINE: Final = 1 - 1e-14
"""Beyond this sine of pitch, roll and yaw share one axis to within 1.5e-7 rad."""

_PARALLEL_COSINE: Final = 1 - 1e-10
"""Beyond this, slerp would divide two tiny sines; an angle as if it were this moves it by 1e-15."""

_MOST_LOPSIDED: Final = 64
"""How often, on average, a point may be measured before intervals are halved instead."""

_TOGETHER: Final = 1 << 14
"""Points whose deviations are computed at once: they fit into the processor's cache."""

_BACKWARDS_WEIGHT: Final = 0.5**2
"""The weight, for squared deviations, of moving back along a segment."""

_SHORTEST_SQUARED: Final = 1e-300
"""Chords whose squared length is not greater are points."""

_SAME_M: Final = 1e-6
"""Transforms that differ by less (m, and in the cosine of half the angle) are the same."""


class _Path(NamedTuple):
    """The points of a path: a row of coordinates (m) for each axis, and the times (s).

    `of_time` is the share of a point's distance in time that counts as deviation.
    """

    coordinates: NDArray[np.float64]
    clock: Numbers
    of_time: float


class _Farthest(NamedTuple):
    """The point of each interval that deviates most: its squared deviation (m2) and its index."""

    starts: NDArray[np.intp]
    ends: NDArray[np.intp]
    squared: Numbers
    point: NDArray[np.intp]


def normalised(q: Quaternion) -> Quaternion | None:
    """Returns the unit quaternion of the same rotation; None for a zero, NaN or infinite one."""
    largest = max(abs(part) for part in q)
    if not all(math.isfinite(part) for part in q) or largest == 0:
        return None
    # Scaled first: the squares of very large and very small parts leave the range of a float.
    x, y, z, w = (part / largest for part in q)
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return (x / length, y / length, z / length, w / length)


def rpy(q: Quaternion) -> tuple[float, float, float]:
    """Returns roll, pitch and yaw (rad) about the fixed axes X, Y, Z in that order (REP-103).

    At gimbal lock (pitch of plus or minus a right angle) only the sum of roll and yaw is
    determined: yaw is that sum, and roll is 0.
    """
    x, y, z, w = q
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    pitch = math.asin(sine)
    if abs(sine) > GIMBAL_LOCK_SINE:
        return 0.0, pitch, math.remainder(2 * math.atan2(z, w), math.tau)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def yaw(q: Quaternion) -> float:
    """Returns the heading about Z (rad, in [-pi, pi]) of `rpy`."""
    return rpy(q)[2]


def multiply(a: tuple[N, N, N, N], b: tuple[N, N, N, N]) -> tuple[N, N, N, N]:
    """Returns the rotation `b` followed, about the fixed axes, by `a` (Hamilton's product a b).

    The parts are numbers, or arrays of numbers.
    """
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate(q: tuple[N, N, N, N], v: tuple[N, N, N]) -> tuple[N, N, N]:
    """Returns `v` rotated by `q`; the parts are numbers, or arrays of numbers."""
    x, y, z, w = q
    vx, vy, vz = v
    cx = 2 * (y * vz - z * vy)
    cy = 2 * (z * vx - x * vz)
    cz = 2 * (x * vy - y * vx)
    return (
        vx + w * cx + y * cz - z * cy,
        vy + w * cy + z * cx - x * cz,
        vz + w * cz + x * cy - y * cx,
    )


def transform_point(t: Transform, point: Vector3) -> Vector3:
    """Returns a point (m) of the child frame in the parent frame."""
    x, y, z = rotate(t.rotation, point)
    dx, dy, dz = t.translation
    return (x + dx, y + dy, z + dz)


def alike(one: Transform, other: Transform) -> bool:
    """Returns whether two transforms differ by less than 1 um and 3 mrad."""
    cosine = sum(p * q for p, q in zip(one.rotation, other.rotation, strict=True))
    return math.dist(one.translation, other.translation) < _SAME_M and abs(cosine) > 1 - _SAME_M


def slerp(a: tuple[N, N, N, N], b: tuple[N, N, N, N], ratio: N) -> tuple[N, N, N, N]:
    """Returns the rotation between `a` (ratio 0) and `b` (1), the shorter way, at even speed.

    The parts are numbers, or arrays of numbers.
    """
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    angle = np.arccos(np.minimum(abs(cosine), _PARALLEL_COSINE))
    sine = np.sin(angle)
    from_a = np.sin((1 - ratio) * angle) / sine
    from_b = np.copysign(np.sin(ratio * angle) / sine, cosine)
    x, y, z, w = (from_a * p + from_b * q for p, q in zip(a, b, strict=True))
    length = np.sqrt(x * x + y * y + z * z + w * w)
    return (x / length, y / length, z / length, w / length)


def simplified(
    points: NDArray[np.float64],
    clock: Numbers,
    kept: NDArray[np.intp],
    *,
    tolerance_m: float,
    at_most: int,
    of_time: float = 0.1,
) -> tuple[NDArray[np.intp], float]:
    """Selects few points that draw a path (Ramer, Douglas and Peucker), in space and time.

    Points are added until every other point lies within the tolerance of the segment that spans
    it; or, if that takes more than `at_most` points, until there are so many, the worst deviation
    first. The cost is bounded: where the splits stay lopsided, intervals are halved instead, which
    keeps some more points than needed.

    The deviation of a point is the greatest of three: its distance from the segment; half of the
    distance that it lies back along the segment from an earlier point, so that turning points are
    kept; and a share of its distance from where the segment has the robot at that time, so that
    stops are kept (the synchronised distance of Meratnia and de By, Spatiotemporal Compression
    Techniques for Moving Point Objects, EDBT 2004).

    Args:
        points: x, y and z (m) of each point as a row; finite.
        clock: the time of each point (s).
        kept: the ascending indices of points that are selected in any case; the first and the last
            point of all are among them.
        tolerance_m: the greatest deviation of a point that is not selected.
        at_most: the greatest number of points, unless `kept` are more.
        of_time: the share of the third deviation.

    Returns:
        The indices of the selected points, ascending, and the largest deviation (m) of another one.
    """
    # An axis on which all points are equal, as z mostly is, adds nothing to a deviation.
    path = _Path(points.T[(points != points[0]).any(axis=0)].copy(), clock, of_time)
    selected, error = [kept], 0.0
    measured: list[_Farthest] = []
    starts, ends = kept[:-1], kept[1:]
    for depth in count():
        has_inner = ends - starts > 1
        starts, ends = starts[has_inner], ends[has_inner]
        if not starts.size:
            break
        farthest = _farthest_of_each(path, starts, ends)
        measured.append(farthest)
        splits = farthest.squared > tolerance_m * tolerance_m
        error = max(error, float(farthest.squared[~splits].max(initial=0.0)))
        starts, ends, split = starts[splits], ends[splits], farthest.point[splits]
        if depth >= _MOST_LOPSIDED:
            split = (starts + ends) // 2
        selected.append(split)
        if sum(map(len, selected)) > at_most:
            return _worst_first(path, kept, measured, tolerance_m=tolerance_m, at_most=at_most)
        starts, ends = np.append(starts, split), np.append(split, ends)
        order = np.argsort(starts)
        starts, ends = starts[order], ends[order]
    return np.sort(np.concatenate(selected)), math.sqrt(error)


def _worst_first(
    path: _Path,
    kept: NDArray[np.intp],
    measured: Sequence[_Farthest],
    *,
    tolerance_m: float,
    at_most: int,
) -> tuple[NDArray[np.intp], float]:
    """Selects points as `simplified` does, by splitting the worst interval at each step.

    That is slower, and the best choice of few points. `measured` saves measuring intervals again.
    """
    known = {
        (start, end): (squared, point)
        for batch in measured
        for start, end, squared, point in zip(*(column.tolist() for column in batch), strict=True)
    }
    worst: list[tuple[float, int, int, int]] = []  # a heap: -squared deviation, point, start, end

    def push(start: int, end: int) -> None:
        if end - start <= 1:
            return
        if (start, end) in known:
            squared, point = known[start, end]
        else:
            farthest = _farthest_of_each(path, np.array([start]), np.array([end]))
            squared, point = float(farthest.squared[0]), int(farthest.point[0])
        heapq.heappush(worst, (-squared, point, start, end))

    selected = kept.tolist()
    for start, end in pairwise(selected):
        push(start, end)
    scans_left = _MOST_LOPSIDED * len(path.clock)
    while worst and -worst[0][0] > tolerance_m * tolerance_m and len(selected) < at_most:
        _, split, start, end = heapq.heappop(worst)
        scans_left -= end - start
        if scans_left < 0:
            split = (start + end) // 2
        selected.append(split)
        push(start, split)
        push(split, end)
    error = math.sqrt(-worst[0][0]) if worst else 0.0
    return np.sort(np.array(selected, np.intp)), error


class _Segments(NamedTuple):
    """The segments between the first and the last point of each interval.

    Attributes:
        starts: the index of each first point.
        chords: from the first to the last point, a row for each axis.
        squared: the squared length (m2).
        per_squared: 1 / `squared`; 0 for a segment that is too short to divide by, as of a loop.
        per_second: 1 / the duration (s); 0 for a segment of no duration.
    """

    starts: NDArray[np.intp]
    chords: NDArray[np.float64]
    squared: Numbers
    per_squared: Numbers
    per_second: Numbers

    @classmethod
    def between(cls, path: _Path, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> _Segments:
        """Returns the segments of intervals of a path."""
        chords = path.coordinates[:, ends] - path.coordinates[:, starts]
        squared = (chords * chords).sum(axis=0)
        duration = path.clock[ends] - path.clock[starts]
        nothing = np.zeros(len(starts))
        is_long = squared > _SHORTEST_SQUARED
        per_squared = np.divide(1.0, squared, out=nothing.copy(), where=is_long)
        per_second = np.divide(1.0, duration, out=nothing, where=duration > 0)
        return cls(starts, chords, squared, per_squared, per_second)

    def squared_deviations(
        self, path: _Path, at: NDArray[np.intp], interval: NDArray[np.intp], reached: float
    ) -> tuple[Numbers, float]:
        """Returns the squared deviation (m2) of points, and how far along they reached.

        Args:
            path: the path.
            at: the indices of the points, ascending.
            interval: the interval that each point lies in.
            reached: what the call for the points before returned, if those lie in the same
                interval as the first of these; else 0.
        """
        start = self.starts[interval]
        # `coordinates[:, at]` would be in the order of `at` in memory, which is slow to add up.
        chord = self.chords.take(interval, axis=1)
        here = path.coordinates.take(at, axis=1) - path.coordinates.take(start, axis=1)
        along = ((here * chord).sum(axis=0) * self.per_squared[interval]).clip(0.0, 1.0)
        off = ((here - along * chord) ** 2).sum(axis=0)
        # How far along earlier points of the same interval are: those of each interval are greater
        # by 2 than all of the interval before.
        farthest = along + 2.0 * interval
        farthest[0] = max(farthest[0], reached)
        np.maximum.accumulate(farthest, out=farthest)
        back = farthest - 2.0 * interval - along
        np.maximum(off, back * back * self.squared[interval] * _BACKWARDS_WEIGHT, out=off)
        per_second = self.per_second[interval]
        on_time = (path.clock[at] - path.clock[start]) * per_second
        late = ((here - on_time * chord) ** 2).sum(axis=0) * path.of_time**2
        np.maximum(off, np.where(per_second > 0, late, 0.0), out=off)
        return off, float(farthest[-1])


def _farthest_of_each(path: _Path, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> _Farthest:
    """Finds the point of each interval with the largest deviation from the segment of its ends.

    Intervals are in order and have a point inside. Of equal deviations the first point counts.
    """
    segments = _Segments.between(path, starts, ends)
    # The inner points of all intervals, one after the other, are looked at in blocks.
    stops = np.cumsum(ends - starts - 1)
    begins = stops - (ends - starts - 1)
    squared, point = np.zeros(len(starts)), starts + 1
    reached = 0.0
    for low in range(0, int(stops[-1]), _TOGETHER):
        high = min(low + _TOGETHER, int(stops[-1]))
        first, end = np.searchsorted(begins, (low + 1, high)) - (1, 0)
        edges = np.append(begins[first:end], high).clip(low)
        interval = np.repeat(np.arange(first, end), np.diff(edges))
        at = np.arange(low, high) + (starts + 1 - begins)[interval]
        is_continued = begins[first] < low
        off, reached = segments.squared_deviations(
            path, at, interval, reached if is_continued else 0.0
        )
        greatest = np.maximum.reduceat(off, edges[:-1] - low)
        is_greater = greatest > squared[first:end]
        squared[first:end][is_greater] = greatest[is_greater]
        is_farthest = (off == squared[interval]) & is_greater[interval - first]
        last_to_first = np.flatnonzero(is_farthest)[::-1]  # the first of several is written last
        point[interval[last_to_first]] = at[last_to_first]
    return _Farthest(starts, ends, squared, point)

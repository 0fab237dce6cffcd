"""Rotations, rigid transforms and paths.

Quaternions are (x, y, z, w) with Hamilton's product, and must be of unit length unless a function
documents otherwise: `normalised` makes them so. A `Transform` is the pose of a child in its parent.
"""

from __future__ import annotations

import heapq
import math
from itertools import count, pairwise
from typing import TYPE_CHECKING, Final, TypeAlias, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.model import Quaternion, Transform, Vector3

Numbers: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
_Farthest: TypeAlias = "tuple[NDArray[np.intp], NDArray[np.intp], Numbers, NDArray[np.intp]]"
"""Where intervals start and end; what is farthest in each: its squared deviation, and its index."""
N = TypeVar("N", float, "NDArray[np.float64]")

GIMBAL_LOCK_SINE: Final = 1 - 1e-14
"""Beyond this sine of pitch, roll and yaw share one axis to within 1.5e-7 rad."""

_PARALLEL_COSINE: Final = 1 - 1e-10
"""Beyond this, slerp would divide two tiny sines; an angle as if it were this moves it by 1e-15."""

_MOST_LOPSIDED: Final = 64
"""How often, on average, a point may be looked at before intervals are halved instead."""

_TOGETHER: Final = 1 << 14
"""Of so many points deviations are computed at once: they stay in the processor's cache."""

_BACKWARDS_WEIGHT: Final = 0.5**2
"""The weight, for squared deviations, of moving back along a segment."""

_SHORTEST_SQUARED: Final = 1e-300
"""Chords whose squared length is not greater are points."""

_SAME_M: Final = 1e-6


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

    Of numbers, or of arrays of them.
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
    """Returns `v` rotated by `q`; of numbers, or of arrays of them."""
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

    Of numbers, or of arrays of them.
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
    """Draws a path with few of its points (Ramer, Douglas and Peucker), in space and time.

    Points are added to those that are kept anyway until every other one lies within a tolerance of
    the segment that spans it, unless that takes more points than allowed: then as near as these
    allow. The cost is bounded: where the splits stay lopsided, intervals are halved instead, which
    keeps some more points than needed.

    The deviation of a point is at least half the distance that it lies back along its segment from
    an earlier point, so that turning points are kept; and a share of its distance from where the
    segment has the robot at that time, so that stops are kept (the synchronised distance of
    Meratnia and de By, Spatiotemporal Compression Techniques for Moving Point Objects, EDBT 2004).

    Args:
        points: x, y and z (m) of each as a row; finite.
        clock: the time of each (s).
        kept: the indices of those that are kept anyway, ascending; the first and the last of all
            are among them.
        tolerance_m: see above.
        at_most: so many points draw the path, unless `kept` are more.
        of_time: that share.

    Returns:
        The indices of the kept points, ascending, and the largest deviation (m) of another one.
    """
    # What is the same everywhere, as z mostly is, is off by nothing.
    columns = points.T[(points != points[0]).any(axis=0)].copy()
    kept_indices, error = [kept], 0.0
    looked_at: list[_Farthest] = []
    starts, ends = kept[:-1], kept[1:]
    for depth in count():
        inner = ends - starts > 1
        starts, ends = starts[inner], ends[inner]
        if not starts.size:
            break
        most, where = _farthest_of_each(columns, clock, starts, ends, of_time)
        looked_at.append((starts, ends, most, where))
        splits = most > tolerance_m * tolerance_m
        error = max(error, float(most[~splits].max(initial=0.0)))
        starts, ends, where = starts[splits], ends[splits], where[splits]
        if depth >= _MOST_LOPSIDED:
            where = (starts + ends) // 2
        kept_indices.append(where)
        if sum(map(len, kept_indices)) > at_most:
            return _worst_first(
                columns,
                clock,
                kept,
                looked_at,
                tolerance_m=tolerance_m,
                at_most=at_most,
                of_time=of_time,
            )
        starts, ends = np.append(starts, where), np.append(where, ends)
        order = np.argsort(starts)
        starts, ends = starts[order], ends[order]
    return np.sort(np.concatenate(kept_indices)), math.sqrt(error)


def _worst_first(
    columns: NDArray[np.float64],
    clock: Numbers,
    kept: NDArray[np.intp],
    looked_at: Sequence[_Farthest],
    *,
    tolerance_m: float,
    at_most: int,
    of_time: float,
) -> tuple[NDArray[np.intp], float]:
    """Does what `simplified` does, the worst interval first: of a few points these are the best.

    `looked_at` is what is known of some intervals.
    """
    indices = kept.tolist()
    worst: list[tuple[float, int, int, int]] = []
    measured = {
        (start, end): (-most, where)
        for batch in looked_at
        for start, end, most, where in zip(*(column.tolist() for column in batch), strict=True)
    }

    def farthest(start: int, end: int) -> tuple[float, int]:
        most, where = _farthest_of_each(columns, clock, np.array([start]), np.array([end]), of_time)
        return -float(most[0]), int(where[0])

    def look(*edges: int) -> None:
        for start, end in pairwise(edges):
            if end - start > 1:
                off, where = measured.get((start, end)) or farthest(start, end)
                heapq.heappush(worst, (off, where, start, end))

    look(*indices)
    scans_left = _MOST_LOPSIDED * len(clock)
    while worst and -worst[0][0] > tolerance_m * tolerance_m and len(indices) < at_most:
        _, split, start, end = heapq.heappop(worst)
        scans_left -= end - start
        if scans_left < 0:
            split = (start + end) // 2
        indices.append(split)
        look(start, split, end)
    error = math.sqrt(-worst[0][0]) if worst else 0.0
    return np.sort(np.array(indices, np.intp)), error


def _farthest_of_each(
    columns: NDArray[np.float64],
    clock: Numbers,
    starts: NDArray[np.intp],
    ends: NDArray[np.intp],
    of_time: float,
) -> tuple[Numbers, NDArray[np.intp]]:
    """Finds the point of each interval with the largest deviation from the segment of its ends.

    Intervals are in order and have a point inside.

    Returns:
        The squared deviation (m2) of each, and its index.
    """
    chords = columns[:, ends] - columns[:, starts]
    squared = (chords * chords).sum(axis=0)
    # A chord that is too short to divide by is a point, as that of a closed loop.
    scale = np.divide(1.0, squared, out=np.zeros(len(squared)), where=squared > _SHORTEST_SQUARED)
    lasted = clock[ends] - clock[starts]
    rate = np.divide(1.0, lasted, out=np.zeros(len(lasted)), where=lasted > 0)
    stops = np.cumsum(ends - starts - 1)
    begins = stops - (ends - starts - 1)
    most, where = np.zeros(len(starts)), starts + 1
    reached = 0.0
    for low in range(0, int(stops[-1]), _TOGETHER):
        high = min(low + _TOGETHER, int(stops[-1]))
        first, end = np.searchsorted(begins, (low + 1, high)) - (1, 0)
        edges = np.append(begins[first:end], high).clip(low)
        interval = np.repeat(np.arange(first, end), np.diff(edges))
        at = np.arange(low, high) + (starts + 1 - begins)[interval]
        # `columns[:, at]` would be in the order of `at` in memory, which is slow to add up.
        chord = chords.take(interval, axis=1)
        here = columns.take(at, axis=1) - columns.take(starts[interval], axis=1)
        along = ((here * chord).sum(axis=0) * scale[interval]).clip(0.0, 1.0)
        off = ((here - along * chord) ** 2).sum(axis=0)
        # How far along the points before are, of each interval alone: those of a later interval
        # are greater by 2 than all before.
        farthest = along + 2.0 * interval
        if begins[first] < low:
            farthest[0] = max(farthest[0], reached)
        np.maximum.accumulate(farthest, out=farthest)
        reached = farthest[-1]
        back = farthest - 2.0 * interval - along
        np.maximum(off, back * back * squared[interval] * _BACKWARDS_WEIGHT, out=off)
        on_time = (clock[at] - clock[starts[interval]]) * rate[interval]
        late = ((here - on_time * chord) ** 2).sum(axis=0) * of_time**2
        np.maximum(off, np.where(rate[interval] > 0, late, 0.0), out=off)
        greatest = np.maximum.reduceat(off, edges[:-1] - low)
        is_greater = greatest > most[first:end]
        most[first:end][is_greater] = greatest[is_greater]
        # The first of several that are as far: written last.
        farthest_points = np.flatnonzero((off == most[interval]) & is_greater[interval - first])[
            ::-1
        ]
        where[interval[farthest_points]] = at[farthest_points]
    return most, where

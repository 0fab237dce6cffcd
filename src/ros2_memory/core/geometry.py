"""Rotations, rigid transforms and paths in plain floats.

Quaternions are (x, y, z, w) with Hamilton's product, and must be of unit length unless a function
documents otherwise: `normalised` makes them so. A `Transform` is the pose of a child in its parent.
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.core.model import Quaternion, Transform, Vector3

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

Numbers: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
Columns: TypeAlias = "tuple[Numbers, Numbers, Numbers]"
Clock: TypeAlias = "tuple[Sequence[float], Numbers]"
"""The same times as a list and as an array: single elements of an array are slow to read."""

IDENTITY: Final = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))

GIMBAL_LOCK_SINE: Final = 1 - 1e-14
"""Beyond this sine of pitch, roll and yaw share one axis to within 1.5e-7 rad."""

_PARALLEL_COSINE: Final = 1 - 1e-10
"""Beyond this, slerp divides two tiny sines, and a lerp differs from it by less than 1e-14."""

_SCANS_PER_POINT: Final = 64
"""How often, on average, a point may be scanned before intervals are halved instead."""

_BACKWARDS_WEIGHT: Final = 0.5**2
_TIME_WEIGHT: Final = 0.1**2
"""Weights, for squared deviations, of moving back along a segment, and of being early or late."""

_ARRAY_POINTS: Final = 48
"""From here on arrays are faster than a loop: a path of 2000 vertices that are all kept takes 12 ms
with both, and 40 ms with arrays alone."""

_FEWEST_BY_LEVELS: Final = 256
"""Points from which on all intervals of a depth are looked at together."""

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


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Returns the rotation `b` followed, about the fixed axes, by `a` (Hamilton's product a b)."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate(q: Quaternion, v: Vector3) -> Vector3:
    """Returns `v` rotated by `q`."""
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


def compose(a: Transform, b: Transform) -> Transform:
    """Returns the pose of b's child in a's parent."""
    return Transform(transform_point(a, b.translation), multiply(a.rotation, b.rotation))


def invert(t: Transform) -> Transform:
    """Returns the pose of the parent in the child."""
    qx, qy, qz, qw = t.rotation
    back = (-qx, -qy, -qz, qw)
    x, y, z = rotate(back, t.translation)
    return Transform((-x, -y, -z), back)


def alike(one: Transform, other: Transform) -> bool:
    """Returns whether two transforms differ by less than 1 um and 3 mrad."""
    apart = compose(invert(one), other)
    off = distance(apart.translation, (0.0, 0.0, 0.0))
    return off < _SAME_M and abs(apart.rotation[3]) > 1 - _SAME_M


def slerp(a: Quaternion, b: Quaternion, ratio: float) -> Quaternion:
    """Returns the rotation between `a` (ratio 0) and `b` (1), the shorter way, at even speed."""
    cosine = sum(p * q for p, q in zip(a, b, strict=True))
    sign = -1.0 if cosine < 0 else 1.0
    cosine *= sign
    if cosine > _PARALLEL_COSINE:
        from_a, from_b = 1 - ratio, ratio * sign
    else:
        angle = math.acos(cosine)
        from_a = math.sin((1 - ratio) * angle) / math.sin(angle)
        from_b = math.sin(ratio * angle) / math.sin(angle) * sign
    x, y, z, w = (from_a * p + from_b * q for p, q in zip(a, b, strict=True))
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return (x / length, y / length, z / length, w / length)


def interpolate(a: Transform, b: Transform, ratio: float) -> Transform:
    """Returns the transform between `a` (ratio 0) and `b` (1) as tf2: linear, and `slerp`."""
    x, y, z = (p + (q - p) * ratio for p, q in zip(a.translation, b.translation, strict=True))
    return Transform((x, y, z), slerp(a.rotation, b.rotation, ratio))


def distance(a: Vector3, b: Vector3) -> float:
    """Returns the straight distance between two points (m)."""
    return math.dist(a, b)


def off_segment(
    point: tuple[float, float], start: tuple[float, float], end: tuple[float, float]
) -> float:
    """Returns the distance of a point in the plane from a segment; NaN if a coordinate is NaN."""
    (px, py), (ax, ay) = point, start
    dx, dy = end[0] - ax, end[1] - ay
    along = ((px - ax) * dx + (py - ay) * dy) * _scale(dx, dy, 0.0)
    if math.isnan(along):
        return math.nan
    along = min(max(along, 0.0), 1.0)
    return math.hypot(px - ax - along * dx, py - ay - along * dy)


def simplify_to(
    points: Sequence[Vector3],
    tolerance_m: float,
    at_most: int,
    seconds: Sequence[float] | None = None,
) -> tuple[list[int], float]:
    """Simplifies a path (Ramer, Douglas and Peucker).

    Both ends are kept, and every dropped point lies within `tolerance_m` of the kept segment that
    spans it, unless that takes more than `at_most` vertices: then as near as these allow. Points
    must be finite. The cost is bounded: where the splits stay lopsided, intervals are halved
    instead, which keeps some more vertices than needed.

    With `seconds`, the time of each point, the path is simplified in space and time. The deviation
    of a point is then at least half the distance that it lies back along its segment from an
    earlier point, so that turning points are kept; and a tenth of its distance from where the
    segment has the robot at that time, so that stops are kept (the synchronised distance of
    Meratnia and de By, Spatiotemporal Compression Techniques for Moving Point Objects, EDBT 2004).

    Returns:
        The indices of the kept points, ascending, and the largest deviation (m) of a dropped one.

    Raises:
        ValueError: `at_most` is below 2: both ends are always kept.
    """
    if _FEWEST_BY_LEVELS <= len(points) <= at_most:
        found = _simplified_by_levels(points, tolerance_m, seconds)
        if found is not None:
            return found
    kept, off = simplifying(points, tolerance_m, at_most, seconds)
    return sorted(kept), off[-1]


def _simplified_by_levels(
    points: Sequence[Vector3], tolerance_m: float, seconds: Sequence[float] | None
) -> tuple[list[int], float] | None:
    """Does what `simplify_to` does without a limit on count, all intervals of a depth at once.

    That takes a tenth of the time of 4,096 points. None where something is not finite, or the
    splits stay lopsided.
    """
    columns = np.array(points, dtype=np.float64).T.copy()
    clock = None if seconds is None else np.array(seconds, dtype=np.float64)
    starts, ends = np.array([0]), np.array([len(points) - 1])
    kept = [starts, ends]
    error = 0.0
    for _ in range(_SCANS_PER_POINT):
        found = _farthest_of_each(columns, clock, starts, ends)
        if found is None:
            return None
        most, where = found
        splits = most > tolerance_m * tolerance_m
        error = max(error, float(most[~splits].max(initial=0.0)))
        where = where[splits]
        kept.append(where)
        starts, ends = np.stack([starts[splits], where], 1), np.stack([where, ends[splits]], 1)
        inner = ends - starts > 1
        starts, ends = starts[inner], ends[inner]
        if not len(starts):
            return np.sort(np.concatenate(kept)).tolist(), math.sqrt(error)
    return None


def refined(
    points: NDArray[np.float64],
    clock: Numbers,
    kept: NDArray[np.intp],
    tolerance_m: float,
    at_most: int,
) -> tuple[NDArray[np.intp], float]:
    """Adds points to those that draw a path until no other lies farther off than a tolerance.

    Deviations are those of `simplify_to`.

    Args:
        points: x, y and z (m) of each as a row; finite.
        clock: the time of each (s).
        kept: the indices of those that draw the path, ascending; the first and the last of all are
            among them.
        tolerance_m: see above.
        at_most: so many points draw the path, unless `kept` are more.

    Returns:
        The indices of the kept points, ascending, and the largest deviation (m) of another one.
    """
    columns, found = points.T.copy(), [kept]
    starts, ends = kept[:-1], kept[1:]
    count, error = len(kept), 0.0
    while True:
        inner = ends - starts > 1
        starts, ends = starts[inner], ends[inner]
        farthest = _farthest_of_each(columns, clock, starts, ends) if len(starts) else None
        if farthest is None:
            return np.sort(np.concatenate(found)), math.sqrt(error)
        most, where = farthest
        splits = most > tolerance_m * tolerance_m
        if count + int(splits.sum()) > at_most:
            splits[:] = False
        error = max(error, float(most[~splits].max(initial=0.0)))
        where, count = where[splits], count + int(splits.sum())
        found.append(where)
        starts, ends = np.stack([starts[splits], where], 1), np.stack([where, ends[splits]], 1)
        starts, ends = starts.reshape(-1), ends.reshape(-1)


def _farthest_of_each(
    columns: NDArray[np.float64],
    clock: Numbers | None,
    starts: NDArray[np.intp],
    ends: NDArray[np.intp],
) -> tuple[Numbers, NDArray[np.intp]] | None:
    """Finds in each interval what `_farthest_in` finds in one; None where it is not finite.

    Intervals are in order and have a point inside.
    """
    inside = ends - starts - 1
    begins = np.cumsum(inside) - inside
    of = np.repeat(np.arange(len(starts)), inside)
    at = np.arange(len(of)) - begins[of] + starts[of] + 1
    with np.errstate(all="ignore"):
        chords = columns[:, ends] - columns[:, starts]
        squared = (chords * chords).sum(axis=0)
        scale = np.where(squared > _SHORTEST_SQUARED, 1 / squared, 0.0)
        chord, here = chords[:, of], columns[:, at] - columns[:, starts][:, of]
        along = ((here * chord).sum(axis=0) * scale[of]).clip(0.0, 1.0)
        off = ((here - along * chord) ** 2).sum(axis=0)
        if clock is not None:
            # How far along the points before are, of each interval alone: those of a later
            # interval are greater by 2 than all before.
            back = np.maximum.accumulate(along + 2.0 * of) - 2.0 * of - along
            np.maximum(off, back * back * squared[of] * _BACKWARDS_WEIGHT, out=off)
            lasted = clock[ends] - clock[starts]
            rate = np.where(lasted > 0, 1 / lasted, 0.0)[of]
            on_time = (clock[at] - clock[starts][of]) * rate
            late = ((here - on_time * chord) ** 2).sum(axis=0) * _TIME_WEIGHT
            np.maximum(off, np.where(rate > 0, late, 0.0), out=off)
    if not np.isfinite(off).all():
        return None
    most = np.maximum.reduceat(off, begins)
    farthest = np.flatnonzero(off == most[of])
    where = np.empty(len(starts), np.intp)
    # The first of several that are as far: written last.
    where[of[farthest[::-1]]] = at[farthest[::-1]]
    return most, where


def simplifying(
    points: Sequence[Vector3],
    tolerance_m: float,
    at_most: int,
    seconds: Sequence[float] | None = None,
) -> tuple[list[int], list[float]]:
    """Simplifies a path as `simplify_to` does, and returns what that takes step by step.

    So it is known for any wider tolerance, too: `simplify_to` keeps the first points up to the
    first deviation that is not beyond it.

    Returns:
        The indices of the kept points, in the order in which they are kept; and the largest
        deviation (m) of a dropped one with the first two of them, the first three, and so on.
    """
    if at_most < 2:
        raise ValueError(f"a path cannot be drawn with {at_most} vertices; allow 2 or more")
    last = len(points) - 1
    if last < 2:
        return list(range(last + 1)), [0.0]
    # Starting from the chord of the whole path, the worst interval is split again and again.
    # Splitting the worst first makes the limits on tolerance and on count one loop: without a limit
    # on count the result is that of the recursive algorithm, found in another order.
    kept = [0, last]
    columns = _columns(points)
    clock = None if seconds is None else (seconds, np.array(seconds, dtype=np.float64))
    worst = [_farthest(points, columns, 0, last, clock)]
    scans_left = _SCANS_PER_POINT * len(points)
    off = [-worst[0][0]]
    while off[-1] > tolerance_m and len(kept) < at_most:
        _, split, start, end = heapq.heappop(worst)
        if scans_left < 0:
            split = (start + end) // 2
        kept.append(split)
        for low, high in ((start, split), (split, end)):
            if high - low > 1:
                scans_left -= high - low
                heapq.heappush(worst, _farthest(points, columns, low, high, clock))
        off.append(-worst[0][0] if worst else 0.0)
    return kept, off


def _columns(points: Sequence[Vector3]) -> Columns | None:
    """Returns the coordinates as arrays; None for few points, where a loop is faster."""
    if len(points) < _ARRAY_POINTS:
        return None
    xs, ys, zs = np.array(points, dtype=np.float64).T.copy()
    return xs, ys, zs


def _farthest(
    points: Sequence[Vector3],
    columns: Columns | None,
    start: int,
    end: int,
    clock: Clock | None = None,
) -> tuple[float, int, int, int]:
    """Finds the point between `start` and `end` with the largest deviation from their segment.

    Returns:
        (minus its deviation in metres, its index, start, end): an item for a heap.
    """
    if columns is not None and end - start >= _ARRAY_POINTS:
        most, where = _farthest_in(columns, start, end, None if clock is None else clock[1])
        if math.isfinite(most):
            return -math.sqrt(most), where, start, end
    ax, ay, az = points[start]
    bx, by, bz = points[end]
    dx, dy, dz = bx - ax, by - ay, bz - az
    scale = _scale(dx, dy, dz)
    squared = dx * dx + dy * dy + dz * dz
    seconds = None if clock is None else clock[0]
    since, rate = (0.0, 0.0) if seconds is None else (seconds[start], _rate(seconds, start, end))
    most, where, reach = -1.0, start + 1, 0.0
    for index in range(start + 1, end):
        x, y, z = points[index]
        x -= ax
        y -= ay
        z -= az
        along = (x * dx + y * dy + z * dz) * scale
        along = min(along, 1.0) if along > 0 else 0.0
        ox, oy, oz = x - along * dx, y - along * dy, z - along * dz
        off = ox * ox + oy * oy + oz * oz
        if seconds is not None:
            reach = max(reach, along)
            back = (reach - along) * (reach - along) * squared * _BACKWARDS_WEIGHT
            at = (seconds[index] - since) * rate
            lx, ly, lz = x - at * dx, y - at * dy, z - at * dz
            off = max(off, back, (lx * lx + ly * ly + lz * lz) * _TIME_WEIGHT if rate else 0.0)
        if off > most:
            most, where = off, index
    return -math.sqrt(most), where, start, end


def _farthest_in(
    columns: Columns, start: int, end: int, seconds: Numbers | None
) -> tuple[float, int]:
    """Finds it among many points; returns the square of its deviation, and its index."""
    (ax, dx), (ay, dy), (az, dz) = (
        (float(column[start]), float(column[end]) - float(column[start])) for column in columns
    )
    xs, ys, zs = columns
    with np.errstate(all="ignore"):  # the caller repeats what is not finite point by point
        x, y, z = xs[start + 1 : end] - ax, ys[start + 1 : end] - ay, zs[start + 1 : end] - az
        along = ((x * dx + y * dy + z * dz) * _scale(dx, dy, dz)).clip(0.0, 1.0)
        ox, oy, oz = x - along * dx, y - along * dy, z - along * dz
        off = ox * ox + oy * oy + oz * oz
        if seconds is not None:
            back = np.maximum.accumulate(along) - along
            squared = dx * dx + dy * dy + dz * dz
            np.maximum(off, back * back * squared * _BACKWARDS_WEIGHT, out=off)
            rate = _rate(seconds, start, end)
            if rate:
                at = (seconds[start + 1 : end] - seconds[start]) * rate
                x -= at * dx
                y -= at * dy
                z -= at * dz
                np.maximum(off, (x * x + y * y + z * z) * _TIME_WEIGHT, out=off)
    where = int(off.argmax())
    return float(off[where]), start + 1 + where


def _rate(seconds: Sequence[float] | Numbers, start: int, end: int) -> float:
    """Returns one over the time from one point to another; 0 if there is none."""
    lasted = float(seconds[end]) - float(seconds[start])
    return 1 / lasted if lasted > 0 else 0.0


def _scale(dx: float, dy: float, dz: float) -> float:
    """Returns one over the squared length of a chord; 0 for a chord too short to divide by.

    That is a point, as the chord of a closed loop.
    """
    squared = dx * dx + dy * dy + dz * dz
    return 1 / squared if squared > _SHORTEST_SQUARED else 0.0

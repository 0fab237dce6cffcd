"""Rotations, rigid transforms and paths in plain floats.

Quaternions are (x, y, z, w), Hamilton's product, and taken to be of unit length unless a function
says otherwise: `normalised` is the door. A `Transform` is the pose of a child in its parent.
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.model import Quaternion, Transform, Vector3

if TYPE_CHECKING:
    from collections.abc import Sequence

Numbers: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
Columns: TypeAlias = "tuple[Numbers, Numbers, Numbers]"

IDENTITY: Final = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))

_GIMBAL_LOCK_SINE: Final = 1 - 1e-14
"""Beyond this sine of pitch, roll and yaw turn about one axis to within 1.5e-7 rad."""

_PARALLEL_COSINE: Final = 1 - 1e-10
"""Beyond this, slerp divides two tiny sines, and a lerp differs from it by less than 1e-14."""

_SCANS_PER_POINT: Final = 64
"""How often, on average, path refinement may look at a point before it halves intervals."""

_MANY_POINTS: Final = 48
"""From so many on, looking through points as arrays is faster than one by one."""

_SAME_M: Final = 1e-6


def normalised(q: Quaternion) -> Quaternion | None:
    """The unit quaternion of the same rotation; None for a zero, NaN or infinite one."""
    largest = max(abs(part) for part in q)
    if not all(math.isfinite(part) for part in q) or largest == 0:
        return None
    # Scaled first: the squares of very large and very small parts leave the range of a float.
    x, y, z, w = (part / largest for part in q)
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return (x / length, y / length, z / length, w / length)


def rpy(q: Quaternion) -> tuple[float, float, float]:
    """Roll, pitch and yaw (rad) about the fixed axes X, Y, Z in that order (REP-103).

    At gimbal lock (pitch of plus or minus a right angle) only one sum of roll and yaw is
    determined: it is given as yaw, and roll is 0.
    """
    x, y, z, w = q
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    pitch = math.asin(sine)
    if abs(sine) > _GIMBAL_LOCK_SINE:
        return 0.0, pitch, math.remainder(2 * math.atan2(z, w), math.tau)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def yaw(q: Quaternion) -> float:
    """The heading about Z (rad, in [-pi, pi]), as `rpy` gives it."""
    return rpy(q)[2]


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation `b` followed, about the fixed axes, by `a` (Hamilton's product a b)."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The rotation backwards."""
    x, y, z, w = q
    return (-x, -y, -z, w)


def rotate(q: Quaternion, v: Vector3) -> Vector3:
    """`v` turned by `q`."""
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


def compose(a: Transform, b: Transform) -> Transform:
    """`a`, then `b` from there: the pose of b's child in a's parent."""
    x, y, z = rotate(a.rotation, b.translation)
    ax, ay, az = a.translation
    return Transform((ax + x, ay + y, az + z), multiply(a.rotation, b.rotation))


def invert(t: Transform) -> Transform:
    """The pose of the parent in the child."""
    back = conjugate(t.rotation)
    x, y, z = rotate(back, t.translation)
    return Transform((-x, -y, -z), back)


def alike(one: Transform, other: Transform) -> bool:
    """Whether two transforms differ by less than a micrometre, and by hardly an angle."""
    apart = compose(invert(one), other)
    off = distance(apart.translation, (0.0, 0.0, 0.0))
    return off < _SAME_M and abs(apart.rotation[3]) > 1 - _SAME_M


def slerp(a: Quaternion, b: Quaternion, ratio: float) -> Quaternion:
    """The rotation `ratio` (0 to 1) of the way from `a` to `b`, the shorter way, at even speed."""
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
    """The transform `ratio` (0 to 1) of the way: translation linear, rotation by `slerp` (tf2)."""
    x, y, z = (p + (q - p) * ratio for p, q in zip(a.translation, b.translation, strict=True))
    return Transform((x, y, z), slerp(a.rotation, b.rotation, ratio))


def distance(a: Vector3, b: Vector3) -> float:
    """Metres between two points, in a straight line."""
    return math.dist(a, b)


def off_segment(
    point: tuple[float, float], start: tuple[float, float], end: tuple[float, float]
) -> float:
    """How far a point of the plane is from a segment; NaN where a coordinate is NaN."""
    (px, py), (ax, ay) = point, start
    dx, dy = end[0] - ax, end[1] - ay
    along = ((px - ax) * dx + (py - ay) * dy) * _scale(dx, dy, 0.0)
    if math.isnan(along):
        return math.nan
    along = min(max(along, 0.0), 1.0)
    return math.hypot(px - ax - along * dx, py - ay - along * dy)


def simplify_to(
    points: Sequence[Vector3], tolerance_m: float, at_most: int
) -> tuple[list[int], float]:
    """The vertices that are enough to draw a path (Ramer, Douglas and Peucker), and no more.

    Both ends are kept, and every point that is dropped lies within `tolerance_m` of the kept
    segment that spans it, unless that takes more than `at_most` vertices: then as near as these
    allow. Points must be finite. Cost is bounded: where the splits stay lopsided, intervals are
    halved instead, which keeps some vertices more than needed.

    Returns:
        Their indices, ascending, and the largest distance (m) of a dropped point from the kept
        segment that spans it.

    Raises:
        ValueError: `at_most` is below 2: both ends are always kept.
    """
    if at_most < 2:
        raise ValueError(f"a path cannot be drawn with {at_most} vertices; allow 2 or more")
    last = len(points) - 1
    if last < 2:
        return list(range(last + 1)), 0.0
    # From the chord of the whole path the worst interval is split again and again. Splitting the
    # worst first makes the limits on tolerance and on count one loop: with no limit on count the
    # kept set is that of the recursive algorithm, in another order.
    kept = [0, last]
    columns = _columns(points)
    worst = [_farthest(points, columns, 0, last)]
    scans_left = _SCANS_PER_POINT * len(points)
    while worst and -worst[0][0] > tolerance_m and len(kept) < at_most:
        _, split, start, end = heapq.heappop(worst)
        if scans_left < 0:
            split = (start + end) // 2
        kept.append(split)
        for low, high in ((start, split), (split, end)):
            if high - low > 1:
                scans_left -= high - low
                heapq.heappush(worst, _farthest(points, columns, low, high))
    return sorted(kept), -worst[0][0] if worst else 0.0


def _columns(points: Sequence[Vector3]) -> Columns | None:
    """The coordinates as arrays; None for few points, for which these cost more than they save."""
    if len(points) < _MANY_POINTS:
        return None
    xs, ys, zs = np.array(points, dtype=np.float64).T.copy()
    return xs, ys, zs


def _farthest(
    points: Sequence[Vector3], columns: Columns | None, start: int, end: int
) -> tuple[float, int, int, int]:
    """The point between `start` and `end` that lies farthest from the segment between them.

    Returns:
        (minus its distance in metres, its index, start, end): ready for a heap.
    """
    if columns is not None and end - start >= _MANY_POINTS:
        most, where = _farthest_in(columns, start, end)
        if math.isfinite(most):
            return -math.sqrt(most), where, start, end
    ax, ay, az = points[start]
    bx, by, bz = points[end]
    dx, dy, dz = bx - ax, by - ay, bz - az
    scale = _scale(dx, dy, dz)
    most, where = -1.0, start + 1
    for index in range(start + 1, end):
        x, y, z = points[index]
        x -= ax
        y -= ay
        z -= az
        along = (x * dx + y * dy + z * dz) * scale
        if along > 0:
            along = min(along, 1.0)
            x -= along * dx
            y -= along * dy
            z -= along * dz
        off = x * x + y * y + z * z
        if off > most:
            most, where = off, index
    return -math.sqrt(most), where, start, end


def _farthest_in(columns: Columns, start: int, end: int) -> tuple[float, int]:
    """The same of many points: its squared distance and its index, by the same steps."""
    (ax, dx), (ay, dy), (az, dz) = (
        (float(column[start]), float(column[end]) - float(column[start])) for column in columns
    )
    xs, ys, zs = columns
    with np.errstate(all="ignore"):  # what is not finite the caller works out point by point
        x, y, z = xs[start + 1 : end] - ax, ys[start + 1 : end] - ay, zs[start + 1 : end] - az
        along = ((x * dx + y * dy + z * dz) * _scale(dx, dy, dz)).clip(0.0, 1.0)
        x -= along * dx
        y -= along * dy
        z -= along * dz
        off = x * x + y * y + z * z
    where = int(off.argmax())
    return float(off[where]), start + 1 + where


def _scale(dx: float, dy: float, dz: float) -> float:
    """One over the squared length of a chord.

    A chord too short to divide by is a point: a closed loop ends where it starts.
    """
    squared = dx * dx + dy * dy + dz * dz
    return 1 / squared if squared > 1e-300 else 0.0

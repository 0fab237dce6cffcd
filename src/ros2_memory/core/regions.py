"""Regions: circles, boxes and polygons, at any height or at some, and parts of a path inside them.

Lengths are metres. The border of a region is inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Flags
    from ros2_memory.core.model import Vector3

Floats: TypeAlias = "NDArray[np.float64]"
Point: TypeAlias = "tuple[float, float]"
Bounds: TypeAlias = "tuple[float, float, float, float]"
"""The least and greatest x, and the least and greatest y."""
_NEVER: Final = (2.0, -1.0)
"""The shares of a step that is never inside: no share from 0 to 1 lies between them."""


class Steps(NamedTuple):
    """Straight steps of a path, from (x, y, z) to (to_x, to_y, to_z); z is NaN if unknown."""

    x: Floats
    y: Floats
    z: Floats
    to_x: Floats
    to_y: Floats
    to_z: Floats

    @property
    def moved(self) -> tuple[Floats, Floats]:
        """How far each step leads along x and y."""
        return self.to_x - self.x, self.to_y - self.y

    def nearest_to(self, x: float, y: float) -> tuple[Floats, Floats]:
        """Returns the share of each step that is nearest to a point, and its distance (m)."""
        along_x, along_y = self.moved
        squared = along_x * along_x + along_y * along_y
        share = (x - self.x) * along_x + (y - self.y) * along_y
        share = (share / np.where(squared > 0, squared, 1.0)).clip(0.0, 1.0)
        return share, np.hypot(self.x + share * along_x - x, self.y + share * along_y - y)


class ClippedSteps(NamedTuple):
    """Parts of steps: the index of the step, and the shares (0 to 1) at which the part lies."""

    step: NDArray[np.intp]
    start: Floats
    stop: Floats


@dataclass(frozen=True, slots=True)
class Circle:
    """All points within a radius."""

    x: float
    y: float
    radius_m: float

    def contains(self, x: float, y: float) -> bool:
        """Returns whether a point is inside."""
        return math.hypot(x - self.x, y - self.y) <= self.radius_m

    @property
    def bounds(self) -> Bounds:
        """The least and greatest x, and the least and greatest y."""
        x, y, radius = self.x, self.y, self.radius_m
        return x - radius, x + radius, y - radius, y + radius

    def shares_inside(self, steps: Steps) -> tuple[Floats, Floats]:
        """Returns from which to which share each step is inside; `_NEVER` if it never is.

        A point at share s of a step is on the circle where a s^2 + 2 b s + c = 0.
        """
        dx, dy = steps.moved
        px, py = steps.x - self.x, steps.y - self.y
        a = dx * dx + dy * dy
        moves = a > 0
        with np.errstate(over="ignore", invalid="ignore"):  # x, y and the radius may be 1e308
            b = px * dx + py * dy
            c = px * px + py * py - self.radius_m * self.radius_m
            discriminant = b * b - a * c
        root = np.sqrt(np.maximum(discriminant, 0.0))
        divisor = np.where(moves, a, 1.0)
        start = np.where(moves, (-b - root) / divisor, 0.0)
        stop = np.where(moves, (-b + root) / divisor, 1.0)
        meets = np.where(moves, discriminant >= 0, c <= 0)
        never_start, never_stop = _NEVER
        return np.where(meets, start, never_start), np.where(meets, stop, never_stop)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """All points between two x and two y."""

    min_x: float
    max_x: float
    min_y: float
    max_y: float

    def contains(self, x: float, y: float) -> bool:
        """Returns whether a point is inside."""
        return self.min_x <= x <= self.max_x and self.min_y <= y <= self.max_y

    @property
    def bounds(self) -> Bounds:
        """The least and greatest x, and the least and greatest y."""
        return self.min_x, self.max_x, self.min_y, self.max_y

    def shares_inside(self, steps: Steps) -> tuple[Floats, Floats]:
        """Returns from which to which share each step is inside; the first is greater if never."""
        x_start, x_stop = _shares_between(steps.x, steps.to_x, self.min_x, self.max_x)
        y_start, y_stop = _shares_between(steps.y, steps.to_y, self.min_y, self.max_y)
        return np.maximum(x_start, y_start), np.minimum(x_stop, y_stop)


def _shares_between(at: Floats, to: Floats, low: float, high: float) -> tuple[Floats, Floats]:
    """Returns from which to which share steps lie between two values; `_NEVER` if they never do.

    A value that is NaN lies nowhere.
    """
    along = to - at
    moves = along != 0
    divisor = np.where(moves, along, 1.0)
    at_low, at_high = (low - at) / divisor, (high - at) / divisor
    is_between = (at >= low) & (at <= high)
    start_if_still = np.where(is_between, 0.0, _NEVER[0])
    start = np.where(moves, np.minimum(at_low, at_high), start_if_still)
    return start, np.where(moves, np.maximum(at_low, at_high), 1.0)


@dataclass(frozen=True, slots=True)
class Polygon:
    """All points inside of a closed line through these corners, by the even-odd rule."""

    corners: tuple[Point, ...]

    def contains(self, x: float, y: float) -> bool:
        """Returns whether a point is inside; a point on the border may count as either."""
        return bool(_inside(self.corners, np.array([x]), np.array([y]))[0])

    @property
    def bounds(self) -> Bounds:
        """The least and greatest x, and the least and greatest y."""
        xs, ys = zip(*self.corners, strict=True)
        return min(xs), max(xs), min(ys), max(ys)

    def clipped(self, steps: Steps) -> ClippedSteps:
        """Returns the parts of steps inside: those between two crossings whose middle is inside."""
        cuts = self._cuts(steps)
        dx, dy = steps.moved
        middle = (cuts[1:] + cuts[:-1]) / 2
        inside = _inside(self.corners, steps.x + dx * middle, steps.y + dy * middle)
        inside &= cuts[1:] > cuts[:-1]
        # A step of no length is inside as a whole, or not.
        still = (dx == 0) & (dy == 0)
        inside[:, still] = False
        inside[0, still] = _inside(self.corners, steps.x[still], steps.y[still])
        step, part = np.nonzero(inside.T)
        return ClippedSteps(
            step, cuts[part, step], np.where(still[step], 1.0, cuts[part + 1, step])
        )

    def _cuts(self, steps: Steps) -> Floats:
        """Returns the shares at which steps (columns) cross sides, ascending between 0 and 1.

        The share is 1 for a side that the step does not cross.
        """
        count = len(steps.x)
        dx, dy = steps.moved
        cuts = [np.zeros(count), np.ones(count)]
        for (ax, ay), (bx, by) in pairwise((*self.corners, self.corners[0])):
            side_x, side_y = bx - ax, by - ay
            cross = dx * side_y - dy * side_x
            divisor = np.where(cross != 0, cross, 1.0)
            of_step = ((ax - steps.x) * side_y - (ay - steps.y) * side_x) / divisor
            of_side = ((ax - steps.x) * dy - (ay - steps.y) * dx) / divisor
            on_both = (of_step > 0) & (of_step < 1) & (of_side >= 0) & (of_side <= 1)
            cuts.append(np.where((cross != 0) & on_both, of_step, 1.0))
        return np.sort(np.stack(cuts), axis=0)


@dataclass(frozen=True, slots=True)
class AnyOf:
    """All points of several regions."""

    regions: tuple[Region, ...]

    @property
    def bounds(self) -> Bounds:
        """The least and greatest x, and the least and greatest y."""
        low_x, high_x, low_y, high_y = zip(*(region.bounds for region in self.regions), strict=True)
        return min(low_x), max(high_x), min(low_y), max(high_y)

    def clipped(self, steps: Steps) -> ClippedSteps:
        """Returns the parts of steps inside; parts that overlap or touch are one part."""
        parts = [clipped(region, steps) for region in self.regions]
        step, start, stop = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        if not len(step):
            return ClippedSteps(step, start, stop)
        order = np.lexsort((start, step))
        step, start, stop = step[order], start[order], stop[order]
        # `step + stop` ascends along the path, as shares are at most 1.
        reached = np.maximum.accumulate(step + stop)
        is_new = (step[1:] != step[:-1]) | (step[1:] + start[1:] > reached[:-1])
        begins = np.flatnonzero(np.append([True], is_new))
        return ClippedSteps(step[begins], start[begins], np.maximum.reduceat(stop, begins))


@dataclass(frozen=True, slots=True)
class Storey:
    """The points of a region whose z is within two values, which may be infinite."""

    plan: Region
    low: float
    high: float

    @property
    def bounds(self) -> Bounds:
        """The least and greatest x, and the least and greatest y."""
        return self.plan.bounds

    def clipped(self, steps: Steps) -> ClippedSteps:
        """Returns the parts of steps inside."""
        step, start, stop = clipped(self.plan, steps)
        low, high = _shares_between(steps.z[step], steps.to_z[step], self.low, self.high)
        start, stop = np.maximum(start, low), np.minimum(stop, high)
        meets = start <= stop
        return ClippedSteps(step[meets], start[meets], stop[meets])


Region: TypeAlias = "Circle | Rectangle | Polygon | AnyOf | Storey"


def contains(region: Region, x: float, y: float, z: float) -> bool:
    """Returns whether a point is in a region; with a z of NaN, in none that has heights."""
    match region:
        case AnyOf(regions):
            return any(contains(part, x, y, z) for part in regions)
        case Storey(plan, low, high):
            return low <= z <= high and contains(plan, x, y, z)
    return region.contains(x, y)


def _inside(corners: tuple[Point, ...], x: Floats, y: Floats) -> Flags:
    """Returns which points lie in a polygon: a ray to greater x crosses an odd number of sides."""
    inside = np.zeros(np.shape(x), np.bool_)
    for (ax, ay), (bx, by) in pairwise((*corners, corners[0])):
        crosses = (ay > y) != (by > y)
        height = (by - ay) or 1.0
        inside ^= crosses & (x < (bx - ax) * (y - ay) / height + ax)
    return inside


def clipped(region: Region, steps: Steps) -> ClippedSteps:
    """Returns the parts of steps inside of a region, in order."""
    low_x, high_x, low_y, high_y = region.bounds
    near = np.flatnonzero(
        (np.minimum(steps.x, steps.to_x) <= high_x)
        & (np.maximum(steps.x, steps.to_x) >= low_x)
        & (np.minimum(steps.y, steps.to_y) <= high_y)
        & (np.maximum(steps.y, steps.to_y) >= low_y)
    )
    nearby = Steps(*(column[near] for column in steps))
    if isinstance(region, Polygon | AnyOf | Storey):
        parts = region.clipped(nearby)
        return ClippedSteps(near[parts.step], parts.start, parts.stop)
    start, stop = region.shares_inside(nearby)
    start, stop = np.maximum(start, 0.0), np.minimum(stop, 1.0)
    meets = start <= stop
    return ClippedSteps(near[meets], start[meets], stop[meets])


@dataclass(frozen=True, slots=True)
class Place:
    """A named region of a frame."""

    name: str
    frame_id: str
    region: Region


def places_at(places: Sequence[Place], points: Mapping[str, Vector3 | None]) -> tuple[str, ...]:
    """Returns the names of the places that a point is in, the smallest first.

    `points` has it in each frame in which it is known.
    """
    inside = (
        place
        for place in places
        if (point := points.get(place.frame_id)) is not None and contains(place.region, *point)
    )
    return tuple(place.name for place in sorted(inside, key=lambda place: _area(place.region)))


def plan_of(region: Region) -> Region:
    """Returns a region at all heights."""
    return region.plan if isinstance(region, Storey) else region


def _area(region: Region) -> float:
    match plan_of(region):
        case Circle(radius_m=radius_m):
            return math.pi * radius_m**2
        case Polygon(corners):
            sides = pairwise((*corners, corners[0]))
            return abs(sum(ax * by - bx * ay for (ax, ay), (bx, by) in sides)) / 2
    low_x, high_x, low_y, high_y = region.bounds
    return (high_x - low_x) * (high_y - low_y)

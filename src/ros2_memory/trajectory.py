"""The way driven, summed up pose by pose in bounded memory.

Distances and speeds are exact over all poses. The drawn path is simplified on the way: standing
still is merged, each full block of poses is simplified, and the whole again at the end; the
deviations of these stages add up to at most the tolerance, unless a limit on count widens it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from ros2_memory.geometry import distance, normalised, simplify_to, yaw
from ros2_memory.timebase import NS_PER_MS, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.model import Pose, Quaternion, Vector3

ARRIVAL_JITTER_NS: Final[Ns] = 100 * NS_PER_MS
"""How far apart two poses must have been recorded for their distance to tell a speed.

Log time is the time of arrival. Transports and a busy recorder deliver in bursts: public bags
hold poses 3 ms apart that lie 0.2 m apart, which is GNSS noise and not 72 m/s.
"""

_FARTHEST_M: Final = 1e12
"""Coordinates beyond this are no place on Earth but memory that nobody filled in."""

_BLOCK: Final = 4096
_MOST_VERTICES: Final = 20_000

_Vertex: TypeAlias = "tuple[Ns, Vector3, Quaternion | None]"


@dataclass(frozen=True, slots=True)
class Waypoint:
    """One vertex of the drawn path: a pose as recorded (m, rad; no yaw without orientation)."""

    time: Ns
    position: Vector3
    yaw_rad: float | None


@dataclass(frozen=True, slots=True)
class Trajectory:
    """What is said of the way driven.

    Attributes:
        distance_m: path length in 3D in log-time order, jumps left out.
        duration_s: from the first to the last valid pose.
        avg_speed: `distance_m / duration_s` (m/s); 0 where there is no duration.
        max_speed: the highest speed (m/s), from `max_speed_from`.
        max_speed_from: `twist`: the messages' own; `positions`: from poses at least 0.1 s apart.
        waypoints: vertices of the drawn path, first and last pose among them.
        waypoint_error_m: no pose lies farther than this from the drawn path.
        poses: valid poses counted.
        invalid: poses left out, since a coordinate is NaN, infinite or beyond any place.
        jumps: steps faster than is plausible, left out of distance and speed.
        jumped_m: their total length.
    """

    distance_m: float
    duration_s: float
    avg_speed: float
    max_speed: float
    max_speed_from: Literal["twist", "positions"]
    waypoints: tuple[Waypoint, ...]
    waypoint_error_m: float
    poses: int
    invalid: int
    jumps: int
    jumped_m: float


def summarise(
    poses: Iterable[tuple[Ns, Pose, float | None]],
    max_plausible_speed_mps: float,
    max_waypoints: int = 50,
    tolerance_m: float = 0.05,
) -> Trajectory:
    """The trajectory of (log time, pose, the message's own speed in m/s or None) in time order.

    Raises:
        ValueError: `max_waypoints` is below 2, or a limit is not positive.
    """
    builder = TrajectoryBuilder(max_plausible_speed_mps, max_waypoints, tolerance_m)
    for time, pose, speed in poses:
        builder.add(time, pose, speed)
    return builder.result()


class TrajectoryBuilder:
    """Takes poses in log-time order, one at a time, and holds a bounded number of them."""

    def __init__(
        self,
        max_plausible_speed_mps: float,
        max_waypoints: int = 50,
        tolerance_m: float = 0.05,
    ) -> None:
        """Limits as for `summarise`.

        Raises:
            ValueError: `max_waypoints` is below 2, or a limit is not positive.
        """
        if max_waypoints < 2 or not (max_plausible_speed_mps > 0 and tolerance_m > 0):
            raise ValueError(
                f"a trajectory needs 2 or more waypoints ({max_waypoints}), a plausible speed"
                f" ({max_plausible_speed_mps} m/s) and a tolerance ({tolerance_m} m) above 0"
            )
        self._motion = _Motion(max_plausible_speed_mps)
        self._path = _Path(tolerance_m)
        self._max_waypoints = max_waypoints
        self._invalid = 0
        self._twist: float | None = None

    def add(self, time: Ns, pose: Pose, speed_mps: float | None = None) -> None:
        """Takes the next pose, and the speed that its message states, if it states one."""
        x, y, z = pose.position
        # A comparison with NaN is false, so this one refuses all three kinds.
        if not (abs(x) < _FARTHEST_M and abs(y) < _FARTHEST_M and abs(z) < _FARTHEST_M):
            self._invalid += 1
            return
        if speed_mps is not None and math.isfinite(speed_mps):
            self._twist = max(self._twist or 0.0, abs(speed_mps))
        self._motion.add(time, pose.position)
        self._path.add((time, pose.position, pose.orientation))

    @property
    def vertices(self) -> int:
        """How many poses are held to draw the path: about 25,000 at most."""
        return self._path.size

    def result(self) -> Trajectory:
        """The trajectory so far; more poses may be added after."""
        motion = self._motion
        duration_s = unix_from_ns(motion.time - motion.first_time)
        avg_speed = motion.distance_m / duration_s if duration_s > 0 else 0.0
        # Drivers that know no twist leave it zero: then it says nothing of a robot that moved.
        stated = self._twist if self._twist or not motion.distance_m else None
        waypoints, error = self._path.drawn(self._max_waypoints)
        return Trajectory(
            distance_m=motion.distance_m,
            duration_s=duration_s,
            avg_speed=avg_speed,
            max_speed=max(motion.max_speed, avg_speed) if stated is None else stated,
            max_speed_from="positions" if stated is None else "twist",
            waypoints=waypoints,
            waypoint_error_m=error,
            poses=motion.poses,
            invalid=self._invalid,
            jumps=motion.jumps,
            jumped_m=motion.jumped_m,
        )


class _Motion:
    """Distance, speed and jumps of the positions in order."""

    def __init__(self, max_plausible_speed_mps: float) -> None:
        self._limit = max_plausible_speed_mps
        self.poses = 0
        self.first_time: Ns = 0
        self.time: Ns = 0
        self.distance_m = 0.0
        self.max_speed = 0.0
        self.jumps = 0
        self.jumped_m = 0.0
        self._position: Vector3 = (0.0, 0.0, 0.0)
        self._measured_from: tuple[Ns, Vector3] = (0, self._position)

    def add(self, time: Ns, position: Vector3) -> None:
        self.poses += 1
        if self.poses == 1:
            self.first_time = time
            self._measured_from = (time, position)
        else:
            self._step(time, position)
        self.time, self._position = time, position

    def _step(self, time: Ns, position: Vector3) -> None:
        step_m = distance(self._position, position)
        # A burst squeezes the time between two poses to nothing; it does not make a jump of them.
        step_s = unix_from_ns(max(time - self.time, ARRIVAL_JITTER_NS))
        if step_m > self._limit * step_s * (1 + 1e-9):
            self.jumps += 1
            self.jumped_m += step_m
            self._measured_from = (time, position)
            return
        self.distance_m += step_m
        since, origin = self._measured_from
        if time - since >= ARRIVAL_JITTER_NS:
            speed = distance(origin, position) / unix_from_ns(time - since)
            self.max_speed = max(self.max_speed, speed)
            self._measured_from = (time, position)


class _Path:
    """The drawn path: vertices that are enough, and how far any pose may lie off them.

    A simplification of a simplification: the deviations add and do no more, since a vertex that
    the second drops lies beside the same kept segment as its neighbours. A quarter of the
    tolerance goes to merging small steps, a quarter to the blocks, and what is left to the whole.
    Where that keeps too many vertices the first two quarters are doubled, so that all earlier
    deviations together are no more than the last one.
    """

    def __init__(self, tolerance_m: float) -> None:
        self._tolerance_m = tolerance_m
        self._stage_m = tolerance_m / 4
        self._kept: list[_Vertex] = []
        self._block: list[_Vertex] = []
        self._merged: _Vertex | None = None
        self._merged_m = 0.0
        self._dropped_m = 0.0

    @property
    def size(self) -> int:
        return len(self._kept) + len(self._block)

    def add(self, vertex: _Vertex) -> None:
        if self._block:
            off = distance(self._block[-1][1], vertex[1])
            if off <= self._stage_m:
                self._merged_m = max(self._merged_m, off)
                self._merged = vertex
                return
        self._merged = None
        self._block.append(vertex)
        if len(self._block) == _BLOCK:
            self._close_block()

    def drawn(self, at_most: int) -> tuple[tuple[Waypoint, ...], float]:
        """The waypoints, and the bound on how far (m) any pose lies from their polyline."""
        vertices = [*self._kept, *self._block]
        if self._merged is not None:
            vertices.append(self._merged)
        so_far = self._merged_m + self._dropped_m
        kept, error = _thinned(
            vertices, max(self._tolerance_m - so_far, self._tolerance_m / 2), at_most
        )
        return tuple(_waypoint(vertex) for vertex in kept), so_far + error

    def _close_block(self) -> None:
        """Keeps the vertices that draw the block; its last one begins the next block."""
        kept, error = _thinned(self._block, self._stage_m, _BLOCK)
        self._dropped_m = max(self._dropped_m, error)
        self._kept += kept[:-1]
        self._block = kept[-1:]
        if len(self._kept) > _MOST_VERTICES:
            while len(self._kept) > _MOST_VERTICES // 2:
                self._stage_m *= 2
                self._kept, error = _thinned(self._kept, self._stage_m, len(self._kept))
                self._dropped_m += error


def _thinned(
    vertices: list[_Vertex], tolerance_m: float, at_most: int
) -> tuple[list[_Vertex], float]:
    indices, error = simplify_to([vertex[1] for vertex in vertices], tolerance_m, at_most)
    return [vertices[index] for index in indices], error


def _waypoint(vertex: _Vertex) -> Waypoint:
    time, position, orientation = vertex
    unit = None if orientation is None else normalised(orientation)
    return Waypoint(time, position, None if unit is None else yaw(unit))

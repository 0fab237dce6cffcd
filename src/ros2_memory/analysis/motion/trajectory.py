"""The driven path, measured and drawn in bounded memory.

Poses are measured many at a time (see `odometry` and `path_length`). The drawn path is simplified
on the way (see `polyline`); the deviations of all stages add up to at most the tolerance, unless a
limit on the count of vertices widens it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Final, Literal

from ros2_memory.analysis.motion.odometry import (
    Motion,
    MotionTotals,
    PoseDigest,
    TimedPosition,
    Vertex,
    faster,
    is_place,
)
from ros2_memory.analysis.motion.path_length import SPEED_STEPS
from ros2_memory.analysis.motion.polyline import PARTED, DrawnPath
from ros2_memory.core.geometry import normalised, yaw

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import Pose, Quaternion, Vector3
    from ros2_memory.core.timebase import Ns

TOLERANCE_M: Final = 0.05
"""How far a pose may be from the drawn path, unless a limit on count widens it."""

MAX_WAYPOINTS: Final = 50
"""Vertices of the path that is returned, unless more or fewer are asked for."""

_BAG_VERTICES: Final = 32
"""Vertices of the path that is stored of one bag; all of its poses, where they are no more."""

_NOISY_SHARE: Final = 0.02
_NOISY_M: Final = 0.001

_BATCH: Final = 2048
"""Poses that are measured together."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """One vertex of the drawn path: a pose as recorded (m, rad; no yaw without orientation).

    `jump`: the robot jumped here from the waypoint before, instead of driving.
    """

    time: Ns
    position: Vector3
    yaw_rad: float | None
    jump: bool = False


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The measurements of a driven path.

    Attributes:
        totals: path length in 3D in log-time order, as far as its noise allows (see
            `path_length`), and what is left out of it.
        avg_speed: `distance_m / duration_s` (m/s); 0 where there is no duration.
        max_speed: the highest speed (m/s), from `max_speed_from`.
        max_speed_from: `twist`: the messages' own; `positions`: over a second and eight poses.
        waypoints: vertices of the path drawn in space and time: first and last pose, corners,
            turning points, ends of stops, and both ends of the longest jumps.
        waypoint_error_m: no pose is farther than this from the drawn path.
        poses: how many valid poses.
        invalid: poses left out, since a coordinate is NaN, infinite or beyond any place.
    """

    totals: MotionTotals
    avg_speed: float
    max_speed: float
    max_speed_from: Literal["twist", "positions"]
    waypoints: tuple[Waypoint, ...]
    waypoint_error_m: float
    poses: int
    invalid: int

    @property
    def is_known(self) -> bool:
        """Whether there is a valid pose."""
        return self.poses > 0

    @property
    def is_noisy(self) -> bool:
        """Whether the plain sum is longer by more than 2 %, and by a millimetre."""
        distance_m = self.totals.distance_m
        more_m = self.totals.path_sum_m - distance_m
        return more_m > max(_NOISY_SHARE * distance_m, _NOISY_M)


class _Poses:
    """Takes poses in log-time order, and measures and draws many of them at a time."""

    def __init__(self, max_plausible_speed_mps: float, tolerance_m: float) -> None:
        self._motion = Motion(max_plausible_speed_mps)
        self._path = DrawnPath(tolerance_m)
        self._waiting: list[Vertex] = []
        self._poses = 0
        self._invalid = 0
        self._twist: float | None = None
        self._frames: dict[str, None] = {}

    def add(self, time: Ns, pose: Pose, speed_mps: float | None = None) -> None:
        """Takes the next pose, and the speed that its message states, if it states one."""
        self._frames[pose.frame_id] = None
        if not is_place(pose.position):
            self._invalid += 1
            return
        self._twist = faster(self._twist, speed_mps)
        self._add((time, pose.position, pose.orientation))

    def _add(self, vertex: Vertex) -> None:
        self._poses += 1
        self._waiting.append(vertex)
        if len(self._waiting) == _BATCH:
            self._measure()

    def _measure(self) -> None:
        """Measures and draws the waiting poses."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        parted = {
            *self._motion.add([TimedPosition(time, position) for time, position, _ in waiting])
        }
        for index, vertex in enumerate(waiting):
            if index in parted:
                self._path.part()
            self._path.add(vertex)


class TrajectoryBuilder(_Poses):
    """Builds a trajectory from poses in log-time order; holds a bounded number of them.

    A step that would take more than `max_plausible_speed_mps` (m/s) is a jump. The path is drawn
    with at most `max_waypoints`, within `tolerance_m` (m) where these are enough.

    Raises:
        ValueError: `max_waypoints` is below 2, or a limit is not positive.
    """

    def __init__(
        self,
        max_plausible_speed_mps: float,
        max_waypoints: int = MAX_WAYPOINTS,
        tolerance_m: float = TOLERANCE_M,
    ) -> None:
        if max_waypoints < 2 or not (max_plausible_speed_mps > 0 and tolerance_m > 0):
            raise ValueError(
                f"a trajectory needs 2 or more waypoints ({max_waypoints}), a plausible speed"
                f" ({max_plausible_speed_mps} m/s) and a tolerance ({tolerance_m} m) above 0"
            )
        super().__init__(max_plausible_speed_mps, tolerance_m)
        self._max_waypoints = max_waypoints

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames of all poses so far, valid or not, in order of appearance."""
        return tuple(self._frames)

    def join(self, whole: PoseDigest) -> None:
        """Takes all poses of a bag that come next."""
        self._frames.update(dict.fromkeys(whole.frames))
        self._invalid += whole.invalid
        self._twist = faster(self._twist, whole.twist)
        if whole.totals.head is None:
            for vertex in whole.vertices:
                self._add(vertex)
            return
        self._measure()
        self._poses += whole.poses
        if self._motion.join(whole.totals):
            self._path.part()
        self._path.extend(whole.vertices, whole.error_m)

    def result(self) -> Trajectory:
        """Returns the trajectory so far; more poses may be added after."""
        self._measure()
        totals = replace(self._motion.totals)
        distance_m, duration_s = totals.distance_m, totals.duration_s
        avg_speed = distance_m / duration_s if duration_s > 0 else 0.0
        # Drivers without a twist leave it zero, which is wrong where the robot moved.
        stated = self._twist if self._twist or not distance_m else None
        step_mps = self._motion.step_mps if self._poses <= SPEED_STEPS else 0.0
        measured = totals.speed_mps or step_mps
        drawn = self._path.drawn(self._max_waypoints)
        return Trajectory(
            totals=totals,
            avg_speed=avg_speed,
            max_speed=max(measured, avg_speed) if stated is None else stated,
            max_speed_from="positions" if stated is None else "twist",
            waypoints=tuple(
                Waypoint(time, position, _heading(turn), jump=place == 0 and number > 0)
                for number, piece in enumerate(drawn.pieces)
                for place, (time, position, turn) in enumerate(piece)
            ),
            waypoint_error_m=drawn.error_m,
            poses=self._poses,
            invalid=self._invalid,
        )


def joined_poses(
    found: Sequence[tuple[PoseDigest, tuple[Ns, Ns]]], max_plausible_speed_mps: float
) -> list[tuple[PoseDigest, tuple[Ns, Ns]]]:
    """Returns the digests of consecutive bags, with their times, as of few bags.

    Those of few poses stay as they are: what comes before and after them decides how they are
    measured.
    """
    joined: list[tuple[PoseDigest, tuple[Ns, Ns]]] = []
    for has_legs, some in groupby(found, key=lambda each: each[0].totals.head is not None):
        bags = [*some]
        if not has_legs or len(bags) == 1:
            joined += bags
            continue
        motion = Motion(max_plausible_speed_mps)
        vertices: list[Vertex] = []
        for each, _ in bags:
            if motion.join(each.totals):
                vertices.append(PARTED)
            vertices += each.vertices
        twist: float | None = None
        for each, _ in bags:
            twist = faster(twist, each.twist)
        whole = PoseDigest(
            poses=sum(each.poses for each, _ in bags),
            invalid=sum(each.invalid for each, _ in bags),
            totals=motion.totals,
            twist=twist,
            frames=tuple(dict.fromkeys(frame for each, _ in bags for frame in each.frames)),
            vertices=tuple(vertices),
            error_m=max(each.error_m for each, _ in bags),
        )
        joined.append((whole, (bags[0][1][0], bags[-1][1][1])))
    return joined


class PoseCollector(_Poses):
    """Builds the digest of one bag's poses, which come in log-time order.

    `max_plausible_speed_mps` must be that of the trajectories which join the digest.
    """

    def __init__(self, max_plausible_speed_mps: float) -> None:
        super().__init__(max_plausible_speed_mps, TOLERANCE_M / 4)

    def digest(self) -> PoseDigest:
        """Returns the digest."""
        few = self._waiting if self._poses <= _BAG_VERTICES else None
        self._measure()
        drawn = self._path.drawn(_BAG_VERTICES)
        vertices = drawn.row() if few is None else few
        totals = self._motion.totals
        return PoseDigest(
            poses=self._poses,
            invalid=self._invalid,
            totals=replace(totals) if few is None else replace(totals, head=None, tail=None),
            twist=self._twist,
            frames=tuple(self._frames),
            vertices=tuple((time, position, _heading(turn)) for time, position, turn in vertices),
            error_m=drawn.error_m if few is None else 0.0,
        )


def _heading(turn: Quaternion | float | None) -> float | None:
    """Returns the heading (rad) of a vertex; None where it has none."""
    if turn is None or isinstance(turn, float):
        return turn
    unit = normalised(turn)
    return None if unit is None else yaw(unit)

"""The way driven, summed up pose by pose in bounded memory.

Distances and speeds are exact over all poses. The drawn path is simplified on the way (see
`paths`); the deviations of all stages add up to at most the tolerance, unless a limit on count
widens it. Where the robot jumped the path is parted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from ros2_memory.geometry import normalised, yaw
from ros2_memory.motion import Motion, PoseDigest, Vertex, faster, is_place
from ros2_memory.paths import DrawnPath

if TYPE_CHECKING:
    from ros2_memory.model import Pose, Quaternion, Vector3
    from ros2_memory.timebase import Ns

TOLERANCE_M: Final = 0.05
"""How far a pose may lie from the drawn path, unless a limit on count widens it."""

_BAG_VERTICES: Final = 32
"""Vertices of the path that is kept of one bag."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """One vertex of the drawn path: a pose as recorded (m, rad; no yaw without orientation).

    `jump`: the robot jumped here from the waypoint before it, and did not drive.
    """

    time: Ns
    position: Vector3
    yaw_rad: float | None
    jump: bool = False


@dataclass(frozen=True, slots=True)
class Trajectory:
    """What is said of the way driven.

    Attributes:
        distance_m: path length in 3D in log-time order, jumps left out.
        duration_s: from the first to the last valid pose.
        avg_speed: `distance_m / duration_s` (m/s); 0 where there is no duration.
        max_speed: the highest speed (m/s), from `max_speed_from`.
        max_speed_from: `twist`: the messages' own; `positions`: from poses at least 0.1 s apart.
        waypoints: vertices of the drawn path, first and last pose among them, and both ends of
            the longest jumps.
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


class TrajectoryBuilder:
    """Takes poses in log-time order, one at a time, and holds a bounded number of them.

    A step that would take more than `max_plausible_speed_mps` (m/s) is a jump. The path is drawn
    with at most `max_waypoints`, within `tolerance_m` (m) where these are enough.

    Raises:
        ValueError: `max_waypoints` is below 2, or a limit is not positive.
    """

    def __init__(
        self,
        max_plausible_speed_mps: float,
        max_waypoints: int = 50,
        tolerance_m: float = TOLERANCE_M,
    ) -> None:
        if max_waypoints < 2 or not (max_plausible_speed_mps > 0 and tolerance_m > 0):
            raise ValueError(
                f"a trajectory needs 2 or more waypoints ({max_waypoints}), a plausible speed"
                f" ({max_plausible_speed_mps} m/s) and a tolerance ({tolerance_m} m) above 0"
            )
        self._motion = Motion(max_plausible_speed_mps)
        self._path = DrawnPath(tolerance_m)
        self._max_waypoints = max_waypoints
        self._invalid = 0
        self._twist: float | None = None
        self._frames: dict[str, None] = {}

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames of all poses so far, valid or not, in order of appearance."""
        return tuple(self._frames)

    def add(self, time: Ns, pose: Pose, speed_mps: float | None = None) -> None:
        """Takes the next pose, and the speed that its message states, if it states one."""
        self._frames[pose.frame_id] = None
        if not is_place(pose.position):
            self._invalid += 1
            return
        self._twist = faster(self._twist, speed_mps)
        _append(self._motion, self._path, (time, pose.position, pose.orientation))

    def join(self, whole: PoseDigest) -> None:
        """Takes all poses of a bag that come next, as if they were added one by one."""
        self._frames.update(dict.fromkeys(whole.frames))
        self._invalid += whole.invalid
        self._twist = faster(self._twist, whole.twist)
        jumps = self._motion.jumps
        self._motion.join(whole)
        if self._motion.jumps - jumps > whole.jumps:
            self._path.part()
        self._path.extend(whole.vertices, whole.error_m)

    @property
    def vertices(self) -> int:
        """How many poses are held to draw the path: about 25,000 at most."""
        return self._path.size

    def result(self) -> Trajectory:
        """The trajectory so far; more poses may be added after."""
        motion = self._motion
        duration_s = motion.duration_s
        avg_speed = motion.distance_m / duration_s if duration_s > 0 else 0.0
        # Drivers that know no twist leave it zero: then it says nothing of a robot that moved.
        stated = self._twist if self._twist or not motion.distance_m else None
        drawn = self._path.drawn(self._max_waypoints)
        return Trajectory(
            distance_m=motion.distance_m,
            duration_s=duration_s,
            avg_speed=avg_speed,
            max_speed=max(motion.max_speed, avg_speed) if stated is None else stated,
            max_speed_from="positions" if stated is None else "twist",
            waypoints=tuple(
                Waypoint(time, position, _heading(turn), jump=place == 0 and number > 0)
                for number, piece in enumerate(drawn.pieces)
                for place, (time, position, turn) in enumerate(piece)
            ),
            waypoint_error_m=drawn.error_m,
            poses=motion.poses,
            invalid=self._invalid,
            jumps=motion.jumps,
            jumped_m=motion.jumped_m,
        )


class PoseCollector:
    """Makes the digest of one bag's poses, which come in log-time order.

    `max_plausible_speed_mps` must be that of the trajectories which join the digest.
    """

    def __init__(self, max_plausible_speed_mps: float) -> None:
        self._motion = Motion(max_plausible_speed_mps)
        self._path = DrawnPath(TOLERANCE_M / 8)
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
        _append(self._motion, self._path, (time, pose.position, pose.orientation))

    def digest(self) -> PoseDigest:
        """What the poses amount to."""
        motion = self._motion
        drawn = self._path.drawn(_BAG_VERTICES)
        vertices = ((time, position, _heading(turn)) for time, position, turn in drawn.row())
        return PoseDigest(
            poses=motion.poses,
            invalid=self._invalid,
            first=motion.first,
            last=motion.last,
            length_m=motion.distance_m,
            jumps=motion.jumps,
            jumped_m=motion.jumped_m,
            anchor=motion.anchor,
            anchored_by_jump=motion.anchored_by_jump,
            max_speed=motion.later_speed,
            measured_from=motion.measured_from,
            twist=self._twist,
            frames=tuple(self._frames),
            vertices=tuple(vertices),
            error_m=drawn.error_m,
        )


def _append(motion: Motion, path: DrawnPath, vertex: Vertex) -> None:
    """Takes a pose; a jump to it parts the path."""
    jumps = motion.jumps
    motion.add(vertex[0], vertex[1])
    if motion.jumps > jumps:
        path.part()
    path.add(vertex)


def _heading(turn: Quaternion | float | None) -> float | None:
    """The heading (rad) of a vertex; None where it has none."""
    if turn is None or isinstance(turn, float):
        return turn
    unit = normalised(turn)
    return None if unit is None else yaw(unit)

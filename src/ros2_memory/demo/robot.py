"""The simulated robot's motion and sensors, as closed forms of the time t (s) since its start.

It drives one lap for ever: from its dock in the living room to the front door in the hall, on to
the kitchen counter, and back. A lap is a chain of legs, each from rest to rest along a curve of
constant curvature with the eased progress e(u) = u - sin(2 pi u) / (2 pi), u in [0, 1]: pose and
velocity are continuous, and velocity, distance and pose are exact.

Poses are in `odom`, whose origin is the dock and whose x axis points north; `MAP_TO_ODOM` says
where that is in `map`, the frame of the flat. Frames and axes follow REP-103 and REP-105.

The flat has three rooms in a row, no walls between them, and objects. Its coordinates are metres in
`map`: x points east, y north, z up. The living room is in the west, the kitchen in the east, the
hall between them; its front door is in the north wall.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from itertools import accumulate
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.core.model import Vector3


THINGS: Final[Mapping[str, Vector3]] = {
    "sofa": (2.8, 3.6, 0.4),
    "television": (0.1, 2.4, 1.0),
    "plant": (4.6, 0.5, 0.6),
    "toy car": (3.6, 1.4, 0.05),
    "shoes": (5.6, 3.9, 0.1),
    "front door": (6.0, 3.95, 1.0),
    "umbrella": (6.4, 3.9, 0.4),
    "cup": (9.7, 3.8, 0.95),
    "scissors": (10.2, 3.8, 0.95),
    "table": (8.8, 0.9, 0.7),
    "fridge": (10.7, 2.0, 1.0),
}
"""The position of each object (m); nothing moves."""


ROOMS: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "living room": (0.0, 5.0, 0.0, 4.0),
    "hall": (5.0, 7.0, 0.0, 4.0),
    "kitchen": (7.0, 11.0, 0.0, 4.0),
}
"""The rooms, from west to east: the least and greatest x, and the least and greatest y (m)."""


def room_at(x: float) -> str:
    """Returns the name of the room at `x` in `map`; all rooms have the same y."""
    for name, (_, east, _, _) in ROOMS.items():
        if x < east:
            return name
    return "kitchen"


class Planar(NamedTuple):
    """A pose in the plane: metres, and `yaw` in radians from the x axis, in [-pi, pi]."""

    x: float
    y: float
    yaw: float

    def then(self, step: Planar) -> Planar:
        """Returns the pose that is `step` relative to this one."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Planar(
            self.x + cos * step.x - sin * step.y,
            self.y + sin * step.x + cos * step.y,
            math.remainder(self.yaw + step.yaw, math.tau),
        )

    def inverse(self) -> Planar:
        """Returns the pose of the origin relative to this one."""
        return Planar(0.0, 0.0, -self.yaw).then(Planar(-self.x, -self.y, 0.0))


class DriveLeg(NamedTuple):
    """A motion from rest to rest: `length` (m, negative: backwards) while turning by `turn` (rad).

    Without a length it turns on the spot, without a turn it goes straight, without both it waits.
    """

    duration: float
    length: float = 0.0
    turn: float = 0.0

    def after(self, progress: float) -> Planar:
        """Returns the pose relative to the leg's start, at the fraction `progress` of the leg."""
        length, turn = self.length * progress, self.turn * progress
        if not self.turn:
            return Planar(length, 0.0, 0.0)
        radius = self.length / self.turn
        return Planar(radius * math.sin(turn), radius * (1.0 - math.cos(turn)), turn)


class SimulatedThing(NamedTuple):
    """An object that the camera sees, at `point` (m) in `base_link`."""

    label: str
    score: float
    point: Vector3


_RIGHT: Final = math.pi / 2
MAP_TO_ODOM: Final = Planar(1.0, 1.0, _RIGHT)
CAMERA: Final[Vector3] = (0.15, 0.0, 0.30)
LASER: Final[Vector3] = (0.10, 0.0, 0.20)
"""The positions (m) of the camera and the laser in `base_link`; both look straight ahead."""

FRONT_DOOR: Final = Planar(6.0, 3.2, _RIGHT)
KITCHEN_COUNTER: Final = Planar(10.0, 3.0, _RIGHT)
"""Two of the places where the robot stops, in `map`."""

LAP: Final = (
    DriveLeg(4.0, length=_RIGHT, turn=-_RIGHT),  # off the dock, towards the hall
    DriveLeg(8.0, length=4.0),
    DriveLeg(2.5, turn=_RIGHT),
    DriveLeg(3.5, length=1.2),
    DriveLeg(4.0),  # at the front door
    DriveLeg(3.5, length=-1.2),  # backs off, eyes on the door
    DriveLeg(2.5, turn=-_RIGHT),
    DriveLeg(6.0, length=3.0),
    DriveLeg(4.0, length=_RIGHT, turn=_RIGHT),
    DriveLeg(4.0),  # at the kitchen counter
    DriveLeg(5.0, turn=math.pi),
    DriveLeg(4.0, length=_RIGHT, turn=-_RIGHT),
    DriveLeg(12.0, length=7.0),  # through all rooms, home
    DriveLeg(4.0, length=_RIGHT, turn=_RIGHT),
    DriveLeg(5.0, turn=-math.pi),
    DriveLeg(8.0),  # on the dock, charging
)
LAP_S: Final = sum(leg.duration for leg in LAP)
LAP_M: Final = sum(abs(leg.length) for leg in LAP)
_CHARGING_S: Final = LAP[-1].duration
_STARTS: Final = tuple(accumulate((leg.duration for leg in LAP), initial=0.0))
"""When each leg starts (s), the pose there, and the distance driven before it (m)."""
_POSES: Final = tuple(
    accumulate(LAP, lambda pose, leg: pose.then(leg.after(1.0)), initial=Planar(0.0, 0.0, 0.0))
)
_DRIVEN: Final = tuple(accumulate((abs(leg.length) for leg in LAP), initial=0.0))

CLEAR_M: Final = 1.0
SIGHT_M: Final = 3.0
SIGHT_HALF_ANGLE: Final = math.radians(40.0)


def pose(t: float) -> Planar:
    """Returns the robot's pose in `odom`."""
    index, share = _leg(t)
    return _POSES[index].then(LAP[index].after(_eased(share)))


def pose_in_map(t: float) -> Planar:
    """Returns the robot's pose in `map`."""
    return MAP_TO_ODOM.then(pose(t))


def twist(t: float) -> tuple[float, float]:
    """Returns forward speed (m/s) and turning rate (rad/s, left positive) in `base_link`."""
    index, share = _leg(t)
    leg = LAP[index]
    rate = (1.0 - math.cos(2.0 * math.pi * share)) / leg.duration
    return leg.length * rate, leg.turn * rate


def driven(t: float) -> float:
    """Returns the distance (m) driven from 0 to t, backwards driving included."""
    index, share = _leg(t)
    return (t // LAP_S) * LAP_M + _DRIVEN[index] + abs(LAP[index].length) * _eased(share)


def place(t: float) -> str:
    """Returns the name of the room that the robot is in."""
    return room_at(pose_in_map(t).x)


def seen(t: float) -> tuple[SimulatedThing, ...]:
    """Returns the objects in the camera's view and range, nearest first."""
    ahead, aside, _ = CAMERA
    to_camera = pose_in_map(t).then(Planar(ahead, aside, 0.0)).inverse()
    things: list[tuple[float, SimulatedThing]] = []
    for label, (x, y, z) in THINGS.items():
        forward, left, _ = to_camera.then(Planar(x, y, 0.0))
        bearing, distance = math.atan2(left, forward), math.hypot(forward, left)
        if distance > SIGHT_M or abs(bearing) > SIGHT_HALF_ANGLE:
            continue
        score = round(0.97 - 0.1 * distance, 2)  # detectors are less sure of what is far away
        thing = SimulatedThing(label, score, (forward + ahead, left + aside, z))
        things.append((distance, thing))
    return tuple(thing for _, thing in sorted(things))


def path_clear(t: float) -> bool:
    """Returns whether the point `CLEAR_M` straight ahead of the laser is in a room."""
    ahead, *_ = LASER
    x, y, _ = pose_in_map(t).then(Planar(ahead + CLEAR_M, 0.0, 0.0))
    return any(west < x < east and south < y < north for west, east, south, north in ROOMS.values())


def battery(t: float) -> float:
    """Returns the charge (0 to 1), which falls evenly while driving, and rises on the dock."""
    phase = t % LAP_S
    driving_s = LAP_S - _CHARGING_S
    spent = phase / driving_s if phase < driving_s else (LAP_S - phase) / _CHARGING_S
    return 0.90 - 0.08 * spent


def _leg(t: float) -> tuple[int, float]:
    """Returns the index of the current leg, and the share of its duration that has passed."""
    phase = t % LAP_S
    index = bisect_right(_STARTS, phase, hi=len(LAP)) - 1
    return index, (phase - _STARTS[index]) / LAP[index].duration


def _eased(share: float) -> float:
    """Returns the progress e(u) of a leg (see above) at a share u of its duration."""
    return share - math.sin(2.0 * math.pi * share) / (2.0 * math.pi)

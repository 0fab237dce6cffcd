"""How the robot and the people move: straight legs and turns on the spot, at constant speed.

A `Path` is a list of knots between which position and yaw change evenly, so that pose, speed and
distance at any moment are exact.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.arrays import Floats
from tests.home.flat import way

SPEED = 0.4
TURNING = 0.9
"""How fast the robot drives (m/s) and turns (rad/s)."""
WALKING = 1.0


class Pose(NamedTuple):
    """Positions (m) and yaws (rad, not wrapped) at some moments."""

    x: Floats
    y: Floats
    yaw: Floats


@dataclass
class Knots:
    """A path while it is being made: where it has got to, and all knots so far."""

    t: float
    x: float
    y: float
    yaw: float = 0.0
    rows: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    driven: float = 0.0

    def __post_init__(self) -> None:
        self.mark()

    def mark(self) -> None:
        """Makes the present state a knot."""
        self.rows.append((self.t, self.x, self.y, self.yaw, self.driven))

    def wait(self, seconds: float) -> None:
        """Stays for so long."""
        if seconds > 0:
            self.t += seconds
            self.mark()

    def until(self, t: float) -> None:
        """Stays until a moment; one that has passed changes nothing."""
        self.wait(t - self.t)

    def turn_to(self, yaw: float) -> None:
        """Turns on the spot, the shorter way."""
        by = math.remainder(yaw - self.yaw, 2 * math.pi)
        if abs(by) > 1e-6:
            self.t += abs(by) / TURNING
            self.yaw += by
            self.mark()

    def go(self, x: float, y: float, speed: float = SPEED) -> None:
        """Goes straight to a point, without turning."""
        length = math.hypot(x - self.x, y - self.y)
        if length > 1e-6:
            self.t += length / speed
            self.driven += length
            self.x, self.y = x, y
            self.mark()

    def jump(self, x: float, y: float, yaw: float) -> None:
        """Is somewhere else, without having gone there: it was carried while it was off."""
        self.x, self.y, self.yaw = x, y, yaw
        self.t += 1e-3
        self.mark()

    def walk(self, x: float, y: float) -> None:
        """Walks to a point through the doors, as people do."""
        for corner in way((self.x, self.y), (x, y)):
            self.go(*corner, speed=WALKING)


@dataclass(frozen=True)
class Path:
    """A finished path."""

    knots: NDArray[np.float64]

    @cached_property
    def times(self) -> Floats:
        """Returns the moment of each knot."""
        return np.ascontiguousarray(self.knots[:, 0])

    def at(self, t: Floats) -> Pose:
        """Returns the pose at each moment."""
        x, y, yaw = (np.interp(t, self.times, self.knots[:, nth]) for nth in (1, 2, 3))
        return Pose(x, y, yaw)

    def driven(self, t: Floats) -> Floats:
        """Returns the way (m) gone by each moment."""
        gone: Floats = np.interp(t, self.times, self.knots[:, 4])
        return gone

    def rates(self, t: Floats) -> tuple[Floats, Floats]:
        """Returns the forward speed (m/s) and the turning rate (rad/s) at each moment."""
        before, after = self.at(t - 0.02), self.at(t + 0.02)
        east, north = after.x - before.x, after.y - before.y
        speed = (east * np.cos(before.yaw) + north * np.sin(before.yaw)) / 0.04
        turning = (after.yaw - before.yaw) / 0.04
        return np.clip(speed, -SPEED, SPEED), np.clip(turning, -TURNING, TURNING)


def finished(knots: Knots) -> Path:
    """Returns the path of all knots."""
    return Path(np.array(knots.rows))

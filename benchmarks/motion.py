"""Where a drawn robot is: a building, and the ways of a robot through its rooms.

A corridor along x, rooms on both sides, a door in the middle of each. By day the robot goes to one
room after the other, stays a while and looks around; it charges at its dock, and spends the night
there. One room it never enters.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from ros2_memory.core.arrays import Floats

_CORRIDOR_M: Final = 0.8  # half of its width
_WALL_M: Final = 0.7  # what the robot keeps from walls
_TURN_RADPS: Final = 1.0
_NAMES: Final = (
    *("pantry", "nursery", "workshop", "veranda", "lounge", "laundry", "library", "attic"),
    *("cellar", "sauna", "gallery", "cloakroom", "scullery", "parlour", "greenhouse", "foyer"),
)


class Motion(NamedTuple):
    """Poses (m, rad) and velocities (m/s, rad/s) at some moments, one array each."""

    x: Floats
    y: Floats
    yaw: Floats
    speed: Floats
    turning: Floats


class Room(NamedTuple):
    """A rectangle of the plane (m); the door is at `(middle, +-corridor)`."""

    name: str
    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def centre(self) -> tuple[float, float]:
        """The middle of the room."""
        return sum(self.x) / 2.0, sum(self.y) / 2.0


class Interval(NamedTuple):
    """From when to when (s) the robot did what a word says, and in which room."""

    start: float
    stop: float
    doing: str
    room: str


def building(chance: np.random.Generator) -> tuple[Room, ...]:
    """Draws five to nine rooms; the first has the dock, and the last is never entered."""
    names = chance.permutation(_NAMES)
    at = [0.0, 0.0]
    rooms = []
    for number in range(int(chance.integers(5, 10))):
        side = number % 2
        wide, deep = chance.uniform(3.2, 6.5), chance.uniform(3.2, 6.0)
        y = (_CORRIDOR_M, _CORRIDOR_M + deep)
        x = (round(at[side], 2), round(at[side] + wide, 2))
        rooms.append(Room(str(names[number]), x, y if side else (-y[1], -y[0])))
        at[side] += wide
    return tuple(rooms)


@dataclass
class Route:
    """The robot's ways over some days, drawn; times in seconds since its start.

    Attributes:
        night: from which hour to which hour of its day it stays at the dock; None: it has no night.
        stay_s: how long it stays in a room, in the mean.
        busy: what was done when.
        charge: times and levels (0 to 1) of the battery.
    """

    chance: np.random.Generator
    rooms: tuple[Room, ...]
    seconds: float
    night: tuple[float, float] | None
    stay_s: float
    busy: list[Interval] = field(default_factory=list)
    charge: list[tuple[float, float]] = field(default_factory=list)
    knots: list[tuple[float, float, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.dock = (self.rooms[0].x[0] + _WALL_M, self.rooms[0].centre[1])
        self.knots.append((0.0, *self.dock, 0.0))
        self.charge.append((0.0, 0.9))
        hours = self.chance.uniform(2.0, 5.0)
        low = self.chance.uniform(0.15, 0.4)
        room = self.rooms[0]
        while self.now < self.seconds:
            level = self.charge[-1][1] - (self.now - self.charge[-1][0]) / 3600.0 / hours
            self.charge.append((self.now, max(level, 0.02)))
            if self._is_night() or level < low:
                self._go(room, self.rooms[0], self.dock, "returning")
                room = self.rooms[0]
                self._rest()
                continue
            following = self.rooms[int(self.chance.integers(0, len(self.rooms) - 1))]
            place = [self.chance.uniform(a + _WALL_M, b - _WALL_M) for a, b in following[1:]]
            self._go(room, following, (place[0], place[1]), "driving")
            room = following
            self._stay(room)
        self._table = np.array(self.knots).T

    @property
    def now(self) -> float:
        """Up to when the route is drawn."""
        return self.knots[-1][0]

    def at(self, t: Floats) -> Motion:
        """Returns the motion at some times; it is linear between knots."""
        times, *columns = self._table
        x, y, yaw = (np.interp(t, times, column) for column in columns)
        nth = np.clip(np.searchsorted(times, t, side="right"), 1, len(times) - 1)
        lasting = times[nth] - times[nth - 1]
        rates = [(column[nth] - column[nth - 1]) / lasting for column in columns]
        return Motion(x, y, yaw, np.hypot(rates[0], rates[1]), rates[2])

    def doing(self, start: float, stop: float) -> list[Interval]:
        """Returns what was done within a time, oldest first."""
        return [each for each in self.busy if each.start < stop and start < each.stop]

    def _is_night(self) -> bool:
        if self.night is None:
            return False
        hour = self.now / 3600.0 % 24.0
        return hour >= self.night[0] or hour < self.night[1]

    def _rest(self) -> None:
        """Charges at the dock, and sleeps there till the morning."""
        begun, (_, level) = self.now, self.charge[-1]
        full = begun + (1.0 - level) * self.chance.uniform(3600.0, 9000.0)
        until = full
        if self.night is not None and self._is_night():
            hour = begun / 3600.0 % 24.0
            until = max(full, begun + (self.night[1] - hour) % 24.0 * 3600.0)
        until = max(until, begun + 60.0)
        self._hold(until)
        self.charge += [(full, 1.0), (until, 1.0)]
        self.busy.append(Interval(begun, until, "charging", self.rooms[0].name))

    def _stay(self, room: Room) -> None:
        begun = self.now
        until = begun + self.chance.uniform(5.0, 20.0) + self.chance.exponential(self.stay_s)
        doing = str(self.chance.choice(["waiting", "looking", "listening"]))
        if doing == "looking":
            self._turn(self.knots[-1][3] + self.chance.uniform(1.0, 6.0))
        self._hold(max(until, self.now + 1.0))
        self.busy.append(Interval(begun, self.now, doing, room.name))

    def _go(self, room: Room, following: Room, place: tuple[float, float], doing: str) -> None:
        begun = self.now
        if following is not room:
            for one, y in ((room, None), (room, 0.0), (following, 0.0), (following, None)):
                self._line(one.centre[0], min(one.y, key=abs) if y is None else y)
        self._line(*place)
        self.busy.append(Interval(begun, self.now, doing, following.name))

    def _line(self, x: float, y: float) -> None:
        _, from_x, from_y, yaw = self.knots[-1]
        length = float(np.hypot(x - from_x, y - from_y))
        if length < 0.02:
            return
        heading = float(np.arctan2(y - from_y, x - from_x))
        self._turn(yaw + (heading - yaw + np.pi) % (2.0 * np.pi) - np.pi)
        speed = self.chance.uniform(0.2, 0.7)
        self.knots.append((self.now + length / speed, x, y, self.knots[-1][3]))

    def _turn(self, yaw: float) -> None:
        t, x, y, before = self.knots[-1]
        self.knots.append((t + max(abs(yaw - before) / _TURN_RADPS, 0.01), x, y, yaw))

    def _hold(self, until: float) -> None:
        _, *pose = self.knots[-1]
        if until > self.now:
            self.knots.append((until, pose[0], pose[1], pose[2]))

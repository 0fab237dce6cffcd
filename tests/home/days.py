"""What happens: the robot's outings with all that goes wrong, and the people's days.

A day has the same outings at nearly the same times. `Scale.compression` 1 is life: the robot is on
for 24 hours, and an outing takes some 20 minutes. Above it the robot is on only for its outings,
and each is short: a day of some 20 minutes, at the same hours of the clock.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tests.home.flat import DOCK, HALL_X, ROOMS, SPOTS, Spot, way
from tests.home.paths import Knots, Path, finished
from tests.home.things import DAY, HOUR

EXECUTING = 2
SUCCEEDED = 4
CANCELED = 5
ABORTED = 6
LOW_BATTERY = 0.2
CLOCK_STEP_S = 8.0
BUMP_S = 0.8
SLIP_M = 0.25
"""How far the wheels slip when the robot bumps into something."""

_OUTINGS_H = (7.5, 9.0, 10.5, 13.0, 15.0, 17.5, 20.0, 22.0)
_SHORT_OUTINGS_H = (7.5, 10.5, 13.0, 15.0, 20.0)
_ROUNDS_H = (7.5, 20.0)
_BLIND_H = (10 + 5 / 60, 12 + 5 / 60)
_OUTAGE_UNTIL_H = 17.0
_POWER_CUT_S = 1500.0
_GAZES = 6
_NOTICE_S = 0.3  # from what makes the robot stop until it stands


@dataclass(frozen=True)
class Scale:
    """How much of a world there is; the same scale makes the same bytes."""

    seed: int = 7
    days: int = 2
    compression: float = 60.0
    split_s: float = 60.0
    rosout: bool = True

    @property
    def short(self) -> bool:
        """Returns whether days are compressed."""
        return self.compression > 1.0

    def chance(self, *key: int) -> np.random.Generator:
        """Returns the random numbers of one purpose."""
        return np.random.default_rng([self.seed, *key])


class Halt(NamedTuple):
    """The robot stood at a point that it had not meant to stop at."""

    start: float
    stop: float
    reason: str
    x: float
    y: float


class GoalChange(NamedTuple):
    """An action goal took on a status."""

    t: float
    goal: int
    status: int


class Log(NamedTuple):
    """A line of `/rosout`."""

    t: float
    level: int
    node: str
    text: str


class Outing(NamedTuple):
    """The time off the dock: from leaving it to being back on it, or to the loss of power."""

    start: float
    stop: float
    cut: bool = False


@dataclass
class Life:
    """All that the robot did and all that happened to it."""

    path: Path
    outings: list[Outing] = field(default_factory=list)
    halts: list[Halt] = field(default_factory=list)
    bumps: list[float] = field(default_factory=list)
    goals: list[GoalChange] = field(default_factory=list)
    logs: list[Log] = field(default_factory=list)
    hot: list[tuple[float, float]] = field(default_factory=list)
    battery: list[tuple[float, float]] = field(default_factory=list)
    blind: tuple[float, float] = (0.0, 0.0)
    outage: tuple[float, float] = (0.0, 0.0)
    power_cut: tuple[float, float] = (0.0, 0.0)
    clock_step: float = math.inf


@dataclass(frozen=True)
class Incidents:
    """On which day what happens that happens once."""

    blind: int
    outage: int
    power_cut: int
    low_battery: int
    clock_step: int

    @classmethod
    def of(cls, days: int) -> "Incidents":
        """Returns them, spread over so many days; the detector is blind on the last."""
        last = days - 1
        return cls(
            blind=last,
            outage=round(0.45 * last),
            power_cut=round(0.2 * last),
            low_battery=round(0.6 * last),
            clock_step=round(0.75 * last),
        )

    def low_battery_at(self) -> float:
        """Returns the hour of the outing on which the battery runs low."""
        return 10.5 if self.low_battery == self.outage else 15.0


def blind_time(days: int) -> tuple[float, float]:
    """Returns when the detector is silent."""
    start = Incidents.of(days).blind * DAY
    return start + _BLIND_H[0] * HOUR, start + _BLIND_H[1] * HOUR


class _Robot:
    """Drives through all days, and writes down what happens."""

    def __init__(self, scale: Scale) -> None:
        self.scale = scale
        self.incidents = Incidents.of(scale.days)
        self.chance = scale.chance(1)
        self.at = Knots(-10.0, DOCK[0], DOCK[1], DOCK[2])
        self.life = Life(finished(self.at), battery=[(-10.0, 1.0)])
        self.goal = 0

    def live(self) -> Life:
        """Returns the whole life."""
        for day in range(self.scale.days):
            for hour in _SHORT_OUTINGS_H if self.scale.short else _OUTINGS_H:
                self._outing(day, hour)
        self.at.until(self.scale.days * DAY + 60.0)
        self._charge(self.at.t)
        self.life.path = finished(self.at)
        self.life.blind = blind_time(self.scale.days)
        blind = self.life.blind
        self._log(blind[0], 40, "camera_driver", "No frame for 5 s, the device does not answer")
        self._log(blind[1], 20, "camera_driver", "Device found again")
        self.life.logs.sort()
        return self.life

    def _outing(self, day: int, hour: float) -> None:
        start = day * DAY + hour * HOUR + float(self.chance.uniform(-480.0, 480.0))
        self.at.until(start)
        start = self.at.t
        level = self._charge(start)
        spots = self._spots(hour)
        events = self._events(day, hour, len(spots))
        for nth, spot in enumerate(spots):
            event = events.get(nth, "")
            if not self._drive((spot.x, spot.y), spot.name, event):
                break
            self._look_around()
            if event == "power cut":
                self._lose_power()
                break
        cut = self.life.power_cut[0] >= start
        if not cut:
            self._home()
        stop = self.life.power_cut[0] if cut else self.at.t
        low = day == self.incidents.low_battery and hour == self.incidents.low_battery_at()
        use = level - 0.13 if low else float(self.chance.uniform(0.12, 0.35))
        self.life.battery.append((stop, level - use))
        if low:
            crossed = start + (level - LOW_BATTERY) / use * (stop - start)
            self._log(crossed, 30, "power_manager", "Battery is low: 20 %")
        self.life.outings.append(Outing(start, stop, cut))

    def _spots(self, hour: float) -> list[Spot]:
        order = [SPOTS[nth] for nth in self.chance.permutation(len(SPOTS))]
        return order if hour in _ROUNDS_H else order[: int(self.chance.integers(4, 7))]

    def _events(self, day: int, hour: float, spots: int) -> dict[int, str]:
        """Returns what happens on the drives of an outing, by the drive's number."""
        last, wanted = day == self.scale.days - 1, self.chance.random(4) < 0.6
        found: dict[int, str] = {}
        if hour == 7.5:
            found |= {1: "blocked"} if last or wanted[0] else {}
            found |= {3: "bump"} if last or wanted[1] else {}
        if hour == 20.0:
            found |= {2: "pause"} if last or wanted[2] else {}
            found |= {1: "clock step"} if day == self.incidents.clock_step else {}
        if hour == 13.0:
            found |= {1: "hot"} if last or wanted[3] else {}
            found |= {spots - 2: "power cut"} if day == self.incidents.power_cut else {}
        if hour == 15.0:
            found |= {spots // 2: "outage"} if day == self.incidents.outage else {}
        if day == self.incidents.low_battery and hour == self.incidents.low_battery_at():
            found[spots - 2] = "low battery"
        return found

    def _drive(self, goal: tuple[float, float], name: str, event: str = "") -> bool:
        """Drives to a point; returns False where it gave up on the way."""
        corners = way((self.at.x, self.at.y), goal)
        points = [(self.at.x, self.at.y), *corners]
        lengths = [math.dist(a, b) for a, b in zip(points, corners, strict=False)]
        longest = lengths.index(max(lengths))
        self._goal(EXECUTING, new=True)
        self._log(self.at.t, 20, "bt_navigator", f"Begin navigating to {name}")
        for nth, (x, y) in enumerate(corners):
            self.at.turn_to(math.atan2(y - self.at.y, x - self.at.x))
            if nth == longest and event:
                half = (self.at.x + x) / 2, (self.at.y + y) / 2
                self.at.go(*half)
                if not self._happens(event):
                    return False
            self.at.go(x, y)
        self._goal(SUCCEEDED)
        self._log(self.at.t, 20, "bt_navigator", "Goal succeeded")
        return True

    def _happens(self, event: str) -> bool:
        """Does what happens in the middle of a drive; returns whether it goes on."""
        at = self.at
        start = at.t
        if event == "blocked":
            self._goal(ABORTED, ago=_NOTICE_S)
            self._log(start - _NOTICE_S, 40, "planner_server", "Failed to create plan: no way")
            at.wait(float(self.chance.uniform(25.0, 35.0)))
            self._goal(EXECUTING, new=True)
        elif event == "bump":
            self.life.bumps.append(start - _NOTICE_S)
            at.wait(6.0)
        elif event == "pause":
            at.wait(float(self.chance.uniform(20.0, 35.0)))
        elif event == "hot":
            self.life.hot.append((start - 6.0, start + 30.0))
            self._log(start - 5.0, 30, "motor_driver", "Left wheel motor is overheated: 81 C")
            at.wait(25.0)
        elif event == "low battery":
            self._goal(CANCELED, ago=_NOTICE_S)
            at.wait(5.0)
        elif event == "outage":
            until = math.floor(start / DAY) * DAY + _OUTAGE_UNTIL_H * HOUR
            self.life.outage = (start, max(until, start + 600.0))
        elif event == "clock step":
            self.life.clock_step = start
        if at.t > start:
            self.life.halts.append(Halt(start, at.t, event, at.x, at.y))
        return event != "low battery"

    def _lose_power(self) -> None:
        """Goes dead where it stands; somebody carries it to the dock and switches it on."""
        cut, back = self.at.t, self.at.t + _POWER_CUT_S
        self.life.power_cut = (cut, back)
        self.at.until(back - 1.0)
        self.at.jump(*DOCK)

    def _look_around(self) -> None:
        """Turns once around in steps, looking; then stays for a while."""
        gaze = 1.6 if self.scale.short else 7.0
        step = 2 * math.pi / _GAZES
        first = round(self.at.yaw / step) * step
        for nth in range(_GAZES):
            self.at.turn_to(first + nth * step)
            self.at.wait(gaze)
        longest = 6.0 if self.scale.short else 240.0
        self.at.wait(float(self.chance.uniform(0.2, 1.0)) * longest)

    def _home(self) -> None:
        """Drives to the dock and backs onto it."""
        self._drive((HALL_X, DOCK[1] + 1.0), "dock")
        self.at.turn_to(DOCK[2])
        self.at.go(DOCK[0], DOCK[1])

    def _charge(self, t: float) -> float:
        """Charges from the last moment of the battery until t; returns the charge then."""
        since, level = self.life.battery[-1]
        full = since + (1.0 - level) * 2 * HOUR
        if full < t:
            self.life.battery.append((full, 1.0))
        now = min(1.0, level + (t - since) / (2 * HOUR))
        self.life.battery.append((t, now))
        return now

    def _goal(self, status: int, *, new: bool = False, ago: float = 0.0) -> None:
        self.goal += new
        self.life.goals.append(GoalChange(self.at.t - ago, self.goal, status))

    def _log(self, t: float, level: int, node: str, text: str) -> None:
        self.life.logs.append(Log(t, level, node, text))


def live(scale: Scale) -> Life:
    """Returns the robot's life."""
    return _Robot(scale).live()


def without(
    spans: Iterable[tuple[float, float]], gaps: Sequence[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Returns the spans without the gaps."""
    left = list(spans)
    for start, stop in gaps:
        if stop <= start:
            continue
        left = [
            piece
            for a, b in left
            for piece in ((a, min(b, start)), (max(a, stop), b))
            if piece[1] > piece[0]
        ]
    return left


def switched_on(scale: Scale, life: Life) -> list[tuple[float, float]]:
    """Returns when the robot is on and recorded."""
    if not scale.short:
        whole = [(0.0, scale.days * DAY)]
        return without(whole, [life.outage, life.power_cut])
    lead = max(20.0, 1800.0 / scale.compression)
    spans = [(each.start - lead, each.stop + lead * (not each.cut)) for each in life.outings]
    back = life.power_cut[1]
    return without(sorted([*spans, (back, back + 2 * lead)]), [life.outage])


class Person(NamedTuple):
    """A person's way, and when they are out of the flat."""

    path: Path
    out: tuple[tuple[float, float], ...]


_BEDS = ((9.0, 7.8), (10.2, 7.8), (0.8, 1.6))
_OUT_H = ((8.5, 17.1), None, (9.2, 12.5))


def people(scale: Scale) -> list[Person]:
    """Returns the three people who live here: asleep at night, about by day, two of them out."""
    return [
        _person(scale, nth, bed, out)
        for nth, (bed, out) in enumerate(zip(_BEDS, _OUT_H, strict=True))
    ]


def _person(
    scale: Scale, nth: int, bed: tuple[float, float], out_h: tuple[float, float] | None
) -> Person:
    chance = scale.chance(2, nth)
    at = Knots(-10.0, *bed)
    out = []
    for day in range(scale.days):
        start = day * DAY
        at.until(start + 7.0 * HOUR + float(chance.uniform(0.0, 1200.0)))
        while at.t < start + 22.7 * HOUR:
            if out_h is not None and start + out_h[0] * HOUR < at.t < start + out_h[1] * HOUR:
                at.walk(HALL_X, 8.8)
                out.append((at.t, start + out_h[1] * HOUR))
                at.until(start + out_h[1] * HOUR)
            room = ROOMS[str(chance.choice(list(ROOMS)))]
            x = float(chance.uniform(room.x0 + 0.5, room.x1 - 0.5))
            y = float(chance.uniform(room.y0 + 0.5, room.y1 - 0.5))
            at.walk(x, y)
            brief = chance.random() < 0.5
            at.wait(float(chance.uniform(15, 90) if brief else chance.uniform(300, 1800)))
        at.walk(*bed)
    at.until(scale.days * DAY + 60.0)
    return Person(finished(at), tuple(out))

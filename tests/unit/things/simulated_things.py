"""A seeded home of things, people and walls, as a detector on a robot reports it.

Only the simulation's state is the truth. The detector drops a fifth of what it could see, places it
5 to 30 cm off (more at range), gives 2 % a label of something else, and swaps near names.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from random import Random
from typing import TYPE_CHECKING, Final

from tests.support.sights import Message, PlacedDetection, sights_of_messages

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.sights import Sights
    from ros2_memory.core.timebase import Ns

BEGIN_S: Final = 1_700_000_000
BAG_S: Final = 30
RATE_HZ: Final = 2
DROPPED: Final = 0.2
FALSE_LABEL: Final = 0.02
SWAPPED: Final = 0.06
RANGE_M: Final = 5.0
HALF_VIEW: Final = math.radians(35)
SPEED_MPS: Final = 0.5
NEAR_NAMES: Final = {"mug": "cup", "cup": "mug", "phone": "headphones", "sofa": "armchair"}

Point = tuple[float, float]
WALLS: Final[tuple[tuple[Point, Point], ...]] = (
    ((5.0, 0.0), (5.0, 3.0)),
    ((5.0, 4.2), (5.0, 8.0)),
    ((5.0, 4.6), (8.0, 4.6)),
    ((9.2, 4.6), (12.0, 4.6)),
)
STOPS: Final[tuple[tuple[float, float, float], ...]] = (
    (1.0, 1.0, 0.6),
    (3.0, 3.5, 2.2),
    (3.2, 3.5, -1.8),
    (3.8, 6.0, 2.8),
    (6.5, 3.8, -0.6),
    (8.6, 3.6, -1.2),
    (8.6, 6.2, 0.5),
    (8.6, 6.2, 2.4),
    (1.4, 6.6, -0.9),
)
ROUTE: Final[dict[str, Point]] = {"left": (3.8, 3.6), "door": (5.0, 3.6), "right": (8.6, 3.6)}


@dataclass(slots=True)
class Thing:
    """A thing of the simulation: where it is, and where it was."""

    label: str
    x: float
    y: float
    z: float = 0.7
    spellings: tuple[str, ...] = ()
    moves: list[tuple[float, Point, Point]] = field(default_factory=list)
    shows: list[float] = field(default_factory=list)
    """When the robot could have seen it, whether it did or not."""
    detected: list[float] = field(default_factory=list)
    places: list[tuple[float, Point]] = field(default_factory=list)

    def place_at(self, time: float) -> Point | None:
        """Returns where it was; None while it was out of the home."""
        best = None
        for since, place in self.places:
            if since <= time:
                best = place
        return None if best is None or best[0] < 0 else best


@dataclass(slots=True)
class Simulation:
    """What was simulated: the truth, and what the detector made of it."""

    things: list[Thing]
    bags: list[Sights]
    stop_s: float
    looks: list[tuple[float, tuple[float, float, float]]]
    true_of: list[list[tuple[float, str, Point, int]]]
    """By bag: detections as (time, label, place, number of the thing or -1)."""


OUT: Final[Point] = (-100.0, -100.0)


@lru_cache(100_000)
def visible(robot: tuple[float, float, float], place: Point) -> bool:
    """Whether a place lies in the view of the detector, with no wall between."""
    x, y, yaw = robot
    dx, dy = place[0] - x, place[1] - y
    away = math.hypot(dx, dy)
    if not 0.3 < away < RANGE_M:
        return False
    off = (math.atan2(dy, dx) - yaw + math.pi) % (2 * math.pi) - math.pi
    return abs(off) <= HALF_VIEW and not any(
        _crosses((x, y), place, start, end) for start, end in WALLS
    )


def _crosses(a: Point, b: Point, c: Point, d: Point) -> bool:
    def side(p: Point, q: Point, r: Point) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


def _furniture(chance: Random) -> list[Thing]:
    chairs = [(2.0, 2.2), (3.1, 2.2), (2.0, 1.2), (3.1, 1.2), (10.5, 2.0), (7.5, 7.0)]
    things = [Thing("chair", *each, 0.5, ("chair", "Chair", "chairs")) for each in chairs]
    things += [
        Thing("table", 2.55, 1.7),
        Thing("sofa", 1.0, 5.2),
        Thing("armchair", 2.6, 7.4),
        Thing("tv", 0.3, 3.4),
        Thing("fridge", 10.9, 0.6),
        Thing("oven", 9.8, 0.5),
        Thing("sink", 8.6, 0.5),
        Thing("bed", 10.6, 7.0),
        Thing("lamp", 7.0, 5.4),
        Thing("lamp", 4.6, 7.6),
        Thing("lamp", 0.4, 0.4),
        Thing("potted plant", 4.5, 0.6, 0.4, ("potted plant", "Potted_Plant", "potted-plants")),
        Thing("potted plant", 11.5, 3.9, 0.4),
        Thing("potted plant", 0.4, 7.6, 0.4),
        Thing("shelf", 6.0, 0.4),
        Thing("clock", 7.2, 0.3),
        Thing("window", 11.9, 5.6),
        Thing("dining table", 10.0, 2.6),
    ]
    for each in things:
        each.places = [(0.0, (each.x, each.y))]
        each.spellings = each.spellings or (each.label,)
    chance.random()
    return things


SPOTS: Final[tuple[Point, ...]] = (
    (2.3, 1.9),
    (2.8, 1.5),
    (1.1, 5.6),
    (0.6, 4.6),
    (2.2, 7.2),
    (9.9, 2.9),
    (9.2, 0.5),
    (6.1, 0.6),
    (7.9, 7.3),
    (10.2, 6.4),
)


def _movables(chance: Random, stop_s: float, moves: int) -> list[Thing]:
    things = [
        Thing("mug", 0, 0, spellings=("mug", "Mug", "coffee mug")),
        Thing("cup", 0, 0),
        Thing("phone", 0, 0),
        Thing("headphones", 0, 0),
        Thing("keys", 0, 0),
        Thing("book", 0, 0),
        Thing("remote", 0, 0),
        Thing("bag", 0, 0),
    ]
    free = [*SPOTS]
    chance.shuffle(free)
    taken: dict[int, Point] = {}
    for nth, each in enumerate(things):
        each.spellings = each.spellings or (each.label,)
        taken[nth] = free.pop()
        each.places = [(0.0, taken[nth])]
    times = sorted(chance.uniform(0.1, 0.9) * stop_s for _ in range(moves))
    for time in times:
        nth = chance.randrange(len(things))
        before = taken[nth]
        out = chance.random() < 0.1
        after = OUT if out else free.pop(chance.randrange(len(free)))
        if before != OUT:
            free.append(before)
        taken[nth] = after
        things[nth].places.append((time, after))
        things[nth].moves.append((time, before, after))
    return things


def _person_at(nth: int, time: float) -> Point:
    """Returns where a person is: walking in ellipses, standing for a minute now and then."""
    step = time - (time % 90.0) + max(0.0, (time % 90.0) - 60.0) * 3.0
    angle = step / 37.0 + nth * 2.1
    x, y = 2.6 + 1.6 * math.cos(angle), 4.0 + 2.6 * math.sin(angle * 1.3 + nth)
    return (x, y) if nth % 2 == 0 else (x + 5.5, min(y, 3.9))


def _path(chance: Random, stop_s: float) -> list[tuple[float, float, float]]:
    """Returns the robot's pose at each detector message."""
    poses: list[tuple[float, float, float]] = []
    x, y, yaw = STOPS[0]
    count = int(stop_s * RATE_HZ)
    while len(poses) < count:
        at = STOPS[chance.randrange(len(STOPS))]
        goal = (at[0] + chance.gauss(0, 0.04), at[1] + chance.gauss(0, 0.04))
        legs: list[Point] = []
        if (x < 5.0) != (goal[0] < 5.0):
            legs = [ROUTE["left"], ROUTE["door"]]
            legs = [*legs, ROUTE["right"]] if x < 5.0 else [ROUTE["right"], *reversed(legs)]
        elif x > 5.0 and (y > 4.6) != (goal[1] > 4.6):
            legs = [ROUTE["right"]]
        for to in (*legs, goal):
            heading = math.atan2(to[1] - y, to[0] - x)
            steps = max(1, int(math.hypot(to[0] - x, to[1] - y) / SPEED_MPS * RATE_HZ))
            turn = (heading - yaw + math.pi) % (2 * math.pi) - math.pi
            turns = int(abs(turn) * RATE_HZ)
            poses += [(x, y, yaw + turn * (nth + 1) / (turns + 1)) for nth in range(turns)]
            yaw = heading
            dx, dy = (to[0] - x) / steps, (to[1] - y) / steps
            poses += [(x + dx * nth, y + dy * nth, yaw) for nth in range(1, steps + 1)]
            x, y = to
        yaw = at[2] + chance.gauss(0, 0.04)
        poses += [(x, y, yaw)] * int(chance.uniform(20, 240) * RATE_HZ)
    return poses[:count]


def simulate(seed: int, hours: float = 6.0, moves: int = 14, *, walls: bool = True) -> Simulation:
    """Returns a home in which this many things are moved; the same for the same seed."""
    chance = Random(seed)
    stop_s = hours * 3600
    things = [*_furniture(chance), *_movables(chance, stop_s, moves)]
    labels = sorted({each.label for each in things})
    poses = _path(chance, stop_s)
    bags: list[Sights] = []
    looks: list[tuple[float, tuple[float, float, float]]] = []
    truths: list[list[tuple[float, str, Point, int]]] = []
    a_bag = BAG_S * RATE_HZ
    for start in range(0, len(poses), a_bag):
        messages: list[Message] = []
        drift = (chance.gauss(0, 0.03), chance.gauss(0, 0.03))
        truth: list[tuple[float, str, Point, int]] = []
        for step in range(start, min(start + a_bag, len(poses))):
            time, pose = step / RATE_HZ, poses[step]
            seen = _detect(chance, things, labels, time, pose, drift, truth)
            measured = (pose[0] + drift[0], pose[1] + drift[1], pose[2])
            messages.append(Message("/detections", moment(time), measured, seen))
            looks.append((time, pose))
        bags.append(sights_of_messages(messages))
        truths.append(truth)
    return Simulation(things, bags, stop_s, looks, truths)


def moment(time: float) -> Ns:
    """Returns a time of the simulation in nanoseconds."""
    return BEGIN_S * 10**9 + round(time * 1e9)


def _detect(
    chance: Random,
    things: Sequence[Thing],
    labels: Sequence[str],
    time: float,
    pose: tuple[float, float, float],
    drift: Point,
    truth: list[tuple[float, str, Point, int]],
) -> list[PlacedDetection]:
    targets: list[tuple[int, str, Point, float]] = []
    for nth, each in enumerate(things):
        place = each.place_at(time)
        if place is not None and visible(pose, place):
            each.shows.append(time)
            targets.append((nth, chance.choice(each.spellings), place, each.z))
    for nth in range(3):
        place = _person_at(nth, time)
        if visible(pose, place):
            targets.append((-1, "person", place, 1.0))
    seen = []
    for nth, label, place, z in targets:
        if chance.random() < DROPPED:
            continue
        away = math.hypot(place[0] - pose[0], place[1] - pose[1])
        sigma = 0.05 + 0.25 * away / RANGE_M
        x = place[0] + drift[0] + chance.gauss(0, sigma)
        y = place[1] + drift[1] + chance.gauss(0, sigma)
        score = chance.uniform(0.55, 0.97)
        shown, number = label, nth
        if chance.random() < FALSE_LABEL:
            shown, number, score = chance.choice(labels), -1, chance.uniform(0.3, 0.6)
        elif label in NEAR_NAMES and chance.random() < SWAPPED:
            shown, number = NEAR_NAMES[label], -1
        if number >= 0:
            things[number].detected.append(time)
        truth.append((time, shown, (x, y), number))
        seen.append(PlacedDetection(shown, (x, y, z), score))
    return seen

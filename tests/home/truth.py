"""What an answer is judged by, from the simulation's state alone: no message is read for it.

All times are Unix seconds of the robot's clock, all lengths metres, all points in `map`. What could
be known of a thing comes from the state, too: `in_view` is when the camera had it in view, while
the detector ran and the recorder as well; `detected` adds the detector's own luck.
"""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from typing import TypeAlias

import numpy as np

from ros2_memory.core.arrays import Floats
from ros2_memory.core.model import JsonValue
from tests.home import flat
from tests.home.days import CLOCK_STEP_S, Scale
from tests.home.things import DAY, Place
from tests.home.world import START_S, World, world_of

Span: TypeAlias = tuple[float, float]
VIEW_GAP_S = 5.0
"""A thing that is in view again within so long was in view all along."""
_SAMPLE_S = 0.1
_STOOD_S = 3.0


@dataclass
class Sight:
    """How one stay of a thing was seen."""

    in_view: list[Span] = field(default_factory=list)
    first_detected: float | None = None
    last_detected: float | None = None


@dataclass(frozen=True)
class PlaceOfThing:
    """A stay of a thing: where, from when to when, and how it was seen there."""

    start: float
    stop: float
    place: Place | None
    sight: Sight


@dataclass(frozen=True)
class ThingTruth:
    """A thing with all its stays."""

    label: str
    stays: tuple[PlaceOfThing, ...]

    def known(self, until: float = math.inf) -> list[PlaceOfThing]:
        """Returns the stays that were seen before a moment, in order."""
        return [
            stay
            for stay in self.stays
            if stay.place is not None
            and stay.sight.first_detected is not None
            and stay.sight.first_detected <= until
        ]


@dataclass(frozen=True)
class Standstill:
    """The robot stood off its dock; `reason` is why it had not meant to, "" where it had."""

    start: float
    stop: float
    x: float
    y: float
    room: str
    reason: str


@dataclass(frozen=True)
class DayTruth:
    """One calendar day (UTC), as far as it was recorded."""

    date: str
    recorded_s: float
    driven_m: float
    departures: tuple[float, ...]
    lowest_battery: float


@dataclass(frozen=True)
class Truth:
    """All that is true of a world."""

    recorded: tuple[Span, ...]
    days: tuple[DayTruth, ...]
    things: tuple[ThingTruth, ...]
    visits: Mapping[str, tuple[Span, ...]]
    standstills: tuple[Standstill, ...]
    bumps: tuple[float, ...]
    blind: Span
    outage: Span
    clock_step: float

    def elapsed(self, start: float, end: float) -> float:
        """Returns how long it truly was from one time of the robot's clock to another."""
        step = self.clock_step
        return end - start - max(0.0, min(end, step + CLOCK_STEP_S) - max(start, step))

    def of(self, label: str) -> list[ThingTruth]:
        """Returns the things of a label."""
        return [thing for thing in self.things if thing.label == label]


@cache
def truth_of(scale: Scale) -> Truth:
    """Returns the truth about the world of a scale; the same one however often it is asked for."""
    world = world_of(scale)
    recorded = world.on
    life, clock = world.life, world.clock_at
    return Truth(
        recorded=tuple((clock(start), clock(stop)) for start, stop in recorded),
        days=tuple(_day(world, recorded, day) for day in range(scale.days)),
        things=_things(world),
        visits=_visits(world, recorded),
        standstills=_standstills(world, recorded),
        bumps=tuple(clock(t) for t in life.bumps if _inside(recorded, t)),
        blind=(clock(life.blind[0]), clock(life.blind[1])),
        outage=(clock(life.outage[0]), clock(life.outage[1])),
        clock_step=START_S + life.clock_step,
    )


def _inside(spans: Sequence[Span], t: float) -> bool:
    return any(start <= t < stop for start, stop in spans)


def _day(world: World, recorded: Sequence[Span], day: int) -> DayTruth:
    start = day * DAY
    parts = [
        (max(a, start), min(b, start + DAY)) for a, b in recorded if a < start + DAY and b > start
    ]
    gone = world.life.path.driven(np.array(parts).ravel()).reshape(-1, 2)
    grid = np.concatenate([np.append(np.arange(a, b, 1.0), b) for a, b in parts])
    return DayTruth(
        date=datetime.fromtimestamp(START_S + start, UTC).date().isoformat(),
        recorded_s=sum(b - a for a, b in parts),
        driven_m=float((gone[:, 1] - gone[:, 0]).sum()),
        departures=tuple(
            world.clock_at(outing.start)
            for outing in world.life.outings
            if start <= outing.start < start + DAY and _inside(recorded, outing.start)
        ),
        lowest_battery=float(world.battery(grid).min()),
    )


def _things(world: World) -> tuple[ThingTruth, ...]:
    seen = [[Sight() for _ in thing.stays] for thing in world.things]

    def sight(target: int, t: float) -> Sight:
        starts = [stay.start for stay in world.things[target].stays]
        return seen[target][bisect_right(starts, t) - 1]

    for recording in world.recordings:
        beats, sights = world.sights(recording)
        clock, stamps = world.clock(beats.stamp).tolist(), beats.stamp.tolist()
        for message, target in np.argwhere(sights.in_view[:, : len(world.things)]).tolist():
            spans, at = sight(target, stamps[message]).in_view, clock[message]
            if spans and at - spans[-1][1] <= VIEW_GAP_S:
                spans[-1] = (spans[-1][0], at)
            else:
                spans.append((at, at))
        for each in sights.detected:
            if each.right and each.target < len(world.things):
                of_stay = sight(each.target, stamps[each.message])
                of_stay.last_detected = clock[each.message]
                if of_stay.first_detected is None:
                    of_stay.first_detected = of_stay.last_detected
    return tuple(
        ThingTruth(
            thing.label,
            tuple(
                PlaceOfThing(
                    world.clock_at(stay.start), world.clock_at(stay.stop), stay.place, of_stay
                )
                for stay, of_stay in zip(thing.stays, of_thing, strict=True)
            ),
        )
        for thing, of_thing in zip(world.things, seen, strict=True)
    )


def _visits(world: World, recorded: Sequence[Span]) -> dict[str, tuple[Span, ...]]:
    """Returns when the robot was in each named place; a gap in the recording ends a visit."""
    found: dict[str, list[Span]] = {name: [] for name in places()}
    for start, stop in recorded:
        grid = np.append(np.arange(start, stop, _SAMPLE_S), stop)
        pose = world.robot(grid)
        for name, spans in found.items():
            inside = _in_place(name, pose.x, pose.y)
            edges = np.flatnonzero(np.diff(inside.astype(np.int8), prepend=0, append=0))
            for first, after in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                left = min(after, len(grid) - 1)
                spans.append(
                    (world.clock_at(float(grid[first])), world.clock_at(float(grid[left])))
                )
    return {name: tuple(spans) for name, spans in found.items()}


def _in_place(name: str, x: Floats, y: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    room = flat.ROOMS.get(name)
    if room is not None:
        return (x >= room.x0) & (x < room.x1) & (y >= room.y0) & (y < room.y1)
    if name == "dining corner":
        return _in_polygon(flat.DINING_CORNER, x, y)
    centre, radius = (flat.DOCK[:2], flat.DOCK_RADIUS_M)
    if name == "front door":
        centre, radius = flat.FRONT_DOOR, 1.0
    inside: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = (
        np.hypot(x - centre[0], y - centre[1]) <= radius
    )
    return inside


def _in_polygon(
    corners: Sequence[tuple[float, float]], x: Floats, y: Floats
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    inside = np.zeros(x.shape, dtype=np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def places() -> dict[str, JsonValue]:
    """Returns the places as `places.yaml` has them."""
    named: dict[str, JsonValue] = {
        name: {"frame": "map", "x": [room.x0, room.x1], "y": [room.y0, room.y1]}
        for name, room in flat.ROOMS.items()
    }
    x, y, _ = flat.DOCK
    named["dock"] = {"frame": "map", "x": x, "y": y, "radius_m": flat.DOCK_RADIUS_M}
    x, y = flat.FRONT_DOOR
    named["front door"] = {"frame": "map", "x": x, "y": y, "radius_m": 1.0}
    corner: list[JsonValue] = [[x, y] for x, y in flat.DINING_CORNER]
    named["dining corner"] = {"frame": "map", "polygon": corner}
    return named


def _standstills(world: World, recorded: Sequence[Span]) -> tuple[Standstill, ...]:
    """Returns where the robot stood off its dock for three seconds or more; it may turn there."""
    knots = world.life.path.knots
    found: list[Standstill] = []
    first = 0
    for nth in range(1, len(knots) + 1):
        if nth < len(knots) and math.dist(knots[nth, 1:3], knots[first, 1:3]) < 1e-6:
            continue
        a, b = float(knots[first, 0]), float(knots[nth - 1, 0])
        x, y = float(knots[first, 1]), float(knots[first, 2])
        first = nth
        if (x, y) == flat.DOCK[:2]:
            continue
        reason = next((halt.reason for halt in world.life.halts if a <= halt.start < b), "")
        for start, stop in recorded:
            begin, end = max(a, start), min(b, stop)
            if end - begin >= _STOOD_S:
                room = flat.room_at(x, y) or ""
                span = world.clock_at(begin), world.clock_at(end)
                found.append(Standstill(*span, x, y, room, reason))
    return tuple(found)

"""What an answer is judged by, from the simulation's state alone: no message is read for it.

All times are Unix seconds of the robot's clock, all lengths metres, all points in `map`. What could
be known of a thing comes from the state, too: `in_view` is when the camera had it in view, while
the detector ran and the recorder as well; `detected` adds the detector's own luck.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from tests.home import flat
from tests.home.days import CLOCK_STEP_S, Scale
from tests.home.things import DAY, Place, Thing
from tests.home.world import START_S, World, world_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from benchmarks.motion import Floats

    from ros2_memory.core.model import JsonValue

Span: TypeAlias = tuple[float, float]
VIEW_GAP_S: Final = 5.0
"""A thing that is in view again within so long was in view all along."""
_SAMPLE_S: Final = 0.1
_STOOD_S: Final = 3.0


@dataclass(slots=True)
class Sight:
    """How one stay of a thing was seen."""

    in_view: list[Span] = field(default_factory=list)
    messages: int = 0
    detections: int = 0
    first_detected: float | None = None
    last_detected: float | None = None


@dataclass(frozen=True, slots=True)
class PlaceOfThing:
    """A stay of a thing: where, from when to when, and how it was seen there."""

    start: float
    stop: float
    place: Place | None
    sight: Sight


@dataclass(frozen=True, slots=True)
class ThingTruth:
    """A thing with all its stays."""

    name: str
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


@dataclass(frozen=True, slots=True)
class Standstill:
    """The robot stood off its dock; `reason` is why it had not meant to, "" where it had."""

    start: float
    stop: float
    x: float
    y: float
    room: str
    reason: str


@dataclass(frozen=True, slots=True)
class DayTruth:
    """One calendar day (UTC), as far as it was recorded."""

    date: str
    recorded_s: float
    driven_m: float
    departures: tuple[float, ...]
    lowest_battery: float
    lowest_battery_at: float


@dataclass(frozen=True, slots=True)
class Truth:
    """All that is true of a world."""

    recorded: tuple[Span, ...]
    days: tuple[DayTruth, ...]
    things: tuple[ThingTruth, ...]
    people_in_view: int
    visits: Mapping[str, tuple[Span, ...]]
    standstills: tuple[Standstill, ...]
    bumps: tuple[float, ...]
    errors: tuple[tuple[float, str], ...]
    goals: tuple[tuple[float, int, int], ...]
    blind: Span
    outage: Span
    power_cut: Span
    clock_step: float
    corrections: tuple[tuple[float, float], ...]

    @property
    def end(self) -> float:
        """Returns the last recorded moment; questions are asked then."""
        return self.recorded[-1][1]

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
    recorded = _recorded(world)
    life, clock = world.life, world.clock_at
    step = life.clock_step
    return Truth(
        recorded=tuple((clock(start), clock(stop)) for start, stop in recorded),
        days=tuple(_day(world, recorded, day) for day in range(scale.days)),
        things=_things(world),
        people_in_view=sum(
            int(world.sights(each)[1].in_view[:, len(world.things) :].sum())
            for each in world.recordings
        ),
        visits=_visits(world, recorded),
        standstills=_standstills(world, recorded),
        bumps=tuple(clock(t) for t in life.bumps if _inside(recorded, t)),
        errors=tuple(
            (clock(log.t), log.text)
            for log in life.logs
            if log.level >= 40 and _inside(recorded, log.t)
        ),
        goals=tuple(
            (clock(goal.t), goal.goal, goal.status)
            for goal in life.goals
            if _inside(recorded, goal.t)
        ),
        blind=(clock(life.blind[0]), clock(life.blind[1])),
        outage=(clock(life.outage[0]), clock(life.outage[1])),
        power_cut=(clock(life.power_cut[0]), clock(life.power_cut[1])),
        clock_step=START_S + step,
        corrections=tuple((clock(each.t), each.metres) for each in world.drift.corrections),
    )


def _recorded(world: World) -> list[Span]:
    """Returns the recorded times; recordings that follow each other are one."""
    return [(start, stop) for start, stop in world.on if stop > start]


def _inside(spans: Sequence[Span], t: float) -> bool:
    return any(start <= t < stop for start, stop in spans)


def _day(world: World, recorded: Sequence[Span], day: int) -> DayTruth:
    start = day * DAY
    parts = [
        (max(a, start), min(b, start + DAY)) for a, b in recorded if a < start + DAY and b > start
    ]
    gone = world.life.path.driven(np.array(parts).ravel()).reshape(-1, 2)
    grid = np.concatenate([np.append(np.arange(a, b, 1.0), b) for a, b in parts])
    charge = world.battery(grid)
    lowest = int(np.argmin(charge))
    return DayTruth(
        date=datetime.fromtimestamp(START_S + start, UTC).date().isoformat(),
        recorded_s=sum(b - a for a, b in parts),
        driven_m=float((gone[:, 1] - gone[:, 0]).sum()),
        departures=tuple(
            world.clock_at(outing.start)
            for outing in world.life.outings
            if start <= outing.start < start + DAY and _inside(recorded, outing.start)
        ),
        lowest_battery=float(charge[lowest]),
        lowest_battery_at=world.clock_at(float(grid[lowest])),
    )


def _things(world: World) -> tuple[ThingTruth, ...]:
    seen: list[dict[int, Sight]] = [
        {nth: Sight() for nth in range(len(thing.stays))} for thing in world.things
    ]
    for recording in world.recordings:
        beats, sights = world.sights(recording)
        clock = world.clock(beats.stamp).tolist()
        stamps = beats.stamp.tolist()
        for message, target in zip(
            *map(np.ndarray.tolist, np.nonzero(sights.in_view)), strict=True
        ):
            if target < len(world.things):
                nth = _stay(world.things[target], stamps[message])
                _view(seen[target][nth], clock[message])
        for each in sights.detected:
            if each.right and each.target < len(world.things):
                nth = _stay(world.things[each.target], stamps[each.message])
                _detect(seen[each.target][nth], clock[each.message])
    return tuple(
        ThingTruth(
            thing.name,
            thing.label,
            tuple(
                PlaceOfThing(
                    world.clock_at(stay.start), world.clock_at(stay.stop), stay.place, mine[nth]
                )
                for nth, stay in enumerate(thing.stays)
            ),
        )
        for thing, mine in zip(world.things, seen, strict=True)
    )


def _stay(thing: Thing, t: float) -> int:
    return max(nth for nth, stay in enumerate(thing.stays) if stay.start <= t)


def _view(sight: Sight, at: float) -> None:
    sight.messages += 1
    if sight.in_view and at - sight.in_view[-1][1] <= VIEW_GAP_S:
        sight.in_view[-1] = (sight.in_view[-1][0], at)
    else:
        sight.in_view.append((at, at))


def _detect(sight: Sight, at: float) -> None:
    sight.detections += 1
    sight.first_detected = at if sight.first_detected is None else sight.first_detected
    sight.last_detected = at


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

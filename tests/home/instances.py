"""How well `find_things` makes instances of detections: numbers, places, moves, and what it denies.

All labels are asked for one by one, without a window, as an owner does. A thing that was never
detected is not expected; what cannot be known (a move that nobody saw) is not counted.
"""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from tests.home import replies
from tests.home.camera import in_view
from tests.home.paths import Pose
from tests.home.world import VISION, World

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.serving.mcp_server import EpisodicServer
    from tests.home.replies import Row
    from tests.home.things import Place
    from tests.home.truth import PlaceOfThing, ThingTruth, Truth

_SAME_M: Final = 0.7
"""A place that is reported so near to a true one is that one: half of the way to another."""
_DENIED: Final = "not_seen_where_expected"
_FEWEST_LOOKS: Final = 2


@dataclass(slots=True)
class Measures:
    """What was found. `switches` are places of a thing that it never stood at."""

    labels: int = 0
    right_labels: int = 0
    wrong_numbers: list[str] = field(default_factory=list)
    away_m: list[float] = field(default_factory=list)
    moves: int = 0
    moves_in_time: int = 0
    late_moves: list[str] = field(default_factory=list)
    sightings: int = 0
    switches: list[str] = field(default_factory=list)
    denied: list[str] = field(default_factory=list)


def measured(server: EpisodicServer, truth: Truth, split_s: float) -> Measures:
    """Returns the measures."""
    found = Measures()
    for label in sorted({thing.label for thing in truth.things}):
        things = [thing for thing in truth.of(label) if thing.known()]
        if not things:
            continue
        reply = asyncio.run(server.dispatcher.answer("find_things", {"label": label})).text
        _compare(found, label, things, replies.things(json.loads(reply)), split_s)
    return found


@dataclass(slots=True)
class Denials:
    """What was denied as of the end of each recorded time, and what of that without a reason."""

    count: int = 0
    unseen: list[str] = field(default_factory=list)
    """Since the thing was seen last, its place was in view in fewer than two messages."""
    false: list[str] = field(default_factory=list)
    """The thing stood there all the time."""


def denials(server: EpisodicServer, world: World, truth: Truth) -> Denials:
    """Returns what `find_things` denied of all things, as of the end of each recorded time."""
    found = Denials()
    beats = [world.beats(VISION, each).stamp for each in world.recordings]
    stamps = np.unique(np.concatenate(beats))
    clock, robot = world.clock(stamps), world.robot(stamps)
    for _, stop in truth.recorded:
        question = {"end": stop, "limit": 100}
        reply = asyncio.run(server.dispatcher.answer("find_things", question)).text
        for each in replies.things(json.loads(reply)):
            still = replies.row(each.get("still_there") or {})
            if _DENIED not in still:
                continue
            found.count += 1
            point, label = point_of(each), replies.text(each, "label")
            named = f"{label} at {point[0]:.1f}, {point[1]:.1f} by {stop:.0f}"
            since, until = replies.time(each, "last_seen"), replies.time(still, _DENIED)
            looked = np.flatnonzero((clock > since + 0.5) & (clock <= until + 0.5))
            poses = Pose(robot.x[looked], robot.y[looked], robot.yaw[looked])
            x, y = (np.full((len(looked), 1), part) for part in point)
            if np.count_nonzero(in_view(poses, x, y)) < _FEWEST_LOOKS:
                found.unseen.append(named)
            if any(_stood(thing, point, since, until) for thing in truth.of(label)):
                found.false.append(named)
    return found


def _stood(thing: ThingTruth, point: tuple[float, float], since: float, until: float) -> bool:
    """Whether a thing stood at a point from one time to another."""
    return any(
        stay.start <= since and until <= stay.stop and _away(point, stay.place) <= _SAME_M
        for stay in thing.stays
    )


def _compare(
    found: Measures, label: str, things: Sequence[ThingTruth], reported: list[Row], split_s: float
) -> None:
    found.labels += 1
    found.right_labels += len(reported) == len(things)
    if len(reported) != len(things):
        found.wrong_numbers.append(f"{label} {len(reported)} for {len(things)}")
    points = [point_of(each) for each in reported]
    for thing in things:
        now = thing.known()[-1]
        nearest = min((_away(point, now.place) for point in points), default=math.inf)
        if nearest <= _SAME_M:
            found.away_m.append(nearest)
        found.sightings += sum(len(stay.sight.in_view) for stay in thing.stays)
    histories = [replies.stays(each) for each in reported]
    _compare_moves(found, label, things, histories, split_s)
    every = [stay for thing in things for stay in thing.known()]
    for history in histories:
        for each in history:
            if all(_away(point_of(each), stay.place) > _SAME_M for stay in every):
                x, y = point_of(each)
                found.switches.append(f"{label} at {x:.1f}, {y:.1f}")
    for each, point in zip(reported, points, strict=True):
        stands = [thing.stays[-1] for thing in things]
        denied = _DENIED in replies.row(each.get("still_there", {}))
        if denied and any(_away(point, stay.place) <= _SAME_M for stay in stands):
            found.denied.append(f"{label} at {point[0]:.1f}, {point[1]:.1f}")


def _compare_moves(
    found: Measures,
    label: str,
    things: Sequence[ThingTruth],
    histories: Sequence[list[Row]],
    split_s: float,
) -> None:
    for thing in things:
        for stay in thing.known()[1:]:
            found.moves += 1
            if any(_is_known(stay, history, split_s) for history in histories):
                found.moves_in_time += 1
            else:
                found.late_moves.append(f"{label} to {stay.place.name if stay.place else ''}")


def _is_known(stay: PlaceOfThing, history: list[Row], split_s: float) -> bool:
    """Whether a history has the stay, beginning when it was first seen, within one split."""
    first = stay.sight.first_detected or math.inf
    return any(
        _away(point_of(each), stay.place) <= _SAME_M
        and abs(replies.time(each, *replies.SINCE) - first) <= split_s
        for each in history
    )


def point_of(found: Row) -> tuple[float, float]:
    """Returns where a reply has a thing, or a stay of it.

    Raises:
        UnreadableError: it has no point.
    """
    at = found.get("place", found.get("position", found))
    where = at if isinstance(at, dict) and "x" in at else found
    return replies.number(where, "x"), replies.number(where, "y")


def _away(point: tuple[float, float], place: Place | None) -> float:
    return math.inf if place is None else math.dist(point, (place.x, place.y))

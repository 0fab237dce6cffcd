"""Visits to a place: arrival, departure and closest approach, newest first.

A visit is pose after pose inside. It is over when the robot is outside for some seconds, and where
for longer there is no pose to know it by. When odometry is reset, the same
coordinates are another place: visits from before that are marked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
)
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Circle
from ros2_memory.core.spans import Spans, united
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, Ns, ns_from_unix
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_unread, unix_text, unknown_times
from ros2_memory.history.driven_path import (
    driven_path,
    resolve_path_topic,
)
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import TimeRange, View, open_view, search_window
from ros2_memory.places.pose_frames import map_placement
from ros2_memory.places.region_visits import (
    WHEREABOUTS,
    RegionVisits,
    place_visits,
    placed_times,
    places_in,
)
from ros2_memory.places.where import Where, note_other_frame, parse_where, places_setting
from ros2_memory.results import Visit, Visits

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.history.context import Call, Memory, QuerySettings

_SPLITS: Final = 3
"""A pose no older than so many splits is current: a split answers only when it is closed."""


def visits(
    memory: Memory,
    call: Call,
    x: float | None = None,
    y: float | None = None,
    *,
    where: JsonValue = None,
    frame_id: str | None = None,
    radius_m: float | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    limit: int = 10,
) -> Visits:
    """Returns when the robot was in a place, newest visits first; of no place, all named ones.

    A place is a circle around `x` and `y` (m), or `where`. Coordinates are in `frame_id`: the map,
    which is the default, or the frame of the poses. Between `start_s` and `end_s` (Unix seconds,
    inclusive) alone, where these are given.

    Raises:
        InvalidArgumentsError: the pose topic carries no position, the place is invalid, the frame
            is another one, or the bounds are reversed.
        NoDataError: nothing is recorded, or no poses.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place = asked_place(memory.limits, (x, y), radius_m, where)
    wall = memory.clock.now()
    window = search_window(TimeRange(start_s, end_s), wall)
    view = open_view(memory, call, min(window.stop, wall))
    require_recorded(view, window)
    topic = resolve_path_topic(view)
    mixed = note_robots(view, topic, window)
    named_frame = None if place is None else place.frame_id
    asked = frame_id if named_frame is None else named_frame
    placement = map_placement(view, topic, asked)
    now = memory.now(wall, view.snapshot.latest, call)
    if place is None:
        table = [
            (each, RegionVisits(view, each.frame_id, each.region, window))
            for each, _ in places_in(view, memory.limits.places, placement, window)
        ]
        rows = (place_visits(found, each.name) for each, found in table)
        places = tuple(sorted(rows, key=lambda each: (-each.duration, each.place)))
        tracks = {each.frame_id: found.joined.track for each, found in table}.values()
        been = any(each.duration for each in places)
        note_unread(view, window, nothing=not been, gaps=not been)
        return Visits(
            frame_id=placement.frame_id,
            x=None,
            y=None,
            radius_m=None,
            visits=(),
            more=False,
            total=sum(each.entries for each in places),
            now=now,
            places=places,
            unknown=_unknown(view, window, tracks, mixed),
            notes=view.notes.sentences(),
        )
    found = RegionVisits(view, placement.frame_id, place.region, window)
    track, every = found.joined.track, found.every
    newest = _newest(view, topic, track, window, now + FUTURE_NS)
    # A newer pose shows where the robot is now.
    stale = now - _SPLITS * ns_from_unix(view.limits.split_duration_s)
    current = newest if newest is not None and newest >= stale else None
    shown = tuple(_within_asked(found.shown(each, current), window) for each in every[:limit])
    if not placement.is_map:
        shown = _with_restarts(view, topic, shown, now)
    if not every and asked is None:
        ask = f'ask with frame_id "{placement.pose_frame}"'
        note_other_frame(view, place, placement, window, ask)
    view.notes.retract_outside(window)
    _note_doubts(view, shown, newest, window)
    circle = place.region if isinstance(place.region, Circle) and place.name is None else None
    return Visits(
        frame_id=placement.frame_id,
        x=None if circle is None else circle.x,
        y=None if circle is None else circle.y,
        radius_m=None if circle is None else circle.radius_m,
        visits=shown,
        more=len(every) > len(shown),
        total=len(every),
        now=now,
        duration=found.duration,
        entries=sum(each.inside.entered for each in every),
        exits=sum(each.inside.left for each in every),
        all_counted=found.joined.since is None,
        where=place.name,
        unknown=_unknown(view, window, [track], mixed),
        reaches_now=newest is not None,
        notes=view.notes.sentences(),
    )


def asked_place(
    limits: QuerySettings,
    point: tuple[float | None, float | None],
    radius_m: float | None,
    where: JsonValue,
) -> Where | None:
    """Returns the requested place; None for all named ones.

    Raises:
        InvalidArgumentsError: the arguments name none, or two.
    """
    radius = limits.position_tolerance_m if radius_m is None else radius_m
    if not (radius > 0 and math.isfinite(radius)):
        raise InvalidArgumentsError(f"radius_m must be more than 0, and was {radius_m}")
    x, y = point
    if where is not None:
        if x is not None or y is not None:
            raise InvalidArgumentsError("give either where or x and y")
        return parse_where(limits, where, radius)
    if x is not None and y is not None:
        return Where(Circle(x, y, radius))
    if x is not None or y is not None:
        raise InvalidArgumentsError("x and y must both be given, or neither")
    if not limits.places:
        raise InvalidArgumentsError(
            f"no place is named in {places_setting(limits)}: give x and y, or where"
        )
    return None


def _unknown(view: View, window: TimeWindow, tracks: Iterable[RobotTrack], mixed: Spans) -> Ns:
    """Returns for how long it is not known where the robot was, by a track for each frame."""
    every = (unknown_times(view, window, placed_times(one, mixed), WHEREABOUTS) for one in tracks)
    return elapsed_in(view, window).among(united(chain.from_iterable(every)))


def _newest(view: View, topic: str, track: RobotTrack, window: TimeWindow, last: Ns) -> Ns | None:
    """Returns the time of the newest pose until `last`, where the window reaches as far."""
    message = view.stream.newest(topic, TimeWindow(MIN_NS, last + 1))
    if message is None or window.stop <= message.time:
        return None
    known = track.times[track.times <= last]
    return int(known[-1]) if known.size else None


def _within_asked(visit: Visit, window: TimeWindow) -> Visit:
    """Returns a visit that is cut at the bounds that were given, not at their tolerance."""
    start, end = window.asked()
    if visit.arrived == window.start:
        visit = replace(visit, arrived=start)
    return replace(visit, departed=end) if visit.departed == window.stop - 1 else visit


def _with_restarts(view: View, topic: str, shown: tuple[Visit, ...], now: Ns) -> tuple[Visit, ...]:
    """Returns visits with the number of odometry resets since."""
    if not shown:
        return shown
    last = shown[-1]
    began = (last.departed or now) - last.duration if last.arrived is None else last.arrived
    resets = _resets(view, topic, began)
    return tuple(
        replace(each, restarts=sum(reset > (each.departed or now) for reset in resets))
        for each in shown
    )


def _note_doubts(view: View, shown: Sequence[Visit], newest: Ns | None, window: TimeWindow) -> None:
    """Adds notes on visits that are uncertain."""
    note_unread(view, window, nothing=not shown, gaps=not shown)
    if newest is not None and any(visit.departed == newest for visit in shown):
        view.notes.add(
            f"the newest pose, at {unix_text(newest)}, is too old to know whether the robot is "
            "there now: departed is the time of that pose"
        )
    if any(visit.restarts for visit in shown):
        view.notes.add(
            "visits with restarts_since are from before odometry restarted: "
            "the same coordinates may have been another place"
        )


def _resets(view: View, topic: str, since: Ns) -> tuple[Ns, ...]:
    """Returns the times of the first poses after each reset of odometry since a moment.

    None, with a note, if the time for the answer runs out first.
    """
    try:
        path, _ = driven_path(view, topic, TimeWindow(since, MAX_NS))
    except (InvalidArgumentsError, NoDataError):
        return ()  # poses that cannot be read say nothing about resets
    except QueryTimeoutError:
        view.notes.add_lack("there was no time to check whether odometry restarted since")
        return ()
    return () if path is None else path.totals.resets

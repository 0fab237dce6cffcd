"""Visits to a place: arrival, departure and closest approach, newest first.

A visit is pose after pose within the radius. It is over when the robot is farther away for some
seconds, and where for longer there is no pose to know it by. When odometry is reset, the same
coordinates are another place: visits from before that are marked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.bulk_decode import motion_decoder
from ros2_memory.analysis.conditions import Condition, NearPosition
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.motion.dwell import FLICKER_NS, Approach, DwellBuilder
from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle
from ros2_memory.core.timebase import MAX_NS, Deadline, Ns, ns_from_unix
from ros2_memory.history.coverage import note_unread, unix_text
from ros2_memory.history.driven_path import (
    driven_path,
    pose_frame,
    positions_of,
    resolve_path_topic,
)
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.poses import pose_rows
from ros2_memory.history.reverse_search import CandidateBags
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import TimeRange, open_view, search_window
from ros2_memory.insights.clock_steps import elapsed_in
from ros2_memory.places.map_placement import map_placement
from ros2_memory.places.region_visits import place_visits, region_visits, visit_of
from ros2_memory.places.where import Where, note_other_frame, parse_where, places_setting
from ros2_memory.results import Visit, Visits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.analysis.motion.dwell import Dwell
    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.core.regions import Region
    from ros2_memory.history.context import Call, Memory, QuerySettings
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.places.map_placement import MapPlacement

_COUNTING_S: Final = 5.0
"""How long visits are counted that are not shown."""
_ROUNDING_M: Final = 1e-6
"""What rounding of doubles may take off a distance."""
_FLICKERS: Final = -(-SILENCE_NS // FLICKER_NS)
"""So many visits may be in the margin of a window: poses just outside decide what is one visit."""
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
    note_robots(view, topic, window)
    named_frame = None if place is None else place.frame_id
    asked = frame_id if named_frame is None else named_frame
    own_frame = pose_frame(view, topic)
    placement = map_placement(view, own_frame, topic, asked)
    now = memory.now(wall, view.snapshot.latest)
    if place is None:
        found = place_visits(view, memory.limits.places, placement, window)
        note_unread(view, window, nothing=not any(each.duration for each in found))
        return Visits(
            frame_id=placement.frame_id,
            x=None,
            y=None,
            radius_m=None,
            visits=(),
            more=False,
            total=sum(each.entries for each in found),
            now=now,
            places=found,
            notes=view.notes.sentences(),
        )
    search = _VisitSearch(view, topic, placement, place.region, window)
    by_track = where is not None or placement.moves or topic in memory.limits.tf_topics
    # A lake has the track alone, of which few poses are vertices.
    by_track = by_track or memory.stated is not None
    # In the poses' own frame as in the map: by the track, where that map moves.
    by_track = by_track or (asked == own_frame and map_placement(view, own_frame, topic).moves)
    if by_track:
        known = _by_track(view, search, placement.frame_id, place, (window, now, limit))
    else:
        known = _by_poses(view, search, window, now, limit)
    # Its rows say which visit was under way, which only the ends of recordings cut.
    is_unbounded = not by_track and start_s is None and end_s is None
    known = known._replace(shown=tuple(_within_asked(each, window) for each in known.shown))
    if not placement.is_map:
        known = known._replace(shown=_with_restarts(view, topic, known.shown, now))
    if not known.total and asked is None:
        note_other_frame(view, place, placement, window, f'ask with frame_id "{own_frame}"')
    _note_doubts(view, known, window)
    circle = place.region if isinstance(place.region, Circle) and place.name is None else None
    return Visits(
        frame_id=placement.frame_id,
        x=None if circle is None else circle.x,
        y=None if circle is None else circle.y,
        radius_m=None if circle is None else circle.radius_m,
        visits=known.shown,
        more=known.total > len(known.shown),
        total=known.total,
        now=now,
        duration=known.duration,
        entries=None if is_unbounded else known.entries,
        exits=None if is_unbounded else known.exits,
        all_counted=known.is_all,
        where=place.name,
        notes=view.notes.sentences(),
    )


class _Known(NamedTuple):
    """The visits to show, and the number and duration of all."""

    shown: tuple[Visit, ...]
    total: int
    duration: Ns
    newest: Ns | None
    entries: int
    exits: int
    is_all: bool


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


def _by_track(
    view: View,
    search: _VisitSearch,
    frame_id: str,
    place: Where,
    bounds: tuple[TimeWindow, Ns, int],
) -> _Known:
    """Returns the visits by the robot's track."""
    window, now, limit = bounds
    found = region_visits(view, frame_id, place, window)
    newest = search.newest_time
    current = newest if _is_current(view, newest, now) else None
    shown = tuple(visit_of(found, each, place, current) for each in found.all[:limit])
    entries, exits = sum(each.entered for each in found.all), sum(each.left for each in found.all)
    return _Known(
        shown, len(found.all), found.duration, newest, entries, exits, is_all=found.is_all
    )


def _by_poses(view: View, search: _VisitSearch, window: TimeWindow, now: Ns, limit: int) -> _Known:
    """Returns the visits pose by pose."""
    newest = search.newest_time
    known = _is_current(view, newest, now)
    every = search.all(limit)
    left = [search.has_left(each) for each in every]
    elapsed = elapsed_in(view, window)
    lasted = [
        elapsed.between(max(each.arrived, window.start), min(each.departed, window.stop - 1))
        for each in every
    ]
    shown: list[Visit] = []
    for dwell, is_left, duration in list(zip(every, left, lasted, strict=True))[:limit]:
        closest = search.closest(dwell)
        is_there = known and dwell.departed == newest
        shown.append(
            Visit(
                arrived=max(dwell.arrived, window.start) if dwell.begun else None,
                departed=None if is_there else min(dwell.departed, window.stop - 1),
                duration=duration,
                closest_m=None if closest is None else closest.distance_m,
                closest_at=None if closest is None else closest.time,
                restarts=0,
                already_inside=dwell.begun and not _entered(dwell, window),
                still_inside=not is_there and (is_left is False or dwell.departed >= window.stop),
            )
        )
    entries = sum(_entered(each, window) for each in every)
    exits = sum(
        bool(is_left) and each.departed < window.stop
        for each, is_left in zip(every, left, strict=True)
    )
    is_all = search.is_all
    return _Known(tuple(shown), len(every), sum(lasted), newest, entries, exits, is_all=is_all)


def _within_asked(visit: Visit, window: TimeWindow) -> Visit:
    """Returns a visit that is cut at the bounds that were given, not at their tolerance."""
    start, end = window.asked()
    if visit.arrived == window.start:
        visit = replace(visit, arrived=start)
    return replace(visit, departed=end) if visit.departed == window.stop - 1 else visit


def _entered(dwell: Dwell, window: TimeWindow) -> bool:
    return dwell.entered and dwell.arrived >= window.start


def _is_current(view: View, newest: Ns | None, now: Ns) -> bool:
    """Whether the newest pose is recent enough to know where the robot is now."""
    stale = _SPLITS * ns_from_unix(view.memory.limits.split_duration_s)
    return newest is not None and newest >= now - stale


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


def _note_doubts(view: View, known: _Known, window: TimeWindow) -> None:
    """Adds notes on visits that are uncertain."""
    shown, newest = known.shown, known.newest
    note_unread(view, window, nothing=not shown)
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
        path = driven_path(view, topic, TimeWindow(since, MAX_NS))
    except (InvalidArgumentsError, NoDataError):
        return ()  # poses that cannot be read say nothing about resets
    except QueryTimeoutError:
        view.notes.complete = False
        view.notes.add("there was no time to check whether odometry restarted since")
        return ()
    return () if path is None else path.trajectory.totals.resets


class _VisitSearch:
    """Searches the poses of a topic, newest first, without bags that are ruled out.

    Attributes:
        is_all: whether the time was enough to find all visits.
    """

    def __init__(
        self, view: View, topic: str, placement: MapPlacement, region: Region, window: TimeWindow
    ) -> None:
        self._window = window
        # What is one visit, and was entered or left, is decided by poses just outside, too.
        self._within = window.widened(SILENCE_NS)
        self._view = view
        self._topic = topic
        self._placement = placement
        circle = region if isinstance(region, Circle) else Circle(0.0, 0.0, 0.0)
        self._x, self._y, self._radius = circle.x, circle.y, circle.radius_m
        self._decoder = motion_decoder(view.memory.reader, view.memory.extractor)
        self._counting: Deadline | None = None
        self.is_all = True

    @property
    def newest_time(self) -> Ns | None:
        """The log time of the newest pose; None without one."""
        if self._topic in self._view.memory.limits.tf_topics:
            newest = self._view.stream.newest(self._topic, TimeWindow.everything())
            return None if newest is None else newest.time
        return next((found.time for found, _ in self._positions(TimeWindow.everything())), None)

    def all(self, limit: int) -> list[Dwell]:
        """Returns the visits, newest first; if the time runs out before all, at least some.

        A note then says how far back they were counted.
        """
        visits = DwellBuilder(limit + _FLICKERS)
        before = self._within.stop
        try:
            for part in self._parts():
                self._pass_over(visits, TimeWindow(part.stop, max(before, part.stop)))
                self._add_part(visits, part)
                before = part.start
                if visits.enough and self._counting is None:
                    self._counting = self._view.call.partial_after(_COUNTING_S)
                self._check_counting()
            self._pass_over(visits, TimeWindow(self._within.start, before))
            visits.end()
        except QueryTimeoutError:
            if not visits.all:
                raise
            self.is_all = False
            self._view.notes.complete = False
            if self._counting is None:
                self._view.notes.add(f"the search ran out of time at {unix_text(before)}")
            self._view.notes.add(
                f"total counts the visits back to {unix_text(before)}: there may be more"
            )
        return [each for each in visits.all if self._window.overlaps(each.arrived, each.departed)]

    def has_left(self, visit: Dwell) -> bool | None:
        """Whether the robot was seen elsewhere just after a visit; None without time to know."""
        if visit.left is None:
            after = TimeWindow(visit.departed + 1, visit.departed + SILENCE_NS + 1)
            try:
                messages = self._view.stream.messages([self._topic], after)
                visit.left = any(True for _ in positions_of(self._view, self._decoder, messages))
            except QueryTimeoutError:
                self._view.notes.complete = False
        return visit.left

    def _check_counting(self) -> None:
        """Checks that there is time left to count visits that are not shown.

        Raises:
            QueryTimeoutError: there is none.
        """
        if self._counting is not None and self._counting.expired():
            raise QueryTimeoutError("counting takes too long")

    def closest(self, visit: Dwell) -> Approach | None:
        """Returns the closest pose of a visit, the earliest of equals; None where it has none.

        Whole bags within the radius are read only where one of their poses may be closer.
        """
        closest = visit.closest
        for bound, window, target in sorted(visit.unread, key=attrgetter("bound")):
            if closest is not None and closest <= bound:
                break
            approaches = [] if closest is None else [closest]
            try:
                self._add_approaches(approaches, window, target)
            except QueryTimeoutError:
                self._view.notes.complete = False
                self._view.notes.add(
                    f"closest_m of the visit until {unix_text(visit.departed)} is not the least: "
                    "there was no time to read all of its poses"
                )
                return min(approaches, default=bound)
            closest = min(approaches, default=None)
        # Bags that were deleted meanwhile leave their bounds.
        closest = closest or min(each.bound for each in visit.unread)
        return closest if math.isfinite(closest.distance_m) else None

    def _add_approaches(
        self, approaches: list[Approach], window: TimeWindow, target: tuple[float, float]
    ) -> None:
        for block in pose_rows(self._view, self._topic, window, []):
            poses = block.poses.rows(np.flatnonzero(are_places(block.poses.positions)))
            for time, (x, y, z) in zip(poses.times.tolist(), poses.positions.tolist(), strict=True):
                approaches.append(Approach(_away((x, y, z), target), time))

    def _parts(self) -> Iterator[TimeWindow]:
        """Yields the times in which the robot may have been near, newest first.

        Each is in the window as a whole, or beyond it.
        """
        start, stop = self._window.start, self._window.stop
        newer, older = TimeWindow(stop, self._within.stop), TimeWindow(self._within.start, start)
        for part in self._near():
            for each in map(part.intersect, (newer, self._window, older)):
                if not each.empty:
                    yield each

    def _near(self) -> Iterator[TimeWindow]:
        if self._view.stream.may_be_relatched([self._topic]):
            # A visit may be ended by the duplicate of a pose in a bag that is ruled out.
            yield self._within
            return
        bags = self._view.stream.overlapping_bags([self._topic], self._within)
        target = (
            self._target_in(bags[0]) if self._placement.is_fixed(self._topic) and bags else None
        )
        if target is None:  # its coordinates are not the same in all bags, so none is ruled out
            near = Condition(NearPosition(0.0, 0.0, None, math.inf))
        else:
            near = Condition(NearPosition(*target, None, self._radius))
        for part in CandidateBags(self._view, (self._topic,), near, self._within.stop).windows():
            if part.window.stop <= self._within.start:
                return
            yield part.window

    def _pass_over(self, visits: DwellBuilder, gap: TimeWindow) -> None:
        """Adds the poses between two parts, which are all elsewhere, until the visit is over."""
        if gap.empty or not visits.under_way:
            return
        for found, _ in self._positions(gap):
            if not visits.away(found.time):
                return

    def _add_part(self, visits: DwellBuilder, part: TimeWindow) -> None:
        """Adds the poses of a part: one by one."""
        self._placement.use_window(part)
        for found, position in self._positions(part):
            self._check_counting()
            distance = self._distance(found, position)
            if distance is not None and distance <= self._radius:
                counts = self._window.contains(found.time)
                visits.near(Approach(distance if counts else math.inf, found.time))
            else:
                visits.away(found.time)

    def _target_in(self, held: BagSpan) -> tuple[float, float] | None:
        """Returns the target in the frame of a bag's poses; None where that frame moves."""
        return self._placement.to_pose_frame(held.bag.recording, held.first, self._x, self._y)

    def _distance(self, found: StoredMessage, position: Vector3) -> float | None:
        """Returns how far (m) a pose is from the target; None if no transform connects them."""
        recording = found.bag.recording
        target = self._placement.to_pose_frame(recording, found.time, self._x, self._y)
        if target is not None:
            return _away(position, target)
        placed = self._placement.of(recording, found.time, position)
        return None if placed is None else _away(placed, (self._x, self._y))

    def _positions(self, part: TimeWindow) -> Iterator[tuple[StoredMessage, Vector3]]:
        """Returns the positions of a part, newest first."""
        messages = self._view.stream.messages([self._topic], part, newest_first=True)
        return positions_of(self._view, self._decoder, messages)


def _away(position: Vector3, target: tuple[float, float]) -> float:
    """Returns how far (m, in the plane) a position is from a place of the same frame."""
    return math.dist(position[:2], target)

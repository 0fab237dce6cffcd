"""Visits to a place: arrival, departure and closest approach, newest first.

`visits` is the query; the track comes from `robot_tracks`, by way of `known_track`.

A visit is pose after pose inside. It is over when the robot is outside for some seconds, and where
for longer there is no pose to know it by. All visits are found by the track, from which no pose is
farther than some 5 cm; those that are shown begin and end at poses. When odometry is reset, the
same coordinates are another place: visits from before that are marked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import FLICKER_NS
from ros2_memory.analysis.motion.robot_track import TOLERANCE_M, TRACK_SLICE_NS, RobotTrack
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, QueryTimeoutError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Circle, Region, Steps
from ros2_memory.core.spans import Spans, united
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, NS_PER_S, Ns, Span, ns_from_unix
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_unread, unix_text, unknown_times
from ros2_memory.history.driven_path import driven_path, resolve_path_topic
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import TimeRange, View, open_search
from ros2_memory.places.pose_frames import (
    NEWEST_POSE_NS,
    WHEREABOUTS,
    MapPlacement,
    known_track,
    map_placement,
    placed_times,
    places_in,
)
from ros2_memory.places.robot_tracks import Placed, Stay, TrackReader, stays
from ros2_memory.places.where import Where, note_other_frame, parse_where, places_setting
from ros2_memory.results import PlaceVisits, Visit, Visits

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.frames import Times
    from ros2_memory.history.context import Call, Memory, QuerySettings

_SPLITS: Final = 3
"""A pose no older than so many splits is current: a split answers only when it is closed."""
_CLOSE_NS: Final = 60 * NS_PER_S
_MOST_TRIED: Final = 50
_MOST_CONFIRMED: Final = 1000
"""Visits along the edge of a region that are looked at: it takes about a millisecond for each."""
_CLEARLY_M: Final = 5 * TOLERANCE_M


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
    view, now, window = open_search(memory, call, TimeRange(start_s, end_s))
    require_recorded(view, window)
    topic = resolve_path_topic(view)
    mixed = note_robots(view, topic, window)
    asked_frame = (place and place.frame_id) or frame_id
    placement = map_placement(view, topic, asked_frame)
    if place is None:
        return _visits_of_places(view, window, placement, mixed, now)
    region_visits = ConfirmedStays(view, placement.frame_id, place.region, window)
    track, all_visits = region_visits.known.track, region_visits.every
    newest = _newest_pose_time(view, topic, track, window, now + FUTURE_NS)
    # A newer pose shows where the robot is now; or what else was recorded since, that none does.
    stale = now - _SPLITS * ns_from_unix(view.limits.split_duration_s)
    stale = max(stale, min(view.snapshot.latest or MIN_NS, now) - NEWEST_POSE_NS)
    current = newest if newest is not None and newest >= stale else None
    shown = tuple(
        _within_asked(region_visits.shown(visit, current), window) for visit in all_visits[:limit]
    )
    if not placement.is_map:
        shown = _with_restarts(view, topic, shown, now)
    if not all_visits and asked_frame is None:
        ask = f'ask with frame_id "{placement.pose_frame}"'
        note_other_frame(view, place, placement, window, ask)
    view.notes.retract_outside(window)
    _note_shown(view, window, shown, newest)
    circle = place.region if isinstance(place.region, Circle) and place.name is None else None
    return Visits(
        frame_id=placement.frame_id,
        circle=circle,
        visits=shown,
        more=len(all_visits) > len(shown),
        total=len(all_visits),
        now=now,
        duration=region_visits.duration,
        entries=sum(visit.inside.entered for visit in all_visits),
        exits=sum(visit.inside.left for visit in all_visits),
        all_counted=region_visits.known.since is None,
        where=place.name,
        unknown=_unknown(view, window, [track], mixed),
        is_current=current is not None,
        notes=view.notes.sentences(),
    )


def _visits_of_places(
    view: View, window: TimeWindow, placement: MapPlacement, mixed: Spans, now: Ns
) -> Visits:
    """Returns how often and for how long the robot was in each named place, the longest first."""
    visited = [
        (place, ConfirmedStays(view, place.frame_id, place.region, window))
        for place, _ in places_in(view, view.limits.places, placement, window)
    ]
    rows = (place_visits(region_visits, place.name) for place, region_visits in visited)
    places = tuple(sorted(rows, key=lambda row: (-row.duration, row.place)))
    tracks = {place.frame_id: region_visits.known.track for place, region_visits in visited}
    was_in_one = any(row.duration for row in places)
    note_unread(view, window, nothing=not was_in_one, gaps=not was_in_one)
    return Visits(
        frame_id=placement.frame_id,
        total=sum(row.entries for row in places),
        now=now,
        places=places,
        unknown=_unknown(view, window, tracks.values(), mixed),
        notes=view.notes.sentences(),
    )


def _note_shown(view: View, window: TimeWindow, shown: Sequence[Visit], newest: Ns | None) -> None:
    """Adds notes on what the visits shown leave open; `newest` is the time of the newest pose."""
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
    spans = (
        unknown_times(view, window, placed_times(track, mixed), WHEREABOUTS, mixed=mixed)
        for track in tracks
    )
    return elapsed_in(view, window).among(united(chain.from_iterable(spans)))


def _newest_pose_time(
    view: View, topic: str, track: RobotTrack, window: TimeWindow, last: Ns
) -> Ns | None:
    """Returns the time of the newest pose until `last`, where the window reaches as far."""
    message = view.stream.last(topic, last + 1)
    if message is None or window.stop <= message.time:
        return None
    times = track.times[track.times <= last]
    return int(times[-1]) if times.size else None


def _within_asked(visit: Visit, window: TimeWindow) -> Visit:
    """Returns a visit that is cut at the bounds that were given, not at their tolerance."""
    start, end = window.asked()
    if visit.arrived == window.start:
        visit = replace(visit, arrived=start)
    return replace(visit, departed=end) if visit.departed == window.stop - 1 else visit


def _with_restarts(view: View, topic: str, shown: tuple[Visit, ...], now: Ns) -> tuple[Visit, ...]:
    """Returns visits, newest first, with the number of odometry resets since.

    None are counted, with a note, if the time for the answer runs out first.
    """
    if not shown:
        return shown
    try:
        path, _ = driven_path(view, topic, TimeWindow(shown[-1].arrived or MIN_NS, MAX_NS))
    except (InvalidArgumentsError, NoDataError):
        return shown  # poses that cannot be read say nothing about resets
    except QueryTimeoutError:
        view.notes.add_lack("there was no time to check whether odometry restarted since")
        return shown
    resets = () if path is None else path.totals.resets
    return tuple(
        replace(visit, restarts=sum(reset > (visit.departed or now) for reset in resets))
        for visit in shown
    )


class TrackedStay(NamedTuple):
    """A visit to a region by a track.

    Attributes:
        inside: the part in the window, as long as the track has it.
        whole: the visit, not cut.
        track: of the robot.
    """

    inside: Stay
    whole: Stay
    track: RobotTrack


class ConfirmedStays:
    """The visits to a region of a frame that reach into a window.

    Attributes:
        known: the tracks of the robots.
        every: their visits, newest first.
        elapsed: how much time passed between moments of the window.
    """

    def __init__(self, view: View, frame_id: str, region: Region, window: TimeWindow) -> None:
        """Finds the visits by the tracks, and confirms by poses those that are in doubt.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
        """
        self.known = known_track(view, frame_id, window)
        self.elapsed = elapsed_in(view, window)
        self._region, self._window = region, window
        # The poses that confirm a visit show where it begins, too.
        self._poses = lru_cache(2 * _MOST_TRIED)(TrackReader(view, frame_id).poses)
        by_track = [
            TrackedStay(stay.within(window), stay, track)
            for track in self.known.tracks
            for stay in self._continued(stays(track, region), track)
            if window.overlaps(stay.start, stay.stop)
        ]
        by_track.sort(key=lambda visit: visit.whole, reverse=True)
        self._looked_at = 0
        self.every = [visit for visit in map(self._confirmed, by_track) if visit is not None]
        if self._looked_at > _MOST_CONFIRMED:
            older = counted(self._looked_at - _MOST_CONFIRMED, "older visit")
            view.notes.add(
                f"{older} may be none: the robot passed at the edge of the place, known to 5 cm"
            )

    @property
    def duration(self) -> Ns:
        """How long they were in all, as the tracks have them."""
        return self.elapsed.among((visit.inside.start, visit.inside.stop) for visit in self.every)

    def ends(self, visit: TrackedStay) -> Stay:
        """Returns a visit from its first to its last pose inside, cut at the window's ends."""
        exact = self._by_poses(visit)
        return visit.inside if exact is None else exact.within(self._window)

    def shown(self, visit: TrackedStay, newest: Ns | None) -> Visit:
        """Returns a visit for the reply.

        Its times are those of poses: of the first and the last one inside, and of the closest.
        `newest` is the newest pose, if it is recent enough.
        """
        ends = self.ends(visit)
        is_there = newest is not None and ends.start <= newest <= ends.stop and not ends.left
        distance_m, at = None, None
        if isinstance(self._region, Circle):
            distance_m, at = self._closest(visit.track, ends, self._region)
        return Visit(
            arrived=ends.start,
            departed=None if is_there else ends.stop,
            duration=self.elapsed.between(ends.start, ends.stop),
            closest_m=distance_m,
            closest_at=at,
            restarts=0,
            already_inside=not ends.entered,
            still_inside=not ends.left and not is_there,
        )

    def _continued(self, visits: list[Stay], track: RobotTrack) -> list[Stay]:
        """Returns visits; those as one between which the robot's poses did not leave.

        Along the edge of a region its track may be outside where it was inside. The newest
        `_MOST_TRIED` of those where it stays near the edge are looked at.
        """
        joined_visits = visits[-1:]
        looked_at = 0
        for older in visits[-2::-1]:
            newer = joined_visits[-1]
            is_close = newer.start - older.stop < _CLOSE_NS
            if newer.entered and older.left and is_close and not self._left(older, newer, track):
                looked_at += 1
                if looked_at <= _MOST_TRIED and self._stays(older, newer):
                    joined_visits[-1] = newer._replace(start=older.start, entered=older.entered)
                    continue
            joined_visits.append(older)
        return joined_visits

    def _left(self, older: Stay, newer: Stay, track: RobotTrack) -> bool:
        """Returns whether a track is clearly outside for as long as leaving takes between visits.

        So far beyond one side of the region that no pose near it is inside.
        """
        between = slice(*np.searchsorted(track.times, (older.stop, newer.start)))
        times, x, y = track.times[between], track.x[between], track.y[between]
        low_x, high_x, low_y, high_y = self._region.bounds
        for beyond_m in (low_x - x, x - high_x, low_y - y, y - high_y):
            is_out = np.diff(beyond_m > _CLEARLY_M, prepend=False, append=False)
            begins, stops = np.flatnonzero(is_out).reshape(-1, 2).T
            if (times[stops - 1] - times[begins] >= FLICKER_NS).any():
                return True
        return False

    def _stays(self, older: Stay, newer: Stay) -> bool:
        """Returns whether poses between two visits were never outside for as long as leaving takes.

        False where there is no pose inside before or after.
        """
        first = max(older.start, older.stop - TRACK_SLICE_NS)
        last = min(newer.stop, newer.start + TRACK_SLICE_NS)
        poses = self._poses(TimeWindow(first, last + 1))
        inside = self._inside(poses)
        if not inside or inside[0] > older.stop or inside[-1] < newer.start:
            return False
        return not any(_absences(poses.times, inside))

    def _confirmed(self, visit: TrackedStay) -> TrackedStay | None:
        """Returns a visit; None where no pose in the window is inside: the line alone touches.

        Of the visits without a vertex inside the newest `_MOST_TRIED` are looked at, and as many as
        `_MOST_CONFIRMED` of those along the edge; a note says if there are more.
        """
        window, whole, track = self._window, visit.whole, visit.track
        # So near to the window's ends, poses decide on which side a visit begins, or ends.
        room = TRACK_SLICE_NS
        if window.start + room <= whole.start and whole.stop < window.stop - room:
            if self._inside(track, whole.start, whole.stop):
                return visit
            if self._looked_at >= _MOST_TRIED and self._is_clearly_inside(visit):
                return visit
            self._looked_at += 1
            if self._looked_at > _MOST_CONFIRMED:
                return visit
        exact = self._by_poses(visit)
        if exact is None or not window.overlaps(exact.start, exact.stop):
            return None
        inside = exact.within(window)
        if inside != exact and not self._inside(track, inside.start, inside.stop):
            poses = self._poses(TimeWindow(inside.start, inside.stop + 1))
            if not self._inside(poses):
                return None
        return visit._replace(
            inside=visit.inside._replace(entered=inside.entered, left=inside.left)
        )

    def _is_clearly_inside(self, visit: TrackedStay) -> bool:
        """Returns whether any pose near the track in the middle of a visit would be inside."""
        track, at = visit.track, (visit.whole.start + visit.whole.stop) // 2
        after = min(max(int(np.searchsorted(track.times, at)), 1), len(track.times) - 1)
        step = slice(after - 1, after + 1)
        since = track.times[after - 1]
        x, y = (
            float(np.interp(at - since, track.times[step] - since, axis[step]))
            for axis in (track.x, track.y)
        )
        off = (-TOLERANCE_M, TOLERANCE_M)
        return all(self._region.contains(x + dx, y + dy) for dx in off for dy in off)

    def _by_poses(self, visit: TrackedStay) -> Stay | None:
        """Returns a visit from its first to its last pose inside, where it was entered and left.

        None where no pose is inside: the robot's line alone touches the region.
        """
        whole = visit.whole
        first = self._inside_near(visit, whole.start) if whole.entered else [whole.start]
        last = self._inside_near(visit, whole.stop) if whole.left else [whole.stop]
        if not first or not last or min(first) > max(last):
            return None
        return whole._replace(start=min(first), stop=max(last))

    def _inside_near(self, visit: TrackedStay, at: Ns) -> list[Ns]:
        """Returns when poses of a visit near its begin or its end, and its vertices, are inside."""
        whole, poses = visit.whole, self._poses_around(visit.track, at)
        inside = self._inside(poses)
        absences = [*_absences(poses.times, inside)]
        # What lies beyond an absence is of the visit before, or after.
        begin = max((back for left, back in absences if left < whole.start), default=MIN_NS)
        end = min((left for left, back in absences if back > whole.stop), default=MAX_NS)
        own = (time for time in inside if begin <= time <= end)
        return [*own, *self._inside(visit.track, whole.start, whole.stop)]

    def _inside(
        self, path: Placed | RobotTrack, first: Ns = MIN_NS, last: Ns = MAX_NS - 1
    ) -> list[Ns]:
        """Returns when the robot was in the region, at the poses or vertices of a time."""
        some = slice(*np.searchsorted(path.times, (first, last + 1)))
        rows = zip(
            path.times[some].tolist(), path.x[some].tolist(), path.y[some].tolist(), strict=True
        )
        return [time for time, *place in rows if self._region.contains(*place)]

    def _poses_around(self, track: RobotTrack, at: Ns) -> Placed:
        """Returns the poses between the vertices before and after a time, these included."""
        times = track.times
        before = max(int(np.searchsorted(times, at, side="left")) - 1, 0)
        after = min(int(np.searchsorted(times, at, side="right")), len(times) - 1)
        return self._poses(TimeWindow(int(times[before]), int(times[after]) + 1))

    def _closest(self, track: RobotTrack, stay: Stay, circle: Circle) -> tuple[float, Ns]:
        """Returns how near (m) a pose of a visit was to the middle of a circle, and when."""
        inner = track.times[(track.times > stay.start) & (track.times < stay.stop)]
        inner = np.concatenate(([stay.start], inner, [stay.stop]))
        x, y, _ = track.at(inner)
        along, off = Steps(x[:-1], y[:-1], x[1:], y[1:]).nearest_to(circle.x, circle.y)
        nearest = int(off.argmin())
        lasted = int(inner[nearest + 1] - inner[nearest])
        at = int(inner[nearest]) + round(float(along[nearest]) * lasted)
        poses = self._poses_around(track, at)
        away_m = np.hypot(poses.x - circle.x, poses.y - circle.y)
        near = (poses.times >= stay.start) & (poses.times <= stay.stop)
        approaches = zip(away_m[near].tolist(), poses.times[near].tolist(), strict=True)
        return min(approaches, default=(float(min(off[nearest], circle.radius_m)), at))


def _absences(times: Times, inside: Sequence[Ns]) -> Iterator[Span]:
    """Yields the last pose inside, and the next one, around each absence as long as leaving takes.

    On a straight way from one part of a region to another one there are poses of both.
    """
    for left, back in pairwise(inside):
        if back - left >= FLICKER_NS and ((times > left) & (times < back)).any():
            yield left, back


def place_visits(region_visits: ConfirmedStays, name: str) -> PlaceVisits:
    """Returns how often, and for how long, the robot was in a place."""
    entries = [visit for visit in region_visits.every if visit.inside.entered]
    exits = [visit for visit in region_visits.every if visit.inside.left]
    return PlaceVisits(
        place=name,
        entries=len(entries),
        exits=len(exits),
        duration=region_visits.duration,
        first=region_visits.ends(entries[-1]).start if entries else None,
        last=region_visits.ends(max(exits, key=lambda visit: visit.inside.stop)).stop
        if exits
        else None,
    )

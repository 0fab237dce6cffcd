"""Visits to a place: arrival, departure and closest approach, newest first.

A visit lasts as long as poses are inside the place. It ends when the robot is outside for
`FLICKER_NS`, or when there is no pose for `SILENCE_NS`. The robot's track, which is within 5 cm of
every pose, shows the visits. Those that are shown, and those along the edge of the place, are then
checked by the poses. A reset of odometry moves its coordinates: visits from before are marked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from itertools import chain, pairwise, product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import FLICKER_NS
from ros2_memory.analysis.motion.robot_track import (
    TOLERANCE_M,
    TOLERANCE_OF_HEIGHT_M,
    TRACK_SLICE_NS,
    RobotTrack,
    place_at,
)
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, QueryTimeoutError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Circle, Region, Steps, contains, plan_of
from ros2_memory.core.spans import Spans, overlaps_any, united
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, NS_PER_S, Ns, Span, ns_from_unix
from ros2_memory.history.coverage import note_unread, unix_text, unknown_times
from ros2_memory.history.driven_path import driven_path, resolve_path_topic
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import ANY_TIME, TimeRange, View, clamped, open_search
from ros2_memory.places.pose_frames import (
    NEWEST_POSE_NS,
    WHEREABOUTS,
    MapPlacement,
    known_track,
    map_placement,
    note_overlaps,
    placed_times,
    places_in,
)
from ros2_memory.places.robot_tracks import Placed, TrackReader
from ros2_memory.places.stays import Stay, stays
from ros2_memory.places.where import Scope, Where, note_other_frame, parse_where, places_setting
from ros2_memory.results import PlaceVisits, Visit, Visits

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.conditions import Sought
    from ros2_memory.history.context import Call, Memory, QuerySettings

_CURRENT_SPLITS: Final = 3
"""A pose no older than so many splits is current: the server reads a split once it is closed."""
_CLOSE_NS: Final = 60 * NS_PER_S
"""Two visits farther apart are never joined."""
_MOST_TRIED: Final = 50
"""How many doubtful joins, and doubtful visits without a vertex inside, are checked by poses."""
_MOST_CONFIRMED: Final = 1000
"""How many visits along the edge of a region are checked by poses: each takes a millisecond."""
_CLEARLY_M: Final = 5 * TOLERANCE_M
"""If a vertex is so far (m) beyond one side of a region, no pose near it is inside."""


def visits(
    memory: Memory,
    call: Call,
    x: float | None = None,
    y: float | None = None,
    *,
    where: JsonValue = None,
    frame_id: str | None = None,
    radius_m: float | None = None,
    span: TimeRange = ANY_TIME,
    limit: int = 10,
    during: Sequence[Sought] = (),
) -> Visits:
    """Returns the visits to a place, newest first; without a place, a summary for each named one.

    The place is a circle around `x` and `y` (m), or `where`. Coordinates are in `frame_id`: the map
    (the default) or the frame of the poses. `span` bounds the search. With `during` visits count
    as in `ConfirmedStays`, and none has `there_now`.

    Raises:
        InvalidArgumentsError: the pose topic carries no position, the place is invalid, the frame
            is another one, the bounds are reversed, or nothing can meet a condition.
        NoDataError: nothing is recorded, no poses, or no topic of a condition.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place = asked_place(memory.limits, (x, y), radius_m, where, frame_id)
    view, now, window = open_search(memory, call, span)
    require_recorded(view, window)
    topic = resolve_path_topic(view)
    mixed = note_robots(view, topic, window, places=True)
    placement = map_placement(view, topic, frame_id if place is None else place.frame_id)
    scope = Scope(view, clamped(view, window), during=during)
    if place is None:
        return _visits_of_places(view, window, placement, mixed, scope, now=now)
    confirmed = ConfirmedStays(view, placement.frame_id, place.region, window, scope)
    newest = _newest_pose_time(view, topic, confirmed.known.track, window, now + FUTURE_NS)
    is_current = newest is not None and newest >= _oldest_current(view, now)
    shown = tuple(
        _at_asked_bounds(confirmed.shown(visit, newest if is_current else None), window)
        for visit in confirmed.visits[:limit]
    )
    if not placement.is_map:
        shown = _with_restarts(view, topic, shown, now)
    if not confirmed.visits and not during:
        advice = f'ask with frame_id "{placement.pose_frame}"'
        note_other_frame(view, place, placement, window, advice)
    view.notes.retract_outside(window)
    _note_shown(view, window, shown, newest)
    circle = place.region if isinstance(place.region, Circle) and place.name is None else None
    return Visits(
        frame_id=placement.frame_id,
        circle=circle,
        visits=shown,
        more=len(confirmed.visits) > len(shown),
        total=len(confirmed.visits),
        now=now,
        duration=confirmed.duration,
        entries=len(confirmed.entries),
        exits=len(confirmed.exits),
        all_counted=confirmed.known.since is None,
        where=place.name,
        unknown=_unknown(view, window, [confirmed.known.track], mixed, scope),
        is_current=is_current and not during,
        notes=view.notes.sentences(),
    )


def _oldest_current(view: View, now: Ns) -> Ns:
    """Returns the log time from which on a pose shows where the robot is now.

    If the newest messages have no pose beside them, the robot may have moved meanwhile.
    """
    by_splits = now - _CURRENT_SPLITS * ns_from_unix(view.limits.split_duration_s)
    newest = min(view.snapshot.latest or MIN_NS, now)
    return max(by_splits, newest - NEWEST_POSE_NS)


def _visits_of_places(
    view: View, window: TimeWindow, placement: MapPlacement, mixed: Spans, scope: Scope, *, now: Ns
) -> Visits:
    """Returns how often and how long the robot was in each named place, the longest first."""
    settled = scope.settled()
    stays_of_places = [
        (place, ConfirmedStays(view, place.frame_id, place.region, window, settled))
        for place, _ in places_in(view, view.limits.places, placement, window)
    ]
    rows = (confirmed.summary(place.name) for place, confirmed in stays_of_places)
    places = tuple(sorted(rows, key=lambda row: (-row.duration, row.place)))
    tracks = {place.frame_id: confirmed.known.track for place, confirmed in stays_of_places}
    note_overlaps(view, [confirmed.of_first_robot for _, confirmed in stays_of_places])
    was_in_one = any(row.duration for row in places)
    note_unread(view, window, nothing=not was_in_one, gaps=not was_in_one)
    return Visits(
        frame_id=placement.frame_id,
        total=sum(row.entries for row in places),
        now=now,
        places=places,
        unknown=_unknown(view, window, tracks.values(), mixed, scope),
        notes=view.notes.sentences(),
    )


def _note_shown(view: View, window: TimeWindow, shown: Sequence[Visit], newest: Ns | None) -> None:
    """Notes what the visits shown leave open; `newest` is the log time of the newest pose."""
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
    frame_id: str | None,
) -> Where | None:
    """Returns the place that the arguments of a tool name; None for all named places.

    Args:
        limits: the settings, which have the named places.
        point: the middle x and y (m) of a circle, if they are given.
        radius_m: the radius of a circle; None for the position tolerance.
        where: the argument `where`, if it is given.
        frame_id: the frame of a place that names none; None for the map.

    Raises:
        InvalidArgumentsError: the arguments are invalid, name two places, or name none although no
            place has a name.
    """
    radius = limits.position_tolerance_m if radius_m is None else radius_m
    if not (radius > 0 and math.isfinite(radius)):
        raise InvalidArgumentsError(f"radius_m must be more than 0, and was {radius_m}")
    x, y = point
    if where is not None:
        if point != (None, None):
            raise InvalidArgumentsError("give either where or x and y")
        place = parse_where(limits, where, radius)
        return place if place.frame_id is not None else replace(place, frame_id=frame_id)
    if x is not None and y is not None:
        return Where(Circle(x, y, radius), frame_id)
    if point != (None, None):
        raise InvalidArgumentsError("x and y must both be given, or neither")
    if not limits.places:
        raise InvalidArgumentsError(
            f"no place is named in {places_setting(limits)}: give x and y, or where"
        )
    return None


def _unknown(
    view: View, window: TimeWindow, tracks: Iterable[RobotTrack], mixed: Spans, scope: Scope
) -> Ns:
    """Returns how long (ns) some track, of those in different frames, or the scope is not known."""
    spans = (
        unknown_times(view, window, placed_times(track, mixed), WHEREABOUTS, mixed=mixed)
        for track in tracks
    )
    return view.elapsed_in(window).among(united(chain(scope.unknown, *spans)))


def _newest_pose_time(
    view: View, topic: str, track: RobotTrack, window: TimeWindow, last: Ns
) -> Ns | None:
    """Returns the log time of the track's newest vertex, which is the newest pose until `last`.

    None if the window ends before that pose, or if there is none.
    """
    message = view.stream.last(topic, last + 1)
    if message is None or window.stop <= message.time:
        return None
    times = track.times[track.times <= last]
    return int(times[-1]) if times.size else None


def _at_asked_bounds(visit: Visit, window: TimeWindow) -> Visit:
    """Returns the visit; if the window cuts it, it is cut at the bounds that the client gave.

    The window itself has some tolerance beyond them.
    """
    start, end = window.asked()
    if visit.arrived == window.start:
        visit = replace(visit, arrived=start)
    return replace(visit, departed=end) if visit.departed == window.stop - 1 else visit


def _with_restarts(view: View, topic: str, shown: tuple[Visit, ...], now: Ns) -> tuple[Visit, ...]:
    """Returns visits, newest first, with the number of odometry resets since each.

    If time runs out, none is counted, and a note says so.
    """
    if not shown:
        return shown
    try:
        path, _ = driven_path(view, topic, TimeWindow(shown[-1].arrived or MIN_NS, MAX_NS))
    except (InvalidArgumentsError, NoDataError):
        # Poses that cannot be read say nothing about resets.
        return shown
    except QueryTimeoutError:
        view.notes.add_lack("there was no time to check whether odometry restarted since")
        return shown
    resets = () if path is None else path.totals.resets
    return tuple(
        replace(visit, restarts=sum(reset > (visit.departed or now) for reset in resets))
        for visit in shown
    )


class TrackedStay(NamedTuple):
    """A visit to a region, as a track has it.

    Attributes:
        inside: the part of the visit in the window.
        whole: the whole visit.
        track: the robot's track.
        parts: the parts of `inside` that count; both ends are inclusive.
    """

    inside: Stay
    whole: Stay
    track: RobotTrack
    parts: Sequence[Span]

    def counted_in(self, scope: Scope) -> TrackedStay:
        """Returns the visit with the parts that lie in a scope, and its ends if they do."""
        inside = self.inside
        return self._replace(
            inside=inside._replace(
                entered=inside.entered and scope.holds_at(inside.start),
                left=inside.left and scope.holds_at(inside.stop),
            ),
            parts=scope.parts_of(*inside.span),
        )


class ConfirmedStays:
    """The visits to a region of a frame that overlap a window, and some time of a scope.

    Tracks show them. Those that are in doubt are confirmed by poses. Of a visit only the time in
    the scope counts, and its entry and its exit if they are in it.

    Attributes:
        known: the tracks of the robots.
        visits: the visits of all robots, newest first.
        elapsed: how much time passed between log times of the window.
    """

    def __init__(
        self, view: View, frame_id: str, region: Region, window: TimeWindow, scope: Scope
    ) -> None:
        """Finds the visits.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
        """
        self.known = known_track(view, frame_id, window)
        self.elapsed = view.elapsed_in(window)
        self._region, self._window, self._scope = region, window, scope
        self._misdated = united(fault.span for fault in view.snapshot.misdated)
        # A shown visit begins at one of the poses by which it was confirmed.
        self._poses = lru_cache(2 * _MOST_TRIED)(TrackReader(view, frame_id).poses)
        by_track = [
            TrackedStay(stay.within(window), stay, track, ())
            for track in self.known.tracks
            for stay in self._without_false_exits(stays(track, region), track)
            if window.overlaps(stay.start, stay.stop)
        ]
        by_track.sort(key=lambda visit: visit.whole, reverse=True)
        self._looked_at = 0
        confirmed = map(self._confirmed, by_track)
        in_scope = (visit.counted_in(scope) for visit in confirmed if visit is not None)
        self.visits = [visit for visit in in_scope if visit.parts]
        if self._looked_at > _MOST_CONFIRMED:
            older = counted(self._looked_at - _MOST_CONFIRMED, "older visit")
            view.notes.add(
                f"{older} may be none: the robot passed at the edge of the place, known to 5 cm"
            )

    @property
    def entries(self) -> list[TrackedStay]:
        """The visits in whose beginning the robot came from outside."""
        return [visit for visit in self.visits if visit.inside.entered]

    @property
    def exits(self) -> list[TrackedStay]:
        """The visits at whose end the robot went outside."""
        return [visit for visit in self.visits if visit.inside.left]

    @property
    def duration(self) -> Ns:
        """How long (ns) all visits lasted together, by the tracks."""
        return self.elapsed.among(part for visit in self.visits for part in visit.parts)

    @property
    def of_first_robot(self) -> Spans:
        """When the robot was inside; of several at one time, the one of `known.track`."""
        own = [visit.inside for visit in self.visits if visit.track is self.known.track]
        return united((stay.start, stay.stop) for stay in own)

    def summary(self, name: str) -> PlaceVisits:
        """Returns how often and how long the robot was in the region, which has this name."""
        entries, exits = self.entries, self.exits
        first = last = None
        if entries:
            first = self._between_poses(self._dated(entries)[-1]).start
        if exits:
            newest = max(self._dated(exits), key=lambda visit: visit.inside.stop)
            last = self._between_poses(newest).stop
        return PlaceVisits(name, len(entries), len(exits), self.duration, first, last)

    def _dated(self, visits: Sequence[TrackedStay]) -> Sequence[TrackedStay]:
        """Returns the visits that no wrong clock dated; all if it dated all."""
        dated = [each for each in visits if not overlaps_any(self._misdated, *each.inside.span)]
        return dated or visits

    def shown(self, visit: TrackedStay, newest: Ns | None) -> Visit:
        """Returns a visit as the reply shows it.

        Its times are log times of poses: the first and the last inside, and the closest to the
        middle. `newest` is the log time of the robot's newest pose, or None if that is too old.
        """
        stay, scope = self._between_poses(visit), self._scope
        is_there = newest is not None and stay.start <= newest <= stay.stop and not stay.left
        closest_m, closest_at = None, None
        if isinstance(plan := plan_of(self._region), Circle):
            closest_m, closest_at = self._closest(visit.track, stay, plan)
        return Visit(
            arrived=stay.start,
            departed=None if is_there else stay.stop,
            duration=self.elapsed.among(scope.parts_of(*stay.span)),
            closest_m=closest_m,
            closest_at=closest_at,
            restarts=0,
            already_inside=not stay.entered,
            still_inside=not stay.left and not is_there,
        )

    def _between_poses(self, visit: TrackedStay) -> Stay:
        """Returns a visit from its first to its last pose inside, cut at the window's ends."""
        exact = self._by_poses(visit)
        return visit.inside if exact is None else exact.within(self._window)

    def _without_false_exits(self, visits: list[Stay], track: RobotTrack) -> list[Stay]:
        """Returns visits, newest first, joined where the poses between them did not leave.

        Along the edge of a region the track may be outside while poses are inside. At most
        `_MOST_TRIED` such times, the newest, are looked at.
        """
        joined_visits = visits[-1:]
        looked_at = 0
        for older in visits[-2::-1]:
            newer = joined_visits[-1]
            is_close = newer.start - older.stop < _CLOSE_NS
            if (
                is_close
                and newer.entered
                and older.left
                and not self._is_clearly_outside(track, older.stop, newer.start)
            ):
                looked_at += 1
                if looked_at <= _MOST_TRIED and self._poses_stay(older, newer):
                    joined_visits[-1] = newer._replace(start=older.start, entered=older.entered)
                    continue
            joined_visits.append(older)
        return joined_visits

    def _is_clearly_outside(self, track: RobotTrack, start: Ns, stop: Ns) -> bool:
        """Returns whether a track is clearly outside for `FLICKER_NS` between two log times.

        It is if its vertices are `_CLEARLY_M` beyond one side of the region.
        """
        between = slice(*np.searchsorted(track.times, (start, stop)))
        times, x, y = track.times[between], track.x[between], track.y[between]
        low_x, high_x, low_y, high_y = self._region.bounds
        for beyond_m in (low_x - x, x - high_x, low_y - y, y - high_y):
            is_out = np.diff(beyond_m > _CLEARLY_M, prepend=False, append=False)
            begins, stops = np.flatnonzero(is_out).reshape(-1, 2).T
            if (times[stops - 1] - times[begins] >= FLICKER_NS).any():
                return True
        return False

    def _poses_stay(self, older: Stay, newer: Stay) -> bool:
        """Returns whether poses between two visits were never outside for `FLICKER_NS`.

        False if there is no pose inside at the end of the older or the begin of the newer one.
        """
        first = max(older.start, older.stop - TRACK_SLICE_NS)
        last = min(newer.stop, newer.start + TRACK_SLICE_NS)
        poses = self._poses(TimeWindow(first, last + 1))
        inside = self._times_inside(poses)
        if not inside or inside[0] > older.stop or inside[-1] < newer.start:
            return False
        return not any(_absences(poses.times, inside))

    def _confirmed(self, visit: TrackedStay) -> TrackedStay | None:
        """Returns a visit; None if no pose in the window is inside, but only the line of the track.

        Poses are looked up if the visit is near an end of the window, or has no vertex inside. Of
        the latter, those beyond the newest `_MOST_TRIED` need no poses if they are clearly inside,
        and those beyond `_MOST_CONFIRMED` are taken as they are.
        """
        window, whole, track = self._window, visit.whole, visit.track
        # Near an end of the window, poses decide on which side of it a visit begins or ends.
        near_end = TRACK_SLICE_NS
        if window.start + near_end <= whole.start and whole.stop < window.stop - near_end:
            if self._times_inside(track, whole.start, whole.stop):
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
        if inside != exact and not self._times_inside(track, inside.start, inside.stop):
            poses = self._poses(TimeWindow(inside.start, inside.stop + 1))
            if not self._times_inside(poses):
                return None
        return visit._replace(
            inside=visit.inside._replace(entered=inside.entered, left=inside.left)
        )

    def _is_clearly_inside(self, visit: TrackedStay) -> bool:
        """Returns whether all poses near the track in the middle of a visit must be inside."""
        middle = place_at(visit.track, (visit.whole.start + visit.whole.stop) // 2)
        if middle is None:
            return False
        x, y, z = middle
        off, off_z = (-TOLERANCE_M, TOLERANCE_M), (-TOLERANCE_OF_HEIGHT_M, TOLERANCE_OF_HEIGHT_M)
        corners = product(off, off, off_z)
        return all(contains(self._region, x + dx, y + dy, z + dz) for dx, dy, dz in corners)

    def _by_poses(self, visit: TrackedStay) -> Stay | None:
        """Returns a whole visit from its first to its last pose inside.

        An end at which the robot did not enter or leave stays as it is. None if no pose is inside.
        """
        whole = visit.whole
        first = self._times_near(visit, whole.start) if whole.entered else [whole.start]
        last = self._times_near(visit, whole.stop) if whole.left else [whole.stop]
        if not first or not last or min(first) > max(last):
            return None
        return whole._replace(start=min(first), stop=max(last))

    def _times_near(self, visit: TrackedStay, end: Ns) -> list[Ns]:
        """Returns the log times of a visit's poses inside near one of its ends, and vertices."""
        whole, poses = visit.whole, self._poses_around(visit.track, end)
        inside = self._times_inside(poses)
        absences = [*_absences(poses.times, inside)]
        # Poses on the far side of an absence belong to another visit.
        first = max((back for left, back in absences if left < whole.start), default=MIN_NS)
        last = min((left for left, back in absences if back > whole.stop), default=MAX_NS)
        own = (time for time in inside if first <= time <= last)
        return [*own, *self._times_inside(visit.track, whole.start, whole.stop)]

    def _times_inside(
        self, path: Placed | RobotTrack, first: Ns = MIN_NS, last: Ns = MAX_NS - 1
    ) -> list[Ns]:
        """Returns the log times, from `first` to `last`, of poses or vertices in the region."""
        rows = slice(*np.searchsorted(path.times, (first, last + 1)))
        columns = (path.times[rows], path.x[rows], path.y[rows], path.z[rows])
        points = zip(*(column.tolist() for column in columns), strict=True)
        return [time for time, *point in points if contains(self._region, *point)]

    def _poses_around(self, track: RobotTrack, at: Ns) -> Placed:
        """Returns the poses from the vertex before a log time to the vertex after it."""
        times = track.times
        before = max(int(np.searchsorted(times, at, side="left")) - 1, 0)
        after = min(int(np.searchsorted(times, at, side="right")), len(times) - 1)
        return self._poses(TimeWindow(int(times[before]), int(times[after]) + 1))

    def _closest(self, track: RobotTrack, stay: Stay, circle: Circle) -> tuple[float, Ns]:
        """Returns how near (m) a pose of a visit was to the middle of a circle, and when.

        The track shows around which time to look for that pose.
        """
        inner = track.times[(track.times > stay.start) & (track.times < stay.stop)]
        times = np.concatenate(([stay.start], inner, [stay.stop]))
        points = track.at(times)[:3]
        steps = Steps(*(axis[:-1] for axis in points), *(axis[1:] for axis in points))
        along, away_m = steps.nearest_to(circle.x, circle.y)
        nearest = int(away_m.argmin())
        lasted = int(times[nearest + 1] - times[nearest])
        at = int(times[nearest]) + round(float(along[nearest]) * lasted)
        poses = self._poses_around(track, at)
        pose_away_m = np.hypot(poses.x - circle.x, poses.y - circle.y)
        is_of_visit = (poses.times >= stay.start) & (poses.times <= stay.stop)
        approaches = zip(
            pose_away_m[is_of_visit].tolist(), poses.times[is_of_visit].tolist(), strict=True
        )
        return min(approaches, default=(float(min(away_m[nearest], circle.radius_m)), at))


def _absences(times: Ints, inside: Sequence[Ns]) -> Iterator[Span]:
    """Yields the last pose inside before, and the first after, each absence of `FLICKER_NS`.

    An absence has poses (their log times are `times`) outside. A pause without poses is none.
    """
    for left, back in pairwise(inside):
        if back - left >= FLICKER_NS and ((times > left) & (times < back)).any():
            yield left, back

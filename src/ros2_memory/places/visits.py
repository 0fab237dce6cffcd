"""Visits to a place: arrival, departure and closest approach, newest first.

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
from ros2_memory.analysis.motion.robot_track import TRACK_SLICE_NS, RobotTrack
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, QueryTimeoutError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Circle, Region
from ros2_memory.core.spans import Spans, united
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, NS_PER_S, Ns, ns_from_unix
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_unread, unix_text, unknown_times
from ros2_memory.history.driven_path import driven_path, resolve_path_topic
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import TimeRange, View, open_view, search_window
from ros2_memory.places.pose_frames import (
    NEWEST_POSE_NS,
    WHEREABOUTS,
    joined_in,
    map_placement,
    placed_times,
    places_in,
)
from ros2_memory.places.robot_tracks import Inside, RobotTracks, times_inside
from ros2_memory.places.where import Where, note_other_frame, parse_where, places_setting
from ros2_memory.results import PlaceVisits, Visit, Visits

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.frames import Floats, Times
    from ros2_memory.history.context import Call, Memory, QuerySettings

_SPLITS: Final = 3
"""A pose no older than so many splits is current: a split answers only when it is closed."""
_CLOSE_NS: Final[Ns] = 60 * NS_PER_S
_MOST_TRIED: Final = 50


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
    # A newer pose shows where the robot is now; or what else was recorded since, that none does.
    stale = now - _SPLITS * ns_from_unix(view.limits.split_duration_s)
    stale = max(stale, min(view.snapshot.latest or MIN_NS, now) - NEWEST_POSE_NS)
    current = newest if newest is not None and newest >= stale else None
    shown = tuple(_within_asked(found.shown(each, current), window) for each in every[:limit])
    if not placement.is_map:
        shown = _with_restarts(view, topic, shown, now)
    if not every and asked is None:
        ask = f'ask with frame_id "{placement.pose_frame}"'
        note_other_frame(view, place, placement, window, ask)
    view.notes.retract_outside(window)
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
        replace(each, restarts=sum(reset > (each.departed or now) for reset in resets))
        for each in shown
    )


class RegionVisit(NamedTuple):
    """A visit to a region by a track.

    Attributes:
        inside: the part in the window, as long as the track has it.
        whole: the visit, not cut.
        track: of the robot.
    """

    inside: Inside
    whole: Inside
    track: RobotTrack


class RegionVisits:
    """The visits to a region of a frame that reach into a window.

    Attributes:
        joined: the tracks of the robots.
        every: their visits, newest first.
        elapsed: how much time passed between moments of the window.
    """

    def __init__(self, view: View, frame_id: str, region: Region, window: TimeWindow) -> None:
        """Finds them.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
        """
        self.joined = joined_in(view, frame_id, window)
        self.elapsed = elapsed_in(view, window)
        self._region, self._window = region, window
        # What shows that a visit is one shows where it begins, too.
        self._poses = lru_cache(2 * _MOST_TRIED)(RobotTracks(view, frame_id).poses)
        found = [
            RegionVisit(one.within(window), one, track)
            for track in self.joined.tracks
            for one in self._continued(times_inside(track, region))
            if window.overlaps(one.start, one.stop)
        ]
        found.sort(key=lambda visit: visit.whole, reverse=True)
        self._looked_at = 0
        self.every = [each for each in map(self._seen, found) if each is not None]

    @property
    def duration(self) -> Ns:
        """How long they were in all, as the tracks have them."""
        return self.elapsed.among((each.inside.start, each.inside.stop) for each in self.every)

    def ends(self, visit: RegionVisit) -> Inside:
        """Returns a visit from its first to its last pose inside, cut at the window's ends."""
        exact = self._by_poses(visit)
        return visit.inside if exact is None else exact.within(self._window)

    def shown(self, visit: RegionVisit, newest: Ns | None) -> Visit:
        """Returns a visit for the reply.

        Its times are those of poses: of the first and the last one inside, and of the closest.
        `newest` is the newest pose, if it is recent enough.
        """
        one = self.ends(visit)
        is_there = newest is not None and one.start <= newest <= one.stop and not one.left
        distance_m, at = None, None
        if isinstance(self._region, Circle):
            distance_m, at = self._closest(visit.track, one, self._region)
        return Visit(
            arrived=one.start,
            departed=None if is_there else one.stop,
            duration=self.elapsed.between(one.start, one.stop),
            closest_m=distance_m,
            closest_at=at,
            restarts=0,
            already_inside=not one.entered,
            still_inside=not one.left and not is_there,
        )

    def _continued(self, visits: list[Inside]) -> list[Inside]:
        """Returns visits; those as one between which the robot's poses did not leave.

        Along the edge of a region its track may be outside where it was inside. The newest
        `_MOST_TRIED` of such visits are looked at.
        """
        found = visits[-1:]
        looked_at = 0
        for older in visits[-2::-1]:
            newer = found[-1]
            if newer.entered and older.left and newer.start - older.stop < _CLOSE_NS:
                looked_at += 1
                if looked_at <= _MOST_TRIED and self._stays(older, newer):
                    found[-1] = newer._replace(start=older.start, entered=older.entered)
                    continue
            found.append(older)
        return found

    def _stays(self, older: Inside, newer: Inside) -> bool:
        """Returns whether poses between two visits were never outside for as long as leaving takes.

        False where there is no pose inside before or after.
        """
        first = max(older.start, older.stop - TRACK_SLICE_NS)
        last = min(newer.stop, newer.start + TRACK_SLICE_NS)
        poses = self._poses(TimeWindow(first, last + 1))
        inside = [*self._inside(*poses[:3])]
        if not inside or inside[0] > older.stop or inside[-1] < newer.start:
            return False
        return not any(_absences(poses.times, inside))

    def _seen(self, visit: RegionVisit) -> RegionVisit | None:
        """Returns a visit; None where no pose in the window is inside: the line alone touches.

        The newest `_MOST_TRIED` visits without a vertex inside are looked at.
        """
        window, whole, track = self._window, visit.whole, visit.track
        # So near to the window's ends, poses decide on which side a visit begins, or ends.
        room = TRACK_SLICE_NS
        if window.start + room <= whole.start and whole.stop < window.stop - room:
            self._looked_at += not (has_vertex := any(True for _ in self._vertices(track, whole)))
            if has_vertex or self._looked_at > _MOST_TRIED:
                return visit
        exact = self._by_poses(visit)
        if exact is None or not window.overlaps(exact.start, exact.stop):
            return None
        cut = exact.within(window)
        if cut != exact and not any(True for _ in self._vertices(track, cut)):
            poses = self._poses(TimeWindow(cut.start, cut.stop + 1))
            if not any(True for _ in self._inside(*poses[:3])):
                return None
        inside = visit.inside._replace(entered=cut.entered, left=cut.left)
        return visit._replace(inside=inside)

    def _by_poses(self, visit: RegionVisit) -> Inside | None:
        """Returns a visit from its first to its last pose inside, where it was entered and left.

        None where no pose is inside: the robot's line alone touches the region.
        """
        one = visit.whole
        within = [*self._vertices(visit.track, one)]
        start, stop = one.start, one.stop
        if one.entered:
            poses = self._poses_around(visit.track, one.start)
            inside = [time for time in self._inside(*poses) if time <= one.stop]
            others = [back for left, back in _absences(poses[0], inside) if left < one.start]
            inside = [time for time in inside if time >= max(others, default=MIN_NS)]
            start = min((*inside[:1], *within[:1]), default=MAX_NS)
        if one.left:
            poses = self._poses_around(visit.track, one.stop)
            inside = [time for time in self._inside(*poses) if time >= one.start]
            others = [left for left, back in _absences(poses[0], inside) if back > one.stop]
            inside = [time for time in inside if time <= min(others, default=MAX_NS)]
            stop = max((*inside[-1:], *within[-1:]), default=MIN_NS)
        return one._replace(start=start, stop=stop) if start <= stop else None

    def _inside(self, times: Times, x: Floats, y: Floats) -> Iterator[Ns]:
        """Yields those of some times at which the robot was in the region."""
        rows = zip(times.tolist(), x.tolist(), y.tolist(), strict=True)
        return (time for time, *place in rows if self._region.contains(*place))

    def _vertices(self, track: RobotTrack, one: Inside) -> Iterator[Ns]:
        """Yields the times of a visit's vertices that are inside."""
        first = int(np.searchsorted(track.times, one.start, side="left"))
        last = int(np.searchsorted(track.times, one.stop, side="right"))
        visit = slice(first, last)
        return self._inside(track.times[visit], track.x[visit], track.y[visit])

    def _poses_around(self, track: RobotTrack, at: Ns) -> tuple[Times, Floats, Floats]:
        """Returns the poses between the vertices before and after a time, these included."""
        times = track.times
        before = max(int(np.searchsorted(times, at, side="left")) - 1, 0)
        after = min(int(np.searchsorted(times, at, side="right")), len(times) - 1)
        return self._poses(TimeWindow(int(times[before]), int(times[after]) + 1))[:3]

    def _closest(self, track: RobotTrack, one: Inside, circle: Circle) -> tuple[float, Ns]:
        """Returns how near (m) a pose of a visit was to the middle of a circle, and when."""
        first = max(int(np.searchsorted(track.times, one.start, side="right")) - 1, 0)
        last = int(np.searchsorted(track.times, one.stop, side="left"))
        times = track.times[first : last + 1]
        inner = np.concatenate(([one.start], times, [one.stop])).clip(one.start, one.stop)
        since = times[0]
        x, y = (
            np.interp(inner - since, times - since, column[first : last + 1])
            for column in (track.x, track.y)
        )
        dx, dy = np.diff(x), np.diff(y)
        size = dx * dx + dy * dy
        along = (circle.x - x[:-1]) * dx + (circle.y - y[:-1]) * dy
        along = (along / np.where(size > 0, size, 1.0)).clip(0.0, 1.0)
        off = np.hypot(x[:-1] + along * dx - circle.x, y[:-1] + along * dy - circle.y)
        nearest = int(off.argmin())
        lasted = int(inner[nearest + 1] - inner[nearest])
        at = int(inner[nearest] + round(float(along[nearest]) * lasted))
        times, x, y = self._poses_around(track, at)
        away_m = np.hypot(x - circle.x, y - circle.y)
        near = (times >= one.start) & (times <= one.stop)
        poses = zip(away_m[near].tolist(), times[near].tolist(), strict=True)
        return min(poses, default=(float(min(off[nearest], circle.radius_m)), at))


def _absences(times: Times, inside: Sequence[Ns]) -> Iterator[tuple[Ns, Ns]]:
    """Yields the last pose inside, and the next one, around each absence as long as leaving takes.

    On a straight way from one part of a region to another one there are poses of both.
    """
    for left, back in pairwise(inside):
        between = (times > left) & (times < back)
        if back - left >= FLICKER_NS and between.any():
            yield left, back


def place_visits(found: RegionVisits, name: str) -> PlaceVisits:
    """Returns how often, and for how long, the robot was in a place."""
    entries = [each for each in found.every if each.inside.entered]
    exits = [each for each in found.every if each.inside.left]
    return PlaceVisits(
        place=name,
        entries=len(entries),
        exits=len(exits),
        duration=found.duration,
        first=found.ends(entries[-1]).start if entries else None,
        last=found.ends(max(exits, key=lambda each: each.inside.stop)).stop if exits else None,
    )

"""Visits to regions by the robot's track: in a map that moves, and of any shape.

All visits are found by the track, from which no pose is farther than some 5 cm; those that are
shown begin and end at poses.
"""

from __future__ import annotations

from contextlib import suppress
from heapq import merge
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import FLICKER_NS
from ros2_memory.analysis.motion.robot_track import TRACK_SLICE_NS, RobotTrack
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, Region
from ros2_memory.core.spans import Spans, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.places.pose_frames import MapPlacement, map_placement, note_runs
from ros2_memory.places.robot_tracks import Inside, JoinedTrack, RobotTracks, times_inside
from ros2_memory.results import PlaceVisits, Visit

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.frames import Floats, Times
    from ros2_memory.history.view import View


WHEREABOUTS: Final = "where the robot was"
"""What is not known without poses, for sentences."""
_CLOSE_NS: Final[Ns] = 60 * NS_PER_S
_MOST_TRIED: Final = 50


def joined_in(view: View, frame_id: str, window: TimeWindow) -> JoinedTrack:
    """Returns the robot's track in a window; a note says how far back it reaches, if not all.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    joined = RobotTracks(view, frame_id).over(window)
    note_runs(view, resolve_path_topic(view), frame_id, window)
    if joined.since is not None:
        view.notes.add_lack(
            f"visits are known back to {unix_text(joined.since)}: out of time before older "
            "poses were placed"
        )
    if joined.left_out:
        view.notes.add(f"poses that no transform places in {frame_id} are left out")
    return joined


def placed_times(track: RobotTrack, mixed: Spans) -> Spans:
    """Returns when it is known where the robot was: not at `mixed` times, which several have."""
    starts, stops = track.pieces
    return without(zip(starts.tolist(), (stops + 1).tolist(), strict=True), mixed)


def tracks_made(view: View, window: TimeWindow) -> Iterator[Ns]:
    """Makes what the parts in a window say of where the robot was in the frames of places.

    Yields a log time (ns) of each, the newest first.
    """
    with suppress(InvalidArgumentsError, NoDataError):
        topic = resolve_path_topic(view)
        frames = map_placement(view, topic).frames
        yield from merge(*(RobotTracks(view, one).made(window) for one in frames), reverse=True)


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
        self._tracks = RobotTracks(view, frame_id)
        found = [
            RegionVisit(one.within(window), one, track)
            for track in self.joined.tracks
            for one in _joined_visits(self._tracks, times_inside(track, region), region)
            if window.overlaps(one.start, one.stop)
        ]
        found.sort(key=lambda visit: visit.whole, reverse=True)
        self._looked_at = 0
        self.every = [each for each in map(self._seen, found) if each is not None]

    @property
    def duration(self) -> Ns:
        """How long they were in all, as the tracks have them."""
        return self.elapsed.among((each.inside.start, each.inside.stop) for each in self.every)

    def _seen(self, visit: RegionVisit) -> RegionVisit | None:
        """Returns a visit; None where no pose in the window is inside: the line alone touches.

        The newest `_MOST_TRIED` visits without a vertex inside are looked at.
        """
        window, whole = self._window, visit.whole
        # So near to the window's ends, poses decide on which side a visit begins, or ends.
        room = TRACK_SLICE_NS
        if window.start + room <= whole.start and whole.stop < window.stop - room:
            if any(True for _ in _vertices_inside(visit.track, whole, self._region)):
                return visit
            self._looked_at += 1
            if self._looked_at > _MOST_TRIED:
                return visit
        exact = _by_poses(self._tracks, visit.track, whole, self._region)
        if exact is None or not window.overlaps(exact.start, exact.stop):
            return None
        cut = exact.within(window)
        if cut != exact and not _has_pose(self._tracks, cut, visit.track, self._region):
            return None
        inside = visit.inside._replace(entered=cut.entered, left=cut.left)
        return visit._replace(inside=inside)

    def ends(self, visit: RegionVisit) -> Inside:
        """Returns a visit from its first to its last pose inside, cut at the window's ends."""
        exact = _by_poses(self._tracks, visit.track, visit.whole, self._region)
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
            distance_m, at = _closest(self._tracks, visit.track, one, self._region)
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


def _joined_visits(tracks: RobotTracks, visits: list[Inside], region: Region) -> list[Inside]:
    """Returns visits in order; those as one between which the robot's poses did not leave.

    Along the edge of a region its track may be outside where it was inside. The newest
    `_MOST_TRIED` of such visits are looked at.
    """
    found: list[Inside] = []
    looked_at = 0
    for older in reversed(visits):
        newer = found[-1] if found else None
        is_close = newer is not None and newer.start - older.stop < _CLOSE_NS
        if newer is None or not (newer.entered and older.left and is_close):
            found.append(older)
            continue
        looked_at += 1
        if looked_at <= _MOST_TRIED and _stays(tracks, region, older, newer):
            found[-1] = newer._replace(start=older.start, entered=older.entered)
        else:
            found.append(older)
    return found[::-1]


def _stays(tracks: RobotTracks, region: Region, older: Inside, newer: Inside) -> bool:
    """Returns whether poses between two visits were never outside for as long as leaving takes.

    False where there is no pose inside before or after.
    """
    first = max(older.start, older.stop - TRACK_SLICE_NS)
    last = min(newer.stop, newer.start + TRACK_SLICE_NS)
    times, x, y = tracks.poses(TimeWindow(first, last + 1))[:3]
    inside = [*_inside(region, times, x, y)]
    if not inside or inside[0] > older.stop or inside[-1] < newer.start:
        return False
    return not any(_absences(times, inside))


def _has_pose(tracks: RobotTracks, one: Inside, track: RobotTrack, region: Region) -> bool:
    """Returns whether a visit that a window cuts off has a pose in the window."""
    if any(True for _ in _vertices_inside(track, one, region)):
        return True
    poses = tracks.poses(TimeWindow(one.start, one.stop + 1))[:3]
    return any(True for _ in _inside(region, *poses))


def _inside(region: Region, times: Times, x: Floats, y: Floats) -> Iterator[Ns]:
    """Yields those of some times at which the robot was in a region."""
    rows = zip(times.tolist(), x.tolist(), y.tolist(), strict=True)
    return (time for time, *place in rows if region.contains(*place))


def _by_poses(tracks: RobotTracks, track: RobotTrack, one: Inside, region: Region) -> Inside | None:
    """Returns a visit from its first to its last pose inside, where it was entered and left.

    None where no pose is inside: the robot's line alone touches the region.
    """
    within = [*_vertices_inside(track, one, region)]
    start, stop = one.start, one.stop
    if one.entered:
        poses = _poses_around(tracks, track, one.start)
        inside = [time for time in _inside(region, *poses) if time <= one.stop]
        others = [back for left, back in _absences(poses[0], inside) if left < one.start]
        inside = [time for time in inside if time >= max(others, default=MIN_NS)]
        start = min((*inside[:1], *within[:1]), default=MAX_NS)
    if one.left:
        poses = _poses_around(tracks, track, one.stop)
        inside = [time for time in _inside(region, *poses) if time >= one.start]
        others = [left for left, back in _absences(poses[0], inside) if back > one.stop]
        inside = [time for time in inside if time <= min(others, default=MAX_NS)]
        stop = max((*inside[-1:], *within[-1:]), default=MIN_NS)
    return one._replace(start=start, stop=stop) if start <= stop else None


def _absences(times: Times, inside: Sequence[Ns]) -> Iterator[tuple[Ns, Ns]]:
    """Yields the last pose inside, and the next one, around each absence as long as leaving takes.

    On a straight way from one part of a region to another one there are poses of both.
    """
    for left, back in pairwise(inside):
        between = (times > left) & (times < back)
        if back - left >= FLICKER_NS and between.any():
            yield left, back


def _vertices_inside(track: RobotTrack, one: Inside, region: Region) -> Iterator[Ns]:
    """Yields the times of a visit's vertices that are inside."""
    first = int(np.searchsorted(track.times, one.start, side="left"))
    last = int(np.searchsorted(track.times, one.stop, side="right"))
    visit = slice(first, last)
    return _inside(region, track.times[visit], track.x[visit], track.y[visit])


def _poses_around(tracks: RobotTracks, track: RobotTrack, at: Ns) -> tuple[Times, Floats, Floats]:
    """Returns the poses between the vertices before and after a time, these included."""
    times = track.times
    last = len(times) - 1
    before = max(int(np.searchsorted(times, at, side="left")) - 1, 0)
    after = min(int(np.searchsorted(times, at, side="right")), last)
    return tracks.poses(TimeWindow(int(times[before]), int(times[after]) + 1))[:3]


def _closest(
    tracks: RobotTracks, track: RobotTrack, one: Inside, circle: Circle
) -> tuple[float, Ns]:
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
    along = ((circle.x - x[:-1]) * dx + (circle.y - y[:-1]) * dy) / np.where(size > 0, size, 1.0)
    along = np.where(size > 0, along.clip(0.0, 1.0), 0.0)
    off = np.hypot(x[:-1] + along * dx - circle.x, y[:-1] + along * dy - circle.y)
    nearest = int(off.argmin())
    lasted = int(inner[nearest + 1] - inner[nearest])
    at = int(inner[nearest] + round(float(along[nearest]) * lasted))
    times, x, y = _poses_around(tracks, track, at)
    away_m = np.hypot(x - circle.x, y - circle.y)
    near = (times >= one.start) & (times <= one.stop)
    poses = zip(away_m[near].tolist(), times[near].tolist(), strict=True)
    return min(poses, default=(float(min(off[nearest], circle.radius_m)), at))


def places_in(
    view: View, places: Sequence[Place], placement: MapPlacement, window: TimeWindow
) -> list[tuple[Place, JoinedTrack]]:
    """Returns the places of the map and of the poses' own frame, each with the track in its frame.

    Notes name the others.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    found: list[tuple[Place, JoinedTrack]] = []
    for place in places:
        if place.frame_id in placement.frames:
            found.append((place, joined_in(view, place.frame_id, window)))
        else:
            view.notes.add(
                f"{place.name} is left out: it is in {place.frame_id}, and where the robot was is "
                f"known in {' and '.join(placement.frames)}"
            )
    return found


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
        last=found.ends(exits[0]).stop if exits else None,
    )

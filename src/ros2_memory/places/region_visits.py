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
from ros2_memory.places.robot_tracks import (
    Inside,
    JoinedTrack,
    RobotTracks,
    robot_inside,
    times_inside,
)
from ros2_memory.results import PlaceVisits, Visit

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.analysis.frames import Floats, Times
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Where


WHEREABOUTS: Final = "where the robot was"
"""What is not known without poses, for sentences."""
_CLOSE_NS: Final[Ns] = 60 * NS_PER_S
_MOST_JOINED: Final = 50


class RegionVisits(NamedTuple):
    """All visits to a region that reach into a window, newest first, and the track they are of.

    `elapsed`: how much time passed between moments of the window. `is_all`: whether the track
    reaches back to its begin. `tracks`: has the poses themselves.
    """

    track: RobotTrack
    all: Sequence[tuple[Inside, RobotTrack]]
    elapsed: Elapsed
    is_all: bool
    tracks: RobotTracks

    @property
    def duration(self) -> Ns:
        """How long they were in all, as the track has them."""
        return self.elapsed.among((one.start, one.stop) for one, _ in self.all)


def track_in(view: View, frame_id: str, window: TimeWindow) -> RobotTrack:
    """Returns the robot's track in a window; a note says how far back it reaches, if not all.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    return joined_in(view, frame_id, window).track


def joined_in(view: View, frame_id: str, window: TimeWindow) -> JoinedTrack:
    """Returns what `track_in` does, and since when it is known."""
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


def region_visits(view: View, frame_id: str, where: Where, window: TimeWindow) -> RegionVisits:
    """Returns the visits to a region that reach into a window, not cut at its ends.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    joined = joined_in(view, frame_id, window)
    tracks = RobotTracks(view, frame_id)
    every = [
        (one, track)
        for track in (joined.track, *joined.others)
        for one in _joined_visits(tracks, times_inside(track, where.region), where.region)
        if window.overlaps(one.start, one.stop)
    ]
    every.sort(key=lambda visit: visit[0], reverse=True)
    elapsed = elapsed_in(view, window)
    every = [
        (one, track)
        for one, track in every
        if one == (cut := one.within(window)) or _has_pose(tracks, cut, track, where.region)
    ]
    return RegionVisits(joined.track, every, elapsed, joined.since is None, tracks)


def _joined_visits(tracks: RobotTracks, visits: list[Inside], region: Region) -> list[Inside]:
    """Returns visits in order; those as one between which the robot's poses did not leave.

    Along the edge of a region its track may be outside where it was inside. The newest
    `_MOST_JOINED` of such visits are looked at.
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
        if looked_at <= _MOST_JOINED and _stays(tracks, region, older, newer):
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
    inside = _inside(region, times, x, y)
    if not inside or inside[0] > older.stop or inside[-1] < newer.start:
        return False
    return not any(_absences(times, inside))


def _has_pose(tracks: RobotTracks, one: Inside, track: RobotTrack, region: Region) -> bool:
    """Returns whether a visit that a window cuts off has a pose in the window."""
    if _vertices_inside(track, one, region):
        return True
    return bool(_inside(region, *tracks.poses(TimeWindow(one.start, one.stop + 1))[:3]))


def _inside(region: Region, times: Times, x: Floats, y: Floats) -> list[Ns]:
    """Returns those of some times at which the robot was in a region."""
    rows = zip(times.tolist(), x.tolist(), y.tolist(), strict=True)
    return [time for time, *place in rows if region.contains(*place)]


def shown_visits(
    found: RegionVisits, window: TimeWindow, limit: int, where: Where, newest: Ns | None
) -> tuple[tuple[Visit, ...], RegionVisits]:
    """Returns the newest visits in a window for the reply, and all, cut at the window's ends.

    Not those that turned out to be none. `newest` is the newest pose, if it is recent enough.
    """
    shown: list[Visit] = []
    every: list[tuple[Inside, RobotTrack]] = []
    for by_track, track in found.all:
        if len(shown) == limit:
            every.append((by_track.within(window), track))
            continue
        of_track = found._replace(track=track)
        one = _by_poses(of_track, by_track, where.region)
        if one is not None and window.overlaps(one.start, one.stop):
            cut = one.within(window)
            lasted = by_track.within(window)
            every.append((lasted._replace(entered=cut.entered, left=cut.left), track))
            shown.append(_visit_of(of_track, cut, where, newest))
    return tuple(shown), found._replace(all=every)


def _visit_of(found: RegionVisits, one: Inside, where: Where, newest: Ns | None) -> Visit:
    """Returns a visit for the reply.

    Its times are those of poses: of the first and the last one inside, and of the closest.
    """
    is_there = newest is not None and one.start <= newest <= one.stop and not one.left
    distance_m, at = None, None
    if isinstance(where.region, Circle):
        distance_m, at = _closest(found, one, where.region)
    return Visit(
        arrived=one.start,
        departed=None if is_there else one.stop,
        duration=found.elapsed.between(one.start, one.stop),
        closest_m=distance_m,
        closest_at=at,
        restarts=0,
        already_inside=not one.entered,
        still_inside=not one.left and not is_there,
    )


def _by_poses(found: RegionVisits, one: Inside, region: Region) -> Inside | None:
    """Returns a visit from its first to its last pose inside, where it was entered and left.

    None where no pose is inside: the robot's line alone touches the region.
    """
    within = _vertices_inside(found.track, one, region)
    start, stop = one.start, one.stop
    if one.entered:
        poses = _poses_around(found, one.start)
        inside = [time for time in _inside(region, *poses) if time <= one.stop]
        others = [back for left, back in _absences(poses[0], inside) if left < one.start]
        inside = [time for time in inside if time >= max(others, default=MIN_NS)]
        start = min((*inside[:1], *within[:1]), default=MAX_NS)
    if one.left:
        poses = _poses_around(found, one.stop)
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


def _vertices_inside(track: RobotTrack, one: Inside, region: Region) -> list[Ns]:
    """Returns the times of a visit's vertices that are inside."""
    first = int(np.searchsorted(track.times, one.start, side="left"))
    last = int(np.searchsorted(track.times, one.stop, side="right"))
    visit = slice(first, last)
    return _inside(region, track.times[visit], track.x[visit], track.y[visit])


def _poses_around(found: RegionVisits, at: Ns) -> tuple[Times, Floats, Floats]:
    """Returns the poses between the vertices before and after a time, these included."""
    times = found.track.times
    last = len(times) - 1
    before = max(int(np.searchsorted(times, at, side="left")) - 1, 0)
    after = min(int(np.searchsorted(times, at, side="right")), last)
    return found.tracks.poses(TimeWindow(int(times[before]), int(times[after]) + 1))[:3]


def _closest(found: RegionVisits, one: Inside, circle: Circle) -> tuple[float, Ns]:
    """Returns how near (m) a pose of a visit was to the middle of a circle, and when."""
    track = found.track
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
    times, x, y = _poses_around(found, at)
    away_m = np.hypot(x - circle.x, y - circle.y)
    near = (times >= one.start) & (times <= one.stop)
    poses = zip(away_m[near].tolist(), times[near].tolist(), strict=True)
    return min(poses, default=(float(min(off[nearest], circle.radius_m)), at))


def places_in(
    view: View, places: Sequence[Place], placement: MapPlacement, window: TimeWindow
) -> list[tuple[Place, RobotTrack]]:
    """Returns the places of the map and of the poses' own frame, each with the track in its frame.

    Notes name the others.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    found: list[tuple[Place, RobotTrack]] = []
    tracks: dict[str, RobotTrack] = {}
    for place in places:
        frame = place.frame_id
        if frame not in placement.frames:
            view.notes.add(
                f"{place.name} is left out: it is in {frame}, and where the robot was is known in "
                f"{' and '.join(placement.frames)}"
            )
            continue
        if frame not in tracks:
            tracks[frame] = track_in(view, frame, window)
        found.append((place, tracks[frame]))
    return found


def place_visits(
    view: View, places: Sequence[tuple[Place, RobotTrack]], window: TimeWindow, elapsed: Elapsed
) -> tuple[PlaceVisits, ...]:
    """Returns how often, and for how long, the robot was in each of `places_in`.

    Those in which it was longest come first.
    """
    found: list[PlaceVisits] = []
    for place, track in places:
        inside = robot_inside(track, place.region, window)
        tracks = RobotTracks(view, place.frame_id)
        every = [(one, track) for one in inside]
        of_place = RegionVisits(track, every, elapsed, is_all=True, tracks=tracks)
        entries = [one for one in inside if one.entered]
        exits = [one for one in inside if one.left]
        first, last = (
            _by_poses(of_place, some[nth], place.region) or some[nth] if some else None
            for some, nth in ((entries, 0), (exits, -1))
        )
        found.append(
            PlaceVisits(
                place=place.name,
                entries=len(entries),
                exits=len(exits),
                duration=of_place.duration,
                first=None if first is None else first.start,
                last=None if last is None else last.stop,
            )
        )
    return tuple(sorted(found, key=lambda each: (-each.duration, each.place)))

"""What the robot drove while it was inside of a region: metres, speed and the drawn way.

When it was inside follows from its track in the region's frame, and how far it drove from its drawn
path, whose corners have times and the metres driven up to them. So corrections of the map add no
metres.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.motion.robot_track import RobotTrack, cut, jumps
from ros2_memory.analysis.motion.trajectory import MAX_WAYPOINTS, Line, Waypoint, drawn, mean_speed
from ros2_memory.core.arrays import rows_of, stacked
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.geometry import yaw
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import places_at
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import NS_PER_S, Ns, Span, unix_from_ns
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_edges, note_unread, note_unrecorded
from ros2_memory.history.driven_path import driven_path, resolve_path_topic
from ros2_memory.history.no_data import no_data_between
from ros2_memory.history.robots import require_one_robot
from ros2_memory.history.view import TimeRange, View, open_span
from ros2_memory.places.pose_frames import (
    NEWEST_POSE_NS,
    known_track,
    map_placement,
    newest_pose,
    placed_waypoints,
)
from ros2_memory.places.robot_tracks import Stay, TrackReader, stays_within
from ros2_memory.places.where import known_track_for, parse_where
from ros2_memory.results import DrivenInside, FarthestPose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.frames import Floats, Times
    from ros2_memory.history.context import Call, Memory

_FARTHEST_FROM: Final = "farthest_from"
_AROUND_NS: Final = 10 * NS_PER_S
_OFF_TRACK_M: Final = 0.1
"""No pose is as far from the line of a track."""
_MOST_TRIED: Final = 20
_SPEED_NS: Final = NS_PER_S
"""Over so long a speed is measured: what is shorter is noise."""
_FEWEST_WAYPOINTS: Final = 2
_TURNED_RAD: Final = math.radians(10.0)
"""More than a robot turns between two poses."""


def driven_inside(
    memory: Memory,
    call: Call,
    span: TimeRange,
    *,
    where: JsonValue,
    topic: str | None = None,
    frame_id: str | None = None,
    max_waypoints: int = MAX_WAYPOINTS,
    farthest: JsonValue = None,
) -> DrivenInside:
    """Returns what was driven inside of a region in a window, by one pose topic.

    Its waypoints are in the poses' own frame or in `frame_id`; 0 asks for none, 1 for the last.
    `farthest` is the point from which the farthest pose inside is wanted.

    Raises:
        InvalidArgumentsError: the topic carries no position, or `where` is no region of a frame
            that its poses can be placed in.
        NoDataError: there are no poses in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    region = parse_where(memory.limits, where)
    view, window = open_span(memory, call, span)
    name = resolve_path_topic(view, topic)
    path, _ = driven_path(view, name, window)
    if path is None or not path.poses:
        raise no_data_between(view, (name,), window)
    note_unrecorded(view, window)
    track = known_track_for(view, region, window).track
    inside = stays_within(track, region.region, window)
    totals = totals_inside(path.line, inside)
    waypoints = way_inside(path.line, inside, max_waypoints)
    waypoints = tuple(
        _with_measured_heading(view, name, path.line, waypoint) for waypoint in waypoints
    )
    elapsed = elapsed_in(view, window)
    spans = [(stay.start, stay.stop) for stay in inside]
    duration = elapsed.among(spans)
    average = mean_speed(totals.distance_m, unix_from_ns(duration)) if duration else 0.0
    if frame_id is not None:
        waypoints = placed_waypoints(view, name, waypoints, path.frames[0], frame_id)
    require_one_robot(view, name, window)
    away = None if farthest is None else farthest_from(view, farthest, name, spans, frame_id)
    note_unread(view, window)
    note_edges(view, window)
    return DrivenInside(
        name,
        frame_id or path.frames[0],
        region.shown,
        len(inside),
        duration,
        inside[0].start if inside else None,
        inside[-1].stop if inside else None,
        totals.distance_m,
        average,
        # Measured over a second, it is below the mean of a visit that hardly lasts as long.
        None if average is None else max(totals.max_speed or 0.0, average),
        waypoints,
        away,
        notes=view.notes.sentences(),
    )


class InsideTotals(NamedTuple):
    """What was driven inside: metres, and the highest speed (m/s) over a second.

    `max_speed` is None where no time inside is long enough for one.
    """

    distance_m: float
    max_speed: float | None


def totals_inside(line: Line, spans: Sequence[Stay]) -> InsideTotals:
    """Returns what was driven along a line in some times."""
    metres, speeds = 0.0, [] if spans else [0.0]
    for start, stop in united((span.start, span.stop) for span in spans):
        first_m, last_m = line.metres_at(np.array([start, stop])).tolist()
        metres += last_m - first_m
        fastest = _fastest(line, start, stop, last_m - first_m)
        speeds += [] if fastest is None else [fastest]
    return InsideTotals(metres, max(speeds, default=None))


def _fastest(line: Line, start: Ns, stop: Ns, driven_m: float) -> float | None:
    if stop - start <= _SPEED_NS:
        return mean_speed(driven_m, unix_from_ns(stop - start))
    end = stop - _SPEED_NS
    inner = line.times[np.searchsorted(line.times, start) :]
    inner = inner[: np.searchsorted(inner, end)]
    # The speed over a second changes its slope only where it begins or ends at a vertex.
    ends = line.times[np.searchsorted(line.times, start + _SPEED_NS) :]
    ends = ends[: np.searchsorted(ends, stop)] - _SPEED_NS
    begin = np.concatenate(([start, end], inner, ends))
    here, there = line.at(begin), line.at(begin + _SPEED_NS)
    # Metres are without jumps, but noise may shift some of them along the way.
    moved = np.linalg.norm(there.places - here.places, axis=1)
    return float(np.minimum(there.metres - here.metres, moved).max())


def way_inside(line: Line, spans: Sequence[Stay], at_most: int) -> tuple[Waypoint, ...]:
    """Returns the drawn way in some times; `jump` marks where another time begins.

    `at_most` 0 asks for none, 1 for the last.
    """
    if not spans:
        return ()
    inside = stacked([_part(line, span) for span in spans])
    waypoints, _ = drawn(inside, max(at_most, _FEWEST_WAYPOINTS))
    return waypoints if at_most >= _FEWEST_WAYPOINTS else waypoints[len(waypoints) - at_most :]


def _with_measured_heading(view: View, topic: str, line: Line, waypoint: Waypoint) -> Waypoint:
    """Returns a waypoint with the heading of the newest pose then, where it has quite another.

    Between vertices a heading is one between theirs, and the robot may have turned meanwhile
    without turning off its way. Without an orientation then, it has no heading.
    """
    if waypoint.yaw_rad is None or np.isin(waypoint.time, line.times):
        return waypoint
    window = TimeWindow.before(waypoint.time, NEWEST_POSE_NS)
    _, pose = newest_pose(view, topic, window) or (None, None)
    orientation = None if pose is None else pose.orientation
    if orientation is None:
        return dataclasses.replace(waypoint, yaw_rad=None)
    measured_rad = yaw(orientation)
    if abs(math.remainder(measured_rad - waypoint.yaw_rad, math.tau)) > _TURNED_RAD:
        return dataclasses.replace(waypoint, yaw_rad=measured_rad)
    return waypoint


def _part(line: Line, span: Stay) -> Line:
    """Returns the line in a time: its first vertex is where that begins, as after a jump."""
    inner = np.flatnonzero((line.times > span.start) & (line.times < span.stop))
    ends = [span.start, span.stop] if span.stop > span.start else [span.start]
    first, last = line.at(np.array(ends[:1])), line.at(np.array(ends[1:], np.int64))
    begins = dataclasses.replace(first, jumps=np.array([True]))
    return stacked([begins, rows_of(line, inner), last])


def farthest_from(
    view: View,
    value: JsonValue,
    topic: str,
    spans: Sequence[Span],
    frame_id: str | None,
) -> FarthestPose | None:
    """Returns the pose in some times (both ends inclusive, in order) that is farthest from a point.

    The point, of `value`, is in the frame of places or in `frame_id`. None where no pose could be
    placed there.

    Raises:
        InvalidArgumentsError: `value` is no point, or the poses are not in its frame.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place = parse_where(view.limits, value, 1.0, _FARTHEST_FROM)
    if place.several:
        raise InvalidArgumentsError(f"{_FARTHEST_FROM} has several places; give one, or x and y")
    if topic != (robot_topic := resolve_path_topic(view)):
        raise InvalidArgumentsError(
            f"{_FARTHEST_FROM} is measured along {robot_topic}: leave out topic"
        )
    frame = map_placement(view, topic, place.frame_id or frame_id).frame_id
    min_x, max_x, min_y, max_y = place.region.bounds
    x, y = (min_x + max_x) / 2, (min_y + max_y) / 2
    if not spans:
        return None
    window = TimeWindow(spans[0][0], spans[-1][1] + 1)
    track = known_track(view, frame, window).track
    pose = _farthest_pose(TrackReader(view, frame), track, spans, (x, y))
    if pose is None:
        return None
    inside = places_at(view.limits.places, frame, pose.x, pose.y)
    return FarthestPose((x, y), frame, pose.away_m, pose.time, (pose.x, pose.y), inside)


class _DistantPose(NamedTuple):
    """A pose (m), its log time (ns), and its distance from the point that is asked about."""

    away_m: float
    time: Ns
    x: float
    y: float


def _farthest_pose(
    tracks: TrackReader,
    track: RobotTrack,
    spans: Sequence[Span],
    point: tuple[float, float],
) -> _DistantPose | None:
    """Returns the pose in some times that is farthest from a point (m).

    Poses are looked up around the places of the track that are farthest away.
    """
    x, y = point
    times, at_x, at_y = _along(track, spans)
    off_m = np.hypot(at_x - x, at_y - y)
    farthest: _DistantPose | None = None
    for nth in np.argsort(-off_m, kind="stable")[:_MOST_TRIED].tolist():
        if farthest is not None and off_m[nth] <= farthest.away_m - _OFF_TRACK_M:
            break
        at = int(times[nth])
        first, last = next((first, last) for first, last in spans if first <= at <= last)
        around = TimeWindow(max(first, at - _AROUND_NS), min(last, at + _AROUND_NS) + 1)
        poses = tracks.poses(around)
        rows = zip(poses.times.tolist(), poses.x.tolist(), poses.y.tolist(), strict=True)
        for time, pose_x, pose_y in rows:
            away_m = math.hypot(pose_x - x, pose_y - y)
            is_near = away_m <= off_m[nth] + _OFF_TRACK_M  # else the robot jumped there, and back
            if is_near and (farthest is None or away_m > farthest.away_m):
                farthest = _DistantPose(away_m, time, pose_x, pose_y)
    return farthest


def _along(track: RobotTrack, spans: Sequence[Span]) -> tuple[Times, Floats, Floats]:
    """Returns where the track was in some times: its vertices, and where each begins and ends.

    Without those that the robot jumped to and from.
    """
    points = []
    for first, last in spans:
        part = cut(track, TimeWindow(first, last + 1))
        jumped = jumps(part)
        fine = ~(jumped & np.roll(jumped, 1))
        points.append((part.times[fine], part.x[fine], part.y[fine]))
    times, x, y = (np.concatenate(column) for column in zip(*points, strict=True))
    return times, x, y

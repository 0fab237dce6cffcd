"""What the robot drove inside of a region, or while topics met conditions: metres, speed, the way.

The robot's track in the region's frame says when it was inside. The drawn path, each of whose
vertices has a log time and the metres driven so far, says how far it drove meanwhile. So
corrections of the map add no metres.
"""

from __future__ import annotations

import dataclasses
import math
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.motion.robot_track import RobotTrack, cut_track, jumps
from ros2_memory.analysis.motion.trajectory import (
    LEAST_OF_SPEED_S,
    MAX_WAYPOINTS,
    Line,
    Waypoint,
    draw_waypoints,
    mean_speed,
)
from ros2_memory.core.arrays import Ints, bounds_of, rows_of, stable_order, stacked
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.geometry import yaw
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import places_at
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import NS_PER_S, Ns, Span, unix_from_ns
from ros2_memory.history.coverage import note_edges, note_unread, note_unrecorded
from ros2_memory.history.driven_path import driven_path, follow, no_path
from ros2_memory.history.robots import require_one_robot
from ros2_memory.history.view import TimeRange, View, open_span
from ros2_memory.places.pose_frames import (
    NEWEST_POSE_NS,
    known_track,
    map_placement,
    newest_pose,
    placed_waypoints,
)
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.places.where import Scope, counted_stays, parse_where
from ros2_memory.results import DrivenInside, FarthestPose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.frames import Floats
    from ros2_memory.core.model import Vector3
    from ros2_memory.history.conditions import Sought
    from ros2_memory.history.context import Call, Memory

_FARTHEST_FROM: Final = "farthest_from"
_AROUND_NS: Final = 10 * NS_PER_S
"""Poses up to so far before and after a point of the track are tried."""
_OFF_TRACK_M: Final = 0.1
"""Every pose is nearer than this to the line of a track."""
_MOST_TRIED: Final = 20
"""How many points of the track are tried."""
_SPEED_NS: Final = NS_PER_S
"""Speed is measured over this time: over a shorter one, noise is too large a part."""
_FEWEST_WAYPOINTS: Final = 2
_TURNED_RAD: Final = math.radians(10.0)
"""A robot turns less than this between two poses."""


def driven_inside(
    memory: Memory,
    call: Call,
    span: TimeRange,
    *,
    where: JsonValue = None,
    during: Sequence[Sought] = (),
    topic: str | None = None,
    frame_id: str | None = None,
    max_waypoints: int = MAX_WAYPOINTS,
    farthest: JsonValue = None,
) -> DrivenInside:
    """Returns what the robot drove in a window inside of a region, or while topics met conditions.

    Args:
        memory: the memory.
        call: the call.
        span: the window.
        where: the region, as `parse_where` takes it; None for all.
        during: the conditions on other topics, all of which have to hold.
        topic: the topic of the poses; None for the robot's.
        frame_id: the frame of the waypoints; None for that of the poses.
        max_waypoints: how many waypoints to draw; 0 for none, 1 for the last alone.
        farthest: the point from which to look for the farthest pose inside; None for no search.

    Raises:
        InvalidArgumentsError: the topic carries no position, or `where` is no region of a frame
            that its poses can be placed in, or nothing can meet a condition.
        NoDataError: there are no poses in the window, or no topic of a condition.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place = None if where is None else parse_where(memory.limits, where)
    view, window = open_span(memory, call, span)
    name = follow(view, topic)
    path, _ = driven_path(view, name, window)
    if path is None or not path.poses:
        raise no_path(view, name, window)
    note_unrecorded(view, window)
    scope = Scope(view, window, during=during)
    stays = counted_stays(view, place, scope, (path.first, path.last))
    spans = [*chain.from_iterable(stays)]
    totals = totals_inside(path.line, spans)
    waypoints = tuple(
        _with_measured_heading(view, name, path.line, waypoint)
        for waypoint in _way_inside(path.line, spans, max_waypoints)
    )
    elapsed = view.elapsed_in(window)
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
        None if place is None else place.shown,
        None if place is None else len(stays),
        duration,
        spans[0][0] if spans else None,
        spans[-1][1] if spans else None,
        totals.distance_m,
        average,
        # The highest speed over a second may be below the mean of a visit of about a second.
        None if average is None else max(totals.max_speed or 0.0, average),
        waypoints,
        away,
        elapsed.among(scope.unknown),
        notes=view.notes.sentences(),
    )


class InsideTotals(NamedTuple):
    """What was driven inside: metres, and the highest speed (m/s) over a second.

    `max_speed` is None if no span is long enough to measure one.
    """

    distance_m: float
    max_speed: float | None


def totals_inside(line: Line, spans: Sequence[Span]) -> InsideTotals:
    """Returns what was driven along a line in spans; time in which they overlap counts once."""
    if not spans:
        return InsideTotals(0.0, 0.0)
    starts, stops = bounds_of(united(spans))
    driven_m = np.diff(line.metres_at(np.stack((starts, stops))), axis=0)[0]
    lasted = stops - starts
    is_short = (lasted >= LEAST_OF_SPEED_S * NS_PER_S) & (lasted <= _SPEED_NS)
    speeds = driven_m[is_short] / lasted[is_short] * NS_PER_S
    speeds = np.append(speeds, _speeds_over_second(line, starts, stops - _SPEED_NS))
    return InsideTotals(float(driven_m.sum()), float(speeds.max()) if speeds.size else None)


def _speeds_over_second(line: Line, starts: Ints, stops: Ints) -> Floats:
    """Returns speeds (m/s) over `_SPEED_NS` from times in spans on, the highest among them.

    As the window of a second moves along the line, its speed is highest where one of its ends is at
    a vertex, or it begins at a start or a stop. None is returned of spans that stop before their
    start.
    """
    begins = np.concatenate((starts, stops, line.times, line.times - _SPEED_NS))
    begins = begins[_span_numbers(begins, starts, stops) >= 0]
    here, there = line.at(begins), line.at(begins + _SPEED_NS)
    # Metres are without jumps, but noise may shift some of them along the way.
    moved: Floats = np.linalg.norm(there.places - here.places, axis=1)
    return np.minimum(moved, there.metres - here.metres)


def _span_numbers(times: Ints, starts: Ints, stops: Ints) -> Ints:
    """Returns the number of the span in which each time lies, ends included; -1 for none."""
    numbers = np.searchsorted(starts, times, side="right") - 1
    return np.where(times <= stops[numbers], numbers, -1)


def _way_inside(line: Line, spans: Sequence[Span], at_most: int) -> tuple[Waypoint, ...]:
    """Returns the drawn way in spans, the first waypoint of each marked as a jump.

    `at_most` 0 asks for no waypoint, 1 for the last.
    """
    if not spans:
        return ()
    starts, stops = bounds_of(spans)
    of_vertex = _span_numbers(line.times, starts + 1, stops - 1)
    is_inner, is_long = of_vertex >= 0, stops > starts
    first = dataclasses.replace(line.at(starts), jumps=np.ones(len(spans), np.bool_))
    parts = stacked([first, rows_of(line, is_inner), line.at(stops[is_long])])
    numbers = np.arange(len(spans))
    order = np.lexsort((parts.times, np.append(numbers, (*of_vertex[is_inner], *numbers[is_long]))))
    waypoints, _ = draw_waypoints(rows_of(parts, order), max(at_most, _FEWEST_WAYPOINTS))
    return waypoints if at_most >= _FEWEST_WAYPOINTS else waypoints[len(waypoints) - at_most :]


def _with_measured_heading(view: View, topic: str, line: Line, waypoint: Waypoint) -> Waypoint:
    """Returns a waypoint with the heading of the newest pose then, if the two differ clearly.

    Between vertices a line interpolates the heading, but the robot may have turned on the spot. If
    that pose has no orientation, the waypoint gets none.
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


def farthest_from(
    view: View,
    value: JsonValue,
    topic: str,
    spans: Sequence[Span],
    frame_id: str | None,
) -> FarthestPose | None:
    """Returns the pose that is farthest from a point; None if no pose can be placed in its frame.

    Args:
        view: the view of this call.
        value: the point, as `parse_where` takes a place.
        topic: the topic of the poses.
        spans: the times of the poses, in order; both ends are inclusive.
        frame_id: the frame of the point; None for the frame of places.

    Raises:
        InvalidArgumentsError: `value` is no point, or the poses are not in its frame.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place = parse_where(view.limits, value, 1.0, _FARTHEST_FROM)
    if place.several:
        raise InvalidArgumentsError(f"{_FARTHEST_FROM} has several places; give one, or x and y")
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
    inside = places_at(view.limits.places, {frame: pose.place})
    return FarthestPose((x, y), frame, pose.away_m, pose.time, pose.place, inside)


class _DistantPose(NamedTuple):
    """A pose (m), its log time (ns), and its distance from the point that is asked about."""

    away_m: float
    time: Ns
    place: Vector3


def _farthest_pose(
    tracks: TrackReader,
    track: RobotTrack,
    spans: Sequence[Span],
    point: tuple[float, float],
) -> _DistantPose | None:
    """Returns the pose in `spans` that is farthest from a point (m); None if there is no pose.

    Poses are looked up around the vertices of the track that are farthest away.
    """
    x, y = point
    times, track_x, track_y = _vertices_during(track, spans)
    track_away_m = np.hypot(track_x - x, track_y - y)
    farthest: _DistantPose | None = None
    for nth in stable_order(-track_away_m)[:_MOST_TRIED].tolist():
        if farthest is not None and track_away_m[nth] <= farthest.away_m - _OFF_TRACK_M:
            break
        at = int(times[nth])
        first, last = next((first, last) for first, last in spans if first <= at <= last)
        around = TimeWindow(max(first, at - _AROUND_NS), min(last, at + _AROUND_NS) + 1)
        poses = tracks.poses(around)
        columns = (poses.times, poses.x, poses.y, poses.z)
        for time, *place in zip(*(column.tolist() for column in columns), strict=True):
            away_m = math.dist(place[:2], point)
            # A pose farther off the track is one that the robot jumped to and back from.
            is_on_track = away_m <= track_away_m[nth] + _OFF_TRACK_M
            if is_on_track and (farthest is None or away_m > farthest.away_m):
                farthest = _DistantPose(away_m, time, (*place,))
    return farthest


def _vertices_during(track: RobotTrack, spans: Sequence[Span]) -> tuple[Ints, Floats, Floats]:
    """Returns the times, x and y (m) of a track's vertices in spans, and of the spans' ends.

    Vertices that the robot jumped to and from are left out.
    """
    points = []
    for first, last in spans:
        part = cut_track(track, TimeWindow(first, last + 1))
        jumped = jumps(part)
        on_way = ~(jumped & np.roll(jumped, 1))
        points.append((part.times[on_way], part.x[on_way], part.y[on_way]))
    times, x, y = (np.concatenate(column) for column in zip(*points, strict=True))
    return times, x, y

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

from ros2_memory.analysis.motion.trajectory import MAX_WAYPOINTS, Line, Waypoint, drawn, mean_speed
from ros2_memory.core.arrays import rows_of, stacked
from ros2_memory.core.geometry import yaw
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_edges, note_unread, note_unrecorded
from ros2_memory.history.driven_path import driven_path, resolve_path_topic
from ros2_memory.history.no_data import no_data_between
from ros2_memory.history.robots import require_one_robot
from ros2_memory.history.view import TimeRange, open_span
from ros2_memory.places.farthest import farthest_from
from ros2_memory.places.pose_frames import NEWEST_POSE_NS, newest_pose, placed_waypoints
from ros2_memory.places.robot_tracks import Inside, robot_inside
from ros2_memory.places.where import joined_in_region, parse_where
from ros2_memory.results import DrivenInside

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.view import View

_SPEED_NS: Final[Ns] = NS_PER_S
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
    way, _ = driven_path(view, name, window)
    if way is None or not way.poses:
        raise no_data_between(view, (name,), window)
    note_unrecorded(view, window)
    track = joined_in_region(view, region, window).track
    inside = robot_inside(track, region.region, window)
    totals = totals_inside(way.line, inside)
    waypoints = way_inside(way.line, inside, max_waypoints)
    waypoints = tuple(_as_turned(view, name, way.line, each) for each in waypoints)
    elapsed = elapsed_in(view, window)
    spans = [(each.start, each.stop) for each in inside]
    duration = elapsed.among(spans)
    average = mean_speed(totals.distance_m, unix_from_ns(duration)) if duration else 0.0
    if frame_id is not None:
        waypoints = placed_waypoints(view, name, waypoints, way.frames[0], frame_id)
    require_one_robot(view, name, window)
    away = None if farthest is None else farthest_from(view, farthest, name, spans, frame_id)
    note_unread(view, window)
    note_edges(view, window)
    return DrivenInside(
        name,
        frame_id or way.frames[0],
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


def totals_inside(line: Line, spans: Sequence[Inside]) -> InsideTotals:
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
    driven = line.metres_at(begin + _SPEED_NS) - line.metres_at(begin)
    # Metres are without jumps, but noise may shift some of them along the way.
    moved = line.places_at(begin + _SPEED_NS) - line.places_at(begin)
    return float(np.minimum(driven, np.sqrt((moved * moved).sum(axis=1))).max())


def way_inside(line: Line, spans: Sequence[Inside], at_most: int) -> tuple[Waypoint, ...]:
    """Returns the drawn way in some times; `jump` marks where another time begins.

    `at_most` 0 asks for none, 1 for the last.
    """
    if not spans:
        return ()
    inside = stacked([_part(line, span) for span in spans])
    found, _ = drawn(inside, max(at_most, _FEWEST_WAYPOINTS))
    return found if at_most >= _FEWEST_WAYPOINTS else found[len(found) - at_most :]


def _as_turned(view: View, topic: str, line: Line, waypoint: Waypoint) -> Waypoint:
    """Returns a waypoint with the heading of the newest pose then, where it has quite another.

    Between vertices a heading is one between theirs, and the robot may have turned meanwhile
    without turning off its way.
    """
    if waypoint.yaw_rad is None or np.isin(waypoint.time, line.times):
        return waypoint
    window = TimeWindow(max(waypoint.time - NEWEST_POSE_NS, MIN_NS), waypoint.time + 1)
    _, pose = newest_pose(view, topic, window) or (None, None)
    turn = None if pose is None else pose.orientation
    if turn is None:
        return dataclasses.replace(waypoint, yaw_rad=None)
    off = math.remainder(yaw(turn) - waypoint.yaw_rad, math.tau)
    return dataclasses.replace(waypoint, yaw_rad=yaw(turn)) if abs(off) > _TURNED_RAD else waypoint


def _part(line: Line, span: Inside) -> Line:
    """Returns the line in a time: its first vertex is where that begins, as after a jump."""
    inner = np.flatnonzero((line.times > span.start) & (line.times < span.stop))
    ends = [span.start, span.stop] if span.stop > span.start else [span.start]
    first, last = line.at(np.array(ends[:1])), line.at(np.array(ends[1:], np.int64))
    begins = dataclasses.replace(first, jumps=np.array([True]))
    return stacked([begins, rows_of(line, inner), last])

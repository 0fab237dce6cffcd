"""The path as it was driven, for the part of the map that is looked at.

The first look has the robot's track, of which a pose may be 5 cm off, and of a long span some of
its points. Here every pose in a box of the map counts: none lies farther from the lines than half
a pixel of the screen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.motion.robot_track import TOLERANCE_M, RobotTrack, cut_track
from ros2_memory.core.errors import NoDataError, NoDataReason, QueryTimeoutError
from ros2_memory.core.geometry import simplified
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S, unix_from_ns
from ros2_memory.history.no_data import GIVE_TOPIC, resolve_pose_topic
from ros2_memory.history.view import View
from ros2_memory.messages.to_json import evenly
from ros2_memory.places.local_map import local_track
from ros2_memory.places.pose_frames import robot_places
from ros2_memory.places.robot_tracks import TrackReader

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory

MOST_POINTS: Final = 20_000
_MOST_PIXELS: Final = 20_000_000
"""A path that passes more, as where it jumps far, is not searched for what it repeats."""
_QUICK_S: Final = 2.0
_WHERE_LISTED: Final = "; list_recorded_topics lists all"
_TOGETHER_NS: Final = 5 * NS_PER_S
"""A robot that leaves the box for less is read on: reading begins anew for each stretch."""


class Box(NamedTuple):
    """A part of the map: corners, and how long (m) a pixel of the screen is there."""

    x0: float
    y0: float
    x1: float
    y1: float
    pixel_m: float


class Line(NamedTuple):
    """Points of a path in order of time; `begins`: whether no line leads to a point."""

    times: Ints
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    begins: Flags

    def some(self, kept: NDArray[np.intp]) -> Line:
        """Returns the points with these indices."""
        return Line(self.times[kept], self.x[kept], self.y[kept], self.begins[kept])

    def simplified(self, tolerance_m: float, at_most: int) -> NDArray[np.intp]:
        """Returns the indices of at most so many points, from whose lines no other is farther."""
        count = len(self.times)
        if count < 3:
            return np.arange(count)
        are_ends = self.begins | np.append(self.begins[1:], [True])
        are_ends[0] = True
        ends = np.flatnonzero(are_ends)
        points = np.stack([self.x, self.y, np.zeros(count)], axis=1)
        clock = (self.times - self.times[0]) / NS_PER_S
        must = ends[evenly(len(ends), at_most)]
        kept, _ = simplified(points, clock, must, tolerance_m=tolerance_m, at_most=at_most)
        return kept


class RobotPath(NamedTuple):
    """The robot's track in a window, in a frame.

    `is_whole`: whether there was time for all of it. `reader` has each pose; None where it is of a
    satellite receiver.
    """

    frame: str
    track: RobotTrack
    is_whole: bool
    reader: TrackReader | None

    @property
    def line(self) -> Line:
        """The points of the track."""
        track = self.track
        return Line(track.times, track.x, track.y, track.begins)


def robot_path(view: View, window: TimeWindow) -> RobotPath | None:
    """Returns the robot's path in the map, else in the frame of odometry, or by its receiver.

    None where no topic places it.

    Raises:
        QueryTimeoutError: the call's time is over before any of it is known.
    """
    places = robot_places(view, window)
    if places is None:
        local = local_track(view, view.pose_topic, window)
        return None if local is None else RobotPath(*local, is_whole=True, reader=None)
    reader = TrackReader(view, places.map_frame)
    # With what was just before, to know whether the path goes on from there.
    known = reader.track_in(TimeWindow(window.start - SILENCE_NS, window.stop))
    return RobotPath(places.map_frame, cut_track(known.track, window), known.since is None, reader)


def path_in_box(memory: Memory, call: Call, window: TimeWindow, box: Box) -> JsonObject:
    """Returns the path in a window where it passes a box, and whether every pose there counted.

    Raises:
        NoDataError: no topic places the robot.
        QueryTimeoutError: the call's time is over before its track is known.
    """
    path, line, is_exact = line_in_box(memory, call, window, box)
    track = path.track
    return {
        "frame": path.frame,
        "exact": is_exact,
        "until": unix_from_ns(int(track.times[-1])) if len(track.times) else None,
        "t": np.round(line.times / NS_PER_S, 3).tolist(),
        "x": np.round(line.x, 4).tolist(),
        "y": np.round(line.y, 4).tolist(),
        "begins": np.flatnonzero(line.begins).tolist(),
    }


def line_in_box(
    memory: Memory, call: Call, window: TimeWindow, box: Box
) -> tuple[RobotPath, Line, bool]:
    """Returns the robot's path, it as drawn in a box, and whether every pose there counted.

    Raises:
        NoDataError: no topic places the robot.
        QueryTimeoutError: the call's time is over before its track is known.
    """
    view = View(memory, call.within(_QUICK_S), window.stop)
    path = robot_path(view, window)
    if path is None:
        raise NoDataError(NoDataReason.TOPIC_NOT_RECORDED, why_no_path(view))
    stretches = [*stretches_inside(path.track, box)]
    lines: list[Line] = []
    is_exact = path.reader is None or box.pixel_m >= TOLERANCE_M
    if path.reader is not None and not is_exact:
        lines = [*_every_pose(path.reader, path.track, stretches)]
        is_exact = len(lines) == len(stretches)
    older = []
    for first, last in stretches[: len(stretches) - len(lines)]:
        begins = np.arange(last + 1 - first) == 0
        older.append(path.line.some(np.arange(first, last + 1))._replace(begins=begins))
    return path, _drawn(_joined([*older, *lines[::-1]]), box.pixel_m), is_exact


def why_no_path(view: View) -> str:
    """Returns why no topic places the robot, and which setting gives a path."""
    try:
        return f"{resolve_pose_topic(view)} has no poses"
    except NoDataError as error:
        return error.detail.replace(f", or {GIVE_TOPIC}", "").removesuffix(_WHERE_LISTED)


def stretches_inside(track: RobotTrack, box: Box) -> Iterator[tuple[int, int]]:
    """Yields the first and the last vertex of each stretch of a track that may pass a box."""
    low_x, high_x = _bounds(track.x)
    low_y, high_y = _bounds(track.y)
    room = TOLERANCE_M + box.pixel_m
    inside = (low_x <= box.x1 + room) & (high_x >= box.x0 - room) & ~track.begins[1:]
    inside &= (low_y <= box.y1 + room) & (high_y >= box.y0 - room)
    steps = np.flatnonzero(inside)
    begins = track.times[steps[1:]] - track.times[steps[:-1] + 1] > _TOGETHER_NS
    begins |= np.cumsum(track.begins)[steps[1:]] != np.cumsum(track.begins)[steps[:-1]]
    for piece in np.split(steps, np.flatnonzero(begins) + 1):
        if len(piece):
            yield int(piece[0]), int(piece[-1]) + 1


def _bounds(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.minimum(values[1:], values[:-1]), np.maximum(values[1:], values[:-1])


def _every_pose(
    tracks: TrackReader, track: RobotTrack, stretches: Sequence[tuple[int, int]]
) -> Iterator[Line]:
    """Yields a line through each pose of a stretch, the newest stretch first, while time lasts."""
    for first, last in reversed(stretches):
        start, stop = int(track.times[first]), int(track.times[last]) + 1
        try:
            poses = tracks.poses(TimeWindow(start, stop))
        except QueryTimeoutError:
            return
        fine = np.isfinite(poses.x) & np.isfinite(poses.y)
        times, at = np.unique(poses.times[fine], return_index=True)
        begins = np.arange(len(times)) == 0
        yield Line(times, poses.x[fine][at], poses.y[fine][at], begins)


def _joined(lines: Sequence[Line]) -> Line:
    nothing = Line(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0, np.bool_))
    return Line(*(np.concatenate(column) for column in zip(nothing, *lines, strict=True)))


def _drawn(line: Line, pixel_m: float) -> Line:
    """Returns a line without what lies within half a pixel of it, or was drawn already.

    Of a path that takes too many points for that, it is as many pixels as it must be.
    """
    while True:
        simple = line.some(line.simplified(pixel_m / 2, max(len(line.times), 1)))
        few = _without_repeats(simple, pixel_m)
        if len(few.times) <= MOST_POINTS:
            return few
        pixel_m *= 2


def _without_repeats(line: Line, pixel_m: float) -> Line:
    """Returns a line without the steps of which each pixel was drawn by others."""
    if len(line.times) <= MOST_POINTS:
        return line
    dx, dy = np.diff(line.x), np.diff(line.y)
    counts = np.ceil(np.hypot(dx, dy) / pixel_m).astype(np.int64).clip(1)
    counts[line.begins[1:]] = 0
    if counts.sum() > _MOST_PIXELS:
        return line
    part = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(part)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[part]
    cells = np.stack([line.x[part] + dx[part] * share, line.y[part] + dy[part] * share]) // pixel_m
    row, column = (cells - cells.min(axis=1, keepdims=True)).astype(np.int64)
    _, first = np.unique(row * (int(column.max(initial=0)) + 1) + column, return_index=True)
    drawn = np.zeros(len(counts), np.bool_)
    drawn[part[first]] = True
    kept = np.append(drawn, [False]) | np.append([False], drawn)
    # A line leads to a point alone where that step is drawn.
    return line._replace(begins=~np.append([False], drawn)).some(np.flatnonzero(kept))

"""The path as it was driven, for the part of the map that is on the screen.

The first look has the robot's track: its lines may pass a pose by 5 cm, and of a long span it has
only some points. Here every pose in a box of the map counts: none lies farther from the lines than
half a pixel of the screen.
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
from ros2_memory.places.pose_frames import known_placement
from ros2_memory.places.robot_tracks import TrackReader

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory

MOST_POINTS: Final = 20_000
_MOST_PIXELS: Final = 20_000_000
"""In a longer path, as one that jumps far, repeated pixels are not searched for."""
_QUICK_S: Final = 2.0
_WHERE_LISTED: Final = "; list_recorded_topics lists all"
_TOGETHER_NS: Final = 5 * NS_PER_S
"""A robot may leave the box for this long within one stretch: each stretch is read separately."""


class Box(NamedTuple):
    """A part of the map: corners, and how long (m) a pixel of the screen is there."""

    x0: float
    y0: float
    x1: float
    y1: float
    pixel_m: float


class Line(NamedTuple):
    """Points of a path in order of time. `begins` marks the points that no line leads to."""

    times: Ints
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    begins: Flags

    def select(self, points: NDArray[np.intp]) -> Line:
        """Returns the points with these indices."""
        return Line(self.times[points], self.x[points], self.y[points], self.begins[points])

    def simplified(self, tolerance_m: float, at_most: int) -> NDArray[np.intp]:
        """Returns the indices of at most `at_most` points.

        No other point is farther than `tolerance_m` from the lines between them, as far as
        `at_most` allows. The ends of lines are among them.
        """
        count = len(self.times)
        if count < 3:
            return np.arange(count)
        is_end = self.begins | np.append(self.begins[1:], [True])
        is_end[0] = True
        ends = np.flatnonzero(is_end)
        points = np.stack([self.x, self.y, np.zeros(count)], axis=1)
        clock_s = (self.times - self.times[0]) / NS_PER_S
        ends = ends[evenly(len(ends), at_most)]
        indices, _ = simplified(points, clock_s, ends, tolerance_m=tolerance_m, at_most=at_most)
        return indices


class RobotPath(NamedTuple):
    """The robot's track in a window.

    Attributes:
        frame: of the track.
        track: the track.
        is_whole: False if there was not time for all of it.
        reader: reads each pose; None if the track comes from a satellite receiver.
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
    """Returns the robot's path in the map, else in the frame of odometry, else by its receiver.

    None if no topic places the robot.

    Raises:
        QueryTimeoutError: the call's time is over before any of it is known.
    """
    placement = known_placement(view)
    if placement is None:
        local = local_track(view, view.pose_topic, window)
        return None if local is None else RobotPath(*local, is_whole=True, reader=None)
    reader = TrackReader(view, placement.frame_id)
    # From a little earlier on, to know whether the path continues into the window.
    known = reader.track_in(TimeWindow(window.start - SILENCE_NS, window.stop))
    return RobotPath(
        placement.frame_id, cut_track(known.track, window), known.since is None, reader
    )


def path_in_box(memory: Memory, call: Call, window: TimeWindow, box: Box) -> JsonObject:
    """Returns the path in a window where it passes a box, as columns of points.

    `exact` tells whether every pose in the box counted.

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
    """Returns the robot's path, the line to draw in a box, and whether every pose there counted.

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
        lines = [*_lines_of_poses(path.reader, path.track, stretches)][::-1]
        is_exact = len(lines) == len(stretches)
    # The track stands in for the older stretches whose poses there was no time to read.
    older = [
        _one_line(path.line.select(np.arange(first, last + 1)))
        for first, last in stretches[: len(stretches) - len(lines)]
    ]
    return path, _draw(_concatenate([*older, *lines]), box.pixel_m), is_exact


def _one_line(line: Line) -> Line:
    """Returns the points as one line from the first to the last."""
    return line._replace(begins=np.arange(len(line.times)) == 0)


def why_no_path(view: View) -> str:
    """Returns why no topic places the robot, and which setting would give a path."""
    try:
        return f"{resolve_pose_topic(view)} has no poses"
    except NoDataError as error:
        # Without the advice that is for tool calls alone.
        return error.detail.replace(f", or {GIVE_TOPIC}", "").removesuffix(_WHERE_LISTED)


def stretches_inside(track: RobotTrack, box: Box) -> Iterator[tuple[int, int]]:
    """Yields the first and the last point of each stretch of a track that may pass a box."""
    margin = TOLERANCE_M + box.pixel_m
    may_pass = ~track.begins[1:]  # for each step from a point to the next
    for values, low, high in ((track.x, box.x0, box.x1), (track.y, box.y0, box.y1)):
        may_pass &= np.minimum(values[1:], values[:-1]) <= high + margin
        may_pass &= np.maximum(values[1:], values[:-1]) >= low - margin
    steps = np.flatnonzero(may_pass)
    line_of = np.cumsum(track.begins)[steps]
    is_apart = track.times[steps[1:]] - track.times[steps[:-1] + 1] > _TOGETHER_NS
    is_apart |= line_of[1:] != line_of[:-1]
    for stretch in np.split(steps, np.flatnonzero(is_apart) + 1):
        if len(stretch):
            yield int(stretch[0]), int(stretch[-1]) + 1


def _lines_of_poses(
    tracks: TrackReader, track: RobotTrack, stretches: Sequence[tuple[int, int]]
) -> Iterator[Line]:
    """Yields a line through all poses of each stretch, the newest first, while time lasts."""
    for first, last in reversed(stretches):
        start, stop = int(track.times[first]), int(track.times[last]) + 1
        try:
            poses = tracks.poses(TimeWindow(start, stop))
        except QueryTimeoutError:
            return
        is_finite = np.isfinite(poses.x) & np.isfinite(poses.y)
        times, rows = np.unique(poses.times[is_finite], return_index=True)
        x, y = poses.x[is_finite][rows], poses.y[is_finite][rows]
        yield _one_line(Line(times, x, y, np.zeros(len(times), np.bool_)))


def _concatenate(lines: Sequence[Line]) -> Line:
    nothing = Line(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0, np.bool_))
    return Line(*(np.concatenate(column) for column in zip(nothing, *lines, strict=True)))


def _draw(line: Line, pixel_m: float) -> Line:
    """Returns a line of at most `MOST_POINTS` points, within half a pixel of all points.

    If that takes more points, pixels are made larger until it does not.
    """
    while True:
        points = line.simplified(pixel_m / 2, max(len(line.times), 1))
        drawn = _without_repeats(line.select(points), pixel_m)
        if len(drawn.times) <= MOST_POINTS:
            return drawn
        pixel_m *= 2


def _without_repeats(line: Line, pixel_m: float) -> Line:
    """Returns a line without the steps whose pixels are all drawn by earlier steps."""
    if len(line.times) <= MOST_POINTS:
        return line
    dx, dy = np.diff(line.x), np.diff(line.y)
    counts = np.ceil(np.hypot(dx, dy) / pixel_m).astype(np.int64).clip(1)
    counts[line.begins[1:]] = 0
    if counts.sum() > _MOST_PIXELS:
        return line
    # One row for each pixel of each step.
    step = np.repeat(np.arange(len(counts)), counts)
    nth = np.arange(len(step)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = nth / counts[step]
    pixels = np.stack([line.x[step] + dx[step] * share, line.y[step] + dy[step] * share]) // pixel_m
    row, column = (pixels - pixels.min(axis=1, keepdims=True)).astype(np.int64)
    _, first = np.unique(row * (int(column.max(initial=0)) + 1) + column, return_index=True)
    is_drawn = np.zeros(len(counts), np.bool_)
    is_drawn[step[first]] = True
    is_needed = np.append(is_drawn, [False]) | np.append([False], is_drawn)
    begins = ~np.append([False], is_drawn)
    return line._replace(begins=begins).select(np.flatnonzero(is_needed))

"""Where the robot was farthest from a point, by its poses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.motion.robot_track import RobotTrack, cut, jumps
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import places_at
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.places.pose_frames import map_placement
from ros2_memory.places.region_visits import joined_in
from ros2_memory.places.robot_tracks import RobotTracks
from ros2_memory.places.where import parse_where
from ros2_memory.results import FarthestPose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.frames import Floats, Times
    from ros2_memory.history.view import View

_ARGUMENT: Final = "farthest_from"
_AROUND_NS: Final[Ns] = 10 * NS_PER_S
_OFF_TRACK_M: Final = 0.1
"""No pose is as far from the line of a track."""
_MOST_TRIED: Final = 20


def farthest_from(
    view: View,
    value: JsonValue,
    topic: str,
    spans: Sequence[tuple[Ns, Ns]],
    frame_id: str | None = None,
) -> FarthestPose | None:
    """Returns the pose in some times (both ends inclusive, in order) that is farthest from a point.

    The point, of `value`, is in the frame of places or in `frame_id`. None where no pose could be
    placed there.

    Raises:
        InvalidArgumentsError: `value` is no point, or the poses are not in its frame.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place = parse_where(view.limits, value, 1.0, _ARGUMENT)
    if place.several:
        raise InvalidArgumentsError(f"{_ARGUMENT} has several places; give one, or x and y")
    if topic != (known := resolve_path_topic(view)):
        raise InvalidArgumentsError(f"{_ARGUMENT} is measured along {known}: leave out topic")
    frame = map_placement(view, topic, place.frame_id or frame_id).frame_id
    min_x, max_x, min_y, max_y = place.region.bounds
    x, y = (min_x + max_x) / 2, (min_y + max_y) / 2
    if not spans:
        return None
    window = TimeWindow(spans[0][0], spans[-1][1] + 1)
    track, tracks = joined_in(view, frame, window).track, RobotTracks(view, frame)
    times, at_x, at_y = _along(track, spans)
    off_m = np.hypot(at_x - x, at_y - y)
    best: tuple[float, Ns, float, float] | None = None
    for nth in np.argsort(-off_m, kind="stable")[:_MOST_TRIED].tolist():
        if best is not None and off_m[nth] <= best[0] - _OFF_TRACK_M:
            break
        at = int(times[nth])
        first, last = next(span for span in spans if span[0] <= at <= span[1])
        around = TimeWindow(max(first, at - _AROUND_NS), min(last, at + _AROUND_NS) + 1)
        poses = tracks.poses(around)
        for time, pose_x, pose_y in zip(*(part.tolist() for part in poses[:3]), strict=True):
            away_m = math.hypot(pose_x - x, pose_y - y)
            is_near = away_m <= off_m[nth] + _OFF_TRACK_M  # else the robot jumped there, and back
            if is_near and (best is None or away_m > best[0]):
                best = away_m, time, pose_x, pose_y
    if best is None:
        return None
    away_m, time, *there = best
    inside = places_at(view.limits.places, frame, *there)
    return FarthestPose((x, y), frame, away_m, time, (there[0], there[1]), inside)


def _along(track: RobotTrack, spans: Sequence[tuple[Ns, Ns]]) -> tuple[Times, Floats, Floats]:
    """Returns where the track was in some times: its vertices, and where each begins and ends.

    Without those that the robot jumped to and from.
    """
    found = []
    for first, last in spans:
        part = cut(track, TimeWindow(first, last + 1))
        jumped = jumps(part)
        fine = ~(jumped & np.roll(jumped, 1))
        found.append((part.times[fine], part.x[fine], part.y[fine]))
    times, x, y = (np.concatenate(column) for column in zip(*found, strict=True))
    return times, x, y

"""The driven path of bags without a topic of poses: by transforms, or by a satellite receiver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.cli.output import format_duration
from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.driven_path import Body, robot_body
from ros2_memory.history.no_data import topics_that_show_poses, topics_with
from ros2_memory.history.transforms import transform_at

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import Geodetic, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View

_MOST_MOMENTS: Final = 300
"""Transforms that are looked up: each takes some milliseconds."""
_MOST_FIXES: Final = 4000
_RADIUS_M: Final = 6_378_137.0
_ECCENTRICITY_SQUARED: Final = 6.694_379_990_14e-3
"""Of the ellipsoid of WGS 84."""


@dataclass(frozen=True, slots=True)
class DrawnPath:
    """A driven path in a frame: where (m) and when, and which points the robot jumped to."""

    frame: str
    times: tuple[float, ...]
    xs: tuple[float, ...]
    ys: tuple[float, ...]
    jumps: tuple[bool, ...]

    def at(self, time: float) -> tuple[float, float]:
        """Returns where the robot was, between two points on the line between them."""
        return (
            float(np.interp(time, self.times, self.xs)),
            float(np.interp(time, self.times, self.ys)),
        )


FoundPath: TypeAlias = tuple[DrawnPath, str, "Sequence[str]"]
"""A path, a line on it, and notes."""


def path_without_poses(
    view: View, window: TimeWindow, topic: str | None, frame: str | None
) -> FoundPath | None:
    """Returns the path by transforms or by fixes, if that is what the topic has, or all there is.

    `topic`: None where the topic of poses is not recorded.

    Raises:
        NoDataError: there is nothing of it in this time, or it leads to no frame.
    """
    fixes = [each.partition(" ")[0] for each in topics_with(view, "geodetic")]
    body = robot_body(view)
    if topic is not None:
        if topic in fixes:
            return _by_fixes(view, window, topic)
        if body is None or topic not in view.memory.limits.tf_topics:
            return None
        return _by_transforms(view, window, body, frame)
    if topics_with(view, "position") or topics_that_show_poses(view):
        return None
    if body is not None:
        return _by_transforms(view, window, body, frame)
    return _by_fixes(view, window, fixes[0]) if fixes else None


def _by_transforms(
    view: View, window: TimeWindow, found_body: Body, frame: str | None
) -> FoundPath:
    """Returns the path of the robot's body in the map, or in the root of its frames."""
    parent, body, others = found_body
    parent = parent if frame is None else frame
    found: list[tuple[Ns, float, float]] = []
    failure: NoDataError | None = None
    for at in np.linspace(window.start, window.stop - 1, _MOST_MOMENTS).astype(np.int64).tolist():
        try:
            explains = failure is None
            x, y, _ = transform_at(view, parent, body, at, explains=explains).transform.translation
        except NoDataError as error:
            failure = failure or error
            continue
        found.append((at, x, y))
    if not found:
        raise failure or NoDataError(NoDataReason.OUTSIDE_RANGE, "no transform in this time")
    path = _drawn(parent, found)
    notes = [*view.notes.sentences()]
    if others:
        notes.append(f"other frames that move: {', '.join(others[:5])}; get_transform_at has them")
    by = f"{body} in {parent} by transforms, at {len(found)} times"
    return path, f"{_line(path)}; {by}", notes


def _by_fixes(view: View, window: TimeWindow, topic: str) -> FoundPath:
    """Returns the path of a satellite receiver, in metres east and north of its first fix."""
    total, messages = view.pick(topic, window, _MOST_FIXES)
    fixes: list[tuple[Ns, Geodetic]] = []
    for each in messages:
        message = view.bags.decode(each)
        extractor = view.memory.extractor
        fix = None if message is None else extractor.geodetic(message, each.record.channel.type)
        if fix is not None and math.isfinite(fix.latitude) and math.isfinite(fix.longitude):
            fixes.append((each.time, fix))
    if not fixes:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no message of {topic} has a position")
    first = fixes[0][1]
    path = _drawn(
        f"east and north of {first.latitude:.6f}, {first.longitude:.6f}",
        [(at, *east_north(first, fix)) for at, fix in fixes],
    )
    return (
        path,
        f"{_line(path)}; by {len(fixes)} of {total} fixes of {topic}",
        view.notes.sentences(),
    )


def east_north(origin: Geodetic, fix: Geodetic) -> tuple[float, float]:
    """Returns how far (m) a fix lies east and north of another, on the plane that touches there.

    By the ellipsoid's radii of curvature; off by 1 m some 10 km away.
    """
    latitude = math.radians(origin.latitude)
    flat = 1 - _ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    across = _RADIUS_M / math.sqrt(flat) * math.cos(latitude)
    along = _RADIUS_M * (1 - _ECCENTRICITY_SQUARED) / flat**1.5
    degrees_east = (fix.longitude - origin.longitude + 180) % 360 - 180
    degrees_north = fix.latitude - origin.latitude
    return math.radians(degrees_east) * across, math.radians(degrees_north) * along


def _drawn(frame: str, points: Sequence[tuple[Ns, float, float]]) -> DrawnPath:
    times, xs, ys = zip(*points, strict=True)
    return DrawnPath(frame, tuple(map(unix_from_ns, times)), xs, ys, (False,) * len(points))


def _line(path: DrawnPath) -> str:
    points = [*zip(path.xs, path.ys, strict=True)]
    driven = sum(math.dist(one, other) for one, other in pairwise(points))
    return f"{driven:.1f} m in {format_duration(path.times[-1] - path.times[0])}"

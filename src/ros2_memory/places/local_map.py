"""A satellite receiver's fixes as a map in metres, east and north of one of them."""

from __future__ import annotations

import math
from itertools import chain, islice
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.motion.robot_track import RobotTrack, empty_track, track_of
from ros2_memory.core.model import Geodetic, TimeWindow
from ros2_memory.history.scan import pick

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View

MOST_FIXES: Final = 4000
"""How many messages of a path are read, evenly spaced."""
_MOST_TRIED: Final = 1000
"""How many first messages are tried: before it has satellites a receiver sends no position."""
_MOST_BAGS: Final = 200
"""In how many bags the last message is tried, too."""
_RADIUS_M: Final = 6_378_137.0
"""The equatorial radius of the WGS 84 ellipsoid."""
_ECCENTRICITY_SQUARED: Final = 6.694_379_990_14e-3
"""The first eccentricity of the WGS 84 ellipsoid, squared."""


def east_north(origin: Geodetic, fix: Geodetic) -> tuple[float, float]:
    """Returns how far (m) a fix lies east and north of an origin, in the plane tangent there.

    It uses the radii of curvature of the ellipsoid. The error is 1 m at a distance of 10 km.
    """
    latitude = math.radians(origin.latitude)
    flat = 1 - _ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    across = _RADIUS_M / math.sqrt(flat) * math.cos(latitude)
    along = _RADIUS_M * (1 - _ECCENTRICITY_SQUARED) / flat**1.5
    degrees_east = (fix.longitude - origin.longitude + 180) % 360 - 180
    degrees_north = fix.latitude - origin.latitude
    return math.radians(degrees_east) * across, math.radians(degrees_north) * along


def local_frame(origin: Geodetic) -> str:
    """Returns the name of the frame around a fix, as people read it."""
    return f"east and north of {origin.latitude:.6f}, {origin.longitude:.6f}"


def fixes_in(view: View, topic: str, window: TimeWindow) -> list[tuple[Ns, Geodetic]]:
    """Returns the fixes among `MOST_FIXES` messages of a window."""
    _, messages = pick(view, topic, window, MOST_FIXES)
    return [*_fixes(view, messages)]


def local_track(view: View, topic: str, window: TimeWindow) -> tuple[str, RobotTrack] | None:
    """Returns the path of a receiver in a window, and the frame that it is in.

    The origin of the frame is the first fix among the topic's first messages or, if these have
    none, among the last messages of its bags. None if there is no such fix.
    """
    if topic not in view.timeline.topics():
        return None
    everything = TimeWindow.everything()
    first = islice(view.stream.messages([topic], everything), _MOST_TRIED)
    ends = np.unique(view.bounds(topic, everything)[1])[:_MOST_BAGS].tolist()
    lasts = filter(None, (view.stream.last(topic, end + 1) for end in ends))
    first_fix = next(_fixes(view, chain(first, lasts)), None)
    if first_fix is None:
        return None
    _, origin = first_fix
    fixes = fixes_in(view, topic, window)
    if not fixes:
        return local_frame(origin), empty_track()
    times = np.array([at for at, _ in fixes], np.int64)
    x, y = np.array([east_north(origin, fix) for _, fix in fixes]).T
    unknown = np.full(len(fixes), math.nan)
    return local_frame(origin), track_of(times, x, y, unknown, unknown)


def _fixes(view: View, messages: Iterable[StoredMessage]) -> Iterator[tuple[Ns, Geodetic]]:
    """Yields the log time and the position of each message that has a fix."""
    extractor = view.extractor
    for stored, message in view.bags.decoded(messages):
        fix = extractor.geodetic(message, stored.type)
        if fix is not None and fix.has_fix and math.isfinite(fix.latitude + fix.longitude):
            yield stored.time, fix

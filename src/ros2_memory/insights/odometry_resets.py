"""When odometry began anew: from then on the same coordinates are another place.

`motion.link` decides, for the way driven and for visits alike.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.history.driven_path import driven_path

if TYPE_CHECKING:
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View


def odometry_resets(view: View, topic: str, since: Ns) -> tuple[Ns, ...]:
    """The times of the first poses of odometry that began anew after a moment, in order."""
    # Poses that cannot be read, or are none, do not say where odometry is.
    with suppress(InvalidArgumentsError, NoDataError):
        way = driven_path(view, topic, TimeWindow(since, MAX_NS))
        if way is not None:
            return way.trajectory.resets
    return ()

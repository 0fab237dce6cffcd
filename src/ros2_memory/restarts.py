"""When odometry began anew: from then on the same coordinates are another place.

It does when the robot is switched on: after a silence its poses go on elsewhere, by more than
`MOVED_M`; or without one they step, faster than is plausible, to the origin.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from ros2_memory.model import TimeWindow
from ros2_memory.portions import Kept, is_whole
from ros2_memory.presences import SILENCE_NS
from ros2_memory.timebase import MAX_NS, unix_from_ns
from ros2_memory.ways import POSES, stops

if TYPE_CHECKING:
    from ros2_memory.history import View
    from ros2_memory.motion import PoseDigest, Stop
    from ros2_memory.timebase import Ns

MOVED_M: Final = 1.0


def restarts(view: View, topic: str, since: Ns) -> list[Ns]:
    """The times of the first poses of odometry that began anew after a moment, in order."""
    window = TimeWindow(since, MAX_NS)
    kept: Kept[PoseDigest] = Kept(view, topic, POSES, window)
    fastest = view.memory.limits.max_plausible_speed_mps
    found: list[Ns] = []
    before: Stop | None = None
    for group in view.groups(topic, window):
        known = kept.of(group) if is_whole(group, window) else None
        digest = None if known is None else known[0]
        steady = digest is not None and _is_steady(digest)
        poses = [digest.first] if digest is not None and steady else stops(view, group.once())
        for stop in filter(None, poses):
            if before is not None and _is_anew(before, stop, fastest):
                found.append(stop.time)
            before = stop
        if digest is not None and steady:
            before = digest.last or before
    return found


def _is_steady(digest: PoseDigest) -> bool:
    """Whether odometry certainly did not begin anew between the poses of a digest."""
    if digest.jumps or digest.invalid:
        return False
    # Two poses next to each other lie between two vertices, and by the path or next to it.
    nearer = MOVED_M - 2 * digest.error_m
    return all(
        after - before <= SILENCE_NS or math.dist(here, there) < nearer
        for (before, here, _), (after, there, _) in pairwise(digest.vertices)
    )


def _is_anew(before: Stop, after: Stop, fastest_mps: float) -> bool:
    step = math.dist(before.position, after.position)
    if step <= MOVED_M:
        return False
    apart = after.time - before.time
    if apart > SILENCE_NS:
        return True
    jumped = step > fastest_mps * unix_from_ns(apart)
    return jumped and math.hypot(*after.position) <= MOVED_M

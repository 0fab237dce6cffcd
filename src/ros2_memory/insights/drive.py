"""How the robot moved in a window: its path, and where it stood still."""

from __future__ import annotations

from bisect import bisect_left
from contextlib import suppress
from dataclasses import dataclass
from heapq import merge
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.motion.standstills import (
    BESIDE_NS,
    CONTEXT_NS,
    CREEP_MPS,
    DROP_SLOT_NS,
    SHORTEST_NS,
    SILENCE_NS,
    SpeedDrop,
    Stands,
    Standstill,
    stands_of,
    standstills_of,
)
from ros2_memory.analysis.motion.trajectory import SLICE_NS, PathSlice, Trajectory
from ros2_memory.columns.kinds import STANDS
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import without
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    START_SLACK_NS,
    Ns,
    ns_from_unix,
    unix_from_ns,
)
from ros2_memory.history.clock_steps import across_steps, elapsed_in
from ros2_memory.history.coverage import reached, recording_gaps
from ros2_memory.history.driven_path import (
    PoseSlice,
    driven_path,
    resolve_path_topic,
    slices_by_poses,
    slices_of_path,
)
from ros2_memory.history.no_data import resolve_pose_topic
from ros2_memory.history.robots import require_one_robot
from ros2_memory.places.pose_frames import NEWEST_POSE_NS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.history.view import View

_BRAKING_NS: Final[Ns] = 4 * NS_PER_S
"""A standstill that begins so soon after a loss of speed is what that led to."""
_MOST_MISSING: Final = 0.1
"""Where poses are missing for more of the time, how long the robot stood is not known."""


class Stop(NamedTuple):
    """A standstill, as far as it is in a window, and whether it goes on after that."""

    standstill: Standstill
    goes_on: bool

    @property
    def length(self) -> Ns:
        """How long it lasts in the window."""
        return self.standstill.end - self.standstill.start


@dataclass(frozen=True, slots=True)
class Drive:
    """How the robot moved: its path, and its standstills.

    `drops` are sudden losses of speed that no standstill follows. `elapsed` is how much time passed
    between moments of the window, `recorded` for how much of it, from where the path is known on,
    something was recorded.
    """

    elapsed: Elapsed
    path: PathSlice | None = None
    trajectory: Trajectory | None = None
    standstills: tuple[Stop, ...] = ()
    drops: tuple[SpeedDrop, ...] = ()
    recorded: Ns = 0

    @property
    def valid_trajectory(self) -> Trajectory | None:
        """The path's trajectory, if it has a valid pose."""
        trajectory = self.trajectory
        return trajectory if trajectory is not None and trajectory.is_known else None

    def stops(self, length: Ns) -> tuple[Stop, ...]:
        """Returns the standstills that a window of a length lists.

        Those that fill it, or last half of the shortest one in it: so of windows that follow each
        other one at least lists it, and none lists the last moment of one before it.
        """
        least = min(SHORTEST_NS // 2, length)
        return tuple(stop for stop in self.standstills if stop.length >= least)

    def stood(self, length: Ns) -> Ns | None:
        """Returns how long the robot stood in all, in a window of a length; None if not known.

        It is not known where no pose has a valid position, nor where poses are too far apart to
        show it, or missing for much of the time in which something was recorded: some robots
        publish none while they stand. Nor where the robot neither moved nor stood for most of the
        time: noise hides where it stood.
        """
        stood = self.elapsed.among(
            (standstill.start, standstill.end) for standstill, _ in self.standstills
        )
        trajectory = self.valid_trajectory
        if trajectory is None:
            return stood or None
        recorded_s = trajectory.totals.duration_s - unix_from_ns(trajectory.totals.gap_ns)
        if ns_from_unix(recorded_s) > SILENCE_NS * max(trajectory.poses - 1, 1):
            return None
        missing = self.recorded - ns_from_unix(recorded_s)
        if missing > max(SHORTEST_NS, _MOST_MISSING * self.recorded):
            return None
        else_s = recorded_s - unix_from_ns(stood)
        is_slow = else_s > recorded_s / 2 and trajectory.totals.distance_m <= CREEP_MPS * else_s
        # A window without a standstill may begin and end beyond its poses.
        lasted = ns_from_unix(else_s) if stood else length
        is_hidden = is_slow and lasted >= SHORTEST_NS and not (stood and trajectory.totals.gaps)
        return None if is_hidden else stood


def drive_in(view: View, window: TimeWindow) -> Drive:
    """Returns how the robot moved; nothing, with a note, if that is unknown."""
    elapsed = elapsed_in(view, window)
    try:
        topic = resolve_path_topic(view)
        require_one_robot(view, topic, window)
        path, since = driven_path(view, topic, window)
        begin = window.start if since is None else since
        standstills, drops = _standstills_in(view, topic, TimeWindow(begin, window.stop))
    except (InvalidArgumentsError, NoDataError) as error:
        view.notes.add(f"the path is unknown: {error}")
        return Drive(elapsed)
    if path is None:
        view.notes.add(f"{topic} has no poses in this time: the path is unknown")
        return Drive(elapsed, None, None, standstills, drops)
    trajectory = across_steps(path.trajectory(0), path, elapsed)
    known = reached(view.snapshot, TimeWindow(begin, window.stop))
    spans = without([known.asked()], [*recording_gaps(view, known)])
    recorded = elapsed.among(spans)
    return Drive(elapsed, path, trajectory, standstills, drops, recorded)


def _standstills_in(
    view: View, topic: str, window: TimeWindow
) -> tuple[tuple[Stop, ...], tuple[SpeedDrop, ...]]:
    """Returns where the robot of a pose topic stood still, and where it lost speed without that.

    Each in order. A standstill goes on where it does after the window, or up to the last pose that
    is known, but not where other topics were recorded for long after that pose.

    Poses outside of the window count too: a standstill that goes on beyond an end of the window
    ends there, however little of it is inside. So those of windows that follow each other add up.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    slices = _stands_of_slices(view, topic, window.widened(CONTEXT_NS))
    stands = [stand for _, stand in slices][::-1]
    standing = standstills_of([stand.blocks for stand in stands])
    starts = [standstill.start for standstill in standing]
    start, end = window.start + START_SLACK_NS, window.stop - 1 - AT_OR_BEFORE_SLACK_NS
    drops = tuple(
        drop
        for stand in stands
        for drop in stand.drops
        if start <= drop.time <= end
        and bisect_left(starts, drop.time - DROP_SLOT_NS)
        == bisect_left(starts, drop.time + _BRAKING_NS)
    )
    last = max((stand.last for stand in stands), default=MIN_NS)
    later = min(last, MAX_NS - NEWEST_POSE_NS) + NEWEST_POSE_NS
    was_recorded_later = bool(view.timeline.overlapping(TimeWindow(later, later + 1)))
    stops = tuple(
        Stop(
            stood._replace(start=max(stood.start, start), end=min(stood.end, end)),
            stood.end > end or (stood.end == last and not was_recorded_later),
        )
        for stood in standing
        if stood.start < end and stood.end > start
    )
    return stops, drops


def _stands_of_slices(view: View, topic: str, window: TimeWindow) -> Iterator[tuple[Ns, Stands]]:
    """Yields what shows where the robot stood; see `slices_by_poses`."""

    def make(part: PoseSlice) -> Stands:
        return stands_of(part.poses, part.start, part.stop)

    return slices_by_poses(view, topic, window, STANDS, make, failures=[], beside=BESIDE_NS)


def make_drive_slices(view: View, window: TimeWindow) -> Iterator[Ns]:
    """Makes the slices of the path in a window, and of where the robot stood, the newest first.

    Yields the log time (ns) of each.
    """
    with suppress(InvalidArgumentsError, NoDataError):
        topic = resolve_pose_topic(view)
        path = slices_of_path(view, topic, window.widened(SLICE_NS), [])
        stands = _stands_of_slices(view, topic, window.widened(SLICE_NS + BESIDE_NS))
        yield from merge((at for at, _ in path), (at for at, _ in stands), reverse=True)

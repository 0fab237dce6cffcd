"""How the robot moved in a window: its path, and where it stood still."""

from __future__ import annotations

from bisect import bisect_left
from contextlib import suppress
from dataclasses import dataclass, replace
from heapq import merge
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.clock_steps import across_steps
from ros2_memory.analysis.motion.standstills import (
    BESIDE_NS,
    CONTEXT_NS,
    CREEP_MPS,
    DROP_SLOT_NS,
    SHORTEST_NS,
    SILENCE_NS,
    Blocks,
    SpeedDrop,
    Stands,
    Standstill,
    stands_of,
    standstills_of,
)
from ros2_memory.analysis.motion.trajectory import SLICE_NS, PathSlice, Trajectory
from ros2_memory.columns.fragments import FragmentKind
from ros2_memory.core.arrays import stacked
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import listed
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
from ros2_memory.history.coverage import recording_gaps, shown_span, span_text
from ros2_memory.history.driven_path import (
    PoseSlice,
    driven_path,
    resolve_path_topic,
    slices_by_poses,
    slices_of_path,
)
from ros2_memory.history.no_data import describe_earlier_poses, resolve_pose_topic
from ros2_memory.history.robots import parallel_or_twice, require_one_robot
from ros2_memory.places.pose_frames import NEWEST_POSE_NS, with_runs

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.history.view import View


def _joined_stands(parts: Sequence[Stands]) -> Sequence[Stands]:
    drops = tuple(drop for part in parts for drop in part.drops)
    return [
        Stands(stacked([part.blocks for part in parts]), drops, max(part.last for part in parts))
    ]


STANDS: Final = FragmentKind("stands", (Stands, Blocks, SpeedDrop), _joined_stands)
"""Where the robot may have stood in a slice of the clock, by the poses of a topic."""
_BRAKING_NS: Final[Ns] = 4 * NS_PER_S
"""A standstill that begins so soon after a loss of speed is the end of braking."""
_MOST_MISSING: Final = 0.1
"""If poses are missing for more of the recorded time, how long the robot stood is unknown."""


@dataclass(frozen=True, slots=True)
class Drive:
    """How the robot moved in a window: its path, and its standstills.

    Attributes:
        length: of the window (ns).
        elapsed: tells how much time passed between two moments of the window.
        standstills: the parts of standstills in the window.
        drops: sudden losses of speed that no standstill follows.
        recorded: for how long (ns) anything was recorded since the path is known.
    """

    length: Ns
    elapsed: Elapsed
    path: PathSlice | None = None
    trajectory: Trajectory | None = None
    standstills: tuple[Standstill, ...] = ()
    drops: tuple[SpeedDrop, ...] = ()
    recorded: Ns = 0

    @property
    def valid_trajectory(self) -> Trajectory | None:
        """The trajectory of the path; None without a valid pose."""
        trajectory = self.trajectory
        return trajectory if trajectory is not None and trajectory.is_known else None

    @property
    def stops(self) -> list[Standstill]:
        """The standstills that the window lists.

        They fill the window, or last half of the shortest standstill in it. So at least one of two
        consecutive windows lists a standstill across their bound, and none lists its last moment.
        """
        least = min(SHORTEST_NS // 2, self.length)
        return [stop for stop in self.standstills if stop.length >= least]

    @property
    def stood(self) -> Ns | None:
        """How long (ns) the robot stood in the window; None if that is unknown.

        It is unknown in these cases:

        - No pose has a valid position.
        - Poses are too far apart to show standstills.
        - Poses are missing for much of the recorded time: some robots have none while they stand.
        - The robot neither moved nor stood for most of the time: noise hides where it stood.
        """
        stood = self.elapsed.among(stop.span for stop in self.standstills)
        trajectory = self.valid_trajectory
        if trajectory is None:
            return stood or None
        recorded_s = trajectory.totals.duration_s - unix_from_ns(trajectory.totals.gap_ns)
        if ns_from_unix(recorded_s) > SILENCE_NS * max(trajectory.poses - 1, 1):
            return None
        missing = self.recorded - ns_from_unix(recorded_s)
        if missing > max(SHORTEST_NS, _MOST_MISSING * self.recorded):
            return None
        moving_s = recorded_s - unix_from_ns(stood)
        is_slow = moving_s > recorded_s / 2 and trajectory.totals.distance_m <= CREEP_MPS * moving_s
        # A window without a standstill may begin and end beyond its poses.
        lasted = ns_from_unix(moving_s) if stood else self.length
        is_hidden = is_slow and lasted >= SHORTEST_NS and not (stood and trajectory.totals.gaps)
        return None if is_hidden else stood


def drive_in(view: View, window: TimeWindow) -> Drive:
    """Returns how the robot moved in a window. If that is unknown, a note says why."""
    elapsed, (start, end) = view.elapsed_in(window), window.asked()
    unknown = Drive(end - start, elapsed)
    try:
        topic = resolve_path_topic(view)
        require_one_robot(view, topic, window)
        path, since = driven_path(view, topic, window)
        begin = window.start if since is None else since
        standstills, drops = _stops_and_drops(view, topic, TimeWindow(begin, window.stop))
    except (InvalidArgumentsError, NoDataError) as error:
        view.notes.add(f"the path is unknown: {error}")
        return unknown
    stands = replace(unknown, standstills=standstills, drops=drops)
    if path is None:
        is_twice = any(pair.is_twice for pair in parallel_or_twice(view, topic, window))
        which = " that count" if is_twice else ""
        elsewhere = describe_earlier_poses(view, topic, window.stop)
        view.notes.add(f"{topic} has no poses in this time{which}: the path is unknown{elsewhere}")
        return stands
    trajectory = across_steps(with_runs(view, topic, path, path.trajectory(0)), path, elapsed)
    window = TimeWindow(begin, window.stop)
    (start, end), gaps = shown_span(view.snapshot, window), [*recording_gaps(view, window)]
    recorded = elapsed.among(without([(start, end)], gaps))
    absent = united([*gaps, *elapsed.skipped])
    beyond = without([(start, path.first), (path.last, end)], absent)
    long = [span_text(*span) for span in beyond if span[1] - span[0] > NEWEST_POSE_NS]
    if long:
        view.notes.add(f"{topic} has no poses from {listed(long)}: the path is without that time")
    return replace(stands, path=path, trajectory=trajectory, recorded=recorded)


def _stops_and_drops(
    view: View, topic: str, window: TimeWindow
) -> tuple[tuple[Standstill, ...], tuple[SpeedDrop, ...]]:
    """Returns the standstills and the sudden losses of speed in a window, each in order.

    Poses outside of the window count too. A standstill across a bound of the window ends there,
    however little of it is inside: so the standstills of consecutive windows add up.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    slices = _stands_of_slices(view, topic, window.widened(CONTEXT_NS))
    stands = [stand for _, stand in slices][::-1]
    standstills = standstills_of([stand.blocks for stand in stands])
    start, end = window.start + START_SLACK_NS, window.stop - 1 - AT_OR_BEFORE_SLACK_NS
    begins = [standstill.start for standstill in standstills]
    drops = []
    for stand in stands:
        for drop in stand.drops:
            first = bisect_left(begins, drop.time - DROP_SLOT_NS)
            is_braking = first < bisect_left(begins, drop.time + _BRAKING_NS)
            if start <= drop.time <= end and not is_braking:
                drops.append(drop)
    last = max((stand.last for stand in stands), default=MIN_NS)
    # A standstill up to the last known pose goes on, unless other topics were recorded for long
    # after that.
    later = min(last, MAX_NS - NEWEST_POSE_NS) + NEWEST_POSE_NS
    was_recorded_later = bool(view.timeline.overlapping(TimeWindow(later, later + 1)))
    stops = []
    for standstill in standstills:
        if standstill.start < end and standstill.end > start:
            is_newest = standstill.end == last and not was_recorded_later
            part = standstill._replace(
                start=max(standstill.start, start),
                end=min(standstill.end, end),
                goes_on=standstill.end > end or is_newest,
            )
            stops.append(part)
    return tuple(stops), tuple(drops)


def _stands_of_slices(view: View, topic: str, window: TimeWindow) -> Iterator[tuple[Ns, Stands]]:
    """Yields what standstills follow from, slice by slice; see `slices_by_poses`."""

    def make(part: PoseSlice) -> Stands:
        return stands_of(part.poses, part.start, part.stop)

    return slices_by_poses(view, topic, window, STANDS, make, beside=BESIDE_NS)


def make_drive_slices(view: View, window: TimeWindow) -> Iterator[Ns]:
    """Makes and stores the slices of the path and of standstills in a window, the newest first.

    Yields the log time (ns) of each slice.
    """
    with suppress(InvalidArgumentsError, NoDataError):
        topic = resolve_pose_topic(view)
        path = slices_of_path(view, topic, window.widened(SLICE_NS))
        stands = _stands_of_slices(view, topic, window.widened(SLICE_NS + BESIDE_NS))
        yield from merge((at for at, _ in path), (at for at, _ in stands), reverse=True)

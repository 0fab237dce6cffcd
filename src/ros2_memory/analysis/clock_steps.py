"""Steps of the clock that dates messages. Pure decisions.

A clock that is set forward leaves a hole, in which no topic has a message. So does a recorder that
stalls. Two things show a step:

- The robot drove on both sides, and is where it would be without the hole: no time passed.
- Header stamps of another clock go on across the hole in their cadence. From then on messages are
  recorded later after their stamps, by the length of the step. What a stalled recorder receives
  late has such stamps, too, but only until its queues are empty.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.motion.odometry import GAP_NS, GAP_PERIODS
from ros2_memory.analysis.motion.trajectory import PathSlice, Trajectory, mean_speed
from ros2_memory.core.timebase import NS_PER_S, Ns, Span, ns_from_unix, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.poses import Poses
    from ros2_memory.storage.base import IntArray

SHORTEST_STEP_NS: Final = 2 * NS_PER_S
SHORTEST_BY_STAMPS_NS: Final = NS_PER_S // 2
"""Header stamps show shorter steps than poses do."""
STAMPS_BESIDE_NS: Final = 5 * NS_PER_S
"""Delays beside a hole are measured over this time, in which queues become empty."""
_FEWEST_STAMPS: Final = 5
_LIVE_NS: Final = NS_PER_S
"""Messages must go on for so long after a hole: the first ones may have waited in a queue."""
ALIKE_NS: Final = NS_PER_S // 10
"""How much the delays on one side, and the steps by several topics, may differ."""
_AGREEING: Final = 2
"""How many topics must show a step: the clock of one sensor may be set by itself."""
BESIDE_NS: Final = NS_PER_S
"""The speed of the robot beside a hole is measured over this time."""
_DRIVING_MPS: Final = 0.1
_MOVED: Final = 0.3
"""Across a step, the robot moved less than this share of the distance it drives in such a time."""


class ClockStep(NamedTuple):
    """A step of the clock (ns): forward, or back if `by` is negative.

    `at` is the last log time before a step forward, and the first one after a step back.
    """

    at: Ns
    by: Ns


class Elapsed:
    """Computes how much time passed between log times across steps of the clock.

    The time that a step forward skips never passed and does not count. Of a step back only a bound
    is known: it changes nothing here. So adjacent durations add up, and none is negative.

    Attributes:
        skipped: the times that steps forward skipped, as half-open spans, in order.
    """

    def __init__(self, steps: Iterable[ClockStep] = ()) -> None:
        self.skipped = tuple((at, at + by) for at, by in sorted(steps) if by > 0)

    def between(self, start: Ns, stop: Ns) -> Ns:
        """Returns how much time (ns) passed from one log time to another."""
        return stop - start - self.skipped_between(start, stop)

    def among(self, spans: Iterable[Span]) -> Ns:
        """Returns how much time (ns) passed in all spans together."""
        return sum(self.between(start, stop) for start, stop in spans)

    def skipped_between(self, start: Ns, stop: Ns) -> Ns:
        """Returns how much time (ns) the clock skipped between two log times."""
        return sum(max(0, min(stop, end) - max(start, begin)) for begin, end in self.skipped)


def across_steps(trajectory: Trajectory, path: PathSlice, elapsed: Elapsed) -> Trajectory:
    """Returns the trajectory of a path without the steps of the clock: no gaps, and no time.

    A step counts as a gap if it is longer than the usual time between poses explains; see
    `odometry`.
    """
    skipped = elapsed.skipped_between(path.first, path.last)
    if not skipped or trajectory.poses < 2:
        return trajectory
    totals = trajectory.totals
    usual = (ns_from_unix(totals.duration_s) - totals.gap_ns) // (trajectory.poses - 1)
    # Between two poses lie a step and the usual time.
    longest = max(GAP_NS, GAP_PERIODS * usual) - usual
    counted_as_gaps = [
        stop - begin
        for begin, stop in elapsed.skipped
        if path.first <= begin and stop <= path.last and stop - begin > longest
    ]
    gaps = max(0, totals.gaps - len(counted_as_gaps))
    gap_ns = totals.gap_ns - sum(counted_as_gaps)
    without_gaps = replace(
        totals,
        gaps=gaps,
        gap_m=totals.gap_m if gaps else 0.0,
        gap_ns=gap_ns if gap_ns > GAP_NS else 0,
    )
    elapsed_s = totals.duration_s - unix_from_ns(skipped)
    avg_speed = mean_speed(totals.distance_m, elapsed_s) or trajectory.avg_speed
    return replace(trajectory, totals=without_gaps, avg_speed=avg_speed)


def while_recorded(trajectory: Trajectory, elapsed: Elapsed, path: PathSlice) -> Trajectory:
    """Returns a trajectory whose mean speed leaves out the time of gaps (`gap_ns`).

    Its length leaves out the metres across gaps as well.
    """
    gap_ns = trajectory.totals.gap_ns
    recorded = elapsed.between(path.first, path.last) - gap_ns
    if not gap_ns or recorded <= 0:
        return trajectory
    avg_speed, fastest = mean_speed(trajectory.totals.distance_m, unix_from_ns(recorded)), None
    if trajectory.max_speed_from == "twist":
        fastest = trajectory.max_speed
    elif avg_speed is not None:
        fastest = max(trajectory.max_speed or 0.0, avg_speed)
    return replace(trajectory, avg_speed=avg_speed, max_speed=fastest)


def delay_change(hole: Span, log_times: IntArray, stamps: IntArray) -> Ns | None:
    """Returns how much the delay of a topic's messages, from stamp to log time, grew (ns).

    None if that is not clear: there are few messages, the delays vary, or the stamps have the hole,
    too.

    Args:
        hole: the log times of the last message (of any topic) before it, and of the first after.
        log_times: log times (ns) of the topic's messages up to `STAMPS_BESIDE_NS` from the hole.
        stamps: their header stamps (ns).
    """
    last_before, first_after = hole
    is_before = log_times <= last_before
    delays = log_times - stamps
    sides = (delays[is_before], delays[~is_before])
    if min(side.size for side in sides) < _FEWEST_STAMPS:
        return None
    if log_times.max() - first_after < _LIVE_NS:
        return None
    if any(np.percentile(side, 90) - np.percentile(side, 10) > ALIKE_NS for side in sides):
        return None
    passed = int(stamps[~is_before].min()) - int(stamps[is_before].max())
    if not 0 < passed < (first_after - last_before) // 2:
        return None
    before, after = (int(np.median(side)) for side in sides)
    return after - before


def step_by_delays(last_before: Ns, changes: Sequence[Ns]) -> ClockStep | None:
    """Returns the clock step at a hole; None if it is no step, or not clearly one.

    Args:
        last_before: the log time of the last message before the hole.
        changes: the `delay_change` of several topics.
    """
    if len(changes) < _AGREEING or max(changes) - min(changes) > ALIKE_NS:
        return None
    by = int(np.median(changes))
    return ClockStep(last_before, by) if by >= SHORTEST_BY_STAMPS_NS else None


def step_over(last_before: Ns, before: Poses, after: Poses) -> ClockStep | None:
    """Returns the clock step at a hole; None if it may be a pause of the recording.

    Args:
        last_before: the log time of the last message before the hole.
        before: the poses in the last `BESIDE_NS` before it.
        after: the poses in the first `BESIDE_NS` after it.
    """
    speed_mps = min(_speed_mps(before), _speed_mps(after))
    if speed_mps < _DRIVING_MPS:
        return None
    length = int(after.times[0] - before.times[-1])
    moved_m = math.dist(before.positions[-1], after.positions[0])
    if moved_m > _MOVED * speed_mps * unix_from_ns(length):
        return None
    by = length - ns_from_unix(moved_m / speed_mps)
    return ClockStep(last_before, by) if by >= SHORTEST_STEP_NS else None


def _speed_mps(poses: Poses) -> float:
    """Returns the mean speed from the first to the last pose; 0 over less than 0.25 s."""
    lasted = int(poses.times[-1] - poses.times[0]) if len(poses) else 0
    if lasted < BESIDE_NS // 4:
        return 0.0
    return math.dist(poses.positions[0], poses.positions[-1]) / unix_from_ns(lasted)

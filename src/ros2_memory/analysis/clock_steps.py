"""Steps of the clock that dates messages, found where the robot drove through one. Pure decisions.

A clock that is set forward leaves a hole: for so long no topic has a message. So does a recorder
that stalls. They differ in where the robot is afterwards: time that never passed moved nothing. So
a hole is a step where the robot drove on both sides, and is where it would be if the hole were not
there. And where header stamps of another clock go on in their cadence across it: from then on
messages are recorded that much later after their stamps. What a stalled recorder receives late has
such stamps, too, but only as long as its queues were.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.timebase import NS_PER_S, Ns, Span, ns_from_unix, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.poses import Poses
    from ros2_memory.storage.base import IntArray

SHORTEST_STEP_NS: Final = 2 * NS_PER_S
SHORTEST_BY_STAMPS_NS: Final = NS_PER_S // 2
"""Header stamps show shorter steps than poses do."""
STAMPS_BESIDE_NS: Final = 5 * NS_PER_S
"""Delays beside a hole are measured over this long: what stays is no queue that empties."""
_FEWEST_STAMPS: Final = 5
_LIVE_NS: Final = NS_PER_S
"""Messages must go on for so long after a hole: the first ones may have waited in a queue."""
ALIKE_NS: Final = NS_PER_S // 10
"""By how much the delays on one side, and the steps by several topics, may differ."""
_AGREEING: Final = 2
"""Topics that must show a step: the clock of one sensor may be set as well."""
BESIDE_NS: Final = NS_PER_S
"""How the robot drives beside a hole is measured over this long."""
_DRIVING_MPS: Final = 0.1
_MOVED: Final = 0.3
"""It drove less than this share of the distance that it would have driven in the hole."""


class ClockStep(NamedTuple):
    """A clock was set at a log time: forward by so much, or back by so much where negative.

    `at` is the last log time before a step forward, and the first one after a step back.
    """

    at: Ns
    by: Ns


class Elapsed:
    """How much time passed between log times, where the clock was set at some moments.

    A step forward skipped the time that follows it on the clock, which never passed and does not
    count. A step back is known as a bound alone, and changes nothing here. So durations that adjoin
    add up, and none is negative.

    Attributes:
        skipped: the times that steps forward skipped, as half-open spans, in order.
    """

    def __init__(self, steps: Iterable[ClockStep] = ()) -> None:
        self.skipped = tuple((at, at + by) for at, by in sorted(steps) if by > 0)

    def between(self, start: Ns, stop: Ns) -> Ns:
        """Returns how much time passed from one moment to another."""
        return stop - start - self.skipped_between(start, stop)

    def among(self, spans: Iterable[Span]) -> Ns:
        """Returns how much time passed in spans, all together."""
        return sum(self.between(start, stop) for start, stop in spans)

    def skipped_between(self, start: Ns, stop: Ns) -> Ns:
        """Returns how much of the time from one moment to another the clock skipped."""
        return sum(max(0, min(stop, end) - max(start, begin)) for begin, end in self.skipped)


def delay_change(hole: Span, log_times: IntArray, stamps: IntArray) -> Ns | None:
    """Returns by how much the delays of a topic's messages, from stamp to log time, changed.

    None where that is not plain: of few messages, of delays that go up and down, or where the
    stamps have the hole, too.

    Args:
        hole: the log times of the last message (of any topic) before it, and of the first after.
        log_times: of messages up to `STAMPS_BESIDE_NS` from it, ns.
        stamps: their header stamps, ns.
    """
    last_before, first_after = hole
    is_before = log_times <= last_before
    delays = log_times - stamps
    sides = [delays[is_before], delays[~is_before]]
    if min(side.size for side in sides) < _FEWEST_STAMPS:
        return None
    if log_times.max() - first_after < _LIVE_NS:
        return None
    if max(float(np.percentile(side, 90) - np.percentile(side, 10)) for side in sides) > ALIKE_NS:
        return None
    passed = int(stamps[~is_before].min()) - int(stamps[is_before].max())
    if not 0 < passed < (first_after - last_before) // 2:
        return None
    before, after = (int(np.median(side)) for side in sides)
    return after - before


def step_by_delays(hole: Span, changes: Sequence[Ns]) -> ClockStep | None:
    """Returns the step that a hole is, by `delay_change` of several topics; None if it is none."""
    if len(changes) < _AGREEING or max(changes) - min(changes) > ALIKE_NS:
        return None
    (last_before, _), by = hole, int(np.median(changes))
    return ClockStep(last_before, by) if by >= SHORTEST_BY_STAMPS_NS else None


def step_over(hole: Span, before: Poses, after: Poses) -> ClockStep | None:
    """Returns the step that a hole is; None where it may be a pause of the recording.

    Args:
        hole: the log times of the last message before it, and of the first one after.
        before: the poses in the last `BESIDE_NS` before it.
        after: those in the first `BESIDE_NS` after it.
    """
    speed_mps = min(_speed_mps(before), _speed_mps(after))
    if speed_mps < _DRIVING_MPS:
        return None
    length = int(after.times[0] - before.times[-1])
    moved_m = math.dist(before.positions[-1], after.positions[0])
    if moved_m > _MOVED * speed_mps * unix_from_ns(length):
        return None
    (last_before, _), by = hole, length - ns_from_unix(moved_m / speed_mps)
    return ClockStep(last_before, by) if by >= SHORTEST_STEP_NS else None


def _speed_mps(poses: Poses) -> float:
    lasted = int(poses.times[-1] - poses.times[0]) if len(poses) else 0
    if lasted < BESIDE_NS // 4:
        return 0.0
    return math.dist(poses.positions[0], poses.positions[-1]) / unix_from_ns(lasted)

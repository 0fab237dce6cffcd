"""Steps of the clock that dates messages, found where the robot drove through one. Pure decisions.

A clock that is set forward leaves a hole: for so long no topic has a message. So does a recorder
that stalls. They differ in where the robot is afterwards: time that never passed moved nothing. So
a hole is a step where the robot drove on both sides, and is where it would be if the hole were not
there.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.geometry import distance
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.motion.odometry import TimedPosition

SHORTEST_STEP_NS: Final[Ns] = 2 * NS_PER_S
BESIDE_NS: Final[Ns] = NS_PER_S
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

    def skipped_between(self, start: Ns, stop: Ns) -> Ns:
        """Returns how much of the time from one moment to another the clock skipped."""
        return sum(max(0, min(stop, end) - max(start, begin)) for begin, end in self.skipped)


def holes(times: Iterable[Ns]) -> list[tuple[Ns, Ns]]:
    """Returns where the log times of all messages of a bag, in any order, are far apart."""
    return [
        (before, after)
        for before, after in pairwise(sorted(set(times)))
        if after - before >= SHORTEST_STEP_NS
    ]


def step_over(
    hole: tuple[Ns, Ns], before: Sequence[TimedPosition], after: Sequence[TimedPosition]
) -> ClockStep | None:
    """Returns the step that a hole is; None where it may be a pause of the recording.

    Args:
        hole: the log times of the last message before it, and of the first one after.
        before: the poses in the last `BESIDE_NS` before it, in order of time.
        after: those in the first `BESIDE_NS` after it.
    """
    speed_mps = min(_speed_mps(before), _speed_mps(after))
    if speed_mps < _DRIVING_MPS:
        return None
    length = after[0].time - before[-1].time
    moved_m = distance(before[-1].position, after[0].position)
    if moved_m > _MOVED * speed_mps * unix_from_ns(length):
        return None
    by = length - ns_from_unix(moved_m / speed_mps)
    return ClockStep(hole[0], by) if by >= SHORTEST_STEP_NS else None


def _speed_mps(poses: Sequence[TimedPosition]) -> float:
    if len(poses) < 2 or poses[-1].time - poses[0].time < BESIDE_NS // 4:
        return 0.0
    elapsed = unix_from_ns(poses[-1].time - poses[0].time)
    return distance(poses[0].position, poses[-1].position) / elapsed

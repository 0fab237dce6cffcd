"""Distance, speed, gaps, jumps and resets along poses in log-time order.

Paths can be joined: what is measured of some poses and of those that follow them gives what all of
them together give. Lengths so joined differ a little from those of the same poses in other parts,
since noise is estimated in each part; without noise they do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import median_low
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.motion.path_length import (
    FEWEST,
    SPEED_STEPS,
    End,
    measured,
)
from ros2_memory.core.arrays import Flags, Floats, Ints, Vectors, row_sums
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import Vector3

ARRIVAL_JITTER_NS: Final = 100 * NS_PER_MS
"""The jitter of arrivals: the shortest time that the distance of two poses is divided by.

Log time is the time of arrival. Transports and a busy recorder deliver in bursts: public bags
contain poses 3 ms apart in time and 0.2 m in space, which is GNSS noise and not 72 m/s.
"""

GAP_NS: Final = NS_PER_S
"""Poses are consecutive up to this far apart, or up to `GAP_PERIODS` of their usual periods."""
GAP_PERIODS: Final = 5
_NEARBY: Final = 8
"""The usual period around a pair of poses is the median of so many intervals on either side."""

MOVED_M: Final = 1.0
"""Odometry that is reset begins within this of its origin, having been farther away."""

_RESTART_M: Final = 0.25
"""A longer step may be a reset of odometry by comparison with its neighbours alone."""
_AT_ORIGIN_M: Final = 0.05
"""Odometry that is reset begins so near its origin, or within two steps of it."""
_LONGER: Final = 4.0
_FASTER: Final = 2.0
"""A step to the origin is a reset if it is so many times longer, and faster, than those near it."""
_DENSE_NS: Final = 250 * NS_PER_MS
_HARD_MPS2: Final = (2.0, 10.0)
"""Accelerations (m/s^2) that such a step would need at least, to be a reset.

The first among poses that follow closely, where no whole start and stop fits between two of them;
the second among others: more than wheels can transmit.
"""

FARTHEST_M: Final = 1e12
"""Coordinates beyond this (m) are no place on Earth but memory that was never initialised."""

_DOUBTFUL: Final = 0.25
"""Noise of this share of the mean step makes a path longer by some 3 %."""

_MAX_RESETS: Final = 1000
_UNCERTAIN: Final = 4.0
"""Standard deviations by which a step must exceed its neighbours to be longer than them."""

Link: TypeAlias = Literal["driven", "gap", "jump", "reset"]
"""What is between two consecutive poses; only `driven` counts as distance."""


class TimedPosition(NamedTuple):
    """Where the robot was (m), and when."""

    time: Ns
    position: Vector3


class NearbyMotion(NamedTuple):
    """How a robot moves near a pose: its longest step (m) and its highest speed."""

    step_m: float
    speed_mps: float

    def or_more(self, other: NearbyMotion) -> NearbyMotion:
        """Returns the longer step and the higher speed of two."""
        return NearbyMotion(max(self.step_m, other.step_m), max(self.speed_mps, other.speed_mps))


_STATIONARY: Final = NearbyMotion(0.0, 0.0)


def link(
    before: TimedPosition,
    after: TimedPosition,
    usual_ns: Ns | None,
    fastest_mps: float,
    near: NearbyMotion | None = None,
) -> Link:
    """Returns what is between two consecutive poses.

    A jump is faster than plausible. A gap is time in which nothing was recorded: more than a
    second, and more than five usual periods (ns), where these are known. A jump or a gap to the
    origin of odometry is a reset, and so is a step to it that the robot, by its motion near the
    step, cannot have driven.
    """
    elapsed = after.time - before.time
    step_m, elapsed_s = _step(before, after)
    from_origin_m = math.hypot(*after.position)
    is_gap = elapsed > GAP_NS and usual_ns is not None and elapsed > GAP_PERIODS * usual_ns
    is_jump = _is_jump(step_m, elapsed_s, fastest_mps)
    if is_gap or is_jump:
        if step_m > MOVED_M >= from_origin_m:
            return "reset"
        return "jump" if is_jump else "gap"
    if near is None or usual_ns is None or from_origin_m > max(_AT_ORIGIN_M, 2 * near.step_m):
        return "driven"
    # From rest to rest, half of the time faster and half of it slower.
    hardest_m = _HARD_MPS2[usual_ns > _DENSE_NS] * elapsed_s * elapsed_s / 4
    usual_m = max(_LONGER * near.step_m, _FASTER * near.speed_mps * elapsed_s)
    return "reset" if step_m > max(_RESTART_M, usual_m, hardest_m) else "driven"


def _step(before: TimedPosition, after: TimedPosition) -> tuple[float, float]:
    """Returns the length (m) of a step, and how long it took (s).

    A burst shortens the time between two poses to nothing, which is neither a jump nor fast.
    """
    elapsed_s = unix_from_ns(max(after.time - before.time, ARRIVAL_JITTER_NS))
    return math.dist(before.position, after.position), elapsed_s


def _is_jump(step_m: float, elapsed_s: float, fastest_mps: float) -> bool:
    return step_m > fastest_mps * elapsed_s * (1 + 1e-9)


def _motion_of(path: Sequence[TimedPosition]) -> NearbyMotion:
    """Returns the longest step of consecutive poses, and the highest speed over half of them."""
    if len(path) < 2:
        return _STATIONARY
    half = max(len(path) // 2, 1)
    speed_mps = max(step_m / elapsed_s for step_m, elapsed_s in map(_step, path, path[half:]))
    return NearbyMotion(max(step_m for step_m, _ in map(_step, path, path[1:])), speed_mps)


class Leg(NamedTuple):
    """A path driven without a gap, a jump or a reset.

    Attributes:
        first: its first pose.
        last: its last pose.
        poses: how many it has.
        period_ns: the usual time between two of them; None for one alone.
        length_m: its length except for the creeps at its ends (see `path_length`).
        sum_m: the sum of the distances between its poses.
        head: how it begins.
        tail: how it ends.
        still: whether it is one creep from end to end: that of the head and of the tail.
        near_first: the motion near its first pose.
        near_last: the motion near its last pose.
    """

    first: TimedPosition
    last: TimedPosition
    poses: int
    period_ns: Ns | None
    length_m: float
    sum_m: float
    head: End
    tail: End
    still: bool
    near_first: NearbyMotion
    near_last: NearbyMotion

    @property
    def total_m(self) -> float:
        """Its length, if nothing more is joined to it."""
        ends = (self.head,) if self.still else (self.head, self.tail)
        return self.length_m + sum(end.creep.length_m for end in ends if end.creep is not None)

    @property
    def is_uncertain(self) -> bool:
        """Whether noise may be much of its length: poses too rare to distinguish it from turns."""
        if self.poses < FEWEST or self.period_ns is None or self.period_ns <= _DENSE_NS:
            return False
        noise_m = max(self.head.noise_m, self.tail.noise_m)
        return self.total_m > MOVED_M and noise_m > _DOUBTFUL * self.sum_m / (self.poses - 1)

    def joined(self, later: Leg) -> Leg:
        """Returns this leg continued, without a break, by a later one."""
        step_m = math.dist(self.last.position, later.first.position)
        is_bridged = (self.poses < FEWEST) != (later.poses < FEWEST)
        head, tail, length_m, still = (
            self._bridged(later, step_m) if is_bridged else self._linked(later, step_m)
        )
        # In one step: a path has a leg for each bag, and thousands of bags.
        return Leg(
            first=self.first,
            last=later.last,
            poses=self.poses + later.poses,
            period_ns=(self if self.poses >= later.poses else later).period_ns
            or self.period_ns
            or later.period_ns,
            length_m=length_m,
            sum_m=self.sum_m + step_m + later.sum_m,
            head=head,
            tail=tail,
            still=still,
            near_first=self.near_first
            if self.poses > _NEARBY
            else self.near_first.or_more(later.near_first),
            near_last=later.near_last
            if later.poses > _NEARBY
            else later.near_last.or_more(self.near_last),
        )

    def _linked(self, later: Leg, step_m: float) -> tuple[End, End, float, bool]:
        """Returns the ends, the length and whether it is still of this leg and a later one."""
        head, tail, length_m = self.head, later.tail, self.length_m + later.length_m
        before, after = self.tail.creep, later.head.creep
        if before is not None and after is not None:
            creep = before.joined(after)
            if self.still:
                head = head._replace(creep=creep)
            if later.still:
                tail = tail._replace(creep=creep)
            if not (self.still or later.still):
                length_m += creep.length_m
            return head, tail, length_m, self.still and later.still
        inner_m = _step_m(self.tail, later.head, 1, step_m, step_m)
        # A creep that filled its leg reaches only one end of the whole.
        if before is not None and not self.still:
            inner_m += before.length_m
        if after is not None and not later.still:
            inner_m += after.length_m
        return head, tail, length_m + inner_m, False

    def _bridged(self, later: Leg, step_m: float) -> tuple[End, End, float, bool]:
        """Does as `_linked`, where one of the legs has too few poses to estimate its noise."""
        if later.poses < FEWEST:
            net_m = math.dist(self.last.position, later.last.position)
            end, short, long = self.tail, later, self
        else:
            net_m = math.dist(self.first.position, later.first.position)
            end, short, long = later.head, self, later
        added_m = _step_m(end, end, short.poses, net_m, step_m + short.sum_m)
        return long.head, long.tail, long.length_m + added_m, long.still


def _step_m(before: End, after: End, steps: int, net_m: float, plain_m: float) -> float:
    """Returns the length of some steps between two ends: their paces, unless it is clearly more.

    `net_m`: the distance from end to end; `plain_m`: the sum of the distances between.
    """
    if before.plain and after.plain:
        return plain_m
    expected_m = steps * (before.pace_m + after.pace_m) / 2
    variance = before.noise_m**2 + after.noise_m**2
    if net_m <= expected_m + _UNCERTAIN * math.sqrt(variance):
        return expected_m
    return math.sqrt(max(net_m**2 - variance, expected_m**2))


@dataclass(slots=True)
class MotionTotals:
    """What was driven, and what is left out of it: the legs of a path, summed up.

    Attributes:
        head: the first leg; None without a pose.
        tail: the last leg; None where the first is the only one.
        length_m: of the legs between these.
        sum_m: the sum of the distances between poses, of the legs between these.
        jumps: steps that were faster than plausible; some of them are resets too.
        jumped_m: their total length.
        gaps: times in which nothing was recorded.
        gap_m: the distance across them in straight lines.
        gap_ns: how long they last, and other steps of more than a second that are left out.
        resets: the first pose after each reset of odometry; the earliest, of very many.
        speed_mps: the highest speed measured; None where the poses are too few.
    """

    head: Leg | None = None
    tail: Leg | None = None
    length_m: float = 0.0
    sum_m: float = 0.0
    jumps: int = 0
    jumped_m: float = 0.0
    gaps: int = 0
    gap_m: float = 0.0
    gap_ns: Ns = 0
    resets: tuple[Ns, ...] = ()
    speed_mps: float | None = None

    @property
    def newest(self) -> Leg | None:
        """The last leg, be it the only one."""
        return self.tail or self.head

    @property
    def distance_m(self) -> float:
        """The length of all that was driven: gaps, jumps and resets left out."""
        return self.length_m + sum(leg.total_m for leg in self._ends())

    @property
    def path_sum_m(self) -> float:
        """The sum of the distances between the poses of `distance_m`, noise included."""
        return self.sum_m + sum(leg.sum_m for leg in self._ends())

    @property
    def is_uncertain(self) -> bool:
        """Whether noise may be much of the length of its first or last leg."""
        return any(leg.is_uncertain for leg in self._ends())

    @property
    def duration_s(self) -> float:
        """Seconds from the first pose to the last."""
        ends = self._ends()
        return unix_from_ns(ends[-1].last.time - ends[0].first.time) if ends else 0.0

    def _ends(self) -> list[Leg]:
        return [leg for leg in (self.head, self.tail) if leg is not None]


class MeasuredPath(NamedTuple):
    """What is measured of poses in order.

    Attributes:
        totals: what was driven.
        step_mps: the highest speed from one pose to the next, where these are too few to measure
            a speed.
        parted: which poses a jump or a reset led to.
        begins: which poses a gap, a jump or a reset led to.
        steps_m: what was driven from each pose to the next.
    """

    totals: MotionTotals
    step_mps: float
    parted: tuple[int, ...]
    begins: tuple[int, ...]
    steps_m: Floats


def measured_path(times: Ints, positions: Vectors, fastest_mps: float) -> MeasuredPath:
    """Measures poses: the more at a time, the better noise is distinguished from driving.

    Args:
        times: log times (ns), ascending; at least one.
        positions: x, y and z (m) of each as a row; places.
        fastest_mps: a step that would take a higher speed is a jump.
    """
    motion, steps_m = Motion(fastest_mps), np.zeros(len(times) - 1)
    parted: list[int] = []
    begins: list[int] = []
    apart = np.diff(times)
    plain_m = np.sqrt(row_sums(np.diff(positions, axis=0) ** 2))
    begin = 0
    for index in _odd_steps(apart, plain_m, fastest_mps):
        earlier = _poses(times, positions, max(begin, index - _NEARBY), index + 1)
        later = _poses(times, positions, index + 1, index + 2 + _NEARBY)
        # Too few poses do not show what is usual.
        are_enough = len(earlier) + len(later) >= _NEARBY
        near = _motion_of(earlier).or_more(_motion_of(later)) if are_enough else None
        here, there = earlier[-1], later[0]
        before = motion.totals.newest
        usual_ns = _usual_ns(apart, index, None if before is None else before.period_ns)
        kind = link(here, there, usual_ns, fastest_mps, near)
        if kind == "driven":
            continue
        steps_m[begin:index] = motion.add_leg(
            times[begin : index + 1], positions[begin : index + 1]
        )
        motion.count_break(kind, here, there)
        begin = index + 1
        begins.append(begin)
        if kind != "gap":
            parted.append(begin)
    steps_m[begin:] = motion.add_leg(times[begin:], positions[begin:])
    return MeasuredPath(motion.totals, motion.step_mps, tuple(parted), tuple(begins), steps_m)


def _odd_steps(apart: Ints, steps_m: Floats, fastest_mps: float) -> list[int]:
    """Returns after which poses a gap, a jump or a reset may be."""
    plausible_m = fastest_mps * np.maximum(apart, ARRIVAL_JITTER_NS) / NS_PER_S
    beside_m = np.maximum(
        np.concatenate(([0.0], steps_m[:-1])), np.concatenate((steps_m[1:], [0.0]))
    )
    odd = (steps_m > _RESTART_M) & (steps_m > _LONGER * beside_m[: len(steps_m)])
    return np.flatnonzero((apart > GAP_NS) | (steps_m > plausible_m) | odd).tolist()


def _poses(times: Ints, positions: Vectors, begin: int, end: int) -> list[TimedPosition]:
    places = zip(times[begin:end].tolist(), positions[begin:end].tolist(), strict=True)
    return [TimedPosition(time, (x, y, z)) for time, (x, y, z) in places]


class Motion:
    """Adds up what was driven.

    Attributes:
        totals: so far.
        step_mps: the highest speed from one pose to the next where these were too few to measure
            a speed.
    """

    def __init__(self, max_plausible_speed_mps: float) -> None:
        self._fastest_mps = max_plausible_speed_mps
        self.totals = MotionTotals()
        self.step_mps = 0.0

    def add_leg(self, times: Ints, positions: Vectors) -> Floats:
        """Takes a leg that does not go on from the one before; returns the length of its steps."""
        apart = np.diff(times)
        seconds = (times - times[0]) / NS_PER_S
        length_m, sum_m, head, tail, still, speed_mps, steps_m = measured(seconds, positions)
        begin = _poses(times, positions, 0, _NEARBY + 1)
        end = _poses(times, positions, max(len(times) - _NEARBY - 1, 0), len(times))
        period_ns = int(np.median(apart)) if len(apart) else None
        motion = _motion_of(begin), _motion_of(end)
        count, first, last = len(times), begin[0], end[-1]
        leg = Leg(first, last, count, period_ns, length_m, sum_m, head, tail, still, *motion)
        if len(times) <= SPEED_STEPS:
            steps = zip(map(_step, begin, begin[1:]), apart >= ARRIVAL_JITTER_NS, strict=False)
            speeds = (step_m / elapsed_s for (step_m, elapsed_s), is_known in steps if is_known)
            self.step_mps = max(self.step_mps, *speeds, 0.0)
        self._go_on(None, leg, speed_mps)
        return steps_m

    def join(self, later: MotionTotals) -> bool:
        """Takes the legs that come next; returns whether a jump or reset led there."""
        if later.head is None:
            return False
        totals = self.totals
        parted = self._go_on(totals.newest, later.head, later.speed_mps)
        totals.jumps += later.jumps
        totals.jumped_m += later.jumped_m
        totals.gaps += later.gaps
        totals.gap_m += later.gap_m
        totals.gap_ns += later.gap_ns
        totals.resets = (*totals.resets, *later.resets)[:_MAX_RESETS]
        if later.tail is not None:
            self._end_leg()
            totals.length_m += later.length_m
            totals.sum_m += later.sum_m
            totals.tail = later.tail
        return parted

    def _go_on(self, before: Leg | None, leg: Leg, speed_mps: float | None) -> bool:
        """Takes the leg that comes next; returns whether a jump or reset led to it.

        `before` is the one before it, unless what ended that is counted already.
        """
        totals = self.totals
        if speed_mps is not None:
            totals.speed_mps = max(totals.speed_mps or 0.0, speed_mps)
        kind = None if before is None else self._link_between(before, leg)
        if before is not None and kind is not None:
            if kind == "driven":
                if totals.tail is None:
                    totals.head = before.joined(leg)
                else:
                    totals.tail = before.joined(leg)
                return False
            self.count_break(kind, before.last, leg.first)
        if totals.head is None:
            totals.head = leg
        else:
            self._end_leg()
            totals.tail = leg
        return kind in ("jump", "reset")

    def _link_between(self, before: Leg, after: Leg) -> Link:
        periods = [leg.period_ns for leg in (before, after) if leg.period_ns is not None]
        near = None
        if before.poses + after.poses >= _NEARBY:
            near = before.near_last.or_more(after.near_first)
        usual_ns = max(periods, default=None)
        return link(before.last, after.first, usual_ns, self._fastest_mps, near)

    def _end_leg(self) -> None:
        """Adds the last leg to those between."""
        totals = self.totals
        if totals.tail is not None:
            totals.length_m += totals.tail.total_m
            totals.sum_m += totals.tail.sum_m
            totals.tail = None

    def count_break(self, kind: Link, before: TimedPosition, after: TimedPosition) -> None:
        """Counts what ends a leg."""
        totals = self.totals
        step_m = math.dist(before.position, after.position)
        if after.time - before.time > GAP_NS:
            totals.gap_ns += after.time - before.time
        if kind == "gap":
            totals.gaps += 1
            totals.gap_m += step_m
            return
        if _is_jump(*_step(before, after), self._fastest_mps):
            totals.jumps += 1
            totals.jumped_m += step_m
        if kind == "reset":
            totals.resets = (*totals.resets, after.time)[:_MAX_RESETS]


def _usual_ns(apart: Ints, index: int, known: Ns | None) -> Ns:
    """Returns the usual time between poses around an interval, which itself counts least."""
    near: list[Ns] = apart[max(index - _NEARBY, 0) : index + 1 + _NEARBY].tolist()
    own_ns = near.pop(min(index, _NEARBY))
    return median_low(near or [known or own_ns])


def are_places(positions: Vectors) -> Flags:
    """Returns which coordinates, as rows, are a place: finite, and on Earth."""
    x, y, z = np.abs(positions).T
    # A comparison with NaN is false, so this one refuses all three kinds.
    marks: Flags = (x < FARTHEST_M) & (y < FARTHEST_M) & (z < FARTHEST_M)
    return marks

"""Distance, speed, gaps, jumps and resets along poses in log-time order.

The measurements of consecutive parts of a path can be joined. Without noise the result does not
depend on where the path is cut. Noise is estimated in each part, so with noise lengths differ a
little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from statistics import median_low
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.motion.path_length import (
    FEWEST,
    SPEED_STEPS,
    End,
    measure,
)
from ros2_memory.core.arrays import Flags, Floats, Ints, Vectors, row_sums
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import Vector3

ARRIVAL_JITTER_NS: Final = 100 * NS_PER_MS
"""The shortest time by which the distance of two poses is divided.

Log time is the time of arrival. Transports and a busy recorder deliver in bursts: public bags
contain poses 3 ms apart in time and 0.2 m in space, which is GNSS noise and not 72 m/s.
"""

GAP_NS: Final = NS_PER_S
"""Poses farther apart than this, and than `GAP_PERIODS` usual periods, have a gap between them."""
GAP_PERIODS: Final = 5
_NEARBY: Final = 8
"""The usual period around a pair of poses is the median of so many intervals on either side."""

MOVED_M: Final = 1.0
"""After a reset, odometry begins within this distance of its origin; before, it was farther."""

_RESTART_M: Final = 0.25
"""A longer step, which is neither a jump nor a gap, may be a reset by its length alone."""
_AT_ORIGIN_M: Final = 0.05
"""Such a reset leads this near to the origin, or within two steps of it."""
_LONGER: Final = 4.0
_FASTER: Final = 2.0
"""Such a reset is so many times longer, and faster, than the steps near it."""
_DENSE_NS: Final = 250 * NS_PER_MS
_HARD_MPS2: Final = 10.0
"""Such a reset would need this acceleration at least: more than wheels can transmit."""
_HARD_DENSE_MPS2: Final = 2.0
"""The same among poses that follow closely: no robot starts and stops between two of them."""

FARTHEST_M: Final = 1e12
"""Coordinates beyond this (m) are no place on Earth but memory that was never initialised."""

_DOUBTFUL: Final = 0.25
"""Noise of this share of the mean step makes a path longer by some 3 %."""

_MAX_RESETS: Final = 1000
_UNCERTAIN: Final = 4.0
"""A step that exceeds the expected length by so many standard deviations is longer."""

Link: TypeAlias = Literal["driven", "gap", "jump", "reset"]
"""What is between two consecutive poses; only `driven` counts as distance."""


class TimedPosition(NamedTuple):
    """Where the robot was (m), and when (log time)."""

    time: Ns
    position: Vector3


class NearbyMotion(NamedTuple):
    """How a robot moves near a pose: its longest step (m) and its highest speed (m/s)."""

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

    A jump is faster than plausible. A gap is longer than `GAP_NS` and `GAP_PERIODS` usual periods.
    A jump or a gap to the origin of odometry is a reset. So is another step to the origin, if the
    robot cannot have driven it, by its motion near the step.

    Args:
        before: the first pose.
        after: the second pose.
        usual_ns: the usual time between poses; None if it is not known.
        fastest_mps: the highest plausible speed.
        near: the motion near the step; None if there are too few poses.
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
    hard_mps2 = _HARD_MPS2 if usual_ns > _DENSE_NS else _HARD_DENSE_MPS2
    # From rest to rest: half of the time the robot accelerates, the other half it brakes.
    hardest_m = hard_mps2 * elapsed_s * elapsed_s / 4
    usual_m = max(_LONGER * near.step_m, _FASTER * near.speed_mps * elapsed_s)
    return "reset" if step_m > max(_RESTART_M, usual_m, hardest_m) else "driven"


def _step(before: TimedPosition, after: TimedPosition) -> tuple[float, float]:
    """Returns the length (m) of a step, and how long it took (s), at least `ARRIVAL_JITTER_NS`."""
    elapsed_s = unix_from_ns(max(after.time - before.time, ARRIVAL_JITTER_NS))
    return math.dist(before.position, after.position), elapsed_s


def _is_jump(step_m: float, elapsed_s: float, fastest_mps: float) -> bool:
    return step_m > fastest_mps * elapsed_s * (1 + 1e-9)


def _motion_of(path: Sequence[TimedPosition]) -> NearbyMotion:
    """Returns the longest step of some poses, and the highest speed over half of them."""
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
        poses: how many poses it has.
        period_ns: the usual time between two poses; None for a single pose.
        length_m: its length except for the creeps at its ends (see `path_length`).
        sum_m: the sum of the distances between its poses.
        head: how it begins.
        tail: how it ends.
        still: whether the whole leg is one creep, which the head and the tail share.
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
        """Its length with the creeps at its ends."""
        ends = (self.head,) if self.still else (self.head, self.tail)
        return self.length_m + sum(end.creep.length_m for end in ends if end.creep is not None)

    @property
    def is_uncertain(self) -> bool:
        """Whether noise may be much of its length, since rare poses do not tell it from turns."""
        if self.poses < FEWEST or self.period_ns is None or self.period_ns <= _DENSE_NS:
            return False
        noise_m = max(self.head.noise_m, self.tail.noise_m)
        return self.total_m > MOVED_M and noise_m > _DOUBTFUL * self.sum_m / (self.poses - 1)

    def joined(self, later: Leg) -> Leg:
        """Returns this leg and a later one, which continues it without a break, as one."""
        step_m = math.dist(self.last.position, later.first.position)
        are_alike = (self.poses < FEWEST) == (later.poses < FEWEST)
        measured = (self._linked if are_alike else self._bridged)(later, step_m)
        longer, shorter = (self, later) if self.poses >= later.poses else (later, self)
        near_first, near_last = self.near_first, later.near_last
        if self.poses <= _NEARBY:
            near_first = near_first.or_more(later.near_first)
        if later.poses <= _NEARBY:
            near_last = near_last.or_more(self.near_last)
        return measured._replace(
            first=self.first,
            last=later.last,
            poses=self.poses + later.poses,
            period_ns=longer.period_ns or shorter.period_ns,
            sum_m=self.sum_m + step_m + later.sum_m,
            near_first=near_first,
            near_last=near_last,
        )

    def _linked(self, later: Leg, step_m: float) -> Leg:
        """Returns this leg with the length and the ends of both.

        The noise of both is known, or of neither.
        """
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
            still = self.still and later.still
            return self._replace(head=head, tail=tail, length_m=length_m, still=still)
        inner_m = _step_m(self.tail, later.head, 1, step_m, step_m)
        # A creep that filled its leg reaches only one end of the whole.
        if before is not None and not self.still:
            inner_m += before.length_m
        if after is not None and not later.still:
            inner_m += after.length_m
        return self._replace(head=head, tail=tail, length_m=length_m + inner_m, still=False)

    def _bridged(self, later: Leg, step_m: float) -> Leg:
        """Returns the longer of two legs with the length of both; its ends stay the ends.

        The shorter one has too few poses to estimate its noise.
        """
        if later.poses < FEWEST:
            net_m = math.dist(self.last.position, later.last.position)
            end, short, long = self.tail, later, self
        else:
            net_m = math.dist(self.first.position, later.first.position)
            end, short, long = later.head, self, later
        added_m = _step_m(end, end, short.poses, net_m, step_m + short.sum_m)
        return long._replace(length_m=long.length_m + added_m)


def _step_m(before: End, after: End, steps: int, net_m: float, plain_m: float) -> float:
    """Returns the length (m) of steps between two ends.

    It is expected from the paces of the ends, unless the distance is clearly longer than that.

    Args:
        before: the end of the path before the steps.
        after: the beginning of the path after the steps.
        steps: how many there are.
        net_m: the distance from the first to the last position.
        plain_m: the sum of the distances of all positions.
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
    """Sums over the legs of a path, and what is left out between them.

    Attributes:
        head: the first leg; None without a pose.
        tail: the last leg; None if the first is the only one.
        length_m: the length of the legs between these two.
        sum_m: the sum of the distances between poses of the legs between these two.
        jumps: how many steps were faster than plausible; some are resets, too.
        jumped_m: the length of these steps.
        gaps: how many times nothing was recorded.
        gap_m: the distance across gaps, in straight lines.
        gap_ns: how long gaps last, and other steps of more than a second that are left out.
        resets: log times of the first pose after each reset, of at most `_MAX_RESETS`.
        speed_mps: the highest measured speed; None if there are too few poses.
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
        """The last leg, which may be the first one."""
        return self.tail or self.head

    @property
    def distance_m(self) -> float:
        """The driven length, without gaps, jumps and resets."""
        return self.length_m + sum(leg.total_m for leg in self._ends())

    @property
    def path_sum_m(self) -> float:
        """The sum of the distances between poses of all legs, noise included."""
        return self.sum_m + sum(leg.sum_m for leg in self._ends())

    @property
    def is_uncertain(self) -> bool:
        """Whether noise may be much of the length of the first or the last leg."""
        return any(leg.is_uncertain for leg in self._ends())

    @property
    def duration_s(self) -> float:
        """Seconds from the first pose to the last."""
        ends = self._ends()
        return unix_from_ns(ends[-1].last.time - ends[0].first.time) if ends else 0.0

    def _ends(self) -> list[Leg]:
        return [leg for leg in (self.head, self.tail) if leg is not None]


class MeasuredPath(NamedTuple):
    """The measurements of poses in order.

    Attributes:
        totals: sums over the legs.
        step_mps: the highest speed from one pose to the next, in legs with too few poses to measure
            a speed.
        parted: the indices of poses that a jump or a reset led to.
        begins: the indices of poses that a gap, a jump or a reset led to.
        steps_m: the driven length from each pose to the next.
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
        positions: rows of x, y and z (m); all are places.
        fastest_mps: a step that would take a higher speed is a jump.
    """
    motion, steps_m = Motion(fastest_mps), np.zeros(len(times) - 1)
    parted, begins = list[int](), [0]
    apart = np.diff(times)
    plain_m = np.sqrt(row_sums(np.diff(positions, axis=0) ** 2))
    for index in _odd_steps(apart, plain_m, fastest_mps):
        earlier = _poses(times, positions, max(begins[-1], index - _NEARBY), index + 1)
        later = _poses(times, positions, index + 1, index + 2 + _NEARBY)
        # Too few poses do not show what is usual.
        are_enough = len(earlier) + len(later) >= _NEARBY
        near = _motion_of(earlier).or_more(_motion_of(later)) if are_enough else None
        here, there = earlier[-1], later[0]
        kind = link(here, there, _usual_ns(apart, index), fastest_mps, near)
        if kind == "driven":
            continue
        motion.count_break(kind, here, there)
        begins.append(index + 1)
        if kind != "gap":
            parted.append(index + 1)
    for begin, stop in pairwise([*begins, len(times)]):
        measured_leg = _measured_leg(times[begin:stop], positions[begin:stop])
        steps_m[begin : stop - 1] = measured_leg.steps_m
        motion.add(measured_leg)
    return MeasuredPath(motion.totals, motion.step_mps, tuple(parted), tuple(begins[1:]), steps_m)


class _MeasuredLeg(NamedTuple):
    """A leg, and what is measured in it alone.

    Attributes:
        leg: the leg.
        speed_mps: the highest speed; None if there are too few poses.
        step_mps: the highest speed from one pose to the next, if there are too few; else 0.
        steps_m: the driven length from each pose to the next.
    """

    leg: Leg
    speed_mps: float | None
    step_mps: float
    steps_m: Floats


def _measured_leg(times: Ints, positions: Vectors) -> _MeasuredLeg:
    """Measures poses without a gap, a jump or a reset between them."""
    apart = np.diff(times)
    measured = measure((times - times[0]) / NS_PER_S, positions)
    head = _poses(times, positions, 0, _NEARBY + 1)
    tail = _poses(times, positions, max(len(times) - _NEARBY - 1, 0), len(times))
    leg = Leg(
        first=head[0],
        last=tail[-1],
        poses=len(times),
        period_ns=int(np.median(apart)) if len(apart) else None,
        length_m=measured.length_m,
        sum_m=measured.sum_m,
        head=measured.head,
        tail=measured.tail,
        still=measured.still,
        near_first=_motion_of(head),
        near_last=_motion_of(tail),
    )
    step_mps = 0.0
    if len(times) <= SPEED_STEPS:
        for (step_m, elapsed_s), apart_ns in zip(map(_step, head, head[1:]), apart, strict=True):
            if apart_ns >= ARRIVAL_JITTER_NS:
                step_mps = max(step_mps, step_m / elapsed_s)
    return _MeasuredLeg(leg, measured.speed_mps, step_mps, measured.steps_m)


def _odd_steps(apart: Ints, steps_m: Floats, fastest_mps: float) -> list[int]:
    """Returns the indices of poses after which a gap, a jump or a reset may be."""
    plausible_m = fastest_mps * np.maximum(apart, ARRIVAL_JITTER_NS) / NS_PER_S
    padded_m = np.pad(steps_m, 1)
    beside_m = np.maximum(padded_m[:-2], padded_m[2:])
    odd = (steps_m > _RESTART_M) & (steps_m > _LONGER * beside_m)
    return np.flatnonzero((apart > GAP_NS) | (steps_m > plausible_m) | odd).tolist()


def _poses(times: Ints, positions: Vectors, begin: int, end: int) -> list[TimedPosition]:
    places = zip(times[begin:end].tolist(), positions[begin:end].tolist(), strict=True)
    return [TimedPosition(time, (x, y, z)) for time, (x, y, z) in places]


class Motion:
    """Adds up the legs of a path.

    Attributes:
        totals: the sums so far.
        step_mps: the highest speed from one pose to the next, in legs with too few poses to measure
            a speed.
        is_parted: whether a jump or a reset led to what was joined last.
    """

    def __init__(self, fastest_mps: float) -> None:
        self._fastest_mps = fastest_mps
        self.totals = MotionTotals()
        self.step_mps = 0.0
        self.is_parted = False

    def add(self, measured: _MeasuredLeg) -> None:
        """Adds a leg that does not continue the newest one; `count_break` counts the break."""
        self.step_mps = max(self.step_mps, measured.step_mps)
        self._add_speed(measured.speed_mps)
        self._begin_leg(measured.leg)

    def join(self, later: MotionTotals) -> None:
        """Adds the legs of a later part, the first of which may continue the newest leg."""
        self.is_parted = False
        if later.head is None:
            return
        totals, newest = self.totals, self.totals.newest
        self._add_speed(later.speed_mps)
        if newest is None:
            self._begin_leg(later.head)
        else:
            kind = self._link_between(newest, later.head)
            self.is_parted = kind in {"jump", "reset"}
            if kind != "driven":
                self.count_break(kind, newest.last, later.head.first)
                self._begin_leg(later.head)
            elif totals.tail is None:
                totals.head = newest.joined(later.head)
            else:
                totals.tail = newest.joined(later.head)
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

    def _add_speed(self, speed_mps: float | None) -> None:
        if speed_mps is not None:
            self.totals.speed_mps = max(self.totals.speed_mps or 0.0, speed_mps)

    def _begin_leg(self, leg: Leg) -> None:
        if self.totals.head is None:
            self.totals.head = leg
        else:
            self._end_leg()
            self.totals.tail = leg

    def _link_between(self, before: Leg, after: Leg) -> Link:
        periods = [leg.period_ns for leg in (before, after) if leg.period_ns is not None]
        near = None
        if before.poses + after.poses >= _NEARBY:
            near = before.near_last.or_more(after.near_first)
        usual_ns = max(periods, default=None)
        return link(before.last, after.first, usual_ns, self._fastest_mps, near)

    def _end_leg(self) -> None:
        """Adds the last leg to the legs between the first and the last."""
        totals = self.totals
        if totals.tail is not None:
            totals.length_m += totals.tail.total_m
            totals.sum_m += totals.tail.sum_m
            totals.tail = None

    def count_break(self, kind: Link, before: TimedPosition, after: TimedPosition) -> None:
        """Counts a gap, a jump or a reset, which ends a leg."""
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


def _usual_ns(apart: Ints, index: int) -> Ns:
    """Returns the usual time (ns) between poses around one interval.

    It is the median of the intervals beside it; the only interval is as long as usual.
    """
    near: list[Ns] = apart[max(index - _NEARBY, 0) : index + 1 + _NEARBY].tolist()
    own_ns = near.pop(min(index, _NEARBY))
    return median_low(near or [own_ns])


def are_places(positions: Vectors) -> Flags:
    """Returns which rows of x, y and z (m) are a place: finite, and on Earth."""
    x, y, z = np.abs(positions).T
    # A comparison with NaN is false.
    marks: Flags = (x < FARTHEST_M) & (y < FARTHEST_M) & (z < FARTHEST_M)
    return marks

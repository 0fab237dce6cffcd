"""Where the robot stood still, and where it suddenly slowed down.

A standstill is a time of at least `SHORTEST_NS` in which the robot moves no faster than odometry
drifts. It begins with the first pose at that place and ends with the last.

Poses are averaged in slots of `SLOT_NS`, counted from the epoch, so that noise averages out.
Consecutive slots are linked where their means are no farther apart than a drift of `DRIFT_MPS` or
the noise of their own poses explains, and linked slots form a chain, whose first and last slot may
be half motion and are left out. Slow motion that noise hides from two slots shows in blocks of
`BLOCK_NS`: a block whose means spread farther than drift and noise explain is motion, and splits
the chain. So are still blocks that lead `LARGEST_M` away within `CREEP_NS`: the robot creeps. What
takes longer is drift: the odometry of a camera wanders while the robot is at its dock. A standstill
that drifts out of `DRIFTED_M` ends there, and the next one begins.

The ends of still blocks in a row are found pose by pose: some slots just inside give the place and
its noise, and poses are followed outwards until one is elsewhere. The last one before that is
clearly there is the end: between the two, noise hides that the robot moves.

All of this depends only on poses a few slots around, and slots and blocks are counted from the
epoch. So the `Blocks` of stretches of time, each made of its poses and of those `BESIDE_NS` beside
it, are together those of all the time; and a standstill is the same whatever window is asked about,
and however a history is cut.

The noise of a slot is estimated from second differences, which a steady motion leaves at zero: see
J. von Neumann et al., "The mean square successive difference", Ann. Math. Statist. 12 (1941), for
first differences; those of second order have six times the variance of the noise.

Of sudden losses of speed the first pose of every slot of `DROP_SLOT_NS`, counted from the epoch,
counts. A robot moves clearly where it goes `MOVING_MPS` or faster from slot to slot. It slows down
suddenly where its speed falls, from one slot to the next but one, to `FRACTION` of that or less,
and stays there for two slots. A robot that turns meanwhile is taken to do so on purpose: nearly all
slow down to turn. That depends on `_DROP_SLOTS` slots in a row. Poses that come less often than
once a slot, and a position that jumps for a moment, show no drop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.poses import Poses, headings
from ros2_memory.core.arrays import (
    Flags,
    Floats,
    Ints,
    Vectors,
    narrowed,
    row_sums,
    rows_of,
    run_starts,
    stacked,
)
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.model import Vector3

SHORTEST_NS: Final = 3 * NS_PER_S
"""A robot that is still for less is turning, or driving with care."""
SILENCE_NS: Final = 5 * NS_PER_S // 2
"""Between poses farther apart nothing is known: a standstill ends there."""
SLOT_NS: Final = 2 * NS_PER_S // 5
BLOCK_NS: Final = 5 * SLOT_NS
BESIDE_NS: Final = SHORTEST_NS + 3 * NS_PER_S
"""Poses so far beside a stretch of time decide what its blocks are: those of the block beside."""
CREEP_NS: Final = 15 * BLOCK_NS
"""A robot that moves farther than `LARGEST_M` in this time creeps; a slower one drifts."""
CONTEXT_NS: Final = CREEP_NS + SHORTEST_NS + BLOCK_NS + 2 * SILENCE_NS
"""Poses so far outside a window decide whether the robot stood still inside it."""
DRIFT_MPS: Final = 0.008
"""The mean position of a still robot may move so fast: odometry drifts."""
LARGEST_M: Final = 0.1
DRIFTED_M: Final = 1.0
"""So far odometry may drift while the robot stands."""
CREEP_MPS: Final = LARGEST_M / unix_from_ns(CREEP_NS)
"""A slower robot cannot be distinguished from one that stands still."""

_NOISE_FACTOR: Final = 5.5
_NEAREST_M: Final = 0.0003
"""Poses without noise are at one place if they are no farther apart than this."""
_ELSEWHERE: Final = 3.0
"""Poses so many standard deviations from a place are elsewhere."""
_CLEARLY: Final = 2.0
"""Those that are so many nearer are clearly there."""
_OWN_BENDS: Final = 4
"""Poses of a slot that give its noise by themselves."""
_SPARSE_NS: Final = 11 * NS_PER_S // 10
"""Over longer a bend shows how the robot turned, rather than noise."""
_PLACE_SLOTS: Final = 4
"""Slots that give the place at an end of a standstill."""
_OUTWARDS: Final = SILENCE_NS // SLOT_NS + 1
"""Slots beyond, in which the robot may still be there."""
PER_METRE: Final = 10_000
"""Means of positions are rounded: nothing depends on the order in which they are added up."""
_CREEP_BLOCKS: Final = CREEP_NS // BLOCK_NS
_BLOCKS_AT_ONCE: Final = 128
_STILL_M: Final = DRIFT_MPS * unix_from_ns(BLOCK_NS)
"""How far the means of a block spread without noise."""

DROP_SLOT_NS: Final = NS_PER_S // 2
MOVING_MPS: Final = 0.15
FRACTION: Final = 0.4
TURNS_RAD: Final = 0.35
_DROP_SLOTS: Final = 7
"""Slots that decide whether there is a drop at the fourth of them, and none at the third."""


class Box3(NamedTuple):
    """The smallest box (m) around some positions."""

    low: Vector3
    high: Vector3

    @property
    def centre(self) -> Vector3:
        """Its middle."""
        (a, b, c), (d, e, f) = self
        return ((a + d) / 2, (b + e) / 2, (c + f) / 2)

    @property
    def diagonal(self) -> float:
        """The distance of its far corners."""
        return math.dist(self.low, self.high)


class Standstill(NamedTuple):
    """A time in which the robot stood still: from its first pose there to its last (inclusive).

    `box` is around the mean positions of its slots.
    """

    start: Ns
    end: Ns
    box: Box3


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Blocks of time with slots that are linked, in order; a block may hold parts of two chains.

    In few bytes, since a week has 300,000.

    Attributes:
        numbers: which block, counted from the epoch.
        firsts: when the first pose of each is, in the chain that it is of: ns from its begin.
        lasts: when the last one is, likewise.
        noises: the highest standard deviation (m) of a slot's mean that noise of poses explains.
        lows: x, y, z of the lower corner of the box around the slots' means, as rows, in
            1 / `PER_METRE`.
        sizes: of the box, likewise.
        starts: of the first of still blocks in a row, the log time of the first pose at that place;
            else `MIN_NS`.
        ends: of the last of them, of the last pose there; else `MIN_NS`.
    """

    numbers: Ints
    firsts: NDArray[np.uint32]
    lasts: NDArray[np.uint32]
    noises: NDArray[np.float32]
    lows: Ints
    sizes: Ints
    starts: Ints
    ends: Ints

    def __len__(self) -> int:
        """Returns the number of blocks."""
        return self.numbers.size

    def span(self) -> tuple[Ints, Ints]:
        """Returns the log times (ns) of the first and of the last pose of each."""
        begins = self.numbers.astype(np.int64) * BLOCK_NS
        return begins + self.firsts, begins + self.lasts

    def corners(self) -> tuple[Vectors, Vectors]:
        """Returns the lower and the upper corners (m)."""
        lows = self.lows.astype(np.int64)
        return lows / PER_METRE, (lows + self.sizes) / PER_METRE

    def are_still(self) -> Flags:
        """Returns whether drift and noise explain the boxes."""
        lows, highs = self.corners()
        explained_m = np.maximum(_STILL_M, 4.5 * self.noises.astype(np.float64))
        return _lengths(highs - lows) <= np.minimum(explained_m, LARGEST_M)

    @property
    def memory_bytes(self) -> int:
        """How much memory the arrays take."""
        return sum(getattr(self, column.name).nbytes for column in fields(self))


_NONE: Final = np.empty(0, np.int64)
_NOWHERE: Final = narrowed(np.empty((0, 3), np.int64))
_OFFSETS: Final = np.empty(0, np.uint32)
NO_BLOCKS: Final = Blocks(
    narrowed(_NONE), _OFFSETS, _OFFSETS, np.empty(0, np.float32), _NOWHERE, _NOWHERE, _NONE, _NONE
)


class Stands(NamedTuple):
    """What shows where the robot stood in a stretch of time.

    Attributes:
        blocks: its blocks.
        drops: sudden losses of speed; standstills may follow.
        last: log time (ns) of the last pose at a place; `MIN_NS` without one.
    """

    blocks: Blocks
    drops: tuple[SpeedDrop, ...]
    last: Ns

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 2000 + self.blocks.memory_bytes + 200 * len(self.drops)


def stands_of(poses: Poses, start: Ns, stop: Ns) -> Stands:
    """Returns what shows where the robot stood; see `blocks_of`."""
    inside = poses.between(start, stop)
    places = inside.times[are_places(inside.positions)]
    return Stands(
        blocks_of(poses, start, stop),
        tuple(drop for drop in speed_drops(poses) if start <= drop.time < stop),
        int(places[-1]) if places.size else MIN_NS,
    )


def blocks_of(poses: Poses, start: Ns, stop: Ns) -> Blocks:
    """Returns the blocks of a stretch of time; chains that are surely too short have none.

    Args:
        poses: at least those of the stretch and `BESIDE_NS` beside it.
        start: log time (ns) where the stretch begins; blocks begin there.
        stop: where it ends, and blocks end.
    """
    valid = are_places(poses.positions)
    if not valid.any():
        return NO_BLOCKS
    slots = _Slots(poses.times[valid], poses.positions[valid])
    links = slots.links()
    to_previous, to_next = np.r_[False, links], np.r_[links, False]
    begins_chain = to_next & ~to_previous
    firsts, lasts = np.flatnonzero(begins_chain), np.flatnonzero(to_previous & ~to_next)
    # The robot may stand in a part of the slot beside a chain, too.
    previous, following = np.maximum(firsts - 1, 0), np.minimum(lasts + 1, len(slots) - 1)
    is_long = slots.lasts[following] - slots.firsts[previous] >= SHORTEST_NS
    # Each slot with links on both sides is of the newest chain that began.
    chains = np.cumsum(begins_chain)
    inner = np.flatnonzero(to_previous & to_next)
    blocks = _blocks(slots, inner[is_long[chains[inner] - 1]], chains)
    times, _ = blocks.span()
    return rows_of(blocks, (times >= start) & (times < stop))


def _blocks(slots: _Slots, inner: Ints, chains: Ints) -> Blocks:
    if not inner.size:
        return NO_BLOCKS
    numbers = slots.numbers[inner] * SLOT_NS // BLOCK_NS
    is_new = np.ones(inner.size, np.bool_)
    is_new[1:] = (np.diff(numbers) != 0) | (np.diff(chains[inner]) != 0)
    begins = np.flatnonzero(is_new)
    firsts, lasts = inner[begins], inner[np.r_[begins[1:], inner.size] - 1]
    first_times, last_times = slots.firsts[firsts], slots.lasts[lasts]
    starts_ns = numbers[begins] * BLOCK_NS
    means = slots.means[inner]
    noises = slots.noises(inner, inner + 1) / np.sqrt(slots.counts[inner])
    lows, highs = (
        np.rint(extreme.reduceat(means, begins) * PER_METRE).astype(np.int64)
        for extreme in (np.minimum, np.maximum)
    )
    blocks = Blocks(
        narrowed(numbers[begins]),
        (first_times - starts_ns).astype(np.uint32),
        (last_times - starts_ns).astype(np.uint32),
        np.maximum.reduceat(noises, begins).astype(np.float32),
        narrowed(lows),
        narrowed(highs - lows),
        np.full(begins.size, MIN_NS),
        np.full(begins.size, MIN_NS),
    )
    chain = chains[firsts]
    for begin, stop in zip(*_runs(blocks.are_still(), chain), strict=True):
        is_inside = begin > 0 and stop < chain.size and chain[begin - 1] == chain[stop]
        if is_inside and last_times[stop - 1] - first_times[begin] < SHORTEST_NS:
            continue  # noise hides slow motion for as long
        first, last = int(firsts[begin]), int(lasts[stop - 1])
        blocks.starts[begin] = slots.edge(first, last, -1)
        blocks.ends[stop - 1] = slots.edge(last, first, 1)
    return blocks


class _Slots:
    """Poses, of which there is one at least, by their slots of time."""

    def __init__(self, times: Ints, positions: Vectors) -> None:
        self.times, self.positions = times, positions
        slots = times // SLOT_NS
        self.begins = run_starts(slots)
        self.stops = np.r_[self.begins[1:], times.size]
        self.counts = self.stops - self.begins
        self.numbers = slots[self.begins]
        self.firsts, self.lasts = times[self.begins], times[self.stops - 1]

    def __len__(self) -> int:
        return self.begins.size

    @cached_property
    def means(self) -> Vectors:
        """The mean position of each slot."""
        # Mostly the same in each part, so that sums are rounded alike.
        origin = np.rint(self.positions[0])
        sums = np.add.reduceat(self.positions - origin, self.begins)
        means: Vectors = origin + sums / self.counts[:, None]
        return means

    @cached_property
    def _bends(self) -> tuple[Floats, Ints]:
        """The squares (m2) of second differences of poses: each is of the slot of its middle pose.

        And where those of each slot begin, and the last one's stop. A slot with enough poses has
        those inside of it alone.
        """
        bends = self.positions[:-2] - 2 * self.positions[1:-1] + self.positions[2:]
        slot = np.repeat(np.arange(len(self)), self.counts)
        is_inside = slot[2:] == slot[:-2]
        is_short = self.times[2:] - self.times[:-2] <= _SPARSE_NS
        is_counted = is_inside | (is_short & (self.counts[slot[1:-1]] < _OWN_BENDS))
        counts = np.bincount(slot[1:-1][is_counted], minlength=len(self))
        return row_sums(bends * bends)[is_counted], np.r_[0, np.cumsum(counts)]

    def noises(self, firsts: Ints, stops: Ints) -> Floats:
        """Returns the standard deviation (m) of the poses in ranges of slots.

        By a median, since a stopping robot bends once; 0 where there is no bend.
        """
        squares, edges = self._bends
        begins = edges[firsts]
        counts = edges[stops] - begins
        middles = np.zeros(counts.size)
        # Most ranges have as many: their rows are sorted at once.
        for count in np.unique(counts[counts > 0]).tolist():
            which, middle = np.flatnonzero(counts == count), (count - 1) // 2
            rows = squares[begins[which][:, None] + np.arange(count)]
            middles[which] = np.partition(rows, middle, axis=1)[:, middle]
        # The median of chi-squared is 0.45 of its mean for noise on one axis, 0.79 on three.
        return np.sqrt(middles / 6 / 0.6)

    def links(self) -> Flags:
        """Returns whether the robot may have stood still from each slot to the next with poses."""
        follows = self.firsts[1:] - self.lasts[:-1] <= SILENCE_NS
        apart_m = _lengths(np.diff(self.means, axis=0))
        allowed_m = DRIFT_MPS * (np.diff(self.numbers) * SLOT_NS / NS_PER_S)
        _, edges = self._bends
        many = edges[2:] - edges[:-2]
        unsure = np.flatnonzero(follows & (apart_m > allowed_m) & (many > 0))
        if unsure.size:
            spread = np.sqrt(1 / self.counts[unsure] + 1 / self.counts[unsure + 1])
            # Few of them may show much less noise than there is, hence the allowance.
            factor = _NOISE_FACTOR * (1 + 4 / many[unsure]) * spread
            noise = self.noises(unsure, unsure + 2)
            allowed_m[unsure] = np.maximum(allowed_m[unsure], factor * noise)
        linked: Flags = follows & (apart_m <= allowed_m)
        return linked

    def edge(self, at: int, other: int, step: int) -> Ns:
        """Returns when a standstill ends (`step` 1), or begins (-1), by its still slots there.

        Args:
            at: the outermost one.
            other: that at its other end.
            step: see above.
        """
        low, high = sorted((at, at - step * min(_PLACE_SLOTS - 1, abs(at - other))))
        at_end = self.positions[self.begins[low] : self.stops[high]]
        place = at_end.mean(axis=0)
        noise = float(self.noises(np.array([low]), np.array([high + 1]))[0])
        reach = max(_NEAREST_M, _ELSEWHERE * noise, 1.2 * float(_lengths(at_end - place).max()))
        far = np.searchsorted(self.numbers, self.numbers[at] + step * _OUTWARDS, side="left")
        low, high = sorted((at, int(far)))
        rows = np.arange(self.begins[low], self.stops[min(high, len(self) - 1)])[::step]
        away = _lengths(self.positions[rows] - place)
        # None is there beyond a silence.
        away[1:][np.abs(np.diff(self.times[rows])) > SILENCE_NS] = np.inf
        elsewhere = np.flatnonzero(away > reach)
        if not elsewhere.size:
            return int(self.times[rows[-1]])
        there = np.flatnonzero(away[: elsewhere[0]] <= reach - _CLEARLY * noise)
        return int(self.times[rows[there[-1] if there.size else 0]])


def _lengths(vectors: Vectors) -> Floats:
    return np.sqrt(row_sums(vectors * vectors))


def standstills_of(parts: Sequence[Blocks]) -> tuple[Standstill, ...]:
    """Returns the standstills in blocks of stretches of time that follow each other, in order."""
    blocks = stacked([NO_BLOCKS, *parts])
    if not len(blocks):
        return ()
    begins_chain = blocks.starts != MIN_NS
    firsts, lasts = blocks.span()
    # Parts of a history that each go on may have a silence between them.
    begins_chain[1:] |= firsts[1:] - lasts[:-1] > SILENCE_NS
    begins_chain[0] = True
    chain = np.cumsum(begins_chain)
    still = blocks.are_still()
    moves = _creeping(blocks, chain, still) | ~still
    stands: list[Standstill] = []
    begins, stops = _runs(~moves, chain)
    starts, ends = blocks.starts[begins], blocks.ends[stops - 1]
    starts = np.where(starts == MIN_NS, firsts[begins], starts)
    ends = np.where(ends == MIN_NS, lasts[stops - 1], ends)
    runs = (column.tolist() for column in (begins, stops, starts, ends))
    corners = blocks.corners()
    until = MIN_NS
    for begin, stop, since, end, box in zip(*runs, _boxes(corners, begins, stops), strict=True):
        # Ends are followed into each other's slots.
        start = max(since, until)
        if end - start < SHORTEST_NS:
            continue
        if box.diagonal <= DRIFTED_M:
            stands.append(Standstill(start, end, box))
        else:
            stands += _split_by_drift(corners, firsts[begin:stop], begin, start, end)
        until = stands[-1].end
    return tuple(stands)


def _boxes(corners: tuple[Vectors, Vectors], begins: Ints, stops: Ints) -> Iterator[Box3]:
    """Yields the boxes around some half-open ranges of blocks, which follow each other."""
    if not begins.size:
        return
    edges = np.stack([begins, stops], axis=1).reshape(-1)
    # One row more, since the last range may end where the blocks do.
    lows, highs = (np.append(corner, corner[-1:], axis=0) for corner in corners)
    lows, highs = np.minimum.reduceat(lows, edges)[::2], np.maximum.reduceat(highs, edges)[::2]
    for (a, b, c), (d, e, f) in zip(lows.tolist(), highs.tolist(), strict=True):
        yield Box3((a, b, c), (d, e, f))


def _runs(marks: Flags, chain: Ints) -> tuple[Ints, Ints]:
    """Returns where the ranges in one chain in which marks are set begin, and where they stop."""
    is_new = np.r_[True, (np.diff(chain) != 0) | ~marks[:-1]]
    is_over = np.r_[(np.diff(chain) != 0) | ~marks[1:], True]
    return np.flatnonzero(marks & is_new), np.flatnonzero(marks & is_over) + 1


def _split_by_drift(
    corners: tuple[Vectors, Vectors], firsts: Ints, first: int, start: Ns, end: Ns
) -> Iterator[Standstill]:
    """Yields the standstills of consecutive still blocks, of a robot that drifts away.

    Args:
        corners: of all blocks (m).
        firsts: of those in the run, the log time (ns) of the first pose.
        first: the position of the first of them among all.
        start: when the robot began to stand.
        end: when it ended.
    """
    lows, highs = (corner[first : first + firsts.size] for corner in corners)
    begin = 0
    while begin < firsts.size:
        count = _BLOCKS_AT_ONCE
        while True:
            low = np.minimum.accumulate(lows[begin : begin + count])
            high = np.maximum.accumulate(highs[begin : begin + count])
            fits = int((_lengths(high - low) <= DRIFTED_M).sum())
            if fits < count or begin + fits == firsts.size:
                break
            count *= 4
        (a, b, c), (d, e, f) = low[fits - 1].tolist(), high[fits - 1].tolist()
        begin += fits
        until = min(int(firsts[begin]), end) if begin < firsts.size else end
        if start < until:
            yield Standstill(start, until, Box3((a, b, c), (d, e, f)))
            start = until


def _creeping(blocks: Blocks, chain: Ints, still: Flags) -> Flags:
    """Returns which blocks are part of a creep: the shortest ones that lead `LARGEST_M` away."""
    left = _left_blocks(blocks, chain, still)
    creeping = np.zeros(len(blocks), np.bool_)
    since, newest = MIN_NS, 0
    for here in np.flatnonzero(left >= 0).tolist():
        there = int(left[here])
        if chain[here] != newest:
            newest, since = chain[here], MIN_NS
        if (begin := int(blocks.numbers[there])) > since:
            creeping[there : here + 1] = True
            since = begin
    return creeping


def _left_blocks(blocks: Blocks, chain: Ints, still: Flags) -> Ints:
    """Returns the newest block that each is `LARGEST_M` away from, within `CREEP_NS`; else -1."""
    run = np.cumsum(np.r_[True, (np.diff(chain) != 0) | ~(still[1:] & still[:-1])])
    low, high = blocks.corners()
    centres, noises = (low + high) / 2, blocks.noises.astype(np.float64)
    # Mostly the robot stands: no block is that far from another one as near in time.
    groups = np.arange(0, len(blocks), _CREEP_BLOCKS)
    lows, highs = (extreme.reduceat(centres, groups) for extreme in (np.minimum, np.maximum))
    lows[1:], highs[1:] = np.minimum(lows[1:], lows[:-1]), np.maximum(highs[1:], highs[:-1])
    has_moved = _lengths(highs - lows) > LARGEST_M
    moved = np.flatnonzero(np.repeat(has_moved, _CREEP_BLOCKS)[: len(blocks)])
    left, numbers = np.full(len(blocks), -1), blocks.numbers.astype(np.int64)
    for lag in range(1, _CREEP_BLOCKS):
        waiting = moved[(moved >= lag) & (left[moved] < 0)]
        waiting = waiting[run[waiting] == run[waiting - lag]]
        before = waiting - lag
        near = numbers[waiting] - numbers[before] < _CREEP_BLOCKS
        apart_m = _lengths(centres[waiting] - centres[before])
        far = near & (apart_m > LARGEST_M + 2 * (noises[waiting] + noises[before]))
        left[waiting[far]] = before[far]
    return left


class SpeedDrop(NamedTuple):
    """A sudden loss of speed: when it began, and the speeds (m/s) before and after."""

    time: Ns
    before_mps: float
    after_mps: float


def speed_drops(poses: Poses) -> tuple[SpeedDrop, ...]:
    """Returns where the robot suddenly slowed down, in order."""
    valid = np.flatnonzero(are_places(poses.positions))
    slots = poses.times[valid] // DROP_SLOT_NS
    # The first pose of each slot.
    rows = valid[run_starts(slots)]
    if rows.size < _DROP_SLOTS:
        return ()
    times, places = poses.times[rows], poses.positions[rows]
    speeds = _lengths(np.diff(places, axis=0)) / (np.diff(times) / NS_PER_S)
    # Of two slots: a robot whose position jumps, and is back, gets no farther.
    ahead = _lengths(places[2:] - places[:-2]) / ((times[2:] - times[:-2]) / NS_PER_S)
    before = np.minimum(np.minimum(speeds[:-1], speeds[1:]), ahead)
    after = np.maximum(speeds[:-1], speeds[1:])
    falls = (before[:-3] >= MOVING_MPS) & (after[3:] <= FRACTION * before[:-3])
    slots = times // DROP_SLOT_NS
    in_a_row = slots[_DROP_SLOTS - 1 :] - slots[: 1 - _DROP_SLOTS] < _DROP_SLOTS
    drops = np.flatnonzero(in_a_row & falls[1:] & ~falls[:-1])
    turned = headings(poses.turns[rows[drops + 6]]) - headings(poses.turns[rows[drops + 2]])
    # Where a heading is not known, it turns no more than others.
    drops = drops[~(np.abs(np.angle(np.exp(1j * turned))) > TURNS_RAD)]
    return tuple(
        SpeedDrop(int(times[at + 3]), float(before[at + 1]), float(after[at + 4]))
        for at in drops.tolist()
    )

"""Where the robot stood still, and where it suddenly slowed down.

A standstill lasts at least `SHORTEST_NS`, in which the robot moves no faster than odometry drifts.
It begins with the first pose at its place and ends with the last one.

- **Slots.** Poses are averaged in slots of `SLOT_NS`, so that noise averages out. Consecutive slots
  are linked if a drift of `DRIFT_MPS`, or the noise of their poses, explains the distance of their
  means, or the wandering of a position at rest (`Poses.wander_m`). Linked slots form a chain. Its
  first and last slot may be half motion and are left out.
- **Blocks.** Noise may hide slow motion from two slots, but not from the slots of a block of
  `BLOCK_NS`. A block whose means spread farther than drift and noise explain is motion, and splits
  the chain.
- **Creeps.** Still blocks that lead `LARGEST_M` away within `CREEP_NS` are motion, too: the robot
  creeps. What takes longer is drift, as of a camera's odometry while the robot is at its dock. A
  standstill that drifts out of `DRIFTED_M` ends there, and the next one begins.
- **Ends.** The ends of a row of still blocks are found pose by pose. Some slots just inside give
  the place and its noise. From there poses are followed outwards until two in a row are elsewhere,
  or one that noise does not explain. The last pose before that is clearly at the place is the end.
  Two rows at one place whose ends meet are one standstill, which noise parted.

All this depends on poses a few slots around, and slots and blocks are counted from the epoch. The
`Blocks` of a stretch of time follow from its poses and those `BESIDE_NS` beside it. So a standstill
is the same in every window, and however a history is cut.

The noise of a slot is estimated from second differences, which a steady motion leaves at zero.
Their variance is six times that of the noise. For first differences see J. von Neumann et al., "The
mean square successive difference", Ann. Math. Statist. 12 (1941).

Sudden losses of speed are found in the first poses of slots of `DROP_SLOT_NS`. The robot goes
`MOVING_MPS` or faster from slot to slot. Then its speed falls, within two slots, to `FRACTION` of
that or less, and stays there for two slots. If it turns meanwhile, or in the two slots after these,
it slows down on purpose, as nearly all robots do. A drop depends on `_DROP_SLOTS` slots in a row:
poses that come less often than once a slot, and a position that jumps for a moment, show none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.poses import REST_NS, SLOT_NS, Poses, headings
from ros2_memory.core.arrays import (
    Flags,
    Floats,
    Ints,
    Vectors,
    narrowed,
    range_numbers,
    row_sums,
    rows_of,
    run_starts,
    runs_where,
    stacked,
)
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, Span, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.model import Vector3

SHORTEST_NS: Final = 3 * NS_PER_S
"""A robot that is still for less is turning, or driving with care."""
SILENCE_NS: Final = 5 * NS_PER_S // 2
"""Between poses farther apart nothing is known: a standstill ends there."""
BLOCK_NS: Final = 5 * SLOT_NS
BESIDE_NS: Final = REST_NS + SHORTEST_NS + 3 * NS_PER_S
"""Poses so far before and after a stretch of time take part in its blocks."""
CREEP_NS: Final = 15 * BLOCK_NS
"""A robot that moves farther than `LARGEST_M` in this time creeps; a slower one drifts."""
CONTEXT_NS: Final = CREEP_NS + SHORTEST_NS + BLOCK_NS + 2 * SILENCE_NS
"""Poses so far outside a window decide whether the robot stood still inside it."""
DRIFT_MPS: Final = 0.008
"""How fast odometry may drift while the robot stands."""
LARGEST_M: Final = 0.1
_WIDEST_M: Final = 0.15
"""No noise explains a larger box around the means of a block."""
DRIFTED_M: Final = 1.0
"""How far odometry may drift in one standstill."""
CREEP_MPS: Final = LARGEST_M / unix_from_ns(CREEP_NS)
"""A slower robot cannot be distinguished from one that stands still."""

_NOISE_FACTOR: Final = 5.5
"""Noise explains a distance of two means of up to so many of its standard deviations."""
_BOX_NOISE_FACTOR: Final = 4.5
"""Noise explains a box around the means of a block of up to so many of its standard deviations."""
_NEAREST_M: Final = 0.0003
"""Poses without noise are at one place if they are no farther apart than this."""
_ELSEWHERE: Final = 3.0
"""Two poses in a row more than so many standard deviations from a place are elsewhere."""
_SURELY: Final = 6.0
"""A single pose so many standard deviations from a place is elsewhere, whatever the next one is."""
_CLEARLY: Final = 2.0
"""Poses that are so many standard deviations nearer are clearly there."""
_OWN_BENDS: Final = 4
"""So many poses of a slot give its noise by themselves."""
_SPARSE_NS: Final = 11 * NS_PER_S // 10
"""Over a longer time, a second difference shows how the robot turned, not noise."""
_PLACE_SLOTS: Final = 4
"""How many slots give the place at an end of a standstill."""
_OUTWARDS: Final = SILENCE_NS // SLOT_NS + 1
"""In how many slots outside of it the robot may still be there."""
PER_METRE: Final = 10_000
"""Means of positions are rounded, so that the order of their sums does not matter."""
_CREEP_BLOCKS: Final = CREEP_NS // BLOCK_NS
_STILL_M: Final = DRIFT_MPS * unix_from_ns(BLOCK_NS)
"""How far drift alone spreads the means of a block."""

DROP_SLOT_NS: Final = NS_PER_S // 2
MOVING_MPS: Final = 0.15
FRACTION: Final = 0.4
TURNS_RAD: Final = 0.35
_DROP_SLOTS: Final = 9
"""How many slots decide whether there is a drop at the fourth of them, and none at the third."""


class Box3(NamedTuple):
    """The smallest box (m) around some positions."""

    low: Vector3
    high: Vector3

    @property
    def centre(self) -> Vector3:
        """The middle (m)."""
        (a, b, c), (d, e, f) = self
        return ((a + d) / 2, (b + e) / 2, (c + f) / 2)

    @property
    def diagonal(self) -> float:
        """The distance (m) of opposite corners."""
        return math.dist(self.low, self.high)

    def united(self, other: Box3) -> Box3:
        """Returns the smallest box around both."""
        (a, b, c), (d, e, f) = (map(min, self.low, other.low), map(max, self.high, other.high))
        return Box3((a, b, c), (d, e, f))


class Standstill(NamedTuple):
    """A standstill, from the first pose to the last (log times, inclusive), or a part of one.

    `box` is the box around the mean positions of its slots. If it `goes_on`, it did not end then.
    """

    start: Ns
    end: Ns
    box: Box3
    goes_on: bool = False

    @property
    def length(self) -> Ns:
        """How long it lasts (ns)."""
        return self.end - self.start

    @property
    def span(self) -> Span:
        """Its first and its last time (ns)."""
        return self.start, self.end


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Blocks of linked slots, in order; a row for each block and chain, which may share a block.

    Rows take few bytes, since a week has 300,000 blocks.

    Attributes:
        numbers: the number of the block, counted from the epoch.
        firsts: the first pose of the chain in the block: ns from the begin of the block.
        lasts: the last pose of the chain in the block: ns from the begin of the block.
        noises: the greatest standard deviation (m) that noise gives to the mean of a slot.
        lows: x, y, z of the lower corner of the box around the means of slots, in 1 / `PER_METRE`.
        sizes: the size of this box, in 1 / `PER_METRE`.
        starts: for the first block of a row of still blocks, the log time of the first pose at its
            place; else `MIN_NS`.
        ends: for the last block of a row of still blocks, the log time of the last pose at its
            place; else `MIN_NS`.
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
        """Returns the log times (ns) of the first and the last pose of each block."""
        begins = self.numbers.astype(np.int64) * BLOCK_NS
        return begins + self.firsts, begins + self.lasts

    def corners(self) -> tuple[Vectors, Vectors]:
        """Returns the lower and the upper corners (m) of the boxes."""
        lows = self.lows.astype(np.int64)
        return lows / PER_METRE, (lows + self.sizes) / PER_METRE

    def are_still(self) -> Flags:
        """Returns in which blocks drift and noise explain the spread of the means."""
        lows, highs = self.corners()
        explained_m = np.maximum(_STILL_M, _BOX_NOISE_FACTOR * self.noises.astype(np.float64))
        return _lengths(highs - lows) <= np.minimum(explained_m, _WIDEST_M)

    @property
    def memory_bytes(self) -> int:
        """How much memory the arrays take."""
        return sum(getattr(self, column.name).nbytes for column in fields(self))


_NO_INTS: Final = np.empty(0, np.int64)
_NO_OFFSETS: Final = np.empty(0, np.uint32)
_NO_PLACES: Final = narrowed(np.empty((0, 3), np.int64))
NO_BLOCKS: Final = Blocks(
    numbers=narrowed(_NO_INTS),
    firsts=_NO_OFFSETS,
    lasts=_NO_OFFSETS,
    noises=np.empty(0, np.float32),
    lows=_NO_PLACES,
    sizes=_NO_PLACES,
    starts=_NO_INTS,
    ends=_NO_INTS,
)


class Stands(NamedTuple):
    """What is stored of standstills and drops in a stretch of time.

    Attributes:
        blocks: the blocks of the stretch.
        drops: its sudden losses of speed.
        last: log time of the last valid pose; `MIN_NS` without one.
    """

    blocks: Blocks
    drops: tuple[SpeedDrop, ...]
    last: Ns

    @property
    def memory_bytes(self) -> int:
        """About how much memory they take."""
        return 2000 + self.blocks.memory_bytes + 200 * len(self.drops)


def stands_of(poses: Poses, start: Ns, stop: Ns) -> Stands:
    """Returns the blocks and drops of a stretch of time, with arguments as `blocks_of` takes."""
    inside = poses.between(start, stop)
    places = inside.times[are_places(inside.positions)]
    return Stands(
        blocks_of(poses, start, stop),
        tuple(drop for drop in speed_drops(poses) if start <= drop.time < stop),
        int(places[-1]) if places.size else MIN_NS,
    )


def blocks_of(poses: Poses, start: Ns, stop: Ns) -> Blocks:
    """Returns the blocks of a stretch of time, without those of chains that are too short.

    Args:
        poses: the poses of the stretch and `BESIDE_NS` before and after it; more do no harm.
        start: log time (ns) at which the stretch begins, the begin of a block.
        stop: log time (ns) at which it ends, the end of a block.
    """
    valid = np.flatnonzero(are_places(poses.positions))
    if not valid.size:
        return NO_BLOCKS
    slots = _Slots(poses.rows(valid))
    links = slots.links()
    to_previous, to_next = np.r_[False, links], np.r_[links, False]
    begins_chain = to_next & ~to_previous
    firsts, lasts = np.flatnonzero(begins_chain), np.flatnonzero(to_previous & ~to_next)
    # The robot may also stand in a part of the slots before and after a chain.
    previous, following = np.maximum(firsts - 1, 0), np.minimum(lasts + 1, len(slots) - 1)
    is_long = slots.lasts[following] - slots.firsts[previous] >= SHORTEST_NS
    # For each inner slot of a chain, this is the number of its chain.
    chains = np.cumsum(begins_chain)
    inner = np.flatnonzero(to_previous & to_next)
    blocks = _blocks(slots, inner[is_long[chains[inner] - 1]], chains)
    times, _ = blocks.span()
    return rows_of(blocks, (times >= start) & (times < stop))


def _blocks(slots: _Slots, inner: Ints, chains: Ints) -> Blocks:
    """Returns the blocks of the inner slots of chains, with the ends of rows of still blocks.

    `inner` has the indices of these slots, `chains` the number of the chain of each slot.
    """
    if not inner.size:
        return NO_BLOCKS
    numbers = slots.numbers[inner] * SLOT_NS // BLOCK_NS
    begins = run_starts(numbers, chains[inner])
    firsts, lasts = inner[begins], inner[np.r_[begins[1:], inner.size] - 1]
    first_times, last_times = slots.firsts[firsts], slots.lasts[lasts]
    starts_ns = numbers[begins] * BLOCK_NS
    means = slots.means[inner]
    noises = slots.noises(inner, inner + 1) / np.sqrt(slots.counts[inner])
    noises = np.maximum(noises, slots.wander_m[inner])
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
    for begin, stop in runs_where(blocks.are_still(), chain).tolist():
        # Between blocks of motion in one chain, noise may hide slow motion for so short a time.
        is_inside = begin > 0 and stop < chain.size and chain[begin - 1] == chain[stop]
        if is_inside and last_times[stop - 1] - first_times[begin] < SHORTEST_NS:
            continue
        first, last = int(firsts[begin]), int(lasts[stop - 1])
        blocks.starts[begin] = slots.edge(first, last, -1)
        blocks.ends[stop - 1] = slots.edge(last, first, 1)
    return blocks


class _Slots:
    """One or more poses by their slots of time.

    Attributes:
        times: log times of the poses (ns), ascending.
        positions: rows of x, y and z (m) of the poses.
        begins: for each slot, the index of its first pose.
        stops: for each slot, the index after its last pose.
        counts: for each slot, how many poses it has.
        numbers: for each slot, its number since the epoch.
        firsts: for each slot, the log time of its first pose.
        lasts: for each slot, the log time of its last pose.
        wander_m: for each slot, the standard deviation with which its mean may wander at rest.
    """

    def __init__(self, poses: Poses) -> None:
        times = self.times = poses.times
        self.positions = poses.positions
        slots = times // SLOT_NS
        self.begins = run_starts(slots)
        self.stops = np.r_[self.begins[1:], times.size]
        self.counts = self.stops - self.begins
        self.numbers = slots[self.begins]
        self.firsts, self.lasts = times[self.begins], times[self.stops - 1]
        self.wander_m = poses.wander_m()[self.begins]

    def __len__(self) -> int:
        return self.begins.size

    @cached_property
    def means(self) -> Vectors:
        """The mean position (m) of each slot."""
        # Mostly the origin is the same in all parts of a history, so that sums are rounded alike.
        origin = np.rint(self.positions[0])
        sums = np.add.reduceat(self.positions - origin, self.begins)
        means: Vectors = origin + sums / self.counts[:, None]
        return means

    @cached_property
    def _bends(self) -> tuple[Floats, Ints]:
        """The squared second differences (m2) of poses, and the edges of those of each slot.

        A difference belongs to the slot of its middle pose. If a slot has enough poses, only
        differences inside of it count.
        """
        bends = self.positions[:-2] - 2 * self.positions[1:-1] + self.positions[2:]
        slot = range_numbers(self.counts)
        is_inside = slot[2:] == slot[:-2]
        is_short = self.times[2:] - self.times[:-2] <= _SPARSE_NS
        is_counted = is_inside | (is_short & (self.counts[slot[1:-1]] < _OWN_BENDS))
        counts = np.bincount(slot[1:-1][is_counted], minlength=len(self))
        return row_sums(bends * bends)[is_counted], np.r_[0, np.cumsum(counts)]

    def noises(self, firsts: Ints, stops: Ints) -> Floats:
        """Returns the standard deviation (m) of poses in half-open ranges of slots.

        It follows from the median of the squared second differences, since a stopping robot makes
        one large difference. 0 if there is no difference.
        """
        squares, edges = self._bends
        begins = edges[firsts]
        counts = edges[stops] - begins
        medians = np.zeros(counts.size)
        # Most ranges have equally many differences: their medians are computed at once.
        for count in np.unique(counts[counts > 0]).tolist():
            ranges, middle = np.flatnonzero(counts == count), (count - 1) // 2
            rows = squares[begins[ranges][:, None] + np.arange(count)]
            medians[ranges] = np.partition(rows, middle, axis=1)[:, middle]
        # The median of chi-squared is 0.45 of its mean for noise on one axis, 0.79 on three.
        return np.sqrt(medians / 6 / 0.6)

    def links(self) -> Flags:
        """Returns whether the robot may have stood still from each slot to the next one."""
        follows = self.firsts[1:] - self.lasts[:-1] <= SILENCE_NS
        apart_m = _lengths(np.diff(self.means, axis=0))
        allowed_m = np.maximum(
            DRIFT_MPS * (np.diff(self.numbers) * SLOT_NS / NS_PER_S),
            _NOISE_FACTOR * np.minimum(self.wander_m[:-1], self.wander_m[1:]),
        )
        _, edges = self._bends
        many = edges[2:] - edges[:-2]
        unsure = np.flatnonzero(follows & (apart_m > allowed_m) & (many > 0))
        if unsure.size:
            spread = np.sqrt(1 / self.counts[unsure] + 1 / self.counts[unsure + 1])
            # A few differences may show much less noise than there is, hence the allowance.
            factor = _NOISE_FACTOR * (1 + 4 / many[unsure]) * spread
            noise = self.noises(unsure, unsure + 2)
            allowed_m[unsure] = np.maximum(allowed_m[unsure], factor * noise)
        linked: Flags = follows & (apart_m <= allowed_m)
        return linked

    def edge(self, at: int, other: int, step: int) -> Ns:
        """Returns the log time (ns) at which a standstill begins or ends, by its poses.

        Args:
            at: the outermost still slot at this end.
            other: the outermost still slot at the other end.
            step: 1 for the end, -1 for the begin.
        """
        low, high = sorted((at, at - step * min(_PLACE_SLOTS - 1, abs(at - other))))
        inside = self.positions[self.begins[low] : self.stops[high]]
        place = inside.mean(axis=0)
        noise = float(self.noises(np.array([low]), np.array([high + 1]))[0])
        reach = max(_NEAREST_M, _ELSEWHERE * noise, 1.2 * float(_lengths(inside - place).max()))
        far = np.searchsorted(self.numbers, self.numbers[at] + step * _OUTWARDS, side="left")
        low, high = sorted((at, int(far)))
        outwards = np.arange(self.begins[low], self.stops[min(high, len(self) - 1)])[::step]
        away = _lengths(self.positions[outwards] - place)
        # Poses beyond a silence are elsewhere.
        away[1:][np.abs(np.diff(self.times[outwards])) > SILENCE_NS] = np.inf
        is_beyond = away > reach
        # Noise alone takes one pose of some hundreds so far, but hardly two in a row.
        is_next_beyond = np.append(is_beyond[1:], True)
        elsewhere = np.flatnonzero(is_beyond & (is_next_beyond | (away > _SURELY * noise)))
        if not elsewhere.size:
            return int(self.times[outwards[-1]])
        clearly_there = np.flatnonzero(away[: elsewhere[0]] <= reach - _CLEARLY * noise)
        last = clearly_there[-1] if clearly_there.size else 0
        return int(self.times[outwards[last]])


def _lengths(vectors: Vectors) -> Floats:
    return np.sqrt(row_sums(vectors * vectors))


def standstills_of(parts: Sequence[Blocks]) -> tuple[Standstill, ...]:
    """Returns the standstills in the blocks of consecutive stretches of time, in order."""
    blocks = stacked([NO_BLOCKS, *parts])
    if not len(blocks):
        return ()
    begins_chain = blocks.starts != MIN_NS
    firsts, lasts = blocks.span()
    # The poses of two parts may have a silence between them that neither part shows.
    begins_chain[1:] |= firsts[1:] - lasts[:-1] > SILENCE_NS
    begins_chain[0] = True
    chain = np.cumsum(begins_chain)
    is_still = blocks.are_still()
    moves = _creeping(blocks, chain, is_still) | ~is_still
    begins, stops = runs_where(~moves, chain).T
    starts, ends = blocks.starts[begins], blocks.ends[stops - 1]
    starts = np.where(starts == MIN_NS, firsts[begins], starts)
    ends = np.where(ends == MIN_NS, lasts[stops - 1], ends)
    runs = (column.tolist() for column in (begins, stops, starts, ends))
    corners = blocks.corners()
    stands: list[Standstill] = []
    newest_end, newest_box = MIN_NS, None
    for begin, stop, since, end, box in zip(*runs, _boxes(corners, begins, stops), strict=True):
        # The ends of two standstills may reach into each other's slots.
        start = max(since, newest_end)
        if since <= newest_end and newest_box is not None:
            # No pose is elsewhere between two at one place: noise parted them.
            whole, both = stands[-1].box.united(box), newest_box.united(box)
            apart_m = both.diagonal - newest_box.diagonal - box.diagonal
            if (apart_m <= 0 or both.diagonal <= LARGEST_M) and whole.diagonal <= DRIFTED_M:
                newest_end, newest_box = max(end, newest_end), box
                stands[-1] = stands[-1]._replace(end=newest_end, box=whole)
                continue
        if end - start < SHORTEST_NS:
            continue
        newest_box = box
        if box.diagonal <= DRIFTED_M:
            stands.append(Standstill(start, end, box))
        else:
            blocks_of_run = np.arange(begin, stop)
            boxes = _boxes(corners, blocks_of_run, blocks_of_run + 1)
            stands += _split_by_drift(boxes, firsts[begin:stop], start, end)
        newest_end = stands[-1].end
    return tuple(stands)


def _boxes(corners: tuple[Vectors, Vectors], begins: Ints, stops: Ints) -> Iterator[Box3]:
    """Yields the boxes around half-open ranges of blocks, which are in order and apart."""
    if not begins.size:
        return
    edges = np.stack([begins, stops], axis=1).reshape(-1)
    # `reduceat` takes no edge behind the last row, where the last range may stop: one row more.
    lows, highs = (np.append(corner, corner[-1:], axis=0) for corner in corners)
    lows, highs = np.minimum.reduceat(lows, edges)[::2], np.maximum.reduceat(highs, edges)[::2]
    for (a, b, c), (d, e, f) in zip(lows.tolist(), highs.tolist(), strict=True):
        yield Box3((a, b, c), (d, e, f))


def _split_by_drift(
    boxes: Iterable[Box3], firsts: Ints, start: Ns, end: Ns
) -> Iterator[Standstill]:
    """Yields the standstills of a run of still blocks that drifts out of `DRIFTED_M`.

    Args:
        boxes: the boxes of the blocks.
        firsts: the log times (ns) of the first poses of the blocks.
        start: the log time (ns) at which the run begins.
        end: the log time (ns) at which it ends.
    """
    box, *others = boxes
    for first, other in zip(firsts[1:].tolist(), others, strict=True):
        whole = box.united(other)
        if whole.diagonal <= DRIFTED_M:
            box = whole
            continue
        if start < min(first, end):
            yield Standstill(start, min(first, end), box)
            start = min(first, end)
        box = other
    if start < end:
        yield Standstill(start, end, box)


def _creeping(blocks: Blocks, chain: Ints, is_still: Flags) -> Flags:
    """Returns which blocks are part of a creep, a row of blocks that leads `LARGEST_M` away.

    Of creeps that end in one block, or that contain each other, the shortest counts.
    """
    left = _left_blocks(blocks, chain, is_still)
    is_creeping = np.zeros(len(blocks), np.bool_)
    newest_begin, newest_chain = MIN_NS, 0
    for last in np.flatnonzero(left >= 0).tolist():
        first = int(left[last])
        if chain[last] != newest_chain:
            newest_chain, newest_begin = chain[last], MIN_NS
        begin = int(blocks.numbers[first])
        if begin > newest_begin:
            is_creeping[first : last + 1] = True
            newest_begin = begin
    return is_creeping


def _left_blocks(blocks: Blocks, chain: Ints, is_still: Flags) -> Ints:
    """Returns, for each block, the newest one that it is `LARGEST_M` away from; else -1.

    Only still blocks up to `CREEP_NS` before, in an unbroken row of still blocks, are compared.
    """
    run = np.cumsum(np.r_[True, (np.diff(chain) != 0) | ~(is_still[1:] & is_still[:-1])])
    low, high = blocks.corners()
    centres, noises = (low + high) / 2, blocks.noises.astype(np.float64)
    # Mostly the robot stands. Only groups of blocks whose centres spread far enough are compared.
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
        explained_m = 4 * np.minimum(noises[waiting], noises[before])
        far = near & (apart_m > LARGEST_M + explained_m)
        left[waiting[far]] = before[far]
    return left


class SpeedDrop(NamedTuple):
    """A sudden loss of speed: the log time at which it began, and the speeds before and after."""

    time: Ns
    before_mps: float
    after_mps: float


def speed_drops(poses: Poses) -> tuple[SpeedDrop, ...]:
    """Returns the sudden losses of speed, in order."""
    valid = np.flatnonzero(are_places(poses.positions))
    rows = valid[run_starts(poses.times[valid] // DROP_SLOT_NS)]
    if rows.size < _DROP_SLOTS:
        return ()
    times, places = poses.times[rows], poses.positions[rows]
    speeds = _lengths(np.diff(places, axis=0)) / (np.diff(times) / NS_PER_S)
    # Over two slots, a robot whose position jumps for a moment gets no farther.
    ahead = _lengths(places[2:] - places[:-2]) / ((times[2:] - times[:-2]) / NS_PER_S)
    before = np.minimum(np.minimum(speeds[:-1], speeds[1:]), ahead)
    after = np.maximum(speeds[:-1], speeds[1:])
    falls = (before[:-3] >= MOVING_MPS) & (after[3:] <= FRACTION * before[:-3])
    slots = times // DROP_SLOT_NS
    in_a_row = slots[_DROP_SLOTS - 1 :] - slots[: 1 - _DROP_SLOTS] < _DROP_SLOTS
    drops = np.flatnonzero(in_a_row & falls[1:-2] & ~falls[:-3])
    turned = headings(poses.turns[rows[drops + 8]]) - headings(poses.turns[rows[drops + 2]])
    # A comparison with NaN is false: without a heading the robot is taken not to turn.
    drops = drops[~(np.abs(np.angle(np.exp(1j * turned))) > TURNS_RAD)]
    return tuple(
        SpeedDrop(int(times[at + 3]), float(before[at + 1]), float(after[at + 4]))
        for at in drops.tolist()
    )

"""Where the robot stood still: pose by pose, or a whole bag at once.

A standstill is a time of at least `SHORTEST_NS` in which the robot stays in a box that does not
grow with time. It begins with the first pose at that place and ends with the last.

Poses are averaged in slots of `SLOT_NS`, counted from the epoch, so that noise averages out.
Consecutive slots are linked where their means are no farther apart than a drift of `DRIFT_MPS` or
the noise of their own poses explains, and linked slots form a chain. The ends of a chain are then
found pose by pose: a slot that is clearly inside gives the place and its noise, and poses are
followed outwards, through the last slot of the chain and the one beyond, until one is elsewhere.
Slow motion that noise hides from two slots shows in blocks of `BLOCK_NS`: a block whose means
spread farther than drift and noise explain is motion, and splits the chain. So are still blocks
that lead `LARGEST_M` away within `CREEP_NS`: the robot creeps. A standstill that drifts out of
`LARGEST_M` in a longer time ends there, and the next one begins.

All of this depends only on poses a few slots around; slots and blocks are counted from the epoch,
and all positions are rounded alike (`_STEP_M`). So a standstill is the same whatever window is
asked about, and however a history is cut into bags.

The noise of a slot is estimated from second differences, which a steady motion leaves at zero: see
J. von Neumann et al., "The mean square successive difference", Ann. Math. Statist. 12 (1941), for
first differences; those of second order have six times the variance of the noise.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, takewhile
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.motion.odometry import TimedPosition
from ros2_memory.analysis.motion.speed_drops import (
    NO_DROPS,
    SpeedDropBuilder,
    SpeedDropCollector,
    SpeedDropDigest,
)
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.motion.speed_drops import SpeedDrop
    from ros2_memory.core.model import Quaternion, Vector3

SHORTEST_NS: Final[Ns] = 3 * NS_PER_S
"""A robot that is still for less is turning, or driving with care."""
SILENCE_NS: Final[Ns] = 5 * NS_PER_S // 2
"""Between poses farther apart nothing is known: a standstill ends there."""
SLOT_NS: Final[Ns] = 2 * NS_PER_S // 5
BLOCK_NS: Final[Ns] = 5 * SLOT_NS
CREEP_NS: Final[Ns] = 15 * BLOCK_NS
"""A robot that moves farther than `LARGEST_M` in this time creeps; a slower one drifts."""
CONTEXT_NS: Final[Ns] = CREEP_NS + SHORTEST_NS + BLOCK_NS + 2 * SILENCE_NS
"""Poses so far outside a window decide whether the robot stood still inside it."""
DRIFT_MPS: Final = 0.008
"""The mean position of a still robot may move so fast: odometry drifts."""
LARGEST_M: Final = 0.1
CREEP_MPS: Final = LARGEST_M / unix_from_ns(CREEP_NS)
"""A slower robot cannot be distinguished from one that stands still."""

_NOISE_FACTOR: Final = 5.5
_NEAREST_M: Final = 0.0003
"""Poses without noise are at one place if they are no farther apart than this."""
_STEP_M: Final = 0.0001
"""What positions and their means are rounded to."""
_MAX_IN_SLOT: Final = 1_000
_EDGE_SLOTS: Final = 3
_CREEP_BLOCKS: Final = CREEP_NS // BLOCK_NS


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

    def united(self, other: Box3) -> Box3:
        """Returns the box around both."""
        (a, b, c), (d, e, f) = self
        (g, h, i), (j, k, m) = other
        return Box3((min(a, g), min(b, h), min(c, i)), (max(d, j), max(e, k), max(f, m)))


class Standstill(NamedTuple):
    """A time in which the robot stood still: from its first pose there to its last (inclusive).

    `box` is around the mean positions of its slots.
    """

    start: Ns
    end: Ns
    box: Box3


class Block(NamedTuple):
    """The linked slots of one block of time: their first and last pose, the box of their means.

    `noise` is the highest standard deviation (m) of these means that the noise of poses explains.
    """

    number: int
    first: Ns
    last: Ns
    noise: float
    box: Box3

    @property
    def is_still(self) -> bool:
        """Whether drift and noise explain its box."""
        explained = max(DRIFT_MPS * unix_from_ns(BLOCK_NS), 4.5 * self.noise)
        return self.box.diagonal <= min(explained, LARGEST_M)

    def is_far_from(self, other: Block) -> bool:
        """Returns whether the distance exceeds `LARGEST_M` by more than noise."""
        apart_m = math.dist(self.box.centre, other.box.centre)
        return apart_m > LARGEST_M + 2 * (self.noise + other.noise)


class ChainDigest(NamedTuple):
    """Linked slots of one bag; an end that depends on the poses of other bags is None.

    `blocks` are encoded by `encode_blocks`.
    """

    start: Ns | None
    end: Ns | None
    blocks: bytes


@dataclass(frozen=True, slots=True)
class StandstillDigest:
    """The standstills among the poses of one bag, to be joined with those before and after.

    The first and the last slot may have more poses in the bags before and after, so `chains` are of
    the slots between them; those with two known ends last at least `SHORTEST_NS`.

    Attributes:
        head: poses of the first three slots; of all where there are fewer than five. Encoded by
            `encode_positions`.
        head_until: the log time of the last of these.
        tail: poses of the last three slots; empty where `head` has all.
        tail_since: the log time of the first of these.
        chains: in order. The first one's start is None where it includes the second slot, the last
            one's end where it includes the last slot but one.
        drops: of speed, among the same poses.
    """

    head: bytes
    head_until: Ns
    tail: bytes = b""
    tail_since: Ns = 0
    chains: tuple[ChainDigest, ...] = ()
    drops: SpeedDropDigest = NO_DROPS


@dataclass(frozen=True, slots=True)
class StandstillRun:
    """Consecutive bags, joined as far as no bag before or after them matters.

    Attributes:
        lead: the first bags, up to one at whose end no standstill is open; if none, all.
        found: the standstills of the bags after these, up to the last one of that kind.
        drops: of speed, in the same bags.
        last: the last bag of that kind.
        trail: the bags after it.
    """

    lead: tuple[StandstillDigest, ...]
    found: tuple[Standstill, ...] = ()
    drops: tuple[SpeedDrop, ...] = ()
    last: StandstillDigest | None = None
    trail: tuple[StandstillDigest, ...] = ()

    @classmethod
    def of(cls, bags: Sequence[StandstillDigest]) -> StandstillRun:
        """Returns the run of some bags, in order."""
        over = [nth for nth, bag in enumerate(bags) if _ends_over(bag)]
        if len(over) < 2:
            return cls(tuple(bags))
        first, last = over[0], over[-1]
        found, drops = StandstillBuilder().run_after(bags[first], bags[first + 1 : last + 1])
        return cls(tuple(bags[: first + 1]), found, drops, bags[last], tuple(bags[last + 1 :]))


def _ends_over(bag: StandstillDigest) -> bool:
    """Returns whether no standstill is open at the end of a bag, whatever came before it.

    All that ended in it did so before its last slots, in which the next one may begin.
    """
    if not (bag.tail and bag.drops.tail) or bag.head_until > bag.tail_since:
        return False
    end = bag.chains[-1].end if bag.chains else 0
    return end is not None and end <= bag.tail_since


class _Slot:
    """The poses of one slot of time; none is added once `mean` or `bends` were asked for."""

    def __init__(self, poses: list[TimedPosition]) -> None:
        self.number = poses[0].time // SLOT_NS
        self.poses = poses

    def add(self, pose: TimedPosition) -> None:
        if len(self.poses) < _MAX_IN_SLOT:
            self.poses.append(pose)
        else:
            self.poses[-1] = pose

    @property
    def first(self) -> Ns:
        return self.poses[0].time

    @property
    def last(self) -> Ns:
        return self.poses[-1].time

    @cached_property
    def mean(self) -> Vector3:
        x, y, z = zip(*(position for _, position in self.poses), strict=True)
        many = len(self.poses)
        return (math.fsum(x) / many, math.fsum(y) / many, math.fsum(z) / many)

    @cached_property
    def bends(self) -> list[float]:
        """Squares of the second differences of its positions (m2)."""
        places = [position for _, position in self.poses]
        return [
            (a - 2 * b + c) ** 2 + (d - 2 * e + f) ** 2 + (g - 2 * h + i) ** 2
            for (a, d, g), (b, e, h), (c, f, i) in zip(places, places[1:], places[2:], strict=False)
        ]

    def reach(self) -> float:
        """Returns how far (m) from its mean a pose may be and still be at the same place."""
        farthest = max(math.dist(position, self.mean) for _, position in self.poses)
        return max(_NEAREST_M, 4.5 * _noise(self.bends), 1.5 * farthest)


def _noise(bends: Sequence[float]) -> float:
    """Returns the standard deviation (m) of poses; a median, since a stopping robot bends once."""
    if not bends:
        return 0.0
    middle = sorted(bends)[(len(bends) - 1) // 2]
    # The median of chi-squared is 0.45 of its mean for noise on one axis, 0.79 on three.
    return math.sqrt(middle / 6 / 0.6)


def _linked(slot: _Slot, after: _Slot) -> bool:
    """Returns whether the robot may have stood still from one slot to the next that has poses."""
    if not _follows(slot, after):
        return False
    allowed = DRIFT_MPS * unix_from_ns((after.number - slot.number) * SLOT_NS)
    bends = [*slot.bends, *after.bends]
    if bends:
        spread = math.sqrt(1 / len(slot.poses) + 1 / len(after.poses))
        # Few of them may show much less noise than there is, hence the allowance.
        allowed = max(allowed, _NOISE_FACTOR * (1 + 4 / len(bends)) * _noise(bends) * spread)
    return math.dist(slot.mean, after.mean) <= allowed


def _follows(slot: _Slot, after: _Slot) -> bool:
    return after.first - slot.last <= SILENCE_NS


def _begin(before: _Slot | None, first: _Slot, inside: _Slot) -> Ns:
    """Returns the first pose of a chain's standstill; `inside` is the second slot of the chain."""
    beyond = [before] if before is not None and _follows(before, first) else []
    slots = (inside, first, *beyond)
    return _last_there(inside, (pose for slot in slots for pose in reversed(slot.poses)))


def _end(inside: _Slot, last: _Slot, after: _Slot | None) -> Ns:
    """Returns the last pose of a chain's standstill; `inside` is the last slot but one."""
    beyond = [after] if after is not None and _follows(last, after) else []
    return _last_there(inside, _poses((inside, last, *beyond)))


def _last_there(inside: _Slot, poses: Iterable[TimedPosition]) -> Ns:
    """Returns the last of the poses up to which all are at the place of the slot they begin in."""
    reach = inside.reach()
    *_, last = takewhile(lambda pose: math.dist(pose.position, inside.mean) <= reach, poses)
    return last.time


class _Chain:
    """Linked slots, and the standstills among them; `start` is None where it is not known."""

    def __init__(self, start: Ns | None, blocks: Iterable[Block] = ()) -> None:
        self.start = start
        self.end: Ns | None = None
        self.blocks = [*blocks]  # not settled yet
        self._found: list[Standstill] = []
        self._parts: list[Standstill] = []  # of the open standstill, which drifts
        self._settled: Block | None = None  # the newest settled one
        self._not_before: Ns = 0
        self._checked: list[Block] = []  # consecutive still ones, over the time of a creep
        self._creeps: deque[tuple[int, int]] = deque()  # the numbers of first and last block

    def add(self, slot: _Slot) -> None:
        mean = _rounded(slot.mean)
        box = Box3(mean, mean)
        noise = round(_noise(slot.bends) / math.sqrt(len(slot.poses)) / _STEP_M) * _STEP_M
        number = slot.number * SLOT_NS // BLOCK_NS
        self.extend([Block(number, slot.first, slot.last, noise, box)])

    def extend(self, blocks: Iterable[Block]) -> None:
        for block in blocks:
            if self.blocks and self.blocks[-1].number == block.number:
                known = self.blocks[-1]
                box = known.box.united(block.box)
                noise = max(known.noise, block.noise)
                self.blocks[-1] = Block(known.number, known.first, block.last, noise, box)
            else:
                self.blocks.append(block)

    def settle(self, not_before: Ns, *, is_over: bool = False) -> None:
        """Turns blocks into standstills: those that no later slot or block can change, or all.

        They begin at `not_before` or later, where the standstill of the chain before ends: the ends
        of chains are followed into each other's slots.
        """
        self._not_before = not_before
        newest = self.blocks[-1].number if self.blocks else 0
        for block in self.blocks if is_over else self.blocks[:-1]:
            if not self._checked or block.number > self._checked[-1].number:
                self._mark_creep(block)
        many = sum(is_over or newest - each.number >= _CREEP_BLOCKS for each in self.blocks)
        settled, self.blocks = self.blocks[:many], self.blocks[many:]
        for block in settled:
            self._settle(block)
            self._settled = block

    def _mark_creep(self, block: Block) -> None:
        """Marks the blocks of the shortest creep that ends in a block."""
        oldest = block.number - _CREEP_BLOCKS + 1
        before = [each for each in self._checked if each.is_still and each.number >= oldest]
        if not block.is_still:
            before = []
        since = self._creeps[-1][0] if self._creeps else -1
        for each in reversed(before):
            if each.number <= since:
                break
            if each.is_far_from(block):
                self._creeps.append((each.number, block.number))
                break
        self._checked = [*before, block]

    @property
    def is_long(self) -> bool:
        """Whether a standstill may be in it."""
        return self.start is None or self.end is None or self.end - self.start >= SHORTEST_NS

    def standstills(self, not_before: Ns) -> list[Standstill]:
        """Returns the standstills of a chain that has ended, from `not_before` on; see `settle`."""
        self.settle(not_before, is_over=True)
        if self.end is not None:
            self._finish(self.end)
        return self._found

    def _settle(self, block: Block) -> None:
        before = self._settled
        while len(self._creeps) > 1 and self._creeps[0][1] < block.number:
            self._creeps.popleft()
        creeps = self._creeps and self._creeps[0][0] <= block.number <= self._creeps[0][1]
        if creeps or not block.is_still:
            if before is not None:
                self._finish(before.last)
            return
        start = block.first if before is not None or self.start is None else self.start
        here = Standstill(start, block.last, block.box)
        part = self._parts[-1] if self._parts else here
        box = part.box.united(block.box)
        if box.diagonal <= LARGEST_M:
            self._parts[-1:] = [Standstill(part.start, block.last, box)]
        else:
            self._parts[-1] = part._replace(end=start)
            self._parts.append(here)

    def _finish(self, end: Ns) -> None:
        """Ends the open standstill."""
        parts, self._parts = self._parts, []
        if not parts:
            return
        begin = max(parts[0].start, self._not_before)
        if end - begin < SHORTEST_NS:
            return
        parts[-1] = parts[-1]._replace(end=end)
        clipped = (
            Standstill(max(start, begin), min(until, end), box) for start, until, box in parts
        )
        self._found += [each for each in clipped if each.start < each.end]


class _Linking:
    """Takes complete slots in order, and links them to chains."""

    def __init__(self) -> None:
        self.before: _Slot | None = None
        self.newest: _Slot | None = None
        self.chain: _Chain | None = None

    def take(self, slot: _Slot) -> _Chain | None:
        """Takes the next slot; returns the chain that it ends."""
        before, newest, over = self.before, self.newest, None
        if newest is not None:
            if _linked(newest, slot):
                if self.chain is None:
                    self.chain = _Chain(_begin(before, newest, slot))
                    self.chain.add(newest)
                self.chain.add(slot)
            else:
                over = self.end(slot)
        self.before, self.newest = newest, slot
        return over

    def end(self, after: _Slot | None) -> _Chain | None:
        """Ends the open chain, if there is one, with the newest slot."""
        chain, self.chain = self.chain, None
        if chain is not None and self.before is not None and self.newest is not None:
            chain.end = _end(self.before, self.newest, after)
        return chain


class StandstillCollector:
    """Builds the digest of one bag's poses, which come in log-time order."""

    def __init__(self) -> None:
        self._slots: list[_Slot] = []  # the first three and the newest three
        self._linking = _Linking()
        self._chains: list[_Chain] = []
        self._first: _Chain | None = None  # holds the second slot
        self._drops = SpeedDropCollector()

    def add(self, time: Ns, position: Vector3, turn: Quaternion | None = None) -> None:
        """Takes the next pose (m), which must be finite; `turn` is its orientation."""
        self._drops.add(time, position, turn)
        pose = TimedPosition(time, _rounded(position))
        if self._slots and time // SLOT_NS == self._slots[-1].number:
            self._slots[-1].add(pose)
            return
        if len(self._slots) > 1:
            self._take(self._slots[-1])
        self._slots.append(_Slot([pose]))
        if len(self._slots) > 2 * _EDGE_SLOTS:
            del self._slots[_EDGE_SLOTS]

    def digest(self) -> StandstillDigest | None:
        """Returns the digest; None without a pose."""
        slots = self._slots
        if not slots:
            return None
        if len(slots) < _EDGE_SLOTS + 2:
            head, drops = encode_positions(_poses(slots)), self._drops.digest()
            return StandstillDigest(head, slots[-1].last, drops=drops)
        under_way = self._linking.chain
        chains = self._chains if under_way is None else [*self._chains, under_way]
        first, tail = slots[:_EDGE_SLOTS], slots[-_EDGE_SLOTS:]
        return StandstillDigest(
            encode_positions(_poses(first)),
            first[-1].last,
            encode_positions(_poses(tail)),
            tail[0].first,
            tuple(
                ChainDigest(
                    None if chain is self._first else chain.start,
                    chain.end,
                    encode_blocks(chain.blocks),
                )
                for chain in chains
                if chain is self._first or chain.is_long
            ),
            self._drops.digest(),
        )

    def _take(self, slot: _Slot) -> None:
        """Takes a slot that is neither the first nor the last one."""
        second = self._linking.newest is not None and self._linking.before is None
        over = self._linking.take(slot)
        if second:
            self._first = self._linking.chain
        if over is not None:
            self._chains.append(over)


class StandstillBuilder:
    """Finds where the robot stood still, from poses or whole bags of them in log-time order."""

    def __init__(self) -> None:
        self._linking = _Linking()
        self._open: _Slot | None = None
        self._tail: tuple[bytes, Ns] | None = None
        self._done: list[Standstill] = []
        self._drops = SpeedDropBuilder()

    def add(self, time: Ns, position: Vector3, turn: Quaternion | None = None) -> None:
        """Takes the next pose (m), which must be finite; `turn` is its orientation."""
        self._drops.add(time, position, turn)
        self._decode_tail()
        self._add(TimedPosition(time, _rounded(position)))

    def join(self, bag: StandstillDigest | StandstillRun) -> None:
        """Takes all poses of a bag, or of a run of them, that come next, as if one by one."""
        if isinstance(bag, StandstillRun):
            self._join_run(bag)
            return
        self._drops.join(bag.drops)
        if not bag.tail:
            self._decode_tail()
            for pose in decode_positions(bag.head):
                self._add(pose)
            return
        chains = [*bag.chains]
        if self._may_continue_into(bag):
            chain = self._continue_across(bag)
            if chain is None:
                self._decode_tail()
                chain = self._join_edges(bag)
            if chain is not None:
                self._add_chain(chain, chains.pop(0))
        for each in chains:
            self._add_chain(_Chain(each.start), each)
        self._tail = (bag.tail, bag.tail_since)

    def _join_run(self, run: StandstillRun) -> None:
        for each in run.lead:
            self.join(each)
        if run.last is None:
            return
        self._done += run.found
        self._drops.drops += run.drops
        self._go_on_after(run.last)
        for each in run.trail:
            self.join(each)

    def _go_on_after(self, bag: StandstillDigest) -> None:
        """Goes on as after a bag at whose end no standstill is open."""
        self._tail = (bag.tail, bag.tail_since)
        self._drops.go_on_after(bag.drops)

    def run_after(
        self, bag: StandstillDigest, later: Sequence[StandstillDigest]
    ) -> tuple[tuple[Standstill, ...], tuple[SpeedDrop, ...]]:
        """Returns the standstills and drops of bags after one at whose end none is open.

        At the end of the last one none may be open either. Called once, before all else.
        """
        self._go_on_after(bag)
        for each in later:
            self.join(each)
        return tuple(self._done), tuple(self._drops.drops)

    def standstills(self) -> tuple[Standstill, ...]:
        """Returns the standstills of all poses, in order; no pose may be added after."""
        self._decode_tail()
        if self._open is not None:
            self._close(self._linking.take(self._open))
        self._close(self._linking.end(None))
        return tuple(self._done)

    @property
    def drops(self) -> Sequence[SpeedDrop]:
        """Where the robot slowed down suddenly, in order; standstills may follow."""
        return self._drops.drops

    @property
    def last(self) -> Ns | None:
        """The log time of the last pose, once all standstills were returned."""
        newest = self._linking.newest
        return None if newest is None else newest.last

    def _may_continue_into(self, bag: StandstillDigest) -> bool:
        """Returns whether a long enough standstill may be where a bag begins."""
        if _begins_linked(bag) or self._linking.chain is not None or self._tail is None:
            return True
        return bag.head_until - self._tail[1] >= SHORTEST_NS

    def _continue_across(self, bag: StandstillDigest) -> _Chain | None:
        """Returns the chain that certainly continues into a bag, without decoding single poses.

        A robot that stands for hours has thousands of such bags.
        """
        chain = self._linking.chain
        if chain is None or self._tail is None or not _begins_linked(bag):
            return None
        rows = np.hstack([_columns(self._tail[0], 4), _columns(bag.head, 4)])
        low, high = rows[1:].min(axis=1) * _STEP_M, rows[1:].max(axis=1) * _STEP_M
        times = rows[0]
        if math.dist(low, high) > DRIFT_MPS * unix_from_ns(SLOT_NS):
            return None
        if int(np.diff(times).max()) > SILENCE_NS:
            return None
        numbers = times // SLOT_NS
        parts = sorted(set(numbers.tolist()))
        a, b, c = ((low + high) / 2).tolist()
        # The chains have the slots up to the last but one of the bag before, and from the second
        # of this bag on: the slots between are added here.
        for number in parts[2:-2]:
            here = times[numbers == number].tolist()
            box = Box3((a, b, c), (a, b, c))
            chain.extend([Block(number * SLOT_NS // BLOCK_NS, here[0], here[-1], 0.0, box)])
        self._linking.chain = self._tail = None
        return chain

    def _join_edges(self, bag: StandstillDigest) -> _Chain | None:
        """Takes the first two slots of a bag; returns a chain that continues from there."""
        first, second, third = _slots(decode_positions(bag.head))
        for pose in first.poses:
            self._add(pose)
        first, self._open = self._open or first, None
        self._close(self._linking.take(first))
        self._close(self._linking.take(second))
        if not _begins_linked(bag):
            self._close(self._linking.end(third))
            return None
        chain, self._linking.chain = self._linking.chain, None
        return chain or _Chain(_begin(first, second, third))

    def _add_chain(self, chain: _Chain, stored: ChainDigest) -> None:
        """Appends a chain of a bag, the newest there is, to the one that it continues."""
        chain.extend(decode_blocks(stored.blocks))
        chain.settle(self._not_before)
        chain.end = stored.end
        if stored.end is None:
            self._linking.chain = chain
        else:
            self._close(chain)

    def _decode_tail(self) -> None:
        """Takes the last slots of the bag before."""
        if self._tail is None:
            return
        linking = self._linking
        linking.before, linking.newest, self._open = _slots(decode_positions(self._tail[0]))
        self._tail = None

    def _add(self, pose: TimedPosition) -> None:
        if self._open is not None and pose.time // SLOT_NS == self._open.number:
            self._open.add(pose)
            return
        slot, self._open = self._open, _Slot([pose])
        if slot is not None:
            self._close(self._linking.take(slot))

    def _close(self, chain: _Chain | None) -> None:
        if chain is not None:
            self._done += chain.standstills(self._not_before)

    @property
    def _not_before(self) -> Ns:
        """Where the newest standstill ends."""
        return self._done[-1].end if self._done else 0


def _begins_linked(bag: StandstillDigest) -> bool:
    """Returns whether the second and third slot of a bag are linked."""
    return bool(bag.chains) and bag.chains[0].start is None


def _rounded(position: Vector3) -> Vector3:
    """Rounds a position as its encoding does, so that cuts into bags change nothing."""
    x, y, z = position
    return (
        round(x / _STEP_M) * _STEP_M,
        round(y / _STEP_M) * _STEP_M,
        round(z / _STEP_M) * _STEP_M,
    )


def encode_positions(poses: Iterable[TimedPosition]) -> bytes:
    """Encodes poses, rounded to `_STEP_M`; their log times stay exact."""
    return _encode(
        [(time, *(round(each / _STEP_M) for each in position)) for time, position in poses]
    )


def decode_positions(packed: bytes) -> list[TimedPosition]:
    """Decodes what `encode_positions` returned."""
    return [
        TimedPosition(time, (x * _STEP_M, y * _STEP_M, z * _STEP_M))
        for time, x, y, z in _decode(packed, 4)
    ]


def encode_blocks(blocks: Iterable[Block]) -> bytes:
    """Encodes blocks, their boxes rounded to `_STEP_M`."""
    return _encode(
        [
            (number, first, last, *(round(each / _STEP_M) for each in (noise, *box.low, *box.high)))
            for number, first, last, noise, box in blocks
        ]
    )


def decode_blocks(packed: bytes) -> list[Block]:
    """Decodes what `encode_blocks` returned."""
    return [
        Block(
            number,
            first,
            last,
            noise * _STEP_M,
            Box3((a * _STEP_M, b * _STEP_M, c * _STEP_M), (d * _STEP_M, e * _STEP_M, f * _STEP_M)),
        )
        for number, first, last, noise, a, b, c, d, e, f in _decode(packed, 10)
    ]


def _poses(slots: Iterable[_Slot]) -> list[TimedPosition]:
    return [pose for slot in slots for pose in slot.poses]


def _encode(rows: Sequence[tuple[int, ...]]) -> bytes:
    """Encodes rows of integers, column by column as differences, which compress well."""
    if not rows:
        return b""
    columns: NDArray[np.int64] = np.diff(np.array(rows, "<i8").T, prepend=0)
    return columns.tobytes()


def _decode(packed: bytes, columns: int) -> list[list[int]]:
    rows: list[list[int]] = _columns(packed, columns).T.tolist()
    return rows


def _columns(packed: bytes, columns: int) -> NDArray[np.int64]:
    return np.frombuffer(packed, np.dtype("<i8")).reshape(columns, -1).cumsum(axis=1)


def _slots(poses: Iterable[TimedPosition]) -> list[_Slot]:
    """Returns the slots of poses in order."""
    numbered = groupby(poses, key=lambda pose: pose.time // SLOT_NS)
    return [_Slot([*inside]) for _, inside in numbered]

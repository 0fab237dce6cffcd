"""Where the robot stood still, pose by pose or a whole bag at once.

Time is cut into slots of `SLOT_NS` from the epoch, and each slot that has poses is still or not:
by the box around its poses and the first pose of the next such slot, and the time that these
take. So what stands in a slot can be put together from parts, and where a history is cut into
bags changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.motion import Stop
from ros2_memory.timebase import NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from ros2_memory.model import Vector3

SLOT_NS: Final[Ns] = NS_PER_S
STILL_MPS: Final = 0.05
"""A slot is still where its poses stay in a box whose diagonal is no longer than this way."""
SILENCE_NS: Final[Ns] = 5 * NS_PER_S // 2
"""Poses farther apart say nothing of the time between them: a rest ends there."""


class Box3(NamedTuple):
    """The smallest box (m) around places."""

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

    def with_place(self, place: Vector3) -> Box3:
        """The box around it and a place."""
        return self.united(Box3(place, place))

    def united(self, other: Box3) -> Box3:
        """The box around both."""
        (a, b, c), (d, e, f) = self
        (g, h, i), (j, k, m) = other
        return Box3((min(a, g), min(b, h), min(c, i)), (max(d, j), max(e, k), max(f, m)))


class Slot(NamedTuple):
    """The poses of one slot, as far as they are known: its first one, and a box around all."""

    number: int
    first: Stop
    last: Ns
    box: Box3

    def joined(self, later: Slot) -> Slot:
        """The same slot with poses that come after these."""
        return Slot(self.number, self.first, later.last, self.box.united(later.box))


class Rest(NamedTuple):
    """A time in which the robot stood still: from its first pose to its last (inclusive)."""

    start: Ns
    end: Ns
    box: Box3

    @property
    def is_still(self) -> bool:
        """Whether its box is small for the time that it took."""
        return self.box.diagonal <= STILL_MPS * unix_from_ns(self.end - self.start)


@dataclass(frozen=True, slots=True)
class RestDigest:
    """The rests among the poses of one bag, to be joined with those before and after.

    Attributes:
        head: the first slot, which the bag before may have more of.
        second: the first pose of the slot after; None where there is one slot alone.
        rests: of the slots between the first and the last.
        from_second: whether the first rest begins with the second slot.
        to_tail: whether the last rest leads up to the first pose of the last slot.
        tail: the last slot, which the bag after may have more of; None as `second`.
    """

    head: Slot
    second: Stop | None = None
    rests: tuple[Rest, ...] = ()
    from_second: bool = False
    to_tail: bool = False
    tail: Slot | None = None


class _Growing:
    """A slot to which poses are added one by one, for less than making it anew each time."""

    __slots__ = ("first", "high", "last", "low", "number")

    def __init__(self, time: Ns, position: Vector3) -> None:
        self.number = time // SLOT_NS
        self.first = Stop(time, position)
        self.last = time
        self.low = [*position]
        self.high = [*position]

    def add(self, time: Ns, position: Vector3) -> None:
        self.last = time
        low, high = self.low, self.high
        for axis in (0, 1, 2):
            value = position[axis]
            if value < low[axis]:
                low[axis] = value
            elif value > high[axis]:
                high[axis] = value

    def slot(self) -> Slot:
        (a, b, c), (d, e, f) = self.low, self.high
        return Slot(self.number, self.first, self.last, Box3((a, b, c), (d, e, f)))


class RestBuilder:
    """Takes poses, or whole bags of them, in log-time order, and says where the robot stood."""

    def __init__(self) -> None:
        self._done: list[Rest] = []
        self._rest: Rest | None = None
        self._open: Slot | None = None
        self._growing: _Growing | None = None

    def add(self, time: Ns, position: Vector3) -> None:
        """Takes the next pose (m), which must be finite."""
        growing = self._growing
        if growing is not None and time // SLOT_NS == growing.number:
            growing.add(time, position)
        else:
            self._settle()
            self._growing = _Growing(time, position)

    def join(self, bag: RestDigest) -> None:
        """Takes all poses of a bag that come next, as if they were added one by one."""
        self._settle()
        self._take(bag.head)
        if bag.second is None or bag.tail is None:
            return
        self._close(bag.second)
        if bag.tail.first == bag.second:
            self._open = bag.tail
            return
        rests = list(bag.rests)
        if rests and bag.from_second and self._rest is not None:
            rests[0] = _joined(self._rest, rests[0])
            self._rest = None
        self._finish()
        self._done += rests
        if rests and bag.to_tail:
            self._rest = self._done.pop()
        self._open = bag.tail

    def rests(self) -> tuple[Rest, ...]:
        """The rests so far, in order; more poses may be added after."""
        done, rest, slot = self.state()
        if slot is not None:
            own = Rest(slot.first.time, slot.last, slot.box)
            if own.is_still:
                rest = own if rest is None else _joined(rest, own)
        return tuple(each for each in (*done, rest) if each is not None and each.end > each.start)

    def state(self) -> tuple[tuple[Rest, ...], Rest | None, Slot | None]:
        """What a digest is made of: the rests that are over, the one that is not, the last slot."""
        self._settle()
        return tuple(self._done), self._rest, self._open

    def _settle(self) -> None:
        """Takes the slot that was growing."""
        if self._growing is not None:
            slot, self._growing = self._growing.slot(), None
            self._take(slot)

    def _take(self, slot: Slot) -> None:
        if self._open is None:
            self._open = slot
        elif slot.number == self._open.number:
            self._open = self._open.joined(slot)
        else:
            self._close(slot.first)
            self._open = slot

    def _close(self, following: Stop) -> None:
        """Ends the open slot, whose next pose is known."""
        slot = self._open
        if slot is None:
            return
        silent = following.time - slot.last > SILENCE_NS
        if silent:
            own = Rest(slot.first.time, slot.last, slot.box)
        else:
            box = slot.box.with_place(following.position)
            own = Rest(slot.first.time, following.time, box)
        if not own.is_still:
            self._finish()
            return
        self._rest = own if self._rest is None else _joined(self._rest, own)
        if silent:
            self._finish()

    def _finish(self) -> None:
        if self._rest is not None:
            self._done.append(self._rest)
            self._rest = None


class RestCollector:
    """Makes the digest of one bag's poses, which come in log-time order."""

    def __init__(self) -> None:
        self._head: _Growing | None = None
        self._second: Stop | None = None
        self._rest = RestBuilder()

    def add(self, time: Ns, position: Vector3) -> None:
        """Takes the next pose (m), which must be finite."""
        if self._second is None:
            if self._head is None:
                self._head = _Growing(time, position)
                return
            if time // SLOT_NS == self._head.number:
                self._head.add(time, position)
                return
            self._second = Stop(time, position)
        self._rest.add(time, position)

    def digest(self) -> RestDigest | None:
        """The rests; None without a pose."""
        if self._head is None:
            return None
        done, under_way, tail = self._rest.state()
        rests = done if under_way is None else (*done, under_way)
        return RestDigest(
            head=self._head.slot(),
            second=self._second,
            rests=rests,
            from_second=bool(
                rests and self._second is not None and rests[0].start == self._second.time
            ),
            to_tail=under_way is not None,
            tail=tail,
        )


def _joined(rest: Rest, later: Rest) -> Rest:
    return Rest(rest.start, later.end, rest.box.united(later.box))

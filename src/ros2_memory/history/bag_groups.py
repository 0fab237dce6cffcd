"""The bags of one topic in groups: what must be ordered, and told apart, together.

Most groups are one bag; where recordings overlap, or splits are out of order, they are more.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history.duplicates import COPY_HORIZON_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.merged_stream import MergedStream
    from ros2_memory.history.view import View


def groups_of(view: MergedStream, topic: str, window: TimeWindow) -> list[Group]:
    """The groups of bags that hold messages of the topic in the window, in order."""
    holdings = view.holdings([topic], window)
    if view.may_be_relatched([topic]) and holdings:
        return [Group(view, topic, window, holdings, received_twice=True)]
    groups: list[list[BagSpan]] = []
    reach: dict[Path, Ns] = {}
    for held in holdings:
        recording = held.bag.recording
        oldest = held.first - COPY_HORIZON_NS
        if reach and min(reach.values()) < oldest:
            reach = {each: last for each, last in reach.items() if last >= oldest}
        if groups and _belongs(held, recording, reach):
            groups[-1].append(held)
        else:
            groups.append([held])
        reach[recording] = max(reach.get(recording, MIN_NS), held.last)
    return [Group(view, topic, window, group, received_twice=False) for group in groups]


class Group:
    """Bags of one topic whose messages must be ordered, and told apart, together.

    Attributes:
        holdings: the bags, in order.
        received_twice: which of the messages count depends on bags outside of the group too.
    """

    def __init__(
        self,
        view: MergedStream,
        topic: str,
        window: TimeWindow,
        holdings: Sequence[BagSpan],
        *,
        received_twice: bool,
    ) -> None:
        self._view = view
        self._topic = topic
        self._window = window
        self.holdings = holdings
        self.may_be_relatched = received_twice
        self._mixed = received_twice or (
            len(holdings) > 1 and len({held.bag.recording for held in holdings}) > 1
        )
        self._places: list[Place] | None = None

    def whole(self) -> BagFile | None:
        """The bag that alone makes up the group and lies in the window with all of its messages."""
        held = self.holdings[0]
        alone = len(self.holdings) == 1 and not self._mixed
        return held.bag if alone and self._window.covers(held.first, held.last) else None

    def once(self) -> Iterator[StoredMessage]:
        """The messages of the group in order, each one once."""
        return self._view.stream([self._topic], self._window, among=self.holdings)

    def count(self) -> int:
        """How many messages of the window the group holds."""
        if self._mixed:
            return sum(1 for _ in self.once())
        bag = self.whole()
        if bag is not None:
            return sum(each.count for each in bag.summary.of(self._topic))
        return len(self._located())

    def fetch(self, indices: Sequence[int]) -> Iterator[StoredMessage]:
        """The messages at these positions of the group, which must ascend."""
        if not indices:
            return
        if self._mixed:
            wanted = set(indices)
            yield from (each for index, each in enumerate(self.once()) if index in wanted)
            return
        places = self._located()
        at_once: Iterator[StoredMessage] = iter(())
        at: tuple[Ns, int] | None = None
        passed = 0
        for index in indices:
            if index >= len(places):
                return  # a bag was deleted since its messages were counted
            place = places[index]
            if at != (place.time, place.rank):
                at, passed = (place.time, place.rank), 0
                moment = TimeWindow(place.time, place.time + 1)
                at_once = self._view.read(self.holdings[place.rank].bag, [self._topic], moment)
            # Read on: any number of messages may bear one log time.
            yield from self._view.used(islice(at_once, place.nth - passed, place.nth - passed + 1))
            passed = place.nth + 1

    def _located(self) -> list[Place]:
        if self._places is None:
            places = [
                Place(moment, rank, nth)
                for rank, held in enumerate(self.holdings)
                for moment, nth in _numbered(
                    self._view.log_times(held.bag, self._topic, self._window)
                )
            ]
            self._places = sorted(places) if len(self.holdings) > 1 else places
        return self._places


class Place(NamedTuple):
    """Where a message of a group stands: the nth of its bag at exactly that log time."""

    time: Ns
    rank: int
    nth: int


def _numbered(times: Iterable[Ns]) -> Iterator[tuple[Ns, int]]:
    before, nth = None, 0
    for moment in times:
        nth = nth + 1 if moment == before else 0
        before = moment
        yield moment, nth


def _belongs(held: BagSpan, recording: Path, reach: Mapping[Path, Ns]) -> bool:
    """Whether a bag can hold messages before, or copies of, what the bags before it hold.

    `recording` is the bag's own; `reach` is the last log time so far of each recording. Splits of
    one recording that only share a timestamp stay apart: bag order already orders them.
    """
    return any(
        held.first < last if each == recording else held.first <= last + COPY_HORIZON_NS
        for each, last in reach.items()
    )


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class DigestKind(Generic[T]):
    """What is kept of a topic in a bag.

    Attributes:
        name: tells it from the others.
        ask: what the catalogue has of a topic in some entries of one run of bags, by entry.
        packed: one as text.
        unpacked: back; a ValueError where it is none.
    """

    name: str
    ask: Callable[[SegmentDigests, str, Sequence[int]], Mapping[int, T]]
    packed: Callable[[T], str]
    unpacked: Callable[[str], T]


def is_whole(group: Group, window: TimeWindow) -> bool:
    """Whether all messages of the group's bags lie in the window, and no crash cut a bag short."""
    return all(
        window.covers(held.first, held.last) and held.bag.state is BagState.CLOSED
        for held in group.holdings
    )


class StoredPart(Generic[T]):
    """What the catalogue keeps of one topic in a window; of one run of bags at a time."""

    def __init__(self, view: View, topic: str, kind: DigestKind[T], window: TimeWindow) -> None:
        self._view = view
        self._topic = topic
        self._kind = kind
        self._window = window
        self._question = f"{kind.name} {topic}"
        self._notes: SegmentDigests | None = None
        self._known: Mapping[int, T] = {}

    def of(self, group: Group) -> tuple[T, tuple[Ns, Ns]] | None:
        """What is kept of a group, and the times of its first and last message; None: nothing."""
        if group.may_be_relatched:
            return None
        if len(group.holdings) > 1:
            return self._remembered(group)
        [held] = group.holdings
        number = None if self._notes is None else self._notes.numbers.get(held.bag.file)
        if number is None:  # not of the run that the bag before it was of
            entry = self._view.entry(held.bag)
            if entry is None:
                return None
            self._view.check_deadline()
            self._notes, number = entry
            run = self._view.snapshot.run_of(held.bag)
            numbers = self._notes.numbers
            inside = [each.bag.file for each in run.extents(self._topic, self._window)]
            among = [numbers[file] for file in dict.fromkeys(inside) if file in numbers]
            self._known = self._kind.ask(self._notes, self._topic, among)
        if number not in self._known:
            return None
        return self._known[number], (held.first, held.last)

    def keep(self, group: Group, kept: T, span: tuple[Ns, Ns]) -> None:
        """Keeps what bags that hold copies of each other come to, for the next time."""
        recall, numbers = self._view.memory.recall, self._numbers(group)
        if recall is None or numbers is None or len(numbers) < 2 or not self._view.complete:
            return
        if group.may_be_relatched:
            return
        recall.remember(self._question, numbers, json.dumps([self._kind.packed(kept), *span]))

    def _remembered(self, group: Group) -> tuple[T, tuple[Ns, Ns]] | None:
        recall, numbers = self._view.memory.recall, self._numbers(group)
        if recall is None or numbers is None:
            return None
        return recall.remembered(self._question, numbers, self._parsed)

    def _parsed(self, answer: str) -> tuple[T, tuple[Ns, Ns]]:
        packed, first, last = json.loads(answer)
        return self._kind.unpacked(packed), (int(first), int(last))

    def _numbers(self, group: Group) -> list[int] | None:
        """The entries of the group's bags; None where one has none."""
        entries = [self._view.entry(held.bag) for held in group.holdings]
        numbers = [entry[1] for entry in entries if entry is not None]
        return numbers if len(numbers) == len(entries) else None

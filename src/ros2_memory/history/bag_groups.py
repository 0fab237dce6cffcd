"""The bags of one topic in groups: what must be ordered, and told apart, together.

Most groups are one bag; where recordings overlap, or splits are out of order, they are more.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history.duplicates import COPY_HORIZON_NS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.merged_stream import MergedStream


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

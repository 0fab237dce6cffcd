"""The bags of one topic in groups.

A group is what must be ordered and cleared of duplicates together. Most groups are one bag; where
recordings overlap, or splits are out of order, they are more.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeVar

from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.merged_stream import MergedStream

T = TypeVar("T")
Span: TypeAlias = "tuple[Ns, Ns]"
"""Log times of a first and a last message, both inclusive."""


class MessagePosition(NamedTuple):
    """Identifies a message of a group: the nth of its bag at exactly that log time."""

    time: Ns
    rank: int
    nth: int


class Group:
    """Bags of one topic whose messages must be ordered, and cleared of duplicates, together.

    Attributes:
        bags: in order.
        window: what of them is asked for.
        first: log time of the first message of the bags, in the window or not.
        last: of the last one.
        may_be_relatched: whether bags outside of the group decide which of the messages count.
        has_duplicates: whether some message may be in two of the bags, so that all are to be read.
    """

    def __init__(
        self,
        stream: MergedStream,
        topic: str,
        window: TimeWindow,
        bags: Sequence[BagSpan],
        *,
        may_be_relatched: bool = False,
    ) -> None:
        self._stream = stream
        self._topic = topic
        self.window = window
        self.bags = bags
        self.first = min(each.first for each in bags)
        self.last = max(each.last for each in bags)
        self.may_be_relatched = may_be_relatched
        self.has_duplicates = may_be_relatched or (
            len(bags) > 1 and len({each.bag.recording for each in bags}) > 1
        )
        self._known_positions: list[MessagePosition] | None = None

    @property
    def is_inside(self) -> bool:
        """Whether all messages of the bags lie in the window."""
        return all(self.window.covers(each.first, each.last) for each in self.bags)

    @property
    def is_whole(self) -> bool:
        """Whether all messages lie in the window, and no crash cut a bag short."""
        return self.is_inside and all(each.bag.state is BagState.CLOSED for each in self.bags)

    def of(self, bag: BagSpan) -> Group:
        """Returns one bag of it as a group."""
        return Group(self._stream, self._topic, self.window, [bag])

    def messages(self) -> Iterator[StoredMessage]:
        """Returns the messages of the group in log-time order, each one once."""
        return self._stream.messages([self._topic], self.window, among=self.bags)

    def count(self) -> int:
        """Returns how many messages of the window the group holds."""
        if self.has_duplicates:
            return sum(1 for _ in self.messages())
        if len(self.bags) == 1 and self.is_inside:
            return sum(each.count for each in self.bags[0].bag.summary.of(self._topic))
        return len(self._log_times())

    def times(self) -> list[Ns]:
        """Returns the log times of the messages of the window, in order."""
        if self.has_duplicates:
            return [each.time for each in self.messages()]
        return [*self._log_times()]

    def fetch(self, indices: Sequence[int]) -> Iterator[StoredMessage]:
        """Yields the messages at these indices of the group, which must ascend."""
        if not indices:
            return
        if self.has_duplicates:
            wanted = set(indices)
            yield from (each for index, each in enumerate(self.messages()) if index in wanted)
            return
        chosen = self._chosen(indices)
        bags = self._stream.bags
        # Any number of messages may bear one log time: these are read once.
        for (time, rank), positions in groupby(chosen, key=lambda each: (each.time, each.rank)):
            numbers = {each.nth for each in positions}
            at_once = bags.read(self.bags[rank].bag, [self._topic], TimeWindow(time, time + 1))
            found = (each for nth, each in enumerate(at_once) if nth in numbers)
            yield from bags.track_sources(found)

    def _chosen(self, indices: Sequence[int]) -> Iterator[MessagePosition]:
        """Yields the messages at some indices; fewer, where a bag was deleted since."""
        if len(self.bags) > 1:
            positions = self._positions()
            yield from (positions[index] for index in indices if index < len(positions))
            return
        # Of a single bag only those that are wanted become objects.
        times = self._log_times()
        for index in indices:
            if index < len(times):
                time = times[index]
                yield MessagePosition(time, 0, index - bisect_left(times, time))

    def _log_times(self) -> Sequence[Ns]:
        """Returns the log times of the messages, in order, where none has a duplicate."""
        if len(self.bags) > 1:
            return [each.time for each in self._positions()]
        return sorted(self._stream.bags.log_times(self.bags[0].bag, self._topic, self.window))

    def _positions(self) -> list[MessagePosition]:
        if self._known_positions is None:
            self._known_positions = sorted(
                MessagePosition(time, rank, nth)
                for rank, each in enumerate(self.bags)
                for time, equal in groupby(
                    self._stream.bags.log_times(each.bag, self._topic, self.window)
                )
                for nth, _ in enumerate(equal)
            )
        return self._known_positions


def groups_of(stream: MergedStream, topic: str, window: TimeWindow) -> list[Group]:
    """Returns the groups of bags that hold messages of the topic in the window, in order."""
    bags = stream.overlapping_bags([topic], window)
    groups: list[list[BagSpan]] = []
    latest: dict[Path, Ns] = {}
    for each in bags:
        recording = each.bag.recording
        before = latest.get(recording)
        if before is not None and len(latest) == 1:
            # One recording continues, as almost always.
            belongs = each.first < before
        else:
            oldest = each.first - COPY_HORIZON_NS
            if latest and min(latest.values()) < oldest:
                latest = {path: last for path, last in latest.items() if last >= oldest}
            belongs = _belongs(each.first, recording, latest)
            if recording not in latest:
                # Another recording may have gone on in a new bag, and so in a new group.
                while len(groups) > 1 and _reaches(groups[-2], oldest, recording):
                    newest = groups.pop()
                    groups[-1] += newest
        if belongs:
            groups[-1].append(each)
        else:
            groups.append([each])
        latest[recording] = each.last if before is None else max(before, each.last)
    repeats = stream.may_be_relatched([topic])
    return [Group(stream, topic, window, group, may_be_relatched=repeats) for group in groups]


def _belongs(first: Ns, recording: Path, latest: Mapping[Path, Ns]) -> bool:
    """Whether a bag can hold messages before, or duplicates of, those of the bags before it.

    `latest` is the last log time so far of each recording. Splits of one recording that only share
    a timestamp stay apart: the order of bags already orders them.
    """
    return any(
        first < last if path == recording else first <= last + COPY_HORIZON_NS
        for path, last in latest.items()
    )


def _reaches(group: Sequence[BagSpan], oldest: Ns, recording: Path) -> bool:
    """Whether a bag of another recording ends at a time or after it."""
    return any(each.last >= oldest and each.bag.recording != recording for each in group)

"""Many bags as one stream: in log-time order, each message once.

Messages of one log time are in the order of their recordings' names, then of their bags. Which
ones count where recordings overlap, `columns.units` says.

A new recording receives latched messages again: with a new log time and the original publish time.
Such a message counts once too, at its earliest log time, however long ago that is.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from functools import partial
from itertools import chain, pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ros2_memory.columns.units import Identities, copies_among
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.spans import (
    COPY_HORIZON_NS,
    Spans,
    enclosing,
    lies_inside,
    overlap_spans,
    united,
    without,
)
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.index.segment import TopicExtent

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.history.bag_access import BagAccess
    from ros2_memory.history.stored_message import StoredMessage

_Row: TypeAlias = tuple[str, Ns, Ns, int]
"""Of a message of a topic: its file, log time, publish time, and the hash of its payload."""


class MergedStream:
    """Reads all bags of one call together."""

    def __init__(self, bags: BagAccess) -> None:
        self.bags = bags
        self._timeline = bags.snapshot.timeline
        self._first_copies: dict[tuple[str, Ns, int], tuple[Ns, Path]] = {}
        self._searched: dict[str, Spans] = {}

    def overlapping_bags(self, topics: Collection[str], window: TimeWindow) -> list[TopicExtent]:
        """Returns the bags that hold messages of these topics in the window, in order.

        Each with the times of its first and last message of those that reach into the window.
        """
        spans: dict[str, TopicExtent] = {}
        for topic in topics:
            for bag, first, last in self._timeline.extents(topic, window):
                known = spans.get(bag.file, TopicExtent(bag, first, last))
                spans[bag.file] = TopicExtent(bag, min(first, known.first), max(last, known.last))
        return sorted(spans.values(), key=_span_order)

    def messages(
        self,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[StoredMessage]:
        """Returns the messages of the topics in the window in log-time order, each one once.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        parts = self._segment_windows(topics, window)
        return chain.from_iterable(
            self._messages_in(topics, part, newest_first=newest_first)
            for part in (reversed(parts) if newest_first else parts)
        )

    def first(
        self,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> StoredMessage | None:
        """Returns what `messages` yields first."""
        return next(self.messages(topics, window, newest_first=newest_first), None)

    def newest(self, topic: str, window: TimeWindow) -> StoredMessage | None:
        """Returns the newest message of the topic in the window."""
        return self.first([topic], window, newest_first=True)

    def last(self, topic: str, before: Ns = MAX_NS) -> StoredMessage | None:
        """Returns the newest message of the topic before a log time."""
        return self.newest(topic, TimeWindow(MIN_NS, before))

    def _segment_windows(self, topics: Sequence[str], window: TimeWindow) -> list[TimeWindow]:
        """Returns the window cut where segments begin, to hold few bags at a time.

        It is also cut after the first and before the last message of each segment: many callers
        read no other.
        """
        edges = {window.start, window.stop}
        for segment in self._timeline.segments_in(window):
            spans = [segment.spans[topic] for topic in topics if topic in segment.spans]
            if spans:
                first, last = enclosing(spans)
                edges.update((segment.bags[0].start, first + 1, last))
        inside = sorted(edge for edge in edges if window.start <= edge <= window.stop)
        return [TimeWindow(start, stop) for start, stop in pairwise(inside)]

    def _messages_in(
        self, topics: Sequence[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[StoredMessage]:
        near = self.overlapping_bags(topics, window.widened(COPY_HORIZON_NS))
        bags = [span for span in near if window.overlaps(span.first, span.last)]
        messages = self.merged(bags, topics, window, newest_first=newest_first)
        shared = overlap_spans((span.first, span.last, span.bag.recording) for span in near)
        if shared:
            messages = self._without_copies(messages, window, shared)
        if self.may_be_repeated(topics):
            messages = (message for message in messages if not self._is_repeated(message))
        if all(span.bag.state is BagState.CLOSED for span in bags):
            return messages
        return self.bags.track_sources(messages)

    def may_be_repeated(self, topics: Iterable[str]) -> bool:
        """Whether two recordings may have received one latched message of these topics."""
        return any(
            topic in self._timeline.transient_local and len(self._timeline.recordings(topic)) > 1
            for topic in topics
        )

    def _without_copies(
        self, messages: Iterable[StoredMessage], window: TimeWindow, shared: Spans
    ) -> Iterator[StoredMessage]:
        """Yields messages of a window, in any order of time, without the copies among them.

        It is looked at some seconds of a topic at once, where recordings share them.
        """
        asked: dict[str, tuple[Ns, Counter[_Row]]] = {}
        for stored in messages:
            if lies_inside(shared, stored.time):
                topic, begin = stored.topic, stored.time - stored.time % COPY_HORIZON_NS
                if topic not in asked or asked[topic][0] != begin:
                    part = TimeWindow(begin, begin + COPY_HORIZON_NS).intersect(window)
                    asked[topic] = begin, self._copies(topic, part)
                _, copies = asked[topic]
                row = stored.bag.file, stored.time, *stored.identity
                if copies[row]:
                    copies[row] -= 1
                    continue
            yield stored

    def _copies(self, topic: str, part: TimeWindow) -> Counter[_Row]:
        """Returns how many messages of a part of a topic are copies, by what tells them apart."""
        around = TimeWindow(max(part.start - COPY_HORIZON_NS, MIN_NS), part.stop)
        bags = self.overlapping_bags([topic], around)
        recordings = sorted({str(span.bag.recording) for span in bags})
        number_of = {recording: number for number, recording in enumerate(recordings)}
        merged = self.merged(bags, [topic], around, since=part.start)
        rows = [
            (number_of[str(stored.bag.recording)], (stored.bag.file, stored.time, *stored.identity))
            for stored in merged
        ]
        columns = np.array([(*row[1:], number) for number, row in rows], np.int64).reshape(-1, 4)
        are_copies = copies_among(Identities(*columns.T))
        return Counter(row for (_, row), is_copy in zip(rows, are_copies, strict=True) if is_copy)

    def find_first_copy(self, stored: StoredMessage) -> None:
        """Notes what cannot be read where a message may have been received before."""
        topic, window = stored.topic, _since_published(stored)
        if stored.record.may_be_repeated and self.may_be_repeated([topic]):
            copies = self.merged(self.overlapping_bags([topic], window), [topic], window)
            next((copy for copy in copies if copy.identity == stored.identity), None)

    def _is_repeated(self, stored: StoredMessage) -> bool:
        if not stored.record.may_be_repeated:
            return False
        self._find_first_copies(stored)
        own = stored.time, stored.bag.recording
        first_time, first_recording = self._first_copies.get((stored.topic, *stored.identity), own)
        return stored.time > first_time and stored.bag.recording != first_recording

    def _find_first_copies(self, late: StoredMessage) -> None:
        """Records the first reception of every message that a late one may repeat.

        Late messages come many at once. So the search covers the rest of the late one's bag, and as
        much again before its window: a few searches serve them all.
        """
        topic, window = late.topic, _since_published(late)
        searched = self._searched.setdefault(topic, [])
        if not without([(window.start, window.stop)], searched):
            return
        back = max(window.start - (window.stop - window.start), MIN_NS)
        missing = without([(back, max(window.stop, late.bag.end + 1))], searched)
        for start, stop in missing:
            part = TimeWindow(start, stop)
            bags = self.overlapping_bags([topic], part)
            for message in self.merged(bags, [topic], part, since=window.start):
                key, first = (topic, *message.identity), (message.time, message.bag.recording)
                self._first_copies[key] = min(first, self._first_copies.get(key, first))
        self._searched[topic] = united([*searched, *missing])

    def merged(
        self,
        bags: Sequence[TopicExtent],
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
        since: Ns = MIN_NS,
    ) -> Iterator[StoredMessage]:
        """Yields all messages in order, copies too; opens a bag when the stream reaches it.

        What cannot be read is noted, unless all of it lies before `since`.
        """
        read = partial(
            self.bags.read, topics=topics, window=window, newest_first=newest_first, since=since
        )
        if len(bags) == 1:
            yield from read(bags[0].bag)
            return
        sign = -1 if newest_first else 1
        # Each with the earliest sort key that one of its messages can have in the heap.
        waiting = deque(
            sorted(
                (-span.last if newest_first else span.first, sign * rank, span.bag)
                for rank, span in enumerate(sorted(bags, key=_recording_order))
            )
        )
        heap: list[tuple[int, int, StoredMessage, Iterator[StoredMessage]]] = []
        while heap or waiting:
            if waiting and (not heap or waiting[0][0] <= heap[0][0]):
                _, rank, bag = waiting.popleft()
                source = read(bag)
            else:
                _, rank, stored, source = heapq.heappop(heap)
                yield stored
            following = next(source, None)
            if following is not None:
                heapq.heappush(heap, (sign * following.time, rank, following, source))


def _since_published(stored: StoredMessage) -> TimeWindow:
    """Returns the window in which a late message may have been received before."""
    since = max(stored.record.publish_time - COPY_HORIZON_NS, MIN_NS)
    return TimeWindow(since, stored.time + 1)


def _span_order(span: TopicExtent) -> tuple[Ns, Ns, str]:
    return span.first, span.last, span.bag.file


def _recording_order(span: TopicExtent) -> tuple[str, Ns, Ns, str]:
    return str(span.bag.recording), *_span_order(span)

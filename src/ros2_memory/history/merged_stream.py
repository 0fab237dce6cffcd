"""Many bags as one stream: in log-time order, each message once.

Messages with one log time are sorted by the names of their recordings, then by their bags. Where
recordings overlap, `columns.units` decides which copies count.

A new recording receives latched messages again: with a new log time and the original publish time.
Such a message counts once too, at its earliest log time, however long ago that is.
"""

from __future__ import annotations

import heapq
from collections import Counter
from functools import partial
from itertools import chain, compress, pairwise
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

    from ros2_memory.core.arrays import Flags
    from ros2_memory.history.bag_access import BagAccess, StoredMessage

_MessageKey: TypeAlias = tuple[str, Ns, Ns, int]
"""What tells messages of a topic apart: file, log time, publish time, and hash of the payload."""


class MergedStream:
    """Reads all bags of one call together."""

    def __init__(self, bags: BagAccess) -> None:
        self.bags = bags
        self._timeline = bags.snapshot.timeline
        self._first_copies: dict[tuple[str, Ns, int], tuple[Ns, Path]] = {}
        self._searched: dict[str, Spans] = {}

    def overlapping_bags(self, topics: Collection[str], window: TimeWindow) -> list[TopicExtent]:
        """Returns the bags that may hold messages of these topics in the window, in order.

        With the first and last log time of these topics in each bag; of topics that do not reach
        into the window, none.
        """
        extents: dict[str, TopicExtent] = {}
        for topic in topics:
            for extent in self._timeline.extents(topic, window):
                bag, first, last = extent
                known = extents.get(bag.file, extent)
                extents[bag.file] = TopicExtent(bag, min(first, known.first), max(last, known.last))
        return sorted(extents.values(), key=_in_time)

    def messages(
        self,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[StoredMessage]:
        """Returns the messages of the topics in the window in log-time order, each once."""
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
        """Returns the window cut where segments begin, so that few bags are open at a time.

        It is also cut after the first and before the last message of each segment: many callers
        read only these.
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
        messages = self.merged(near, topics, window, newest_first=newest_first)
        shared = overlap_spans((extent.first, extent.last, extent.bag.recording) for extent in near)
        if shared:
            messages = self._without_copies(messages, window, shared)
        if self.may_be_repeated(topics):
            messages = (message for message in messages if not self._is_repeated(message))
        if all(extent.bag.state is BagState.CLOSED for extent in near):
            return messages
        return self.bags.track_sources(messages)

    def may_be_repeated(self, topics: Iterable[str]) -> bool:
        """Whether two recordings may have received the same latched message of a topic."""
        return any(
            topic in self._timeline.transient_local and len(self._timeline.recordings(topic)) > 1
            for topic in topics
        )

    def _without_copies(
        self, messages: Iterable[StoredMessage], window: TimeWindow, shared: Spans
    ) -> Iterator[StoredMessage]:
        """Yields messages of a window, in either order of time, without copies.

        `shared` are the spans in which recordings may hold copies. Copies are looked up for one
        topic and some seconds at once.
        """
        looked_up: dict[str, tuple[Ns, Counter[_MessageKey]]] = {}
        for stored in messages:
            if not lies_inside(shared, stored.time):
                yield stored
                continue
            topic, begin = stored.topic, stored.time - stored.time % COPY_HORIZON_NS
            known_begin, copies = looked_up.get(topic, (None, Counter[_MessageKey]()))
            if known_begin != begin:
                part = TimeWindow(begin, begin + COPY_HORIZON_NS).intersect(window)
                copies = self._count_copies(topic, part)
                looked_up[topic] = begin, copies
            key = stored.bag.file, stored.time, *stored.identity
            if copies[key]:
                copies[key] -= 1
            else:
                yield stored

    def _count_copies(self, topic: str, part: TimeWindow) -> Counter[_MessageKey]:
        """Returns how many messages with each key are copies, in a part of a topic.

        Messages of `COPY_HORIZON_NS` before decide, for these the ones before them, and the next
        ones with the same payload: `Scan` compares as much.
        """
        since = max(part.start - 2 * COPY_HORIZON_NS, MIN_NS)
        around = TimeWindow(since, min(part.stop + COPY_HORIZON_NS, MAX_NS))
        extents = self.overlapping_bags([topic], around)
        recordings = sorted({str(extent.bag.recording) for extent in extents})
        number_of = {recording: number for number, recording in enumerate(recordings)}
        keys: list[_MessageKey] = []
        messages: list[tuple[int, StoredMessage]] = []
        for stored in self.merged(extents, [topic], around, since=part.start):
            keys.append((stored.bag.file, stored.time, *stored.identity))
            messages.append((number_of[str(stored.recording)], stored))
        return Counter(compress(keys, copies_in(messages)))

    def read_up_to_first_copy(self, stored: StoredMessage) -> None:
        """Reads bags that may have a message earlier, for the notes on what is damaged there."""
        topic, window = stored.topic, _since_published(stored)
        if stored.record.may_be_repeated and self.may_be_repeated([topic]):
            for copy in self.merged(self.overlapping_bags([topic], window), [topic], window):
                if copy.identity == stored.identity:
                    break

    def _is_repeated(self, stored: StoredMessage) -> bool:
        """Whether another recording received the same latched message earlier."""
        if not stored.record.may_be_repeated:
            return False
        self._find_first_copies(stored)
        own = stored.time, stored.recording
        first_time, first_recording = self._first_copies.get((stored.topic, *stored.identity), own)
        return stored.time > first_time and stored.recording != first_recording

    def _find_first_copies(self, repeated: StoredMessage) -> None:
        """Finds the first reception of each message in the time since one was published.

        Many messages are repeated at once. So the search also covers the rest of the bag, and as
        much time again before: a few searches serve them all.
        """
        topic, window = repeated.topic, _since_published(repeated)
        searched = self._searched.setdefault(topic, [])
        if not without([(window.start, window.stop)], searched):
            return
        begin = max(window.start - (window.stop - window.start), MIN_NS)
        missing = without([(begin, max(window.stop, repeated.bag.end + 1))], searched)
        for start, stop in missing:
            part = TimeWindow(start, stop)
            bags = self.overlapping_bags([topic], part)
            for message in self.merged(bags, [topic], part, since=window.start):
                key, reception = (topic, *message.identity), (message.time, message.recording)
                self._first_copies[key] = min(reception, self._first_copies.get(key, reception))
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
        """Yields all messages of bags in order, including copies.

        Opens a bag when the stream reaches it, and none without messages in the window.

        A note reports what cannot be read, unless all of it lies before `since`.
        """
        bags = [extent for extent in bags if window.overlaps(extent.first, extent.last)]
        read = partial(self.bags.read, topics=topics, newest_first=newest_first, since=since)
        if len(bags) == 1:
            yield from read(bags[0].bag, window=_part_with_messages(bags[0], window))
            return
        sign = -1 if newest_first else 1

        def received(
            rank: int, extent: TopicExtent
        ) -> Iterator[tuple[Ns, int, StoredMessage | None]]:
            # Until the stream reaches the first of them (or the last), no message is asked for.
            yield -extent.last if newest_first else extent.first, rank, None
            for stored in read(extent.bag, window=_part_with_messages(extent, window)):
                yield sign * stored.time, rank, stored

        in_order = enumerate(sorted(bags, key=_by_recording))
        for _, _, stored in heapq.merge(*(received(sign * rank, bag) for rank, bag in in_order)):
            if stored is not None:
                yield stored


def copies_in(messages: Iterable[tuple[int, StoredMessage]]) -> Flags:
    """Returns which messages of a topic are copies, by `copies_among`.

    Args:
        messages: each with the number of its recording.
    """
    rows = [(stored.time, *stored.identity, number) for number, stored in messages]
    return copies_among(Identities(*np.array(rows, np.int64).reshape(-1, 4).T))


def _part_with_messages(extent: TopicExtent, window: TimeWindow) -> TimeWindow:
    """Returns the part of a window from the first to the last message of the topics in a bag.

    A reader without an index by topic, as of a `.db3`, goes through all messages in the rest. What
    is damaged there counts: a bag with remarks is read as it was asked for.
    """
    if extent.bag.state is not BagState.CLOSED or extent.bag.summary.remarks:
        return window
    return window.intersect(TimeWindow(extent.first, extent.last + 1))


def _since_published(stored: StoredMessage) -> TimeWindow:
    """Returns the window in which another recording may have received a message."""
    since = max(stored.record.publish_time - COPY_HORIZON_NS, MIN_NS)
    return TimeWindow(since, stored.time + 1)


def _in_time(extent: TopicExtent) -> tuple[Ns, Ns, str]:
    return extent.first, extent.last, extent.bag.file


def _by_recording(extent: TopicExtent) -> tuple[str, Ns, Ns, str]:
    return str(extent.bag.recording), *_in_time(extent)

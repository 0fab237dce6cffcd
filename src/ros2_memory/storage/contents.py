"""Summarizes the messages of a file: counts, first and last times, and pauses of each topic."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress, pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.arrays import run_starts
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS, BagSummary, SummarySchema, TopicSummary
from ros2_memory.core.pauses import (
    SHORTEST_PAUSE_NS,
    SHORTEST_SILENCE_NS,
    CountedPause,
    absences_of,
    noteworthy,
    pauses_among,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Channel


@dataclass(frozen=True, slots=True)
class Extent:
    """The messages of one channel: their count, and the earliest and the latest log time."""

    count: int
    first: Ns
    last: Ns


class Contents(NamedTuple):
    """What `Tally` found out about the messages of a file.

    Attributes:
        totals: the messages of each channel, by its number; without channels that have none.
        set_back: the longest step back (ns) from a log time to a later one of the same channel, in
            file order, and the log time that it leads to.
        pauses: where no channel has a message for more than `SHORTEST_PAUSE_NS`.
        absences: for each channel, where it has no message for more than `SHORTEST_SILENCE_NS`.
    """

    totals: Mapping[int, Extent] = MappingProxyType({})
    set_back: tuple[Ns, Ns] = (0, 0)
    pauses: Sequence[CountedPause] = ()
    absences: Mapping[int, Sequence[CountedPause]] = MappingProxyType({})

    def summary(
        self, channels: Mapping[int, Channel], notes: tuple[str, ...], *, complete: bool = True
    ) -> BagSummary:
        """Returns the summary of the file; channels of one topic and type count as one.

        Args:
            channels: the channels that the file declares, by number.
            notes: sentences on what is wrong with the file.
            complete: whether the file was readable to its end.
        """
        numbers_by_topic: dict[tuple[str, str], list[int]] = {}
        for number in self.totals:
            channel = channels[number]
            numbers_by_topic.setdefault((channel.topic, channel.type), []).append(number)
        topics: list[TopicSummary] = []
        absences: dict[str, tuple[CountedPause, ...]] = {}
        for (topic, type_name), numbers in sorted(numbers_by_topic.items()):
            extents = [self.totals[number] for number in numbers]
            count = sum(extent.count for extent in extents)
            first = min(extent.first for extent in extents)
            last = max(extent.last for extent in extents)
            latched = any(channels[number].latched for number in numbers)
            encoding = channels[numbers[0]].encoding
            topics.append(TopicSummary(topic, type_name, encoding, count, first, last, latched))
            # While one channel of a topic pauses, another may speak.
            has_one_channel = len(numbers) == 1 and topic not in absences
            pauses = self.absences.get(numbers[0], ()) if has_one_channel else ()
            absences[topic] = absences_of(pauses, count, last - first)
        declared = {channel.topic for channel in channels.values()}
        silent = declared - {topic.topic for topic in topics}
        start = min((topic.first for topic in topics), default=0)
        end = max((topic.last for topic in topics), default=0)
        besides = SummarySchema(
            (),
            tuple(sorted(silent)),
            complete,
            notes,
            set_back=self.set_back if self.set_back[0] > OUT_OF_ORDER_NS else None,
            pauses=noteworthy(self.pauses, [topic.count for topic in topics], end - start),
            absences=tuple((topic, pauses) for topic, pauses in absences.items() if pauses),
        )
        return BagSummary.packed(topics, besides)


class _Spans(NamedTuple):
    """Runs of messages, column by column: the channel, first and last log time, and the count."""

    numbers: Ints
    firsts: Ints
    lasts: Ints
    counts: Ints

    @classmethod
    def split_at(cls, begins: Ints, numbers: Ints, times: Ints, longest: Ns) -> _Spans:
        """Returns a span for each run of messages; of a run over `longest`, one for each message.

        Args:
            begins: the row at which each run begins.
            numbers: the channel of each message.
            times: the log time of each message, in ns.
            longest: in ns.
        """
        sizes = np.diff(begins, append=times.size)
        firsts, lasts = np.minimum.reduceat(times, begins), np.maximum.reduceat(times, begins)
        is_long = lasts - firsts > longest
        if not is_long.any():  # most chunks are short
            return cls(numbers[begins], firsts, lasts, sizes)
        is_message = np.repeat(is_long, sizes)
        is_span = is_message.copy()
        is_span[begins] = True
        run = np.repeat(np.arange(begins.size), sizes)[is_span]
        is_message, time = is_message[is_span], times[is_span]
        return cls(
            numbers[is_span],
            np.where(is_message, time, firsts[run]),
            np.where(is_message, time, lasts[run]),
            np.where(is_message, 1, sizes[run]),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[_Spans]) -> _Spans:
        """Returns the spans of all parts in order."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))


def _longest_step_back(firsts: Ints, lasts: Ints) -> tuple[Ns, Ns]:
    """Returns how far (ns) a span begins at most before an earlier one ends, and where it begins.

    Args:
        firsts: the first log time of each of two spans or more, in file order.
        lasts: the last log time of each span.
    """
    steps = np.maximum.accumulate(lasts)[:-1] - firsts[1:]
    longest = int(steps.argmax())
    return int(steps[longest]), int(firsts[longest + 1])


class Tally:
    """Counts the messages of a file, which come in groups of chunks."""

    def __init__(self) -> None:
        none = np.empty(0, np.int64)
        self._set_back = (0, 0)
        self._by_chunk = [_Spans(none, none, none, none)]
        self._by_channel = [_Spans(none, none, none, none)]

    def add(self, numbers: Ints, times: Ints, chunks: Ints) -> None:
        """Adds the messages of the next chunks of the file, at least one message.

        Args:
            numbers: the channel of each message.
            times: its log time (ns).
            chunks: the position of its chunk, ascending.
        """
        by_chunk = _Spans.split_at(run_starts(chunks), numbers, times, SHORTEST_PAUSE_NS)
        self._by_chunk.append(by_chunk)
        order = np.argsort(numbers, kind="stable")
        numbers, times, chunks = numbers[order], times[order], chunks[order]
        begins = run_starts(numbers, chunks)
        by_channel = _Spans.split_at(begins, numbers, times, SHORTEST_SILENCE_NS)
        self._by_channel.append(by_channel)
        # `contents` compares the spans with each other, and this the messages inside one.
        goes_back = np.append(False, times[1:] < times[:-1])
        goes_back[begins] = False
        if goes_back.any():
            spans = pairwise([*begins.tolist(), times.size])
            for begin, end in compress(spans, np.logical_or.reduceat(goes_back, begins)):
                step = _longest_step_back(times[begin:end], times[begin:end])
                self._set_back = max(self._set_back, step)

    def contents(self) -> Contents:
        """Returns the contents of all chunks that were added."""
        spans = _Spans.concatenate(self._by_channel)
        order = np.argsort(spans.numbers, kind="stable")
        numbers, firsts, lasts, counts = (column[order] for column in spans)
        goes_back = (numbers[1:] == numbers[:-1]) & (firsts[1:] < lasts[:-1])
        going_back = {*numbers[1:][goes_back].tolist()}
        begins = run_starts(numbers)
        channels = zip(
            numbers[begins].tolist(),
            np.add.reduceat(counts, begins).tolist(),
            np.minimum.reduceat(firsts, begins).tolist(),
            np.maximum.reduceat(lasts, begins).tolist(),
            strict=True,
        )
        totals = {number: Extent(count, first, last) for number, count, first, last in channels}
        absences: dict[int, Sequence[CountedPause]] = {}
        set_back = self._set_back
        bounds = pairwise([*begins.tolist(), numbers.size])
        for (number, extent), (begin, end) in zip(totals.items(), bounds, strict=True):
            rows = slice(begin, end)
            if number in going_back:
                set_back = max(set_back, _longest_step_back(firsts[rows], lasts[rows]))
            if extent.last - extent.first > SHORTEST_SILENCE_NS:
                pauses = pauses_among(
                    firsts[rows], lasts[rows], counts[rows], longer_than=SHORTEST_SILENCE_NS
                )
                if pauses:
                    absences[number] = pauses
        _, firsts, lasts, counts = _Spans.concatenate(self._by_chunk)
        return Contents(totals, set_back, pauses_among(firsts, lasts, counts), absences)

"""What the messages of a file amount to: counts, first and last times, pauses of each topic."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress, pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.arrays import run_starts
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS, BagSummary, TopicSummary
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
    """Messages of one channel: how many, and the log times of the earliest and the latest."""

    count: int
    first: Ns
    last: Ns


class Contents(NamedTuple):
    """What the messages of a file amount to.

    Attributes:
        totals: the messages of each channel that has some, by its number.
        set_back: by how much a log time lies at most before an earlier one of its channel in the
            order of the file, and that log time.
        pauses: where no channel has a message for more than `SHORTEST_PAUSE_NS`.
        absences: by channel, where it has none for more than `SHORTEST_SILENCE_NS`.
    """

    totals: Mapping[int, Extent] = MappingProxyType({})
    set_back: tuple[Ns, Ns] = (0, 0)
    pauses: Sequence[CountedPause] = ()
    absences: Mapping[int, Sequence[CountedPause]] = MappingProxyType({})

    def summary(
        self, channels: Mapping[int, Channel], notes: tuple[str, ...], *, complete: bool = True
    ) -> BagSummary:
        """Returns the summary of a file; channels of one topic and type count as one.

        Args:
            channels: those that it declares, by number.
            notes: sentences on what is wrong with it.
            complete: whether it was readable to its end.
        """
        by_topic: dict[tuple[str, str], list[int]] = {}
        for number in self.totals:
            channel = channels[number]
            by_topic.setdefault((channel.topic, channel.type), []).append(number)
        silent = {channel.topic for channel in channels.values()} - {topic for topic, _ in by_topic}
        topics: list[TopicSummary] = []
        absences: dict[str, tuple[CountedPause, ...]] = {}
        for (topic, type_name), numbers in sorted(by_topic.items()):
            extents = [self.totals[number] for number in numbers]
            count = sum(extent.count for extent in extents)
            first = min(extent.first for extent in extents)
            last = max(extent.last for extent in extents)
            latched = any(channels[number].latched for number in numbers)
            encoding = channels[numbers[0]].encoding
            topics.append(TopicSummary(topic, type_name, encoding, count, first, last, latched))
            # Where it has several channels, a pause of one is none of the topic.
            is_whole = len(numbers) == 1 and topic not in absences
            listed = self.absences.get(numbers[0], ()) if is_whole else ()
            absences[topic] = absences_of(listed, count, last - first)
        length = max((topic.last for topic in topics), default=0) - min(
            (topic.first for topic in topics), default=0
        )
        return BagSummary(
            topics,
            tuple(sorted(silent)),
            complete,
            notes,
            set_back=self.set_back if self.set_back[0] > OUT_OF_ORDER_NS else None,
            pauses=noteworthy(self.pauses, [topic.count for topic in topics], length),
            absences=tuple((topic, found) for topic, found in absences.items() if found),
        )


class _Spans(NamedTuple):
    """Messages that follow each other: of which channel, from when to when, and how many."""

    numbers: Ints
    firsts: Ints
    lasts: Ints
    counts: Ints

    @classmethod
    def of(cls, numbers: Ints, times: Ints, begins: Ints, longest: Ns) -> _Spans:
        """Returns the spans of messages that begin so; one for each message of a longer one."""
        sizes = np.diff(begins, append=times.size)
        firsts, lasts = np.minimum.reduceat(times, begins), np.maximum.reduceat(times, begins)
        is_long = lasts - firsts > longest
        if not is_long.any():
            return cls(numbers[begins], firsts, lasts, sizes)
        if is_long.all():
            return cls(numbers, times, times, np.ones_like(times))
        alone = np.repeat(is_long, sizes)
        is_row = alone.copy()
        is_row[begins] = True
        span = np.repeat(np.arange(begins.size), sizes)[is_row]
        alone, at = alone[is_row], times[is_row]
        firsts, lasts = np.where(alone, at, firsts[span]), np.where(alone, at, lasts[span])
        return cls(numbers[is_row], firsts, lasts, np.where(alone, 1, sizes[span]))


def _set_back(firsts: Ints, lasts: Ints) -> tuple[Ns, Ns]:
    """Returns by how much spans begin at most before an earlier one has ended, and when that is."""
    behind = np.maximum.accumulate(lasts)[:-1] - firsts[1:]
    most = int(behind.argmax())
    return int(behind[most]), int(firsts[most + 1])


class Tally:
    """Counts the messages of a file, some at a time."""

    def __init__(self) -> None:
        none = np.empty(0, np.int64)
        self._back = (0, 0)
        self._all = [_Spans(none, none, none, none)]
        self._by_channel = [_Spans(none, none, none, none)]

    def add(self, numbers: Ints, times: Ints, chunks: Ints) -> None:
        """Adds all messages of chunks, one at least, which follow those before in the file.

        Args:
            numbers: the channel of each.
            times: its log time (ns).
            chunks: the position of its chunk; those of one chunk follow each other.
        """
        self._all.append(_Spans.of(numbers, times, run_starts(chunks), SHORTEST_PAUSE_NS))
        order = np.argsort(numbers, kind="stable")
        numbers, times, chunks = numbers[order], times[order], chunks[order]
        is_other = (numbers[1:] != numbers[:-1]) | (chunks[1:] != chunks[:-1])
        begins = np.append(0, np.flatnonzero(is_other) + 1)
        goes_back = np.append(False, times[1:] < times[:-1])
        goes_back[begins] = False
        if goes_back.any():
            groups = pairwise([*begins.tolist(), times.size])
            for group in compress(groups, np.logical_or.reduceat(goes_back, begins)):
                of_group = times[slice(*group)]
                self._back = max(self._back, _set_back(of_group, of_group))
        self._by_channel.append(_Spans.of(numbers, times, begins, SHORTEST_SILENCE_NS))

    def contents(self) -> Contents:
        """Returns what all messages amount to."""
        spans = _Spans(*map(np.concatenate, zip(*self._by_channel, strict=True)))
        order = np.argsort(spans.numbers, kind="stable")
        numbers, firsts, lasts, counts = (column[order] for column in spans)
        goes_back = (numbers[1:] == numbers[:-1]) & (firsts[1:] < lasts[:-1])
        going_back = {*numbers[1:][goes_back].tolist()}
        begins = run_starts(numbers)
        extents = zip(
            numbers[begins].tolist(),
            np.add.reduceat(counts, begins).tolist(),
            np.minimum.reduceat(firsts, begins).tolist(),
            np.maximum.reduceat(lasts, begins).tolist(),
            pairwise([*begins.tolist(), order.size]),
            strict=True,
        )
        totals: dict[int, Extent] = {}
        absences: dict[int, Sequence[CountedPause]] = {}
        back = self._back
        for number, count, first, last, (begin, end) in extents:
            totals[number] = Extent(count, first, last)
            rows = slice(begin, end)
            if number in going_back:
                back = max(back, _set_back(firsts[rows], lasts[rows]))
            if last - first > SHORTEST_SILENCE_NS:
                columns = firsts[rows], lasts[rows], counts[rows]
                if pauses := pauses_among(*columns, longer_than=SHORTEST_SILENCE_NS):
                    absences[number] = pauses
        _, firsts, lasts, counts = map(np.concatenate, zip(*self._all, strict=True))
        return Contents(totals, back, pauses_among(firsts, lasts, counts), absences)

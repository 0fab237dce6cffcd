"""Bags in time order, and what follows from their summaries.

A week is 60,000 bags, and another one closes every ten seconds. So the bags are kept in segments:
what is computed for a segment serves every later timeline that still has it, and only the segment
that changes is computed again.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cached_property, reduce
from itertools import accumulate, chain
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.bag_dir.layout import MEMORY_FOLDER, is_derived, is_thinned
from ros2_memory.core.arrays import Ints, joined_codes, run_starts
from ros2_memory.core.memo import Memo
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS, Spans, overlap_spans, united, without
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.index.bag_rows import Bags
from ros2_memory.index.segment import (
    Pace,
    Segment,
    TopicExtent,
    TopicTotals,
    add_totals,
    in_time,
    is_log,
    wider,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path


MAX_FILE_NS: Final[Ns] = 24 * 3600 * NS_PER_S
"""The longest span that a file is taken to hold when one end of it is known."""
SEGMENT_BAGS: Final = 1024
"""The most bags in a segment: few enough to compute in some milliseconds; a week has 60."""


class Timeline:
    """Bags sorted by (start, end, path). Immutable; `changed` returns the next one.

    Attributes:
        memo: what was derived from these bags; a new bag makes a new timeline.
    """

    def __init__(self, segments: Sequence[Segment] = ()) -> None:
        self.segments = tuple(segments)
        self.memo = Memo()
        self._recordings: dict[str, dict[Path, Span]] = {}

    @classmethod
    def of(cls, bags: Iterable[BagFile]) -> Timeline:
        """Returns a timeline of bags given in any order."""
        return cls(_segments_of(bags))

    def changed(self, removed: Iterable[BagFile], added: Iterable[BagFile]) -> Timeline:
        """Returns a timeline without some bags and with others; itself if there are none.

        Raises:
            ValueError: a removed bag is not in it.
        """
        removed, added = tuple(removed), tuple(added)
        if not removed and not added:
            return self
        if not self.segments:
            return Timeline.of(added)
        touched: dict[int, list[BagFile]] = {}

        def bags_around(bag: BagFile) -> list[BagFile]:
            at = self._position(bag)
            if at not in touched:
                touched[at] = [*self.segments[at].bags]
            return touched[at]

        for bag in removed:
            bags_around(bag).remove(bag)
        for bag in added:
            bags_around(bag).append(bag)
        segments: list[Segment] = []
        for at, segment in enumerate(self.segments):
            segments += _segments_of(touched[at]) if at in touched else [segment]
        return Timeline(segments)

    @cached_property
    def _firsts(self) -> list[tuple[Ns, Ns, str]]:
        return [segment.first for segment in self.segments]

    @cached_property
    def _reaches(self) -> list[Ns]:
        """For each segment the latest log time in it and all before it: ascending."""
        return list(accumulate((segment.latest for segment in self.segments), max))

    def named(self, files: Collection[str]) -> list[BagFile]:
        """Returns the bags of these paths that are in it."""
        folders, found = {file.rpartition("/")[0] for file in files}, list[BagFile]()
        for segment in self.segments:
            if not folders.isdisjoint(segment.bags.folders):
                paths = segment.bags.files()
                found += segment.bags.at([row for row, path in enumerate(paths) if path in files])
        return found

    def _position(self, bag: BagFile) -> int:
        return max(bisect_right(self._firsts, in_time(bag)) - 1, 0)

    def segments_in(self, window: TimeWindow) -> Sequence[Segment]:
        """Returns the segments that can contain something of a window, in order."""
        begin = bisect_left(self._reaches, window.start)
        end = bisect_left(self._firsts, window.stop, key=lambda first: first[0])
        return self.segments[begin:end]

    def totals(self, topic: str) -> dict[str, TopicTotals]:
        """Returns by type what all bags hold of a topic."""
        totals: dict[str, TopicTotals] = {}
        for segment in self.segments:
            for type_name, more in segment.totals.get(topic, {}).items():
                add_totals(totals, type_name, more)
        return totals

    def recordings(self, topic: str) -> dict[Path, Span]:
        """Returns the recordings that hold the topic, with its first and last log time in each."""
        if topic not in self._recordings:
            spans: dict[Path, Span] = {}
            for segment in self.segments:
                for folder, totals in segment.recordings(topic).items():
                    spans[folder] = wider(spans.get(folder), totals[:2])
            self._recordings[topic] = spans
        return self._recordings[topic]

    @cached_property
    def handed_over(self) -> frozenset[str]:
        """The folders of bags with a `handover.json`; of those of a lake all."""
        return frozenset(chain.from_iterable(segment.handed_over for segment in self.segments))

    @cached_property
    def bags(self) -> Bags:
        """All bags, in order."""
        return Bags(segment.bags for segment in self.segments)

    @property
    def starts(self) -> Ints:
        """Log time of the first message in each of all bags."""
        return np.concatenate(
            [np.empty(0, np.int64), *(part.bags.starts for part in self.segments)]
        )

    @property
    def latest(self) -> Ns:
        """Log time of the last message in any of the bags; the earliest time without any."""
        return max((segment.latest for segment in self.segments), default=MIN_NS)

    @property
    def ends(self) -> Ints:
        """Log time of the last message in each of all bags."""
        return np.concatenate([np.empty(0, np.int64), *(part.bags.ends for part in self.segments)])

    @property
    def folder_numbers(self) -> Ints:
        """For each of all bags a number; those of one folder have the same."""
        bags = (segment.bags for segment in self.segments)
        return joined_codes((part.folder_of, part.folders) for part in bags)[0]

    @cached_property
    def recorded_segments(self) -> tuple[Segment, ...]:
        """The bags that show when there was a recording, in order, some at a time.

        The bag of carried messages does not: it holds what is left of deleted bags. It is among
        them only where there is no other.
        """
        return tuple(filter(None, (segment.recorded for segment in self.segments))) or self.segments

    @cached_property
    def recorded(self) -> Bags:
        """The bags of `recorded_segments`."""
        return Bags(segment.bags for segment in self.recorded_segments)

    @cached_property
    def thinned(self) -> tuple[BagFile, ...]:
        """The days of which only some messages stayed, in order."""
        bags = chain.from_iterable(
            segment.bags
            for segment in self.segments
            if any(folder.endswith(f"/{MEMORY_FOLDER}") for folder in segment.bags.folders)
        )
        return tuple(bag for bag in bags if is_thinned(bag.file))

    @cached_property
    def thinned_times(self) -> Spans:
        """The times of which a thinned day has some messages, and no other bag has all."""
        days = united((day.start, day.end + 1) for day in self.thinned)
        if not days:
            return days
        around = self.overlapping(TimeWindow(days[0][0], days[-1][1]))
        whole = [bag for bag in around if not is_derived(bag.file)]
        # Between the bags of a moment nothing is missing.
        return without(days, united([(bag.start, bag.end + 1) for bag in whole], NS_PER_S))

    @property
    def disk_use(self) -> tuple[int, int]:
        """The bytes of the recorded bags, and how many of them a crash left open."""
        parts = [segment.disk_use for segment in self.recorded_segments]
        return sum(size for size, _ in parts), sum(left_open for _, left_open in parts)

    @property
    def closed(self) -> int:
        """How many of the bags are closed."""
        closed = (segment.bags.are(BagState.CLOSED).sum() for segment in self.segments)
        return sum(map(int, closed))

    @cached_property
    def types(self) -> dict[str, tuple[str, ...]]:
        """By topic (sorted), the types of its messages (sorted)."""
        types: dict[str, set[str]] = {}
        for segment in self.segments:
            for topic, names in segment.types.items():
                types.setdefault(topic, set()).update(names)
        return {topic: tuple(sorted(types[topic])) for topic in sorted(types)}

    @cached_property
    def transient_local(self) -> frozenset[str]:
        """The topics that some publisher offered as transient local.

        A subscriber may receive their last messages again, long after they were published.
        """
        return frozenset(chain.from_iterable(segment.transient_local for segment in self.segments))

    def topics(self) -> tuple[str, ...]:
        """Returns the topics of which some bag holds a message, sorted."""
        return tuple(self.types)

    def types_of(self, topic: str) -> tuple[str, ...]:
        """Returns the message types of the topic, sorted; empty where it has no message."""
        return self.types.get(topic, ())

    def is_transient_state(self, topic: str) -> bool:
        """Returns whether the topic is transient local, and no log as `/rosout` is everywhere."""
        return topic in self.transient_local and not self.is_log(topic)

    def is_log(self, topic: str) -> bool:
        """Returns whether the topic is a log, whose lines come when something happens."""
        return all(map(is_log, self.types_of(topic)))

    def pace(self, topic: str, recording: Path) -> Pace:
        """Returns how often a recording has messages of a topic; it must hold some."""
        folder = str(recording)
        segments = [segment for segment in self.segments if folder in segment.bags.folders]
        totals = filter(None, (segment.recordings(topic).get(recording) for segment in segments))
        extents = (segment.folder_spans[folder] for segment in segments)
        return Pace(reduce(TopicTotals.__or__, totals), *reduce(wider, extents))

    @cached_property
    def silent(self) -> frozenset[str]:
        """The topics that some bag declares without a message; another may hold some."""
        return frozenset(chain.from_iterable(segment.silent for segment in self.segments))

    def overlapping(self, window: TimeWindow) -> tuple[BagFile, ...]:
        """Returns the bags whose span overlaps the window, in order."""
        if window.empty:
            return ()
        segments = self.segments_in(window)
        return tuple(chain.from_iterable(segment.overlapping(window) for segment in segments))

    @cached_property
    def shared_times(self) -> Spans:
        """The half-open spans in which bags of different recordings may hold copies, in order."""
        if not self.segments:
            return []
        folders, starts, ends = self.folder_numbers, self.starts, self.ends
        # A run is bags of one folder in a row. Two sorts of its bags show all that it shares: those
        # that begin before an earlier run has ended, and the one that ends last.
        begins = run_starts(folders)
        sizes = np.diff(begins, append=folders.size)
        reached = np.append(MIN_NS, np.maximum.accumulate(ends)[begins[1:] - 1])
        nearest = np.maximum(starts, MIN_NS + COPY_HORIZON_NS) - COPY_HORIZON_NS
        is_near = nearest <= np.repeat(reached, sizes)
        is_last = ends == np.repeat(np.maximum.reduceat(ends, begins), sizes)
        rows = np.flatnonzero(is_near | is_last)
        return overlap_spans(
            zip(*(of[rows].tolist() for of in (starts, ends, folders)), strict=True)
        )

    def faulty(self, window: TimeWindow) -> list[BagFile]:
        """Returns the bags whose faults may bear on the window, in order.

        Those of a bag that a crash left open reach to the last time that its file was written to,
        if that was within a day.
        """
        faulty = []
        for segment in self.segments:
            for bag in segment.faulty if segment.first[0] < window.stop else ():
                is_cut = bag.state is BagState.INCOMPLETE
                is_late = bag.end < bag.mtime_ns <= bag.end + MAX_FILE_NS
                if window.overlaps(bag.start, bag.mtime_ns if is_cut and is_late else bag.end):
                    faulty.append(bag)
        return faulty

    def extents(self, topic: str, window: TimeWindow) -> Iterator[TopicExtent]:
        """Yields the bags that hold the topic (in a window), in order, once for each type.

        Those are the bags that can contain some of its messages in the window, by its first and
        last time in each bag.
        """
        if window.empty:
            return
        for segment in self.segments_in(window):
            span = segment.spans.get(topic)
            if span is not None and window.overlaps(*span):
                yield from segment.extents(topic, window)

    def first_with(self, topic: str, type_name: str) -> BagFile:
        """Returns the first bag that holds the topic under a type; there must be one."""
        segment = next(
            segment for segment in self.segments if type_name in segment.types.get(topic, ())
        )
        holds = segment.bags.with_schema(
            lambda schema: any(header[:2] == (topic, type_name) for header in schema.topics)
        )
        return segment.bags[int(holds.argmax())]


def _segments_of(bags: Iterable[BagFile]) -> list[Segment]:
    """Returns segments of bags given in any order."""
    runs: list[list[BagFile]] = []
    for bag in sorted(bags, key=in_time):
        if not runs or len(runs[-1]) == SEGMENT_BAGS:
            runs.append([])
        runs[-1].append(bag)
    return [Segment(run) for run in runs]

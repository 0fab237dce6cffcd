"""Bags in time order, and what follows from their summaries.

A week is 60,000 bags, and another one closes every ten seconds. So the bags are kept in segments: a
new timeline shares the unchanged segments, with all that was computed for them.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cached_property
from itertools import accumulate, chain
from math import ceil
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.bag_dir.layout import MEMORY_FOLDER, is_derived, is_thinned
from ros2_memory.core.arrays import (
    Ints,
    bounds_of,
    concatenated,
    joined_codes,
    run_starts,
    stable_order,
)
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.memo import Memo
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import (
    COPY_HORIZON_NS,
    Spans,
    enclosing,
    overlap_spans,
    united,
    without,
)
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.index.bag_rows import Bags
from ros2_memory.index.segment import (
    NO_TOTALS,
    Pace,
    Segment,
    TopicExtent,
    TopicTotals,
    in_time,
    is_log,
    wider,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import TopicHeader

MAX_FILE_NS: Final[Ns] = 24 * 3600 * NS_PER_S
"""The longest time that a file is taken to hold if only one end of it is known."""
SEGMENT_BAGS: Final = 1024
"""The most bags in a segment: it is computed in some milliseconds, and a week has 60 segments."""
_ACTION: Final = "/_action/"
_SERVICE_EVENT: Final = "/_service_event"


class Timeline:
    """Bags sorted by (start, end, path). Immutable; `changed` returns the next one.

    Attributes:
        segments: the bags.
        memo: what was derived from these bags. A new bag makes a new timeline.
    """

    def __init__(self, segments: Sequence[Segment] = ()) -> None:
        self.segments = tuple(segments)
        self.memo = Memo()
        self._recordings: dict[str, dict[Path, Span]] = {}
        self._paces: dict[str, dict[Path, Pace]] = {}

    @classmethod
    def of(cls, bags: Iterable[BagFile]) -> Timeline:
        """Returns a timeline of bags given in any order."""
        return cls(_segments_of(bags))

    def changed(self, removed: Iterable[BagFile], added: Iterable[BagFile]) -> Timeline:
        """Returns the timeline without some bags and with others.

        Raises:
            ValueError: a removed bag is not in it.
        """
        removed, added = tuple(removed), tuple(added)
        if not removed and not added:
            return self
        if not self.segments:
            return Timeline.of(added)
        touched: dict[int, list[BagFile]] = {}

        def bags_beside(bag: BagFile) -> list[BagFile]:
            position = max(bisect_right(self._firsts, in_time(bag)) - 1, 0)
            if position not in touched:
                touched[position] = [*self.segments[position].bags]
            return touched[position]

        for bag in removed:
            bags_beside(bag).remove(bag)
        for bag in added:
            bags_beside(bag).append(bag)
        segments: list[Segment] = []
        for position, segment in enumerate(self.segments):
            if position not in touched:
                segments.append(segment)
                continue
            bags = touched[position]
            # Else bags that come in the order of copying, or go one by one, leave many segments.
            if segments and len(segments[-1].bags) + len(bags) <= SEGMENT_BAGS // 2:
                bags += segments.pop().bags
            segments += _segments_of(bags, evenly=segment is not self.segments[-1])
        return Timeline(segments)

    @cached_property
    def _firsts(self) -> list[tuple[Ns, Ns, str]]:
        return [segment.first for segment in self.segments]

    @cached_property
    def _reaches(self) -> list[Ns]:
        """For each segment the latest log time up to its end; ascending."""
        return list(accumulate((segment.latest for segment in self.segments), max))

    def bags_named(self, files: Collection[str]) -> list[BagFile]:
        """Returns the bags at these paths; a path without a bag is passed over."""
        folders = {file.rpartition("/")[0] for file in files}
        bags: list[BagFile] = []
        for segment in self.segments:
            if not folders.isdisjoint(segment.bags.folders):
                paths = segment.bags.files()
                bags += segment.bags.at([row for row, path in enumerate(paths) if path in files])
        return bags

    def segments_in(self, window: TimeWindow) -> Sequence[Segment]:
        """Returns the segments that may have messages in a window, in order."""
        begin = bisect_left(self._reaches, window.start)
        end = bisect_left(self._firsts, window.stop, key=lambda first: first[0])
        return self.segments[begin:end]

    def totals(self, topic: str) -> dict[str, TopicTotals]:
        """Returns by type the totals of a topic over all bags."""
        totals: dict[str, TopicTotals] = {}
        for segment in self.segments:
            for type_name, more in segment.totals.get(topic, {}).items():
                totals[type_name] = totals.get(type_name, NO_TOTALS) | more
        return totals

    def recordings(self, topic: str) -> dict[Path, Span]:
        """Returns the recordings that hold the topic, with its first and last log time in each."""
        if topic not in self._recordings:
            paces = self.paces(topic).items()
            self._recordings[topic] = {
                path: (pace.topic.first, pace.topic.last) for path, pace in paces
            }
        return self._recordings[topic]

    @cached_property
    def handed_over(self) -> frozenset[str]:
        """The folders of bags with a `handover.json`; in a lake, all folders."""
        return frozenset(chain.from_iterable(segment.handed_over for segment in self.segments))

    @cached_property
    def bags(self) -> Bags:
        """All bags, in order."""
        return Bags(segment.bags for segment in self.segments)

    @property
    def starts(self) -> Ints:
        """Log time of the first message in each bag."""
        return concatenated(segment.bags.starts for segment in self.segments)

    @property
    def latest(self) -> Ns:
        """Log time of the last message in any bag; `MIN_NS` without bags."""
        return max((segment.latest for segment in self.segments), default=MIN_NS)

    @property
    def ends(self) -> Ints:
        """Log time of the last message in each bag."""
        return concatenated(segment.bags.ends for segment in self.segments)

    @property
    def folder_numbers(self) -> Ints:
        """A number for each bag, which all bags of its folder share."""
        bags = (segment.bags for segment in self.segments)
        numbers, _ = joined_codes((part.folder_of, part.folders) for part in bags)
        return numbers

    @cached_property
    def recorded_segments(self) -> tuple[Segment, ...]:
        """The segments without the bag of carried messages, unless there is no other bag.

        That bag does not show when there was a recording: it holds what is left of deleted bags.
        """
        return tuple(filter(None, (segment.recorded for segment in self.segments))) or self.segments

    @cached_property
    def recorded(self) -> Bags:
        """The bags of `recorded_segments`."""
        return Bags(segment.bags for segment in self.recorded_segments)

    @cached_property
    def thinned(self) -> tuple[BagFile, ...]:
        """The thinned days, in order."""
        bags = chain.from_iterable(
            segment.bags
            for segment in self.segments
            if any(folder.endswith(f"/{MEMORY_FOLDER}") for folder in segment.bags.folders)
        )
        return tuple(bag for bag in bags if is_thinned(bag.file))

    @cached_property
    def thinned_times(self) -> Spans:
        """The times of thinned days in which no other bag has all messages."""
        days = united((day.start, day.end + 1) for day in self.thinned)
        if not days:
            return days
        begin, stop = enclosing(days)
        around = self.overlapping(TimeWindow(begin, stop))
        whole = [(bag.start, bag.end + 1) for bag in around if not is_derived(bag.file)]
        # Bags of a saved moment that are at most a second apart lack nothing in between.
        return without(days, united(whole, NS_PER_S))

    @property
    def disk_use(self) -> tuple[int, int]:
        """The size of the recorded bags in bytes, and how many of them a crash left open."""
        parts = [segment.disk_use for segment in self.recorded_segments]
        return sum(size for size, _ in parts), sum(left_open for _, left_open in parts)

    @property
    def closed(self) -> int:
        """How many bags are closed."""
        closed = (segment.bags.in_state(BagState.CLOSED).sum() for segment in self.segments)
        return sum(map(int, closed))

    @cached_property
    def _headers(self) -> frozenset[TopicHeader]:
        return frozenset(chain.from_iterable(segment.headers for segment in self.segments))

    @cached_property
    def types(self) -> dict[str, tuple[str, ...]]:
        """By topic (sorted), the types of its messages (sorted)."""
        types: dict[str, set[str]] = {}
        for header in self._headers:
            types.setdefault(header.topic, set()).add(header.type)
        return {topic: tuple(sorted(types[topic])) for topic in sorted(types)}

    @cached_property
    def transient_local(self) -> frozenset[str]:
        """The topics that some publisher offered as transient local.

        A subscriber may receive their last messages again, long after they were published.
        """
        return frozenset(header.topic for header in self._headers if header.latched)

    def topics(self) -> tuple[str, ...]:
        """Returns the topics with a message in some bag, sorted."""
        return tuple(self.types)

    def types_of(self, topic: str) -> tuple[str, ...]:
        """Returns the message types of the topic, sorted; empty if it has no message."""
        return self.types.get(topic, ())

    def is_transient_state(self, topic: str) -> bool:
        """Returns whether the topic is transient local and no log (`/rosout` is both)."""
        return topic in self.transient_local and not self.is_log(topic)

    def is_log(self, topic: str) -> bool:
        """Returns whether the topic is a log, whose lines come when something happens."""
        return all(map(is_log, self.types_of(topic)))

    def is_on_events(self, topic: str) -> bool:
        """Returns whether the messages come when something happens: of logs and of calls.

        Calls are actions and services, whose topics are hidden.
        """
        return self.is_log(topic) or _ACTION in topic or topic.endswith(_SERVICE_EVENT)

    def pace(self, topic: str, recording: Path) -> Pace:
        """Returns the pace of a topic in a recording, which must hold the topic."""
        return self.paces(topic)[recording]

    def paces(self, topic: str) -> dict[Path, Pace]:
        """Returns the pace of a topic in each recording that holds it."""
        if topic not in self._paces:
            totals: dict[Path, TopicTotals] = {}
            for segment in self.segments:
                for path, more in segment.recordings(topic).items():
                    totals[path] = totals.get(path, NO_TOTALS) | more
            spans = self._folder_spans
            self._paces[topic] = {path: Pace(totals[path], *spans[str(path)]) for path in totals}
        return self._paces[topic]

    @cached_property
    def _folder_spans(self) -> dict[str, Span]:
        """By folder, the first and the last log time of its bags."""
        spans: dict[str, Span] = {}
        for segment in self.segments:
            for folder, totals in segment.folder_totals.items():
                spans[folder] = wider(spans.get(folder), (totals.first, totals.last))
        return spans

    @cached_property
    def silent(self) -> frozenset[str]:
        """The topics that some bag declares without a message; other bags may hold some."""
        return frozenset(chain.from_iterable(segment.silent for segment in self.segments))

    def overlapping(self, window: TimeWindow) -> tuple[BagFile, ...]:
        """Returns the bags whose span overlaps the window, in order."""
        if window.empty:
            return ()
        segments = self.segments_in(window)
        return tuple(chain.from_iterable(segment.overlapping(window) for segment in segments))

    @property
    def _recorded_spans(self) -> tuple[Ints, Ints, Ints]:
        """The folder, first and last log time of each bag, in order.

        A bag in which the clock was set ahead has two: months without a message lie between them.
        """
        folders, starts, ends = self.folder_numbers, self.starts, self.ends
        rows, jumps, begin = list[int](), list[Span](), 0
        for segment in self.segments:
            files = segment.bags.files() if segment.set_ahead else []
            rows += [begin + files.index(bag.file) for bag, _ in segment.set_ahead]
            jumps += [jump for _, jump in segment.set_ahead]
            begin += len(segment.bags)
        if not rows:
            return folders, starts, ends
        before, after = bounds_of(jumps)
        folders, starts = np.append(folders, folders[rows]), np.append(starts, after)
        ends = np.append(ends, ends[rows])
        ends[rows] = before
        order = stable_order(starts)
        return folders[order], starts[order], ends[order]

    @cached_property
    def shared_times(self) -> Spans:
        """The half-open spans in which bags of different recordings may hold copies, in order."""
        if not self.segments:
            return []
        folders, starts, ends = self._recorded_spans
        # A run is a row of bags of one folder. Two kinds of its bags show all that it shares: bags
        # that begin before an earlier run has ended, and the bag that ends last.
        begins = run_starts(folders)
        sizes = np.diff(begins, append=folders.size)
        earlier_ends = np.append(MIN_NS, np.maximum.accumulate(ends)[begins[1:] - 1])
        nearest = np.maximum(starts, MIN_NS + COPY_HORIZON_NS) - COPY_HORIZON_NS
        is_near = nearest <= np.repeat(earlier_ends, sizes)
        is_last = ends == np.repeat(np.maximum.reduceat(ends, begins), sizes)
        rows = np.flatnonzero(is_near | is_last)
        spans = (starts[rows].tolist(), ends[rows].tolist(), folders[rows].tolist())
        return overlap_spans(zip(*spans, strict=True))

    def faulty(self, window: TimeWindow) -> list[BagFile]:
        """Returns the bags whose faults may concern the window, in order.

        A bag that a crash left open may lack messages up to its mtime, if that is within a day: if
        nothing else is wrong with it, from its last ones on.
        """
        faulty = []
        for segment in self.segments:
            if segment.first[0] < window.stop:
                faulty += [bag for bag in segment.faulty if window.overlaps(*_span_of_faults(bag))]
        return faulty

    def extents(self, topic: str, window: TimeWindow) -> Iterator[TopicExtent]:
        """Yields the bags that may hold messages of the topic in a window, in order.

        By the first and last time of the topic in each bag. A bag comes once for each type.
        """
        if window.empty:
            return
        for segment in self.segments_in(window):
            span = segment.spans.get(topic)
            if span is not None and window.overlaps(*span):
                yield from segment.extents(topic, window)

    def bag_with(self, topic: str, type_name: str, *, last: bool = False) -> BagFile:
        """Returns the first or last bag that holds the topic under a type; there must be one."""

        def has_type(headers: Sequence[TopicHeader], positions: Iterable[int]) -> bool:
            return any(headers[position].type == type_name for position in positions)

        segments = self.segments[::-1] if last else self.segments
        segment = next(
            segment
            for segment in segments
            if has_type(segment.headers, segment.positions.get(topic, ()))
        )
        has_topic = segment.bags.with_schema(
            lambda schema: has_type(schema.topics, schema.positions.get(topic, ()))
        )
        rows = np.flatnonzero(has_topic)
        return segment.bags[int(rows[-1 if last else 0])]


def _span_of_faults(bag: BagFile) -> Span:
    if bag.state is not BagState.INCOMPLETE:
        return bag.start, bag.end
    schema = bag.summary.schema
    is_cut_off = schema.remarks and not schema.faults and schema.clock_set_back is None
    start = max(bag.end - OUT_OF_ORDER_NS, bag.start) if is_cut_off else bag.start
    return start, bag.mtime_ns if bag.end < bag.mtime_ns <= bag.end + MAX_FILE_NS else bag.end


def _segments_of(bags: Iterable[BagFile], *, evenly: bool = False) -> list[Segment]:
    """Returns the segments of bags that are given in any order: full ones, or of about one size."""
    ordered = sorted(bags, key=in_time)
    size = SEGMENT_BAGS
    if evenly and len(ordered) > size:
        size = ceil(len(ordered) / ceil(len(ordered) / size))
    return [Segment(ordered[begin : begin + size]) for begin in range(0, len(ordered), size)]

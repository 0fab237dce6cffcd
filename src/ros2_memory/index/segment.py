"""A segment: consecutive bags of a timeline, and what follows from their summaries.

Everything is computed on first use, and kept as long as the segment. A query looks at few topics of
many bags, so the numbers of all summaries are read as arrays.
"""

from __future__ import annotations

from functools import cached_property
from itertools import chain, starmap
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.silences import SHORTEST_NS, Pacing, Spacing
from ros2_memory.bag_dir.layout import CARRY_FOLDER, MEMORY_FOLDER, is_carried, is_thinned
from ros2_memory.core.arrays import run_starts
from ros2_memory.core.bag_summary import SummarySchema, TopicHeader, numbers_of, positions_of
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import Spans, enclosing, spans_of, united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_MS, NS_PER_S, Ns, Span
from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.holes import FAR_AHEAD_NS, Pause, pauses_between
from ros2_memory.index.split_order import StepBack
from ros2_memory.messages.levels import FOXGLOVE_LOGS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Flags, Ints


RARE_NS: Final[Ns] = 5 * NS_PER_S
"""A topic is rare if its mean spacing is at least this."""
_JITTER_NS: Final[Ns] = 50 * NS_PER_MS
"""The mean spacing may be shorter by this: publishers and transports are not exact."""
_FEW_MESSAGES: Final = 5
"""Fewer messages have no usual spacing: a map may be published twice when its node starts."""


_LOGS: Final = FOXGLOVE_LOGS | {
    "rcl_interfaces/msg/Log",
    "rcl_interfaces/Log",
    "mavros_msgs/msg/StatusText",
    "nav2_msgs/msg/BehaviorTreeLog",
}
_FEWEST: Final = 3
"""A bag with fewer messages of a topic shows no period."""
_PER_OCTAVE: Final = 2
_OCTAVES: Final = 64 * _PER_OCTAVE
"""Periods (64 bits) are sorted into this many bins, two for each octave."""
_NO_MESSAGES: Final = (0, MAX_NS, MIN_NS)
"""Count, first and last log time of a topic in a bag without a message of it."""


class TopicExtent(NamedTuple):
    """A bag, and the log times (inclusive) of the first and last message of a topic in it.

    If the topic has two types in a bag, the bag has two extents.
    """

    bag: BagFile
    first: Ns
    last: Ns


class TopicColumn(NamedTuple):
    """What the bags of a segment hold of one topic: a row for each bag and type, in bag order.

    `bags` are positions in the segment; times are inclusive.
    """

    bags: NDArray[np.intp]
    firsts: Ints
    lasts: Ints
    messages: Ints


class TopicTotals(NamedTuple):
    """First and last log time (inclusive) of a topic's messages, and their number."""

    first: Ns
    last: Ns
    messages: int

    def __or__(self, other: TopicTotals) -> TopicTotals:
        """Returns the totals of both."""
        return TopicTotals(
            min(self.first, other.first), max(self.last, other.last), self.messages + other.messages
        )

    @property
    def is_rare(self) -> bool:
        """Whether a message comes every `RARE_NS` or less often, from the first to the last."""
        return self.last - self.first >= (self.messages - 1) * (RARE_NS - _JITTER_NS)


NO_TOTALS: Final = TopicTotals(MAX_NS, MIN_NS, 0)
"""The totals of no message."""


class Pace(NamedTuple):
    """What a recording holds of a topic.

    Attributes:
        topic: the totals of the topic.
        begin: log time of the first message in the recording.
        end: log time of the last one (inclusive).
    """

    topic: TopicTotals
    begin: Ns
    end: Ns

    def __or__(self, other: Pace) -> Pace:
        """Returns the pace in two recordings that are of one run."""
        topic = self.topic | other.topic
        return Pace(topic, min(self.begin, other.begin), max(self.end, other.end))

    @property
    def is_rare(self) -> bool:
        """Whether the topic has a message every `RARE_NS` or less often, as a map has.

        Measured between the first and the last message, so that telemetry which fell silent stays
        frequent. A few messages are also rare if the recording went on for long enough.
        """
        if self.topic.is_rare:
            return True
        messages, span = self.topic.messages, self.topic.last - self.topic.first
        length = self.end - self.begin
        return (
            messages < _FEW_MESSAGES
            and length >= messages * RARE_NS
            and length - span >= 2 * RARE_NS
        )


class TopicTimes(NamedTuple):
    """How often bags hold a topic, and in which spans; see `analysis.silences`."""

    pacing: Pacing
    runs: tuple[Span, ...]


class Tally(NamedTuple):
    """A number of bags, and the number of their messages."""

    bags: int = 0
    messages: int = 0


def in_time(bag: BagFile) -> tuple[Ns, Ns, str]:
    """Returns the sort key of bags: first and last log time; the path breaks ties."""
    return bag.start, bag.end, bag.file


class Segment:
    """Consecutive bags of a timeline, at least one."""

    def __init__(self, bags: Iterable[BagFile] | BagRows) -> None:
        self.bags = bags if isinstance(bags, BagRows) else BagRows(bags)
        self.first = in_time(self.bags[0])

    @cached_property
    def latest(self) -> Ns:
        """Log time of the last message in any of the bags."""
        return int(self.bags.ends.max())

    @cached_property
    def newest(self) -> BagFile:
        """The bag that ends last."""
        return self.bags[int(self.bags.ends.argmax())]

    def overlapping(self, window: TimeWindow) -> Iterator[BagFile]:
        """Yields the bags whose span overlaps a window, in order."""
        return self.bags.at(window.overlapping(self.bags.starts, self.bags.ends))

    @cached_property
    def recorded(self) -> Segment | None:
        """The segment without the bag of carried messages; None if no other bag is left."""
        return self._without_folder(CARRY_FOLDER, is_carried)

    @cached_property
    def unthinned(self) -> Segment | None:
        """The segment without thinned days; None if no other bag is left."""
        return self._without_folder(MEMORY_FOLDER, is_thinned)

    def _without_folder(self, name: str, is_inside: Callable[[str], bool]) -> Segment | None:
        """Returns the segment without the bags inside a folder."""
        # Few segments have such a folder: most need not look at the path of each bag.
        if not any(f"/{folder}".endswith(f"/{name}") for folder in self.bags.folders):
            return self
        return self.without(map(is_inside, self.bags.files()))

    def without(self, are_left_out: Iterable[bool]) -> Segment | None:
        """Returns the segment without some bags; None if no bag is left."""
        rest = self.bags.select(~np.fromiter(are_left_out, np.bool_, len(self.bags)))
        if rest is self.bags:
            return self  # with all that it has computed
        return None if rest is None else Segment(rest)

    @cached_property
    def disk_use(self) -> tuple[int, int]:
        """The size of the bags in bytes, and how many of them a crash left open."""
        left_open = self.bags.in_state(BagState.INCOMPLETE)
        return int(self.bags.sizes.sum()), int(left_open.sum())

    @cached_property
    def folder_totals(self) -> dict[str, TopicTotals]:
        """By folder, the totals of all topics in its bags."""
        return dict(zip(self.bags.folders, _joined(self._by_folder), strict=True))

    @property
    def tallies(self) -> dict[str, Tally]:
        """By folder, the number of its bags and of their messages."""
        bags = np.bincount(self.bags.folder_of).tolist()
        totals = self.folder_totals.items()
        return {
            folder: Tally(count, of_folder.messages)
            for count, (folder, of_folder) in zip(bags, totals, strict=True)
        }

    @cached_property
    def handed_over(self) -> frozenset[str]:
        """The folders with a `handover.json`."""
        _, _, sidecars = self.bags.contents.T
        folders = np.unique(self.bags.folder_of[sidecars != 0]).tolist()
        return frozenset(map(self.bags.folders.__getitem__, folders))

    @cached_property
    def faulty(self) -> tuple[BagFile, ...]:
        """The bags that cannot be read whole, or that contradict themselves."""
        bags = self.bags
        has_remarks = bags.with_schema(attrgetter("remarks"))
        return tuple(bags.at(has_remarks | bags.in_state(BagState.INCOMPLETE)))

    @cached_property
    def set_back(self) -> tuple[StepBack, ...]:
        """Where the clock was set back within a bag."""
        steps: list[StepBack] = []
        for bag in self._bags_with("clock_set_back"):
            set_back = bag.summary.schema.clock_set_back
            if set_back is not None:
                by, _ = set_back
                steps.append(StepBack(bag, bag, by))
        return tuple(steps)

    @cached_property
    def set_ahead(self) -> tuple[tuple[BagFile, Span], ...]:
        """The bags that pause for so long that the clock was set meanwhile; the last such pause."""
        last = {
            pause.bags[0].file: (pause.bags[0], pause.span)
            for pause in self.pauses_within
            if pause.ran_on and pause.length >= FAR_AHEAD_NS
        }
        return tuple(last.values())

    @cached_property
    def schemas(self) -> tuple[SummarySchema, ...]:
        """The different schemas of the summaries; mostly one."""
        return tuple({id(alike.schema): alike.schema for alike in self.bags.summaries}.values())

    @cached_property
    def headers(self) -> tuple[TopicHeader, ...]:
        """All topics; one with two types, or one that is latched at times, appears twice."""
        return tuple(dict.fromkeys(chain.from_iterable(schema.topics for schema in self.schemas)))

    @cached_property
    def positions(self) -> dict[str, tuple[int, ...]]:
        """The positions of each topic among `headers`; see `positions_of`."""
        return positions_of(self.headers)

    def _bags_with(self, attribute: str) -> Iterator[BagFile]:
        """Yields the bags whose schema has a non-empty attribute: mostly none."""
        return self.bags.at(self.bags.with_schema(attrgetter(attribute)))

    @cached_property
    def totals(self) -> dict[str, dict[str, TopicTotals]]:
        """By topic and type, the totals of all bags."""
        totals: dict[str, dict[str, TopicTotals]] = {}
        numbers = _sum_groups(self._by_folder, [0], axis=1)[:, 0].tolist()
        for header, (messages, first, last) in zip(self.headers, numbers, strict=True):
            by_type = totals.setdefault(header.topic, {})
            known = by_type.get(header.type, NO_TOTALS)
            by_type[header.type] = known | TopicTotals(first, last, messages)
        return totals

    @cached_property
    def spans(self) -> dict[str, Span]:
        """By topic, the log times of its first and last message (inclusive)."""
        return {
            topic: enclosing((totals.first, totals.last) for totals in by_type.values())
            for topic, by_type in self.totals.items()
        }

    def recordings(self, topic: str) -> dict[Path, TopicTotals]:
        """Returns the totals of a topic for each recording that holds it, over all types."""
        headers = self.positions.get(topic)
        if headers is None:
            return {}
        by_folder = zip(self._recording_paths, _joined(self._by_folder[[*headers]]), strict=True)
        return {path: totals for path, totals in by_folder if totals.messages}

    @cached_property
    def _by_folder(self) -> Ints:
        """Count, first and last log time of each header in each folder."""
        folders = self.bags.folder_of[self._order]
        order = np.argsort(folders, kind="stable")
        begins = np.searchsorted(folders[order], np.arange(len(self.bags.folders)))
        return _sum_groups(self._numbers(self.headers)[:, order], begins, axis=1)

    @cached_property
    def _recording_paths(self) -> list[Path]:
        """The recordings, in the order of their folders."""
        # Made once: paths for all bags of a week would take longer than all else.
        return [Path(folder or "/") for folder in self.bags.folders]

    def extents(
        self, topic: str, window: TimeWindow, among: Flags | None = None
    ) -> Iterator[TopicExtent]:
        """Yields the bags that hold the topic in a window, in order, once for each type.

        Only bags marked in `among` count, if that is given.
        """
        column = self.column(topic)
        if column is None:
            return
        is_inside = window.overlapping(column.firsts, column.lasts)
        if among is not None:
            is_inside &= among[column.bags]
        rows, firsts, lasts, _ = (values[is_inside] for values in column)
        yield from map(TopicExtent, self.bags.at(rows), firsts.tolist(), lasts.tolist())

    def column(self, topic: str) -> TopicColumn | None:
        """Returns what the bags hold of a topic; None if they do not have it."""
        headers = [self.headers[nth] for nth in self.positions.get(topic, ())]
        if not headers:
            return None
        numbers = self._numbers(headers)[:, self._places]
        bags, types = np.nonzero(numbers[:, :, 0].T)
        counts, firsts, lasts = numbers[types, bags].T
        return TopicColumn(bags, firsts, lasts, counts)

    def _numbers(self, headers: Sequence[TopicHeader]) -> Ints:
        """Returns count, first and last log time of each header in each bag.

        The bags are in the order of `_order`. A bag without the topic has `_NO_MESSAGES`.
        """
        # In memory all counts lie together, and all times: so they are added up quickly.
        numbers = np.empty((3, len(headers), len(self.bags)), np.int64).transpose(1, 2, 0)
        end = 0
        # Many schemas differ in their pauses alone, and share their topics.
        found: dict[int, tuple[list[int], list[int]]] = {}
        for schema, bags, joined in self.bags.summaries:
            begin, end = end, end + bags.size
            if id(schema.topics) not in found:
                found[id(schema.topics)] = _find_headers(headers, schema)
            rows, positions = found[id(schema.topics)]
            if len(rows) < len(headers):
                numbers[:, begin:end] = _NO_MESSAGES
            numbers[rows, begin:end] = numbers_of(schema, joined, bags.size, positions)
        return numbers

    @cached_property
    def _order(self) -> NDArray[np.uint16]:
        """The positions of the bags in the order of `_numbers`."""
        return np.concatenate([alike.rows for alike in self.bags.summaries])

    @cached_property
    def _places(self) -> Ints:
        """Where each bag is in the order of `_numbers`."""
        return np.argsort(self._order)

    @cached_property
    def _topics(self) -> list[str]:
        """All topics, sorted."""
        return sorted({header.topic for header in self.headers})

    @cached_property
    def topic_times(self) -> dict[str, TopicTimes]:
        """By topic, how often and when the bags hold it."""
        # Both at once: the numbers of all parts take too much memory to be kept.
        numbers, lengths = self._parts_between_absences()
        counts = numbers[:, :, 0]
        spacings = _spacings(counts, numbers[:, :, 2] - numbers[:, :, 1])
        rows = zip(spacings, counts.sum(axis=1).tolist(), lengths.tolist(), strict=True)
        topic_times = map(TopicTimes, starmap(Pacing, rows), _runs(numbers))
        return dict(zip(self._topics, topic_times, strict=True))

    def _parts_between_absences(self) -> tuple[Ints, Ints]:
        """Cuts bags at the absences that their summaries state.

        Returns count, first and last log time of each topic (sorted) in each part of a bag: the
        first part of every bag, then all later parts. And for each topic the length (ns) of the
        bags that hold it, without its absences.
        """
        numbers = self._numbers_by_topic()
        lengths = (numbers[:, :, 0] > 0) @ (self.bags.ends - self.bags.starts)[self._order]
        row_of = {topic: row for row, topic in enumerate(self._topics)}
        later_parts: list[tuple[int, tuple[int, Ns, Ns]]] = []
        has_absences = self.bags.with_schema(attrgetter("absences"))[self._order]
        for column in np.flatnonzero(has_absences).tolist():
            bag = self.bags[int(self._order[column])]
            for topic, absences in bag.summary.schema.absences:
                row = row_of[topic]
                first_part, *others = _cut_at(absences, *numbers[row, column].tolist())
                numbers[row, column] = first_part
                later_parts += [(row, part) for part in others]
                lengths[row] -= sum(end - start for start, end, _ in absences)
        if not later_parts:
            return numbers, lengths
        more = np.empty((len(row_of), len(later_parts), 3), np.int64)
        more[:] = _NO_MESSAGES
        for column, (row, part) in enumerate(later_parts):
            more[row, column] = part
        return np.concatenate((numbers, more), axis=1), lengths

    def _numbers_by_topic(self) -> Ints:
        """Returns count, first and last log time of each topic (sorted) in each bag.

        The bags are in the order of `_order`.
        """
        headers = sorted(self.headers, key=attrgetter("topic"))
        numbers = self._numbers(headers)
        if len(headers) == len(self._topics):
            return numbers
        names = [header.topic for header in headers]
        return _sum_groups(numbers, [*map(names.index, self._topics)], axis=0)

    @cached_property
    def together(self) -> frozenset[frozenset[str]]:
        """The sets of topics that some bag holds together."""
        return frozenset(frozenset(schema.positions) for schema in self.schemas)

    @cached_property
    def pauses(self) -> tuple[Pause, ...]:
        """The pauses between the bags."""
        return tuple(pauses_between(self.bags))

    @cached_property
    def pauses_within(self) -> tuple[Pause, ...]:
        """The pauses within each bag. Other bags may have messages meanwhile."""
        return tuple(
            Pause(start, end, (bag,), ran_on=not is_thinned(bag.file))
            for bag in self._bags_with("pauses")
            for start, end in bag.summary.schema.pauses
        )

    @cached_property
    def covered(self) -> Spans:
        """When some bag may have messages: from its first one to its last, but for its pauses."""
        is_whole = ~self.bags.with_schema(attrgetter("pauses"))
        spans = spans_of(self.bags.starts[is_whole], self.bags.ends[is_whole])
        for bag in self._bags_with("pauses"):
            spans += without([(bag.start, bag.end)], bag.summary.schema.pauses)
        return united(spans)

    @cached_property
    def silent(self) -> frozenset[str]:
        """The topics that some bag declares without a message."""
        return frozenset(chain.from_iterable(schema.silent for schema in self.schemas))


def is_log(type_name: str) -> bool:
    """Returns whether messages of a type are lines of a log."""
    return type_name in _LOGS


def wider(span: Span | None, other: Span) -> Span:
    """Returns the span from the earlier start to the later end; `other` if the first is None."""
    if span is None:
        return other
    (first, last), (other_first, other_last) = span, other
    return min(first, other_first), max(last, other_last)


def _find_headers(
    headers: Sequence[TopicHeader], schema: SummarySchema
) -> tuple[list[int], list[int]]:
    """Returns the rows of the headers that a schema has, and their positions among its topics."""
    rows, positions = list[int](), list[int]()
    for row, header in enumerate(headers):
        for position in schema.positions.get(header.topic, ()):
            if schema.topics[position] == header:
                rows.append(row)
                positions.append(position)
    return rows, positions


def _cut_at(
    absences: Iterable[tuple[Ns, Ns, int]], count: int, first: Ns, last: Ns
) -> list[tuple[int, Ns, Ns]]:
    """Returns count, first and last log time of each part of a topic in a bag, in order.

    Args:
        absences: when the topic was absent, and how many messages came before.
        count: of all messages of the topic in the bag.
        first: their first log time.
        last: their last log time.
    """
    parts: list[tuple[int, Ns, Ns]] = []
    sent = 0
    for start, end, count_before in absences:
        parts.append((count_before - sent, first, start))
        sent, first = count_before, end
    return [*parts, (count - sent, first, last)]


def _sum_groups(numbers: Ints, begins: Sequence[int] | NDArray[np.intp], axis: int) -> Ints:
    """Adds up counts, first and last log times along an axis, in groups that begin at `begins`."""
    counts, firsts, lasts = numbers.transpose(2, 0, 1)
    return np.stack(
        [
            np.add.reduceat(counts, begins, axis),
            np.minimum.reduceat(firsts, begins, axis),
            np.maximum.reduceat(lasts, begins, axis),
        ],
        axis=2,
    )


def _joined(by_folder: Ints) -> list[TopicTotals]:
    """Returns the totals of all headers in each folder; see `Segment._by_folder`."""
    [rows] = _sum_groups(by_folder, [0], axis=0).tolist()
    return [TopicTotals(first, last, messages) for messages, first, last in rows]


def _runs(numbers: Ints) -> Iterator[tuple[Span, ...]]:
    """Yields for each topic the spans in which it has messages; see `analysis.silences`.

    `numbers` has count, first and last log time by topic and part of a bag.
    """
    _, firsts, lasts = numbers.transpose(2, 0, 1)
    order = np.argsort(firsts, axis=1, kind="stable")
    begins = np.take_along_axis(firsts, order, axis=1)
    reach = np.maximum.accumulate(np.take_along_axis(lasts, order, axis=1), axis=1)
    is_break = (begins[:, 1:] - SHORTEST_NS > reach[:, :-1]) & (begins[:, 1:] < MAX_NS)
    for nth, breaks in enumerate(is_break):
        edges = np.flatnonzero(breaks)
        starts = begins[nth, [0, *(edges + 1)]].tolist()
        yield tuple(zip(starts, reach[nth, [*edges, -1]].tolist(), strict=True))


def _spacings(counts: Ints, spans: Ints) -> list[dict[int, Spacing]]:
    """Returns for each topic its spacings, by the bin of the period (half an octave).

    `counts` and `spans` (ns) are by topic and part of a bag.
    """
    topics, parts = np.nonzero((counts >= _FEWEST) & (spans > 0))
    spans, intervals = spans[topics, parts], counts[topics, parts] - 1
    octaves = np.maximum(np.log2(spans / intervals) * _PER_OCTAVE, 0).astype(np.int64)
    keys = topics * _OCTAVES + octaves
    sums = np.zeros((3, len(counts) * _OCTAVES), np.int64)
    # Mostly the next part has the same key: adding runs first is quicker.
    begins = run_starts(keys)
    for total, values in zip(sums, (np.ones_like(spans), spans, intervals), strict=True):
        np.add.at(total, keys[begins], np.add.reduceat(values, begins))
    spacings: list[dict[int, Spacing]] = [{} for _ in counts]
    used = np.flatnonzero(sums[0])
    for key, spacing in zip(used.tolist(), sums[:, used].T.tolist(), strict=True):
        topic, octave = divmod(key, _OCTAVES)
        spacings[topic][octave] = Spacing(*spacing)
    return spacings

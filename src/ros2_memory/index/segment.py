"""Some consecutive bags of a timeline, and what follows from their summaries.

Everything is computed when it is first asked for, and serves for as long as the bags stay together.
A query looks at few topics of many bags, so the numbers of their summaries are joined.
"""

from __future__ import annotations

from functools import cached_property, reduce
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.silences import SHORTEST_NS, Pacing, Spacing
from ros2_memory.bag_dir.layout import CARRY_FOLDER, MEMORY_FOLDER, is_carried, is_thinned
from ros2_memory.core.bag_summary import SummarySchema, TopicHeader, numbers_of
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_MS, NS_PER_S, Ns, Span
from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.holes import Pause, pauses_between
from ros2_memory.index.split_order import StepBack
from ros2_memory.messages.levels import FOXGLOVE_LOGS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Flags, Ints


RARE_NS: Final[Ns] = 5 * NS_PER_S
"""A topic with a message this often, or less often, is rare."""
_JITTER_NS: Final[Ns] = 50 * NS_PER_MS
"""The mean spacing may be shorter by this: publishers and transports are not exact."""
_FEW_MESSAGES: Final = 5
"""Fewer have no usual spacing: a map may be published twice when its node starts."""


_LOGS: Final = FOXGLOVE_LOGS | {"rcl_interfaces/msg/Log", "rcl_interfaces/Log"}
_FEWEST: Final = 3
"""A bag with fewer messages of a topic shows no period."""
_PER_OCTAVE: Final = 2
_OCTAVES: Final = 64 * _PER_OCTAVE
"""A period of 64 bits is in one of so many parts of octaves."""
_NONE: Final = (0, MAX_NS, MIN_NS)
"""Count, first and last log time of a topic of which a bag has no message."""


class TopicExtent(NamedTuple):
    """A bag, and the log times (inclusive) of the first and last message of a topic in it.

    A bag in which the topic has two types has two extents.
    """

    bag: BagFile
    first: Ns
    last: Ns


class TopicColumn(NamedTuple):
    """What the bags of a segment hold of one topic, in bag order, a row for each of its types.

    `bags` are positions in the segment; times are inclusive.
    """

    bags: NDArray[np.intp]
    firsts: Ints
    lasts: Ints
    messages: Ints


class TopicTotals(NamedTuple):
    """What summaries add up to for one topic under one type; times are inclusive."""

    first: Ns
    last: Ns
    messages: int

    def __or__(self, other: TopicTotals) -> TopicTotals:
        """Returns the totals of both."""
        return TopicTotals(
            min(self.first, other.first), max(self.last, other.last), self.messages + other.messages
        )


class Pace(NamedTuple):
    """What a recording holds of a topic, and the times (inclusive) between which it has bags."""

    topic: TopicTotals
    begin: Ns
    end: Ns

    @property
    def is_rare(self) -> bool:
        """Whether the topic has a message every `RARE_NS` or less often, as a map has.

        That is the spacing between its first and last message, so that telemetry which fell silent
        stays frequent. Few messages are rare if the recording went on for long enough.
        """
        messages, span = self.topic.messages, self.topic.last - self.topic.first
        if span >= (messages - 1) * (RARE_NS - _JITTER_NS):
            return True
        length = self.end - self.begin
        return (
            messages < _FEW_MESSAGES
            and length >= messages * RARE_NS
            and length - span >= 2 * RARE_NS
        )


class Tally(NamedTuple):
    """How many bags, and how many messages they hold."""

    bags: int = 0
    messages: int = 0


def in_time(bag: BagFile) -> tuple[Ns, Ns, str]:
    """Returns the sort key of bags: the times inside them; the path only breaks ties."""
    return bag.start, bag.end, bag.file


class Segment:
    """Some consecutive bags of a timeline; never without any."""

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
        return self.bags.at((self.bags.starts < window.stop) & (self.bags.ends >= window.start))

    @cached_property
    def recorded(self) -> Segment | None:
        """The bags without that of carried messages: mostly itself; None where no other is left."""
        return self._without(is_carried, CARRY_FOLDER)

    @cached_property
    def unthinned(self) -> Segment | None:
        """The bags that have every message that was recorded; itself where all do."""
        return self._without(is_thinned, MEMORY_FOLDER)

    def _without(self, is_left_out: Callable[[str], bool], name: str) -> Segment | None:
        """Returns the bags but for some that lie in a folder of a name, if they are there."""
        if not any(f"/{folder}".endswith(f"/{name}") for folder in self.bags.folders):
            return self
        return self.without(map(is_left_out, self.bags.files()))

    def without(self, are_left_out: Iterable[bool]) -> Segment | None:
        """Returns the bags but for some: itself where that are all; None where none is left."""
        rest = self.bags.some(~np.fromiter(are_left_out, np.bool_, len(self.bags)))
        if rest is self.bags:
            return self  # what it remembers serves the next timeline
        return None if rest is None else Segment(rest)

    @cached_property
    def disk_use(self) -> tuple[int, int]:
        """The bytes of the bags, and how many of them a crash left open."""
        left_open = self.bags.are(BagState.INCOMPLETE)
        return int(self.bags.sizes.sum()), int(left_open.sum())

    @cached_property
    def folder_spans(self) -> dict[str, Span]:
        """By folder, the log times of the first and last message (inclusive) of its bags."""
        _, firsts, lasts = _added(self._by_folder, [0], axis=0)[0].T.tolist()
        return dict(zip(self.bags.folders, zip(firsts, lasts, strict=True), strict=True))

    @cached_property
    def tallies(self) -> dict[str, Tally]:
        """By folder, the tally of the bags in it."""
        messages = self._by_folder[:, :, 0].sum(axis=0)
        rows = zip(np.bincount(self.bags.folder_of).tolist(), messages.tolist(), strict=True)
        return {folder: Tally(*row) for folder, row in zip(self.bags.folders, rows, strict=True)}

    @cached_property
    def handed_over(self) -> frozenset[str]:
        """The folders with a `handover.json`."""
        _, _, sidecars = self.bags.contents.T
        folders = np.unique(self.bags.folder_of[sidecars != 0]).tolist()
        return frozenset(map(self.bags.folders.__getitem__, folders))

    @cached_property
    def faulty(self) -> tuple[BagFile, ...]:
        """The bags that are not readable as a whole, or that contradict themselves."""
        bags = self.bags
        has_remarks = bags.with_schema(attrgetter("remarks"))
        return tuple(bags.at(has_remarks | bags.are(BagState.INCOMPLETE)))

    @cached_property
    def set_back(self) -> tuple[StepBack, ...]:
        """Where the clock was set back within a bag."""
        return tuple(
            StepBack(bag, bag, back[0])
            for bag in self._bags_with("clock_set_back")
            if (back := bag.summary.schema.clock_set_back) is not None
        )

    @cached_property
    def schemas(self) -> tuple[SummarySchema, ...]:
        """The different schemas of the summaries; mostly one."""
        return tuple({id(alike.schema): alike.schema for alike in self.bags.summaries}.values())

    @cached_property
    def _headers(self) -> tuple[TopicHeader, ...]:
        """All topics, each type of one by itself."""
        return tuple(dict.fromkeys(chain.from_iterable(schema.topics for schema in self.schemas)))

    def _bags_with(self, name: str) -> Iterator[BagFile]:
        """Yields the bags of whose schemas an attribute is not empty: mostly none."""
        return self.bags.at(self.bags.with_schema(attrgetter(name)))

    @cached_property
    def totals(self) -> dict[str, dict[str, TopicTotals]]:
        """By topic and type, the totals of the bags."""
        totals: dict[str, dict[str, TopicTotals]] = {}
        of_headers = _added(self._by_folder, [0], axis=1)[:, 0].tolist()
        for (topic, type_name, *_), (messages, first, last) in zip(
            self._headers, of_headers, strict=True
        ):
            add_totals(totals.setdefault(topic, {}), type_name, (first, last, messages))
        return totals

    @cached_property
    def spans(self) -> dict[str, Span]:
        """By topic, the log times of its first and last message (inclusive)."""
        return {
            topic: reduce(TopicTotals.__or__, by_type.values())[:2]
            for topic, by_type in self.totals.items()
        }

    def recordings(self, topic: str) -> dict[Path, TopicTotals]:
        """Returns what the bags of each recording that holds the topic have of it, of any type."""
        headers = [nth for nth, header in enumerate(self._headers) if header.topic == topic]
        if not headers:
            return {}
        [of_topic] = _added(self._by_folder[headers], [0], axis=0).tolist()
        return {
            path: TopicTotals(first, last, messages)
            for path, (messages, first, last) in zip(self._recording_paths, of_topic, strict=True)
            if messages
        }

    @cached_property
    def _by_folder(self) -> Ints:
        """Count, first and last by topic of one type, and folder."""
        numbers = self.bags.folder_of[self._order]
        order = np.argsort(numbers, kind="stable")
        begins = np.searchsorted(numbers[order], np.arange(len(self.bags.folders)))
        return _added(self._numbers(self._headers)[:, order], begins, axis=1)

    @cached_property
    def _recording_paths(self) -> list[Path]:
        """The recordings of the bags, in the order of their folders."""
        # A path for each bag of a week would take longer than all else.
        return [Path(folder or "/") for folder in self.bags.folders]

    def extents(
        self, topic: str, window: TimeWindow, among: Flags | None = None
    ) -> Iterator[TopicExtent]:
        """Yields the bags that hold the topic in a window, in order, once for each type.

        Of all bags, or `among` some of them.
        """
        column = self.column(topic)
        if column is None:
            return
        is_inside = (column.firsts < window.stop) & (column.lasts >= window.start)
        if among is not None:
            is_inside &= among[column.bags]
        rows, firsts, lasts, _ = (values[is_inside] for values in column)
        yield from map(TopicExtent, self.bags.at(rows), firsts.tolist(), lasts.tolist())

    def column(self, topic: str) -> TopicColumn | None:
        """Returns what the bags hold of a topic; None where nothing."""
        headers = [header for header in self._headers if header.topic == topic]
        if not headers:
            return None
        numbers = self._numbers(headers)[:, np.argsort(self._order)]
        bags, types = np.nonzero(numbers[:, :, 0].T)
        counts, firsts, lasts = numbers[types, bags].T
        return TopicColumn(bags, firsts, lasts, counts)

    def _numbers(self, headers: Sequence[TopicHeader]) -> Ints:
        """Returns count, first and last by topic of one type, and bag; `_NONE` without messages.

        The bags are in the order of `_order`.
        """
        # Counts beside counts, and times beside times: so they are added up at once.
        numbers = np.empty((3, len(headers), len(self.bags)), np.int64).transpose(1, 2, 0)
        end = 0
        for schema, bags, joined in self.bags.summaries:
            begin, end = end, end + bags.size
            at = {header: position for position, header in enumerate(schema.topics)}
            rows = [row for row, header in enumerate(headers) if header in at]
            if len(rows) < len(headers):
                numbers[:, begin:end] = _NONE
            positions = [at[headers[row]] for row in rows]
            numbers[rows, begin:end] = numbers_of(schema, joined, bags.size, positions)
        return numbers

    @cached_property
    def _order(self) -> NDArray[np.uint16]:
        """The positions of the bags as `_numbers` has them."""
        return np.concatenate([alike.rows for alike in self.bags.summaries])

    @cached_property
    def types(self) -> dict[str, frozenset[str]]:
        """By topic, the types of its messages."""
        types: dict[str, set[str]] = {}
        for schema in self.schemas:
            for header in schema.topics:
                types.setdefault(header.topic, set()).add(header.type)
        return {topic: frozenset(names) for topic, names in types.items()}

    @cached_property
    def transient_local(self) -> frozenset[str]:
        """The topics that some publisher offered as transient local."""
        return frozenset(
            header.topic for schema in self.schemas for header in schema.topics if header.latched
        )

    @cached_property
    def pacings(self) -> dict[str, Pacing]:
        """By topic, how often the bags hold it."""
        numbers, lengths = self._between_absences()
        counts = numbers[:, :, 0]
        spacings = _spacings(counts, numbers[:, :, 2] - numbers[:, :, 1])
        rows = zip(spacings, counts.sum(axis=1).tolist(), lengths.tolist(), strict=True)
        return {topic: Pacing(*row) for topic, row in zip(sorted(self.types), rows, strict=True)}

    @cached_property
    def runs(self) -> dict[str, tuple[Span, ...]]:
        """By topic, when the bags hold it; see `analysis.silences`."""
        numbers, _ = self._between_absences()
        return dict(zip(sorted(self.types), _runs(numbers), strict=True))

    def _between_absences(self) -> tuple[Ints, Ints]:
        """Returns count, first and last by topic (sorted) and bag, and the length of the bags.

        In all (ns), of the bags that hold each topic. Between absences a bag is as many: what
        follows each comes behind all bags. A count is 0 where a bag holds none.
        """
        headers, topics = sorted(self._headers, key=attrgetter("topic")), sorted(self.types)
        numbers = self._numbers(headers)
        if len(headers) > len(topics):
            names = [header.topic for header in headers]
            numbers = _added(numbers, [*map(names.index, topics)], axis=0)
        lengths = (numbers[:, :, 0] > 0) @ (self.bags.ends - self.bags.starts)[self._order]
        parts: list[tuple[int, tuple[int, Ns, Ns]]] = []
        has_absences = self.bags.with_schema(attrgetter("absences"))[self._order]
        for row in np.flatnonzero(has_absences).tolist():
            for topic, pauses in self.bags[int(self._order[row])].summary.schema.absences:
                nth = topics.index(topic)
                count, _, last = numbers[nth, row].tolist()
                for start, end, sent in reversed(pauses):
                    parts.append((nth, (count - sent, end, last)))
                    count, last = sent, start
                    lengths[nth] -= end - start
                numbers[nth, row, [0, 2]] = count, last
        if parts:
            more = np.empty((len(topics), len(parts), 3), np.int64)
            more[:] = _NONE
            for at, (nth, part) in enumerate(parts):
                more[nth, at] = part
            numbers = np.concatenate((numbers, more), axis=1)
        return numbers, lengths

    @cached_property
    def together(self) -> frozenset[frozenset[str]]:
        """Which topics the bags hold together, each combination once."""
        return frozenset(frozenset(schema.positions) for schema in self.schemas)

    @cached_property
    def pauses(self) -> tuple[Pause, ...]:
        """The pauses between the bags."""
        return tuple(pauses_between(self.bags))

    @cached_property
    def pauses_within(self) -> tuple[Pause, ...]:
        """The pauses of each bag; other bags may have messages in them."""
        return tuple(
            Pause(start, end, (bag,), ran_on=not is_thinned(bag.file))
            for bag in self._bags_with("pauses")
            for start, end in bag.summary.schema.pauses
        )

    @cached_property
    def silent(self) -> frozenset[str]:
        """The topics that some bag declares without a message."""
        return frozenset(chain.from_iterable(schema.silent for schema in self.schemas))


def is_log(type_name: str) -> bool:
    """Returns whether messages of a type are lines of a log."""
    return type_name in _LOGS


def wider(span: Span | None, other: Span) -> Span:
    """Returns the span that holds both; the other where there is only that."""
    if span is None:
        return other
    (first, last), (other_first, other_last) = span, other
    return min(first, other_first), max(last, other_last)


def add_totals(totals: dict[str, TopicTotals], type_name: str, more: tuple[Ns, Ns, int]) -> None:
    """Adds first and last log time and count of a type to its totals."""
    before, added = totals.get(type_name), TopicTotals(*more)
    totals[type_name] = added if before is None else before | added


def _added(numbers: Ints, begins: Sequence[int] | NDArray[np.intp], axis: int) -> Ints:
    """Returns count, first and last of some rows together, each from one of `begins` on."""
    added = (np.add, np.minimum, np.maximum)
    return np.stack(
        [add.reduceat(numbers[:, :, nth], begins, axis) for nth, add in enumerate(added)], axis=2
    )


def _runs(numbers: Ints) -> Iterator[tuple[Span, ...]]:
    """Yields the runs of each topic, by count, first and last; see `analysis.silences`."""
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
    """Returns the spacings of each topic, by the part of an octave of the period."""
    topics, bags = np.nonzero((counts >= _FEWEST) & (spans > 0))
    spans, intervals = spans[topics, bags], counts[topics, bags] - 1
    octaves = np.maximum(np.log2(spans / intervals) * _PER_OCTAVE, 0).astype(np.int64)
    keys = topics * _OCTAVES + octaves
    sums = np.zeros((3, len(counts) * _OCTAVES), np.int64)
    # Mostly the next bag has the same key.
    begins = np.flatnonzero(np.diff(keys, prepend=-1))
    for added, values in zip(sums, (np.ones_like(spans), spans, intervals), strict=True):
        np.add.at(added, keys[begins], np.add.reduceat(values, begins))
    spacings: list[dict[int, Spacing]] = [{} for _ in counts]
    there = np.flatnonzero(sums[0])
    for key, spacing in zip(there.tolist(), sums[:, there].T.tolist(), strict=True):
        topic, octave = divmod(key, _OCTAVES)
        spacings[topic][octave] = Spacing(*spacing)
    return spacings

"""Scans a topic: stored parts, and the bags that are not stored, each message once.

A scan yields `Rows`: a table, and which of its rows count. Rows of different tables overlap in time
if recordings do. Queries open scans by `history.scan`. Parts come from the `Scanner`; their columns
are unpacked when they are first used.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.table import UNHASHED
from ros2_memory.columns.units import (
    BagUnit,
    GoneError,
    Identities,
    Rows,
    Unit,
    copies_among,
    repeated_among,
)
from ros2_memory.columns.writing import DELAY, PUBLISH_TIME
from ros2_memory.core.arrays import concatenated
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS, COPY_JITTER_NS, overlaps_any
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.index.segment import in_time
from ros2_memory.storage.base import REPEATED_NS, IntArray, Mask
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.coverage import Coverage
    from ros2_memory.columns.scanner import Scanner
    from ros2_memory.columns.store import PartHead
    from ros2_memory.columns.stored import PartZones
    from ros2_memory.columns.table import Table
    from ros2_memory.index.segment import TopicExtent
    from ros2_memory.index.timeline import Timeline

Decode: TypeAlias = "Callable[[BagFile, str, bool], Iterable[Table]]"
"""Decodes a topic of a bag, with hashes of payloads where the last argument is true."""

_SLICE_NS: Final = 600 * NS_PER_S
"""How much of overlapping recordings is compared at a time."""
STRETCH_NS: Final[Ns] = 4 * 3600 * NS_PER_S
"""Fragments of so much of the clock are joined once."""
_ATTEMPTS: Final = 5
"""How often a scan looks up what is stored, while that changes; then it reads the bags."""
_MOST_BYTES: Final = 64 << 20
"""Columns in memory at once; a bag with more has none, and its messages are read."""
_TOO_LARGE: Final = "its messages are too large to hold their columns"


class _Source(NamedTuple):
    """Where rows come from: a part, or a bag that is not stored.

    Attributes:
        first: the log time (ns) of the first row.
        last: the log time (ns) of the last row.
        part: the part, or None.
        bag: the bag, or None.
    """

    first: Ns
    last: Ns
    part: PartHead | None
    bag: BagFile | None = None

    @property
    def number(self) -> int | None:
        """The number of the part; None if it is a bag."""
        return None if self.part is None else self.part.number


class Stretch(NamedTuple):
    """A stretch of the clock in a scan. No rows that begin in it overlap those of another one.

    Attributes:
        window: the stretch.
        last: the latest log time (ns) of the parts that begin in it.
        parts: the numbers of the whole parts with all rows in it and beside it; None if bags or
            parts of a single bag have some, too, or the scan does not have all of them.
    """

    window: TimeWindow
    last: Ns
    parts: tuple[int, ...] | None

    def key(self, settings: str = "") -> FragmentKey | None:
        """Returns the key of fragments made of its rows; None if these rows may still change."""
        return None if self.parts is None else FragmentKey(self.window.start, settings, self.parts)


@dataclass(eq=False)
class Scan:
    """One scan of a topic: its sources, and which rows of them are copies.

    Attributes:
        scanner: has what is stored.
        topic: its name.
        window: of log time.
        timeline: the bags.
        decode: decodes a topic of a bag that is not stored.
        shared: half-open spans, in order, in which different recordings may have copies. The scan
            reduces them to those in which two sources may have the same messages.
        repeats_latched: whether recordings may have received a latched message again.
        may_match: returns which parts may have rows that are wanted, by their zones; the other
            parts are left out.
        may_not_match: whether the other parts are yielded all the same, marked as such.
        may_be_empty: whether rows are yielded before it is known that any of them counts.
        within: half-open spans, in order and apart; tables that overlap none of them are left out.
            None: all tables are wanted.
        stored: whether bags that are not stored are left out.
        check: called before each table with its first log time (with `newest_first` its last one);
            raises when the call's time is over.
    """

    scanner: Scanner
    topic: str
    window: TimeWindow
    timeline: Timeline
    decode: Decode
    shared: Sequence[Span] = ()
    repeats_latched: bool = False
    may_match: Callable[[PartZones], bool | Mask] | None = None
    may_not_match: bool = False
    may_be_empty: bool = False
    within: Sequence[Span] | None = None
    stored: bool = False
    check: Callable[[Ns], None] = lambda _: None

    def __post_init__(self) -> None:
        # A bag is compared with all beside it: a long one is used again and again.
        self._decoded = ByteLru[list[BagUnit]](_MOST_BYTES)
        # Rows that do not count, by the keys of their units: found when they are asked for.
        self._copies: dict[object, list[IntArray]] = defaultdict(list)
        self._compared: set[Ns] = set()
        self._latched_again: dict[object, IntArray] = {}
        self._latched_again_since = MAX_NS
        self.shared = _overlapping(self.shared, self.window)
        self._coverage, sources = self._read_sources(self._reach())
        self._sources = self._ordered(sources)
        self._firsts = np.array([source.first for source in self._sources], np.int64)
        self._lasts = np.array([source.last for source in self._sources], np.int64)
        self._latest = np.maximum.accumulate(self._lasts)
        if self.shared:
            self.shared = [span for span in self.shared if self._may_have_copies(span)]
        self._shared_stops = [stop for _, stop in self.shared]

    def _reach(self) -> TimeWindow:
        """Returns the window, widened by the times in which copies of its messages may lie."""
        if self.repeats_latched:
            return TimeWindow.everything()
        return self.window.widened(2 * COPY_HORIZON_NS) if self.shared else self.window

    def rows(
        self, *, newest_first: bool = False, among: TimeWindow | None = None
    ) -> Iterator[Rows]:
        """Yields the rows of the topic that count in the window.

        Args:
            newest_first: whether tables are in the order of their last log times, the newest
                first; else in the order of their first log times.
            among: if given, only tables that reach into this window are yielded.

        Raises:
            QueryTimeoutError: raised by `check`.
            GoneError: stored rows were deleted meanwhile.
        """
        sources, ruled_out = self._asked_sources(newest_first=newest_first, among=among)
        waiting: list[Rows] = []
        for nth, source in enumerate(sources):
            self.check(source.last if newest_first else source.first)
            for unit in self._units(source):
                may_match = source.number not in ruled_out
                waiting.append(Rows(unit, partial(self._counting_rows, unit), may_match))
            # A bag has a table for each type: one may be later than the next bag, the other not.
            waiting.sort(key=lambda rows: -rows.last if newest_first else rows.first)
            after = sources[nth + 1] if nth + 1 < len(sources) else None
            while waiting and _is_next(waiting[0], after, newest_first=newest_first):
                rows = waiting.pop(0)
                if self.may_be_empty or len(rows):
                    yield rows

    def _asked_sources(
        self, *, newest_first: bool, among: TimeWindow | None
    ) -> tuple[Sequence[_Source], set[int]]:
        """Returns the sources to read, in their order, and the parts that cannot match."""
        sources = self._sources if among is None else self._sources_in(among)
        if newest_first:
            sources = sorted(sources, key=lambda source: (source.last, source.first))[::-1]
        # Before the zones are read: a part outside of the window says nothing about what matches.
        sources = [s for s in sources if self.window.overlaps(s.first, s.last)]
        ruled_out: set[int] = set()
        if self.may_match is not None:
            heads = _heads(sources)
            wanted = self.scanner.matching(heads, self.may_match)
            ruled_out = {head.number for head, may in zip(heads, wanted, strict=True) if not may}
        if not self.may_not_match:
            sources = [source for source in sources if source.number not in ruled_out]
        if self.within is not None:
            sources = [s for s in sources if overlaps_any(self.within, s.first, s.last)]
        return sources, ruled_out

    def stretches(self, beside: Ns = 0) -> list[Stretch]:
        """Returns the stretches of the clock that make up the window, the newest first.

        Stretches of `STRETCH_NS` are settled: whole parts have all of their rows. What lies between
        them is not.

        Args:
            beside: how long (ns) before and after a settled stretch whole parts have all rows, too.
        """
        settled = self._settled_stretches(beside) if self._sources else []
        stretches: list[Stretch] = []
        stop = self.window.stop
        for stretch in settled:
            stretches += [*self._unsettled_stretch(stretch.window.stop, stop), stretch]
            stop = stretch.window.start
        return [*stretches, *self._unsettled_stretch(self.window.start, stop)]

    def _unsettled_stretch(self, start: Ns, stop: Ns) -> list[Stretch]:
        """Returns a stretch whose rows may change; none if it is empty."""
        if start >= stop:
            return []
        latest = self._latest[: np.searchsorted(self._firsts, stop)]
        last = max([stop - 1, *latest[-1:].tolist()])
        return [Stretch(TimeWindow(start, stop), last, None)]

    def whole_parts(self, window: TimeWindow) -> tuple[int, ...] | None:
        """Returns the whole parts with all rows in a window; None if there are other sources.

        If latched messages in the window may repeat earlier ones, the parts of these are included.
        """
        parts = self._whole_parts_in(window)
        late = [part for part in parts or () if self.repeats_latched and self._may_be_late(part)]
        if not late:
            return parts
        published = min(self._published[part][0] for part in late)
        if published < window.start - STRETCH_NS:
            return None
        since = min(int(published) - COPY_HORIZON_NS, window.start)
        return self._whole_parts_in(TimeWindow(since, window.stop))

    def _whole_parts_in(self, window: TimeWindow) -> tuple[int, ...] | None:
        """Returns the whole parts with all rows in a window; None if there are other sources."""
        if self._coverage is None:
            return None
        begin = int(np.searchsorted(self._latest, window.start))
        end = int(np.searchsorted(self._firsts, window.stop))
        if self._others_before[end] > self._others_before[begin]:
            return None
        reaching = begin + np.flatnonzero(self._lasts[begin:end] >= window.start)
        return tuple(self._numbers[reaching].tolist())

    def is_stored(self, window: TimeWindow) -> bool:
        """Returns whether parts have all rows in a window."""
        return all(source.part for source in self._sources_in(window))

    def recording_of(self, part: int) -> Path:
        """Returns the recording of a whole part of which all rows count."""
        assert self._coverage is not None  # noqa: S101 - there are no parts without one
        recording = self._coverage.recording(int(self._head_of[part].bags[0]))
        if recording is None:
            raise GoneError
        return recording

    @cached_property
    def _numbers(self) -> IntArray:
        return np.array([source.number or 0 for source in self._sources])

    @cached_property
    def _head_of(self) -> dict[int, PartHead]:
        return {head.number: head for head in _heads(self._sources)}

    @cached_property
    def _others_before(self) -> IntArray:
        """How many sources before each are not whole parts of which all rows count."""
        is_whole = np.array([bool(s.part and s.part.is_whole) for s in self._sources], np.bool_)
        bags = [head.bags for head in _heads(self._sources)]
        if self._coverage is not None and bags:
            all_count = self._coverage.counts(bags) == [*map(len, bags)]
            is_whole[self._numbers > 0] &= all_count
        is_whole &= self._lasts - self._firsts < STRETCH_NS
        return np.concatenate([[0], np.cumsum(~is_whole)])

    def _settled_stretches(self, beside: Ns) -> list[Stretch]:
        """Returns the stretches whose rows whole parts have; see `stretches`."""
        window, firsts = self.window, self._firsts
        starts = np.unique(firsts // STRETCH_NS)[::-1] * STRETCH_NS
        stops = starts + STRETCH_NS
        begin, end = np.searchsorted(firsts, starts), np.searchsorted(firsts, stops)
        # The first log time from a source on, and the last one of all sources before it.
        first_from, last_before = np.append(firsts, MAX_NS), np.append(MIN_NS, self._latest)
        # A source may reach over an edge if it overlaps none that begins behind it.
        is_apart = (last_before[begin] < first_from[begin]) & (last_before[end] < first_from[end])
        lasts = np.maximum(last_before[end], stops - 1)
        is_inside = (starts - beside >= window.start) & (lasts + beside < window.stop)
        is_over = starts <= self.timeline.latest - STRETCH_NS
        stretches = []
        for nth in np.flatnonzero(is_apart & is_inside & is_over).tolist():
            start, stop, last = int(starts[nth]), int(stops[nth]), int(lasts[nth])
            around = TimeWindow(start - beside, last + beside + 1)
            # The rows beside a row decide whether it is a copy.
            compared = around.widened(2 * COPY_HORIZON_NS)
            has_copies = overlaps_any(self.shared, compared.start, compared.stop)
            parts = self.whole_parts(compared if has_copies else around)
            if parts is not None:
                stretches.append(Stretch(TimeWindow(start, stop), last, parts))
        return stretches

    def copies(self) -> Iterator[Rows]:
        """Yields the rows that do not count, since another recording has their messages, too.

        Raises:
            QueryTimeoutError: as for `rows`.
        """
        shared: set[int] = set()
        for span in self.shared:
            shared.update(map(id, self._sources_in(TimeWindow(*span))))
        for source in self._sources:
            may_be_late = self.repeats_latched and self._may_be_late(source.number)
            if id(source) not in shared and not may_be_late:
                continue
            self.check(source.first)
            for unit in self._units(source):
                repeated = self._repeated(unit)
                if repeated.size:
                    yield Rows.of(unit, np.unique(repeated))

    def _read_sources(self, reach: TimeWindow) -> tuple[Coverage | None, list[_Source]]:
        """Returns the sources that may have rows in a window, and the coverage that has the parts.

        Without a store, or if that changes all the time, there is no coverage, and all are bags.
        """
        store = self.scanner.store
        for _ in range(_ATTEMPTS):
            if store is None:
                break
            failures = store.failures
            coverage = self.scanner.coverage(self.timeline)
            if coverage is None:
                break
            sources = [*self._stored_sources(coverage, reach)]
            # Meanwhile another process may have replaced parts, or the file may have failed: rows
            # would be missing.
            before, now = coverage.state, store.state()
            is_same = (before.part, before.deletion) == (now.part, now.deletion)
            if is_same and store.failures == failures:
                return coverage, sources
        return None, self._bag_sources(self.timeline.extents(self.topic, reach))

    def _stored_sources(self, coverage: Coverage, reach: TimeWindow) -> Iterator[_Source]:
        """Yields the parts that may have rows in a window, then the bags that are not stored."""
        for head in self.scanner.parts(self.topic, reach, coverage):
            yield _Source(head.first, head.last, head)
        if self.stored:
            # No bag is read: those near the window are needed to tell which stretches are settled.
            reach = reach.intersect(self.window.widened(2 * STRETCH_NS))
        yield from self._bag_sources(coverage.missing_extents(self.topic, reach))

    def _bag_sources(self, extents: Iterable[TopicExtent]) -> list[_Source]:
        """Returns one source for each bag, which has two extents if the topic has two types."""
        source_of: dict[str, _Source] = {}
        for bag, first, last in extents:
            if bag.file in source_of:
                source_of[bag.file] = _Source(*bag.summary.span_of([self.topic]), None, bag)
            else:
                source_of[bag.file] = _Source(first, last, None, bag)
        return [*source_of.values()]

    def _ordered(self, sources: Iterable[_Source]) -> list[_Source]:
        """Returns sources in order of time; those of equal times in the order of their bags."""
        by_time = sorted(sources, key=lambda source: (source.first, source.last))
        if len({(source.first, source.last) for source in by_time}) == len(by_time):
            return by_time

        def order(source: _Source) -> tuple[Ns, Ns, tuple[Ns, Ns, str] | tuple[()]]:
            bag = source.bag if source.part is None else self._first_bag(source.part)
            return source.first, source.last, () if bag is None else in_time(bag)

        return sorted(by_time, key=order)

    def _first_bag(self, part: PartHead) -> BagFile | None:
        """Returns the first bag whose rows in a part count, if there is one."""
        assert self._coverage is not None  # noqa: S101 - there are no parts without one
        counting = self._coverage.known(part.bags)
        return self._coverage.bag(int(counting[0])) if counting.size else None

    def _units(self, source: _Source) -> Iterable[Unit]:
        """Returns the tables of a source."""
        if source.part is None and self.stored:
            return ()
        if source.part is not None and self._coverage is not None:
            unit = self.scanner.part(source.part, self._coverage)
            return () if unit is None else (unit,)
        assert source.bag is not None  # noqa: S101 - a source is a part or a bag
        return self._units_of_bag(source.bag)

    def _units_of_bag(self, bag: BagFile) -> list[BagUnit]:
        """Returns the tables of a bag, which is decoded unless it was lately."""
        units = self._decoded.get(bag.file)
        if units is None:
            hashed = bool(self.shared) or self.repeats_latched
            tables = _without_columns_if_large(self.decode(bag, self.topic, hashed))
            units = [BagUnit(bag, table, nth) for nth, table in enumerate(tables) if len(table)]
            size = sum(unit.table.memory_bytes for unit in units)
            self._decoded.put(bag.file, units, size)
        return units

    def _counting_rows(self, unit: Unit) -> IntArray | None:
        """Returns the rows of a unit that count in the window; None if all do."""
        window = self.window
        is_inside = window.covers(unit.first, unit.last)
        is_counting = unit.counting() if is_inside else _in_window(unit, window)
        repeated = self._repeated(unit)
        if repeated.size:
            if is_counting is None:
                is_counting = np.ones(len(unit.table), np.bool_)
            is_counting[repeated] = False
        return None if is_counting is None or is_counting.all() else np.flatnonzero(is_counting)

    # Copies

    def _may_have_copies(self, span: Span) -> bool:
        """Returns whether two sources in a span may have one message, by their publish times."""
        published = sorted(
            self._published.get(source.number, (-math.inf, math.inf))
            for source in self._sources_in(TimeWindow(*span))
        )
        pairs = pairwise(published)
        return any(latest + COPY_JITTER_NS >= earliest for (_, latest), (earliest, _) in pairs)

    def _repeated(self, unit: Unit) -> IntArray:
        """Returns the rows of a unit that repeat a message of another recording."""
        for start, stop in self.shared[bisect_right(self._shared_stops, unit.first) :]:
            if start > unit.last:
                break
            first = start + max(unit.first - start, 0) // _SLICE_NS * _SLICE_NS
            for begin in range(first, min(unit.last + 1, stop), _SLICE_NS):
                if begin not in self._compared:
                    self._compared.add(begin)
                    end = min(begin + _SLICE_NS, stop)
                    self._find_copies(TimeWindow(begin, end), TimeWindow(start, stop))
        copies = self._copies.get(unit.key, [])
        if self.repeats_latched:
            copies = [*copies, self._received_again(unit)]
        return concatenated(copies)

    def _find_copies(self, window: TimeWindow, span: TimeWindow) -> None:
        """Finds the copies in a window of a shared span."""

        def are_copies(messages: Identities) -> Mask:
            return copies_among(messages) & window.holding(messages.log_times)

        around = window.widened(2 * COPY_HORIZON_NS).intersect(span)
        for unit, rows in self._compare_recordings(around, are_copies):
            self._copies[unit.key].append(rows)

    def _compare_recordings(
        self, window: TimeWindow, compare: Callable[[Identities], Mask]
    ) -> Iterator[tuple[Unit, IntArray]]:
        """Yields the units in a window, if several recordings have some, with the rows picked.

        Args:
            window: of log time.
            compare: picks some of all messages of these units in the window.
        """
        units = [unit for source in self._sources_in(window) for unit in self._units(source)]
        if len({unit.first_bag.recording for unit in units}) < 2:
            return
        rows = [np.flatnonzero(_in_window(unit, window)) for unit in units]
        is_picked = compare(self._messages(units, rows))
        of_units = np.split(is_picked, np.cumsum([unit_rows.size for unit_rows in rows])[:-1])
        for unit, unit_rows, mask in zip(units, rows, of_units, strict=True):
            yield unit, unit_rows[mask]

    def _received_again(self, unit: Unit) -> IntArray:
        """Returns the rows of a unit whose latched messages another recording received before."""
        none = np.empty(0, np.int64)
        may_be_late = unit.table.channel.latched and self._may_be_late(unit.part)
        identities = unit.identities() if may_be_late else None
        if identities is None:
            return none
        published, _ = identities
        is_late = unit.times() - published > REPEATED_NS
        if not is_late.any():
            return none
        since = max(int(published[is_late].min()) - COPY_HORIZON_NS, MIN_NS)
        if since < self._latched_again_since:
            # As much again before it: late messages come many at once, of about the same age.
            self._latched_again_since = max(since - (unit.last - since), MIN_NS)
            window = TimeWindow(self._latched_again_since, MAX_NS)
            for latched_unit, rows in self._compare_recordings(window, repeated_among):
                if latched_unit.table.channel.latched:
                    self._latched_again[latched_unit.key] = rows
        return self._latched_again.get(unit.key, none)

    @cached_property
    def _delays(self) -> dict[int | None, tuple[float, float]]:
        return self.scanner.bounds(_heads(self._sources), DELAY)

    @cached_property
    def _published(self) -> dict[int | None, tuple[float, float]]:
        return self.scanner.bounds(_heads(self._sources), PUBLISH_TIME)

    def _may_be_late(self, part: int | None) -> bool:
        """Returns whether a part, or a bag (None), may have messages received long after."""
        _, longest = self._delays.get(part, (0.0, math.inf))
        return longest > REPEATED_NS

    def _sources_in(self, window: TimeWindow) -> list[_Source]:
        """Returns the sources that reach into a window."""
        # They are in the order of their first times; an early one may end after later ones.
        begin = int(np.searchsorted(self._latest, window.start))
        stop = int(np.searchsorted(self._firsts, window.stop))
        return [source for source in self._sources[begin:stop] if source.last >= window.start]

    def _messages(self, units: Sequence[Unit], rows: Sequence[IntArray]) -> Identities:
        """Returns what tells apart the messages in some rows of each unit."""
        # In the order of names: of copies with one log time that of the first recording counts.
        recordings = sorted({unit.first_bag.recording for unit in units}, key=str)
        number_of = {recording: nth for nth, recording in enumerate(recordings)}
        parts: list[Identities] = []
        for unit, unit_rows in zip(units, rows, strict=True):
            recording = number_of[unit.first_bag.recording]
            published, hashes = self._identities(unit, unit_rows)
            # A hash of its own for each recording, so that unhashed messages are no copies.
            hashes = np.where(hashes == UNHASHED, UNHASHED - recording, hashes)
            of_recording = np.full(unit_rows.size, recording)
            parts.append(Identities(unit.times()[unit_rows], published, hashes, of_recording))
        return Identities(*map(np.concatenate, zip(*parts, strict=True)))

    def _identities(self, unit: Unit, positions: IntArray) -> tuple[IntArray, IntArray]:
        """Returns the publish times and hashes of some rows of a unit.

        A bag that was stored before another recording came beside it has no hashes, and is read.
        Rows of a bag that has changed meanwhile have their log times, and are `UNHASHED`.
        """
        times = unit.times()
        published, hashes = unit.identities() or (times, np.full(times.size, UNHASHED))
        unknown = positions[hashes[positions] == UNHASHED]
        if not unknown.size:
            return published[positions], hashes[positions]
        published, hashes, numbers = published.copy(), hashes.copy(), unit.bag_numbers()
        for number in np.unique(numbers[unknown]).tolist():
            rows = np.flatnonzero(numbers == number)
            for table in self.decode(unit.bag_of(number), self.topic, True):
                if table.payload_hashes is None or table.channel.type != unit.table.channel.type:
                    continue
                # A part has ten minutes of a long bag.
                begin = int(np.searchsorted(table.log_times, times[rows[0]]))
                same = slice(begin, begin + rows.size)
                if np.array_equal(table.log_times[same], times[rows]):
                    published[rows] = table.publish_times[same]
                    hashes[rows] = table.payload_hashes[same]
        return published[positions], hashes[positions]


def _in_window(unit: Unit, window: TimeWindow) -> Mask:
    """Returns which rows of a unit are in a window, and of bags that count."""
    is_inside, is_counted = window.holding(unit.times()), unit.counting()
    return is_inside if is_counted is None else is_inside & is_counted


def _overlapping(spans: Sequence[Span], window: TimeWindow) -> Sequence[Span]:
    """Returns the half-open spans that overlap a window; they are in order and apart."""
    begin = bisect_right(spans, window.start, key=itemgetter(1))
    end = bisect_left(spans, window.stop, begin, key=itemgetter(0))
    return spans[begin:end]


def _heads(sources: Iterable[_Source]) -> list[PartHead]:
    return [source.part for source in sources if source.part is not None]


def _is_next(rows: Rows, after: _Source | None, *, newest_first: bool) -> bool:
    """Returns whether rows come before those of the next source, `after`."""
    if after is None:
        return True
    return rows.last >= after.last if newest_first else rows.first <= after.first


def _without_columns_if_large(tables: Iterable[Table]) -> list[Table]:
    """Returns the tables of a bag, without their columns if these take too much memory together."""
    kept: list[Table] = []
    size = 0
    for table in tables:
        size += table.memory_bytes
        kept.append(table)
        if size > _MOST_BYTES:
            kept = [earlier.without_columns(_TOO_LARGE) for earlier in kept]
        del table  # before the next one is decoded
    return kept

"""Scans a topic: from the store where it has the rows, else from the bags, each message once.

A scan yields `Rows`: a table, and which of its rows count. Rows of different tables may overlap in
time where recordings do. Queries open scans by `history.scan`; parts come from the `Scanner`, whose
columns are unpacked when they are first used.
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
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS, overlaps_any
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.index.segment import in_time
from ros2_memory.storage.base import REPEATED_NS, IntArray, Mask

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.coverage import Coverage
    from ros2_memory.columns.scanner import Scanner
    from ros2_memory.columns.store import PartHead
    from ros2_memory.columns.table import Table
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.index.timeline import Timeline

Decode: TypeAlias = "Callable[[BagFile, str, bool], Iterable[Table]]"
"""Decodes a topic of a bag, with hashes of payloads where the last argument is true."""

_SLICE_NS: Final = 600 * NS_PER_S
"""How much of overlapping recordings is compared at a time."""
STRETCH_NS: Final[Ns] = 4 * 3600 * NS_PER_S
"""What follows from the rows of so much of the clock is joined once."""
_ATTEMPTS: Final = 5
"""How often a scan looks what is stored, while that changes; then it reads the bags."""
_MOST_DECODED: Final = 16
"""Bags whose tables a scan keeps, to compare them with others."""
_MOST_BYTES: Final = 64 << 20
"""Columns that are held at once; those of a bag with more are not, and it is read."""
_TOO_LARGE: Final = "its messages are too large to hold their columns"


class _Source(NamedTuple):
    """Where rows come from: a part, or a bag that is not stored."""

    first: Ns
    last: Ns
    part: PartHead | None
    bag: BagFile | None = None

    @property
    def number(self) -> int | None:
        """The number of the part; None of a bag."""
        return None if self.part is None else self.part.number


class Stretch(NamedTuple):
    """A stretch of the clock in a scan. No rows that begin in it overlap those of another one.

    Attributes:
        window: the stretch.
        last: no row of a part that begins in it is later (log time, ns).
        parts: the numbers of the whole parts that all rows in it and beside it are of; None where
            there are others, or the scan has not all of them.
    """

    window: TimeWindow
    last: Ns
    parts: tuple[int, ...] | None

    def key(self, settings: str = "") -> FragmentKey | None:
        """Returns the key of fragments made of its rows; None where these rows may change."""
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
        shared: the half-open spans in which different recordings may hold copies, in order; once
            it is made, those of them in which two sources may have the same messages.
        repeats_latched: whether recordings may have received a message again, as a latched one.
        may_match: says by zones which parts may have rows that are wanted, of each or of all;
            the others are left out.
        may_not_match: whether the others are yielded, too, as such.
        may_be_empty: whether rows are yielded also where none of them counts. Which do is then
            found out only where that is asked.
        within: half-open spans, in order and apart; tables that overlap none of them are left out.
            None: none is.
        stored: whether bags that are not stored are left out.
        check: is called before each table with a log time that what is left does not lie behind
            (with `newest_first`: is not later than); raises where the call's time is over.
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
        self._decoded: dict[str, list[BagUnit]] = {}
        # Rows that do not count, by the keys of their units: found when they are asked for.
        self._copies: dict[object, list[IntArray]] = defaultdict(list)
        self._compared: set[Ns] = set()
        self._latched_again: dict[object, IntArray] = {}
        self._latched_again_since = MAX_NS
        self.shared = _overlapping(self.shared, self.window)
        self._coverage: Coverage | None = None
        sources = self._settled(self._reach())  # which also sets `_coverage`
        self._sources = self._ordered(sources)
        self._firsts = np.array([source.first for source in self._sources], np.int64)
        self._lasts = np.array([source.last for source in self._sources], np.int64)
        self._latest = np.maximum.accumulate(self._lasts)
        if self.shared:
            self.shared = self._holding_copies()
        self._ends = [stop for _, stop in self.shared]

    def _reach(self) -> TimeWindow:
        """Returns the window, and the times beside it in which it may have copies of messages."""
        if self.repeats_latched:
            return TimeWindow.everything()
        return self.window.widened(2 * COPY_HORIZON_NS) if self.shared else self.window

    def rows(
        self, *, newest_first: bool = False, among: TimeWindow | None = None
    ) -> Iterator[Rows]:
        """Yields what counts of the topic in the window.

        In the order of the first log time of each table, or with `newest_first` of the last, from
        the newest on. Only of the tables that reach into `among`, where that is given.

        Raises:
            QueryTimeoutError: by `check`; or what was stored was deleted meanwhile.
        """
        sources, ruled_out = self._asked_sources(newest_first=newest_first, among=among)
        waiting: list[Rows] = []
        for nth, source in enumerate(sources):
            self.check(source.last if newest_first else source.first)
            waiting += [
                Rows(unit, partial(self._counting, unit), source.number not in ruled_out)
                for unit in self._units(source)
            ]
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
        """Returns the sources that are asked for, in their order; and the parts without a match."""
        sources = self._sources if among is None else self._sources_in(among)
        if newest_first:
            sources = sorted(sources, key=lambda source: (source.last, source.first))[::-1]
        # Before zones are asked: what lies elsewhere neither matches nor says that nothing does.
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
        """Returns the stretches of the clock that the window consists of, the newest first.

        Those of `STRETCH_NS` in which all rows are of whole parts, also those so long (ns) before
        and after, and what lies between them.
        """
        stretches: list[Stretch] = []
        until = self.window.stop

        def between(start: Ns) -> Iterator[Stretch]:
            if start < until:
                latest = self._latest[: np.searchsorted(self._firsts, until)].tolist()
                yield Stretch(TimeWindow(start, until), max([until - 1, *latest[-1:]]), None)

        for stretch in self._settled_stretches(beside) if self._sources else ():
            stretches += [*between(stretch.window.stop), stretch]
            until = stretch.window.start
        return [*stretches, *between(self.window.start)]

    def whole_parts(self, window: TimeWindow) -> tuple[int, ...] | None:
        """Returns the whole parts that all rows in a window are of; None where others are, too.

        With them those that latched messages in the window may have been received in before.
        """
        parts = self._parts_reaching_into(window)
        late = [part for part in parts or () if self.repeats_latched and self._may_be_late(part)]
        if not late:
            return parts
        published = min(self._published[part][0] for part in late)
        if published < window.start - STRETCH_NS:
            return None
        since = min(int(published) - COPY_HORIZON_NS, window.start)
        return self._parts_reaching_into(TimeWindow(since, window.stop))

    def _parts_reaching_into(self, window: TimeWindow) -> tuple[int, ...] | None:
        if self._coverage is None:
            return None
        begin = int(np.searchsorted(self._latest, window.start))
        end = int(np.searchsorted(self._firsts, window.stop))
        if self._others[end] > self._others[begin]:
            return None
        reaching = begin + np.flatnonzero(self._lasts[begin:end] >= window.start)
        return tuple(self._numbers[reaching].tolist())

    def is_stored(self, window: TimeWindow) -> bool:
        """Returns whether all rows in a window are of parts."""
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
    def _others(self) -> IntArray:
        """How many of the first sources are not whole parts of which all rows count."""
        is_whole = np.array([bool(s.part and s.part.is_whole) for s in self._sources], np.bool_)
        bags = [head.bags for head in _heads(self._sources)]
        if self._coverage is not None and bags:
            all_count = self._coverage.counts(bags) == [*map(len, bags)]
            is_whole[self._numbers > 0] &= all_count
        is_whole &= self._lasts - self._firsts < STRETCH_NS
        return np.concatenate([[0], np.cumsum(~is_whole)])

    def _settled_stretches(self, beside: Ns) -> list[Stretch]:
        """Returns the stretches of which all rows are of whole parts; see `stretches`."""
        window, firsts, latest = self.window, self._firsts, self._latest
        newest = self.timeline.latest
        starts = np.unique(firsts // STRETCH_NS)[::-1] * STRETCH_NS
        stops = starts + STRETCH_NS
        begin, end = np.searchsorted(firsts, starts), np.searchsorted(firsts, stops)
        after, before = np.append(firsts, MAX_NS), np.append(MIN_NS, latest)
        # What reaches over an edge overlaps nothing that begins behind it.
        is_apart = (before[begin] < after[begin]) & (before[end] < after[end])
        lasts = np.maximum(before[end], stops - 1)
        is_inside = (starts - beside >= window.start) & (lasts + beside < window.stop)
        stretches = []
        for nth in np.flatnonzero(is_apart & is_inside & (stops <= newest)).tolist():
            start, stop, last = int(starts[nth]), int(stops[nth]), int(lasts[nth])
            around = TimeWindow(start - beside, last + beside + 1)
            # Which rows are copies follows from those beside them, too.
            copied = around.widened(2 * COPY_HORIZON_NS)
            has_copies = overlaps_any(self.shared, copied.start, copied.stop)
            parts = self.whole_parts(copied if has_copies else around)
            if parts is not None:
                stretches.append(Stretch(TimeWindow(start, stop), last, parts))
        return stretches

    def copies(self) -> Iterator[Rows]:
        """Yields the rows that do not count, as another recording has their messages, too.

        Raises:
            QueryTimeoutError: as for `rows`.
        """
        spans = [TimeWindow(*span) for span in self.shared]
        shared = {id(source) for span in spans for source in self._sources_in(span)}
        asked = [
            source
            for source in self._sources
            if id(source) in shared or (self.repeats_latched and self._may_be_late(source.number))
        ]
        for source in asked:
            self.check(source.first)
            for unit in self._units(source):
                repeated = self._repeated(unit)
                if repeated.size:
                    yield Rows.of(unit, np.unique(repeated))

    def _settled(self, reach: TimeWindow) -> list[_Source]:
        """Returns the sources that may have rows in a window, as the store is at one moment."""
        store = self.scanner.store
        for _ in range(_ATTEMPTS):
            if store is None:
                break
            failures = store.failures
            self._coverage = self.scanner.coverage(self.timeline)
            sources = [*self._sources_of(reach)]
            # Meanwhile another process may have replaced parts, or the file may have failed: rows
            # would be missing.
            if self._coverage is None:
                return sources
            before, now = self._coverage.state, store.state()
            is_same = (before.part, before.deletion) == (now.part, now.deletion)
            if is_same and store.failures == failures:
                return sources
        self._coverage = None
        return [*self._sources_of(reach)]

    def _sources_of(self, reach: TimeWindow) -> Iterator[_Source]:
        """Yields the sources that may have rows in a window."""
        coverage = self._coverage
        if coverage is None or self.scanner.store is None:
            extents = self.timeline.extents(self.topic, reach)
        else:
            for head in self.scanner.parts(self.topic, reach, coverage):
                yield _Source(head.first, head.last, head)
            if self.stored:
                # Of bags nothing is read: those near the window tell what does not settle in it.
                reach = reach.intersect(self.window.widened(2 * STRETCH_NS))
            extents = coverage.missing_extents(self.topic, reach)
        of_bags: dict[str, _Source] = {}
        for bag, *span in extents:
            first, last = bag.summary.span_of([self.topic]) if bag.file in of_bags else span
            of_bags[bag.file] = _Source(first, last, None, bag)
        yield from of_bags.values()

    def _ordered(self, sources: Iterable[_Source]) -> list[_Source]:
        """Returns sources in order of time; of those of the same times as their bags are."""
        by_time = sorted(sources, key=lambda source: (source.first, source.last))
        if len({(source.first, source.last) for source in by_time}) == len(by_time):
            return by_time

        def order(source: _Source) -> tuple[Ns, Ns, tuple[Ns, Ns, str] | tuple[()]]:
            bag = source.bag if source.part is None else self._first_bag(source.part)
            return source.first, source.last, () if bag is None else in_time(bag)

        return sorted(by_time, key=order)

    def _first_bag(self, part: PartHead) -> BagFile | None:
        """Returns the first bag of a part of which rows count, if any."""
        assert self._coverage is not None  # noqa: S101 - there are no parts without one
        counting = self._coverage.of_part(part.number, part.bags)
        return self._coverage.bag(int(counting[0])) if counting.size else None

    def _units(self, source: _Source) -> Iterable[Unit]:
        """Returns what a source has."""
        if source.part is None and self.stored:
            return ()
        if source.part is not None and self._coverage is not None:
            unit = self.scanner.part(source.part, self._coverage)
            return () if unit is None else (unit,)
        assert source.bag is not None  # noqa: S101 - a source is a part or a bag
        return self._units_of_bag(source.bag)

    def _units_of_bag(self, bag: BagFile) -> list[BagUnit]:
        """Returns the tables of a bag, which is decoded unless it is one of those at hand."""
        if bag.file not in self._decoded:
            hashed = bool(self.shared) or self.repeats_latched
            tables = self.decode(bag, self.topic, hashed)
            held = _without_columns_if_large(tables)
            units = [BagUnit(bag, table, nth) for nth, table in enumerate(held) if len(table)]
            self._decoded[bag.file] = units
            while len(self._decoded) > _MOST_DECODED or (
                len(self._decoded) > 1 and self._decoded_bytes() > _MOST_BYTES
            ):
                # What lies farthest away is done with; a long bag serves all beside it.
                others = [*self._decoded][:-1]
                del self._decoded[max(others, key=lambda file: self._apart(file, bag))]
        return self._decoded[bag.file]

    def _apart(self, file: str, bag: BagFile) -> Ns:
        """Returns how far the rows of a decoded bag lie from another bag (ns); less, the longer."""
        units = self._decoded[file]
        return min((max(u.first - bag.end, bag.start - u.last) for u in units), default=MAX_NS)

    def _decoded_bytes(self) -> int:
        return sum(unit.memory_bytes for units in self._decoded.values() for unit in units)

    def _counting(self, unit: Unit) -> IntArray | None:
        """Returns the rows of a unit that count in the window; None: all do."""
        window = self.window
        is_covered = window.covers(unit.first, unit.last)
        is_counted = unit.counting() if is_covered else _in_window(unit, window)
        repeated = self._repeated(unit)
        if repeated.size:
            is_counted = np.ones(len(unit.table), np.bool_) if is_counted is None else is_counted
            is_counted[repeated] = False
        return None if is_counted is None or is_counted.all() else np.flatnonzero(is_counted)

    # Copies

    def _holding_copies(self) -> list[Span]:
        """Returns the shared spans in which two sources may have messages of one publish time."""

        def may_repeat(span: Span) -> bool:
            published = sorted(
                self._published.get(source.number, (-math.inf, math.inf))
                for source in self._sources_in(TimeWindow(*span))
            )
            return any(latest >= earliest for (_, latest), (earliest, _) in pairwise(published))

        return [span for span in self.shared if may_repeat(span)]

    def _repeated(self, unit: Unit) -> IntArray:
        """Returns the rows of a unit that repeat a message of another recording."""
        for start, stop in self.shared[bisect_right(self._ends, unit.first) :]:
            if start > unit.last:
                break
            first = start + max(unit.first - start, 0) // _SLICE_NS * _SLICE_NS
            for begin in range(first, min(unit.last + 1, stop), _SLICE_NS):
                if begin not in self._compared:
                    self._compared.add(begin)
                    end = min(begin + _SLICE_NS, stop)
                    self._compare(TimeWindow(start, stop), TimeWindow(begin, end))
        copies = self._copies.get(unit.key, [])
        if self.repeats_latched:
            copies = [*copies, self._received_again(unit)]
        return np.concatenate(copies) if copies else np.empty(0, np.int64)

    def _compare(self, span: TimeWindow, part: TimeWindow) -> None:
        """Finds the copies in a part of a shared span."""

        def are_copies(messages: Identities) -> Mask:
            times = messages.log_times
            return copies_among(messages) & (times >= part.start) & (times < part.stop)

        around = part.widened(2 * COPY_HORIZON_NS).intersect(span)
        for unit, rows in self._judged(around, are_copies):
            self._copies[unit.key].append(rows)

    def _judged(
        self, window: TimeWindow, judge: Callable[[Identities], Mask]
    ) -> Iterator[tuple[Unit, IntArray]]:
        """Yields the units of several recordings, with those rows in a window that are judged so.

        `judge` is given all of their messages in the window.
        """
        units = [unit for source in self._sources_in(window) for unit in self._units(source)]
        if len({unit.first_bag.recording for unit in units}) > 1:
            rows = [np.flatnonzero(_in_window(unit, window)) for unit in units]
            judged = judge(self._messages(units, rows))
            for unit, unit_rows in zip(units, rows, strict=True):
                yield unit, unit_rows[judged[: unit_rows.size]]
                judged = judged[unit_rows.size :]

    def _received_again(self, unit: Unit) -> IntArray:
        """Returns the rows of a unit that were received before, as late messages of a latch."""
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
            for late, rows in self._judged(window, repeated_among):
                if late.table.channel.latched:
                    self._latched_again[late.key] = rows
        return self._latched_again.get(unit.key, none)

    @cached_property
    def _delays(self) -> dict[int | None, tuple[float, float]]:
        return self._bounds(DELAY)

    @cached_property
    def _published(self) -> dict[int | None, tuple[float, float]]:
        return self._bounds(PUBLISH_TIME)

    def _bounds(self, path: str) -> dict[int | None, tuple[float, float]]:
        bounds = self.scanner.bounds(_heads(self._sources), path)
        return {number: span for number, span in bounds.items()}  # noqa: C416 - also of None

    def _may_be_late(self, part: int | None) -> bool:
        """Returns whether a part, or a bag, may have messages that were received long after."""
        return self._delays.get(part, (0.0, math.inf))[1] > REPEATED_NS

    def _sources_in(self, window: TimeWindow) -> list[_Source]:
        # They are in the order of their first times, and reach beyond the next ones.
        begin = int(np.searchsorted(self._latest, window.start))
        stop = int(np.searchsorted(self._firsts, window.stop))
        return [source for source in self._sources[begin:stop] if source.last >= window.start]

    def _messages(self, units: Sequence[Unit], rows: Sequence[IntArray]) -> Identities:
        """Returns what tells messages apart, of some rows of each unit."""
        # By their names: of messages of one time that counts which lies in the first recording.
        recordings = sorted({unit.first_bag.recording for unit in units}, key=str)
        number_of = {recording: nth for nth, recording in enumerate(recordings)}
        parts: list[Identities] = []
        for unit, unit_rows in zip(units, rows, strict=True):
            recording = number_of[unit.first_bag.recording]
            published, hashes = self._identities(unit, unit_rows)
            # Another for each recording: what has no hash is no copy.
            hashes = np.where(hashes == UNHASHED, UNHASHED - recording, hashes)
            of_recording = np.full(unit_rows.size, recording)
            parts.append(Identities(unit.times()[unit_rows], published, hashes, of_recording))
        return Identities(*map(np.concatenate, zip(*parts, strict=True)))

    def _identities(self, unit: Unit, positions: IntArray) -> tuple[IntArray, IntArray]:
        """Returns publish times and hashes of some rows of a unit.

        Bags that were stored before another recording came beside them are read. Rows of one that
        has changed meanwhile have their log times, and are `UNHASHED`.
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
    times, is_counted = unit.times(), unit.counting()
    is_inside: Mask = (times >= window.start) & (times < window.stop)
    return is_inside if is_counted is None else is_inside & is_counted


def _overlapping(spans: Sequence[Span], window: TimeWindow) -> Sequence[Span]:
    """Returns those half-open spans, of some in order and apart, that overlap a window."""
    begin = bisect_right(spans, window.start, key=itemgetter(1))
    end = bisect_left(spans, window.stop, begin, key=itemgetter(0))
    return spans[begin:end]


def _heads(sources: Iterable[_Source]) -> list[PartHead]:
    return [source.part for source in sources if source.part is not None]


def _is_next(rows: Rows, after: _Source | None, *, newest_first: bool) -> bool:
    """Returns whether no row of the sources from `after` on comes before a table."""
    if after is None:
        return True
    return rows.last >= after.last if newest_first else rows.first <= after.first


def _without_columns_if_large(tables: Iterable[Table]) -> list[Table]:
    """Returns the tables of a bag; without their columns where these take too much together."""
    held: list[Table] = []
    size = 0
    for table in tables:
        size += table.memory_bytes
        held.append(table)
        if size > _MOST_BYTES:
            held = [earlier.without_columns(_TOO_LARGE) for earlier in held]
        del table
    return held

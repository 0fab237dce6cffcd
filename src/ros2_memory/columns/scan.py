"""Scans a topic: from the store where it has the rows, else from the bags, each message once.

A scan yields `Rows`: a table, and which of its rows count. Rows of different tables may overlap in
time where recordings do. Of a table that nothing needs not even the times are unpacked.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict, defaultdict
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.blob import unpack_tables
from ros2_memory.columns.copies import Identities, copies_among, joined_identities, relatched_among
from ros2_memory.columns.coverage import Covering
from ros2_memory.columns.pack import decompressed, unpack
from ros2_memory.columns.parts import part_table
from ros2_memory.columns.table import Texts
from ros2_memory.columns.units import BagUnit, GoneError, PartUnit, Rows, Unit
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.storage.base import RELATCHED_NS
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.analysis.motion.standstills import Stands
    from ros2_memory.analysis.motion.trajectory import PathSlice
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.columns.coverage import Coverage
    from ros2_memory.columns.pack import Packed
    from ros2_memory.columns.store import ColumnStore, PartHead
    from ros2_memory.columns.table import Column, Table
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import IntArray

Decode: TypeAlias = "Callable[[BagFile, str, bool], Iterable[Table]]"
"""Decodes a topic of a bag, with hashes of payloads where the last argument is true."""

_SLICE_NS: Final = 600 * NS_PER_S
"""How much of overlapping recordings is compared at a time."""
_HEAD_BYTES: Final = 400
"""About how much memory what is known of a part takes."""
_COLUMN_BYTES: Final = 300
"""About how much memory what is known of a column takes."""
_ATTEMPTS: Final = 5
"""How often a scan looks what is stored, while that changes; then it reads the bags."""
_MOST_LOOKED_UP: Final = 64
"""Parts whose columns are looked up at once."""
_MOST_DECODED: Final = 16
"""Bags whose tables a scan keeps, to compare them with others."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What a scan is of.

    Attributes:
        topic: its name.
        window: of log time.
        timeline: the bags.
        decode: decodes a topic of a bag that is not stored.
        shared: the half-open spans in which different recordings may hold copies, in order.
        relatches: whether recordings may have received a message again, as of a latched topic.
        may_match: whether rows of a part may be wanted, told by its zones; others are left out.
        may_be_empty: whether rows are yielded also where none of them counts. Which do is then
            found out only where that is asked.
        check: is called before each table with a log time that what is left does not lie behind
            (with `newest_first`: is not later than); raises where the call's time is over.
    """

    topic: str
    window: TimeWindow
    timeline: Timeline
    decode: Decode
    shared: Sequence[tuple[Ns, Ns]] = ()
    relatches: bool = False
    may_match: Callable[[Table], bool] = lambda _: True
    may_be_empty: bool = False
    check: Callable[[Ns], None] = lambda _: None


class _Source(NamedTuple):
    """Where rows come from: a part, or a bag with its number in the store (-1: not stored)."""

    first: Ns
    last: Ns
    part: PartHead | None
    bag: BagFile | None = None
    number: int = -1


@dataclass(frozen=True, slots=True, eq=False)
class _Heads:
    """The parts of a topic, in order of their first log times.

    Attributes:
        coverage: of the timeline that they were compared with.
        heads: the parts.
        firsts: their first log times.
        lasts: their last ones.
        live: of how many of its bags the rows of each count.
    """

    coverage: Coverage
    heads: Sequence[PartHead]
    firsts: IntArray
    lasts: IntArray
    live: IntArray

    @classmethod
    def of(cls, heads: Sequence[PartHead], coverage: Coverage) -> _Heads:
        """Returns the parts as of a coverage."""
        live = np.zeros(len(heads), np.int64)
        if heads:
            sizes = np.cumsum([0, *(head.bags.size for head in heads)])
            positions = coverage.positions(np.concatenate([head.bags for head in heads]))
            live = np.add.reduceat(positions >= 0, sizes[:-1]).astype(np.int64)
        return cls(
            coverage,
            heads,
            np.array([head.first for head in heads], np.int64),
            np.array([head.last for head in heads], np.int64),
            live,
        )

    def within(self, window: TimeWindow) -> Iterator[PartHead]:
        """Yields the parts that may have rows in a window."""
        here = (self.live > 0) & (self.firsts < window.stop) & (self.lasts >= window.start)
        for nth in np.flatnonzero(here).tolist():
            yield self.heads[nth]


@dataclass(frozen=True, slots=True)
class Census:
    """Log times of the earliest and latest message (inclusive), and how many there are."""

    first: Ns
    last: Ns
    count: int


class Scanner:
    """Scans topics of one bag directory. Thread-safe.

    Args:
        store: the store; None where nothing is stored.
        bag_dir: the bag directory.

    Attributes:
        censuses: by topic, span and bags, what is stored of each type and what of it counts.
        events: by part, what happened in it; of parts of which all rows count.
        paths: by slice of the clock and such parts, the path of the poses in it.
        stands: likewise, where the robot may have stood.
    """

    def __init__(self, store: ColumnStore | None, bag_dir: Path) -> None:
        self.store = store
        self._covering = None if store is None else Covering(store, bag_dir)
        self._columns: ByteLru[Column] = ByteLru(48 << 20)
        self._known: ByteLru[Mapping[str, Packed]] = ByteLru(16 << 20)
        self._heads: ByteLru[_Heads] = ByteLru(16 << 20)
        self.censuses: ByteLru[Mapping[str, tuple[Census, Census]]] = ByteLru(8 << 20)
        self.events: ByteLru[TopicEvents] = ByteLru(24 << 20)
        self.paths: ByteLru[PathSlice] = ByteLru(24 << 20)
        self.stands: ByteLru[Stands] = ByteLru(24 << 20)

    def rows(self, asked: Asked, *, newest_first: bool = False) -> Iterator[Rows]:
        """Yields what counts of a topic in a window.

        In the order of the first log time of each table, or with `newest_first` of the last, from
        the newest on.

        Raises:
            QueryTimeoutError: by `check`; or what was stored was deleted meanwhile.
        """
        return _Scan(self, asked).rows(newest_first=newest_first)

    def coverage(self, timeline: Timeline) -> Coverage | None:
        """Returns which bags of a timeline are stored; None without a store."""
        return None if self._covering is None else self._covering.of(timeline)

    def parts(self, topic: str, window: TimeWindow, coverage: Coverage) -> Iterator[PartHead]:
        """Yields the parts of a topic that may have rows in a window."""
        if self.store is None:
            return
        state = coverage.state
        known = self._heads.get(topic)
        if known is None or known.coverage is not coverage:
            failures = self.store.failures
            heads: list[PartHead] = []
            if known is not None and known.coverage.state.deletion == state.deletion:
                heads = [*known.heads]
            if known is None or known.coverage.state != state:
                heads += self.store.parts(topic, max((head.number for head in heads), default=0))
                heads.sort(key=lambda head: (head.first, head.number))
            known = _Heads.of(heads, coverage)
            if self.store.failures == failures:
                self._heads.put(topic, known, 1000 + _HEAD_BYTES * len(heads))
        yield from known.within(window)

    def part(
        self,
        head: PartHead,
        coverage: Coverage,
        may_match: Callable[[Table], bool] = lambda _: True,
    ) -> PartUnit | None:
        """Returns a part; None where no row of it counts, or none may match.

        Raises:
            GoneError: it was deleted meanwhile.
        """
        assert self.store is not None  # noqa: S101 - there are no parts without one
        offset = self.store.offset
        known = self._known.get(head.number) or self.look_up([head]).get(head.number)
        topic = self.store.topic(head.topic)
        if not known or topic is None:
            raise GoneError
        columns = known

        def load(path: str) -> Column:
            return self._column(head.number, path, columns[path])

        table = part_table(topic, columns, load)
        if not may_match(table):
            return None
        counting = coverage.among(head.bags)
        if not counting.size:
            return None

        def integers(path: str) -> IntArray | None:
            column = load(path) if path in columns else None
            return None if column is None else np.asarray(column, np.int64)

        def bag_of(number: int) -> BagFile:
            bag = coverage.bag(number + offset)
            if bag is None:
                raise GoneError
            return bag

        return PartUnit(head, table, integers, counting - offset, bag_of)

    def look_up(self, heads: Iterable[PartHead]) -> Mapping[int, Mapping[str, Packed]]:
        """Reads at once what is known of the columns of parts, where it is not known yet."""
        missing = [head.number for head in heads if self._known.get(head.number) is None]
        found = self.store.part_columns(missing) if self.store is not None and missing else {}
        for number, columns in found.items():
            if columns:
                self._known.put(number, columns, _COLUMN_BYTES * len(columns))
        return found

    def split(self, number: int, topic: str) -> list[Table] | None:
        """Returns the tables of a topic in a bag that is no part yet; None if they are gone."""
        assert self.store is not None  # noqa: S101 - there are no splits without one
        failures = self.store.failures
        data = self.store.split_data(number)
        topics = self.store.topics()
        if data is None or self.store.failures != failures:
            return None
        tables = unpack_tables(data, topics)
        return [table for number, table in tables if topics[number].channel.topic == topic]

    def _column(self, part: int, path: str, packed: Packed) -> Column:
        column = self._columns.get((part, path))
        if column is not None:
            return column
        assert self.store is not None  # noqa: S101 - as above
        data = b""
        # The one value of a constant is its least, unless it is a text.
        if not packed.codec.endswith(" constant") or packed.codec.startswith("text"):
            stored = self.store.part_data(part, path)
            if stored is None:
                raise GoneError
            data = decompressed(stored) if stored else b""
        column = unpack(packed.codec, packed.count, packed.zone.least, data)
        self._columns.put((part, path), column, _bytes_of(column))
        return column


class _Scan:
    """One scan: its sources, and which rows of them are copies."""

    def __init__(self, scanner: Scanner, asked: Asked) -> None:
        self._scanner = scanner
        self._asked = asked
        self._coverage: Coverage | None = None
        self._shared = [
            span for span in asked.shared if asked.window.overlaps(span[0], span[1] - 1)
        ]
        self._ends = [stop for _, stop in self._shared]
        self._decoded: OrderedDict[str, list[Unit]] = OrderedDict()
        self._copies: dict[object, list[IntArray]] = defaultdict(list)
        self._compared: set[Ns] = set()
        self._relatched: dict[object, IntArray] = {}
        self._relatched_since = MAX_NS
        reach = asked.window
        if asked.relatches:
            reach = TimeWindow.everything()
        elif self._shared:
            reach = reach.widened(2 * COPY_HORIZON_NS)
        found = self._settled(reach)
        self._sources = sorted(found, key=lambda source: (source.first, source.last))

    def rows(self, *, newest_first: bool) -> Iterator[Rows]:
        sources = self._sources
        if newest_first:
            sources = sorted(sources, key=lambda source: (source.last, source.first), reverse=True)
        window = self._asked.window
        ahead = together = 1
        for nth, source in enumerate(sources):
            if nth == ahead:
                # Who goes on reads many.
                together = min(2 * together, _MOST_LOOKED_UP)
                ahead += together
                parts = [each.part for each in sources[nth:ahead] if each.part is not None]
                self._scanner.look_up(parts)
            if window.overlaps(source.first, source.last):
                self._asked.check(source.last if newest_first else source.first)
                for unit in self._units(source, self._asked.may_match):
                    rows = Rows(unit, partial(self._counting, unit))
                    if self._asked.may_be_empty or len(rows):
                        yield rows

    def _settled(self, reach: TimeWindow) -> list[_Source]:
        """Returns the sources that may have rows in a window, as the store is at one moment."""
        store = self._scanner.store
        for _ in range(_ATTEMPTS):
            if store is None:
                break
            failures = store.failures
            self._coverage = self._scanner.coverage(self._asked.timeline)
            found = [*self._found(reach)]
            # Meanwhile another process may have made parts of splits, or the file may have failed:
            # rows would be missing.
            if self._coverage is None:
                return found
            before, now = self._coverage.state, store.state()
            if (failures, before.part, before.deletion) == (
                store.failures,
                now.part,
                now.deletion,
            ):
                return found
        self._coverage = None
        return [*self._found(reach)]

    def _found(self, reach: TimeWindow) -> Iterator[_Source]:
        """Yields the sources that may have rows in a window."""
        topic, timeline, coverage = self._asked.topic, self._asked.timeline, self._coverage
        if coverage is None or self._scanner.store is None:
            bags = {bag.file: bag for bag, *_ in timeline.extents(topic, reach)}
            for bag in bags.values():
                yield _Source(*bag.summary.span_of([topic]), None, bag)
            return
        for head in self._scanner.parts(topic, reach, coverage):
            yield _Source(head.first, head.last, head)
        for number in self._scanner.store.splits():
            split = coverage.bag(number)
            if (
                split is not None
                and split.summary.of(topic)
                and reach.overlaps(split.start, split.end)
            ):
                yield _Source(*split.summary.span_of([topic]), None, split, number)
        for bag in coverage.missing:
            if reach.overlaps(bag.start, bag.end) and bag.summary.of(topic):
                yield _Source(*bag.summary.span_of([topic]), None, bag)

    def _units(
        self, source: _Source, may_match: Callable[[Table], bool] = lambda _: True
    ) -> Iterable[Unit]:
        if source.part is not None and self._coverage is not None:
            unit = self._scanner.part(source.part, self._coverage, may_match)
            return () if unit is None else (unit,)
        assert source.bag is not None  # noqa: S101 - a source is a part or a bag
        known = self._decoded.get(source.bag.file)
        if known is None:
            tables = None
            if source.number >= 0:
                tables = self._scanner.split(source.number, self._asked.topic)
            if tables is None:
                hashed = bool(self._shared) or self._asked.relatches
                tables = [*self._asked.decode(source.bag, self._asked.topic, hashed)]
            known = [
                BagUnit(source.bag, table, nth) for nth, table in enumerate(tables) if len(table)
            ]
            self._decoded[source.bag.file] = known
            if len(self._decoded) > _MOST_DECODED:
                self._decoded.popitem(last=False)
        return known

    def _counting(self, unit: Unit) -> IntArray | None:
        """Returns the rows of a unit that count in the window; None: all do."""
        window = self._asked.window
        counting = unit.counting()
        if not window.covers(unit.first, unit.last):
            times = unit.times()
            inside = (times >= window.start) & (times < window.stop)
            counting = inside if counting is None else counting & inside
        repeated = self._repeated(unit)
        if repeated.size:
            counting = np.ones(len(unit.table), np.bool_) if counting is None else counting
            counting[repeated] = False
        return None if counting is None or counting.all() else np.flatnonzero(counting)

    # Copies

    def _repeated(self, unit: Unit) -> IntArray:
        """Returns the rows of a unit that repeat a message of another recording."""
        for start, stop in self._shared[bisect_right(self._ends, unit.first) :]:
            if start > unit.last:
                break
            for begin in range(start, stop, _SLICE_NS):
                end = min(begin + _SLICE_NS, stop)
                if begin <= unit.last and unit.first < end and begin not in self._compared:
                    self._compared.add(begin)
                    self._compare(TimeWindow(start, stop), TimeWindow(begin, end))
        found = self._copies.get(unit.key, [])
        if self._asked.relatches:
            found = [*found, self._received_again(unit)]
        return np.concatenate(found) if found else np.empty(0, np.int64)

    def _compare(self, span: TimeWindow, part: TimeWindow) -> None:
        """Finds the copies in a part of a shared span."""
        around = part.widened(2 * COPY_HORIZON_NS).intersect(span)
        units = [*self._units_in(around)]
        if len({unit.recording for unit in units}) < 2:
            return
        rows = [self._rows_in(unit, around) for unit in units]
        messages = self._messages(units, rows)
        copies = copies_among(messages)
        copies &= (messages.log_times >= part.start) & (messages.log_times < part.stop)
        begin = 0
        for unit, some in zip(units, rows, strict=True):
            of_unit = some[copies[begin : begin + some.size]]
            begin += some.size
            if of_unit.size:
                self._copies[unit.key].append(of_unit)

    def _received_again(self, unit: Unit) -> IntArray:
        """Returns the rows of a unit that were received before, as late messages of a latch."""
        none = np.empty(0, np.int64)
        identities = unit.identities() if unit.table.channel.latched else None
        if identities is None:
            return none
        published = identities[0]
        late = unit.times() - published > RELATCHED_NS
        if not late.any():
            return none
        since = max(int(published[late].min()) - COPY_HORIZON_NS, MIN_NS)
        if since < self._relatched_since:
            # As much again before it: late messages come many at once, of about the same age.
            self._relatched_since = max(since - (unit.last - since), MIN_NS)
            self._find_relatched(TimeWindow(self._relatched_since, MAX_NS))
        return self._relatched.get(unit.key, none)

    def _find_relatched(self, window: TimeWindow) -> None:
        units = [*self._units_in(window)]
        rows = [self._rows_in(unit, window) for unit in units]
        messages = self._messages(units, rows)
        latched = np.repeat(
            [unit.table.channel.latched for unit in units], [some.size for some in rows]
        )
        again = relatched_among(messages) & latched
        begin = 0
        for unit, some in zip(units, rows, strict=True):
            self._relatched[unit.key] = some[again[begin : begin + some.size]]
            begin += some.size

    def _units_in(self, window: TimeWindow) -> Iterator[Unit]:
        # Sources are in the order of their first times, and reach beyond the next ones.
        stop = bisect_right(self._sources, window.stop - 1, key=lambda source: source.first)
        for source in self._sources[:stop]:
            if source.last >= window.start:
                yield from self._units(source)

    def _rows_in(self, unit: Unit, window: TimeWindow) -> IntArray:
        times, counting = unit.times(), unit.counting()
        inside = (times >= window.start) & (times < window.stop)
        return np.flatnonzero(inside if counting is None else inside & counting)

    def _messages(self, units: Sequence[Unit], rows: Sequence[IntArray]) -> Identities:
        """Returns what tells messages apart, of some rows of each unit."""
        numbers: dict[Path, int] = {}
        parts: list[Identities] = []
        for unit, some in zip(units, rows, strict=True):
            recording = numbers.setdefault(unit.recording, len(numbers))
            # Below 0, and another for each recording: what has no hash is no copy.
            published, hashes = unit.identities() or self._hashed_again(unit, -1 - recording)
            parts.append(
                Identities(
                    unit.times()[some],
                    published[some],
                    hashes[some],
                    np.full(some.size, recording),
                )
            )
        return joined_identities(parts)

    def _hashed_again(self, unit: Unit, unknown: int) -> tuple[IntArray, IntArray]:
        """Reads the bags of a unit that was stored before another recording came beside it.

        Rows of a bag that has changed meanwhile have their log times, and the hash `unknown`.
        """
        published = unit.times().copy()
        hashes = np.full(published.size, unknown)
        numbers = unit.bag_numbers()
        for number, bag in unit.bags().items():
            rows = np.flatnonzero(numbers == number)
            for table in self._asked.decode(bag, self._asked.topic, True):
                same = table.channel.type == unit.table.channel.type
                if same and len(table) == rows.size and table.payload_hashes is not None:
                    published[rows] = table.publish_times
                    hashes[rows] = table.payload_hashes
        return published, hashes


def _bytes_of(column: Column) -> int:
    if isinstance(column, Texts):
        return column.codes.nbytes + sum(map(len, column.words)) + 60 * len(column.words)
    return column.nbytes

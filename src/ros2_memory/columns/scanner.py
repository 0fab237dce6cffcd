"""Reads the stored parts of a bag directory, and remembers their zones and columns.

A `Scan` asks a `Scanner` for parts, which reads the bytes of their columns from the `ColumnStore`.
A column is unpacked when it is first used, the log times too.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar, cast

import numpy as np

from ros2_memory.columns.coverage import Coverage, Covering
from ros2_memory.columns.database import row_id
from ros2_memory.columns.fragments import FragmentKey, FragmentKind, Fragments, Sized
from ros2_memory.columns.pack import Packed, decompress, is_large, unpack
from ros2_memory.columns.stored import (
    OUTLINE,
    PartZones,
    StoredTable,
    Zones,
    lazy_columns,
    outline_of,
)
from ros2_memory.columns.table import Column, Table, Texts, column_bytes
from ros2_memory.columns.units import GoneError, Unit
from ros2_memory.columns.writing import BAG, LOG_TIME
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.analysis.clock_steps import ClockStep
    from ros2_memory.columns.store import ColumnStore, PartHead, State
    from ros2_memory.columns.stored import Topic
    from ros2_memory.core.errors import BagError
    from ros2_memory.core.model import BagFile, StampedTransform, TimeWindow
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import Channel, IntArray, Mask

T = TypeVar("T", bound="Sized")

_HEAD_BYTES: Final = 400
"""About how much memory what is known of a part takes, besides the numbers of its bags."""
_COLUMN_BYTES: Final = 300
"""About how much memory what is known of a column takes."""
_NEIGHBOURS: Final = 512
"""Parts, about those of a day, whose zones of a column are read and remembered together."""
DAY_NS: Final[Ns] = 86_400 * NS_PER_S
DECODED_BYTES: Final = 8 << 20
"""The tables of a bag that is not stored are remembered if they take no more memory than this."""
_DROPPED: Final = "beyond the share of the store (store.max_share)"
_MOST_DAMAGED: Final = 10_000
"""Files whose damage is remembered."""


class _Heads(NamedTuple):
    """The parts of a topic, in order of their first log times.

    Attributes:
        coverage: which bags the timeline has.
        heads: the parts.
        firsts: the first log time of each.
        lasts: the last log time of each.
        counting_bags: how many bags of each the timeline has.
    """

    coverage: Coverage
    heads: Sequence[PartHead]
    firsts: IntArray
    lasts: IntArray
    counting_bags: IntArray

    @classmethod
    def of(cls, heads: Sequence[PartHead], coverage: Coverage) -> _Heads:
        """Returns the parts, each with the bags that a coverage has for it."""
        return cls(
            coverage,
            heads,
            np.array([head.first for head in heads], np.int64),
            np.array([head.last for head in heads], np.int64),
            coverage.counts([head.bags for head in heads]),
        )

    def within(self, window: TimeWindow) -> list[PartHead]:
        """Returns the parts that may have rows in a window."""
        is_within = window.overlapping(self.firsts, self.lasts) & (self.counting_bags > 0)
        return [self.heads[nth] for nth in np.flatnonzero(is_within).tolist()]


class _ColumnZones(NamedTuple):
    """The zones of a column of a topic in neighbouring parts.

    Attributes:
        newest: the newest part that was looked up; it need not have the column.
        packed: how the column is packed, without data, by part; deleted parts may be among them.
        zones: the zones of these parts.
    """

    newest: int
    packed: Mapping[int, Packed]
    zones: Zones

    def with_newer(self, newest: int, packed: Mapping[int, Packed]) -> _ColumnZones:
        """Returns these zones and those of newer parts."""
        zones = Zones.of([*packed], [column.zone for column in packed.values()])
        return _ColumnZones(
            max([newest, *packed]), {**self.packed, **packed}, self.zones.joined(zones)
        )

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        texts = sum(len(column.zone.words or "") for column in self.packed.values())
        return _COLUMN_BYTES * len(self.packed) + texts + self.zones.memory_bytes


_NO_ZONES: Final = _ColumnZones(0, {}, Zones.of([], []))


@dataclass(frozen=True, slots=True)
class Caches:
    """Caches of all scanners, and of data derived from parts, within one capacity.

    So the memory of a server does not grow with the robots that it is asked about.

    Attributes:
        read: unpacked columns, by part and path; fragments, by kind and key.
        zones: the zones of a column, by topic, path and the first of `_NEIGHBOURS` parts.
        heads: the parts of a topic, by its name.
        decoded: the tables of bags that are not stored, in groups, by file, topic and window.
        clock_steps: the steps of the clock in a pause, by the pause and the bags beside it.
        statics: the static transforms of sessions of a timeline, by topics.
        sights: what detectors saw in ten minutes, by these and what it is computed from.
        things: what was estimated from all bags of a timeline, by settings.
    """

    read: ByteLru[object]
    zones: ByteLru[_ColumnZones]
    heads: ByteLru[_Heads]
    decoded: ByteLru[list[list[Table]]]
    clock_steps: ByteLru[tuple[ClockStep, ...]]
    statics: ByteLru[tuple[Timeline, Mapping[frozenset[str], Sequence[StampedTransform]]]]
    sights: ByteLru[object]
    things: ByteLru[tuple[Timeline, object]]

    @classmethod
    def of(cls, cache_mb: int = 64) -> Caches:
        """Returns caches that take so much memory together, in MiB."""
        whole = ByteLru[Any](cache_mb << 20)
        return cls(**{cache.name: whole.namespace() for cache in fields(cls)})

    def namespace(self) -> Caches:
        """Returns caches with keys of their own, within the same capacity."""
        return Caches(
            **{cache.name: getattr(self, cache.name).namespace() for cache in fields(self)}
        )


class Scanner:
    """Reads the stored parts of one bag directory. Thread-safe.

    Args:
        store: the store; None if nothing is stored.
        bag_dir: the bag directory.
        reading: identifies the settings with which bags are read, on which fragments depend.
        large: the turn to hold much of a bag in memory, which large columns need, too.
        caches: the caches of all scanners; None for some of its own.

    Attributes:
        store: as given.
        covering: says which bags are stored; None without a store.
        caches: the part of the caches that is its own.
    """

    def __init__(
        self,
        store: ColumnStore | None,
        bag_dir: Path,
        reading: str = "",
        large: LargeReads | None = None,
        caches: Caches | None = None,
    ) -> None:
        self.store = store
        self._large = large or LargeReads()
        self.covering = None if store is None else Covering(store, bag_dir)
        self.caches = Caches.of() if caches is None else caches.namespace()
        self._reading = reading
        self._damaged: dict[tuple[str | Ns, ...], str] = {}
        # Outlines depend on no settings, so that they serve where columns were dropped.
        self._outlines = Fragments(store, OUTLINE, "", self.caches.read)
        self._fragments: dict[str, object] = {OUTLINE.name: self._outlines}

    def met_damage(self, bag: BagFile, error: BagError) -> None:
        """Remembers what is wrong with a part of a bag: only reading the bag finds that out."""
        if error.lost is None:
            return
        if len(self._damaged) >= _MOST_DAMAGED:
            self._damaged.clear()
        self._damaged[bag.identity] = error.reason

    def damaged_parts(self, bags: Iterable[BagFile]) -> list[tuple[BagFile, str]]:
        """Returns the bags of which a part was found damaged since the program began, and how."""
        if not self._damaged:  # else no bag's identity is needed
            return []
        damaged = self._damaged
        return [(bag, damaged[bag.identity]) for bag in bags if bag.identity in damaged]

    def fragments(self, kind: FragmentKind[T]) -> Fragments[T]:
        """Returns the fragments of a kind."""
        if kind.name not in self._fragments:
            fragments = Fragments(self.store, kind, self._reading, self.caches.read)
            self._fragments.setdefault(kind.name, fragments)
        # By name: each kind has one type.
        return cast("Fragments[T]", self._fragments[kind.name])

    def outlines_made(self, timeline: Timeline, window: TimeWindow) -> Iterator[Ns]:
        """Makes the outlines of whole parts with rows in a window, the newest part first.

        Yields:
            The first log time (ns) of each part, once its outline is made.
        """
        coverage = self.coverage(timeline)
        if coverage is None:
            return
        topics = timeline.topics()
        heads = [head for topic in topics for head in self.parts(topic, window, coverage)]
        for head in sorted(heads, key=lambda head: head.first, reverse=True):
            key = _outline_key(head)
            if head.is_whole and not self._outlines.get(key):
                unit = self.part(head, coverage)
                if unit is not None:
                    self._outlines.put(key, outline_of(unit.table, unit.times()))
            yield head.first

    def fragments_of_others(self) -> list[Ns]:
        """Returns the log times (ns) at which only fragments of other settings begin."""
        return [] if self.store is None else self.store.fragments_of_others(self._reading)

    def write_fragments(self) -> None:
        """Stores the fragments that were made since the last call."""
        for fragments in [*self._fragments.values()]:
            cast("Fragments[Sized]", fragments).write()

    def coverage(self, timeline: Timeline) -> Coverage | None:
        """Returns which bags of a timeline are stored; None without a store."""
        return None if self.covering is None else self.covering.of(timeline)

    def channels(self, timeline: Timeline, bag: BagFile) -> list[Channel]:
        """Returns the channels of all topics ever stored; none if `bag` is not stored."""
        coverage = self.coverage(timeline)
        if self.store is None or coverage is None or bag in coverage.missing:
            return []
        return [topic.channel for topic in self.store.topics().values()]

    def parts(self, topic: str, window: TimeWindow, coverage: Coverage) -> list[PartHead]:
        """Returns the parts of a topic that may have rows in a window."""
        if self.store is None:
            return []
        cached = self.caches.heads.get(topic)
        if cached is None or cached.coverage is not coverage:
            failures = self.store.failures
            heads = self._read_heads(self.store, topic, coverage.state)
            cached = _Heads.of(heads, coverage)
            if self.store.failures == failures:
                size = sum(_HEAD_BYTES + head.bags.nbytes for head in heads)
                self.caches.heads.put(topic, cached, 1000 + size)
        return cached.within(window)

    def _read_heads(self, store: ColumnStore, topic: str, state: State) -> list[PartHead]:
        """Returns the parts of a topic in a state; reads only those that are not in the cache."""
        cached = self.caches.heads.get(topic)
        heads: list[PartHead] = []
        if cached is not None and cached.coverage.state.deletion == state.deletion:
            heads += cached.heads
            if cached.coverage.state == state:
                return heads
        newest = max((head.number for head in heads), default=0)
        heads += store.parts(topic, newest)
        return sorted(heads, key=lambda head: (head.first, head.number))

    def matching(
        self, heads: Sequence[PartHead], may_match: Callable[[PartZones], bool | Mask]
    ) -> Mask:
        """Returns which parts may match, by their zones."""
        possible = np.ones(len(heads), np.bool_)
        topics = np.array([head.topic for head in heads], np.int64)
        numbers = np.array([head.number for head in heads], np.int64)
        for number in np.unique(topics).tolist():
            topic = None if self.store is None else self.store.topic(number)
            if topic is not None:
                is_of_topic = topics == number
                of_topic = numbers[is_of_topic]
                zones = partial(self._zones, number, of_topic)
                possible[is_of_topic] = may_match(PartZones(topic, of_topic, zones))
        return possible

    def bounds(self, heads: Sequence[PartHead], path: str) -> dict[int | None, tuple[float, float]]:
        """Returns the least and greatest value of a column by part; infinite if not known."""
        by_part: dict[int | None, tuple[float, float]] = {}
        for topic in {head.topic for head in heads}:
            parts = [head.number for head in heads if head.topic == topic]
            zones = self._zones(topic, np.array(parts, np.int64), path)
            bounds = zip(zones.low.tolist(), zones.high.tolist(), strict=True)
            by_part.update(zip(parts, bounds, strict=True))
        return by_part

    @property
    def _store_of_parts(self) -> ColumnStore:
        """The store that has the parts.

        Raises:
            GoneError: there is none.
        """
        if self.store is None:
            raise GoneError
        return self.store

    def _zones(self, topic: int, parts: IntArray, path: str) -> Zones:
        """Returns the zones of a column in some parts of a topic."""
        ascending = np.sort(parts)
        newest = ascending[np.diff(ascending // _NEIGHBOURS, append=-1) != 0].tolist()
        zones = _NO_ZONES.zones
        for part in newest:
            zones = zones.joined(self._column_zones(topic, path, part).zones)
        return zones.among(parts)

    def _column_zones(self, topic: int, path: str, part: int) -> _ColumnZones:
        """Returns the zones of a column of a topic, in a part and in its older neighbours."""
        store = self._store_of_parts
        first = part // _NEIGHBOURS * _NEIGHBOURS
        key = (topic, path, first)
        known = self.caches.zones.get(key) or _NO_ZONES
        if part > known.newest:
            failures = store.failures
            newer = range(max(first, known.newest + 1), first + _NEIGHBOURS)
            known = known.with_newer(part, store.zones(topic, path, newer))
            if store.failures == failures:
                self.caches.zones.put(key, known, known.memory_bytes)
        return known

    def part(self, head: PartHead, coverage: Coverage) -> Unit | None:
        """Returns a part; None if no row of it counts.

        Raises:
            GoneError: it was deleted meanwhile.
        """
        offset = self._store_of_parts.offset
        topic = self._store_of_parts.topic(head.topic)
        if topic is None:
            raise GoneError
        counting = coverage.known(head.bags)
        if not counting.size:
            return None
        table = self._table(head, topic)

        def load(path: str) -> IntArray | None:
            packed = table.packed(path)
            if packed is None:
                return None
            return np.asarray(self._column(head.number, path, packed), np.int64)

        def bag_of(number: int) -> BagFile:
            bag = coverage.bag(number + offset)
            if bag is None:
                raise GoneError
            return bag

        return Unit(
            head.number,
            table,
            head.first,
            head.last,
            load,
            counting - offset,
            bag_of,
            head.number if head.is_whole else None,
            counting.size == head.bags.size,
        )

    def _table(self, head: PartHead, topic: Topic) -> StoredTable:
        """Returns the table of a part; its columns are unpacked when they are first used."""
        packed = partial(self.packed, head, {LOG_TIME, BAG, *topic.layout.paths})

        def load(path: str) -> Column:
            column = packed(path)
            if column is None:
                raise KeyError(path)
            return self._column(head.number, path, column)

        left_out = topic.left_out
        if head.dropped:
            left_out = {**left_out, **dict.fromkeys(head.dropped, _DROPPED)}
        zeros = np.zeros(head.messages, np.int64)  # `Unit` loads the true times
        return StoredTable(
            topic.channel,
            zeros,
            zeros,
            zeros,
            *lazy_columns(topic.layout, load, head.dropped),
            left_out,
            define=lambda: topic.definition,
            packed=packed,
            outline=partial(self._outlines.get, _outline_key(head), DAY_NS),
            memory=self.caches.read,
            number=head.number,
        )

    def packed(self, head: PartHead, always: Collection[str], path: str) -> Packed | None:
        """Returns how a column of a part is packed, without data; None if there is no such column.

        Args:
            head: of the part.
            always: the paths of the columns that each part of the topic has.
            path: of the column.

        Raises:
            GoneError: a column in `always` is missing: the part was deleted meanwhile, or the store
                cannot be read.
        """
        packed = self._column_zones(head.topic, path, head.number).packed.get(head.number)
        if packed is None and path in always:
            raise GoneError
        return packed

    def _column(self, part: int, path: str, packed: Packed) -> Column:
        """Returns a column of a part; remembers it, but not its compressed bytes.

        Raises:
            GoneError: the part was deleted meanwhile, or the store cannot be read, or is damaged.
        """
        key = (part, path)
        cached = self.caches.read.get(key)
        if cached is not None:
            return cast("Column", cached)
        # The zone has the one value of a constant number.
        is_constant = packed.codec.endswith(" constant") and not packed.codec.startswith("text")
        stored = self._stored_bytes(part, path) if packed.count and not is_constant else b""
        try:
            data = decompress(stored) if stored else b""
            column = unpack(packed.codec, packed.count, packed.zone.least, data)
        except (ValueError, TypeError, LookupError, ArithmeticError, struct.error) as error:
            # Else each question about the part would fail, for ever.
            self._store_of_parts.give_up(part, error)
            raise GoneError from error
        has_row_numbers = path == BAG or path.endswith("#")
        if has_row_numbers and not isinstance(column, Texts) and all(column.strides):
            # Numbers of rows and bags are not negative, and few need eight bytes.
            column = column.astype(np.min_scalar_type(column.max(initial=0)))
        self.caches.read.put(key, column, column_bytes(column))
        return column

    def _stored_bytes(self, part: int, path: str) -> bytes:
        stored = self._store_of_parts.part_data(part, path)
        if stored is None:
            raise GoneError
        if is_large(stored):
            self._large.acquire()
        return stored


def _outline_key(head: PartHead) -> FragmentKey:
    # The topic as settings, since the outlines of a day and topic are read together.
    return FragmentKey(head.first, str(row_id(head.topic)), (head.number,))

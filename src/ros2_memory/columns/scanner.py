"""What is stored of a bag directory: parts, with zones and columns that are remembered.

It lies between a `Scan`, which asks for parts, and the `ColumnStore`, which reads the bytes of
their columns. Of a part that nothing needs not even the times are unpacked.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, fields
from functools import partial, reduce
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar, cast

import numpy as np

from ros2_memory.columns.coverage import Coverage, Covering
from ros2_memory.columns.database import row_id
from ros2_memory.columns.fragments import FragmentKey, FragmentKind, Fragments, Sized
from ros2_memory.columns.pack import Packed, decompressed, is_large, unpack
from ros2_memory.columns.stored import OUTLINE, StoredTable, lazy_columns, outline_of
from ros2_memory.columns.table import Column, Table, Texts, column_bytes
from ros2_memory.columns.units import GoneError, Unit
from ros2_memory.columns.writing import BAG, LOG_TIME
from ros2_memory.columns.zones import PartZones, Zones
from ros2_memory.core.errors import BagContradictionError, BagError
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.analysis.clock_steps import ClockStep
    from ros2_memory.columns.store import ColumnStore, PartHead
    from ros2_memory.columns.transforms import Pair
    from ros2_memory.core.model import BagFile, StampedTransform, TimeWindow
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import Channel, IntArray, Mask

T = TypeVar("T", bound="Sized")

_HEAD_BYTES: Final = 400
"""About how much memory what is known of a part takes, besides the numbers of its bags."""
_COLUMN_BYTES: Final = 300
"""About how much memory what is known of a column takes."""
_TOGETHER: Final = 512
"""Parts with so many numbers in a row, as a day has, are known together."""
DAY_NS: Final[Ns] = 86_400 * NS_PER_S
DECODED_BYTES: Final = 8 << 20
"""The tables of a bag that is not stored are remembered if they take no more memory than this."""
_DROPPED: Final = "beyond the share of the store (store.max_share)"
_MOST_DAMAGED: Final = 10_000
"""Files whose damage is remembered."""


class _Heads(NamedTuple):
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
        return cls(
            coverage,
            heads,
            np.array([head.first for head in heads], np.int64),
            np.array([head.last for head in heads], np.int64),
            coverage.counts([head.bags for head in heads]),
        )

    def within(self, window: TimeWindow) -> list[PartHead]:
        """Returns the parts that may have rows in a window."""
        is_within = (self.live > 0) & (self.firsts < window.stop) & (self.lasts >= window.start)
        return [self.heads[nth] for nth in np.flatnonzero(is_within).tolist()]


class _Known(NamedTuple):
    """What is known of a column of a topic in neighbouring parts, without values.

    Attributes:
        newest: the newest of these parts; it need not have the column.
        packed: by part, how the column is packed; also of parts that were deleted since.
        zones: those of the parts.
    """

    newest: int
    packed: Mapping[int, Packed]
    zones: Zones

    def joined(self, newest: int, packed: Mapping[int, Packed]) -> _Known:
        """Returns it with what is known of newer parts."""
        zones = Zones.of([*packed], [of_part.zone for of_part in packed.values()])
        return _Known(
            max([newest, *packed]),
            {**self.packed, **packed},
            self.zones.joined(zones),
        )

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        words = (of_part.zone.words for of_part in self.packed.values())
        texts = sum(map(len, filter(None, words)))
        return _COLUMN_BYTES * len(self.packed) + texts + self.zones.memory_bytes


_UNKNOWN: Final = _Known(0, {}, Zones.of([], []))


@dataclass(frozen=True, slots=True)
class Caches:
    """What scanners read last, and what they made of it, within one capacity for all of them.

    So the memory of a server does not grow with the robots that it is asked about.

    Attributes:
        read: by part and path, unpacked columns; by kind and key, fragments.
        known: by topic, path and the first of the parts, what is known of a column in them.
        heads: by topic, its parts.
        decoded: by file, topic and window, the tables of bags that are not stored, in groups.
        pairs: by part, the parents and children of its transforms.
        clock_steps: by pause and the bags beside it, the steps of the clock in it.
        statics: by topics, the static transforms of sessions of a timeline.
        sights: by ten minutes and all that they follow from, what detectors saw.
        things: by settings, what was estimated of all bags of a timeline.
    """

    read: ByteLru[object]
    known: ByteLru[_Known]
    heads: ByteLru[_Heads]
    decoded: ByteLru[list[list[Table]]]
    pairs: ByteLru[frozenset[Pair]]
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
        """Returns caches with keys of their own, within the capacities of these."""
        return Caches(
            **{cache.name: getattr(self, cache.name).namespace() for cache in fields(self)}
        )


class Scanner:
    """What is stored of one bag directory, and what was read of it last. Thread-safe.

    Args:
        store: the store; None where nothing is stored.
        bag_dir: the bag directory.
        reading: what identifies how bags are read, on which fragments depend besides the bags.
        large: the turn to hold much of a bag, which large columns need, too.
        caches: those of all scanners; None where it has some of its own.

    Attributes:
        caches: what was read last.
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
        self._covering = None if store is None else Covering(store, bag_dir)
        self.caches = Caches.of() if caches is None else caches.namespace()
        self._reading = reading
        self._damaged: dict[tuple[str | Ns, ...], str] = {}
        # They follow from columns alone, and are of use where these were dropped.
        self._outlines = Fragments(store, OUTLINE, "", self.caches.read)
        self._fragments: dict[str, object] = {OUTLINE.name: self._outlines}

    def met_damage(self, bag: BagFile, error: BagError) -> None:
        """Remembers why a part of a bag is lost, if it is: only who reads it finds that out."""
        if error.lost is None or isinstance(error, BagContradictionError):
            return
        if len(self._damaged) >= _MOST_DAMAGED:
            self._damaged.clear()
        self._damaged[bag.identity] = error.reason

    def damaged_parts(self, bags: Sequence[BagFile]) -> list[tuple[BagFile, str]]:
        """Returns the bags of which a part was found lost since the program began, and why."""
        if not self._damaged:
            return []
        reasons = ((bag, self._damaged.get(bag.identity)) for bag in bags)
        return [(bag, reason) for bag, reason in reasons if reason is not None]

    def fragments(self, kind: FragmentKind[T]) -> Fragments[T]:
        """Returns the fragments of a kind."""
        if kind.name not in self._fragments:
            fragments = Fragments(self.store, kind, self._reading, self.caches.read)
            self._fragments.setdefault(kind.name, fragments)
        # By name: each kind has one type.
        return cast("Fragments[T]", self._fragments[kind.name])

    def outlines_made(self, timeline: Timeline, window: TimeWindow) -> Iterator[Ns]:
        """Makes the outlines of the whole parts that have rows in a window, the newest first.

        Yields a log time (ns) of each.
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
        """Returns where slices begin that have fragments of other settings alone, newest first."""
        return [] if self.store is None else self.store.fragments_of_others(self._reading)

    def write_fragments(self) -> None:
        """Stores the fragments that were made since."""
        for fragments in [*self._fragments.values()]:
            cast("Fragments[Sized]", fragments).write()

    def coverage(self, timeline: Timeline) -> Coverage | None:
        """Returns which bags of a timeline are stored; None without a store."""
        return None if self._covering is None else self._covering.of(timeline)

    def channels(self, timeline: Timeline, bag: BagFile) -> list[Channel]:
        """Returns the channels of all that was ever stored; none where a bag is not stored."""
        coverage = self.coverage(timeline)
        if self.store is None or coverage is None or bag in coverage.missing:
            return []
        return [topic.channel for topic in self.store.topics().values()]

    def parts(self, topic: str, window: TimeWindow, coverage: Coverage) -> list[PartHead]:
        """Returns the parts of a topic that may have rows in a window."""
        if self.store is None:
            return []
        state = coverage.state
        cached = self.caches.heads.get(topic)
        if cached is None or cached.coverage is not coverage:
            failures = self.store.failures
            heads: list[PartHead] = []
            if cached is not None and cached.coverage.state.deletion == state.deletion:
                heads = [*cached.heads]
            if cached is None or cached.coverage.state != state:
                newest = max((head.number for head in heads), default=0)
                heads += self.store.parts(topic, newest)
                heads.sort(key=lambda head: (head.first, head.number))
            cached = _Heads.of(heads, coverage)
            if self.store.failures == failures:
                size = sum(_HEAD_BYTES + head.bags.nbytes for head in heads)
                self.caches.heads.put(topic, cached, 1000 + size)
        return cached.within(window)

    def matching(
        self, heads: Sequence[PartHead], may_match: Callable[[PartZones], bool | Mask]
    ) -> Mask:
        """Returns which of some parts may have rows that are wanted, by their zones."""
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

    def bounds(self, heads: Sequence[PartHead], path: str) -> dict[int, tuple[float, float]]:
        """Returns the least and greatest value of a column by part; infinite if not stored."""
        by_part: dict[int, tuple[float, float]] = {}
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
        newest = ascending[np.diff(ascending // _TOGETHER, append=-1) != 0].tolist()
        known = (self._known(topic, path, part).zones for part in newest)
        return reduce(Zones.joined, known, _UNKNOWN.zones).among(parts)

    def _known(self, topic: int, path: str, part: int) -> _Known:
        """Returns what is known of a column of a topic, in a part and in older ones beside it."""
        store = self._store_of_parts
        first = part // _TOGETHER * _TOGETHER
        key = (topic, path, first)
        known = self.caches.known.get(key) or _UNKNOWN
        if part > known.newest:
            failures = store.failures
            newer = range(max(first, known.newest + 1), first + _TOGETHER)
            known = known.joined(part, store.zones(topic, path, newer))
            if store.failures == failures:
                self.caches.known.put(key, known, known.memory_bytes)
        return known

    def part(self, head: PartHead, coverage: Coverage) -> Unit | None:
        """Returns a part; None where no row of it counts.

        Raises:
            GoneError: it was deleted meanwhile.
        """
        offset = self._store_of_parts.offset
        topic = self._store_of_parts.topic(head.topic)
        if topic is None:
            raise GoneError
        packed = partial(self.packed, head, {LOG_TIME, BAG} | topic.layout.slots.keys())

        def load(path: str) -> Column:
            column = packed(path)
            if column is None:
                raise KeyError(path)
            return self._column(head.number, path, column)

        counting = coverage.of_part(head.number, head.bags)
        if not counting.size:
            return None

        def integers(path: str) -> IntArray | None:
            return None if packed(path) is None else np.asarray(load(path), np.int64)

        def bag_of(number: int) -> BagFile:
            bag = coverage.bag(number + offset)
            if bag is None:
                raise GoneError
            return bag

        left_out = topic.layout.left_out
        if head.dropped:
            left_out = {**left_out, **dict.fromkeys(head.dropped, _DROPPED)}
        none = np.zeros(head.messages, np.int64)  # `Unit` loads the true times
        table = StoredTable(
            topic.channel,
            none,
            none,
            none,
            *lazy_columns(topic.layout, load, head.dropped),
            left_out,
            define=lambda: topic.definition,
            packed=packed,
            outline=partial(self._outlines.get, _outline_key(head), DAY_NS),
            memory=self.caches.read,
            number=head.number,
        )
        return Unit(
            head.number,
            table,
            head.first,
            head.last,
            integers,
            counting - offset,
            bag_of,
            head.number if head.is_whole else None,
            counting.size == head.bags.size,
        )

    def packed(self, head: PartHead, always: Collection[str], path: str) -> Packed | None:
        """Returns what is known of a column of a part; None where it has no such one.

        Raises:
            GoneError: it is one that each part has `always`, and the part was deleted meanwhile, or
                the store cannot be read.
        """
        packed = self._known(head.topic, path, head.number).packed.get(head.number)
        if packed is None and path in always:
            raise GoneError
        return packed

    def _column(self, part: int, path: str, packed: Packed) -> Column:
        """Returns a column of a part, of which the compressed bytes are not kept.

        Raises:
            GoneError: the part was deleted meanwhile, or the store cannot be read, or is damaged.
        """
        key = (part, path)
        cached = self.caches.read.get(key)
        if cached is not None:
            return cast("Column", cached)
        stored: bytes | None = b""
        # The one value of a constant is its least, unless it is a text.
        is_constant = packed.codec.endswith(" constant") and not packed.codec.startswith("text")
        if packed.count and not is_constant:
            stored = self._store_of_parts.part_data(part, path)
            if stored is None:
                raise GoneError
            if is_large(stored):
                self._large.acquire()
        try:
            data = decompressed(stored) if stored else b""
            column = unpack(packed.codec, packed.count, packed.zone.least, data)
        except (ValueError, LookupError, struct.error) as error:
            # Else each question about the part would fail, for ever.
            self._store_of_parts.give_up(error)
            raise GoneError from error
        is_number = path == BAG or path.endswith("#")
        if is_number and not isinstance(column, Texts) and all(column.strides):
            # Numbers of rows and bags: none is negative, and few need eight bytes.
            column = column.astype(np.min_scalar_type(column.max(initial=0)))
        self.caches.read.put(key, column, column_bytes(column))
        return column


def _outline_key(head: PartHead) -> FragmentKey:
    # Those of a day are read together: of one topic alone.
    return FragmentKey(head.first, str(row_id(head.topic)), (head.number,))

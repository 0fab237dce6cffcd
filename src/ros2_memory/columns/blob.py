"""All tables of a bag in one blob, and tables that unpack a column when it is asked for.

The columns of a topic are the same from bag to bag, so a blob holds none of their names: a
`Layout` does, which its caller keeps under a number. What the blob is, once decompressed (numbers
are little-endian; `k` values of 8 bytes lie in planes, the lowest byte of each first, as they then
compress best)::

    1       format (`pack.FORMAT`)
    2       t, the number of tables
    t times:
      4     number of the topic, as the caller has it
      1     which of these it has: 1 publish times, 2 places (else all are 0), 4 hashes of payloads
      2     p, the number of its packed columns
      2     s, the number of its sequences, also of those within sequences
      4     rows
      4 s   elements of each sequence, in order
    4       k, the number of packed columns: of each table in turn the log times, those of 1, 2
            and 4 that it has, and then, of its layout, the columns; of each sequence the owners,
            its columns and its sequences in turn
    2       length of the codecs
    ...     codecs without their type, separated by newlines
    2 k     which codec
    4 k     bytes of the column's data
    4 k     greatest error, as a float32 that is not less
    4 k     nulls
    8 k     least: an int64, uint64 or float64; 0 of texts and where there is none
    8 k     greatest, but for the bits that it has in common with the least (exclusive or)
    ...     the data, one column after the other

Publish times are packed in place of log times where both are there, and log times as what they are
later: the middleware delays every message by a little, and publishers keep time.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple, cast

import numpy as np

from ros2_memory.columns.pack import (
    FORMAT,
    Known,
    Packed,
    carried,
    compressed,
    decompressed,
    eight_bytes,
    number_of,
    pack_columns,
    unpack,
    zone_of_texts,
)
from ros2_memory.columns.steps import EXACT, Step
from ros2_memory.columns.stored import StoredTable, Times, Topic, lazy_table
from ros2_memory.columns.table import Column, Elements, Numbers, Table, Zone

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.columns.layout import Layout
    from ros2_memory.storage.base import IntArray

_PUBLISHED: Final = 1
_PLACES: Final = 2
_HASHES: Final = 4


class Entry(NamedTuple):
    """A table to be packed: the number that its topic and layout have at the caller's."""

    topic: int
    layout: Layout
    table: Table


def pack_tables(entries: Sequence[Entry], *, places: bool = False) -> bytes:
    """Returns the tables as one compressed blob.

    Publish times are packed where there are hashes, with which they tell copies of a message.
    Elsewhere they come back as log times.

    Args:
        entries: the tables, in any order.
        places: whether places are packed. Without them messages still have an order: they come back
            as 0, 1, 2 among the messages of all these tables that have one log time.

    Raises:
        ValueError: a table has other columns than its layout.
    """
    heads: list[bytes] = []
    columns: list[_Source] = []
    tables = [entry.table for entry in entries]
    orders = [table.places for table in tables] if places else _order_of_ties(tables)
    for (topic, layout, table), order in zip(entries, orders, strict=True):
        if not layout.fits(table):
            raise ValueError(f"a table of {table.channel.topic} has other columns than its layout")
        published = table.payload_hashes is not None
        flags, first = 0, [table.log_times]
        if published:
            flags |= _PUBLISHED
            first = [table.log_times - table.publish_times, table.publish_times]
        if order is not None:
            flags |= _PLACES
            first.append(order)
        if table.payload_hashes is not None:
            flags |= _HASHES
            first.append(table.payload_hashes)
        sources = [*(_Source(times) for times in first), *_sources(layout, table)]
        counts = [len(one.column) for one in sources[len(first) :] if one.are_owners]
        sizes = (len(sources), len(counts), len(table), *counts)
        heads.append(struct.pack(f"<IBHHI{len(counts)}I", topic, flags, *sizes))
        columns += sources
    packs = _packed(columns)
    head = struct.pack("<BH", FORMAT, len(heads)) + b"".join(heads)
    return compressed(head + _directory(packs) + b"".join(packed.data for packed in packs))


def _order_of_ties(tables: Sequence[Table]) -> list[IntArray | None]:
    """For each table the places of its messages among those of one log time; None if all are 0."""
    if not tables:
        return []
    log_times = np.concatenate([table.log_times for table in tables])
    places = np.concatenate([table.places for table in tables])
    order = np.lexsort((places, log_times))
    first = np.ones(len(order), np.bool_)
    first[1:] = np.diff(log_times[order]) != 0
    if first.all():
        return [None] * len(tables)
    nth = np.arange(len(order))
    ranks = np.empty_like(nth)
    ranks[order] = nth - np.maximum.accumulate(np.where(first, nth, 0))
    parts = np.split(ranks, np.cumsum([len(table) for table in tables])[:-1])
    return [part if part.any() else None for part in parts]


def pack_table(layout: Layout, table: Table) -> dict[str, Packed]:
    """Returns the columns of one table, each on its own, by the paths of `Layout.slots`.

    Times, places and hashes are not among them.

    Raises:
        ValueError: the table has other columns than the layout.
    """
    if not layout.fits(table):
        raise ValueError(f"a table of {table.channel.topic} has other columns than its layout")
    return dict(zip(layout.slots, _packed(list(_sources(layout, table))), strict=True))


class _Source(NamedTuple):
    """A column to be packed, and what is known of it if it was packed before."""

    column: Column
    step: Step = EXACT
    known: Known | None = None
    are_owners: bool = False


def _packed(sources: Sequence[_Source]) -> list[Packed]:
    packs = pack_columns([(source.column, source.step) for source in sources])
    return [
        packed if source.known is None else carried(packed, source.known)
        for packed, source in zip(packs, sources, strict=True)
    ]


def _sources(
    layout: Layout, table: Table, rows: Elements | None = None, around: str = ""
) -> Iterator[_Source]:
    """The columns of a table, or of elements of it, in the order of `Layout.slots`."""
    some = table if rows is None else rows
    for path, kind in layout.columns.items():
        whole = f"{around}{path}"
        zone = table.zone(whole)
        known = None if zone is None else Known(table.error(whole), zone)
        yield _Source(some.columns[path], kind.step, known)
    for path, inner in layout.sequences.items():
        elements = some.elements[path]
        yield _Source(elements.owners, are_owners=True)
        yield from _sources(inner, table, elements, f"{around}{path}.")


def _directory(packs: list[Packed]) -> bytes:
    """What is known of the columns, as the module's docstring shows it."""
    codecs: dict[str, int] = {}
    which = [codecs.setdefault(packed.codec.partition(" ")[2], len(codecs)) for packed in packs]
    errors = np.array([packed.error for packed in packs])
    with np.errstate(over="ignore"):
        stated = errors.astype("<f4")
    stated = np.where(stated < errors, np.nextafter(stated, np.float32(np.inf)), stated)
    sizes = np.array([len(packed.data) for packed in packs], "<u4")
    nulls = np.array([packed.zone.nulls for packed in packs], "<u4")
    leasts = [eight_bytes(packed.zone.least or 0) for packed in packs]
    greatests = [eight_bytes(packed.zone.greatest or 0) for packed in packs]
    least, greatest = (np.frombuffer(b"".join(some), "<u8") for some in (leasts, greatests))
    names = "\n".join(codecs).encode()
    return b"".join(
        (
            struct.pack("<IH", len(packs), len(names)),
            names,
            _in_planes(np.array(which, "<u2")),
            _in_planes(sizes),
            _in_planes(stated),
            _in_planes(nulls),
            _in_planes(least),
            _in_planes(greatest ^ least),
        )
    )


def _in_planes(numbers: Numbers) -> bytes:
    return numbers.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes()


def unpack_tables(
    blob: bytes, topics: Mapping[int, Topic], wanted: Callable[[int], bool] | None = None
) -> list[StoredTable]:
    """Returns the tables of a blob, in the order in which they were packed.

    Args:
        blob: what `pack_tables` returned.
        topics: the topics of the tables, by the number under which they were packed.
        wanted: of which numbers tables are returned; of all by default. Others cost nothing, and
            `topics` need not know them.

    Raises:
        ValueError: the blob is damaged, of another format, or not of these layouts.
    """
    data = decompressed(blob)
    form, count = struct.unpack_from("<BH", data)
    if form != FORMAT:
        raise ValueError(f"the blob of columns is of format {form}, this program reads {FORMAT}")
    at = 3
    heads: list[tuple[_Head, tuple[int, ...]]] = []
    for _ in range(count):
        head = _Head(*struct.unpack_from("<IBHHI", data, at))
        heads.append((head, struct.unpack_from(f"<{head.sequences}I", data, at + 13)))
        at += 13 + 4 * head.sequences
    packs = _Packs(data, at)
    first = 0
    tables: list[StoredTable] = []
    for head, counts in heads:
        if wanted is None or wanted(head.topic):
            tables.append(_table(packs, first, head, counts, topics[head.topic]))
        first += head.packs
    return tables


class _Head(NamedTuple):
    """The head of a table in a blob."""

    topic: int
    flags: int
    packs: int
    sequences: int
    rows: int


class _Packs:
    """The packed columns of a blob, by their number."""

    def __init__(self, data: bytes, at: int) -> None:
        count, length = struct.unpack_from("<IH", data, at)
        at += 6
        self._data = data
        self._codecs = data[at : at + length].decode().split("\n")
        planes = np.frombuffer(data, np.uint8, 30 * count, at + length).reshape(30, count)
        self._which = _from_planes(planes[:2], "<u2").astype(np.int64)
        self._starts = np.zeros(count + 1, np.int64)
        np.cumsum(_from_planes(planes[2:6], "<u4"), out=self._starts[1:])
        self._starts += at + length + 30 * count
        self._facts = np.ascontiguousarray(planes[6:].T)

    def packed(self, nth: int, dtype: str, count: int) -> Packed:
        """Returns one of them; `count` values of this type are in it."""
        codec = f"{dtype} {self._codecs[self._which[nth]]}"
        data = self._data[self._starts[nth] : self._starts[nth + 1]]
        if dtype == "text":
            return Packed(codec, count, 0.0, zone_of_texts(data), data)
        error, nulls, least, difference = struct.unpack("<fIQQ", self._facts[nth])
        zone = Zone(nulls=nulls)
        if nulls < count:
            least, greatest = (struct.pack("<Q", bits) for bits in (least, least ^ difference))
            zone = Zone(number_of(least, dtype), number_of(greatest, dtype), nulls)
        return Packed(codec, count, error, zone, data)


def unpacked(packed: Packed) -> Column:
    """Returns the values of a packed column."""
    return unpack(packed.codec, packed.count, packed.zone.least, packed.data)


def _from_planes(planes: NDArray[np.uint8], dtype: str) -> Numbers:
    return np.ascontiguousarray(planes.T).view(dtype).ravel()


def _table(
    packs: _Packs, first: int, head: _Head, counts: tuple[int, ...], topic: Topic
) -> StoredTable:
    """The table whose packed columns begin with number `first`."""
    has = [flag for flag in (_PUBLISHED, _PLACES, _HASHES) if head.flags & flag]
    begin = first + 1 + len(has)
    if len(topic.layout.slots) != first + head.packs - begin:
        raise ValueError(f"a blob has other columns of {topic.channel.topic} than its layout")

    @cache
    def packed(path: str) -> Packed:
        slot = topic.layout.slots[path]
        count = counts[slot.sequence - 1] if slot.sequence else head.rows
        return packs.packed(begin + slot.nth, slot.dtype, count)

    def known(path: str) -> Known:
        found = packed(path)
        return Known(found.error, found.zone)

    times = [
        cast("IntArray", unpacked(packs.packed(nth, "int64", head.rows)))
        for nth in range(first, begin)
    ]
    log_times, others = times[0], dict(zip(has, times[1:], strict=True))
    if _PUBLISHED in others:
        log_times = log_times + others[_PUBLISHED]
    kept = Times(
        log_times,
        others.get(_PUBLISHED, log_times),
        others.get(_PLACES, np.zeros(head.rows, np.int64)),
        others.get(_HASHES),
    )
    return lazy_table(head.topic, topic, kept, known, lambda path: unpacked(packed(path)))

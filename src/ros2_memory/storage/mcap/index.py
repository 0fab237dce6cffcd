"""Indexes an MCAP file: where its messages lie, by its summary section.

The summary section is believed if its checksum matches and it agrees with itself, with the heads of
the chunks and with the message indexes that are read. Every other file (no summary, no statistics,
channels not repeated, no message index, no chunks, cut short) is scanned, which finds the same from
the messages themselves.
"""

from __future__ import annotations

import struct
import zlib
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter, itemgetter, le
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from ros2_memory.core.bag_summary import MESSAGES_MISSING, OUT_OF_ORDER_NS, WRONG_STATISTICS
from ros2_memory.core.pauses import SHORTEST_PAUSE_NS, Pauses, pauses_among
from ros2_memory.core.timebase import MAX_NS, Ns, unix_from_ns
from ros2_memory.storage.cache import unshared_bytes
from ros2_memory.storage.errors import (
    MAX_CHUNKS,
    MAX_SECTION_BYTES,
    SizeLimit,
    UnreadableError,
    reason_of,
)
from ros2_memory.storage.mcap.chunk import (
    Column,
    Extent,
    columns_from_index,
    decompressed_chunk,
    decompressed_prefix,
    extents_from_index,
    index_bytes,
    indexed_channels,
    read_compressed_chunk,
)
from ros2_memory.storage.mcap.records import (
    FOOTER,
    MAGIC_SIZE,
    RECORD,
    Declarations,
    section_records,
    statistics,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from mcap.records import Statistics

    from ros2_memory.storage.base import Channel
    from ros2_memory.storage.file_io import OpenFile

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
"""A chunk's first and last log time, offset and length, and the bytes of its index offsets."""
_INDEX_OFFSET: Final = struct.Struct("<HQ")
INDEX_OFFSET_BYTES: Final = _INDEX_OFFSET.size
"""Bytes of a chunk index for the place of one channel's message index."""
_INDEX_LENGTH: Final = struct.Struct("<Q")
_new_tuple: Final = tuple.__new__
_MAX_CACHED_BYTES: Final = 128 << 10

# Plain integers: the opcodes of records are compared with them some million times.
_DECLARES: Final = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))
_CHUNK_INDEX_OPCODE: Final = int(Opcode.CHUNK_INDEX)
_STATISTICS_OPCODE: Final = int(Opcode.STATISTICS)


class Chunk(NamedTuple):
    """One chunk of a file (a tuple: indexing a week makes millions).

    Attributes:
        offset: where its record begins in the file.
        length: bytes of its record.
        start: the earliest log time in it.
        end: the latest log time in it, inclusive.
        channels: the channels that have messages in it.
        index_places: the offsets of its message indexes, as they are written in the file; None if
            there are none to rely on.
        index_length: bytes of its message indexes, which follow it.
        usable: how many of its decompressed bytes are whole records, if the file ends inside it.
    """

    offset: int
    length: int
    start: Ns
    end: Ns
    channels: frozenset[int]
    index_places: bytes | None = None
    index_length: int = 0
    usable: int | None = None

    @property
    def index_offsets(self) -> dict[int, int]:
        """Where each channel's message index lies in the file."""
        return dict(_INDEX_OFFSET.iter_unpack(self.index_places or b""))


class DoubtError(UnreadableError):
    """The summary section cannot be relied on; the text is a note on it, or empty."""


class Declared(NamedTuple):
    """What the schema and channel records of a summary section declare.

    Attributes:
        channels: the channels by their number in the file.
        channel_bytes: memory that the channels take which no other file shares.
        declarations: the records, to compare others with.
    """

    channels: Mapping[int, Channel]
    channel_bytes: int
    declarations: Declarations


class Summary(NamedTuple):
    """What a summary section states; it begins at `start` in the file."""

    start: int
    declared: Declared
    chunks: list[Chunk]
    statistics: Statistics | None


def read_summary(file: OpenFile) -> Summary:
    """Returns the summary section of a file.

    Raises:
        DoubtError: it is missing, or does not match its checksum.
        UnreadableError, struct.error and others: it is damaged.
    """
    start, section = _section(file)
    declaring: list[bytes] = []
    chunks: list[Chunk] = []
    stated: Statistics | None = None
    for opcode, begin, end in section_records(section):
        if opcode == _CHUNK_INDEX_OPCODE:
            chunks.append(_chunk(section, begin, end))
        elif opcode in _DECLARES:
            declaring.append(section[begin - RECORD.size : end])
        elif opcode == _STATISTICS_OPCODE:
            stated = statistics(section[begin:end])
    records = b"".join(declaring)
    declared = _declared if len(records) <= _MAX_CACHED_BYTES else _declared.__wrapped__
    return Summary(start, declared(records), chunks, stated)


def _section(file: OpenFile) -> tuple[int, bytes]:
    """Returns where the summary section begins, and its bytes."""
    footer_at = file.size - MAGIC_SIZE - FOOTER.size
    footer = file.read(footer_at, FOOTER.size)
    opcode, _, summary_at, _, crc = FOOTER.unpack(footer)
    if opcode != Opcode.FOOTER or not summary_at:
        raise DoubtError
    if footer_at - summary_at > MAX_SECTION_BYTES:
        raise DoubtError("its summary section is too large to be one")
    section = file.read(summary_at, footer_at - summary_at)
    if crc and zlib.crc32(footer[:-4], zlib.crc32(section)) != crc:
        raise DoubtError("its summary section does not match its checksum")
    return summary_at, section


def _chunk(section: bytes, at: int, end: int) -> Chunk:
    """Returns the chunk of the chunk index record whose body lies from `at` to `end`."""
    start, last, offset, length, places_size = _CHUNK_INDEX.unpack_from(section, at)
    at += _CHUNK_INDEX.size
    stop = at + places_size
    if stop + _INDEX_LENGTH.size > end or places_size % INDEX_OFFSET_BYTES:
        raise UnreadableError("damaged: a chunk index is shorter than it states")
    places = section[at:stop]
    # Slices with a step take the low and the high byte of every channel number at once.
    channels = _numbers(places[::INDEX_OFFSET_BYTES], places[1::INDEX_OFFSET_BYTES])
    (index_length,) = _INDEX_LENGTH.unpack_from(section, stop)
    # Past the function that takes the fields of a named tuple: it costs as much as all the rest.
    return _new_tuple(Chunk, (offset, length, start, last, channels, places, index_length, None))


@lru_cache(1024)
def _numbers(low: bytes, high: bytes) -> frozenset[int]:
    """Returns the channel numbers with these low and high bytes: one set for all equal ones."""
    return frozenset(one | other << 8 for one, other in zip(low, high, strict=True))


@lru_cache(32)
def _declared(records: bytes) -> Declared:
    declarations = Declarations()
    for opcode, begin, end in section_records(records):
        declarations.add(opcode, records[begin:end])
    channels = declarations.channels()
    return Declared(channels, unshared_bytes(channels), declarations)


_CHUNK: Final = int(Opcode.CHUNK)
_INDEXED: Final = frozenset((_CHUNK, int(Opcode.MESSAGE_INDEX)))
_OTHER_CHUNKS: Final = "its chunk indexes do not agree with its chunks"
OTHER_DECLARED: Final = "its summary section declares other channels or types than its messages"
_OUTSIDE: Final = "damaged: a chunk states other times than its messages have"
_STATED: Final = struct.Struct("<BQQQ")
"""A chunk record up to its times: opcode, length, first and last log time."""
_STATED_BYTES: Final = _STATED.size
_HEAD_BYTES: Final = RECORD.size
_SEAM_SHARE: Final = 16
_SEAM_TIMES: Final = 4
_SEAM_CHUNKS: Final = 3
_MOST_SEAMS: Final = 8
_stating: Final = _STATED.pack
_NEVER: Final = 1 << 64
"""Later than any time that a file can state."""


class Seam(NamedTuple):
    """A chunk after which the stated times do not go on as elsewhere in its file.

    Attributes:
        nth: its number; the next chunk is the other side.
        first: the earliest time that a chunk near it states, on either side.
        last: the latest.
    """

    nth: int
    first: Ns
    last: Ns


class McapIndex(NamedTuple):
    """The index of a file, without its payloads.

    Attributes:
        channels: the channels by their number in the file.
        channel_bytes: memory that the channels take which no other file shares.
        chunks: the chunks with messages, in file order.
        totals: the messages of each channel that has some.
        loose: the messages outside chunks, by channel; their places are offsets in the file.
        complete: whether the writer finished the file.
        notes: sentences on what is missing or wrong.
        set_back: by how much the log times of a channel go back from one chunk, or one loose
            message, to a later one, at most; 0 up to `OUT_OF_ORDER_NS`.
        pauses: where no channel has a message for more than `SHORTEST_PAUSE_NS`.
        seams: where the times of chunks do not go on from one to the next; empty after a scan.
        contradiction: how the indexes of the file contradict its messages, if that was found after
            they had been used; else empty.
        declared: what the summary section declares; None if the index comes from a scan.
    """

    channels: Mapping[int, Channel]
    channel_bytes: int
    chunks: tuple[Chunk, ...]
    totals: Mapping[int, Extent]
    loose: Mapping[int, Column] = MappingProxyType({})
    complete: bool = True
    notes: tuple[str, ...] = ()
    set_back: Ns = 0
    pauses: Pauses = ()
    seams: tuple[Seam, ...] = ()
    contradiction: str = ""
    declared: Declarations | None = None

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes, without the channels that files share."""
        places = sum([len(chunk.index_places or ()) for chunk in self.chunks])
        loose = sum([column.times.nbytes * 2 for column in self.loose.values()])
        return 1000 + self.channel_bytes + 400 * len(self.chunks) + places + loose


def chunk_columns(file: OpenFile, chunk: Chunk, wanted: Collection[int]) -> dict[int, Column]:
    """Returns the messages of the `wanted` channels of a chunk, by its message indexes.

    Raises:
        UnreadableError: the indexes are damaged, or disagree with the times that the chunk states.
    """
    offsets = {number: at for number, at in chunk.index_offsets.items() if number in wanted}
    region, base = _index_region(file, chunk), chunk.offset + chunk.length
    every = extents_from_index(region, chunk.index_offsets, base).values()
    first, last = min([each.first for each in every]), max([each.last for each in every])
    if (first, last) != (chunk.start, chunk.end):
        raise UnreadableError(_OUTSIDE)
    return columns_from_index(region, offsets, base)


def require_channels(file: OpenFile, chunk: Chunk) -> None:
    """Compares the channels that a chunk index names with the message indexes behind the chunk.

    Raises:
        UnreadableError: they differ.
    """
    if indexed_channels(_index_region(file, chunk)) != chunk.channels:
        raise UnreadableError(
            "damaged: a chunk index names other channels than have messages in its chunk"
        )


def _chunk_extents(file: OpenFile, chunk: Chunk) -> dict[int, Extent]:
    """Returns what `chunk_columns` would amount to, without sorting."""
    offsets, base = chunk.index_offsets, chunk.offset + chunk.length
    extents = extents_from_index(_index_region(file, chunk), offsets, base)
    start, end = chunk.start, chunk.end
    for each in extents.values():
        if not start <= each.first <= each.last <= end:
            raise UnreadableError(_OUTSIDE)
    return extents


def _set_back(file: OpenFile, chunks: Sequence[Chunk]) -> Ns:
    """Returns `McapIndex.set_back` for chunks with message indexes, in the order of writing.

    Chunks that overlap do not prove it: some writers sort channels into chunks.
    """
    latest = -1
    for chunk in chunks:
        if chunk.start < latest - OUT_OF_ORDER_NS:
            break
        latest = max(latest, chunk.end)
    else:
        return 0
    most: Ns = 0
    lasts: dict[int, Ns] = {}
    for chunk in chunks:
        for channel, extent in _chunk_extents(file, chunk).items():
            before = lasts.get(channel, extent.first)
            most = max(most, before - extent.first)
            lasts[channel] = max(before, extent.last)
    return beyond_disorder(most)


def _pauses(file: OpenFile, chunks: Sequence[Chunk]) -> Pauses:
    """Returns `McapIndex.pauses`; reads the indexes of those chunks alone that may have one."""
    firsts = np.array([chunk.start for chunk in chunks], np.int64)
    lasts = np.array([chunk.end for chunk in chunks], np.int64)
    is_long = lasts - firsts > SHORTEST_PAUSE_NS
    inside = [
        column.times
        for nth in np.flatnonzero(is_long).tolist()
        for column in chunk_columns(file, chunks[nth], chunks[nth].channels).values()
    ]
    return pauses_among(
        np.concatenate([firsts[~is_long], *inside]), np.concatenate([lasts[~is_long], *inside])
    )


def _seams(chunks: Sequence[Chunk]) -> tuple[Seam, ...]:
    """Returns `McapIndex.seams`.

    A writer fills one chunk after the other, so their times follow each other. Where all indexes of
    neighbouring chunks agree on wrong times there is a hole, or an overlap, of more than a
    `_SEAM_SHARE` of the two chunks, and of several times what is usual in the file. A file with
    many of them was written in another order, and they say nothing.
    """
    # Plain lists: for some thirty chunks arrays take twice as long.
    apart = [abs(other[2] - one[3]) for one, other in pairwise(chunks)]
    usual = _SEAM_TIMES * sorted(apart)[len(apart) // 2] if apart else 0
    seams: list[Seam] = []
    for nth in [nth for nth, gap in enumerate(apart) if gap > usual]:
        one, other = chunks[nth], chunks[nth + 1]
        if apart[nth] * _SEAM_SHARE > one.end - one.start + other.end - other.start:
            near = chunks[max(nth + 1 - _SEAM_CHUNKS, 0) : nth + 1 + _SEAM_CHUNKS]
            first, last = min([each.start for each in near]), max([each.end for each in near])
            seams.append(Seam(nth, first, last))
    return tuple(seams) if len(seams) <= _MOST_SEAMS else ()


def beyond_disorder(back: Ns) -> Ns:
    """Returns `back`; 0 if messages are merely out of order."""
    return back if back > OUT_OF_ORDER_NS else 0


def _index_region(file: OpenFile, chunk: Chunk) -> bytes:
    if chunk.index_length > MAX_SECTION_BYTES:
        raise UnreadableError("damaged: a message index is larger than any chunk")
    return file.read(chunk.offset + chunk.length, chunk.index_length)


def chunk_data(file: OpenFile, chunk: Chunk, limit: SizeLimit) -> bytes:
    """Returns the decompressed records of a chunk; see `decompressed_chunk`.

    Raises:
        UnreadableError: the chunk is damaged or larger than allowed.
    """
    body_at, body_size = chunk.offset + RECORD.size, chunk.length - RECORD.size
    head, compressed = read_compressed_chunk(file, body_at, body_size, limit.max_bytes)
    if chunk.usable is not None:
        return decompressed_prefix(head, compressed, limit)[: chunk.usable]
    return decompressed_chunk(head, compressed, limit)


def index_from_summary(file: OpenFile) -> McapIndex:
    """Returns the index that the summary section gives.

    Raises:
        DoubtError: the index is missing or unreliable; the file must be scanned.
    """
    try:
        return _index_from_summary(file)
    except (DoubtError, OSError):
        raise
    except Exception as error:
        raise DoubtError(f"its summary section is not used ({reason_of(error)})") from error


def _index_from_summary(file: OpenFile) -> McapIndex:
    start, (channels, channel_bytes, declared), chunks, stated = read_summary(file)
    if stated is None or not declared.resolved or stated.channel_count > len(channels):
        raise DoubtError
    counts = stated.channel_message_counts
    if not counts.keys() <= channels.keys() or len(chunks) > MAX_CHUNKS:
        raise DoubtError
    filled = [chunk for chunk in chunks if chunk.channels]
    if counts and len(filled) < len(chunks):  # some have no message indexes
        raise DoubtError
    known = frozenset(channels)
    if not all(map(known.issuperset, {chunk.channels for chunk in filled})):
        raise DoubtError("its chunk indexes name channels that it does not declare")
    if chunks:
        _require_chunks_as_indexed(file, start, chunks)
    if not _agrees(stated, chunks, filled):
        raise DoubtError
    indexes = sum([len(chunk.index_places or b"") for chunk in filled]) // INDEX_OFFSET_BYTES
    index_length = sum([chunk.index_length for chunk in filled])
    if index_bytes(indexes, stated.message_count) != index_length:
        raise DoubtError("its message indexes do not hold what its statistics state")
    totals = _totals_of(file, filled, counts)
    if totals.keys() != counts.keys() or any(each.first == _NEVER for each in totals.values()):
        raise DoubtError
    notes = disagreements(stated, totals)
    back = _set_back(file, filled)
    return McapIndex(
        channels,
        channel_bytes,
        tuple(filled),
        totals,
        notes=notes,
        set_back=back,
        pauses=_pauses(file, filled),
        seams=_seams(filled),
        declared=declared,
    )


def _require_chunks_as_indexed(file: OpenFile, end: int, chunks: Sequence[Chunk]) -> None:
    """Compares every chunk index with the head of its chunk, and looks between the chunks.

    Raises:
        DoubtError: a chunk is not where its index has it, or not of these times; or there is a
            chunk or a message that no index knows.
    """
    ordered = sorted(chunks, key=itemgetter(0))
    if ordered[-1].offset >= file.size:
        raise DoubtError(_OTHER_CHUNKS)
    begins = [chunk[0] for chunk in ordered]
    heads = [_stating(_CHUNK, chunk[1] - _HEAD_BYTES, chunk[2], chunk[3]) for chunk in ordered]
    if file.read_each(begins, _STATED_BYTES) != heads:
        raise DoubtError(_OTHER_CHUNKS)
    ends = [MAGIC_SIZE, *[chunk[0] + chunk[1] + chunk[6] for chunk in ordered]]
    begins.append(end)
    for at, following in zip(ends, begins, strict=True):
        if at != following:
            _require_no_content(file, at, following)


def _require_no_content(file: OpenFile, at: int, end: int) -> None:
    """Checks that no chunk or message lies in this part of the data section.

    Raises:
        DoubtError: one does, or the part is not made of records.
    """
    while at < end:
        opcode, length = RECORD.unpack(file.read(at, RECORD.size))
        if opcode == Opcode.DATA_END:
            return
        if opcode == Opcode.MESSAGE:
            raise DoubtError  # as any writer may write it, though few do
        if opcode in _INDEXED:
            raise DoubtError("its chunk indexes do not hold all of its chunks")
        at += RECORD.size + length
    if at > end:
        raise DoubtError(_OTHER_CHUNKS)


def _agrees(stated: Statistics, chunks: Sequence[Chunk], filled: Sequence[Chunk]) -> bool:
    """Returns whether the statistics agree with themselves and with the chunk indexes."""
    counted = sum(stated.channel_message_counts.values())
    if counted != stated.message_count or stated.chunk_count != len(chunks):
        return False
    if not filled:
        return not stated.message_count
    starts, ends = [chunk.start for chunk in filled], [chunk.end for chunk in filled]
    start, end = min(starts), max(ends)
    if (start, end) != (stated.message_start_time, stated.message_end_time) or end >= MAX_NS:
        return False
    # The messages of a chunk that ends before it begins would be in no window.
    return all(map(le, starts, ends))


def _totals_of(
    file: OpenFile, chunks: Sequence[Chunk], counts: Mapping[int, int]
) -> dict[int, Extent]:
    """Returns exact totals by channel, from the message indexes of chunks that hold messages.

    Reads the indexes of only those chunks that can hold the earliest or the latest message of a
    channel: to read all of them takes 25 ms instead of 5 in a file of 400 chunks.

    Args:
        file: the open file.
        chunks: its chunks that hold messages.
        counts: the messages of each channel that has some.
    """
    totals = {channel: Extent(0, _NEVER, -1) for channel in counts}
    read: set[int] = set()
    unknown = list(counts)
    for chunk in sorted(chunks, key=attrgetter("start")):
        unknown = [each for each in unknown if totals[each].first > chunk.start]
        if not unknown:
            break
        if not chunk.channels.isdisjoint(unknown):
            _add_extents(file, chunk, totals)
            read.add(chunk.offset)
    unknown = list(counts)
    for chunk in sorted(chunks, key=attrgetter("end"), reverse=True):
        unknown = [each for each in unknown if totals[each].last < chunk.end]
        if not unknown:
            break
        if chunk.offset not in read and not chunk.channels.isdisjoint(unknown):
            _add_extents(file, chunk, totals)
    for channel, total in totals.items():
        total.count = counts.get(channel, 0)
    return totals


def _add_extents(file: OpenFile, chunk: Chunk, totals: dict[int, Extent]) -> None:
    for channel, extent in _chunk_extents(file, chunk).items():
        _add(totals, channel, extent)


def add_column(totals: dict[int, Extent], channel: int, column: Column) -> None:
    """Adds a column of one channel to the totals."""
    times = column.times
    if times.size:
        _add(totals, channel, Extent(times.size, int(times[0]), int(times[-1])))


def _add(totals: dict[int, Extent], channel: int, extent: Extent) -> None:
    total = totals.get(channel)
    if total is None:
        totals[channel] = extent
        return
    total.count += extent.count
    # Not by min() and max(), which take longer than all the rest.
    if extent.first < total.first:  # noqa: PLR1730
        total.first = extent.first
    if extent.last > total.last:  # noqa: PLR1730
        total.last = extent.last


def disagreements(stated: Statistics, totals: Mapping[int, Extent]) -> tuple[str, ...]:
    """Returns a note if the messages contradict the statistics; else nothing."""
    every = totals.values()
    counts = {channel: total.count for channel, total in totals.items()}
    count = sum([total.count for total in every])
    first = min([total.first for total in every], default=stated.message_start_time)
    last = max([total.last for total in every], default=stated.message_end_time)
    claimed = (stated.message_count, stated.message_start_time, stated.message_end_time)
    if stated.channel_message_counts == counts and claimed == (count, first, last):
        return ()
    start, end = _seconds(stated.message_start_time), _seconds(stated.message_end_time)
    note = (
        f"{WRONG_STATISTICS}: they state {stated.message_count} messages from {start} to {end};"
        f" it holds {count} from {_seconds(first)} to {_seconds(last)}"
    )
    return (f"{note}; {MESSAGES_MISSING}" if stated.message_count > count else note,)


def _seconds(time: Ns) -> str:
    return f"{unix_from_ns(time):.6f} s"

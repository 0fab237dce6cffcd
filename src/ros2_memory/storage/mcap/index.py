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
from operator import attrgetter, le
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from ros2_memory.core.arrays import run_starts
from ros2_memory.core.bag_summary import MESSAGES_MISSING, WRONG_STATISTICS
from ros2_memory.core.timebase import MAX_NS, Ns, unix_from_ns
from ros2_memory.storage.cache import unshared_bytes
from ros2_memory.storage.contents import Contents, Tally
from ros2_memory.storage.errors import (
    MAX_CHUNKS,
    MAX_SECTION_BYTES,
    UnreadableError,
    as_unreadable,
    reason_of,
)
from ros2_memory.storage.mcap.chunk import (
    INDEX_OFFSET,
    OUTSIDE,
    Chunk,
    index_bytes,
    index_groups,
    pairs_in,
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
    from collections.abc import Mapping, Sequence

    from mcap.records import Statistics

    from ros2_memory.storage.base import Channel
    from ros2_memory.storage.contents import Extent
    from ros2_memory.storage.file_io import OpenFile

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
"""A chunk's first and last log time, offset and length, and the bytes of its index offsets."""
_INDEX_LENGTH: Final = struct.Struct("<Q")
_new_tuple: Final = tuple.__new__
_MAX_CACHED_BYTES: Final = 128 << 10

# Plain integers: the opcodes of records are compared with them some million times.
_DECLARES: Final = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))
_CHUNK_INDEX_OPCODE: Final = int(Opcode.CHUNK_INDEX)
_STATISTICS_OPCODE: Final = int(Opcode.STATISTICS)


class DoubtError(UnreadableError):
    """The summary section cannot be relied on; the text is a note on it, or empty."""


def _summary(
    file: OpenFile,
) -> tuple[int, Mapping[int, Channel], Declarations, list[Chunk], Statistics | None]:
    """Returns where the summary section of a file begins, and what it states.

    That is the channels by their number, the records that declare them, to compare others with, the
    chunks and the statistics.

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
    return start, *declared(records), chunks, stated


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
    if stop + _INDEX_LENGTH.size > end or places_size % INDEX_OFFSET.itemsize:
        raise UnreadableError("damaged: a chunk index is shorter than it states")
    places = section[at:stop]
    # Slices with a step take the low and the high byte of every channel number at once.
    channels = _numbers(places[:: INDEX_OFFSET.itemsize], places[1 :: INDEX_OFFSET.itemsize])
    (index_length,) = _INDEX_LENGTH.unpack_from(section, stop)
    # Past the function that takes the fields of a named tuple: it costs as much as all the rest.
    fields = (offset, length, start, last, channels, places, index_length, None, False)
    return _new_tuple(Chunk, fields)


@lru_cache(1024)
def _numbers(low: bytes, high: bytes) -> frozenset[int]:
    """Returns the channel numbers with these low and high bytes: one set for all equal ones."""
    return frozenset(first | second << 8 for first, second in zip(low, high, strict=True))


@lru_cache(32)
def _declared(records: bytes) -> tuple[Mapping[int, Channel], Declarations]:
    declarations = Declarations()
    for opcode, begin, end in section_records(records):
        declarations.add(opcode, records[begin:end])
    return declarations.channels(), declarations


_CHUNK: Final = int(Opcode.CHUNK)
_INDEXED: Final = frozenset((_CHUNK, int(Opcode.MESSAGE_INDEX)))
_OTHER_CHUNKS: Final = "its chunk indexes do not agree with its chunks"
OTHER_DECLARED: Final = "its summary section declares other channels or types than its messages"
_STATED: Final = struct.Struct("<BQQQ")
"""A chunk record up to its times: opcode, length, first and last log time."""
_HEAD_BYTES: Final = RECORD.size
_SEAM_SHARE: Final = 16
_SEAM_TIMES: Final = 4
_SEAM_CHUNKS: Final = 3
_MOST_SEAMS: Final = 8
_stating: Final = _STATED.pack


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
        chunks: the chunks with messages, in file order.
        complete: whether the writer finished the file.
        notes: sentences on what is missing or wrong.
        contents: what the messages amount to; nothing where that was not asked for.
        seams: where the times of chunks do not go on from one to the next; empty after a scan.
        contradiction: how the indexes of the file contradict its messages, if that was found after
            they had been used; else empty.
        declared: what the summary section declares; None if the index comes from a scan.
    """

    channels: Mapping[int, Channel]
    chunks: tuple[Chunk, ...]
    contents: Contents = Contents()
    complete: bool = True
    notes: tuple[str, ...] = ()
    seams: tuple[Seam, ...] = ()
    contradiction: str = ""
    declared: Declarations | None = None

    @property
    def used(self) -> frozenset[int]:
        """The channels that have messages."""
        of_chunks = {chunk.channels for chunk in self.chunks}
        return frozenset[int]().union(*of_chunks)

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes, without the channels that files share."""
        places = sum([len(chunk.index_places or ()) for chunk in self.chunks])
        return 1000 + unshared_bytes(self.channels) + 400 * len(self.chunks) + places


def _seams(chunks: Sequence[Chunk]) -> tuple[Seam, ...]:
    """Returns `McapIndex.seams`.

    A writer fills one chunk after the other, so their times follow each other. Where all indexes of
    neighbouring chunks agree on wrong times there is a hole, or an overlap, of more than a
    `_SEAM_SHARE` of the two chunks, and of several times what is usual in the file. A file with
    many of them was written in another order, and they say nothing.
    """
    # Plain lists: for some thirty chunks arrays take twice as long.
    apart = [abs(following.start - chunk.end) for chunk, following in pairwise(chunks)]
    usual = _SEAM_TIMES * sorted(apart)[len(apart) // 2] if apart else 0
    seams: list[Seam] = []
    for nth in [nth for nth, gap in enumerate(apart) if gap > usual]:
        before, after = chunks[nth], chunks[nth + 1]
        if apart[nth] * _SEAM_SHARE > before.end - before.start + after.end - after.start:
            near = chunks[max(nth + 1 - _SEAM_CHUNKS, 0) : nth + 1 + _SEAM_CHUNKS]
            first, last = min([chunk.start for chunk in near]), max([chunk.end for chunk in near])
            seams.append(Seam(nth, first, last))
    return tuple(seams) if len(seams) <= _MOST_SEAMS else ()


def index_from_summary(file: OpenFile, *, is_sound: bool = False) -> McapIndex:
    """Returns the index that the summary section and the message indexes give.

    Of a file that was found sound before, without what its messages amount to.

    Raises:
        DoubtError: the summary section is missing or unreliable; the file must be scanned.
        UnreadableError: a message index is not what the summary section says.
    """
    try:
        index, stated = _index_without_totals(file, is_sound=is_sound)
    except (DoubtError, OSError):
        raise
    except Exception as error:
        raise DoubtError(f"its summary section is not used ({reason_of(error)})") from error
    if is_sound or not index.chunks:
        return index
    tally = Tally()
    with as_unreadable():
        for group, regions in index_groups(file, index.chunks):
            pairs = pairs_in(group, regions)
            tally.add(pairs.channels, pairs.times, pairs.chunks)
            begins = run_starts(pairs.chunks)
            firsts = np.minimum.reduceat(pairs.times, begins).tolist()
            lasts = np.maximum.reduceat(pairs.times, begins).tolist()
            stated_times = [(chunk.start, chunk.end) for chunk in group]
            if [*zip(firsts, lasts, strict=True)] != stated_times:
                raise UnreadableError(OUTSIDE)
    contents = tally.contents()
    if contents.totals.keys() != stated.channel_message_counts.keys():
        raise DoubtError
    notes = disagreements(stated, contents.totals)
    return index._replace(contents=contents, notes=notes)


def _index_without_totals(file: OpenFile, *, is_sound: bool) -> tuple[McapIndex, Statistics]:
    """Returns the index without what its messages amount to, and what the file states of that."""
    start, channels, declared, chunks, stated = _summary(file)
    if stated is None or not declared.resolved or stated.channel_count > len(channels):
        raise DoubtError
    counts = stated.channel_message_counts
    if not counts.keys() <= channels.keys() or len(chunks) > MAX_CHUNKS:
        raise DoubtError
    filled = [chunk for chunk in chunks if chunk.channels]
    # Some have no message indexes, or all of these are empty.
    if chunks and (not counts or len(filled) < len(chunks)):
        raise DoubtError
    declared_channels = frozenset(channels)
    if not all(map(declared_channels.issuperset, {chunk.channels for chunk in filled})):
        raise DoubtError("its chunk indexes name channels that it does not declare")
    if chunks and not is_sound:
        _require_chunks_as_indexed(file, start, chunks)
    if not _agrees(stated, chunks, filled):
        raise DoubtError
    indexes = sum([len(chunk.index_places or b"") for chunk in filled]) // INDEX_OFFSET.itemsize
    index_length = sum([chunk.index_length for chunk in filled])
    if index_bytes(indexes, stated.message_count) != index_length:
        raise DoubtError("its message indexes do not hold what its statistics state")
    seams = _seams(filled)
    index = McapIndex(channels, tuple(filled), seams=seams, declared=declared)
    return index, stated


def _require_chunks_as_indexed(file: OpenFile, end: int, chunks: Sequence[Chunk]) -> None:
    """Compares every chunk index with the head of its chunk, and looks between the chunks.

    Raises:
        DoubtError: a chunk is not where its index has it, or not of these times; or there is a
            chunk or a message that no index knows.
    """
    ordered = sorted(chunks, key=attrgetter("offset"))
    if ordered[-1].offset >= file.size:
        raise DoubtError(_OTHER_CHUNKS)
    begins = [chunk.offset for chunk in ordered]
    heads = [
        _stating(_CHUNK, chunk.length - _HEAD_BYTES, chunk.start, chunk.end) for chunk in ordered
    ]
    if [file.read(begin, _STATED.size) for begin in begins] != heads:
        raise DoubtError(_OTHER_CHUNKS)
    ends = [MAGIC_SIZE, *[chunk.offset + chunk.length + chunk.index_length for chunk in ordered]]
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


def disagreements(stated: Statistics, totals: Mapping[int, Extent]) -> tuple[str, ...]:
    """Returns a note if the messages contradict the statistics; else nothing."""
    extents = totals.values()
    counts = {channel: total.count for channel, total in totals.items()}
    count = sum([total.count for total in extents])
    first = min([total.first for total in extents], default=stated.message_start_time)
    last = max([total.last for total in extents], default=stated.message_end_time)
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

"""Indexes an MCAP file: where its messages lie, by its summary section.

The summary section is believed if its checksum matches and it agrees with itself, with the heads of
the chunks and with the message indexes that are read. Every other file (no summary, no statistics,
channels not repeated, no message index, no chunks, cut short) is scanned, which finds the same from
the messages themselves.
"""

from __future__ import annotations

import struct
import zlib
from contextlib import contextmanager
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
    read_indexes,
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
    from collections.abc import Iterator, Mapping, Sequence

    from mcap.records import Statistics

    from ros2_memory.storage.base import Channel
    from ros2_memory.storage.contents import Extent
    from ros2_memory.storage.file_io import OpenFile

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
"""A chunk's first and last log time, offset and length, and the bytes of its index offsets."""
_INDEX_LENGTH: Final = struct.Struct("<Q")
_MAX_CACHED_BYTES: Final = 128 << 10
"""Longer declarations are decoded anew for each file, so that the cache stays below 4 MiB."""

# Plain integers: the opcodes of records are compared with them some million times.
_DECLARES: Final = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))
_CHUNK_INDEX_OPCODE: Final = int(Opcode.CHUNK_INDEX)
_STATISTICS_OPCODE: Final = int(Opcode.STATISTICS)


class DoubtError(UnreadableError):
    """The summary section cannot be relied on; the text is a note on it, or empty."""


class _Summary(NamedTuple):
    """What the summary section of a file states.

    Attributes:
        begins_at: where the section begins in the file.
        channels: the channels by number.
        declared: the records that declare channels and schemas, to compare others with.
        chunks: the chunks, in the order of their indexes.
        stated: the statistics.
    """

    begins_at: int
    channels: Mapping[int, Channel]
    declared: Declarations
    chunks: list[Chunk]
    stated: Statistics


def _read_summary(file: OpenFile) -> _Summary:
    """Reads the summary section of a file.

    Raises:
        DoubtError: it is missing, does not match its checksum, or lacks something that is needed
            to find all messages: statistics, channels, schemas or message indexes.
        UnreadableError, struct.error and others: it is damaged.
    """
    begins_at, section = _read_section(file)
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
    if stated is None:
        raise DoubtError
    records = b"".join(declaring)
    decode = _declarations if len(records) <= _MAX_CACHED_BYTES else _declarations.__wrapped__
    channels, declared = decode(records)
    counts = stated.channel_message_counts
    if not declared.resolved or stated.channel_count > len(channels):
        raise DoubtError
    if not counts.keys() <= channels.keys() or len(chunks) > MAX_CHUNKS:
        raise DoubtError
    # A chunk without channels has no message indexes, or they are all empty.
    if chunks and (not counts or not all(chunk.channels for chunk in chunks)):
        raise DoubtError
    declared_channels = frozenset(channels)
    if not all(map(declared_channels.issuperset, {chunk.channels for chunk in chunks})):
        raise DoubtError("its chunk indexes name channels that it does not declare")
    return _Summary(begins_at, channels, declared, chunks, stated)


def _read_section(file: OpenFile) -> tuple[int, bytes]:
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
    channels = _channel_numbers(
        places[:: INDEX_OFFSET.itemsize], places[1 :: INDEX_OFFSET.itemsize]
    )
    (index_length,) = _INDEX_LENGTH.unpack_from(section, stop)
    return Chunk(offset, length, start, last, channels, places, index_length)


@lru_cache(1024)
def _channel_numbers(low: bytes, high: bytes) -> frozenset[int]:
    """Returns the 16-bit numbers with these low and high bytes: one set for all equal ones."""
    return frozenset(first | second << 8 for first, second in zip(low, high, strict=True))


@lru_cache(32)
def _declarations(records: bytes) -> tuple[Mapping[int, Channel], Declarations]:
    """Decodes schema and channel records: the channels by number, and the records."""
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
_SEAM_SHARE: Final = 16
"""A seam is longer than one of so many parts of the two chunks beside it."""
_SEAM_TIMES: Final = 4
"""A seam is so many times longer than the median distance of two chunks."""
_SEAM_CHUNKS: Final = 3
"""How many chunks on each side count as near a seam."""
_MOST_SEAMS: Final = 8


class Seam(NamedTuple):
    """Two chunks in file order between which the times jump farther than elsewhere in the file.

    Attributes:
        nth: the position of the first of the two chunks.
        first: the earliest time of the chunks near the seam.
        last: their latest time.
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
        contents: the summary of the messages; empty if it was not asked for.
        seams: where the times jump from one chunk to the next; empty after a scan.
        contradiction: how the indexes of the file contradict its messages; empty if they do not.
            It is set where the indexes had been used before that was found out.
        declared: the schemas and channels of the summary section; None after a scan.
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
    def memory_bytes(self) -> int:
        """About how much memory it takes, without the channels that files share."""
        places = sum([len(chunk.index_places or ()) for chunk in self.chunks])
        return 1000 + unshared_bytes(self.channels) + 400 * len(self.chunks) + places


def _seams(chunks: Sequence[Chunk]) -> tuple[Seam, ...]:
    """Returns the seams between chunks; none if there are more than `_MOST_SEAMS`.

    A writer fills one chunk after the other, so their times follow each other. Where all indexes of
    neighbouring chunks agree on wrong times there is a hole or an overlap. A file with many of them
    was written in another order, and they say nothing.
    """
    # Plain lists: for some thirty chunks arrays take twice as long.
    apart = [abs(following.start - chunk.end) for chunk, following in pairwise(chunks)]
    usual = _SEAM_TIMES * sorted(apart)[len(apart) // 2] if apart else 0
    seams: list[Seam] = []
    for nth, gap in enumerate(apart):
        if gap <= usual:
            continue
        before, after = chunks[nth], chunks[nth + 1]
        if gap * _SEAM_SHARE > before.end - before.start + after.end - after.start:
            near = chunks[max(nth + 1 - _SEAM_CHUNKS, 0) : nth + 1 + _SEAM_CHUNKS]
            first, last = min([chunk.start for chunk in near]), max([chunk.end for chunk in near])
            seams.append(Seam(nth, first, last))
    return tuple(seams) if len(seams) <= _MOST_SEAMS else ()


def checked_index(file: OpenFile) -> McapIndex:
    """Returns the index of the summary section, compared with the chunks and message indexes.

    Raises:
        DoubtError: the summary section is missing or unreliable; the file must be scanned.
        UnreadableError: a message index is not what the summary section says.
    """
    with _doubting():
        summary = _read_summary(file)
        if summary.chunks:
            _require_chunks_as_indexed(file, summary)
        index = _index_of(summary)
    if not index.chunks:
        return index
    tally = Tally()
    with as_unreadable():
        for chunks, indexes in index_groups(file, index.chunks):
            messages = read_indexes(chunks, indexes)
            tally.add(messages.channels, messages.times, messages.chunks)
            begins = run_starts(messages.chunks)
            firsts = np.minimum.reduceat(messages.times, begins).tolist()
            lasts = np.maximum.reduceat(messages.times, begins).tolist()
            stated_times = [(chunk.start, chunk.end) for chunk in chunks]
            if [*zip(firsts, lasts, strict=True)] != stated_times:
                raise UnreadableError(OUTSIDE)
    contents = tally.contents()
    if contents.totals.keys() != summary.stated.channel_message_counts.keys():
        raise DoubtError
    notes = disagreements(summary.stated, contents.totals)
    return index._replace(contents=contents, notes=notes)


def trusted_index(file: OpenFile) -> McapIndex:
    """Returns the index of a file that `checked_index` has checked before, without `contents`.

    Raises:
        DoubtError: the summary section is missing or unreliable.
    """
    with _doubting():
        return _index_of(_read_summary(file))


@contextmanager
def _doubting() -> Iterator[None]:
    """Raises whatever damaged bytes of a summary section cause as a `DoubtError`."""
    try:
        yield
    except (DoubtError, OSError):
        raise
    except Exception as error:
        raise DoubtError(f"its summary section is not used ({reason_of(error)})") from error


def _index_of(summary: _Summary) -> McapIndex:
    """Returns the index of a summary section, without `contents`.

    Raises:
        DoubtError: its statistics do not agree with its chunk indexes.
    """
    chunks, stated = summary.chunks, summary.stated
    if not _statistics_agree(stated, chunks):
        raise DoubtError
    indexes = sum([len(chunk.index_places or b"") for chunk in chunks]) // INDEX_OFFSET.itemsize
    index_length = sum([chunk.index_length for chunk in chunks])
    if index_bytes(indexes, stated.message_count) != index_length:
        raise DoubtError("its message indexes do not hold what its statistics state")
    return McapIndex(
        summary.channels, tuple(chunks), seams=_seams(chunks), declared=summary.declared
    )


def _require_chunks_as_indexed(file: OpenFile, summary: _Summary) -> None:
    """Compares every chunk index with the head of its chunk, and looks between the chunks.

    Raises:
        DoubtError: a chunk is not where its index has it, or states other times; or a chunk or a
            message is in no index.
    """
    chunks = sorted(summary.chunks, key=attrgetter("offset"))
    if chunks[-1].offset >= file.size:
        raise DoubtError(_OTHER_CHUNKS)
    for chunk in chunks:
        head = _STATED.pack(_CHUNK, chunk.length - RECORD.size, chunk.start, chunk.end)
        if file.read(chunk.offset, _STATED.size) != head:
            raise DoubtError(_OTHER_CHUNKS)
    end = MAGIC_SIZE
    for chunk in chunks:
        _require_no_content(file, end, chunk.offset)
        end = chunk.offset + chunk.length + chunk.index_length
    _require_no_content(file, end, summary.begins_at)


def _require_no_content(file: OpenFile, at: int, end: int) -> None:
    """Checks that no chunk or message lies from `at` to `end` in the data section.

    Raises:
        DoubtError: one does, or this part is not made of records.
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


def _statistics_agree(stated: Statistics, chunks: Sequence[Chunk]) -> bool:
    """Returns whether the statistics agree with themselves and with the chunk indexes."""
    counted = sum(stated.channel_message_counts.values())
    if counted != stated.message_count or stated.chunk_count != len(chunks):
        return False
    if not chunks:
        return not stated.message_count
    starts, ends = [chunk.start for chunk in chunks], [chunk.end for chunk in chunks]
    start, end = min(starts), max(ends)
    if (start, end) != (stated.message_start_time, stated.message_end_time) or end >= MAX_NS:
        return False
    # The messages of a chunk that ends before it begins would be in no window.
    return all(map(le, starts, ends))


def disagreements(stated: Statistics, totals: Mapping[int, Extent]) -> tuple[str, ...]:
    """Returns a note if the messages contradict the statistics; else nothing."""
    counts = {channel: total.count for channel, total in totals.items()}
    count = sum(counts.values())
    first = min([total.first for total in totals.values()], default=stated.message_start_time)
    last = max([total.last for total in totals.values()], default=stated.message_end_time)
    stated_times = (stated.message_start_time, stated.message_end_time)
    has_stated_count = stated.message_count == count and stated.channel_message_counts == counts
    if has_stated_count and stated_times == (first, last):
        return ()
    start, end = map(_seconds, stated_times)
    note = (
        f"{WRONG_STATISTICS}: they state {stated.message_count} messages from {start} to {end};"
        f" it holds {count} from {_seconds(first)} to {_seconds(last)}"
    )
    if stated.message_count > count:
        note += f"; {MESSAGES_MISSING}"
    return (note,)


def _seconds(time: Ns) -> str:
    return f"{unix_from_ns(time):.6f} s"

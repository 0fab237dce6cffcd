"""Decompresses chunks, and finds the messages of each channel in them.

The fields of messages and message indexes are read with numpy and struct: the `mcap` library makes
a Python object for every record of a chunk (2.4 ms a chunk, where walking its bytes takes 0.47).
"""

from __future__ import annotations

import struct
import zlib
from array import array
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]  # has no types
import numpy as np
from mcap.opcode import Opcode

from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.errors import (
    MAX_CHUNK_DECLARATIONS,
    MAX_CHUNK_MESSAGES,
    MAX_CHUNKS,
    MAX_COMPRESSION_RATIO,
    MESSAGE_BYTES,
    SizeLimit,
    UnreadableError,
    as_unreadable,
    max_decompressed_bytes,
    too_large,
)
from ros2_memory.storage.mcap.records import (
    CHUNK_TIMES,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    FileRecord,
)
from ros2_memory.storage.zstd_bag import decompress_zstd, zstd_front

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.storage.file_io import OpenFile

Ints: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.int64]]"

_INDEX_HEAD: Final = struct.Struct("<BQHI")
"""A message index up to its pairs of log time and offset: opcode, length, channel, their size."""
_INDEX_HEAD_BYTES: Final = _INDEX_HEAD.size
_index_head: Final = _INDEX_HEAD.unpack_from
_PAIR_BYTES: Final = 16
_MESSAGE_INDEX: Final = int(Opcode.MESSAGE_INDEX)
_NO_INDEX: Final = "damaged: a message index is not where its chunk index says"
_OTHER_INDEX: Final = "damaged: a message index is not what its chunk index says"
_LONG_INDEX: Final = "damaged: a message index holds more than a chunk can"
_IMPOSSIBLE_TIMES: Final = "damaged: a message index holds impossible log times"
NOT_THERE: Final = "damaged: a message is not where its index says"
_MESSAGE_OPCODE: Final = bytes((Opcode.MESSAGE,))
_MANY_DECLARED: Final = f"a chunk declares more than {MAX_CHUNK_DECLARATIONS} things"
_LENGTH_AT: Final = 1
_CHANNEL_AT: Final = 9
_LOG_TIME_AT: Final = 15
"""Where these fields lie in a message record."""
_UINT16: Final = np.dtype("<u2")
_INT64: Final = np.dtype("<i8")
_UINT64: Final = np.dtype("<u8")
_EVERY_BYTE: Final = (1,)
_EVERY_PAIR: Final = (_PAIR_BYTES,)
_FEW: Final = 100
"""Up to so many log times are sooner unpacked by struct than by numpy."""
_EMPTY: Final[Ints] = np.zeros(0, dtype=np.int64)
_ZERO: Final[Ints] = np.zeros(1, dtype=np.int64)


class Column(NamedTuple):
    """The messages of one channel in one part of a file, by log time, ties in file order.

    `places` are the offsets of the message records, in the file or in the decompressed chunk.
    """

    times: Ints
    places: Ints

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes, in bytes."""
        return 2 * self.times.nbytes + 300

    @classmethod
    def of(cls, times: Ints, places: Ints) -> Column:
        """Returns a sorted column, without log times that do not fit into 64 signed bits."""
        if times.size > 1 and not bool((times[1:] > times[:-1]).all()):
            order = np.lexsort((places, times))
            times, places = times[order], places[order]
            if bool(((times[1:] == times[:-1]) & (places[1:] == places[:-1])).any()):
                raise UnreadableError("damaged: a message index holds a message twice")
        if times.size and times[0] >= 0 and times[-1] < MAX_NS:
            return cls(times, places)
        # An unsigned time past the signed range has become negative.
        first = int(np.searchsorted(times, 0))
        stop = int(np.searchsorted(times, MAX_NS))
        return cls(times[first:stop], places[first:stop])

    def between(self, start: int, stop: int) -> Column:
        """Returns the part with log times in `[start, stop)`."""
        times = self.times
        first, last = times.searchsorted(start), times.searchsorted(stop)
        if not first and last == times.size:
            return self
        return Column(times[first:last], self.places[first:last])


NO_MESSAGES: Final = Column(_EMPTY, _EMPTY)


def joined(columns: list[Column]) -> Column:
    """Returns the messages of several channels as one column."""
    if len(columns) == 1:
        return columns[0]
    if not columns:
        return NO_MESSAGES
    times = np.concatenate([column.times for column in columns])
    places = np.concatenate([column.places for column in columns])
    order = np.lexsort((places, times))
    return Column(times[order], places[order])


def columns_from_index(region: bytes, offsets: Mapping[int, int], base: int) -> dict[int, Column]:
    """Returns the columns of the message indexes of one chunk.

    Args:
        region: the bytes behind the chunk, where its message indexes lie.
        offsets: where each channel's record begins in the file.
        base: where the region begins in the file.
    """
    columns: dict[int, Column] = {}
    for channel, offset in offsets.items():
        at, count = _index_at(region, channel, offset - base)
        pairs = np.frombuffer(region, "<i8", 2 * count, at).reshape(-1, 2)
        column = Column.of(pairs[:, 0].copy(), pairs[:, 1].copy())
        if column.times.size != count:
            raise UnreadableError(_IMPOSSIBLE_TIMES)
        columns[channel] = column
    return columns


def require_indexed(data: bytes, channel: int, column: Column) -> None:
    """Compares a column with the records of its chunk.

    Together with the number of messages, which `mcap.index` compares with the statistics, this
    proves that the column has all messages of the channel in this chunk. It takes some microseconds
    a chunk.

    Args:
        data: the decompressed records of the chunk, which its checksum protects.
        channel: the number of the channel.
        column: what the message index of the channel holds.

    Raises:
        UnreadableError: a message is not there, or has another channel or log time.
    """
    times, places = column
    count = times.size
    stop = len(data) - MESSAGE.size + 1
    if not count:
        return
    if stop <= 0 or places.min() < 0:
        raise UnreadableError(NOT_THERE)
    # Strided views with an element at every byte: indexing one with `places` gathers a field of all
    # messages at once, aligned or not.
    try:
        opcodes = np.ndarray(stop, np.uint8, data, 0, _EVERY_BYTE)[places]
        channels = np.ndarray(stop, _UINT16, data, _CHANNEL_AT, _EVERY_BYTE)[places]
        stated = np.ndarray(stop, _INT64, data, _LOG_TIME_AT, _EVERY_BYTE)[places]
    except IndexError:
        raise UnreadableError(NOT_THERE) from None
    if (
        opcodes.tobytes() != _MESSAGE_OPCODE * count
        or channels.tobytes() != channel.to_bytes(2, "little") * count
        or stated.tobytes() != times.tobytes()
    ):
        raise UnreadableError(NOT_THERE)


def declarations_of(data: bytes, columns: Sequence[Column]) -> list[tuple[int, bytes]]:
    """Returns the schema and channel records of a chunk; walks only the bytes between messages.

    Args:
        data: the decompressed records of the chunk.
        columns: all of its messages, compared with these records already.

    Returns:
        The opcode and the body of each.

    Raises:
        UnreadableError: there are other messages between them, or too many declarations.
    """
    places = np.sort(np.concatenate([column.places for column in columns] or [_EMPTY]))
    size = len(data)
    lengths = _EMPTY
    if places.size:
        stop = size - RECORD.size + 1
        lengths = np.ndarray(stop, _INT64, data, _LENGTH_AT, _EVERY_BYTE)[places]
        if lengths.min() < 0 or lengths.max() > size:
            raise UnreadableError(NOT_THERE)
    begins = np.concatenate([_ZERO, places + RECORD.size + lengths])
    ends = np.append(places, size)
    if bool((begins > ends).any()):
        raise UnreadableError(NOT_THERE)
    found: list[tuple[int, bytes]] = []
    between = begins < ends
    for begin, end in zip(begins[between].tolist(), ends[between].tolist(), strict=True):
        walked = walk_chunk(data[begin:end])
        if walked.messages:
            raise UnreadableError("damaged: a chunk holds messages that its indexes do not")
        found += walked.declarations
        if len(found) > MAX_CHUNK_DECLARATIONS:
            raise UnreadableError(_MANY_DECLARED)
    return found


@dataclass(slots=True)
class Extent:
    """Messages of one channel: how many, and the log times of the earliest and the latest."""

    count: int
    first: int
    last: int


def extents_from_index(region: bytes, offsets: Mapping[int, int], base: int) -> dict[int, Extent]:
    """Returns what `columns_from_index` would amount to, for channels with messages."""
    extents: dict[int, Extent] = {}
    messages = 0
    for channel, offset in offsets.items():
        pairs_at, count = _index_at(region, channel, offset - base)
        messages += count
        if count > _FEW:
            column = np.ndarray(count, _UINT64, region, pairs_at, _EVERY_PAIR)
            first, last = int(column.min()), int(column.max())
        elif count:
            times = _log_times_of(count)(region, pairs_at)
            first, last = min(times), max(times)
        else:
            continue
        if last >= MAX_NS:
            raise UnreadableError(_IMPOSSIBLE_TIMES)
        extents[channel] = Extent(count, first, last)
    if index_bytes(len(offsets), messages) != len(region):
        raise UnreadableError("damaged: a chunk has message indexes that its chunk index lacks")
    return extents


def indexed_channels(region: bytes) -> frozenset[int]:
    """Returns the channels whose message indexes lie in these bytes behind a chunk.

    Not by `section_records`, since it is called for every chunk: indexing would be 10 % slower.
    """
    channels = []
    at, size = 0, len(region)
    while at < size:
        if at + _INDEX_HEAD_BYTES > size:
            raise UnreadableError(_NO_INDEX)
        opcode, length, number, _ = _index_head(region, at)
        if opcode != _MESSAGE_INDEX:
            raise UnreadableError(_NO_INDEX)
        channels.append(number)
        at += RECORD.size + length
    return frozenset(channels)


def index_bytes(indexes: int, messages: int) -> int:
    """Returns the bytes of so many message indexes with so many messages in all."""
    return indexes * _INDEX_HEAD_BYTES + messages * _PAIR_BYTES


@lru_cache(_FEW)
def _log_times_of(count: int) -> Callable[[bytes, int], tuple[int, ...]]:
    """Returns what unpacks the log times of `count` pairs: 50 of 330 us of a cold point query."""
    return struct.Struct("<" + "Q8x" * count).unpack_from


def _index_at(region: bytes, channel: int, at: int) -> tuple[int, int]:
    """Returns where the pairs of log time and offset of a message index begin, and how many."""
    pairs_at = at + _INDEX_HEAD_BYTES
    if at < 0 or pairs_at > len(region):
        raise UnreadableError(_NO_INDEX)
    opcode, length, number, size = _index_head(region, at)
    if opcode != _MESSAGE_INDEX or number != channel or length != size + 6 or size % _PAIR_BYTES:
        raise UnreadableError(_OTHER_INDEX)
    count = size // _PAIR_BYTES
    if count > MAX_CHUNK_MESSAGES or pairs_at + size > len(region):
        raise UnreadableError(_LONG_INDEX)
    return pairs_at, count


@dataclass(slots=True)
class ChunkContent:
    """The content of a decompressed chunk.

    Attributes:
        columns: the messages by channel.
        usable: how many of its bytes are whole records.
        messages: how many there are, with those of impossible log times.
        declarations: opcode and body of its schema and channel records.
    """

    columns: dict[int, Column]
    usable: int
    messages: int
    declarations: list[tuple[int, bytes]] = field(default_factory=list)


def walk_chunk(data: bytes) -> ChunkContent:
    """Returns the content of a decompressed chunk, as far as whole records reach.

    Raises:
        UnreadableError: it has more messages or declarations than are indexed.
    """
    found: dict[int, tuple[array[int], array[int]]] = {}
    declarations: list[tuple[int, bytes]] = []
    position, end = 0, len(data)
    record, message = RECORD.unpack_from, MESSAGE.unpack_from
    messages = 0
    while position + RECORD.size <= end:
        opcode, length = record(data, position)
        following = position + RECORD.size + length
        if following > end or opcode == 0:
            break
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE_FIELDS:
                break
            _, _, channel, _, log_time, _ = message(data, position)
            entry = found.get(channel)
            if entry is None:
                entry = found[channel] = (array("Q"), array("q"))
            entry[0].append(log_time)
            entry[1].append(position)
            messages += 1
            if messages > MAX_CHUNK_MESSAGES:
                raise UnreadableError(f"a chunk holds more than {MAX_CHUNK_MESSAGES} messages")
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            declarations.append((opcode, data[position + RECORD.size : following]))
            if len(declarations) > MAX_CHUNK_DECLARATIONS:
                raise UnreadableError(_MANY_DECLARED)
        position = following
    columns = {channel: column_of(*lists) for channel, lists in found.items()}
    return ChunkContent(columns, position, messages, declarations)


def column_of(times: Sequence[int], places: Sequence[int]) -> Column:
    """Returns a column of log times (unsigned, in file order) and offsets."""
    return Column.of(
        np.array(times, dtype=np.uint64).astype(np.int64), np.array(places, dtype=np.int64)
    )


class ChunkHead(NamedTuple):
    """The fields of a chunk record before its data, which begins at `data_at` in the body."""

    crc: int
    compression: str
    data_size: int
    data_at: int


CHUNK_HEAD_BYTES: Final = 96
"""The front of the body of a chunk record: all its fields, for any compression."""
_SMALL_BYTES: Final = 48 << 10


def read_compressed_chunk(
    file: OpenFile, body_at: int, body_size: int, max_bytes: int
) -> tuple[ChunkHead, bytes]:
    """Reads the fields of a chunk record, and its data as far as the body reaches.

    Args:
        file: the open file.
        body_at: where the record's body begins.
        body_size: how much of the body there is.
        max_bytes: the size up to which the data is read.

    Raises:
        UnreadableError: the fields are not all there, or the data is larger than `max_bytes`.
    """
    # A small chunk is read at once: to copy it costs less than a second read.
    whole = file.read(body_at, body_size if body_size <= _SMALL_BYTES else CHUNK_HEAD_BYTES)
    head = chunk_head(whole)
    if head.data_size > max_bytes:
        raise UnreadableError(too_large("a chunk", max_bytes))
    in_file = min(body_size - head.data_at, head.data_size)
    if head.data_at + in_file <= len(whole):
        return head, whole[head.data_at : head.data_at + in_file]
    return head, file.read(body_at + head.data_at, in_file)


def chunk_head(body: bytes) -> ChunkHead:
    """Decodes the fields of a chunk record, from the front of its body.

    Raises:
        UnreadableError: the body is too short.
    """
    if len(body) < CHUNK_TIMES.size + 12:
        raise UnreadableError("damaged: a chunk ends inside its own header")
    crc: int = CHUNK_TIMES.unpack_from(body)[3]
    at = CHUNK_TIMES.size + 4
    name_size = int.from_bytes(body[at - 4 : at], "little")
    name = body[at : at + name_size]
    at += name_size + 8
    if at > len(body):
        raise UnreadableError("damaged: a chunk ends inside its own header")
    return ChunkHead(crc, name.decode(), int.from_bytes(body[at - 8 : at], "little"), at)


def decompressed_chunk(head: ChunkHead, compressed: bytes, limit: SizeLimit) -> bytes:
    """Decompresses a whole chunk, and verifies its checksum if it has one.

    Nothing is allocated by the size that the chunk states.

    Raises:
        UnreadableError: it is damaged, larger than allowed, or its compression is unknown.
    """
    if len(compressed) != head.data_size:
        raise UnreadableError("damaged: a chunk is shorter than it states")
    data = _decompressed(head.compression, compressed, limit)
    if len(data) > limit.max_bytes:
        raise UnreadableError(too_large("a chunk", limit.max_bytes))
    if head.crc and zlib.crc32(data) != head.crc:
        raise UnreadableError("damaged: a chunk does not match its checksum")
    return data


def decompressed_prefix(head: ChunkHead, compressed: bytes, limit: SizeLimit) -> bytes:
    """Decompresses the front of a chunk that its file ends in."""
    max_bytes, take_turn = limit
    if head.compression == "zstd":
        data = zstd_front(compressed, min(LARGE_BYTES, max_bytes))
        if len(data) < LARGE_BYTES:
            return data
        take_turn()
        return zstd_front(compressed, max_bytes)
    return _decompressed(head.compression, compressed, limit)[:max_bytes]


def _decompressed(compression: str, compressed: bytes, limit: SizeLimit) -> bytes:
    """Returns at most one byte more than allowed, so that the caller sees the excess."""
    max_bytes, take_turn = limit
    if not compression:
        if len(compressed) > LARGE_BYTES:
            take_turn()
        return compressed
    if compression == "zstd":
        return decompress_zstd(compressed, limit)
    if compression == "lz4":
        data = _lz4_front(compressed, min(LARGE_BYTES, max_bytes) + 1)
        if LARGE_BYTES < len(data) <= max_bytes:
            take_turn()
            data = _lz4_front(compressed, max_bytes + 1)
        return data
    raise UnreadableError(f"its compression {compression!r} is not read (zstd and lz4 are)")


def _lz4_front(compressed: bytes, size: int) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(compressed, size))


class OpenedChunk(NamedTuple):
    """A chunk of a file, decompressed as far as the file reaches.

    Attributes:
        data: the decompressed records; only the first `content.usable` bytes are whole records.
        content: what the records hold.
        data_at: where the compressed data begins in the body of the chunk record.
        compression: how it was compressed; empty where it was not.
    """

    data: bytes
    content: ChunkContent
    data_at: int
    compression: str


class ChunkOpener:
    """Decompresses the chunks of one file, and stops where they come to more than a robot's do.

    A file of some MB can hold chunks that decompress to terabytes.
    """

    def __init__(self, file: OpenFile, limit: SizeLimit) -> None:
        self._file = file
        self._limit = limit
        self._bytes = 0
        self._chunks = 0

    def open(self, record: FileRecord) -> OpenedChunk:
        """Decompresses a chunk; one that the file ends in, as far as the file reaches.

        Raises:
            UnreadableError: the chunk is damaged or too large, or the chunks before it were.
        """
        if self._chunks >= MAX_CHUNKS:
            raise UnreadableError(f"it has more than {MAX_CHUNKS} chunks")
        if self._bytes > max_decompressed_bytes(self._file.size):
            raise UnreadableError(
                f"its chunks hold more than {MAX_COMPRESSION_RATIO} times what the file does"
            )
        in_file = min(record.end, self._file.size) - record.body_at
        decompress = decompressed_chunk if record.end <= self._file.size else decompressed_prefix
        with as_unreadable():
            head, compressed = read_compressed_chunk(
                self._file, record.body_at, in_file, self._limit.max_bytes
            )
            data = decompress(head, compressed, self._limit)
            self._bytes += len(data)
            content = walk_chunk(data)
        self._bytes += MESSAGE_BYTES * content.messages
        self._chunks += 1
        return OpenedChunk(data, content, head.data_at, head.compression)

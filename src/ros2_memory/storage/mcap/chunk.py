"""Decompresses chunks, and finds the messages of each channel in them.

The fields of messages and message indexes are read with numpy and struct: the `mcap` library makes
a Python object for every record of a chunk (2.4 ms a chunk, where walking its bytes takes 0.47).
"""

from __future__ import annotations

import struct
import zlib
from array import array
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]  # has no types
import numpy as np
from mcap.opcode import Opcode

from ros2_memory.core.arrays import gathered, places_within
from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.storage.errors import (
    MAX_CHANNELS,
    MAX_CHUNK_DECLARATIONS,
    MAX_CHUNK_MESSAGES,
    MAX_CHUNKS,
    MAX_COMPRESSION_RATIO,
    MESSAGE_BYTES,
    SizeLimit,
    UnreadableError,
    as_unreadable,
    max_decompressed_bytes,
)
from ros2_memory.storage.mcap.records import (
    CHUNK,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    UINT64,
    FileRecord,
)
from ros2_memory.storage.zstd_bag import decompress_front, decompress_zstd, zstd_front

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ros2_memory.storage.base import IntArray, Mask
    from ros2_memory.storage.file_io import OpenFile


_INDEX_OPCODE: Final = int(Opcode.MESSAGE_INDEX)
_OTHER_INDEX: Final = "damaged: a message index is not what its chunk index says"
OUTSIDE: Final = "damaged: a chunk states other times than its messages have"
INDEX_OFFSET: Final = np.dtype([("channel", "<u2"), ("at", "<i8")])
"""In a chunk index: where in the file a channel's message index is."""
_INDEX: Final = np.dtype(
    [("opcode", "u1"), ("length", "<i8"), ("channel", "<u2"), ("size", "<u4")], align=False
)
"""A message index up to its entries: opcode, length, channel, and the bytes of the entries."""
_INDEX_FIELDS: Final = 6
"""Bytes that the length of a message index counts besides its entries: channel and size."""
_INDEX_SIZE: Final = struct.Struct("<I")
_INDEX_PLACE: Final = struct.Struct("<HQ")
_ENTRY: Final = np.dtype([("time", "<i8"), ("offset", "<i8")])
"""An entry of a message index: a log time, and an offset in the decompressed chunk."""


class Chunk(NamedTuple):
    """One chunk of a file, or a part of a file with messages outside chunks (`is_unchunked`).

    A tuple: indexing a week makes millions.

    Attributes:
        offset: where the chunk record begins in the file.
        length: bytes of the record.
        start: the earliest log time in the chunk.
        end: the latest log time in the chunk, inclusive.
        channels: the channels that have messages in the chunk.
        index_places: the offsets of its message indexes, as they are written in the file; None if
            there are none to rely on.
        index_length: bytes of its message indexes, which follow the chunk.
        usable: how many of its decompressed bytes are whole records, if the file ends inside it.
        is_unchunked: whether this is no chunk: its message records begin at `offset` in the file.
    """

    offset: int
    length: int
    start: Ns
    end: Ns
    channels: frozenset[int]
    index_places: bytes | None = None
    index_length: int = 0
    usable: int | None = None
    is_unchunked: bool = False


class MessageTable(NamedTuple):
    """Messages as columns: channel, log time, offset in the chunk, and position of the chunk."""

    channels: IntArray
    times: IntArray
    offsets: IntArray
    chunks: IntArray

    @classmethod
    def of_chunk(cls, channels: array[int], times: array[int], offsets: array[int]) -> MessageTable:
        """Returns the messages of one chunk, without those whose log time is past `MAX_NS`."""
        unsigned = np.array(times, np.uint64)
        is_possible = unsigned < MAX_NS
        return cls(
            np.array(channels, np.int64)[is_possible],
            unsigned[is_possible].astype(np.int64),
            np.array(offsets, np.int64)[is_possible],
            np.zeros(np.count_nonzero(is_possible), np.int64),
        )

    def select(self, rows: IntArray | Mask) -> MessageTable:
        """Returns the messages at these positions, or where the mask is set."""
        return MessageTable(*(column[rows] for column in self))


class _Indexes(NamedTuple):
    """Message indexes as columns.

    Attributes:
        channels: the channel of each index.
        chunks: the position of its chunk.
        entries_at: where its entries begin in the bytes of all indexes.
        counts: how many entries it has.
    """

    channels: IntArray
    chunks: IntArray
    entries_at: IntArray
    counts: IntArray


def read_indexes(
    chunks: Sequence[Chunk], indexes: Sequence[bytes], wanted: Collection[int] | None = None
) -> MessageTable:
    """Returns the messages of the `wanted` channels, or of all, by the message indexes of chunks.

    Args:
        chunks: at least one.
        indexes: for each chunk the bytes of its message indexes.
        wanted: the numbers of channels; None for all.

    Raises:
        UnreadableError: the indexes are not those that the chunk indexes name, or have other times.
    """
    region = b"".join(indexes)
    channels, chunk_of, entries_at, counts = _checked_indexes(chunks, indexes, region)
    is_wanted = counts > 0
    if wanted is not None:
        is_wanted &= np.isin(channels, np.array(sorted(wanted), np.int64), kind="sort")
    counts = counts[is_wanted]
    nth = places_within(counts)
    places = np.repeat(entries_at[is_wanted], counts) + nth * _ENTRY.itemsize
    entries = gathered(region, _ENTRY, places)
    messages = MessageTable(
        np.repeat(channels[is_wanted], counts),
        np.ascontiguousarray(entries["time"]),
        np.ascontiguousarray(entries["offset"]),
        np.repeat(chunk_of[is_wanted], counts),
    )
    times = messages.times
    starts = np.array([chunk.start for chunk in chunks])[messages.chunks]
    ends = np.array([chunk.end for chunk in chunks])[messages.chunks]
    if ((times < starts) | (times > ends) | (times < 0) | (times >= MAX_NS)).any():
        raise UnreadableError(OUTSIDE)
    return messages


def _checked_indexes(chunks: Sequence[Chunk], indexes: Sequence[bytes], region: bytes) -> _Indexes:
    """Finds the message indexes of chunks in their joined bytes, the `region`.

    Raises:
        UnreadableError: they are not those that the chunk indexes name.
    """
    stated = np.frombuffer(b"".join([chunk.index_places or b"" for chunk in chunks]), INDEX_OFFSET)
    if not stated.size:
        raise UnreadableError(_OTHER_INDEX)
    indexes_of_chunk = [len(chunk.index_places or b"") // INDEX_OFFSET.itemsize for chunk in chunks]
    chunk_of = np.repeat(np.arange(len(chunks)), indexes_of_chunk)
    ends = np.cumsum([len(index) for index in indexes])
    begins = ends - [len(index) for index in indexes]
    in_file = np.array([chunk.offset + chunk.length for chunk in chunks])
    at = stated["at"] - (in_file - begins)[chunk_of]
    if at.min() < 0 or at.max() + _INDEX.itemsize > len(region):
        raise UnreadableError(_OTHER_INDEX)
    heads = gathered(region, _INDEX, at)
    sizes = heads["size"].astype(np.int64)
    entries_at = at + _INDEX.itemsize
    if (
        (heads["opcode"] != _INDEX_OPCODE).any()
        or (heads["channel"] != stated["channel"]).any()
        or (heads["length"] != sizes + _INDEX_FIELDS).any()
        or (sizes % _ENTRY.itemsize).any()
        or sizes.max() > MAX_CHUNK_MESSAGES * _ENTRY.itemsize
        or (at < begins[chunk_of]).any()
        or (entries_at + sizes > ends[chunk_of]).any()
        or not _cover(at, entries_at + sizes, len(region))
    ):
        raise UnreadableError(_OTHER_INDEX)
    channels = heads["channel"].astype(np.int64)
    return _Indexes(channels, chunk_of, entries_at, sizes // _ENTRY.itemsize)


def _cover(begins: IntArray, ends: IntArray, size: int) -> bool:
    """Returns whether records cover a region of `size` bytes without gaps or overlaps."""
    order = np.argsort(begins)
    begins, ends = begins[order], ends[order]
    return bool(begins[0] == 0 and ends[-1] == size and (begins[1:] == ends[:-1]).all())


def read_trusted_index(chunk: Chunk, index: bytes, wanted: Collection[int]) -> MessageTable:
    """Returns the messages of the `wanted` channels of a chunk, by the indexes behind it.

    `read_indexes` has checked all indexes of the file when the file was indexed. To check them
    again takes longer than all else that a chunk takes.

    Raises:
        ValueError, struct.error: they have changed since.
    """
    base = chunk.offset + chunk.length
    numbers: list[int] = []
    entries = [np.zeros(0, _ENTRY)]
    for number, place in _INDEX_PLACE.iter_unpack(chunk.index_places or b""):
        if number in wanted:
            at = place - base + _INDEX.itemsize
            (size,) = _INDEX_SIZE.unpack_from(index, at - _INDEX_SIZE.size)
            numbers.append(number)
            entries.append(np.frombuffer(index, _ENTRY, size // _ENTRY.itemsize, at))
    joined = entries[1] if len(numbers) == 1 else np.concatenate(entries)
    counts = [part.size for part in entries[1:]]
    return MessageTable(
        np.repeat(np.array(numbers, np.int64), counts),
        np.ascontiguousarray(joined["time"]),
        np.ascontiguousarray(joined["offset"]),
        np.zeros(joined.size, np.int64),
    )


def index_bytes(indexes: int, messages: int) -> int:
    """Returns how many bytes message indexes take that list so many messages in all."""
    return indexes * _INDEX.itemsize + messages * _ENTRY.itemsize


def index_behind(file: OpenFile, chunk: Chunk) -> bytes:
    """Returns the message indexes behind a chunk."""
    return file.read(chunk.offset + chunk.length, chunk.index_length)


def index_groups(
    file: OpenFile, chunks: Sequence[Chunk]
) -> Iterator[tuple[Sequence[Chunk], list[bytes]]]:
    """Yields chunks with the bytes of the message indexes behind each, some MB at a time.

    Raises:
        UnreadableError: an index is larger than it can be.
    """
    group: list[Chunk] = []
    indexes: list[bytes] = []
    size = 0
    for chunk in chunks:
        if chunk.index_length > index_bytes(MAX_CHANNELS, MAX_CHUNK_MESSAGES):
            raise UnreadableError(_OTHER_INDEX)
        group.append(chunk)
        indexes.append(index_behind(file, chunk))
        size += chunk.index_length
        if size > LARGE_BYTES:
            yield group, indexes
            group, indexes, size = [], [], 0
    if group:
        yield group, indexes


class ChunkContent(NamedTuple):
    """The content of a decompressed chunk.

    Attributes:
        messages: the messages with possible log times.
        usable: how many of its bytes are whole records.
        message_count: how many messages it has, also with impossible log times.
        declarations: opcode and body of its schema and channel records.
    """

    messages: MessageTable
    usable: int
    message_count: int
    declarations: list[tuple[int, bytes]]


def walk_chunk(data: bytes) -> ChunkContent:
    """Returns the content of a decompressed chunk, as far as whole records reach.

    Raises:
        UnreadableError: it has more messages or declarations than are indexed.
    """
    channels, times, offsets = array("H"), array("Q"), array("q")
    declarations: list[tuple[int, bytes]] = []
    position, end = 0, len(data)
    while position + RECORD.size <= end:
        opcode, length = RECORD.unpack_from(data, position)
        following = position + RECORD.size + length
        is_cut_message = opcode == Opcode.MESSAGE and length < MESSAGE_FIELDS
        if following > end or opcode == 0 or is_cut_message:
            break
        if opcode == Opcode.MESSAGE:
            _, _, channel, _, log_time, _ = MESSAGE.unpack_from(data, position)
            channels.append(channel)
            times.append(log_time)
            offsets.append(position)
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            declarations.append((opcode, data[position + RECORD.size : following]))
        if len(times) > MAX_CHUNK_MESSAGES:
            raise UnreadableError(f"a chunk holds more than {MAX_CHUNK_MESSAGES} messages")
        if len(declarations) > MAX_CHUNK_DECLARATIONS:
            raise UnreadableError(f"a chunk declares more than {MAX_CHUNK_DECLARATIONS} things")
        position = following
    messages = MessageTable.of_chunk(channels, times, offsets)
    return ChunkContent(messages, position, len(times), declarations)


class ChunkHead(NamedTuple):
    """The fields of a chunk record before its data, which begins at `data_at` in the body.

    `size` is that of the decompressed data.
    """

    size: int
    crc: int
    compression: str
    data_size: int
    data_at: int


_HEAD_BYTES: Final = 96
"""The front of the body of a chunk record: all its fields, for any compression."""


def chunk_body(file: OpenFile, at: int, length: int, limit: SizeLimit) -> bytes:
    """Returns the body of the chunk record at an offset, of which `length` bytes are in the file.

    Of one above the limit, enough to recognise that.
    """
    return file.read(at + RECORD.size, min(length - RECORD.size, limit.max_bytes + _HEAD_BYTES))


def chunk_head(body: bytes) -> ChunkHead:
    """Decodes the fields of a chunk record, from the front of its body.

    Raises:
        UnreadableError: the body is too short.
        ValueError: the name of the compression is not UTF-8.
    """
    try:
        _, _, size, crc, name_size = CHUNK.unpack_from(body)
        name_end = CHUNK.size + name_size
        (data_size,) = UINT64.unpack_from(body, name_end)
    except struct.error as error:
        raise UnreadableError("damaged: a chunk ends inside its own header") from error
    compression = body[CHUNK.size : name_end].decode()
    return ChunkHead(size, crc, compression, data_size, name_end + UINT64.size)


def decompressed_chunk(body: bytes, limit: SizeLimit, *, is_whole: bool = True) -> bytes:
    """Decompresses the body of a chunk record; verifies its size, and its checksum if it has one.

    Of a body that is not `is_whole`, the front is decompressed, as far as it is there. Nothing is
    allocated by the size that the chunk states, and no more is decompressed.

    Raises:
        UnreadableError: it is damaged, larger than allowed, or its compression is unknown.
    """
    head = chunk_head(body)
    compressed = memoryview(body)[head.data_at : head.data_at + head.data_size]
    limit.require("a chunk", max(head.size, head.data_size))
    limit = limit._replace(max_bytes=head.size)
    if not is_whole:
        if head.compression == "zstd":
            data = decompress_front(partial(zstd_front, compressed), limit)
        else:
            data = _decompress(head.compression, compressed, limit)
        return data[: limit.max_bytes]
    if len(compressed) != head.data_size:
        raise UnreadableError("damaged: a chunk is shorter than it states")
    data = _decompress(head.compression, compressed, limit)
    if len(data) != head.size:  # data that ends early decompresses without an error
        raise UnreadableError("damaged: a chunk is not as long as it states")
    if head.crc and zlib.crc32(data) != head.crc:
        raise UnreadableError("damaged: a chunk does not match its checksum")
    return data


def chunk_data(file: OpenFile, chunk: Chunk, limit: SizeLimit) -> bytes:
    """Returns the decompressed records of a chunk; see `decompressed_chunk`.

    Raises:
        UnreadableError: the chunk is damaged or larger than allowed.
    """
    if chunk.is_unchunked:
        if chunk.length > LARGE_BYTES:
            limit.take_turn()
        return file.read(chunk.offset, chunk.length)
    body = chunk_body(file, chunk.offset, chunk.length, limit)
    return decompressed_chunk(body, limit, is_whole=chunk.usable is None)[: chunk.usable]


def _decompress(compression: str, compressed: memoryview, limit: SizeLimit) -> bytes:
    """Returns at most one byte more than allowed, so that the caller sees the excess."""
    if not compression:
        if len(compressed) > LARGE_BYTES:
            limit.take_turn()
        return bytes(compressed)
    if compression == "zstd":
        return decompress_zstd(compressed, limit)
    if compression == "lz4":
        return decompress_front(partial(_lz4_front, compressed), limit)
    raise UnreadableError(f"its compression {compression!r} is not read (zstd and lz4 are)")


def _lz4_front(compressed: memoryview, size: int) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(compressed, size))


class OpenedChunk(NamedTuple):
    """A chunk of a file, decompressed as far as the file reaches.

    Attributes:
        data: the decompressed bytes; the first `content.usable` of them are whole records.
        content: the messages and declarations in these records.
        is_compressed: whether the chunk is compressed in the file.
    """

    data: bytes
    content: ChunkContent
    is_compressed: bool


class ChunkOpener:
    """Decompresses the chunks of one file, up to `MAX_CHUNKS` and `MAX_COMPRESSION_RATIO`.

    Without these limits a file of some MB could decompress to terabytes.
    """

    def __init__(self, file: OpenFile, limit: SizeLimit) -> None:
        self._file = file
        self._limit = limit
        self._bytes = 0
        self._chunks = 0

    def open(self, record: FileRecord) -> OpenedChunk:
        """Decompresses a chunk, as far as the file reaches.

        Raises:
            UnreadableError: the chunk is damaged or too large, or a limit of the file is reached.
        """
        if self._chunks >= MAX_CHUNKS:
            raise UnreadableError(f"it has more than {MAX_CHUNKS} chunks")
        if self._bytes > max_decompressed_bytes(self._file.size):
            raise UnreadableError(
                f"its chunks hold more than {MAX_COMPRESSION_RATIO} times what the file does"
            )
        in_file = min(record.end, self._file.size) - record.offset
        with as_unreadable():
            body = chunk_body(self._file, record.offset, in_file, self._limit)
            is_whole = record.end <= self._file.size
            # Also of a chunk that turns out to be damaged.
            self._bytes += min(chunk_head(body).size, self._limit.max_bytes)
            data = decompressed_chunk(body, self._limit, is_whole=is_whole)
            content = walk_chunk(data)
        self._bytes += MESSAGE_BYTES * content.message_count
        self._chunks += 1
        return OpenedChunk(data, content, bool(chunk_head(body).compression))

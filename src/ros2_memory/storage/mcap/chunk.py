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

from ros2_memory.core.arrays import gathered
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
    too_large,
)
from ros2_memory.storage.mcap.records import (
    CHUNK,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    UINT64,
    FileRecord,
)
from ros2_memory.storage.zstd_bag import decompress_zstd, in_turn, zstd_front

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
"""A message index up to its pairs of log time and offset: opcode, length, channel, their size."""
_INDEX_SIZE: Final = struct.Struct("<I")
_INDEX_PLACE: Final = struct.Struct("<HQ")
_PAIR: Final = np.dtype([("time", "<i8"), ("place", "<i8")])


class Chunk(NamedTuple):
    """One chunk of a file (a tuple: indexing a week makes millions).

    Or a part of a file that has messages outside chunks: `is_unchunked`.

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
        is_unchunked: whether its messages are in no chunk; they are found from its first byte on.
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


class Pairs(NamedTuple):
    """Messages: for each its channel, log time, offset in its chunk, and the chunk's position."""

    channels: IntArray
    times: IntArray
    offsets: IntArray
    chunks: IntArray

    @classmethod
    def of(cls, numbers: array[int], times: array[int], offsets: array[int]) -> Pairs:
        """Returns messages in file order, without (unsigned) log times that no clock shows."""
        unsigned = np.array(times, np.uint64)
        is_possible = unsigned < MAX_NS
        places, channels = (
            np.array(column, np.int64)[is_possible] for column in (offsets, numbers)
        )
        return cls(channels, unsigned[is_possible].astype(np.int64), places, np.zeros_like(places))

    def taken(self, rows: Mask) -> Pairs:
        """Returns some of the messages."""
        return Pairs(*(column[rows] for column in self))


def pairs_in(
    chunks: Sequence[Chunk], indexes: Sequence[bytes], wanted: Collection[int] | None = None
) -> Pairs:
    """Returns the messages of the `wanted` channels, or of all, by the indexes of these chunks.

    Raises:
        UnreadableError: the indexes are not those that the chunk indexes name, or have other times.
    """
    region = b"".join(indexes)
    stated = np.frombuffer(b"".join([chunk.index_places or b"" for chunk in chunks]), INDEX_OFFSET)
    if not stated.size:
        raise UnreadableError(_OTHER_INDEX)
    places = [len(chunk.index_places or b"") // INDEX_OFFSET.itemsize for chunk in chunks]
    number = np.repeat(np.arange(len(chunks)), places)
    ends = np.cumsum([len(index) for index in indexes])
    begins = ends - [len(index) for index in indexes]
    behind = np.array([chunk.offset + chunk.length for chunk in chunks])
    at = stated["at"] - (behind - begins)[number]
    if at.min() < 0 or at.max() + _INDEX.itemsize > len(region):
        raise UnreadableError(_OTHER_INDEX)
    heads = gathered(region, _INDEX, at)
    sizes = heads["size"].astype(np.int64)
    after = at + _INDEX.itemsize + sizes
    if (
        (heads["opcode"] != _INDEX_OPCODE).any()
        or (heads["channel"] != stated["channel"]).any()
        or (heads["length"] != sizes + 6).any()
        or (sizes % _PAIR.itemsize).any()
        or sizes.max() > MAX_CHUNK_MESSAGES * _PAIR.itemsize
        or (at < begins[number]).any()
        or (after > ends[number]).any()
        or not _fill(at, after, len(region))
    ):
        raise UnreadableError(_OTHER_INDEX)
    channels = heads["channel"].astype(np.int64)
    is_kept = sizes > 0
    if wanted is not None:
        is_kept &= np.isin(channels, np.array(sorted(wanted), np.int64), kind="sort")
    counts = sizes[is_kept] // _PAIR.itemsize
    total = int(counts.sum())
    before = np.cumsum(counts) - counts
    pairs_at = np.repeat(at[is_kept] + _INDEX.itemsize - before * _PAIR.itemsize, counts)
    pairs_at += np.arange(total) * _PAIR.itemsize
    pairs = gathered(region, _PAIR, pairs_at)
    times = np.ascontiguousarray(pairs["time"])
    chunk_of = np.repeat(number[is_kept], counts)
    starts = np.array([chunk.start for chunk in chunks])[chunk_of]
    stops = np.array([chunk.end for chunk in chunks])[chunk_of]
    if total and ((times < starts) | (times > stops) | (times < 0) | (times >= MAX_NS)).any():
        raise UnreadableError(OUTSIDE)
    return Pairs(
        np.repeat(channels[is_kept], counts), times, np.ascontiguousarray(pairs["place"]), chunk_of
    )


def believed_pairs(chunk: Chunk, region: bytes, wanted: Collection[int]) -> Pairs:
    """Returns the messages of the `wanted` channels of a chunk, by the indexes behind it.

    These are believed: `pairs_in` found all indexes of the file right when the file was indexed. To
    check them once more takes longer than all else that a chunk takes.

    Raises:
        ValueError, struct.error: they have changed.
    """
    base = chunk.offset + chunk.length
    numbers: list[int] = []
    columns = [np.zeros(0, _PAIR)]
    for number, place in _INDEX_PLACE.iter_unpack(chunk.index_places or b""):
        if number in wanted:
            at = place - base + _INDEX.itemsize
            (size,) = _INDEX_SIZE.unpack_from(region, at - _INDEX_SIZE.size)
            numbers.append(number)
            columns.append(np.frombuffer(region, _PAIR, size // _PAIR.itemsize, at))
    pairs = columns[1] if len(numbers) == 1 else np.concatenate(columns)
    times, offsets = (np.ascontiguousarray(pairs[name]) for name in ("time", "place"))
    sizes = [column.size for column in columns[1:]]
    channels = np.repeat(np.array(numbers, np.int64), sizes)
    return Pairs(channels, times, offsets, np.zeros(channels.size, np.int64))


def _fill(begins: IntArray, ends: IntArray, size: int) -> bool:
    """Returns whether records follow each other from the begin of a region to its end."""
    order = np.argsort(begins)
    begins, ends = begins[order], ends[order]
    return bool(begins[0] == 0 and ends[-1] == size and (begins[1:] == ends[:-1]).all())


def index_bytes(indexes: int, messages: int) -> int:
    """Returns the bytes of so many message indexes with so many messages in all."""
    return indexes * _INDEX.itemsize + messages * _PAIR.itemsize


def index_groups(
    file: OpenFile, chunks: Sequence[Chunk]
) -> Iterator[tuple[Sequence[Chunk], list[bytes]]]:
    """Yields chunks with the bytes of the message indexes behind each, some MB at a time.

    Raises:
        UnreadableError: an index is larger than it can be.
    """
    begin = size = 0
    for nth, chunk in enumerate(chunks):
        if chunk.index_length > index_bytes(MAX_CHANNELS, MAX_CHUNK_MESSAGES):
            raise UnreadableError(_OTHER_INDEX)
        size += chunk.index_length
        if size > LARGE_BYTES or nth == len(chunks) - 1:
            group = chunks[begin : nth + 1]
            yield (
                group,
                [file.read(member.offset + member.length, member.index_length) for member in group],
            )
            begin, size = nth + 1, 0


class ChunkContent(NamedTuple):
    """The content of a decompressed chunk.

    Attributes:
        pairs: the messages.
        usable: how many of its bytes are whole records.
        messages: how many there are, with those of impossible log times.
        declarations: opcode and body of its schema and channel records.
    """

    pairs: Pairs
    usable: int
    messages: int
    declarations: list[tuple[int, bytes]]


def walk_chunk(data: bytes) -> ChunkContent:
    """Returns the content of a decompressed chunk, as far as whole records reach.

    Raises:
        UnreadableError: it has more messages or declarations than are indexed.
    """
    channels, times, places = array("H"), array("Q"), array("q")
    declarations: list[tuple[int, bytes]] = []
    position, end = 0, len(data)
    record, message = RECORD.unpack_from, MESSAGE.unpack_from
    while position + RECORD.size <= end:
        opcode, length = record(data, position)
        following = position + RECORD.size + length
        if following > end or opcode == 0:
            break
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE_FIELDS:
                break
            _, _, channel, _, log_time, _ = message(data, position)
            channels.append(channel)
            times.append(log_time)
            places.append(position)
            if len(times) > MAX_CHUNK_MESSAGES:
                raise UnreadableError(f"a chunk holds more than {MAX_CHUNK_MESSAGES} messages")
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            declarations.append((opcode, data[position + RECORD.size : following]))
            if len(declarations) > MAX_CHUNK_DECLARATIONS:
                raise UnreadableError(f"a chunk declares more than {MAX_CHUNK_DECLARATIONS} things")
        position = following
    pairs = Pairs.of(channels, times, places)
    return ChunkContent(pairs, position, len(times), declarations)


class ChunkHead(NamedTuple):
    """The fields of a chunk record before its data, which begins at `data_at` in the body."""

    crc: int
    compression: str
    data_size: int
    data_at: int


_HEAD_BYTES: Final = 96
"""The front of the body of a chunk record: all its fields, for any compression."""


def chunk_body(file: OpenFile, at: int, size: int, limit: SizeLimit) -> bytes:
    """Returns the body of a chunk record, or so much of it that a too large one is recognised."""
    return file.read(at, min(size, limit.max_bytes + _HEAD_BYTES))


def chunk_head(body: bytes) -> ChunkHead:
    """Decodes the fields of a chunk record, from the front of its body.

    Raises:
        UnreadableError: the body is too short.
        ValueError: the name of the compression is not UTF-8.
    """
    try:
        *_, crc, name_size = CHUNK.unpack_from(body)
        name_end = CHUNK.size + name_size
        (data_size,) = UINT64.unpack_from(body, name_end)
    except struct.error as error:
        raise UnreadableError("damaged: a chunk ends inside its own header") from error
    return ChunkHead(crc, body[CHUNK.size : name_end].decode(), data_size, name_end + UINT64.size)


def decompressed_chunk(body: bytes, limit: SizeLimit, *, is_whole: bool = True) -> bytes:
    """Decompresses a chunk, and verifies its checksum if it has one; or its front, if it is cut.

    Nothing is allocated by the size that the chunk states.

    Raises:
        UnreadableError: it is damaged, larger than allowed, or its compression is unknown.
    """
    crc, compression, size, at = chunk_head(body)
    compressed = memoryview(body)[at : at + size]
    if size > limit.max_bytes:
        raise UnreadableError(too_large("a chunk", limit.max_bytes))
    if not is_whole:
        if compression == "zstd":
            data = in_turn(partial(zstd_front, compressed), limit)
        else:
            data = _decompressed(compression, compressed, limit)
        return data[: limit.max_bytes]
    if len(compressed) != size:
        raise UnreadableError("damaged: a chunk is shorter than it states")
    data = _decompressed(compression, compressed, limit)
    if len(data) > limit.max_bytes:
        raise UnreadableError(too_large("a chunk", limit.max_bytes))
    if crc and zlib.crc32(data) != crc:
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
    body = chunk_body(file, chunk.offset + RECORD.size, chunk.length - RECORD.size, limit)
    return decompressed_chunk(body, limit, is_whole=chunk.usable is None)[: chunk.usable]


def _decompressed(compression: str, compressed: memoryview, limit: SizeLimit) -> bytes:
    """Returns at most one byte more than allowed, so that the caller sees the excess."""
    if not compression:
        if len(compressed) > LARGE_BYTES:
            limit.take_turn()
        return bytes(compressed)
    if compression == "zstd":
        return decompress_zstd(compressed, limit)
    if compression == "lz4":
        return in_turn(partial(_lz4_front, compressed), limit)
    raise UnreadableError(f"its compression {compression!r} is not read (zstd and lz4 are)")


def _lz4_front(compressed: memoryview, size: int) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(compressed, size))


class OpenedChunk(NamedTuple):
    """A chunk of a file, decompressed as far as the file reaches.

    Attributes:
        data: the decompressed records; only the first `content.usable` bytes are whole records.
        content: what the records hold.
        is_compressed: whether it was.
    """

    data: bytes
    content: ChunkContent
    is_compressed: bool


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
        with as_unreadable():
            body = chunk_body(self._file, record.body_at, in_file, self._limit)
            is_whole = record.end <= self._file.size
            data = decompressed_chunk(body, self._limit, is_whole=is_whole)
            self._bytes += len(data)
            content = walk_chunk(data)
        self._bytes += MESSAGE_BYTES * content.messages
        self._chunks += 1
        return OpenedChunk(data, content, bool(chunk_head(body).compression))

"""Decompresses chunks, and finds the messages of each channel in them.

The fields of messages and message indexes are read with numpy and struct: the `mcap` library makes
a Python object for every record of a chunk (2.4 ms a chunk, where walking its bytes takes 0.47).
"""

from __future__ import annotations

import struct
import zlib
from array import array
from dataclasses import dataclass, field
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
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)
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
NOT_THERE: Final = "damaged: a message is not where its index says"
_MANY_DECLARED: Final = f"a chunk declares more than {MAX_CHUNK_DECLARATIONS} things"
_EMPTY: Final[IntArray] = np.zeros(0, dtype=np.int64)
_ZERO: Final[IntArray] = np.zeros(1, dtype=np.int64)


class Column(NamedTuple):
    """Messages of one part of a file, by log time, ties in file order.

    `places` are the offsets of the message records, in the file or in the decompressed chunk.
    """

    times: IntArray
    places: IntArray

    @classmethod
    def of(cls, times: IntArray, places: IntArray) -> Column:
        """Returns a sorted column."""
        if times.size > 1 and not bool((times[1:] > times[:-1]).all()):
            order = np.lexsort((places, times))
            times, places = times[order], places[order]
            if bool(((times[1:] == times[:-1]) & (places[1:] == places[:-1])).any()):
                raise UnreadableError("damaged: a message index holds a message twice")
        return cls(times, places)


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


NO_PAIRS: Final = Pairs(_EMPTY, _EMPTY, _EMPTY, _EMPTY)


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


def believed_pairs(file: OpenFile, chunk: Chunk, wanted: Collection[int]) -> Pairs:
    """Returns the messages of the `wanted` channels of a chunk, by its indexes.

    These are believed: `pairs_in` found all indexes of the file right when the file was indexed. To
    check them once more takes longer than all else that a chunk takes.

    Raises:
        UnreadableError, ValueError, struct.error: they have changed.
    """
    base = chunk.offset + chunk.length
    region = file.read(base, chunk.index_length)
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


_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<i8"),
        ("publish_time", "<i8"),
    ],
    align=False,
)
"""The heads of message records: all but their payloads."""


def require_indexed(
    pairs: Pairs, data: bytes, places: IntArray, ends: IntArray | int
) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Compares messages with their records, and returns the heads of these.

    Together with the number of messages, which `mcap.index` compares with the statistics, this
    proves that all messages of these channels are there.

    Args:
        pairs: the messages, by their indexes.
        data: the decompressed records, which checksums protect.
        places: where the record of each message begins.
        ends: where the records of its chunk end.

    Raises:
        UnreadableError: a message is not there, has another channel or log time, or does not end in
            its chunk.
    """
    if places.size and (places.min() < 0 or places.max() > len(data) - _HEAD.itemsize):
        raise UnreadableError(NOT_THERE)
    heads, room = gathered(data, _HEAD, places), ends - places - RECORD.size
    is_other = heads["opcode"] != _MESSAGE_OPCODE
    is_other |= (heads["channel"] != pairs.channels) | (heads["log_time"] != pairs.times)
    is_other |= (heads["length"] < MESSAGE_FIELDS) | (heads["length"] > room)
    if is_other.any():
        raise UnreadableError(NOT_THERE)
    return heads


def in_file_order(places: IntArray) -> IntArray:
    """Returns where messages begin, ascending.

    Raises:
        UnreadableError: two of them begin at the same place.
    """
    ordered = np.sort(places)
    if (ordered[1:] == ordered[:-1]).any():
        raise UnreadableError("damaged: a message index holds a message twice")
    return ordered


def declarations_of(data: bytes, places: IntArray, chunk_ends: IntArray) -> list[tuple[int, bytes]]:
    """Returns the schema and channel records of chunks; walks only the bytes between messages.

    Args:
        data: the decompressed records of the chunks.
        places: where all of their messages begin in these.
        chunk_ends: where each chunk ends in these, ascending.

    Returns:
        The opcode and the body of each.

    Raises:
        UnreadableError: there are other messages between them, or too many declarations.
    """
    size = len(data)
    lengths = gathered(data, _HEAD, places)["length"]
    if ((lengths < 0) | (lengths > size)).any():
        raise UnreadableError(NOT_THERE)
    begins = np.concatenate([_ZERO, chunk_ends[:-1], places + RECORD.size + lengths])
    ends = np.concatenate([places, chunk_ends])
    begins.sort()
    ends.sort()
    if bool((begins > ends).any()):
        raise UnreadableError(NOT_THERE)
    declarations: list[tuple[int, bytes]] = []
    has_content = begins < ends
    for begin, end in zip(begins[has_content].tolist(), ends[has_content].tolist(), strict=True):
        walked = walk_chunk(data[begin:end])
        if walked.messages:
            raise UnreadableError("damaged: a chunk holds messages that its indexes do not")
        declarations += walked.declarations
        if len(declarations) > MAX_CHUNK_DECLARATIONS:
            raise UnreadableError(_MANY_DECLARED)
    return declarations


@dataclass(slots=True)
class ChunkContent:
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
    declarations: list[tuple[int, bytes]] = field(default_factory=list)


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
                raise UnreadableError(_MANY_DECLARED)
        position = following
    pairs = Pairs.of(channels, times, places)
    return ChunkContent(pairs, position, len(times), declarations)


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
        ValueError: the name of the compression is not UTF-8.
    """
    try:
        *_, crc, name_size = CHUNK.unpack_from(body)
        name_end = CHUNK.size + name_size
        (data_size,) = UINT64.unpack_from(body, name_end)
    except struct.error as error:
        raise UnreadableError("damaged: a chunk ends inside its own header") from error
    return ChunkHead(crc, body[CHUNK.size : name_end].decode(), data_size, name_end + UINT64.size)


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
    if head.compression == "zstd":
        data = in_turn(partial(zstd_front, compressed), limit)
    else:
        data = _decompressed(head.compression, compressed, limit)
    return data[: limit.max_bytes]


def _decompressed(compression: str, compressed: bytes, limit: SizeLimit) -> bytes:
    """Returns at most one byte more than allowed, so that the caller sees the excess."""
    if not compression:
        if len(compressed) > LARGE_BYTES:
            limit.take_turn()
        return compressed
    if compression == "zstd":
        return decompress_zstd(compressed, limit)
    if compression == "lz4":
        return in_turn(partial(_lz4_front, compressed), limit)
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

"""The second yardstick: the physical floor, frozen.

Open, read the bytes of the chunks needed, decompress, decode the messages returned. Where the
chunks lie, and where in them the messages, is known to it beforehand and costs nothing.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING, Final, NamedTuple, cast

import zstandard
from mcap.reader import make_reader

from benchmarks.payloads import typestore

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from mcap.records import ChunkIndex

    from benchmarks.bags import Split, Topic
    from benchmarks.views import OdometryMessage

_CHUNK_HEAD: Final = struct.calcsize("<BQQQQII") + len(b"zstd") + struct.calcsize("<Q")
"""From the start of a chunk record to its data, where its compression is `zstd`."""
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_RECORD: Final = struct.Struct("<BQ")
_FOOTER: Final = struct.Struct("<BQQQI")
_MAGIC_BYTES: Final = 8
_IS_MESSAGE: Final = 0x05


class Chunk(NamedTuple):
    """The compressed data of one chunk: where it lies in the file."""

    at: int
    size: int


class Needed(NamedTuple):
    """The chunks of one file that a question needs."""

    path: Path
    chunks: tuple[Chunk, ...]


class Message(NamedTuple):
    """One message: which chunk of which file, and where in the chunk's decompressed bytes."""

    nth: int
    chunk: int
    at: int
    size: int
    log_time: int


def needed(splits: Sequence[Split], topic: Topic) -> list[Needed]:
    """The chunks that hold a topic's messages, by file."""
    found = []
    for split in splits:
        with split.path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is None:
            raise ValueError(f"{split.path.name} has no summary; make the bags again")
        number = next(
            number for number, each in summary.channels.items() if each.topic == topic.name
        )
        indexes = sorted(summary.chunk_indexes, key=lambda index: index.message_start_time)
        chunks = tuple(_chunk(each) for each in indexes if number in each.message_index_offsets)
        found.append(Needed(split.path, chunks))
    return found


def located(places: Sequence[Needed], topic: Topic) -> list[Message]:
    """Every message of a topic in these chunks, oldest first."""
    found = []
    for nth, place in enumerate(places):
        number = _channel(place.path, topic)
        for chunk, data in enumerate(unpacked(place)):
            at = 0
            while at < len(data):
                opcode, length = _RECORD.unpack_from(data, at)
                if opcode == _IS_MESSAGE:
                    _, _, channel, _, log_time, _ = _MESSAGE.unpack_from(data, at)
                    size = _RECORD.size + length - _MESSAGE.size
                    if channel == number:
                        found.append(Message(nth, chunk, at + _MESSAGE.size, size, log_time))
                at += _RECORD.size + length
    return sorted(found, key=lambda message: message.log_time)


def open_and_read_summaries(paths: Sequence[Path]) -> int:
    """The bytes of all summary sections, having read them."""
    total = 0
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            end = os.fstat(descriptor).st_size - _MAGIC_BYTES
            footer = os.pread(descriptor, _FOOTER.size, end - _FOOTER.size)
            summary_at = _FOOTER.unpack(footer)[2]
            total += len(os.pread(descriptor, end - _FOOTER.size - summary_at, summary_at))
        finally:
            os.close(descriptor)
    return total


def unpacked(place: Needed) -> Iterator[bytes]:
    """The decompressed chunks of one file."""
    unpacker = zstandard.ZstdDecompressor()
    descriptor = os.open(place.path, os.O_RDONLY)
    try:
        for chunk in place.chunks:
            yield unpacker.decompress(os.pread(descriptor, chunk.size, chunk.at))
    finally:
        os.close(descriptor)


def unpack_all(places: Sequence[Needed]) -> int:
    """The bytes of all chunks, having decompressed them."""
    return sum(len(data) for place in places for data in unpacked(place))


def poses(places: Sequence[Needed], wanted: Sequence[Message]) -> list[tuple[int, float, float]]:
    """Log times and places of odometry messages, having decompressed all the chunks."""
    by_chunk: dict[tuple[int, int], list[Message]] = {}
    for message in wanted:
        by_chunk.setdefault((message.nth, message.chunk), []).append(message)
    return [
        _pose(message, data)
        for nth, place in enumerate(places)
        for number, data in enumerate(unpacked(place))
        for message in by_chunk.get((nth, number), ())
    ]


def pose(place: Needed, message: Message) -> tuple[int, float, float]:
    """Log time and place of one odometry message: one chunk read, one message decoded."""
    chunk = place.chunks[message.chunk]
    data = next(unpacked(Needed(place.path, (chunk,))))
    return _pose(message, data)


def _pose(message: Message, data: bytes) -> tuple[int, float, float]:
    payload = data[message.at : message.at + message.size]
    decoded = typestore().deserialize_cdr(payload, "nav_msgs/msg/Odometry")
    at = cast("OdometryMessage", decoded).pose.pose.position
    return message.log_time, at.x, at.y


def _chunk(index: ChunkIndex) -> Chunk:
    if index.compression != "zstd":
        raise ValueError(f"a chunk is compressed as {index.compression!r}; make the bags again")
    return Chunk(index.chunk_start_offset + _CHUNK_HEAD, index.compressed_size)


def _channel(path: Path, topic: Topic) -> int:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    channels = {} if summary is None else summary.channels
    return next(number for number, each in channels.items() if each.topic == topic.name)

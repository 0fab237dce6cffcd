"""One MCAP file, written record by record as the real recorder's library writes it.

A chunk ends with the message that fills it, and repeats no schema or channel that an earlier chunk
of the file holds; the summary has all of them, also those without messages; statistics count what
was written. What is not in a full chunk, and what does not fill a block of the file, is in memory
alone, and nothing is ever fsynced. Record layouts: the MCAP specification.
"""

from __future__ import annotations

import errno
import os
import zlib
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_MAGIC: Final = b"\x89MCAP0\r\n"
_BLOCK: Final = 4096
DISK_FULL: Final = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


_WORTH_COMPRESSING: Final = 1024  # bytes; both bounds are libmcap's
_LEAST_RATIO: Final = 1.02


@dataclass(frozen=True)
class Layout:
    """How a file is written: the options of the storage plugin that the double knows."""

    chunk_bytes: int = 768 * 1024  # before compression
    is_compressed: bool = False
    has_crc: bool = False


class _BlockFile:
    """A file that gets whole blocks as they fill up. A full disk is not reported."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self._waiting = bytearray()
        self.position = 0

    def write(self, data: bytes) -> None:
        self.position += len(data)
        self._waiting += data
        whole = len(self._waiting) - len(self._waiting) % _BLOCK
        self._put(memoryview(bytes(self._waiting[:whole])))
        del self._waiting[:whole]

    def close(self) -> None:
        self._put(memoryview(bytes(self._waiting)))
        os.close(self._fd)

    def _put(self, data: memoryview) -> None:
        try:
            while data:
                data = data[os.write(self._fd, data) :]
        except OSError as error:
            if error.errno not in DISK_FULL:
                raise


class McapFile:
    """An open file. Channels are declared before their messages; ids count from 1."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self._file = _BlockFile(path)
        self._layout = layout
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._written: set[tuple[type[McapRecord], int]] = set()
        self._chunk = RecordBuilder()
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._counts: Counter[int] = Counter()
        self._times: tuple[int, int] | None = None
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._file.write(_MAGIC)
        self._put(Header(profile="ros2", library="test double of ros2 bag record"))

    def declare(
        self, topic: str, type_name: str, definition: str | None, metadata: dict[str, str]
    ) -> None:
        """A topic. A definition that is not known leaves its schema empty."""
        if type_name not in self._schemas:
            self._schemas[type_name] = Schema(
                id=len(self._schemas) + 1,
                name=type_name,
                encoding="" if definition is None else "ros2msg",
                data=(definition or "").encode(),
            )
        self._channels[topic] = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata=metadata,
            schema_id=self._schemas[type_name].id,
        )

    def message(self, topic: str, payload: bytes, log_time: int, publish_time: int) -> None:
        channel = self._channels[topic]
        schema = next(s for s in self._schemas.values() if s.id == channel.schema_id)
        for record in (schema, channel):
            if (type(record), record.id) not in self._written:
                self._written.add((type(record), record.id))
                record.write(self._chunk)
        self._index.setdefault(channel.id, []).append((log_time, self._chunk.count))
        self._counts[channel.id] += 1
        first, last = self._times or (log_time, log_time)
        self._times = min(first, log_time), max(last, log_time)
        Message(channel.id, log_time, payload, publish_time, 0).write(self._chunk)
        if self._chunk.count >= self._layout.chunk_bytes:
            self._end_chunk()

    def metadata(self, text: str) -> None:
        self._end_chunk()
        offset, length = self._put(Metadata("rosbag2", {"serialized_metadata": text}))
        self._metadata.append(MetadataIndex(offset, length, "rosbag2"))

    def close(self) -> None:
        self._end_chunk()
        self._put(DataEnd(0))
        start = self._file.position
        summary, offsets = self._summary(start)
        offset_start = start + len(summary)
        footer = Footer(start, offset_start, 0)
        # The footer up to the checksum itself counts too.
        footer.summary_crc = zlib.crc32(summary + offsets + _bytes_of(footer)[:-4])
        self._file.write(summary + offsets + _bytes_of(footer) + _MAGIC)
        self._file.close()

    def _put(self, record: McapRecord) -> tuple[int, int]:
        """Writes a record of the data section: its offset and its length."""
        offset, data = self._file.position, _bytes_of(record)
        self._file.write(data)
        return offset, len(data)

    def _end_chunk(self) -> None:
        if not self._index:
            return
        content = self._chunk.end()
        compression, data = "", content
        if self._layout.is_compressed and len(content) >= _WORTH_COMPRESSING:
            packed = zstandard.compress(content, 1)
            if len(content) >= _LEAST_RATIO * len(packed):
                compression, data = "zstd", packed
        times = [time for entries in self._index.values() for time, _ in entries]
        begin, end = min(times), max(times)
        crc = zlib.crc32(content) if self._layout.has_crc else 0
        start, length = self._put(Chunk(compression, data, end, begin, crc, len(content)))
        offsets = {
            channel: self._put(MessageIndex(channel, entries))[0]
            for channel, entries in self._index.items()
        }
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=compression,
                compressed_size=len(data),
                message_end_time=end,
                message_index_length=self._file.position - start - length,
                message_index_offsets=offsets,
                message_start_time=begin,
                uncompressed_size=len(content),
            )
        )
        self._index = {}

    def _statistics(self) -> Statistics:
        first, last = self._times or (0, 0)
        return Statistics(
            attachment_count=0,
            channel_count=sum(kind is Channel for kind, _ in self._written),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self._metadata),
            schema_count=sum(kind is Schema for kind, _ in self._written),
        )

    def _summary(self, start: int) -> tuple[bytes, bytes]:
        """The summary section, and the offsets to its groups."""
        groups: tuple[tuple[Opcode, Sequence[McapRecord]], ...] = (
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        summary, offsets = b"", b""
        for opcode, records in groups:
            group = b"".join(map(_bytes_of, records))
            if group:
                offsets += _bytes_of(SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        return summary, offsets


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())

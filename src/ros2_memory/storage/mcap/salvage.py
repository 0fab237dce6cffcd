"""Reads every record of an MCAP file that can be read, in file order, wherever the file ends.

Chunks are opened on the way: their records come in their place; a last, partial chunk gives its
whole records. The summary section repeats the data section, but channels without a message may be
declared there alone.
"""

from __future__ import annotations

import hashlib
import struct
from typing import TYPE_CHECKING, Final

from mcap import records as mcap_records
from mcap.opcode import Opcode

from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.errors import MAX_SECTION_BYTES, SizeLimit, UnreadableError, as_unreadable
from ros2_memory.storage.mcap.chunk import ChunkOpener
from ros2_memory.storage.mcap.records import (
    MAGIC_SIZE,
    BodyStream,
    FileRecord,
    file_records,
    section_records,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from mcap.data_stream import ReadDataStream

    from ros2_memory.storage.file_io import OpenFile


_READERS: Final[dict[int, Callable[[ReadDataStream], mcap_records.McapRecord]]] = {
    Opcode.HEADER: mcap_records.Header.read,
    Opcode.SCHEMA: mcap_records.Schema.read,
    Opcode.CHANNEL: mcap_records.Channel.read,
    Opcode.ATTACHMENT: mcap_records.Attachment.read,
    Opcode.METADATA: mcap_records.Metadata.read,
}
_CONTENT: Final = frozenset((*_READERS, Opcode.MESSAGE))
"""Records with content of their own; all others are indexes."""
_MESSAGE_BODY: Final = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time; the payload follows."""


class Salvage:
    """Reads all records of one file, once.

    Attributes:
        lost_bytes: bytes of the file that made no whole record; final when `records` has ended.
    """

    def __init__(self, file: OpenFile, limit: SizeLimit) -> None:
        self._file = file
        self._limit = limit
        self._opener = ChunkOpener(file, limit)
        self.lost_bytes = 0

    def records(self) -> Iterator[mcap_records.McapRecord]:
        """Yields the records with content of their own, without indexes and damaged records.

        Raises:
            UnreadableError: the file is not MCAP, or ends within its magic.
        """
        read_to, data_ended = MAGIC_SIZE, False
        for record in file_records(self._file):
            data_ended = data_ended or record.opcode == Opcode.DATA_END
            if record.opcode == Opcode.CHUNK:
                bodies = self._bodies_in_chunk(record)
            else:
                bodies = self._body(record)
            for opcode, body in bodies:
                decoded = decode_record(opcode, body)
                if decoded is not None:
                    yield decoded
            read_to = min(record.end, self._file.size)
        if not data_ended:
            self.lost_bytes += self._file.size - read_to

    def _body(self, record: FileRecord) -> Iterator[tuple[int, bytes]]:
        """Yields opcode and body of a record outside chunks, if it has content and is not large."""
        if record.opcode not in _CONTENT:
            return
        size = record.end - record.body_at
        if record.opcode == Opcode.MESSAGE:
            is_large = record.end - record.offset > self._limit.max_bytes
        else:
            is_large = size > MAX_SECTION_BYTES
        if is_large:
            self.lost_bytes += size
        else:
            yield record.opcode, self._file.read(record.body_at, size)

    def _bodies_in_chunk(self, record: FileRecord) -> Iterator[tuple[int, bytes]]:
        """Yields opcode and body of each whole record with content in a chunk."""
        in_file = min(record.end, self._file.size) - record.body_at
        try:
            opened = self._opener.open(record)
        except UnreadableError:
            # The chunks behind it may be whole.
            self.lost_bytes += in_file
            return
        usable = opened.content.usable
        is_cut = record.end > self._file.size
        self.lost_bytes += in_file if is_cut and not usable else len(opened.data) - usable
        for opcode, begin, end in section_records(opened.data[:usable]):
            if opcode in _CONTENT:
                yield opcode, opened.data[begin:end]


def decode_record(opcode: int, body: bytes) -> mcap_records.McapRecord | None:
    """Decodes a record with content of its own (`_CONTENT`); None for a damaged one."""
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = _MESSAGE_BODY.unpack_from(body)
        data = body[_MESSAGE_BODY.size :]
        return mcap_records.Message(channel, log_time, data, publish_time, sequence)
    try:
        with as_unreadable():
            return _READERS[opcode](BodyStream(body))
    except UnreadableError:
        return None


class ContentDigest:
    """A digest of the content of a file, to compare a rewritten file with its source.

    Schemas and channels count by their content, since ids are local to a file. A message counts if
    its channel is declared before it and its log time is possible.
    """

    def __init__(self) -> None:
        self._schemas: dict[int, mcap_records.Schema] = {}
        self._channels: dict[int, bytes] = {}
        self._in_order = hashlib.blake2b()
        self._between = hashlib.blake2b()
        self.messages = 0
        self.last: int | None = None

    @property
    def digests(self) -> tuple[bytes, bytes, frozenset[bytes]]:
        """Digests of the messages in order, of attachments and metadata, and of each channel."""
        channels = frozenset(self._channels.values())
        return self._in_order.digest(), self._between.digest(), channels

    def add(self, record: mcap_records.McapRecord) -> bool:
        """Adds a record; returns False for one that does not count, as a repeated declaration."""
        if isinstance(record, mcap_records.Message):
            return self._add_message(record)
        if isinstance(record, mcap_records.Schema):
            is_known = record.id == 0 or record.id in self._schemas
            self._schemas.setdefault(record.id, record)
            return not is_known
        if isinstance(record, mcap_records.Channel):
            return self._add_channel(record)
        if not isinstance(record, mcap_records.Header):
            self._between.update(repr(record).encode())
        return True

    def _add_channel(self, channel: mcap_records.Channel) -> bool:
        if channel.id in self._channels:
            return False
        schema = self._schemas.get(channel.schema_id)
        definition = (schema.name, schema.encoding, schema.data) if schema else None
        content = repr((channel.topic, channel.message_encoding, channel.metadata, definition))
        self._channels[channel.id] = hashlib.blake2b(content.encode()).digest()
        return True

    def _add_message(self, message: mcap_records.Message) -> bool:
        channel = self._channels.get(message.channel_id)
        if channel is None or message.log_time >= MAX_NS:
            return False
        numbers = (message.sequence, message.log_time, message.publish_time, len(message.data))
        self._in_order.update(channel + repr(numbers).encode())
        self._in_order.update(message.data)
        self.messages += 1
        self.last = max(self.last or 0, message.log_time)
        return True


def is_rosbag2_metadata(record: mcap_records.McapRecord) -> bool:
    """Returns whether a record is the metadata.yaml that rosbag2 embeds, which counts messages."""
    return isinstance(record, mcap_records.Metadata) and record.name == "rosbag2"

"""Every record of an MCAP file that can be read, in file order, wherever the file ends.

The chunks are opened on the way: their records come in their place, those of a last, partial chunk
as far as they are whole. What follows the data section repeats it, but for channels without a
message, which may be declared there alone.
"""

from __future__ import annotations

import hashlib
import struct
from io import BytesIO
from typing import TYPE_CHECKING, Final

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream

from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.errors import (
    MAX_SECTION_BYTES,
    UnreadableError,
    as_unreadable,
    most_unpacked,
)
from ros2_memory.storage.mcap.chunk import (
    packed_chunk,
    unpacked,
    unpacked_in_part,
    walk,
)
from ros2_memory.storage.mcap.records import (
    MAGIC_SIZE,
    MESSAGE_FIELDS,
    RECORD,
    Opcode,
    require_mcap,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from ros2_memory.storage.file_io import OpenFile

_READERS: Final[dict[int, Callable[[ReadDataStream], mcap_records.McapRecord]]] = {
    Opcode.HEADER: mcap_records.Header.read,
    Opcode.SCHEMA: mcap_records.Schema.read,
    Opcode.CHANNEL: mcap_records.Channel.read,
    Opcode.ATTACHMENT: mcap_records.Attachment.read,
    Opcode.METADATA: mcap_records.Metadata.read,
}
_CONTENT: Final = frozenset((*_READERS, Opcode.MESSAGE))
"""The records that say something of their own; the others say where these are."""
_MESSAGE_BODY: Final = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time; the payload follows."""


class Salvage:
    """Reads one file once; `lost_bytes` then is what of it made no whole record."""

    def __init__(self, file: OpenFile, max_chunk_bytes: int) -> None:
        self._file = file
        self._max_chunk_bytes = max_chunk_bytes
        self._unpacked = 0
        self.lost_bytes = 0

    def records(self, progress: Callable[[int], None] | None = None) -> Iterator[tuple[int, bytes]]:
        """The records that say something of their own as (opcode, body).

        Raises:
            UnreadableError: it is no MCAP file, or ends within its magic.
        """
        file = self._file
        require_mcap(file)
        position, data_ended = MAGIC_SIZE, False
        while position + RECORD.size <= file.size:
            opcode, length = RECORD.unpack(file.read(position, RECORD.size))
            start, end = position + RECORD.size, position + RECORD.size + length
            if opcode == 0 or (opcode == Opcode.MESSAGE and length < MESSAGE_FIELDS):
                break
            if end > file.size or opcode == Opcode.FOOTER:
                if opcode == Opcode.CHUNK:
                    yield from self._cut_chunk(start)
                    position = file.size
                break
            data_ended = data_ended or opcode == Opcode.DATA_END
            yield from self._whole(opcode, start, end)
            position = end
            if progress is not None:
                progress(position)
        if not data_ended:
            self.lost_bytes += file.size - position

    def _whole(self, opcode: int, start: int, end: int) -> Iterator[tuple[int, bytes]]:
        if opcode == Opcode.CHUNK:
            yield from self._chunk(start, end)
        elif opcode in _CONTENT:
            whole = end - start + RECORD.size <= self._max_chunk_bytes
            if whole if opcode == Opcode.MESSAGE else end - start <= MAX_SECTION_BYTES:
                yield opcode, self._file.read(start, end - start)
            else:
                self.lost_bytes += end - start

    def _chunk(self, start: int, end: int) -> Iterator[tuple[int, bytes]]:
        try:
            with as_unreadable():
                head, packed = packed_chunk(self._file, start, end - start, self._max_chunk_bytes)
                data = unpacked(head, packed, self._max_chunk_bytes)
                usable = self._usable(data)
        except UnreadableError:
            # Those behind it may be whole.
            self.lost_bytes += end - start
            return
        self.lost_bytes += len(data) - usable
        yield from _whole_records(data, usable)

    def _usable(self, data: bytes) -> int:
        """How much of a chunk is whole records; none of it is used where the file does harm."""
        if self._unpacked > most_unpacked(self._file.size):
            raise UnreadableError("its chunks hold more than such a file can")
        self._unpacked += len(data)
        return walk(data).usable

    def _cut_chunk(self, start: int) -> Iterator[tuple[int, bytes]]:
        """The chunk inside which the file ends."""
        held = self._file.size - start
        try:
            with as_unreadable():
                head, packed = packed_chunk(self._file, start, held, self._max_chunk_bytes)
                data = unpacked_in_part(head, packed, self._max_chunk_bytes)
                usable = self._usable(data)
        except UnreadableError:
            self.lost_bytes += held
            return
        self.lost_bytes += len(data) - usable if usable else held
        yield from _whole_records(data, usable)


def _whole_records(data: bytes, usable: int) -> Iterator[tuple[int, bytes]]:
    position = 0
    while position < usable:
        opcode, length = RECORD.unpack_from(data, position)
        position += RECORD.size + length
        if opcode in _CONTENT:
            yield opcode, data[position - length : position]


def parsed(records: Iterable[tuple[int, bytes]]) -> Iterator[mcap_records.McapRecord]:
    """The records themselves; a damaged one is left out, as readers leave it out."""
    for opcode, body in records:
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE_BODY.unpack_from(body)
            data = body[_MESSAGE_BODY.size :]
            yield mcap_records.Message(channel, log_time, data, publish_time, sequence)
            continue
        try:
            with as_unreadable():
                record = _READERS[opcode](ReadDataStream(BytesIO(body)))
        except UnreadableError:
            continue
        yield record


class Tally:
    """What counts of a file; `said` is the same for two files that hold the same.

    Schemas and channels count by what they say, since their numbers are local to a file. A message
    counts where its channel is declared before it and its log time is one.
    """

    def __init__(self) -> None:
        self._schemas: dict[int, mcap_records.Schema] = {}
        self._channels: dict[int, bytes] = {}
        self._in_order = hashlib.blake2b()
        self._beside = hashlib.blake2b()
        self.messages = 0

    @property
    def said(self) -> tuple[bytes, bytes, frozenset[bytes]]:
        """Digests of the messages in their order, of what stands between them, and of channels."""
        channels = frozenset(self._channels.values())
        return self._in_order.digest(), self._beside.digest(), channels

    def counts(self, record: mcap_records.McapRecord) -> bool:
        """Takes a record in; whether it counts. A declaration that is repeated does not."""
        if isinstance(record, mcap_records.Message):
            return self._message(record)
        if isinstance(record, mcap_records.Schema):
            known = record.id == 0 or record.id in self._schemas
            self._schemas.setdefault(record.id, record)
            return not known
        if isinstance(record, mcap_records.Channel):
            return self._channel(record)
        if not isinstance(record, mcap_records.Header):
            self._beside.update(repr(record).encode())
        return True

    def _channel(self, channel: mcap_records.Channel) -> bool:
        if channel.id in self._channels:
            return False
        schema = self._schemas.get(channel.schema_id)
        definition = (schema.name, schema.encoding, schema.data) if schema else None
        said = repr((channel.topic, channel.message_encoding, channel.metadata, definition))
        self._channels[channel.id] = hashlib.blake2b(said.encode()).digest()
        return True

    def _message(self, message: mcap_records.Message) -> bool:
        channel = self._channels.get(message.channel_id)
        if channel is None or message.log_time >= MAX_NS:
            return False
        numbers = (message.sequence, message.log_time, message.publish_time, len(message.data))
        self._in_order.update(channel + repr(numbers).encode())
        self._in_order.update(message.data)
        self.messages += 1
        return True

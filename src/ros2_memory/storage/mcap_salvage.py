"""Every record of an MCAP file that can be read, in file order, wherever the file ends.

The chunks are opened on the way: their records come in their place, those of a last, partial chunk
as far as they are whole. What follows the data section repeats it, but for channels without a
message, which may be declared there alone.
"""

from __future__ import annotations

import hashlib
import struct
from contextlib import suppress
from io import BytesIO
from typing import TYPE_CHECKING, Final

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream

from ros2_memory.storage.faults import UnreadableError, damage
from ros2_memory.storage.mcap_chunk import (
    CHUNK_HEAD_BYTES,
    chunk_head,
    unpacked,
    unpacked_in_part,
    walk,
)
from ros2_memory.storage.mcap_file import begins_as_mcap
from ros2_memory.storage.mcap_index import MAX_SECTION_BYTES
from ros2_memory.storage.mcap_records import MAGIC_SIZE, MESSAGE_FIELDS, RECORD, Opcode
from ros2_memory.storage.open_file import EMPTY_FILE
from ros2_memory.timebase import MAX_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from ros2_memory.storage.open_file import OpenFile

_KINDS: Final = {
    int(Opcode.HEADER): mcap_records.Header,
    int(Opcode.SCHEMA): mcap_records.Schema,
    int(Opcode.CHANNEL): mcap_records.Channel,
    int(Opcode.MESSAGE): mcap_records.Message,
    int(Opcode.ATTACHMENT): mcap_records.Attachment,
    int(Opcode.METADATA): mcap_records.Metadata,
}
"""The records that say something of their own; the others say where these are."""
_MESSAGE_BODY: Final = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time; the payload follows."""


class Salvage:
    """Reads one file once; `lost_bytes` then is what of it made no whole record."""

    def __init__(self, file: OpenFile, max_chunk_bytes: int) -> None:
        self._file = file
        self._max_chunk_bytes = max_chunk_bytes
        self.lost_bytes = 0

    def records(self, progress: Callable[[int], None] | None = None) -> Iterator[tuple[int, bytes]]:
        """The records that say something of their own as (opcode, body).

        Raises:
            UnreadableError: it is no MCAP file, or is empty.
        """
        file = self._file
        if not file.size:
            raise UnreadableError(EMPTY_FILE)
        if not begins_as_mcap(file):
            raise UnreadableError("not an MCAP file: it does not begin as one")
        position, data_ended = min(MAGIC_SIZE, file.size), False
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
        elif opcode in _KINDS:
            if end - start <= MAX_SECTION_BYTES:
                yield opcode, self._file.read(start, end - start)
            else:
                self.lost_bytes += end - start

    def _chunk(self, start: int, end: int) -> Iterator[tuple[int, bytes]]:
        try:
            with damage():
                head = chunk_head(self._file.read(start, min(CHUNK_HEAD_BYTES, end - start)))
                if start + head.data_at + head.data_size > end:
                    raise UnreadableError("damaged: a chunk is shorter than it states")
                packed = self._file.read(start + head.data_at, head.data_size)
                data = unpacked(head, packed, self._max_chunk_bytes)
        except UnreadableError:
            # Those behind it may be whole.
            self.lost_bytes += end - start
            return
        usable = walk(data).usable
        self.lost_bytes += len(data) - usable
        yield from _whole_records(data, usable)

    def _cut_chunk(self, start: int) -> Iterator[tuple[int, bytes]]:
        """The chunk inside which the file ends."""
        held = self._file.size - start
        try:
            with damage():
                head = chunk_head(self._file.read(start, min(CHUNK_HEAD_BYTES, held)))
                size = min(held - head.data_at, head.data_size)
                packed = self._file.read(start + head.data_at, size)
                data = unpacked_in_part(head, packed, self._max_chunk_bytes)
        except UnreadableError:
            self.lost_bytes += held
            return
        usable = walk(data).usable
        self.lost_bytes += len(data) - usable if usable else held
        yield from _whole_records(data, usable)


def _whole_records(data: bytes, usable: int) -> Iterator[tuple[int, bytes]]:
    position = 0
    while position < usable:
        opcode, length = RECORD.unpack_from(data, position)
        position += RECORD.size + length
        if opcode in _KINDS:
            yield opcode, data[position - length : position]


def parsed(records: Iterable[tuple[int, bytes]]) -> Iterator[mcap_records.McapRecord]:
    """The records themselves; a damaged one is left out, as readers leave it out."""
    for opcode, body in records:
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE_BODY.unpack_from(body)
            data = body[_MESSAGE_BODY.size :]
            yield mcap_records.Message(channel, log_time, data, publish_time, sequence)
            continue
        kind = _KINDS[opcode]
        with suppress(UnreadableError), damage():
            yield kind.read(ReadDataStream(BytesIO(body)))


class Tally:
    """What counts of a file, and a digest of it that another file with the same content shares.

    Schemas and channels count by what they say, since their numbers are local to a file. A message
    counts where its channel is declared before it and its log time is one.
    """

    def __init__(self) -> None:
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._channels: dict[int, bytes] = {}
        self._hash = hashlib.blake2b()
        self.messages = 0

    @property
    def digest(self) -> bytes:
        """Of all records that count but the header, in their order."""
        return self._hash.digest()

    def counts(self, record: mcap_records.McapRecord) -> bool:
        """Takes a record in; whether it counts. A declaration that is repeated does not."""
        if isinstance(record, mcap_records.Message):
            return self._message(record)
        if isinstance(record, mcap_records.Schema):
            said = (record.name, record.encoding, record.data)
            known = record.id == 0 or record.id in self._schemas
            self._schemas.setdefault(record.id, said)
            return not known
        if isinstance(record, mcap_records.Channel):
            return self._channel(record)
        if not isinstance(record, mcap_records.Header):
            self._hash.update(repr(record).encode())
        return True

    def _channel(self, channel: mcap_records.Channel) -> bool:
        if channel.id in self._channels:
            return False
        schema = self._schemas.get(channel.schema_id)
        said = (channel.topic, channel.message_encoding, schema, channel.metadata)
        self._channels[channel.id] = hashlib.blake2b(repr(said).encode()).digest()
        self._hash.update(self._channels[channel.id])
        return True

    def _message(self, message: mcap_records.Message) -> bool:
        said = self._channels.get(message.channel_id)
        if said is None or message.log_time >= MAX_NS:
            return False
        times = (message.sequence, message.log_time, message.publish_time, len(message.data))
        self._hash.update(said + repr(times).encode())
        self._hash.update(message.data)
        self.messages += 1
        return True

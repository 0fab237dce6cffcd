"""Decodes the records of an MCAP file (https://mcap.dev/spec).

A file is magic, records, magic; a record is an opcode (1 byte), a length (8 bytes, little endian)
and a body. The most frequent records are read with `struct`; records that are seldom read, or equal
in all bags of a robot, with the `mcap` package.

The scan, the salvage of a file that was cut short and the reader of embedded metadata share one
walk, `file_records`, so that all of them stop at the same byte.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from typing import TYPE_CHECKING, Final, NamedTuple

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Statistics
from mcap.writer import MCAP0_MAGIC

from ros2_memory.storage.base import Channel, Schema
from ros2_memory.storage.cache import shared
from ros2_memory.storage.errors import (
    MANY_TOPICS,
    MAX_DEFINITION_BYTES,
    MAX_NAMES_CHARS,
    MAX_SECTION_BYTES,
    MAX_TOPICS,
    UnreadableError,
)
from ros2_memory.storage.file_io import EMPTY_FILE, OpenFile

if TYPE_CHECKING:
    from collections.abc import Iterator


MAGIC: Final = MCAP0_MAGIC
MAGIC_SIZE: Final = len(MAGIC)
RECORD: Final = struct.Struct("<BQ")
"""Opcode and length of the body."""
MESSAGE: Final = struct.Struct("<BQHIQQ")
"""A message record up to its payload: opcode, length, channel, sequence, log and publish time."""
MESSAGE_FIELDS: Final = MESSAGE.size - RECORD.size
CHUNK: Final = struct.Struct("<QQQII")
"""A chunk's first and last log time, uncompressed size, CRC and length of its compression's name.

That name follows, then the size of the data (`UINT64`), and the data.
"""
UINT64: Final = struct.Struct("<Q")
FOOTER: Final = struct.Struct("<BQQQI")
"""Opcode, length, start of the summary section, start of the summary offsets, summary CRC."""
_COUNTS_AT: Final = 46
"""Where the counts by channel begin in the body of a statistics record, behind their size."""
_COUNT_BYTES: Final = 10
_LONGEST_CACHED: Final = 16 * 1024


# rosbag2 writes QoS into the metadata of a channel as YAML; to parse it takes fifty times as long
# as this search. Newer distros write the name of the durability, older ones the number of rmw.
_TRANSIENT_LOCAL: Final = re.compile(r"durability:\s*(?:transient_local|1)\b")


def offered_as_latched(qos_profiles: str) -> bool:
    """Returns whether a publisher offers the topic as transient local, by the QoS of rosbag2."""
    return _TRANSIENT_LOCAL.search(qos_profiles) is not None


class BodyStream(ReadDataStream):
    """The body of a record. Texts that are not UTF-8 are read, too: they must not hide the rest."""

    def __init__(self, body: bytes) -> None:
        super().__init__(BytesIO(body))

    def read_prefixed_string(self) -> str:
        """Returns a text, with replacement characters for what is not UTF-8."""
        return self.read(self.read4()).decode(errors="replace")


def section_records(section: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields the opcode of each record of a section, and where its body begins and ends.

    Raises:
        UnreadableError: the section does not end where a record does.
    """
    position, end = 0, len(section)
    while position < end:
        if position + RECORD.size > end:
            raise UnreadableError("damaged: a section ends inside a record")
        opcode, length = RECORD.unpack_from(section, position)
        begin = position + RECORD.size
        position = begin + length
        if position > end:
            raise UnreadableError("damaged: a record is longer than its section")
        yield opcode, begin, position


def statistics(body: bytes) -> Statistics:
    """Decodes a statistics record, without channels that have no message.

    Raises:
        UnreadableError: the record is shorter than it states.
    """
    size = int.from_bytes(body[_COUNTS_AT - 4 : _COUNTS_AT], "little")
    if _COUNTS_AT + size > len(body) or size % _COUNT_BYTES:
        raise UnreadableError("damaged: the statistics are shorter than they state")
    stated: Statistics = Statistics.read(BodyStream(body))
    counts = stated.channel_message_counts.items()
    stated.channel_message_counts = {channel: count for channel, count in counts if count}
    return stated


@dataclass(slots=True)
class Declarations:
    """The schemas and channels of one file, by id, as far as it was read."""

    _schemas: dict[int, Schema] = field(default_factory=dict)
    _channels: dict[int, mcap_records.Channel] = field(default_factory=dict)

    def add(self, opcode: int, body: bytes) -> None:
        """Adds a schema or channel record; others are ignored."""
        # Short ones only, so that what the cache holds stays below 8 MiB.
        decode = _declaration if len(body) <= _LONGEST_CACHED else _declaration.__wrapped__
        number, declared = decode(opcode, body)
        if isinstance(declared, Schema):
            self._schemas[number] = declared
        elif declared is not None:
            self._channels[number] = declared

    def agrees(self, opcode: int, body: bytes) -> bool:
        """Returns whether a record agrees with the known schema or channel of its id, if any."""
        other = Declarations()
        other.add(opcode, body)
        return not self._contradicts(other)

    def update(self, other: Declarations) -> bool:
        """Adds the records of another; returns whether one of them replaced a different one."""
        has_replaced = self._contradicts(other)
        self._schemas |= other._schemas
        self._channels |= other._channels
        return has_replaced

    def _contradicts(self, other: Declarations) -> bool:
        """Returns whether both declare the same id differently."""
        for number, schema in other._schemas.items():
            if self._schemas.get(number, schema) != schema:
                return True
        for number, channel in other._channels.items():
            if self._channels.get(number, channel) != channel:
                return True
        return False

    @property
    def resolved(self) -> bool:
        """Whether the schema of every channel is known; id 0 means a channel without one."""
        return all(
            channel.schema_id == 0 or channel.schema_id in self._schemas
            for channel in self._channels.values()
        )

    def channels(self) -> dict[int, Channel]:
        """Returns the channels by id; a channel without its schema in the file has an empty one.

        Raises:
            UnreadableError: there are more topics, or longer names, than any robot has.
        """
        names = sum(
            len(channel.topic) + len(channel.message_encoding)
            for channel in self._channels.values()
        )
        types = sum(len(schema.name) for schema in self._schemas.values())
        if names + types > MAX_NAMES_CHARS:
            raise UnreadableError("its topics and types have longer names than any can have")
        channels = {
            number: shared(
                Channel(
                    channel.topic,
                    channel.message_encoding,
                    self._schemas.get(channel.schema_id, Schema("")),
                    offered_as_latched(channel.metadata.get("offered_qos_profiles", "")),
                    tuple(channel.metadata.items()),
                )
            )
            for number, channel in self._channels.items()
        }
        if len({(channel.topic, channel.type) for channel in channels.values()}) > MAX_TOPICS:
            raise UnreadableError(MANY_TOPICS)
        return channels


# The bags of one robot declare the same, byte for byte.
@lru_cache(512)
def _declaration(opcode: int, body: bytes) -> tuple[int, Schema | mcap_records.Channel | None]:
    stream = BodyStream(body)
    if opcode == Opcode.SCHEMA:
        schema: mcap_records.Schema = mcap_records.Schema.read(stream)
        text = schema.data[: MAX_DEFINITION_BYTES + 1]
        return schema.id, Schema(schema.name, schema.encoding, text)
    if opcode == Opcode.CHANNEL:
        channel: mcap_records.Channel = mcap_records.Channel.read(stream)
        return channel.id, channel
    return 0, None


def is_finished(file: OpenFile) -> bool:
    """Returns whether a file is MCAP and its writer finished it."""
    ends = file.size >= 2 * MAGIC_SIZE and file.read(file.size - MAGIC_SIZE, MAGIC_SIZE) == MAGIC
    return ends and starts_as_mcap(file)


def starts_as_mcap(file: OpenFile) -> bool:
    """Returns whether a file begins with the magic of MCAP, as far as it reaches."""
    return MAGIC.startswith(file.read(0, min(file.size, MAGIC_SIZE)))


def require_mcap(file: OpenFile) -> None:
    """Checks that a file begins as MCAP.

    Raises:
        UnreadableError: it is not MCAP, or ends within its magic.
    """
    if not file.size:
        raise UnreadableError(EMPTY_FILE)
    if not starts_as_mcap(file):
        raise UnreadableError("not an MCAP file: it does not begin as one")
    if file.size < MAGIC_SIZE:
        raise UnreadableError(f"only its first {file.size} bytes had reached the disk")


_BLOCK_BYTES: Final = 8 << 10
"""Bytes that are read at once: messages outside chunks are small and lie close together."""


class FileRecord(NamedTuple):
    """A record of a file, without its body.

    Only the last record that a walk yields can end past the end of its file, and only if it is a
    chunk: the messages at its front may be whole.

    Attributes:
        opcode: the type of the record.
        offset: where it begins in the file.
        end: where it ends, as its length states.
        head: its first bytes; of a message, all fields before the payload.
    """

    opcode: int
    offset: int
    end: int
    head: bytes

    @property
    def body_at(self) -> int:
        """Where the body begins in the file."""
        return self.offset + RECORD.size

    def body(self, file: OpenFile) -> bytes:
        """Returns the body.

        Raises:
            UnreadableError: it is larger than any can be, or not all there.
        """
        if self.end - self.body_at > MAX_SECTION_BYTES:
            raise UnreadableError("damaged: a record is larger than any can be")
        return file.read(self.body_at, self.end - self.body_at)


def file_records(file: OpenFile) -> Iterator[FileRecord]:
    """Yields the records up to the footer, or up to the first that is not whole.

    Raises:
        UnreadableError: the file is not MCAP, or ends within its magic.
    """
    require_mcap(file)
    offset, block, block_at = MAGIC_SIZE, b"", 0
    while offset + RECORD.size <= file.size:
        if not block_at <= offset <= block_at + len(block) - MESSAGE.size:
            block_at, block = offset, file.read(offset, min(_BLOCK_BYTES, file.size - offset))
        head = block[offset - block_at : offset - block_at + MESSAGE.size]
        opcode, length = RECORD.unpack_from(head)
        end = offset + RECORD.size + length
        # Opcode 0 is invalid: blocks that never reached the disk read as zeros.
        if opcode in {0, Opcode.FOOTER} or (opcode == Opcode.MESSAGE and length < MESSAGE_FIELDS):
            return
        if end <= file.size or opcode == Opcode.CHUNK:
            yield FileRecord(opcode, offset, end, head)
        if end > file.size:
            return
        offset = end

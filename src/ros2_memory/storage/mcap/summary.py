"""Reads the summary section of an MCAP file: the channels, chunks and statistics that it states.

Written by hand, since indexing a week reads sixty thousand of them, and a query of an unread bag
waits for one: 0.06 ms for a bag of 29 chunks, where `get_summary` of the `mcap` library takes
0.31 ms (the splits that `benchmarks/bags.py` writes). It decodes only what shows whether a chunk is
wanted, and the schemas and channels, which the bags of one robot share, only once.
"""

from __future__ import annotations

import struct
import zlib
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

from mcap.opcode import Opcode

from ros2_memory.storage.cache import unshared_bytes
from ros2_memory.storage.errors import MAX_SECTION_BYTES, UnreadableError
from ros2_memory.storage.mcap.records import (
    FOOTER,
    MAGIC_SIZE,
    RECORD,
    Declarations,
    section_records,
    statistics,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.records import Statistics

    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Channel
    from ros2_memory.storage.file_io import OpenFile

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
"""A chunk's first and last log time, offset and length, and the bytes of its index offsets."""
_INDEX_OFFSET: Final = struct.Struct("<HQ")
INDEX_OFFSET_BYTES: Final = _INDEX_OFFSET.size
"""Bytes of a chunk index for the place of one channel's message index."""
_INDEX_LENGTH: Final = struct.Struct("<Q")
_new_tuple: Final = tuple.__new__
_MAX_CACHED_BYTES: Final = 128 << 10

# Plain integers: the opcodes of records are compared with them some million times.
_DECLARES: Final = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))
_CHUNK_INDEX_OPCODE: Final = int(Opcode.CHUNK_INDEX)
_STATISTICS_OPCODE: Final = int(Opcode.STATISTICS)


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

    @property
    def index_offsets(self) -> dict[int, int]:
        """Where each channel's message index lies in the file."""
        return dict(_INDEX_OFFSET.iter_unpack(self.index_places or b""))


class DoubtError(UnreadableError):
    """The summary section cannot be relied on; the text is a note on it, or empty."""


class Declared(NamedTuple):
    """What the schema and channel records of a summary section declare.

    Attributes:
        channels: the channels by their number in the file.
        channel_bytes: memory that the channels take which no other file shares.
        declarations: the records, to compare others with.
    """

    channels: Mapping[int, Channel]
    channel_bytes: int
    declarations: Declarations


class Summary(NamedTuple):
    """What a summary section states; it begins at `start` in the file."""

    start: int
    declared: Declared
    chunks: list[Chunk]
    statistics: Statistics | None


def read_summary(file: OpenFile) -> Summary:
    """Returns the summary section of a file.

    Raises:
        DoubtError: it is missing, or does not match its checksum.
        UnreadableError, struct.error and others: it is damaged.
    """
    start, section = _section(file)
    declaring: list[bytes] = []
    chunks: list[Chunk] = []
    stated: Statistics | None = None
    for opcode, begin, end in section_records(section):
        if opcode == _CHUNK_INDEX_OPCODE:
            chunks.append(_chunk(section, begin, end))
        elif opcode in _DECLARES:
            declaring.append(section[begin - RECORD.size : end])
        elif opcode == _STATISTICS_OPCODE:
            stated = statistics(section[begin:end])
    records = b"".join(declaring)
    declared = _declared if len(records) <= _MAX_CACHED_BYTES else _declared.__wrapped__
    return Summary(start, declared(records), chunks, stated)


def _section(file: OpenFile) -> tuple[int, bytes]:
    """Returns where the summary section begins, and its bytes."""
    footer_at = file.size - MAGIC_SIZE - FOOTER.size
    footer = file.read(footer_at, FOOTER.size)
    opcode, _, summary_at, _, crc = FOOTER.unpack(footer)
    if opcode != Opcode.FOOTER or not summary_at:
        raise DoubtError
    if footer_at - summary_at > MAX_SECTION_BYTES:
        raise DoubtError("its summary section is too large to be one")
    section = file.read(summary_at, footer_at - summary_at)
    if crc and zlib.crc32(footer[:-4], zlib.crc32(section)) != crc:
        raise DoubtError("its summary section does not match its checksum")
    return summary_at, section


def _chunk(section: bytes, at: int, end: int) -> Chunk:
    """Returns the chunk of the chunk index record whose body lies from `at` to `end`."""
    start, last, offset, length, places_size = _CHUNK_INDEX.unpack_from(section, at)
    at += _CHUNK_INDEX.size
    stop = at + places_size
    if stop + _INDEX_LENGTH.size > end or places_size % INDEX_OFFSET_BYTES:
        raise UnreadableError("damaged: a chunk index is shorter than it states")
    places = section[at:stop]
    # Slices with a step take the low and the high byte of every channel number at once.
    channels = _numbers(places[::INDEX_OFFSET_BYTES], places[1::INDEX_OFFSET_BYTES])
    (index_length,) = _INDEX_LENGTH.unpack_from(section, stop)
    # Past the function that takes the fields of a named tuple: it costs as much as all the rest.
    return _new_tuple(Chunk, (offset, length, start, last, channels, places, index_length, None))


@lru_cache(1024)
def _numbers(low: bytes, high: bytes) -> frozenset[int]:
    """Returns the channel numbers with these low and high bytes: one set for all equal ones."""
    return frozenset(one | other << 8 for one, other in zip(low, high, strict=True))


@lru_cache(32)
def _declared(records: bytes) -> Declared:
    declarations = Declarations()
    for opcode, begin, end in section_records(records):
        declarations.add(opcode, records[begin:end])
    channels = declarations.channels()
    return Declared(channels, unshared_bytes(channels), declarations)

"""The summary section of an MCAP file: its channels, its chunks and its statistics, as stated.

Indexing a week reads sixty thousand of them, a query of an unread bag one: both wait for this.
What is the same in the bags of one robot is therefore remembered by its bytes, and of a chunk index
only what tells whether the chunk is wanted is unpacked.
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
    Statistics,
    framed,
    statistics,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Channel
    from ros2_memory.storage.file_io import OpenFile

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
"""A chunk's first and last log time, offset and length, and the bytes of its index offsets."""
_CHUNK_INDEX_BYTES: Final = _CHUNK_INDEX.size
_chunk_index: Final = _CHUNK_INDEX.unpack_from
_INDEX_OFFSET: Final = struct.Struct("<HQ")
INDEX_OFFSET_BYTES: Final = _INDEX_OFFSET.size
"""What a chunk index takes to say where the message index of one channel lies."""
_SIZE_BYTES: Final = 8
_index_size: Final = struct.Struct("<Q").unpack_from
_tuple: Final = tuple.__new__
_DECLARING: Final = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))
_STATISTICS: Final = int(Opcode.STATISTICS)
_CHUNK_INDEX_OPCODE: Final = int(Opcode.CHUNK_INDEX)
_MOST_REMEMBERED: Final = 32
_LONGEST_REMEMBERED: Final = 128 * 1024


class Chunk(NamedTuple):
    """One chunk of a file (a tuple: indexing a week makes millions). `start`, `end`: inclusive.

    `index_places` says where each channel's message index lies, as it stands in the file; None
    where there is none to rely on. `usable` is how many of its decompressed bytes count where the
    file ends inside it.
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


class _Declared(NamedTuple):
    """Schema and channel records as they stand in a file, and what they declare."""

    records: bytes
    channels: Mapping[int, Channel]
    channel_bytes: int
    declarations: Declarations


_beginnings: tuple[_Declared, ...] = ()
"""What sections begin with that were read: those of one robot's bags begin with the same bytes."""


class DoubtError(UnreadableError):
    """The summary section cannot be relied on; the text is a note on it, or empty."""


class Summary(NamedTuple):
    """What a summary section states, and where in the file it begins."""

    start: int
    channels: Mapping[int, Channel]
    channel_bytes: int
    declarations: Declarations
    chunks: list[Chunk]
    statistics: Statistics | None


def read_summary(file: OpenFile) -> Summary:
    """The summary section of a file.

    Raises:
        DoubtError: there is none, or not the one that its writer wrote.
        UnreadableError, struct.error and others: it is damaged.
    """
    start, section = _section(file)
    beginning = next((each for each in _beginnings if section.startswith(each.records)), None)
    declaring: list[bytes] = [] if beginning is None else [beginning.records]
    chunks: list[Chunk] = []
    stated: Statistics | None = None
    for opcode, begin, end in framed(section, sum(map(len, declaring))):
        if opcode == _CHUNK_INDEX_OPCODE:
            chunks.append(_chunk(section, begin, end))
        elif opcode in _DECLARING:
            declaring.append(section[begin - RECORD.size : end])
        elif opcode == _STATISTICS:
            stated = statistics(section[begin:end])
    if beginning is None or len(declaring) > 1:
        beginning = _declared(b"".join(declaring))
        _remember(beginning, section)
    return Summary(
        start, beginning.channels, beginning.channel_bytes, beginning.declarations, chunks, stated
    )


def _section(file: OpenFile) -> tuple[int, bytes]:
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
    """The chunk of the chunk index record whose body lies from `at` to `end`."""
    start, last, offset, length, places_size = _chunk_index(section, at)
    at += _CHUNK_INDEX_BYTES
    stop = at + places_size
    if stop + _SIZE_BYTES > end or places_size % INDEX_OFFSET_BYTES:
        raise UnreadableError("damaged: a chunk index is shorter than it states")
    places = section[at:stop]
    channels = _numbers(places[::INDEX_OFFSET_BYTES], places[1::INDEX_OFFSET_BYTES])
    (index_length,) = _index_size(section, stop)
    # As a tuple is made, past the function that a named tuple's fields go through.
    return _tuple(Chunk, (offset, length, start, last, channels, places, index_length, None))


@lru_cache(1024)
def _numbers(low: bytes, high: bytes) -> frozenset[int]:
    """The channels whose numbers have these low and high bytes; one set for all equal ones."""
    return frozenset(one | other << 8 for one, other in zip(low, high, strict=True))


def _declared(records: bytes) -> _Declared:
    """What schema and channel records declare."""
    declarations = Declarations()
    for opcode, begin, end in framed(records):
        declarations.add(opcode, records[begin:end])
    channels = declarations.channels()
    return _Declared(records, channels, unshared_bytes(channels), declarations)


def _remember(declared: _Declared, section: bytes) -> None:
    """Remembers what a section begins with, if it declares nothing else."""
    global _beginnings  # noqa: PLW0603 - replaced as a whole, so that threads may share it
    records = declared.records
    if records and len(records) <= _LONGEST_REMEMBERED and section.startswith(records):
        _beginnings = (declared, *_beginnings[: _MOST_REMEMBERED - 1])

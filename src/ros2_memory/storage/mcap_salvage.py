"""Every record of an MCAP file that can be read, in file order, wherever the file ends.

The chunks are opened on the way: their records come in their place, those of a last, partial chunk
as far as they are whole. What follows the data section only repeats it, and is left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

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

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ros2_memory.storage.open_file import OpenFile

_ENDS_DATA: Final = frozenset({Opcode.DATA_END, Opcode.FOOTER})
_INDEXES: Final = frozenset({Opcode.MESSAGE_INDEX})


class Salvage:
    """Reads one file once; `lost_bytes` then is what of it made no whole record."""

    def __init__(self, file: OpenFile, max_chunk_bytes: int) -> None:
        self._file = file
        self._max_chunk_bytes = max_chunk_bytes
        self.lost_bytes = 0

    def records(self, progress: Callable[[int], None]) -> Iterator[tuple[int, bytes]]:
        """The records as (opcode, body), chunks and message indexes excepted.

        Raises:
            UnreadableError: it is no MCAP file, or is empty.
        """
        file = self._file
        if not file.size:
            raise UnreadableError(EMPTY_FILE)
        if not begins_as_mcap(file):
            raise UnreadableError("not an MCAP file: it does not begin as one")
        position = min(MAGIC_SIZE, file.size)
        while position + RECORD.size <= file.size:
            opcode, length = RECORD.unpack(file.read(position, RECORD.size))
            start, end = position + RECORD.size, position + RECORD.size + length
            if opcode == 0 or (opcode == Opcode.MESSAGE and length < MESSAGE_FIELDS):
                break
            if opcode in _ENDS_DATA:
                return
            if end > file.size:
                if opcode == Opcode.CHUNK:
                    yield from self._cut_chunk(start)
                    return
                break
            if opcode == Opcode.CHUNK:
                yield from self._chunk(start, end)
            elif opcode not in _INDEXES:
                if length <= MAX_SECTION_BYTES:
                    yield opcode, file.read(start, length)
                else:
                    self.lost_bytes += length
            position = end
            progress(position)
        self.lost_bytes += file.size - position

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
        yield opcode, data[position - length : position]

"""Walks the records of an MCAP file from front to back, and opens its chunks.

The scan, the salvage of a file that was cut short and the reader of embedded metadata share this
walk, so that all of them stop at the same byte.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from mcap.opcode import Opcode

from ros2_memory.storage.errors import (
    MAX_CHUNKS,
    MAX_COMPRESSION_RATIO,
    MAX_SECTION_BYTES,
    MESSAGE_BYTES,
    UnreadableError,
    as_unreadable,
    max_decompressed_bytes,
)
from ros2_memory.storage.mcap.chunk import (
    decompressed_chunk,
    decompressed_prefix,
    read_compressed_chunk,
    walk_chunk,
)
from ros2_memory.storage.mcap.records import (
    MAGIC_SIZE,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    require_mcap,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ros2_memory.storage.file_io import OpenFile
    from ros2_memory.storage.mcap.chunk import ChunkContent

_BLOCK_BYTES: Final = 8 << 10
"""Read at once: loose messages and schemas are small and lie close together."""


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

    def body(self, file: OpenFile, max_bytes: int = MAX_SECTION_BYTES) -> bytes:
        """Returns the body.

        Raises:
            UnreadableError: it is larger than `max_bytes`, or not all there.
        """
        if self.end - self.body_at > max_bytes:
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

    def __init__(
        self,
        file: OpenFile,
        max_chunk_bytes: int,
        take_turn: Callable[[], None] = lambda: None,
    ) -> None:
        self._file = file
        self._max_chunk_bytes = max_chunk_bytes
        self._take_turn = take_turn
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
                self._file, record.body_at, in_file, self._max_chunk_bytes
            )
            data = decompress(head, compressed, self._max_chunk_bytes, self._take_turn)
            self._bytes += len(data)
            content = walk_chunk(data)
        self._bytes += MESSAGE_BYTES * content.messages
        self._chunks += 1
        return OpenedChunk(data, content, head.data_at, head.compression)

"""MCAP files in layouts and with faults that no writer makes on request."""

import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from tests.support.bags import McapLayout, Msg, text

SMALL = McapLayout(chunk_size=400)
RECORD = struct.Struct("<BQ")
FOOTER = struct.Struct("<BQQQI")


def chatter(count: int, start: int = 0) -> list[Msg]:
    """Messages of one topic, at 0, 1, 2 ... ns by default, each with a text of 100 letters."""
    return [text(time, f"{time:0100d}") for time in range(start, start + count)]


def raw_mcap(path: Path, fill: Callable[[Writer], None], *, profile: str = "", **how: Any) -> Path:
    """A bag that `fill` writes with the writer itself."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream, **how)
        writer.start(profile=profile, library="test")
        fill(writer)
        writer.finish()
    return path


def chunks_of(path: Path) -> list[ChunkIndex]:
    """The chunk indexes of a file, as its summary states them."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        return summary.chunk_indexes


def unpacked(path: Path) -> list[bytes]:
    """The bytes of a file, and the data of each record in its chunks."""
    parts = [path.read_bytes()]
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                parts += [getattr(each, "data", b"") for each in breakup_chunk(record)]
    return parts


def spoil_chunk(path: Path, number: int) -> None:
    """Flips a bit in the middle of a chunk's data."""
    chunk = chunks_of(path)[number]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size // 2] ^= 1
    path.write_bytes(data)


def change_index(path: Path, chunk: ChunkIndex, at: int, value: int) -> None:
    """Overwrites a number of the first message that a chunk's index has.

    `at` is 0 for its log time and 8 for its place.
    """
    data = bytearray(path.read_bytes())
    index_at = min(chunk.message_index_offsets.values())
    struct.pack_into("<Q", data, index_at + 15 + at, value)
    path.write_bytes(data)


def edit_summary(path: Path, opcode: Opcode, edit: Callable[[bytearray], None]) -> None:
    """Changes the bodies of the summary's records of one kind, checksum kept right."""

    def edited(found: int, body: bytes) -> bytes:
        changed = bytearray(body)
        if found == opcode:
            edit(changed)
        return bytes(changed)

    rewrite_summary(path, edited)


def rewrite_summary(path: Path, change: Callable[[int, bytes], bytes | None]) -> None:
    """Writes the bodies of the summary's records anew, None for none, checksum kept right."""
    data = path.read_bytes()
    footer_at = len(data) - 8 - FOOTER.size
    kind, length, start, offsets, _ = FOOTER.unpack_from(data, footer_at)
    section = bytearray()
    position = start
    while position < footer_at:
        opcode, size = RECORD.unpack_from(data, position)
        position += RECORD.size
        body = change(opcode, data[position : position + size])
        if body is not None:
            section += RECORD.pack(opcode, len(body)) + body
        position += size
    footer = FOOTER.pack(kind, length, start, offsets, 0)[:-4]
    crc = zlib.crc32(footer, zlib.crc32(section))
    path.write_bytes(data[:start] + section + footer + struct.pack("<I", crc) + data[-8:])


def damaged(data: bytes, seed: int) -> bytes:
    """The bytes after some accident: flipped bits, a cut, an overwritten or a lost stretch."""
    chance = random.Random(seed)
    spoiled = bytearray(data)
    at = chance.randrange(len(spoiled))
    match chance.randrange(5):
        case 0 | 1:
            for _ in range(chance.choice((1, 1, 3, 20))):
                spoiled[chance.randrange(len(spoiled))] ^= 1 << chance.randrange(8)
        case 2:
            del spoiled[at:]
        case 3:
            spoiled[at : at + 8] = chance.choice((b"\0", b"\xff")) * 8
        case _:
            del spoiled[at : at + chance.randrange(1, 50)]
    return bytes(spoiled)

"""Taking MCAP files apart, and putting them together with faults that no writer makes."""

import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from random import Random

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

MAGIC = MCAP0_MAGIC
RECORD = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_CHUNK = struct.Struct("<QQQI")


@dataclass(frozen=True)
class Piece:
    """One record at its place in the file."""

    opcode: int
    start: int
    body: bytes

    @property
    def end(self) -> int:
        return self.start + RECORD.size + len(self.body)

    @property
    def data(self) -> bytes:
        return RECORD.pack(self.opcode, len(self.body)) + self.body


def pieces(data: bytes, start: int = len(MAGIC)) -> list[Piece]:
    """The whole records of a file, or of a chunk from 0."""
    found, at = [], start
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, at)
        end = at + RECORD.size + length
        if opcode == 0 or end > len(data):
            break
        found.append(Piece(opcode, at, data[at + RECORD.size : end]))
        at = end
    return found


def numbers_of(records: list[Piece], *opcodes: int) -> list[int]:
    """Where the records of some kinds are."""
    return [at for at, each in enumerate(records) if each.opcode in opcodes]


def without_summary(records: Iterable[Piece]) -> bytes:
    """A file of the records up to the end of its data section, and a footer that names none."""
    out = bytearray(MAGIC)
    for each in records:
        if each.opcode in {Opcode.DATA_END, Opcode.FOOTER}:
            break
        out += each.data
    out += RECORD.pack(Opcode.DATA_END, 4) + bytes(4)
    return bytes(out + _FOOTER.pack(Opcode.FOOTER, 20, 0, 0, 0) + MAGIC)


def as_it_was(data: bytes, records: Iterable[Piece]) -> bytes:
    """The records one after the other, and what came behind the last of them."""
    known = pieces(data)
    tail = data[known[-1].end :] if known else b""
    return MAGIC + b"".join(each.data for each in records) + tail


def with_summary_or_without(rng: Random, data: bytes, records: list[Piece]) -> bytes:
    """The records, every other time with what came behind the last of them."""
    return without_summary(records) if rng.random() < 0.5 else as_it_was(data, records)


def with_summary_sealed(data: bytes) -> bytes:
    """The file with the checksum of its summary section made right."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < 0 or data[at] != Opcode.FOOTER:
        return data
    kind, length, start, offsets, _ = _FOOTER.unpack_from(data, at)
    if not 0 < start <= at:
        return data
    head = _FOOTER.pack(kind, length, start, offsets, 0)[:-4]
    crc = zlib.crc32(head, zlib.crc32(data[start:at]))
    return data[:at] + head + struct.pack("<I", crc) + data[-len(MAGIC) :]


def inside(chunk: Piece) -> bytes:
    """The records in a chunk, unpacked; nothing where that cannot be done."""
    name_size = int.from_bytes(chunk.body[28:32], "little")
    name, at = chunk.body[32 : 32 + name_size].decode(), 40 + name_size
    try:
        if name == "zstd":
            return zstandard.decompress(chunk.body[at:], max_output_size=1 << 24)
        if name == "lz4":
            return bytes(lz4.frame.decompress(chunk.body[at:]))
    except (zstandard.ZstdError, RuntimeError):
        return b""
    return chunk.body[at:]


def chunk_of(
    content: bytes,
    compression: str = "",
    *,
    packed: bytes | None = None,
    size: int | None = None,
    crc: int | None = None,
    span: tuple[int, int] = (1, 2),
) -> Piece:
    """A chunk record; `packed`, `size` and `crc` may say something else than is true."""
    if packed is None:
        packed = content
        if compression == "zstd":
            packed = zstandard.compress(content)
        elif compression == "lz4":
            packed = bytes(lz4.frame.compress(content))
    name = compression.encode()
    body = _CHUNK.pack(
        *span, len(content) if size is None else size, zlib.crc32(content) if crc is None else crc
    )
    body += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return Piece(Opcode.CHUNK, 0, body)


def rebuilt(chunk: Piece, content: bytes, compression: str = "") -> Piece:
    """The chunk with another content, its times as they were."""
    first, last = struct.unpack_from("<QQ", chunk.body)
    return chunk_of(content, compression, span=(first, last))


def text_of(value: str | bytes) -> bytes:
    """A string as records hold it."""
    raw = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(raw)) + raw


def schema(number: int, name: str, encoding: str, data: bytes) -> Piece:
    body = struct.pack("<H", number) + text_of(name) + text_of(encoding) + text_of(data)
    return Piece(Opcode.SCHEMA, 0, body)


def channel(number: int, schema_number: int, topic: str, encoding: str = "cdr") -> Piece:
    body = struct.pack("<HH", number, schema_number) + text_of(topic) + text_of(encoding)
    return Piece(Opcode.CHANNEL, 0, body + struct.pack("<I", 0))


def message(number: int, log_time: int, payload: bytes) -> Piece:
    return Piece(Opcode.MESSAGE, 0, struct.pack("<HIQQ", number, 0, log_time, log_time) + payload)


def header() -> Piece:
    return Piece(Opcode.HEADER, 0, text_of("ros2") + text_of("test"))

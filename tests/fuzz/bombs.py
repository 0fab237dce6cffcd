"""Small files that unpack to enormous ones: zstd and lz4, in chunks, messages and whole files."""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from ros2_memory.core.timebase import NS_PER_S
from tests.fuzz.good import BASE_S, Good, goods
from tests.fuzz.mutant import Mutant, mutant_file, mutant_of
from tests.fuzz.records import (
    MAGIC,
    RECORD,
    Piece,
    channel,
    chunk_of,
    header,
    message,
    schema,
    without_summary,
)
from tests.support.bags import Msg, definition, write_db3

_BASE = BASE_S * NS_PER_S
_MB = 1 << 20
_BLOCK = 128 << 10
_SIZES_MB = (1, 8, 30, 60, 130, 255, 300, 1000, 4000)
_LZ4_SIZES_MB = (1, 8, 30, 60, 130, 255, 300)

_WIDE = {
    "std_msgs/msg/String": ("string data\n", b"", 1),
    "pkg/msg/Numbers": ("float64[] data\n", b"", 8),
    "pkg/msg/Shorts": ("uint16[] data\n", b"", 2),
    "pkg/msg/Bytes": ("uint8[] data\n", b"", 1),
    "pkg/msg/Names": ("string[] data\n", b"", 8),
    "pkg/msg/Many": (
        f"std_msgs/Bool[] data\n{'=' * 80}\nMSG: std_msgs/Bool\nbool data\n",
        b"",
        1,
    ),
    "pkg/msg/Empties": (
        f"std_msgs/Empty[] data\n{'=' * 80}\nMSG: std_msgs/Empty\nuint8 nothing\n",
        b"",
        1,
    ),
}
"""Types with one array: their definition, what stands before it, and the least of an element."""


def rle_frame(size: int, *, stated: int | None = None, window: int = 0x70) -> bytes:
    """A zstd frame of zeros, made of run-length blocks; `stated` is its content size."""
    if stated is None:
        head = b"\x28\xb5\x2f\xfd\x00" + bytes([window])
    else:
        head = b"\x28\xb5\x2f\xfd\xc0" + bytes([window]) + struct.pack("<Q", stated)
    blocks = [min(_BLOCK, size - at) for at in range(0, size, _BLOCK)] or [0]
    body = b"".join(
        (int(at == len(blocks) - 1) | 1 << 1 | length << 3).to_bytes(3, "little") + b"\0"
        for at, length in enumerate(blocks)
    )
    return head + body


@lru_cache(64)
def _packed(compression: str, head: bytes, unit: bytes, size: int, *, states_size: bool) -> bytes:
    """So many bytes of one unit behind a head, compressed without ever being held."""
    piece = unit * max(1, _MB // len(unit))
    rest = max(0, size - len(head))

    def parts() -> Iterator[bytes]:
        yield head
        left = rest
        while left:
            yield piece[:left]
            left -= len(piece[:left])

    if compression == "zstd":
        total = len(head) + rest if states_size else -1
        packer = zstandard.ZstdCompressor(write_content_size=states_size).compressobj(size=total)
        return b"".join([packer.compress(each) for each in parts()]) + packer.flush()
    lz4_packer = lz4.frame.LZ4FrameCompressor()
    begun = lz4_packer.begin(source_size=len(head) + rest if states_size else 0)
    done = b"".join([lz4_packer.compress(each) for each in parts()])
    return bytes(begun + done + lz4_packer.flush())


def _contents(rng: Random, size: int) -> tuple[bytes, bytes]:
    """What a chunk that unpacks to so many bytes may hold: a head, and a unit that repeats."""
    declared = schema(
        1, "std_msgs/msg/String", "ros2msg", definition("std_msgs/msg/String").encode()
    )
    head = declared.data + channel(1, 1, "/odom").data
    whole = message(1, _BASE, b"\0\1\0\0\1\0\0\0\0")
    match rng.randrange(4):
        case 0:
            return b"", b"\0"
        case 1:
            return head, whole.data
        case 2:
            return b"", declared.data
        case _:
            length = size - len(head) - RECORD.size
            return head + RECORD.pack(5, max(length, 22)) + whole.body[:22], b"\0"


def chunk_bomb(rng: Random, good: Good, compression: str = "zstd") -> Mutant:
    """Chunks that unpack to far more than their file, whatever they state."""
    sizes = _SIZES_MB[:-1] if compression == "zstd" else _LZ4_SIZES_MB
    size = rng.choice(sizes) * _MB
    if compression == "zstd" and rng.random() < 0.5:
        stated = rng.choice((None, 0, 1, size, 1 << 40, (1 << 64) - 1, 1 << 63))
        packed = rle_frame(size, stated=stated, window=rng.choice((0, 0x70, 0x88, 0xA0, 0xFF)))
    else:
        head, unit = _contents(rng, min(size, 300 * _MB))
        packed = _packed(
            compression, head, unit, min(size, 300 * _MB), states_size=rng.random() < 0.5
        )
    claim = rng.choice((size, 0, 100, 1 << 30, 1 << 40, (1 << 64) - 1))
    chunk = chunk_of(b"", compression, packed=packed, size=claim, crc=0, span=(_BASE, _BASE + 9))
    return _around(good, [chunk] * rng.choice((1, 1, 1, 3, 20)), f"{size >> 20} MB")


def lying_frame(rng: Random, good: Good, compression: str = "zstd") -> Mutant:
    """A frame whose header, or whose chunk, states more than there is."""
    content = b"".join(each.data for each in _one_message(b"\0\1\0\0\1\0\0\0\0"))
    stated = rng.choice((1 << 20, 200 << 20, 1 << 32, 1 << 40, (1 << 63) - 1, (1 << 64) - 1))
    if compression == "zstd":
        packed = bytearray(rle_frame(len(content), stated=stated, window=rng.randrange(256)))
        if rng.random() < 0.5:
            del packed[rng.randrange(6, len(packed)) :]
    else:
        packed = bytearray(lz4.frame.compress(content, content_checksum=False, store_size=True))
        packed[6:14] = struct.pack("<Q", stated)
        packed[4] = rng.choice((packed[4], rng.randrange(256)))
    chunk = chunk_of(content, compression, packed=bytes(packed), size=stated, crc=0)
    return _around(good, [chunk] * rng.choice((1, 5)), f"states {stated}")


def message_bomb(rng: Random, good: Good) -> Mutant:
    """Messages, compressed one by one, that unpack to enormous arrays and texts."""
    name, size = rng.choice([*_WIDE]), rng.choice(_SIZES_MB[:-2]) * _MB
    payload = _packed("zstd", *_payload(name, size), states_size=rng.random() < 0.7)
    if rng.random() < 0.3:
        payload = rle_frame(size, stated=rng.choice((None, 0, size, 1 << 60)))
    count = rng.choice((1, 1, 5, 30))
    return _with_messages(good, name, [payload] * count, f"{count} of {size >> 20} MB")


def wide_message(rng: Random, good: Good, compression: str = "zstd") -> Mutant:
    """One message of an enormous array or text, alone in its compressed chunk."""
    name = rng.choice([*_WIDE])
    size = rng.choice((1, 8, 30, 60, 130, 250)) * _MB
    head, unit, total = _payload(name, size)
    before = b"".join(
        each.data
        for each in (schema(1, name, "ros2msg", _WIDE[name][0].encode()), channel(1, 1, "/odom"))
    )
    begin = message(1, _BASE, b"").body + head
    record = RECORD.pack(5, len(begin) - len(head) + total)
    packed = _packed(
        compression,
        before + record + begin,
        unit,
        len(before + record) + len(begin) - len(head) + total,
        states_size=rng.random() < 0.5,
    )
    size_of = len(before + record) + len(begin) - len(head) + total
    chunk = chunk_of(b"", compression, packed=packed, size=size_of, crc=0, span=(_BASE, _BASE))
    return _around(good, [chunk], f"{name} of {size >> 20} MB")


def _payload(name: str, size: int) -> tuple[bytes, bytes, int]:
    """A CDR payload of a type with one array that fills it: head, unit, size."""
    _, before, least = _WIDE[name]
    count = (size - 12 - len(before)) // least
    head = b"\0\1\0\0" + before + struct.pack("<I", count)
    if least == 8 and name.endswith("Numbers"):
        head += bytes(4)
    unit = b"\1\0\0\0\0\0\0\0" if name.endswith("Names") else b"\0"
    return head, unit, size


def file_bomb(rng: Random, good: Good) -> Mutant:
    """A bag compressed as a whole that unpacks to far more than the disk or patience has."""
    size = rng.choice(_SIZES_MB) * _MB
    packed_kind = next(each for each in goods() if each.suffix == ".mcap.zstd")
    sqlite_kind = next(each for each in goods() if each.suffix == ".db3.zstd")
    match rng.randrange(5):
        case 0:
            data = zstandard.compress(MAGIC + header().data) + rle_frame(size)
        case 1:
            head, unit = _contents(rng, size)
            head = MAGIC + header().data + head
            data = _packed("zstd", head, unit, min(size, 300 * _MB), states_size=False)
        case 2:
            head = packed_kind.plain[: -len(MAGIC)]
            data = _packed("zstd", head, b"\0", min(size, 1000 * _MB), states_size=True)
        case 3:
            data = sqlite_kind.packed(sqlite_kind.plain) + rle_frame(size)
            return mutant_file(sqlite_kind, data, f"{size >> 20} MB")
        case _:
            data = rle_frame(size, stated=rng.choice((None, 1, size, 1 << 50)))
    return mutant_file(packed_kind, data, f"{size >> 20} MB")


def lz4_chunk_bomb(rng: Random, good: Good) -> Mutant:
    """As `chunk_bomb`, with lz4."""
    return chunk_bomb(rng, good, "lz4")


def lz4_lying_frame(rng: Random, good: Good) -> Mutant:
    """As `lying_frame`, with lz4."""
    return lying_frame(rng, good, "lz4")


def lz4_wide_message(rng: Random, good: Good) -> Mutant:
    """As `wide_message`, with lz4."""
    return wide_message(rng, good, "lz4")


def _one_message(payload: bytes, name: str = "std_msgs/msg/String", count: int = 1) -> list[Piece]:
    text = _WIDE[name][0] if name in _WIDE else definition(name)
    return [
        schema(1, name, "ros2msg", text.encode()),
        channel(1, 1, "/odom"),
        *(message(1, _BASE + n * NS_PER_S // 10, payload) for n in range(count)),
    ]


def _around(good: Good, chunks: list[Piece], told: str) -> Mutant:
    kind = good if good.is_mcap else goods()[0]
    return mutant_of(kind, without_summary([header(), *chunks]), told)


def _with_messages(good: Good, name: str, payloads: list[bytes], told: str) -> Mutant:
    if good.is_mcap:
        content = _one_message(payloads[0], name, len(payloads))
        return mutant_of(good, without_summary([header(), *content]), told)
    messages = [Msg("/odom", name, _BASE + n, payload) for n, payload in enumerate(payloads)]
    with TemporaryDirectory() as folder:
        path = write_db3(Path(folder) / "bag.db3", messages, definitions=False)
        with closing(sqlite3.connect(path)) as base:
            base.execute(
                "INSERT INTO message_definitions VALUES (1,?,'ros2msg',?,'')",
                (name, _WIDE[name][0]),
            )
            base.commit()
        return mutant_of(good, path.read_bytes(), told)

"""What of a mutant can be read, found out without any code of the program or of its indexes.

Every record of an MCAP file from its beginning, every chunk unpacked and held against its checksum,
every row of a sqlite table as it lies there. Every answer about the mutant is held to that: what it
gives must be a message that can be read, and what it leaves out must not be one, unless it says
that the file is damaged.
"""

import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

_MAGIC = b"\x89MCAP0\r\n"
_LATEST = (1 << 63) - 1
"""This time and later ones are none: no half-open window of 64 bits has them."""
_LARGEST = 1 << 24
_PLAIN = (
    "SELECT count(*) FROM sqlite_master"
    " WHERE lower(name) IN ('topics', 'messages') AND type = 'table' AND rootpage > 0"
)
_COMPUTED = (
    "SELECT 1 FROM pragma_table_xinfo('messages') WHERE hidden UNION"
    " SELECT 1 FROM pragma_table_xinfo('topics') WHERE hidden"
)
_MOST_ROWS = 20_000


class Readable(NamedTuple):
    """One message that can be read: topic, log time, and its payload as it is stored."""

    topic: str
    time: int
    payload: bytes


def readable_mcap(data: bytes) -> list[Readable] | None:
    """The messages of an MCAP file in file order; None where its records are not whole.

    Of a file that ends early, or holds a chunk that is damaged, too much is left to a reader's
    judgement for one right answer.
    """
    topics: dict[int, str] = {}
    found: list[tuple[int, int, bytes]] = []
    if data[:8] != _MAGIC or data[-8:] != _MAGIC:
        return None
    ended = False
    for opcode, body in _records(data[8:-8]):
        if opcode == 0x02:
            ended = True
            break
        if opcode == 0x06:
            inner = _unpacked(body)
            if inner is None:
                return None
            for kind, content in _records(inner):
                if kind == 0 or not _take(kind, content, topics, found):
                    return None
        elif opcode == 0 or not _take(opcode, body, topics, found):
            return None
    if not ended or any(number not in topics or time >= _LATEST for number, time, _ in found):
        return None
    return [Readable(topics[number], time, payload) for number, time, payload in found]


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of each record; (0, b"") where there is no whole one."""
    at = 0
    while at < len(data):
        if at + 9 > len(data):
            yield 0, b""
            return
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            yield 0, b""
            return
        yield opcode, data[at + 9 : at + 9 + length]
        at += 9 + length


def _take(
    opcode: int, body: bytes, topics: dict[int, str], found: list[tuple[int, int, bytes]]
) -> bool:
    """Takes a channel or a message in; whether it makes sense."""
    try:
        if opcode == 0x04:
            number, _, size = struct.unpack_from("<HHI", body)
            topic = body[8 : 8 + size].decode()
            if topics.setdefault(number, topic) != topic:
                return False
        elif opcode == 0x05:
            number, _, time = struct.unpack_from("<HIQ", body)
            if len(body) < 22:
                return False
            found.append((number, time, body[22:]))
    except (struct.error, UnicodeDecodeError):
        return False
    return True


def _unpacked(chunk: bytes) -> bytes | None:
    """The records in a chunk; None where they are not what its checksum says."""
    try:
        _, _, size, crc, name_size = struct.unpack_from("<QQQII", chunk)
        name = chunk[32 : 32 + name_size]
        (packed_size,) = struct.unpack_from("<Q", chunk, 32 + name_size)
        packed = chunk[40 + name_size : 40 + name_size + packed_size]
        if size > _LARGEST:
            return None
        data = packed
        if name == b"zstd":
            data = zstandard.decompress(packed, max_output_size=_LARGEST)
        elif name == b"lz4":
            data = bytes(lz4.frame.decompress(packed))
        elif name:
            return None
    except (struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError):
        return None
    # Without a checksum nothing vouches for the messages.
    return data if crc and zlib.crc32(data) == crc else None


def readable_db3(data: bytes) -> list[Readable] | None:
    """The messages of a sqlite bag in the order of their rows; None where it cannot be read."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        path.write_bytes(data)
        try:
            with closing(sqlite3.connect(path)) as base:
                base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST)
                if base.execute(_PLAIN).fetchone() != (2,) or base.execute(_COMPUTED).fetchone():
                    return None
                names = dict(base.execute("SELECT id, name FROM topics NOT INDEXED"))
                rows = base.execute(
                    "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY rowid"
                ).fetchmany(_MOST_ROWS)
        except (sqlite3.Error, UnicodeDecodeError, OverflowError, ValueError):
            return None
    if len(rows) == _MOST_ROWS:
        return None
    if not all(isinstance(row[1], int) and isinstance(row[2], bytes) for row in rows):
        return None
    if not all(isinstance(names.get(row[0]), str) for row in rows):
        return None
    return [Readable(names[number], time, payload) for number, time, payload in rows]

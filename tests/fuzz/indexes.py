"""Mutations of what points to messages: every index lies, and every message is as it was."""

import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from mcap.opcode import Opcode

from tests.fuzz.good import Good
from tests.fuzz.mutant import Mutant, mutant_of
from tests.fuzz.records import Piece, as_it_was, numbers_of, pieces, with_summary_sealed

_PAIR = 16
_INDEX_PAGES = (2, 10)
"""What the first byte of a page of an index is in sqlite's file format (1.6)."""


def flip_message_index(rng: Random, good: Good) -> Mutant:
    """One bit, or some, of the times and places in message indexes."""
    records = pieces(good.plain)
    at = numbers_of(records, Opcode.MESSAGE_INDEX)
    if not at:
        return mutant_of(good, good.plain)
    for _ in range(rng.choice((1, 1, 1, 4))):
        number = rng.choice(at)
        body = bytearray(records[number].body)
        if len(body) <= 6:
            continue
        body[rng.randrange(6, len(body))] ^= 1 << rng.randrange(8)
        records[number] = replace(records[number], body=bytes(body))
    return mutant_of(good, as_it_was(good.plain, records))


def wrong_message_index(rng: Random, good: Good) -> Mutant:
    """Message indexes with pairs that are another's: swapped, doubled, moved in time."""
    records = pieces(good.plain)
    at = numbers_of(records, Opcode.MESSAGE_INDEX)
    if not at:
        return mutant_of(good, good.plain)
    number = rng.choice(at)
    body = bytearray(records[number].body)
    count = (len(body) - 6) // _PAIR
    if not count:
        return mutant_of(good, good.plain)
    one, other = (6 + _PAIR * rng.randrange(count) for _ in range(2))
    match rng.randrange(4):
        case 0:
            body[one : one + _PAIR] = body[other : other + _PAIR]
        case 1:
            body[one : one + 8], body[other : other + 8] = (
                body[other : other + 8],
                body[one : one + 8],
            )
        case 2:
            (time,) = struct.unpack_from("<Q", body, one)
            moved = time + rng.choice((-1, 1, 50_000_000, -200_000_000))
            struct.pack_into("<Q", body, one, moved % (1 << 64))
        case _:
            donor = records[rng.choice(at)].body
            if len(donor) >= len(body):
                body[6:] = donor[6 : len(body)]
    records[number] = replace(records[number], body=bytes(body))
    return mutant_of(good, as_it_was(good.plain, records))


def wrong_chunk_index(rng: Random, good: Good) -> Mutant:
    """A chunk index that names another chunk, other times, or other message indexes."""
    records = pieces(good.plain)
    at = numbers_of(records, Opcode.CHUNK_INDEX)
    if not at:
        return mutant_of(good, good.plain)
    number, donor = rng.choice(at), records[rng.choice(at)].body
    records[number] = _with_a_lie(rng, records[number], donor)
    return mutant_of(good, with_summary_sealed(as_it_was(good.plain, records)))


def _with_a_lie(rng: Random, index: Piece, donor: bytes) -> Piece:
    body = bytearray(index.body)
    field = rng.choice((0, 8, 16, 24))
    (places,) = struct.unpack_from("<I", body, 32)
    match rng.randrange(5):
        case 0:
            body[field : field + 8] = donor[field : field + 8]
        case 1:
            body[:16] = donor[:16]
        case 2:
            (value,) = struct.unpack_from("<Q", body, field)
            moved = value + rng.choice((-1, 1, 100_000_000, -100_000_000))
            struct.pack_into("<Q", body, field, moved % (1 << 64))
        case 3 if places >= 20:
            # Two channels change places: each has the other's message index.
            one, other = (36 + 10 * rng.randrange(places // 10) for _ in range(2))
            body[one : one + 2], body[other : other + 2] = (
                body[other : other + 2],
                body[one : one + 2],
            )
        case _ if places:
            struct.pack_into("<H", body, 36 + 10 * rng.randrange(places // 10), 999)
    return replace(index, body=bytes(body))


def wrong_statistics(rng: Random, good: Good) -> Mutant:
    """Statistics or summary offsets that state something else."""
    opcode = rng.choice((Opcode.STATISTICS, Opcode.SUMMARY_OFFSET))
    return mutant_of(good, with_summary_sealed(_with_flipped_bit(rng, good, opcode)))


def wrong_chunk_head(rng: Random, good: Good) -> Mutant:
    """A chunk that states other times than it holds."""
    return mutant_of(good, _with_flipped_bit(rng, good, Opcode.CHUNK, slice(16)))


def _with_flipped_bit(
    rng: Random, good: Good, opcode: Opcode, within: slice = slice(None)
) -> bytes:
    """The file with a bit of one such record flipped, where it has any."""
    records = pieces(good.plain)
    at = numbers_of(records, opcode)
    if not at:
        return good.plain
    number = rng.choice(at)
    body = bytearray(records[number].body)
    body[rng.randrange(*within.indices(len(body)))] ^= 1 << rng.randrange(8)
    records[number] = replace(records[number], body=bytes(body))
    return as_it_was(good.plain, records)


def one_lie(rng: Random, good: Good) -> Mutant:
    """All that points to one chunk agrees on other times than its messages have."""
    chunks = len(_indexed_spans(good.plain))
    if not chunks:
        return mutant_of(good, good.plain)
    moved = rng.choice((-1, 1)) * rng.choice((1, 1_000_000, 50_000_000, 600_000_000))
    return mutant_of(good, agreed(good.plain, rng.randrange(chunks), lambda time: time + moved))


def _indexed_spans(plain: bytes) -> list[tuple[int, int]]:
    """The first and last log time that each chunk states; none unless all have a chunk index."""
    records = pieces(plain)
    chunks = [each for each in records if each.opcode == Opcode.CHUNK]
    if len(chunks) != sum(each.opcode == Opcode.CHUNK_INDEX for each in records):
        return []
    return [struct.unpack_from("<QQ", each.body) for each in chunks]


def lies_together(rng: Random, good: Good) -> Mutant:
    """Two or three neighbouring chunks, of which all indexes agree on each other's times, or later.

    So the times of the file may be covered without a hole.
    """
    spans = _indexed_spans(good.plain)
    if len(spans) < 2:
        return mutant_of(good, good.plain)
    first = rng.randrange(len(spans) - 1)
    together = range(first, min(first + rng.choice((2, 2, 3)), len(spans)))
    longest = max(end - start for start, end in spans)
    if rng.random() < 0.5:
        moved = rng.choice((-1, 1)) * rng.choice((50_000_000, longest // 2 + 1, longest + 1))
        shifts = dict.fromkeys(together, moved)
    else:  # in descending order
        shifts = {
            nth: spans[other][0] - spans[nth][0]
            for nth, other in zip(together, reversed(together), strict=True)
        }
    plain = good.plain
    for nth, moved in shifts.items():
        plain = agreed(plain, nth, partial(int.__add__, moved))
    return mutant_of(good, plain)


def agreed(plain: bytes, nth: int, told: Callable[[int], int]) -> bytes:
    """Returns the bag with one chunk whose message indexes, head and chunk index tell times anew.

    Every checksum is right, and every message as it was.
    """
    records = pieces(plain)
    at = numbers_of(records, Opcode.CHUNK)[nth]
    whole = numbers_of(records, Opcode.CHUNK_INDEX)[nth]
    after = at + 1
    while records[after].opcode == Opcode.MESSAGE_INDEX:
        body = bytearray(records[after].body)
        for pair in range(6, len(body) - _PAIR + 1, _PAIR):
            _retell(body, pair, told)
        records[after] = replace(records[after], body=bytes(body))
        after += 1
    for number in (at, whole):
        body = bytearray(records[number].body)
        _retell(body, 0, told)
        _retell(body, 8, told)
        records[number] = replace(records[number], body=bytes(body))
    return with_summary_sealed(as_it_was(plain, records))


def _retell(body: bytearray, at: int, told: Callable[[int], int]) -> None:
    (time,) = struct.unpack_from("<Q", body, at)
    struct.pack_into("<Q", body, at, max(told(time), 0) % (1 << 64))


def wrong_order(_rng: Random, good: Good) -> Mutant:
    """An index by time that is declared descending and stored ascending."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        path.write_bytes(good.plain)
        try:
            with closing(sqlite3.connect(path)) as base:
                base.execute("PRAGMA writable_schema = 1")
                base.execute(
                    "UPDATE sqlite_master SET sql = replace(sql, 'ASC', 'DESC') WHERE type = ?",
                    ("index",),
                )
                base.commit()
        except sqlite3.Error:
            return mutant_of(good, good.plain)
        return mutant_of(good, path.read_bytes())


def flip_index_page(rng: Random, good: Good) -> Mutant:
    """Bits of the pages of an index of a sqlite bag."""
    data = bytearray(good.plain)
    size = int.from_bytes(data[16:18], "big") or 4096
    pages = [at for at in range(size, len(data), size) if data[at] in _INDEX_PAGES]
    if not pages or size < 512:
        return mutant_of(good, good.plain)
    for _ in range(rng.choice((1, 1, 3))):
        data[rng.choice(pages) + rng.randrange(size)] ^= 1 << rng.randrange(8)
    return mutant_of(good, bytes(data))

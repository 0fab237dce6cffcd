"""Mutations of the bytes of a file: flipped bits, cuts, wrong lengths, absurd numbers."""

import struct
from random import Random

from mcap.opcode import Opcode

from tests.fuzz.good import Good
from tests.fuzz.mutant import Mutant, mutant_file, mutant_of
from tests.fuzz.records import (
    MAGIC,
    RECORD,
    inside,
    numbers_of,
    pieces,
    rebuilt,
    with_summary_or_without,
    with_summary_sealed,
    without_summary,
)

_PAGE = 4096
_SUMMARIZING = frozenset(
    (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.SUMMARY_OFFSET, Opcode.MESSAGE_INDEX)
)


def flip_bits(rng: Random, good: Good) -> Mutant:
    """Between one and fifty bits of the file, anywhere."""
    data = bytearray(good.whole)
    for _ in range(rng.choice((1, 1, 2, 5, 50))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return mutant_file(good, bytes(data))


def flip_bits_beneath_checksums(rng: Random, good: Good) -> Mutant:
    """Bits of the content, with the checksums of what holds it made right again."""
    plain = bytearray(good.plain)
    records = pieces(good.plain)
    chunks = numbers_of(records, Opcode.CHUNK)
    if not chunks or rng.random() < 0.5:
        begin = max(0, len(plain) - 2000) if rng.random() < 0.5 else 0
        for _ in range(rng.choice((1, 3, 10))):
            plain[rng.randrange(begin, len(plain))] ^= 1 << rng.randrange(8)
        return mutant_of(good, with_summary_sealed(bytes(plain)))
    at = rng.choice(chunks)
    content = bytearray(inside(records[at]) or b"\0")
    for _ in range(rng.choice((1, 3, 10))):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    records[at] = rebuilt(records[at], bytes(content))
    return mutant_of(good, without_summary(records))


def cut(rng: Random, good: Good) -> Mutant:
    """An end at a boundary of the structure, or a few bytes beside it."""
    data = good.plain if rng.random() < 0.5 else good.whole
    at = rng.choice(_boundaries(data, good)) + rng.choice((-9, -1, 0, 0, 0, 1, 9))
    at = min(max(at, 0), len(data))
    return (mutant_of if data is good.plain else mutant_file)(good, data[:at], f"cut at {at}")


def cut_inside_a_chunk(rng: Random, good: Good) -> Mutant:
    """An end at or inside a record of a chunk, the chunk stored plain."""
    records = pieces(good.plain)
    chunks = numbers_of(records, Opcode.CHUNK)
    if not chunks:
        return cut(rng, good)
    at = rng.choice(chunks)
    records[at] = rebuilt(records[at], inside(records[at]))
    start = len(MAGIC) + sum(len(each.data) for each in records[:at])
    inner = pieces(inside(records[at]), 0)
    offset = rng.choice(inner).start if inner else 0
    length = len(records[at].data) - len(inside(records[at])) + offset + rng.choice((0, 5, 40))
    return mutant_of(good, without_summary(records)[: start + length])


def cut_out(rng: Random, good: Good) -> Mutant:
    """A stretch in the middle is missing, or holds zeros as after a crash of the disk."""
    data = good.whole
    start = rng.randrange(len(data))
    stop = min(len(data), start + rng.choice((1, 8, 100, 512, 4096)))
    gap = bytes(stop - start) if rng.random() < 0.5 else b""
    return mutant_file(good, data[:start] + gap + data[stop:])


def _boundaries(data: bytes, good: Good) -> list[int]:
    if good.suffix == ".db3" or data[:6] == b"SQLite":
        return [0, 16, 100, *range(_PAGE, len(data), _PAGE), len(data) - 1]
    found = [0, 4, len(MAGIC), len(data) - len(MAGIC), len(data) - len(MAGIC) - 29, len(data) - 1]
    for each in pieces(data):
        found += [each.start, each.start + 1, each.start + RECORD.size, each.end]
    if data[:4] == b"\x28\xb5\x2f\xfd":
        found += range(4, len(data), max(1, len(data) // 40))
    return found


def wrong_length(rng: Random, good: Good) -> Mutant:
    """A record that states another length than it has."""
    if not good.is_mcap:
        return _wrong_number(rng, good)
    records = pieces(good.plain)
    if not records:
        return flip_bits(rng, good)
    each = rng.choice(records)
    data = bytearray(good.plain)
    length = len(each.body)
    stated = _other_length(rng, length, len(data))
    struct.pack_into("<Q", data, each.start + 1, stated)
    return mutant_of(good, with_summary_sealed(bytes(data)), f"{each.opcode}: {length}>{stated}")


def wrong_length_inside(rng: Random, good: Good) -> Mutant:
    """A record in a chunk, or a text in a record, that states another length than it has."""
    records = pieces(good.plain)
    chunks = numbers_of(records, Opcode.CHUNK)
    if not chunks:
        return wrong_length(rng, good)
    at = rng.choice(chunks)
    content = bytearray(inside(records[at]))
    inner = pieces(bytes(content), 0)
    if not inner:
        return wrong_length(rng, good)
    each = rng.choice(inner)
    if rng.random() < 0.5 or len(each.body) < 10:
        struct.pack_into("<Q", content, each.start + 1, _other_length(rng, len(each.body), 1 << 40))
    else:
        where = each.start + RECORD.size + rng.randrange(0, len(each.body) - 4)
        struct.pack_into("<I", content, where, _other_length(rng, 40, 1 << 20) & 0xFFFFFFFF)
    records[at] = rebuilt(records[at], bytes(content))
    return mutant_of(good, with_summary_or_without(rng, good.plain, records))


def absurd_number(rng: Random, good: Good) -> Mutant:
    """A count, an offset or a size somewhere in the structure that is beyond reason."""
    if not good.is_mcap:
        return _wrong_number(rng, good)
    records = pieces(good.plain)
    stating = [each for each in records if each.opcode in _SUMMARIZING and each.body]
    headed = [each for each in records if each.body]
    if not headed:
        return flip_bits(rng, good)
    each = rng.choice(stating if stating and rng.random() < 0.7 else headed)
    data = bytearray(good.plain)
    for _ in range(rng.choice((1, 1, 2))):
        size = rng.choice((2, 4, 8, 8))
        reach = min(len(each.body), 80) - size
        if reach < 0:
            continue
        offset = each.start + RECORD.size + rng.randint(0, reach)
        data[offset : offset + size] = _absurd(rng, len(data)).to_bytes(8, "little")[:size]
    return mutant_of(good, with_summary_sealed(bytes(data)), f"in {each.opcode}")


def absurd_footer(rng: Random, good: Good) -> Mutant:
    """A footer that points somewhere else."""
    if not good.is_mcap or len(good.plain) < 40:
        return _wrong_number(rng, good)
    data = bytearray(good.plain)
    where = len(data) - len(MAGIC) - 20 + rng.choice((0, 8))
    struct.pack_into("<Q", data, where, _absurd(rng, len(data)))
    return mutant_of(good, with_summary_sealed(bytes(data)))


def _wrong_number(rng: Random, good: Good) -> Mutant:
    """Numbers in the header of a sqlite file, in its pages' headers and their cell pointers."""
    data = bytearray(good.plain)
    for _ in range(rng.choice((1, 1, 3))):
        page = rng.randrange(0, max(1, len(data) // _PAGE)) * _PAGE
        base = 0 if page == 0 and rng.random() < 0.6 else page
        reach = 100 if base == 0 and page == 0 else 60
        size = rng.choice((1, 2, 4))
        where = min(base + rng.randrange(0, reach), len(data) - size)
        data[where : where + size] = _absurd(rng, len(data)).to_bytes(8, "big")[-size:]
    return mutant_of(good, bytes(data))


_EXTREMES = (
    *(0, 1, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF),
    *(1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 2, (1 << 64) - 1),
)


def _other_length(rng: Random, length: int, size: int) -> int:
    near = (max(length - 1, 0), length + 1, length + 9, length * 2, size, size * 2)
    return rng.choice((*near, *_EXTREMES, rng.randrange(0, 2 * length + 2)))


def _absurd(rng: Random, size: int) -> int:
    return rng.choice((size - 1, size, size + 1, *_EXTREMES, rng.getrandbits(64)))

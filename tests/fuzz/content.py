"""Mutations of what a bag says: its chunks, schemas, definitions, payloads and times."""

import sqlite3
import struct
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from ros2_memory.core.timebase import MAX_NS, NS_PER_S
from tests.fuzz.good import BASE_S, Good, mcaps, run_of, sqlites
from tests.fuzz.mutant import Mutant, mutant_of
from tests.fuzz.records import (
    Piece,
    channel,
    chunk_of,
    header,
    inside,
    message,
    numbers_of,
    pieces,
    schema,
    with_summary_or_without,
    without_summary,
)
from tests.support.bags import Msg, definition, write_db3, write_mcap
from tests.support.reader_cases import LAYOUTS

_BASE = BASE_S * NS_PER_S
_PAGE = 4096
_NUMBERS = (0, 1, 2, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF, 1 << 26)


def splice(rng: Random, good: Good) -> Mutant:
    """Chunks from another bag, twice, missing or in another order."""
    if not good.is_mcap:
        return splice_pages(rng, good)
    records = pieces(good.plain)
    other = pieces(rng.choice(mcaps()).plain)
    mine = numbers_of(records, Opcode.CHUNK, Opcode.MESSAGE)
    if not mine:
        return mutant_of(good, without_summary(records + other))
    for _ in range(rng.choice((1, 1, 3))):
        _splice_one(rng, records, rng.choice(mine), other)
        mine = [at for at in mine if at < len(records)]
    return mutant_of(good, with_summary_or_without(rng, good.plain, records))


def _splice_one(rng: Random, records: list[Piece], at: int, other: list[Piece]) -> None:
    theirs = [each for each in other if each.opcode in {Opcode.CHUNK, Opcode.MESSAGE}]
    match rng.randrange(6):
        case 0:
            records.insert(at, records[at])
        case 1:
            to = rng.randrange(len(records))
            records.insert(to, records.pop(at))
        case 2:
            del records[at]
        case 3 if theirs:
            records[at] = rng.choice(theirs)
        case 4 if theirs:
            records.insert(at, rng.choice(theirs))
        case _:
            records[at:at] = other[: rng.randrange(1, len(other) + 1)] if other else []


def splice_pages(rng: Random, good: Good) -> Mutant:
    """Pages of another sqlite bag, twice, or in another order."""
    data = bytearray(good.plain)
    other = rng.choice(sqlites()).plain if rng.random() < 0.5 else good.plain
    for _ in range(rng.choice((1, 2, 5))):
        to = rng.randrange(1 if rng.random() < 0.8 else 0, max(2, len(data) // _PAGE)) * _PAGE
        start = rng.randrange(max(1, len(other) // _PAGE)) * _PAGE
        page = other[start : start + _PAGE]
        data[to : to + len(page)] = page
    return mutant_of(good, bytes(data))


def swap_schemas(rng: Random, good: Good) -> Mutant:
    """Channels that name one another's types, or schemas of one name and another's text."""
    messages = run_of(BASE_S)
    types = sorted({each.type for each in messages})
    swapped = dict(zip(types, rng.sample(types, len(types)), strict=True))
    if rng.random() < 0.5:
        return _written(rng, good, [_of_type(each, swapped[each.type]) for each in messages])
    texts = {name: definition(swapped[name]).encode() for name in types}
    encodings = ("ros2msg", "ros2msg", "ros2idl", "", "jsonschema", "protobuf", "ros1msg")
    return _mcap(
        good,
        messages,
        lambda name: (rng.choice(encodings[: rng.choice((1, len(encodings)))]), texts[name]),
        rng.choice(("cdr", "cdr", "cdr", "json", "protobuf", "ros1", "")),
    )


def _of_type(each: Msg, type_name: str) -> Msg:
    return replace(each, type=type_name, body=each.payload)


def swap_schema_numbers(rng: Random, good: Good) -> Mutant:
    """Schema and channel records with numbers that are another's, unknown or declared twice."""
    records = pieces(good.plain)
    for at, each in enumerate(records):
        if each.opcode == Opcode.CHUNK and rng.random() < 0.8:
            inner = pieces(inside(each), 0)
            content = b"".join(_renumbered(rng, one).data for one in inner)
            records[at] = chunk_of(content, rng.choice(("", "zstd", "lz4")))
    records = [_renumbered(rng, each) for each in records]
    if not records:
        return swap_schemas(rng, good)
    return mutant_of(good, with_summary_or_without(rng, good.plain, records))


def _renumbered(rng: Random, each: Piece) -> Piece:
    if each.opcode not in {Opcode.SCHEMA, Opcode.CHANNEL} or rng.random() < 0.6:
        return each
    body = bytearray(each.body)
    at = 0 if each.opcode == Opcode.SCHEMA else rng.choice((0, 2))
    struct.pack_into("<H", body, at, rng.choice((0, 1, 2, 3, 65535)))
    return replace(each, body=bytes(body))


def odd_payloads(rng: Random, good: Good) -> Mutant:
    """Messages whose payloads state absurd lengths, end early, or go on."""
    messages = [_odd(rng, each) for each in run_of(BASE_S)]
    return _written(rng, good, messages)


def _odd(rng: Random, each: Msg) -> Msg:
    payload = bytearray(each.payload)
    match rng.randrange(8):
        case 0 | 1 | 2:
            at = 4 + 4 * rng.randrange(max(1, (len(payload) - 4) // 4))
            payload[at : at + 4] = struct.pack("<I", rng.choice(_NUMBERS))
        case 3:
            del payload[rng.randrange(len(payload)) :]
        case 4:
            payload[rng.randrange(4)] = rng.randrange(256)
        case 5:
            payload += rng.randbytes(rng.choice((1, 4, 1000)))
        case 6:
            payload[4:] = rng.randbytes(len(payload) - 4)
        case _:
            at = 4 + 8 * rng.randrange(max(1, (len(payload) - 4) // 8))
            payload[at : at + 8] = rng.choice(
                (
                    b"\xff" * 8,
                    struct.pack("<d", float("nan")),
                    struct.pack("<d", float("inf")),
                    struct.pack("<d", 1e308),
                    struct.pack("<d", 5e-324),
                )
            )
    return replace(each, body=bytes(payload))


def odd_json(rng: Random, good: Good) -> Mutant:
    """JSON messages that are deep, long, not JSON, or no object."""
    deep = rng.choice((10, 1000, 100_000))
    texts = (
        b"[" * deep + b"]" * deep,
        b'{"a":' * deep + b"1" + b"}" * deep,
        b"NaN",
        b"[1e999, -1e999, NaN]",
        b"1" * rng.choice((10, 4000, 5000)),
        b'{"x": ' + b"9" * 400 + b"}",
        b'"\\ud800"',
        b'{"\\ud800": "\\u0000\\u202e"}',
        b"\xff\xfe",
        b"",
        b"null",
        b'{"position": {"x": 1e308, "y": true}}',
        b"[" + b"0," * deep + b"0]",
    )
    content = [header(), schema(1, "Thing", "jsonschema", b"{}"), channel(1, 1, "/json", "json")]
    content += [
        message(1, _BASE + n * NS_PER_S // 10, rng.choice(texts)) for n in range(rng.choice((1, 9)))
    ]
    return mutant_of(good if good.is_mcap else mcaps()[0], without_summary(content))


def odd_times(rng: Random, good: Good) -> Mutant:
    """Log times at 0, at the end of time, in any order, or all the same."""
    odd = (0, 1, MAX_NS - 1, MAX_NS, (1 << 64) - 1, 4_102_444_800 * NS_PER_S, _BASE)
    share = rng.choice((0.02, 0.3, 1.0))
    most = MAX_NS if not good.is_mcap else 1 << 64
    messages = [
        replace(each, log_time=min(rng.choice(odd), most - 1), publish_time=rng.choice(odd) % most)
        if rng.random() < share
        else each
        for each in run_of(BASE_S)
    ]
    if rng.random() < 0.5:
        rng.shuffle(messages)
    return _written(rng, good, messages)


def _written(rng: Random, good: Good, messages: list[Msg]) -> Mutant:
    """A bag of the good one's kind that holds the messages."""
    if not good.is_mcap:
        return db3_with(good, messages, None)
    layout = rng.choice([*LAYOUTS.values()])
    with TemporaryDirectory() as folder:
        path = write_mcap(Path(folder) / "bag.mcap", messages, layout)
        return mutant_of(good, path.read_bytes())


def db3_with(good: Good, messages: list[Msg], texts: dict[str, str] | None) -> Mutant:
    """A sqlite bag of these messages; `texts` are the definitions in it, if not the right ones."""
    with TemporaryDirectory() as folder:
        path = write_db3(Path(folder) / "bag.db3", messages, definitions=texts is None)
        with closing(sqlite3.connect(path)) as base:
            for number, (name, text) in enumerate((texts or {}).items()):
                base.execute(
                    "INSERT INTO message_definitions VALUES (?,?,?,?,?)",
                    (number + 100, name, "ros2msg", text, ""),
                )
            base.commit()
        return mutant_of(good, path.read_bytes())


def _mcap(
    good: Good,
    messages: Iterable[Msg],
    schema_of: Callable[[str], tuple[str, bytes]],
    encoding: str,
) -> Mutant:
    out = BytesIO()
    writer = Writer(out, chunk_size=2000, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="test")
    channels: dict[tuple[str, str], int] = {}
    for each in messages:
        key = (each.topic, each.type)
        if key not in channels:
            number = writer.register_schema(each.type, *schema_of(each.type))
            channels[key] = writer.register_channel(each.topic, encoding, number)
        writer.add_message(channels[key], each.log_time, each.payload, each.published)
    writer.finish()
    return mutant_of(good if good.is_mcap else mcaps()[0], out.getvalue())

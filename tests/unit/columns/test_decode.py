"""Decoding whole bags as columns, compared with rosbags leaf by leaf; also what is odd or bulky."""

import random
import struct
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from ros2_memory.columns import decode
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.plan import Plan
from ros2_memory.columns.table import Table, join_tables
from ros2_memory.columns.walk import LevelColumns, NotWalkedError, read_columns
from ros2_memory.core.errors import UndecodableError
from ros2_memory.storage.base import BagReader, Batch, Record
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import Msg, text, write_mcap
from tests.support.column_worlds import EVERYTHING
from tests.support.examples import LONG, examples
from tests.support.leaves import Comparison
from tests.support.mcap_surgery import SMALL, chatter, raw_mcap, spoil_chunk
from tests.support.reader_cases import read_through
from tests.support.shared_bags import REAL, needs_real
from tests.unit.columns.drawn_tables import message_in

NUMBERS = (
    *("bool", "byte", "char", "int8", "uint8", "int16", "uint16", "int32", "uint32"),
    *("int64", "uint64", "float32", "float64"),
)
TIME, DURATION = "builtin_interfaces/Time", "builtin_interfaces/Duration"

_TIME_TEXT = "int32 sec\nuint32 nanosec\n"


@dataclass(frozen=True)
class DrawnField:
    """`length`: None for one value, a number of a fixed array, -1 of a sequence."""

    name: str
    kind: str
    length: int | None = None


@dataclass(frozen=True)
class DrawnTypes:
    """Types by name, each of those before it and of primitives; the last one is the root."""

    types: tuple[tuple[str, tuple[DrawnField, ...]], ...]

    @property
    def root(self) -> str:
        return f"drawn_msgs/msg/{self.types[-1][0]}"

    def msg(self) -> str:
        """The definition as ros2msg, nested types behind it."""
        nested = {f"drawn_msgs/{name}": _msg(fields) for name, fields in self.types[:-1]}
        nested |= dict.fromkeys((TIME, DURATION), _TIME_TEXT)
        parts = [f"{'=' * 80}\nMSG: {name}\n{part}" for name, part in nested.items()]
        return "".join([_msg(self.types[-1][1]), *parts])

    def store(self) -> Typestore:
        """A typestore of them; bytes are unsigned, as in ROS, which rosbags has signed."""
        store = Typestore()
        for name in ("Time", "Duration"):
            store.register(get_types_from_msg(_TIME_TEXT, f"builtin_interfaces/msg/{name}"))
        for name, fields in self.types:
            unsigned = [
                replace(each, kind="uint8") if each.kind == "byte" else each for each in fields
            ]
            store.register(get_types_from_msg(_msg(unsigned), f"drawn_msgs/msg/{name}"))
        return store


def _msg(fields: Sequence[DrawnField]) -> str:
    arrays: dict[int | None, str] = {None: "", -1: "[]"}
    return "".join(
        f"{each.kind}{arrays.get(each.length, f'[{each.length}]')} {each.name}\n" for each in fields
    )


_PRIMITIVES = st.sampled_from([*NUMBERS, "string", "string", TIME, DURATION])

_LENGTHS = st.one_of(
    st.none(), st.none(), st.just(-1), st.just(-1), st.sampled_from((1, 3, 9, 12, 600))
)


@st.composite
def drawn_types(draw: st.DrawFn) -> DrawnTypes:
    """Up to four types, each of the ones before it; few fields, of every kind."""
    types: list[tuple[str, tuple[DrawnField, ...]]] = []
    count = draw(st.integers(1, 4))
    for nth in range(count):
        nested = [name for name, _ in types]
        kinds = st.one_of(_PRIMITIVES, st.sampled_from(nested)) if nested else _PRIMITIVES
        fields = []
        names = ("from", "data", "length", "x", "y", "z", "stamp")
        for name in names[: draw(st.integers(0 if nth < count - 1 else 1, 6))]:
            kind, length = draw(kinds), draw(_LENGTHS)
            if length is not None and length > 12 and kind not in NUMBERS:
                length = 2
            fields.append(DrawnField(name, kind, length))
        types.append((f"Type{nth}", tuple(fields)))
    return DrawnTypes(tuple(types))


def tables_of(reader: BagReader, path: Path) -> list[Table]:
    """All tables of a bag, those of several groups joined; errors of lost messages are passed.

    Without the messages that cannot be decoded.
    """
    parts: dict[object, list[Table]] = {}
    groups, _ = read_through(map(Group.tables, undecoded(reader, path, skip_undecodable=True)))
    for table in chain.from_iterable(groups):
        parts.setdefault((table.channel.topic, table.channel.schema), []).append(table)
    return [join_tables(tables) for tables in parts.values()]


def decoded_alike(reader: BagReader, path: Path) -> None:
    """Checks the tables of a bag by its records, decoded one by one."""
    tables = tables_of(reader, path)
    records: dict[object, list[Record]] = {}
    topics = {table.channel.topic for table in tables}
    read, _ = read_through(reader.records(path, topics, EVERYTHING))
    for record in read:
        records.setdefault((record.channel.topic, record.channel.schema), []).append(record)
    assert records.keys() == {(table.channel.topic, table.channel.schema) for table in tables}
    for table in tables:
        kept = records[table.channel.topic, table.channel.schema]
        if "" not in table.left_out:
            comparison, decoded = Comparison(), {}
            for nth, record in enumerate(kept):
                with suppress(UndecodableError):
                    decoded[nth] = reader.decode(record)
            comparison.table(table, [*decoded.values()])
            assert comparison.wrong == []
            kept = [kept[nth] for nth in decoded]
            assert table.publish_times.tolist() == [record.publish_time for record in kept]
        assert table.log_times.tolist() == [record.log_time for record in kept]


def bag_of(path: Path, types: DrawnTypes, payloads: Sequence[bytes]) -> Path:
    """A bag of one topic."""

    def fill(writer: Writer) -> None:
        schema = writer.register_schema(types.root, "ros2msg", types.msg().encode())
        channel = writer.register_channel("/drawn", "cdr", schema)
        for nth, payload in enumerate(payloads):
            writer.add_message(channel, 10 + nth, payload, 5 + nth)

    return raw_mcap(path, fill, profile="ros2", chunk_size=4096)


def bags_below(folder: Path) -> list[Path]:
    """The bags of a folder: of a short run those of which there is one of a kind."""
    reader = Rosbag2Reader()
    files = sorted(file for file in folder.rglob("*") if file.is_file() and reader.reads(file))
    if LONG:
        return files
    first = {file.parent: file for file in reversed(files)}
    return sorted(file for file in first.values() if file.stat().st_size < 120_000)


@pytest.fixture
def fallbacks(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The topics of batches that were decoded message by message."""
    topics: list[str] = []

    def noting(plan: Plan, batch: Batch) -> LevelColumns:
        try:
            return read_columns(plan, batch)
        except NotWalkedError:
            topics.append(batch.channel.topic)
            raise

    monkeypatch.setattr(decode, "read_columns", noting)
    return topics


@needs_real
@pytest.mark.parametrize("path", bags_below(REAL), ids=lambda path: path.name)
def test_bags_of_public_robots_are_decoded_as_rosbags_does(
    path: Path, fallbacks: list[str]
) -> None:
    decoded_alike(Rosbag2Reader(), path)
    assert fallbacks == []


@settings(max_examples=examples(75))
@given(
    types=drawn_types(),
    seed=st.integers(0, 2**32),
    longest=st.sampled_from((0, 1, 3, 12)),
    is_little=st.sampled_from((True, True, True, False)),
)
def test_messages_of_any_definition_are_decoded_as_rosbags_does(
    types: DrawnTypes, seed: int, longest: int, is_little: bool
) -> None:
    chance = random.Random(seed)
    store = types.store()
    payloads = [
        bytes(
            store.serialize_cdr(
                message_in(store, types.root, chance, longest=longest),
                types.root,
                little_endian=is_little,
            )
        )
        for _ in range(chance.randint(1, 6))
    ]
    if sum(map(len, payloads)) > 1 << 20:
        return
    with tempfile.TemporaryDirectory() as folder:
        path = bag_of(Path(folder) / "drawn.mcap", types, payloads)
        [table] = tables_of(McapReader(), path)
        assert table.left_out.get("") is None
        comparison = Comparison()
        comparison.table(table, [store.deserialize_cdr(each, types.root) for each in payloads])
        assert comparison.wrong == []


@settings(max_examples=examples(75))
@given(types=drawn_types(), seed=st.integers(0, 2**32))
def test_damaged_payloads_are_decoded_or_left_out_as_rosbags_decides(
    types: DrawnTypes, seed: int
) -> None:
    chance = random.Random(seed)
    store = types.store()
    payloads = []
    for _ in range(4):
        payload = bytearray(
            store.serialize_cdr(message_in(store, types.root, chance, longest=3), types.root)
        )
        at = chance.randrange(4, max(len(payload), 5))
        match chance.randrange(5):
            case 0:
                del payload[at:]
            case 1:
                payload[at : at + 4] = struct.pack("<I", chance.choice((2**32 - 1, 40, 0, 2**31)))
            case 2:
                payload += bytes(chance.randrange(9))
            case 3:
                payload[at:] = bytes([chance.choice((0, 1, 255, 65))]) * (len(payload) - at)
            case _:
                pass
        payloads.append(bytes(payload))
    with tempfile.TemporaryDirectory() as folder:
        path = bag_of(Path(folder) / "damaged.mcap", types, payloads)
        decoded_alike(McapReader(), path)


def groups_of(path: Path) -> Iterator[list[Table]]:
    return map(Group.tables, undecoded(McapReader(), path))


LONG_TYPES = DrawnTypes(
    (
        ("Point", (DrawnField("x", "float64"), DrawnField("kind", "uint8"))),
        ("Named", (DrawnField("label", "string"), DrawnField("points", "Point", -1))),
        (
            "Long",
            (
                DrawnField("points", "Point", -1),
                DrawnField("named", "Named", -1),
                DrawnField("scan", "float32", -1),
                DrawnField("answer", "int32"),
            ),
        ),
    )
)


@pytest.mark.parametrize("rows", [1, 40])
def test_what_follows_long_sequences_is_read_where_it_is(
    tmp_path: Path, rows: int, fallbacks: list[str]
) -> None:
    store = LONG_TYPES.store()
    named, part, long = (
        store.types[f"drawn_msgs/msg/{name}"] for name in ("Named", "Point", "Long")
    )
    messages = [
        long(
            [part(float(nth), nth % 200) for nth in range(700 + row)],
            [named("n" * (nth % 7), [part(0.5, 1)] * (nth % 4)) for nth in range(30)],
            np.arange(2000 - row, dtype=np.float32),
            42,
        )
        for row in range(rows)
    ]
    payloads = [bytes(store.serialize_cdr(each, LONG_TYPES.root)) for each in messages]
    path = bag_of(tmp_path / "long.mcap", LONG_TYPES, payloads)
    [table] = tables_of(McapReader(), path)
    comparison = Comparison()
    comparison.table(table, messages)
    assert comparison.wrong == fallbacks == []
    assert len(table.elements["named"].elements["points"]) == rows * 43


def test_large_messages_of_large_files_have_times_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = [text(1, "x" * 100_000, "/long"), text(2, "x", "/short")]
    path = write_mcap(tmp_path / "a.mcap", messages)
    [tables] = groups_of(path)
    assert all(table.columns for table in tables)
    monkeypatch.setattr(decode, "LARGE_FILE_BYTES", 1000)
    [tables] = groups_of(path)
    assert {table.channel.topic: bool(table.columns) for table in tables} == {
        "/long": False,
        "/short": True,
    }


def test_an_array_longer_than_any_message_has_no_columns(tmp_path: Path) -> None:
    endless = DrawnTypes((("Endless", (DrawnField("numbers", "float64", 10**18),)),))
    [[table]] = groups_of(bag_of(tmp_path / "a.mcap", endless, [b"\0\1\0\0\7"]))
    assert table.log_times.tolist() == [10]
    assert f"numbers is an array of {10**18} elements" in table.left_out[""]


@pytest.mark.parametrize("broken", [[], [b"\x00\x01\x00\x00\xff\xff\xff\x7f"]])
def test_what_a_damaged_chunk_loses_is_raised_and_all_the_rest_follows(
    tmp_path: Path, broken: list[bytes]
) -> None:
    """Also where a drawn_message of it cannot be decoded."""
    messages = [*chatter(20), *(Msg("/chatter", "std_msgs/msg/String", 20, b) for b in broken)]
    path = write_mcap(tmp_path / "a.mcap", messages, SMALL)
    spoil_chunk(path, 1)
    [[table]], [error] = read_through(groups_of(path))
    assert error.lost is not None
    first, last = error.lost
    assert ("cannot be decoded" in table.left_out.get("", "")) is bool(broken)
    assert set(table.log_times.tolist()) == {*range(len(messages))} - {*range(first, last + 1)}

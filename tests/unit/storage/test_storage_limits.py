"""What a small file may make its reader do: hold no more, and work no longer, than it is worth."""

import random
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import count
from pathlib import Path
from unittest.mock import patch

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage import errors
from ros2_memory.storage.base import Batch, Channel, Record, Schema, errors_as_items
from ros2_memory.storage.cache import ByteLru
from ros2_memory.storage.errors import (
    MAX_DEFINITION_BYTES,
    MAX_NAMES_CHARS,
    MAX_TOPICS,
    UnreadableError,
    max_decompressed_bytes,
)
from ros2_memory.storage.mcap.chunk import walk_chunk
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from ros2_memory.storage.sqlite_bag import guard
from tests.fuzz.bombs import rle_frame
from tests.fuzz.records import (
    MAGIC,
    Piece,
    channel,
    chunk_of,
    header,
    message,
    schema,
    without_summary,
)
from tests.support.bags import text, write_db3
from tests.support.reader_cases import read_through

MB = 1 << 20
TOO_LONG = "a" * MAX_NAMES_CHARS
EVERYTHING = TimeWindow.everything()
STRINGS = [schema(1, "std_msgs/msg/String", "ros2msg", b"string data\n"), channel(1, 1, "/chatter")]

CUTTING = """\
import sys
from pathlib import Path
from ros2_memory.storage.mcap.writer import McapWriter

def peak_kb():
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])

before = peak_kb()
taken = McapWriter().cut(*map(Path, sys.argv[1:]), lambda _topic, time, _: time % 2 == 0)
print(taken.total(), peak_kb() - before)
"""


def string_message(name: str = "x", time: int = 5) -> Piece:
    return message(1, time, text(0, name).payload)


def string_chunk(*more: Piece) -> Piece:
    return chunk_of(b"".join(each.data for each in (*STRINGS, string_message(), *more)))


def bomb(size: int) -> Piece:
    """A chunk of some bytes that unpacks to `size` bytes, which do not match its checksum."""
    return chunk_of(b"", "zstd", packed=rle_frame(size), size=size, crc=1)


@contextmanager
def little_memory(most: int) -> Iterator[None]:
    """What is done meanwhile must hold less than so many bytes at any time."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < most


def bag(folder: Path, *records: Piece) -> Path:
    path = folder / "run/run_0.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(without_summary([header(), *records]))
    return path


@pytest.mark.parametrize(
    ("records", "said"),
    [
        *(
            ([string_chunk(), chunk_of(b"", how, packed=packed, size=stated, crc=0)], said)
            for how, packed in (
                ("zstd", rle_frame(300 * MB)),
                ("lz4", lz4.frame.compress(bytes(300 * MB))),
            )
            for stated, said in (
                (10, "left out: 1 damaged record ("),
                (1 << 40, "than the 1 MiB allowed; if that is right, raise reader.max_chunk_mb"),
            )
        ),
        # Outside of chunks.
        ([*STRINGS, string_message("x" * 2 * MB), string_message()], "a message is larger"),
        ([string_chunk(), *[chunk_of(b"")] * 20], "more than 20 chunks"),
    ],
    ids=count(),
)
@patch("ros2_memory.storage.mcap.chunk.MAX_CHUNKS", 20)
def test_what_is_larger_or_more_than_allowed_is_left_out_and_named(
    tmp_path: Path, records: list[Piece], said: str
) -> None:
    path, reader = bag(tmp_path, *records), McapReader(max_chunk_mb=1)
    with little_memory(10 * MB):
        summary = reader.summarize(path)
        assert len([*reader.records(path, ["/chatter"], EVERYTHING)]) == summary.count == 1
    assert said in summary.notes[0]


def test_a_chunk_larger_than_allowed_is_refused_before_it_is_in_memory(tmp_path: Path) -> None:
    path, reader = tmp_path / "run_0.mcap", McapReader(max_chunk_mb=1)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1024, compression=CompressionType.NONE)
        writer.start("ros2")
        declared = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        number = writer.register_channel("/chatter", "cdr", declared)
        for time, size in ((5, 2000), (6, 40 * MB), (7, 2000)):
            writer.add_message(number, time, bytes(size), time)
        writer.finish()
    with little_memory(10 * MB):
        [before, lost, behind] = errors_as_items(reader.batches(path, ["/chatter"], EVERYTHING))
    assert isinstance(lost, BagError)
    assert lost.lost == (6, 6)
    assert "larger than the 1 MiB allowed" in lost.reason
    for batch, time in ((before, 5), (behind, 7)):
        assert isinstance(batch, Batch)
        assert batch.log_times.tolist() == [time]


@pytest.mark.parametrize("newest_first", [False, True])
def test_a_message_larger_than_allowed_costs_no_other_of_its_db3(
    tmp_path: Path, *, newest_first: bool
) -> None:
    path = tmp_path / "run_0.db3"
    write_db3(path, [text(time, "x" * 2 * MB if time == 6 else "x") for time in (5, 6, 7)])
    reader = Rosbag2Reader(max_chunk_mb=1)
    assert reader.summarize(path).count == 3
    records = reader.records(path, ["/chatter"], EVERYTHING, newest_first=newest_first)
    found, [lost] = read_through(records)
    assert [record.log_time for record in found] == ([7, 5] if newest_first else [5, 7])
    assert lost.lost == (6, 6)
    assert "larger than the 1 MiB allowed" in lost.reason
    batches, [lost] = read_through(reader.batches(path, ["/chatter"], EVERYTHING))
    assert [batch.log_times.tolist() for batch in batches] == [[5], [7]]


def test_a_message_larger_than_allowed_costs_no_other_of_a_db3_that_was_cut_short(
    tmp_path: Path,
) -> None:
    messages = [text(time, "x" * (2 * MB if time == 6 else 200)) for time in range(2000)]
    path = write_db3(tmp_path / "run_0.db3", messages)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 9 // 10 // 4096 * 4096])
    reader = Rosbag2Reader(max_chunk_mb=1)
    count = reader.summarize(path).count
    assert 100 < count < 2000
    found, [lost] = read_through(reader.records(path, ["/chatter"], EVERYTHING))
    assert [record.log_time for record in found] == [*range(6), *range(7, count)]
    assert lost.lost == (6, 6)


def test_chunks_that_together_unpack_to_far_more_than_the_file_end_the_look_into_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "_ALWAYS_ALLOWED", 32 * MB)
    whole = string_chunk()
    summary = McapReader().summarize(bag(tmp_path, whole, *[bomb(30 * MB)] * 5, whole))
    assert summary.count == 1
    assert "4 damaged records" not in summary.notes[0]
    assert "damaged record" in summary.notes[0]


@patch("ros2_memory.storage.mcap.chunk.MAX_CHUNK_MESSAGES", 10)
def test_a_chunk_of_more_messages_than_are_kept_in_mind_is_refused() -> None:
    one = message(1, 5, b"").data
    assert walk_chunk(one * 10).message_count == 10
    with pytest.raises(UnreadableError, match="more than 10 messages"):
        walk_chunk(one * 11)


def test_repairing_a_bag_of_bombs_counts_them_as_lost(tmp_path: Path) -> None:
    path = bag(tmp_path, string_chunk(), *[bomb(30 * MB)] * 6)
    path.write_bytes(path.read_bytes()[: -len(MAGIC)])
    rewritten = McapWriter().rewrite(path, tmp_path / "repaired.mcap")
    assert rewritten.messages == 1
    assert rewritten.lost_bytes


def test_large_chunks_that_overlap_in_time_are_not_all_in_memory_at_once(tmp_path: Path) -> None:
    count, size = 8, 9 * MB
    noise = random.Random(1).randbytes(size)
    declared = b"".join(each.data for each in STRINGS)
    chunks = []
    for time in range(count):
        both = message(1, time, noise).data + string_message("b", 100 + time).data
        chunks.append(chunk_of(declared + both, "zstd", span=(time, 100 + time)))
    path = bag(tmp_path, *chunks)
    reader = McapReader(cache_mb=1)
    reader.summarize(path)
    with little_memory(5 * size):
        times = [each.log_time for each in reader.records(path, ["/chatter"], EVERYTHING)]
    assert times == [*range(count), *range(100, 100 + count)]


MANY = [channel(n, 1, f"/t{n}") for n in range(1, MAX_TOPICS + 2)]


@pytest.mark.parametrize(
    ("declared", "said"),
    [
        ([STRINGS[0], *MANY], "may be whole, but has more than the 5000 topics"),
        ([STRINGS[0], channel(1, 1, f"/{TOO_LONG}")], "longer names"),
        ([schema(1, TOO_LONG, "ros2msg", b"uint8 data"), STRINGS[1]], "longer names"),
    ],
    ids=["topics", "a topic", "a type"],
)
def test_more_topics_or_longer_names_than_any_robot_has_are_refused(
    tmp_path: Path, declared: list[Piece], said: str
) -> None:
    """They stay in memory as long as a bag exists."""
    packed = chunk_of(b"".join(each.data for each in (*declared, string_message())), "zstd")
    with pytest.raises(BagError, match=said):
        McapReader().summarize(bag(tmp_path, packed))
    known = bag(tmp_path, STRINGS[0], *MANY[:-1], string_message())
    assert McapReader().summarize(known).count == 1


def test_a_compressed_message_larger_than_allowed_cannot_be_decoded_and_the_next_can(
    tmp_path: Path,
) -> None:
    large = message(1, 5, zstandard.compress(text(0, "x" * 2 * MB).payload))
    path = bag(tmp_path, *STRINGS, large, string_message("y", 9))
    reader = McapReader(max_chunk_mb=1)
    first, second = reader.records(path, ["/chatter"], EVERYTHING)
    with pytest.raises(UndecodableError, match="damaged or too large"):
        reader.decode(first)
    assert getattr(reader.decode(second), "data", None) == "y"


MANY_BOOLS = b"std_msgs/Bool[] data\n" + b"=" * 80 + b"\nMSG: std_msgs/Bool\nbool data\n"


@pytest.mark.parametrize(
    ("encoding", "kind", "payload_of", "most", "said"),
    [
        (
            "cdr",
            Schema("pkg/msg/Many", "ros2msg", MANY_BOOLS),
            lambda number: b"\0\1\0\0" + struct.pack("<I", number) + bytes(number),
            199_000,
            "more than 200000 texts or messages",
        ),
        (
            "json",
            Schema("Thing", "jsonschema", b"{}"),
            lambda number: b"[" + b"0," * number + b"0]",
            2 * MB - 2,
            "longer than the 4 MiB",
        ),
    ],
)
def test_a_message_of_more_than_there_is_room_for_is_not_decoded(
    encoding: str, kind: Schema, payload_of: Callable[[int], bytes], most: int, said: str
) -> None:
    def decoded(number: int) -> object:
        return McapReader().decode(Record(Channel("/t", encoding, kind), 1, 1, payload_of(number)))

    assert decoded(most)
    with pytest.raises(UndecodableError, match=said):
        decoded(2 * most)


def test_of_a_definition_larger_than_any_no_more_is_kept_than_shows_it(tmp_path: Path) -> None:
    large = schema(1, "a/msg/B", "ros2msg", b"#" * 3 * MB + b"\nuint8 data").data
    path = bag(tmp_path, chunk_of(large + STRINGS[1].data + string_message().data, "zstd"))
    reader = McapReader()
    [known] = reader.channels(path)
    assert len(known.schema.text) == MAX_DEFINITION_BYTES + 1
    assert "larger than" in (reader.undecodable(known) or "")


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 15_000))))
def test_what_is_cached_never_passes_the_bound(puts: list[tuple[int, int]]) -> None:
    cache: ByteLru[int] = ByteLru(20_000)
    for key, size in puts:
        cache.put(key, size, size)
        assert sum(cache.get(each) or 0 for each in range(6)) <= 20_000


def test_a_file_that_unpacks_to_far_more_than_its_size_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "_ALWAYS_ALLOWED", 32 * MB)
    path = tmp_path / "bag.mcap.zstd"
    start = zstandard.compress(MAGIC + header().data)
    path.write_bytes(start + rle_frame(max_decompressed_bytes(MB)))
    with pytest.raises(BagError, match="unpacks to more than 100 times its size"):
        Rosbag2Reader().summarize(path)


@patch("ros2_memory.storage.zstd_bag._MAX_FRAMES", 100)
@patch("ros2_memory.storage.zstd_bag._MAX_BLOCKS", 1000)
def test_a_file_of_more_frames_or_blocks_than_any_writer_makes_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap.zstd"
    for data in (rle_frame(1) * 101, rle_frame(10)[:6] + b"\x08\0\0x" * 1001):
        path.write_bytes(data)
        with pytest.raises(BagError, match="it is made of more than"):
            Rosbag2Reader().is_finished(path)


LONG = "char(0) || hex(zeroblob(17000000))"


@pytest.mark.parametrize(
    ("statements", "said"),
    [
        (
            (
                "ALTER TABLE messages RENAME TO m;"
                "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1"
                " FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
            ),
            "its messages is not a plain table",
        ),
        (
            "ALTER TABLE messages ADD COLUMN more AS (zeroblob(900000000))",
            "its messages is not a plain table",
        ),
        (
            "ALTER TABLE messages RENAME COLUMN data TO other",
            "lacks the tables topics and messages",
        ),
        (
            (
                "WITH RECURSIVE n(i) AS (SELECT 9 UNION ALL SELECT i + 1 FROM n LIMIT 5000)"
                "INSERT INTO topics SELECT i, '/t' || i, 'a/msg/B', 'cdr', '', '' FROM n"
            ),
            "more than the 5000 topics",
        ),
        (
            (
                "WITH RECURSIVE n(i) AS (SELECT 9 UNION ALL SELECT i + 1 FROM n LIMIT 70)"
                "INSERT INTO message_definitions"
                " SELECT i, 'a/msg/B', 'ros2msg', hex(zeroblob(500000)), '' FROM n"
            ),
            "texts of its table message_definitions are longer than",
        ),
        *(
            (f"UPDATE {table} SET {column} = {LONG}", f"its table {table} are longer than")  # noqa: S608
            for table, column in (
                ("topics", "offered_qos_profiles"),
                ("topics", "name"),
                ("message_definitions", "encoded_message_definition"),
                ("message_definitions", "topic_type"),
            )
        ),
    ],
    ids=count(),
)
def test_a_database_that_is_not_what_it_seems_is_refused_before_it_is_read(
    tmp_path: Path, statements: str, said: str
) -> None:
    path = write_db3(tmp_path / "bag.db3", [text(n, "x") for n in range(5)])
    with closing(sqlite3.connect(path)) as base:
        base.executescript(statements)
    with little_memory(4 * MB), pytest.raises(BagError, match=said):
        Rosbag2Reader().summarize(path)


def test_what_works_longer_than_the_size_explains_is_interrupted() -> None:
    with closing(sqlite3.connect(":memory:")) as base:
        guard(base, MB, 1000)
        endless = (
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT count(*) FROM n"
        )
        with pytest.raises(sqlite3.OperationalError, match="interrupted"):
            base.execute(endless)


def test_cutting_a_file_does_not_take_memory_as_large_as_the_file(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "a.db3", [text(1, "x")])
    with closing(sqlite3.connect(path)) as base:
        base.execute(
            "WITH RECURSIVE every (time) AS (SELECT 2 UNION ALL SELECT time + 1 FROM every LIMIT ?)"
            " INSERT INTO messages (topic_id, timestamp, data)"
            " SELECT 1, time, zeroblob(1000) FROM every",
            (40_000,),
        )
        base.commit()
    program = [sys.executable, "-c", CUTTING, str(path), str(tmp_path / "b.db3")]
    taken, grown_kb = map(int, subprocess.check_output(program).split())
    assert taken == 20_000
    assert grown_kb << 10 < path.stat().st_size // 4

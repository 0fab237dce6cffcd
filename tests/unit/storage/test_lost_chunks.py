"""A damaged chunk costs its own messages, and is reported where these were looked for."""

import errno
import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.core.errors import (
    BagContradictionError,
    BagError,
    BagUnreachableError,
    BagVanishedError,
    UndecodableError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Memory
from ros2_memory.storage.base import BagReader, Channel, Record, Schema
from ros2_memory.storage.errors import UnreadableError, reading
from ros2_memory.storage.mcap import bulk
from ros2_memory.storage.mcap.bulk import ReadChunks
from ros2_memory.storage.mcap.chunk import MessageTable
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import McapLayout, Msg, boolean, definition, odom, text, write_mcap
from tests.support.examples import examples
from tests.support.mcap_surgery import (
    SMALL,
    chatter,
    chunks_of,
    damaged,
    raw_mcap,
    spoil_chunk,
)
from tests.support.memories import Remember, asked, memory_of, with_store
from tests.support.reader_cases import read_through

S = 10**9


LATCHED = McapLayout(chunk_size=1, latched=frozenset({"/dock"}))

EVERYTHING = TimeWindow.everything()


@pytest.mark.parametrize("newest_first", [False, True])
@pytest.mark.parametrize(
    "made",
    [
        lambda _: McapReader(),
        lambda _: Rosbag2Reader(),
        lambda _: BagDirReader(McapReader()),
        lambda root: BagDirReader(McapReader(), root),
    ],
)
def test_reading_goes_on_behind_a_damaged_chunk(
    tmp_path: Path, made: Callable[[Path], BagReader], newest_first: bool
) -> None:
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", chatter(40), SMALL)
    lost = chunks_of(path)[3]
    spoil_chunk(path, 3)
    records = made(tmp_path).records(path, ["/chatter"], EVERYTHING, newest_first=newest_first)
    found, [error] = read_through(records)
    assert error.lost == (lost.message_start_time, lost.message_end_time)
    whole = [*range(lost.message_start_time), *range(lost.message_end_time + 1, 40)]
    assert [each.log_time for each in found] == sorted(whole, reverse=newest_first)


@pytest.mark.parametrize("compression", CompressionType)
def test_a_chunk_without_a_checksum_that_ends_early_is_reported(
    tmp_path: Path, compression: CompressionType
) -> None:
    def fill(writer: Writer) -> None:
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        for each in chatter(40):
            writer.add_message(channel, each.log_time, each.payload, each.log_time)

    how = partial(raw_mcap, enable_crcs=False, use_statistics=False)
    path = how(tmp_path / "a.mcap", fill, compression=compression)
    assert McapReader().summarize(path).schema.notes == ()
    [chunk] = chunks_of(path)
    data, cut = bytearray(path.read_bytes()), chunk.compressed_size // 2
    begin, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
    for at in (begin + 1, end - chunk.compressed_size - 8):
        struct.pack_into("<Q", data, at, struct.unpack_from("<Q", data, at)[0] - cut)
    del data[end - cut : end]
    path.write_bytes(data)
    assert "left out: 1 damaged record" in McapReader().summarize(path).schema.notes[-1]


def overlapping(folder: Path) -> Memory:
    """A damaged bag up to 1 s, one of its recording from 2 s on, and one that overlaps this."""
    first = write_mcap(folder / "a" / "a_0.mcap", [text(S, "hello")])
    spoil_chunk(first, 0)
    write_mcap(folder / "a" / "a_1.mcap", [text(2 * S, "person"), text(20 * S, "person")])
    write_mcap(folder / "b" / "b_0.mcap", [text(S // 2, "nobody"), text(3 * S, "nobody")])
    return memory_of(folder)


def test_a_damaged_chunk_is_reported_where_what_is_asked_may_be_in_it(tmp_path: Path) -> None:
    """What overlaps has a search look further back for copies than it was asked to."""
    plain = overlapping(tmp_path)
    recalled = with_store(plain, tmp_path)

    def is_noted(tool: str, value: str = "person", **given: float) -> bool:
        asks = {"topic": "/*", "condition_type": "contains", "value": value, **given}
        reply, again = (asked(each, tool, **asks) for each in (plain, recalled))
        assert reply == again
        return "a_0.mcap could not be read whole" in str(reply.get("notes"))

    assert not is_noted("find_last_match", before=10)
    assert is_noted("find_last_match", "hello")
    assert not is_noted("find_matches", start=2)
    assert is_noted("find_matches", start=0.5)
    assert is_noted("find_matches", limit=5)
    assert is_noted("find_matches", end=10, limit=5)
    assert not is_noted("find_matches", limit=1)


def test_where_the_first_reception_of_a_latched_match_cannot_be_read_is_reported(
    tmp_path: Path, remember: Remember
) -> None:
    dock = text(10 * S, "docked", "/dock")
    other = text(9 * S, "undocked", "/dock")
    first = write_mcap(tmp_path / "a" / "a_0.mcap", [other, dock], LATCHED)
    spoil_chunk(first, 1)
    again = Msg("/dock", dock.type, 100 * S, dock.body, 10 * S)
    write_mcap(tmp_path / "b" / "b_0.mcap", [again], LATCHED)
    memory = remember()
    asks = {"topic": "/dock", "condition_type": "contains", "value": "docked"}
    found = asked(memory, "find_last_match", **asks)
    assert found["timestamp"] == 100
    assert "a_0.mcap could not be read whole" in found["notes"][0]


def of_sqlite(code: int) -> sqlite3.OperationalError:
    error = sqlite3.OperationalError(f"as sqlite puts {code}")
    error.sqlite_errorcode = code
    return error


@pytest.mark.parametrize(
    ("foreign", "kind"),
    [
        (OSError(errno.EIO, "Input/output error"), BagUnreachableError),
        (OSError(errno.ESTALE, "Stale file handle"), BagUnreachableError),
        (OSError(errno.ENOENT, "No such file or directory"), BagVanishedError),
        (MemoryError(), BagUnreachableError),
        (KeyError(1), BagError),
        (RuntimeError("LZ4F_decompress\nfailed"), BagError),
        (AssertionError(), BagError),
        (UnreadableError("its reason"), BagError),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), BagError),
        (of_sqlite(sqlite3.SQLITE_IOERR_READ), BagUnreachableError),
        (of_sqlite(sqlite3.SQLITE_CANTOPEN), BagUnreachableError),
        (of_sqlite(sqlite3.SQLITE_NOMEM), BagUnreachableError),
        (of_sqlite(sqlite3.SQLITE_CORRUPT), BagError),
        (of_sqlite(sqlite3.SQLITE_NOTADB), BagError),
    ],
    ids=repr,
)
def test_every_foreign_exception_becomes_an_error_about_the_file_and_says_what_may_pass(
    foreign: Exception, kind: type[BagError]
) -> None:
    path = Path("bag.mcap")
    with pytest.raises(BagError) as caught, reading(path):
        raise foreign
    assert type(caught.value) is kind
    assert caught.value.path == str(path)
    assert caught.value.reason
    assert "\n" not in caught.value.reason
    assert caught.value.__cause__ is foreign


@pytest.mark.parametrize("error", [UndecodableError("/t", "a/msg/B", "no"), KeyboardInterrupt()])
def test_errors_of_the_tree_and_interruptions_pass_as_they_are(error: BaseException) -> None:
    with pytest.raises(type(error)) as caught, reading(Path("bag.mcap")):
        raise error
    assert caught.value is error


TOPICS = ("/chatter", "/bumper")


@settings(max_examples=examples(150))
@given(
    st.integers(0, 2**32),
    st.sampled_from([SMALL, McapLayout(chunk_size=400, compression=CompressionType.ZSTD)]),
)
def test_of_a_damaged_file_batches_hold_what_records_do(seed: int, how: McapLayout) -> None:
    messages = [*chatter(12), *(boolean(time, True) for time in range(5, 9))]
    with tempfile.TemporaryDirectory() as folder:
        path = write_mcap(Path(folder) / "a.mcap", messages, how)
        path.write_bytes(damaged(path.read_bytes(), seed))
        records, errors = read_through(McapReader().records(path, TOPICS, EVERYTHING))
        batches, others = read_through(McapReader().batches(path, TOPICS, EVERYTHING))
    # Where indexes lie, the rest is read in the order of the file, up to where that is damaged:
    # messages beyond may have come before by their times.
    if not any(isinstance(error, BagContradictionError) for error in errors):
        found = Counter(each.record(nth) for each in batches for nth in range(each.sizes.size))
        assert found == Counter(records)
    assert bool(errors) == bool(others)


def test_compressed_messages_are_decompressed(tmp_path: Path) -> None:
    plain = [text(time, f"message {time}") for time in range(9)]
    packed = [
        Msg(each.topic, each.type, each.log_time, zstandard.compress(each.payload))
        if each.log_time % 2
        else each
        for each in plain
    ]
    path = write_mcap(tmp_path / "a.mcap", packed, SMALL)
    batches = list(McapReader().batches(path, TOPICS, EVERYTHING))
    found = {
        time: batch.payload(nth)
        for batch in batches
        for nth, time in enumerate(batch.log_times.tolist())
    }
    assert found == {each.log_time: each.payload for each in plain}


def test_no_buffer_has_more_than_its_share_of_small_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(40), SMALL)
    monkeypatch.setattr(bulk, "BATCH_BYTES", 1500)
    batches = list(McapReader().batches(path, TOPICS, EVERYTHING))
    assert len(batches) > 3
    assert max(len(batch.buffer) for batch in batches) <= 1500
    assert [time for batch in batches for time in batch.log_times.tolist()] == list(range(40))


def decoded(type_name: str, payload: bytes, text: str) -> object:
    schema = Schema(type_name, "ros2msg", text.encode())
    return McapReader().decode(Record(Channel("/any", "cdr", schema), 1, 1, payload))


def test_big_endian_messages_are_read() -> None:
    found = decoded("a_msgs/msg/A", bytes(4) + b"\x00\x00\x00\x03hi\x00", "string data")
    assert getattr(found, "data", "") == "hi"


def test_every_cut_of_a_payload_is_undecodable_and_nothing_else() -> None:
    whole = odom(1, 2.0, 3.0)
    for size in range(len(whole.payload)):
        with pytest.raises(UndecodableError):
            decoded(whole.type, whole.payload[:size], definition(whole.type))
    assert decoded(whole.type, whole.payload, definition(whole.type))


def test_a_message_of_a_type_whose_definition_is_empty_names_what_to_set() -> None:
    with pytest.raises(UndecodableError, match=r"reader\.custom_msg_paths"):
        decoded("a_msgs/msg/Lost", text(1, "a text").payload, "")
    assert decoded("a_msgs/msg/Lost", b"\x00\x01\x00\x00\x00", "") is not None


def test_a_place_past_all_that_can_be_counted_is_damage() -> None:
    content = ReadChunks((), bytes(200), [100, 100])
    messages = MessageTable(*np.array([[1], [0], [2**63 - 1], [1]]))
    with pytest.raises(UnreadableError, match="a message is not where its index says"):
        bulk.message_heads(content, messages)

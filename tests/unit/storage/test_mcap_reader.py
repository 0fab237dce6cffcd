"""MCAP files, also unfinished: what is read of them by their indexes, though these are wrong."""

import random
import struct
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from ros2_memory.core.errors import BagContradictionError, BagError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import BagReader, Record
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.fuzz.records import message
from tests.support.bags import VOLATILE, McapLayout, Msg, boolean, text, write_mcap
from tests.support.mcap_surgery import (
    FOOTER,
    SMALL,
    change_index,
    chatter,
    chunks_of,
    edit_summary,
    raw_mcap,
    rewrite_summary,
    spoil_chunk,
)
from tests.support.memories import asked, memory_of
from tests.support.reader_cases import read_through

EVERYTHING = TimeWindow.everything()
STRING = "std_msgs/msg/String"


def read(reader: BagReader, path: Path, *topics: str, **how: Any) -> list[Record]:
    return list(reader.records(path, topics or ("/chatter",), EVERYTHING, **how))


def times(records: list[Record]) -> list[int]:
    return [record.log_time for record in records]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A bag of some small chunks."""
    return write_mcap(tmp_path / "a.mcap", chatter(20), SMALL)


def test_a_summary_needs_no_chunk(path: Path) -> None:
    for number in range(len(chunks_of(path))):
        spoil_chunk(path, number)
    reader = McapReader()
    assert reader.summarize(path).count == 20
    with pytest.raises(BagError, match="does not match its checksum"):
        read(reader, path)


def test_a_chunk_without_the_topic_is_not_read(tmp_path: Path) -> None:
    messages = [*chatter(12), *(boolean(time, True) for time in range(12, 40))]
    path = write_mcap(tmp_path / "a.mcap", messages, SMALL)
    spoil_chunk(path, 0)
    assert times(read(McapReader(), path, "/bumper")) == list(range(12, 40))


def read_on(
    reader: McapReader, path: Path, *, newest_first: bool = False
) -> tuple[list[int], list[str]]:
    """The log times of all messages, and the notes on contradictions on the way."""
    records = reader.records(path, ["/chatter"], EVERYTHING, newest_first=newest_first)
    found, errors = read_through(records)
    return times(found), [error.reason for error in errors]


def test_statistics_that_are_wrong_are_noted_and_not_believed(path: Path) -> None:
    edit_summary(path, Opcode.STATISTICS, lambda body: struct.pack_into("<Q", body, 0, 21))
    reader = McapReader()
    summary = reader.summarize(path)
    assert summary.count == len(read(reader, path)) == 20
    assert all(said in str(summary.notes) for said in ("statistics are wrong", "21 messages"))


@pytest.mark.parametrize(
    ("count", "layout"), [(12, SMALL), (120, McapLayout(chunk_size=5000))], ids=["few", "many"]
)
@pytest.mark.parametrize(
    ("at", "value"),
    [(0, 1), (8, 7), (8, 1 << 40), (8, (1 << 64) - 60)],
    ids=["another time", "another place", "a place outside", "a place before"],
)
def test_a_message_index_that_is_wrong_costs_no_message_and_is_named(
    tmp_path: Path, at: int, value: int, count: int, layout: McapLayout
) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(count), layout)
    wrong = chunks_of(path)[1]
    first = wrong.message_start_time
    change_index(path, wrong, at, first + value if at == 0 else value)
    fault = "a message is not where its index says"
    if at == 0:
        fault = "a chunk states other times than its messages have"
    note = f"damaged: {fault}; its messages were read without its indexes"
    for newest_first in (False, True):
        found = read_on(McapReader(), path, newest_first=newest_first)
        assert found == (sorted(range(count), reverse=newest_first), [note])
    reader = McapReader()
    with pytest.raises(BagContradictionError):
        next(reader.records(path, ["/chatter"], TimeWindow(first, first + 1)))
    # From now on it is known, and no doubt of an answer.
    with pytest.raises(BagError):
        next(reader.records(path, ["/chatter"], EVERYTHING, newest_first=True), None)
    assert read_on(reader, path)[0] == [*range(count)]
    assert any("without its indexes" in note for note in reader.summarize(path).notes)
    memory = memory_of(tmp_path)
    reply = asked(memory, "get_topic_in_range", topic="/chatter", start=0, end=1)
    assert reply["total"] == count
    assert "without its indexes" not in str(reply)
    assert asked(memory, "data_time_range")["notes"][0].endswith(f"a.mcap: {note}")


@pytest.mark.parametrize(
    ("kind", "old", "new"),
    [
        (Opcode.CHANNEL, b"/chatter", b"/chattes"),
        (Opcode.CHANNEL, b"\x01\x00\x01\x00", b"\x01\x00\x02\x00"),  # its schema
        (Opcode.CHANNEL, b"cdr", b"cbr"),
        (Opcode.CHANNEL, b"volatile", b"volatild"),
        (Opcode.SCHEMA, b"msg/String", b"msg/Strinh"),
        (Opcode.SCHEMA, b"ros2msg", b"ros2mso"),
        (Opcode.SCHEMA, b"string data", b"string dada"),
    ],
    ids=count(),
)
@pytest.mark.parametrize("cache_mb", [64, 0])
def test_what_a_summary_section_declares_otherwise_than_the_chunks_is_named(
    tmp_path: Path, kind: Opcode, old: bytes, new: bytes, cache_mb: int
) -> None:
    """Also after the index was let go of, and of a message in another chunk."""
    both = [each for n in range(20) for each in (*chatter(1, start=n), boolean(n, True))]
    path = write_mcap(tmp_path / "a.mcap", both, SMALL)
    (right,) = (each for each in McapReader().channels(path) if each.topic == "/chatter")
    before = path.read_bytes()

    def otherwise(body: bytearray) -> None:
        body[:] = body.replace(old, new, 1)

    edit_summary(path, kind, otherwise)
    assert path.read_bytes() != before
    reader = McapReader(cache_mb=cache_mb)
    summary = reader.summarize(path)
    assert [each.type for each in summary.of("/chatter")] == [STRING]
    reason = (
        "its summary section declares other channels or types than its messages; its messages"
        " were read without its indexes"
    )
    assert summary.notes == (reason,)
    assert read_on(reader, path) == ([*range(20)], [reason])
    records = reader.records(path, ["/chatter"], TimeWindow(15, 20))
    with pytest.raises(BagContradictionError):
        next(records)
    assert next(records).channel == right
    # Where there is nothing else to go by, it is noted all the same.
    data = path.read_bytes()
    path.write_bytes(data[:-60] + bytes((data[-60] ^ 1,)) + data[-59:])
    assert [each.type for each in McapReader().summarize(path).of("/chatter")] == [STRING]


def test_a_chunk_that_neither_indexes_nor_statistics_know_is_not_lost(path: Path) -> None:
    hidden = chunks_of(path)[2]
    left = struct.pack("<Q", 20 - (hidden.message_end_time - hidden.message_start_time + 1))

    def without_it(opcode: int, body: bytes) -> bytes | None:
        if opcode == Opcode.CHUNK_INDEX:
            return None if struct.pack("<Q", hidden.chunk_start_offset) == body[16:24] else body
        if opcode == Opcode.STATISTICS:
            chunks = struct.pack("<I", *(count - 1 for count in struct.unpack("<I", body[22:26])))
            return left + body[8:22] + chunks + body[26:-8] + left
        return body

    rewrite_summary(path, without_it)
    reader = McapReader()
    assert reader.summarize(path).count == 20
    assert times(read(reader, path)) == [*range(20)]
    assert any("all of its chunks" in note for note in reader.summarize(path).notes)


def test_messages_outside_chunks_are_not_lost_beside_chunks(path: Path) -> None:
    data, chunk = path.read_bytes(), chunks_of(path)[-1]
    loose = message(1, 3, text(3, "loose").payload).data
    # Before the data end: behind the last message index, which moves the summary on.
    at = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
    moved = bytearray(data[:at] + loose + data[at:])
    footer_at = len(moved) - 8 - FOOTER.size
    kind, length, start, _, _ = FOOTER.unpack_from(moved, footer_at)
    FOOTER.pack_into(moved, footer_at, kind, length, start + len(loose), 0, 0)
    path.write_bytes(moved)
    edit_summary(path, Opcode.STATISTICS, lambda body: struct.pack_into("<Q", body, 0, 21))
    reader, expected = McapReader(), sorted([*range(20), 3])
    assert reader.summarize(path).count == 21
    assert times(read(reader, path)) == expected
    assert times(read(reader, path, newest_first=True)) == expected[::-1]


@pytest.mark.parametrize(
    ("qos", "latched"),
    [
        ("- durability: 1\n", True),
        ("- durability: transient_local\n", True),
        ("- durability: volatile\n- durability: transient_local\n", True),
        ("- durability: 2\n", False),
        ("- durability: 10\n", False),
        (VOLATILE, False),
        ("", False),
    ],
)
def test_latched_is_what_some_publisher_offered_as_transient_local(
    qos: str, latched: bool, tmp_path: Path
) -> None:
    def fill(writer: Writer) -> None:
        channel = writer.register_channel("/t", "cdr", 0, {"offered_qos_profiles": qos})
        writer.add_message(channel, 1, b"\x00", 1)

    (topic,) = McapReader().summarize(raw_mcap(tmp_path / "a.mcap", fill)).topics
    assert topic.latched is latched


def test_a_channel_whose_metadata_is_not_utf_8_has_its_messages(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(3), McapLayout(chunk_size=None))
    path.write_bytes(path.read_bytes().replace(b"volatile", b"vol\xb8tile")[:-40])
    assert times(read(McapReader(), path)) == [0, 1, 2]
    McapWriter().rewrite(path, tmp_path / "b.mcap")
    assert times(read(McapReader(), tmp_path / "b.mcap")) == [0, 1, 2]


def test_json_is_read_as_what_it_says(tmp_path: Path) -> None:
    payloads = b'{"x": 1.5, "far": NaN, "tags": ["a"]}', b"{not json", b"[" * 100_000

    def fill(writer: Writer) -> None:
        schema = writer.register_schema("Mouse", "jsonschema", b"{}")
        channel = writer.register_channel("mouse", "json", schema)
        for at, payload in enumerate(payloads):
            writer.add_message(channel, at, payload, at)

    reader = McapReader()
    good, *others = read(reader, raw_mcap(tmp_path / "a.mcap", fill), "mouse")
    assert repr(reader.decode(good)) == "{'x': 1.5, 'far': nan, 'tags': ['a']}"
    assert reader.undecodable(good.channel) is None
    for record in others:
        with pytest.raises(UndecodableError, match=r"mouse \(Mouse\): the payload is not JSON"):
            reader.decode(record)


@pytest.mark.parametrize("chunked", [True, False])
def test_times_and_channels_that_cannot_be_are_left_out_and_reported(
    tmp_path: Path, chunked: bool
) -> None:
    def fill(writer: Writer) -> None:
        channel = writer.register_channel("/t", "json", 0)
        for time in (5, 2**63 + 1, 2**64 - 1):
            writer.add_message(channel, time, b"{}", time)
        writer.add_message(99, 2, b"{}", 2)

    path = raw_mcap(tmp_path / "a.mcap", fill, use_chunking=chunked)
    reader = McapReader()
    summary = reader.summarize(path)
    assert (summary.count, summary.start, summary.end) == (1, 5, 5)
    assert "left out: 2 messages without a possible log time" in summary.notes
    assert "left out: 1 message of no declared channel" in summary.notes
    assert times(read(reader, path, "/t")) == [5]


@pytest.mark.parametrize("layout", [McapLayout(), SMALL, McapLayout(chunk_size=None)])
def test_of_uncompressed_files_every_message_that_reached_the_disk_is_read(
    layout: McapLayout, tmp_path: Path
) -> None:
    messages = [text(time, f"{time}", f"/{time % 2}") for time in (3, 1, 2, 5, 4, 0)]
    whole = write_mcap(tmp_path / "whole.mcap", messages, layout).read_bytes()
    ends = sorted(whole.index(m.payload) + len(m.payload) for m in messages)
    path = tmp_path / "cut.mcap"
    reader = McapReader()
    for size in range(8, len(whole) - 8, 19):
        path.write_bytes(whole[:size])
        summary = reader.summarize(path)
        on_disk = sum(end <= size for end in ends)
        assert summary.count == on_disk, size
        assert len(read(reader, path, "/0", "/1")) == on_disk
        assert not reader.is_finished(path)
        path.unlink()


@pytest.mark.parametrize(
    ("layout", "left", "count", "note"),
    [
        # Its record begins 31 bytes before the payload.
        (McapLayout(), lambda whole, third: whole[: third + 10], 2, "the last 41 bytes {}"),
        (McapLayout(), lambda whole, _: whole[:-20], 5, "behind its messages: none is lost"),
        # What a power cut leaves.
        (
            McapLayout(chunk_size=None, finish=False),
            lambda whole, _: whole + bytes(4096),
            5,
            "the last 4096 bytes {}",
        ),
    ],
)
def test_the_note_states_how_much_could_not_be_read(
    tmp_path: Path,
    layout: McapLayout,
    left: Callable[[bytes, int], bytes],
    count: int,
    note: str,
) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(5), layout)
    whole = path.read_bytes()
    path.write_bytes(left(whole, whole.index(chatter(5)[2].payload)))
    summary = McapReader().summarize(path)
    assert (summary.count, summary.complete) == (count, False)
    assert summary.notes[0].startswith("the file ends early")
    assert summary.notes[0].endswith(note.format("could not be read"))


@pytest.mark.parametrize(
    ("layout", "note"),
    [
        (McapLayout(8 << 20, CompressionType.ZSTD), "only a part could be read"),
        (McapLayout(8 << 20, CompressionType.LZ4), "only a part could be read"),
        (McapLayout(50_000), "its compressed file ends early"),
    ],
    ids=["zstd", "lz4", "file"],
)
def test_of_a_compressed_chunk_or_file_that_is_cut_what_can_be_decompressed_counts(
    tmp_path: Path, layout: McapLayout, note: str
) -> None:
    messages = [
        Msg("/noise", STRING, time, random.Random(time).randbytes(4000)) for time in range(300)
    ]
    path = write_mcap(tmp_path / "a.mcap", messages, layout)
    whole = path.read_bytes()
    if "file" in note:
        path, whole = tmp_path / "a.mcap.zstd", zstandard.compress(whole)
    path.write_bytes(whole[: len(whole) // 2])
    reader = Rosbag2Reader()
    summary = reader.summarize(path)
    assert not reader.is_finished(path)
    assert 60 < summary.count < 240
    assert not summary.complete
    assert any(note in each for each in summary.notes)
    found = read(reader, path, "/noise")
    assert [r.payload for r in found] == [m.payload for m in messages[: summary.count]]

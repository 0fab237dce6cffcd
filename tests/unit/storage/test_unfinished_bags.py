"""Files whose writer never finished them: killed, out of disk, or without power."""

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from ros2_memory.storage.base import Closing
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, text, write_mcap
from tests.support.mcap_surgery import SMALL, chatter, chunks_of, spoil_chunk
from tests.unit.storage.test_mcap_reader import read, times


@pytest.mark.parametrize("layout", [McapLayout(), SMALL, McapLayout(chunk_size=None)])
def test_of_uncompressed_files_every_message_that_reached_the_disk_is_read(
    layout: McapLayout, tmp_path: Path
) -> None:
    messages = [text(time, f"{time}", f"/{time % 2}") for time in (3, 1, 2, 5, 4, 0)]
    whole = write_mcap(tmp_path / "whole.mcap", messages, layout).read_bytes()
    ends = sorted(whole.index(m.payload) + len(m.payload) for m in messages)
    path = tmp_path / "cut.mcap"
    reader = McapReader()
    for size in range(8, len(whole) - 8, 7):
        path.write_bytes(whole[:size])
        summary = reader.summarize(path)
        on_disk = sum(end <= size for end in ends)
        assert summary.count == on_disk, size
        assert len(read(reader, path, "/0", "/1")) == on_disk
        assert reader.closing(path) is Closing.OPEN
        path.unlink()


@pytest.mark.parametrize(
    ("left", "count", "note"),
    [
        # Its record begins 31 bytes before the payload.
        (lambda whole, third: whole[: third + 10], 2, "the last 41 bytes could not be read"),
        (lambda whole, _: whole[:-20], 5, ", behind its messages: none is lost"),
    ],
)
def test_the_note_states_how_much_could_not_be_read(
    tmp_path: Path, left: Callable[[bytes, int], bytes], count: int, note: str
) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(5))
    whole = path.read_bytes()
    path.write_bytes(left(whole, whole.index(chatter(5)[2].payload)))
    summary = McapReader().summarize(path)
    assert (summary.count, summary.complete) == (count, False)
    assert summary.notes[0].startswith("the file ends early")
    assert summary.notes[0].endswith(note)


def test_zeros_behind_the_last_record_are_what_a_power_cut_leaves(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(5), McapLayout(chunk_size=None, finish=False))
    path.write_bytes(path.read_bytes() + bytes(4096))
    summary = McapReader().summarize(path)
    assert summary.count == 5
    assert summary.notes == ("the file ends early: the last 4096 bytes could not be read",)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_of_a_compressed_chunk_that_is_cut_what_can_be_decompressed_counts(
    compression: CompressionType, tmp_path: Path
) -> None:
    messages = [
        Msg("/noise", "std_msgs/msg/String", time, random.Random(time).randbytes(4000))
        for time in range(300)
    ]
    path = write_mcap(
        tmp_path / "a.mcap", messages, McapLayout(chunk_size=8 << 20, compression=compression)
    )
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    reader = McapReader()
    summary = reader.summarize(path)
    assert 60 < summary.count < 240
    assert not summary.complete
    assert any("only a part could be read" in note for note in summary.notes)
    found = read(reader, path, "/noise")
    assert [r.payload for r in found] == [m.payload for m in messages[: summary.count]]


def test_one_damaged_chunk_of_an_unfinished_file_is_left_out_and_reported(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(20), SMALL)
    lost = chunks_of(path)[1]
    spoil_chunk(path, 1)
    path.write_bytes(path.read_bytes()[:-100])
    reader = McapReader()
    summary = reader.summarize(path)
    kept = set(range(20)) - set(range(lost.message_start_time, lost.message_end_time + 1))
    assert times(read(reader, path)) == sorted(kept)
    assert summary.count == len(kept)
    assert any(note.startswith("left out: 1 damaged record (") for note in summary.notes)

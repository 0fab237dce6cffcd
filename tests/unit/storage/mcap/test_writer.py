import os
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import Channel, Record, Schema
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, odom, text, tf_of, write_mcap
from tests.support.examples import examples
from tests.support.fakes import files_limited_to
from tests.support.reader_cases import LAYOUTS
from tests.support.shared_bags import REAL, needs_real

S = 10**9
T0 = 1_790_000_000 * S
EVERYTHING = TimeWindow.everything()
CHANNEL = Channel("/a", "cdr", Schema("std_msgs/msg/String"))


def messages(count: int = 40) -> list[Msg]:
    times = [T0 + n * S // 10 for n in range(count)]
    return [
        tf_of(T0, "base_link", "laser", (0.1, 0.0, 0.2), topic="/tf_static"),
        *(odom(time, 1.0, 2.0, log_time=time + 70) for time in times),
        *(text(T0 + n * S, f"line {n}") for n in range(3)),
    ]


def contents(path: Path) -> list[Record]:
    reader = McapReader()
    topics = [each.topic for each in reader.summarize(path).topics]
    return list(reader.records(path, topics, EVERYTHING))


def raw_contents(path: Path) -> list[tuple[Any, ...]]:
    """Everything of every message, by the format's own library and in file order."""
    with path.open("rb") as stream:
        return [
            (channel.topic, channel.metadata, schema, replace(message, channel_id=0))
            for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False)
        ]


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_a_copy_keeps_every_message_with_its_times_sequence_and_channel(
    tmp_path: Path, layout: McapLayout
) -> None:
    layout = replace(layout, chunk_size=layout.chunk_size and 2000, profile="ros2")
    source = write_mcap(tmp_path / "a.mcap", messages(), layout)
    target = tmp_path / "b.mcap"
    result = McapWriter().rewrite(source, target)
    complete = write_mcap(tmp_path / "c.mcap", messages())
    assert raw_contents(target) == raw_contents(complete)
    assert (result.messages, result.lost_bytes) == (len(messages()), 0)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(60))
@given(share=st.floats(0.0, 1.0), name=st.sampled_from(["small chunks", "zstd", "unchunked"]))
def test_wherever_a_file_is_cut_what_was_readable_is_in_the_copy(
    tmp_path: Path, share: float, name: str
) -> None:
    layout = replace(LAYOUTS[name], profile="ros2", chunk_size=LAYOUTS[name].chunk_size and 900)
    source, target = write_mcap(tmp_path / "a.mcap", messages(12), layout), tmp_path / "b.mcap"
    os.truncate(source, max(8, round(share * source.stat().st_size)))
    target.unlink(missing_ok=True)
    McapWriter().rewrite(source, target)
    assert contents(target) == contents(source)
    after = McapReader().summarize(target)
    assert (after.complete, after.notes) == (True, ())


def test_metadata_attachments_and_the_profile_are_kept(tmp_path: Path) -> None:
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with source.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="some recorder")
        writer.add_metadata("rosbag2", {"serialized_metadata": "version: 9"})
        writer.add_attachment(1, 2, "map.png", "image/png", b"pixels")
        writer.flush()
    McapWriter().rewrite(source, target)
    with target.open("rb") as stream:
        reader = make_reader(stream)
        [metadata], [attachment] = reader.iter_metadata(), reader.iter_attachments()
        header = reader.get_header()
    assert metadata.metadata == {"serialized_metadata": "version: 9"}
    assert (attachment.name, attachment.data) == ("map.png", b"pixels")
    assert header.profile == "ros2"
    assert header.library.startswith("some recorder")


@needs_real
def test_what_anybody_recorded_is_the_same_afterwards(tmp_path: Path) -> None:
    sources = [path for path in sorted(REAL.rglob("*.mcap")) if path.name != "Dockerfile.mcap"]
    for number, source in enumerate(sources):
        target = tmp_path / f"{number}.mcap"
        McapWriter().rewrite(source, target)
        assert contents(target) == contents(source), source


def test_a_time_that_the_format_cannot_hold_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(BagError):
        McapWriter().write(tmp_path / "b.mcap", [Record(CHANNEL, -1, -1, b"")])
    assert not list(tmp_path.iterdir())


def test_a_disk_that_takes_no_more_is_reported_and_nothing_is_left(tmp_path: Path) -> None:
    noise = random.Random(1)
    records = [Record(CHANNEL, n, n, noise.randbytes(100_000)) for n in range(20)]
    with files_limited_to(500_000), pytest.raises(BagError, match="cannot be written: File"):
        McapWriter().write(tmp_path / "b.mcap", records)
    assert not list(tmp_path.iterdir())


def test_a_copy_has_no_more_chunks_than_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("chunk", "index", "writer"):
        monkeypatch.setattr(f"ros2_memory.storage.mcap.{module}.MAX_CHUNKS", 20)
    lines = [text(T0 + n * S, "x" * 50_000) for n in range(60)]
    source = write_mcap(tmp_path / "a.mcap", lines)
    assert McapWriter().rewrite(source, tmp_path / "b.mcap").messages == 60
    assert not McapWriter().cut(source, tmp_path / "c.mcap", lambda *_: False)
    assert contents(tmp_path / "b.mcap") == contents(tmp_path / "c.mcap") == contents(source)


def test_a_file_of_the_targets_name_is_not_overwritten(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "a.mcap", messages())
    target = tmp_path / "b.mcap"
    target.write_bytes(b"somebody's")
    with pytest.raises(BagError, match="File exists"):
        McapWriter().rewrite(source, target)
    assert target.read_bytes() == b"somebody's"

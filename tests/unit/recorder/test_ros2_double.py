"""What the double of `ros2 bag record` writes, which needs no ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from tests.ros2_double.bag import Bag, Writing
from tests.ros2_double.mcap_file import Layout, McapFile
from tests.ros2_double.metadata import Topic

if TYPE_CHECKING:
    pass

SECOND = 10**9


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["/a", "/b", "/c"]),
            st.binary(max_size=300),
            st.integers(0, 2**63),
            st.integers(0, 2**63),
        ),
        max_size=40,
    ),
    st.sampled_from([None, 64, 1024, 768 * 1024]),
    st.sampled_from([None, 1]),
)
def test_every_message_of_a_file_is_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    written: list[tuple[str, bytes, int, int]],
    chunk_bytes: int | None,
    zstd_level: int | None,
) -> None:
    path = tmp_path_factory.mktemp("file") / "a.mcap"
    file = McapFile(path, Layout(chunk_bytes, zstd_level))
    for topic in ("/a", "/b", "/c"):
        file.declare(topic, "std_msgs/msg/String", "string data\n", {})
    for topic, payload, log_time, publish_time in written:
        file.message(topic, payload, log_time, publish_time)
    file.close()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        read = [
            (channel.topic, message.data, message.log_time, message.publish_time)
            for _, channel, message in reader.iter_messages()
        ]
        summary = reader.get_summary()
    assert sorted(read) == sorted(written)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(written)
    assert {channel.topic for channel in summary.channels.values()} == {"/a", "/b", "/c"}


@given(st.lists(st.integers(0, 4 * SECOND), min_size=1, max_size=30))
def test_a_message_later_than_the_limit_begins_the_next_split(
    tmp_path_factory: pytest.TempPathFactory, gaps: list[int]
) -> None:
    directory = tmp_path_factory.mktemp("bag") / "a"
    how = Writing(directory, Layout(), 3 * SECOND, "jazzy", {}, False, True, {})
    said: list[str] = []
    bag = Bag(how, lambda level, logger, text: said.append(text))
    bag.subscribe(Topic("/a", "no_such_package/msg/Thing", "[]", ""))
    now, start, expected = 10 * SECOND, None, [0]
    for gap in gaps:
        now += gap
        if start is not None and now - start > 3 * SECOND:
            expected.append(0)
            start = None
        start = now if start is None else start
        expected[-1] += 1
        bag.write("/a", b"\0" * 8, now, now)
    bag.close()
    counts = []
    for number in range(len(expected)):
        with (directory / f"a_{number}.mcap").open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        counts.append(summary.statistics.message_count)
        # A type whose definition was not found has an empty schema.
        assert [(schema.encoding, schema.data) for schema in summary.schemas.values()] == [
            ("", b"")
        ]
    assert counts == expected
    assert len(said) == len(expected)
    assert len(list(directory.glob("*.mcap"))) == len(expected)

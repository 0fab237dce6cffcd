"""The parts of the double of `ros2 bag record` that need no ROS: its options and its files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from tests.ros2_double.arguments import DISTROS, RefusedError, options, parser
from tests.ros2_double.bag import Bag, Writing
from tests.ros2_double.mcap_file import Layout, McapFile
from tests.ros2_double.metadata import Topic

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 10**9
COMMON = {
    "--regex",
    "--output",
    "--storage",
    "--max-bag-duration",
    "--max-cache-size",
    "--storage-config-file",
    "--storage-preset-profile",
    "--qos-profile-overrides-path",
    "--compression-mode",
    "--include-hidden-topics",
    "--use-sim-time",
}
SINCE_JAZZY = {"--topics", "--node-name", "--custom-data", "--disable-keyboard-controls"}
SINCE_LYRICAL = {"--repeat-transient-local", "--max-bag-files", "--max-cache-duration"}


@pytest.mark.parametrize(
    ("distro", "has", "lacks"),
    [
        ("humble", COMMON, SINCE_JAZZY | SINCE_LYRICAL),
        ("jazzy", COMMON | SINCE_JAZZY, SINCE_LYRICAL),
        ("kilted", COMMON | SINCE_JAZZY, SINCE_LYRICAL),
        ("lyrical", COMMON | SINCE_JAZZY | SINCE_LYRICAL, set[str]()),
    ],
)
def test_the_help_lists_the_options_of_its_distribution(
    distro: str, has: set[str], lacks: set[str]
) -> None:
    listed = set(parser(distro).format_help().replace("[", " ").replace(",", " ").split())
    assert listed >= has
    assert not listed & lacks


@pytest.mark.parametrize("distro", DISTROS)
def test_an_option_that_the_distribution_lacks_exits_with_2(
    distro: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        options(distro, ["-o", str(tmp_path / "a"), "-e", "/odom", "--no-such-option"])
    assert ended.value.code == 2
    assert "unrecognized arguments: --no-such-option" in capsys.readouterr().err


@pytest.mark.parametrize("distro", ["humble", "jazzy", "kilted"])
def test_topics_may_be_given_by_position(distro: str, tmp_path: Path) -> None:
    given_options = options(distro, ["-o", str(tmp_path / "a"), "/odom", "/tf"])
    assert given_options.topics == ("/odom", "/tf")


def test_lyrical_takes_no_topics_by_position(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        options("lyrical", ["-o", str(tmp_path / "a"), "/odom"])


@pytest.mark.parametrize(
    "asked",
    [
        ["-e", "/odom", "-s", "sqlite3"],
        ["-e", "/odom", "--compression-mode", "message", "--compression-format", "zstd"],
        ["-e", "/odom", "--compression-format", "zstd"],
        ["-e", "/odom", "--max-bag-files", "3"],
        ["-e", "/odom", "--repeat-transient-local", "/tf_static=0"],
        [],
    ],
)
def test_what_the_double_does_not_do_is_refused(asked: list[str], tmp_path: Path) -> None:
    with pytest.raises(RefusedError):
        options("lyrical", ["-o", str(tmp_path / "a"), *asked])


def test_the_storage_config_changes_the_chunks(tmp_path: Path) -> None:
    file = tmp_path / "storage.yaml"
    file.write_text("chunkSize: 16384\ncompression: Zstd\n")
    asked = ["-o", str(tmp_path / "a"), "-e", "/odom", "--storage-config-file", str(file)]
    assert options("jazzy", asked).layout == Layout(chunk_bytes=16384, zstd_level=1)


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

"""The command line of `ros2 bag record`, held against a model of each distribution's options."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pytest
import yaml

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.command import (
    STATISTICS,
    options_in_help,
    record_argv,
    storage_config,
)
from ros2_memory.recorder.process.topics import TopicSelection

TOPICS = TopicSelection(("/odom", "/tf", "/tf_static"))
COMMON = (
    "--max-cache-size",
    "--storage-preset-profile",
    "--compression-mode",
    "--polling-interval",
)
OPTIONAL = ("--disable-keyboard-controls", "--node-name", "--custom-data")
DISTRIBUTIONS = {
    "humble": ("positional", ()),
    "jazzy before 0.26.4": ("positional", OPTIONAL),
    "jazzy": ("both", OPTIONAL),
    "kilted": ("both", OPTIONAL),
    "lyrical": ("--topics", (*OPTIONAL, "--repeat-transient-local", "--max-bag-files")),
    "rolling": ("--topics", (*OPTIONAL, "--repeat-transient-local", "--max-bag-files")),
}


def parser_of(distribution: str) -> argparse.ArgumentParser:
    """The options of a distribution's `ros2 bag record`, as far as they matter here."""
    topics, options = DISTRIBUTIONS[distribution]
    parser = argparse.ArgumentParser(prog="ros2 bag record", exit_on_error=False)
    group = parser.add_mutually_exclusive_group()
    if topics in {"positional", "both"}:
        group.add_argument("topics_positional", nargs="*", default=[])
    if topics in {"--topics", "both"}:
        group.add_argument("--topics", nargs="+", default=[], metavar="Topic")
    parser.add_argument("-o", "--output")
    parser.add_argument("-s", "--storage", choices=["mcap", "sqlite3"])
    parser.add_argument("-e", "--regex", default="")
    parser.add_argument("-d", "--max-bag-duration", type=int, default=0)
    parser.add_argument(
        "--qos-profile-overrides-path", help="unlike --node-name-of-no-distribution"
    )
    parser.add_argument("--storage-config-file")
    parser.add_argument("--include-hidden-topics", action="store_true")
    parser.add_argument("--use-sim-time", action="store_true")
    for name in COMMON:
        parser.add_argument(name)
    for name in options:
        if name == "--disable-keyboard-controls":
            parser.add_argument(name, action="store_true")
        elif name == "--custom-data":
            parser.add_argument(name, nargs="*", metavar="KEY=VALUE")
        elif name == "--repeat-transient-local":
            parser.add_argument(name, nargs="+", default=[], metavar="Topic[=Depth]")
        else:
            parser.add_argument(name)
    return parser


def argv_for(
    known: frozenset[str] = frozenset(),
    *,
    topics: TopicSelection = TOPICS,
    use_sim_time: bool = False,
    repeat_latched: tuple[str, ...] = (),
) -> list[str]:
    return record_argv(
        ros2="/opt/ros/jazzy/bin/ros2",
        directory=Path("/bags/rec_1"),
        topics=topics,
        split_duration_s=10,
        qos_file=Path("/bags/q.yaml"),
        storage_file=Path("/bags/s.yaml"),
        node_name="ros2_memory_rec_1",
        cache_bytes=64 * 2**20,
        min_free_bytes=10**9,
        use_sim_time=use_sim_time,
        repeat_latched=repeat_latched,
        known_options=known,
    )


def test_the_argv_is_this_to_the_letter() -> None:
    assert argv_for() == [
        "/opt/ros/jazzy/bin/ros2",
        "bag",
        "record",
        "-s",
        "mcap",
        "-d",
        "10",
        "-o",
        "/bags/rec_1",
        "-e",
        "^(/odom|/tf|/tf_static)$",
        "--qos-profile-overrides-path",
        "/bags/q.yaml",
        "--storage-config-file",
        "/bags/s.yaml",
    ]


def test_what_a_distribution_knows_is_added_to_the_letter() -> None:
    known = frozenset(
        (*OPTIONAL, "--repeat-transient-local", "--max-cache-size", "--min-free-space")
    )
    added = argv_for(known, use_sim_time=True, repeat_latched=("/tf_static=32", "/map"))
    assert added[: len(argv_for())] == argv_for()
    assert added[len(argv_for()) :] == [
        "--use-sim-time",
        "--max-cache-size",
        "67108864",
        "--min-free-space",
        "1000000000",
        "--disable-keyboard-controls",
        "--node-name",
        "ros2_memory_rec_1",
        "--custom-data",
        "recorded_by=ros2-memory",
        "--repeat-transient-local",
        "/tf_static=32",
        "/map",
    ]


@pytest.mark.parametrize("known", [(), (STATISTICS,)], ids=["plain", "with statistics"])
def test_what_is_excluded_is_recorded_by_no_distribution(known: tuple[str, ...]) -> None:
    argv = argv_for(frozenset(known), topics=TopicSelection(("/a/*",), ("/a/secret",)))
    recorded = re.compile(argv[argv.index("-e") + 1])
    assert recorded.search("/a/speed")
    assert not recorded.search("/a/secret")


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("use_sim_time", [False, True])
def test_every_distribution_understands_it(distribution: str, use_sim_time: bool) -> None:
    parser = parser_of(distribution)
    known = options_in_help(parser.format_help())
    argv = argv_for(known, use_sim_time=use_sim_time, repeat_latched=("/tf_static=32",))
    parsed = vars(parser.parse_args(argv[3:]))
    assert parsed.pop("topics_positional", []) == []
    assert parsed.pop("topics", []) == []
    assert parsed["output"] == "/bags/rec_1"
    assert parsed["storage"] == "mcap"
    assert parsed["regex"] == "^(/odom|/tf|/tf_static)$"
    assert parsed["max_bag_duration"] == 10
    assert parsed["qos_profile_overrides_path"] == "/bags/q.yaml"
    assert parsed["storage_config_file"] == "/bags/s.yaml"
    assert parsed["use_sim_time"] is use_sim_time
    assert parsed.get("node_name", "ros2_memory_rec_1") == "ros2_memory_rec_1"
    assert parsed.get("custom_data", ["recorded_by=ros2-memory"]) == ["recorded_by=ros2-memory"]
    assert parsed.get("repeat_transient_local", ["/tf_static=32"]) == ["/tf_static=32"]


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_the_help_of_every_distribution_lists_its_options(distribution: str) -> None:
    known = options_in_help(parser_of(distribution).format_help())
    wanted = {*OPTIONAL, "--repeat-transient-local"}
    assert known & wanted == wanted & set(DISTRIBUTIONS[distribution][1])
    assert set(COMMON) <= known


def test_an_option_that_only_a_description_mentions_is_not_there() -> None:
    assert "--node-name-of-no-distribution" not in options_in_help(
        parser_of("humble").format_help()
    )


def test_an_installation_without_mcap_is_refused() -> None:
    usage = "usage: ros2 bag record [-h] [-s {sqlite3,my_plugin}]\n\noptions: mcap\n"
    with pytest.raises(RecorderError, match="rosbag2-storage-mcap"):
        options_in_help(usage)
    assert options_in_help("usage: x [-s {mcap,sqlite3}] [--node-name N]") == {"--node-name"}


def test_chunks_are_small_and_compressed() -> None:
    assert yaml.safe_load(storage_config(16384)) == {"chunkSize": 16384, "compression": "Zstd"}

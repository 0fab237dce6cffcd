"""The command line of `ros2 bag record`."""

import re
from pathlib import Path

import pytest

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.command import STATISTICS, options_in_help, record_argv
from ros2_memory.recorder.process.topics import TopicSelection

TOPICS = TopicSelection(("/odom", "/tf", "/tf_static"))
OPTIONAL = ("--disable-keyboard-controls", "--node-name")


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
        use_sim_time=use_sim_time,
        repeat_latched=repeat_latched,
        known_options=known,
    )


def test_the_argv_is_this_to_the_letter_and_then_what_a_distribution_knows() -> None:
    known = frozenset((*OPTIONAL, "--repeat-transient-local", "--max-cache-size"))
    added = argv_for(known, use_sim_time=True, repeat_latched=("/tf_static=32", "/map"))
    assert " ".join(argv_for()) == (
        "/opt/ros/jazzy/bin/ros2 bag record -s mcap -d 10 -o /bags/rec_1 "
        "-e ^(/odom|/tf|/tf_static)$ --qos-profile-overrides-path /bags/q.yaml "
        "--storage-config-file /bags/s.yaml"
    )
    assert " ".join(added).removeprefix(" ".join(argv_for())) == (
        " --use-sim-time --max-cache-size 67108864 --disable-keyboard-controls "
        "--node-name ros2_memory_rec_1 --repeat-transient-local /tf_static=32 /map"
    )


@pytest.mark.parametrize("known", [(), (STATISTICS,)], ids=["plain", "with statistics"])
def test_what_is_excluded_is_recorded_by_no_distribution(known: tuple[str, ...]) -> None:
    argv = argv_for(frozenset(known), topics=TopicSelection(("/a/*",), ("/a/secret",)))
    recorded = re.compile(argv[argv.index("-e") + 1])
    assert recorded.search("/a/speed")
    assert not recorded.search("/a/secret")


def test_an_installation_without_mcap_is_refused() -> None:
    usage = "usage: ros2 bag record [-h] [-s {sqlite3,my_plugin}]\n\noptions: mcap\n"
    with pytest.raises(RecorderError, match="rosbag2-storage-mcap"):
        options_in_help(usage)
    usage = "usage: x [-s {mcap,sqlite3}] [--node-name N]\n\n  --node-name N  like --no-other\n"
    assert options_in_help(usage) == {"--node-name"}

"""Makes the command line of `ros2 bag record`, and its two configuration files. Pure.

Distributions accept different options. Topics are passed in the one form that all of them accept, a
regular expression; an option that only some have is used only if the help lists it.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import yaml

from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from ros2_memory.recorder.process.topics import TopicSelection


HELP_ARGV: Final = ("bag", "record", "--help")
KEYBOARD: Final = "--disable-keyboard-controls"
NODE_NAME: Final = "--node-name"
REPEAT: Final = "--repeat-transient-local"
SERVICES: Final = "--services"
CACHE: Final = "--max-cache-size"
STATISTICS: Final = "--stats_max_publishing_rate"
MESSAGES_LOST: Final = "/events/rosbag2_messages_lost"
"""The topic of lost messages, of distributions with `STATISTICS`; it is recorded, too."""

_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9_-]*")
_STORAGES = re.compile(r"-s \{([^}]*)\}|--storage \{([^}]*)\}")


def record_argv(
    *,
    ros2: str,
    directory: Path,
    topics: TopicSelection,
    split_duration_s: int,
    qos_file: Path,
    storage_file: Path,
    node_name: str,
    cache_bytes: int,
    use_sim_time: bool = False,
    repeat_latched: Sequence[str] = (),
    known_options: Collection[str],
) -> list[str]:
    """Returns the argv of one recording.

    Args:
        ros2: the program.
        directory: where to record, absolute; it must not exist yet.
        topics: the topics to record.
        split_duration_s: length of one bag file in whole seconds.
        qos_file: QoS overrides, see `Reception` in `reception.py`.
        storage_file: how MCAP is written, see `storage_config`.
        node_name: the name of the recorder's node, if the distribution can set it.
        cache_bytes: the size of each of the two buffers in which messages wait for the disk; a
            machine may not have rosbag2's own 100 MiB beside two recorders' queues.
        use_sim_time: whether log times come from `/clock`, before which nothing is recorded.
        repeat_latched: topics, as `topic` or `topic=depth`, whose last messages begin every split
            if the distribution can do that.
        known_options: the options that this distribution has, see `options_in_help`.
    """
    argv = [ros2, "bag", "record", "-s", "mcap", "-d", str(split_duration_s), "-o", str(directory)]
    if STATISTICS in known_options:
        topics = replace(topics, entries=(*topics.entries, MESSAGES_LOST))
    argv += ["-e", topics.regex]
    argv += ["--qos-profile-overrides-path", str(qos_file)]
    argv += ["--storage-config-file", str(storage_file)]
    if topics.hidden:
        argv.append("--include-hidden-topics")
    if use_sim_time:
        argv.append("--use-sim-time")
    optional: dict[str, Sequence[str | int] | None] = {
        CACHE: [cache_bytes],
        # At most one message a second; without a rate statistics may be switched off.
        STATISTICS: [1],
        KEYBOARD: [],
        NODE_NAME: [node_name],
        REPEAT: repeat_latched or None,
    }
    for name, values in optional.items():
        if name in known_options and values is not None:
            argv += [name, *map(str, values)]
    return argv


def options_in_help(text: str) -> frozenset[str]:
    """Returns the long options in the help of `ros2 bag record`.

    Only its usage counts: the descriptions below also mention options of other distributions.

    Raises:
        RecorderError: this installation cannot write MCAP.
    """
    usage = text.partition("usage:")[2].partition("\n\n")[0]
    storages = _STORAGES.search(usage)
    if storages is not None and "mcap" not in re.split(r"[\s,]+", storages[1] or storages[2]):
        raise RecorderError(
            "this ROS 2 installation cannot write MCAP; "
            "install the package ros-$ROS_DISTRO-rosbag2-storage-mcap"
        )
    return frozenset(_OPTION.findall(usage))


def storage_config(chunk_bytes: int) -> str:
    """Returns YAML for `--storage-config-file`: zstd, in chunks of `chunk_bytes` uncompressed.

    A chunk that is not full is lost with the process, so its size bounds the loss (README of the
    ROS package rosbag2_storage_mcap). By default rosbag2 writes no CRC of a chunk: nothing would
    show a bit that flips on the disk.
    """
    how = {"chunkSize": chunk_bytes, "compression": "Zstd", "noChunkCRC": False}
    return yaml.safe_dump(how, sort_keys=True)

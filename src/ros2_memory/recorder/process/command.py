"""The command line of `ros2 bag record`, and the two files that it is given. Pure.

Distributions differ in what they take. Topics are given in the one form that all of them take, a
regular expression; an option that only some know is used only where the help lists it.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import yaml

from ros2_memory.bag_dir.own_recordings import BAG_DIR_ID, PROGRAM, RECORDED_BY
from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence
    from pathlib import Path

    from ros2_memory.recorder.process.topics import TopicSelection

HELP_ARGV: Final = ("bag", "record", "--help")
KEYBOARD: Final = "--disable-keyboard-controls"
NODE_NAME: Final = "--node-name"
REPEAT: Final = "--repeat-transient-local"
CUSTOM_DATA: Final = "--custom-data"

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
    use_sim_time: bool = False,
    repeat_latched: Sequence[str] = (),
    bag_dir_id: str | None = None,
    known_options: Collection[str] = (),
) -> list[str]:
    """The argv of one recording.

    Args:
        ros2: the program.
        directory: where the recording is to lie, absolute; it must not exist yet.
        topics: what is recorded.
        split_duration_s: length of one bag file in whole seconds.
        qos_file: QoS overrides, see `qos_overrides`.
        storage_file: how MCAP is written, see `storage_config`.
        node_name: what the recorder's node is called, where that can be said.
        use_sim_time: whether log times come from `/clock`, before which nothing is recorded.
        repeat_latched: `topic` or `topic=depth`, whose last messages begin every split, where the
            distribution can do that.
        bag_dir_id: what the files carry, besides who recorded them, where that can be said.
        known_options: the options that this distribution has, see `options_in_help`.
    """
    argv = [ros2, "bag", "record", "-s", "mcap", "-d", str(split_duration_s), "-o", str(directory)]
    argv += ["-e", topics.regex]
    argv += ["--qos-profile-overrides-path", str(qos_file)]
    argv += ["--storage-config-file", str(storage_file)]
    if topics.hidden:
        argv.append("--include-hidden-topics")
    if use_sim_time:
        argv.append("--use-sim-time")
    if KEYBOARD in known_options:
        argv.append(KEYBOARD)
    if NODE_NAME in known_options:
        argv += [NODE_NAME, node_name]
    if CUSTOM_DATA in known_options:
        argv += [CUSTOM_DATA, f"{RECORDED_BY}={PROGRAM}"]
        argv += [] if bag_dir_id is None else [f"{BAG_DIR_ID}={bag_dir_id}"]
    if REPEAT in known_options and repeat_latched:
        argv += [REPEAT, *repeat_latched]
    return argv


def options_in_help(text: str) -> frozenset[str]:
    """The long options that the help of `ros2 bag record` lists.

    Only its usage counts: the descriptions below mention options too, of other distributions even.

    Raises:
        RecorderError: the help says that MCAP cannot be written.
    """
    usage = _usage(text)
    storages = _STORAGES.search(usage)
    if storages is not None and "mcap" not in re.split(r"[\s,]+", storages[1] or storages[2]):
        raise RecorderError(
            "this ROS 2 installation cannot write MCAP; "
            "install the package ros-$ROS_DISTRO-rosbag2-storage-mcap"
        )
    return frozenset(_OPTION.findall(usage))


def qos_overrides(latched: Iterable[str]) -> str:
    """YAML for `--qos-profile-overrides-path`: every message of these topics, however many.

    The recorder's default depth of 10 loses messages where many broadcasters publish at once. For
    a topic whose publishers are not latched this would record nothing: only name those that are.
    """
    profile = {"history": "keep_all", "reliability": "reliable", "durability": "transient_local"}
    return yaml.safe_dump({topic: dict(profile) for topic in latched}, sort_keys=True)


def storage_config(chunk_bytes: int) -> str:
    """YAML for `--storage-config-file`: zstd, in chunks of so many bytes before compression.

    What is in a chunk that is not full yet is lost with the process, so the size is what bounds
    the loss (README of the ROS package rosbag2_storage_mcap).
    """
    return yaml.safe_dump({"chunkSize": chunk_bytes, "compression": "Zstd"}, sort_keys=True)


def _usage(text: str) -> str:
    """The first paragraph that begins with "usage:"; nothing where there is none."""
    begin = text.find("usage:")
    return "" if begin < 0 else text[begin:].split("\n\n", 1)[0]

"""The options of `ros2 bag record`, as far as the recorder asks for them: those of Jazzy."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from tests.ros2_double.mcap_file import Layout

# What its help lists besides; to use them is refused.
_NOT_DONE: Final[dict[str, str | int | None]] = {
    "--topics": "+",
    "-a, --all": 0,
    "--services": "+",
    "--topic-types": "+",
    "--all-topics": 0,
    "--all-services": 0,
    "--exclude-regex": None,
    "--exclude-topic-types": "+",
    "--exclude-topics": "+",
    "--exclude-services": "+",
    "--include-unpublished-topics": 0,
    "--no-discovery": 0,
    "-p, --polling-interval": None,
    "--ignore-leaf-topics": 0,
    "-f, --serialization-format": None,
    "-b, --max-bag-size": None,
    "--start-paused": 0,
    "--snapshot-mode": 0,
    "--log-level": None,
    "--storage-preset-profile": None,
    "--compression-mode": None,
    "--compression-format": None,
    "--compression-queue-size": None,
    "--compression-threads": None,
    "--compression-threads-priority": None,
}


class RefusedError(Exception):
    """What was asked for is refused with this sentence."""


@dataclass(frozen=True)
class Options:
    """What was asked for."""

    output: Path
    regex: str
    duration_s: int
    layout: Layout
    overrides: dict[str, dict[str, Any]]
    include_hidden: bool
    use_sim_time: bool
    node_name: str
    custom: dict[str, str]
    keyboard: bool


class _Refused(argparse.Action):
    """Refuses the option."""

    def __call__(self, _parser: object, _given: object, _values: object, name: object = "") -> None:
        raise RefusedError(f"the double does not do {name}")


def parser() -> argparse.ArgumentParser:
    """The options that the double knows."""
    model = argparse.ArgumentParser(
        prog="ros2 bag record",
        description="Test double of `ros2 bag record`, ROS 2 Jazzy.",
        allow_abbrev=False,
    )
    add = model.add_argument
    add("-e", "--regex", required=True, help="Record only topics that contain a match.")
    add("-o", "--output", type=Path, required=True, help="Directory to create.")
    add("-s", "--storage", required=True, choices=("mcap",))
    add("-d", "--max-bag-duration", type=int, default=0, help="Seconds after which to split.")
    add("--max-cache-size", type=int)
    add("--storage-config-file", type=_file, help="YAML with options of the MCAP writer.")
    add("--qos-profile-overrides-path", type=_file, help="YAML with QoS profiles by topic.")
    add("--include-hidden-topics", action="store_true")
    add("--use-sim-time", action="store_true", help="Times are those of /clock.")
    add("--node-name", default="rosbag2_recorder")
    add("--custom-data", nargs="*", default=[], metavar="KEY=VALUE")
    add("--disable-keyboard-controls", action="store_true")
    for names, count in _NOT_DONE.items():
        add(*names.split(", "), nargs=count, action=_Refused, help="The double refuses it.")
    return model


def options(argv: list[str]) -> Options:
    """Parses the arguments behind `ros2 bag record`; exits 2 on those that are not known.

    Raises:
        RefusedError: as the real recorder does, or for what the double does not do.
    """
    given = vars(parser().parse_args(argv))
    if given["output"].is_dir():
        raise RefusedError(f"Output folder '{given['output']}' already exists.")
    return Options(
        output=given["output"],
        regex=given["regex"],
        duration_s=given["max_bag_duration"],
        layout=_layout(_yaml(given["storage_config_file"])),
        overrides=_yaml(given["qos_profile_overrides_path"]),
        include_hidden=given["include_hidden_topics"],
        use_sim_time=given["use_sim_time"],
        node_name=given["node_name"],
        custom={
            key: value for key, _, value in (text.partition("=") for text in given["custom_data"])
        },
        keyboard=not given["disable_keyboard_controls"],
    )


def _file(name: str) -> Path:
    if not Path(name).is_file():
        raise argparse.ArgumentTypeError(f"can't open '{name}'")
    return Path(name)


def _yaml(file: Path | None) -> dict[str, Any]:
    return {} if file is None else yaml.safe_load(file.read_text("utf-8")) or {}


def _layout(given: dict[str, Any]) -> Layout:
    compression = given.get("compression", "None")
    known = {"chunkSize", "compression", "noChunkCRC"}
    if given.keys() - known or compression not in {"None", "Zstd"}:
        raise RefusedError(f"the double does not write MCAP by {given}")
    chunk_bytes, has_crc = (
        given.get("chunkSize", Layout.chunk_bytes),
        not given.get("noChunkCRC", True),
    )
    return Layout(chunk_bytes, compression == "Zstd", has_crc)

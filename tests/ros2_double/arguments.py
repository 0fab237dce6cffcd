"""The options of `ros2 bag record`, as far as the double has them: those of Jazzy."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from tests.ros2_double.mcap_file import Layout

# What its help lists besides; to use them is refused.
_NOT_DONE: Final[dict[str, str | int | None]] = {
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
    "--compression-queue-size": None,
    "--compression-threads": None,
    "--compression-threads-priority": None,
}
_LEVELS: Final = {"Fastest": -5, "Fast": -3, "Default": 1, "Slow": 5, "Slowest": 19}
_PRESETS: Final = {
    "none": Layout(),
    "fastwrite": Layout(chunk_bytes=None, summary_crc=False),
    "zstd_fast": Layout(zstd_level=_LEVELS["Fastest"]),
    "zstd_small": Layout(zstd_level=_LEVELS["Slowest"], chunk_bytes=4 * 1024 * 1024),
}


class RefusedError(Exception):
    """What was asked for is refused with this sentence."""


@dataclass(frozen=True)
class Options:
    """What was asked for."""

    output: Path
    topics: tuple[str, ...]
    regex: str
    duration_s: int
    layout: Layout
    cached: bool
    overrides: dict[str, dict[str, Any]]
    compress_files: bool
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
    add("positional_topics", nargs="*", default=[], metavar="topics", help="Topics to record.")
    add("--topics", nargs="+", default=[], metavar="Topic", help="Topics to record.")
    add("-a", "--all", action="store_true", help="Record all topics.")
    add("-e", "--regex", default="", help="Record only topics that contain a match.")
    add("-o", "--output", help="Directory to create; it must not exist.")
    add("-s", "--storage", default="mcap", choices=("mcap", "sqlite3"))
    add("-d", "--max-bag-duration", type=int, default=0, help="Seconds after which to split.")
    add("--max-cache-size", type=int, default=100 * 1024 * 1024, help="0: write directly.")
    add("--storage-preset-profile", default="none", choices=tuple(_PRESETS))
    add("--storage-config-file", type=_file, help="YAML with options of the MCAP writer.")
    add("--qos-profile-overrides-path", type=_file, help="YAML with QoS profiles by topic.")
    add("--compression-mode", default="none", choices=("none", "file", "message"))
    add("--compression-format", default="", choices=("", "zstd"))
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
    topics = (*given["topics"], *given["positional_topics"])
    regex = ".*" if given["all"] else given["regex"]
    if not topics and not regex:
        raise RefusedError("Need to specify at least one option out of --all, topics or --regex")
    if given["output"] is None:
        raise RefusedError("the double needs --output")
    output = Path(given["output"])
    if output.is_dir():
        raise RefusedError(f"Output folder '{output}' already exists.")
    if bool(given["compression_format"]) != (given["compression_mode"] != "none"):
        raise RefusedError("Compression needs both a mode and a format.")
    if given["storage"] != "mcap":
        raise RefusedError(f"the double does not do --storage {given['storage']}")
    if given["compression_mode"] == "message":
        raise RefusedError("MCAP storage plugin does not support message compression")
    return Options(
        output=output,
        topics=topics,
        regex=regex,
        duration_s=given["max_bag_duration"],
        layout=_layout(given["storage_preset_profile"], given["storage_config_file"]),
        cached=given["max_cache_size"] > 0,
        overrides=_yaml(given["qos_profile_overrides_path"]),
        compress_files=given["compression_mode"] == "file",
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


def _layout(preset: str, file: Path | None) -> Layout:
    base, given = _PRESETS[preset], _yaml(file)
    if unknown := given.keys() - {"chunkSize", "compression", "compressionLevel", "noChunking"}:
        raise RefusedError(f"the double knows no MCAP writer option {sorted(unknown)}")
    compression = given.get("compression", "None" if base.zstd_level is None else "Zstd")
    level = given.get("compressionLevel", "Default")
    if compression not in {"None", "Zstd"} or level not in _LEVELS:
        raise RefusedError(f"yaml-cpp: bad conversion: {compression} {level}")
    zstd_level = base.zstd_level if base.zstd_level is not None else _LEVELS[level]
    chunk_bytes: int | None = given.get("chunkSize", base.chunk_bytes)
    unchunked: bool = given.get("noChunking", base.chunk_bytes is None)
    return Layout(
        chunk_bytes=None if unchunked else chunk_bytes,
        zstd_level=zstd_level if compression == "Zstd" else None,
        summary_crc=base.summary_crc,
    )

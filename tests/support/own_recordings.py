"""Recordings that count as the recorder's own, and files that carry what its child embeds."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from mcap.writer import Writer

from ros2_memory.bag_dir.directory_identity import identity_of
from ros2_memory.bag_dir.layout import LIST_FILE
from ros2_memory.bag_dir.own_recordings import OwnRecordings, folders_with_bags

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

S = 10**9
OURS = {"recorded_by": "ros2-memory"}


def own_all(bag_dir: Path) -> OwnRecordings:
    """Lists every directory that holds bags now."""
    own = OwnRecordings(bag_dir)
    found = {own.name_of(path): identity_of(path) for path in folders_with_bags(bag_dir)}
    own.adopt({name: identity for name, identity in found.items() if name and identity})
    return own


def lines(bag_dir: Path) -> list[dict[str, Any]]:
    """What the list says, line by line."""
    return [json.loads(line) for line in (bag_dir / LIST_FILE).read_text().splitlines()]


def embedding(
    path: Path, custom: Mapping[str, str] | None, *, start: int = 1_790_000_000 * S, size: int = 20
) -> Path:
    """A split as rosbag2 writes it since Iron: its metadata right behind the header."""
    listed = "\n".join(f"  {key}: {value}" for key, value in (custom or {}).items())
    said = f"custom_data:\n{listed}" if custom else "custom_data: ~"
    text = (
        "version: 9\nstorage_identifier: mcap\nrelative_file_paths:\n"
        f"  - {path.name}\n{said}\nros_distro: jazzy\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=400)
        writer.start("ros2", "libmcap 1.3.0")
        if custom is not None:
            writer.add_metadata("rosbag2", {"serialized_metadata": text})
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/chatter", "cdr", schema, {})
        for number in range(size):
            at = start + number * S // 4
            writer.add_message(channel, at, b"\0\1\0\0\2\0\0\0x\0", at, number)
        writer.finish()
    return path

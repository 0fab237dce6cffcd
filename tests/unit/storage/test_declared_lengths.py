"""What bags declare stays in memory as long as they exist, so it is bounded by its length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from mcap.writer import CompressionType, Writer

from ros2_memory.core.errors import BagError
from ros2_memory.storage.errors import MAX_DEFINITION_BYTES, MAX_NAMES_CHARS
from ros2_memory.storage.mcap_reader import McapReader

if TYPE_CHECKING:
    from pathlib import Path

LONG = 3 << 20
TOO_LONG = "a" * MAX_NAMES_CHARS


def bag(path: Path, topic: str = "/a", type_name: str = "a/msg/B", comment: int = 0) -> Path:
    """A bag whose declarations are, compressed to nearly nothing, in its chunk alone."""
    with path.open("wb") as out:
        writer = Writer(
            out,
            compression=CompressionType.ZSTD,
            repeat_schemas=False,
            repeat_channels=False,
            use_statistics=False,
            use_summary_offsets=False,
        )
        writer.start("ros2", library="test")
        text = b"#" * comment + b"\nuint8 data\n"
        schema = writer.register_schema(type_name, "ros2msg", text)
        channel = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channel, 10**18, b"\0\1\0\0\1", 10**18)
        writer.finish()
    assert path.stat().st_size < 10_000
    return path


@pytest.mark.parametrize(
    ("topic", "type_name"), [("/" + TOO_LONG, "a/msg/B"), ("/a", TOO_LONG)], ids=["topic", "type"]
)
def test_names_longer_than_any_are_refused(tmp_path: Path, topic: str, type_name: str) -> None:
    path = bag(tmp_path / "a.mcap", topic, type_name)
    with pytest.raises(BagError, match="longer names"):
        McapReader().summarize(path)


def test_of_a_definition_larger_than_any_no_more_is_kept_than_shows_it(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", comment=LONG)
    reader = McapReader()
    [channel] = reader.channels(path)
    assert len(channel.schema.text) == MAX_DEFINITION_BYTES + 1
    assert "larger than" in (reader.undecodable(channel) or "")

"""Writes recordings as `ros2 bag record` leaves them: MCAP splits, many thousands in minutes.

Zstd chunks with a message index for each channel, publishers' QoS on every channel, every channel
in every split's summary, and, as rosbag2 does it, all earlier splits of the recording described in
each; `metadata.yaml` closes a recording.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from itertools import starmap
from textwrap import indent
from typing import TYPE_CHECKING, Final, NamedTuple

from mcap.writer import CompressionType, Writer

from benchmarks import payloads

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

QOS: Final = """\
- history: unknown
  depth: 0
  reliability: reliable
  durability: {durability}
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""
"""What rosbag2 records of a publisher's quality of service."""
_LEFT: Final = 0.6
"""The part of a split that reaches the disk before the power fails."""


class Topic(NamedTuple):
    """A topic of a recording; its durability is that of its publishers' QoS."""

    name: str
    type: str
    durability: str = "volatile"


class Row(NamedTuple):
    """A message: log and publish time in nanoseconds, the number of its topic, its CDR."""

    log_time: int
    publish_time: int
    topic: int
    payload: bytes


class Split(NamedTuple):
    """A bag file that was written: first and last log time, messages of each topic."""

    path: Path
    start: int
    stop: int
    counts: tuple[int, ...]


@dataclass
class Recording:
    """A folder of splits that are written one after the other; it is made."""

    folder: Path
    topics: Sequence[Topic]
    chunk_bytes: int = 16 * 1024
    splits: list[Split] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True)

    def write(self, rows: Sequence[Row]) -> None:
        """Writes the next split; rows are in order of log time, at least one."""
        path = self.folder / f"{self.folder.name}_{len(self.splits)}.mcap"
        counts = [0] * len(self.topics)
        for row in rows:
            counts[row.topic] += 1
        split = Split(path, rows[0].log_time, rows[-1].log_time, tuple(counts))
        self.splits.append(split)
        path.write_bytes(self._mcap(rows))
        # A bag that was closed long ago, as most bags of a history were.
        os.utime(path, ns=(split.stop, split.stop))

    def close(self) -> None:
        """Ends the recording as on SIGINT."""
        text = indent(metadata(self.splits, self.topics), "  ")
        text = f"rosbag2_bagfile_information:\n{text}\n"
        (self.folder / "metadata.yaml").write_text(text, encoding="utf-8")

    def cut(self) -> None:
        """Ends the recording as when the power fails: within a chunk, without a summary."""
        last = self.splits[-1]
        os.truncate(last.path, int(last.path.stat().st_size * _LEFT))
        os.utime(last.path, ns=(last.stop, last.stop))

    def _mcap(self, rows: Sequence[Row]) -> bytes:
        file = BytesIO()
        writer = Writer(file, self.chunk_bytes, CompressionType.ZSTD, enable_crcs=False)
        writer.start("ros2", "ros2-memory benchmark")
        schemas = {
            each: writer.register_schema(each, "ros2msg", definition(each).encode())
            for each in dict.fromkeys(topic.type for topic in self.topics)
        }
        channels = [
            writer.register_channel(
                topic.name,
                "cdr",
                schemas[topic.type],
                {"offered_qos_profiles": QOS.format(durability=topic.durability)},
            )
            for topic in self.topics
        ]
        for number, (log_time, publish_time, topic, payload) in enumerate(rows):
            writer.add_message(channels[topic], log_time, payload, publish_time, number)
        writer.add_metadata("rosbag2", {"serialized_metadata": metadata(self.splits, ())[:-1]})
        writer.finish()
        return file.getvalue()


def metadata(splits: Sequence[Split], topics: Sequence[Topic]) -> str:
    """What rosbag2 tells of a recording (its metadata, version 9) when it has these splits."""
    first, last = splits[0].start, max(split.stop for split in splits)
    counts = [sum(each) for each in zip(*(split.counts for split in splits), strict=True)]
    listed = "\n".join(starmap(_topic_told, zip(topics, counts, strict=False)))
    return (
        "version: 9\nstorage_identifier: mcap\n"
        f"duration:\n  nanoseconds: {last - first}\n"
        f"starting_time:\n  nanoseconds_since_epoch: {first}\n"
        f"message_count: {sum(counts)}\n"
        f"topics_with_message_count:{chr(10) + listed if listed else ' []'}\n"
        'compression_format: ""\ncompression_mode: ""\nrelative_file_paths:\n'
        + "".join(f"  - {split.path.name}\n" for split in splits)
        + "files:\n"
        + "".join(map(_split_told, splits))
        + "custom_data: ~\nros_distro: jazzy\n"
    )


def _topic_told(topic: Topic, messages: int) -> str:
    return (
        f"  - topic_metadata:\n      name: {topic.name}\n      type: {topic.type}\n"
        "      serialization_format: cdr\n      offered_qos_profiles:\n"
        + indent(QOS.format(durability=topic.durability), " " * 8)
        + f'\n      type_description_hash: ""\n    message_count: {messages}'
    )


@cache
def _split_told(split: Split) -> str:
    return (
        f"  - path: {split.path.name}\n    starting_time:\n"
        f"      nanoseconds_since_epoch: {split.start}\n    duration:\n"
        f"      nanoseconds: {split.stop - split.start}\n    message_count: {sum(split.counts)}\n"
    )


@cache
def definition(type_name: str) -> str:
    """A type's definition with all that it contains, as bags have it."""
    return payloads.typestore().generate_msgdef(type_name, ros_version=2)[0]

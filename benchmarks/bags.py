"""Writes recordings as `ros2 bag record` leaves them: MCAP splits, many thousands in minutes.

Zstd chunks with a message index for each channel, publishers' QoS on every channel, every channel
in every split's summary, and, as rosbag2 does it, all earlier splits of the recording described in
each; `metadata.yaml` closes a recording. Record layouts: the MCAP specification.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass, field
from functools import cache
from itertools import starmap
from textwrap import indent
from typing import TYPE_CHECKING, Final, NamedTuple

import zstandard

from benchmarks import payloads

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
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
_MAGIC: Final = b"\x89MCAP0\r\n"
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_ENTRY: Final = struct.Struct("<QQ")
_ZSTD: Final = struct.pack("<I4s", 4, b"zstd")
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


class _Chunk(NamedTuple):
    """What the summary says of a chunk that lies in the file."""

    times: tuple[int, int]
    at: int
    length: int
    indexes: Mapping[int, int]
    indexes_length: int
    packed: int
    unpacked: int


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
        path.write_bytes(self._file(rows, split))
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

    def _file(self, rows: Sequence[Row], split: Split) -> bytes:
        data = bytearray(_MAGIC)
        data += _record(0x01, _text("ros2") + _text("ros2-memory benchmark"))
        chunks = list(self._chunks(rows, data))
        metadata_at = len(data)
        told = _text(metadata(self.splits, ())[:-1])
        pairs = _text("serialized_metadata") + told
        data += _record(0x0C, _text("rosbag2") + struct.pack("<I", len(pairs)) + pairs)
        metadata_length = len(data) - metadata_at
        data += _record(0x0F, bytes(4))
        groups = (
            (0x03, b"".join(_schema(*each) for each in _schemas(self.topics))),
            (0x04, b"".join(_channel(each, self.topics) for each in range(len(self.topics)))),
            (0x0B, _statistics(split, len(chunks), self.topics)),
            (0x08, b"".join(map(_chunk_index, chunks))),
            (0x0D, _record(0x0D, _ENTRY.pack(metadata_at, metadata_length) + _text("rosbag2"))),
        )
        summary_at, offsets = len(data), b""
        for opcode, group in groups:
            offsets += _record(0x0E, struct.pack("<BQQ", opcode, len(data), len(group)))
            data += group
        offsets_at = len(data)
        data += offsets + _record(0x02, struct.pack("<QQI", summary_at, offsets_at, 0)) + _MAGIC
        return bytes(data)

    def _chunks(self, rows: Sequence[Row], data: bytearray) -> Iterable[_Chunk]:
        """Appends the chunks to a file's bytes. A chunk ends with the message that fills it."""
        packer = zstandard.ZstdCompressor(level=1)
        parts: list[bytes] = []
        entries: dict[int, list[bytes]] = {}
        size, begin, known = 0, rows[0].log_time, set[int]()
        for number, (log_time, publish_time, topic, payload) in enumerate(rows):
            if topic not in known:
                known.add(topic)
                schema = next(
                    each for each in _schemas(self.topics) if self.topics[topic].type == each[1]
                )
                parts.append(_schema(*schema) + _channel(topic, self.topics))
                size += len(parts[-1])
            entries.setdefault(topic, []).append(_ENTRY.pack(log_time, size))
            length = _MESSAGE.size - 9 + len(payload)
            parts.append(_MESSAGE.pack(0x05, length, topic + 1, number, log_time, publish_time))
            parts.append(payload)
            size += 9 + length
            if size < self.chunk_bytes and number < len(rows) - 1:
                continue
            times, at = (begin, log_time), len(data)
            packed = packer.compress(b"".join(parts))
            data += _record(
                0x06,
                struct.pack("<QQQI", *times, size, 0)
                + _ZSTD
                + struct.pack("<Q", len(packed))
                + packed,
            )
            length, indexes = len(data) - at, {}
            for channel, found in entries.items():
                indexes[channel + 1] = len(data)
                index = b"".join(found)
                data += _record(0x07, struct.pack("<HI", channel + 1, len(index)) + index)
            yield _Chunk(times, at, length, indexes, len(data) - at - length, len(packed), size)
            parts, entries, size = [], {}, 0
            begin = rows[number + 1].log_time if number < len(rows) - 1 else log_time


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


def _schemas(topics: Sequence[Topic]) -> list[tuple[int, str]]:
    return list(enumerate(dict.fromkeys(topic.type for topic in topics), 1))


@cache
def _schema(number: int, type_name: str) -> bytes:
    text = _text(type_name) + _text("ros2msg") + _text(definition(type_name))
    return _record(0x03, struct.pack("<H", number) + text)


def _channel(number: int, topics: Sequence[Topic]) -> bytes:
    topic = topics[number]
    schema = next(at for at, name in _schemas(topics) if name == topic.type)
    qos = _text("offered_qos_profiles") + _text(QOS.format(durability=topic.durability))
    text = _text(topic.name) + _text("cdr") + struct.pack("<I", len(qos)) + qos
    return _record(0x04, struct.pack("<HH", number + 1, schema) + text)


def _statistics(split: Split, chunks: int, topics: Sequence[Topic]) -> bytes:
    counts = b"".join(struct.pack("<HQ", at, n) for at, n in enumerate(split.counts, 1) if n)
    head = struct.pack(
        "<QHIIIIQQI",
        sum(split.counts),
        len(_schemas(topics)),
        len(topics),
        0,
        1,
        chunks,
        split.start,
        split.stop,
        len(counts),
    )
    return _record(0x0B, head + counts)


def _chunk_index(chunk: _Chunk) -> bytes:
    indexes = b"".join(struct.pack("<HQ", *each) for each in chunk.indexes.items())
    head = struct.pack("<QQQQI", *chunk.times, chunk.at, chunk.length, len(indexes))
    sizes = struct.pack("<Q", chunk.indexes_length) + _ZSTD
    return _record(0x08, head + indexes + sizes + _ENTRY.pack(chunk.packed, chunk.unpacked))


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data

"""Writes the bags of a world, as `ros2 bag record` would have left them.

Recordings of ten splits, zstd chunks of 16 KiB, publishers' QoS on every channel and every channel
in every split, `/tf_static` once in each; `metadata.yaml` closes a recording, unless the power
failed: then its last split ends in the middle of a chunk, without a summary.
"""

from __future__ import annotations

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from textwrap import indent
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import yaml
from benchmarks.bags import QOS, definition
from mcap.writer import CompressionType, Writer

from tests.home.messages import (
    TF_STATIC,
    TRANSIENT_LOCAL,
    TYPES,
    Record,
    fixed_frames,
    records,
)
from tests.home.things import LABELS
from tests.home.truth import places
from tests.home.world import Recording, World, world_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tests.home.days import Scale

_CHUNK_BYTES: Final = 16 * 1024
_LEFT: Final = 0.6
"""The part of a split that reaches the disk before the power fails."""


class _Split(NamedTuple):
    path: Path
    start: int
    stop: int
    counts: Counter[str]

    @property
    def messages(self) -> int:
        """Returns how many messages it holds."""
        return self.counts.total()


def write_world(scale: Scale, folder: Path) -> None:
    """Writes bags, and the places and labels that a user would have named, into `folder`."""
    write(scale, folder / "bags")
    named = {"places": places(), "labels": {label: [*also] for label, also in LABELS.items()}}
    for kind, content in named.items():
        text = yaml.safe_dump({kind: content}, sort_keys=False, default_flow_style=None)
        (folder / f"{kind}.yaml").write_text(text, encoding="utf-8")


def write(scale: Scale, folder: Path) -> None:
    """Writes all recordings into `folder`, which must be empty or absent.

    Raises:
        FileExistsError: a recording lies there already.
    """
    world = world_of(scale)
    folder.mkdir(parents=True, exist_ok=True)
    numbers = range(len(world.recordings))
    record = partial(_record, scale, folder)
    if len(numbers) < 30:
        for number in numbers:
            record(number)
    else:
        with ProcessPoolExecutor() as workers:
            for _ in workers.map(record, numbers, chunksize=8):
                pass


def _record(scale: Scale, folder: Path, number: int) -> None:
    """Writes one recording."""
    world = world_of(scale)
    recording = world.recordings[number]
    place = folder / recording.name
    place.mkdir()
    rows = records(world, recording)
    splits: list[_Split] = []
    at = 0
    for nth, (_, stop) in enumerate(recording.splits(scale.split_s)):
        end = int(world.clock_ns(np.array([stop]))[0])
        first = at
        while at < len(rows) and rows[at].log_time < end:
            at += 1
        if at == first:
            continue
        path = place / f"{recording.name}_{nth}.mcap"
        latched = _latched(world, recording, rows[first].log_time)
        part = [latched, *rows[first:at]]
        counts = Counter(row.topic for row in part)
        splits.append(_Split(path, part[0].log_time, part[-1].log_time, counts))
        _write(splits, part)
    closed = [split.path for split in splits]
    if recording.cut:
        whole = splits[-1].path.read_bytes()
        splits[-1].path.write_bytes(whole[: int(_LEFT * len(whole))])
    else:
        text = "rosbag2_bagfile_information:\n" + indent(metadata(splits), "  ") + "\n"
        (place / "metadata.yaml").write_text(text, encoding="utf-8")
    for path, split in zip(closed, splits, strict=True):
        os.utime(path, ns=(split.stop, split.stop))


def _latched(world: World, recording: Recording, log_time: int) -> Record:
    booted = int(world.clock_ns(np.array([recording.booted]))[0])
    return Record(log_time, booted, TF_STATIC, fixed_frames(booted))


def _write(splits: Sequence[_Split], rows: Sequence[Record]) -> None:
    with splits[-1].path.open("xb") as stream:
        writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="ros2-memory benchmark")
        schemas = {
            name: writer.register_schema(name, "ros2msg", definition(name).encode())
            for name in dict.fromkeys(TYPES.values())
        }
        channels = {
            topic: writer.register_channel(
                topic, "cdr", schemas[name], {"offered_qos_profiles": _qos(topic)}
            )
            for topic, name in TYPES.items()
        }
        for sequence, row in enumerate(rows):
            writer.add_message(
                channels[row.topic], row.log_time, row.payload, row.publish_time, sequence
            )
        writer.add_metadata("rosbag2", {"serialized_metadata": metadata(splits)})
        writer.finish()


def _qos(topic: str) -> str:
    return QOS.format(durability="transient_local" if topic in TRANSIENT_LOCAL else "volatile")


def _topic(topic: str, messages: int) -> str:
    return (
        f"  - topic_metadata:\n      name: {topic}\n      type: {TYPES[topic]}\n"
        "      serialization_format: cdr\n      offered_qos_profiles:\n"
        + indent(_qos(topic), " " * 8)
        + f'\n      type_description_hash: ""\n    message_count: {messages}'
    )


def metadata(splits: Sequence[_Split]) -> str:
    """Returns rosbag2's metadata (version 9) of a recording that has these splits."""
    first, last = splits[0].start, splits[-1].stop
    lines = [
        "version: 9",
        "storage_identifier: mcap",
        f"duration:\n  nanoseconds: {last - first}",
        f"starting_time:\n  nanoseconds_since_epoch: {first}",
        f"message_count: {sum(split.messages for split in splits)}",
        "topics_with_message_count:",
        *(_topic(topic, sum(split.counts[topic] for split in splits)) for topic in TYPES),
        'compression_format: ""',
        'compression_mode: ""',
        "relative_file_paths:",
        *(f"  - {split.path.name}" for split in splits),
        "files:",
        *(
            f"  - path: {split.path.name}\n    starting_time:\n"
            f"      nanoseconds_since_epoch: {split.start}\n"
            f"    duration:\n      nanoseconds: {split.stop - split.start}\n"
            f"    message_count: {split.messages}"
            for split in splits
        ),
        "custom_data: ~",
        "ros_distro: jazzy",
    ]
    return "\n".join(lines)

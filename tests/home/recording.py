"""Writes the bags of a world, as `ros2 bag record` would have left them.

Recordings of ten splits, zstd chunks of 16 KiB, publishers' QoS on every channel and every channel
in every split, `/tf_static` once in each; `metadata.yaml` closes a recording, unless the power
failed: then its last split ends in the middle of a chunk, without a summary.
"""

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from benchmarks.bags import Recording as WrittenRecording
from benchmarks.bags import Row, Topic

from tests.home.days import Scale
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

_CHUNK_BYTES = 16 * 1024

_TOPICS = [
    Topic(name, kind, "transient_local" if name in TRANSIENT_LOCAL else "volatile")
    for name, kind in TYPES.items()
]


def write_world(scale: Scale, folder: Path) -> None:
    """Writes bags, and the places and labels that a user would have named, into `folder`."""
    write(scale, folder / "bags")
    named = {"places": places(), "labels": {label: [*also] for label, also in LABELS.items()}}
    for kind, content in named.items():
        text = yaml.safe_dump({kind: content}, sort_keys=False, default_flow_style=None)
        (folder / f"{kind}.yaml").write_text(text)


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
    written = WrittenRecording(folder / recording.name, _TOPICS, _CHUNK_BYTES)
    numbers = {topic.name: nth for nth, topic in enumerate(_TOPICS)}
    rows = records(world, recording)
    at = 0
    for _, stop in recording.splits(scale.split_s):
        end = int(world.clock_ns(np.array([stop]))[0])
        first = at
        while at < len(rows) and rows[at].log_time < end:
            at += 1
        if at > first:
            part = [_latched(world, recording, rows[first].log_time), *rows[first:at]]
            written.write(
                [
                    Row(row.log_time, row.publish_time, numbers[row.topic], row.payload)
                    for row in part
                ]
            )
    if recording.cut:
        written.cut()
    else:
        written.close()


def _latched(world: World, recording: Recording, log_time: int) -> Record:
    booted = int(world.clock_ns(np.array([recording.booted]))[0])
    return Record(log_time, booted, TF_STATIC, fixed_frames(booted))

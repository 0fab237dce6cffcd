"""Makes the history that the benchmark asks about, as `ros2 bag record` would have left it.

The reference rates: 1,261 messages in a split of 10 s. Splits lie in recordings of 60, in zstd
chunks of 16 KiB, with the publishers' QoS on every channel and, as rosbag2 does it, the tale of all
earlier splits of the recording embedded in each; `metadata.yaml` closes a recording. One recording
takes over from the other at a cut, which this project's recorder wrote down, and none overlap.
Everything is drawn from the split's number: the same command makes the same bytes.
"""

from __future__ import annotations

import json
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from textwrap import indent
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer

from benchmarks import payloads
from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.bag_dir.layout import HANDOVER_FILE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

SPLIT_S: Final = 10
SPLIT_NS: Final = SPLIT_S * 1_000_000_000
SPLITS_OF_A_RECORDING: Final = 60
HOUR: Final = 3600 // SPLIT_S
WEEK: Final = 168 * HOUR
"""Splits of an hour, and of a week."""
END_NS: Final = 1_768_176_000_000_000_000
"""Where every history ends: 2026-01-12 00:00 UTC."""

_FORMAT: Final = 2  # of what is written here; folders of another one are made anew
_CHUNK_BYTES: Final = 16 * 1024
_OVERLAP_NS: Final = 3_000_000_000
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


class Topic(NamedTuple):
    """One topic: its type and how many messages of it a split holds."""

    name: str
    type: str
    messages: int
    durability: str = "volatile"


ODOM: Final = Topic("/odom", "nav_msgs/msg/Odometry", 50 * SPLIT_S)
TF: Final = Topic("/tf", "tf2_msgs/msg/TFMessage", 50 * SPLIT_S)
CMD_VEL: Final = Topic("/cmd_vel", "geometry_msgs/msg/Twist", 20 * SPLIT_S)
SCENE: Final = Topic("/vision/scene/scene_objects", payloads.DETECTIONS, SPLIT_S)
FOUND: Final = Topic("/vision/find_object/detections_meta", payloads.DETECTIONS, 5 * SPLIT_S)
TF_STATIC: Final = Topic("/tf_static", "tf2_msgs/msg/TFMessage", 1, "transient_local")
TOPICS: Final = (ODOM, TF, CMD_VEL, SCENE, FOUND, TF_STATIC)
MESSAGES_OF_A_SPLIT: Final = sum(topic.messages for topic in TOPICS)
MAP_TF: Final = Topic("/tf", "tf2_msgs/msg/TFMessage", 60 * SPLIT_S)
"""Each sixth of its messages corrects `map -> odom`; the others are those of `TF`."""
BATTERY: Final = Topic("/battery_state", "sensor_msgs/msg/BatteryState", SPLIT_S)
STATUS: Final = Topic("/robot/status", "std_msgs/msg/String", SPLIT_S)
ROSOUT: Final = Topic("/rosout", "rcl_interfaces/msg/Log", 2 * SPLIT_S, "transient_local")
ROBOT_TOPICS: Final = (ODOM, MAP_TF, CMD_VEL, SCENE, FOUND, TF_STATIC, BATTERY, STATUS, ROSOUT)
"""Those of a robot with a localiser, a battery, a state and a log."""


def with_idle(topics: Sequence[Topic], count: int) -> tuple[Topic, ...]:
    """Returns the topics and so many of one short text a split, `count` in all."""
    idle = range(count - len(topics))
    return (*topics, *(Topic(f"/idle/topic_{nth:04}", STATUS.type, 1) for nth in idle))


class Split(NamedTuple):
    """One bag file and its place in its recording. It covers `[start, start + SPLIT_NS)`."""

    number: int
    path: Path
    start: int
    nth: int


@dataclass(frozen=True, slots=True)
class History:
    """Recordings in a folder: consecutive splits that end at `END_NS`."""

    folder: Path
    bags: int
    topics: tuple[Topic, ...] = TOPICS

    @property
    def start(self) -> int:
        """The first moment, in nanoseconds."""
        return END_NS - self.bags * SPLIT_NS

    @property
    def end(self) -> int:
        """The moment after the last one."""
        return END_NS

    def splits(self) -> Iterator[Split]:
        """The bag files, oldest first."""
        for number in range(self.bags):
            recording, nth = divmod(number, SPLITS_OF_A_RECORDING)
            name = _name(recording)
            path = self.folder / name / f"{name}_{nth}.mcap"
            yield Split(number, path, self.start + number * SPLIT_NS, nth)


def made(
    folder: Path,
    bags: int,
    *,
    jobs: int | None = None,
    topics: tuple[Topic, ...] = TOPICS,
) -> History:
    """The history of so many splits in `folder`, taken as it lies there or made.

    Where making it was interrupted it goes on.

    Raises:
        ValueError: there is not a bag to make.
    """
    if bags < 1:
        raise ValueError(f"a history of {bags} bags cannot be made: give 1 or more")
    name = f"bags_{bags}" if topics == TOPICS else f"bags_{bags}_{len(topics)}_topics"
    place = folder / name
    history = History(place, bags, topics)
    seal = folder / f"{name}.json"
    facts = {"format": _FORMAT, "bags": bags, "messages_of_a_split": _messages(topics)}
    if seal.is_file() and json.loads(seal.read_text(encoding="utf-8")) == facts:
        return history
    seal.unlink(missing_ok=True)
    begun = folder / f"{name}.begun.json"
    if not begun.is_file() or json.loads(begun.read_text(encoding="utf-8")) != facts:
        shutil.rmtree(place, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        begun.write_text(json.dumps(facts), encoding="utf-8")
    splits = list(history.splits())
    recordings = [
        splits[at : at + SPLITS_OF_A_RECORDING] for at in range(0, bags, SPLITS_OF_A_RECORDING)
    ]
    record = partial(_record, history)
    if len(recordings) == 1:
        record(recordings[0])
    else:
        with ProcessPoolExecutor(jobs) as workers:
            for _ in workers.map(record, recordings):
                pass
    begun.replace(seal)
    return history


def _record(history: History, splits: list[Split]) -> None:
    """Writes one recording, unless it was written before a run was interrupted."""
    folder = splits[0].path.parent
    if (folder / HANDOVER_FILE).exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for split in splits:
        write_split(split, splits[: split.nth + 1], history.topics)
        # A bag that was closed long ago, as most bags of a history were.
        closed = split.start + SPLIT_NS
        os.utime(split.path, ns=(closed, closed))
    text = "rosbag2_bagfile_information:\n" + indent(metadata(splits, history.topics), "  ") + "\n"
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")
    write_handover(folder, _handover(history, splits))


def _handover(history: History, splits: list[Split]) -> Handover:
    """What this project's recorder writes down where one recording takes over from another."""
    first, last = splits[0], splits[-1]
    number = first.number // SPLITS_OF_A_RECORDING

    def around(cut: int, split: Split) -> Overlap:
        return Overlap(cut - _OVERLAP_NS, cut + _OVERLAP_NS, (split.path.name,))

    begins, ends = first.number > 0, last.number < history.bags - 1
    stop = last.start + SPLIT_NS
    return Handover(
        previous=_name(number - 1) if begins else None,
        counts_from=first.start if begins else None,
        begin=around(first.start, first) if begins else None,
        next=_name(number + 1) if ends else None,
        counts_until=stop if ends else None,
        end=around(stop, last) if ends else None,
    )


def _name(recording: int) -> str:
    return f"rec_{recording:04}"


def write_split(split: Split, so_far: Sequence[Split], topics: Sequence[Topic]) -> None:
    """Writes a bag of 10 s; `so_far` are the splits of its recording up to it."""
    noise = np.random.default_rng(split.number)
    with split.path.open("wb") as stream:
        writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="ros2-memory benchmark")
        channels = _declared(writer, topics)
        rows = [row for topic in topics for row in _rows(split, topic, channels[topic], noise)]
        rows.sort(key=lambda row: row[0])
        for sequence, (log_time, publish_time, channel, payload) in enumerate(rows):
            writer.add_message(channel, log_time, payload, publish_time, sequence)
        writer.add_metadata("rosbag2", {"serialized_metadata": metadata(so_far, topics)})
        writer.finish()


def _declared(writer: Writer, topics: Sequence[Topic]) -> dict[Topic, int]:
    schemas = {
        name: writer.register_schema(name, "ros2msg", definition(name).encode())
        for name in dict.fromkeys(topic.type for topic in topics)
    }
    return {
        topic: writer.register_channel(
            topic.name,
            "cdr",
            schemas[topic.type],
            {"offered_qos_profiles": QOS.format(durability=topic.durability)},
        )
        for topic in topics
    }


def _rows(
    split: Split, topic: Topic, channel: int, noise: np.random.Generator
) -> list[tuple[int, int, int, bytes]]:
    """Log time, publish time, channel and payload of a topic's messages."""
    if topic == TF_STATIC:
        recording_began = split.start - split.nth * SPLIT_NS
        return [(split.start, recording_began, channel, payloads.fixed_frames())]
    published = split.start + np.arange(topic.messages) * (SPLIT_NS // topic.messages)
    # Log time: some tenths of a millisecond in the middleware, never past the next split.
    logged = published + noise.integers(60_000, 460_000, topic.messages)
    bodies = _payloads(split, topic, published.astype(np.int64), noise)
    number = [channel] * topic.messages
    return list(zip(logged.tolist(), published.tolist(), number, bodies, strict=True))


def _payloads(
    split: Split, topic: Topic, published: NDArray[np.int64], noise: np.random.Generator
) -> list[bytes]:
    t = (published - (END_NS - WEEK * SPLIT_NS)) / 1e9
    made_of: dict[Topic, Callable[[], list[bytes]]] = {
        ODOM: lambda: payloads.odometry(t, published, split.number),
        TF: lambda: payloads.moving_frame(t, published, split.number),
        MAP_TF: lambda: payloads.corrected_frames(t, published, split.number),
        CMD_VEL: lambda: payloads.command(t),
        BATTERY: lambda: payloads.battery(t, published),
        ROSOUT: lambda: payloads.logged(published, noise),
    }
    if topic in made_of:
        return made_of[topic]()
    if topic.type == STATUS.type:
        return payloads.states(t)
    skill, fewest, most = ("scene", 3, 9) if topic == SCENE else ("find_object", 0, 3)
    return [
        payloads.detections(stamp, skill, int(noise.integers(fewest, most)), noise)
        for stamp in published.tolist()
    ]


def _messages(topics: Sequence[Topic]) -> int:
    """How many messages of the topics a split holds."""
    return sum(topic.messages for topic in topics)


def metadata(splits: Sequence[Split], topics: Sequence[Topic] = TOPICS) -> str:
    """What rosbag2 tells of a recording (its metadata, version 9) when it has these splits."""
    each = _messages(topics)
    lines = [
        "version: 9",
        "storage_identifier: mcap",
        f"duration:\n  nanoseconds: {len(splits) * SPLIT_NS}",
        f"starting_time:\n  nanoseconds_since_epoch: {splits[0].start}",
        f"message_count: {len(splits) * each}",
        "topics_with_message_count:",
        *(_topic_told(topic, len(splits)) for topic in topics),
        'compression_format: ""',
        'compression_mode: ""',
        "relative_file_paths:",
        *(f"  - {split.path.name}" for split in splits),
        "files:",
        *(_split_told(split, each) for split in splits),
        "custom_data: ~",
        "ros_distro: jazzy",
    ]
    return "\n".join(lines)


def _topic_told(topic: Topic, splits: int) -> str:
    return (
        f"  - topic_metadata:\n      name: {topic.name}\n      type: {topic.type}\n"
        "      serialization_format: cdr\n      offered_qos_profiles:\n"
        + indent(QOS.format(durability=topic.durability), " " * 8)
        + f'\n      type_description_hash: ""\n    message_count: {topic.messages * splits}'
    )


def _split_told(split: Split, messages: int) -> str:
    return (
        f"  - path: {split.path.name}\n    starting_time:\n"
        f"      nanoseconds_since_epoch: {split.start}\n    duration:\n"
        f"      nanoseconds: {SPLIT_NS}\n    message_count: {messages}"
    )


@cache
def definition(type_name: str) -> str:
    """A type's definition with all that it contains, as bags have it."""
    return payloads.typestore().generate_msgdef(type_name, ros_version=2)[0]

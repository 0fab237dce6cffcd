"""Finds out which topics there are, and how much comes on each, by two short real recordings.

The first is paused: it lists all topics with their types, and writes no message. The second records
those that are not left out by their type, for some seconds and a bounded number of bytes.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

import yaml

from ros2_memory.cli.proposal import INDEX_BYTES, MESSAGE_BYTES, Choice, Offered, chosen, judge
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import Ns, unix_from_ns
from ros2_memory.recorder.process.child import Child, end_all
from ros2_memory.recorder.process.command import record_argv, storage_config
from ros2_memory.recorder.process.output import LineKind, parse_line
from ros2_memory.recorder.process.topics import TopicSelection
from ros2_memory.recorder.reception import ALL_MESSAGES

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from ros2_memory.recorder.process.installation import Installation
    from ros2_memory.storage.base import BagReader

LOOK_S: Final = 10.0
"""Topics are waited for so long; discovery takes 0.4 to 3 s on one machine."""
QUIET_S: Final = 2.0
"""No further topic is expected when none has appeared for so long."""
MAX_BYTES: Final = 100 * 2**20
LEAST_RATIO: Final = 0.05
CACHE_BYTES: Final = 16 * 2**20
_POLL_S: Final = 0.05
_EVERYTHING: Final = TopicSelection((*("/*" * n for n in range(1, 12)), "/*/_action/status"))
_OWN: Final = re.compile(r"^/(rosout|parameter_events)$|^/events/|^/rosbag2_|^/ros2_memory_up")
"""Topics that every recorder offers itself."""


@dataclass(frozen=True, slots=True)
class Survey:
    """What was found.

    Attributes:
        topics: those that others offer, in the order of their names.
        unknown_types: names of topics that cannot be recorded, for want of their definition.
        ratio: compressed bytes of a byte, over all that was recorded.
        fixed_bytes: what a file without a message has.
    """

    topics: Sequence[Offered]
    unknown_types: Sequence[str]
    ratio: float
    fixed_bytes: int


def survey(ros: Installation, reader: BagReader, chunk_bytes: int, seconds: float) -> Survey:
    """Looks what is offered, and measures for `seconds` what is not left out by its type.

    Must be called from the main thread, as every child is.

    Raises:
        BagError: what was recorded cannot be read.
        RecorderError: `ros2 bag record` fails; the sentence has its last words.
    """
    with TemporaryDirectory(prefix="ros2-memory-up-") as name:
        folder = Path(name)
        (folder / "qos.yaml").write_text(yaml.safe_dump({"/tf_static": ALL_MESSAGES}))
        (folder / "storage.yaml").write_text(storage_config(chunk_bytes))
        unknown, empty = _record(
            ros, folder / "look", _EVERYTHING, QUIET_S, options=("--start-paused",)
        )
        offered = {
            channel.topic: Offered(
                channel.topic, re.sub(r"[^\w/]", "?", channel.type), channel.latched
            )
            for channel in reader.channels(empty)
            if not _OWN.match(channel.topic)
        }
        # Neither pixels nor what people say is recorded even now.
        light = tuple(topic.topic for topic in chosen(judge(offered.values()), Choice.RECORD))
        fixed, ratio = empty.stat().st_size, 1.0
        if light:
            _, bag = _record(ros, folder / "measure", TopicSelection(light), seconds, light)
            ratio = _measure(reader, bag, offered, fixed)
    topics = [topic for _, topic in sorted(offered.items())]
    return Survey(topics, sorted(unknown), ratio, fixed)


def _measure(reader: BagReader, bag: Path, offered: dict[str, Offered], fixed: int) -> float:
    """Adds to the topics how they came in a bag; returns by how much the bag is compressed."""
    sizes: dict[str, list[int]] = {}
    times: dict[str, list[Ns]] = {}
    for batch in reader.batches(bag, offered, TimeWindow.everything()):
        sizes.setdefault(batch.channel.topic, []).extend(batch.sizes.tolist())
        times.setdefault(batch.channel.topic, []).extend(batch.log_times.tolist())
    ends = [max(times_ns) for times_ns in times.values()]
    for topic, payloads in sizes.items():
        # A topic is heard from its first message on: others may have been subscribed to before.
        span_s = unix_from_ns(max(ends) - min(times[topic]))
        count = len(payloads)
        hz = (count - 1) / span_s if count > 1 and span_s else 1 / max(span_s, 1.0)
        mean = sum(payloads) / count
        offered[topic] = replace(offered[topic], messages=count, hz=hz, payload_bytes=mean)
    payload = sum(sum(payloads) + len(payloads) * MESSAGE_BYTES for payloads in sizes.values())
    stored = bag.stat().st_size - fixed - INDEX_BYTES * sum(map(len, sizes.values()))
    return min(max(stored / payload, LEAST_RATIO), 1.0) if payload else 1.0


def _record(
    ros: Installation,
    directory: Path,
    topics: TopicSelection,
    quiet_s: float,
    expected: Collection[str] = (),
    *,
    options: Sequence[str] = (),
) -> tuple[set[str], Path]:
    """Records until all that is expected (else anything) came, and nothing new for `quiet_s`.

    Returns the topics of unknown types, and the file.
    """
    argv = record_argv(
        ros2=ros.ros2,
        directory=directory,
        topics=topics,
        split_duration_s=3600,
        qos_file=directory.with_name("qos.yaml"),
        storage_file=directory.with_name("storage.yaml"),
        node_name="ros2_memory_up",
        cache_bytes=CACHE_BYTES,
        known_options=ros.options,
    )
    child = Child.start([*argv, *options], {**ros.env, "ROS_LOG_DIR": str(directory.parent)})
    heard: dict[LineKind, set[str]] = {LineKind.SUBSCRIBED: set(), LineKind.UNKNOWN_TYPE: set()}
    lines: list[str] = []
    began = changed = time.monotonic()
    try:
        while child.exit_status() is None and time.monotonic() < began + LOOK_S + quiet_s:
            for line in map(parse_line, child.take_lines()):
                lines.append(line.text)
                if line.topic and line.kind in heard and not _OWN.match(line.topic):
                    heard[line.kind].add(line.topic)
                    changed = time.monotonic()
            subscribed = heard[LineKind.SUBSCRIBED]
            has_all = subscribed and subscribed.issuperset(expected)
            if has_all and time.monotonic() > changed + quiet_s:
                break
            if sum(file.stat().st_size for file in directory.glob("*")) > MAX_BYTES:
                break
            time.sleep(_POLL_S)
        failed = child.exit_status()
    finally:
        end_all([child])
    file = next(directory.glob("*.mcap"), None)
    if failed is not None or file is None:
        words = "; ".join([*lines, *child.take_lines()][-3:])
        raise RecorderError(
            f"ros2 bag record ended by itself (status {failed}): {words}; `ros2-memory doctor` "
            "checks the installation"
        )
    return heard[LineKind.UNKNOWN_TYPE], file

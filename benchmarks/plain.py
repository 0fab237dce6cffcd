"""The first yardstick: plain rosbags, frozen.

For every bag that overlaps the question, newest first where the question is,
`rosbags.rosbag2.Reader(path)`, `messages(connections of the topic, start, stop)`,
`typestore.deserialize_cdr`, the condition in Python, and stop at the answer. Which bags overlap is
known to it beforehand and costs nothing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

from rosbags.rosbag2 import Reader

from benchmarks.bags import SPLIT_NS
from benchmarks.payloads import typestore

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from benchmarks.bags import Split
    from benchmarks.views import DetectionArray, OdometryMessage


def index(paths: Sequence[Path]) -> list[tuple[str, int]]:
    """Messages by topic over all bags, having opened each."""
    counts: dict[str, int] = {}
    for path in paths:
        with Reader(path) as reader:
            for connection in reader.connections:
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    return sorted(counts.items())


def messages(path: Path, topic: str, start: int, stop: int) -> Iterator[tuple[int, object]]:
    """Log times and messages of one bag in `[start, stop)`."""
    with Reader(path) as reader:
        wanted = [each for each in reader.connections if each.topic == topic]
        for connection, moment, raw in reader.messages(wanted, start, stop):
            yield moment, typestore().deserialize_cdr(raw, connection.msgtype)


def position_at(
    splits: Sequence[Split], topic: str, start: int, stop: int
) -> tuple[int, float, float] | None:
    """Log time and place of the newest pose in `[start, stop)`."""
    for split in reversed(_overlapping(splits, start, stop)):
        found = list(messages(split.path, topic, start, stop))
        if found:
            return _place(*found[-1])
    return None


def samples(
    splits: Sequence[Split], topic: str, start: int, stop: int, at_most: int
) -> list[tuple[int, float, float]]:
    """Evenly spaced poses of a window, the first and the last among them."""
    found = [
        each
        for split in _overlapping(splits, start, stop)
        for each in messages(split.path, topic, start, stop)
    ]
    count = min(at_most, len(found))
    if count < 2:
        return [_place(*each) for each in found[-count:]]
    indices = [k * (len(found) - 1) // (count - 1) for k in range(count)]
    return [_place(*found[at]) for at in indices]


def path_length(splits: Sequence[Split], topic: str, start: int, stop: int) -> float:
    """Metres driven in a window."""
    length = 0.0
    before: tuple[float, float, float] | None = None
    for split in _overlapping(splits, start, stop):
        for _, message in messages(split.path, topic, start, stop):
            at = cast("OdometryMessage", message).pose.pose.position
            here = (at.x, at.y, at.z)
            if before is not None:
                length += math.dist(before, here)
            before = here
    return length


def last_match(splits: Sequence[Split], topic: str, meets: Callable[[object], bool]) -> int | None:
    """Log time of the newest message that meets a condition."""
    for split in reversed(splits):
        newest: int | None = None
        for moment, message in messages(split.path, topic, split.start, split.start + SPLIT_NS):
            if meets(message):
                newest = moment
        if newest is not None:
            return newest
    return None


def shows(label: str) -> Callable[[object], bool]:
    """Whether a detection array has a label that contains this one."""
    folded = label.casefold()

    def meets(message: object) -> bool:
        array = cast("DetectionArray", message)
        return folded in array.skill.casefold() or any(
            folded in each.label.casefold() for each in array.detections
        )

    return meets


def near(x: float, y: float, tolerance_m: float) -> Callable[[object], bool]:
    """Whether an odometry message is within a distance of a place, in the plane."""

    def meets(message: object) -> bool:
        at = cast("OdometryMessage", message).pose.pose.position
        return math.hypot(at.x - x, at.y - y) <= tolerance_m

    return meets


def _overlapping(splits: Sequence[Split], start: int, stop: int) -> list[Split]:
    return [each for each in splits if each.start < stop and start < each.start + SPLIT_NS]


def _place(moment: int, message: object) -> tuple[int, float, float]:
    at = cast("OdometryMessage", message).pose.pose.position
    return moment, at.x, at.y

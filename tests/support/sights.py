"""Sights of messages that a test writes down one by one."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ros2_memory.analysis.sights import TABLES, DetectorMessages, Sights, sights_of
from ros2_memory.columns.sights import JoinedSights, joined, packed
from ros2_memory.columns.table import Texts
from ros2_memory.core.model import Vector3
from ros2_memory.core.timebase import Ns


class PlacedDetection(NamedTuple):
    """A detection in the frame of the sights (m)."""

    label: str
    place: Vector3 | None
    score: float | None = None


class Message(NamedTuple):
    """A message of a detector: when, from where (x, y, yaw), and what it has."""

    topic: str
    time: Ns
    robot: tuple[float, float, float] | None
    things: Sequence[PlacedDetection]


def no_sights() -> Sights:
    """Returns the sights where no detector published."""
    return Sights((), (), *(np.zeros((0, len(columns)), np.int64) for columns in TABLES))


def sights_of_messages(messages: Sequence[Message]) -> Sights:
    """The sights of messages of one topic in order of time."""
    return sights_of(messages[0].topic, seen_in(messages)) if messages else no_sights()


def seen_in(messages: Sequence[Message]) -> DetectorMessages:
    """Messages of one topic as arrays."""
    nowhere = (math.nan, math.nan, math.nan)
    poses = [message.robot or nowhere for message in messages]
    robots = [(x, y, 0.0, yaw, 0.0) for x, y, yaw in poses]
    every = [(row, one) for row, message in enumerate(messages) for one in message.things]
    scores = [math.nan if one.score is None else one.score for _, one in every]
    labels = Texts.of([one.label for _, one in every])
    return DetectorMessages(
        np.array([message.time for message in messages], np.int64),
        np.array(robots, np.float64).reshape(-1, 5),
        np.array([row for row, _ in every], np.int64),
        labels.codes.astype(np.int64),
        labels.words,
        np.array([one.place or nowhere for _, one in every], np.float64).reshape(-1, 3),
        np.array(scores, np.float64),
    )


def whole(parts: Sequence[Sights]) -> JoinedSights:
    """The sights of all parts, which are in one coordinate system."""
    zeros = [0] * len(parts)
    return joined([packed(part) for part in parts], zeros, zeros)

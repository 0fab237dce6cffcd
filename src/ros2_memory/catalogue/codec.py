"""Encodes what bags hold of their topics as the bytes and texts in the catalogue."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.core.bag_summary import TopicHeader, shared_schema

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import JsonValue


def encode_schema(schema: SummarySchema) -> str:
    """Encodes a summary schema; equal ones give equal texts."""
    topics: JsonValue = [[*header] for header in schema.topics]
    return json.dumps([topics, [*schema.silent], schema.complete, [*schema.notes], schema.set_back])


def decode_schema(text: str) -> SummarySchema:
    """Decodes a summary schema.

    Raises:
        ValueError: the text is not valid.
        TypeError: likewise.
    """
    topics, silent, complete, notes, set_back = json.loads(text)
    headers = (
        TopicHeader(topic, type_name, encoding, bool(latched))
        for topic, type_name, encoding, latched in topics
    )
    return shared_schema(tuple(headers), tuple(silent), bool(complete), tuple(notes), int(set_back))


def encode_counts(numbers: bytes) -> bytes:
    """Encodes count, first and last of each topic: the earliest time, then all relative to it.

    Of `last`, how much later than `first` it is.
    """
    table = np.frombuffer(numbers, "<i8").reshape(-1, 3).copy()
    if not table.size:
        return b""
    start = table[:, 1].min()
    table[:, 2] -= table[:, 1]
    table[:, 1] -= start
    return b"".join((start.tobytes(), table.tobytes()))


def decode_counts(
    encoded: Sequence[bytes], topics: int
) -> np.ndarray[tuple[int, int, int], np.dtype[np.int64]]:
    """Decodes count, first and last of each of so many topics, for each bag.

    Raises:
        ValueError: some are not those of so many topics.
    """
    size = 8 * (1 + 3 * topics) if topics else 0
    if any(len(each) != size for each in encoded):
        raise ValueError(f"not the numbers of bags that hold {topics} topics")
    if not size:
        return np.zeros((len(encoded), 0, 3), np.int64)
    rows = np.frombuffer(b"".join(encoded), "<i8").reshape(len(encoded), -1)
    table = rows[:, 1:].reshape(len(encoded), topics, 3).copy()
    table[:, :, 1] += rows[:, :1]
    table[:, :, 2] += table[:, :, 1]
    return table

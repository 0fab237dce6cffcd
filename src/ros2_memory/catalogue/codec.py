"""Encodes the numbers of bags as the bytes in the catalogue."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence


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

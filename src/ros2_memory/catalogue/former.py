"""What the catalogue knows of all files at once: a start reads it for a week of bags."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.catalogue.codec import decode_schema
from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.index.file_state import KnownFile

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Sequence

    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.timebase import Ns

_AT_ONCE: Final = 4096
"""Rows that are held besides what is made of them."""


def known_files(base: sqlite3.Connection, config: str, root: str) -> dict[str, KnownFile]:
    """The files that have an entry, by `root` and their path.

    Raises:
        sqlite3.Error: the base cannot be read.
        ValueError: it holds what is no summary.
    """
    found: dict[str, KnownFile] = {}
    for number, text in base.execute("SELECT id, text FROM shapes").fetchall():
        shape = decode_schema(text)
        cursor = base.execute(
            "SELECT path, size, mtime, sidecar, counts FROM bags WHERE config = ? AND shape = ?",
            (config, number),
        )
        while rows := cursor.fetchmany(_AT_ONCE):
            starts, ends = _spans(shape, [row[4] for row in rows])
            for row, start, end in zip(rows, starts, ends, strict=True):
                path, size, mtime, sidecar, counts = row
                summary = BagSummary.packed(shape, counts)
                found[root + path] = KnownFile(size, mtime, sidecar, summary, start, end)
    return found


def _spans(shape: SummarySchema, counts: Sequence[bytes]) -> tuple[list[Ns], list[Ns]]:
    """Of bags of one shape, given by their numbers, the log times of the first and last message.

    0 for bags without a message.

    Raises:
        ValueError: the numbers are of another shape.
    """
    size = shape.layout.size
    if any(len(each) != size for each in counts):
        raise ValueError(f"not the numbers of bags that hold {len(shape.topics)} topics")
    if not size or not counts:
        return [0] * len(counts), [0] * len(counts)
    numbers = np.frombuffer(b"".join(counts), "<i8").reshape(len(counts), -1, 3)
    return numbers[:, :, 1].min(axis=1).tolist(), numbers[:, :, 2].max(axis=1).tolist()

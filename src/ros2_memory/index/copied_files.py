"""Bags that somebody copied beside themselves, `run_0 (copy).mcap` beside `run_0.mcap`.

One of them counts. Messages of one folder are no copies of each other, so all would count twice.
"""

from __future__ import annotations

import os
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.index.timeline import Timeline

_BLOCK_BYTES: Final = 64 << 10
_BLOCKS: Final = 16


def alike_among(timeline: Timeline) -> Iterator[tuple[BagFile, BagFile]]:
    """Yields bags with the folder, size and summary of one with a shorter name, behind that one."""
    starts = timeline.starts
    is_same = starts[1:] == starts[:-1]
    are_suspects = np.append(is_same, False) | np.append(False, is_same)
    edges = np.cumsum([len(segment.bags) for segment in timeline.segments])
    of_segments = zip(timeline.segments, np.split(are_suspects, edges), strict=False)
    suspects = chain.from_iterable(segment.bags.at(rows) for segment, rows in of_segments)
    originals: dict[tuple[Path, int, int, int], BagFile] = {}
    for bag in sorted(suspects, key=lambda bag: (len(bag.file), bag.file)):
        original = originals.setdefault((bag.recording, bag.size, bag.start, bag.end), bag)
        if original is not bag and original.summary == bag.summary:
            yield original, bag


def is_copy(original: BagFile, bag: BagFile) -> bool:
    """Returns whether two bags of one size are the same bytes, as blocks all over them show.

    Runs of a simulation may have the same times and sizes.

    Raises:
        OSError: one of them cannot be read.
    """
    return _blocks(original) == _blocks(bag)


def _blocks(bag: BagFile) -> list[bytes]:
    step = max(bag.size // _BLOCKS, _BLOCK_BYTES)
    places = (*range(0, bag.size, step), max(bag.size - _BLOCK_BYTES, 0))
    file = os.open(bag.file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        return [os.pread(file, _BLOCK_BYTES, place) for place in places]
    finally:
        os.close(file)

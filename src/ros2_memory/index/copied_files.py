"""Bags that somebody copied beside themselves, `run_0 (copy).mcap` beside `run_0.mcap`.

One of them counts. Messages of one folder are no copies of each other, so all would count twice.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import BagFile

Alike: TypeAlias = "tuple[tuple[BagFile, BagFile], ...]"
"""Bags that may be copies, each behind the one that it may be a copy of."""
_BLOCK_BYTES: Final = 64 << 10
_BLOCKS: Final = 16


def alike_among(bags: Sequence[BagFile]) -> Alike:
    """Returns those of some bags that have folder, size and summary of one with a shorter name."""
    if len({bag.start for bag in bags}) == len(bags):
        return ()
    originals: dict[tuple[str, int, int, int], BagFile] = {}
    pairs = []
    for bag in sorted(bags, key=lambda bag: (len(bag.file), bag.file)):
        key = (bag.file.rpartition("/")[0], bag.size, bag.start, bag.end)
        original = originals.setdefault(key, bag)
        if original is not bag and original.summary == bag.summary:
            pairs.append((original, bag))
    return tuple(pairs)


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

"""Bags that somebody copied beside themselves, `run_0 (copy).mcap` beside `run_0.mcap`.

One of them counts. Messages of one folder are no copies of each other, so all would count twice.
A copy that was interrupted has the first bytes of the bag.
"""

from __future__ import annotations

import os
from collections import Counter
from operator import eq
from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import BagState
from ros2_memory.index.segment import folder_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns

_BLOCK_BYTES: Final = 64 << 10
_BLOCKS: Final = 16


def alike_among(bags: Sequence[BagFile]) -> Iterator[tuple[BagFile, BagFile]]:
    """Yields bags behind one of their folder that begins alike, and may be what they are copies of.

    That is one with the same size and summary, and a shorter name; or a larger one, where a bag is
    not closed.
    """
    starts = Counter(bag.start for bag in bags)
    suspects = [bag for bag in bags if starts[bag.start] > 1]
    originals: dict[tuple[str, Ns], list[BagFile]] = {}
    for bag in sorted(suspects, key=lambda bag: (-bag.size, len(bag.file), bag.file)):
        others = originals.setdefault((folder_of(bag), bag.start), [])
        is_cut = bag.state is BagState.INCOMPLETE
        for original in others:
            if is_cut or (original.size == bag.size and original.summary == bag.summary):
                yield original, bag
        others.append(bag)


def is_copy(original: BagFile, bag: BagFile) -> bool:
    """Returns whether a bag has the first bytes of another one, as blocks all over it show.

    Runs of a simulation may have the same times and sizes.

    Raises:
        OSError: one of them cannot be read.
    """
    return all(map(eq, _blocks(original, bag.size), _blocks(bag, bag.size)))


def _blocks(bag: BagFile, size: int) -> Iterator[bytes]:
    step = max(size // _BLOCKS, _BLOCK_BYTES)
    places = (*range(0, size, step), max(size - _BLOCK_BYTES, 0))
    file = os.open(bag.file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        for place in places:
            yield os.pread(file, min(_BLOCK_BYTES, size - place), place)
    finally:
        os.close(file)

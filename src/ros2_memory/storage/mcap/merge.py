"""Merges runs of messages that are each in order and may overlap in time.

`heapq.merge` compares every message; this yields whole stretches that no other run interrupts.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from heapq import heappop, heappush
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

T = TypeVar("T")


class RunRows(NamedTuple, Generic[T]):
    """The messages of one run in output order.

    Attributes:
        keys: their log times, ascending; negative for newest first.
        places: offsets in the chunk; of messages with equal keys in output order.
        fetch: returns a message by its place.
    """

    keys: list[int]
    places: list[int]
    fetch: Callable[[int], T]


class SortedRun(NamedTuple, Generic[T]):
    """A part of a file that was not read yet; compared by its first two fields, as `_Open` is.

    Attributes:
        key: no message of the part has a lower one.
        rank: breaks ties of keys: where the part is in the file; negative for newest first.
        rows: reads the part; called only when it can hold the next message.
    """

    key: int
    rank: int
    rows: Callable[[], RunRows[T] | None]


class _Open(NamedTuple, Generic[T]):
    """A run that is being merged.

    Attributes:
        key: the key of its next message.
        rank: of the run.
        position: which of its rows is the next message.
        rows: the messages.
    """

    key: int
    rank: int
    position: int
    rows: RunRows[T]


def merged(runs: Iterable[SortedRun[T]]) -> Iterator[T]:
    """Yields the messages of all runs in the order of keys; ties in the order of ranks.

    A run is read only when it can hold the next message, and dropped at its end: only the runs that
    overlap in time are in memory.
    """
    waiting = sorted(runs, reverse=True)  # the next to be read is the last of the list
    heap: list[_Open[T]] = []
    while waiting or heap:
        if waiting and (not heap or waiting[-1].key <= heap[0].key):
            _, rank, read = waiting.pop()
            rows = read()
            if rows is not None:
                heappush(heap, _Open(rows.keys[0], rank, 0, rows))
            del rows, read
            continue
        _, rank, position, rows = heappop(heap)
        next_keys = [run.key for run in heap[:1]] + [run.key for run in waiting[-1:]]
        other_key = min(next_keys, default=math.inf)
        # At a tie with another run, the lower rank goes first, one message at a time.
        stop = max(bisect_left(rows.keys, other_key, position), position + 1)
        yield from map(rows.fetch, rows.places[position:stop])
        if stop < len(rows.keys):
            heappush(heap, _Open(rows.keys[stop], rank, stop, rows))
        del rows  # and the decompressed chunk, before the next is read

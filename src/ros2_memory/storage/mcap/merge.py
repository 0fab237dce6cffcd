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

    from ros2_memory.core.timebase import Ns

T = TypeVar("T")


class RunRows(NamedTuple, Generic[T]):
    """The messages of one run in output order.

    Attributes:
        times: log times; descending for newest first, with equal ones in reverse file order.
        places: offsets in the chunk.
        fetch: returns a message by its place and log time.
    """

    times: list[Ns]
    places: list[int]
    fetch: Callable[[int, Ns], T]


class SortedRun(NamedTuple, Generic[T]):
    """A part of a file.

    Attributes:
        first: no message of the part has an earlier log time.
        last: no message of the part has a later log time.
        rank: the position of the part in the file, which no other run has.
        rows: reads the part; called only when it can hold the next message.
    """

    first: Ns
    last: Ns
    rank: int
    rows: Callable[[], RunRows[T] | None]


class _Waiting(NamedTuple, Generic[T]):
    """A run that was not read yet; compared by its first two fields, as `_Open` is.

    Attributes:
        key: no message of the run comes earlier; a log time, negative for newest first.
        rank: breaks ties of keys; negative for newest first.
        run: the run.
    """

    key: Ns
    rank: int
    run: SortedRun[T]


class _Open(NamedTuple, Generic[T]):
    """A run that is being merged.

    Attributes:
        key: the key of its next message.
        rank: breaks ties of keys.
        position: which of its rows is the next message.
        rows: the messages.
        keys: the key of each of its rows.
    """

    key: Ns
    rank: int
    position: int
    rows: RunRows[T]
    keys: list[Ns]


def merged(runs: Iterable[SortedRun[T]], *, newest_first: bool) -> Iterator[T]:
    """Yields the messages of all runs by log time, ties in file order; or exactly the reverse.

    A run is read only when it can hold the next message, and dropped at its end: only the runs that
    overlap in time are in memory.
    """
    if newest_first:
        waiting = [_Waiting(-run.last, -run.rank, run) for run in runs]
    else:
        waiting = [_Waiting(run.first, run.rank, run) for run in runs]
    waiting.sort(reverse=True)  # the next to be read is the last of the list
    heap: list[_Open[T]] = []
    while waiting or heap:
        while waiting and (not heap or waiting[-1].key <= heap[0].key):
            _, rank, run = waiting.pop()
            rows = run.rows()
            if rows is not None:
                keys = [-time for time in rows.times] if newest_first else rows.times
                heappush(heap, _Open(keys[0], rank, 0, rows, keys))
            del rows, run
        if not heap:
            continue
        _, rank, position, rows, keys = heappop(heap)
        other_key = min(heap[0].key if heap else math.inf, waiting[-1].key if waiting else math.inf)
        # At a tie with another run, the lower rank goes first, one message at a time.
        stop = max(bisect_left(keys, other_key, position), position + 1)
        fetch = rows.fetch
        for place, time in zip(rows.places[position:stop], rows.times[position:stop], strict=True):
            yield fetch(place, time)
        if stop < len(keys):
            heappush(heap, _Open(keys[stop], rank, stop, rows, keys))
        del rows, keys, fetch  # and the decompressed chunk, before the next is read

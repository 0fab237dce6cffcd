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
    """The messages of one run in output order: log times, offsets, and how to fetch one by both.

    For newest first the times are descending, and equal ones are in reverse file order.
    """

    times: list[Ns]
    places: list[int]
    fetch: Callable[[int, Ns], T]


class SortedRun(NamedTuple, Generic[T]):
    """A part of a file: no message in it lies outside `first` to `last` (inclusive).

    `rank` is its position in the file, which no other run has; `rows` reads it, and is called only
    when its turn comes.
    """

    first: Ns
    last: Ns
    rank: int
    rows: Callable[[], RunRows[T] | None]


def merged(runs: Iterable[SortedRun[T]], *, newest_first: bool) -> Iterator[T]:
    """Yields the messages of all runs by log time, ties in file order; or exactly the reverse.

    A run is read only when it can hold the next message, and dropped at its end: only the runs that
    overlap in time are in memory.
    """
    sign = -1 if newest_first else 1
    # Sorted so that the next to be read is the last of the list.
    waiting = sorted(
        ((-run.last if newest_first else run.first, sign * run.rank, run) for run in runs),
        reverse=True,
    )
    heap: list[tuple[Ns, int, int, RunRows[T], list[Ns]]] = []
    while waiting or heap:
        while waiting and (not heap or waiting[-1][0] <= heap[0][0]):
            _, rank, run = waiting.pop()
            rows = run.rows()
            if rows is not None:
                keys = [-time for time in rows.times] if newest_first else rows.times
                heappush(heap, (keys[0], rank, 0, rows, keys))
            del rows, run
        if not heap:
            continue
        _, rank, position, rows, keys = heappop(heap)
        following = min([other[0] for other in (*heap[:1], *waiting[-1:])], default=math.inf)
        # At a tie with another run, the lower rank goes first, one message at a time.
        stop = max(bisect_left(keys, following, position), position + 1)
        fetch = rows.fetch
        for place, time in zip(rows.places[position:stop], rows.times[position:stop], strict=True):
            yield fetch(place, time)
        if stop < len(keys):
            heappush(heap, (keys[stop], rank, stop, rows, keys))
        del rows, keys, fetch

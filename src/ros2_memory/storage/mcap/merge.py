"""Merges runs of messages that are each in order and may overlap in time."""

from __future__ import annotations

from bisect import bisect_left
from itertools import repeat
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeAlias, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.mcap.chunk import Column

T = TypeVar("T")
Fetch: TypeAlias = "Callable[[int, Ns], T]"
"""Returns a message by its offset and its log time."""


class Run(NamedTuple, Generic[T]):
    """A part of a file: no message in it lies outside `first` to `last` (inclusive).

    `rank` is its position in the file, which no other run has; `read` returns its messages, if it
    has any, and is called only when its turn comes.
    """

    first: Ns
    last: Ns
    rank: int
    read: Callable[[], tuple[Column, Fetch[T]] | None]


def merged(runs: Iterable[Run[T]], *, newest_first: bool) -> Iterator[T]:
    """Yields the messages of all runs by log time, ties in file order; or exactly the reverse.

    A run is read only when it can hold the next message, and dropped at its end: only the runs that
    overlap in time are in memory.
    """
    # Negated, what is newest first ascends as well.
    sign = -1 if newest_first else 1
    waiting = sorted(
        (-run.last if newest_first else run.first, sign * run.rank, run) for run in runs
    )
    held: list[tuple[Ns, int, int]] = []  # log time, rank and place of each message, in order
    fetches: dict[int, Fetch[T]] = {}
    for nth, (_, rank, run) in enumerate(waiting, start=1):
        read = run.read()
        if read is not None:
            column, fetches[rank] = read
            times, places = (values * sign for values in column)
            held += zip(times.tolist(), repeat(rank), places.tolist(), strict=False)
            held.sort()
        del read
        end = bisect_left(held, waiting[nth][:1]) if nth < len(waiting) else len(held)
        for time, of_rank, place in held[:end]:
            yield fetches[of_rank](sign * place, sign * time)
        del held[:end]
        fetches = {of_rank: fetches[of_rank] for _, of_rank, _ in held}

"""How many messages of a topic there are in pieces of a window, each counted once.

The index knows that of every bag in which no piece ends, where no other recording may hold copies.
Of the rest the times of messages are looked at, and where recordings overlap those that count.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.spans import united
from ros2_memory.history.scan import scan

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray


class Counted(NamedTuple):
    """How many messages a piece holds, or a part of it, and when the first and the last were.

    `piece` is its number: how many edges do not lie after it.
    """

    piece: int
    messages: int
    first: Ns
    last: Ns


def count_messages(
    view: View, topic: str, window: TimeWindow, edges: IntArray
) -> Iterator[Counted]:
    """Yields how many messages of a topic lie in a window, of parts that no edge cuts.

    Messages that cannot be decoded count, too.

    Args:
        view: the call's.
        topic: its name.
        window: of log time.
        edges: where pieces begin (ns), ascending.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    if view.stream.may_be_relatched([topic]):
        for rows in scan(view, topic, window, columns=False):
            yield from _in_pieces(rows.times, edges)
        return
    shared = view.snapshot.timeline.shared_times
    ends = [stop for _, stop in shared]
    to_read: dict[str, tuple[Ns, Ns]] = {}
    for first, last, bag in view.stream.overlapping_bags([topic], window):
        near = bisect_right(ends, first)
        is_shared = near < len(shared) and shared[near][0] <= last
        piece, until = np.searchsorted(edges, [first, last], side="right").tolist()
        if piece == until and not is_shared and window.covers(first, last):
            yield Counted(piece, sum(known.count for known in bag.summary.of(topic)), first, last)
        else:
            to_read[bag.file] = (first, last + 1)
    near_those = united(sorted(to_read.values()))
    for rows in scan(view, topic, window, columns=False, within=near_those):
        for bag, positions in rows.bag_rows():
            if bag.file in to_read:
                yield from _in_pieces(rows.times[positions], edges)


def _in_pieces(times: IntArray, edges: IntArray) -> Iterator[Counted]:
    """Yields the counts of ascending times."""
    if not times.size:
        return
    bounds = np.searchsorted(times, edges)
    starts = [0, *bounds.tolist()]
    stops = [*bounds.tolist(), times.size]
    for piece, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        if start < stop:
            yield Counted(piece, stop - start, int(times[start]), int(times[stop - 1]))

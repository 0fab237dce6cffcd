"""How many messages of a topic there are in pieces of a window, each counted once.

The index knows that of every bag in which no piece ends, where no other recording may hold copies.
Of the rest the times of messages are read, and where recordings overlap those that count.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.scan import scan

if TYPE_CHECKING:
    from collections.abc import Iterator

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
        yield from _scanned(view, topic, window, edges)
        return
    shared = view.stream.duplicate_spans(topic, window)
    ends = [stop for _, stop in shared]
    for span in view.stream.overlapping_bags([topic], window):
        near = bisect_right(ends, span.first)
        is_shared = near < len(shared) and shared[near][0] <= span.last
        piece, until = np.searchsorted(edges, [span.first, span.last], side="right").tolist()
        if piece == until and not is_shared and window.covers(span.first, span.last):
            messages = sum(known.count for known in span.bag.summary.of(topic))
            yield Counted(piece, messages, span.first, span.last)
            continue
        times = np.sort(np.array(view.bags.log_times(span.bag, topic, window), np.int64))
        for start, stop in shared[near:]:
            if start > span.last:
                break
            times = times[(times < start) | (times >= stop)]
        yield from _in_pieces(times, edges)
    for start, stop in shared:
        yield from _scanned(view, topic, TimeWindow(start, stop).intersect(window), edges)


def _scanned(view: View, topic: str, window: TimeWindow, edges: IntArray) -> Iterator[Counted]:
    if not window.empty:
        for rows in scan(view, topic, window, columns=False):
            yield from _in_pieces(rows.times, edges)


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

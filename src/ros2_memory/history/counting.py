"""How many messages of a topic there are in pieces of a window, each counted once; some of them.

The index knows that of every bag in which no piece ends, where no other recording may hold copies.
Of the rest the times of messages are looked at, and where recordings overlap those that count.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, united
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.scan import open_scan, scan
from ros2_memory.messages.to_json import evenly

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import TopicColumn
    from ros2_memory.storage.base import IntArray


class Counted(NamedTuple):
    """How many messages each piece holds, and the log times of its first and last one."""

    messages: IntArray
    first: IntArray
    last: IntArray

    def add(self, pieces: IntArray, messages: IntArray, first: IntArray, last: IntArray) -> None:
        """Adds messages to pieces, each of which may be named several times."""
        np.add.at(self.messages, pieces, messages)
        np.minimum.at(self.first, pieces, first)
        np.maximum.at(self.last, pieces, last)

    def add_times(self, times: IntArray, edges: IntArray) -> None:
        """Adds a message at each of some log times (ns) to the piece that it lies in."""
        pieces = np.searchsorted(edges, times, side="right")
        self.add(pieces, np.ones_like(times), times, times)


def count_messages(
    view: View, topic: str, window: TimeWindow, edges: IntArray, *, proves: bool = False
) -> Counted:
    """Returns how many messages of a topic lie in each piece of a window.

    Messages that cannot be decoded count, too.

    Args:
        view: the call's.
        topic: its name.
        window: of log time.
        edges: where pieces begin (ns), ascending; what is before the first is piece 0.
        proves: whether messages are read for their times, as indexes of bags may lie.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    size = len(edges) + 1
    counted = Counted(np.zeros(size, np.int64), np.full(size, MAX_NS), np.full(size, MIN_NS))
    if view.stream.may_be_relatched([topic]):
        for rows in scan(view, topic, window, columns=proves):
            counted.add_times(rows.times, edges)
        return counted
    shared = open_scan(view, topic, window).shared
    to_read: set[str] = set()
    spans: list[tuple[Ns, Ns]] = []
    for segment in view.timeline.segments_in(window):
        column = segment.column(topic)
        if column is None:
            continue
        bag_numbers, firsts, lasts, messages = column
        pieces, is_in, is_cut = _classify_bags(column, window, edges, shared)
        counted.add(pieces[is_in], messages[is_in], firsts[is_in], lasts[is_in])
        for row in np.flatnonzero(is_cut).tolist():
            # A bag has a row for each type of the topic.
            to_read.add(segment.bags[bag_numbers[row]].file)
            spans.append((int(firsts[row]), int(lasts[row]) + 1))
    near_those = united(sorted(spans))
    for rows in scan(view, topic, window, columns=proves, shared=shared, within=near_those):
        for _, positions in rows.bag_rows(to_read):
            counted.add_times(rows.times[positions], edges)
    return counted


def _classify_bags(
    column: TopicColumn, window: TimeWindow, edges: IntArray, shared: Spans
) -> tuple[IntArray, NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns the piece of each bag, which of them are counted whole, and which are to be read."""
    bags, firsts, lasts, _ = column
    pieces = np.searchsorted(edges, firsts, side="right")
    is_cut = pieces != np.searchsorted(edges, lasts, side="right")
    is_cut |= (firsts < window.start) | (lasts >= window.stop)
    # These are inclusive; spans are half-open, in order and apart.
    starts, stops = np.array([*shared, (MAX_NS, MAX_NS)], np.int64).T
    is_cut |= starts[np.searchsorted(stops, firsts, side="right")] <= lasts
    # Under none of its types is a bag counted that is read.
    is_cut = np.isin(bags, bags[is_cut])
    is_here = (firsts < window.stop) & (lasts >= window.start)
    return pieces, is_here & ~is_cut, is_here & is_cut


def pick(
    view: View, topic: str, window: TimeWindow, at_most: int
) -> tuple[int, Iterator[StoredMessage]]:
    """Returns how many messages of a topic a window holds, and `at_most` of them, evenly spaced.

    The first and the last are always among them. Each is read when it is its turn.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    edges = np.unique(view.bounds(topic, window)[0])
    counts = count_messages(view, topic, window, edges, proves=True).messages
    ends = np.cumsum(counts)
    chosen = np.array(evenly(int(ends[-1]), at_most), np.int64)
    opened = open_scan(view, topic, window)

    def read() -> Iterator[StoredMessage]:
        pieces = np.searchsorted(ends, chosen, side="right")
        bounds = [MIN_NS, *edges.tolist(), MAX_NS]
        for piece in np.unique(pieces).tolist():
            part = window.intersect(TimeWindow(bounds[piece], bounds[piece + 1]))
            nth = chosen[pieces == piece] - (ends[piece] - counts[piece])
            none = np.empty(0, np.int64)
            times = np.concatenate([none, *(rows.times for rows in opened.rows(among=part))])
            times = np.sort(times[(times >= part.start) & (times < part.stop)])
            yield from _at_positions(view, topic, times, nth.tolist())

    return int(ends[-1]), read()


def _at_positions(
    view: View, topic: str, times: IntArray, positions: Sequence[int]
) -> Iterator[StoredMessage]:
    """Yields the messages at some positions, which ascend, among all that have these times."""
    there = [nth for nth in positions if nth < times.size]  # fewer, where a bag was deleted since
    for time, equal in groupby(there, key=lambda nth: int(times[nth])):
        numbers = {nth - int(np.searchsorted(times, time)) for nth in equal}
        at_once = view.stream.messages([topic], TimeWindow(time, time + 1))
        yield from (stored for nth, stored in enumerate(at_once) if nth in numbers)

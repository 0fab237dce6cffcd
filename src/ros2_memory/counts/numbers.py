"""What numbers a topic held in each bin of a window: how many messages, least, greatest, mean."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow
from ros2_memory.history.bag_groups import groups_of
from ros2_memory.history.no_data import no_data_between, resolve_topic
from ros2_memory.history.view import open_span
from ros2_memory.insights.field_extremes import numbers_in

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from ros2_memory.core.timebase import Ns
    from ros2_memory.counts.bins import By
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.view import TimeRange, View
    from ros2_memory.results import BinColumn, Bins

    Times: TypeAlias = NDArray[np.int64]

MOST_READ: Final = 4_000
"""Messages that are read; where there are more, as many evenly spaced ones."""


class _Numbers:
    """The numbers of one field in one bin."""

    def __init__(self) -> None:
        self.count = 0
        self.sums: list[float] = []
        self.least = (math.inf, 0)
        self.most = (-math.inf, 0)

    def add(self, at: Ns, numbers: Sequence[float]) -> None:
        """Adds the numbers of the next message; of equal ones the first counts."""
        self.count += len(numbers)
        self.sums.append(math.fsum(numbers))
        low, high = min(numbers), max(numbers)
        if low < self.least[0]:
            self.least = (low, at)
        if high > self.most[0]:
            self.most = (high, at)


def count_range(
    memory: Memory,
    call: Call,
    topic: str,
    span: TimeRange,
    by: By,
    *,
    fields: Sequence[str] = (),
) -> Bins:
    """Returns how many messages of a topic each bin holds, and the numbers of fields in them.

    Raises:
        InvalidArgumentsError: there are too many bins, or too many fields for them.
        NoDataError: there is no message in the window.
        QueryTimeoutError: the call's time is over.
    """
    view, asked = open_span(memory, call, span)
    name = resolve_topic(view, topic)
    binned = BinnedWindow(view, asked, by, (name,))
    names = tuple(dict.fromkeys(fields))
    size = len(binned.bins.names)
    if len(names) * size > MOST_CELLS:
        raise InvalidArgumentsError(
            f"{len(names)} fields by {by} in {size} bins are too many for one reply: "
            "name fewer fields, or ask about a shorter window"
        )
    counts, first, last = _counted(view, name, binned)
    if not counts.any():
        raise no_data_between(view, (name,), asked)
    member = binned.bins.member
    binned.add("count", "count", (counts @ member).tolist(), int(counts.sum()))
    held = [counts.astype(bool) & each for each in member.T]
    binned.add("first", "time", [_extreme(first[each], min) for each in held], first.min())
    binned.add("last", "time", [_extreme(last[each], max) for each in held], last.max())
    if names:
        _add_numbers(view, name, binned, names)
    return binned.answer()


def _extreme(times: Times, which: Callable[[Iterable[Ns]], Ns]) -> Ns | None:
    return which(times.tolist()) if len(times) else None


def _counted(view: View, topic: str, binned: BinnedWindow) -> tuple[Times, Times, Times]:
    """Returns for each piece how many messages it holds, and when the first and the last came.

    Messages are read where recordings overlap; the times of messages where a bag lies in several
    pieces.
    """
    size = len(binned.bins.member)
    counts = np.zeros(size, np.int64)
    first, last = np.full(size, MAX_NS), np.full(size, MIN_NS)

    def add(piece: int, count: int, begin: Ns, end: Ns) -> None:
        counts[piece] += count
        first[piece] = min(first[piece], begin)
        last[piece] = max(last[piece], end)

    for group in groups_of(view.stream, topic, binned.asked):
        begin = min(each.first for each in group.bags)
        end = max(each.last for each in group.bags)
        pieces = binned.bins.pieces([begin, end])
        if group.is_inside and pieces[0] == pieces[1]:
            add(int(pieces[0]), group.count(), begin, end)
            continue
        times = np.array(group.times(), np.int64)
        where = binned.bins.pieces(times)
        for piece in np.unique(where).tolist():
            here = times[where == piece]
            add(piece, len(here), int(here.min()), int(here.max()))
    return counts, first, last


def _add_numbers(view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]) -> None:
    bins = range(len(binned.bins.names))
    cells = {field: [_Numbers() for _ in (*bins, "all")] for field in fields}
    total, chosen = view.pick(topic, binned.asked, MOST_READ)
    if len(chosen) < total:
        view.notes.add(
            f"min, max and mean are of {len(chosen)} of {total} messages, evenly spaced over the "
            "window: ask about a shorter one for all"
        )
    for each in chosen:
        message = view.bags.decode(each)
        if message is None:
            continue
        [among] = binned.bins.among([each.time])
        for field in fields:
            value = view.memory.extractor.exact_at(message, each.record.channel.type, field)
            numbers = [*numbers_in(value)]
            if numbers:
                for number in (*np.flatnonzero(among).tolist(), -1):
                    cells[field][number].add(each.time, numbers)
    for field in fields:
        _add_columns(binned, field, cells[field])


def _add_columns(binned: BinnedWindow, field: str, cells: Sequence[_Numbers]) -> None:
    """Adds the columns of a field; the last cell is that of all bins together."""
    if not cells[-1].count:
        binned.view.notes.add(f"{field} holds no number in the window")
        return
    columns: tuple[tuple[str, BinColumn, Callable[[_Numbers], float]], ...] = (
        ("min", "number", lambda cell: cell.least[0]),
        ("min_at", "time", lambda cell: cell.least[1]),
        ("max", "number", lambda cell: cell.most[0]),
        ("max_at", "time", lambda cell: cell.most[1]),
        ("mean", "number", lambda cell: math.fsum(cell.sums) / cell.count),
    )
    for name, kind, of in columns:
        *each, whole = [of(cell) if cell.count else None for cell in cells]
        binned.add(f"{field}.{name}", kind, each, whole)

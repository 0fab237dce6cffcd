"""What numbers a topic held in each bin of a window: how many messages, least, greatest, mean."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.counts.bins import BinnedWindow
from ros2_memory.history.bag_groups import groups_of
from ros2_memory.history.no_data import no_data_between, resolve_topic
from ros2_memory.history.view import open_span
from ros2_memory.insights.field_extremes import numbers_in

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.timebase import Ns
    from ros2_memory.counts.bins import By
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.view import TimeRange, View
    from ros2_memory.results import Bins

MOST_CELLS: Final = 124
"""Fields of all bins together that one reply has room for."""
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
    if not any(counts):
        raise no_data_between(view, (name,), asked)
    binned.add("count", "count", counts, sum(counts))
    binned.add("first", "time", first, min(each for each in first if each is not None))
    binned.add("last", "time", last, max(each for each in last if each is not None))
    if names:
        _add_numbers(view, name, binned, names)
    return binned.answer()


def _counted(
    view: View, topic: str, binned: BinnedWindow
) -> tuple[list[int], list[float | None], list[float | None]]:
    """Returns for each bin how many messages it holds, and when the first and the last came.

    Messages are read where recordings overlap; the times of messages where a bag lies in several
    bins.
    """
    size = len(binned.bins.names)
    counts = [0] * size
    first: list[float | None] = [None] * size
    last: list[float | None] = [None] * size

    def add(number: int, count: int, begin: Ns, end: Ns) -> None:
        counts[number] += count
        known = first[number], last[number]
        first[number] = begin if known[0] is None else min(known[0], begin)
        last[number] = end if known[1] is None else max(known[1], end)

    for group in groups_of(view.stream, topic, binned.asked):
        begin, end = (
            min(each.first for each in group.bags),
            max(each.last for each in group.bags),
        )
        pieces = binned.bins.pieces([begin, end])
        if group.is_inside and pieces[0] == pieces[1]:
            add(int(binned.bins.bin_of[pieces[0]]), group.count(), begin, end)
            continue
        times = np.array(group.times(), np.int64)
        for number in np.unique(found := binned.bins.bins(times)).tolist():
            here = times[found == number]
            add(number, len(here), int(here.min()), int(here.max()))
    return counts, first, last


def _add_numbers(view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]) -> None:
    cells = {
        (field, number): _Numbers() for field in fields for number in range(len(binned.bins.names))
    }
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
        number = int(binned.bins.bins([each.time])[0])
        for field in fields:
            value = view.memory.extractor.exact_at(message, each.record.channel.type, field)
            numbers = [*numbers_in(value)]
            if numbers:
                cells[field, number].add(each.time, numbers)
    for field in fields:
        _add_columns(
            binned, field, [cells[field, number] for number in range(len(binned.bins.names))]
        )


def _add_columns(binned: BinnedWindow, field: str, cells: Sequence[_Numbers]) -> None:
    some = [each for each in cells if each.count]
    if not some:
        binned.view.notes.add(f"{field} holds no number in the window")
        return
    least, most = min(each.least for each in some), max(each.most for each in some)
    mean = math.fsum(part for each in some for part in each.sums) / sum(each.count for each in some)

    def column(value: int, kind: str) -> list[float | None]:
        return [
            None if not each.count else (each.least if kind == "min" else each.most)[value]
            for each in cells
        ]

    binned.add(f"{field}.min", "number", column(0, "min"), least[0])
    binned.add(f"{field}.min_at", "time", column(1, "min"), least[1])
    binned.add(f"{field}.max", "number", column(0, "max"), most[0])
    binned.add(f"{field}.max_at", "time", column(1, "max"), most[1])
    means = [math.fsum(each.sums) / each.count if each.count else None for each in cells]
    binned.add(f"{field}.mean", "number", means, mean)

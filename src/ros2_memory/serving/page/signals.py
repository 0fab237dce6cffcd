"""The numbers of a field over a span, in bins: the least, the mean and the greatest of each."""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.errors import EpisodicError, InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.reply import rounded
from ros2_memory.core.timebase import NS_PER_S, unix_from_ns
from ros2_memory.counts.field_numbers import FieldReader
from ros2_memory.history.no_data import resolve_topic
from ros2_memory.history.view import View

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.reply import JsonObject
    from ros2_memory.core.timebase import Ns
    from ros2_memory.counts.field_numbers import FieldNumbers
    from ros2_memory.history.context import Call, Memory

MOST_SIGNALS: Final = 4
MOST_BINS: Final = 400

_BAGS_OF_A_BIN: Final = 2
"""From so many bags in a bin on, bags count as a whole, by their digests."""


class Signal(NamedTuple):
    """A field (dot-path) of a topic."""

    topic: str
    field: str

    @classmethod
    def parse(cls, text: str) -> Signal:
        """Returns the signal of `/topic:field`.

        Raises:
            InvalidArgumentsError: it has another form.
        """
        topic, colon, field = text.rpartition(":")
        if not (topic and colon and field):
            raise InvalidArgumentsError(f"a signal is /topic:field, not {text[:80]!r}")
        return cls(topic, field)


class _Part(NamedTuple):
    first: Ns
    last: Ns
    numbers: FieldNumbers


def signal_in(
    memory: Memory, call: Call, signal: Signal, window: TimeWindow, span: TimeWindow
) -> JsonObject:
    """Returns a signal in a window, in bins as wide as those of the whole `span`.

    An error in one signal is part of the answer; the others are still shown.
    """
    shown: JsonObject = {"topic": signal.topic, "field": signal.field}
    try:
        view = View(memory, call, window.stop)
        reader = FieldReader(view, resolve_topic(view, signal.topic), (signal.field,))
        width = max((span.stop - span.start) // MOST_BINS, 1)
        # Bins begin at the same times in every answer, so that these can be joined.
        window = TimeWindow(window.start - window.start % width, window.stop)
        edges = _edges(view, window, width)
        folded = reader.over(window, edges)
    except EpisodicError as error:
        return {**shown, "error": str(error)}
    parts = [
        _Part(first, last, numbers[0])
        for table in folded.parts
        for first, last, numbers in zip(*table, strict=True)
        if numbers[0].size
    ]
    if not parts:
        why = f"no number under {signal.field} in this time"
        return {**shown, "error": str(reader.failures[0]) if reader.failures else why}
    shown["from"] = round(unix_from_ns(window.start), 3)
    rows = _binned(parts, width)
    for name, column in zip(("t", "low", "mean", "high"), zip(*rows, strict=True), strict=True):
        shown[name] = [*column]
    if folded.since is not None:
        shown["since"] = round(unix_from_ns(folded.since), 3)
    return shown


def _edges(view: View, window: TimeWindow, width: Ns) -> Sequence[Ns]:
    """Returns where bags are cut; nowhere where bins hold whole ones."""
    bags = view.snapshot.timeline.overlapping(window)
    lengths = [each.end - each.start for each in bags]
    if lengths and width >= _BAGS_OF_A_BIN * median(lengths):
        return ()
    return range(window.start - window.start % width + width, window.stop, width)


def _binned(parts: Sequence[_Part], width: Ns) -> list[tuple[float | None, ...]]:
    """Returns for each bin with numbers its middle, and the least, mean and greatest number."""
    middles = np.array([(each.first + each.last) // 2 for each in parts], np.int64)
    bins = middles // width
    starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    sizes = np.array([each.numbers.size for each in parts], np.float64)
    totals = np.array([each.numbers.total for each in parts])
    lows = np.minimum.reduceat(np.array([each.numbers.low for each in parts]), starts)
    highs = np.maximum.reduceat(np.array([each.numbers.high for each in parts]), starts)
    means = np.add.reduceat(totals, starts) / np.add.reduceat(sizes, starts)
    times = np.add.reduceat(middles / NS_PER_S * sizes, starts) / np.add.reduceat(sizes, starts)
    columns = (lows, means, highs)
    return [
        (round(at, 3), *(rounded(each, 6) for each in row))
        for at, *row in zip(times.tolist(), *(each.tolist() for each in columns), strict=True)
    ]

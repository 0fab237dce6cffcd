"""The numbers of a field over a span, in bins: the least, the mean and the greatest of each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.errors import EpisodicError, InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.reply import JsonObject, rounded
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns
from ros2_memory.counts.column_numbers import PieceNumbers
from ros2_memory.history.no_data import resolve_topic
from ros2_memory.history.view import View

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.history.context import Call, Memory

MOST_SIGNALS: Final = 4
MOST_BINS: Final = 400


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
    size: int
    total: float
    low: float
    high: float


_Found: TypeAlias = "tuple[Sequence[_Part], Ns | None, Sequence[UndecodableError]]"
"""Numbers in order of time, since when they are known if not all were read, and failures."""


def signal_in(
    memory: Memory, call: Call, signal: Signal, window: TimeWindow, span: TimeWindow
) -> JsonObject:
    """Returns a signal in a window, in bins as wide as those of the whole `span`.

    An error in one signal is part of the answer; the others are still shown.
    """
    shown: JsonObject = {"topic": signal.topic, "field": signal.field}
    try:
        view = View(memory, call, window.stop)
        topic = resolve_topic(view, signal.topic)
        width = max((span.stop - span.start) // MOST_BINS, 1)
        # Bins begin at the same times in every answer, so that these can be joined.
        window = TimeWindow(window.start - window.start % width, window.stop)
        parts, since, failures = _numbers(view, topic, signal.field, window, width)
    except EpisodicError as error:
        return {**shown, "error": str(error)}
    if not parts:
        why = f"no number under {signal.field} in this time"
        return {**shown, "error": str(failures[0]) if failures else why}
    shown["from"] = round(unix_from_ns(window.start), 3)
    rows = _binned(parts, width)
    for name, column in zip(("t", "low", "mean", "high"), zip(*rows, strict=True), strict=True):
        shown[name] = [*column]
    if since is not None:
        shown["since"] = round(unix_from_ns(since), 3)
    return shown


def _numbers(view: View, topic: str, field: str, window: TimeWindow, width: Ns) -> _Found:
    """Returns the numbers of a field, of times that no edge of a bin cuts, in order."""
    inside = [
        (max(first, window.start), min(last, window.stop - 1))
        for first, last in view.timeline.recordings(topic).values()
        if window.overlaps(first, last)
    ]
    if not inside:
        return [], None, ()
    begin, end = min(first for first, _ in inside), max(last for _, last in inside)
    edges = np.arange(begin - begin % width + width, end + 1, width)
    numbers = PieceNumbers(view, topic, (field,), edges)
    numbers.collect(window)
    parts = [
        _Part(
            part.first,
            part.last,
            part.size,
            part.total,
            part.least.middle,
            -part.greatest.middle,
        )
        for piece in range(len(edges) + 1)
        for part in sorted(numbers.parts(0, piece))
    ]
    return parts, numbers.since, numbers.failures


def _binned(parts: Sequence[_Part], width: Ns) -> list[tuple[float | None, ...]]:
    """Returns for each bin with numbers its middle, and the least, mean and greatest number."""
    middles = np.array([(each.first + each.last) // 2 for each in parts], np.int64)
    bins = middles // width
    starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    sizes = np.array([each.size for each in parts], np.float64)
    totals = np.array([each.total for each in parts])
    lows = np.minimum.reduceat(np.array([each.low for each in parts]), starts)
    highs = np.maximum.reduceat(np.array([each.high for each in parts]), starts)
    # One of them may be exact, and the other rounded to beyond it.
    lows, highs = np.minimum(lows, highs), np.maximum(lows, highs)
    means = np.add.reduceat(totals, starts) / np.add.reduceat(sizes, starts)
    # Of a whole part the least and the greatest number are exact, and the sum is of rounded ones.
    means = np.clip(means, lows, highs)
    times = np.add.reduceat(middles / NS_PER_S * sizes, starts) / np.add.reduceat(sizes, starts)
    columns = (lows, means, highs)
    return [
        (round(at, 3), *(rounded(each, 6) for each in row))
        for at, *row in zip(times.tolist(), *(each.tolist() for each in columns), strict=True)
    ]

"""The rows of the page: when labels were in view, the numbers of a field, and the topics.

Of a topic it shows how often it speaks, when it did in a span, what can be plotted, and whether it
can place the robot: poses, and satellite receivers. Numbers come in bins: the least, the mean and
the greatest of each. Labels count without a place, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import united_tables
from ros2_memory.core.errors import (
    EpisodicError,
    InvalidArgumentsError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.reply import JsonObject, rounded
from ros2_memory.core.spans import enclosing
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns
from ros2_memory.counts.numbers import SUM_SCALE, Part, PieceNumbers
from ros2_memory.history.no_data import (
    resolve_topic,
    topics_of_robot,
    topics_that_show,
    topics_with,
)
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.insights.fields import fields_of
from ros2_memory.insights.recap import events_by_topic
from ros2_memory.insights.status import usual_rate

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.context import Call, Memory


MOST_LABELS: Final = 60
_BARS: Final = 400
"""At most so many bars of a label: what lies nearer than a pixel or two is drawn as one."""
_PATIENT_S: Final = 8.0


def labels_shown(memory: Memory, call: Call, window: TimeWindow) -> JsonObject:
    """Returns the labels that were in view longest, with how often, how long (s) and when.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    view = View(memory, call.within(_PATIENT_S), window.stop)
    least = memory.limits.min_score
    in_view = [
        events.visible for events in events_by_topic(view, window).values() if events is not None
    ]
    if least:
        in_view = [visible.scoring(least) for visible in in_view]
    rows = [
        _label(label, first, last, window)
        for label, (first, last) in united_tables(in_view).spans().items()
        if len(first)
    ]
    rows.sort(key=lambda row: (-float(str(row["seconds"])), str(row["label"])))
    shown: list[JsonValue] = [*rows[:MOST_LABELS]]
    return {"end": unix_from_ns(window.stop), "labels": shown, "labels_total": len(rows)}


def _label(label: str, first: Ints, last: Ints, window: TimeWindow) -> JsonObject:
    """Returns a row of a label, whose intervals are in order and do not overlap."""
    start, stop = first.clip(window.start), last.clip(None, window.stop)
    is_apart = start[1:] - stop[:-1] > (window.stop - window.start) // _BARS
    begins, ends = start[np.append(True, is_apart)], stop[np.append(is_apart, True)]
    pairs = zip(begins.tolist(), ends.tolist(), strict=True)
    return {
        "label": label,
        "sightings": len(first),
        "seconds": rounded(unix_from_ns(int((stop - start).sum())), 1),
        "bars": [[round(unix_from_ns(bound), 3) for bound in pair] for pair in pairs],
    }


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
        parts, since, failures = _signal_parts(view, topic, signal.field, window, width)
    except EpisodicError as error:
        return {**shown, "error": str(error)}
    if not parts:
        why = f"no number under {signal.field} in this time"
        return {**shown, "error": str(failures[0]) if failures else why}
    shown["from"] = round(unix_from_ns(window.start), 3)
    rows = _in_bins(parts, width)
    for name, column in zip(("t", "low", "mean", "high"), zip(*rows, strict=True), strict=True):
        shown[name] = [*column]
    if since is not None:
        shown["since"] = round(unix_from_ns(since), 3)
    return shown


def _signal_parts(
    view: View, topic: str, field: str, window: TimeWindow, width: Ns
) -> tuple[list[Part], Ns | None, Sequence[UndecodableError]]:
    """Returns the parts of a field's numbers in order; no edge of a bin cuts one.

    Besides from which log time on they are known (None where all were read), and failures.
    """
    inside = [
        (max(first, window.start), min(last, window.stop - 1))
        for first, last in view.timeline.recordings(topic).values()
        if window.overlaps(first, last)
    ]
    if not inside:
        return [], None, ()
    begin, end = enclosing(inside)
    edges = np.arange(begin - begin % width + width, end + 1, width)
    numbers = PieceNumbers(view, topic, (field,), edges)
    numbers.collect(window)
    pieces = range(len(edges) + 1)
    parts = [part for piece in pieces for part in sorted(numbers.parts(0, piece))]
    return parts, numbers.since, numbers.failures


def _in_bins(parts: Sequence[Part], width: Ns) -> list[tuple[float | None, ...]]:
    """Returns for each bin with numbers its middle, and the least, mean and greatest number."""
    middles = np.array([(part.first + part.last) // 2 for part in parts], np.int64)
    bins = middles // width
    starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    sizes = np.array([part.size for part in parts], np.float64)
    totals = np.array([part.total for part in parts])
    lows = np.minimum.reduceat(np.array([part.least.middle for part in parts]), starts)
    highs = np.maximum.reduceat(np.array([-part.greatest.middle for part in parts]), starts)
    # One of them may be exact, and the other rounded to beyond it.
    lows, highs = np.minimum(lows, highs), np.maximum(lows, highs)
    means = np.add.reduceat(totals, starts) / np.add.reduceat(sizes, starts) / SUM_SCALE
    # Of a whole part the least and the greatest number are exact, and the sum is of rounded ones.
    means = np.clip(means, lows, highs)
    times = np.add.reduceat(middles / NS_PER_S * sizes, starts) / np.add.reduceat(sizes, starts)
    columns = (lows, means, highs)
    return [
        (round(at, 3), *(rounded(value, 6) for value in row))
        for at, *row in zip(times.tolist(), *(column.tolist() for column in columns), strict=True)
    ]


MOST_TOPICS: Final = 200
MOST_NUMBERS: Final = 60
BINS: Final = 60
_MOST_TIMES: Final = 20_000
"""Messages of a topic of which each is counted where it is; more are spread over their bags."""
_LARGEST_BYTES: Final = 1_000_000
"""A message that is decoded to see what numbers it has: images have none that are worth a plot."""
_PLOTTED: Final = frozenset({"number", "list of numbers"})
_QUICK_S: Final = 2.0


def topics_shown(memory: Memory, call: Call, window: TimeWindow) -> JsonObject:
    """Returns the topics with counts and rates, their messages in each bin of a window, and more.

    `numbers` are the fields that can be plotted, by the newest message; `places_robot` lists the
    topics that can place the robot, and whether they are poses or fixes. Where time runs out,
    messages are taken to be spread evenly over their bags.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    view = View(memory, call.within(_QUICK_S), window.stop)
    topics = view.timeline.topics()
    return {
        "topics": [_topic_row(view, topic, window) for topic in topics[:MOST_TOPICS]],
        "topics_total": len(topics),
        "places_robot": _places_robot(view),
    }


def _topic_row(view: View, topic: str, window: TimeWindow) -> JsonObject:
    """Returns a topic's row, with the type under which it was recorded last."""
    by_type = view.census(topic)
    newest_type = max(by_type, key=lambda type_name: by_type[type_name].last)
    return {
        "topic": topic,
        "type": newest_type,
        "count": by_type[newest_type].messages,
        "rate_hz": usual_rate(view.snapshot, topic, view.limits.latching),
        "spoke": _spoke(view, topic, window).tolist(),
        "numbers": [*_numbers(view, topic)],
    }


def _spoke(view: View, topic: str, window: TimeWindow) -> Ints:
    """Returns how many messages each bin of a window has."""
    extents = [*view.timeline.extents(topic, window)]
    messages = sum(summary.count for extent in extents for summary in extent.bag.summary.of(topic))
    width = max((window.stop - window.start) // BINS, 1)
    longest = max((extent.last - extent.first for extent in extents), default=0)
    if longest > width and messages <= _MOST_TIMES:
        try:
            parts = [rows.times for rows in scan(view, topic, window, columns=False)]
        except QueryTimeoutError:
            pass
        else:
            return _binned(np.concatenate([np.zeros(0, np.int64), *parts]), window)
    spread = [
        np.linspace(extent.first, extent.last, min(summary.count, BINS), dtype=np.int64)
        for extent in extents
        for summary in extent.bag.summary.of(topic)
    ]
    return _binned(np.concatenate([np.zeros(0, np.int64), *spread]), window)


def _binned(times: Ints, window: TimeWindow) -> Ints:
    length: Ns = window.stop - window.start
    inside = times[(times >= window.start) & (times < window.stop)] - window.start
    return np.bincount((inside / length * BINS).astype(np.int64).clip(0, BINS - 1), minlength=BINS)


def _numbers(view: View, topic: str) -> list[str]:
    """Returns the fields of a topic's newest message that are numbers, as dot-paths."""
    newest = view.stream.last(topic)
    if newest is None or len(newest.record.payload) > _LARGEST_BYTES:
        return []
    message = view.bags.decode(newest)
    if message is None:
        return []
    value = view.extractor.exact(message, newest.type)
    numbers = [path or "data" for path, kind in fields_of(value) if kind in _PLOTTED]
    return numbers[:MOST_NUMBERS]


def _places_robot(view: View) -> list[JsonValue]:
    """Returns the topics that can place the robot; those that are its own come first."""

    def names(described: Iterable[str]) -> list[str]:
        return [topic.partition(" ")[0] for topic in described]

    of_robot = {*topics_of_robot(view, "position")}
    posed = names(topics_with(view, "position") or topics_that_show(view))
    posed.sort(key=lambda topic: (topic not in of_robot, topic))
    fixes = names(topics_with(view, "geodetic"))
    kinds = {**dict.fromkeys(fixes, "fixes"), **dict.fromkeys(posed, "poses")}
    return [{"topic": topic, "kind": kinds[topic]} for topic in dict.fromkeys([*posed, *fixes])]

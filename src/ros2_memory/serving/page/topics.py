"""The rows of the page: when labels were in view, the numbers of a field, and the topics.

A row of a topic tells how often it speaks, when it spoke in a span, which fields can be plotted,
and whether it can place the robot. Numbers come in bins: the least, the mean and the greatest of
each. Labels count without a place, too.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import united_tables
from ros2_memory.core.arrays import concatenated
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
    topics_with,
    unmapped_topics_with,
)
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.insights.fields import fields_of
from ros2_memory.insights.recap import events_by_topic
from ros2_memory.insights.status import usual_rate
from ros2_memory.insights.topic_events import note_left_out

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.context import Call, Memory


MOST_LABELS: Final = 60
_BARS: Final = 400
"""Most bars of a label. Bars that would be nearer than a pixel or two are drawn as one."""
_PATIENT_S: Final = 8.0


def labels_shown(memory: Memory, call: Call, window: TimeWindow) -> JsonObject:
    """Returns the labels that were in view longest: how often, for how many seconds, and when.

    Notes say of which topics sightings are left out, since they have too many.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    view = View(memory, call.within(_PATIENT_S), window.stop)
    least = memory.limits.min_score
    topics = events_by_topic(view, window)
    for topic, events in topics.items():
        note_left_out(view, topic, events)
    in_view = [events.visible for events in topics.values()]
    if least:
        in_view = [visible.scoring(least) for visible in in_view]
    rows = [
        _label_row(label, first, last, window)
        for label, (first, last) in united_tables(in_view).spans().items()
        if len(first)
    ]
    rows.sort(key=lambda row: (-float(str(row["seconds"])), str(row["label"])))
    shown: list[JsonValue] = [*rows[:MOST_LABELS]]
    return {
        "end": unix_from_ns(window.stop),
        "labels": shown,
        "labels_total": len(rows),
        "notes": [*view.notes.sentences()],
    }


def _label_row(label: str, first: Ints, last: Ints, window: TimeWindow) -> JsonObject:
    """Returns the row of a label from its intervals, which are in order and do not overlap."""
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
    """Returns the numbers of a field as parts in order, none of which crosses the edge of a bin.

    Also the log time from which on all numbers were read (None if all were), and the failures.
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
    """Returns for each bin with numbers its middle (Unix s), least, mean and greatest number."""
    bins = np.array([part.first for part in parts], np.int64) // width
    starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    counts = np.array([part.size for part in parts], np.float64)
    bin_counts = np.add.reduceat(counts, starts)
    totals = np.array([part.total for part in parts])
    lows = np.minimum.reduceat(np.array([part.least.middle for part in parts]), starts)
    highs = np.maximum.reduceat(np.array([-part.greatest.middle for part in parts]), starts)
    # One of them may be exact, and the other rounded to beyond it.
    lows, highs = np.minimum(lows, highs), np.maximum(lows, highs)
    means = np.add.reduceat(totals, starts) / bin_counts / SUM_SCALE
    # The sum of a part is of rounded numbers, and may lie beyond the exact least and greatest.
    means = np.clip(means, lows, highs)
    times = (bins[starts] + 0.5) * width / NS_PER_S
    columns = zip(times.tolist(), lows.tolist(), means.tolist(), highs.tolist(), strict=True)
    return [
        (round(time, 3), rounded(low, 6), rounded(mean, 6), rounded(high, 6))
        for time, low, mean, high in columns
    ]


MOST_TOPICS: Final = 200
MOST_NUMBERS: Final = 60
BINS: Final = 60
_MOST_TIMES: Final = 20_000
"""If a topic has more messages, they count as spread evenly over their bags."""
_LARGEST_BYTES: Final = 1_000_000
"""A larger message is not decoded to see its numbers: images have none that are worth a plot."""
_PLOTTED: Final = frozenset({"number", "list of numbers"})
_QUICK_S: Final = 2.0


def topics_shown(memory: Memory, call: Call, window: TimeWindow) -> JsonObject:
    """Returns the topics with their counts and rates, and those that can place the robot.

    In a row `spoke` counts the messages in each of `BINS` bins of the window; if time runs out,
    they count as spread evenly over their bags. `numbers` are the fields of the newest message that
    can be plotted; none if time ran out before it was read.
    """
    view = View(memory, call.within(_QUICK_S), window.stop)
    topics = view.timeline.topics()
    # Before the counts, which may take all the time.
    numbers = {topic: _plottable_fields(view, topic) for topic in topics[:MOST_TOPICS]}
    return {
        "topics": [_topic_row(view, topic, window, numbers[topic]) for topic in numbers],
        "topics_total": len(topics),
        "places_robot": _places_robot(view),
    }


def _topic_row(view: View, topic: str, window: TimeWindow, numbers: Sequence[str]) -> JsonObject:
    """Returns a topic's row, with the type under which it was recorded last."""
    by_type = view.census(topic)
    newest_type = max(by_type, key=lambda type_name: by_type[type_name].last)
    return {
        "topic": topic,
        "type": newest_type,
        "count": by_type[newest_type].messages,
        "rate_hz": usual_rate(view.snapshot, topic, view.limits.latching),
        "spoke": _count_in_bins(view, topic, window).tolist(),
        "numbers": [*numbers],
    }


def _count_in_bins(view: View, topic: str, window: TimeWindow) -> Ints:
    """Returns how many messages each bin of a window has.

    They count as spread evenly over their bags if these are short, or reading them takes long.
    """
    columns = [segment.column(topic) for segment in view.timeline.segments_in(window)]
    rows = [np.stack(column[1:]) for column in columns if column is not None]
    firsts, lasts, counts = np.concatenate([np.empty((3, 0), np.int64), *rows], axis=1)
    edges = np.linspace(0, window.stop - window.start, BINS + 1)
    if (lasts - firsts > edges[1]).any() and counts.sum() <= _MOST_TIMES:
        with suppress(QueryTimeoutError):
            scanned = scan(view, topic, window, columns=False)
            times = concatenated(rows.times for rows in scanned)
            return np.histogram(times - window.start, edges)[0]
    before_edges = np.zeros(BINS + 1)
    for first, last, count in zip(firsts, lasts, counts, strict=True):
        before_edges += np.interp(edges, np.array((first, last + 1)) - window.start, (0, count))
    return np.diff(np.rint(before_edges)).astype(np.int64)


def _plottable_fields(view: View, topic: str) -> list[str]:
    """Returns the dot-paths of the numbers in a topic's newest message, if there is time for it."""
    newest = message = None
    with suppress(QueryTimeoutError):
        newest = view.stream.last(topic)
        if newest is not None and len(newest.record.payload) <= _LARGEST_BYTES:
            message = view.bags.decode(newest)
    if newest is None or message is None:
        return []
    value = view.extractor.exact(message, newest.type)
    paths = [path or "data" for path, kind in fields_of(value) if kind in _PLOTTED]
    return paths[:MOST_NUMBERS]


def _places_robot(view: View) -> list[JsonValue]:
    """Returns the topics that can place the robot: its own poses, other poses, then fixes."""
    of_robot = {*topics_of_robot(view, "position")}
    poses = _names(topics_with(view, "position") or unmapped_topics_with(view))
    poses.sort(key=lambda topic: (topic not in of_robot, topic))
    fixes = _names(topics_with(view, "geodetic"))
    return [
        {"topic": topic, "kind": "poses" if topic in poses else "fixes"}
        for topic in dict.fromkeys([*poses, *fixes])
    ]


def _names(described: Iterable[str]) -> list[str]:
    """Returns the topics of descriptions such as `/odom (nav_msgs/msg/Odometry)`."""
    return [topic.partition(" ")[0] for topic in described]

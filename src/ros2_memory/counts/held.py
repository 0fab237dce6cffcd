"""What a window held, in a row for each: labels of detections by label, values of a topic by value.

A label has how often, how long, when first and last it was seen, as in a recap: a thing may be
missed for `FLICKER_NS`, and is gone after `SILENCE_NS` without a message of the topic. A value has
how often and how long the topic held it.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import Condition, Contains, Equals
from ros2_memory.analysis.intervals import (
    IntervalPart,
    IntervalTable,
    VisibleInterval,
    joined,
    united,
    visible_in,
)
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united as united_spans
from ros2_memory.core.spans import without
from ros2_memory.core.text import Quoted, counted, listed, named, shortened
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.context import READING_S
from ros2_memory.history.coverage import (
    note_edges,
    note_unread,
    recorded_reach,
    recording_gaps,
    seconds,
    unix_text,
)
from ros2_memory.history.detections import Detected, DetectionRows, joined_detected
from ros2_memory.history.held_values import Held, HeldValues
from ros2_memory.history.no_data import matching_topics, no_data_between
from ros2_memory.history.robots import note_robots, note_robots_on
from ros2_memory.history.scan import blocks, scan
from ros2_memory.results import BinColumn, Bins

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.spans import Spans
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Scope


BY_LABEL: Final = "label"
ANY_LABEL: Final = ""
"""What `contains` takes for every label."""
_MOST_LABELS: Final = 60
_TEXT: Final = "std_msgs/msg/String"
_COLUMNS: Final[tuple[tuple[str, BinColumn], ...]] = (
    ("count", "count"),
    ("seconds", "duration"),
    ("first", "time"),
    ("last", "time"),
    ("best_score", "number"),
    ("most_at_once", "count"),
)


def count_labels(
    view: View,
    topic: str,
    condition: Condition,
    value: JsonValue,
    scope: Scope,
    *,
    asked: TimeWindow,
) -> Bins:
    """Returns a row for each label that meets a condition, those seen most often first.

    Args:
        view: what is searched.
        topic: the detectors' topic, or a glob.
        condition: on the labels; its least score holds for each detection.
        value: of the condition; `ANY_LABEL` takes every label.
        scope: when detections count.
        asked: the window that was asked for, of which notes say what the memory does not have.

    Raises:
        InvalidArgumentsError: the condition is not on texts, or names a field.
        QueryTimeoutError: the call's time runs out before any result.
    """
    test = condition.test
    if not isinstance(test, Contains | Equals) or condition.field is not None:
        raise InvalidArgumentsError(
            "by label takes labels of detections: give condition_type contains or equals, the "
            f'label as value ("{ANY_LABEL}" for all), and no field'
        )
    topics = matching_topics(view, topic)
    reader = LabelReader(view, scope, condition)
    reader.read(topics, lambda label: value == ANY_LABEL or test.passes(label))
    if reader.since is not None:
        view.notes.add_lack(
            f"not all before {unix_text(reader.since)} is counted: "
            f"{view.bags.filling_progress() or 'out of time; '}ask about a shorter window"
        )
    window = scope.window if reader.since is None else replace(scope.window, start=reader.since)
    table, elapsed = united(reader.visible), elapsed_in(view, window)
    rows = _label_rows(table, reader.most_at_once, elapsed)
    note_robots_on(view, topics, window)
    note_unread(view, asked, nothing=not rows, search=True)
    note_edges(view, asked)
    if unknown := elapsed.among(scope.unknown):
        view.notes.add(
            f"for {seconds(unknown)} it is not known whether what was seen counts: without poses, "
            "or without messages of the other topic"
        )
    texts = [topic for topic in topics if view.timeline.types_of(topic) == (_TEXT,)]
    if texts and not rows:
        view.notes.add(
            f"{listed(texts)} has texts: by label counts those that are JSON, an object with a "
            "label or a list of such, alone or in an object, and nothing deeper; leave by out to "
            "search texts"
        )
    if len(rows) > _MOST_LABELS:
        view.notes.add(f"the {_MOST_LABELS} of {len(rows)} labels that were seen most often")
    start, end = asked.asked()
    first, last = recorded_reach(view.snapshot, asked) or (start, end)
    return Bins(
        by=BY_LABEL,
        about=tuple(topics),
        start=min(max(start, reader.since or first), end),
        end=max(min(end, last), start),
        columns=_COLUMNS,
        rows=tuple(rows[:_MOST_LABELS]),
        all=_row_of_all(reader, table, elapsed),
        notes=view.notes.sentences(),
    )


class _DetectionBlock(NamedTuple):
    """Messages of a topic that no other ones of it lie between."""

    topic: str
    detected: Detected

    @property
    def first(self) -> Ns:
        return int(self.detected.log_times[0])

    @property
    def last(self) -> Ns:
        return int(self.detected.log_times[-1])


class LabelReader:
    """Reads what counts, the newest first: detections in a scope, of a condition's least score.

    Attributes:
        visible: when labels were in view.
        most_at_once: of each label, how many one message has at most.
        most_at_once_of_all: of all labels together.
        since: back to when all was read, where the time was over before; else None.
    """

    def __init__(self, view: View, scope: Scope, condition: Condition) -> None:
        self.visible: list[IntervalTable] = []
        self.most_at_once: Counter[str] = Counter()
        self.most_at_once_of_all = 0
        self.since: Ns | None = None
        self._view = view
        self._scope = scope
        self._least_score = condition.least_score if condition.min_score > 0 else -np.inf

    def read(self, topics: Sequence[str], wanted: Callable[[str], bool]) -> None:
        """Reads the detections of topics whose labels are wanted."""
        reading = self._view.call.partial_after(READING_S)
        reached: Ns | None = None
        parts: dict[str, list[IntervalPart]] = {}
        try:
            for window in self._scope.narrowed():
                parts = defaultdict(list)
                sources = (_detection_blocks(self._view, topic, window) for topic in topics)
                for block in heapq.merge(*sources, key=lambda block: -block.last):
                    parts[block.topic].append(self._read_block(block, wanted))
                    reached = block.first if len(topics) == 1 else block.last
                    if reading.expired():
                        raise QueryTimeoutError("the rest is left out")  # noqa: TRY301 - as by a scan
                self._add_intervals(parts)
        except QueryTimeoutError:
            if reached is None:
                raise
            self._add_intervals(parts)
            self.since = reached

    def _add_intervals(self, parts: Mapping[str, Sequence[IntervalPart]]) -> None:
        self.visible += [joined(parts_of_topic[::-1]).visible for parts_of_topic in parts.values()]

    def _read_block(self, block: _DetectionBlock, wanted: Callable[[str], bool]) -> IntervalPart:
        """Returns when wanted labels were in view in a block, by detections that count.

        How many of each one message has is taken up into `most_at_once`.
        """
        times, detections = block.detected.log_times, block.detected.found
        is_wanted = np.array([wanted(word) for word in detections.labels.words], np.bool_)
        counts = is_wanted[detections.labels.codes] & ~(detections.scores < self._least_score)
        if self._scope.is_bounded:
            # The newest first, as it reads what the other topic said.
            holds = [self._scope.holds_at(time) for time in times[::-1].tolist()]
            counts &= np.array(holds[::-1], np.bool_)[detections.rows]
        rows, codes = detections.rows[counts], detections.labels.codes[counts].astype(np.int64)
        labels = detections.labels.words
        if rows.size:
            pairs, counts_at_once = np.unique(np.stack((rows, codes)), axis=1, return_counts=True)
            for code, at_once in zip(pairs[1].tolist(), counts_at_once.tolist(), strict=True):
                self.most_at_once[labels[code]] = max(self.most_at_once[labels[code]], at_once)
            self.most_at_once_of_all = max(self.most_at_once_of_all, int(np.bincount(rows).max()))
        visible = visible_in(times, rows, codes, detections.scores[counts], labels)
        return IntervalPart(block.first, block.last, visible)


def _detection_blocks(view: View, topic: str, window: TimeWindow) -> Iterator[_DetectionBlock]:
    """Yields the messages of a topic in blocks that do not overlap, the newest first."""
    reader = DetectionRows(view)
    left_out = 0
    for overlapping in blocks(scan(view, topic, window, newest_first=True), newest_first=True):
        detected = joined_detected([reader.of(rows) for rows in overlapping])
        left_out += sum(map(len, overlapping)) - detected.log_times.size
        if detected.log_times.size:
            yield _DetectionBlock(topic, detected)
    if left_out:
        view.notes.add_lack(f"messages of {topic} that could not be decoded: {left_out}")


def _label_rows(
    table: IntervalTable, most_at_once: Mapping[str, int], elapsed: Elapsed
) -> list[tuple[str, tuple[float | None, ...]]]:
    """Returns the values of each label, those seen most often first."""
    intervals: defaultdict[str, list[VisibleInterval]] = defaultdict(list)
    for interval in table.intervals():
        intervals[interval.label].append(interval)
    rows = []
    for label, of_label in intervals.items():
        spans = [(interval.first, interval.last) for interval in of_label]
        rows.append((named(label), _row(of_label, spans, elapsed, most_at_once[label])))
    return sorted(rows, key=lambda row: (-(row[1][0] or 0), row[0]))


def _row(
    intervals: Sequence[VisibleInterval],
    spans: Sequence[tuple[Ns, Ns]],
    elapsed: Elapsed,
    most_at_once: int,
) -> tuple[float | None, ...]:
    """Returns the values of `_COLUMNS` for intervals, which last for some spans in all."""
    return (
        len(intervals),
        elapsed.among(spans),
        min((first for first, _ in spans), default=None),
        max((last for _, last in spans), default=None),
        max((interval.best for interval in intervals if interval.best is not None), default=None),
        most_at_once,
    )


def _row_of_all(
    reader: LabelReader, table: IntervalTable, elapsed: Elapsed
) -> tuple[float | None, ...]:
    """Returns the values of all labels together: for how long any of them was in view."""
    intervals = table.intervals()
    spans = united_spans((interval.first, interval.last) for interval in intervals)
    return _row(intervals, spans, elapsed, reader.most_at_once_of_all)


_MOST_VALUES: Final = 100
_LONGEST_VALUE: Final = 120


@dataclass(slots=True)
class _Tally:
    """How often and how long (ns) a value held, when it first began, and when it last ended."""

    name: str
    count: int
    length: Ns
    first: Ns
    last: Ns


def count_values(
    view: View,
    topic: str,
    asked: TimeWindow,
    *,
    fields: Sequence[str] = (),
    condition: Condition | None = None,
) -> Bins:
    """Returns a row for each value that held at some time of a window, that of the longest first.

    What lies outside of the window, or in a gap, counts to no length. An empty text is no value.

    Args:
        view: the call's.
        topic: its name.
        asked: the window.
        fields: the field of the messages that is meant, if it is not all that they have.
        condition: what values have to meet, if there is one.

    Raises:
        InvalidArgumentsError: more than one field is named, or there is no single value.
        NoDataError: the topic said nothing in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    if len(fields) > 1:
        raise InvalidArgumentsError("by value counts one field: name one in fields")
    values = HeldValues(view, topic, *fields, asked="by value", until=asked.stop)
    start, end = asked.asked()
    first, last = recorded_reach(view.snapshot, asked) or (start, end)
    start, stop = max(start, first), min(end, last) + 1
    try:
        values_held = values.during(start, stop)
    except QueryTimeoutError as error:
        # What is newer is known all the same.
        values_held = values.known[::-1]
        if not values_held:
            raise
        start = values.reached
        view.notes.add_lack(f"only what is after {unix_text(start)} is counted: {error}")
    if not values_held:
        raise no_data_between(view, (topic,), asked)
    outside = [(MIN_NS, start), *recording_gaps(view, TimeWindow(start, stop)), (stop, MAX_NS)]
    tallies = _tallies_of(values_held, elapsed_in(view, asked), united_spans(outside), condition)
    rows = sorted(tallies, key=lambda tally: (-tally.length, tally.first))
    if len(rows) > _MOST_VALUES:
        more = counted(len(rows) - _MOST_VALUES, "value")
        view.notes.add(f"{more} that held for a shorter time are left out; all counts them, too")
    note_unread(view, asked)
    note_edges(view, asked)
    note_robots(view, topic, asked)
    return Bins(
        by="value",
        about=(topic,),
        start=start,
        end=stop - 1,
        columns=(("count", "count"), ("seconds", "duration"), ("first", "time"), ("last", "time")),
        rows=tuple(
            (tally.name, (tally.count, tally.length, tally.first, tally.last))
            for tally in rows[:_MOST_VALUES]
        ),
        all=(
            sum(tally.count for tally in rows),
            sum(tally.length for tally in rows),
            min((tally.first for tally in rows), default=None),
            max((tally.last for tally in rows), default=None),
        ),
        notes=view.notes.sentences(),
    )


def _tallies_of(
    values: Sequence[Held],
    elapsed: Elapsed,
    outside: Spans,
    condition: Condition | None,
) -> list[_Tally]:
    """Returns a tally for each value that counts, whose length leaves out some times."""
    tallies: dict[str, _Tally] = {}
    uncounted: set[str] = set()
    for value in values:
        if value.word in uncounted:
            continue
        if value.word not in tallies:
            counts = condition is None or condition.matches({"value": value.exact})
            if value.is_blank or not counts:
                uncounted.add(value.word)
                continue
            tallies[value.word] = _Tally(_shown_value(value), 0, 0, value.start, value.stop)
        tally = tallies[value.word]
        tally.count += 1
        tally.length += elapsed.among(without([(value.start, value.stop)], outside))
        tally.last = value.stop
    return [*tallies.values()]


def _shown_value(held: Held) -> str:
    value = held.value
    name = value if isinstance(value, str) else json.dumps(value)
    return Quoted(shortened(name, _LONGEST_VALUE))

"""How often and how long each label of detections was in view, and how many were seen at once.

Spellings of a label ("Mug", "mugs") are one, as of things, under the most frequent of them.
A thing is in view as in a recap: a detector may miss it for `FLICKER_NS`, and it is gone after
`SILENCE_NS` without a message. Only detections that lie in the scope of the question, and that
have its least score, count.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter, defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import Condition, Contains, Equals
from ros2_memory.analysis.intervals import (
    IntervalTable,
    VisibleInterval,
    united_tables,
    visible_in,
)
from ros2_memory.analysis.topic_events import TopicEvents, joined_visible
from ros2_memory.core.arrays import numbered, pair_counts
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.reply import rounded
from ros2_memory.core.spans import united
from ros2_memory.core.text import Reason, listed, named
from ros2_memory.counts.bins import HELD_COLUMNS
from ros2_memory.history.context import READING_S, Note
from ros2_memory.history.coverage import note_unread, seconds, shown_span, unix_text
from ros2_memory.history.detections import Detected, DetectionRows, joined_detected
from ros2_memory.history.no_data import matching_topics
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.scan import blocks, read_until_late, scan
from ros2_memory.results import Bins
from ros2_memory.things.labels import Labels

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.core.arrays import Flags
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Scope
    from ros2_memory.results import BinColumn

BY_LABEL: Final = "label"
_MOST_LABELS: Final = 60
_TEXT: Final = "std_msgs/msg/String"
_UNDECODED: Final = Reason("that could not be decoded", "topic", of="messages of ")
_COLUMNS: Final[tuple[tuple[str, BinColumn], ...]] = (
    *HELD_COLUMNS,
    ("best_score", "number"),
    ("most_at_once", "count"),
)


class SeenLabels(NamedTuple):
    """When labels were in view, and how many of them were seen at once.

    Attributes:
        visible: the intervals in which each label was in view, by its key.
        name_of: returns the label to show for a key.
        most_at_once: for each key, the most detections of it in one message.
        most_of_all: the most detections of all these labels in one message.
        since: log time after which everything was read, if time ran out; else None.
    """

    visible: IntervalTable
    name_of: Callable[[str], str]
    most_at_once: Counter[str]
    most_of_all: int
    since: Ns | None


class _TopicBlock(NamedTuple):
    """Consecutive messages of a detector's topic; no other block of the topic overlaps them."""

    topic: str
    detected: Detected


class _SeenBlock(NamedTuple):
    """What was in view in a block. See `SeenLabels`.

    `source` names its topic and window; `spellings` counts the detections of each label.
    """

    source: str
    events: TopicEvents
    spellings: Counter[str]
    most_at_once: Counter[str]
    most_of_all: int


class _LabelRow(NamedTuple):
    """The values of `_COLUMNS` for one label."""

    occurrences: int
    length: Ns
    first: Ns | None
    last: Ns | None
    best_score: float | None
    most_at_once: int


def count_labels(
    view: View,
    topic: str,
    condition: Condition,
    scope: Scope,
    *,
    any_label: bool,
    asked: TimeWindow,
) -> Bins:
    """Returns a row for each label that meets a condition, those seen most often first.

    Args:
        view: the view of this call.
        topic: the topic of a detector, or a glob.
        condition: the test for labels, and the least score of a detection.
        scope: the times and places in which detections count.
        any_label: whether every label counts, whatever the test says.
        asked: the window that the client asked for; notes say what of it is not recorded.

    Raises:
        InvalidArgumentsError: the condition is not on texts, or names a field.
        QueryTimeoutError: the call's time runs out before any result.
    """
    test = condition.test
    if not isinstance(test, Contains | Equals) or condition.field is not None:
        raise InvalidArgumentsError(
            "by label takes labels of detections: give condition_type contains or equals, the "
            'label as value ("" for all), and no field'
        )
    topics = matching_topics(view, topic)
    seen = read_labels(
        view, topics, scope, condition, lambda label: any_label or test.passes(label)
    )
    if seen.since is not None:
        view.notes.add_lack(
            f"not all before {unix_text(seen.since)} is counted: "
            f"{view.bags.filling_progress() or 'out of time; '}ask about a shorter window"
        )
    window = scope.window if seen.since is None else replace(scope.window, start=seen.since)
    elapsed = view.elapsed_in(window)
    rows = _label_rows(seen, elapsed)
    note_robots_on(view, topics, window)
    note_unread(view, asked, nothing=not rows, search=True)
    _note_labels(view, topics, elapsed.among(scope.unknown), len(rows))
    start, end = shown_span(view.snapshot, asked)
    return Bins(
        by=BY_LABEL,
        about=tuple(topics),
        start=min(max(start, seen.since or start), asked.asked()[1]),
        end=max(end, asked.asked()[0]),
        columns=_COLUMNS,
        rows=tuple(rows[:_MOST_LABELS]),
        all=_row(seen.visible.intervals(), elapsed, seen.most_of_all),
        notes=view.notes.sentences(),
    )


def _note_labels(view: View, topics: Sequence[str], unknown: Ns, labels: int) -> None:
    """Notes why labels may be missing; `unknown` is in ns, `labels` is the number of all rows."""
    if unknown:
        view.notes.add(
            f"for {seconds(unknown)} it is not known whether what was seen counts: without poses, "
            "or without messages of the other topic"
        )
    texts = [topic for topic in topics if view.timeline.types_of(topic) == (_TEXT,)]
    if texts and not labels:
        view.notes.add(
            f"{listed(texts)} has texts: by label counts those that are JSON, an object with a "
            "label or a list of such, alone or in an object, and nothing deeper; leave by out to "
            "search texts"
        )
    elif not labels:
        view.notes.add(
            f"by label counts detections alone: leave by out to search all that {listed(topics)} "
            "said"
        )
    if labels > _MOST_LABELS:
        view.notes.add(f"the {_MOST_LABELS} of {labels} labels that were seen most often")


def _label_rows(seen: SeenLabels, elapsed: Elapsed) -> list[tuple[str, _LabelRow]]:
    """Returns each label with its row, those seen most often first."""
    intervals_of: defaultdict[str, list[VisibleInterval]] = defaultdict(list)
    for interval in seen.visible.intervals():
        intervals_of[interval.label].append(interval)
    rows = [
        (named(seen.name_of(key)), _row(intervals, elapsed, seen.most_at_once[key]))
        for key, intervals in intervals_of.items()
    ]
    return sorted(rows, key=lambda named_row: (-named_row[1].occurrences, named_row[0]))


def _row(intervals: Sequence[VisibleInterval], elapsed: Elapsed, most_at_once: int) -> _LabelRow:
    """Returns the row of intervals. Time in which several overlap counts once."""
    spans = united((interval.first, interval.last) for interval in intervals)
    scores = [interval.best for interval in intervals if interval.best is not None]
    return _LabelRow(
        len(intervals),
        elapsed.among(spans),
        spans[0][0] if spans else None,
        spans[-1][1] if spans else None,
        rounded(max(scores), 6) if scores else None,
        most_at_once,
    )


def read_labels(
    view: View,
    topics: Sequence[str],
    scope: Scope,
    condition: Condition,
    is_wanted: Callable[[str], bool],
) -> SeenLabels:
    """Returns when the wanted labels were in view in a scope.

    Detections below the least score of the condition do not count.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    least_score = condition.least_score if condition.min_score > 0 else -math.inf

    def counting(detected: Detected) -> Flags:
        detections, labels = detected.found, detected.found.labels
        is_counted = np.array([*map(is_wanted, labels.words)], np.bool_)
        counts: Flags = is_counted[labels.codes] & ~(detections.scores < least_score)
        if scope.is_bounded:
            # A scope reads what the other topics said from the newest message back.
            holds = [*map(scope.holds_at, detected.log_times[::-1].tolist())]
            counts &= np.array(holds[::-1], np.bool_)[detections.rows]
        return counts

    labels = Labels(view.limits.labels)
    newest_first = _seen_blocks(view, topics, scope, counting, labels.key)
    seen_blocks, since = read_until_late(view, newest_first, READING_S)
    parts: defaultdict[str, list[TopicEvents]] = defaultdict(list)
    most_at_once, spellings = Counter[str](), Counter[str]()
    for block in seen_blocks:
        parts[block.source].append(block.events)
        most_at_once |= block.most_at_once
        spellings += block.spellings
    return SeenLabels(
        united_tables([joined_visible(newest[::-1]) for newest in parts.values()]),
        labels.one_spelling(spellings),
        most_at_once,
        max((block.most_of_all for block in seen_blocks), default=0),
        since,
    )


def _seen_blocks(
    view: View,
    topics: Sequence[str],
    scope: Scope,
    counting: Callable[[Detected], Flags],
    key_of: Callable[[str], str],
) -> Iterator[tuple[Ns, _SeenBlock]]:
    """Yields what was in view in each block, newest first, and a log time.

    Nothing that is later than this time follows. `counting` says which detections count.
    """
    for nth, window in enumerate(scope.narrowed()):
        by_topic = (_topic_blocks(view, topic, window) for topic in topics)
        newest_first = heapq.merge(*by_topic, key=lambda block: -block.detected.log_times[-1])
        for topic, detected in newest_first:
            # Blocks of different topics may overlap.
            reached = detected.log_times[0 if len(topics) == 1 else -1]
            counts = counting(detected)
            yield int(reached), _seen_in_block(f"{nth} {topic}", detected, counts, key_of)


def _topic_blocks(view: View, topic: str, window: TimeWindow) -> Iterator[_TopicBlock]:
    """Yields the messages of a topic in blocks that do not overlap, newest first."""
    reader = DetectionRows(view)
    left_out = 0
    for overlapping in blocks(scan(view, topic, window, newest_first=True), newest_first=True):
        detected = joined_detected([reader.read(rows) for rows in overlapping])
        left_out += sum(map(len, overlapping)) - detected.log_times.size
        if detected.log_times.size:
            yield _TopicBlock(topic, detected)
    if left_out:
        view.notes.add_lack(Note(_UNDECODED, topic, str(left_out)))


def _seen_in_block(
    source: str, detected: Detected, counts: Flags, key_of: Callable[[str], str]
) -> _SeenBlock:
    """Returns when labels were in view in a block, by the detections that count."""
    times, detections = detected.log_times, detected.found
    words = detections.labels.words
    rows, written = detections.rows[counts], detections.labels.codes[counts]
    keys, key_codes = numbered(map(key_of, words))
    codes = key_codes[written]
    _, code_of_pair, sizes = pair_counts(rows, codes).T
    most_of_codes = np.zeros(len(keys), np.int64)
    np.maximum.at(most_of_codes, code_of_pair, sizes)
    spellings = np.bincount(written, minlength=len(words)).tolist()
    return _SeenBlock(
        source,
        TopicEvents(
            int(times[0]),
            int(times[-1]),
            visible_in(times, rows, codes, detections.scores[counts], keys),
        ),
        Counter(dict(zip(words, spellings, strict=True))),
        Counter(dict(zip(keys, most_of_codes.tolist(), strict=True))),
        int(np.bincount(rows).max(initial=0)),
    )

"""How often and how long a condition held in each bin of a window, or each label or value did.

What counts as once:

- A boolean that is asked for holds from the message in which it toggles to it until it toggles
  back, or until nothing is recorded, and not through silences of more than `SILENCE_NS` on a topic
  that is neither latched nor rare. It counts where it is seen to toggle.
- A text on a topic of detections is a label. A thing is in view as in a recap: it may be missed
  for `FLICKER_NS`, since detectors miss things now and then, and it is gone after `SILENCE_NS`
  without a message. These and booleans are counted by the topic's events; labels in a scope, or of
  a least score, by its detections.
- Any other condition, also a text that is no label, holds in sightings, as `find_matches` returns
  them; these are read.
- By value, what a topic held from one message to the next that says otherwise.
"""

from __future__ import annotations

import heapq
import json
import math
from bisect import bisect_left
from collections import Counter, defaultdict
from dataclasses import replace
from itertools import groupby, pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.conditions import Condition, Contains, Equals
from ros2_memory.analysis.facts import FLAG, has_errors, has_events
from ros2_memory.analysis.intervals import (
    FLICKER_NS,
    SILENCE_NS,
    IntervalPart,
    IntervalTable,
    VisibleInterval,
    joined,
    united,
    visible_in,
)
from ros2_memory.analysis.topic_events import TopicEvents, joined_events
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, without
from ros2_memory.core.spans import united as united_spans
from ros2_memory.core.text import Quoted, counted, listed, named, shortened
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.counts.bins import BinnedWindow, By
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.context import READING_S, Call, Memory
from ros2_memory.history.coverage import (
    note_edges,
    note_unread,
    reached,
    recording_gaps,
    seconds,
    shown_span,
    unix_text,
)
from ros2_memory.history.detections import Detected, DetectionRows, joined_detected
from ros2_memory.history.held_values import Held, HeldValues, held_at, held_until, holds_on, is_text
from ros2_memory.history.no_data import matching_topics, no_data_between, require_recorded
from ros2_memory.history.reverse_search import condition_of
from ros2_memory.history.robots import note_robots, note_robots_on
from ros2_memory.history.scan import blocks, in_time, scan
from ros2_memory.history.view import TimeRange, View, clamped, open_search
from ros2_memory.insights.sightings import held_spans, read_sightings
from ros2_memory.insights.topic_events import events_back, flags_before
from ros2_memory.places.where import Scope, Where, WhileCondition, heard_times, parse_where
from ros2_memory.results import BinColumn, Bins
from ros2_memory.things.unseen import notes_on_never

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import JsonValue

    _TrueSpans: TypeAlias = list[tuple[Ns, Ns, bool]]
    """From when to when something was true, and whether it is known to have begun then."""
    _Held: TypeAlias = tuple[Ints | None, Ns | None]
    """Such times, N x 3, and since when they are known, if not all are; None: it is not clear."""

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
_TRUTHS = {"true": True, "false": False}


def count_matches(
    memory: Memory,
    call: Call,
    topic: str,
    condition_type: str,
    value: JsonValue,
    *,
    by: By | Literal["label", "value"],
    field: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    last_s: float | None = None,
    min_score: float | None = None,
    where: JsonValue = None,
    during: Sequence[WhileCondition] = (),
) -> Bins:
    """Returns how often and how long a condition held in each bin, and how long was recorded.

    `by` label a row for each label of detections that meets it, `""` for all; see `count_labels`.

    With `where` or `during` only while the robot was there, or other topics met conditions; `by`
    place, the places of `where` have the rows, and what was elsewhere counts there.

    Raises:
        InvalidArgumentsError: nothing can meet the condition, the bounds make no window, or there
            are too many bins.
        NoDataError: nothing is recorded in the window, or no such topic.
        QueryTimeoutError: the call's time runs out before any result.
    """
    span = TimeRange(start_s, end_s, last_s)
    view, _, window = open_search(memory, call, span)
    sought = "any" if by == BY_LABEL and value == ANY_LABEL else value
    condition = condition_of(view, topic, condition_type, sought, field=field, min_score=min_score)
    asked = clamped(view, window)
    if by == BY_LABEL:
        window = reached(view.snapshot, asked)
        require_recorded(view, asked if window.empty else window)
        scope = Scope(view, window, where, during)
        return count_labels(view, topic, condition, value, scope, asked=asked)
    topics = matching_topics(view, topic)
    if by == "value":
        return _by_value(view, topics, asked, condition, is_bounded=bool(where or during))
    places: Where | None = None
    if by == "place" and where is not None:
        places, where = parse_where(memory.limits, where), None
    binned = BinnedWindow(view, asked, by, topics, places)
    note_robots_on(view, topics, binned.counted)
    scope = Scope(view, binned.counted, where, during)
    held, since, too_many = None, None, ""
    if isinstance(condition.test, Contains | Equals):
        held, since = _held_by_events(binned, topics, condition, value, scope)
    if held is None:
        held, since, too_many = read_sightings(view, topic, condition, scope)
    binned.count_since(since, too_many)
    binned.add_heard("topic_s", topics)
    binned.add_unknown(scope.unknown)
    binned.add_held(held)
    if not held.size:
        bounded = scope.is_bounded
        view.notes.add(
            *notes_on_never(view, topic, condition, asked, min_score, is_bounded=bounded)
        )
    return binned.answer()


def _by_value(
    view: View,
    topics: Sequence[str],
    asked: TimeWindow,
    condition: Condition,
    *,
    is_bounded: bool,
) -> Bins:
    """Returns how often and how long a topic held each value that meets a condition.

    Raises:
        InvalidArgumentsError: it is not one topic, or only some of its values would count.
    """
    if len(topics) > 1:
        raise InvalidArgumentsError(f"by value counts one topic: name one of {listed(topics)}")
    if is_bounded:
        raise InvalidArgumentsError("where, while cannot be combined with by value")
    fields = () if condition.field is None else (condition.field,)
    wanted = replace(condition, field="value")
    return count_values(view, topics[0], asked, fields=fields, condition=wanted)


def _held_by_events(
    binned: BinnedWindow,
    topics: Sequence[str],
    condition: Condition,
    value: JsonValue,
    scope: Scope,
) -> _Held:
    """Returns when a boolean or a label held in a scope, and since when that is known.

    None where the condition is on neither.
    """
    types = {name for topic in topics for name in binned.view.timeline.types_of(topic)}
    if not any(map(has_events, types)):
        return None, None
    wanted = value if isinstance(value, bool) else _TRUTHS.get(str(value).strip().casefold())
    if wanted is not None:
        # Texts that a topic had before are no events.
        if len(types) > 1 or len(topics) > 1:
            return None, None
        return _boolean_held(binned, topics[0], condition, scope, wanted=wanted)
    may_be_label = isinstance(value, str) and condition.field is None
    if not may_be_label or any(map(has_errors, types)):
        return None, None
    return _label_held(binned, topics, condition, scope)


def _boolean_held(
    binned: BinnedWindow, topic: str, condition: Condition, scope: Scope, *, wanted: bool
) -> _Held:
    """Returns when a boolean of a topic held; None where it is not clear which one is meant."""
    view = binned.view
    if not condition.field and _has_lists(view, topic):  # booleans in them are no events
        return None, None
    parts, since = _events_in_order(view, topic, binned.counted)
    before = _met_before(binned, topic, condition) if since is None else None
    spans = _flag_spans(binned, topic, parts, condition, before, wanted=wanted)
    if spans is None:
        return None, None
    _note_uncounted(view, topic, parts)
    counted, end = _in_scope(spans, scope)
    return held_spans(counted), since if end is None else end


def _in_scope(spans: _TrueSpans, scope: Scope) -> tuple[_TrueSpans, Ns | None]:
    """Returns the parts of spans in a scope, and since when they are known, if time is over."""
    counted: _TrueSpans = []
    try:
        for start, stop, is_begun in reversed(spans):
            parts = scope.parts_of(start, stop)
            counted += [(first, last, is_begun and first == start) for first, last in parts]
    except QueryTimeoutError:
        if not counted:
            raise
        return sorted(counted), min(start for start, _, _ in counted)
    return sorted(counted), None


def _has_lists(view: View, topic: str) -> bool:
    """Returns whether the newest message of a topic has a list, which may hold booleans."""
    message = view.stream.last(topic)
    values = [None if message is None else view.value(message)]
    while values:
        value = values.pop()
        if isinstance(value, list):
            return True
        if isinstance(value, dict):
            values.extend(value.values())
    return False


def _events_in_order(
    view: View, topic: str, window: TimeWindow
) -> tuple[list[TopicEvents], Ns | None]:
    """Returns the events of a topic in order, and since when they are known, if not all are.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    parts, since = in_time(view, events_back(view, topic, window), READING_S)
    return parts[::-1], since


def _note_uncounted(view: View, topic: str, parts: Sequence[TopicEvents]) -> None:
    left_out = sum(part.left_out for part in parts)
    if left_out:
        view.notes.add(f"{topic} changes too often to count all: {left_out} more")
    undecodable = sum(part.undecodable for part in parts)
    if undecodable:
        view.notes.add_lack(f"messages of {topic} that could not be decoded: {undecodable}")


def _label_held(
    binned: BinnedWindow, topics: Sequence[str], condition: Condition, scope: Scope
) -> _Held:
    """Returns when a thing with a label was in view; None where no label meets a condition."""
    view, matches = binned.view, Condition(condition.test).matches
    if scope.is_bounded or condition.min_score or len(topics) > 1:
        seen = read_labels(view, topics, scope, condition, matches)
        visible, since = seen.visible, seen.since
    else:
        events, since = _events_in_order(view, topics[0], binned.counted)
        parts = [
            IntervalPart(
                part.first,
                part.last,
                part.visible.without(
                    [label for label in part.visible.labels if not matches(label)]
                ),
            )
            for part in events
            if part.first <= part.last
        ]
        visible = joined(parts).visible if parts else IntervalTable()
        if visible.size:
            _note_uncounted(view, topics[0], events)
    if not visible.size:
        return None, None
    texts = [topic for topic in topics if is_text(view, topic)]
    if texts:
        view.notes.add(
            f"{listed(texts)} has detections as JSON: by counts their labels, and no other texts"
        )
    # Each label's first: only of one label it is known whether a message lay between.
    of_any = ((interval.first, interval.last) for interval in visible.intervals())
    united_times = united_spans(of_any, FLICKER_NS)
    return held_spans((first, last, True) for first, last in united_times), since


def _flag_spans(
    binned: BinnedWindow,
    topic: str,
    parts: Sequence[TopicEvents],
    condition: Condition,
    before: bool | None,
    *,
    wanted: bool,
) -> _TrueSpans | None:
    """Returns when a boolean held, in order; None where it is not clear which boolean is meant.

    `before`: whether it held when the window began, where an earlier message says so.
    """
    start, end = binned.counted.asked()
    events = joined_events([part.without_sights() for part in parts])
    states = [] if before is None else [(start, before)]
    if events is not None:
        flags, toggles = events.of_kind(FLAG)
        meant = [flag for flag in flags if condition.field in {None, flag.name}]
        if len(meant) != 1:
            return None
        [flag] = meant
        said = flags_before(binned.view, topic, flag.at) if before is None else {}
        if said.get(flag.name) is (not wanted):
            states.append((start, False))
        states.append((flag.at, bool(flag.first) is wanted))
        states += [
            (toggle.time, bool(toggle.value) is wanted)
            for toggle in toggles
            if toggle.name == flag.name
        ]
        end = held_until(binned.view, topic, events.last, max(events.last, end))
    changed = [next(same) for _, same in groupby(states, lambda state: state[1])]
    gaps = _gaps_for_topic(binned, topic)
    spans = [
        part
        for nth, ((since, held), (stop, _)) in enumerate(pairwise([*changed, (end, False)]))
        if held
        for part in _without_gaps(since, stop, nth > 0, gaps)
    ]
    return _without_silences(binned, topic, spans)


def _met_before(binned: BinnedWindow, topic: str, condition: Condition) -> bool | None:
    """Returns whether what a latched topic said last before the window meets a condition.

    None where it said nothing that still held when the window began.
    """
    held = held_at(binned.view, topic, binned.counted.asked()[0])
    value = None if held is None else binned.view.value(held)
    return None if value is None else condition.matches(value)


def _gaps_for_topic(binned: BinnedWindow, topic: str) -> list[Span]:
    """Returns the gaps in the recording, each until it is known what a topic says after it."""
    view = binned.view
    if view.limits.latching.is_latched(view.snapshot, topic):
        return binned.gaps
    # Within a bag that has the topic before and after it, a gap ends where it does.
    firsts, lasts = binned.bounds([topic])
    order = np.argsort(lasts)
    earliest = np.minimum.accumulate(firsts[order][::-1])[::-1]
    begins, ends = np.array(binned.gaps, np.int64).reshape(-1, 2).T
    following = np.searchsorted(lasts[order], ends)
    heard = np.append(earliest, MIN_NS)[following].clip(ends)
    return [*zip(begins.tolist(), heard.tolist(), strict=True)]


def _without_gaps(start: Ns, stop: Ns, is_begun: bool, gaps: Sequence[Span]) -> _TrueSpans:
    """Returns a time without the gaps in it; what comes after a gap is not known to begin there."""
    parts: _TrueSpans = []
    first = bisect_left(gaps, start, key=itemgetter(1))
    for begin, end in gaps[first : bisect_left(gaps, stop, key=itemgetter(0))]:
        if begin > start or (begin == start and is_begun):  # it may toggle in the last message
            parts.append((start, begin, is_begun))
        start, is_begun = end, False
    return [*parts, (start, stop, is_begun)] if start < stop or not parts else parts


def _without_silences(binned: BinnedWindow, topic: str, spans: _TrueSpans) -> _TrueSpans:
    """Returns times, in order, without a topic's silences, unless what it says holds through them.

    What toggles in the message after a silence begins there.
    """
    long = [(start, stop) for start, stop, _ in spans if stop - start > SILENCE_NS]
    if not long or holds_on(binned.view, (topic,)):
        return spans
    window = TimeWindow(long[0][0], long[-1][1] + 1)
    heard = heard_times(binned.view, (topic,), window)
    between = (
        (last - 1, min(first, window.stop))
        for (_, last), (first, _) in pairwise(heard)
        if window.contains(last - 1)  # of other times not all is heard
    )
    # An old thinned day has one message a minute of measurements.
    silences = without(between, binned.view.timeline.thinned_times)
    return [
        (first, last, is_begun and first == start)
        for start, stop, is_begun in spans
        for first, last, _ in _without_gaps(start, stop, True, silences)
    ]


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
    seen = read_labels(
        view, topics, scope, condition, lambda label: value == ANY_LABEL or test.passes(label)
    )
    if seen.since is not None:
        view.notes.add_lack(
            f"not all before {unix_text(seen.since)} is counted: "
            f"{view.bags.filling_progress() or 'out of time; '}ask about a shorter window"
        )
    window = scope.window if seen.since is None else replace(scope.window, start=seen.since)
    intervals, elapsed = seen.visible.intervals(), elapsed_in(view, window)
    of_label: defaultdict[str, list[VisibleInterval]] = defaultdict(list)
    for interval in intervals:
        of_label[interval.label].append(interval)
    rows = [
        (named(label), _row(own, elapsed, seen.most_at_once[label]))
        for label, own in of_label.items()
    ]
    rows.sort(key=lambda row: (-(row[1][0] or 0), row[0]))
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
    start, end = shown_span(view.snapshot, asked)
    return Bins(
        by=BY_LABEL,
        about=tuple(topics),
        start=min(max(start, seen.since or start), asked.asked()[1]),
        end=max(end, asked.asked()[0]),
        columns=_COLUMNS,
        rows=tuple(rows[:_MOST_LABELS]),
        all=_row(intervals, elapsed, seen.most_at_once_of_all),
        notes=view.notes.sentences(),
    )


class SeenLabels(NamedTuple):
    """What was seen of some labels.

    Attributes:
        visible: when labels were in view.
        most_at_once: of each label, how many one message has at most.
        most_at_once_of_all: of all labels together.
        since: back to when all was read, where the time was over before; else None.
    """

    visible: IntervalTable
    most_at_once: Counter[str]
    most_at_once_of_all: int
    since: Ns | None


def read_labels(
    view: View,
    topics: Sequence[str],
    scope: Scope,
    condition: Condition,
    wanted: Callable[[str], bool],
) -> SeenLabels:
    """Returns what was seen in a scope of the labels that are wanted, of a condition's least score.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    least_score = condition.least_score if condition.min_score > 0 else -math.inf

    def newest_first() -> Iterator[tuple[Ns, tuple[str, IntervalPart, Counter[str], int]]]:
        for nth, window in enumerate(scope.narrowed()):
            sources = (_detection_blocks(view, topic, window) for topic in topics)
            for topic, detected in heapq.merge(*sources, key=lambda of: -of[1].log_times[-1]):
                seen = _seen_in_block(detected, scope, least_score, wanted)
                reached = detected.log_times[0 if len(topics) == 1 else -1]
                yield int(reached), (f"{nth} {topic}", *seen)

    found, since = in_time(view, newest_first(), READING_S)
    parts: defaultdict[str, list[IntervalPart]] = defaultdict(list)
    most_at_once = Counter[str]()
    for source, part, at_once, _ in found:
        parts[source].append(part)
        most_at_once |= at_once
    visible = united([joined(of_source[::-1]).visible for of_source in parts.values()])
    return SeenLabels(visible, most_at_once, max((most for *_, most in found), default=0), since)


def _seen_in_block(
    detected: Detected, scope: Scope, least_score: float, wanted: Callable[[str], bool]
) -> tuple[IntervalPart, Counter[str], int]:
    """Returns when wanted labels were in view in a block, by detections that count.

    With them how many of each, and of all together, one message has at most.
    """
    times, detections = detected.log_times, detected.found
    labels = detections.labels.words
    is_wanted = np.array([wanted(word) for word in labels], np.bool_)
    counts = is_wanted[detections.labels.codes] & ~(detections.scores < least_score)
    if scope.is_bounded:
        # The newest first, as it reads what the other topic said.
        holds = [scope.holds_at(time) for time in times[::-1].tolist()]
        counts &= np.array(holds[::-1], np.bool_)[detections.rows]
    rows, codes = detections.rows[counts], detections.labels.codes[counts].astype(np.int64)
    at_once = Counter[str]()
    pairs, sizes = np.unique(np.stack((rows, codes)), axis=1, return_counts=True)
    for code, size in zip(pairs[1].tolist(), sizes.tolist(), strict=True):
        at_once[labels[code]] = max(at_once[labels[code]], size)
    visible = visible_in(times, rows, codes, detections.scores[counts], labels)
    part = IntervalPart(int(times[0]), int(times[-1]), visible)
    return part, at_once, int(np.bincount(rows).max(initial=0))


def _detection_blocks(view: View, topic: str, window: TimeWindow) -> Iterator[tuple[str, Detected]]:
    """Yields the messages of a topic in blocks that do not overlap, the newest first."""
    reader = DetectionRows(view)
    left_out = 0
    for overlapping in blocks(scan(view, topic, window, newest_first=True), newest_first=True):
        detected = joined_detected([reader.of(rows) for rows in overlapping])
        left_out += sum(map(len, overlapping)) - detected.log_times.size
        if detected.log_times.size:
            yield topic, detected
    if left_out:
        view.notes.add_lack(f"messages of {topic} that could not be decoded: {left_out}")


def _row(
    intervals: Sequence[VisibleInterval], elapsed: Elapsed, most_at_once: int
) -> tuple[float | None, ...]:
    """Returns the values of `_COLUMNS` for intervals; for how long any of them lasted."""
    spans = united_spans((interval.first, interval.last) for interval in intervals)
    return (
        len(intervals),
        elapsed.among(spans),
        spans[0][0] if spans else None,
        spans[-1][1] if spans else None,
        max((interval.best for interval in intervals if interval.best is not None), default=None),
        most_at_once,
    )


_MOST_VALUES: Final = 100
_LONGEST_VALUE: Final = 120


def count_values(
    view: View,
    topic: str,
    asked: TimeWindow,
    *,
    fields: Sequence[str],
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
    start, end = shown_span(view.snapshot, asked)
    stop = end + 1
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
    rows = _value_rows(values_held, elapsed_in(view, asked), united_spans(outside), condition)
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
        columns=_COLUMNS[:4],
        rows=tuple(rows[:_MOST_VALUES]),
        all=(
            sum(count for _, (count, *_) in rows),
            sum(length for _, (_, length, *_) in rows),
            min((first for _, (*_, first, _) in rows), default=None),
            max((last for _, (*_, last) in rows), default=None),
        ),
        notes=view.notes.sentences(),
    )


def _value_rows(
    values: Sequence[Held], elapsed: Elapsed, outside: Spans, condition: Condition | None
) -> list[tuple[str, tuple[int, Ns, Ns, Ns]]]:
    """Returns for each value that counts how often and how long it held, that of the longest first.

    Its length leaves out some times. With it when it first began, and when it last ended.
    """
    by_word: defaultdict[str, list[Held]] = defaultdict(list)
    for held in values:
        by_word[held.word].append(held)
    rows = []
    for times in by_word.values():
        value = times[0].value
        if times[0].is_blank or (condition and not condition.matches({"value": times[0].exact})):
            continue
        name = shortened(value if isinstance(value, str) else json.dumps(value), _LONGEST_VALUE)
        length = elapsed.among(without([(held.start, held.stop) for held in times], outside))
        rows.append((Quoted(name), (len(times), length, times[0].start, times[-1].stop)))
    return sorted(rows, key=lambda row: (-row[1][1], row[1][2]))

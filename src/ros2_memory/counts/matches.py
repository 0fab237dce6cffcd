"""How often and how long a condition held in each bin of a window.

What counts as once:

- A boolean that is asked for holds from the message in which it toggles to it until it toggles
  back, or until nothing is recorded. It counts where it is seen to toggle.
- A text on a topic of detections is a label. A thing is in view as in a recap: it may be missed
  for `FLICKER_NS`, since detectors miss things now and then, and it is gone after `SILENCE_NS`
  without a message. These and booleans are counted by the topic's events; labels in a scope, or of
  a least score, by its detections.
- Any other condition, also a text that is no label, holds in sightings, as `find_matches` returns
  them; these are read.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby, pairwise
from typing import TYPE_CHECKING, Literal

from ros2_memory.analysis.conditions import Condition, Contains, Equals
from ros2_memory.analysis.facts import FLAG, has_errors, has_events
from ros2_memory.analysis.intervals import IntervalPart, IntervalTable, joined, united
from ros2_memory.analysis.topic_events import TopicEvents, joined_events
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import listed
from ros2_memory.counts.bins import BinnedWindow, By, TrueIntervals
from ros2_memory.counts.held import ANY_LABEL, BY_LABEL, LabelReader, count_labels, count_values
from ros2_memory.history.context import READING_S, Call, Memory
from ros2_memory.history.coverage import reached
from ros2_memory.history.held_values import held_at, held_until, is_text
from ros2_memory.history.no_data import matching_topics, require_recorded
from ros2_memory.history.reverse_search import condition_of
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.view import TimeRange, View, clamped, open_search
from ros2_memory.insights.sightings import read_sightings
from ros2_memory.insights.topic_events import events_back
from ros2_memory.places.where import Scope, Where, WhileCondition, parse_where

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.results import Bins

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
    held, since = None, None
    if isinstance(condition.test, Contains | Equals):
        held, since = _held_by_events(binned, topics, condition, value, scope)
    if held is None:
        spans, since = read_sightings(view, topic, condition, scope)
        held = TrueIntervals.of(spans)
    binned.count_since(since)
    binned.add_heard("topic_s", topics)
    binned.add_unknown(scope.unknown)
    binned.add_held(held)
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
) -> tuple[TrueIntervals | None, Ns | None]:
    """Returns when a boolean or a label held in a scope, and since when that is known.

    None where the condition is on neither.
    """
    view, topic = binned.view, topics[0]
    types = {name for topic in topics for name in view.timeline.types_of(topic)}
    if not any(map(has_events, types)):
        return None, None
    wanted = value if isinstance(value, bool) else _TRUTHS.get(str(value).strip().casefold())
    if wanted is None:
        if condition.field is not None or not isinstance(value, str) or any(map(has_errors, types)):
            return None, None
        return _label_held(binned, topics, condition, scope)
    # What texts say of a topic that had them before is no event, nor are booleans in lists.
    if len(types) > 1 or len(topics) > 1 or (not condition.field and _has_lists(view, topic)):
        return None, None
    parts, since = _events_in_order(view, topic, binned.counted)
    before = _met_before(binned, topic, condition) if since is None else None
    spans = _flag_held(binned, topic, parts, condition, before, wanted=wanted)
    if spans is None:
        return None, None
    _note_uncounted(view, topic, parts)
    counted, end = _in_scope(spans, scope)
    return TrueIntervals.of(counted), since if end is None else end


def _in_scope(
    spans: Sequence[tuple[Ns, Ns, bool]], scope: Scope
) -> tuple[list[tuple[Ns, Ns, bool]], Ns | None]:
    """Returns the parts of spans in a scope, and since when they are known, if time is over."""
    counted: list[tuple[Ns, Ns, bool]] = []
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
    message = view.stream.newest(topic, TimeWindow.everything())
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
    reading = view.call.partial_after(READING_S)
    parts: list[TopicEvents] = []

    def end_in_time(_: Ns) -> None:
        if reading.expired() and parts:
            raise QueryTimeoutError("the rest is left out")

    try:
        parts.extend(events_back(view, topic, window, reached=end_in_time))
    except QueryTimeoutError:
        if not parts:
            raise
        return parts[::-1], parts[-1].first
    return parts[::-1], None


def _note_uncounted(view: View, topic: str, parts: Sequence[TopicEvents]) -> None:
    left_out = sum(part.left_out for part in parts)
    if left_out:
        view.notes.add(f"{topic} changes too often to count all: {left_out} more")
    undecodable = sum(part.undecodable for part in parts)
    if undecodable:
        view.notes.add_lack(f"messages of {topic} that could not be decoded: {undecodable}")


def _label_held(
    binned: BinnedWindow, topics: Sequence[str], condition: Condition, scope: Scope
) -> tuple[TrueIntervals | None, Ns | None]:
    """Returns when a thing with a label was in view; None where no label meets a condition."""
    view, matches = binned.view, Condition(condition.test).matches
    if scope.is_bounded or condition.min_score or len(topics) > 1:
        reader = LabelReader(view, scope, condition)
        reader.read(topics, matches)
        visible, since = united(reader.visible), reader.since
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
    intervals = united([visible.under_one_label("")]).intervals()
    held = [(interval.first, interval.last, True) for interval in intervals]
    return TrueIntervals.of(held), since


def _flag_held(
    binned: BinnedWindow,
    topic: str,
    parts: Sequence[TopicEvents],
    condition: Condition,
    before: bool | None,
    *,
    wanted: bool,
) -> list[tuple[Ns, Ns, bool]] | None:
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
        states.append((flag.at, bool(flag.first) is wanted))
        states += [
            (toggle.time, bool(toggle.value) is wanted)
            for toggle in toggles
            if toggle.name == flag.name
        ]
        end = held_until(binned.view, topic, events.last, max(events.last, end))
    changed = [next(same) for _, same in groupby(states, lambda state: state[1])]
    gaps = _gaps_for_topic(binned, topic)
    return [
        part
        for nth, ((since, held), (stop, _)) in enumerate(pairwise([*changed, (end, False)]))
        if held
        for part in _without_gaps(since, stop, nth > 0, gaps)
    ]


def _met_before(binned: BinnedWindow, topic: str, condition: Condition) -> bool | None:
    """Returns whether what a latched topic said last before the window meets a condition.

    None where it said nothing that still held when the window began.
    """
    held = held_at(binned.view, topic, binned.counted.asked()[0])
    value = None if held is None else binned.view.value(held)
    return None if value is None else condition.matches(value)


def _gaps_for_topic(binned: BinnedWindow, topic: str) -> list[tuple[Ns, Ns]]:
    """Returns the gaps in the recording, each until it is known what a topic says after it."""
    view = binned.view
    if view.limits.latching.is_latched(view.snapshot, topic):
        return binned.gaps
    bags = view.stream.overlapping_bags([topic], binned.counted)
    # Within a bag that has the topic before and after it, a gap ends where it does.
    return [
        (begin, min((max(bag.first, end) for bag in bags if bag.last >= end), default=end))
        for begin, end in binned.gaps
    ]


def _without_gaps(
    start: Ns, stop: Ns, is_begun: bool, gaps: Sequence[tuple[Ns, Ns]]
) -> list[tuple[Ns, Ns, bool]]:
    """Returns a time without the gaps in it; what comes after a gap is not known to begin there."""
    parts: list[tuple[Ns, Ns, bool]] = []
    for begin, end in gaps:
        if end < start or begin >= stop:
            continue
        if begin > start or (begin == start and is_begun):  # it may toggle in the last message
            parts.append((start, begin, is_begun))
        start, is_begun = end, False
    return [*parts, (start, stop, is_begun)] if start < stop or not parts else parts

"""How often and how long a condition held in each bin of a window.

Four rules say what counts as once:

- A boolean holds from the message in which it toggles to the wanted value until it toggles back,
  or until nothing is recorded. It does not hold through silences of more than `SILENCE_NS`, unless
  its topic is latched or rare. It counts if the toggle was seen.
- A text on a topic of detections is a label, which is counted as `labels` says.
- Any other condition, also a text that is no label, holds in sightings: see `find_matches`.
- With `by` "value", what a topic says holds until a message says otherwise.
"""

from __future__ import annotations

import json
from bisect import bisect_left
from collections import defaultdict
from dataclasses import replace
from itertools import chain, groupby, pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import Condition, Contains, Equals, at_field
from ros2_memory.analysis.facts import FLAG, has_errors, has_events
from ros2_memory.analysis.intervals import FLICKER_NS, SILENCE_NS, IntervalTable
from ros2_memory.analysis.topic_events import TopicEvents, joined_events, joined_visible
from ros2_memory.core.arrays import bounds_of
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, spans_of, united, without
from ros2_memory.core.text import Quoted, counted, listed, shortened
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.counts.bins import HELD_COLUMNS, BinnedWindow, By
from ros2_memory.counts.labels import BY_LABEL, count_labels, read_labels
from ros2_memory.history.condition_hints import names_of_numbers
from ros2_memory.history.conditions import Sought, condition_of
from ros2_memory.history.context import READING_S, Call, Memory
from ros2_memory.history.coverage import (
    note_unread,
    recording_gaps,
    shown_span,
    shown_window,
    unix_text,
)
from ros2_memory.history.held_values import HeldValue, HeldValues
from ros2_memory.history.lasting import (
    held_until,
    holds_on,
    is_latched,
    is_text,
)
from ros2_memory.history.no_data import matching_topics, no_value_between, require_recorded
from ros2_memory.history.robots import note_robots, note_robots_on
from ros2_memory.history.scan import read_until_late
from ros2_memory.history.view import ANY_TIME, TimeRange, View, clamped, open_search
from ros2_memory.insights.sightings import SightingSpans, held_spans, read_sightings
from ros2_memory.insights.topic_events import events_back, flags_before, message_before
from ros2_memory.messages.detections import name_field
from ros2_memory.places.where import Scope, Where, known_times, parse_where
from ros2_memory.results import Bins
from ros2_memory.things.unseen import notes_on_never

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.core.model import JsonValue

_TRUTHS = {"true": True, "false": False}
_MOST_VALUES: Final = 100
_LONGEST_NAME: Final = 120
"""Characters of a value that its row shows."""


class _HeldSpan(NamedTuple):
    """A time (inclusive) in which a condition held; `is_begun`: it is known to begin then."""

    start: Ns
    stop: Ns
    is_begun: bool


def count_matches(
    memory: Memory,
    call: Call,
    sought: Sought,
    *,
    by: By | Literal["label", "value"],
    span: TimeRange = ANY_TIME,
    where: JsonValue = None,
    during: Sequence[Sought] = (),
) -> Bins:
    """Returns how often and how long a condition held in each bin, and how long was recorded.

    With `by` "label" each label that meets the condition has a row; value "" takes every label.
    With `where` or `during` only the times count in which the robot was there, or in which other
    topics met conditions. With `by` "place" the places of `where` are the bins instead, and what
    happened elsewhere is counted, too.

    Raises:
        InvalidArgumentsError: nothing can meet the condition, the bounds make no window, or there
            are too many bins.
        NoDataError: nothing is recorded in the window, or no such topic.
        QueryTimeoutError: the call's time runs out before any result.
    """
    view, _, window = open_search(memory, call, span)
    topic, value = sought.topic, sought.value
    any_label = by == BY_LABEL and value == ""
    # No condition takes a blank text.
    condition = condition_of(view, sought._replace(value="any") if any_label else sought)
    asked = clamped(view, window)
    if by == BY_LABEL:
        window = shown_window(view.snapshot, asked)
        require_recorded(view, asked if window.empty else window)
        scope = Scope(view, window, where, during)
        return count_labels(view, topic, condition, scope, any_label=any_label, asked=asked)
    topics = matching_topics(view, topic)
    if by == "value":
        return _count_values(view, topics, asked, condition, is_bounded=bool(where or during))
    places: Where | None = None
    if by == "place" and where is not None:
        places, where = parse_where(memory.limits, where), None
    binned = BinnedWindow(view, asked, by, topics, places)
    note_robots_on(view, topics, binned.counted)
    scope = Scope(view, binned.counted, where, during)
    held = _held_by_events(binned, topics, condition, value, scope)
    if held is None:
        held = read_sightings(view, topic, condition, scope)
    binned.count_since(held.since, held.too_many)
    binned.add_heard("topic_s", topics)
    binned.add_unknown(scope.unknown)
    binned.add_held(held.spans)
    if not held.spans.size:
        bounded = scope.is_bounded
        view.notes.add(*notes_on_never(view, sought, condition, asked, is_bounded=bounded))
    return binned.answer()


def _count_values(
    view: View,
    topics: Sequence[str],
    asked: TimeWindow,
    condition: Condition,
    *,
    is_bounded: bool,
) -> Bins:
    """Returns how often and how long a topic held each value that meets a condition.

    Raises:
        InvalidArgumentsError: there are several topics, or `where` or `while` bounds the times.
    """
    if len(topics) > 1:
        raise InvalidArgumentsError(f"by value counts one topic: name one of {listed(topics)}")
    if is_bounded:
        raise InvalidArgumentsError("where, while cannot be combined with by value")
    fields = () if condition.field is None else (condition.field,)
    on_value = replace(condition, field="value")
    return count_values(view, topics[0], asked, fields=fields, condition=on_value)


def _held_by_events(
    binned: BinnedWindow,
    topics: Sequence[str],
    condition: Condition,
    value: JsonValue,
    scope: Scope,
) -> SightingSpans | None:
    """Returns when a boolean or a label held in a scope; None if the condition is on neither."""
    types = {name for topic in topics for name in binned.view.timeline.types_of(topic)}
    if not isinstance(condition.test, Contains | Equals) or not any(map(has_events, types)):
        return None
    wanted = value if isinstance(value, bool) else _TRUTHS.get(str(value).strip().casefold())
    if wanted is not None:
        # A topic that had another type before may have said the same as a text: no event has that.
        if len(types) > 1 or len(topics) > 1:
            return None
        return _boolean_held(binned, topics[0], condition, scope, wanted=wanted)
    if any(map(has_errors, types)) or not (condition.field or isinstance(value, str)):
        return None
    return _label_held(binned, topics, condition, scope)


def _boolean_held(
    binned: BinnedWindow, topic: str, condition: Condition, scope: Scope, *, wanted: bool
) -> SightingSpans | None:
    """Returns when a boolean of a topic held; None if it is not clear which one is meant."""
    view = binned.view
    # Booleans in lists are no events.
    if not condition.field and _has_lists(view, topic):
        return None
    parts, since = _events_in_order(view, topic, binned.counted)
    events = joined_events([part.without_sights() for part in parts])
    before = _met_before(binned, topic, condition) if since is None else None
    states = _flag_states(binned, topic, events, condition, before, wanted=wanted)
    if states is None:
        return None
    _note_uncounted(view, topic, [events])
    spans = _flag_spans(binned, topic, events, states)
    in_scope: list[_HeldSpan] = []
    try:
        # A scope reads what the other topics said from the newest message back.
        for start, stop, is_begun in reversed(spans):
            for first, last in scope.parts_of(start, stop):
                in_scope.append(_HeldSpan(first, last, is_begun and first == start))
    except QueryTimeoutError:
        if not in_scope:
            raise
        since = min(span.start for span in in_scope)
    return SightingSpans(held_spans(sorted(in_scope)), since)


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
    """Returns the events of a topic, oldest first, and the log time since which they are known.

    The time is None if all are known.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    parts, since = read_until_late(view, events_back(view, topic, window), READING_S)
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
) -> SightingSpans | None:
    """Returns when a thing was in view whose label meets a condition; None if no label does.

    Nor if the condition is on a field that is not the label.
    """
    view, field = binned.view, condition.field
    if field and not all(_is_label(view, topic, field, binned.counted) for topic in topics):
        return None
    matches = condition.is_on
    # What was in view just before the window does not begin in it, nor end before its end.
    if scope.is_bounded or condition.min_score or len(topics) > 1:
        seen = read_labels(view, topics, scope.widened(FLICKER_NS), condition, matches)
        visible, since = seen.visible, seen.since
    else:
        events, since = _events_in_order(view, topics[0], binned.counted.widened(FLICKER_NS))
        visible = _visible_by_events(events, matches)
        if visible.size:
            _note_uncounted(view, topics[0], events)
    # Whether a message lay between two intervals is known only if both are of one label.
    spans = united(
        ((interval.first, interval.last) for interval in visible.intervals()), FLICKER_NS
    )
    counted = binned.counted
    held = [(*span, span[0] >= counted.start) for span in spans if counted.overlaps(*span)]
    if not held:
        return None
    texts = [topic for topic in topics if is_text(view, topic)]
    if texts:
        view.notes.add(
            f"{listed(texts)} has detections as JSON: by counts their labels, and no other texts"
        )
    return SightingSpans(held_spans(held), since)


def _is_label(view: View, topic: str, field: str, window: TimeWindow) -> bool:
    """Returns whether a field names what is seen, by the last message in which anything was."""
    holder, _, name = field.rpartition(".")
    for _, part in events_back(view, topic, window):
        lasts = [interval.last for interval in part.visible.intervals()]
        if lasts:
            seen = view.stream.newest(topic, TimeWindow(window.start, max(lasts) + 1))
            value = None if seen is None else view.value(seen)
            objects = at_field(value, holder) if holder else [value]
            elements = chain.from_iterable(
                found if isinstance(found, list) else [found] for found in objects
            )
            return any(isinstance(one, dict) and name_field(one) == name for one in elements)
    return False


def _visible_by_events(
    events: Sequence[TopicEvents], matches: Callable[[str], bool]
) -> IntervalTable:
    """Returns when labels that match were in view, by consecutive events of one topic."""
    parts = []
    for part in events:
        others = [label for label in part.visible.labels if not matches(label)]
        if part.first <= part.last:
            parts.append(replace(part, visible=part.visible.without(others)))
    return joined_visible(parts)


def _flag_spans(
    binned: BinnedWindow,
    topic: str,
    events: TopicEvents,
    states: Sequence[tuple[Ns, bool]],
) -> list[_HeldSpan]:
    """Returns when a boolean held, in order, by its states; see `_flag_states`."""
    last = binned.window.start if events.is_empty else events.last
    end = held_until(binned.view, topic, last, max(last, binned.window.stop), states=True)
    if events.left_out and states:
        end, _ = states[-1]  # later changes are left out
    changes = [next(same) for _, same in groupby(states, itemgetter(1))]
    gaps = _gaps_for_topic(binned, topic)
    # What holds at first may have begun before the window, and what holds after a gap in it.
    unsure = {start for start, _ in changes[:1]}.union(stop for _, stop in gaps)
    spans = [
        _HeldSpan(since, stop, since not in unsure)
        for (since, holds), (stop, _) in pairwise([*changes, (end, False)])
        if holds
    ]
    unheard = united([*gaps, *_silences(binned, topic, spans)])
    return [part for span in spans for part in _heard_parts(span, unheard)]


def _flag_states(
    binned: BinnedWindow,
    topic: str,
    events: TopicEvents,
    condition: Condition,
    before: bool | None,
    *,
    wanted: bool,
) -> list[tuple[Ns, bool]] | None:
    """Returns whether a boolean had the wanted value, from each of some log times on.

    None if it is not clear which boolean the condition means. `before` is whether it had that value
    when the window began; None if no earlier message says so.
    """
    start, _ = binned.counted.asked()
    states = [] if before is None else [(start, before)]
    if events.is_empty:
        return states
    flags, toggles = events.of_kind(FLAG)
    meant = [flag for flag in flags if condition.field in {None, flag.name}]
    if len(meant) != 1:
        return None
    [flag] = meant
    if before is None:
        earlier = flags_before(binned.view, topic, flag.at)
        if earlier.get(flag.name) is (not wanted):
            states.append((start, False))
    states.append((flag.at, bool(flag.first) is wanted))
    own_toggles = (toggle for toggle in toggles if toggle.name == flag.name)
    states += [(toggle.time, bool(toggle.value) is wanted) for toggle in own_toggles]
    return states


def _met_before(binned: BinnedWindow, topic: str, condition: Condition) -> bool | None:
    """Returns whether a latched or rare topic met a condition when the window began.

    None if it said nothing before that still held then.
    """
    view, (start, _) = binned.view, binned.counted.asked()
    held = message_before(view, topic, start)
    if held is None or not holds_on(view, topic, held.time):
        return None
    value = view.value(held)
    return None if value is None else condition.matches(value)


def _gaps_for_topic(binned: BinnedWindow, topic: str) -> list[Span]:
    """Returns the gaps of the recording, a long one prolonged until the topic is heard again."""
    if is_latched(binned.view, topic):
        return binned.gaps
    firsts, lasts = binned.bounds([topic])
    order = np.argsort(lasts)
    begins, ends = bounds_of(binned.gaps)
    # The topic is heard again in the bags that end after the gap, if there are any. If one of them
    # begins before the gap, the gap is not prolonged.
    following = np.searchsorted(lasts[order], ends)
    earliest = np.minimum.accumulate(firsts[order][::-1])[::-1]
    heard_again = np.append(earliest, MAX_NS)[following].clip(ends)
    return spans_of(begins, np.where(ends - begins > SILENCE_NS, heard_again, ends))


def _silences(binned: BinnedWindow, topic: str, spans: Sequence[_HeldSpan]) -> Sequence[Span]:
    """Returns the silences of a topic in some spans through which what it says does not last."""
    long = [span for span in spans if span.stop - span.start > SILENCE_NS]
    if not long:
        return []
    view, window = binned.view, TimeWindow(long[0].start, long[-1].stop + 1)
    # A thinned day has one message of a measurement a minute.
    known = [*known_times(view, [topic], window), *view.timeline.thinned_times]
    return without([(window.start, window.stop)], united(known))


def _heard_parts(span: _HeldSpan, unheard: Spans) -> list[_HeldSpan]:
    """Returns the parts of a span in which the topic was heard; the first alone may begin there."""
    start, stop, is_begun = span
    parts: list[_HeldSpan] = []
    first = bisect_left(unheard, start, key=itemgetter(1))
    for begin, end in unheard[first : bisect_left(unheard, stop, key=itemgetter(0))]:
        # The last message before a silence may toggle: that part has no length.
        if begin >= start:
            parts.append(_HeldSpan(start, begin, is_begun))
            is_begun = False
        start = end
    if start < stop or not parts:
        parts.append(_HeldSpan(start, stop, is_begun))
    return parts


class _ValueRow(NamedTuple):
    """The values of `HELD_COLUMNS` for one value of the topic."""

    occurrences: int
    length: Ns
    first: Ns
    last: Ns


def count_values(
    view: View,
    topic: str,
    asked: TimeWindow,
    *,
    fields: Sequence[str],
    condition: Condition | None = None,
) -> Bins:
    """Returns a row for each value that held in a window, the one that held longest first.

    Time outside of the window and in gaps of the recording does not count. An empty text is no
    value.

    Args:
        view: the view of this call.
        topic: the name of the topic.
        asked: the window.
        fields: the field that has the value; none for the whole message.
        condition: a condition on field `value` that values must meet; None counts all.

    Raises:
        InvalidArgumentsError: more than one field is named, or there is no single value.
        NoDataError: the topic said nothing in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    if len(fields) > 1:
        raise InvalidArgumentsError("by value counts one field: name one in fields")
    field = fields[0] if fields else None
    values = HeldValues(view, topic, field, asked="by value", until=asked.stop)
    start, end = shown_span(view.snapshot, asked)
    stop = end + 1
    held_values, start = _held_since(view, values, start, stop)
    if not held_values:
        raise no_value_between(view, topic, field, asked)
    view.notes.add(*names_of_numbers(view, topic, field, {value.word for value in held_values}))
    outside = [(MIN_NS, start), *recording_gaps(view, TimeWindow(start, stop)), (stop, MAX_NS)]
    valued_rows = _value_rows(held_values, view.elapsed_in(asked), united(outside), condition)
    if len(valued_rows) > _MOST_VALUES:
        more = counted(len(valued_rows) - _MOST_VALUES, "value")
        view.notes.add(f"{more} that held for a shorter time are left out; all counts them, too")
    note_unread(view, asked)
    note_robots(view, topic, asked)
    rows = [row for _, row in valued_rows]
    return Bins(
        by="value",
        about=(topic,),
        start=start,
        end=stop - 1,
        columns=HELD_COLUMNS,
        rows=tuple((_name_of(held), row) for held, row in valued_rows[:_MOST_VALUES]),
        all=(
            sum(row.occurrences for row in rows),
            sum(row.length for row in rows),
            min((row.first for row in rows), default=None),
            max((row.last for row in rows), default=None),
        ),
        notes=view.notes.sentences(),
    )


def _held_since(
    view: View, values: HeldValues, start: Ns, stop: Ns
) -> tuple[Sequence[HeldValue], Ns]:
    """Returns the values of a time, and since when they are known; a note says if time ran out.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    try:
        return values.during(start, stop), start
    except QueryTimeoutError as error:
        if not values.known:
            raise
        since = values.complete_since
        view.notes.add_lack(f"only what is after {unix_text(since)} is counted: {error}")
        return values.known[::-1], since


def _value_rows(
    held_values: Sequence[HeldValue], elapsed: Elapsed, outside: Spans, condition: Condition | None
) -> list[tuple[HeldValue, _ValueRow]]:
    """Returns each value that counts, when it first held, with its row, the longest first.

    Time that lies in the spans `outside` adds nothing to a length.
    """
    by_word: defaultdict[str, list[HeldValue]] = defaultdict(list)
    for held in held_values:
        by_word[held.word].append(held)
    rows = []
    for times in by_word.values():
        first, last = times[0], times[-1]
        if first.is_blank or (condition and not condition.matches({"value": first.exact})):
            continue
        length = elapsed.among(without([(held.start, held.stop) for held in times], outside))
        row = _ValueRow(len(times), length, first.start, last.stop)
        rows.append((first, row))
    return sorted(rows, key=lambda valued_row: (-valued_row[1].length, valued_row[1].first))


def _name_of(held: HeldValue) -> str:
    """Returns the name of the row of a value."""
    value = held.value
    text = value if isinstance(value, str) else json.dumps(value)
    return Quoted(shortened(text, _LONGEST_NAME))

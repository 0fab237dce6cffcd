"""How often and how long a condition held in each bin of a window.

What counts as once:

- A boolean that is asked for holds from the message in which it toggles to it until it toggles
  back, or until nothing is recorded. It counts where it is seen to toggle.
- A text on a topic of detections is a label. A thing is in view as in a recap: it may be missed
  for `FLICKER_NS`, since detectors miss things now and then, and it is gone after `SILENCE_NS`
  without a message. These and booleans are counted by the digests of events, unless a least score
  is asked for.
- Any other condition holds in sightings, as `find_matches` returns them; these are read.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from ros2_memory.analysis.conditions import Contains, Equals
from ros2_memory.analysis.intervals import IntervalPart, IntervalTable, joined
from ros2_memory.analysis.topic_events import NO_EVENTS, TopicEvents, TopicEventsBuilder, has_events
from ros2_memory.counts.bins import BinnedWindow
from ros2_memory.counts.segment_fold import Digested, SegmentFold
from ros2_memory.counts.time_bins import TrueIntervals
from ros2_memory.history.no_data import matching_topics
from ros2_memory.history.reverse_search import condition_of
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.view import TimeRange, clamped, open_view, search_window
from ros2_memory.insights.sightings import read_sightings
from ros2_memory.insights.topic_events import TOPIC_EVENTS, collect_events
from ros2_memory.places.scope import Scope

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.analysis.topic_events import KnownFlag
    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.counts.bins import By
    from ros2_memory.counts.segment_fold import Folded
    from ros2_memory.history.bag_groups import Group
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.view import View
    from ros2_memory.places.scope import WhileCondition
    from ros2_memory.results import Bins

_TRUTHS = {"true": True, "false": False}


def count_matches(
    memory: Memory,
    call: Call,
    topic: str,
    condition_type: str,
    value: JsonValue,
    *,
    by: By,
    field: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    last_s: float | None = None,
    min_score: float | None = None,
    where: JsonValue = None,
    during: WhileCondition | None = None,
) -> Bins:
    """Returns how often and how long a condition held in each bin, and how long was recorded.

    With `where` or `during` only while the robot was there, or another topic met a condition.

    Raises:
        InvalidArgumentsError: nothing can meet the condition, the bounds make no window, or there
            are too many bins.
        NoDataError: nothing is recorded in the window, or no such topic.
        QueryTimeoutError: the call's time runs out before any result.
    """
    span = TimeRange(start_s, end_s, last_s)
    wall = memory.clock.now()
    view = open_view(memory, call, min(search_window(span, wall).stop, wall))
    condition = condition_of(view, topic, condition_type, value, field=field, min_score=min_score)
    asked = clamped(view, search_window(span, memory.now(wall, view.snapshot.latest)))
    topics = matching_topics(view, topic)
    binned = BinnedWindow(view, asked, by, topics)
    note_robots_on(view, topics, binned.counted)
    held, since = None, None
    # Events have labels without scores.
    by_events = isinstance(condition.test, Contains | Equals) and not condition.min_score
    alone = where is None and during is None and len(topics) == 1
    if alone and by_events:
        held, since = _by_events(binned, topics[0], condition, value)
    if held is None:
        scope = Scope(view, binned.counted, where, during)
        spans, since = read_sightings(view, topic, condition, scope)
        held = TrueIntervals.of([(first, last, True) for first, last in spans])
    binned.count_since(since)
    binned.add_heard("topic_s", topics)
    binned.add_held(held)
    return binned.answer()


def _by_events(
    binned: BinnedWindow, topic: str, condition: Condition, value: JsonValue
) -> tuple[TrueIntervals | None, Ns | None]:
    """Returns when a condition held, by the events of a topic, and since when these are known.

    None where events do not show it.
    """
    view = binned.view
    if not any(map(has_events, view.snapshot.timeline.types_of(topic))):
        return None, None
    wanted = value if isinstance(value, bool) else _TRUTHS.get(str(value).strip().casefold())
    if wanted is None and (condition.field is not None or not isinstance(value, str)):
        return None, None
    label = condition if wanted is None else None
    folded = _events(view, topic, binned.counted, label)
    _note_limits(view, topic, folded)
    if wanted is not None:
        return _flag_held(folded, condition, _gaps_of(binned, topic), wanted=wanted), folded.since
    return _label_held(folded, condition), folded.since


def _events(
    view: View, topic: str, window: TimeWindow, label: Condition | None
) -> Folded[TopicEvents]:
    """Returns the events of a topic; of bags that cannot have a label perhaps not all others."""
    fold = SegmentFold(
        TOPIC_EVENTS,
        partial(collect_events, view),
        _joined_events,
        name="events",
        leaves_out=lambda events: events is not None and events.left_out > 0,
        collect_all=partial(collect_events, view, at_most=None),
        unread=None if label is None else _WithoutLabel(view, topic, label).of,
        question="" if label is None else f"of {label}",
    )
    return fold.over(view, topic, window)


class _WithoutLabel:
    """Finds groups of bags that cannot have a label: other labels in them do not matter."""

    def __init__(self, view: View, topic: str, condition: Condition) -> None:
        self._view = view
        self._topic = topic
        self._condition = condition

    def of(self, group: Group) -> Digested[TopicEvents | None] | None:
        """Returns the stored events of a group that cannot have the label."""
        if group.may_be_relatched:
            return None
        builder = TopicEventsBuilder()
        for each in group.bags:
            entry = self._view.bags.entry(each.bag)
            if entry is None or entry[1] in self._may_have_it(entry[0]):
                return None
            digests, number = entry
            stored = digests.catalogue.topic_events(self._topic, [number])
            if number not in stored:
                return None
            events = stored[number]
            if events is NO_EVENTS:
                builder.join(TopicEvents(each.first, each.last))
            elif events is not None:
                builder.join(replace(events, left_out=0))
        first = group.first
        last = group.last
        return Digested(builder.events() or NO_EVENTS, first, last)

    def _may_have_it(self, digests: SegmentDigests) -> set[int]:
        """Returns the entries of a segment that may have the label."""

        def may_have() -> set[int]:
            maps = digests.zone_maps(self._topic)
            return {number for number, each in maps.items() if self._condition.can_match(each)}

        name = f"bags that may have {self._condition} on {self._topic}"
        return digests.derived(name, may_have)


def _joined_events(found: Sequence[Digested[TopicEvents | None]]) -> TopicEvents:
    builder = TopicEventsBuilder()
    for digest, first, last in found:
        if digest is not None:
            builder.join(TopicEvents(first, last) if digest is NO_EVENTS else digest)
    return builder.events() or TopicEvents(1, 0)


def _note_limits(view: View, topic: str, folded: Folded[TopicEvents]) -> None:
    left_out = sum(each.left_out for each in folded.parts)
    if left_out:
        view.notes.add(f"{topic} changes too often to count all: {left_out} more")
    undecodable = sum(each.undecodable for each in folded.parts)
    if undecodable:
        view.notes.complete = False
        view.notes.add(f"messages of {topic} that could not be decoded: {undecodable}")


def _label_held(folded: Folded[TopicEvents], condition: Condition) -> TrueIntervals | None:
    """Returns when a thing with a label was in view; None where there are no labels at all."""
    if not any(each.visible.labels for each in folded.parts):
        return None
    parts = [
        IntervalPart(each.first, each.last, _of_label(each.visible, condition))
        for each in folded.parts
        if each.first <= each.last
    ]
    seen = joined(parts).visible.intervals()
    return TrueIntervals.of([(each.first, each.last, True) for each in seen])


def _of_label(visible: IntervalTable, condition: Condition) -> IntervalTable:
    """Returns the intervals of all labels that meet a condition, as those of one label."""
    others = [label for label in visible.labels if not condition.test.matches(label)]
    return visible.without(others).under_one_label("")


def _flag_held(
    folded: Folded[TopicEvents],
    condition: Condition,
    gaps: Sequence[tuple[Ns, Ns]],
    *,
    wanted: bool,
) -> TrueIntervals | None:
    """Returns when a boolean held; None where it is not clear which boolean is meant."""
    builder = TopicEventsBuilder()
    for part in folded.parts:
        if part.first <= part.last:
            builder.join(replace(part, visible=IntervalTable(), errors=()))
    events = builder.events()
    if events is None:
        return TrueIntervals.of([])
    meant = [each for each in events.known if condition.field in {None, each.path}]
    if len(meant) != 1:
        return None
    spans = _spans_of(events, meant[0], wanted=wanted)
    return TrueIntervals.of([part for each in spans for part in _without_gaps(*each, gaps)])


def _spans_of(
    events: TopicEvents, known: KnownFlag, *, wanted: bool
) -> Iterator[tuple[Ns, Ns, bool]]:
    """Yields when a boolean had a value, and whether it is known that it toggled to it then."""
    since, begun, value = known.at, False, known.first
    for toggle in events.toggles:
        if toggle.path == known.path:
            if value is wanted:
                yield since, toggle.time, begun
            since, begun, value = toggle.time, True, toggle.value
    if value is wanted:
        yield since, events.last, begun


def _gaps_of(binned: BinnedWindow, topic: str) -> list[tuple[Ns, Ns]]:
    """Returns the gaps in the recording, each until the first message of a topic after it."""
    firsts = [each.first for each in binned.view.stream.overlapping_bags([topic], binned.counted)]
    return [
        (begin, min((each for each in firsts if each >= end), default=end))
        for begin, end in binned.gaps
    ]


def _without_gaps(
    start: Ns, stop: Ns, begun: bool, gaps: Sequence[tuple[Ns, Ns]]
) -> list[tuple[Ns, Ns, bool]]:
    """Returns a time without the gaps in it; what comes after a gap is not known to begin there."""
    parts: list[tuple[Ns, Ns, bool]] = []
    for begin, end in gaps:
        if end < start or begin >= stop:
            continue
        if begin > start:
            parts.append((start, begin, begun))
        start, begun = end, False
    return [*parts, (start, stop, begun)] if start < stop or not parts else parts

"""Silences that bear on a question: a topic with a usual rate had no messages while others had."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from functools import cache, partial
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.silences import Silence
from ros2_memory.bag_dir.state_files import read_thinned
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, overlaps_any, united, without
from ros2_memory.core.text import MAX_NAMED, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.history.coverage import (
    cut_spans,
    excluded_spans,
    recording_gaps,
    span_text,
    unix_text,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.history.context import Memory
    from ros2_memory.history.view import View
    from ros2_memory.index.snapshot import Snapshot

_ALIKE_NS: Final[Ns] = 30 * NS_PER_S
"""Topics of one node fall silent and return within this of each other."""


def silences_of(
    memory: Memory, snapshot: Snapshot, first: Ns = MIN_NS, last: Ns = MAX_NS
) -> list[Silence]:
    """Returns all silences that overlap a time (ns, inclusive), in order of time.

    A latched topic is never silent, since its value holds. Where messages were deleted, no topic
    was silent.
    """
    bag_dir, latching = memory.bag_dir, memory.limits.latching
    excluded = excluded_spans(bag_dir)
    deleted = cache(lambda topic: cut_spans(bag_dir, topic, TimeWindow.everything()))
    is_latched = cache(partial(latching.is_latched, snapshot))
    silences: list[Silence] = []
    for silence in _all_silences(bag_dir, snapshot):
        if silence.within(first, last) is not None and not is_latched(silence.topic):
            silences += _outside_deleted(snapshot, silence, excluded, deleted(silence.topic))
    return sorted(silences, key=lambda silence: (silence.start, silence.end, silence.topic))


def _all_silences(bag_dir: Path, snapshot: Snapshot) -> list[Silence]:
    """Returns the silences in bags, and the recorded silences of deleted bags."""
    silences = [*snapshot.silences]
    spans_by_topic: defaultdict[str, Spans] = defaultdict(list)
    for silence in silences:
        spans_by_topic[silence.topic].append((silence.start, silence.end))
    for columns in read_thinned(bag_dir).silences:
        silence = snapshot.prolonged(Silence._make(columns))
        # Until its bags are deleted, they show the same silence.
        if not overlaps_any(spans_by_topic[silence.topic], silence.start, silence.end - 1):
            silences.append(silence)
    return silences


def _outside_deleted(
    snapshot: Snapshot, silence: Silence, excluded: Spans, deleted: Sequence[Span]
) -> Iterator[Silence]:
    """Yields a silence, or its parts before and after deleted messages, if they are long enough.

    Nothing, if a silence is only long enough with the times in which recording was excluded.
    """
    shortest = snapshot.shortest_silence(silence.topic)
    whole = [(silence.start, silence.end)]
    outside = without(whole, excluded)
    if outside != whole and all(end - start < shortest for start, end in outside):
        return
    if not overlaps_any(deleted, silence.start + 1, silence.end - 1):
        yield silence
        return
    if silence.length < silence.end - silence.start:
        return  # the robot was off for a while, and it is unknown in which part
    for start, end in without(whole, deleted):
        if end - start >= shortest:
            goes_on = silence.goes_on and end == silence.end
            yield Silence(silence.topic, start, end, end - start, goes_on)


def silences_in(view: View, window: TimeWindow) -> Iterator[Silence]:
    """Yields the parts of silences in a window, in order."""
    start, end = window.asked()
    for silence in silences_of(view.memory, view.snapshot, start, end):
        part = silence.within(start, end)
        if part is not None:
            yield part


def unrecorded_times(view: View, topic: str, window: TimeWindow) -> list[Span]:
    """Returns the times of a window without messages of a topic, in order, none overlapping.

    These are gaps in the recording, and silences of the topic.
    """
    silences = [silence for silence in silences_in(view, window) if silence.topic == topic]
    silent = [(silence.start, silence.end) for silence in silences]
    return united([*recording_gaps(view, window), *silent])


def describe_unsearched(view: View, topics: Collection[str], window: TimeWindow) -> tuple[str, ...]:
    """Returns a sentence if topics were first heard after a window; else their silences in it."""
    spans = chain.from_iterable(view.timeline.recordings(topic).values() for topic in topics)
    first_heard = min((first for first, _ in spans), default=MIN_NS)
    if first_heard < window.stop or view.snapshot.older is not None:
        return describe_silences(view, topics, window)
    named = listed([*topics])
    return (f"no message of {named} is here before {unix_text(first_heard)}: nothing was searched",)


def describe_silences(view: View, topics: Collection[str], window: TimeWindow) -> tuple[str, ...]:
    """Returns the sentence on the longest silences of topics in a window, if there were any.

    An answer of "never" needs it: matches may be missing there.
    """
    silences = [silence for silence in silences_in(view, window) if silence.topic in topics]
    if not silences:
        return ()
    longest = sorted(silences, key=lambda silence: -silence.length)[:MAX_NAMED]
    names = [
        f"{silence.topic} {span_text(silence.start, silence.end, silence.length)}"
        for silence in sorted(longest, key=lambda silence: silence.start)
    ]
    return (f"silent while the robot was on, so not searched: {listed(names, len(silences))}",)


def group_silences(silences: Iterable[Silence]) -> list[list[Silence]]:
    """Returns silences, in order, in groups that begin and end at about the same time."""
    groups: list[list[Silence]] = []
    for silence in silences:
        nth = bisect_left(groups, silence.start - _ALIKE_NS, key=lambda group: group[0].start)
        alike = [group for group in groups[nth:] if abs(silence.end - group[0].end) <= _ALIKE_NS]
        if alike:
            alike[-1].append(silence)
        else:
            groups.append([silence])
    return groups

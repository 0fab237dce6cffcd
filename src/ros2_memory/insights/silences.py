"""Silences that bear on a question: a topic with a usual rate had no message, the robot was on."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from functools import cache, partial
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.silences import Silence
from ros2_memory.bag_dir.state_files import read_thinned
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, overlaps_any, united, without
from ros2_memory.core.text import MAX_NAMED, listed
from ros2_memory.core.timebase import (
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    Ns,
    Span,
    local_text,
)
from ros2_memory.history.coverage import (
    cut_spans,
    excluded_spans,
    recording_gaps,
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
    """Returns all silences that reach into a time (inclusive), in order of time.

    A latched topic holds, and is never silent. Nor was one silent where its messages were deleted.
    """
    bag_dir, everything = memory.index.bag_dir, TimeWindow.everything()
    is_latched = cache(partial(memory.limits.latching.is_latched, snapshot))
    excluded = excluded_spans(bag_dir)
    deleted = cache(lambda topic: cut_spans(bag_dir, topic, everything))
    found: list[Silence] = []
    for silence in _all_silences(bag_dir, snapshot):
        if silence.within(first, last) is not None and not is_latched(silence.topic):
            found += _outside_deleted(snapshot, silence, excluded, deleted(silence.topic))
    return sorted(found, key=lambda silence: (silence.start, silence.end, silence.topic))


def _all_silences(bag_dir: Path, snapshot: Snapshot) -> list[Silence]:
    """Returns those that bags show, and those that deleted bags showed."""
    shown: defaultdict[str, Spans] = defaultdict(list)
    for kept in snapshot.silences:
        shown[kept.topic].append((kept.start, kept.end))
    # Until its bags are deleted, they show it as well.
    deleted = [
        silence
        for silence in map(snapshot.prolonged, map(Silence._make, read_thinned(bag_dir).silences))
        if not overlaps_any(shown[silence.topic], silence.start, silence.end - 1)
    ]
    return [*snapshot.silences, *deleted]


def _outside_deleted(
    snapshot: Snapshot, silence: Silence, excluded: Spans, deleted: Sequence[Span]
) -> Iterator[Silence]:
    """Yields a silence, or the parts of it before and after messages that were deleted.

    None that lasts long enough only with times that were excluded.
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
        return  # the robot was off for a while, and which part that was in is not known
    for start, end in without(whole, deleted):
        if end - start >= shortest:
            goes_on = silence.goes_on and end == silence.end
            yield Silence(silence.topic, start, end, end - start, goes_on)


def silences_in(view: View, window: TimeWindow) -> Iterator[Silence]:
    """Yields the silences in a window, in order, as far as they are inside."""
    start, end = window.asked()
    for silence in silences_of(view.memory, view.snapshot, start, end):
        part = silence.within(start, end)
        if part is not None:
            yield part


def unrecorded_times(view: View, topic: str, window: TimeWindow) -> list[Span]:
    """Returns the times of a window in which a topic was not recorded, in order, none overlapping.

    Nothing was recorded, or the topic has a usual rate and was silent.
    """
    silences = (silence for silence in silences_in(view, window) if silence.topic == topic)
    silent = ((silence.start, silence.end) for silence in silences)
    return united([*recording_gaps(view, window), *silent])


def describe_silences(view: View, topics: Collection[str], window: TimeWindow) -> tuple[str, ...]:
    """Returns the sentence on when topics were silent in a window, for an answer of "never".

    The longest silences are named. Empty where there was none.
    """
    silences = [silence for silence in silences_in(view, window) if silence.topic in topics]
    if not silences:
        return ()
    longest = sorted(silences, key=lambda silence: silence.start - silence.end)[:MAX_NAMED]
    names = [
        f"{silence.topic} {unix_text(silence.start)} to {unix_text(silence.end)} "
        f"({local_text(silence.start)} to {local_text(silence.end)})"
        for silence in sorted(longest, key=lambda silence: silence.start)
    ]
    return (f"silent while the robot was on, so not searched: {listed(names, len(silences))}",)


def grouped(silences: Iterable[Silence]) -> list[list[Silence]]:
    """Returns silences, in order, with those of several topics at about the same time together."""
    groups: list[list[Silence]] = []
    for silence in silences:
        # They fell silent together, and returned together.
        nth = bisect_left(groups, silence.start - _ALIKE_NS, key=lambda group: group[0].start)
        alike = [group for group in groups[nth:] if abs(silence.end - group[0].end) <= _ALIKE_NS]
        if alike:
            alike[-1].append(silence)
        else:
            groups.append([silence])
    return groups

"""Silences that bear on a question: a topic with a usual rate had no message, the robot was on."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.silences import Silence
from ros2_memory.bag_dir.state_files import read_thinned
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import MAX_NAMED, listed
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    START_SLACK_NS,
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
    from collections.abc import Collection, Iterable, Iterator
    from pathlib import Path

    from ros2_memory.history.context import Memory
    from ros2_memory.history.view import View
    from ros2_memory.index.snapshot import Snapshot

_ALIKE_NS: Final[Ns] = 30 * NS_PER_S
"""Topics of one node fall silent and return within this of each other."""


def silences_of(
    memory: Memory, snapshot: Snapshot, first: Ns = MIN_NS, last: Ns = MAX_NS
) -> Iterator[Silence]:
    """Yields all silences that reach into a time (inclusive), in order of time.

    A latched topic holds, and is never silent. Nor was one silent where its messages were deleted.
    """
    latching, bag_dir = memory.limits.latching, memory.index.bag_dir
    is_latched: dict[str, bool] = {}
    for silence in _all_silences(bag_dir, snapshot):
        if silence.within(first, last) is None:
            continue
        if silence.topic not in is_latched:
            is_latched[silence.topic] = latching.is_latched(snapshot, silence.topic)
        if not is_latched[silence.topic]:
            yield from _outside_deleted(bag_dir, snapshot, silence)


def _all_silences(bag_dir: Path, snapshot: Snapshot) -> list[Silence]:
    """Returns those that bags show, and those that deleted bags showed, in order of time."""
    shown: defaultdict[str, list[Silence]] = defaultdict(list)
    for kept in snapshot.silences:
        shown[kept.topic].append(kept)
    # Until its bags are deleted, they show it as well.
    deleted = [
        silence
        for silence in map(snapshot.prolonged, map(Silence._make, read_thinned(bag_dir).silences))
        if not any(silence.within(kept.start, kept.end) for kept in shown[silence.topic])
    ]
    return sorted(
        [*snapshot.silences, *deleted],
        key=lambda silence: (silence.start, silence.end, silence.topic),
    )


def _outside_deleted(bag_dir: Path, snapshot: Snapshot, silence: Silence) -> Iterator[Silence]:
    """Yields a silence, or the parts of it before and after messages that were deleted.

    None that lasts long enough only with times that were excluded.
    """
    shortest = snapshot.shortest_silence(silence.topic)
    excluded = excluded_spans(bag_dir, TimeWindow(silence.start, silence.end))
    outside = without([(silence.start, silence.end)], excluded)
    if excluded and all(end - start < shortest for start, end in outside):
        return
    deleted = cut_spans(bag_dir, silence.topic, TimeWindow(silence.start + 1, silence.end))
    if not deleted:
        yield silence
        return
    if silence.length < silence.end - silence.start:
        return  # the robot was off for a while, and which part that was in is not known
    for start, end in without([(silence.start, silence.end)], deleted):
        if end - start >= shortest:
            goes_on = silence.goes_on and end == silence.end
            yield Silence(silence.topic, start, end, end - start, goes_on)


def silences_in(view: View, window: TimeWindow) -> Iterator[Silence]:
    """Yields the silences in a window, in order, as far as they are inside."""
    start = window.start + START_SLACK_NS
    end = max(start, window.stop - 1 - AT_OR_BEFORE_SLACK_NS)
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
        alike = [
            group
            for group in groups
            if silence.start - group[0].start <= _ALIKE_NS
            and abs(silence.end - group[0].end) <= _ALIKE_NS
        ]
        if alike:
            alike[-1].append(silence)
        else:
            groups.append([silence])
    return groups

"""Silences that bear on a question: a topic with a usual rate had no message, the robot was on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.silences import Silence
from ros2_memory.bag_dir.state_files import read_thinned
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.text import MAX_NAMED, listed
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    NS_PER_S,
    START_SLACK_NS,
    Ns,
    local_text,
)
from ros2_memory.history.coverage import cut_spans, recording_gaps, unix_text

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator
    from pathlib import Path

    from ros2_memory.history.context import Memory
    from ros2_memory.history.view import View
    from ros2_memory.index.snapshot import Snapshot

_ALIKE_NS: Final[Ns] = 30 * NS_PER_S
"""Topics of one node fall silent and return within this of each other."""


def silences_of(memory: Memory, snapshot: Snapshot) -> Iterator[Silence]:
    """Yields all silences in order of time.

    A latched topic holds, and is never silent. Nor was one silent where its messages were deleted.
    """
    latching, bag_dir = memory.limits.latching, memory.index.bag_dir
    latched: dict[str, bool] = {}
    for each in _all_silences(bag_dir, snapshot):
        if each.topic not in latched:
            latched[each.topic] = latching.is_latched(snapshot, each.topic)
        if not latched[each.topic]:
            yield from _around_cut(bag_dir, snapshot, each)


def _all_silences(bag_dir: Path, snapshot: Snapshot) -> list[Silence]:
    """Returns those that bags show, and those that deleted bags showed, in order of time."""
    shown: dict[str, list[Silence]] = {}
    for each in snapshot.silences:
        shown.setdefault(each.topic, []).append(each)
    deleted = [
        each
        for each in map(Silence._make, read_thinned(bag_dir).silences)
        # Until its bags are deleted, they show it as well.
        if all(each.within(one.start, one.end) is None for one in shown.get(each.topic, ()))
    ]
    return sorted(
        [*snapshot.silences, *deleted], key=lambda each: (each.start, each.end, each.topic)
    )


def _around_cut(bag_dir: Path, snapshot: Snapshot, silence: Silence) -> Iterator[Silence]:
    """Yields a silence, or the parts of it before and after messages that were deleted."""
    gone = cut_spans(bag_dir, silence.topic, TimeWindow(silence.start + 1, silence.end))
    if not gone:
        yield silence
        return
    if silence.length < silence.end - silence.start:
        return  # the robot was off for a while, and which part that was in is not known
    begins = [silence.start, *(stop for _, stop in gone)]
    ends = [*(start for start, _ in gone), silence.end]
    for start, end in zip(begins, ends, strict=True):
        if end - start >= snapshot.shortest_silence(silence.topic):
            goes_on = silence.goes_on and end == silence.end
            yield Silence(silence.topic, start, end, end - start, goes_on)


def silences_in(view: View, window: TimeWindow) -> Iterator[Silence]:
    """Yields the silences in a window, in order, as far as they are inside."""
    start = window.start + START_SLACK_NS
    end = max(start, window.stop - 1 - AT_OR_BEFORE_SLACK_NS)
    for each in silences_of(view.memory, view.snapshot):
        part = each.within(start, end)
        if part is not None:
            yield part


def unrecorded_times(view: View, topic: str, window: TimeWindow) -> list[tuple[Ns, Ns]]:
    """Returns the times of a window in which a topic was not recorded, in order, none overlapping.

    Nothing was recorded, or the topic has a usual rate and was silent.
    """
    silences = (each for each in silences_in(view, window) if each.topic == topic)
    silent = ((each.start, each.end) for each in silences)
    return united([*recording_gaps(view, window), *silent])


def describe_silences(view: View, topics: Collection[str], window: TimeWindow) -> tuple[str, ...]:
    """Returns the sentence on when topics were silent in a window, for an answer of "never".

    The longest silences are named. Empty where there was none.
    """
    found = [each for each in silences_in(view, window) if each.topic in topics]
    if not found:
        return ()
    longest = sorted(found, key=lambda each: each.start - each.end)[:MAX_NAMED]
    names = [
        f"{each.topic} {unix_text(each.start)} to {unix_text(each.end)} "
        f"({local_text(each.start)} to {local_text(each.end)})"
        for each in sorted(longest, key=lambda each: each.start)
    ]
    return (f"silent while the robot was on, so not searched: {listed(names, len(found))}",)


def grouped(silences: Iterable[Silence]) -> list[list[Silence]]:
    """Returns silences, in order, with those of several topics at about the same time together."""
    groups: list[list[Silence]] = []
    for each in silences:
        for group in reversed(groups):
            first = group[0]
            if each.start - first.start > _ALIKE_NS:
                continue
            if abs(each.end - first.end) <= _ALIKE_NS:
                group.append(each)
                break
        else:
            groups.append([each])
    return groups

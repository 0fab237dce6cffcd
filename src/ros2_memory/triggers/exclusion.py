"""Computes which data to exclude, from the values of a topic in each recording. Pure.

A message is valid from its log time on: on a latched topic until the next one, on any other topic
for `stale` after the last one. It is valid only in its own recording, since the next one receives
the topic again. Exception: a condition that is true at the end of a recording stays true in the
following ones, for at most `stale`, until one of them receives the topic. If another recording has
taken over by then, the last value is valid for `stale` more, until that recording must have
received the topic.

All other times are unknown, and so are spans in which the clock was set back.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.bag_dir.state_files import ConditionInterval, Excluded
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.spans import Spans, lies_inside, overlaps_any, united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from ros2_memory.analysis.conditions import Condition


@dataclass(frozen=True, slots=True, kw_only=True)
class ExclusionRule:
    """A rule of `recording.exclude_when`.

    Attributes:
        margin: how long before and after is excluded, too.
        stale: for how long a message is valid if its topic is not latched.
        excludes_unknown: whether times with an unknown value are excluded, too.
    """

    name: str
    topic: str
    condition: Condition
    margin: Ns
    stale: Ns
    excludes_unknown: bool = True


class RecordingConditions(NamedTuple):
    """The values of a topic in one recording, in the order in which they were written.

    `end` is None while it is being written. `previous` is the recording that it took over from
    while both ran, if there is one: the clock of any other may have been set since.
    """

    start: Ns
    end: Ns | None
    heard: Sequence[ConditionInterval]
    unclear: Sequence[Span] = ()
    name: str = ""
    previous: str | None = None

    @property
    def stop(self) -> Ns:
        """The end, excluded."""
        return MAX_NS if self.end is None else self.end + 1


def add_message(
    heard: list[ConditionInterval], time: Ns, holds: bool | None, *, latched: bool, stale: Ns
) -> None:
    """Adds the next message; `holds` is None if it cannot be read.

    A message that lies before the last one was logged out of order, and changes nothing unless the
    condition holds.
    """
    last = heard[-1] if heard else None
    if last is not None and time < last.last:
        if holds is False:
            return
        if holds is None:
            time = last.last
        elif last.holds and last.lasts == latched:
            last.first = min(last.first, time)
            return
    if (
        last is not None
        and (last.holds, last.lasts) == (holds, latched)
        and (latched or time - last.last <= stale)
    ):
        last.last = time
    else:
        heard.append(ConditionInterval(time, time, holds, latched))


def excluded_intervals(
    rule: ExclusionRule, recordings: Sequence[RecordingConditions]
) -> list[Excluded]:
    """Returns the intervals to cut out, with the margin, in order of time.

    Those in which the condition held, and those in which it was not known, are apart, and may
    overlap. Recordings come in the order in which they began; one that begins before the one before
    it follows a clock that was set back, and learns from it only that the condition held.
    """
    held: Spans = []
    free: list[Spans] = []
    for place, recording in enumerate(recordings, 1):
        later = recordings[place:]
        free_here: Spans = []
        for run, following in zip(recording.heard, [*recording.heard[1:], None], strict=False):
            stop = _valid_until(run, following, recording, rule.stale)
            if following is None and stop >= recording.stop < MAX_NS:
                stop = _valid_past_end(run, recording, later, rule.stale)
                if run.holds:
                    held += _carried(run.first, recording, later, rule.stale)
            if run.holds is True:
                held.append((run.first, stop))
            elif run.holds is False:
                free_here.append((run.first, stop))
        free.append(free_here)
    unknown = [span for recording in recordings for span in recording.unclear]
    if rule.excludes_unknown:
        unknown += _unknown(recordings, held, free)
    return [
        *(Excluded(*span, held=True) for span in _widened(held, rule.margin)),
        *(Excluded(*span, held=False) for span in _widened(unknown, rule.margin)),
    ]


def _unknown(
    recordings: Sequence[RecordingConditions], held: Spans, free: Sequence[Spans]
) -> Iterator[Span]:
    """Yields where recordings did not know, by themselves or by others, whether it holds."""
    for recording in recordings:
        # Of those alone that ran beside it by one clock.
        beside = (
            spans
            for spans, other in zip(free, recordings, strict=True)
            if other is recording
            or (recording.previous == other.name and not other.unclear)
            or other.previous == recording.name
        )
        yield from without([(recording.start, recording.stop)], united(chain(held, *beside)))


def _valid_until(
    run: ConditionInterval,
    following: ConditionInterval | None,
    recording: RecordingConditions,
    stale: Ns,
) -> Ns:
    """Returns until when a recording itself knows the value."""
    stop = recording.stop
    if following is not None and following.first >= run.last:
        stop = following.first
    elif following is not None and not run.holds:
        # The clock was set back: nothing is sure but that the condition may hold.
        return run.last + 1
    return stop if run.lasts else min(stop, run.last + stale)


def _valid_past_end(
    run: ConditionInterval,
    recording: RecordingConditions,
    later: Iterable[RecordingConditions],
    stale: Ns,
) -> Ns:
    """Returns until when the last value of a recording is valid; longer if another took over."""
    was_taken_over = any(
        recording.start <= other.start < recording.stop < other.stop for other in later
    )
    if run.holds or not was_taken_over:
        return recording.stop
    return (recording.stop if run.lasts else run.last) + stale


def _carried(
    since: Ns, ended: RecordingConditions, others: Iterable[RecordingConditions], stale: Ns
) -> Spans:
    """Returns where a condition that held from `since` to the end of a recording goes on after it.

    One that took over may have begun, and received the topic, before the condition held.
    """
    spans: Spans = []
    until: Ns | None = None
    for other in others:
        start = other.start
        if other.previous == ended.name and not (ended.unclear or other.unclear):
            start = max(since, start)
        if other.start < ended.start:  # the clock was set back
            start, until = other.start, other.start + stale
        elif until is None:
            until = max(other.start, ended.stop) + stale
        stop = min(until, other.heard[0].first if other.heard else MAX_NS)
        if start < stop:
            spans.append((start, stop))
        if other.heard:
            break
    return spans


class Cut:
    """Which messages of one bag are deleted.

    The time of receipt decides, but on a latched topic, which each recording receives again, the
    publish time: a message is deleted if it lies in a stretch in which the condition held, or in
    one in which that was not known and the message was received in a stretch, too.

    Args:
        stretches: those of the bag's own time.
        before: those that were excluded before, in which latched messages may have been published.
        latched: the latched topics.
    """

    def __init__(
        self, stretches: Sequence[Excluded], before: Sequence[Excluded], latched: Collection[str]
    ) -> None:
        self._latched = frozenset(latched)
        self._all = united(stretch.span for stretch in stretches)
        known = (*before, *stretches)
        self._known = united(stretch.span for stretch in known)
        self._held = united(stretch.span for stretch in known if stretch.held)

    def takes(self, topic: str, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a message is deleted."""
        if topic not in self._latched:
            return lies_inside(self._all, log_time)
        return self.takes_always(log_time, publish_time) or (
            lies_inside(self._known, _published(log_time, publish_time))
            and lies_inside(self._all, log_time)
        )

    def takes_always(self, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a latched message is deleted whenever it is received."""
        return lies_inside(self._held, _published(log_time, publish_time))

    def touches(self, topic: str, first: Ns, last: Ns) -> bool:
        """Returns whether messages of a topic between two log times may be deleted."""
        if topic in self._latched:
            return bool(self._known)
        return overlaps_any(self._all, first, last)


def add_excluded(
    known: Sequence[Excluded], stretches: Iterable[Excluded], start: Ns, end: Ns
) -> list[Excluded]:
    """Returns what is known with the parts of stretches that touch a file from `start` to `end`.

    What lies between two files, less than messages are out of order, counts with both.
    """
    low, high = start - OUT_OF_ORDER_NS, end + OUT_OF_ORDER_NS + 1
    parts = [
        Excluded(max(stretch.start, low), min(stretch.stop, high), stretch.held)
        for stretch in stretches
        if stretch.start <= end and start < stretch.stop
    ]
    joined: list[Excluded] = []
    for held in (True, False):
        spans = [stretch.span for stretch in (*known, *parts) if stretch.held is held]
        joined += (Excluded(*span, held=held) for span in united(spans))
    return sorted(joined, key=lambda stretch: stretch.span)


def _published(log_time: Ns, publish_time: Ns) -> Ns:
    return publish_time if 0 < publish_time < log_time else log_time


def _widened(spans: Iterable[Span], margin: Ns) -> Spans:
    return united(
        (max(start - margin, MIN_NS), min(stop + margin, MAX_NS))
        for start, stop in spans
        if start < stop
    )

"""Computes when `recording.exclude_when` excludes messages, and which of a bag go. Pure.

The intervals follow from the values of a topic in each recording. A message is valid from its log
time on: on a latched topic until the next one, on any other topic for `stale` after the last one.
It is valid only in its own recording, since the next one receives the topic again. Exception: a
condition that is true at the end of a recording stays true in the following ones, for at most
`stale`, until one of them receives the topic. If another recording has taken over by then, the last
value is valid for `stale` more, until that recording must have received the topic. All other times
are unknown, and so are spans in which the clock was set back.
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

    `end` is None while the recording is being written. `unclear` are the spans in which the clock
    was set back. `previous` is the recording that this one took over from while both ran, if there
    is one: only then the two have one clock.
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
    """Adds the next message to the intervals; `holds` is None if it cannot be read.

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
    is_same = last is not None and (last.holds, last.lasts) == (holds, latched)
    if last is not None and is_same and (latched or time - last.last <= stale):
        last.last = time
    else:
        heard.append(ConditionInterval(time, time, holds, latched))


def excluded_intervals(
    rule: ExclusionRule, recordings: Sequence[RecordingConditions]
) -> list[Excluded]:
    """Returns the intervals to cut out, margins included.

    First come the intervals in which the condition held, then those in which it was unknown; the
    two kinds may overlap. Recordings come in the order in which they began. A recording that
    begins before the one before it follows a clock that was set back, and learns from that one only
    that the condition held.
    """
    held: Spans = []
    free: list[Spans] = []
    for number, recording in enumerate(recordings, 1):
        held_here, free_here = _known_spans(recording, recordings[number:], rule.stale)
        held += held_here
        free.append(free_here)
    unknown = [span for recording in recordings for span in recording.unclear]
    if rule.excludes_unknown:
        unknown += _unknown_spans(recordings, held, free)
    return [
        *(Excluded(*span, held=True) for span in _widened(held, rule.margin)),
        *(Excluded(*span, held=False) for span in _widened(unknown, rule.margin)),
    ]


def _known_spans(
    recording: RecordingConditions, later: Sequence[RecordingConditions], stale: Ns
) -> tuple[Spans, Spans]:
    """Returns when the condition held by the messages of a recording, and when it did not."""
    held: Spans = []
    free: Spans = []
    followers = (*recording.heard[1:], None)
    for interval, following in zip(recording.heard, followers, strict=False):
        stop = _valid_until(interval, following, recording, stale)
        has_ended = recording.end is not None
        if following is None and has_ended and stop >= recording.stop:
            stop = _valid_past_end(interval, recording, later, stale)
            if interval.holds:
                held += _carried(interval.first, recording, later, stale)
        if interval.holds:
            held.append((interval.first, stop))
        elif interval.holds is False:
            free.append((interval.first, stop))
    return held, free


def _unknown_spans(
    recordings: Sequence[RecordingConditions], held: Spans, free: Sequence[Spans]
) -> Iterator[Span]:
    """Yields the spans of recordings in which it is unknown whether the condition held.

    A recording also knows what a recording knew that ran beside it by the same clock.
    """
    for recording in recordings:
        known = [held]
        for other, spans in zip(recordings, free, strict=True):
            is_predecessor = recording.previous == other.name and not other.unclear
            if other is recording or is_predecessor or other.previous == recording.name:
                known.append(spans)
        yield from without([(recording.start, recording.stop)], united(chain(*known)))


def _valid_until(
    interval: ConditionInterval,
    following: ConditionInterval | None,
    recording: RecordingConditions,
    stale: Ns,
) -> Ns:
    """Returns until when a recording itself knows the value."""
    stop = recording.stop
    if following is not None and following.first >= interval.last:
        stop = following.first
    elif following is not None and not interval.holds:
        # The clock was set back: nothing is sure but that the condition may hold.
        return interval.last + 1
    return stop if interval.lasts else min(stop, interval.last + stale)


def _valid_past_end(
    interval: ConditionInterval,
    recording: RecordingConditions,
    later: Iterable[RecordingConditions],
    stale: Ns,
) -> Ns:
    """Returns until when the last value of a recording is valid; longer if another took over."""
    was_taken_over = any(
        recording.start <= other.start < recording.stop < other.stop for other in later
    )
    if interval.holds or not was_taken_over:
        return recording.stop
    return (recording.stop if interval.lasts else interval.last) + stale


def _carried(
    since: Ns, ended: RecordingConditions, others: Iterable[RecordingConditions], stale: Ns
) -> Spans:
    """Returns the spans in later recordings of a condition that held when a recording ended.

    The condition held from `since` on. A recording that took over may have begun, and received the
    topic, before that.
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

    On most topics the log time decides. Each recording receives latched messages again, so there
    the publish time decides, too. A latched message is deleted if it was published in a stretch in
    which the condition held. It is also deleted if it was published in a stretch of unknown state
    and received in a stretch.

    Args:
        stretches: the excluded stretches of the bag's own time.
        before: the stretches excluded before, in which latched messages may have been published.
        latched: the latched topics.
    """

    def __init__(
        self, stretches: Sequence[Excluded], before: Sequence[Excluded], latched: Collection[str]
    ) -> None:
        self._latched = frozenset(latched)
        known = (*before, *stretches)
        self._received = united(stretch.span for stretch in stretches)
        self._published = united(stretch.span for stretch in known)
        self._held = united(stretch.span for stretch in known if stretch.held)

    def takes(self, topic: str, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a message is deleted."""
        is_received_inside = lies_inside(self._received, log_time)
        if topic not in self._latched:
            return is_received_inside
        if self.takes_always(log_time, publish_time):
            return True
        published = _published_at(log_time, publish_time)
        return is_received_inside and lies_inside(self._published, published)

    def takes_always(self, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a latched message is deleted whenever it is received."""
        return lies_inside(self._held, _published_at(log_time, publish_time))

    def touches(self, topic: str, first: Ns, last: Ns) -> bool:
        """Returns whether messages of a topic between two log times may be deleted."""
        if topic in self._latched:
            return bool(self._published)
        return overlaps_any(self._received, first, last)


def add_excluded(
    known: Sequence[Excluded], stretches: Iterable[Excluded], start: Ns, end: Ns
) -> list[Excluded]:
    """Returns the known stretches, with the parts of others that touch a file from start to end.

    A gap between two files, shorter than messages are out of order, belongs to both files.
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


def _published_at(log_time: Ns, publish_time: Ns) -> Ns:
    """Returns the publish time, or the log time if no plausible one was recorded."""
    return publish_time if 0 < publish_time < log_time else log_time


def _widened(spans: Iterable[Span], margin: Ns) -> Spans:
    return united(
        (max(start - margin, MIN_NS), min(stop + margin, MAX_NS))
        for start, stop in spans
        if start < stop
    )

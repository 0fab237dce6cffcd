"""Half-open spans of log time, as sets of moments. Pure."""

from __future__ import annotations

from bisect import bisect_right
from operator import itemgetter
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_MS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.arrays import Ints

COPY_HORIZON_NS: Final[Ns] = 2 * NS_PER_S
"""How far apart the log times of one message in two recordings are at most."""
COPY_JITTER_NS: Final[Ns] = 20 * NS_PER_MS
"""The same where recorders give a message no publish time but its log time.

Two robots seldom say the same in less."""
Spans: TypeAlias = list[Span]
"""Sorted and apart, where functions return them."""


def spans_of(starts: Ints, stops: Ints) -> list[Span]:
    """Returns the spans from each start to its stop, as they come."""
    return [*zip(starts.tolist(), stops.tolist(), strict=True)]


def united(spans: Iterable[Span], apart: Ns = 0) -> Spans:
    """Merges spans that overlap, touch, or are no farther apart; returns them sorted."""
    merged: Spans = []
    for start, stop in sorted(spans):
        if merged and start - merged[-1][1] <= apart:
            last_start, last_stop = merged[-1]
            merged[-1] = last_start, max(last_stop, stop)
        else:
            merged.append((start, stop))
    return merged


def enclosing(spans: Iterable[Span]) -> Span:
    """Returns the earliest start and the latest stop of spans; there is at least one."""
    starts, stops = zip(*spans, strict=True)
    return min(starts), max(stops)


def without(spans: Iterable[Span], others: Sequence[Span]) -> Spans:
    """Returns the parts of spans outside of other spans, which are sorted and apart."""
    parts: Spans = []
    for start, stop in spans:
        at = start
        for nth in range(bisect_right(others, start, key=itemgetter(1)), len(others)):
            other_start, other_stop = others[nth]
            if other_start >= stop:
                break
            if other_start > at:
                parts.append((at, other_start))
            at = other_stop
        if at < stop:
            parts.append((at, stop))
    return parts


def lies_inside(spans: Sequence[Span], moment: Ns) -> bool:
    """Returns whether a moment lies in one of the spans, which are sorted and apart."""
    return overlaps_any(spans, moment, moment)


def overlaps_any(spans: Sequence[Span], first: Ns, last: Ns) -> bool:
    """Returns whether `[first, last]` overlaps one of the spans, which are sorted and apart."""
    nearest = bisect_right(spans, first, key=itemgetter(1))
    if nearest == len(spans):
        return False
    start, _ = spans[nearest]
    return start <= last


def overlap_spans(held: Iterable[tuple[Ns, Ns, object]]) -> list[Span]:
    """Returns the half-open spans in which different recordings can hold copies.

    That is the time that two recordings both hold, widened at both ends by `COPY_HORIZON_NS`.

    Args:
        held: the first and the last log time (inclusive) of each file, and its recording.
    """
    spans: list[Span] = []
    # The last time that any recording holds so far, and that any other recording than this holds.
    farthest: tuple[Ns, object] = (MIN_NS, None)
    farthest_other: tuple[Ns, object] = (MIN_NS, None)
    for first, last, recording in sorted(held, key=itemgetter(0)):
        is_farthest = recording == farthest[1]
        reach, other = farthest_other if is_farthest else farthest
        if other is not None and reach + COPY_HORIZON_NS >= first:
            until = min(reach, last, MAX_NS - COPY_HORIZON_NS - 1) + COPY_HORIZON_NS + 1
            spans.append((first - COPY_HORIZON_NS, until))
        if is_farthest:
            farthest = max(farthest[0], last), recording
        elif last >= farthest[0]:
            farthest, farthest_other = (last, recording), farthest
        elif last > farthest_other[0]:
            farthest_other = last, recording
    return united(spans)

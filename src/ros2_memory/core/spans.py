"""Half-open spans of log time, as sets of moments. Pure."""

from __future__ import annotations

from bisect import bisect_right
from itertools import islice
from operator import itemgetter
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

COPY_HORIZON_NS: Final[Ns] = 2 * NS_PER_S
"""How far apart the log times of one message in two recordings are at most."""
Spans: TypeAlias = list[Span]
"""Sorted and apart, where functions return them."""


def united(spans: Iterable[Span], apart: Ns = 0) -> Spans:
    """Returns spans, sorted; those that touch, or are no farther apart, are merged."""
    merged: Spans = []
    for start, stop in sorted(spans):
        if merged:
            last_start, last_stop = merged[-1]
            if start - last_stop <= apart:
                merged[-1] = last_start, max(last_stop, stop)
                continue
        merged.append((start, stop))
    return merged


def enclosing(spans: Iterable[Span]) -> Span:
    """Returns the earliest begin and the latest end of spans, of which there is one at least."""
    firsts, lasts = zip(*spans, strict=True)
    return min(firsts), max(lasts)


def without(spans: Iterable[Span], others: Sequence[Span]) -> Spans:
    """Returns what is left of spans outside of others, which are sorted and apart."""
    left: Spans = []
    for start, stop in spans:
        at = start
        nth = bisect_right(others, start, key=itemgetter(1))
        for begin, until in islice(others, nth, None):
            if begin >= stop:
                break
            if begin > at:
                left.append((at, begin))
            at = until
        if at < stop:
            left.append((at, stop))
    return left


def lies_inside(spans: Sequence[Span], moment: Ns) -> bool:
    """Returns whether a moment lies in one of spans that are sorted and apart."""
    return overlaps_any(spans, moment, moment)


def overlaps_any(spans: Sequence[Span], first: Ns, last: Ns) -> bool:
    """Returns whether a time (inclusive) overlaps one of spans that are sorted and apart."""
    nth = bisect_right(spans, first, key=lambda span: span[1])
    return nth < len(spans) and spans[nth][0] <= last


def overlap_spans(held: Iterable[tuple[Ns, Ns, object]]) -> list[Span]:
    """Returns the half-open spans in which different recordings can hold copies.

    That is the time that both hold, widened by the horizon at both ends; spans that touch are
    merged.

    Args:
        held: first and last log times (inclusive) of files or recordings, and their recording.
    """
    spans: list[Span] = []
    # What reaches farthest of all so far, and of all other recordings than that.
    farthest: tuple[Ns, object] = (MIN_NS, None)
    another: tuple[Ns, object] = (MIN_NS, None)
    for first, last, recording in sorted(held, key=itemgetter(0)):
        reach, holder = another if recording == farthest[1] else farthest
        if holder is not None and reach + COPY_HORIZON_NS >= first:
            until = min(reach, last, MAX_NS - COPY_HORIZON_NS - 1) + COPY_HORIZON_NS + 1
            spans.append((first - COPY_HORIZON_NS, until))
        if recording == farthest[1]:
            farthest = max(farthest[0], last), recording
        elif last >= farthest[0]:
            farthest, another = (last, recording), farthest
        elif last > another[0]:
            another = last, recording
    return united(spans)

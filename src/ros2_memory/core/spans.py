"""Half-open spans of log time, as sets of moments. Pure."""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, TypeAlias

from ros2_memory.core.timebase import MAX_NS, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Spans: TypeAlias = list[tuple[Ns, Ns]]
"""Sorted and apart, where functions return them."""


def united(spans: Iterable[tuple[Ns, Ns]]) -> Spans:
    """Returns half-open spans, sorted; those that touch are merged."""
    merged: Spans = []
    for start, stop in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], stop))
        else:
            merged.append((start, stop))
    return merged


def without(spans: Iterable[tuple[Ns, Ns]], others: Sequence[tuple[Ns, Ns]]) -> Spans:
    """Returns what is left of spans outside of others, which are sorted and apart."""
    left: Spans = []
    for start, stop in spans:
        at = start
        for begin, until in others:
            if until <= at or begin >= stop:
                continue
            if begin > at:
                left.append((at, begin))
            at = until
        if at < stop:
            left.append((at, stop))
    return left


def lies_inside(spans: Sequence[tuple[Ns, Ns]], moment: Ns) -> bool:
    """Returns whether a moment lies in one of spans that are sorted and apart."""
    index = bisect_right(spans, (moment, MAX_NS)) - 1
    return index >= 0 and moment < spans[index][1]

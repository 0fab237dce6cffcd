"""When some bags hold each topic, and how often, from their summaries.

A week has 60,000 bags with some ten topics or more, so this computes with the numbers of all bags
and topics of a segment at a time.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.analysis.silences import SHORTEST_NS, Presence, Spacing
from ros2_memory.core.bag_summary import numbers_of
from ros2_memory.core.timebase import MAX_NS, MIN_NS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.silences import Span
    from ros2_memory.core.model import BagFile

_FEWEST: Final = 3
"""A bag with fewer messages of a topic shows no period."""
_PER_OCTAVE: Final = 2
_OCTAVES: Final = 64 * _PER_OCTAVE

_NOWHERE: Final = np.empty(0, np.intp)

_Times: TypeAlias = "NDArray[np.int64]"


def presences_of(bags: Sequence[BagFile]) -> dict[str, Presence]:
    """Returns by topic when the bags hold it, and how often; a topic's types count together."""
    schemas = {id(bag.summary.schema): bag.summary.schema for bag in bags}.values()
    topics = sorted({topic for schema in schemas for topic in schema.positions})
    counts, firsts, lasts = _tables(bags, {topic: at for at, topic in enumerate(topics)})
    held = np.array([bag.end - bag.start for bag in bags], np.int64)
    messages = counts.sum(axis=0).tolist()
    lengths = np.where(counts > 0, held[:, None], 0).sum(axis=0).tolist()
    rows = zip(
        topics, _runs(firsts, lasts), _spacings(counts, lasts - firsts), messages, lengths,
        strict=True,
    )  # fmt: skip
    return {topic: Presence(*each) for topic, *each in rows}


def _tables(bags: Sequence[BagFile], column: dict[str, int]) -> tuple[_Times, _Times, _Times]:
    """Returns counts, first and last times by bag and topic; where a bag has none, 0, MAX, MIN."""
    shape = len(bags), len(column)
    counts = np.zeros(shape, np.int64)
    firsts, lasts = np.full(shape, MAX_NS), np.full(shape, MIN_NS)
    groups: dict[int, list[int]] = {}
    for row, bag in enumerate(bags):
        groups.setdefault(id(bag.summary.schema), []).append(row)
    for rows in groups.values():
        schema = bags[rows[0]].summary.schema
        numbers = numbers_of([bags[row].summary for row in rows])
        columns = [column[header.topic] for header in schema.topics]
        if len(schema.positions) == len(columns):
            here = np.ix_(rows, columns)
            counts[here], firsts[here], lasts[here] = np.moveaxis(numbers, 2, 0)
            continue
        for position, at in enumerate(columns):  # a topic of two types has two
            count, first, last = numbers[:, position].T
            counts[rows, at] += count
            firsts[rows, at] = np.minimum(firsts[rows, at], first)
            lasts[rows, at] = np.maximum(lasts[rows, at], last)
    return counts, firsts, lasts


def _runs(firsts: _Times, lasts: _Times) -> Iterator[tuple[Span, ...]]:
    """Yields for each topic its runs; see `Presence`."""
    order = np.argsort(firsts, axis=0, kind="stable")
    firsts = np.take_along_axis(firsts, order, 0)
    reach = np.maximum.accumulate(np.take_along_axis(lasts, order, 0), axis=0)
    # Bags without the topic are sorted to the end, and are no break.
    before = firsts[1:] < MAX_NS
    breaks = before & (np.where(before, firsts[1:], reach[:-1]) - reach[:-1] > SHORTEST_NS)
    whole = [*zip(firsts[0].tolist(), reach[-1].tolist(), strict=True)]
    broken = frozenset(np.flatnonzero(breaks.any(axis=0)).tolist())
    for topic, (first, last) in enumerate(whole):
        at = np.flatnonzero(breaks[:, topic]) if topic in broken else _NOWHERE
        begins = [first, *firsts[1:][at, topic].tolist()]
        ends = [*reach[at, topic].tolist(), last]
        yield tuple(zip(begins, ends, strict=True))


def _spacings(counts: _Times, spans: _Times) -> Iterator[dict[int, Spacing]]:
    """Yields for each topic the spacings of its bags, by the part of an octave of the period."""
    bag, topic = np.nonzero((counts >= _FEWEST) & (spans > 0))
    span, intervals = spans[bag, topic], counts[bag, topic] - 1
    octave = (np.log2(span / intervals) * _PER_OCTAVE).astype(np.int64).clip(0, _OCTAVES - 1)
    key = topic * _OCTAVES + octave
    order = np.argsort(key, kind="stable")
    parts, at = np.unique(key[order], return_index=True)
    found: list[dict[int, Spacing]] = [{} for _ in range(counts.shape[1])]
    bounds = pairwise([*at.tolist(), len(order)])
    for part, (begin, end) in zip(parts.tolist(), bounds, strict=True):
        rows = order[begin:end]
        found[part // _OCTAVES][part % _OCTAVES] = Spacing(
            end - begin, int(span[rows].sum()), int(intervals[rows].sum())
        )
    return iter(found)

"""Where bags may have a hole: a time in which no topic has a message, by their summaries alone.

Within a bag each topic with a usual rate then has fewer messages than fit between its first and its
last. From one split of a recording to the next the recorder ran on, so their times must meet.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.clock_steps import SHORTEST_STEP_NS
from ros2_memory.analysis.silences import usual_period
from ros2_memory.core.timebase import NS_PER_MS, Ns
from ros2_memory.index.split_order import split_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.analysis.silences import Presence
    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import BagFile

_MOST_TOPICS: Final = 4
_FREQUENT_NS: Final[Ns] = 1200 * NS_PER_MS
_LACKING_NS: Final[Ns] = 1500 * NS_PER_MS
"""Messages of so much time are missing: a step of the clock less a period and its jitter."""
_UNSTEADY: Final = 0.01
"""A rate may differ by this share of a bag's length without anything missing."""
_PARTS_OF_AN_OCTAVE: Final = 64
_COVERED: Final = 0.9

Rates: TypeAlias = "tuple[tuple[str, Ns], ...]"
"""Some topics, and their usual periods."""


class SuspectedHole(NamedTuple):
    """A time with a hole in it, or that is one: then it lies from one bag to the next."""

    first: Ns
    last: Ns
    bag: BagFile | None = None


def rates_of(presences: Mapping[str, Presence]) -> Rates:
    """Returns the most frequent topics with a usual rate.

    Their periods are rounded to 1 %, so that a bag more does not change them.
    """
    periods = [
        (period, topic)
        for topic, presence in presences.items()
        if (period := usual_period(presence)) is not None and 0 < period <= _FREQUENT_NS
    ]
    return tuple((topic, _rounded(period)) for period, topic in sorted(periods)[:_MOST_TOPICS])


def _rounded(period: Ns) -> Ns:
    part = round(float(np.log2(period)) * _PARTS_OF_AN_OCTAVE)
    return round(float(np.exp2(part / _PARTS_OF_AN_OCTAVE)))


def bags_with_holes(bags: Sequence[BagFile], rates: Rates) -> Iterator[SuspectedHole]:
    """Yields the bags in which all of these topics have a hole, if they go through the bag."""
    groups: dict[int, list[BagFile]] = {}
    for bag in bags:
        groups.setdefault(id(bag.summary.schema), []).append(bag)
    for group in groups.values():
        schema = group[0].summary.schema
        data = b"".join([bag.summary.numbers for bag in group])
        numbers = np.frombuffer(data, "<i8").reshape(len(group), len(schema.topics), 3)
        lengths = np.array([bag.end - bag.start for bag in group], np.int64)
        limit = np.maximum(_LACKING_NS, lengths * _UNSTEADY)
        lacking, through = np.full(len(group), True), np.full(len(group), False)
        for position, period in _positions(schema, rates):
            count, first, last = numbers[:, position].T
            passes = last - first >= _COVERED * lengths
            lacking &= ~passes | (last - first - (count - 1) * period >= limit)
            through |= passes
        for row in np.flatnonzero(lacking & through).tolist():
            yield SuspectedHole(group[row].start, group[row].end, group[row])


def _positions(schema: SummarySchema, rates: Rates) -> Iterator[tuple[int, Ns]]:
    """Yields where a schema has each topic; not one that has two types in a bag."""
    for topic, period in rates:
        found = schema.positions.get(topic, ())
        if len(found) == 1:
            yield found[0], period


def _is_cut(before: BagFile, after: BagFile, rates: Rates) -> bool:
    """Returns whether messages of a topic are regular to the end of a bag, and on in the next."""
    return any(
        before.end - last.last <= 2 * period and first.first - after.start <= 2 * period
        for topic, period in rates
        for last in before.summary.of(topic)
        for first in after.summary.of(topic)
    )


def between(bags: Sequence[BagFile], rates: Rates) -> Iterator[SuspectedHole]:
    """Yields the holes from one split to the next of the same recording, of bags in order.

    One of these topics must be heard up to the hole, and from it on: a robot on which little is
    published has holes all along.
    """
    for before, after in pairwise(bags):
        if after.start - before.end < SHORTEST_STEP_NS:
            continue
        one, other = split_of(before.file), split_of(after.file)
        if one is None or other is None or one[0] != other[0]:
            continue
        if other[1] == one[1] + 1 and _is_cut(before, after, rates):
            yield SuspectedHole(before.end, after.start)

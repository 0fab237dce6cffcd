"""Where no topic has a message, by the summaries of bags alone: between bags, or perhaps in one.

From one bag to the next that is a gap if it is longer than the recorded data explains. Within a bag
with a hole each topic with a usual rate has fewer messages than fit between its first and its last.
From one split of a recording to the next the recorder ran on, so their times must meet.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.clock_steps import SHORTEST_BY_STAMPS_NS
from ros2_memory.analysis.silences import usual_period
from ros2_memory.core.bag_summary import numbers_of
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns
from ros2_memory.index.split_order import split_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.silences import Presence
    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import BagFile

_MOST_TOPICS: Final = 4
_FREQUENT_NS: Final[Ns] = 1200 * NS_PER_MS
_LACKING_NS: Final[Ns] = 400 * NS_PER_MS
"""Messages of so much time are missing: a step of the clock less its jitter."""
_UNSTEADY: Final = 0.01
"""A rate may differ by this share of a bag's length without anything missing."""
_PARTS_OF_AN_OCTAVE: Final = 64
_COVERED: Final = 0.9
SHORTEST_GAP_NS: Final[Ns] = NS_PER_S
_GAP_PERIODS: Final = 3
_GAP_SPLITS: Final = 2
_LONGEST_LEAST_NS: Final[Ns] = 20 * NS_PER_S

Rates: TypeAlias = "tuple[tuple[str, Ns], ...]"
"""Some topics, and their usual periods."""


class Pause(NamedTuple):
    """A time (log times of two messages) of more than `SHORTEST_GAP_NS` between bags.

    `least` is how long it must be to be a gap: between two splits of a recording, in which the
    recorder ran on, twice the longer one, or 20 s.
    """

    start: Ns
    end: Ns
    least: Ns = SHORTEST_GAP_NS


def pauses_between(bags: Sequence[BagFile]) -> Iterator[Pause]:
    """Yields the pauses between bags, which are in order of time and may overlap."""
    before = bags[0]
    for after in bags[1:]:
        if after.start - before.end > SHORTEST_GAP_NS:
            longer = max(before.end - before.start, after.end - after.start)
            within = min(_GAP_SPLITS * longer, _LONGEST_LEAST_NS)
            least = within if _follows(before, after) else 0
            yield Pause(before.end, after.start, max(least, SHORTEST_GAP_NS))
        if after.end > before.end:
            before = after


def gaps_of(pauses: Iterable[Pause], presences: Mapping[str, Presence]) -> list[tuple[Ns, Ns]]:
    """Returns the pauses that are gaps: those far longer than the most frequent topic's period."""
    least = shortest_gap(presences)
    return [
        (each.start, each.end) for each in pauses if each.end - each.start > max(each.least, least)
    ]


def shortest_gap(presences: Mapping[str, Presence]) -> Ns:
    """Returns how long a pause between two recordings may be without being a gap."""
    periods = filter(None, map(usual_period, presences.values()))
    return max(SHORTEST_GAP_NS, _GAP_PERIODS * min(periods, default=0))


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
        numbers = numbers_of([bag.summary for bag in group])
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
    shortest = SHORTEST_BY_STAMPS_NS + min((period for _, period in rates), default=0)
    for before, after in pairwise(bags):
        if after.start - before.end < shortest:
            continue
        if _follows(before, after) and _is_cut(before, after, rates):
            yield SuspectedHole(before.end, after.start)


def _follows(before: BagFile, after: BagFile) -> bool:
    """Returns whether a bag is the next split of the same recording."""
    one, other = split_of(before.file), split_of(after.file)
    return one is not None and other == (one[0], one[1] + 1)

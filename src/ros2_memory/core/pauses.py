"""Pauses of a bag: times of half a second or more without a message of any topic.

And absences of one topic, which are much longer: they may be silences.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.core.arrays import stable_order
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.arrays import Ints

Pauses: TypeAlias = "tuple[Span, ...]"
"""The log times of the last message before each pause and of the first one after it, in order."""
CountedPause: TypeAlias = "tuple[Ns, Ns, int]"
"""A pause, and how many messages the bag has before it."""
Absences: TypeAlias = "tuple[tuple[str, tuple[CountedPause, ...]], ...]"
"""By topic, the pauses of that topic which may be silences, in order."""

SHORTEST_PAUSE_NS: Final[Ns] = NS_PER_S // 2
SHORTEST_SILENCE_NS: Final[Ns] = 30 * NS_PER_S
SILENT_PERIODS: Final = 20
"""A topic is silent after so many of its periods without a message."""
_PERIODS: Final = 1.5
"""Half as many as make a gap: in a bag with long pauses the mean period exceeds the usual one."""
_CHAINED: Final = 3
"""A pause in a chain belongs to slow topics unless it is so many times as long as the median."""
_MOST: Final = 64
"""Pauses that the summary of a bag states: the longest ones."""


def pauses_among(
    firsts: Ints,
    lasts: Ints,
    counts: Ints,
    *,
    longer_than: Ns = SHORTEST_PAUSE_NS,
) -> list[CountedPause]:
    """Returns the pauses between spans of messages, given in any order.

    Args:
        firsts: the first log time of each span.
        lasts: the last log time of each span (inclusive).
        counts: the number of messages in each span.
        longer_than: shorter pauses are left out.
    """
    order = stable_order(firsts)
    begins, reach = firsts[order][1:], np.maximum.accumulate(lasts[order])[:-1]
    is_pause = begins - reach > longer_than
    columns = (reach, begins, np.cumsum(counts[order])[:-1])
    return [*zip(*(column[is_pause].tolist() for column in columns), strict=True)]


def noteworthy(pauses: Sequence[CountedPause], counts: Sequence[int], length: Ns) -> Pauses:
    """Returns the pauses of a bag that may be more than the time between messages of slow topics.

    While frequent topics are off, the slow ones go on: their pauses follow each other, as a chain.
    Of a chain only pauses that are much longer than its median count.

    Args:
        pauses: of the bag, in order.
        counts: how many messages the bag has of each topic.
        length: from its first message to its last.
    """
    if not pauses:
        return ()
    *_, second_most = sorted(counts, reverse=True)[:2]
    slow_period = _PERIODS * length / second_most
    slow_pauses = [pause for pause in pauses if _length(pause) > slow_period]
    long: list[CountedPause] = []
    for chain in _chains(slow_pauses, len(counts), slow_period):
        median = sorted(map(_length, chain))[(len(chain) - 1) // 2]
        limit = _CHAINED * median if len(chain) > 1 else 0
        long += (pause for pause in chain if _length(pause) > limit)
    return tuple((start, end) for start, end, _ in _longest(long))


def _chains(
    pauses: Sequence[CountedPause], topics: int, slow_period: float
) -> list[list[CountedPause]]:
    """Divides pauses where frequent topics came back: with more messages than slow ones send.

    Slow topics send one message each, or one in each `slow_period` (ns), between two pauses.
    """
    chains: list[list[CountedPause]] = []
    last_end, sent_before = MIN_NS, 0
    for start, end, sent in pauses:
        by_slow_topics = max(topics, (start - last_end) / slow_period)
        if not chains or sent - sent_before > by_slow_topics:
            chains.append([])
        chains[-1].append((start, end, sent))
        last_end, sent_before = end, sent
    return chains


def absences_of(pauses: Sequence[CountedPause], count: int, length: Ns) -> tuple[CountedPause, ...]:
    """Returns the longest pauses of a topic that are far longer than its mean period in a bag.

    Args:
        pauses: of the topic.
        count: how many messages of the topic the bag has.
        length: from the first of these messages to the last.
    """
    limit = SILENT_PERIODS * length // max(count - 1, 1)
    return _longest([pause for pause in pauses if _length(pause) > limit])


def _length(pause: CountedPause) -> Ns:
    start, end, _ = pause
    return end - start


def _longest(pauses: list[CountedPause]) -> tuple[CountedPause, ...]:
    """Returns the `_MOST` longest pauses, in order of time."""
    return tuple(sorted(sorted(pauses, key=_length, reverse=True)[:_MOST]))

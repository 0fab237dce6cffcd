"""Pauses of a bag: from one message to the next, of any topic, nothing was logged for a while.

And those of one topic alone, which are much longer: they may be silences.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.arrays import Ints

Pauses: TypeAlias = "tuple[Span, ...]"
"""From the log time of the last message before each to that of the first after it, in order."""
CountedPause: TypeAlias = "tuple[Ns, Ns, int]"
"""A pause, and how many messages the bag has before it."""
Absences: TypeAlias = "tuple[tuple[str, tuple[CountedPause, ...]], ...]"
"""By topic, the pauses of that topic which may be silences, in order."""

SHORTEST_PAUSE_NS: Final[Ns] = NS_PER_S // 2
SHORTEST_SILENCE_NS: Final[Ns] = 30 * NS_PER_S
SILENT_PERIODS: Final = 20
"""A topic is silent after so many of its periods without a message."""
_PERIODS: Final = 1.5
"""Half of those of a gap: in a bag with long pauses the mean period is longer than the usual."""
_CHAINED: Final = 3
"""A pause among those of slow topics is one of them unless it is so many times as long."""
_MOST: Final = 64
"""The longest pauses of a bag are stated."""


def pauses_among(
    firsts: Ints,
    lasts: Ints,
    counts: Ints,
    *,
    longer_than: Ns = SHORTEST_PAUSE_NS,
) -> list[CountedPause]:
    """Returns the pauses between spans of log time (inclusive), in any order, of some messages."""
    order = np.argsort(firsts, kind="stable")
    begins, reach = firsts[order][1:], np.maximum.accumulate(lasts[order])[:-1]
    apart = begins - reach > longer_than
    columns = (reach, begins, np.cumsum(counts[order])[:-1])
    return [*zip(*(column[apart].tolist() for column in columns), strict=True)]


def noteworthy(pauses: Sequence[CountedPause], counts: Sequence[int], length: Ns) -> Pauses:
    """Returns the pauses that may be more than what lies between messages of slow topics.

    That is where frequent topics come back after each. While they are off and slow ones go on, one
    pause follows the other, with some messages between them.

    Args:
        pauses: of a bag, in order.
        counts: how many messages it has of each topic.
        length: from its first message to its last.
    """
    if not pauses:
        return ()
    slower = _PERIODS * length / sorted(counts, reverse=True)[:2][-1]
    chains: list[list[CountedPause]] = []
    since, sent_before = MIN_NS, 0
    for start, end, sent in pauses:
        if end - start > slower:
            if sent - sent_before > max(len(counts), (start - since) / slower) or not chains:
                chains.append([])
            chains[-1].append((start, end, sent))
            since, sent_before = end, sent
    longer = [
        (start, end) for chain in chains for start, end, _ in chain if end - start > _usual(chain)
    ]
    longer.sort(key=lambda pause: pause[0] - pause[1])  # the longest first
    return tuple(sorted(longer[:_MOST]))


def absences_of(pauses: Sequence[CountedPause], count: int, length: Ns) -> tuple[CountedPause, ...]:
    """Returns the longest pauses of a topic that are far longer than its mean period in a bag.

    `count` and `length`: how many messages of it the bag has, and from the first to the last.
    """
    limit = SILENT_PERIODS * length // max(count - 1, 1)
    longer = [pause for pause in pauses if pause[1] - pause[0] > limit]
    return tuple(sorted(sorted(longer, key=lambda pause: pause[0] - pause[1])[:_MOST]))


def _usual(chain: Sequence[CountedPause]) -> Ns:
    """Returns how long pauses of a chain may be; 0 for one that stands alone."""
    lengths = sorted(end - start for start, end, _ in chain)
    return _CHAINED * lengths[(len(chain) - 1) // 2] if len(chain) > 1 else 0

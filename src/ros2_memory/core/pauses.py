"""Pauses of a bag: from one message to the next, of any topic, nothing was logged for a while."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

Pauses: TypeAlias = "tuple[tuple[Ns, Ns], ...]"
"""From the log time of the last message before each to that of the first after it, in order."""

SHORTEST_PAUSE_NS: Final[Ns] = NS_PER_S // 2
_PERIODS: Final = 1.5
"""Half of those of a gap: in a bag with long pauses the mean period is longer than the usual."""
_MOST: Final = 64
"""The longest pauses of a bag are stated."""


def pauses_among(firsts: NDArray[np.int64], lasts: NDArray[np.int64]) -> Pauses:
    """Returns the pauses between spans of log time (inclusive) in any order, without one inside."""
    order = np.argsort(firsts, kind="stable")
    begins, reach = firsts[order][1:], np.maximum.accumulate(lasts[order])[:-1]
    apart = begins - reach > SHORTEST_PAUSE_NS
    return tuple(zip(reach[apart].tolist(), begins[apart].tolist(), strict=True))


def noteworthy(pauses: Pauses, counts: Sequence[int], length: Ns) -> Pauses:
    """Returns the pauses that may be more than what lies between messages of a slow topic.

    Args:
        pauses: of a bag.
        counts: how many messages it has of each topic.
        length: from its first message to its last.
    """
    if not pauses:
        return ()
    second = sorted(counts, reverse=True)[:2][-1]
    longer = [(start, end) for start, end in pauses if end - start > _PERIODS * length / second]
    longer.sort(key=lambda pause: pause[0] - pause[1])  # the longest first
    return tuple(sorted(longer[:_MOST]))

"""Gaps: where no topic has a message for longer than the recorded data explains. Pure decisions.

A pause lies between two bags, or within one. The usual period of the topics around it explains a
pause: the period of the second most frequent topic, since one topic may fall silent by itself.

Between bags, a long pause is a gap even if the topics are rare. From one split of a recording to
the next the recorder ran on: there, long means twice the longer split, and 20 s at most. If the
two splits have only rare topics, it means 20 s.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.core.pauses import SHORTEST_PAUSE_NS
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, Span
from ros2_memory.index.split_order import split_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ros2_memory.core.model import BagFile
    from ros2_memory.index.bag_rows import BagRows

FAR_AHEAD_NS: Final[Ns] = 30 * 24 * 3600 * NS_PER_S
"""No recorder that runs pauses for so long: the clock was set ahead."""
_SHORTEST_GAP_NS: Final[Ns] = NS_PER_S
"""The shortest gap between two recordings with frequent topics."""
_GAP_PERIODS: Final = 3
"""A topic is missed after this many of its periods."""
_GAP_SPLITS: Final = 2
"""A recorder that runs on may pause for this many splits."""
_ALWAYS_A_GAP_NS: Final[Ns] = 20 * NS_PER_S
"""A longer pause between bags is a gap in any case."""


class Pause(NamedTuple):
    """A time of more than `SHORTEST_PAUSE_NS` without a message.

    Attributes:
        start: log time of the last message before it.
        end: log time of the first message after it.
        bags: the bag that it lies in, or the bags before and after it.
        ran_on: whether one run of a recorder recorded both messages.
    """

    start: Ns
    end: Ns
    bags: tuple[BagFile, ...]
    ran_on: bool

    @property
    def span(self) -> Span:
        """Start and end."""
        return self.start, self.end

    @property
    def length(self) -> Ns:
        """How long it is, ns."""
        return self.end - self.start


def pauses_between(bags: BagRows) -> Iterator[Pause]:
    """Yields the pauses between bags. The bags are in order of time and may overlap."""
    reach = np.minimum(np.maximum.accumulate(bags.ends), MAX_NS - SHORTEST_PAUSE_NS)
    for row in np.flatnonzero(bags.starts[1:] > reach[:-1] + SHORTEST_PAUSE_NS).tolist():
        yield pause_between(bags[int(bags.ends[: row + 1].argmax())], bags[row + 1])


def pause_between(before: BagFile, after: BagFile) -> Pause:
    """Returns the pause between two bags; consecutive splits are of one run of a recorder."""
    name, next_name = split_of(before.file), split_of(after.file)
    ran_on = name is not None and next_name == (name.series, name.number + 1)
    return Pause(before.end, after.start, (before, after), ran_on)


class Rhythm:
    """Tells gaps from other pauses by how often topics usually have a message.

    Args:
        periods: by topic, its usual period (ns); topics without one are missing.
    """

    def __init__(self, periods: Mapping[str, Ns]) -> None:
        self._periods = periods

    def gaps(self, pauses: Iterable[Pause]) -> list[Pause]:
        """Returns the pauses that are gaps."""
        return [pause for pause in pauses if self._is_gap(pause)]

    def suspects(self, pauses: Iterable[Pause]) -> list[Pause]:
        """Returns the pauses of running recorders that may be steps of the clock."""
        return [pause for pause in pauses if pause.ran_on and self._is_unusual(pause, topics=1)]

    @property
    def shortest_gap(self) -> Ns:
        """The length (ns) that a pause between two recordings must exceed to be a gap."""
        return max(_SHORTEST_GAP_NS, _GAP_PERIODS * min(self._periods.values(), default=0))

    def _is_gap(self, pause: Pause) -> bool:
        if any(is_thinned(bag.file) for bag in pause.bags):
            # A thinned day keeps a message of each topic in every slot of 7 s.
            return pause.length > _ALWAYS_A_GAP_NS
        if self._is_unusual(pause, topics=2):
            return True
        if len(pause.bags) == 1:
            return False
        least = self.shortest_gap
        if pause.ran_on:
            split = max(bag.end - bag.start for bag in pause.bags)
            if not any(self._periods.keys() & bag.summary.schema.positions for bag in pause.bags):
                split = _ALWAYS_A_GAP_NS  # rare topics do not show how long a split was
            least = max(least, min(_GAP_SPLITS * split, _ALWAYS_A_GAP_NS))
        return pause.length > least

    def _is_unusual(self, pause: Pause, topics: int) -> bool:
        """Returns whether a pause is longer than the topics around it usually pause.

        The most frequent topics are asked first, until two of them were heard next to the pause,
        and one on each of its sides. The rarest of these sets the limit. With fewer than `topics`
        heard, nothing is known.
        """
        summaries = [bag.summary for bag in pause.bags]
        usual = self._periods.keys() & chain.from_iterable(
            summary.schema.positions for summary in summaries
        )
        unheard_sides, heard, longest_usual = {pause.start, pause.end}, 0, 0
        for topic in sorted(usual, key=self._periods.__getitem__):
            limit = _GAP_PERIODS * self._periods[topic]
            spans = [
                summary.span_of((topic,))
                for summary in summaries
                if topic in summary.schema.positions
            ]
            sides = {
                side
                for side in pause.span
                if any(first - limit <= side <= last + limit for first, last in spans)
            }
            if sides:
                unheard_sides -= sides
                heard += 1
                longest_usual = limit
            if heard > 1 and not unheard_sides:
                break
        return heard >= topics and not unheard_sides and pause.length > longest_usual

"""Gaps: where no topic has a message for longer than the recorded data explains. Pure decisions.

From one bag to the next, or within a bag, as its summary states. What explains a pause is how often
topics have a message that usually have one: the second most frequent of them, since one may fall
silent by itself. Between bags a longer pause is a gap however rare topics are: from one split of a
recording to the next, in which the recorder ran on, twice the longer one, or 20 s; 20 s where they
have rare topics alone.
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

SHORTEST_GAP_NS: Final[Ns] = NS_PER_S
"""Between two recordings, where topics are frequent."""
_GAP_PERIODS: Final = 3
_GAP_SPLITS: Final = 2
_LONGEST_LEAST_NS: Final[Ns] = 20 * NS_PER_S


class Pause(NamedTuple):
    """A time (log times of two messages) of more than `SHORTEST_PAUSE_NS` without a message.

    Attributes:
        start: of the message before it.
        end: of the message after it.
        bags: the bag that it lies in, or those before and after it.
        ran_on: whether one recorder recorded both messages.
    """

    start: Ns
    end: Ns
    bags: tuple[BagFile, ...]
    ran_on: bool

    @property
    def span(self) -> Span:
        """Its first and its last moment (log time, ns)."""
        return self.start, self.end

    @property
    def length(self) -> Ns:
        """How long it is, ns."""
        return self.end - self.start


def pauses_between(bags: BagRows) -> Iterator[Pause]:
    """Yields the pauses between bags, which are in order of time and may overlap."""
    reach = np.minimum(np.maximum.accumulate(bags.ends), MAX_NS - SHORTEST_PAUSE_NS)
    for row in np.flatnonzero(bags.starts[1:] > reach[:-1] + SHORTEST_PAUSE_NS).tolist():
        yield pause_between(bags[int(bags.ends[: row + 1].argmax())], bags[row + 1])


def pause_between(before: BagFile, after: BagFile) -> Pause:
    """Returns the pause between two bags, of one recorder if they are splits that follow."""
    name, next_name = split_of(before.file), split_of(after.file)
    ran_on = name is not None and next_name == (name.series, name.number + 1)
    return Pause(before.end, after.start, (before, after), ran_on)


class Rhythm:
    """How often the topics of bags have a message.

    Args:
        periods: the usual period of each topic of a memory that has one.
    """

    def __init__(self, periods: Mapping[str, Ns]) -> None:
        self._periods = periods

    def gaps(self, pauses: Iterable[Pause]) -> list[Pause]:
        """Returns the pauses that are gaps."""
        return [pause for pause in pauses if self._is_gap(pause)]

    def suspects(self, pauses: Iterable[Pause]) -> list[Pause]:
        """Returns the pauses of running recorders that may be steps of the clock."""
        return [pause for pause in pauses if pause.ran_on and self._is_longer(pause, topics=1)]

    @property
    def shortest_gap(self) -> Ns:
        """How long a pause between two recordings may be without being a gap."""
        return max(SHORTEST_GAP_NS, _GAP_PERIODS * min(self._periods.values(), default=0))

    def _is_gap(self, pause: Pause) -> bool:
        if any(is_thinned(bag.file) for bag in pause.bags):
            # There each topic has a message in every slot of 7 s, or as often as it had.
            return pause.length > _LONGEST_LEAST_NS
        if self._is_longer(pause, topics=2):
            return True
        if len(pause.bags) == 1:
            return False
        longer = max(bag.end - bag.start for bag in pause.bags)
        if not any(self._periods.keys() & bag.summary.schema.positions for bag in pause.bags):
            longer = _LONGEST_LEAST_NS  # how long a split was, rare topics do not show
        least = min(_GAP_SPLITS * longer, _LONGEST_LEAST_NS) if pause.ran_on else 0
        return pause.length > max(least, self.shortest_gap)

    def _is_longer(self, pause: Pause, topics: int) -> bool:
        """Returns whether a pause is longer than its bags explain, by so many topics at least.

        What explains it is how often the second most frequent of the topics has a message that are
        heard up to it or from it on; and the most frequent on either side alone, as others may have
        fallen silent, or have been so, for longer.
        """
        summaries = [bag.summary for bag in pause.bags]
        usual = self._periods.keys() & chain.from_iterable(
            summary.schema.positions for summary in summaries
        )
        sides, heard, explained = {pause.start, pause.end}, 0, 0
        for topic in sorted(usual, key=self._periods.__getitem__):
            limit = _GAP_PERIODS * self._periods[topic]
            spans = [
                summary.span_of((topic,))
                for summary in summaries
                if topic in summary.schema.positions
            ]
            beside = {
                at
                for at in pause.span
                if any(first - limit <= at <= last + limit for first, last in spans)
            }
            if beside:
                sides, heard, explained = sides - beside, heard + 1, limit
            if heard > 1 and not sides:
                break
        return heard >= topics and not sides and pause.length > explained

"""When messages of some topics may meet a condition, by their columns, newest first."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.truth import ColumnCondition
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns
from ros2_memory.history.scan import scan

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.columns.units import Rows
    from ros2_memory.columns.values import Mask
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray

_TOGETHER_NS: Final[Ns] = NS_PER_S
"""Messages that may match and are no farther apart are read at once."""
_MOST_TOGETHER: Final = 256


class Candidate(NamedTuple):
    """A time at which messages may match, and the topics that these are of."""

    window: TimeWindow
    topics: tuple[str, ...]


class CandidateRows:
    """Finds the times of messages that may meet a condition, before a moment.

    Attributes:
        condition: what is searched for.
        ruled_out: whether a message was left out, because its columns do not meet the condition.
        has_looked: whether any message was looked at.
    """

    def __init__(self, view: View, topics: Sequence[str], condition: Condition, until: Ns) -> None:
        self.condition = condition
        self.ruled_out = False
        self.has_looked = False
        newest = max((part.latest for part in view.timeline.segments), default=MIN_NS)
        self._left: dict[str, Ns] = dict.fromkeys(topics, min(until, newest + 1))
        self._ready: list[tuple[Ns, int]] = []
        self._view = view
        self._topics = topics
        self._until = until
        self._test = ColumnCondition(condition, view.extractor)

    def windows(self) -> Iterator[Candidate]:
        """Yields the times at which a match can lie, newest first; they do not overlap."""
        group: list[tuple[Ns, str]] = []
        most = 1
        for time, topic in self._times():
            if group and (group[-1][0] - time > _TOGETHER_NS or len(group) >= most):
                yield _together(group)
                # The first that may match mostly does; where many do not, more are read at once.
                most, group = min(2 * most, _MOST_TOGETHER), []
            group.append((time, topic))
        if group:
            yield _together(group)

    @property
    def reached(self) -> Ns:
        """The log time from which on all has been looked at, and what may match was yielded."""
        waiting = [-time + 1 for time, _ in self._ready]
        return max([*self._left.values(), *waiting], default=MIN_NS)

    def _times(self) -> Iterator[tuple[Ns, str]]:
        """Yields the log times of messages that may match, newest first, each once."""
        sources = [iter(self._of_topic(topic)) for topic in self._topics]
        # What each topic may still yield is no newer than its next table.
        waiting = [
            (-last, nth, times)
            for nth, source in enumerate(sources)
            if (found := next(source, None)) is not None
            for last, times in [found]
        ]
        heapq.heapify(waiting)
        ready = self._ready
        before: tuple[Ns, int] | None = None
        while waiting or ready:
            while waiting and (not ready or waiting[0][0] <= ready[0][0]):
                _, nth, times = heapq.heappop(waiting)
                for time in times.tolist():
                    heapq.heappush(ready, (-time, nth))
                if (found := next(sources[nth], None)) is not None:
                    heapq.heappush(waiting, (-found[0], nth, found[1]))
            if ready:
                time, nth = heapq.heappop(ready)
                if (time, nth) != before:
                    yield -time, self._topics[nth]
                before = time, nth

    def _of_topic(self, topic: str) -> Iterator[tuple[Ns, IntArray]]:
        """Yields for each table of a topic its last log time, and when messages may match."""

        def reached(last: Ns) -> None:
            self._left[topic] = min(last + 1, self._until)

        window = TimeWindow(MIN_NS, self._until)
        for rows in scan(
            self._view,
            topic,
            window,
            newest_first=True,
            may_match=self._may_match,
            may_be_empty=True,
            reached=reached,
        ):
            yield rows.last, self._candidates(rows)
        self._left[topic] = MIN_NS

    def _may_match(self, parts: PartZones) -> bool | Mask:
        found = self._test.may_match(parts)
        self.has_looked = True
        self.ruled_out |= not np.all(found)
        return found

    def _candidates(self, rows: Rows) -> IntArray:
        self.has_looked = True
        truth = self._test.truth(rows.table)
        if truth.is_none:
            self.ruled_out = True
            return np.empty(0, np.int64)
        may = truth.met | truth.unsure
        if rows.index is not None:
            may = may[rows.index]
        self.ruled_out |= not may.all()
        return rows.times[may]


def _together(group: Sequence[tuple[Ns, str]]) -> Candidate:
    topics = tuple(sorted({topic for _, topic in group}))
    return Candidate(TimeWindow(group[-1][0], group[0][0] + 1), topics)

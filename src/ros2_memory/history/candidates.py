"""Which stretches of the history can hold a match, newest first, by what the catalogue rules out.

A match that counts stands in a bag that is not ruled out. So only the time of such bags is
searched; in it everything that can bear on what counts is read, as it is without a catalogue.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.core.model import TimeWindow

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment


class SearchWindow(NamedTuple):
    """A half-open span of time, and what in it is not ruled out: the topics, and the files."""

    window: TimeWindow
    topics: tuple[str, ...]
    bags: frozenset[str]
    recordings: frozenset[Path]


class _Candidate(NamedTuple):
    """A bag that may hold a match on a topic between two log times (inclusive)."""

    first: Ns
    last: Ns
    topic: str
    bag: BagFile


class CandidateBags:
    """Looks for bags that may hold a match on any of the topics.

    Attributes:
        ruled_out: whether a bag was passed over; each of its messages could be decoded.
    """

    def __init__(self, view: View, topics: Sequence[str], condition: Condition, until: Ns) -> None:
        self._view = view
        self._topics = topics
        self._condition = condition
        self._until = until
        self.ruled_out = False

    def stretches(self) -> Iterator[SearchWindow]:
        """The stretches in which a match may lie before `until`, newest first, none twice."""
        group: list[_Candidate] = []
        start = until = self._until
        for each in self._newest_first():
            if group and each.last < start:
                yield _stretch(group, start, until)
                group, until = [], start
            group.append(each)
            start = min(start, each.first)
        if group:
            yield _stretch(group, start, until)

    def _newest_first(self) -> Iterator[_Candidate]:
        """The bags that may hold a match, by the time of their last message of the topic."""
        runs = [
            (-run.spans[topic][1], -rank, order, topic, run)
            for rank, run in enumerate(self._view.snapshot.runs)
            for order, topic in enumerate(self._topics)
            if topic in run.spans and run.spans[topic][0] < self._until
        ]
        heapq.heapify(runs)
        waiting: list[tuple[Ns, int, _Candidate]] = []
        count = 0
        while runs or waiting:
            if runs and (not waiting or runs[0][0] <= waiting[0][0]):
                *_, topic, run = heapq.heappop(runs)
                self._view.check_deadline()
                for each in self._in_run(run, topic):
                    count += 1
                    heapq.heappush(waiting, (-each.last, count, each))
            else:
                yield heapq.heappop(waiting)[2]

    def _in_run(self, run: Segment, topic: str) -> Iterator[_Candidate]:
        notes = self._view.recalled(run)
        known = {} if notes is None else notes.numbers
        possible: Collection[int] = ()
        if notes is not None and known:
            if self._condition.can_match(notes.evidence_of_all(topic)):
                possible = self._possible(notes, topic)
            if notes.whole and not possible:
                self.ruled_out = True
                return
        for bag, first, last in run.extents(topic):
            if first >= self._until:
                continue
            number = known.get(bag.file)
            if number is None or number in possible:
                yield _Candidate(first, last, topic, bag)
            else:
                self.ruled_out = True

    def _possible(self, notes: SegmentDigests, topic: str) -> Collection[int]:
        """The entries that may hold a match."""
        place = self._condition.place
        if place is not None:
            boxes = notes.boxes(topic)
            return boxes.meeting(place.x, place.y, place.z, place.tolerance_m)
        said = notes.evidence(topic)
        return {number for number, each in said.items() if self._condition.can_match(each)}


def _stretch(group: Sequence[_Candidate], start: Ns, until: Ns) -> SearchWindow:
    stop = min(until, max(each.last for each in group) + 1)
    bags = [each.bag for each in group]
    return SearchWindow(
        TimeWindow(start, stop),
        tuple(sorted({each.topic for each in group})),
        frozenset(bag.file for bag in bags),
        frozenset(bag.recording for bag in bags),
    )

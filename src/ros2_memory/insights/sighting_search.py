"""Finds sightings: runs of matches on each topic, the newest first, over columns.

A sighting is message after message of one topic that meets a condition; see `insights.sightings`.
Where a scope does not hold, a match counts as no match.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.history.matched import MET, NOT_MET, Matching, Tested, runs_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.matched import Block, Runs
    from ros2_memory.history.reverse_search import ReverseSearch
    from ros2_memory.history.view import View
    from ros2_memory.places.scope import Scope


@dataclass(frozen=True, slots=True)
class Run:
    """Consecutive matches on one topic.

    Attributes:
        topic: its name.
        first: log time of the first match.
        last: of the last one.
        messages: how many there are.
        until: of the next message, which is no match; None where that is not known.
        begun: whether what came before the first match is known.
    """

    topic: str
    first: Ns
    last: Ns
    messages: int
    until: Ns | None
    begun: bool = True


@dataclass(frozen=True, slots=True)
class Found:
    """What a search found.

    Attributes:
        runs: the newest first.
        searched_to: a log time; all that is newer was searched. None: all of the window was.
        is_over: whether the search ended since its time was over.
    """

    runs: list[Run]
    searched_to: Ns | None = None
    is_over: bool = False


class _OfTopic:
    """The runs of one topic, from its newest block on."""

    def __init__(self, topic: str, *, apart: bool) -> None:
        self._topic = topic
        self._apart = apart
        self.runs: list[Run] = []
        self._is_open = False
        self._begins: Ns = MAX_NS

    @property
    def closed(self) -> list[Run]:
        """The runs to which no older match can belong."""
        return self.runs[:-1] if self._is_open else self.runs

    def add(self, block: Block) -> None:
        """Adds the next older block."""
        if not block.has_match and not self._is_open:
            self._begins = MAX_NS
            return
        tested = block.tested()
        if not tested.times.size:
            return
        runs = runs_of(tested, SILENCE_NS, apart=self._apart)
        after, self._begins = self._begins, int(tested.times[0])
        is_near = after - int(tested.times[-1]) <= SILENCE_NS
        if runs.is_blank:
            self._is_open = self._is_open and is_near
            return
        found = self._listed(runs, after)
        if self._is_open and is_near and runs.goes_on:
            newer, older = self.runs.pop(), found.pop(0)
            messages = newer.messages + older.messages
            self.runs.append(replace(newer, first=older.first, messages=messages))
        self.runs += found
        self._is_open = bool(runs.counts.size) and runs.goes_back

    def end_in(self, view: View, gap: TimeWindow) -> None:
        """Ends the oldest run if the topic has a message in a time that was not searched.

        Then, and where no run goes on, what follows an older run is not known.
        """
        if not self._is_open or _has_messages(view, self._topic, gap):
            self._is_open, self._begins = False, MAX_NS

    def cut(self) -> list[Run]:
        """Returns the runs, of which the oldest may have begun earlier than is known."""
        if not self._is_open:
            return self.runs
        return [*self.runs[:-1], replace(self.runs[-1], begun=False)]

    def _listed(self, runs: Runs, after: Ns) -> list[Run]:
        """Returns the runs of a block, the newest first; `after` is when the next block begins."""
        ends = np.minimum(runs.ends, after).tolist()
        rows = zip(runs.firsts.tolist(), runs.lasts.tolist(), runs.counts.tolist(), strict=True)
        return [
            Run(self._topic, *row, until=None if end == MAX_NS else end)
            for row, end in zip(rows, ends, strict=True)
        ][::-1]


def find_runs(view: View, search: ReverseSearch, scope: Scope, *, enough: int | None) -> Found:
    """Returns the runs of matches in a scope, on all topics of a search; of a log each message.

    Args:
        view: what is searched.
        search: which topics, and for what.
        scope: when matches count.
        enough: how many of the newest are wanted: the search ends when no older match can change
            these, and there is one more. None: all of them.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        NoDataError: none of the topics' messages can be decoded.
        QueryTimeoutError: the call's time is over before the first match was found.
    """
    matching = Matching(view, search)
    # What lies outside of a scope is not read, and may well be decodable.
    matching.ruled_out = scope.is_bounded
    is_log = view.timeline.is_log
    topics = {topic: _OfTopic(topic, apart=is_log(topic)) for topic in search.topics}
    reached = searched = scope.window.stop
    try:
        for window in scope.narrowed():
            for of_topic in topics.values():
                of_topic.end_in(view, TimeWindow(window.stop, searched))
            searched = window.start
            for block in _blocks(matching, topics, window):
                topics[block.topic].add(_counting(block, scope) if scope.is_bounded else block)
                reached = block.first if len(topics) == 1 else block.last
                if enough is not None and _has_enough(topics, enough, reached):
                    search.note_undecodable(_newest_first(topics)[enough - 1].first)
                    return Found(_newest_first(topics), reached)
    except QueryTimeoutError:
        runs = [run for each in topics.values() for run in each.cut()]
        if not runs:
            raise
        return Found(sorted(runs, key=_by_last), reached, is_over=True)
    runs = _newest_first(topics)
    if enough is not None and len(runs) > enough:
        # Whether more was searched than had to be depends on how the rows are stored.
        search.note_undecodable(runs[enough - 1].first)
        return Found(runs, reached)
    search.close(matching, scope.window, found=bool(runs))
    return Found(runs)


def _blocks(matching: Matching, topics: dict[str, _OfTopic], window: TimeWindow) -> Iterator[Block]:
    """Returns the blocks of all topics, the newest first."""
    sources = (matching.newest_first(topic, window) for topic in topics)
    return heapq.merge(*sources, key=lambda block: -block.last)


def _counting(block: Block, scope: Scope) -> Block:
    """Returns a block in which only those are matches that count in a scope."""

    def tested() -> Tested:
        found = block.tested()
        matches = np.flatnonzero(found.met == MET)[::-1]
        # The newest first, as a scope reads what the other topic said.
        times = found.times[matches].tolist()
        counts = np.array([scope.holds_at(time) for time in times], np.bool_)
        met = found.met.copy()
        met[matches[~counts]] = NOT_MET
        return found._replace(met=met)

    return block._replace(tested=tested)


def _has_messages(view: View, topic: str, gap: TimeWindow) -> bool:
    """Whether a topic has a message in a time; by the index where that is enough."""
    if gap.empty:
        return False
    held = view.stream.overlapping_bags([topic], gap)
    is_alone = len({each.bag.recording for each in held}) == 1
    counts = is_alone and not view.stream.may_be_relatched([topic])
    if counts and any(gap.contains(each.first) or gap.contains(each.last) for each in held):
        return True
    return bool(held) and view.stream.first([topic], gap) is not None


def _has_enough(topics: dict[str, _OfTopic], enough: int, reached: Ns) -> bool:
    """Returns whether no match older than a moment can change the newest runs."""
    if sum(len(each.runs) for each in topics.values()) <= enough:
        return False
    newest = _newest_first(topics)[:enough]
    closed = {id(run) for each in topics.values() for run in each.closed}
    return newest[-1].last >= reached and all(id(run) in closed for run in newest)


def _newest_first(topics: dict[str, _OfTopic]) -> list[Run]:
    if len(topics) == 1:
        [only] = topics.values()
        return only.runs
    return sorted((run for each in topics.values() for run in each.runs), key=_by_last)


def _by_last(run: Run) -> Ns:
    return -run.last

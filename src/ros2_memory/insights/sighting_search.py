"""Finds sightings: runs of matches on each topic, the newest first, over columns.

See `insights.sightings`. A match while the scope does not hold counts as no match.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import Equals
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.arrays import rows_of, stable_order, stacked
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.history.lasting import (
    Lasting,
    held_until,
    is_latched,
    lasting_of,
    says_events,
)
from ros2_memory.history.reverse_search import MET, NOT_MET, Block, ReverseSearch, Tested

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Scope


_MOST_WAITING: Final = 1 << 14
"""Messages of blocks that are joined together."""


class Run(NamedTuple):
    """Consecutive matches on one topic.

    Attributes:
        first, last: log times (ns) of the first and the last match.
        messages: how many matches.
        until: log time of the next message, which is no match, or until which the last match does
            not last; `MAX_NS` if that is unknown.
        later: how many matches after the last one have the same log time.
        begun: 1 if it is known what came before the first match, else 0.
        node: the number of the node that publishes diagnostics; else 0.
    """

    topic: str
    first: Ns
    last: Ns
    messages: int
    until: Ns
    later: int
    begun: int
    node: int


_FIRST, _LAST, _MESSAGES, _BEGUN = 1, 2, 3, 6
"""Columns of runs as an array: the fields of `Run`, with a number for the topic."""


@dataclass(frozen=True, slots=True)
class SearchedRuns:
    """The runs that a search found.

    Attributes:
        topics: the names of topics by number.
        table: a row for each run, the newest first.
        searched_to: the log time since when all was searched; None for all of the window.
        is_over: whether the search ended because its time was over.
    """

    topics: Sequence[str]
    table: Ints
    searched_to: Ns | None = None
    is_over: bool = False

    @property
    def spans(self) -> Ints:
        """The first and the last log time of each run, and whether it is known to begin then."""
        return self.table[:, [_FIRST, _LAST, _BEGUN]]

    def runs(self, which: Ints | slice[int | None, int | None]) -> list[Run]:
        """Returns the runs in some rows."""
        return [Run(self.topics[topic], *run) for topic, *run in self.table[which].tolist()]


class _NodeRuns:
    """Joins the messages of one topic, on diagnostics of one node, the newest first, into runs.

    Args:
        topic: its number.
        node: its number.
        apart: whether each match is a run of its own.
        lasting: says which match lasts until the next message.
    """

    def __init__(self, topic: int, node: int, *, apart: bool, lasting: Lasting) -> None:
        self._topic = topic
        self._node = node
        self._apart = apart
        self._lasting = lasting
        self._tables: list[Ints] = []
        # Whether the oldest run may go on in an older message.
        self.is_open = False
        # The log time of the oldest message; MAX_NS if it is unknown what follows an older one.
        self._begins: Ns = MAX_NS
        # The log time of the oldest message that ends a match before it; MAX_NS if none is known.
        self._bound: Ns = MAX_NS

    def tables(self, *, cut: bool) -> list[Ints]:
        """Returns tables of runs. With `cut` an oldest run that may go on has no known begin."""
        if not (cut and self.is_open):
            return self._tables
        *newer, last = self._tables
        oldest = last.copy()
        oldest[-1, _BEGUN] = 0
        return [*newer, oldest]

    def add(self, tested: Tested) -> None:
        """Joins the matches of the next older messages to the runs."""
        after, self._begins = self._begins, int(tested.times[0])
        times, met = tested.times, tested.met
        ends = self._lasting.ends(np.append(times, after))
        goes_on = self.is_open and not ends[-1]
        # Bounds are messages that do not match, or until which none lasts.
        is_bound = (met == NOT_MET) | np.append(False, ends[:-1])
        bounds, rows = np.flatnonzero(is_bound), np.flatnonzero(met == MET)
        bound_times = np.append(times[bounds], after if ends[-1] else self._bound)
        self._bound = int(bound_times[0])
        if not rows.size and not bounds.size:
            self.is_open = goes_on
            return
        next_bound = np.searchsorted(bounds, rows, side="right")
        starts = np.flatnonzero(self._apart | (np.diff(next_bound, prepend=-1) > 0))
        stops = np.append(starts, rows.size)[1:]
        until = bound_times[next_bound[stops - 1]]
        lasts = times[rows[stops - 1]]
        later = np.searchsorted(times[rows], lasts, side="right") - stops
        columns = (times[rows[starts]], lasts, stops - starts, until, later)
        runs = np.stack(np.broadcast_arrays(self._topic, *columns, 1, self._node), axis=1)[::-1]
        if goes_on and next_bound[-1:].tolist() == [bounds.size]:
            # The newest of these runs is the begin of the oldest one before.
            oldest = self._tables[-1][-1]
            oldest[_FIRST] = runs[0, _FIRST]
            oldest[_MESSAGES] += runs[0, _MESSAGES]
            runs = runs[1:]
        if len(runs):
            self._tables.append(runs)
        self.is_open = not self._apart and next_bound[:1].tolist() == [0]

    def end(self) -> None:
        """Ends the oldest run; it is not known what follows an older one."""
        self.is_open, self._begins, self._bound = False, MAX_NS, MAX_NS


class _TopicRuns:
    """Joins the blocks of one topic, the newest first, into runs.

    Each node of diagnostics has runs of its own: its report does not end the error of another.

    Args:
        topic: its number.
        apart, lasting: see `_NodeRuns`.
    """

    def __init__(self, topic: int, *, apart: bool, lasting: Lasting) -> None:
        self._new_runs = partial(_NodeRuns, topic, apart=apart, lasting=lasting)
        self._lasting = lasting
        self._by_node: dict[int, _NodeRuns] = {}
        self._waiting: list[Tested] = []
        self._messages = 0
        # Blocks without a match that follow the next older one soon, the newest first.
        self._skipped: list[Block] = []

    def tables(self, *, cut: bool) -> list[Ints]:
        """Returns tables of runs; see `_NodeRuns.tables`."""
        self._join()
        return [table for runs in self._by_node.values() for table in runs.tables(cut=cut)]

    def add(self, block: Block) -> None:
        """Adds the next older block."""
        # What follows this block soon ends the runs in it; later messages are looked up one by one.
        pause = self._lasting.pause(block.last)
        soon = block.last + (SILENCE_NS if pause == MAX_NS else pause)
        near = [newer for newer in self._skipped if newer.first <= soon]
        self._skipped = [*near, block]
        if not block.has_match and not self._is_open():
            return
        for tested in [skipped.tested() for skipped in self._skipped]:
            # One by one, many small blocks take long.
            self._waiting.append(tested)
            self._messages += tested.times.size
        self._skipped = []
        if self._messages >= _MOST_WAITING:
            self._join()

    def _is_open(self) -> bool:
        """Returns whether a run may go on in an older block."""
        self._join()
        return any(runs.is_open for runs in self._by_node.values())

    def _join(self) -> None:
        """Joins the messages of blocks that wait to the runs of their nodes."""
        if not self._waiting:
            return
        tested = stacked(self._waiting[::-1])
        self._waiting, self._messages = [], 0
        for node in np.unique(tested.nodes).tolist():
            if node not in self._by_node:
                self._by_node[node] = self._new_runs(node)
            self._by_node[node].add(rows_of(tested, tested.nodes == node))

    def end_in(self, view: View, topic: str, gap: TimeWindow) -> None:
        """Ends the oldest runs if the topic has a message in a time that is not searched.

        If none goes on then, it is unknown what follows an older one.
        """
        if not self._is_open() or (not gap.empty and view.stream.first([topic], gap) is not None):
            for runs in self._by_node.values():
                runs.end()


def is_flag(condition: Condition) -> bool:
    """Returns whether a condition asks for true or false, which is a state."""
    test = condition.test
    return isinstance(test, Equals) and str(test.value).casefold() in {"true", "false"}


def find_runs(
    view: View, search: ReverseSearch, scope: Scope, *, enough: int | None
) -> SearchedRuns:
    """Returns the runs of matches in a scope, on all topics of a search; in a log each match.

    A value of a latched topic holds on: its run has the parts of that time in the scope.

    Args:
        view: has the bags.
        search: has the topics and the condition.
        scope: when matches count.
        enough: how many of the newest runs are wanted. The search ends when these are known, and
            that there is one more. None for all runs.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        NoDataError: none of the topics' messages can be decoded.
        QueryTimeoutError: the call's time is over before the first match was found.
    """
    # Messages outside of a scope are not read, and may well be decodable.
    search.ruled_out = scope.is_bounded
    topics = search.topics
    latched = [topic for topic in topics if scope.is_bounded and is_latched(view, topic)]
    if latched:
        enough = None
    by_topic = {
        topic: _TopicRuns(
            nth,
            apart=says_events(view, topic),
            lasting=lasting_of(view, topic, states=is_flag(search.condition)),
        )
        for nth, topic in enumerate(topics)
    }
    windows = [scope.window] if latched else scope.narrowed()
    reached = scope.window.stop
    try:
        for block in _blocks_newest_first(view, search, scope, windows, by_topic):
            is_whole = not scope.is_bounded or block.topic in latched
            by_topic[block.topic].add(block if is_whole else _in_scope(block, scope))
            reached = block.first if len(topics) == 1 else block.last
            if enough is not None and _has_enough(by_topic.values(), enough, reached):
                break
    except QueryTimeoutError:
        table = _newest_first(by_topic.values(), cut=True)
        if not len(table):
            raise
        return _parts_in(view, SearchedRuns(topics, table, reached, is_over=True), scope, latched)
    found = SearchedRuns(topics, _newest_first(by_topic.values(), cut=False))
    found = _parts_in(view, found, scope, latched)
    if enough is not None and len(found.table) > enough:
        # Whether more was searched than had to be depends on how the rows are stored.
        search.note_untested(replace(scope.window, start=int(found.spans[enough - 1, 0])))
        return replace(found, searched_to=reached)
    search.close(scope.window, is_found=len(found.table) > 0)
    return found


def _blocks_newest_first(
    view: View,
    search: ReverseSearch,
    scope: Scope,
    windows: Iterable[TimeWindow],
    by_topic: Mapping[str, _TopicRuns],
) -> Iterator[Block]:
    """Yields the blocks of all topics in windows, the newest first; ends runs between windows."""
    searched = scope.window.stop
    for window in windows:
        for topic, topic_runs in by_topic.items():
            topic_runs.end_in(view, topic, TimeWindow(window.stop, searched))
        searched = window.start
        blocks = (search.blocks(topic, window) for topic in by_topic)
        yield from heapq.merge(*blocks, key=lambda block: -block.last)


def _parts_in(
    view: View, found: SearchedRuns, scope: Scope, latched: Collection[str]
) -> SearchedRuns:
    """Returns runs, with the parts of a scope in which values of latched topics held."""
    if not latched:
        return found
    parts: list[Run] = []
    for run in found.runs(slice(None)):
        parts += _latched_parts(view, run, scope) if run.topic in latched else [run]
    rows = [(found.topics.index(run.topic), *run[1:]) for run in parts]
    table = np.array(rows, np.int64).reshape(-1, len(Run._fields))
    return replace(found, table=_in_order(table))


def _latched_parts(view: View, run: Run, scope: Scope) -> Iterator[Run]:
    """Yields the parts of a scope in which a value of a latched topic held; each begins with it."""
    _, end = scope.window.asked()
    until = held_until(view, run.topic, run.last, end)
    for first, stop in scope.parts_of(run.first, until):
        messages = 0
        if first <= run.last:
            said = TimeWindow(first, min(run.last, stop) + 1)
            messages = sum(1 for _ in view.stream.messages([run.topic], said))
        if messages or first < stop:
            yield run._replace(
                first=first,
                last=max(first, min(run.last, stop)),
                messages=messages,
                later=0,
                begun=run.begun if first == run.first else 1,
            )


def _in_scope(block: Block, scope: Scope) -> Block:
    """Returns a block whose matches outside of a scope are no matches."""

    def test() -> Tested:
        messages = block.tested()
        # The newest first, as a scope reads what the other topic said.
        matches = np.flatnonzero(messages.met == MET)[::-1]
        times = messages.times[matches].tolist()
        counts = np.array([scope.holds_at(time) for time in times], np.bool_)
        met = messages.met.copy()
        met[matches[~counts]] = NOT_MET
        return replace(messages, met=met)

    return block._replace(tested=test)


def _has_enough(by_topic: Collection[_TopicRuns], enough: int, reached: Ns) -> bool:
    """Returns whether the newest runs are known, whatever matches before a moment (ns) follow."""
    runs = _newest_first(by_topic, cut=True)
    newest = runs[:enough]
    return len(runs) > enough and newest[-1, _LAST] >= reached and bool(newest[:, _BEGUN].all())


def _newest_first(by_topic: Collection[_TopicRuns], *, cut: bool) -> Ints:
    """Returns the runs of all topics in one table; see `_NodeRuns.tables`."""
    tables = [table for topic_runs in by_topic for table in topic_runs.tables(cut=cut)]
    return _in_order(np.concatenate([np.empty((0, len(Run._fields)), np.int64), *tables]))


def _in_order(runs: Ints) -> Ints:
    return runs[stable_order(-runs[:, _LAST])]

"""Finds sightings: runs of matches on each topic, the newest first, over columns.

A sighting is message after message of one topic that meets a condition; see `insights.sightings`.
Where a scope does not hold, a match counts as no match.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.columns.values import TruthValues, nowhere
from ros2_memory.core.arrays import rows_of, stacked
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns
from ros2_memory.history.held_values import held_until, is_latched
from ros2_memory.history.reverse_search import RowCondition
from ros2_memory.history.scan import messages_at, scan

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.columns.units import Rows
    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.reverse_search import ReverseSearch
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Scope
    from ros2_memory.storage.base import IntArray


MET: Final = 1
NOT_MET: Final = 0
UNKNOWN: Final = 2
"""The message cannot be decoded."""

_TOGETHER_NS: Final[Ns] = 2 * NS_PER_S
"""Messages that the bag decides and are no farther apart are read at once."""
_MOST_WAITING: Final = 1 << 14
"""So many messages are looked at together."""


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """Messages of a topic, ordered by log time, and which of them meet a condition.

    Attributes:
        times: log times (ns).
        met: `MET`, `NOT_MET` or `UNKNOWN` for each.
        sources: a number for recording and type of each; by it those of one log time are ordered.
    """

    times: IntArray
    met: NDArray[np.uint8]
    sources: IntArray


class Block(NamedTuple):
    """Messages of a topic between two log times (inclusive).

    Attributes:
        topic: its name.
        first: no message is earlier.
        last: none is later.
        has_match: whether some message may meet the condition.
        tested: tests them.
    """

    topic: str
    first: Ns
    last: Ns
    has_match: bool
    tested: Callable[[], Tested]


class MatchTester:
    """Tests the messages of the topics of a search.

    Attributes:
        ruled_out: whether a message was seen not to match by its columns.
    """

    def __init__(self, view: View, search: ReverseSearch) -> None:
        self.ruled_out = False
        self._view = view
        self._search = search
        self._test = RowCondition(view, search.condition)
        self._numbers: dict[str, dict[tuple[Path, str], int]] = {}

    def newest_first(self, topic: str, window: TimeWindow) -> Iterator[Block]:
        """Yields the messages of a topic in blocks that do not overlap, the newest block first.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        waiting: Block | None = None
        try:
            for rows in scan(
                self._view,
                topic,
                window,
                newest_first=True,
                may_match=self._test.may_match,
                may_not_match=True,
                may_be_empty=True,
            ):
                block = self._block(topic, rows, window)
                if waiting is None or block.last < waiting.first:
                    newer, waiting = waiting, block
                else:
                    newer, waiting = _merged_and_split(waiting, block)
                if newer is not None:
                    yield newer
        except QueryTimeoutError:
            if waiting is not None:
                yield waiting
            raise
        if waiting is not None:
            yield waiting

    def _block(self, topic: str, rows: Rows, window: TimeWindow) -> Block:
        truth = self._test.truth(rows) if rows.may_match else nowhere(len(rows.table))
        has_match = not truth.is_none
        self.ruled_out |= not has_match
        first, last = max(rows.first, window.start), min(rows.last, window.stop - 1)
        tested = partial(self._test_rows, topic, rows, truth)
        return Block(topic, first, last, has_match=has_match, tested=tested)

    def _test_rows(self, topic: str, rows: Rows, truth: TruthValues) -> Tested:
        """Tests the rows that count: by columns, and by messages where these leave it open."""
        counting = slice(None) if rows.index is None else rows.index
        surely, perhaps = truth.surely[counting], truth.perhaps[counting]
        self.ruled_out |= not perhaps.all()
        source = self._source_numbers(topic)[rows.recording, rows.table.channel.type]
        sources = np.full(len(rows), source)
        met = surely.astype(np.uint8)
        met[self._test.unstated(rows)[counting] & ~surely] = UNKNOWN
        undecided = np.flatnonzero(perhaps & ~surely)
        if undecided.size:
            # Messages that lie close together are read at once.
            edges = np.flatnonzero(np.diff(rows.times[undecided]) > _TOGETHER_NS) + 1
            for together in np.split(undecided, edges):
                # What cannot be read is no match; a note reports it.
                met[together] = NOT_MET
                for nth, message in messages_at(self._view, rows.some(together)):
                    is_match = self._search.matches(message)
                    met[together[nth]] = UNKNOWN if is_match is None else int(is_match)
        return Tested(rows.times, met, sources)

    def _source_numbers(self, topic: str) -> dict[tuple[Path, str], int]:
        """Returns numbers of the recordings and types of a topic, in the order of `Rows.order`."""
        if topic not in self._numbers:
            timeline = self._view.timeline
            recordings = sorted(timeline.recordings(topic), key=str)
            sources = product(recordings, sorted(timeline.types_of(topic)))
            self._numbers[topic] = {source: nth for nth, source in enumerate(sources)}
        return self._numbers[topic]


def _merged_and_split(waiting: Block, reached: Block) -> tuple[Block | None, Block]:
    """Returns two blocks that overlap as their messages after the end of `reached`, and all others.

    The former are None where there are none. No block that a scan reaches later has a message
    after the end of `reached`.
    """
    if not waiting.tested().times.size:
        return None, reached
    if not reached.tested().times.size:
        return None, waiting
    # Of one log time and recording what the scan reaches later was written before.
    both = stacked([reached.tested(), waiting.tested()])
    ordered = rows_of(both, np.lexsort((both.sources, both.times)))
    cut = int(np.searchsorted(ordered.times, reached.last, side="right"))
    older = _block_of(waiting.topic, rows_of(ordered, slice(cut)))
    newer = rows_of(ordered, slice(cut, None))
    return (_block_of(waiting.topic, newer) if newer.times.size else None), older


def _block_of(topic: str, tested: Tested) -> Block:
    first, last = int(tested.times[0]), int(tested.times[-1])
    return Block(topic, first, last, has_match=bool(tested.met.any()), tested=lambda: tested)


class Run(NamedTuple):
    """Consecutive matches on one topic.

    Attributes:
        topic: its name.
        first: log time of the first match.
        last: of the last one.
        messages: how many there are.
        until: of the next message, which is no match or comes after a silence; `MAX_NS` where that
            is not known.
        later: how many matches have the log time of the last one, and come after it.
        begun: 1 where what came before the first match is known, else 0.
    """

    topic: str
    first: Ns
    last: Ns
    messages: int
    until: Ns
    later: int
    begun: int


_FIRST, _LAST, _MESSAGES, _BEGUN = 1, 2, 3, 6
"""Columns of runs as an array: as `Run` has them, a topic by its number."""


@dataclass(frozen=True, slots=True)
class SearchedRuns:
    """What a search found.

    Attributes:
        topics: their names, by number.
        table: the runs, a row for each, the newest first.
        searched_to: a log time; all that is newer was searched. None: all of the window was.
        is_over: whether the search ended since its time was over.
    """

    topics: Sequence[str]
    table: Ints
    searched_to: Ns | None = None
    is_over: bool = False

    @property
    def spans(self) -> Ints:
        """The first and the last log time of each, and whether it is known to begin then."""
        return self.table[:, [_FIRST, _LAST, _BEGUN]]

    def runs(self, which: Ints | slice[int | None, int | None]) -> list[Run]:
        """Returns some of the runs."""
        return [Run(self.topics[topic], *run) for topic, *run in self.table[which].tolist()]


class _TopicRuns:
    """The runs of one topic, from its newest block on."""

    def __init__(self, topic: int, *, apart: bool) -> None:
        self._topic = topic
        self._apart = apart
        self._runs: list[Ints] = []
        self._is_open = False
        self._begins: Ns = MAX_NS
        self._waiting: list[Tested] = []
        self._messages = 0

    def runs(self, *, cut: bool) -> list[Ints]:
        """Returns tables of runs. With `cut` the oldest may have begun earlier than is known."""
        self._join()
        if not (cut and self._is_open):
            return self._runs
        *newer, last = self._runs
        oldest = last.copy()
        oldest[-1, _BEGUN] = 0
        return [*newer, oldest]

    def add(self, block: Block) -> None:
        """Adds the next older block."""
        if not block.has_match:
            self._join()
            if not self._is_open:
                self._begins = MAX_NS
                return
        tested = block.tested()
        if tested.times.size:
            # Many small blocks take long one by one.
            self._waiting.append(tested)
            self._messages += tested.times.size
            if self._messages >= _MOST_WAITING:
                self._join()

    def _join(self) -> None:
        """Joins the runs in the blocks that were added since to those before."""
        if not self._waiting:
            return
        tested = stacked(self._waiting[::-1])
        self._waiting, self._messages = [], 0
        after, self._begins = self._begins, int(tested.times[0])
        times, met = tested.times, tested.met
        is_silent = np.diff(times, prepend=times[0]) > SILENCE_NS
        is_open = self._is_open and after - int(times[-1]) <= SILENCE_NS
        others, rows = np.flatnonzero((met == NOT_MET) | is_silent), np.flatnonzero(met == MET)
        if not rows.size and not others.size:
            self._is_open = is_open
            return
        # Of two matches, this differs where a message that is none, or a silence, lies between.
        ends = np.searchsorted(others, rows, side="right")
        starts = np.flatnonzero(self._apart | (np.diff(ends, prepend=-1) > 0))
        stops = np.append(starts, rows.size)[1:]
        until = np.append(times[others], MAX_NS)[ends[stops - 1]]
        lasts = times[rows[stops - 1]]
        later = np.searchsorted(times[rows], lasts, side="right") - stops
        columns = (times[rows[starts]], lasts, stops - starts, np.minimum(until, after), later, 1)
        runs = np.stack(np.broadcast_arrays(self._topic, *columns), axis=1)[::-1]
        if is_open and ends[-1:].tolist() == [others.size]:
            self._runs[-1][-1, _FIRST] = runs[0, _FIRST]
            self._runs[-1][-1, _MESSAGES] += runs[0, _MESSAGES]
            runs = runs[1:]
        if len(runs):
            self._runs.append(runs)
        self._is_open = not self._apart and ends[:1].tolist() == [0]

    def end_in(self, view: View, topic: str, gap: TimeWindow) -> None:
        """Ends the oldest run if the topic has a message in a time that was not searched.

        Then, and where no run goes on, what follows an older run is not known.
        """
        self._join()
        if not self._is_open or (not gap.empty and view.stream.first([topic], gap) is not None):
            self._is_open, self._begins = False, MAX_NS


def find_runs(
    view: View, search: ReverseSearch, scope: Scope, *, enough: int | None
) -> SearchedRuns:
    """Returns the runs of matches in a scope, on all topics of a search; of a log each message.

    What a latched topic states holds on: of its runs there are the parts that lie in the scope.

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
    tester = MatchTester(view, search)
    # What lies outside of a scope is not read, and may well be decodable.
    tester.ruled_out = scope.is_bounded
    topics, is_log = search.topics, view.timeline.is_log
    latched = [topic for topic in topics if scope.is_bounded and is_latched(view, topic)]
    if latched:
        enough = None
    by_topic = {topic: _TopicRuns(nth, apart=is_log(topic)) for nth, topic in enumerate(topics)}
    reached = searched = scope.window.stop
    try:
        for window in [scope.window] if latched else scope.narrowed():
            for topic, topic_runs in by_topic.items():
                topic_runs.end_in(view, topic, TimeWindow(window.stop, searched))
            searched = window.start
            blocks = (tester.newest_first(topic, window) for topic in topics)
            for block in heapq.merge(*blocks, key=lambda block: -block.last):
                is_whole = not scope.is_bounded or block.topic in latched
                counted = block if is_whole else _scoped(block, scope)
                by_topic[block.topic].add(counted)
                reached = block.first if len(topics) == 1 else block.last
                if enough is not None and _has_enough(by_topic.values(), enough, reached):
                    break
            else:
                continue
            break
    except QueryTimeoutError:
        found = SearchedRuns(
            topics, _newest_first(by_topic.values(), cut=True), reached, is_over=True
        )
        if not len(found.table):
            raise
        return _parts_in(view, found, scope, latched)
    found = SearchedRuns(topics, _newest_first(by_topic.values()))
    found = _parts_in(view, found, scope, latched)
    if enough is not None and len(found.table) > enough:
        # Whether more was searched than had to be depends on how the rows are stored.
        search.note_untested(replace(scope.window, start=int(found.spans[enough - 1, 0])))
        return replace(found, searched_to=reached)
    search.close(scope.window, is_found=len(found.table) > 0, ruled_out=tester.ruled_out)
    return found


def _parts_in(
    view: View, found: SearchedRuns, scope: Scope, latched: Collection[str]
) -> SearchedRuns:
    """Returns runs, and of those of latched topics the parts of a scope in which they held."""
    if not latched:
        return found
    _, end = scope.window.asked()
    parts: list[tuple[int, ...]] = []
    for run in found.runs(slice(None)):
        topic = found.topics.index(run.topic)
        if run.topic not in latched:
            parts.append((topic, *run[1:]))
            continue
        until = held_until(view, run.topic, run.last, end)
        for first, stop in scope.parts_of(run.first, until):
            said = TimeWindow(first, min(run.last, stop) + 1)
            messages = 0
            if first <= run.last:
                messages = sum(1 for _ in view.stream.messages([run.topic], said))
            if messages or first < stop:
                last = max(first, min(run.last, stop))
                begun = run.begun if first == run.first else 0
                parts.append((topic, first, last, messages, run.until, 0, begun))
    return replace(found, table=_in_order(np.array(parts, np.int64).reshape(-1, 7)))


def _scoped(block: Block, scope: Scope) -> Block:
    """Returns a block in which only those are matches that count in a scope."""

    def tested() -> Tested:
        messages = block.tested()
        # The newest first, as a scope reads what the other topic said.
        matches = np.flatnonzero(messages.met == MET)[::-1]
        times = messages.times[matches].tolist()
        counts = np.array([scope.holds_at(time) for time in times], np.bool_)
        met = messages.met.copy()
        met[matches[~counts]] = NOT_MET
        return replace(messages, met=met)

    return block._replace(tested=tested)


def _has_enough(by_topic: Collection[_TopicRuns], enough: int, reached: Ns) -> bool:
    """Returns whether no match older than a moment can change the newest runs."""
    runs = _newest_first(by_topic, cut=True)
    newest = runs[:enough]
    return len(runs) > enough and newest[-1, _LAST] >= reached and bool(newest[:, _BEGUN].all())


def _newest_first(by_topic: Collection[_TopicRuns], *, cut: bool = False) -> Ints:
    tables = [table for topic_runs in by_topic for table in topic_runs.runs(cut=cut)]
    return _in_order(np.concatenate([np.empty((0, len(Run._fields)), np.int64), *tables]))


def _in_order(runs: Ints) -> Ints:
    return runs[np.argsort(-runs[:, _LAST], kind="stable")]

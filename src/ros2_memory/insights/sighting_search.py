"""Finds sightings: runs of matches on each topic, the newest first, over columns.

A sighting is message after message of one topic that meets a condition; see `insights.sightings`.
Where a scope does not hold, a match counts as no match.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.columns.limits import TruthValues, nowhere
from ros2_memory.core.arrays import rows_of, stacked
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns
from ros2_memory.history.held_values import held_until, is_latched
from ros2_memory.history.reverse_search import RowCondition
from ros2_memory.history.scan import messages_at, scan

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.columns.units import Rows
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
_LAST: Final = attrgetter("last")
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
        until: of the next message, which is no match or comes after a silence; None where that is
            not known.
        begun: whether what came before the first match is known.
        later: how many matches have the log time of the last one, and come after it.
    """

    topic: str
    first: Ns
    last: Ns
    messages: int
    until: Ns | None
    begun: bool = True
    later: int = 0


class BlockRuns(NamedTuple):
    """Consecutive matches in a block.

    Attributes:
        runs: the newest first.
        goes_back: whether an earlier match may belong to the oldest.
        goes_on: whether a later match may belong to the newest.
        is_blank: whether it has neither a match nor a message that surely is none.
    """

    runs: list[Run]
    goes_back: bool = False
    goes_on: bool = False
    is_blank: bool = False


def runs_of(topic: str, tested: Tested, after: Ns, *, apart: bool) -> BlockRuns:
    """Returns the runs of matches in some messages, of which there is at least one.

    A run ends with a message that does not match, and where none comes for longer than
    `SILENCE_NS`. With `apart` each match is a run of its own. The next block begins at `after`.
    """
    times, met = tested.times, tested.met
    begins = np.diff(times, prepend=times[0]) > SILENCE_NS
    # Of two matches, this differs where a message that is none, or a silence, lies between them.
    ends = np.cumsum((met == NOT_MET) | begins)
    rows = np.flatnonzero(met == MET)
    if not rows.size:
        return BlockRuns([], is_blank=int(ends[-1]) == 0)
    new = np.ones(rows.size, np.bool_) if apart else np.r_[True, np.diff(ends[rows]) > 0]
    starts = np.flatnonzero(new)
    stops = np.r_[starts[1:], rows.size]
    others = np.flatnonzero((met == NOT_MET) | begins)
    until = np.append(times[others], MAX_NS)[np.searchsorted(others, rows[stops - 1], side="right")]
    firsts, lasts = times[rows[starts]], times[rows[stops - 1]]
    later = np.searchsorted(times[rows], lasts, side="right") - stops
    columns = firsts, lasts, stops - starts, np.minimum(until, after), later
    runs = [
        Run(topic, first, last, messages, None if end == MAX_NS else end, later=later_matches)
        for first, last, messages, end, later_matches in np.column_stack(columns).tolist()
    ]
    return BlockRuns(
        runs[::-1],
        goes_back=not apart and int(ends[rows[0]]) == 0,
        goes_on=not apart and ends[rows[-1]] == ends[-1],
    )


@dataclass(frozen=True, slots=True)
class SearchedRuns:
    """What a search found.

    Attributes:
        runs: the newest first.
        searched_to: a log time; all that is newer was searched. None: all of the window was.
        is_over: whether the search ended since its time was over.
    """

    runs: list[Run]
    searched_to: Ns | None = None
    is_over: bool = False


class _TopicRuns:
    """The runs of one topic, from its newest block on."""

    def __init__(self, topic: str, *, apart: bool) -> None:
        self._topic = topic
        self._apart = apart
        self._runs: list[Run] = []
        self._is_open = False
        self._begins: Ns = MAX_NS
        self._waiting: list[Tested] = []
        self._messages = 0

    @property
    def runs(self) -> list[Run]:
        """The runs, the newest first."""
        self._join()
        return self._runs

    @property
    def closed(self) -> list[Run]:
        """The runs to which no older match can belong."""
        runs = self.runs
        return runs[:-1] if self._is_open else runs

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
        added = runs_of(self._topic, tested, after, apart=self._apart)
        is_near = after - int(tested.times[-1]) <= SILENCE_NS
        if added.is_blank:
            self._is_open = self._is_open and is_near
            return
        if self._is_open and is_near and added.goes_on:
            newer, older = self._runs.pop(), added.runs.pop(0)
            messages = newer.messages + older.messages
            self._runs.append(newer._replace(first=older.first, messages=messages))
        self._runs += added.runs
        self._is_open = added.goes_back

    def end_in(self, view: View, gap: TimeWindow) -> None:
        """Ends the oldest run if the topic has a message in a time that was not searched.

        Then, and where no run goes on, what follows an older run is not known.
        """
        self._join()
        if not self._is_open or _has_messages(view, self._topic, gap):
            self._is_open, self._begins = False, MAX_NS

    def cut(self) -> list[Run]:
        """Returns the runs, of which the oldest may have begun earlier than is known."""
        runs = self.runs
        return [*runs[:-1], runs[-1]._replace(begun=False)] if self._is_open else runs


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
    is_log = view.timeline.is_log
    latched = [topic for topic in search.topics if scope.is_bounded and is_latched(view, topic)]
    if latched:
        enough = None
    runs_by_topic = {topic: _TopicRuns(topic, apart=is_log(topic)) for topic in search.topics}
    reached = searched = scope.window.stop
    try:
        for window in [scope.window] if latched else scope.narrowed():
            for topic_runs in runs_by_topic.values():
                topic_runs.end_in(view, TimeWindow(window.stop, searched))
            searched = window.start
            blocks = (tester.newest_first(topic, window) for topic in runs_by_topic)
            for block in heapq.merge(*blocks, key=lambda block: -block.last):
                is_whole = not scope.is_bounded or block.topic in latched
                counted = block if is_whole else _scoped(block, scope)
                runs_by_topic[block.topic].add(counted)
                reached = block.first if len(runs_by_topic) == 1 else block.last
                if enough is not None and _has_enough(runs_by_topic, enough, reached):
                    break
            else:
                continue
            break
    except QueryTimeoutError:
        runs = [run for topic_runs in runs_by_topic.values() for run in topic_runs.cut()]
        if not runs:
            raise
        parts = [*_parts_in(view, runs, scope, latched)]
        return SearchedRuns(sorted(parts, key=_LAST, reverse=True), reached, is_over=True)
    runs = sorted(
        _parts_in(view, _newest_first(runs_by_topic), scope, latched), key=_LAST, reverse=True
    )
    if enough is not None and len(runs) > enough:
        # Whether more was searched than had to be depends on how the rows are stored.
        search.note_untested(replace(scope.window, start=runs[enough - 1].first))
        return SearchedRuns(runs, reached)
    search.close(scope.window, is_found=bool(runs), ruled_out=tester.ruled_out)
    return SearchedRuns(runs)


def _parts_in(
    view: View, runs: Iterable[Run], scope: Scope, latched: Collection[str]
) -> Iterator[Run]:
    """Yields runs, and of those of latched topics the parts of a scope in which they held."""
    _, end = scope.window.asked()
    for run in runs:
        if run.topic not in latched:
            yield run
            continue
        until = held_until(view, run.topic, run.last, end)
        for first, stop in scope.parts_of(run.first, until):
            said = TimeWindow(first, min(run.last, stop) + 1)
            messages = 0
            if first <= run.last:
                messages = sum(1 for _ in view.stream.messages([run.topic], said))
            if messages or first < stop:
                last = max(first, min(run.last, stop))
                begun = run.begun and first == run.first
                yield Run(run.topic, first, last, messages, run.until, begun)


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


def _has_messages(view: View, topic: str, gap: TimeWindow) -> bool:
    """Whether a topic has a message in a time; by the index where that is enough."""
    if gap.empty:
        return False
    bags = view.stream.overlapping_bags([topic], gap)
    is_alone = len({bag.bag.recording for bag in bags}) == 1
    counts = is_alone and not view.stream.may_be_repeated([topic])
    if counts and any(gap.contains(bag.first) or gap.contains(bag.last) for bag in bags):
        return True
    return bool(bags) and view.stream.first([topic], gap) is not None


def _has_enough(runs_by_topic: dict[str, _TopicRuns], enough: int, reached: Ns) -> bool:
    """Returns whether no match older than a moment can change the newest runs."""
    if sum(len(topic_runs.runs) for topic_runs in runs_by_topic.values()) <= enough:
        return False
    newest = _newest_first(runs_by_topic)[:enough]
    closed = {id(run) for topic_runs in runs_by_topic.values() for run in topic_runs.closed}
    return newest[-1].last >= reached and all(id(run) in closed for run in newest)


def _newest_first(runs_by_topic: dict[str, _TopicRuns]) -> list[Run]:
    return sorted(
        (run for topic_runs in runs_by_topic.values() for run in topic_runs.runs),
        key=_LAST,
        reverse=True,
    )

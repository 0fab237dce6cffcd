"""Which messages of topics meet a condition: the newest one, or all in blocks.

Zones and words of columns rule out most messages. For the newest match, messages are read at the
times of the others from the merged stream, which decides which copies count.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain, islice, product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import Condition, Equals, at_field, plain_text
from ros2_memory.analysis.refusals import refusal_for, shows_field, summary_conditions
from ros2_memory.columns.stated import Nodes
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.truth import ColumnCondition
from ros2_memory.columns.values import TruthValues, nowhere
from ros2_memory.core.arrays import rows_of, stacked
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.history.condition_hints import hint_on_constants, require_frame
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.lasting import is_text
from ros2_memory.history.no_data import matching_topics, undecodable, with_notes
from ros2_memory.history.scan import decoded_rows, messages_at, scan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.columns.stored import PartZones
    from ros2_memory.columns.table import Table
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray, Mask

MET: Final = 1
NOT_MET: Final = 0
UNKNOWN: Final = 2
"""The message cannot be decoded."""

MOST_UNSURE: Final = 32
"""Up to this many unsure rows of a part are left to their messages; for more, bags are decoded."""
_MOST_LEFT: Final = 0.5
"""If the columns of a bag leave a larger share unsure, bags of that type are not decoded again."""
_TOGETHER_NS: Final[Ns] = 2 * NS_PER_S
"""Messages that must be read from the bag, and are no farther apart, are read at once."""
_MOST_EMPTY: Final = 200
"""At most this many messages are read to find one with elements in its lists."""
_GROUP_GAP_NS: Final = NS_PER_S
"""Candidates that are no farther apart are read as one group."""
_LARGEST_GROUP: Final = 256
_NO_TIMES: Final = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """Messages of a topic, ordered by log time, and which of them meet a condition.

    Attributes:
        times: log times (ns).
        met: `MET`, `NOT_MET` or `UNKNOWN` for each message.
        sources: the number of each message's recording and type, which orders equal log times.
        nodes: the numbers of the nodes that publish diagnostics; else 0.
    """

    times: IntArray
    met: NDArray[np.uint8]
    sources: IntArray
    nodes: IntArray


class Block(NamedTuple):
    """Messages of a topic between two log times (inclusive).

    Attributes:
        first, last: no message is earlier or later.
        has_match: whether some message may meet the condition.
        tested: tests the messages, once.
    """

    topic: str
    first: Ns
    last: Ns
    has_match: bool
    tested: Callable[[], Tested]


class RowCondition:
    """Finds which rows of scans meet a condition, by their columns.

    Large topics do not have all of their columns in the store. If these leave many rows unsure,
    their bags are decoded: their columns mostly tell. Rows that stay unsure are left to the
    messages.

    Args:
        view: of the call.
        condition: what is asked.
    """

    def __init__(self, view: View, condition: Condition) -> None:
        self._view = view
        self._test = ColumnCondition(condition, view.extractor)
        self._left_to_messages: set[str] = set()

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns which parts may have a row that meets it, by their zones."""
        return self._test.may_match(parts)

    def unstated(self, rows: Rows) -> Mask:
        """Returns which rows that count lack the field."""
        return by_columns(self._view, rows, self._test.unstated).astype(np.bool_)

    def truth(self, rows: Rows) -> TruthValues:
        """Returns which rows of the table meet the condition.

        Bags are decoded only for rows that count.
        """
        truth, channel = self._test.truth(rows.table), rows.table.channel
        is_stored = isinstance(rows.table, StoredTable) and "" not in rows.table.left_out
        if not is_stored or channel.type in self._left_to_messages or truth.is_settled:
            return truth
        index = rows.positions
        unsure = np.flatnonzero(truth.unsure[index])
        if unsure.size <= MOST_UNSURE:
            return truth
        surely, perhaps = truth.surely.copy(), truth.perhaps.copy()
        for positions, decoded in decoded_rows(self._view, rows.some(unsure)):
            in_table = index[unsure[positions]]
            of_bag, in_bag = self._test.truth(decoded.table), decoded.index
            surely[in_table], perhaps[in_table] = of_bag.surely[in_bag], of_bag.perhaps[in_bag]
            if (perhaps & ~surely)[in_table].mean() > _MOST_LEFT:
                self._left_to_messages.add(channel.type)
                break
        return TruthValues(surely, perhaps)


def by_columns(view: View, rows: Rows, read: Callable[[Table], IntArray | Mask | None]) -> IntArray:
    """Returns what is read for each row that counts from its table, else from its bag, else 0."""
    of_table = read(rows.table)
    if of_table is not None:
        return of_table[rows.positions].astype(np.int64)
    numbers = np.zeros(len(rows), np.int64)
    for positions, decoded in decoded_rows(view, rows):
        of_bag = read(decoded.table)
        if of_bag is not None:
            numbers[positions] = of_bag[decoded.positions]
    return numbers


def out_of_time(view: View, searched_to: Ns) -> QueryTimeoutError:
    """Returns the error of a search that had to end without a match, back to a log time."""
    back_to, budget_s = unix_text(searched_to), view.call.deadline.budget_s
    return QueryTimeoutError(
        f"no match back to {back_to}, and {budget_s:g} s are over; "
        f"{view.bags.filling_progress()}to continue from there, ask again with before={back_to}",
        searched_back_to=searched_to,
    )


class CandidateRows:
    """Finds the messages of a window that may meet a condition, by their columns.

    Attributes:
        ruled_out: whether columns showed that some message does not meet the condition.
        has_looked: whether any message, or its columns, were looked at.
    """

    def __init__(
        self, view: View, topics: Sequence[str], condition: Condition, window: TimeWindow
    ) -> None:
        self.ruled_out = False
        self.has_looked = False
        end = min(window.stop, view.timeline.latest + 1)
        # By topic, the log time from which on all of its candidates are known.
        self._scanned_to: dict[str, Ns] = dict.fromkeys(topics, end)
        # The candidates that are read next, newest first: log time and topic.
        self._group: list[tuple[Ns, str]] = []
        self._view = view
        self._window = window
        self._test = RowCondition(view, condition)

    def messages(self) -> Iterator[StoredMessage]:
        """Yields the messages at the times of candidates, newest first."""
        for window, topics in self._windows():
            yield from self._view.stream.messages(topics, window, newest_first=True)

    @property
    def searched_to(self) -> Ns:
        """The log time from which on all messages were searched."""
        unread = [time + 1 for time, _ in self._group[:1]]
        return max([*self._scanned_to.values(), *unread], default=MIN_NS)

    def _windows(self) -> Iterator[tuple[TimeWindow, Sequence[str]]]:
        """Yields the windows of groups of candidates, newest first, with the topics of these.

        They do not overlap. The first candidate mostly matches, so the first group is small; if it
        does not, groups grow.
        """
        largest = 1
        by_topic = [self._candidates_of(topic) for topic in self._scanned_to]
        candidates = heapq.merge(*by_topic, reverse=True)
        for time, topic in chain(candidates, [(MIN_NS - 1, "")]):
            group = self._group
            if group:
                (newest, _), (oldest, _) = group[0], group[-1]
                if oldest - time > _GROUP_GAP_NS or len(group) >= largest:
                    yield TimeWindow(oldest, newest + 1), sorted({name for _, name in group})
                    largest = min(2 * largest, _LARGEST_GROUP)
                    self._group = []
            self._group.append((time, topic))

    def _candidates_of(self, topic: str) -> Iterator[tuple[Ns, str]]:
        """Yields the log times of candidates of a topic, newest first, each once."""
        pending = _NO_TIMES  # ascending: candidates that a later table may still precede

        def note_progress(last: Ns) -> None:
            newest = max([last, *pending[-1:].tolist()])
            self._scanned_to[topic] = min(newest + 1, self._window.stop)

        def candidates(times: IntArray) -> Iterator[tuple[Ns, str]]:
            for time in times[::-1].tolist():
                self._scanned_to[topic] = time + 1
                yield time, topic

        for rows in scan(
            self._view,
            topic,
            self._window,
            newest_first=True,
            may_match=self._may_match,
            may_be_empty=True,
            before_table=note_progress,
        ):
            older = np.searchsorted(pending, rows.last, "right")
            yield from candidates(pending[older:])
            pending = np.union1d(pending[:older], self._candidate_times(rows))
        yield from candidates(pending)
        self._scanned_to[topic] = MIN_NS

    def _may_match(self, parts: PartZones) -> bool | Mask:
        may_match = self._test.may_match(parts)
        self.has_looked = True
        self.ruled_out |= not np.all(may_match)
        return may_match

    def _candidate_times(self, rows: Rows) -> IntArray:
        self.has_looked = True
        truth = self._test.truth(rows)
        if truth.is_none:
            self.ruled_out = True
            return _NO_TIMES
        perhaps = truth.perhaps[rows.positions]
        self.ruled_out |= not perhaps.all()
        return rows.times[perhaps]


def note_summarised(view: View, topic: str, fields: Iterable[str], window: TimeWindow) -> None:
    """Notes if long arrays at or below some fields are only summarised in messages of a window."""
    try:
        newest = view.stream.last(topic)
        if newest is None:
            return
        value = view.value(newest)
        paths = (view.extractor.own_path(field, newest.type) for field in fields)
        for condition in chain.from_iterable(summary_conditions(path, value) for path in paths):
            candidates = CandidateRows(view, [topic], condition, window).messages()
            long = next((one for one in candidates if condition.matches(view.value(one))), None)
            if long is not None:
                array, _, _ = (condition.field or "").rpartition(".")
                view.notes.add_lack(
                    f"{topic}: where {array} is long it is only summarised, last at "
                    f"{unix_text(long.time)}, and its numbers are not looked at"
                )
    except QueryTimeoutError:
        view.notes.add_lack(f"{topic}: out of time: some arrays may be only summarised")


class ReverseSearch:
    """A search for a condition on the topics of a name or glob.

    Args:
        view: of the call.
        pattern: the name or glob.
        condition: the condition.
        window: of log time, that all is searched in; None if it is not known.

    Attributes:
        topics: the recorded topics that match the name or glob.
        condition: the condition.
        ruled_out: whether columns showed for any message that it does not match.

    Raises:
        InvalidArgumentsError: the condition names a frame in which a topic has no positions.
        NoDataError: there is no such topic.
    """

    def __init__(
        self, view: View, pattern: str, condition: Condition, window: TimeWindow | None = None
    ) -> None:
        self._view = view
        self.condition = condition
        self.topics = matching_topics(view, pattern)
        require_frame(view, self.topics, condition, window)
        self.ruled_out = False
        self._test = RowCondition(view, condition)
        self._nodes = Nodes(view.extractor)
        self._numbers: dict[str, dict[tuple[Path, str], int]] = {}
        self._failures: dict[tuple[str, str], tuple[UndecodableError, Ns]] = {}
        self._has_decoded = False

    def newest(self, until: Ns, since: Ns = MIN_NS) -> StoredMessage | None:
        """Returns the newest match before `until` and not before `since` (log times).

        Notes report what could not be tested.

        Raises:
            InvalidArgumentsError: no value of the topics can meet the condition.
            NoDataError: no message could be decoded.
            QueryTimeoutError: the call's time is over. It has how far back was searched.
        """
        window = TimeWindow(since, until)
        candidates = CandidateRows(self._view, self.topics, self.condition, window)
        noted_before = self._view.notes.so_far()
        try:
            for stored in candidates.messages():
                if self.matches(stored):
                    read = TimeWindow(stored.time, MAX_NS)
                    self._view.notes.retract_outside(read, keep=noted_before)
                    self._view.stream.read_up_to_first_copy(stored)
                    self.note_untested(read.intersect(window))
                    return stored
        except QueryTimeoutError as error:
            if not candidates.has_looked:
                raise
            raise out_of_time(self._view, candidates.searched_to) from error
        self.ruled_out |= candidates.ruled_out
        self.close(window, is_found=False)
        return None

    def close(self, window: TimeWindow, *, is_found: bool) -> None:
        """Ends a search that looked everywhere in a window; notes what could not be tested.

        Raises:
            InvalidArgumentsError: nothing was found, and no value of the topics can be a match.
            NoDataError: nothing was found, since no message could be decoded.
        """
        if not is_found and self._failures and not self._has_decoded and not self.ruled_out:
            failure, _ = next(iter(self._failures.values()))
            if len(self._failures) > 1:
                self._note_undecodable(MIN_NS)
            raise with_notes(self._view, window, undecodable(failure))
        if not is_found:
            self.require_testable()
        self.note_untested(window)

    def require_testable(self) -> None:
        """Checks that a value of the topics can meet the condition: else "never" is no answer.

        Raises:
            InvalidArgumentsError: the newest values of all topics lack what is tested.
        """
        are_texts = all(is_text(self._view, topic) for topic in self.topics)
        is_number_in_texts = are_texts and isinstance(self.condition.test, Equals)
        if not self.condition.can_be_refused and not is_number_in_texts:
            return
        first, *others = self.topics
        refusal = self._refusal(first)
        if refusal is not None and all(self._refusal(topic) is not None for topic in others):
            raise InvalidArgumentsError(f"{first}: {refusal}")

    def require_met(self, until: Ns) -> None:
        """Checks that a message before a moment meets the condition, or that its topics may.

        Raises:
            InvalidArgumentsError: no message does, and no value of the topics can.
        """
        try:
            self.require_testable()
        except InvalidArgumentsError:
            # Older messages may have had other fields; if not, this raises the error.
            self.newest(until)

    def _refusal(self, topic: str) -> str | None:
        """Returns why no message of a topic can match; None if one may."""
        types = self._view.timeline.types_of(topic)
        if len(types) == 1:
            return self._refusal_of_type(topic, MAX_NS, types[0])
        refusals = []
        for type_name, totals in self._view.census(topic).items():
            refusal = self._refusal_of_type(topic, totals.last + 1, type_name)
            if refusal is None:
                return None
            refusals.append(f"of {type_name} {refusal}")
        return "; ".join(refusals) or None

    def _refusal_of_type(self, topic: str, before: Ns, type_name: str) -> str | None:
        """Returns why no message of a type can match, by the newest message with its fields."""
        condition = self.condition.of_type(type_name, self._view.extractor)
        field = condition.field or ""
        messages = self._view.stream.messages(
            [topic], TimeWindow(MIN_NS, before), newest_first=True
        )
        newest, value = None, None
        for stored in islice(messages, _MOST_EMPTY):
            if stored.type != type_name:
                continue
            read = self._view.example(stored)
            if newest is None:
                newest, value = stored, read
                if value is None:
                    return None
            # An empty list does not show what its elements have, nor one joint what others have.
            if not field or shows_field(read, field):
                value = read
                break
        if newest is None:
            return None
        refusal = refusal_for(condition, value)
        if refusal is not None and field and self._is_beyond_shown(newest, field):
            return (
                f"{field!r} is in the messages of {type_name}, but not among the fields that are "
                "searched; get_topic_in_range shows it with fields, and its extremes"
            )
        word = condition.test.folded
        if refusal is None or word is None:
            return refusal
        return refusal + hint_on_constants(newest.record.channel.schema, field, word)

    def _is_beyond_shown(self, stored: StoredMessage, field: str) -> bool:
        """Returns whether a message has a field that its value, as replies show it, lacks."""
        extractor = self._view.extractor
        message = self._view.bags.decode(stored)
        if message is None or at_field(extractor.exact(message, stored.type), field):
            return False
        return extractor.exact_at(message, stored.type, field) not in (None, [])

    def blocks(self, topic: str, window: TimeWindow) -> Iterator[Block]:
        """Yields the messages of a topic in blocks that do not overlap, the newest block first."""
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
        """Returns rows as a block. Its messages are tested when that is asked for."""
        truth = self._test.truth(rows) if rows.may_match else nowhere(len(rows.table))
        has_match = not truth.is_none
        self.ruled_out |= not has_match
        first, last = max(rows.first, window.start), min(rows.last, window.stop - 1)
        tested = cache(partial(self._test_rows, topic, rows, truth))
        return Block(topic, first, last, has_match=has_match, tested=tested)

    def _test_rows(self, topic: str, rows: Rows, truth: TruthValues) -> Tested:
        """Tests the rows that count by columns, and reads the messages that columns leave open."""
        counting = rows.positions
        surely, perhaps = truth.surely[counting], truth.perhaps[counting]
        self.ruled_out |= not perhaps.all()
        source = self._source_numbers(topic)[rows.recording, rows.table.channel.type]
        met = surely.astype(np.uint8)
        met[self._test.unstated(rows) & ~surely] = UNKNOWN
        undecided = np.flatnonzero(perhaps & ~surely)
        # A message that cannot be read is no match; a note reports it.
        met[undecided] = NOT_MET
        edges = np.flatnonzero(np.diff(rows.times[undecided]) > _TOGETHER_NS) + 1
        for neighbours in np.split(undecided, edges) if undecided.size else ():
            for nth, message in messages_at(self._view, rows.some(neighbours)):
                is_match = self.matches(message)
                met[neighbours[nth]] = UNKNOWN if is_match is None else int(is_match)
        nodes = by_columns(self._view, rows, self._nodes.of)
        tested = Tested(rows.times, met, np.full(len(rows), source), nodes)
        if topic in self._view.moving_topics and plain_text(self.condition.test):
            # A message of transforms that does not name a frame says nothing of it.
            return rows_of(tested, met == MET)
        return tested

    def _source_numbers(self, topic: str) -> dict[tuple[Path, str], int]:
        """Returns a number for each recording and type of a topic, in the order of `Rows.order`."""
        if topic not in self._numbers:
            timeline = self._view.timeline
            recordings = sorted(timeline.recordings(topic), key=str)
            sources = product(recordings, sorted(timeline.types_of(topic)))
            self._numbers[topic] = {source: nth for nth, source in enumerate(sources)}
        return self._numbers[topic]

    def matches(self, stored: StoredMessage) -> bool | None:
        """Whether a message meets the condition; None if it lacks the field, or is not decoded."""
        failures: list[UndecodableError] = []
        with self._view.call.stages.timed("extract"):
            message = self._view.bags.decode(stored, failures)
            if not failures:  # a message may be null, as JSON
                self._has_decoded = True
                value = self._view.extractor.exact(message, stored.type)
                own = self.condition.of_type(stored.type, self._view.extractor)
                return None if own.is_unstated(value) else own.matches(value)
        key = stored.topic, stored.type
        # The newest failure is reported; messages may be tested in any order.
        if key not in self._failures or self._failures[key][1] < stored.time:
            self._failures[key] = failures[0], stored.time
        return None

    def note_untested(self, window: TimeWindow) -> None:
        """Notes on which topics messages of a window could not be tested, or only in part."""
        self._note_undecodable(window.start)
        if self.condition.looks_at_numbers:
            for topic in self.topics:
                note_summarised(self._view, topic, [self.condition.array], window)

    def _note_undecodable(self, since: Ns) -> None:
        for (topic, type_name), (error, newest) in self._failures.items():
            if newest >= since:
                kind = Reason(f"could not be decoded: {error.reason}", "topic", of="messages of ")
                self._view.notes.add_lack(Note(kind, f"{topic} ({type_name})"))


def _merged_and_split(waiting: Block, following: Block) -> tuple[Block | None, Block]:
    """Returns two overlapping blocks as one after the end of `following`, and one up to its end.

    No block that a scan reaches later has messages after that end. The first block is None if it
    has no message.
    """
    if not waiting.tested().times.size:
        return None, following
    if not following.tested().times.size:
        return None, waiting
    # In one recording, what the scan reaches later was written before.
    both = stacked([following.tested(), waiting.tested()])
    ordered = rows_of(both, np.lexsort((both.sources, both.times)))
    cut = int(np.searchsorted(ordered.times, following.last, side="right"))
    older = _block_of(waiting.topic, rows_of(ordered, slice(cut)))
    newer = rows_of(ordered, slice(cut, None))
    return (_block_of(waiting.topic, newer) if newer.times.size else None), older


def _block_of(topic: str, tested: Tested) -> Block:
    first, last = int(tested.times[0]), int(tested.times[-1])
    return Block(topic, first, last, has_match=bool(tested.met.any()), tested=lambda: tested)

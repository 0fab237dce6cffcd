"""Which messages of topics meet a condition, by columns, and in blocks over them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import plain_text
from ros2_memory.analysis.facts import DIAGNOSTICS
from ros2_memory.columns.stated import StatusNames
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.truth import ColumnCondition
from ros2_memory.columns.values import TruthValues, nowhere
from ros2_memory.core.arrays import places_among, rows_of, stacked
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.history.scan import decoded_rows, messages_at, scan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.columns.stored import PartZones
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.stored_message import StoredMessage
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


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """Messages of a topic, ordered by log time, and which of them meet a condition.

    Attributes:
        times: log times (ns).
        met: `MET`, `NOT_MET` or `UNKNOWN` for each message.
        sources: the number of each message's recording and type, which orders equal log times.
        nodes: of diagnostics, on whose topic many nodes publish, a number for each node; else 0.
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
        """Returns which rows of the table lack the field; of rows that count alone, if decoded."""
        unstated = self._test.unstated(rows.table)
        if unstated is not None:
            return unstated
        index = np.arange(len(rows.table)) if rows.index is None else rows.index
        unstated = np.zeros(len(rows.table), np.bool_)
        for positions, decoded in decoded_rows(self._view, rows):
            of_bag = self._test.unstated(decoded.table)
            if of_bag is not None:
                unstated[index[positions]] = of_bag[decoded.index]
        return unstated

    def truth(self, rows: Rows) -> TruthValues:
        """Returns which rows of the table meet the condition.

        Bags are decoded only for rows that count.
        """
        truth, channel = self._test.truth(rows.table), rows.table.channel
        is_stored = isinstance(rows.table, StoredTable) and "" not in rows.table.left_out
        if not is_stored or channel.type in self._left_to_messages or truth.is_settled:
            return truth
        index = np.arange(len(rows.table)) if rows.index is None else rows.index
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


class MatchTester:
    """Tests the messages of topics by columns, and else by `matches`.

    Attributes:
        ruled_out: whether columns showed for any message that it does not match.
    """

    def __init__(
        self, view: View, condition: Condition, matches: Callable[[StoredMessage], bool | None]
    ) -> None:
        self.ruled_out = False
        self._view = view
        self._condition = condition
        self._matches = matches
        self._test = RowCondition(view, condition)
        self._status_names = StatusNames(view.extractor)
        self._nodes: dict[str, int] = {}
        self._numbers: dict[str, dict[tuple[Path, str], int]] = {}

    def newest_first(self, topic: str, window: TimeWindow) -> Iterator[Block]:
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
        counting = slice(None) if rows.index is None else rows.index
        surely, perhaps = truth.surely[counting], truth.perhaps[counting]
        self.ruled_out |= not perhaps.all()
        source = self._source_numbers(topic)[rows.recording, rows.table.channel.type]
        met = surely.astype(np.uint8)
        met[self._test.unstated(rows)[counting] & ~surely] = UNKNOWN
        undecided = np.flatnonzero(perhaps & ~surely)
        # A message that cannot be read is no match; a note reports it.
        met[undecided] = NOT_MET
        edges = np.flatnonzero(np.diff(rows.times[undecided]) > _TOGETHER_NS) + 1
        for neighbours in np.split(undecided, edges) if undecided.size else ():
            for nth, message in messages_at(self._view, rows.some(neighbours)):
                is_match = self._matches(message)
                met[neighbours[nth]] = UNKNOWN if is_match is None else int(is_match)
        tested = Tested(rows.times, met, np.full(len(rows), source), self._nodes_of(rows))
        if topic in self._view.moving_topics and plain_text(self._condition.test):
            # A message of transforms that does not name a frame says nothing of it.
            return rows_of(tested, met == MET)
        return tested

    def _nodes_of(self, rows: Rows) -> IntArray:
        """Returns a number for the node of each row: for the first status that it names."""
        nodes = np.zeros(len(rows), np.int64)
        if rows.table.channel.type != DIAGNOSTICS:
            return nodes
        parts: Iterable[tuple[IntArray, Rows]] = [(np.arange(len(rows)), rows)]
        if self._status_names.of(rows.table) is None:
            parts = decoded_rows(self._view, rows)
        for positions, part in parts:
            named = self._status_names.of(part.table)
            if named is None:
                continue
            owners, names = named
            has_any, firsts = np.unique(owners, return_index=True)
            index = np.arange(len(part.table)) if part.index is None else part.index
            places, is_among = places_among(has_any, index)
            numbers = [self._nodes.setdefault(name, len(self._nodes) + 1) for name in names.words]
            firsts_among = names.codes[firsts[is_among]]
            nodes[positions[places[is_among]]] = np.array(numbers, np.int64)[firsts_among]
        return nodes

    def _source_numbers(self, topic: str) -> dict[tuple[Path, str], int]:
        """Returns a number for each recording and type of a topic, in the order of `Rows.order`."""
        if topic not in self._numbers:
            timeline = self._view.timeline
            recordings = sorted(timeline.recordings(topic), key=str)
            sources = product(recordings, sorted(timeline.types_of(topic)))
            self._numbers[topic] = {source: nth for nth, source in enumerate(sources)}
        return self._numbers[topic]


def met_by_any(met: Mask, nodes: IntArray) -> Mask:
    """Returns for each message, in order, whether the newest one of some node meets a condition.

    What a node said before its first message is taken to be what that says.
    """
    order = np.argsort(nodes, kind="stable")
    is_met = met[order].astype(np.int64)
    is_first = np.diff(nodes[order], prepend=-1) != 0
    changes = np.empty_like(is_met)
    changes[order] = np.where(is_first, 0, np.diff(is_met, prepend=0))
    met_by: Mask = is_met[is_first].sum() + np.cumsum(changes) > 0
    return met_by


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

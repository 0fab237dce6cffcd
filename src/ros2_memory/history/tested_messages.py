"""Which messages of topics meet a condition, in blocks over columns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import plain_text
from ros2_memory.columns.values import TruthValues, nowhere
from ros2_memory.core.arrays import rows_of, stacked
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.history.reverse_search import RowCondition
from ros2_memory.history.scan import messages_at, scan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.reverse_search import ReverseSearch
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray

MET: Final = 1
NOT_MET: Final = 0
UNKNOWN: Final = 2
"""The message cannot be decoded."""

_TOGETHER_NS: Final[Ns] = 2 * NS_PER_S
"""Messages that must be read from the bag, and are no farther apart, are read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """Messages of a topic, ordered by log time, and which of them meet a condition.

    Attributes:
        times: log times (ns).
        met: `MET`, `NOT_MET` or `UNKNOWN` for each message.
        sources: the number of each message's recording and type, which orders equal log times.
    """

    times: IntArray
    met: NDArray[np.uint8]
    sources: IntArray


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


class MatchTester:
    """Tests the messages of the topics of a search.

    Attributes:
        ruled_out: whether columns showed for any message that it does not match.
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
                is_match = self._search.matches(message)
                met[neighbours[nth]] = UNKNOWN if is_match is None else int(is_match)
        tested = Tested(rows.times, met, np.full(len(rows), source))
        if topic in self._view.moving_topics and plain_text(self._search.condition.test):
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


def _merged_and_split(waiting: Block, reached: Block) -> tuple[Block | None, Block]:
    """Returns two overlapping blocks as one after the end of `reached`, and one up to its end.

    No block that a scan reaches later has messages after that end. The first block is None if it
    has no message.
    """
    if not waiting.tested().times.size:
        return None, reached
    if not reached.tested().times.size:
        return None, waiting
    # In one recording, what the scan reaches later was written before.
    both = stacked([reached.tested(), waiting.tested()])
    ordered = rows_of(both, np.lexsort((both.sources, both.times)))
    cut = int(np.searchsorted(ordered.times, reached.last, side="right"))
    older = _block_of(waiting.topic, rows_of(ordered, slice(cut)))
    newer = rows_of(ordered, slice(cut, None))
    return (_block_of(waiting.topic, newer) if newer.times.size else None), older


def _block_of(topic: str, tested: Tested) -> Block:
    first, last = int(tested.times[0]), int(tested.times[-1])
    return Block(topic, first, last, has_match=bool(tested.met.any()), tested=lambda: tested)

"""The pieces that a scan is made of: the rows of a topic in a part, or in a bag."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.columns.parts import BAG, DELAY, LOG_TIME, PAYLOAD_HASH
from ros2_memory.columns.walk import within
from ros2_memory.core.arrays import Groups, distinct_rows
from ros2_memory.core.errors import BusyError
from ros2_memory.index.segment import in_time

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.columns.table import Table
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import IntArray


class GoneError(BusyError):
    """Rows were deleted from the store while they were read."""

    def __init__(self) -> None:
        super().__init__("stored columns were deleted while they were read: ask again")


class Unit:
    """The rows of a topic in a part of the store, or in a bag.

    Attributes:
        key: tells units of one scan apart.
        table: the rows, ordered by log time.
        first: the earliest log time, inclusive.
        last: the latest, inclusive.
        part: the number of the part; None where it is none, or may be replaced.

    Args:
        load: returns one of the columns that every part may have; None where it has none.
        counting: the numbers, as the part has them, of its bags of which rows count; at least one.
        bag_of: returns the bag of such a number.
        all_count: whether these are all of its bags.
    """

    def __init__(
        self,
        key: object,
        table: Table,
        span: tuple[Ns, Ns],
        *,
        load: Callable[[str], IntArray | None],
        counting: IntArray,
        bag_of: Callable[[int], BagFile],
        part: int | None = None,
        all_count: bool = True,
    ) -> None:
        self.key = key
        self.part = part
        self.table = table
        self.first, self.last = span
        self._load = load
        self._counting = counting
        self._bag_of = bag_of
        self._all_count = all_count

    @cached_property
    def first_bag(self) -> BagFile:
        """The first bag of which rows count; all are of one recording."""
        return self._bag_of(int(self._counting[0]))

    def times(self) -> IntArray:
        """Returns the log times of the rows (ns)."""
        return self._column(LOG_TIME)

    def identities(self) -> tuple[IntArray, IntArray] | None:
        """Returns publish times and hashes of payloads; None where they are not known."""
        delays, hashes = self._load(DELAY), self._load(PAYLOAD_HASH)
        return None if delays is None or hashes is None else (self.times() - delays, hashes)

    def bags(self) -> Mapping[int, BagFile]:
        """Returns the bags of which rows count, by their numbers."""
        return {number: self._bag_of(number) for number in self._counting.tolist()}

    def bag_numbers(self) -> IntArray:
        """Returns for each row the number of its bag."""
        return self._column(BAG)

    def counting(self) -> NDArray[np.bool_] | None:
        """Returns which rows are of bags that count; None: all are."""
        return None if self._all_count else np.isin(self.bag_numbers(), self._counting)

    def _column(self, path: str) -> IntArray:
        column = self._load(path)
        if column is None:
            raise GoneError
        return column


class BagUnit(Unit):
    """A table of a bag that is not stored. `nth` tells tables of one bag apart."""

    def __init__(self, bag: BagFile, table: Table, nth: int) -> None:
        times, zeros = table.log_times, np.zeros(len(table), np.int64)
        columns = {
            LOG_TIME: times,
            DELAY: times - table.publish_times,
            PAYLOAD_HASH: table.payload_hashes,
            BAG: zeros,
        }
        span = int(times[0]), int(times[-1])
        key = (bag.file, nth)
        super().__init__(
            key, table, span, load=columns.get, counting=zeros[:1], bag_of=lambda _: bag
        )


class Rows:
    """The rows of one table that count, ordered by log time.

    Attributes:
        table: the table; not all of its rows need count.
        may_match: whether some may be wanted, as far as zones tell.
    """

    def __init__(
        self, unit: Unit, find: Callable[[], IntArray | None], *, may_match: bool = True
    ) -> None:
        self._unit = unit
        self.table = unit.table
        self.may_match = may_match
        self._find = find

    @classmethod
    def of(cls, unit: Unit, index: IntArray) -> Rows:
        """Returns some rows of a unit."""
        return cls(unit, lambda: index)

    @cached_property
    def index(self) -> IntArray | None:
        """Which of the table's rows count, ascending; None: all."""
        return self._find()

    def __len__(self) -> int:
        """Returns how many rows count."""
        return len(self.table) if self.index is None else self.index.size

    @property
    def times(self) -> IntArray:
        """Log times (ns) of the rows that count."""
        times = self._unit.times()
        return times if self.index is None else times[self.index]

    @property
    def part(self) -> int | None:
        """The number of the whole part of which all rows count; None where it is not so."""
        return self._unit.part if self.index is None else None

    @property
    def recording(self) -> Path:
        """The recording that the rows are of."""
        return self._unit.first_bag.recording

    @property
    def order(self) -> tuple[str, str, Ns, Ns, tuple[Ns, Ns, str]]:
        """Sorts tables whose rows have one log time: by recording, as copies, type and bag."""
        bag = self._unit.first_bag
        span = self._unit.first, self._unit.last
        return str(bag.recording), self.table.channel.type, *span, in_time(bag)

    @property
    def first(self) -> Ns:
        """A log time (ns) that none of the rows is earlier than."""
        return self._unit.first

    @property
    def last(self) -> Ns:
        """A log time (ns) that none of the rows is later than."""
        return self._unit.last

    @property
    def span(self) -> tuple[Ns, Ns]:
        """Log times (ns) of the first and the last row, inclusive."""
        if self.index is None:
            return self._unit.first, self._unit.last
        times = self.times
        return int(times[0]), int(times[-1])

    def bag_rows(self, among: Container[str] | None = None) -> Iterator[tuple[BagFile, IntArray]]:
        """Yields each bag with the positions of its rows among those that count, ascending.

        With `among` of these files alone.
        """
        numbers = self._unit.bag_numbers()
        if self.index is not None:
            numbers = numbers[self.index]
        bags = self._unit.bags()
        for number in np.unique(numbers).tolist():
            if among is None or bags[number].file in among:
                yield bags[number], np.flatnonzero(numbers == number)

    @property
    def ranks(self) -> IntArray:
        """For each row that counts, how many rows of its bag have its log time and precede it."""
        times = self._unit.times()
        if (np.diff(times) > 0).all():
            return np.zeros(len(self), np.int64)
        groups = Groups.of(distinct_rows((self._unit.bag_numbers(), times))[1])
        ranks = np.empty_like(groups.order)
        ranks[groups.order] = within(groups.sizes)
        return ranks if self.index is None else ranks[self.index]

    def some(self, positions: IntArray) -> Rows:
        """Returns some of the rows, by their ascending positions among those that count."""
        index = positions if self.index is None else self.index[positions]
        return Rows.of(self._unit, index)

    def mask(self) -> NDArray[np.bool_]:
        """Returns for each row of the table whether it counts."""
        if self.index is None:
            return np.ones(len(self.table), np.bool_)
        mask = np.zeros(len(self.table), np.bool_)
        mask[self.index] = True
        return mask

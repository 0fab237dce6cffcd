"""The pieces that a scan is made of: the rows of a topic in a part, or in a bag."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.columns.parts import BAG, DELAY, LOG_TIME, PAYLOAD_HASH
from ros2_memory.columns.walk import within
from ros2_memory.core.arrays import Groups, distinct_rows
from ros2_memory.core.errors import BusyError
from ros2_memory.index.segment import in_time

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator
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


@dataclass(eq=False)
class Unit:
    """The rows of a topic in a part of the store, or in a bag.

    Attributes:
        key: tells units of one scan apart.
        table: the rows, ordered by log time.
        first: the earliest log time, inclusive.
        last: the latest, inclusive.
        load: returns one of the columns that every part may have; None where it has none.
        numbers: of its bags of which rows count, as the part has them; at least one.
        bag_of: returns the bag of such a number.
        part: the number of the part; None where it is none, or may be replaced.
        all_count: whether these are all of its bags.
    """

    key: object
    table: Table
    first: Ns
    last: Ns
    load: Callable[[str], IntArray | None]
    numbers: IntArray
    bag_of: Callable[[int], BagFile]
    part: int | None = None
    all_count: bool = True

    @cached_property
    def first_bag(self) -> BagFile:
        """The first bag of which rows count; all are of one recording."""
        return self.bag_of(int(self.numbers[0]))

    def times(self) -> IntArray:
        """Returns the log times of the rows (ns)."""
        return self._column(LOG_TIME)

    def identities(self) -> tuple[IntArray, IntArray] | None:
        """Returns publish times and hashes of payloads; None where they are not known."""
        delays, hashes = self.load(DELAY), self.load(PAYLOAD_HASH)
        return None if delays is None or hashes is None else (self.times() - delays, hashes)

    def bag_numbers(self) -> IntArray:
        """Returns for each row the number of its bag."""
        return self._column(BAG)

    def counting(self) -> NDArray[np.bool_] | None:
        """Returns which rows are of bags that count; None: all are."""
        return None if self.all_count else np.isin(self.bag_numbers(), self.numbers)

    def _column(self, path: str) -> IntArray:
        column = self.load(path)
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
        key, span = (bag.file, nth), (int(times[0]), int(times[-1]))
        super().__init__(key, table, *span, columns.get, zeros[:1], lambda _: bag)


@dataclass(eq=False)
class Rows:
    """The rows of one table that count, ordered by log time.

    Attributes:
        unit: has the table; not all of its rows need count.
        find: returns which count, when it is first asked for; see `index`.
        may_match: whether some may be wanted, as far as zones tell.
    """

    unit: Unit
    find: Callable[[], IntArray | None]
    may_match: bool = True

    @classmethod
    def of(cls, unit: Unit, index: IntArray) -> Rows:
        """Returns some rows of a unit."""
        return cls(unit, lambda: index)

    @property
    def table(self) -> Table:
        """The table that has the rows."""
        return self.unit.table

    @cached_property
    def index(self) -> IntArray | None:
        """Which of the table's rows count, ascending; None: all."""
        return self.find()

    def __len__(self) -> int:
        """Returns how many rows count."""
        return len(self.table) if self.index is None else self.index.size

    @property
    def times(self) -> IntArray:
        """Log times (ns) of the rows that count."""
        times = self.unit.times()
        return times if self.index is None else times[self.index]

    @property
    def part(self) -> int | None:
        """The number of the whole part of which all rows count; None where it is not so."""
        return self.unit.part if self.index is None else None

    @property
    def recording(self) -> Path:
        """The recording that the rows are of."""
        return self.unit.first_bag.recording

    @property
    def order(self) -> tuple[str, str, Ns, Ns, tuple[Ns, Ns, str]]:
        """Sorts tables whose rows have one log time: by recording, as copies, type and bag."""
        bag = self.unit.first_bag
        span = self.unit.first, self.unit.last
        return str(bag.recording), self.table.channel.type, *span, in_time(bag)

    @property
    def first(self) -> Ns:
        """A log time (ns) that none of the rows is earlier than."""
        return self.unit.first

    @property
    def last(self) -> Ns:
        """A log time (ns) that none of the rows is later than."""
        return self.unit.last

    @property
    def span(self) -> tuple[Ns, Ns]:
        """Log times (ns) of the first and the last row, inclusive."""
        if self.index is None:
            return self.unit.first, self.unit.last
        times = self.times
        return int(times[0]), int(times[-1])

    def bag_rows(self, among: Container[str] | None = None) -> Iterator[tuple[BagFile, IntArray]]:
        """Yields each bag with the positions of its rows among those that count, ascending.

        With `among` of these files alone.
        """
        numbers = self.unit.bag_numbers()
        if self.index is not None:
            numbers = numbers[self.index]
        bags = {number: self.unit.bag_of(number) for number in self.unit.numbers.tolist()}
        for number in np.unique(numbers).tolist():
            if among is None or bags[number].file in among:
                yield bags[number], np.flatnonzero(numbers == number)

    @property
    def ranks(self) -> IntArray:
        """For each row that counts, how many rows of its bag have its log time and precede it."""
        times = self.unit.times()
        if (np.diff(times) > 0).all():
            return np.zeros(len(self), np.int64)
        groups = Groups.of(distinct_rows((self.unit.bag_numbers(), times))[1])
        ranks = np.empty_like(groups.order)
        ranks[groups.order] = within(groups.sizes)
        return ranks if self.index is None else ranks[self.index]

    def some(self, positions: IntArray) -> Rows:
        """Returns some of the rows, by their ascending positions among those that count."""
        index = positions if self.index is None else self.index[positions]
        return Rows.of(self.unit, index)

    def mask(self) -> NDArray[np.bool_]:
        """Returns for each row of the table whether it counts."""
        if self.index is None:
            return np.ones(len(self.table), np.bool_)
        mask = np.zeros(len(self.table), np.bool_)
        mask[self.index] = True
        return mask

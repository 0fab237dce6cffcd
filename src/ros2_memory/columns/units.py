"""The rows of a topic in a part or in a bag, of which a scan is made; and copies of messages.

Recordings overlap for some seconds while one takes over from the other. A message that is in both
has the same publish time and payload in each, and log times that differ by at most
`COPY_HORIZON_NS`. Some recorders, as those of Humble, write the log time as publish time: between
one of these and any other it has the same payload, which neither has again soon, and log times that
differ by at most `COPY_JITTER_NS`. It counts once, at its earliest log time; if one recording has
it n times and another m times, it counts max(n, m) times. Equal messages of one recording are no
copies.

A latched message is received again by each new recording. It counts at its earliest log time,
however long ago that is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.columns.writing import BAG, DELAY, LOG_TIME, PAYLOAD_HASH
from ros2_memory.core.arrays import Flags, Groups, distinct_rows, places_within, run_starts
from ros2_memory.core.errors import BusyError
from ros2_memory.core.spans import COPY_HORIZON_NS, COPY_JITTER_NS
from ros2_memory.index.segment import in_time
from ros2_memory.storage.base import REPEATED_NS, IntArray

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator
    from pathlib import Path

    from ros2_memory.columns.table import Table
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns, Span


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
        first: the earliest log time (ns), inclusive.
        last: the latest log time (ns), inclusive.
        load: returns the column at a path such as `LOG_TIME`; None if the unit has no such column.
        numbers: the numbers, in the unit, of the bags whose rows count; at least one.
        bag_of: returns the bag with such a number.
        part: the number of the part; None for a bag, and for a part that may be replaced.
        all_count: whether the rows of all its bags count.
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
        """The first bag whose rows count; all are of one recording."""
        return self.bag_of(int(self.numbers[0]))

    def times(self) -> IntArray:
        """Returns the log times of the rows (ns)."""
        return self._column(LOG_TIME)

    def identities(self) -> tuple[IntArray, IntArray] | None:
        """Returns the publish times (ns) and payload hashes of the rows; None if not known."""
        delays, hashes = self.load(DELAY), self.load(PAYLOAD_HASH)
        return None if delays is None or hashes is None else (self.times() - delays, hashes)

    def bag_numbers(self) -> IntArray:
        """Returns the number of each row's bag."""
        return self._column(BAG)

    def counting(self) -> Flags | None:
        """Returns which rows are of bags that count; None if all are."""
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
        first, last = int(times[0]), int(times[-1])
        key = (bag.file, nth)
        super().__init__(key, table, first, last, columns.get, zeros[:1], lambda _: bag)


@dataclass(eq=False)
class Rows:
    """The rows of one table that count, ordered by log time.

    Attributes:
        unit: has the table, and perhaps rows that do not count.
        find: returns `index`; called when that is first used.
        may_match: whether some rows may be wanted, by the zones of the part.
    """

    unit: Unit
    find: Callable[[], IntArray | None]
    may_match: bool = True

    @classmethod
    def of(cls, unit: Unit, index: IntArray) -> Rows:
        """Returns the rows of a unit at some ascending positions."""
        return cls(unit, lambda: index)

    @property
    def table(self) -> Table:
        """The table that has the rows."""
        return self.unit.table

    @cached_property
    def index(self) -> IntArray | None:
        """The positions of the table's rows that count, ascending; None if all do."""
        return self.find()

    @property
    def positions(self) -> IntArray:
        """The positions of the table's rows that count, ascending, also if all do."""
        return np.arange(len(self.table)) if self.index is None else self.index

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
        """The number of the part, if it is whole and all of its rows count; else None."""
        return self.unit.part if self.index is None else None

    def part_between(self, start: Ns, stop: Ns) -> int | None:
        """Returns the number of the part if it is whole and all its rows in a span count.

        Args:
            start: log time (ns), inclusive.
            stop: log time (ns), exclusive.
        """
        if self.unit.part is None or self.index is None:
            return self.unit.part
        begin, end = np.searchsorted(self.unit.times(), (start, stop))
        first, last = np.searchsorted(self.index, (begin, end))
        return self.unit.part if last - first == end - begin else None

    @property
    def recording(self) -> Path:
        """The recording that the rows are of."""
        return self.unit.first_bag.recording

    @property
    def order(self) -> tuple[str, str, Ns, Ns, tuple[Ns, Ns, str]]:
        """The key by which tables with rows of one log time are sorted: first by recording."""
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
    def span(self) -> Span:
        """Log times (ns) of the first and the last row, inclusive."""
        if self.index is None:
            return self.unit.first, self.unit.last
        times = self.times
        return int(times[0]), int(times[-1])

    def bag_rows(self, among: Container[str] | None = None) -> Iterator[tuple[BagFile, IntArray]]:
        """Yields each bag with the positions of its rows among those that count, ascending.

        Args:
            among: the files of the bags that are wanted; None for all.
        """
        numbers = self.unit.bag_numbers()
        if self.index is not None:
            numbers = numbers[self.index]
        for number in np.unique(numbers).tolist():
            bag = self.unit.bag_of(number)
            if among is None or bag.file in among:
                yield bag, np.flatnonzero(numbers == number)

    @property
    def ranks(self) -> IntArray:
        """How many rows with the same bag and log time precede each row that counts."""
        times, numbers, index = self.unit.times(), self.unit.bag_numbers(), self.positions
        # Rows of one log time follow each other: those of other times are not looked at.
        begin, end = 0, 0
        if index.size:
            begin = int(np.searchsorted(times, times[index[0]]))
            end = int(np.searchsorted(times, times[index[-1]], side="right"))
        times, numbers = times[begin:end], numbers[begin:end]
        if (np.diff(times) > 0).all():
            return np.zeros(index.size, np.int64)
        groups = Groups.of(distinct_rows((numbers, times))[1])
        ranks = np.empty_like(groups.order)
        ranks[groups.order] = places_within(groups.sizes)
        return ranks[index - begin]

    def some(self, positions: IntArray) -> Rows:
        """Returns the rows at some ascending positions among those that count."""
        return Rows.of(self.unit, self.positions[positions])

    def mask(self) -> Flags:
        """Returns for each row of the table whether it counts."""
        mask = np.zeros(len(self.table), np.bool_)
        mask[self.positions] = True
        return mask


class Identities(NamedTuple):
    """What tells messages of one topic apart.

    Attributes:
        log_times: ns.
        publish_times: ns.
        hashes: of the payloads.
        recordings: a number for the recording of each message.
    """

    log_times: IntArray
    publish_times: IntArray
    hashes: IntArray
    recordings: IntArray

    def rows(self, positions: IntArray) -> Identities:
        """Returns those of the messages at some positions."""
        return Identities(*(column[positions] for column in self))


def copies_among(messages: Identities) -> Flags:
    """Returns which messages repeat an earlier one of another recording.

    Of messages with one log time that of the recording with the lowest number counts.
    """
    is_copy = _copies_within(messages, COPY_HORIZON_NS)
    is_logged = (messages.publish_times == messages.log_times) | (messages.publish_times == 0)
    is_dated = np.isin(messages.recordings, messages.recordings[~is_logged])
    if not is_dated.all():
        # Those with publish times are compared already, and are as of one recording.
        recordings = np.where(is_dated, -1, messages.recordings)
        others = np.flatnonzero(~is_copy)
        rows = messages._replace(recordings=recordings).rows(others)
        by_payload = rows._replace(publish_times=np.zeros(others.size, np.int64))
        once = _said_once(by_payload)
        is_copy[others[once]] = _copies_within(by_payload.rows(once), COPY_JITTER_NS)
    return is_copy


def _said_once(messages: Identities) -> IntArray:
    """Returns the rows whose payload their recording has not again within `COPY_HORIZON_NS`.

    A boolean that is published ten times a second may be any robot's.
    """
    order = np.lexsort((messages.log_times, messages.hashes, messages.recordings))
    apart, _, of_hashes, of_recordings = (np.diff(column[order]) for column in messages)
    is_again = (of_hashes == 0) & (of_recordings == 0) & (apart <= COPY_HORIZON_NS)
    return np.sort(order[~(np.append(is_again, False) | np.append(False, is_again))])


def _copies_within(messages: Identities, horizon: Ns) -> Flags:
    """Returns which messages another recording has at most `horizon` (ns) before."""
    is_copy = np.zeros(messages.log_times.size, np.bool_)
    suspects = _shared_by_recordings(messages)
    suspected = messages.rows(suspects)
    order = suspects[np.lexsort((suspected.recordings, suspected.log_times))]
    # For each message how often each recording had it lately; and when one more of it counted.
    counts: dict[tuple[int, int], dict[int, int]] = {}
    counted: deque[tuple[Ns, tuple[int, int]]] = deque()
    columns = (column.tolist() for column in messages.rows(order))
    rows = zip(order.tolist(), *columns, strict=True)
    for row, time, published, payload, recording in rows:
        while counted and counted[0][0] < time - horizon:
            _, message = counted.popleft()
            left = {number: count - 1 for number, count in counts.pop(message).items() if count > 1}
            if left:
                counts[message] = left
        message = (published, payload)
        by_recording = counts.setdefault(message, {})
        most = max(by_recording.values(), default=0)
        by_recording[recording] = by_recording.get(recording, 0) + 1
        if by_recording[recording] > most:
            counted.append((time, message))
        else:
            is_copy[row] = True
    return is_copy


def repeated_among(messages: Identities) -> Flags:
    """Returns which messages were received late, after another recording had received them."""
    order = np.lexsort(
        (messages.recordings, messages.log_times, messages.hashes, messages.publish_times)
    )
    ordered = messages.rows(order)
    begins = run_starts(ordered.publish_times, ordered.hashes)
    first = np.repeat(begins, np.diff(begins, append=order.size))
    is_late = ordered.log_times - ordered.publish_times > REPEATED_NS
    is_again = (
        is_late
        & (ordered.log_times > ordered.log_times[first])
        & (ordered.recordings != ordered.recordings[first])
    )
    repeated = np.zeros(order.size, np.bool_)
    repeated[order] = is_again
    return repeated


def _shared_by_recordings(messages: Identities) -> IntArray:
    """Returns the rows whose publish time and payload several recordings have."""
    if not messages.log_times.size:
        return np.zeros(0, np.int64)
    order = np.lexsort((messages.recordings, messages.hashes, messages.publish_times))
    ordered = messages.rows(order)
    is_same = (np.diff(ordered.publish_times) == 0) & (np.diff(ordered.hashes) == 0)
    group = np.append(0, np.cumsum(~is_same))
    is_elsewhere = is_same & (np.diff(ordered.recordings) != 0)
    return order[np.isin(group, group[1:][is_elsewhere])]

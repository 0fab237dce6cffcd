"""What numbers a topic held in each bin of a window: how many messages, least, greatest, mean.

By its columns, newest first, so that what is counted when the time is over is all that is newer
than a moment. Stored numbers may be off by the error of their column: what they add up to is too,
and where the least and the greatest lie is settled in the bags that may hold them.
"""

from __future__ import annotations

import math
import sys
from bisect import bisect_right
from collections import defaultdict
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.conditions import leaves
from ros2_memory.columns.shown import FieldNumbers, column_of, numbers
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.table import Table
from ros2_memory.columns.units import BagUnit, Rows
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError, UndecodableError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow, By
from ros2_memory.counts.matches import count_values
from ros2_memory.history.context import READING_S, Call, Memory
from ros2_memory.history.no_data import no_data_between, resolve_topic
from ros2_memory.history.reverse_search import note_no_fix, note_summarised
from ros2_memory.history.robots import note_robots
from ros2_memory.history.scan import count_messages, decoded_rows, messages_of, of_columns, scan
from ros2_memory.history.view import TimeRange, View, open_span

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.results import BinColumn, Bins
    from ros2_memory.storage.base import Definition, IntArray

    _Cell: TypeAlias = tuple[float, Ns, float, Ns, float]


_LARGEST: Final = sys.float_info.max
SUM_SCALE: Final = 2.0**-64
"""What sums are scaled by: those of the largest floats are finite then, and no digit is lost."""
LEAST: Final = 1
GREATEST: Final = -1
"""The greatest number is the least one of their negatives."""


class TooManyError(Exception):
    """More messages than the caller wants would have to be read from bags."""


class Extreme(NamedTuple):
    """The least (or greatest) number in a part of a piece.

    Attributes:
        low: no number of the part, times the sign, is less.
        high: one is no greater. Equal to `low` where the number is known.
        first: log time of the first message that may hold it.
        last: of the last; equal to `first` where the message is known.
    """

    low: float
    high: float
    first: Ns
    last: Ns

    @classmethod
    def known(cls, number: float, at: Ns) -> Extreme:
        """Returns a number that is known, times the sign, and so is its message."""
        return cls(number, number, at, at)

    @property
    def is_settled(self) -> bool:
        """Whether the number and its first message are known."""
        return self.low == self.high and self.first == self.last

    @property
    def middle(self) -> float:
        """The number, off by no more than its column is."""
        return (self.low + self.high) / 2


class Part(NamedTuple):
    """The numbers of a field in some messages of one piece.

    Attributes:
        first: log time of the first of the messages.
        last: of the last.
        size: how many numbers.
        total: their sum, times `SUM_SCALE`.
        least: the least of them.
        greatest: the greatest, as the least one of their negatives.
    """

    first: Ns
    last: Ns
    size: int
    total: float
    least: Extreme
    greatest: Extreme


_NO_NUMBER: Final = Extreme.known(math.inf, MAX_NS)


class PieceNumbers:
    """Collects the numbers of some fields of a topic in pieces of a window.

    Args:
        view: the call's.
        topic: its name.
        fields: dot-paths.
        edges: where pieces begin (ns), ascending; what is before the first is piece 0.
        most_read: messages that may be read from bags where columns do not hold a field.

    Attributes:
        since: what is before this log time is not among the parts, for lack of time; or None.
        failures: of messages that cannot be decoded.
    """

    def __init__(
        self,
        view: View,
        topic: str,
        fields: Sequence[str],
        edges: IntArray,
        *,
        most_read: int | None = None,
    ) -> None:
        self.since: Ns | None = None
        self._view = view
        self._topic = topic
        self._fields = tuple(fields)
        self._edges = edges
        self._most_read = most_read
        self.failures: list[UndecodableError] = []
        self._read = 0
        self._reading = view.call.partial_after(READING_S)
        self._reached_to: Ns = MAX_NS
        self._pending: list[Rows] = []
        self._parts: defaultdict[tuple[int, int], list[Part]] = defaultdict(list)
        self._exact_extremes: dict[tuple[int, int, Extreme], Extreme] = {}
        self._columns: dict[tuple[Definition, str, str], str | None] = {}

    def collect(self, window: TimeWindow) -> None:
        """Collects the numbers of a window, for as long as there is time.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
            TooManyError: too many messages would have to be read.
        """
        try:
            for rows in scan(
                self._view, self._topic, window, newest_first=True, reached=self._add_newer_than
            ):
                self._pending.append(rows)
        except QueryTimeoutError:
            if not self._parts:
                raise
            self.since = self._reached_to + 1
        for rows in self._pending:
            self._add(rows, MIN_NS if self.since is None else self.since)
        self._pending.clear()
        note_summarised(self._view, self._topic, self._fields, window)

    def parts(self, field: int, piece: int) -> Sequence[Part]:
        """Returns the parts of a piece that hold numbers of a field, in any order."""
        return self._parts.get((field, piece), ())

    def extreme(self, field: int, pieces: Iterable[int], sign: int) -> tuple[float, Ns] | None:
        """Returns the least (or greatest) number in some pieces, and when it was first.

        What the columns do not decide is read from bags; if the time for that is over, the number
        may be off by the error of its column.
        """
        candidates = sorted(
            part.least if sign == LEAST else part.greatest
            for piece in pieces
            for part in self.parts(field, piece)
        )
        least = _NO_NUMBER
        for extreme in candidates:
            if extreme.low > least.low:
                break
            if extreme.low < least.low or extreme.first < least.first:
                least = min(least, self._exact_extreme(field, sign, extreme))
        return (least.low * sign, least.first) if candidates else None

    def _add_newer_than(self, at: Ns) -> None:
        """Adds what no table that is left overlaps; ends the scan where the time is over."""
        complete = [rows for rows in self._pending if rows.span[0] > at]
        self._pending = [rows for rows in self._pending if rows.span[0] <= at]
        for rows in complete:
            self._add(rows, MIN_NS)
        self._reached_to = at
        if self._reading.expired() and self._parts:
            raise QueryTimeoutError("the rest is left out")

    def _add_totals(self, rows: Rows, since: Ns) -> bool:
        """Adds the numbers of a part, if all are of one piece and its outline tells them."""
        piece = bisect_right(self._edges, rows.first)
        is_cut = piece != bisect_right(self._edges, rows.last)
        if rows.index is not None or is_cut or rows.first < since:
            return False
        outlines = [self._outlined(rows, field) for field in range(len(self._fields))]
        stated = [part for part in outlines if part is not None]
        if len(stated) < len(outlines):
            return False
        for field, part in enumerate(stated):
            self._parts[field, piece].append(part)
        return True

    def _outlined(self, rows: Rows, field: int) -> Part | None:
        """Returns the numbers of a field by the outline of a table; None where it has none."""
        table = rows.table
        if not isinstance(table, StoredTable) or table.definition is None:
            return None
        key = (table.definition, table.channel.type, self._fields[field])
        if key not in self._columns:
            extractor = self._view.extractor
            self._columns[key] = column_of(table, self._fields[field], extractor)
        path, outline = self._columns[key], table.outline()
        if path is None or outline is None:
            return None
        totals, zone = outline.totals(path), table.zone(path)
        if totals is None or zone is None or not math.isfinite(totals.total):
            return None
        least = Extreme(zone.low, zone.low, *totals.least)
        greatest = Extreme(-zone.high, -zone.high, *totals.greatest)
        return Part(rows.first, rows.last, totals.size, totals.total * SUM_SCALE, least, greatest)

    def _add(self, rows: Rows, since: Ns) -> None:
        """Adds the numbers of a table from a log time on."""
        if self._add_totals(rows, since):
            return
        stored = of_columns(self._view, rows, self._numbers_of_fields)
        if stored is None:
            self._add_from_messages(rows, since)
        for part_of_rows, numbers_of_fields in stored or ():
            self._add_to_pieces(part_of_rows, numbers_of_fields, self._pieces(part_of_rows, since))

    def _numbers_of_fields(self, rows: Rows) -> tuple[Rows, list[FieldNumbers]] | None:
        """Returns rows with the numbers of all fields in them; None where columns lack some."""
        numbers_of_fields = []
        for field in range(len(self._fields)):
            numbers_of_field = self._numbers(rows, field)
            if numbers_of_field is None:
                return None
            numbers_of_fields.append(numbers_of_field)
        return rows, numbers_of_fields

    def _numbers(self, rows: Rows, field: int) -> FieldNumbers | None:
        """Returns the numbers of the rows that count, by their positions among these."""
        stored = numbers(rows.table, self._fields[field], self._view.extractor)
        if stored is None or rows.index is None:
            return stored
        counting = _some(stored, np.flatnonzero(rows.mask()[stored.rows]))
        return counting._replace(rows=np.searchsorted(rows.index, counting.rows))

    def _add_to_pieces(
        self,
        rows: Rows,
        numbers_of_fields: Sequence[FieldNumbers],
        pieces: Iterable[tuple[int, int, int]],
    ) -> None:
        """Adds the numbers of each field in some rows to pieces, which are as `_pieces` yields."""
        outlines = [
            self._outlined(rows, field) if rows.index is None else None
            for field in range(len(numbers_of_fields))
        ]
        for piece, start, stop in pieces:
            is_whole = stop - start == len(rows)
            first, last = rows.span if is_whole else rows.times[[start, stop - 1]].tolist()
            for field, (numbers_of_field, outline) in enumerate(
                zip(numbers_of_fields, outlines, strict=True)
            ):
                begin, end = np.searchsorted(numbers_of_field.rows, [start, stop]).tolist()
                if begin < end:
                    some = _some(numbers_of_field, np.arange(begin, end))
                    part = _part_of(rows, some, (first, last), outline)
                    self._parts[field, piece].append(part)

    def _pieces(self, rows: Rows, since: Ns) -> Iterator[tuple[int, int, int]]:
        """Yields the number of each piece of some rows, with its first row and the one after it."""
        first, last = rows.span
        begin, end = (bisect_right(self._edges, at) for at in (first, last))
        if begin == end and since <= first:
            yield begin, 0, len(rows)
            return
        edges = np.append(since, self._edges[begin:end])
        least, *bounds = np.searchsorted(rows.times, edges).tolist()
        starts, stops = [0, *bounds], [*bounds, len(rows)]
        for piece, (start, stop) in enumerate(zip(starts, stops, strict=True), begin):
            if max(start, least) < stop:
                yield piece, max(start, least), stop

    def _add_from_messages(self, rows: Rows, since: Ns) -> None:
        """Does as `_add`, by the messages: columns do not hold all fields."""
        self._read += len(rows)
        if self._most_read is not None and self._read > self._most_read:
            raise TooManyError
        for bag, positions in rows.bag_rows():
            decoded_times: list[Ns] = []
            samples: list[list[list[float]]] = [[] for _ in self._fields]
            for stored in messages_of(self._view, rows.some(positions)):
                message = self._view.bags.decode(stored, self.failures)
                if message is None:
                    continue
                decoded_times.append(stored.time)
                for field, of_field in zip(self._fields, samples, strict=True):
                    value = self._view.extractor.exact_at(message, stored.type, field)
                    of_field.append([*numbers_in(value)])
            if decoded_times:
                times = np.array(decoded_times, np.int64)
                table = Table(rows.table.channel, times, times, times)
                read = Rows(BagUnit(bag, table, 0), lambda: None)
                numbers_of_fields = [*map(_numbers_of_samples, samples)]
                self._add_to_pieces(read, numbers_of_fields, self._pieces(read, since))

    def _exact_extreme(self, field: int, sign: int, extreme: Extreme) -> Extreme:
        """Returns an extreme with its number and message known; by the bags where it is open."""
        if extreme.is_settled:
            return extreme
        key = (field, sign, extreme)
        if key not in self._exact_extremes:
            try:
                exact = self._extreme_in_bags(field, sign, extreme)
            except QueryTimeoutError:
                exact = None
                self._view.notes.add(
                    "out of time before bags were read for the exact least and greatest numbers: "
                    f"those of {self._fields[field]} may be off in their last digits"
                )
            self._exact_extremes[key] = exact or Extreme.known(extreme.middle, extreme.first)
        return self._exact_extremes[key]

    def _extreme_in_bags(self, field: int, sign: int, extreme: Extreme) -> Extreme | None:
        """Returns an extreme by the bags that may hold it; None where these cannot be read."""
        least, undecided = self._least_in_columns(field, sign, extreme)
        is_number_known = extreme.low == extreme.high and least.first == MAX_NS
        if is_number_known and len(undecided) == 1 == len(undecided[0]):
            # Of all messages only this one can have the number.
            return Extreme.known(extreme.low, int(undecided[0].times[0]))
        for rows in sorted(undecided, key=lambda rows: int(rows.times[0])):
            if least.low <= extreme.low and least.first <= int(rows.times[0]):
                break
            if self._reading.expired():
                raise QueryTimeoutError("the rest is left out")
            for _, decoded in decoded_rows(self._view, rows):
                found = self._numbers(decoded, field)
                if found is not None:
                    least = min(least, _least(decoded, found, sign))
        return None if least == _NO_NUMBER else least

    def _least_in_columns(
        self, field: int, sign: int, extreme: Extreme
    ) -> tuple[Extreme, list[Rows]]:
        """Returns an extreme as far as columns have exact numbers, and rows that bags decide."""
        least = _NO_NUMBER
        undecided: list[Rows] = []
        for rows in scan(self._view, self._topic, TimeWindow(extreme.first, extreme.last + 1)):
            found, may_hold = self._numbers(rows, field), np.arange(len(rows))
            if found is not None:
                if not found.error or found.exactly is not None:
                    least = min(least, _least(rows, found, sign))
                    continue
                lows, _ = _bounds(found, sign)
                may_hold = found.rows[lows <= extreme.high]
            for _, of_bag in rows.bag_rows():
                positions = np.intersect1d(of_bag, may_hold)
                if positions.size:
                    undecided.append(rows.some(positions))
        return least, undecided


def _some(of_field: FieldNumbers, kept: IntArray) -> FieldNumbers:
    """Returns some of the numbers of a field, in their order."""
    exactly = of_field.exactly
    return of_field._replace(
        rows=of_field.rows[kept],
        numbers=of_field.numbers[kept],
        errors=None if of_field.errors is None else of_field.errors[kept],
        exactly=None if exactly is None else lambda among: exactly(kept[among]),
    )


def _bounds(of_field: FieldNumbers, sign: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the least and the greatest that each number, times the sign, may be."""
    signed = sign * of_field.numbers.astype(np.float64)
    off = of_field.error if of_field.errors is None else of_field.errors
    return signed - off, signed + off


def _extreme_of_column(rows: Rows, of_field: FieldNumbers, sign: int) -> Extreme:
    """Returns the extreme of numbers, as the column decides it."""
    if not of_field.error or of_field.exactly is not None:
        return _least(rows, of_field, sign)
    lows, highs = _bounds(of_field, sign)
    low, high = float(lows.min()), float(highs.min())
    candidates = np.flatnonzero(lows <= high)[[0, -1]]
    return Extreme(low, high, *rows.times[of_field.rows[candidates]].tolist())


def _part_of(rows: Rows, of_field: FieldNumbers, span: Span, outline: Part | None) -> Part:
    """Returns numbers of a field, in messages of a span (ns, inclusive), as a part."""
    first, last = span
    total = float((of_field.numbers * SUM_SCALE).sum())
    extremes = [_extreme_of_column(rows, of_field, sign) for sign in (LEAST, GREATEST)]
    if outline is not None:
        # Those of the whole table are exact, where they lie here.
        extremes = [
            stated if first <= stated.first <= stated.last <= last else computed
            for computed, stated in zip(extremes, (outline.least, outline.greatest), strict=True)
        ]
    return Part(first, last, of_field.rows.size, total, *extremes)


def _numbers_of_samples(samples: Sequence[Sequence[float]]) -> FieldNumbers:
    """Returns the numbers of one field, of which each message has some."""
    values = np.array([number for sample in samples for number in sample])
    if values.dtype.kind not in "iu":
        values = values.astype(np.float64)
    return FieldNumbers(np.repeat(np.arange(len(samples)), [*map(len, samples)]), values, 0.0)


def numbers_in(value: JsonValue) -> Iterator[float]:
    """Yields the numbers of a field; not those of a summary in place of an array."""
    for leaf in leaves(value):
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            continue
        if -_LARGEST <= leaf <= _LARGEST:
            yield leaf


def _least(rows: Rows, of_field: FieldNumbers, sign: int) -> Extreme:
    """Returns the least exact number."""
    positions, values = np.arange(of_field.rows.size), of_field.numbers
    if not positions.size:
        return _NO_NUMBER
    if of_field.error and of_field.exactly is not None:
        lows, highs = _bounds(of_field, sign)
        positions = np.flatnonzero(lows <= highs.min())
        values = of_field.exactly(positions)
    nth = int(values.argmin() if sign == LEAST else values.argmax())
    return Extreme.known(sign * values[nth].item(), int(rows.times[of_field.rows[positions[nth]]]))


_CELL: Final[tuple[tuple[str, BinColumn], ...]] = (
    ("min", "number"),
    ("min_at", "time"),
    ("max", "number"),
    ("max_at", "time"),
    ("mean", "number"),
)
"""The columns of a field."""
_MEAN_DIGITS: Final = 12
"""What rounding of sums cannot change, however a window is cut into bags."""


def count_range(
    memory: Memory,
    call: Call,
    topic: str,
    span: TimeRange,
    by: By | Literal["value"],
    *,
    fields: Sequence[str],
) -> Bins:
    """Returns how many messages of a topic each bin holds, and the numbers of fields in them.

    By value how often and how long it held each (`count_values`).

    Raises:
        InvalidArgumentsError: there are too many bins, or too many fields for them.
        NoDataError: there is no message in the window.
        QueryTimeoutError: the call's time is over.
    """
    view, asked = open_span(memory, call, span)
    name = resolve_topic(view, topic)
    if by == "value":
        return count_values(view, name, asked, fields=fields)
    binned = BinnedWindow(view, asked, by, (name,))
    names = tuple(dict.fromkeys(fields))
    note_no_fix(view, name, asked, names)
    size = len(binned.bins.names)
    if len(names) * size > MOST_CELLS:
        raise InvalidArgumentsError(
            f"{len(names)} fields by {by} in {size} bins are too many for one reply: "
            "name fewer fields, or ask about a shorter window"
        )
    cells_of_fields = _cells_of_fields(view, name, binned, names) if names else []
    edges = binned.bins.edges[1:-1]
    counts, first, last = count_messages(view, name, binned.counted, edges)
    if not counts.any():
        raise no_data_between(view, (name,), asked)
    binned.add_sums("count", "count", counts)
    binned.add_first("first", first[counts > 0])
    binned.add_last(last, int(last.max()))
    for field, cells in zip(names, cells_of_fields, strict=True):
        if cells[-1] is None:
            _require_field(view, name, field, binned.counted.stop)
            view.notes.add(f"{field} holds no number in the window")
            continue
        for nth, (column, kind) in enumerate(_CELL):
            *of_bins, of_window = [None if cell is None else cell[nth] for cell in cells]
            binned.add(f"{field}.{column}", kind, of_bins, of_window)
    note_robots(view, name, binned.counted)
    return binned.answer()


def _require_field(view: View, topic: str, field: str, until: Ns) -> None:
    """Checks that messages of a topic have a field, by the newest one before a moment.

    Raises:
        InvalidArgumentsError: it has none.
    """
    newest = view.stream.last(topic, until)
    message = None if newest is None else view.bags.decode(newest)
    if newest is not None and message is not None:
        view.extractor.shown(message, newest.type, (field,))


def _cells_of_fields(
    view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]
) -> list[Sequence[_Cell | None]]:
    """Returns for each field the cell of each bin, and last that of all of them together."""
    collected = PieceNumbers(view, topic, fields, binned.bins.edges[1:-1])
    collected.collect(binned.counted)
    binned.count_since(collected.since)
    if collected.failures:
        reason = collected.failures[0].reason
        view.notes.add_lack(f"messages left out, since they cannot be decoded: {reason}")
    pieces_of_bins = [np.flatnonzero(member).tolist() for member in binned.bins.member.T]
    pieces_of_bins.append([*range(len(binned.bins.member))])
    return [
        [_cell(collected, field, pieces) for pieces in pieces_of_bins]
        for field in range(len(fields))
    ]


def _cell(collected: PieceNumbers, field: int, pieces: Sequence[int]) -> _Cell | None:
    """Returns the numbers of a field in some pieces; None if there are none."""
    parts = [part for piece in pieces for part in collected.parts(field, piece)]
    least = collected.extreme(field, pieces, LEAST)
    greatest = collected.extreme(field, pieces, GREATEST)
    if least is None or greatest is None:
        return None
    (least_number, least_at), (greatest_number, greatest_at) = least, greatest
    total = math.fsum(part.total for part in parts)
    mean = float(f"{total / sum(part.size for part in parts) / SUM_SCALE:.{_MEAN_DIGITS}g}")
    # The extremes are exact; what columns add up to is not. Plus 0: no reply says -0.0.
    mean = min(max(mean, least_number), greatest_number) + 0.0
    return least_number + 0, least_at, greatest_number + 0, greatest_at, mean

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
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.conditions import leaves
from ros2_memory.columns.numbers import FieldNumbers, column_of, numbers
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.table import Table
from ros2_memory.columns.units import BagUnit, Rows
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError, UndecodableError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow, By
from ros2_memory.counts.held import count_values
from ros2_memory.history.context import READING_S
from ros2_memory.history.counting import count_messages
from ros2_memory.history.no_data import no_data_between, resolve_topic
from ros2_memory.history.robots import note_robots
from ros2_memory.history.scan import decoded_rows, messages_of, of_columns, scan
from ros2_memory.history.view import TimeRange, View, open_span

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.columns.outline import Totals
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.results import BinColumn, Bins
    from ros2_memory.storage.base import Definition, IntArray

    _Cell: TypeAlias = tuple[float, Ns, float, Ns, float]


_LARGEST: Final = sys.float_info.max
SUM_SCALE: Final = 2.0**-64
"""What sums are scaled by: those of the largest floats are finite then, and no digit is lost."""
_SUMMARY: Final = frozenset({"bytes", "numbers"})
"""The keys of a summary in place of numbers that are too many to show."""
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


class _Known(NamedTuple):
    """What is known of a column of a part without it: also its least and greatest number."""

    totals: Totals
    ends: tuple[Extreme, Extreme]


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
        self._left: Ns = MAX_NS
        self._waiting: list[Rows] = []
        self._parts: defaultdict[tuple[int, int], list[Part]] = defaultdict(list)
        self._known: dict[tuple[int, int, Extreme], Extreme] = {}
        self._columns: dict[tuple[Definition, str, str], str | None] = {}

    def collect(self, window: TimeWindow) -> None:
        """Collects the numbers of a window, for as long as there is time.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
            TooManyError: too many messages would have to be read.
        """
        try:
            for rows in scan(
                self._view, self._topic, window, newest_first=True, reached=self._reached
            ):
                self._waiting.append(rows)
        except QueryTimeoutError:
            if not self._parts:
                raise
            self.since = self._left + 1
        for rows in self._waiting:
            self._add(rows, MIN_NS if self.since is None else self.since)
        self._waiting.clear()

    def parts(self, field: int, piece: int) -> Sequence[Part]:
        """Returns the parts of a piece that hold numbers of a field, in any order."""
        return self._parts.get((field, piece), ())

    def extreme(self, field: int, pieces: Iterable[int], sign: int) -> tuple[float, Ns] | None:
        """Returns the least (or greatest) number in some pieces, and when it was first.

        What the columns do not decide is read, but for the time being over.
        """
        found = sorted(
            part.least if sign == LEAST else part.greatest
            for piece in pieces
            for part in self.parts(field, piece)
        )
        best = (math.inf, MAX_NS)
        for extreme in found:
            if extreme.low > best[0]:
                break
            if extreme.low == best[0] and extreme.first >= best[1]:
                continue
            settled = self._settled(field, sign, extreme)
            best = min(best, (settled.high, settled.first))
        return (best[0] * sign, best[1]) if found else None

    def _reached(self, at: Ns) -> None:
        """Adds what no table that is left overlaps; ends the scan where the time is over."""
        settled = [rows for rows in self._waiting if rows.span[0] > at]
        self._waiting = [rows for rows in self._waiting if rows.span[0] <= at]
        for rows in settled:
            self._add(rows, MIN_NS)
        self._left = at
        if self._reading.expired() and self._parts:
            raise QueryTimeoutError("the rest is left out")

    def _add_totals(self, rows: Rows, since: Ns) -> bool:
        """Adds the numbers of a part, if all are of one piece and its outline tells them."""
        piece = bisect_right(self._edges, rows.first)
        is_cut = piece != bisect_right(self._edges, rows.last)
        if rows.index is not None or is_cut or rows.first < since:
            return False
        every = [self._ends(rows, field) for field in range(len(self._fields))]
        known = [some for some in every if some is not None]
        if len(known) < len(every):
            return False
        for field, (totals, ends) in enumerate(known):
            total = totals.total * SUM_SCALE
            part = Part(rows.first, rows.last, totals.size, total, *ends)
            self._parts[field, piece].append(part)
        return True

    def _ends(self, rows: Rows, field: int) -> _Known | None:
        """Returns what is known of a field in a part without its columns; None where nothing is."""
        table = rows.table
        if not isinstance(table, StoredTable) or table.definition is None:
            return None
        key = (table.definition, table.channel.type, self._fields[field])
        if key not in self._columns:
            extractor = self._view.extractor
            self._columns[key] = column_of(table, self._fields[field], extractor)
        path, outline = self._columns[key], table.outline()
        totals = None if path is None or outline is None else outline.totals(path)
        zone = None if path is None or totals is None else table.zone(path)
        if totals is None or zone is None or not math.isfinite(totals.total):
            return None
        least = Extreme(zone.low, zone.low, *totals.least)
        greatest = Extreme(-zone.high, -zone.high, *totals.greatest)
        return _Known(totals, (least, greatest))

    def _add(self, rows: Rows, since: Ns) -> None:
        """Adds the numbers of a table from a log time on."""
        if self._add_totals(rows, since):
            return
        found = of_columns(self._view, rows, self._held)
        if found is None:
            self._add_read(rows, since)
        for some, held in found or ():
            self._add_found(some, held, self._pieces(some, since))

    def _held(self, rows: Rows) -> tuple[Rows, list[FieldNumbers]] | None:
        """Returns the numbers of all fields of a table; None where columns lack some."""
        found = [numbers(rows.table, field, self._view.extractor) for field in self._fields]
        held = [_of_rows(some, rows) for some in found if some is not None]
        return (rows, held) if len(held) == len(found) else None

    def _add_found(
        self, rows: Rows, held: Sequence[FieldNumbers], pieces: Iterable[tuple[int, int, int]]
    ) -> None:
        """Adds the numbers of each field in some rows to pieces, which are as `_pieces` yields."""
        outlines = [
            self._ends(rows, field) if rows.index is None else None for field in range(len(held))
        ]
        for piece, start, stop in pieces:
            is_whole = stop - start == len(rows)
            first, last = rows.span if is_whole else rows.times[[start, stop - 1]].tolist()
            for field, (numbers_of_field, outline) in enumerate(zip(held, outlines, strict=True)):
                begin, end = np.searchsorted(numbers_of_field.rows, [start, stop]).tolist()
                if begin < end:
                    part = _part(rows, numbers_of_field, (begin, end), (first, last), outline)
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

    def _add_read(self, rows: Rows, since: Ns) -> None:
        """Does as `_add`, by the messages: columns do not hold all fields."""
        self._read += len(rows)
        if self._most_read is not None and self._read > self._most_read:
            raise TooManyError
        for bag, positions in rows.bag_rows():
            read = [
                (found.time, sample)
                for found in messages_of(self._view, rows.some(positions))
                if (sample := self._sample(found)) is not None
            ]
            if not read:
                continue
            times = np.array([time for time, _ in read], np.int64)
            whole = Rows(BagUnit(bag, Table(rows.table.channel, times, times, times), 0), _all)
            samples = [[sample[nth] for _, sample in read] for nth in range(len(self._fields))]
            self._add_found(whole, [*map(_of_samples, samples)], self._pieces(whole, since))

    def _sample(self, found: StoredMessage) -> list[list[float]] | None:
        """Returns the numbers of each field in a message; None where it cannot be decoded."""
        message = self._view.bags.decode(found, self.failures)
        if message is None:
            return None
        at = partial(self._view.extractor.exact_at, message, found.type)
        return [[*numbers_in(at(field))] for field in self._fields]

    def _settled(self, field: int, sign: int, extreme: Extreme) -> Extreme:
        """Returns an extreme as the bags have it."""
        if extreme.is_settled:
            return extreme
        key = (field, sign, extreme)
        if key not in self._known:
            try:
                found = self._read_extreme(field, sign, extreme)
            except QueryTimeoutError:
                found = None
                self._view.notes.add(
                    "out of time before bags were read for the exact least and greatest numbers: "
                    f"those of {self._fields[field]} may be off in their last digits"
                )
            number, first = extreme.middle, extreme.first
            self._known[key] = found or Extreme(number, number, first, first)
        return self._known[key]

    def _read_extreme(self, field: int, sign: int, extreme: Extreme) -> Extreme | None:
        """Returns an extreme by the bags that may hold it; None where these cannot be read."""
        extractor, path = self._view.extractor, self._fields[field]
        best = (math.inf, MAX_NS)
        waiting: list[tuple[Ns, int, Rows]] = []
        for rows in scan(self._view, self._topic, TimeWindow(extreme.first, extreme.last + 1)):
            known = numbers(rows.table, path, extractor)
            if known is not None and (not known.error or known.exactly is not None):
                best = min(best, _first_furthest(rows, _of_rows(known, rows), sign))
                continue
            for some in _by_bag(rows, _candidates(rows, known, sign, extreme)):
                waiting.append((int(some.times[0]), len(waiting), some))
        if (
            extreme.low == extreme.high
            and best[1] == MAX_NS
            and len(waiting) == 1 == len(waiting[0][2])
        ):
            # Of all messages only this one can have the number.
            return Extreme(extreme.low, extreme.low, waiting[0][0], waiting[0][0])
        for first, _, rows in sorted(waiting, key=lambda one: one[:2]):
            if best[0] <= extreme.low and best[1] <= first:
                break
            if self._reading.expired():
                raise QueryTimeoutError("the rest is left out")
            for _, decoded in decoded_rows(self._view, rows):
                known = numbers(decoded.table, path, extractor)
                if known is not None:
                    best = min(best, _first_furthest(decoded, _of_rows(known, decoded), sign))
        return None if best[1] == MAX_NS else Extreme(best[0], best[0], best[1], best[1])


def _candidates(rows: Rows, known: FieldNumbers | None, sign: int, extreme: Extreme) -> IntArray:
    """Returns which of some rows may hold an extreme, ascending."""
    if known is None:
        return np.arange(len(rows))
    known = _of_rows(known, rows)
    off = known.error if known.errors is None else known.errors
    return np.unique(known.rows[sign * known.numbers - off <= extreme.high])


def _by_bag(rows: Rows, some: IntArray) -> Iterator[Rows]:
    """Yields some of the rows, those of each bag by themselves."""
    for _, positions in rows.bag_rows():
        kept = np.intersect1d(positions, some, assume_unique=True)
        if kept.size:
            yield rows.some(kept)


def _first_furthest(rows: Rows, found: FieldNumbers, sign: int) -> tuple[float, Ns]:
    """Returns the least exact number, times the sign, and when it was first."""
    if not found.rows.size:
        return math.inf, MAX_NS
    number, row = _furthest(found, np.arange(found.rows.size), sign)
    return number, int(rows.times[row])


def _of_rows(found: FieldNumbers, rows: Rows) -> FieldNumbers:
    """Returns the numbers of the rows that count, by their positions among these."""
    if rows.index is None:
        return found
    kept = np.flatnonzero(rows.mask()[found.rows])
    exactly = found.exactly
    return found._replace(
        rows=np.searchsorted(rows.index, found.rows[kept]),
        numbers=found.numbers[kept],
        errors=None if found.errors is None else found.errors[kept],
        exactly=None if exactly is None else lambda among: exactly(kept[among]),
    )


def _extreme(rows: Rows, found: FieldNumbers, among: tuple[int, int], sign: int) -> Extreme:
    begin, end = among
    if not found.error or found.exactly is not None:
        number, row = _furthest(found, np.arange(begin, end), sign)
        at = int(rows.times[row])
        return Extreme(number, number, at, at)
    signed = sign * found.numbers[begin:end]
    off = found.error if found.errors is None else found.errors[begin:end]
    low, high = float((signed - off).min()), float((signed + off).min())
    may = begin + np.flatnonzero(signed - off <= high)[[0, -1]]
    return Extreme(low, high, *rows.times[found.rows[may]].tolist())


def _part(
    rows: Rows,
    found: FieldNumbers,
    among: tuple[int, int],
    span: tuple[Ns, Ns],
    outline: _Known | None,
) -> Part:
    """Returns some of the numbers of a field, in messages of a span (ns, inclusive), as a part."""
    (begin, end), (first, last) = among, span
    total = float((found.numbers[begin:end] * SUM_SCALE).sum())
    extremes = [_extreme(rows, found, among, sign) for sign in (LEAST, GREATEST)]
    if outline is not None:
        # Those of the whole table are exact, where they lie here.
        extremes = [
            whole if first <= whole.first <= whole.last <= last else own
            for own, whole in zip(extremes, outline.ends, strict=True)
        ]
    return Part(first, last, end - begin, total, *extremes)


def _of_samples(samples: Sequence[Sequence[float]]) -> FieldNumbers:
    """Returns the numbers of one field, of which each message has some."""
    found = np.array([number for sample in samples for number in sample])
    if found.dtype.kind not in "iu":
        found = found.astype(np.float64)
    return FieldNumbers(np.repeat(np.arange(len(samples)), [*map(len, samples)]), found, 0.0)


def numbers_in(value: JsonValue) -> Iterator[float]:
    """Yields the numbers of a field; not those of a summary in place of an array."""
    if isinstance(value, dict) and value.keys() <= _SUMMARY:
        return  # its numbers are counts, not the field's values
    for leaf in leaves(value):
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            continue
        if -_LARGEST <= leaf <= _LARGEST:
            yield leaf


def _all() -> None:
    """Finds that all rows count."""


def _furthest(found: FieldNumbers, among: IntArray, sign: int) -> tuple[float, int]:
    """Returns the least exact number, times the sign, and its first row."""
    values = found.numbers[among]
    if found.error and found.exactly is not None:
        off = found.error if found.errors is None else found.errors[among]
        may = np.flatnonzero(sign * values - off <= (sign * values + off).min())
        among = among[may]
        values = found.exactly(among)
    nth = int(values.argmin() if sign == LEAST else values.argmax())
    number: float = values[nth].item()
    return sign * number, int(found.rows[among[nth]])


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
    fields: Sequence[str] = (),
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
    size = len(binned.bins.names)
    if len(names) * size > MOST_CELLS:
        raise InvalidArgumentsError(
            f"{len(names)} fields by {by} in {size} bins are too many for one reply: "
            "name fewer fields, or ask about a shorter window"
        )
    of_fields = _numbers(view, name, binned, names) if names else []
    edges = binned.bins.edges[1:-1]
    counts, first, last = count_messages(view, name, binned.counted, edges)
    if not counts.any():
        raise no_data_between(view, (name,), asked)
    member = binned.bins.member
    binned.add("count", "count", (counts @ member).tolist(), int(counts.sum()))
    held = [counts.astype(bool) & each for each in member.T]
    binned.add(
        "first", "time", [min(first[each].tolist(), default=None) for each in held], first.min()
    )
    binned.add(
        "last", "time", [max(last[each].tolist(), default=None) for each in held], last.max()
    )
    for field, cells in zip(names, of_fields, strict=True):
        if cells[-1] is None:
            view.notes.add(f"{field} holds no number in the window")
            continue
        for nth, (column, kind) in enumerate(_CELL):
            *each, whole = [None if cell is None else cell[nth] for cell in cells]
            binned.add(f"{field}.{column}", kind, each, whole)
    note_robots(view, name, binned.counted)
    return binned.answer()


def _numbers(
    view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]
) -> list[Sequence[_Cell | None]]:
    """Returns for each field the numbers in each bin, and in all of them together."""
    found = PieceNumbers(view, topic, fields, binned.bins.edges[1:-1])
    found.collect(binned.counted)
    binned.count_since(found.since)
    if found.failures:
        reason = found.failures[0].reason
        view.notes.add_lack(f"messages left out, since they cannot be decoded: {reason}")
    pieces = [np.flatnonzero(member).tolist() for member in binned.bins.member.T]
    pieces.append([*range(len(binned.bins.member))])
    return [[_cell(found, field, some) for some in pieces] for field in range(len(fields))]


def _cell(found: PieceNumbers, field: int, pieces: Sequence[int]) -> _Cell | None:
    """Returns the numbers of a field in some pieces; None if there are none."""
    parts = [part for piece in pieces for part in found.parts(field, piece)]
    least = found.extreme(field, pieces, LEAST)
    greatest = found.extreme(field, pieces, GREATEST)
    if least is None or greatest is None:
        return None
    total = math.fsum(part.total for part in parts)
    mean = float(f"{total / sum(part.size for part in parts) / SUM_SCALE:.{_MEAN_DIGITS}g}")
    # The extremes are exact; what columns add up to is not. Plus 0: no reply says -0.0.
    mean = min(max(mean, least[0]), greatest[0]) + 0.0
    return least[0] + 0, least[1], greatest[0] + 0, greatest[1], mean

"""The numbers of a topic in each bin of a window: how many messages, first, last, least and others.

Columns are read newest first. When time runs out, everything after some moment has been counted.
A stored number may be off by the error of its column, and so may a sum of them. Which number is
the least or the greatest is decided exactly, by the bags that may hold it.
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
from ros2_memory.core.arrays import range_numbers
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    QueryTimeoutError,
    UndecodableError,
    to_report,
)
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.reply import rounded_beside
from ros2_memory.core.text import leaves as leaves_by_path
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow, By
from ros2_memory.counts.matches import count_values
from ros2_memory.history.conditions import is_number, note_no_fix
from ros2_memory.history.context import READING_S, Call, Memory
from ros2_memory.history.held_values import note_unnamed
from ros2_memory.history.no_data import no_data_between, require_fields, resolve_topic
from ros2_memory.history.reverse_search import note_summarised
from ros2_memory.history.robots import note_robots
from ros2_memory.history.scan import count_messages, decoded_rows, messages_of, of_columns, scan
from ros2_memory.history.view import TimeRange, View, open_span
from ros2_memory.messages.conversions import Summary

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.results import BinColumn, Bins
    from ros2_memory.storage.base import Definition, IntArray


_LARGEST: Final = sys.float_info.max
SUM_SCALE: Final = 2.0**-64
"""Sums are scaled by a power of two: the largest floats have a finite sum, and no digit is lost."""
LEAST: Final = 1
GREATEST: Final = -1
"""Numbers are multiplied by one of these signs, so that the greatest is found as a least one."""
_LEFT_TO_COUNT_S: Final = 2.0
"""How long what was read may still be counted after the call's time is over."""


class TooManyError(Exception):
    """Bags hold more messages to read than the caller allows."""


class Extreme(NamedTuple):
    """The least (or greatest) number in a part of a piece, as far as columns decide it.

    Attributes:
        low: a lower bound on the number times its sign (`LEAST`, `GREATEST`).
        high: an upper bound; equal to `low` if the number is known.
        first: log time of the first message that may hold the number.
        last: log time of the last such message; equal to `first` if the message is known.
    """

    low: float
    high: float
    first: Ns
    last: Ns

    @classmethod
    def known(cls, number: float, at: Ns) -> Extreme:
        """Returns the extreme of a known number (times its sign) at a known log time."""
        return cls(number, number, at, at)

    @property
    def is_settled(self) -> bool:
        """Whether the number and its first message are known."""
        return self.low == self.high and self.first == self.last

    @property
    def middle(self) -> float:
        """The number times its sign, off by at most the error of its column."""
        return (self.low + self.high) / 2


class Part(NamedTuple):
    """A summary of the numbers of one field in consecutive messages of one piece.

    Attributes:
        first: log time of the first message with a number.
        last: log time of the last message with a number.
        size: how many numbers there are.
        total: their sum times `SUM_SCALE`.
        least: the least number.
        greatest: the greatest number, negated.
    """

    first: Ns
    last: Ns
    size: int
    total: float
    least: Extreme
    greatest: Extreme


_KeyedPart: TypeAlias = tuple[tuple[int, int], Part]
"""A part with the index of its field, and its piece."""
_NO_NUMBER: Final = Extreme.known(math.inf, MAX_NS)


class _PieceRows(NamedTuple):
    """The rows of a table, from `start` to before `stop`, that lie in one piece."""

    piece: int
    start: int
    stop: int


class PieceNumbers:
    """Summarises the numbers in fields of a topic, for each piece of a window.

    Args:
        view: the view of this call.
        topic: the name of the topic.
        fields: dot-paths of the fields.
        edges: log times (ns), ascending, at which piece 1, 2, ... begin; piece 0 lies before.
        most_read: how many messages may be read from bags if columns lack a field.

    Attributes:
        since: log time before which nothing was counted because time ran out; else None.
        failures: one error for each message that cannot be decoded.
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
        """Summarises the numbers of a window, newest first, until time runs out.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
            TooManyError: bags hold more than `most_read` messages to read.
        """
        try:
            for rows in scan(
                self._view,
                self._topic,
                window,
                newest_first=True,
                before_table=self._add_newer_than,
            ):
                self._pending.append(rows)
        except QueryTimeoutError:
            if not self._parts:
                raise
            self.since = self._reached_to + 1
            self._view.bags.finish_within(_LEFT_TO_COUNT_S)
        self._add(self._pending, MIN_NS if self.since is None else self.since)
        self._pending.clear()
        note_summarised(self._view, self._topic, self._fields, window)

    def parts(self, field: int, piece: int) -> Sequence[Part]:
        """Returns the parts of a piece, in any order; `field` is an index of `fields`."""
        return self._parts.get((field, piece), ())

    def extreme(self, field: int, pieces: Iterable[int], sign: int) -> tuple[float, Ns] | None:
        """Returns the least (or greatest) number in pieces, and the log time of its first message.

        Bags are read if columns do not decide which number it is. If there is no time left for
        that, the number may be off by the error of its column. None if there is no number.
        """
        candidates = sorted(
            part.least if sign == LEAST else part.greatest
            for piece in pieces
            for part in self.parts(field, piece)
        )
        least = _NO_NUMBER
        for extreme in candidates:
            # Candidates ascend by their lower bounds: no later one can be less.
            if extreme.low > least.low:
                break
            if extreme.low < least.low or extreme.first < least.first:
                least = min(least, self._exact_extreme(field, sign, extreme))
        return (least.low * sign, least.first) if candidates else None

    def number_at(self, field: int, at: Ns) -> float | None:
        """Returns the number in the message at a log time; None if it has several.

        None, too, if there is no time left for a bag that has to be read for it.
        """
        unknown = Extreme(-math.inf, math.inf, at, at)
        least, greatest = (
            sign * self._exact_extreme(field, sign, unknown).low for sign in (LEAST, GREATEST)
        )
        return least if least == greatest else None

    def _add_newer_than(self, at: Ns) -> None:
        """Adds the pending tables after `at`: no table still to be scanned overlaps them.

        Raises:
            QueryTimeoutError: time for reading is over, and something has been counted.
        """
        self._add([rows for rows in self._pending if rows.span[0] > at], MIN_NS)
        self._pending = [rows for rows in self._pending if rows.span[0] <= at]
        self._reached_to = at
        if self._reading.expired() and self._parts:
            raise QueryTimeoutError("the rest is left out")

    def _add(self, tables: Sequence[Rows], since: Ns) -> None:
        """Adds the numbers in the messages of tables from log time `since` on: of all, or of none.

        Raises:
            QueryTimeoutError: the call's time is over; nothing is added.
            TooManyError: bags hold more than `most_read` messages to read.
        """
        for key, part in [each for rows in tables for each in self._parts_of(rows, since)]:
            self._parts[key].append(part)

    def _parts_of(self, rows: Rows, since: Ns) -> Iterator[_KeyedPart]:
        """Yields the numbers in a table's messages from log time `since` on."""
        piece = bisect_right(self._edges, rows.first)
        is_in_piece = rows.first >= since and piece == bisect_right(self._edges, rows.last)
        if is_in_piece:
            outlines = [self._outlined(rows, field) for field in range(len(self._fields))]
            # If some messages lack a number, the column says which have the first and the last.
            parts = [part for part in outlines if part is not None and part.size >= len(rows)]
            if len(parts) == len(outlines):
                yield from (((field, piece), part) for field, part in enumerate(parts))
                return
        stored = of_columns(self._view, rows, self._numbers_of_fields)
        if stored is None:
            yield from self._parts_of_messages(rows, since)
            return
        for stored_rows, numbers_of_fields in stored:
            yield from self._parts_in_pieces(stored_rows, numbers_of_fields, since)

    def _outlined(self, rows: Rows, field: int) -> Part | None:
        """Returns the numbers of a field as the table's outline has them.

        None without an outline, or if only some of its rows count.
        """
        table = rows.table
        if rows.index is not None or not isinstance(table, StoredTable) or not table.definition:
            return None
        key = (table.definition, table.channel.type, self._fields[field])
        if key not in self._columns:
            extractor = self._view.extractor
            self._columns[key] = column_of(table, self._fields[field], extractor)
        path, outline = self._columns[key], table.outline()
        if path is None or outline is None:
            return None
        totals, zone = outline.totals.get(path), table.zone(path)
        if totals is None or zone is None or not math.isfinite(totals.total):
            return None
        least = Extreme(zone.low, zone.low, *totals.least)
        greatest = Extreme(-zone.high, -zone.high, *totals.greatest)
        return Part(rows.first, rows.last, totals.size, totals.total * SUM_SCALE, least, greatest)

    def _numbers_of_fields(self, rows: Rows) -> tuple[Rows, list[FieldNumbers]] | None:
        """Returns the rows with the numbers of every field; None if columns lack a field."""
        numbers_of_fields = []
        for field in range(len(self._fields)):
            field_numbers = self._numbers(rows, field)
            if field_numbers is None:
                return None
            numbers_of_fields.append(field_numbers)
        return rows, numbers_of_fields

    def _numbers(self, rows: Rows, field: int) -> FieldNumbers | None:
        """Returns the numbers of a field; their `rows` count the rows that are not left out."""
        stored = numbers(rows.table, self._fields[field], self._view.extractor)
        if stored is None or rows.index is None:
            return stored
        counting = _numbers_at(stored, np.flatnonzero(rows.mask()[stored.rows]))
        return counting._replace(rows=np.searchsorted(rows.index, counting.rows))

    def _parts_in_pieces(
        self, rows: Rows, numbers_of_fields: Sequence[FieldNumbers], since: Ns
    ) -> Iterator[_KeyedPart]:
        """Yields the numbers of each field in the rows from log time `since` on."""
        outlines = [self._outlined(rows, field) for field in range(len(numbers_of_fields))]
        for piece, start, stop in self._pieces(rows, since):
            for field, field_numbers in enumerate(numbers_of_fields):
                begin, end = np.searchsorted(field_numbers.rows, [start, stop]).tolist()
                if begin < end:
                    piece_numbers = _numbers_at(field_numbers, np.arange(begin, end))
                    part = _part_of(rows, piece_numbers, outlines[field])
                    yield (field, piece), part

    def _pieces(self, rows: Rows, since: Ns) -> Iterator[_PieceRows]:
        """Yields the pieces that rows from log time `since` on lie in."""
        begin, end = (bisect_right(self._edges, at) for at in rows.span)
        edges = np.append(since, self._edges[begin:end])
        least, *bounds = np.searchsorted(rows.times, edges).tolist()
        starts, stops = [0, *bounds], [*bounds, len(rows)]
        for piece, (start, stop) in enumerate(zip(starts, stops, strict=True), begin):
            if max(start, least) < stop:
                yield _PieceRows(piece, max(start, least), stop)

    def _parts_of_messages(self, rows: Rows, since: Ns) -> Iterator[_KeyedPart]:
        """Yields the numbers by decoding the messages, since columns lack a field.

        Raises:
            TooManyError: bags hold more than `most_read` messages to read.
        """
        self._read += len(rows)
        if self._most_read is not None and self._read > self._most_read:
            raise TooManyError
        for decoded, numbers_of_fields in self._decoded_numbers(rows):
            yield from self._parts_in_pieces(decoded, numbers_of_fields, since)

    def _decoded_numbers(self, rows: Rows) -> Iterator[tuple[Rows, list[FieldNumbers]]]:
        """Yields the decodable messages of each bag, and the numbers of each field in them."""
        for bag, positions in rows.bag_rows():
            times: list[Ns] = []
            samples: list[list[list[float]]] = [[] for _ in self._fields]
            messages = messages_of(self._view, rows.some(positions))
            for stored, message in self._view.bags.decoded(messages, self.failures):
                times.append(stored.time)
                for field, field_samples in zip(self._fields, samples, strict=True):
                    value = self._view.extractor.exact_at(message, stored.type, field)
                    field_samples.append([*numbers_in(value)])
            if times:
                at = np.array(times, np.int64)
                table = Table(rows.table.channel, at, at, at)
                decoded = Rows(BagUnit(bag, table, 0), lambda: None)
                yield decoded, [*map(_numbers_of_samples, samples)]

    def _exact_extreme(self, field: int, sign: int, extreme: Extreme) -> Extreme:
        """Returns the extreme with its number and message known, from bags if columns cannot say.

        A note says if time runs out; then the number is the middle of its bounds.
        """
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
        """Returns the exact extreme from the bags that may hold it; None if none can be read.

        Raises:
            QueryTimeoutError: time for reading is over.
        """
        least, undecided = self._least_in_columns(field, sign, extreme)
        is_number_known = extreme.low == extreme.high and least == _NO_NUMBER
        if is_number_known and len(undecided) == 1 and len(undecided[0]) == 1:
            # No other message can have the number.
            return Extreme.known(extreme.low, int(undecided[0].times[0]))
        for rows in sorted(undecided, key=lambda rows: int(rows.times[0])):
            if least.low <= extreme.low and least.first <= int(rows.times[0]):
                break
            if self._reading.expired():
                raise QueryTimeoutError("the rest is left out")
            for _, decoded in decoded_rows(self._view, rows):
                field_numbers = self._numbers(decoded, field)
                if field_numbers is not None:
                    least = min(least, _exact_least(decoded, field_numbers, sign))
                    continue
                for of_messages, numbers_of_fields in self._decoded_numbers(decoded):
                    least = min(least, _exact_least(of_messages, numbers_of_fields[field], sign))
        return None if least == _NO_NUMBER else least

    def _least_in_columns(
        self, field: int, sign: int, extreme: Extreme
    ) -> tuple[Extreme, list[Rows]]:
        """Returns the least exact number of the columns, and the rows that only bags can decide."""
        least = _NO_NUMBER
        undecided: list[Rows] = []
        for rows in scan(self._view, self._topic, TimeWindow(extreme.first, extreme.last + 1)):
            field_numbers, candidates = self._numbers(rows, field), np.arange(len(rows))
            if field_numbers is not None:
                if field_numbers.are_exact or field_numbers.exactly is not None:
                    least = min(least, _exact_least(rows, field_numbers, sign))
                    continue
                lows, _ = _bounds(field_numbers, sign)
                candidates = field_numbers.rows[lows <= extreme.high]
            for _, bag_positions in rows.bag_rows():
                positions = np.intersect1d(bag_positions, candidates)
                if positions.size:
                    undecided.append(rows.some(positions))
        return least, undecided


def _numbers_at(field_numbers: FieldNumbers, positions: IntArray) -> FieldNumbers:
    """Returns the numbers at ascending positions."""
    exactly = field_numbers.exactly
    return field_numbers._replace(
        rows=field_numbers.rows[positions],
        numbers=field_numbers.numbers[positions],
        errors=field_numbers.errors[positions],
        exactly=None if exactly is None else lambda among: exactly(positions[among]),
    )


def _bounds(
    field_numbers: FieldNumbers, sign: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns a lower and an upper bound on each number times the sign."""
    signed = sign * field_numbers.numbers.astype(np.float64)
    return signed - field_numbers.errors, signed + field_numbers.errors


def _column_extreme(rows: Rows, field_numbers: FieldNumbers, sign: int) -> Extreme:
    """Returns the extreme, as closely as the column decides it."""
    if field_numbers.are_exact or field_numbers.exactly is not None:
        return _exact_least(rows, field_numbers, sign)
    lows, highs = _bounds(field_numbers, sign)
    low, high = float(lows.min()), float(highs.min())
    first_and_last = np.flatnonzero(lows <= high)[[0, -1]]
    return Extreme(low, high, *rows.times[field_numbers.rows[first_and_last]].tolist())


def _part_of(rows: Rows, field_numbers: FieldNumbers, outline: Part | None) -> Part:
    """Returns the summary of some numbers of a table.

    `outline` summarises the whole table. Its extremes are exact, so they are used if they lie here.
    """
    first, last = rows.times[field_numbers.rows[[0, -1]]].tolist()
    least, greatest = (_column_extreme(rows, field_numbers, sign) for sign in (LEAST, GREATEST))
    if outline is not None:
        if first <= outline.least.first <= outline.least.last <= last:
            least = outline.least
        if first <= outline.greatest.first <= outline.greatest.last <= last:
            greatest = outline.greatest
    total = float((field_numbers.numbers * SUM_SCALE).sum())
    return Part(first, last, field_numbers.rows.size, total, least, greatest)


def _numbers_of_samples(samples: Sequence[Sequence[float]]) -> FieldNumbers:
    """Returns the numbers of one field; each sample has the numbers of one message."""
    values = np.array([number for sample in samples for number in sample])
    if values.dtype.kind not in "iu":
        values = values.astype(np.float64)
    return FieldNumbers(range_numbers([*map(len, samples)]), values, np.zeros(values.size))


def numbers_in(value: JsonValue) -> Iterator[float]:
    """Yields the finite numbers in a field's value: no booleans, and no sizes of a summary."""
    for leaf in leaves(value):
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            continue
        if -_LARGEST <= leaf <= _LARGEST:
            yield leaf


def _exact_least(rows: Rows, field_numbers: FieldNumbers, sign: int) -> Extreme:
    """Returns the least number times the sign, and the first message that has it.

    Numbers that are stored rounded are read exactly if they may be the least.
    """
    positions, values = np.arange(field_numbers.rows.size), field_numbers.numbers
    if not positions.size:
        return _NO_NUMBER
    if field_numbers.exactly is not None and not field_numbers.are_exact:
        lows, highs = _bounds(field_numbers, sign)
        positions = np.flatnonzero(lows <= highs.min())
        values = field_numbers.exactly(positions)
    nth = int(values.argmin() if sign == LEAST else values.argmax())
    row = field_numbers.rows[positions[nth]]
    return Extreme.known(sign * values[nth].item(), int(rows.times[row]))


class _FieldCell(NamedTuple):
    """The numbers of a field in a bin, in the columns of a reply; `..._at` are log times.

    `first` and `last` are None where the first or the last message has several numbers.
    """

    first: float | None
    last: float | None

    min: float
    min_at: Ns
    max: float
    max_at: Ns
    mean: float


_MEAN_DIGITS: Final = 12
"""So many digits are the same however a window is cut into bags: rounding does not reach them."""


def count_range(
    memory: Memory,
    call: Call,
    topic: str,
    span: TimeRange,
    by: By | Literal["value"],
    *,
    fields: Sequence[str],
) -> Bins:
    """Returns how many messages of a topic each bin has, and the numbers of fields in them.

    A message that is one number needs no field. With `by` "value", returns how often and how long
    the topic held each value (`count_values`).

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
    types = view.timeline.types_of(name)
    if types and not fields and all(map(is_number, types)):
        fields = [view.extractor.own_path("data", types[0])]
    names = number_paths(view, name, fields, asked.stop)
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
    for field, (cells, window_cell) in zip(names, cells_of_fields, strict=True):
        if window_cell is None:
            require_fields(view, name, (field,), binned.counted.stop)
            view.notes.add(f"{field} holds no number in the window")
            note_unnamed(view, name, [{field: None}], binned.counted.stop)
            continue
        for column in _FieldCell._fields:
            values = [None if cell is None else getattr(cell, column) for cell in cells]
            kind: BinColumn = "time" if column.endswith("_at") else "number"
            binned.add(f"{field}.{column}", kind, values, getattr(window_cell, column))
    note_robots(view, name, binned.counted)
    note_no_fix(view, name, binned.counted, names)
    return binned.answer()


def number_paths(view: View, topic: str, fields: Sequence[str], until: Ns) -> tuple[str, ...]:
    """Returns the dot-paths of the numbers in fields, each once: those in an object one by one.

    The newest message before a log time (ns) shows what a field is.
    """
    stored = view.stream.last(topic, until) if fields else None
    message = view.bags.decode(stored)
    paths: list[str] = []
    for field in fields:
        value: JsonValue = None
        if stored is not None and message is not None:
            value = view.extractor.exact_at(message, stored.type, field)
        parts: list[str] = []
        if isinstance(value, dict) and not isinstance(value, Summary):
            leaves = leaves_by_path(value, field)
            parts = [path for path, leaf in leaves if not isinstance(leaf, str | bool)]
        paths += parts or [field]
    return tuple(dict.fromkeys(paths))


def _cells_of_fields(
    view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]
) -> list[tuple[list[_FieldCell | None], _FieldCell | None]]:
    """Returns the cells of each field: one for every bin, and one for the whole window."""
    collected = PieceNumbers(view, topic, fields, binned.bins.edges[1:-1])
    collected.collect(binned.counted)
    binned.count_since(collected.since)
    if collected.failures:
        reason = to_report(collected.failures).reason
        view.notes.add_lack(f"messages left out, since they cannot be decoded: {reason}")
    pieces_of_bins = [np.flatnonzero(member).tolist() for member in binned.bins.member.T]
    all_pieces = range(len(binned.bins.member))
    return [
        (
            [_cell(collected, field, pieces) for pieces in pieces_of_bins],
            _cell(collected, field, all_pieces),
        )
        for field in range(len(fields))
    ]


def _cell(collected: PieceNumbers, field: int, pieces: Sequence[int]) -> _FieldCell | None:
    """Returns the numbers of a field in pieces together; None if there are none."""
    parts = [part for piece in pieces for part in collected.parts(field, piece)]
    least = collected.extreme(field, pieces, LEAST)
    greatest = collected.extreme(field, pieces, GREATEST)
    if least is None or greatest is None:
        return None
    (least_number, least_at), (greatest_number, greatest_at) = least, greatest
    total = math.fsum(part.total for part in parts)
    mean = float(f"{total / sum(part.size for part in parts) / SUM_SCALE:.{_MEAN_DIGITS}g}")
    # A sum of rounded numbers may put the mean beside the exact extremes.
    mean = min(max(mean, least_number), greatest_number)
    largest = max(abs(least_number), abs(greatest_number))
    first = collected.number_at(field, min(part.first for part in parts))
    last = collected.number_at(field, max(part.last for part in parts))

    def shown(number: float) -> float:
        # Plus 0 makes -0.0 positive, which replies show as 0.
        return rounded_beside(number, largest) + 0

    return _FieldCell(
        None if first is None else shown(first),
        None if last is None else shown(last),
        shown(least_number),
        least_at,
        shown(greatest_number),
        greatest_at,
        shown(mean),
    )

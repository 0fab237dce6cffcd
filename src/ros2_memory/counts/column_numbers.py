"""The numbers of fields of a topic in pieces of a window, by its columns.

Newest first, so that what is counted when the time is over is all that is newer than a moment.
Stored numbers may be off by the error of their column: what they add up to is too, and where the
least and the greatest lie is settled in the bags that may hold them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.numbers import extent, numbers
from ros2_memory.columns.stored import StoredTable
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.counts.field_numbers import FieldReader
from ros2_memory.history.context import READING_S
from ros2_memory.history.scan import decoded_rows, messages_of, scan

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.columns.numbers import FieldNumbers
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.errors import UndecodableError
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray

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
        total: their sum.
        least: the least of them.
        greatest: the greatest, as the least one of their negatives.
    """

    first: Ns
    last: Ns
    size: int
    total: float
    least: Extreme
    greatest: Extreme


class PieceNumbers:
    """Collects the numbers of some fields of a topic in pieces of a window.

    Args:
        view: the call's.
        topic: its name.
        fields: dot-paths.
        edges: where pieces begin (ns), ascending; what is before the first is piece 0.
        most_read: messages that may be read from bags where columns do not hold a field.
        only_extremes: whether nothing else is wanted: then `Part.size` and `Part.total` say
            nothing, and most columns need not be read.

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
        only_extremes: bool = False,
    ) -> None:
        self.since: Ns | None = None
        self._view = view
        self._topic = topic
        self._fields = tuple(fields)
        self._edges = edges
        self._most_read = most_read
        self._only_extremes = only_extremes
        self._read = 0
        self._reader = FieldReader(view, fields)
        self._reading = view.call.partial_after(READING_S)
        self._left: Ns = MAX_NS
        self._waiting: list[Rows] = []
        self._parts: defaultdict[tuple[int, int], list[Part]] = defaultdict(list)
        self._settled: dict[tuple[int, int, Extreme], Extreme] = {}

    @property
    def failures(self) -> Sequence[UndecodableError]:
        """Why messages that were read cannot be decoded."""
        return self._reader.failures

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
        found = [
            (part.least if sign == LEAST else part.greatest, piece)
            for piece in pieces
            for part in self.parts(field, piece)
        ]
        best = (math.inf, MAX_NS)
        for extreme, piece in sorted(found):
            if extreme.low > best[0]:
                break
            if extreme.low == best[0] and extreme.first >= best[1]:
                continue
            settled = self._settle(field, piece, sign, extreme)
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

    def _add(self, rows: Rows, since: Ns) -> None:
        """Adds the numbers of a table from a log time on."""
        pieces = [*self._pieces(rows, since)]
        if self._only_extremes and self._add_extents(rows, pieces):
            return
        extractor = self._view.memory.extractor
        found = [numbers(rows.table, field, extractor) for field in self._fields]
        held = [some for some in found if some is not None]
        if len(held) < len(found):
            if isinstance(rows.table, StoredTable):
                for decoded in decoded_rows(self._view, rows):
                    self._add(decoded, since)
            else:
                self._add_read(rows, since)
            return
        for field, some in enumerate(held):
            whole = _of_rows(some, rows)
            for piece, start, stop in pieces:
                begin, end = np.searchsorted(whole.rows, [start, stop]).tolist()
                if begin < end:
                    part = _part(rows, whole, (start, stop), (begin, end))
                    self._parts[field, piece].append(part)

    def _add_extents(self, rows: Rows, pieces: Sequence[tuple[int, int, int]]) -> bool:
        """Adds the least and the greatest number of a whole table, if no column must be read."""
        if rows.index is not None or [piece[1:] for piece in pieces] != [(0, len(rows))]:
            return False
        extractor = self._view.memory.extractor
        found = [extent(rows.table, field, extractor) for field in self._fields]
        known = [some for some in found if some is not None]
        if len(known) < len(found):
            return False
        [(piece, _, _)] = pieces
        first, last = rows.span
        for field, (least, greatest) in enumerate(known):
            ends = [Extreme(number, number, first, last) for number in (least, -greatest)]
            self._parts[field, piece].append(Part(first, last, 1, math.nan, *ends))
        return True

    def _pieces(self, rows: Rows, since: Ns) -> Iterator[tuple[int, int, int]]:
        """Yields the number of each piece of some rows, with its first row and the one after it."""
        first, last = rows.span
        begin, end = (bisect_right(self._edges, at) for at in (first, last))
        if begin == end and since <= first:
            yield begin, 0, len(rows)
            return
        times = rows.times
        least = int(np.searchsorted(times, since))
        bounds = np.searchsorted(times, self._edges[begin:end]).tolist()
        starts, stops = [0, *bounds], [*bounds, times.size]
        for piece, (start, stop) in enumerate(zip(starts, stops, strict=True), begin):
            if max(start, least) < stop:
                yield piece, max(start, least), stop

    def _add_read(self, rows: Rows, since: Ns) -> None:
        """Does as `_add`, by the messages: columns do not hold all fields."""
        self._read += len(rows)
        if self._most_read is not None and self._read > self._most_read:
            raise TooManyError
        edges = self._edges.tolist()
        by_piece = defaultdict(list)
        for found in messages_of(self._view, rows):
            if found.time >= since:
                by_piece[bisect_right(edges, found.time)].append(found)
        for piece, messages in by_piece.items():
            known, _ = self._reader.numbers(messages)
            for field, of_field in enumerate(known or ()):
                if of_field.low_at is None or of_field.high_at is None:
                    continue
                low, high = of_field.low, -of_field.high
                times = [found.time for found in messages]
                part = Part(
                    min(times),
                    max(times),
                    of_field.size,
                    of_field.total,
                    Extreme(low, low, of_field.low_at, of_field.low_at),
                    Extreme(high, high, of_field.high_at, of_field.high_at),
                )
                self._parts[field, piece].append(part)

    def _settle(self, field: int, piece: int, sign: int, extreme: Extreme) -> Extreme:
        """Returns an extreme as the bags have it."""
        if extreme.is_settled:
            return extreme
        key = (field * 2 + (sign > 0), piece, extreme)
        if key not in self._settled:
            try:
                found = self._read_extreme(field, sign, extreme)
            except QueryTimeoutError:
                found = None
                self._view.notes.add(
                    "out of time before bags were read for the exact least and greatest numbers: "
                    f"those of {self._fields[field]} may be off in their last digits"
                )
            number, first = extreme.middle, extreme.first
            self._settled[key] = found or Extreme(number, number, first, first)
        return self._settled[key]

    def _read_extreme(self, field: int, sign: int, extreme: Extreme) -> Extreme | None:
        """Returns an extreme by the bags that may hold it; None where these cannot be read."""
        extractor, path = self._view.memory.extractor, self._fields[field]
        best = (math.inf, MAX_NS)
        waiting: list[tuple[Ns, int, Rows]] = []
        for rows in scan(self._view, self._topic, TimeWindow(extreme.first, extreme.last + 1)):
            known = numbers(rows.table, path, extractor)
            if known is not None and (not known.error or known.exactly is not None):
                best = min(best, _first_furthest(rows, _of_rows(known, rows), sign))
                continue
            for some in _by_bag(rows, _candidates(rows, known, sign, extreme)):
                waiting.append((int(some.times[0]), len(waiting), some))
        for first, _, rows in sorted(waiting, key=lambda each: each[:2]):
            if best[0] <= extreme.low and best[1] <= first:
                break
            if self._reading.expired():
                raise QueryTimeoutError("the rest is left out")
            for decoded in decoded_rows(self._view, rows):
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
        least=None,
        greatest=None,
    )


def _part(rows: Rows, found: FieldNumbers, some: tuple[int, int], among: tuple[int, int]) -> Part:
    """Returns the numbers at some positions, which are of some of the rows."""
    start, stop = some
    is_whole = stop - start == len(rows)
    first, last = rows.span if is_whole else (int(rows.times[start]), int(rows.times[stop - 1]))
    begin, end = among
    if not is_whole:
        found = found._replace(least=None, greatest=None)
    return Part(
        first,
        last,
        end - begin,
        float(found.numbers[begin:end].sum(dtype=np.float64)),
        _extreme(rows, found, among, LEAST, (first, last)),
        _extreme(rows, found, among, GREATEST, (first, last)),
    )


def _extreme(
    rows: Rows, found: FieldNumbers, among: tuple[int, int], sign: int, span: tuple[Ns, Ns]
) -> Extreme:
    begin, end = among
    if not found.error or found.exactly is not None:
        number, row = _furthest(found, np.arange(begin, end), sign)
        at = int(rows.times[row])
        return Extreme(number, number, at, at)
    known = found.least if sign == LEAST else found.greatest
    if known is not None:
        return Extreme(sign * known, sign * known, *span)
    signed = sign * found.numbers[begin:end]
    off = found.error if found.errors is None else found.errors[begin:end]
    return Extreme(float((signed - off).min()), float((signed + off).min()), *span)


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

"""Reads all messages of a batch at once, field after field, with numpy.

Each message has a position; every step reads one field (or run of fields) of all messages there and
moves the positions on. The reads of a step may go past the end of their message: what shows it is
that the position behind them does, since positions never go back. Then, and wherever rosbags would
or might refuse a message, nothing of the walk is used: `NotWalkedError` leaves the whole batch to
the decoder, which decides message by message.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from ros2_memory.columns.plan import Array, NumberSequence, Plan, Run, Sequence, Text, Time
from ros2_memory.columns.table import (
    MAX_NUMBERS,
    MAX_RANGED_BYTES,
    Column,
    Elements,
    Numbers,
    Texts,
)
from ros2_memory.core.arrays import gathered, in_ranges
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.storage.base import SEQUENCE, Batch, IntArray

_MANY: Final = 500
_FEW_ROWS: Final = 24
"""Of more than `_MANY` elements, in fewer rows on average, each is sooner decoded alone than nth by
nth."""
_MANY_ROWS: Final = 100
"""The rows of one text are found together where so many have it."""
MAX_COUNTED_BYTES: Final = 256 << 10
"""In a larger message the decoder counts strings and messages, and may refuse it."""
_HEADER_BYTES: Final = 4
_LITTLE_ENDIAN: Final = 0x0100
"""The first two bytes of the header of plain CDR in little endian, as a number in little endian."""
_MAX_PADDING: Final = 3
_UINT8: Final = np.dtype("u1")
_UINT16: Final = np.dtype("<u2")
_UINT32: Final = np.dtype("<u4")


class NotWalkedError(Exception):
    """A batch that must be decoded message by message."""


@dataclass(slots=True)
class LevelColumns:
    """The columns of messages, or of the elements of one sequence, while they are read."""

    columns: dict[str, Column] = field(default_factory=dict)
    elements: dict[str, Elements] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    def add_elements(self, path: str, counts: IntArray, inner: LevelColumns) -> None:
        """Adds a sequence, of which each row has so many elements."""
        owners = np.repeat(np.arange(counts.size), counts)
        self.elements[path] = Elements(owners, inner.columns, inner.elements)
        self.left_out |= {f"{path}.{below}": why for below, why in inner.left_out.items()}


def walked(plan: Plan, batch: Batch) -> LevelColumns:
    """Returns the columns of a batch.

    Raises:
        NotWalkedError: the messages must be decoded one by one.
    """
    sizes = batch.sizes
    if not sizes.size:
        raise NotWalkedError
    if sizes.min() < _HEADER_BYTES or (plan.has_objects and sizes.max() >= MAX_COUNTED_BYTES):
        raise NotWalkedError
    walk = _Walk(batch.buffer)
    try:
        if (gathered(batch.buffer, _UINT16, batch.starts) != _LITTLE_ENDIAN).any():
            raise NotWalkedError
        level = LevelColumns(left_out=dict(plan.left_out))
        rows = _Bodies(batch.starts + _HEADER_BYTES, sizes - _HEADER_BYTES)
        end = walk.read(plan, rows, np.zeros(sizes.size, np.int64), level)
    except (IndexError, UnicodeDecodeError) as error:
        raise NotWalkedError from error
    left = rows.sizes - end
    if left.min() < 0 or left.max() > _MAX_PADDING:
        raise NotWalkedError
    return level


class _Bodies(NamedTuple):
    """The bodies that are walked: where each message's begins in the buffer, and its bytes.

    Positions count from there, since alignment does.
    """

    origins: IntArray
    sizes: IntArray

    def of(self, rows: IntArray) -> _Bodies:
        return _Bodies(self.origins[rows], self.sizes[rows])


def _aligned(positions: IntArray, align: int, skip: int = 0) -> IntArray:
    if align > 1:
        positions = (positions + (align - 1)) & -align
    return positions + skip if skip else positions


@dataclass(slots=True)
class _Walk:
    buffer: bytes

    def read(self, plan: Plan, rows: _Bodies, at: IntArray, level: LevelColumns | None) -> IntArray:
        """Goes through messages that begin at these positions; returns where they end.

        Args:
            plan: of their type.
            rows: the messages that they lie in.
            at: where each begins.
            level: takes the columns; None to find out where they end.
        """
        for step in plan.steps:
            if isinstance(step, Run):
                at = _aligned(at, step.align)
                if level is not None and step.fields:
                    self._read_run(step, rows.origins + at, level)
                at = at + step.size
            elif isinstance(step, Text):
                at = self._read_text(step, rows, at, level)
            elif isinstance(step, NumberSequence):
                at = self._read_numbers(step, rows, at, level)
            else:
                at = self._read_sequence(step, rows, at, level)
        return at

    def _read_run(self, run: Run, places: IntArray, level: LevelColumns) -> None:
        columns = level.columns
        block = gathered(self.buffer, run.dtype, places)
        for nth, entry in enumerate(run.fields):
            if isinstance(entry, Array):
                values = block[str(nth)] if entry.is_ranged else None
                add_array(columns, entry, places.size, values)
                continue
            read = block[str(nth)]
            if isinstance(entry, Time):
                columns[entry.path] = read["f0"] * np.int64(NS_PER_S) + read["f1"]
            else:
                columns[entry.path] = read != 0 if entry.is_bool else np.ascontiguousarray(read)

    def _length(
        self, step: Text | NumberSequence | Sequence, rows: _Bodies, at: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Returns the lengths that a step begins with, and the positions behind them."""
        at = _aligned(at, step.align, step.skip)
        return gathered(self.buffer, _UINT32, rows.origins + at).astype(np.int64), at + 4

    def _read_text(
        self, text: Text, rows: _Bodies, at: IntArray, level: LevelColumns | None
    ) -> IntArray:
        sizes, at = self._length(text, rows, at)
        end = at + sizes
        # Zero behind each string, as rosbags demands.
        if (sizes < 1).any() or (end > rows.sizes).any():
            raise NotWalkedError
        if gathered(self.buffer, _UINT8, rows.origins + end - 1).any():
            raise NotWalkedError
        if level is not None:
            level.columns[text.path] = self._texts(rows.origins + at, sizes - 1)
        return end

    def _texts(self, places: IntArray, sizes: IntArray) -> Texts:
        buffer, codes, words = self.buffer, np.zeros(places.size, np.uint32), list[bytes]()
        left = np.arange(places.size)
        equal = left
        while left.size and equal.size >= _MANY_ROWS:
            begin, size = int(places[left[0]]), int(sizes[left[0]])
            word, is_equal = buffer[begin : begin + size], sizes[left] == size
            if size:
                alike = gathered(buffer, np.dtype(f"V{size}"), places[left[is_equal]])
                is_equal[is_equal] = alike == np.void(word)
            equal, left = left[is_equal], left[~is_equal]
            codes[equal] = len(words)
            words.append(word)
        code_of = {word: code for code, word in enumerate(words)}
        ends = (places + sizes)[left].tolist()
        codes[left] = [
            code_of.setdefault(buffer[begin:end], len(code_of))
            for begin, end in zip(places[left].tolist(), ends, strict=True)
        ]
        return Texts(codes, tuple([word.decode() for word in code_of]))

    def _read_numbers(
        self, step: NumberSequence, rows: _Bodies, at: IntArray, level: LevelColumns | None
    ) -> IntArray:
        counts, at = self._length(step, rows, at)
        # An empty sequence is not aligned to its elements.
        begin = np.where(counts > 0, _aligned(at, step.size), at) if step.size > 4 else at
        end = begin + counts * step.size
        if (end > rows.sizes).any():
            raise NotWalkedError
        if level is not None:
            values = self._values(step, rows.origins + begin, counts)
            add_sequence(level, step.path, counts, values, is_bool=step.is_bool)
        return end

    def _values(self, step: NumberSequence, places: IntArray, counts: IntArray) -> Numbers:
        """Returns the numbers of sequences, but of those that take too long to look at."""
        is_short = counts * step.size <= MAX_RANGED_BYTES
        if not is_short.all():
            places, counts = places[is_short], counts[is_short]
        if not counts.size:
            return np.zeros(0, step.dtype)
        count = int(counts[0])
        if count and (counts == count).all():
            data = gathered(self.buffer, np.dtype(f"V{count * step.size}"), places).tobytes()
            return np.frombuffer(data, step.dtype)
        return gathered(
            self.buffer, step.dtype, np.repeat(places, counts) + _within(counts) * step.size
        )

    def _read_sequence(
        self, step: Sequence, rows: _Bodies, at: IntArray, level: LevelColumns | None
    ) -> IntArray:
        if step.length == SEQUENCE:
            counts, at = self._length(step, rows, at)
        else:
            counts = np.full(at.size, step.length, np.int64)
        if (at + counts * max(step.plan.least, 1) > rows.sizes).any():
            raise NotWalkedError
        owners = np.repeat(np.arange(at.size), counts)
        if step.plan.ends:
            begins, end = _steady(step.plan, at, counts, owners)
        else:
            begins, end = self._stepped(step.plan, rows, at, counts)
        if (end > rows.sizes).any():
            raise NotWalkedError
        if level is not None:
            inner = LevelColumns()
            self.read(step.plan, rows.of(owners), begins, inner)
            level.add_elements(step.path, counts, inner)
        return end

    def _stepped(
        self, plan: Plan, rows: _Bodies, at: IntArray, counts: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Returns where elements of various sizes begin, and where their sequences end."""
        most, total = int(counts.max(initial=0)), int(counts.sum())
        if most > _MANY and total < _FEW_ROWS * most:
            raise NotWalkedError
        first, end = np.cumsum(counts) - counts, at.copy()
        begins = np.zeros(total, np.int64)
        for nth in range(most):
            left = np.flatnonzero(counts > nth)
            starts = _aligned(end[left], plan.align)
            begins[first[left] + nth] = starts
            end[left] = self.read(plan, rows.of(left), starts, None)
        return begins, end


def _steady(
    plan: Plan, at: IntArray, counts: IntArray, owners: IntArray
) -> tuple[IntArray, IntArray]:
    """Returns where elements of a fixed layout begin, and where their sequences end.

    The first begins anywhere; behind it all are equally far apart, since the last field of the
    strictest alignment puts whatever follows it at the same distance from a multiple.
    """
    unit, ends = plan.unit, np.array(plan.ends)
    first = _aligned(at, plan.align)
    rest = first % unit
    second = _aligned(first - rest + ends[rest], plan.align)
    steady = second % unit
    step = _aligned(ends[steady], plan.align) - steady
    nth = _within(counts)
    begins = np.where(nth == 0, first[owners], second[owners] + (nth - 1) * step[owners])
    last = np.where(counts > 1, second + (counts - 2) * step, first)
    end = last - last % unit + ends[last % unit]
    return begins, np.where(counts > 0, end, at)


def _within(counts: IntArray) -> IntArray:
    """Returns the numbers from 0 up to each count, exclusive, one after the other."""
    return in_ranges(np.zeros_like(counts), counts)


def entries_of_codes(entries: IntArray, codes: IntArray) -> tuple[IntArray, IntArray]:
    """Returns how many entries each of some codes has, and their positions, one after the other.

    Args:
        entries: the code of each entry, ascending.
        codes: may occur several times.
    """
    begins = np.searchsorted(entries, codes)
    counts = np.searchsorted(entries, codes, side="right") - begins
    return counts, in_ranges(begins, counts)


def add_sequence(
    level: LevelColumns, path: str, counts: IntArray, values: Numbers, *, is_bool: bool
) -> None:
    """Adds the lengths, the ranges and the short arrays of a sequence of numbers.

    Args:
        level: takes it.
        path: of the sequence.
        counts: the numbers of each row.
        values: those of the rows that take no more than `MAX_RANGED_BYTES`, in order.
        is_bool: whether they are booleans.
    """
    if is_bool:
        values = (values != 0).view(np.uint8)  # a byte that is neither 0 nor 1 is true
    is_ranged = counts * values.itemsize <= MAX_RANGED_BYTES
    add_ranges(level.columns, path, counts, np.where(is_ranged, counts, 0), values)
    is_short = counts <= MAX_NUMBERS
    is_held = np.repeat(is_short[is_ranged], counts[is_ranged])
    numbers = values if is_held.all() else values[is_held]
    owners = np.repeat(np.arange(counts.size), np.where(is_short, counts, 0))
    level.elements[path] = Elements(owners, {"": numbers.view(np.bool_) if is_bool else numbers})
    if not is_short.all():
        level.left_out[path] = f"more than {MAX_NUMBERS} numbers in some messages"


def add_array(columns: dict[str, Column], entry: Array, rows: int, values: Numbers | None) -> None:
    """Adds the columns of a fixed array: its length, and the range of its numbers, if given."""
    lengths = np.full(rows, entry.length)
    if values is None:
        columns[f"{entry.path}.length"] = lengths.astype(np.uint32)
        return
    values = values.reshape(-1)
    if entry.is_bool:
        values = (values != 0).view(np.uint8)
    add_ranges(columns, entry.path, lengths, lengths, values)


def add_ranges(
    columns: dict[str, Column], path: str, lengths: IntArray, counts: IntArray, values: Numbers
) -> None:
    """Adds the lengths of arrays, and the least and greatest finite number of each.

    Those are NaN where there is none; `counts` of the `values` are of each.
    """
    columns[f"{path}.length"] = lengths.astype(np.uint32)
    has_values = counts > 0
    begins = (np.cumsum(counts) - counts)[has_values]
    is_finite = np.isfinite(values)
    for end, ufunc, neutral in (("least", np.minimum, np.inf), ("greatest", np.maximum, -np.inf)):
        extremes = np.full(counts.size, np.nan)
        if values.size:
            comparable = values if is_finite.all() else np.where(is_finite, values, neutral)
            extremes[has_values] = ufunc.reduceat(comparable, begins)
            extremes[np.isinf(extremes)] = np.nan
        columns[f"{path}.{end}"] = extremes

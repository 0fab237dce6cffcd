"""Reads all messages of a batch at once, field after field, with numpy.

Each message has a position. A step reads one field, or a run of fields, of all messages at their
positions and moves these on. It may read past the end of a message; since positions never go back,
the position behind the field shows it. Then, and wherever rosbags might refuse a message,
`NotWalkedError` leaves the whole batch to the decoder, which decides message by message.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from ros2_memory.columns.plan import Array, NumberSequence, Plan, Run, Sequence, Text, Time
from ros2_memory.columns.table import (
    MAX_RANGED_BYTES,
    Column,
    Elements,
    Numbers,
    Texts,
)
from ros2_memory.core.arrays import gathered, places_within, range_numbers
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.storage.base import SEQUENCE, Batch, IntArray, Mask

_MANY: Final = 500
_FEW_ROWS: Final = 24
"""If sequences have more than `_MANY` elements, and on average fewer rows than this have an nth
one, the decoder is faster than a walk by nth elements."""
_MANY_ROWS: Final = 100
"""The rows that have the same text are found together if they are so many."""
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
    """The columns of messages, or of the elements of one sequence, while they are read.

    Attributes:
        columns: as of a `Table`.
        elements: as of a `Table`.
        left_out: as of a `Table`.
    """

    columns: dict[str, Column] = field(default_factory=dict)
    elements: dict[str, Elements] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    def add_elements(self, path: str, counts: IntArray, inner: LevelColumns) -> None:
        """Adds a sequence.

        Args:
            path: of the sequence.
            counts: how many elements each row has.
            inner: the columns of the elements.
        """
        self.elements[path] = Elements(range_numbers(counts), inner.columns, inner.elements)
        for inner_path, reason in inner.left_out.items():
            self.left_out[f"{path}.{inner_path}"] = reason


def read_columns(plan: Plan, batch: Batch) -> LevelColumns:
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
    padding = rows.sizes - end
    if padding.min() < 0 or padding.max() > _MAX_PADDING:
        raise NotWalkedError
    return level


class _Bodies(NamedTuple):
    """The payloads of messages behind their headers. Positions and alignment count from there.

    Attributes:
        origins: where each begins in the buffer.
        sizes: how many bytes each has.
    """

    origins: IntArray
    sizes: IntArray

    def rows(self, positions: IntArray) -> _Bodies:
        return _Bodies(self.origins[positions], self.sizes[positions])


def _aligned(positions: IntArray, align: int, skip: int = 0) -> IntArray:
    """Returns positions moved up to multiples of `align`, then on by `skip` bytes."""
    if align > 1:
        positions = (positions + (align - 1)) & -align
    return positions + skip if skip else positions


@dataclass(slots=True)
class _Walk:
    buffer: bytes

    def read(self, plan: Plan, rows: _Bodies, at: IntArray, level: LevelColumns | None) -> IntArray:
        """Reads messages, or elements of a sequence; returns where they end.

        Args:
            plan: of their type.
            rows: the message that each lies in.
            at: where each begins.
            level: gets the columns; None if only the ends are needed.
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
                add_array(columns, entry, places.size, block[str(nth)] if entry.is_ranged else None)
                continue
            values = block[str(nth)]
            if isinstance(entry, Time):
                columns[entry.path] = values["f0"] * np.int64(NS_PER_S) + values["f1"]
            elif entry.is_bool:
                columns[entry.path] = values != 0
            else:
                columns[entry.path] = np.ascontiguousarray(values)

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
        """Returns the strings at some places of the buffer.

        As long as the text of the first row is that of many rows, numpy finds them all; then the
        rows that are left are looked up one by one.
        """
        codes = np.zeros(places.size, np.uint32)
        code_of: dict[bytes, int] = {}
        left = np.arange(places.size)
        is_frequent = left.size >= _MANY_ROWS
        while left.size and is_frequent:
            word, is_equal = self._rows_like_first(places[left], sizes[left])
            equal, left = left[is_equal], left[~is_equal]
            codes[equal] = len(code_of)
            code_of[word] = len(code_of)
            is_frequent = equal.size >= _MANY_ROWS
        ends = (places + sizes)[left].tolist()
        codes[left] = [
            code_of.setdefault(self.buffer[begin:end], len(code_of))
            for begin, end in zip(places[left].tolist(), ends, strict=True)
        ]
        return Texts(codes, tuple([word.decode() for word in code_of]))

    def _rows_like_first(self, places: IntArray, sizes: IntArray) -> tuple[bytes, Mask]:
        """Returns the first string, and which strings are equal to it."""
        begin, size = int(places[0]), int(sizes[0])
        word, is_equal = self.buffer[begin : begin + size], sizes == size
        if size:
            same_size = gathered(self.buffer, np.dtype(f"V{size}"), places[is_equal])
            is_equal[is_equal] = same_size == np.void(word)
        return word, is_equal

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
            add_sequence(level, step, counts, values)
        return end

    def _values(self, step: NumberSequence, places: IntArray, counts: IntArray) -> Numbers:
        """Returns the numbers of all sequences of at most `MAX_RANGED_BYTES`."""
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
            self.buffer, step.dtype, np.repeat(places, counts) + places_within(counts) * step.size
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
        owners = range_numbers(counts)
        if step.plan.size is None:
            begins, end = self._locate_variable(step.plan, rows, at, counts)
        else:
            begins, end = _locate_fixed(step.plan.align, step.plan.size, at, counts)
        if (end > rows.sizes).any():
            raise NotWalkedError
        if level is not None:
            inner = LevelColumns()
            self.read(step.plan, rows.rows(owners), begins, inner)
            level.add_elements(step.path, counts, inner)
        return end

    def _locate_variable(
        self, plan: Plan, rows: _Bodies, at: IntArray, counts: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Returns where elements of various sizes begin, and where their sequences end.

        The first elements of all sequences are read together, then the second ones, and so on.
        """
        most, total = int(counts.max(initial=0)), int(counts.sum())
        if most > _MANY and total < _FEW_ROWS * most:
            raise NotWalkedError
        first, end = np.cumsum(counts) - counts, at.copy()
        begins = np.zeros(total, np.int64)
        for nth in range(most):
            left = np.flatnonzero(counts > nth)
            starts = _aligned(end[left], plan.align)
            begins[first[left] + nth] = starts
            end[left] = self.read(plan, rows.rows(left), starts, None)
        return begins, end


def _locate_fixed(
    align: int, size: int, at: IntArray, counts: IntArray
) -> tuple[IntArray, IntArray]:
    """Returns where elements of one size begin, and where their sequences end."""
    first, distance = _aligned(at, align), size + -size % align
    begins = np.repeat(first, counts) + places_within(counts) * distance
    return begins, np.where(counts > 0, first + (counts - 1) * distance + size, at)


def add_sequence(
    level: LevelColumns, step: NumberSequence, counts: IntArray, values: Numbers
) -> None:
    """Adds the columns of a sequence of numbers: lengths, ranges and short arrays.

    Args:
        level: gets the columns.
        step: of the sequence.
        counts: how many numbers each row has.
        values: the numbers of the rows that take at most `MAX_RANGED_BYTES`, in order.
    """
    path, is_bool = step.path, step.is_bool
    if is_bool:
        values = (values != 0).view(np.uint8)  # a byte that is neither 0 nor 1 is true
    is_ranged = counts * values.itemsize <= MAX_RANGED_BYTES
    add_ranges(level.columns, path, counts, np.where(is_ranged, counts, 0), values)
    is_short = counts <= step.most
    is_of_short = np.repeat(is_short[is_ranged], counts[is_ranged])
    numbers = values if is_of_short.all() else values[is_of_short]
    owners = range_numbers(np.where(is_short, counts, 0))
    level.elements[path] = Elements(owners, {"": numbers.view(np.bool_) if is_bool else numbers})
    if not is_short.all():
        level.left_out[path] = f"more than {step.most} numbers in some messages"


def add_array(columns: dict[str, Column], entry: Array, rows: int, values: Numbers | None) -> None:
    """Adds the columns of a fixed array: its length, and its range if `values` are given."""
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
    """Adds the lengths of arrays, and the least and greatest finite number of each, or NaN.

    Args:
        columns: gets the columns.
        path: of the arrays.
        lengths: of the arrays.
        counts: how many of `values` each array has; 0 if it is too long to be looked at.
        values: the numbers, array after array.
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

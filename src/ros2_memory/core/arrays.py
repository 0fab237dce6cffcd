"""Rows of arrays, and groups of them."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Sequence

    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
Scalar = TypeVar("Scalar", bound="np.generic[object]")
Word = TypeVar("Word", bound="Hashable")
Ints: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]
Which: TypeAlias = "Ints | Flags | slice[None, None, None]"

Codes: TypeAlias = "Ints | NDArray[np.uint32] | NDArray[np.uint16]"

Floats: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.float64]]"
Vectors: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.float64]]"

_MOST_KEYS: Final = 2**62
_KEYS_OF_ROW: Final = 8
"""Of no more possible rows for each that there is, looking them up is quicker than sorting."""
_EVERY_BYTE: Final = (1,)


def gathered(
    buffer: bytes, dtype: np.dtype[Scalar], places: Ints
) -> np.ndarray[tuple[int], np.dtype[Scalar]]:
    """Returns what lies at some places of a buffer, aligned or not.

    Raises:
        IndexError: something ends behind the buffer.
    """
    # An element at every byte. As bytes: field by field a structure takes ten times as long.
    count = max(len(buffer) - dtype.itemsize + 1, 0)
    elements = np.ndarray(count, f"V{dtype.itemsize}", buffer, 0, _EVERY_BYTE)
    return elements[places].view(dtype)


def row_sums(rows: NDArray[np.float64]) -> Floats:
    """Returns the sum of each row, added from left to right.

    Of rows of two to four numbers; `sum(axis=1)` takes six times as long for these.
    """
    sums: Floats = rows[:, 0].copy()
    for column in rows.T[1:]:
        sums += column
    return sums


def row_maxima(rows: NDArray[np.float64]) -> Floats:
    """Returns the greatest number of each row of a few; NaN where it has one."""
    greatest: Floats = rows[:, 0].copy()
    for column in rows.T[1:]:
        np.maximum(greatest, column, out=greatest)
    return greatest


def in_ranges(starts: Ints, sizes: Ints) -> Ints:
    """Returns the numbers of ranges, one range after another."""
    before = np.cumsum(sizes) - sizes
    numbers: Ints = np.arange(int(sizes.sum())) + np.repeat(starts - before, sizes)
    return numbers


def places_among(numbers: Ints, some: Ints) -> tuple[Ints, Flags]:
    """Returns where each number lies among some, which ascend, and whether it is one of them."""
    place = np.searchsorted(some, numbers)
    if not some.size:
        return place, np.zeros(place.shape, np.bool_)
    # What lies behind all of them is not the last, either.
    return place, some.take(place, mode="clip") == numbers


def begins_of(group: Ints, groups: int) -> Ints:
    """Returns where each of so many groups begins in rows that are in their order, and the end."""
    begins = np.zeros(groups + 1, np.int64)
    np.cumsum(np.bincount(group, minlength=groups), out=begins[1:])
    return begins


def rows_by(group: Ints, groups: int) -> list[Ints]:
    """Returns the rows of each of so many groups, in their order."""
    return np.split(np.argsort(group, kind="stable"), begins_of(group, groups)[1:])[:-1]


def run_starts(numbers: Ints) -> Ints:
    """Returns where each run of equal numbers begins."""
    return np.flatnonzero(np.diff(numbers, prepend=numbers[:1] - 1))


def rows_of(table: T, which: Ints | NDArray[np.bool_] | slice[int | None, int | None]) -> T:
    """Returns some rows of a table, which is a dataclass with a column in each field."""
    names = [column.name for column in fields(table)]
    return replace(table, **{name: getattr(table, name)[which] for name in names})


def stacked(tables: Sequence[T]) -> T:
    """Returns the rows of such tables, of which there is one at least, one after the other."""
    if len(tables) == 1:
        return tables[0]
    first, *_ = tables
    names = [column.name for column in fields(first)]
    columns = {name: np.concatenate([getattr(table, name) for table in tables]) for name in names}
    return replace(first, **columns)


def numbered(values: Iterable[Word]) -> tuple[tuple[Word, ...], Ints]:
    """Returns the different values, in the order of their first, and which of them each one is."""
    code_of: dict[Word, int] = {}
    codes = [code_of.setdefault(value, len(code_of)) for value in values]
    return tuple(code_of), np.array(codes, np.int64)


def joined_codes(parts: Iterable[tuple[Codes, Sequence[Word]]]) -> tuple[Ints, tuple[Word, ...]]:
    """Returns codes one after the other, by one list of words in place of one for each part."""
    code_of: dict[Word, int] = {}
    codes = [np.empty(0, np.int64)]
    recoded: dict[tuple[Word, ...], Ints] = {}  # many parts have the same words
    for old, words in parts:
        listed = tuple(words)
        if listed not in recoded:
            new = [code_of.setdefault(word, len(code_of)) for word in listed]
            recoded[listed] = np.array(new, np.int64)
        codes.append(recoded[listed][old])
    return np.concatenate(codes), tuple(code_of)


def merged_times(parts: Sequence[Ints]) -> tuple[Ints, Ints, list[Ints]]:
    """Returns the times (ns) of several parts in one order.

    Besides their order among the parts behind each other, and for each part the places of its
    times in that order. Of equal times those of an earlier part come first.
    """
    times = np.concatenate(parts)
    order = np.argsort(times, kind="stable")
    places = np.empty(order.size, np.int64)
    places[order] = np.arange(order.size)
    return times[order], order, np.split(places, np.cumsum([part.size for part in parts])[:-1])


def distinct_rows(columns: Sequence[Ints]) -> tuple[Ints, Ints]:
    """Returns the distinct rows of some columns in order, and the number of each row among them."""
    lows = [int(column.min(initial=0)) for column in columns]
    sizes = [
        int(column.max(initial=0)) - low + 1 for column, low in zip(columns, lows, strict=True)
    ]
    most = math.prod(sizes)
    if most >= _MOST_KEYS:
        rows, number = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)
        return rows, number.reshape(-1)
    # One number for each row, in the order of the rows: sorting rows takes ten times as long.
    keys = np.zeros(len(columns[0]), np.int64)
    for column, low, size in zip(columns, lows, sizes, strict=True):
        keys = keys * size + (column.astype(np.int64) - low)
    if most <= _KEYS_OF_ROW * len(keys):
        is_there = np.zeros(most, np.bool_)
        is_there[keys] = True
        distinct, number = np.flatnonzero(is_there), np.cumsum(is_there)[keys] - 1
    else:
        distinct, number = np.unique(keys, return_inverse=True)
    return np.stack(np.unravel_index(distinct, sizes), axis=1) + np.array(lows), number


def narrowed(column: Ints) -> Ints:
    """Returns integers in as few bytes each as they need."""
    low, high = int(column.min(initial=0)), int(column.max(initial=0))
    kinds = (np.uint8, np.int8, np.uint16, np.int16, np.int32, np.int64)
    kind = next(kind for kind in kinds if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max)
    return column.astype(kind, copy=False)


class Columns:
    """A table of integers, which is read like an array of rows, in as few bytes as they need.

    Args:
        columns: what it consists of.
    """

    def __init__(self, columns: Iterable[Ints]) -> None:
        self.columns = [*map(narrowed, columns)]
        self.nbytes = sum(column.nbytes for column in self.columns)

    def __len__(self) -> int:
        return len(self.columns[0])

    def __getitem__(self, at: Which | tuple[Which, int]) -> Ints:
        """Returns some rows, or these of one column."""
        if isinstance(at, tuple):
            return self.columns[at[1]][at[0]].astype(np.int64)
        return np.stack([column[at] for column in self.columns], axis=1, dtype=np.int64)


class Groups(NamedTuple):
    """Rows by their group, numbered from 0 without a gap.

    Attributes:
        order: the rows by group, those of one in their order.
        begins: where each group begins in it.
        sizes: how many rows each has.
    """

    order: Ints
    begins: Ints
    sizes: Ints

    @classmethod
    def of(cls, group: Ints) -> Groups:
        """Returns the groups of rows."""
        sizes = np.bincount(group).astype(np.int64)
        return cls(np.argsort(group, kind="stable"), np.cumsum(sizes) - sizes, sizes)

    @property
    def firsts(self) -> Ints:
        """The first row of each group."""
        return self.order[self.begins]

    def sums(self, values: Ints) -> Ints:
        """Returns the sum of each group."""
        return np.add.reduceat(values[self.order], self.begins) if len(values) else values

    def ends(self, values: Ints) -> tuple[Ints, Ints]:
        """Returns the least and the greatest of each group."""
        ordered = values[self.order]
        if not len(values):
            return ordered, ordered
        return np.minimum.reduceat(ordered, self.begins), np.maximum.reduceat(ordered, self.begins)

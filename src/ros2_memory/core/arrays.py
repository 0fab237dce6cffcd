"""Arrays of rows: sums, ranges, look-ups, groups, and columns in few bytes."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Sequence

    from _typeshed import DataclassInstance

    from ros2_memory.core.timebase import Span

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
"""If there are no more possible rows for each row, a table of them is quicker than sorting."""
_EVERY_BYTE: Final = (1,)


def gathered(
    buffer: bytes, dtype: np.dtype[Scalar], places: Ints
) -> np.ndarray[tuple[int], np.dtype[Scalar]]:
    """Returns the elements that begin at some bytes of a buffer, aligned or not.

    Raises:
        IndexError: an element ends behind the buffer.
    """
    # An element at every byte. As bytes: field by field a structure takes ten times as long.
    count = max(len(buffer) - dtype.itemsize + 1, 0)
    elements = np.ndarray(count, f"V{dtype.itemsize}", buffer, 0, _EVERY_BYTE)
    return elements[places].view(dtype)


def concatenated(parts: Iterable[Ints]) -> Ints:
    """Returns arrays of integers one after the other; an empty one if there are none."""
    return np.concatenate([np.empty(0, np.int64), *parts])


def row_sums(rows: NDArray[np.float64]) -> Floats:
    """Returns the sum of each row, added from left to right.

    For rows of two to four numbers, where `sum(axis=1)` takes six times as long.
    """
    sums: Floats = rows[:, 0].copy()
    for column in rows.T[1:]:
        sums += column
    return sums


def row_maxima(rows: NDArray[np.float64]) -> Floats:
    """Returns the greatest number of each row, NaN if it has one; for rows of a few numbers."""
    greatest: Floats = rows[:, 0].copy()
    for column in rows.T[1:]:
        np.maximum(greatest, column, out=greatest)
    return greatest


def in_ranges(starts: Ints, sizes: Ints) -> Ints:
    """Returns the numbers of all ranges, joined: starts 3, 8 and sizes 2, 1 give 3, 4, 8."""
    before = np.cumsum(sizes) - sizes
    numbers: Ints = np.arange(int(sizes.sum())) + np.repeat(starts - before, sizes)
    return numbers


def places_within(counts: Ints) -> Ints:
    """Returns the numbers from 0 up to each count, exclusive, one after the other."""
    return in_ranges(np.zeros_like(counts), counts)


def entries_of_codes(entries: Ints, codes: Ints) -> tuple[Ints, Ints]:
    """Returns how many entries have each code, and the positions of these entries.

    Args:
        entries: the code of each entry, ascending.
        codes: the codes to look for; one may occur several times.
    """
    begins = np.searchsorted(entries, codes)
    counts = np.searchsorted(entries, codes, side="right") - begins
    return counts, in_ranges(begins, counts)


def stable_order(values: ArrayLike) -> Ints:
    """Returns the order that sorts values; equal values stay as they come."""
    return np.argsort(values, kind="stable")


def bounds_of(spans: Iterable[Span]) -> Ints:
    """Returns the starts and the stops of spans: two rows."""
    return np.array([*spans], np.int64).reshape(-1, 2).T


def range_numbers(sizes: Ints | Sequence[int]) -> Ints:
    """Returns the number of its range for each number of `in_ranges`: sizes 2, 1 give 0, 0, 1."""
    return np.repeat(np.arange(len(sizes)), sizes)


def places_among(numbers: Ints, ascending: Ints) -> tuple[Ints, Flags]:
    """Looks up numbers in an ascending array; returns their positions, and which are in it.

    The position of a number that is not in it is where it would be inserted.
    """
    places = np.searchsorted(ascending, numbers)
    if not ascending.size:
        return places, np.zeros(places.shape, np.bool_)
    # Clipped: a number greater than all is compared with the last one, and differs from it.
    return places, ascending.take(places, mode="clip") == numbers


def begins_of(group: Ints, groups: int) -> Ints:
    """Returns where each group begins in rows that are sorted by group, and the end.

    `group` has the group of each row: a number from 0 up to `groups`, exclusive.
    """
    begins = np.zeros(groups + 1, np.int64)
    np.cumsum(np.bincount(group, minlength=groups), out=begins[1:])
    return begins


def rows_by(group: Ints, groups: int) -> list[Ints]:
    """Returns the rows of each group, ascending; the arguments are those of `begins_of`."""
    return np.split(stable_order(group), begins_of(group, groups)[1:])[:-1]


def run_starts(*columns: Ints | Flags) -> Ints:
    """Returns where each run of equal rows begins; the columns are of one length."""
    is_other = np.zeros(len(columns[0]), np.bool_)
    is_other[:1] = True
    for column in columns:
        is_other[1:] |= column[1:] != column[:-1]
    return np.flatnonzero(is_other)


def distinct(values: Ints) -> Ints:
    """Returns the distinct values in order.

    If most values differ and are in order, `numpy.unique` takes fifty times as long.
    """
    ordered = np.sort(values, kind="stable")
    return ordered[run_starts(ordered)]


def runs_where(marks: Flags, *columns: Ints) -> Ints:
    """Returns where each run of equal rows that are marked begins and stops: rows of two."""
    starts = run_starts(marks, *columns)
    runs: Ints = np.stack((starts, np.append(starts, marks.size)[1:]), axis=1)
    return runs[marks[starts]]


def rows_of(table: T, which: Ints | NDArray[np.bool_] | slice[int | None, int | None]) -> T:
    """Returns the selected rows of a table: a dataclass with a column in each field."""
    names = [column.name for column in fields(table)]
    return replace(table, **{name: getattr(table, name)[which] for name in names})


def stacked(tables: Sequence[T]) -> T:
    """Returns one table with the rows of all tables, one after the other; there is at least one."""
    if len(tables) == 1:
        return tables[0]
    first, *_ = tables
    names = [column.name for column in fields(first)]
    columns = {name: np.concatenate([getattr(table, name) for table in tables]) for name in names}
    return replace(first, **columns)


def numbered(values: Iterable[Word]) -> tuple[tuple[Word, ...], Ints]:
    """Returns the distinct values, in order of first appearance, and the index of each value."""
    code_of: dict[Word, int] = {}
    codes = [code_of.setdefault(value, len(code_of)) for value in values]
    return tuple(code_of), np.array(codes, np.int64)


def renumbered(codes: Codes, count: int) -> tuple[Ints, Ints]:
    """Returns which codes below a count occur, in order of first appearance, and each one's index.

    The same as `numbered`, several times as fast where most of the codes may occur.
    """
    if count > _KEYS_OF_ROW * codes.size:
        occurring, indexes = numbered(codes.tolist())
        return np.array(occurring, np.int64), indexes
    first = np.full(count, codes.size)
    first[codes[::-1]] = np.arange(codes.size)[::-1]  # of equal codes the last assignment stays
    used = np.argsort(first, kind="stable")[: np.count_nonzero(first < codes.size)]
    index_of = np.empty(count, np.int64)
    index_of[used] = np.arange(used.size)
    return used, index_of[codes]


def joined_codes(parts: Iterable[tuple[Codes, Sequence[Word]]]) -> tuple[Ints, tuple[Word, ...]]:
    """Joins columns of codes, each with a list of the words it means, into one with one list."""
    code_of: dict[Word, int] = {}
    codes = [np.empty(0, np.int64)]
    recoded: dict[tuple[Word, ...], Ints] = {}  # many parts have the same words
    for old, words in parts:
        part_words = tuple(words)
        if part_words not in recoded:
            new = [code_of.setdefault(word, len(code_of)) for word in part_words]
            recoded[part_words] = np.array(new, np.int64)
        codes.append(recoded[part_words][old])
    return np.concatenate(codes), tuple(code_of)


def sorted_codes(codes: Codes, words: Sequence[str]) -> tuple[Ints, tuple[str, ...]]:
    """Returns the words that rows have, each once and in order, and the code of each row's."""
    used, nth_used = np.unique(codes, return_inverse=True)
    used_words = [words[code] for code in used.tolist()]
    ordered = sorted({*used_words})
    code_of = {word: code for code, word in enumerate(ordered)}
    return np.array([code_of[word] for word in used_words], np.int64)[nth_used], tuple(ordered)


def merged_times(parts: Sequence[Ints]) -> tuple[Ints, Ints, list[Ints]]:
    """Merges the times (ns) of several parts; equal times stay in the order of the parts.

    Returns:
        The merged times; for each of them its index in the joined parts; and for each part the
        indices of its times in the merged ones.
    """
    times = np.concatenate(parts)
    order = stable_order(times)
    places = np.empty(order.size, np.int64)
    places[order] = np.arange(order.size)
    return times[order], order, np.split(places, np.cumsum([part.size for part in parts])[:-1])


def distinct_rows(columns: Sequence[Codes]) -> tuple[Ints, Ints]:
    """Returns the distinct rows of a table in ascending order, and the index of each row's."""
    lows = [int(column.min(initial=0)) for column in columns]
    sizes = [
        int(column.max(initial=0)) - low + 1 for column, low in zip(columns, lows, strict=True)
    ]
    possible = math.prod(sizes)
    if possible >= _MOST_KEYS:
        rows, index = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)
        return rows, index.reshape(-1)
    # One number for each row, in the order of the rows: sorting rows takes ten times as long.
    keys = np.zeros(len(columns[0]), np.int64)
    for column, low, size in zip(columns, lows, sizes, strict=True):
        keys = keys * size + (column.astype(np.int64) - low)
    if possible <= _KEYS_OF_ROW * len(keys):
        is_there = np.zeros(possible, np.bool_)
        is_there[keys] = True
        distinct, index = np.flatnonzero(is_there), np.cumsum(is_there)[keys] - 1
    else:
        distinct, index = np.unique(keys, return_inverse=True)
    return np.stack(np.unravel_index(distinct, sizes), axis=1) + np.array(lows), index


def pair_counts(first: Ints, other: Ints) -> Ints:
    """Returns the distinct pairs, and how often each occurs, as rows of three."""
    rows, nth = distinct_rows((first, other))
    return np.column_stack((rows, np.bincount(nth, minlength=len(rows))))


def narrowed(column: Ints) -> Ints:
    """Returns a column in the smallest type of integers that holds it."""
    low, high = int(column.min(initial=0)), int(column.max(initial=0))
    kinds = (np.uint8, np.int8, np.uint16, np.int16, np.int32, np.int64)
    kind = next(kind for kind in kinds if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max)
    return column.astype(kind, copy=False)


class Columns:
    """A table of integers, indexed like an array of rows, stored column by column in few bytes."""

    def __init__(self, columns: Iterable[Ints]) -> None:
        self.columns = [*map(narrowed, columns)]
        self.nbytes = sum(column.nbytes for column in self.columns)

    def __len__(self) -> int:
        return len(self.columns[0])

    def __getitem__(self, at: Which | tuple[Which, int]) -> Ints:
        """Returns the selected rows; or, of a pair, those of one column."""
        if isinstance(at, tuple):
            rows, column = at
            return self.columns[column][rows].astype(np.int64)
        return np.stack([column[at] for column in self.columns], axis=1, dtype=np.int64)


class Groups(NamedTuple):
    """Rows by their group, numbered from 0 without a gap.

    Attributes:
        order: the rows sorted by group; the rows of one group ascend.
        begins: where each group begins in `order`.
        sizes: the number of rows of each group.
    """

    order: Ints
    begins: Ints
    sizes: Ints

    @classmethod
    def of(cls, group: Ints) -> Groups:
        """Groups rows by the group that each has."""
        sizes = np.bincount(group).astype(np.int64)
        return cls(stable_order(group), np.cumsum(sizes) - sizes, sizes)

    @property
    def firsts(self) -> Ints:
        """The first row of each group."""
        return self.order[self.begins]

    def sums(self, values: Ints) -> Ints:
        """Returns the sum of each group's values."""
        return np.add.reduceat(values[self.order], self.begins) if len(values) else values

    def ends(self, values: Ints) -> tuple[Ints, Ints]:
        """Returns the least and the greatest of each group's values."""
        ordered = values[self.order]
        if not len(values):
            return ordered, ordered
        return np.minimum.reduceat(ordered, self.begins), np.maximum.reduceat(ordered, self.begins)

"""Sights as few bytes, and the sights of many parts of a history joined.

A packed part has sections, each of one stretch of the clock and one session. It is a zstd frame:
how many bytes a number takes (4 or 8), the first slice, how many sections there are, how many bytes
the names take, how many rows each section has in each table, and the names of topics and labels as
JSON. Then table after table and column after column the lowest bytes of all numbers, the next ones,
and so on.
A number is how much it is more than the one above it in its column, its sign in the lowest bit.
Times are in us: the first one of a row from the beginning of its slice on, the last one from the
first one on. A minute of a detector that sees a room takes some 400 bytes.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from itertools import chain
from struct import Struct
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.sights import SLICE_NS, TABLES, Fix, Hit, Look, Sights, Spot, Unplaced
from ros2_memory.columns.pack import byte_planes, compressed, decompressed
from ros2_memory.core.arrays import Columns, Ints, begins_of, distinct_rows, in_ranges, narrowed
from ros2_memory.core.timebase import NS_PER_US

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]

Names: TypeAlias = "tuple[dict[str, int], dict[str, int]]"
"""The numbers of topics and of labels."""

_HEAD: Final = Struct("<BqII")
_ROWS: Final = np.dtype(("<u4", len(TABLES)))
_SLICE_US: Final = SLICE_NS // NS_PER_US
_SIGN: Final = 63
_AT_ONCE: Final = 16
"""So many parts are unpacked together."""
_COLUMNS: Final = tuple(map(len, TABLES))
_SPOTS, _LOOKS, _HITS, _SCORES, _BESIDE, _UNPLACED, _FIXES = range(len(TABLES))
_NAMED: Final = (
    ((_SPOTS, 1), (_LOOKS, 1), (_UNPLACED, 1)),
    ((_SPOTS, 2), (_UNPLACED, 2), (_BESIDE, 1)),
)
"""Which columns of which tables are topics, and labels."""


class _Times(NamedTuple):
    """Which columns are times, in a table whose column 0 is a slice."""

    first: int
    last: int | None = None


_IN_SLICES: Final = {
    _SPOTS: _Times(Spot.FIRST, Spot.LAST),
    _LOOKS: _Times(Look.FIRST, Look.LAST),
    _UNPLACED: _Times(Unplaced.FIRST, Unplaced.LAST),
    _FIXES: _Times(Fix.TIME),
}


def packed(sights: Sights, rows: Ints | None = None) -> bytes:
    """Returns the sights of some slices of the clock as bytes.

    `rows` has how many each section has in each table; without, there is one section.
    """
    slices = [sights.tables[number][:, 0] for number in _IN_SLICES if len(sights.tables[number])]
    begin = min((int(array.min()) for array in slices), default=0)
    coded = []
    for number, table in enumerate(sights.tables):
        columns = table.T.copy()
        times = _IN_SLICES.get(number)
        if times is not None:
            if times.last is not None:
                columns[times.last] -= columns[times.first]
                columns[times.last] //= NS_PER_US
            columns[times.first] //= NS_PER_US
            columns[times.first] -= columns[0] * _SLICE_US
            columns[0] -= begin
        steps = np.diff(columns, axis=1, prepend=0)
        coded.append(((steps << 1) ^ (steps >> _SIGN)).view(np.uint64))
    width = 4 if all(int(array.max(initial=0)) < 1 << 32 for array in coded) else 8
    names = json.dumps((sights.topics, sights.labels)).encode()
    in_tables = np.array([[*map(len, sights.tables)]] if rows is None else rows, _ROWS.base)
    head = _HEAD.pack(width, begin, len(in_tables), len(names)) + in_tables.tobytes()
    planes = [byte_planes(column, width) for array in coded for column in array.view(np.int64)]
    return compressed(b"".join((head, names, *planes)))


@dataclass(frozen=True, slots=True, eq=False)
class JoinedSights:
    """The sights of many parts of a history, with tables as those of `Sights`, in order.

    Their slices are numbered in order of time. Those of one time and another epoch (the coordinate
    system of a part) are different ones.

    Attributes:
        epochs: of each slice.
    """

    topics: tuple[str, ...]
    labels: tuple[str, ...]
    epochs: Ints
    spots: Columns
    looks: Columns
    hits: Columns
    scores: Columns
    beside: Columns
    unplaced: Columns
    fixes: Columns


def joined(
    parts: Sequence[bytes],
    epochs: Sequence[int],
    sessions: Sequence[int],
) -> JoinedSights:
    """Returns the sights of packed parts, whose sections are of some epochs and sessions.

    Fixes are in order of time for each session: at one time there may be several robots.
    """
    epoch, session = np.array(epochs, np.int64), np.array(sessions, np.int64)
    names: Names = {}, {}
    # Of each table and column, those of the parts that are unpacked together, in few bytes.
    pieces: list[list[list[Ints]]] = [[[] for _ in range(size + 1)] for size in _COLUMNS]
    sections = 0
    for begin in range(0, max(len(parts), 1), _AT_ONCE):
        tables, rows = _unpacked(parts[begin : begin + _AT_ONCE], names)
        section_of = _sections_of(rows)
        for of_table, table, numbers in zip(pieces, tables, section_of, strict=True):
            for of_column, column in zip(of_table, (*table, numbers + sections), strict=True):
                of_column.append(narrowed(column))
        sections += len(rows)
    columns = [[*map(_concatenated, of_table)] for of_table in pieces]
    section = [table.pop() for table in columns]
    _number_rows(columns, section, sections)
    for kind, places in enumerate(_NAMED):
        rank = np.argsort([names[kind][name] for name in sorted(names[kind])]).astype(np.int64)
        for at, column in places:
            columns[at][column] = narrowed(rank[columns[at][column]])
    epoch_of_slice = _number_slices(columns, section, epoch)
    keys = {_SPOTS: 3, _LOOKS: 2, _UNPLACED: 3}
    orders = {at: _order(columns[at][:size]) for at, size in keys.items()}
    orders[_FIXES] = _distinct_fixes(columns[_FIXES], session[section[_FIXES]])
    spots, looks = (_places(orders[at]) for at in (_SPOTS, _LOOKS))
    columns[_HITS][Hit.LOOK] = looks[columns[_HITS][Hit.LOOK]]
    for at in (_HITS, _SCORES, _BESIDE):
        columns[at][0] = spots[columns[at][0]]
        orders[at] = _order(columns[at][:1])
    for at, order in orders.items():
        columns[at] = [column[order] for column in columns[at]]
    topics, labels = (tuple(sorted(names_of_kind)) for names_of_kind in names)
    return JoinedSights(topics, labels, epoch_of_slice, *map(Columns, columns))


def _concatenated(pieces: list[Ints]) -> Ints:
    """Returns some arrays one after the other, and frees them."""
    column = np.concatenate(pieces)
    pieces.clear()
    return column


def _number_rows(columns: Sequence[list[Ints]], section: Sequence[Ints], sections: int) -> None:
    """Numbers the spots and looks that tables name through all sections, no more for each."""
    spots, looks = (begins_of(section[at], sections) for at in (_SPOTS, _LOOKS))
    for at in (_HITS, _SCORES, _BESIDE):
        columns[at][0] = columns[at][0] + spots[section[at]]
    look = columns[_HITS][Hit.LOOK]
    columns[_HITS][Hit.LOOK] = np.where(look < 0, -1, look + looks[section[_HITS]])


def _number_slices(columns: list[list[Ints]], section: Sequence[Ints], epoch: Ints) -> Ints:
    """Numbers the slices in tables, which are of some sections; returns the epoch of each."""
    begins = {at: _begins(columns[at][0], section[at]) for at in _IN_SLICES}
    of_runs = [(columns[at][0][rows], epoch[section[at][rows]]) for at, rows in begins.items()]
    slices, number = distinct_rows([*map(np.concatenate, zip(*of_runs, strict=True))])
    number = narrowed(number)
    for at, rows in begins.items():
        columns[at][0] = np.repeat(number[: len(rows)], np.diff(rows, append=len(section[at])))
        number = number[len(rows) :]
    return slices[:, 1]


def _begins(*columns: Ints) -> Ints:
    """Returns the rows that differ from the one before, and the first."""
    is_other = np.ones(len(columns[0]), np.bool_)
    is_other[1:] = np.any([np.diff(column) != 0 for column in columns], axis=0)
    return np.flatnonzero(is_other)


def _order(keys: Sequence[Ints]) -> Ints:
    """Returns the rows in the order of some columns; equal ones stay in their order."""
    begins = _begins(*keys)  # many rows that are alike follow each other
    order = np.argsort(distinct_rows([key[begins] for key in keys])[1], kind="stable")
    return in_ranges(begins[order], np.diff(begins, append=len(keys[0]))[order])


def _places(order: Ints) -> Ints:
    """Returns where each row comes in an order, in few bytes; at the end, so for row -1, -1."""
    places = np.full(len(order) + 1, -1, np.int64)
    places[order] = np.arange(len(order))
    return narrowed(places)


def united(parts: Sequence[bytes]) -> bytes:
    """Returns packed parts as one, with the sections of all."""
    topics, labels = names = dict[str, int](), dict[str, int]()
    tables, rows = _unpacked(parts, names)
    return packed(Sights((*topics,), (*labels,), *(table.T for table in tables)), rows)


def _distinct_fixes(columns: Sequence[Ints], session: Ints) -> Ints:
    """Returns the fixes of each session in order of time, each once.

    Where a stretch of the clock ends, both that it parts have the fix.
    """
    order = np.lexsort((*columns[:0:-1], session))
    return order[_begins(*(column[order] for column in (*columns, session)))]


def _sections_of(rows: Ints) -> list[Ints]:
    """Returns the section of each row of each table; `rows` has how many each has."""
    return [np.repeat(np.arange(len(rows)), in_table) for in_table in rows.T]


def _unpacked(parts: Sequence[bytes], names: Names) -> tuple[list[Ints], Ints]:
    """Returns the tables of all parts, and how many rows each section has in each.

    Each table has its columns one after the other. `names` has the numbers of topics and labels,
    and gets those of others.
    """
    planes: list[list[Bytes]] = [[] for _ in TABLES]
    own_names, starts, rows_of_parts = [], [], [np.zeros((0, len(TABLES)), _ROWS.base)]
    for part in parts:
        data = decompressed(part)
        width, begin, sections, size = _HEAD.unpack_from(data)
        rows_of_parts.append(np.frombuffer(data, _ROWS, sections, _HEAD.size))
        at = _HEAD.size + sections * _ROWS.itemsize
        own_names.append(data[at : at + size])
        at += size
        starts.append(begin)
        totals = rows_of_parts[-1].sum(axis=0).tolist()
        for blocks, columns, count in zip(planes, _COLUMNS, totals, strict=True):
            if count:
                shape = (columns, width, count)
                blocks.append(np.frombuffer(data, np.uint8, math.prod(shape), at).reshape(shape))
                at += math.prod(shape)
    begins = np.array(starts, np.int64)
    rows = np.concatenate(rows_of_parts).astype(np.int64)
    of_parts = np.array([of_part.sum(axis=0) for of_part in rows_of_parts[1:]], np.int64)
    part_of = _sections_of(of_parts.reshape(-1, len(TABLES)))
    # Of all parts at once: numpy takes longer to be called than to go through a part.
    tables = [_restored(planes.pop(0), part, at) for at, part in enumerate(part_of)]
    for at, times in _IN_SLICES.items():
        table = tables[at]
        table[0] += begins[part_of[at]]
        table[times.first] = (table[times.first] + table[0] * _SLICE_US) * NS_PER_US
        if times.last is not None:
            table[times.last] = table[times.last] * NS_PER_US + table[times.first]
    # Many parts have the same names.
    distinct = {text: json.loads(text) for text in own_names}
    for kind, (places, numbers_of) in enumerate(zip(_NAMED, names, strict=True)):
        codes = {
            text: [numbers_of.setdefault(name, len(numbers_of)) for name in both[kind]]
            for text, both in distinct.items()
        }
        code = np.array([*chain.from_iterable(codes[text] for text in own_names)], np.int64)
        first_codes = np.cumsum([0, *(len(codes[text]) for text in own_names)])
        for at, column in places:
            tables[at][column] = code[tables[at][column] + first_codes[part_of[at]]]
    return tables, rows


def _restored(planes: Sequence[Bytes], part: Ints, at: int) -> Ints:
    """Returns the columns of a table; `planes` of parts are by column, and by byte of a number."""
    width = max((block.shape[1] for block in planes), default=4)
    wide = [np.zeros((len(TABLES[at]), width, 0), np.uint8)]
    for block in planes:
        has_width = block.shape[1] == width
        wide.append(block if has_width else np.concatenate((block, np.zeros_like(block)), axis=1))
    whole = np.concatenate(wide, axis=2)
    columns = np.empty((len(whole), len(part)), np.int64)
    firsts = np.flatnonzero(np.diff(part, prepend=-1))
    # One by one: a column is in the processor's cache, and all of a week would take 50 MB more.
    for column, of_column in zip(columns, whole, strict=True) if len(part) else ():
        coded = of_column[0].astype(f"<u{width}")
        for nth, plane in enumerate(of_column[1:], 1):
            if plane.any():  # most have few bytes
                coded |= plane.astype(coded.dtype) << (8 * nth)
        column[:] = ((coded >> 1) ^ -(coded & 1)).view(f"<i{width}")
        column[firsts[1:]] -= np.add.reduceat(column, firsts)[:-1]
        np.cumsum(column, out=column)
    return columns

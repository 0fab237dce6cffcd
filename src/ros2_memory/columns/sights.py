"""Sights as few bytes, and the sights of many parts of a history joined.

A packed part has sections, each of one stretch of the clock and one session. It is a zstd frame: a
line of JSON with the names of topics and of labels, how many rows each section has in each table,
and how many bytes a number takes in each table; then table after table the lowest bytes of all
numbers, column by column, the next ones, and so on. A number is how much it is more than the one
above it in its column, its sign in the lowest bit. Times are in us. A minute of a detector that
sees a room takes some 400 bytes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.analysis.sights import TABLES, Fix, Hit, Look, Sights, Spot, Unplaced
from ros2_memory.columns.pack import byte_planes, compressed, decompressed, from_planes, signed
from ros2_memory.core.arrays import Columns, Ints, begins_of, distinct_rows, in_ranges, narrowed
from ros2_memory.core.timebase import NS_PER_US

if TYPE_CHECKING:
    from collections.abc import Sequence

Names: TypeAlias = "tuple[dict[str, int], dict[str, int]]"
"""The numbers of topics and of labels."""

_SIGN: Final = 63
_AT_ONCE: Final = 16
"""So many parts are unpacked together."""
_SPOTS, _LOOKS, _HITS, _SCORES, _BESIDE, _UNPLACED, _FIXES = range(len(TABLES))
_NAMED: Final = (
    ((_SPOTS, 1), (_LOOKS, 1), (_UNPLACED, 1)),
    ((_SPOTS, 2), (_UNPLACED, 2), (_BESIDE, 1)),
)
"""Which columns of which tables are topics, and labels."""
_TIMES: Final[dict[int, list[int]]] = {
    _SPOTS: [Spot.FIRST, Spot.LAST],
    _LOOKS: [Look.FIRST, Look.LAST],
    _UNPLACED: [Unplaced.FIRST, Unplaced.LAST],
    _FIXES: [Fix.TIME],
}
"""Which columns are times, in the tables whose column 0 is a slice."""


def packed(sights: Sights, rows: Ints | None = None) -> bytes:
    """Returns the sights of some slices of the clock as bytes.

    `rows` has how many each section has in each table; without, there is one section.
    """
    in_tables = [[*map(len, sights.tables)]] if rows is None else rows.tolist()
    widths, planes = [], []
    for at, table in enumerate(sights.tables):
        columns = table.T.copy()
        columns[_TIMES.get(at, [])] //= NS_PER_US
        steps = np.diff(columns, axis=1, prepend=0)
        coded = (steps << 1) ^ (steps >> _SIGN)
        widths.append((int(coded.max(initial=0)).bit_length() + 7) // 8)
        planes.append(byte_planes(coded, widths[-1]))
    head = json.dumps((sights.topics, sights.labels, in_tables, widths))
    return compressed(b"".join((head.encode(), b"\n", *planes)))


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
    pieces: list[list[list[Ints]]] = [[[] for _ in range(len(kind) + 1)] for kind in TABLES]
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
    begins = {at: _begins(columns[at][0], section[at]) for at in _TIMES}
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
    tables = [[np.empty((len(kind), 0), np.int64)] for kind in TABLES]
    rows = [np.empty((0, len(TABLES)), np.int64)]
    for part in parts:
        head, data = decompressed(part).split(b"\n", 1)
        *own_names, in_tables, widths = json.loads(head)
        rows.append(np.array(in_tables, np.int64).reshape(-1, len(TABLES)))
        begin = 0
        counts = rows[-1].sum(axis=0).tolist()
        for of_table, count, width in zip(tables, counts, widths, strict=True):
            columns = len(of_table[0])
            steps = signed(from_planes(data, begin, columns * count, width))
            begin += columns * count * width
            of_table.append(np.cumsum(steps.reshape(columns, count), axis=1, dtype=np.int64))
        for at, times in _TIMES.items():
            tables[at][-1][times] *= NS_PER_US
        for kind, (places, numbers_of) in enumerate(zip(_NAMED, names, strict=True)):
            own = [numbers_of.setdefault(name, len(numbers_of)) for name in own_names[kind]]
            for at, column in places:
                tables[at][-1][column] = np.array(own, np.int64)[tables[at][-1][column]]
    return [np.concatenate(of_table, axis=1) for of_table in tables], np.concatenate(rows)

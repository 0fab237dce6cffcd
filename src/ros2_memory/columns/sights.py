"""Sights as few bytes, and the sights of many parts of a history joined.

A packed part has sections, each of one stretch of the clock and one session. It is a zstd frame: a
line of JSON with the names of topics, of labels and of ids, how many rows each section has in each
table, and how many bytes a number takes in each table; then table after table the lowest bytes of
all numbers, column by column, the next ones, and so on. A number is how much it is more than the
one above it in its column, its sign in the lowest bit. Times are in us. A minute of a detector that
sees a room takes some 400 bytes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.analysis.sights import (
    TABLES,
    Beside,
    Fix,
    Hit,
    Look,
    Score,
    Sights,
    Spot,
    Unplaced,
)
from ros2_memory.columns.pack import compress, decompress, from_planes, in_planes, signed, unsigned
from ros2_memory.core.arrays import (
    Columns,
    Ints,
    begins_of,
    distinct_rows,
    in_ranges,
    narrowed,
    run_starts,
)
from ros2_memory.core.timebase import NS_PER_US

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_Kind: TypeAlias = type[IntEnum]
"""The columns of a table, one of `TABLES`."""

_AT_ONCE: Final = 16
"""So many parts are unpacked together."""
_NAMED: Final[tuple[dict[_Kind, int], ...]] = (
    {Spot: Spot.TOPIC, Look: Look.TOPIC, Unplaced: Unplaced.TOPIC},
    {Spot: Spot.LABEL, Unplaced: Unplaced.LABEL, Beside: Beside.LABEL},
    {Spot: Spot.ID},
)
"""The column of each table that has numbers of topics, of labels and of ids."""
_TIMES: Final[dict[_Kind, list[int]]] = {
    Spot: [Spot.FIRST, Spot.LAST],
    Look: [Look.FIRST, Look.LAST],
    Unplaced: [Unplaced.FIRST, Unplaced.LAST],
    Fix: [Fix.TIME],
}
"""The columns with times, of each table whose column 0 is a slice."""


def pack_sights(sights: Sights, rows: Ints | None = None) -> bytes:
    """Returns the sights of some slices of the clock as bytes.

    Args:
        sights: the tables.
        rows: how many rows each section has in each table; None for a single section.
    """
    in_tables = [[*map(len, sights.tables)]] if rows is None else rows.tolist()
    written = []
    for kind, table in zip(TABLES, sights.tables, strict=True):
        columns = table.T.copy()
        columns[_TIMES.get(kind, [])] //= NS_PER_US
        written.append(in_planes(unsigned(np.diff(columns, axis=1, prepend=0))))
    widths, planes = zip(*written, strict=True)
    head = json.dumps((sights.topics, sights.labels, sights.ids, in_tables, widths))
    return compress(b"".join((head.encode(), b"\n", *planes)))


@dataclass(frozen=True, slots=True, eq=False)
class JoinedSights:
    """The sights of many parts of a history, with tables as those of `Sights`, in order.

    Their slices are numbered in order of time. Those of one time and another epoch (the coordinate
    system of a part) are different ones.

    Attributes:
        epochs: of each slice.
        sessions: of each slice; one of them, if several saw something in one epoch then.
        ids: "" is the first.
    """

    topics: tuple[str, ...]
    labels: tuple[str, ...]
    ids: tuple[str, ...]
    epochs: Ints
    sessions: Ints
    spots: Columns
    looks: Columns
    hits: Columns
    scores: Columns
    beside: Columns
    unplaced: Columns
    fixes: Columns


_Names: TypeAlias = tuple[dict[str, int], ...]
"""The numbers of topics, of labels and of ids, in the order in which they were first met."""


@dataclass(slots=True)
class _Table:
    """One table of many packed parts, column by column.

    Attributes:
        columns: as its kind names them.
        section: the section that each row is of.
    """

    columns: list[Ints]
    section: Ints

    def sort(self, order: Ints) -> None:
        """Puts the rows into an order."""
        self.columns = [column[order] for column in self.columns]


def join_sights(
    parts: Sequence[bytes], epochs: Sequence[int], sessions: Sequence[int]
) -> JoinedSights:
    """Returns the sights of packed parts as one.

    Fixes are in order of time for each session: at one time there may be several robots.

    Args:
        parts: as `pack_sights` returns them.
        epochs: the epoch of each of their sections.
        sessions: the session of each section.
    """
    names: _Names = ({}, {}, {"": 0})
    tables, sections = _read_tables(parts, names)
    _refer_across_sections(tables, sections)
    topics, labels, ids = (
        _rank_names(tables, column_of, number_of)
        for column_of, number_of in zip(_NAMED, names, strict=True)
    )
    session_of_section = np.array(sessions, np.int64)
    of_slices = _number_slices(tables, np.array(epochs, np.int64), session_of_section)
    _sort_tables(tables, session_of_section)
    columns = (Columns(tables[kind].columns) for kind in TABLES)
    return JoinedSights(topics, labels, ids, *of_slices, *columns)


def unite_sights(parts: Sequence[bytes]) -> bytes:
    """Returns packed parts as one, with the sections of all."""
    names: _Names = ({}, {}, {})
    tables, rows = _unpack(parts, names)
    topics, labels, ids = map(tuple, names)
    return pack_sights(Sights(topics, labels, ids, *(table.T for table in tables)), rows)


def _read_tables(parts: Sequence[bytes], names: _Names) -> tuple[dict[_Kind, _Table], int]:
    """Returns the tables of all parts, and how many sections they have.

    A few parts at a time are unpacked; their numbers are kept in as few bytes as they need.
    """
    # For each column the pieces of it; those of the section come last.
    pieces: dict[_Kind, list[list[Ints]]] = {
        kind: [[] for _ in range(len(kind) + 1)] for kind in TABLES
    }
    sections = 0
    for begin in range(0, max(len(parts), 1), _AT_ONCE):
        batch, rows = _unpack(parts[begin : begin + _AT_ONCE], names)
        numbers = np.arange(sections, sections + len(rows))
        for kind, table, in_table in zip(TABLES, batch, rows.T, strict=True):
            section = np.repeat(numbers, in_table)
            for of_column, column in zip(pieces[kind], (*table, section), strict=True):
                of_column.append(narrowed(column))
        sections += len(rows)
    tables: dict[_Kind, _Table] = {}
    for kind, of_kind in pieces.items():
        *columns, section = map(_concatenated, of_kind)
        tables[kind] = _Table(columns, section)
    return tables, sections


def _concatenated(pieces: list[Ints]) -> Ints:
    """Returns some arrays one after the other, and frees them."""
    column = np.concatenate(pieces)
    pieces.clear()
    return column


def _unpack(parts: Sequence[bytes], names: _Names) -> tuple[list[Ints], Ints]:
    """Returns the tables of all parts, and how many rows each section has in each table.

    Each table has its columns one after the other.

    Args:
        parts: as `pack_sights` returns them.
        names: gets the names that it does not have yet; the tables have its numbers.
    """
    tables = [[np.empty((len(kind), 0), np.int64)] for kind in TABLES]
    rows = [np.empty((0, len(TABLES)), np.int64)]
    for part in parts:
        head, data = decompress(part).split(b"\n", 1)
        *names_of_part, in_tables, widths = json.loads(head)
        numbers = [*map(_numbers_of, names_of_part, names)]
        rows.append(np.array(in_tables, np.int64).reshape(-1, len(TABLES)))
        counts = rows[-1].sum(axis=0).tolist()
        begin = 0
        for kind, of_kind, count, width in zip(TABLES, tables, counts, widths, strict=True):
            steps = signed(from_planes(data, begin, len(kind) * count, width))
            begin += len(kind) * count * width
            table = np.cumsum(steps.reshape(len(kind), count), axis=1, dtype=np.int64)
            table[_TIMES.get(kind, [])] *= NS_PER_US
            for column_of, number_of in zip(_NAMED, numbers, strict=True):
                if kind in column_of:
                    table[column_of[kind]] = number_of[table[column_of[kind]]]
            of_kind.append(table)
    return [np.concatenate(of_kind, axis=1) for of_kind in tables], np.concatenate(rows)


def _numbers_of(names: Sequence[str], number_of: dict[str, int]) -> Ints:
    """Returns the number of each name; new names get the next ones."""
    return np.array([number_of.setdefault(name, len(number_of)) for name in names], np.int64)


# Each of these changes the tables in place.


def _refer_across_sections(tables: Mapping[_Kind, _Table], sections: int) -> None:
    """Numbers the spots and looks that tables refer to through all sections.

    In a section they are numbered from 0.
    """
    spot_begins = begins_of(tables[Spot].section, sections)
    look_begins = begins_of(tables[Look].section, sections)
    for kind in (Hit, Score, Beside):
        table = tables[kind]
        table.columns[0] = table.columns[0] + spot_begins[table.section]
    hits = tables[Hit]
    look = hits.columns[Hit.LOOK]
    hits.columns[Hit.LOOK] = np.where(look < 0, -1, look + look_begins[hits.section])


def _rank_names(
    tables: Mapping[_Kind, _Table], column_of: Mapping[_Kind, int], number_of: Mapping[str, int]
) -> tuple[str, ...]:
    """Puts the places of names in alphabetical order in place of their numbers; returns that."""
    ordered = sorted(number_of)
    rank = np.argsort([number_of[name] for name in ordered]).astype(np.int64)
    for kind, column in column_of.items():
        columns = tables[kind].columns
        columns[column] = narrowed(rank[columns[column]])
    return tuple(ordered)


def _number_slices(
    tables: Mapping[_Kind, _Table], epoch_of_section: Ints, session_of_section: Ints
) -> tuple[Ints, Ints]:
    """Numbers the slices in order of time; returns the epoch and a session of each."""
    timed = [tables[kind] for kind in _TIMES]
    # Many rows of one slice follow each other: one of each run is compared.
    runs = [run_starts(table.columns[0], table.section) for table in timed]
    slices, sections = [], []
    for table, begins in zip(timed, runs, strict=True):
        slices.append(table.columns[0][begins])
        sections.append(table.section[begins])
    section = np.concatenate(sections)
    distinct, numbers = distinct_rows([np.concatenate(slices), epoch_of_section[section]])
    sessions = np.zeros(len(distinct), np.int64)
    sessions[numbers] = session_of_section[section]
    numbers = narrowed(numbers)
    for table, begins in zip(timed, runs, strict=True):
        sizes = np.diff(begins, append=len(table.section))
        table.columns[0] = np.repeat(numbers[: len(begins)], sizes)
        numbers = numbers[len(begins) :]
    return distinct[:, 1], sessions


def _sort_tables(tables: Mapping[_Kind, _Table], session_of_section: Ints) -> None:
    """Sorts the tables, and renews what refers to rows of others."""
    spots, looks, hits, fixes = (tables[kind] for kind in (Spot, Look, Hit, Fix))
    spot_order = _order(spots.columns[: Spot.LABEL + 1])
    look_order = _order(looks.columns[: Look.TOPIC + 1])
    spots.sort(spot_order)
    looks.sort(look_order)
    tables[Unplaced].sort(_order(tables[Unplaced].columns[: Unplaced.LABEL + 1]))
    fixes.sort(_distinct_fixes(fixes.columns, session_of_section[fixes.section]))
    hits.columns[Hit.LOOK] = _places(look_order)[hits.columns[Hit.LOOK]]
    spot_places = _places(spot_order)
    for kind in (Hit, Score, Beside):
        table = tables[kind]
        table.columns[0] = spot_places[table.columns[0]]
        table.sort(_order(table.columns[:1]))


def _order(keys: Sequence[Ints]) -> Ints:
    """Returns the rows in the order of some columns; equal ones stay in their order."""
    begins = run_starts(*keys)  # many rows that are alike follow each other
    order = np.argsort(distinct_rows([key[begins] for key in keys])[1], kind="stable")
    return in_ranges(begins[order], np.diff(begins, append=len(keys[0]))[order])


def _places(order: Ints) -> Ints:
    """Returns the place of each row in an order; the last one, for row -1, is -1."""
    places = np.full(len(order) + 1, -1, np.int64)
    places[order] = np.arange(len(order))
    return narrowed(places)


def _distinct_fixes(columns: Sequence[Ints], session: Ints) -> Ints:
    """Returns the rows of fixes, by session and time, each fix once.

    Two stretches of the clock that meet have the fix at their common edge both.
    """
    order = np.lexsort((*reversed(columns[Fix.TIME :]), session))  # the last is the first key
    return order[run_starts(*(column[order] for column in (*columns, session)))]

"""Sights as few bytes, and the sights of many parts of a history joined.

A packed part is a zstd frame: how many bytes a number takes (4 or 8), the first slice, how many
rows each table has, how many bytes the names take, and the names of topics and labels as JSON. Then
table after table and column after column the lowest bytes of all numbers, the next ones, and so on.
A number is how much it is more than the one above it in its column, its sign in the lowest bit.
Times are in us: the first one of a row from the beginning of its slice on, the last one from the
first one on. A minute of a detector that sees a room takes some 400 bytes.
"""

from __future__ import annotations

import json
import math
from struct import Struct
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import (
    SLICE_NS,
    TABLES,
    Fix,
    Hit,
    Ints,
    Look,
    Sights,
    Spot,
    Unplaced,
)
from ros2_memory.columns.pack import byte_planes, compressed, decompressed
from ros2_memory.core.arrays import distinct_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]

_HEAD: Final = Struct(f"<Bq{len(TABLES) + 1}I")
_NS_PER_US: Final = 1_000
_SLICE_US: Final = SLICE_NS // _NS_PER_US
_SIGN: Final = 63
_SPOTS, _LOOKS, _HITS, _SCORES, _BESIDE, _UNPLACED, _FIXES = range(len(TABLES))


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


def packed(sights: Sights) -> bytes:
    """Returns the sights of some slices of the clock as bytes."""
    slices = [sights.tables[number][:, 0] for number in _IN_SLICES if len(sights.tables[number])]
    begin = min((int(array.min()) for array in slices), default=0)
    coded = []
    for number, table in enumerate(sights.tables):
        columns = table.T.copy()
        times = _IN_SLICES.get(number)
        if times is not None:
            if times.last is not None:
                columns[times.last] -= columns[times.first]
                columns[times.last] //= _NS_PER_US
            columns[times.first] //= _NS_PER_US
            columns[times.first] -= columns[0] * _SLICE_US
            columns[0] -= begin
        steps = np.diff(columns, axis=1, prepend=0)
        coded.append(((steps << 1) ^ (steps >> _SIGN)).view(np.uint64))
    width = 4 if all(int(array.max(initial=0)) < 1 << 32 for array in coded) else 8
    names = json.dumps((sights.topics, sights.labels)).encode()
    head = _HEAD.pack(width, begin, *map(len, sights.tables), len(names))
    planes = [byte_planes(column, width) for array in coded for column in array.view(np.int64)]
    return compressed(b"".join((head, names, *planes)))


def joined(
    parts: Sequence[bytes],
    epochs: Sequence[int] | None = None,
    sessions: Sequence[int] | None = None,
) -> tuple[Sights, Ints]:
    """Returns the sights of packed parts, and the epoch of each slice.

    There is one table of names. Slices are numbered in order of time. Those of one time and another
    epoch (the coordinate system of a part) are different ones. Fixes are in order of time for each
    session: at one time there may be several robots.
    """
    unpacked = _Unpacked(parts)
    spots, looks, hits, scores, beside, unplaced, fixes = unpacked.tables
    topics, labels = unpacked.names()
    epoch = np.zeros(len(parts), np.int64) if epochs is None else np.array(epochs, np.int64)
    slices = unpacked.with_slices_numbered(epoch)
    spot_order = _order(spots[:, Spot.SLICE], spots[:, Spot.TOPIC], spots[:, Spot.LABEL])
    look_order = _order(looks[:, Look.SLICE], looks[:, Look.TOPIC])
    unpacked.renumber_references(_places_of(spot_order), _places_of(look_order))
    session = np.zeros(len(parts), np.int64) if sessions is None else np.array(sessions, np.int64)
    tables = (
        spots[spot_order],
        looks[look_order],
        *(table[_order(table[:, 0], table[:, 1])] for table in (hits, scores, beside)),
        unplaced[_order(unplaced[:, 0], unplaced[:, 1], unplaced[:, 2])],
        _distinct_fixes(fixes, session[unpacked.part[_FIXES]]),
    )
    return Sights(topics, labels, *tables, slices=len(slices)), slices[:, 1]


def united(parts: Sequence[bytes]) -> bytes:
    """Returns packed parts as one: their rows one after the other."""
    unpacked = _Unpacked(parts)
    names = unpacked.names()
    spots, looks, *_ = (np.arange(len(table)) for table in unpacked.tables)
    unpacked.renumber_references(spots, looks)
    return packed(Sights(*names, *unpacked.tables))


def _distinct_fixes(fixes: Ints, session: Ints) -> Ints:
    """Returns the fixes of each session in order of time, each once.

    Where a stretch of the clock ends, both that it parts have the fix.
    """
    order = np.lexsort((*fixes.T[::-1], session))
    fixes, session = fixes[order], session[order]
    is_other = np.ones(len(fixes), np.bool_)
    is_other[1:] = (fixes[1:] != fixes[:-1]).any(axis=1) | (session[1:] != session[:-1])
    return fixes[is_other]


class _Unpacked:
    """Parts unpacked together: numpy takes longer to be called than to go through a part.

    Attributes:
        topics: the names of the topics of each part.
        labels: likewise.
        part: by table, the part of each row.
        tables: the rows of all parts, with slices and times as in `Sights`.
    """

    def __init__(self, parts: Sequence[bytes]) -> None:
        self.topics: list[list[str]] = []
        self.labels: list[list[str]] = []
        counts, slices = [], []
        planes: list[list[Bytes]] = [[] for _ in TABLES]
        for part in parts:
            data = decompressed(part)
            width, begin, *rows, size = _HEAD.unpack_from(data)
            at = _HEAD.size + size
            topics, labels = json.loads(data[_HEAD.size : at])
            self.topics.append(topics)
            self.labels.append(labels)
            counts.append(rows)
            slices.append(begin)
            for blocks, columns, count in zip(planes, TABLES, rows, strict=True):
                shape = (len(columns), width, count)
                blocks.append(np.frombuffer(data, np.uint8, math.prod(shape), at).reshape(shape))
                at += math.prod(shape)
        self._sizes = np.array(counts, np.int64).reshape(-1, len(TABLES)).T
        self.part = [np.repeat(np.arange(len(parts)), sizes) for sizes in self._sizes]
        first = np.array(slices, np.int64)
        self.tables = [
            _table(at, planes.pop(0), part, first[part]) for at, part in enumerate(self.part)
        ]

    def renumber_references(self, spots: Ints, looks: Ints) -> None:
        """Changes numbers of spots and looks inside their part into their places in the whole.

        Args:
            spots: the place of each spot of all parts.
            looks: likewise; a hit without a look keeps -1.
        """
        for number in (_HITS, _SCORES, _BESIDE):
            table = self.tables[number]
            table[:, 0] = spots[table[:, 0] + self.begins(_SPOTS)[self.part[number]]]
        hits = self.tables[_HITS]
        look = hits[:, Hit.LOOK] + self.begins(_LOOKS)[self.part[_HITS]]
        look = np.where(hits[:, Hit.LOOK] < 0, -1, look)
        hits[:, Hit.LOOK] = np.append(looks, [-1])[look]

    def begins(self, at: int) -> Ints:
        """Returns where the rows of each part begin in a table."""
        sizes = self._sizes[at]
        begins: Ints = np.cumsum(sizes) - sizes
        return begins

    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Returns the names of topics and of labels, having changed their numbers in the tables."""
        topics = self._renamed(self.topics, [(_SPOTS, 1), (_LOOKS, 1), (_UNPLACED, 1)])
        return topics, self._renamed(self.labels, [(_SPOTS, 2), (_UNPLACED, 2), (_BESIDE, 1)])

    def _renamed(
        self, names: Sequence[Sequence[str]], columns: Sequence[tuple[int, int]]
    ) -> tuple[str, ...]:
        """Returns the names of all parts, sorted, having changed their numbers in some columns."""
        united = sorted({name for part_names in names for name in part_names})
        number = {name: nth for nth, name in enumerate(united)}
        numbers = np.array([number[name] for part_names in names for name in part_names], np.int64)
        begins = np.cumsum([0, *map(len, names)])
        for at, column in columns:
            table = self.tables[at]
            table[:, column] = numbers[table[:, column] + begins[self.part[at]]]
        return tuple(united)

    def with_slices_numbered(self, epoch: Ints) -> Ints:
        """Returns all slices with their epochs, having changed slices to their numbers."""
        tables = [self.tables[at] for at in _IN_SLICES]
        slices = np.concatenate([table[:, 0] for table in tables])
        epochs = np.concatenate([epoch[self.part[at]] for at in _IN_SLICES])
        rows, number = distinct_rows((slices, epochs))
        ends = np.cumsum([len(table) for table in tables])[:-1]
        for table, table_slices in zip(tables, np.split(number, ends), strict=True):
            table[:, 0] = table_slices
        return rows


def _table(at: int, planes: Sequence[Bytes], part: Ints, begin: Ints) -> Ints:
    """Returns the rows of one table of all parts; `part` and its first slice are of each row."""
    width = max((block.shape[1] for block in planes), default=4)
    wide = [np.zeros((len(TABLES[at]), width, 0), np.uint8)]
    wide += [block if block.shape[1] == width else _widened(block) for block in planes]
    stacked = np.ascontiguousarray(np.concatenate(wide, axis=2).transpose(0, 2, 1))
    coded = stacked.view(f"<u{width}")[:, :, 0].astype(np.uint64)
    del wide, stacked
    # In place: in a week of a detector that sees things everywhere there are millions.
    sign = coded & 1
    coded >>= 1
    columns: Ints = coded.view(np.int64)
    columns ^= -sign.view(np.int64)
    del sign
    firsts = np.flatnonzero(np.diff(part, prepend=-1))
    before = columns[:, firsts]
    np.cumsum(columns, axis=1, out=columns)
    before = columns[:, firsts] - before
    columns -= np.repeat(before, np.diff(firsts, append=len(part)), axis=1)
    times = _IN_SLICES.get(at)
    if times is not None:
        columns[0] += begin
        columns[times.first] = (columns[times.first] + columns[0] * _SLICE_US) * _NS_PER_US
        if times.last is not None:
            columns[times.last] = columns[times.last] * _NS_PER_US + columns[times.first]
    return columns.T


def _widened(planes: Bytes) -> Bytes:
    """Returns planes of numbers of 4 bytes as those of 8."""
    return np.concatenate((planes, np.zeros_like(planes)), axis=1)


def _order(*columns: Ints) -> Ints:
    """Returns the order of rows by their columns: quickly, as most are in it already."""
    keys = columns[0]
    for column in columns[1:]:
        low = column.min(initial=0)
        keys = keys * (column.max(initial=0) - low + 1) + (column - low)
    return np.argsort(keys, kind="stable")


def _places_of(order: Ints) -> Ints:
    """Returns where each row goes in an order."""
    places = np.empty(len(order), np.int64)
    places[order] = np.arange(len(order))
    return places

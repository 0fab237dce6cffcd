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
from itertools import chain
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
from ros2_memory.core.timebase import NS_PER_US

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]

_HEAD: Final = Struct(f"<Bq{len(TABLES) + 1}I")
_SLICE_US: Final = SLICE_NS // NS_PER_US
_SIGN: Final = 63
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
                columns[times.last] //= NS_PER_US
            columns[times.first] //= NS_PER_US
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
    topics, labels, tables, part = _unpacked(parts)
    epoch = np.zeros(len(parts), np.int64) if epochs is None else np.array(epochs, np.int64)
    session = np.zeros(len(parts), np.int64) if sessions is None else np.array(sessions, np.int64)
    slices = np.concatenate([tables[at][0] for at in _IN_SLICES])
    rows, number = distinct_rows((slices, np.concatenate([epoch[part[at]] for at in _IN_SLICES])))
    for at in _IN_SLICES:
        tables[at][0], number = np.split(number, [tables[at].shape[1]])
    spots, looks, hits, scores, beside, unplaced, fixes = tables
    tables.clear()  # frees each when it is ordered
    spots, place = _ordered(spots, 3)
    for table in (hits, scores, beside):
        table[0] = place[table[0]]
    looks, place = _ordered(looks, 2)
    hits[Hit.LOOK] = np.append(place, -1)[hits[Hit.LOOK]]
    ordered = (spots, looks, *(_ordered(table, 2)[0] for table in (hits, scores, beside)))
    ordered += _ordered(unplaced, 3)[0], _distinct_fixes(fixes, session[part[_FIXES]])
    return Sights(topics, labels, *(table.T for table in ordered), slices=len(rows)), rows[:, 1]


def united(parts: Sequence[bytes]) -> bytes:
    """Returns packed parts as one: their rows one after the other."""
    topics, labels, tables, _ = _unpacked(parts)
    return packed(Sights(topics, labels, *(table.T for table in tables)))


def _distinct_fixes(fixes: Ints, session: Ints) -> Ints:
    """Returns the fixes of each session in order of time, each once.

    Where a stretch of the clock ends, both that it parts have the fix.
    """
    order = np.lexsort((*fixes[::-1], session))
    fixes, session = fixes[:, order], session[order]
    is_other = np.ones(len(session), np.bool_)
    is_other[1:] = (np.diff(fixes) != 0).any(axis=0) | (np.diff(session) != 0)
    return fixes[:, is_other]


def _unpacked(
    parts: Sequence[bytes],
) -> tuple[tuple[str, ...], tuple[str, ...], list[Ints], list[Ints]]:
    """Returns the topics and labels of all parts, their tables, and the part of each row of these.

    Each table has its columns one after the other; numbers of spots and looks are of the whole.
    """
    planes: list[list[Bytes]] = [[] for _ in TABLES]
    names, heads = [], []
    for part in parts:
        data = decompressed(part)
        width, begin, *counts, size = _HEAD.unpack_from(data)
        at = _HEAD.size + size
        names.append(json.loads(data[_HEAD.size : at]))
        heads.append((begin, *counts))
        for blocks, columns, count in zip(planes, TABLES, counts, strict=True):
            shape = (len(columns), width, count)
            if count:
                blocks.append(np.frombuffer(data, np.uint8, math.prod(shape), at).reshape(shape))
            at += math.prod(shape)
    starts, *sizes = np.array(heads, np.int64).reshape(-1, 1 + len(TABLES)).T
    numbers = np.arange(len(parts))
    part_of = [np.repeat(numbers, rows) for rows in sizes]
    # Of all parts at once: numpy takes longer to be called than to go through a part.
    tables = [_restored(planes.pop(0), part, at) for at, part in enumerate(part_of)]
    for at, times in _IN_SLICES.items():
        table = tables[at]
        table[0] += starts[part_of[at]]
        table[times.first] = (table[times.first] + table[0] * _SLICE_US) * NS_PER_US
        if times.last is not None:
            table[times.last] = table[times.last] * NS_PER_US + table[times.first]
    for at in (_HITS, _SCORES, _BESIDE):
        tables[at][0] += (np.cumsum(sizes[_SPOTS]) - sizes[_SPOTS])[part_of[at]]
    look = tables[_HITS][Hit.LOOK]
    look += (look >= 0) * (np.cumsum(sizes[_LOOKS]) - sizes[_LOOKS])[part_of[_HITS]]
    united_names = []
    for kind, places in enumerate(_NAMED):
        of_parts = [part_names[kind] for part_names in names]
        united_names.append(tuple(sorted({*chain.from_iterable(of_parts)})))
        number = {name: nth for nth, name in enumerate(united_names[-1])}
        codes = np.array([number[name] for name in chain.from_iterable(of_parts)], np.int64)
        begins = np.cumsum([0, *map(len, of_parts)])
        for at, column in places:
            tables[at][column] = codes[tables[at][column] + begins[part_of[at]]]
    topics, labels = united_names
    return topics, labels, tables, part_of


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
    sizes = np.diff(firsts, append=len(part))
    # One by one: a column is in the processor's cache, and all of a week would take 50 MB more.
    for column, of_column in zip(columns, whole, strict=True):
        coded = np.ascontiguousarray(of_column.T).view(f"<u{width}")[:, 0]
        steps = ((coded >> 1) ^ -(coded & 1)).view(f"<i{width}")
        np.cumsum(steps, out=column)
        np.subtract(column, np.repeat(column[firsts] - steps[firsts], sizes), out=column)
    return columns


def _ordered(table: Ints, keys: int) -> tuple[Ints, Ints]:
    """Returns a table in the order of its first columns, so many, and the new place of each row."""
    key = table[0]
    for column in table[1:keys]:
        low = column.min(initial=0)
        key = key * (column.max(initial=0) - low + 1) + (column - low)
    places = np.arange(len(key))
    if (np.diff(key) >= 0).all():  # most are in it already
        return table, places
    order = np.argsort(key, kind="stable")
    places[order] = np.arange(len(key))
    return table[:, order], places

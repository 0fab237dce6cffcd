"""When a label was at a place: from what was seen there, and from what was not seen.

What was seen is known by slice (`analysis.sights`): 10 s of the clock.
A *cell* is a pose of the robot and its detector, to 25 cm and 10 degrees around where it often is,
from which the place was seen at least once. How often a message from a cell has the label, while it
is there, is its rate. A look from such a cell without a hit is evidence of absence, as strong as
the rate makes it; a hit is evidence of presence, as strong as false detections are rare. A message
that has the label somewhere unknown is neither. The likeliest sequence of being there and not being
there (Viterbi, two states) gives the stays.
"""

from __future__ import annotations

import math
from itertools import chain, pairwise, product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import (
    CELL_DECIDEG,
    CELL_MM,
    STOREY_MM,
    Floats,
    Hit,
    Look,
    Unplaced,
)
from ros2_memory.core.arrays import (
    Flags,
    Groups,
    Ints,
    begins_of,
    distinct_rows,
    in_ranges,
    narrowed,
    places_among,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.timebase import Ns, Span


_FALSE_RATE: Final = 0.01
"""How often a message has a label at a place where there is no such thing."""
_SWITCH: Final = 4.0
"""Natural logarithm of the odds against a change between two slices."""
_MOST_BY_SLICE: Final = 10.0
"""What one slice can add to the evidence: its messages share their errors."""
_STANDING: Final = 0.2
"""A robot that stands looks at the same thing behind the same obstacle."""
_LEAST_BLIND: Final = -2.0
"""A look with hits, from where the place is hardly seen, says no more against it."""
_CLEAR: Final = 1.5
"""A slice with less is not the first or the last of a stay, unless all have less."""
_FIRM: Final = 5.0
"""A slice with evidence above this has more than one detection, which is hardly ever false."""
_UNPLACED_HIT: Final = 2.0
"""What a hit from an unknown pose adds."""
_PRIOR: Final = 0.5
"""Hits, and messages without one, that each cell is taken to have had before (Jeffreys' prior)."""
_MISSED_BY_CHANCE: Final = 0.01
_LEFT_BY_CHANCE: Final = 0.05
_FEWEST_HITS: Final = 3
_RARE_OF: Final = 20
"""A cell sees a place if some hits in a row, or all, are in no more messages than so many each."""
_LEAST_RATE: Final = 0.1
"""In looks with a hit, a cell that sees a place has one in as many of the messages, at least."""
_MANY_LOOKS: Final = 10
_BLOCKED_SHARE: Final = 0.1
"""A cell with so many looks is blocked if its share of hits is below this part of the others'."""
_YAWS: Final = 3600 // CELL_DECIDEG
_VIEW_SHARE: Final = 0.02
"""What lies farther out at each side of a field of view is mistaken."""


class Cells:
    """The looks of all slices by cell: which looks were from where.

    Args:
        sights: of all slices.
        poor: which looks are not where they seem to be; those say nothing of others.
    """

    def __init__(self, sights: JoinedSights, poor: Flags) -> None:
        looks = sights.looks
        names = (Look.SLICE, Look.TOPIC, Look.X, Look.Y, Look.YAW, Look.PAN, Look.N)
        columns = (looks.columns[name] for name in names)
        self.slice, self.topic, self.x, self.y, self.yaw, self.pan, self.n = columns
        self._first, self.last = looks[:, Look.FIRST], looks[:, Look.LAST]
        cells, cell = distinct_rows([*map(narrowed, self._grid(sights, poor))])
        poses = (self.x, self.y, self.yaw / 10.0)
        self.cell = narrowed(_joined(cells, cell, poses, self.n)[cell])
        order = np.argsort(self.cell, kind="stable")  # of 16 bits it is much faster
        self._by_cell = narrowed(order)
        self._slice_starts = begins_of(self.slice, len(sights.epochs))
        self.looks_in = np.bincount(self.cell)
        self.messages_in = np.bincount(self.cell, self.n).astype(np.int64)
        self._starts = np.cumsum(self.looks_in) - self.looks_in
        # How many messages looks from the same cell before have, and those of other cells.
        self.messages_before = np.empty(len(order), np.int64)
        self.messages_before[order] = np.cumsum(self.n[order], dtype=np.int64) - self.n[order]
        after, before = order[1:], order[:-1]
        is_next = self.cell[after] == self.cell[before]
        is_next &= np.diff(self.slice[order].astype(np.int64)) <= 1
        previous = np.full(len(order), -1, np.int64)
        previous[after] = np.where(is_next, before, -1)
        self._previous = narrowed(previous)

    def _grid(self, sights: JoinedSights, poor: Flags) -> Iterator[Ints]:
        """Yields yaw, x and y of looks in the grid of cells, and what else tells cells apart."""
        looks = sights.looks
        for name, size in ((Look.YAW, CELL_DECIDEG), (Look.X, CELL_MM), (Look.Y, CELL_MM)):
            yield looks[:, name] // size
        yield self.topic + poor * np.int64(len(sights.topics) + 1)
        yield sights.epochs[self.slice]
        yield looks[:, Look.PAN] // CELL_DECIDEG
        yield (looks[:, Look.Z] + STOREY_MM // 2) // STOREY_MM

    @property
    def looks(self) -> Looks:
        """What answers need of the looks."""
        return Looks(self.slice, self._first, self.last, self.x, self.y, self.yaw, self.cell)

    def looks_from(self, cells: Ints) -> Ints:
        """Returns all looks from some cells of places, by cell."""
        cell = _number(cells)
        looks = self._by_cell[in_ranges(self._starts[cell], self.looks_in[cell])]
        return _keys(np.repeat(_place(cells), self.looks_in[cell]), looks)

    def looks_during(self, slices: Ints) -> Ints:
        """Returns all looks of some slices of places, by slice."""
        start, stop = (self._slice_starts[_number(slices) + nth] for nth in (0, 1))
        looks = in_ranges(start, stop - start)
        return _keys(np.repeat(_place(slices), stop - start), looks)

    def totals_in(self, looks: Ints, unplaced: Ints) -> Ints:
        """Returns how many detections without a place the slice and topic of each look have."""
        topics = np.int64(self.topic.max(initial=0)) + 1
        keys, n = _totals(
            unplaced[:, Unplaced.SLICE] * topics + unplaced[:, Unplaced.TOPIC],
            unplaced[:, Unplaced.N],
        )
        look_keys = self.slice[looks] * topics + self.topic[looks]
        rows, has_total = places_among(look_keys, keys)
        return np.where(has_total, np.append(n, 0)[rows], 0)

    def looked_in(self, number: int) -> Ns | None:
        """Returns when the first look of a slice ended; None without any."""
        start, stop = self._slice_starts[number : number + 2].tolist()
        return int(self.last[start:stop].min()) if start < stop else None

    def cells_of(self, looks: Ints) -> Ints:
        """Returns the cells of looks of places."""
        return _keys(_place(looks), self.cell[_number(looks)])

    def repeated_misses(self, looks: Ints, hits: Ints) -> Flags:
        """Returns which looks without a hit repeat the previous one, which had none either.

        The one before, from the same cell, is no older than the slice before.
        """
        previous = self._previous[_number(looks)]
        is_repeated: Flags = (hits == 0) & (previous >= 0)
        rows = np.flatnonzero(is_repeated)
        before = _keys(_place(looks[rows]), previous[rows])
        _, has_hit = places_among(before, looks[hits > 0])
        is_repeated[rows] = ~has_hit
        return is_repeated

    def seen_at(self, looks: Ints, x: Floats | Ints, y: Floats | Ints) -> tuple[Floats, Floats]:
        """Returns how far (mm) and where (degrees from ahead) the place of each look was."""
        dx, dy = x - self.x[looks], y - self.y[looks]
        bearing = (np.degrees(np.arctan2(dy, dx)) - self.heading(looks) + 180.0) % 360.0 - 180.0
        return np.hypot(dx, dy), bearing

    def heading(self, looks: Ints) -> Floats:
        """Returns where the detector of each look was turned to (degrees)."""
        return self.yaw[looks] / 10.0 + self.pan[looks] / 10.0


def _joined(cells: Ints, cell: Ints, poses: Sequence[Ints | Floats], n: Ints) -> Ints:
    """Returns for each cell of a grid the one that it is part of: the heaviest near it, or itself.

    A robot that often stands at one pose, and so at the border of several, looks from one cell.

    Args:
        cells: yaw, x and y in the grid, and what else tells cells apart.
        cell: of each look.
        poses: x, y (mm) and yaw (degrees) of each look.
        n: the messages of each look.
    """
    weight = np.bincount(cell, n)
    x, y, yaw = (np.bincount(cell, n * axis.astype(np.float64)) / weight for axis in poses)
    rank = np.argsort(np.argsort(weight, kind="stable"), kind="stable")
    best = rank.copy()
    # With room for a step: what is in order, and each step from it, is found quickest.
    sizes = cells.max(axis=0, initial=0) - cells.min(axis=0, initial=0) + 3
    keys, weights = _hashed(cells, sizes), _hashed(np.eye(3, cells.shape[1], dtype=np.int64), sizes)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    for step in [*product((-1, 0, 1), repeat=3)][14:]:  # the others are from those to these
        turned = (cells[:, 0] + step[0]) % _YAWS - cells[:, 0]
        wanted = keys + turned * weights[0] + weights[1:] @ step[1:]
        place, is_there = places_among(wanted, ordered)
        one = np.flatnonzero(is_there & (cells[:, 0] >= 0))
        other = order[place[one]]
        turn = np.abs((yaw[other] - yaw[one] + 180.0) % 360.0 - 180.0)
        near = (turn < CELL_DECIDEG / 10) & (
            np.hypot(x[other] - x[one], y[other] - y[one]) < CELL_MM
        )
        one, other = one[near], other[near]
        best[one] = np.maximum(best[one], rank[other])
        best[other] = np.maximum(best[other], rank[one])
    leader = np.argsort(rank, kind="stable")[best]
    return np.where(leader[leader] == leader, leader, np.arange(len(cells)))


def _hashed(rows: Ints, sizes: Ints) -> Ints:
    """Returns a number for each row, in their order unless there may be too many of them."""
    numbers = np.zeros(len(rows), np.int64)
    for column, size in zip(rows.T, sizes, strict=True):
        numbers = numbers * size + column
    return numbers


def fields_of_view(topic: Ints, distance: Floats, bearing: Floats, n: Ints, topics: int) -> Floats:
    """Returns how far (mm), and from and to which directions (degrees), detectors see.

    That is for each of so many topics where nearly all its detections lie: `n` at each.
    """
    fields = np.full((topics, 3), -1.0)
    for number in np.flatnonzero(np.bincount(topic)).tolist():
        rows = topic == number
        [far] = _weighted_quantiles(distance[rows], n[rows], 1 - _VIEW_SHARE)
        sides = _weighted_quantiles(bearing[rows], n[rows], _VIEW_SHARE, 1 - _VIEW_SHARE)
        fields[number] = far, *sides
    return fields


def _weighted_quantiles(values: Floats, n: Ints, *shares: float) -> list[float]:
    order = np.argsort(values)
    running = np.cumsum(n[order])
    ranks = [int(np.searchsorted(running, share * running[-1])) for share in shares]
    return [float(values[order[min(rank, len(order) - 1)]]) for rank in ranks]


class Evidence(NamedTuple):
    """The evidence for the places of a label: the looks at each, and those that saw it there.

    Looks are from cells that saw it at least once. Of a cell that does not see it, but for a false
    detection once in a while, only those are here that are in a slice in which it was seen.

    Attributes:
        looks: their places and numbers, as keys in order.
        cell: of each look; cells are numbered for each place.
        n: how many messages of each of these looks say whether it was there: those that have the
            label without a place do not.
        hits: how many messages of each of these looks have the label there.
        blind: the places and slices, as keys in order, of hits by messages without a known pose.
        times: how many hits each of these has.
        sees: whether each of the looks is from a cell that sees the place.
        fair: whether a look that has no hit could have: from a cell that sees the place, and with
            the place well inside the field of view.
    """

    looks: Ints
    cell: Ints
    n: Ints
    hits: Ints
    blind: Ints
    times: Ints
    sees: Flags
    fair: Flags

    def at(self, place: int) -> Evidence:
        """Returns that of the looks at one place alone, in few bytes, with their numbers."""
        ends = np.array([place, place + 1]) << _BITS
        looks = slice(*np.searchsorted(self.looks, ends).tolist())
        of_looks = (_number(self.looks[looks]), self.cell[looks], self.n[looks], self.hits[looks])
        number, cell, n, hits = map(narrowed, of_looks)
        sees, fair, none = self.sees[looks].copy(), self.fair[looks].copy(), self.blind[:0]
        return Evidence(number, cell, n, hits, none, none, sees, fair)


class Looks(NamedTuple):
    """When and from where detectors looked: columns as in `Look`; `cell` is as in `Cells`."""

    slice: Ints
    first: Ints
    last: Ints
    x: Ints
    y: Ints
    yaw: Ints
    cell: Ints


class Stay(NamedTuple):
    """A time at a place: the slices of the first and the last sighting, and what came after.

    `messages` are those of the looks that saw it, `clear_hits` the hits from cells that see it.
    Between the slices `firm_first` and `firm_last` single detections, which may be false, are not
    needed to see it there.
    `left` is the slice by which it was seen to be gone (chance of missing it below 5 %), or None.
    """

    first_slice: int
    last_slice: int
    firm_first: int
    firm_last: int
    hits: int
    clear_hits: int
    messages: int
    left: int | None


def evidence_at(
    cells: Cells,
    fields: Floats,
    places: Floats,
    rows: Ints,
    place: Ints,
    *,
    unplaced: Sequence[Ints],
    label: Ints,
) -> Evidence:
    """Returns the evidence on places (mm) from rows of `Hit` with `SPOT` as the slice.

    `fields` are as of `fields_of_view`, `place` has the number of the place of each row, `label`
    that of the label of each place, and `unplaced` the rows of each label.
    """
    has_look, n = rows[:, Hit.LOOK] >= 0, rows[:, Hit.N]
    blind, times = _totals(_keys(place, rows[:, Hit.SPOT])[~has_look], n[~has_look])
    hit_looks, hits_of = _totals(_keys(place, rows[:, Hit.LOOK])[has_look], n[has_look])
    messages = cells.n[_number(hit_looks)]
    np.minimum(hits_of, messages, out=hits_of)
    hit_cells, cell_of = np.unique(cells.cells_of(hit_looks), return_inverse=True)
    sees = _sees(cells, hit_cells, cell_of, _number(hit_looks), hits_of)
    # From a dock, ten thousands of looks are at each place of which it once had a false detection.
    hit_slices = _keys(_place(hit_looks), cells.slice[_number(hit_looks)])
    beside = cells.looks_during(_distinct(np.concatenate((hit_slices, blind))))
    keys = cells.cells_of(beside)
    cell, is_of_one = places_among(keys, hit_cells)
    looks_in = cells.looks_in[_number(hit_cells[sees])]
    cell = np.concatenate((cell[is_of_one], np.repeat(np.flatnonzero(sees), looks_in)))
    looks = np.concatenate((beside[is_of_one], cells.looks_from(hit_cells[sees])))
    order = np.argsort(looks, kind="stable")
    order = order[np.diff(looks[order], prepend=-1) > 0]
    looks, cell = looks[order], cell[order]
    hits = np.zeros(len(looks), np.int64)
    hits[np.searchsorted(looks, hit_looks)] = hits_of
    look_sees = sees[cell]
    fair = look_sees.copy()
    fair[fair] = _are_in_view(cells, fields, places, looks[fair])
    numbers = _number(looks)
    n = cells.n[numbers].astype(np.int64)
    for nth in [nth for nth, rows_of_label in enumerate(unplaced) if len(rows_of_label)]:
        of_label = np.flatnonzero(label[_place(looks)] == nth)
        n[of_label] -= cells.totals_in(numbers[of_label], unplaced[nth])
    cell, n, hits = map(narrowed, (cell, np.maximum(n, hits), hits))
    return Evidence(looks, cell, n, hits, blind, times, look_sees, fair)


def _are_in_view(cells: Cells, fields: Floats, places: Floats, looks: Ints) -> Flags:
    """Returns which looks have their place (mm) in the field of view of their topic."""
    numbers = _number(looks)
    distance, bearing = cells.seen_at(numbers, *places[_place(looks)].T)
    far, left, right = fields[cells.topic[numbers]].T
    are_in_view: Flags = (distance <= far) & (bearing >= left) & (bearing <= right)
    return are_in_view


_BITS: Final = 32


def _keys(place: Ints, number: Ints) -> Ints:
    """Returns pairs of a place and the number of a look, a cell or a slice as one number each."""
    return (place << _BITS) | number


def _place(keys: Ints) -> Ints:
    return keys >> _BITS


def _number(keys: Ints) -> Ints:
    return keys & ((1 << _BITS) - 1)


def _distinct(keys: Ints) -> Ints:
    """Returns the distinct ones of keys that are mostly in order: `numpy.unique` takes longer."""
    ordered = np.sort(keys, kind="stable")
    return ordered[np.diff(ordered, prepend=-1) > 0]


def _totals(keys: Ints, n: Ints) -> tuple[Ints, Ints]:
    """Returns the distinct keys in order, and the sum of each."""
    distinct, row_of = np.unique(keys, return_inverse=True)
    return distinct, np.bincount(row_of, n, len(distinct)).astype(np.int64)


def _sees(cells: Cells, hit_cells: Ints, cell: Ints, hit_looks: Ints, hits: Ints) -> Flags:
    """Returns which cells see a place, not only report it falsely once in a while.

    `cell` has the number among these of each look that saw it, in order of time. From a dock that
    faces a wall, ten thousands of messages have some false detections behind it.
    """
    place, number = _place(hit_cells), _number(hit_cells)
    hits_in, messages = np.bincount(cell, hits, len(hit_cells)), cells.messages_in[number]
    looks, own_looks = cells.looks_in[number], np.bincount(cell, minlength=len(hit_cells))
    is_frequent = messages <= _RARE_OF * hits_in
    is_frequent[_in_a_row(cell, hits, cells.messages_before[hit_looks])] = True
    is_dense = hits_in >= _LEAST_RATE * np.bincount(cell, cells.n[hit_looks], len(hit_cells))
    # What other cells see most of the time, a cell that sees it does not miss nearly always.
    share, weight = own_looks / looks, np.minimum(looks, _MANY_LOOKS)
    others = np.bincount(place, weight)[place] - weight
    pooled = np.bincount(place, share * weight)[place] - share * weight
    is_blocked = looks >= _MANY_LOOKS
    is_blocked &= share < _BLOCKED_SHARE * (pooled / np.maximum(others, 1))
    return is_frequent & is_dense & ~is_blocked


def _in_a_row(cell: Ints, hits: Ints, messages_before: Ints) -> Ints:
    """Returns the cells of which `_FEWEST_HITS` in a row are in few messages.

    `hits` are those of each look of a cell, in order of time.
    """
    order = np.argsort(cell, kind="stable")
    cell, before = cell[order], messages_before[order]
    running = np.cumsum(hits[order])
    until = np.searchsorted(running, running - hits[order] + _FEWEST_HITS)
    begin = np.flatnonzero(until < len(cell))
    end = until[begin]
    is_row = (cell[end] == cell[begin]) & (before[end] - before[begin] <= _RARE_OF * _FEWEST_HITS)
    cells: Ints = cell[begin[is_row]]
    return cells


def stays_at(cells: Cells, evidence: Evidence) -> Iterator[tuple[int, Stay]]:
    """Yields the stays at places, each with the number of its place, in order of time."""
    slices, odds, *counts = _by_slice(cells, evidence)
    hits = counts[0]
    start, stop = _present(odds, _place(slices))
    run, rows = np.repeat(np.arange(len(start)), stop - start), in_ranges(start, stop - start)
    run, rows = run[hits[rows] > 0], rows[hits[rows] > 0]
    if not len(rows):
        return
    # A false detection or two beside a stay are no part of it.
    clearness = 1 + np.sum([odds[rows] >= least for least in (_CLEAR, _FIRM)], axis=0)
    most = Groups.of(distinct_rows([run])[1])
    clearest = np.repeat(most.ends(clearness)[1], most.sizes)
    first, last = _ends(run, rows, clearness >= np.minimum(clearest, 2))
    firm_first, firm_last = _ends(run, rows, clearness >= clearest)
    place, left = _place(slices[first]), []
    until = np.searchsorted(slices, (place + 1) << _BITS)
    for begin, end in zip((firm_last + 1).tolist(), until.tolist(), strict=True):
        gone = np.cumsum(odds[begin:end]) < math.log(_LEFT_BY_CHANCE)
        left.append(int(_number(slices[begin + gone.argmax()])) if gone.any() else None)
    sums = [np.append(0, np.cumsum(count)).astype(np.int64) for count in counts]
    totals = (count[last + 1] - count[first] for count in sums)
    ends = (_number(slices[row]) for row in (first, last, firm_first, firm_last))
    columns = (column.tolist() for column in (*ends, *totals))
    yield from zip(place.tolist(), map(Stay._make, zip(*columns, left, strict=True)), strict=True)


def _ends(run: Ints, rows: Ints, which: Flags) -> tuple[Ints, Ints]:
    """Returns the first and the last of those of some rows that are of each run."""
    run, rows = run[which], rows[which]
    return rows[np.diff(run, prepend=-1) != 0], rows[np.diff(run, append=-1) != 0]


def _by_slice(cells: Cells, evidence: Evidence) -> tuple[Ints, Floats, Ints, Ints, Ints]:
    """Returns the slices of places, as keys in order, with the evidence of each alone.

    That is the natural logarithm of the odds that it was there, how often it was seen, how often
    from cells that see the place, and the messages of the looks that saw it.
    """
    looks = _keys(_place(evidence.looks), cells.slice[_number(evidence.looks)])
    slices = _distinct(np.concatenate((looks, evidence.blind)))
    slice_of, blind = np.searchsorted(slices, looks), np.searchsorted(slices, evidence.blind)
    hit = np.flatnonzero(evidence.hits)  # few of them all
    weights = evidence.hits[hit], evidence.hits[hit] * evidence.sees[hit], evidence.n[hit]
    counts = [np.bincount(slice_of[hit], weight, len(slices)) for weight in weights]
    for count in counts:
        count[blind] += evidence.times
    hits, clear_hits, messages = counts
    by_look = _odds(cells, evidence, hit, np.flatnonzero((hits > 0)[slice_of]))
    odds = np.bincount(slice_of, by_look, len(slices)).astype(np.float64)
    odds[blind] += _UNPLACED_HIT * evidence.times
    return slices, odds.clip(-_MOST_BY_SLICE, _MOST_BY_SLICE), hits, clear_hits, messages


def _odds(cells: Cells, evidence: Evidence, hit: Ints, there: Ints) -> Floats:
    """Returns the natural logarithm of the odds for a thing by each look.

    `hit` are the looks that saw it, `there` those of slices in which it was seen: these tell how
    often each cell sees it while it is there.
    """
    cell, n, hits = evidence.cell, evidence.n, evidence.hits[hit]
    messages = np.bincount(cell[there], n[there], int(cell.max(initial=0)) + 1)
    rate = (np.bincount(cell[hit], hits, len(messages)) + _PRIOR) / (messages + 2 * _PRIOR)
    rate = rate.clip(2 * _FALSE_RATE, 0.98)
    for_hit, for_miss = np.log(rate / _FALSE_RATE), np.log((1 - rate) / (1 - _FALSE_RATE))
    odds: Floats = np.where(evidence.fair, n * for_miss[cell], 0.0)
    of_hits = hits * for_hit[cell[hit]] + (n[hit] - hits) * for_miss[cell[hit]]
    odds[hit] = np.where(evidence.fair[hit], of_hits, of_hits.clip(_LEAST_BLIND))
    is_repeated = cells.repeated_misses(evidence.looks, evidence.hits)
    np.multiply(odds, _STANDING, out=odds, where=is_repeated)
    return odds


def looks_without(
    every: Looks, evidence: Evidence, stay: Stay, seen_to: Ns, window: Span
) -> tuple[int, Ns | None]:
    """Returns how many messages of a window [start, stop) could have had a thing, and have not.

    And when the chance that all of them missed it fell below 1 %; None where it did not.
    `evidence` is that for this place alone.

    By the looks then from cells that saw it during the stay, up to `seen_to` or with a hit; each
    cell's own rate is known as well as its messages make it (a uniform prior).
    """
    looks, is_hit = evidence.looks, evidence.hits > 0
    slices, first, last = every.slice[looks], every.first[looks], every.last[looks]
    during = (slices >= stay.first_slice) & (slices <= stay.last_slice)
    during &= (last <= seen_to) | is_hit
    start, stop = window
    misses = (first >= start) & (last < stop) & evidence.fair & ~during & ~is_hit
    distinct, cell_of = np.unique(evidence.cell, return_inverse=True)
    hits, n = (
        np.bincount(cell_of[during], column[during], len(distinct))
        for column in (evidence.hits, evidence.n)
    )
    alphas, betas = (1.0 + hits).tolist(), (1.0 + n - hits).tolist()
    log_chance, messages = 0.0, 0
    crossed: Ns | None = None
    for look in np.flatnonzero(misses).tolist():
        cell, n_missed = int(cell_of[look]), int(evidence.n[look])
        alpha, beta = alphas[cell], betas[cell]
        if alpha <= 1.0:
            continue
        # The chance of so many misses in a row, by a beta distribution of the rate.
        log_chance += (
            math.lgamma(beta + n_missed)
            - math.lgamma(beta)
            + math.lgamma(alpha + beta)
            - math.lgamma(alpha + beta + n_missed)
        )
        betas[cell] += n_missed
        messages += n_missed
        if crossed is None and log_chance < math.log(_MISSED_BY_CHANCE):
            crossed = int(last[look])
    return messages, crossed


def _present(by_slice: Floats, place: Ints) -> tuple[Ints, Ints]:
    """Returns where the likeliest runs of slices in which a thing was there begin and end."""
    # Slices of one sign have one state: fewer steps than slices.
    is_positive = by_slice >= 0
    is_first = np.diff(place, prepend=-1) != 0
    starts = np.flatnonzero(is_first | np.diff(is_positive, prepend=is_positive[:1]))
    if not len(starts):
        return starts, starts
    sums = np.add.reduceat(by_slice, starts).tolist()
    spans = pairwise([*np.flatnonzero(is_first[starts]).tolist(), len(starts)])
    states = chain.from_iterable(_states(sums[begin:end]) for begin, end in spans)
    is_there = np.fromiter(states, np.bool_, len(starts))
    begins = is_there & (is_first[starts] | ~np.append(False, is_there[:-1]))
    ends = is_there & np.append(is_first[starts[1:]] | ~is_there[1:], True)
    return starts[begins], np.append(starts, len(place))[1:][ends]


def _states(sums: Sequence[float]) -> Sequence[bool]:
    """Returns in which runs of slices a thing was there, by the evidence of each."""
    absent, present = 0.0, -_SWITCH / 4
    came_from: list[tuple[bool, bool]] = []
    for value in sums:
        to_absent, to_present = present - _SWITCH, absent - _SWITCH
        came_from.append((to_absent > absent, to_present <= present))
        absent, present = max(absent, to_absent), max(present, to_present) + value
    state = present > absent
    states = []
    for from_present, stays_present in reversed(came_from):
        states.append(state)
        state = stays_present if state else from_present
    return states[::-1]

"""When a label was at a place: from what was seen there, and from what was not seen.

What was seen is known by slice (`analysis.sights`): 10 s of the clock.
A *cell* is a pose of the robot and its detector, to 25 cm and 10 degrees around where it often is,
and to 20 degrees of how it leans: a robot that sits, or lies on its side, sees other things.
The *rate* of a cell is how often its messages have the label while the thing is at the place. A
look without a hit, from a cell that saw the place before, is evidence of absence: the higher the
rate, the stronger. A hit is evidence of presence: the rarer false detections, the stronger. A
message that has the label somewhere unknown is no evidence. The likeliest sequence of presence and
absence (Viterbi, two states) gives the stays.
"""

from __future__ import annotations

import math
from itertools import chain, pairwise, product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import (
    CELL_DECIDEG,
    CELL_MM,
    Floats,
    Hit,
    Look,
    Unplaced,
    height_cells,
)
from ros2_memory.core.arrays import (
    Flags,
    Groups,
    Ints,
    begins_of,
    distinct,
    distinct_rows,
    in_ranges,
    narrowed,
    places_among,
    range_numbers,
    stable_order,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.timebase import Ns


_FALSE_RATE: Final = 0.01
"""How often a message has a label at a place where there is no such thing."""
_SWITCH: Final = 4.0
"""Natural logarithm of the odds against a change between two slices."""
_MOST_BY_SLICE: Final = 10.0
"""The most evidence in one slice: its messages share their errors."""
_STANDING: Final = 0.2
"""A robot that stands looks at the same thing behind the same obstacle."""
_LEAST_BLIND: Final = -2.0
"""The most that a look with hits says against a thing, if its cell hardly sees the place."""
_CLEAR: Final = 1.5
"""A slice with less evidence is not the first or last of a stay, unless all slices have less."""
_FIRM: Final = 5.0
"""A slice with evidence above this has more than one detection, which is hardly ever false."""
_UNPLACED_HIT: Final = 2.0
"""The evidence of a hit from an unknown pose."""
_PRIOR: Final = 0.5
"""The hits, and the messages without one, that each cell begins with (Jeffreys' prior)."""
_LEFT_BY_CHANCE: Final = 0.05
_FEWEST_HITS: Final = 3
_RARE_OF: Final = 20
"""A cell sees a place if one message in twenty has a hit: over all, or over a row of hits."""
_LEAST_RATE: Final = 0.1
"""The least share of messages with a hit, in the looks with hits of a cell that sees a place."""
_MANY_LOOKS: Final = 10
_BLOCKED_SHARE: Final = 0.1
"""A cell with many looks is blocked if its share of hits is below a tenth of the others' share."""
_YAWS: Final = 3600 // CELL_DECIDEG


class Cells:
    """The looks of all slices, and the cell that each is from.

    Attributes:
        slice, topic, x, y, yaw, pan, n, last: columns of the looks, as in `Look`.
        cell: the number of each look's cell.
        looks_in: how many looks each cell has; `messages_in` how many messages.
        messages_before: for each look, how many messages the looks before it have, by cell.

    Args:
        sights: the sights of all slices.
        poor: which looks are not where they seem to be: they are in cells of their own.
    """

    def __init__(self, sights: JoinedSights, poor: Flags) -> None:
        looks = sights.looks
        names = (Look.SLICE, Look.TOPIC, Look.X, Look.Y, Look.YAW, Look.PAN, Look.N)
        columns = (looks.columns[name] for name in names)
        self.slice, self.topic, self.x, self.y, self.yaw, self.pan, self.n = columns
        self._first, self.last = looks[:, Look.FIRST], looks[:, Look.LAST]
        cells, cell = distinct_rows([*map(narrowed, self._grid(sights, poor))])
        poses = (self.x, self.y, self.yaw / 10.0)
        self.cell = narrowed(_joined_cells(cells, cell, poses, self.n)[cell])
        order, self._starts, self.looks_in = Groups.of(self.cell)  # much faster in 16 bits
        self._by_cell = narrowed(order)
        self._slice_starts = begins_of(self.slice, len(sights.epochs))
        self.messages_in = np.bincount(self.cell, self.n).astype(np.int64)
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
        yield height_cells(looks[:, Look.Z])
        yield looks[:, Look.LEAN]

    @property
    def looks(self) -> Looks:
        """The columns of looks that answers need."""
        times = self.slice, self._first, self.last
        return Looks(*times, self.x, self.y, self.yaw, self.cell, self.topic, self.n)

    def looks_from(self, cells: Ints) -> Ints:
        """Returns all looks from cells, as keys of places."""
        cell = _number(cells)
        looks = self._by_cell[in_ranges(self._starts[cell], self.looks_in[cell])]
        return _keys(np.repeat(_place(cells), self.looks_in[cell]), looks)

    def looks_during(self, slices: Ints) -> Ints:
        """Returns all looks in slices, as keys of places."""
        start, stop = (self._slice_starts[_number(slices) + nth] for nth in (0, 1))
        looks = in_ranges(start, stop - start)
        return _keys(np.repeat(_place(slices), stop - start), looks)

    def totals_in(self, looks: Ints, unplaced: Ints) -> Ints:
        """Returns how many detections without a place are in each look's slice and topic."""
        topics = np.int64(self.topic.max(initial=0)) + 1
        keys, n = _totals(
            unplaced[:, Unplaced.SLICE] * topics + unplaced[:, Unplaced.TOPIC],
            unplaced[:, Unplaced.N],
        )
        look_keys = self.slice[looks] * topics + self.topic[looks]
        rows, has_total = places_among(look_keys, keys)
        return np.where(has_total, np.append(n, 0)[rows], 0)

    def looked_in(self, number: int) -> Ns | None:
        """Returns when the first look of a slice ended (ns); None if the slice has no look."""
        start, stop = self._slice_starts[number : number + 2].tolist()
        return int(self.last[start:stop].min()) if start < stop else None

    def cells_of(self, looks: Ints) -> Ints:
        """Returns the cells of looks, as keys of places."""
        return _keys(_place(looks), self.cell[_number(looks)])

    def repeated_misses(self, looks: Ints, hits: Ints) -> Flags:
        """Returns which looks without a hit follow another one without, from the same cell.

        The other look must be in the same slice or in the one before.
        """
        previous = self._previous[_number(looks)]
        is_repeated: Flags = (hits == 0) & (previous >= 0)
        rows = np.flatnonzero(is_repeated)
        before = _keys(_place(looks[rows]), previous[rows])
        _, has_hit = places_among(before, looks[hits > 0])
        is_repeated[rows] = ~has_hit
        return is_repeated

    def seen_at(self, looks: Ints, x: Floats | Ints, y: Floats | Ints) -> tuple[Floats, Floats]:
        """Returns the distance (mm) and the direction (degrees from ahead) of each look's place."""
        dx, dy = x - self.x[looks], y - self.y[looks]
        return np.hypot(dx, dy), half_turns(np.degrees(np.arctan2(dy, dx)) - self.heading(looks))

    def heading(self, looks: Ints) -> Floats:
        """Returns where the detector of each look was turned to (degrees)."""
        return self.yaw[looks] / 10.0 + self.pan[looks] / 10.0


def _joined_cells(cells: Ints, cell: Ints, poses: Sequence[Ints | Floats], n: Ints) -> Ints:
    """Returns for each cell of a grid the cell that it joins: the heaviest near it, or itself.

    A robot that often stands at the border of several cells looks from one cell all the same.

    Args:
        cells: yaw, x and y in the grid, and what else tells cells apart.
        cell: the cell of each look.
        poses: x, y (mm) and yaw (degrees) of each look.
        n: the messages of each look.
    """
    weight = np.bincount(cell, n)
    x, y, yaw = (np.bincount(cell, n * axis.astype(np.float64)) / weight for axis in poses)
    rank = stable_order(stable_order(weight))
    best = rank.copy()
    # With room for a step in each column, steps are differences of keys.
    sizes = cells.max(axis=0, initial=0) - cells.min(axis=0, initial=0) + 3
    keys = _row_keys(cells, sizes)
    step_keys = _row_keys(np.eye(3, cells.shape[1], dtype=np.int64), sizes)
    order = stable_order(keys)
    ordered = keys[order]
    for step in [*product((-1, 0, 1), repeat=3)][14:]:  # each pair of cells once
        turned = (cells[:, 0] + step[0]) % _YAWS - cells[:, 0]
        neighbour = keys + turned * step_keys[0] + step_keys[1:] @ step[1:]
        place, is_there = places_among(neighbour, ordered)
        one = np.flatnonzero(is_there & (cells[:, 0] >= 0))
        other = order[place[one]]
        turn = np.abs(half_turns(yaw[other] - yaw[one]))
        away = np.hypot(x[other] - x[one], y[other] - y[one])
        near = (turn < CELL_DECIDEG / 10) & (away < CELL_MM)
        one, other = one[near], other[near]
        best[one] = np.maximum(best[one], rank[other])
        best[other] = np.maximum(best[other], rank[one])
    leader = stable_order(rank)[best]
    return np.where(leader[leader] == leader, leader, np.arange(len(cells)))


def _row_keys(rows: Ints, sizes: Ints) -> Ints:
    """Returns a number for each row, in the order of rows unless the numbers overflow."""
    numbers = np.zeros(len(rows), np.int64)
    for column, size in zip(rows.T, sizes, strict=True):
        numbers = numbers * size + column
    return numbers


class Evidence(NamedTuple):
    """The looks at the places of a label, and how many of their messages have it there.

    A look is from a cell with at least one hit. Some cells do not see the place, and have a false
    detection once in a while: of these only the looks in slices with a hit are here.

    Attributes:
        looks: the place and the number of each look, as keys in order.
        cell: each look's cell, numbered for each place.
        n: how many messages of each look say whether the label was there. A message that has the
            label without a place does not.
        hits: how many messages of each look have the label there.
        blind: the places and slices, as keys in order, with hits from an unknown pose.
        times: how many such hits each of them has.
        sees: whether each look is from a cell that sees the place.
        fair: whether each look could have had a hit: its cell sees the place, and the place is well
            inside the field of view.
    """

    looks: Ints
    cell: Ints
    n: Ints
    hits: Ints
    blind: Ints
    times: Ints
    sees: Flags
    fair: Flags

    def at_place(self, place: int) -> Evidence:
        """Returns the evidence of the looks at one place, without its number in their keys."""
        own = slice(*np.searchsorted(self.looks, np.array([place, place + 1]) << _BITS).tolist())
        columns = (_number(self.looks[own]), self.cell[own], self.n[own], self.hits[own])
        none = self.blind[:0]
        # Copied, so that the evidence of all other places is freed.
        flags = (self.sees[own].copy(), self.fair[own].copy())
        return Evidence._make((*map(narrowed, columns), none, none, *flags))


class Looks(NamedTuple):
    """When and from where detectors looked: columns as in `Look`, and `cell` as in `Cells`."""

    slice: Ints
    first: Ints
    last: Ints
    x: Ints
    y: Ints
    yaw: Ints
    cell: Ints
    topic: Ints
    n: Ints


class Stay(NamedTuple):
    """A time at a place.

    Attributes:
        place: the number of the place.
        first_slice, last_slice: the slices of the first and the last sighting.
        firm_first, firm_last: the slices of the first and the last sighting beyond doubt.
        hits: the detections; `clear_hits` are those from cells that see the place.
        messages: the messages of the looks with hits.
        left: the slice by which it was seen to be gone (chance of missing it below 5 %), or None.
    """

    place: int
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
    """Returns the evidence for places.

    Args:
        cells: the looks.
        fields: the field of view of each topic; see `Observations.fields`.
        places: x and y (mm) of each place.
        rows: the hits as rows of `Hit`, with the slice in place of `SPOT`.
        place: the number of each hit's place.
        unplaced: for each label its rows of `Unplaced`.
        label: the number of each place's label.
    """
    has_look, n = rows[:, Hit.LOOK] >= 0, rows[:, Hit.N]
    blind, times = _totals(_keys(place, rows[:, Hit.SPOT])[~has_look], n[~has_look])
    hit_looks, hits_of = _totals(_keys(place, rows[:, Hit.LOOK])[has_look], n[has_look])
    np.minimum(hits_of, cells.n[_number(hit_looks)], out=hits_of)
    hit_cells, cell_of = np.unique(cells.cells_of(hit_looks), return_inverse=True)
    sees = _seeing_cells(cells, hit_cells, cell_of, _number(hit_looks), hits_of)
    # All looks from cells that see the place, and from other cells the looks in slices with hits: a
    # robot in its dock has ten thousands of looks at each place with one false detection.
    hit_slices = _keys(_place(hit_looks), cells.slice[_number(hit_looks)])
    beside = cells.looks_during(distinct(np.concatenate((hit_slices, blind))))
    cell, has_hits = places_among(cells.cells_of(beside), hit_cells)
    looks_in = cells.looks_in[_number(hit_cells[sees])]
    cell = np.concatenate((cell[has_hits], np.repeat(np.flatnonzero(sees), looks_in)))
    looks = np.concatenate((beside[has_hits], cells.looks_from(hit_cells[sees])))
    order = stable_order(looks)
    order = order[np.diff(looks[order], prepend=-1) > 0]
    looks, cell = looks[order], cell[order]
    hits = np.zeros(len(looks), np.int64)
    hits[np.searchsorted(looks, hit_looks)] = hits_of
    look_sees = sees[cell]
    fair = look_sees.copy()
    fair[fair] = _are_in_view(cells, fields, places, looks[fair])
    numbers = _number(looks)
    n = cells.n[numbers].astype(np.int64)
    for nth_label, rows_of_label in enumerate(unplaced):
        if len(rows_of_label):
            of_label = np.flatnonzero(label[_place(looks)] == nth_label)
            n[of_label] -= cells.totals_in(numbers[of_label], rows_of_label)
    return Evidence(
        looks,
        narrowed(cell),
        narrowed(np.maximum(n, hits)),
        narrowed(hits),
        blind,
        times,
        look_sees,
        fair,
    )


def _are_in_view(cells: Cells, fields: Floats, places: Floats, looks: Ints) -> Flags:
    """Returns which looks have their place in the field of view of their topic."""
    numbers = _number(looks)
    distance, bearing = cells.seen_at(numbers, *places[_place(looks)].T)
    far, middle, left, right = fields[cells.topic[numbers]].T
    beside = half_turns(bearing - middle)
    are_in_view: Flags = (distance <= far) & (beside >= left) & (beside <= right)
    return are_in_view


def half_turns(degrees: Floats) -> Floats:
    """Returns angles as at most half a turn to either side: -180 to below 180 degrees."""
    return (degrees + 180.0) % 360.0 - 180.0


_BITS: Final = 32


def _keys(place: Ints, number: Ints) -> Ints:
    """Returns a place and the number of a look, a cell or a slice as one key each."""
    return (place << _BITS) | number


def _place(keys: Ints) -> Ints:
    return keys >> _BITS


def _number(keys: Ints) -> Ints:
    return keys & ((1 << _BITS) - 1)


def _totals(keys: Ints, n: Ints) -> tuple[Ints, Ints]:
    """Returns the distinct keys in order, and the sum of `n` for each."""
    distinct, row_of = np.unique(keys, return_inverse=True)
    return distinct, np.bincount(row_of, n, len(distinct)).astype(np.int64)


def _seeing_cells(cells: Cells, hit_cells: Ints, cell: Ints, hit_looks: Ints, hits: Ints) -> Flags:
    """Returns which cells with hits see their place, and do not only report it falsely at times.

    From a dock that faces a wall, ten thousands of messages have some false detections behind it.

    Args:
        cells: the looks.
        hit_cells: the cells, as keys of places.
        cell: for each look with hits, which of these cells it is from, in order of time.
        hit_looks: the numbers of these looks.
        hits: how many hits each of these looks has.
    """
    place, number = _place(hit_cells), _number(hit_cells)
    hits_in, messages = np.bincount(cell, hits, len(hit_cells)), cells.messages_in[number]
    looks, own_looks = cells.looks_in[number], np.bincount(cell, minlength=len(hit_cells))
    is_frequent = messages <= _RARE_OF * hits_in
    is_frequent[_cells_with_rows_of_hits(cell, hits, cells.messages_before[hit_looks])] = True
    is_dense = hits_in >= _LEAST_RATE * np.bincount(cell, cells.n[hit_looks], len(hit_cells))
    # If other cells see the place most of the time, a cell that misses it nearly always is blocked.
    share, weight = own_looks / looks, np.minimum(looks, _MANY_LOOKS)
    others = np.bincount(place, weight)[place] - weight
    pooled = np.bincount(place, share * weight)[place] - share * weight
    is_blocked = looks >= _MANY_LOOKS
    is_blocked &= share < _BLOCKED_SHARE * (pooled / np.maximum(others, 1))
    return is_frequent & is_dense & ~is_blocked


def _cells_with_rows_of_hits(cell: Ints, hits: Ints, messages_before: Ints) -> Ints:
    """Returns the cells with `_FEWEST_HITS` hits within few messages.

    `cell` and `hits` are of looks, in order of time for each cell.
    """
    order = stable_order(cell)
    cell, before = cell[order], messages_before[order]
    running = np.cumsum(hits[order])
    until = np.searchsorted(running, running - hits[order] + _FEWEST_HITS)
    begin = np.flatnonzero(until < len(cell))
    end = until[begin]
    is_row = (cell[end] == cell[begin]) & (before[end] - before[begin] <= _RARE_OF * _FEWEST_HITS)
    cells: Ints = cell[begin[is_row]]
    return cells


def stays_at(cells: Cells, evidence: Evidence) -> Iterator[Stay]:
    """Yields the stays at places, by place and in order of time."""
    by_slice = _slice_evidence(cells, evidence)
    slices, odds = by_slice.slices, by_slice.odds
    start, stop = _runs_of_presence(odds, _place(slices))
    run, rows = range_numbers(stop - start), in_ranges(start, stop - start)
    has_hits = by_slice.counts[0, rows] > 0
    run, rows = run[has_hits], rows[has_hits]
    if not len(rows):
        return
    # 1, 2 or 3: a false detection or two beside a stay do not belong to it.
    clearness = 1 + (odds[rows] >= _CLEAR).astype(np.int64) + (odds[rows] >= _FIRM)
    by_run = Groups.of(distinct_rows([run])[1])
    clearest = np.repeat(by_run.ends(clearness)[1], by_run.sizes)
    first, last = _run_ends(run, rows, clearness >= np.minimum(clearest, 2))
    firm_first, firm_last = _run_ends(run, rows, clearness >= clearest)
    own_slices = [_number(slices[ends]) for ends in (first, last, firm_first, firm_last)]
    before = np.pad(np.cumsum(by_slice.counts, axis=1), ((0, 0), (1, 0)))
    counts = before[:, last + 1] - before[:, first]
    place = _place(slices[first])
    begin, end = firm_last + 1, np.searchsorted(slices, (place + 1) << _BITS)
    columns = (begin, end, place, *own_slices, *counts)
    for after, stop, *row in zip(*(column.tolist() for column in columns), strict=True):
        is_gone = np.cumsum(odds[after:stop]) < math.log(_LEFT_BY_CHANCE)
        left = int(_number(slices[after + is_gone.argmax()])) if is_gone.any() else None
        yield Stay._make((*row, left))


def _run_ends(run: Ints, rows: Ints, which: Flags) -> tuple[Ints, Ints]:
    """Returns the first and the last selected row of each run."""
    run, rows = run[which], rows[which]
    return rows[np.diff(run, prepend=-1) != 0], rows[np.diff(run, append=-1) != 0]


class _SliceEvidence(NamedTuple):
    """The evidence in each slice of a place alone.

    Attributes:
        slices: the places and slices, as keys in order.
        odds: the natural logarithm of the odds that the label was there.
        counts: the detections, those from cells that see the place, and the messages of the looks
            with hits, as three rows.
    """

    slices: Ints
    odds: Floats
    counts: Ints


def _slice_evidence(cells: Cells, evidence: Evidence) -> _SliceEvidence:
    looks = _keys(_place(evidence.looks), cells.slice[_number(evidence.looks)])
    slices = distinct(np.concatenate((looks, evidence.blind)))
    slice_of, blind = np.searchsorted(slices, looks), np.searchsorted(slices, evidence.blind)
    hit = np.flatnonzero(evidence.hits)  # a few of all looks
    weights = evidence.hits[hit], evidence.hits[hit] * evidence.sees[hit], evidence.n[hit]
    sums = [np.bincount(slice_of[hit], weight, len(slices)) for weight in weights]
    counts = np.array(sums, np.int64)
    counts[:, blind] += evidence.times
    look_odds = _look_odds(cells, evidence, hit, np.flatnonzero((counts[0] > 0)[slice_of]))
    odds = np.bincount(slice_of, look_odds, len(slices)).astype(np.float64)
    odds[blind] += _UNPLACED_HIT * evidence.times
    return _SliceEvidence(slices, odds.clip(-_MOST_BY_SLICE, _MOST_BY_SLICE), counts)


def _look_odds(cells: Cells, evidence: Evidence, hit: Ints, there: Ints) -> Floats:
    """Returns the natural logarithm of the odds for presence by each look.

    `hit` are the looks with hits. `there` are all looks in slices with hits: they tell how often
    each cell sees the label while it is there.
    """
    cell, n, hits = evidence.cell, evidence.n, evidence.hits[hit]
    messages = np.bincount(cell[there], n[there], int(cell.max(initial=0)) + 1)
    rate = (np.bincount(cell[hit], hits, len(messages)) + _PRIOR) / (messages + 2 * _PRIOR)
    rate = rate.clip(2 * _FALSE_RATE, 1 - 2 * _FALSE_RATE)
    for_hit, for_miss = np.log(rate / _FALSE_RATE), np.log((1 - rate) / (1 - _FALSE_RATE))
    odds: Floats = np.where(evidence.fair, n * for_miss[cell], 0.0)
    of_hits = hits * for_hit[cell[hit]] + (n[hit] - hits) * for_miss[cell[hit]]
    odds[hit] = np.where(evidence.fair[hit], of_hits, of_hits.clip(_LEAST_BLIND))
    is_repeated = cells.repeated_misses(evidence.looks, evidence.hits)
    np.multiply(odds, _STANDING, out=odds, where=is_repeated)
    return odds


def _runs_of_presence(odds: Floats, place: Ints) -> tuple[Ints, Ints]:
    """Returns where the likeliest runs of slices with the thing present begin and end."""
    # Consecutive slices of one sign have one state: that leaves fewer steps.
    is_positive = odds >= 0
    is_first = np.diff(place, prepend=-1) != 0
    starts = np.flatnonzero(is_first | np.diff(is_positive, prepend=is_positive[:1]))
    if not len(starts):
        return starts, starts
    sums = np.add.reduceat(odds, starts).tolist()
    spans = pairwise([*np.flatnonzero(is_first[starts]).tolist(), len(starts)])
    states = chain.from_iterable(_likeliest_states(sums[begin:end]) for begin, end in spans)
    is_there = np.fromiter(states, np.bool_, len(starts))
    begins = is_there & (is_first[starts] | ~np.append(False, is_there[:-1]))
    ends = is_there & np.append(is_first[starts[1:]] | ~is_there[1:], True)
    return starts[begins], np.append(starts, len(place))[1:][ends]


def _likeliest_states(sums: Sequence[float]) -> Sequence[bool]:
    """Returns whether the thing was present in each run of slices (Viterbi), by their evidence."""
    absent, present = 0.0, -_SWITCH / 4  # it may well be there when the place is first seen
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

"""Stays of labels at places: what their spots say, and which of them are false.

A label that is a small share of another's detections at a place, and is never in one message with
it there, is that other thing under a wrong name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.intervals import pieces_of
from ros2_memory.analysis.sights import STOREY_MM, Beside, Spot, Unplaced
from ros2_memory.core.arrays import (
    Flags,
    Ints,
    concatenated,
    in_ranges,
    numbered,
    range_numbers,
    rows_by,
    run_starts,
    stable_order,
)
from ros2_memory.core.timebase import MAX_NS, NS_PER_S
from ros2_memory.things.instances import PlacedStay, Tally, count_labels
from ros2_memory.things.observations import FEWEST, Observations

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.sights import Floats
    from ros2_memory.things.presence import Evidence, Stay

_LOWEST_RATE: Final = 0.15
"""A thing that is seen less often than this when looked at is a false detection that repeats."""
_SAME_PLACE_MM: Final = 450.0
"""A wrong name is at most this far from its host, ..."""
_NEAR_MM: Final = 150.0
_SCATTERS: Final = 2.0
"""... and no farther than this and so many times the scatter of the host: it is the same thing."""
_HALO_MM: Final = 950.0
"""A false stay is this near to its host, and under another label at the same place."""
_SMALL_SHARE: Final = 1 / 3
"""A wrong name has at most this share of its host's detections, ..."""
_HALO_SHARE: Final = 0.2
"""... noise under the same label this share, ..."""
_TINY_SHARE: Final = 0.1
"""... and this share of all that the host ever has."""
_BESIDE_SHARE: Final = 0.2
"""A label that is beside the host in this share of its detections is a thing of its own."""
_TAKEN_NS: Final = 20 * NS_PER_S
_TAKEN_MM: Final = 2000.0
"""A robot that takes a thing along drives within so much time, and is first seen to so near."""
_STAYS_AT_ONCE: Final = 64
"""Stays that are compared with all others at once."""


@dataclass(slots=True)
class LabelGroup:
    """The spots of one label in one epoch, to which estimating adds places, stays and evidence.

    Attributes:
        rows: the spots that count.
        carried: the spots seen while the robot carried the thing.
        unplaced: rows of `Sights.unplaced` with the label, in all epochs.
        places: the spots at each place.
        is_crowded: whether other places are left out, since there are too many.
    """

    key: str
    epoch: int
    rows: Ints
    carried: Ints
    unplaced: Ints
    places: list[Ints] = field(default_factory=list)
    stays: list[PlacedStay] = field(default_factory=list)
    evidence: Evidence = field(init=False)
    is_crowded: bool = False


def groups_in(observed: Observations, keys: Sequence[str]) -> list[LabelGroup]:
    """Returns the labels in each epoch that have detections that count."""
    distinct, key_of_label = numbered(keys)
    spots, unplaced = observed.sights.spots, observed.sights.unplaced
    width = len(distinct) + 1
    epoch = observed.sights.epochs[spots[:, Spot.SLICE]]
    group_of = epoch * width + key_of_label[spots[:, Spot.LABEL]]
    counting, carried = np.flatnonzero(observed.counts), np.flatnonzero(observed.carried)
    numbers, nth = np.unique(group_of[counting], return_inverse=True)
    lost = rows_by(key_of_label[unplaced[:, Unplaced.LABEL]], len(distinct))
    groups = []
    for number, rows in zip(numbers.tolist(), rows_by(nth, len(numbers)), strict=True):
        group_epoch, key = divmod(number, width)
        moving = carried[group_of[carried] == number]
        groups.append(
            LabelGroup(distinct[key], group_epoch, counting[rows], moving, unplaced[lost[key]])
        )
    return groups


def placed_stays(
    observed: Observations, stays: Sequence[Stay], rows: Ints, sizes: Ints
) -> list[PlacedStay]:
    """Returns stays with what their spots say.

    `rows` are the spots of one stay after the other, `sizes` how many each has, at least one.
    """
    if not stays:
        return []
    spots, n = observed.sights.spots[rows], observed.counts[rows]
    begins, stay_of = np.cumsum(sizes) - sizes, range_numbers(sizes)
    count = np.add.reduceat(n, begins)
    x, y, z = (
        np.add.reduceat(n * spots[:, axis], begins) / count for axis in (Spot.X, Spot.Y, Spot.Z)
    )
    off = (spots[:, Spot.X] - x[stay_of]) ** 2 + (spots[:, Spot.Y] - y[stay_of]) ** 2
    squares = np.add.reduceat(n * (spots[:, Spot.DEV] ** 2 + off), begins)
    dev_mm = np.sqrt(squares / count)
    slices, first, last = spots[:, Spot.SLICE], spots[:, Spot.FIRST], spots[:, Spot.LAST]
    firm_from, firm_to = np.array([(stay.firm_first, stay.firm_last) for stay in stays]).T
    is_firm = (slices >= firm_from[stay_of]) & (slices <= firm_to[stay_of])
    # Without a firm spot, or without firm slices (-1), all spots count as firm.
    has_firm = np.maximum.reduceat(is_firm, begins) & (firm_from >= 0)
    is_firm |= ~has_firm[stay_of]
    firm_first = np.minimum.reduceat(np.where(is_firm, first, MAX_NS), begins)
    firm_last = np.maximum.reduceat(np.where(is_firm, last, -MAX_NS), begins)
    first, last = np.minimum.reduceat(first, begins), np.maximum.reduceat(last, begins)
    beside, ids = _side_by_side(spots, stay_of), observed.ids[rows[begins]]
    columns = (x, y, z, dev_mm, first, last, firm_first, firm_last, count, beside, ids)
    placed = []
    numbers = zip(*(column.tolist() for column in columns), strict=True)
    for stay, own_rows, row in zip(stays, np.split(rows, begins[1:]), numbers, strict=True):
        left = None if stay.left is None else observed.cells.looked_in(stay.left)
        is_weak = stay.clear_hits < FEWEST or stay.hits < _LOWEST_RATE * stay.messages
        placed.append(PlacedStay(own_rows, stay, left, is_weak, *row))
    return placed


def _side_by_side(spots: Ints, stay_of: Ints) -> Ints:
    """Returns how many things stand side by side in the middle one of each stay's slices.

    Spots are in the order of their stays and slices. Two of one message are never one thing, and
    those of two detectors may be.
    """
    begins = run_starts(stay_of, *spots[:, : Spot.LABEL + 1].T)
    together = np.maximum.reduceat(spots[:, Spot.TOGETHER], begins)
    numbers = np.minimum(np.diff(begins, append=len(spots)), together)
    stays = stay_of[begins]
    numbers = numbers[np.lexsort((numbers, stays))]
    sizes = np.bincount(stays)
    middle: Ints = numbers[np.cumsum(sizes) - sizes + sizes // 2]
    return middle


def end_where_carried_away(group: LabelGroup, observed: Observations) -> None:
    """Ends the stays from which the robot took the thing along.

    It is nowhere else until the robot has put it down. What is near while the robot carries another
    one past it was not taken.
    """
    spots = observed.sights.spots[group.carried]
    spots = spots[stable_order(spots[:, Spot.FIRST])]
    starts, stops = pieces_of(spots[:, Spot.FIRST], spots[:, Spot.LAST], _TAKEN_NS)
    taken = spots[np.searchsorted(spots[:, Spot.FIRST], starts)]
    for stay in group.stays:
        nth = int(np.searchsorted(starts, stay.last, side="right"))
        if nth == len(starts):
            continue
        away_mm = math.hypot(taken[nth, Spot.X] - stay.x, taken[nth, Spot.Y] - stay.y)
        if starts[nth] - stay.last <= _TAKEN_NS and away_mm <= _TAKEN_MM:
            stay.left, stay.firm_last = int(starts[nth]), int(stops[nth])


def remove_false_stays(
    groups: Sequence[LabelGroup], observed: Observations, keys: Sequence[str]
) -> None:
    """Removes stays that are another thing under a wrong name, noise, or too rare.

    Wrong names are counted in `PlacedStay.misread_as` of the thing that had them.
    """
    stays = [(group, stay) for group in groups for stay in group.stays]
    hosts_of = dict(_HostSearch(stays, observed, keys).find())
    false_stays: set[int] = set()
    for number in sorted(hosts_of, key=lambda number: (stays[number][1].count, number)):
        host = next((host for host in hosts_of[number] if host not in false_stays), None)
        if host is None:
            continue
        false_stays.add(number)
        (group, stay), (host_group, host_stay) = stays[number], stays[host]
        if host_group is not group:
            host_stay.misread_as += count_labels(observed.sights, observed.counts, stay.spots)
    for group in groups:
        group.stays = []
    for number, (group, stay) in enumerate(stays):
        if number not in false_stays and not stay.is_weak:
            group.stays.append(stay)


class _HostSearch:
    """Searches for the hosts of false stays.

    A host is a stay at the same time and near a false one: that is the host's thing under a wrong
    name, or noise around it.
    """

    def __init__(
        self,
        stays: Sequence[tuple[LabelGroup, PlacedStay]],
        observed: Observations,
        keys: Sequence[str],
    ) -> None:
        self._observed = observed
        # Columns of the stays.
        self._keys, self._key_of_label = numbered(keys)
        integers = [
            (
                self._keys.index(group.key),
                group.epoch,
                stay.count,
                stay.first,
                stay.last,
                stay.stay.first_slice,
                stay.stay.last_slice,
                stay.is_weak,
                stay.id,
            )
            for group, stay in stays
        ]
        columns = np.array(integers, np.int64).reshape(-1, 9).T
        self._key, self._epoch, self._count, self._first, self._last = columns[:5]
        self._first_slice, self._last_slice, self._is_weak, self._id = columns[5:]
        places = np.array([(stay.x, stay.y, stay.z, stay.dev_mm) for _, stay in stays], np.float64)
        *self._places, self._dev_mm = places.reshape(-1, 4).T
        self._by_x = stable_order(self._places[0])
        # Each spot's stay and slice as one number, in order; and how many detections are before it.
        sizes = [len(stay.spots) for _, stay in stays]
        self._rows = concatenated(stay.spots for _, stay in stays)
        self._stay_of = range_numbers(sizes)
        spots = observed.sights.spots[self._rows]
        self._width = len(observed.sights.epochs) + 1
        self._slices = self._stay_of * self._width + spots[:, Spot.SLICE]
        self._counts_before = np.append(0, np.cumsum(observed.counts[self._rows]))
        has_several = np.bincount(self._stay_of, spots[:, Spot.TOGETHER] > 1, len(stays))
        self._are_several = 2 * has_several >= sizes
        beside_spots = (observed.sights.beside[:, name] for name in Beside)
        self._beside = Tally.of(len(observed.counts), *beside_spots)

    def find(self) -> Iterator[tuple[int, list[int]]]:
        """Yields the numbers of possibly false stays, each with its hosts, the likeliest first."""
        count = len(self._key)
        for begin in range(0, count, _STAYS_AT_ONCE):
            self._observed.go_on()
            numbers = np.arange(begin, min(begin + _STAYS_AT_ONCE, count))
            stay, host = self._candidates(numbers)
            is_apart = self._are_beside(numbers)[stay - begin, self._key[host]]
            pairs = zip(stay[~is_apart].tolist(), host[~is_apart].tolist(), strict=True)
            for number, pairs_of_stay in groupby(pairs, itemgetter(0)):
                yield number, [other for _, other in pairs_of_stay]

    def _candidates(self, numbers: Ints) -> tuple[Ints, Ints]:
        """Returns pairs of a stay and a possible host, by the stay, the likeliest host first.

        The stay must have few detections in comparison with the host at that time.
        """
        stay, host, away_mm = self._pairs_near(numbers)
        begin = np.searchsorted(self._slices, host * self._width + self._first_slice[stay])
        end = np.searchsorted(self._slices, host * self._width + self._last_slice[stay] + 1)
        hosted = self._counts_before[end] - self._counts_before[begin]
        count, is_same = self._count[stay], self._key[stay] == self._key[host]
        is_tiny = (count <= hosted) & (count <= _TINY_SHARE * self._count[host])
        # Where most messages with one of the label have both, the lighter one is no noise.
        is_tiny &= ~(self._are_several[stay] & is_same) | (2 * count <= hosted)
        is_part = is_tiny | (count <= hosted * np.where(is_same, _HALO_SHARE, _SMALL_SHARE))
        reach_mm = np.minimum(_NEAR_MM + _SCATTERS * self._dev_mm[host], _SAME_PLACE_MM)
        is_part &= (is_same | (away_mm <= reach_mm)) & (hosted > 0)
        order = np.lexsort((host, -hosted, stay))
        order = order[is_part[order]]
        return stay[order], host[order]

    def _are_beside(self, numbers: Ints) -> Flags:
        """Returns for each stay and key whether messages have both: then they are two things.

        `numbers` are consecutive. A stay's own key never counts.
        """
        spots = slice(*np.searchsorted(self._stay_of, (numbers[0], numbers[-1] + 1)))
        labels_per_spot, label, n = self._beside.rows_of(self._rows[spots])
        nth_stay = np.repeat(self._stay_of[spots] - numbers[0], labels_per_spot)
        cells = nth_stay * len(self._keys) + self._key_of_label[label]
        often = np.bincount(cells, n, len(numbers) * len(self._keys)).reshape(len(numbers), -1)
        are_beside: Flags = often >= _BESIDE_SHARE * self._count[numbers, None]
        are_beside[np.arange(len(numbers)), self._key[numbers]] = False
        return are_beside

    def _pairs_near(self, numbers: Ints) -> tuple[Ints, Ints, Floats]:
        """Returns pairs of a stay and another near it at that time, and their distances (mm)."""
        x, y, z = self._places
        start = np.searchsorted(x[self._by_x], x[numbers] - _HALO_MM)
        stop = np.searchsorted(x[self._by_x], x[numbers] + _HALO_MM)
        one, other = np.repeat(numbers, stop - start), self._by_x[in_ranges(start, stop - start)]
        away = np.hypot(x[other] - x[one], y[other] - y[one])
        is_near = (away <= _HALO_MM) & (np.abs(z[other] - z[one]) <= STOREY_MM) & (other != one)
        is_near &= (self._first[other] <= self._last[one]) & (self._last[other] >= self._first[one])
        is_near &= (self._epoch[other] == self._epoch[one]) & (self._is_weak[other] == 0)
        # What has another id is no noise.
        is_alike = (self._id[one] == 0) | (self._id[other] == self._id[one])
        is_near &= is_alike | (self._key[other] != self._key[one])
        return one[is_near], other[is_near], away[is_near]

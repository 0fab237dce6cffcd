"""Stays that are no things: another thing under a wrong name, noise around it, or too rare.

A label that is a small share of another's detections at a place, and is never in one message with
it there, is that other thing under a wrong name.
"""

from __future__ import annotations

from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import STOREY_MM, Beside, Floats, Spot
from ros2_memory.core.arrays import Flags, Ints, in_ranges, numbered
from ros2_memory.things.instances import PlacedStay, Tally, count_labels

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.things.observations import LabelGroup, Observations

_SAME_PLACE_MM: Final = 450.0
_HALO_MM: Final = 950.0
_SMALL_SHARE: Final = 1 / 3
_HALO_SHARE: Final = 0.2
_TINY_SHARE: Final = 0.1
_BESIDE_SHARE: Final = 0.2
_STAYS_AT_ONCE: Final = 64
"""Stays that are compared with all others at once."""


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
        if number not in false_stays and not stay.weak:
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
        self._table = _StayTable.of(stays)
        self._keys, self._key_of_label = numbered(keys)
        self._key = np.array([self._keys.index(group.key) for group, _ in stays], np.int64)
        beside_spots = (observed.sights.beside[:, name] for name in Beside)
        self._beside = Tally.of(len(observed.counts), *beside_spots)
        sizes = [len(stay.spots) for _, stay in stays]
        self._rows = np.concatenate([np.zeros(0, np.int64), *(stay.spots for _, stay in stays)])
        self._stay_of = np.repeat(np.arange(len(stays)), sizes)
        # Each spot's stay and slice as one number, in order; and how many detections are before it.
        spots = observed.sights.spots[self._rows]
        self._width = len(observed.sights.epochs) + 1
        self._slices = self._stay_of * self._width + spots[:, Spot.SLICE]
        self._counts_before = np.append(0, np.cumsum(observed.counts[self._rows]))
        has_several = np.bincount(self._stay_of, spots[:, Spot.TOGETHER] > 1, len(stays))
        self._are_several = 2 * has_several >= sizes

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

        The stay's detections must be few beside those of the host at that time.
        """
        table, key = self._table, self._key
        stay, host, away_mm = table.pairs_near(numbers)
        begin = np.searchsorted(self._slices, host * self._width + table.first_slice[stay])
        end = np.searchsorted(self._slices, host * self._width + table.last_slice[stay] + 1)
        hosted = self._counts_before[end] - self._counts_before[begin]
        count, is_same = table.detections[stay], key[stay] == key[host]
        is_tiny = (count <= hosted) & (count <= _TINY_SHARE * table.detections[host])
        # Where most messages with one of the label have both, the lighter one is no noise.
        is_tiny &= ~(self._are_several[stay] & is_same) | (2 * count <= hosted)
        is_part = is_tiny | (count <= hosted * np.where(is_same, _HALO_SHARE, _SMALL_SHARE))
        is_part &= (is_same | (away_mm <= _SAME_PLACE_MM)) & (hosted > 0)
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
        are_beside: Flags = often >= _BESIDE_SHARE * self._table.detections[numbers, None]
        are_beside[np.arange(len(numbers)), self._key[numbers]] = False
        return are_beside


class _StayTable(NamedTuple):
    """Stays as columns, as `LabelGroup`, `PlacedStay` and `Stay` have them.

    `by_x` has the numbers of the stays in the order of their x.
    """

    epoch: Ints
    detections: Ints
    first: Ints
    last: Ints
    weak: Flags
    first_slice: Ints
    last_slice: Ints
    places: Floats
    by_x: Ints

    @classmethod
    def of(cls, stays: Sequence[tuple[LabelGroup, PlacedStay]]) -> _StayTable:
        """Returns the table of stays with the groups that they are in."""

        def column(values: Iterable[int]) -> Ints:
            return np.array([*values], np.int64)

        places = np.array([(stay.x, stay.y, stay.z) for _, stay in stays], np.float64)
        places = places.reshape(-1, 3).T
        return cls(
            epoch=column(group.epoch for group, _ in stays),
            detections=column(stay.count for _, stay in stays),
            first=column(stay.first for _, stay in stays),
            last=column(stay.last for _, stay in stays),
            weak=column(stay.weak for _, stay in stays).astype(np.bool_),
            first_slice=column(stay.stay.first_slice for _, stay in stays),
            last_slice=column(stay.stay.last_slice for _, stay in stays),
            places=places,
            by_x=np.argsort(places[0], kind="stable"),
        )

    def pairs_near(self, numbers: Ints) -> tuple[Ints, Ints, Floats]:
        """Returns pairs of a stay and another near it at that time, and their distances (mm)."""
        x, y, z = self.places
        start = np.searchsorted(x[self.by_x], x[numbers] - _HALO_MM)
        stop = np.searchsorted(x[self.by_x], x[numbers] + _HALO_MM)
        one, other = np.repeat(numbers, stop - start), self.by_x[in_ranges(start, stop - start)]
        away = np.hypot(x[other] - x[one], y[other] - y[one])
        is_near = (away <= _HALO_MM) & (np.abs(z[other] - z[one]) <= STOREY_MM) & (other != one)
        is_near &= (self.first[other] <= self.last[one]) & (self.last[other] >= self.first[one])
        is_near &= (self.epoch[other] == self.epoch[one]) & ~self.weak[other]
        return one[is_near], other[is_near], away[is_near]

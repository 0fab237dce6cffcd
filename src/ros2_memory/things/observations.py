"""The sights of an estimate by label and epoch, and what is computed once for all labels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import SCORE_BINS, Hit, Score, Spot, Unplaced
from ros2_memory.core.arrays import Ints, distinct_rows, numbered, rows_by
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.things.instances import PlacedStay, Tally
from ros2_memory.things.places import Sightings, poorly_localised
from ros2_memory.things.presence import Cells, Evidence, Stay, fields_of_view

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.columns.sights import JoinedSights

_PLACE: Final = (Spot.X, Spot.Y, Spot.Z)
FEWEST: Final = 3
"""Fewer detections are no thing: a detector sees what is not there."""
_LOWEST_RATE: Final = 0.15
"""A thing that is seen less often than this when looked at is a false detection that repeats."""


@dataclass(slots=True)
class LabelGroup:
    """The spots of one label in one epoch, to which estimating adds places, stays and evidence.

    Attributes:
        rows: the spots.
        unplaced: rows of `Sights.unplaced` with the label, in all epochs.
        places: the spots at each place.
    """

    key: str
    epoch: int
    rows: Ints
    unplaced: Ints
    places: list[Ints] = field(default_factory=list)
    stays: list[PlacedStay] = field(default_factory=list)
    evidence: Evidence = field(init=False)


class Observations:
    """The sights of an estimate, and what is computed once for all labels.

    Attributes:
        counts: how many detections of each spot count.
        poor: which spots were seen while localisation was poor: they move nothing.
        hits: the looks of detections that count, by spot; -1 where localisation was poor.
        groups: a number for each spot, equal for spots of one slice, topic and label.
        fields: the field of view of each topic; see `fields_of_view`.
        side: for each spot, the mean of the unit vectors to it from where it was seen; 0 if that
            is unknown.
        go_on: as in `estimate`.
    """

    def __init__(self, sights: JoinedSights, min_score: float, go_on: Callable[[], None]) -> None:
        spots, self.sights, self.go_on = sights.spots, sights, go_on
        self.counts = spots[:, Spot.N]
        low = np.flatnonzero(sights.scores[:, Score.BIN] < lowest_bin(min_score))
        spot, n = (sights.scores[low, name] for name in (Score.SPOT, Score.N))
        self.counts -= np.bincount(spot, n, len(spots)).astype(np.int64)
        self.poor, poor_looks = poorly_localised(sights)
        # Which hits are of detections that count is not known: as many in proportion, rounded up.
        spot, look, n = (sights.hits[:, name] for name in Hit)
        n = -(-n * self.counts[spot] // spots[spot, Spot.N])
        look[np.append(poor_looks, [False])[look]] = -1
        spot, look, n = (column[n > 0] for column in (spot, look, n))
        self.hits = Tally.of(len(spots), spot, look, n)
        self.groups = distinct_rows(
            [spots[:, Spot.SLICE], spots[:, Spot.TOPIC], spots[:, Spot.LABEL]]
        )[1]
        self.cells = Cells(sights, poor_looks)
        spot, look, n = (column[look >= 0] for column in (spot, look, n))
        distance, bearing = self.cells.seen_at(look, spots[spot, Spot.X], spots[spot, Spot.Y])
        topic = spots[spot, Spot.TOPIC]
        self.fields = fields_of_view(topic, distance, bearing, n, len(sights.topics))
        angle = np.radians(bearing + self.cells.heading(look))
        sums = [np.bincount(spot, n * part, len(spots)) for part in (np.cos(angle), np.sin(angle))]
        total = np.maximum(np.bincount(spot, n, len(spots)), 1)
        self.side = np.stack(sums, axis=1) / total[:, None]

    def firm(self, rows: Ints) -> Ints:
        """Returns the spots seen while localisation was good; all spots if those are too few."""
        good: Ints = rows[~self.poor[rows]]
        return good if self.counts[good].sum() >= FEWEST else rows

    def sightings(self, rows: Ints) -> Sightings:
        """Returns spots as sightings."""
        names = (Spot.X, Spot.Y, Spot.DEV, Spot.FIRST, Spot.LAST)
        x, y, dev, *times = (self.sights.spots[rows, name] for name in names)
        place = np.stack((x, y), axis=1, dtype=np.float64)
        return Sightings(place, self.counts[rows], dev, self.side[rows], *times)


def lowest_bin(min_score: float) -> int:
    """Returns the lowest bin of scores that count."""
    return min(round(min_score * 1000) * SCORE_BINS // 1000, SCORE_BINS - 1)


def groups_in(observed: Observations, keys: Sequence[str]) -> list[LabelGroup]:
    """Returns the labels in each epoch that have detections that count."""
    distinct, key_of_label = numbered(keys)
    spots, unplaced = observed.sights.spots, observed.sights.unplaced
    width = len(distinct) + 1
    epoch = observed.sights.epochs[spots[:, Spot.SLICE]]
    group_of = epoch * width + key_of_label[spots[:, Spot.LABEL]]
    counting = np.flatnonzero(observed.counts)
    numbers, nth = np.unique(group_of[counting], return_inverse=True)
    lost = rows_by(key_of_label[unplaced[:, Unplaced.LABEL]], len(distinct))
    groups = []
    for number, rows in zip(numbers.tolist(), rows_by(nth, len(numbers)), strict=True):
        group_epoch, key = divmod(number, width)
        groups.append(LabelGroup(distinct[key], group_epoch, counting[rows], unplaced[lost[key]]))
    return groups


def placed_stays(
    observed: Observations, stays: Sequence[tuple[int, Stay]], rows: Ints, sizes: Ints
) -> list[PlacedStay]:
    """Returns stays with what their spots say. Each comes with the number of its place.

    `rows` are the spots of one stay after the other, `sizes` how many each has, at least one.
    """
    if not stays:
        return []
    spots, n = observed.sights.spots[rows], observed.counts[rows]
    begins, stay_of = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(stays)), sizes)
    count = np.add.reduceat(n, begins)
    x, y, z = (np.add.reduceat(n * spots[:, axis], begins) / count for axis in _PLACE)
    off = (spots[:, Spot.X] - x[stay_of]) ** 2 + (spots[:, Spot.Y] - y[stay_of]) ** 2
    squares = np.add.reduceat(n * (spots[:, Spot.DEV] ** 2 + off), begins)
    dev_mm = np.sqrt(squares / count)
    slices, first, last = spots[:, Spot.SLICE], spots[:, Spot.FIRST], spots[:, Spot.LAST]
    firm_from, firm_to = np.array([(stay.firm_first, stay.firm_last) for _, stay in stays]).T
    is_firm = (slices >= firm_from[stay_of]) & (slices <= firm_to[stay_of])
    # Without a firm spot, or without firm slices (-1), all spots count as firm.
    has_firm = np.maximum.reduceat(is_firm, begins) & (firm_from >= 0)
    is_firm |= ~has_firm[stay_of]
    firm_first = np.minimum.reduceat(np.where(is_firm, first, MAX_NS), begins)
    firm_last = np.maximum.reduceat(np.where(is_firm, last, -MAX_NS), begins)
    first, last = np.minimum.reduceat(first, begins), np.maximum.reduceat(last, begins)
    return [
        PlacedStay(
            x=float(x[number]),
            y=float(y[number]),
            z=float(z[number]),
            dev_mm=float(dev_mm[number]),
            first=int(first[number]),
            last=int(last[number]),
            firm_first=int(firm_first[number]),
            firm_last=int(firm_last[number]),
            left=None if stay.left is None else observed.cells.looked_in(stay.left),
            count=int(count[number]),
            spots=rows[begins[number] : begins[number] + sizes[number]],
            place=place,
            stay=stay,
            weak=stay.clear_hits < FEWEST or stay.hits < _LOWEST_RATE * stay.messages,
        )
        for number, (place, stay) in enumerate(stays)
    ]

"""Instances and movers: what an estimate knows of things, and what answers ask of it.

An instance is one thing with its stays at places. A mover is a label of people, of pets, or of
things that are carried about all the time: it has a track, and no places.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import SLICE_NS, Spot, Unplaced
from ros2_memory.core.arrays import (
    Columns,
    Flags,
    Groups,
    Ints,
    begins_of,
    distinct_rows,
    in_ranges,
    narrowed,
    range_numbers,
    run_starts,
)
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.things.places import visits_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.model import TimeWindow, Vector3
    from ros2_memory.things.labels import Labels
    from ros2_memory.things.presence import Evidence, Looks, Stay

_MISSED_BY_CHANCE: Final = 0.01
_FEWEST_BESIDE: Final = 3
_NEWEST_BESIDE: Final = 9
"""The newest slices say how many there are now: after older ones, some may have been taken away."""


@dataclass(slots=True)
class PlacedStay:
    """A stay of a label at a place, with the detections in it.

    Attributes:
        spots: rows of `Sights.spots`, in order of time.
        stay: the slices of the stay, and the number of the place.
        left: when it was seen to be gone (ns); None if it was not.
        is_weak: whether it was seen too rarely to be a thing.
        x, y, z: the mean place of the detections (mm); `dev_mm` is their root mean square distance
            from it.
        first, last: log times of the detections (ns); `firm_first` and `firm_last` are those of
            the detections beyond doubt.
        count: how many detections.
        side_by_side: how many things of the label stand there, by most of the stay.
        id: the number of the id in `JoinedSights.ids`; 0 for none.
        misread_as: how often it was seen under the labels of other things.
        has_changed: whether the thing is seen there later in another state, as a door that was
            opened: then it went nowhere.
    """

    spots: Ints
    stay: Stay
    left: Ns | None
    is_weak: bool
    x: float
    y: float
    z: float
    dev_mm: float
    first: Ns
    last: Ns
    firm_first: Ns
    firm_last: Ns
    count: int
    side_by_side: int
    id: int
    misread_as: Counter[str] = field(default_factory=Counter)
    has_changed: bool = False

    @property
    def place(self) -> int:
        """The number of the place."""
        return self.stay.place

    @property
    def at(self) -> Vector3:
        """The mean place of the detections (m)."""
        return self.x / 1000, self.y / 1000, self.z / 1000


@dataclass(slots=True)
class Instance:
    """One thing, with its stays in order of time, at least one. `key` is its canonical label."""

    key: str
    epoch: int
    stays: list[PlacedStay]
    looks: int = 0
    """How many detector messages could have had it since its last stay; see `count_misses`."""
    missed_by: Ns | None = None
    """When the chance that all of them missed it fell below 1 %; None if it never did."""
    labels: Mapping[str, int] = field(default_factory=dict)
    """How often it was seen under each name, the commonest first."""
    id: str = ""
    """What detectors tell it by from others of its label, over sessions."""

    @property
    def kind(self) -> tuple[str, int, str]:
        """What it shares with the things that may be the same."""
        return self.key, self.epoch, self.id

    @property
    def label(self) -> str:
        """The name to show."""
        return next(iter(self.labels), self.key)


class Move(NamedTuple):
    """A thing, its last stay before it moved and the first one after it."""

    thing: Instance
    before: PlacedStay
    after: PlacedStay


class _StayColumns(NamedTuple):
    """The stays of the things of one label, thing by thing, and where each thing went from them.

    Attributes:
        begins: where the stays of each thing begin.
        first, last: log times of the detections (ns).
        left: whether it was seen to be gone.
        next_first: when the thing was first seen after it; `MAX_NS` for the last stay.
        is_moved: whether that is elsewhere, or not known.
    """

    begins: Ints
    first: Ints
    last: Ints
    left: Flags
    next_first: Ints
    is_moved: Flags

    @classmethod
    def of(cls, things: Sequence[Instance]) -> _StayColumns:
        """Returns the stays of one or more things."""
        rows = [
            (stay.first, stay.last, stay.left is not None)
            + ((MAX_NS, True) if after is None else (after.first, after.place != stay.place))
            for thing in things
            for stay, after in zip_longest(thing.stays, thing.stays[1:])
        ]
        first, last, left, next_first, is_moved = np.array(rows, np.int64).T
        begins = run_starts(range_numbers([len(thing.stays) for thing in things]))
        return cls(begins, first, last, left > 0, next_first, is_moved > 0)

    def may_have_moved(self, move: Move) -> Flags:
        """Returns which things may have come to the new place of another one, or from the old one.

        Those are the ones first seen after the move began, or that left their place before it
        ended. They also left if nobody looked, where the same is true of the thing that moved.
        """
        end = move.after.first
        has_left = (self.last <= end) & (self.next_first >= end) & self.is_moved
        if move.before.left is not None:
            has_left &= self.left
        is_new = self.first[self.begins] > move.before.last
        return is_new | np.logical_or.reduceat(has_left, self.begins)


@dataclass(slots=True)
class Mover:
    """A label of things that move by themselves: all its spots, in order of time."""

    key: str
    epoch: int
    spots: Ints


class Tally(NamedTuple):
    """Counts by spot: how often it was seen in each look, or had a score in each bin.

    Attributes:
        starts: where the rows of each spot begin, and where the last spot's rows end.
        what: the number of the look, of the bin, or of the label beside the spot.
        n: how often.
    """

    starts: Ints
    what: Ints
    n: Ints

    @classmethod
    def of(cls, spots: int, spot: Ints, what: Ints, n: Ints) -> Tally:
        """Returns the tally of rows in the order of `spot`, their numbers below `spots`."""
        return cls(narrowed(begins_of(spot, spots)), narrowed(what), narrowed(n))

    def rows_of(self, spots: Ints) -> tuple[Ints, Ints, Ints]:
        """Returns how many rows each spot has, and `what` and `n` of all these rows."""
        begin, end = (self.starts[spots + nth].astype(np.int64) for nth in (0, 1))
        rows = in_ranges(begin, end - begin)
        return end - begin, self.what[rows].astype(np.int64), self.n[rows].astype(np.int64)


class BlindTime(NamedTuple):
    """A time [first, last] (ns) in which a detector saw none of the usual things in its view."""

    topic: str
    first: Ns
    last: Ns


@dataclass(slots=True)
class Estimate:
    """The things in sights, sorted by label and place, and the columns of sights for answers.

    Attributes:
        topics: the topics of detectors.
        labels: the labels as detectors write them.
        spots: one row for each slice, label and place; see `Spot` for its columns.
        unplaced: the detections without a place.
        scores: for each spot, how many detections that count have a score in each bin.
        hits: for each spot, how often it was seen in each of `looks`.
        looks: the looks of the detectors, but of blind ones.
        blind: when a detector was blind.
        instances: the things that stay where they are for a while.
        movers: the things that move by themselves.
    """

    topics: tuple[str, ...]
    labels: tuple[str, ...]
    spots: Columns
    unplaced: Columns
    scores: Tally
    hits: Tally
    looks: Looks
    blind: list[BlindTime]
    instances: list[Instance]
    movers: list[Mover]
    counts: Ints
    """How many detections of each spot count."""
    carried: Flags
    """Which spots are of carried things: none of their detections counts."""
    poor: Flags
    """Which spots were seen while localisation was poor."""
    names: dict[str, str]
    """The name to show of each key."""
    evidence: dict[tuple[str, int, int], Evidence]
    """By key, epoch and place: the evidence for the places of things."""
    unplaced_of: dict[str, Ints]
    """The rows of `unplaced` of each key."""
    crowded: frozenset[str]
    """The names of things that have too many places: some places are left out."""
    stays: list[tuple[Instance, PlacedStay]] = field(init=False)
    stay_of: Ints = field(init=False)
    """For each spot, the number of the first stay that has it; -1 for none."""

    def __post_init__(self) -> None:
        self.stays = [(instance, stay) for instance in self.instances for stay in instance.stays]
        self.stay_of = np.full(len(self.spots), -1, np.int32)
        for number, (_, stay) in reversed([*enumerate(self.stays)]):
            self.stay_of[stay.spots] = number

    @property
    def memory_bytes(self) -> int:
        """About how much memory the estimate takes."""
        of_spots = (self.counts, self.carried, self.poor, self.stay_of, *self.scores, *self.hits)
        of_things = chain(self.unplaced_of.values(), *self.evidence.values())
        of_stays = (stay.spots for _, stay in self.stays)
        arrays = chain(of_spots, self.looks, of_things, of_stays)
        return self.spots.nbytes + self.unplaced.nbytes + sum(array.nbytes for array in arrays)

    def seen_in(self, rows: Ints, window: TimeWindow, before: Ns = MAX_NS) -> Ints:
        """Returns the spots whose slices reach into a window and end before a time.

        Slices count as a whole. A spot without detections that count is left out.
        """
        first, last = (self.spots[rows, column] for column in (Spot.FIRST, Spot.LAST))
        inside = (first < window.stop) & (last >= window.start) & (last < before)
        return rows[inside & (self.counts[rows] > 0)]

    def look_alikes(self, moves: Iterable[Move]) -> Iterator[tuple[Move, int]]:
        """Yields moves, each with how many other things of the label may be the one that moved."""
        things_of: defaultdict[tuple[str, int, str], list[Instance]] = defaultdict(list)
        for thing in self.instances:
            things_of[thing.kind].append(thing)
        stays_of: dict[tuple[str, int, str], _StayColumns] = {}
        for move in moves:
            kind = move.thing.kind
            if kind not in stays_of:
                stays_of[kind] = _StayColumns.of(things_of[kind])
            is_other = np.array([thing is not move.thing for thing in things_of[kind]])
            yield move, int(np.count_nonzero(is_other & stays_of[kind].may_have_moved(move)))

    def is_vague(self, rows: Ints) -> bool:
        """Returns whether the newest of the spots was seen while localisation was poor."""
        return bool(self.poor[rows[self.spots[rows, Spot.LAST].argmax()]])

    def alone_among(self, spot: int, mover: Mover) -> int:
        """Returns in how many messages, up to `SLICE_NS` around it, a spot is the only detection.

        They are of its topic. 0 if the mover has other detections in this time.
        """
        names = [Spot.FIRST, Spot.LAST, Spot.TOPIC]
        first, last, topic = self.spots[np.array([spot])][0, names].tolist()
        start, stop = first - SLICE_NS, last + SLICE_NS
        others = self.spots[mover.spots]
        is_near = (others[:, Spot.LAST] >= start) & (others[:, Spot.FIRST] <= stop)
        if self.counts[mover.spots[is_near]].sum() > 1:
            return 0
        is_around = (self.looks.last >= start) & (self.looks.first <= stop)
        return int(self.looks.n[is_around & (self.looks.topic == topic)].sum())

    def place_of(self, stay: PlacedStay, rows: Ints) -> Vector3:
        """Returns the mean place (m) of a stay's spots, or of the whole stay if all are poor."""
        rows = rows[~self.poor[rows]]
        if not len(rows):
            return stay.at
        spots = self.spots[rows][:, [Spot.X, Spot.Y, Spot.Z]]
        x, y, z = (np.average(spots, axis=0, weights=self.counts[rows]) / 1000).tolist()
        return x, y, z

    def seen_from(self, spots: Ints) -> Vector3 | None:
        """Returns the pose (m, rad) from which most messages saw spots; None if unknown.

        It is the mean pose in the cell with most messages; of equal cells, in the last that saw it.
        """
        _, looks, n = self.hits.rows_of(spots)
        looks, n = looks[looks >= 0], n[looks >= 0]
        if not len(looks):
            return None
        cells, cell_of = np.unique(self.looks.cell[looks], return_inverse=True)
        messages, last = np.bincount(cell_of, n), np.zeros(len(cells), np.int64)
        np.maximum.at(last, cell_of, self.looks.last[looks])
        is_in_best = cell_of == np.lexsort((last, messages))[-1]
        looks, n = looks[is_in_best], n[is_in_best]
        columns = (self.looks.x, self.looks.y, self.looks.yaw)
        poses = np.stack([column[looks] for column in columns], dtype=np.float64)
        # Headings relative to the first one: 0 and 359.9 degrees are side by side.
        poses[2] = poses[2, 0] + (poses[2] - poses[2, 0] + 1800) % 3600 - 1800
        x, y, yaw = np.average(poses, axis=1, weights=n).tolist()
        return x / 1000, y / 1000, math.radians((yaw / 10 + 180) % 360 - 180)

    def side_by_side(self, rows: Ints) -> int:
        """Returns how many things of one label stand at one place, by the spots there.

        Places are no finer than the noise of far detections, but two spots of one message are never
        one thing. The newest slices count, and those of the last visit alone if they have more:
        what came since the visit before was not there to be seen in it.
        """
        visits = visits_of(*(self.spots[rows, name] for name in (Spot.FIRST, Spot.LAST)))
        return max(self._side_by_side_of(seen) for seen in (rows, rows[visits == visits[-1]]))

    def _side_by_side_of(self, rows: Ints) -> int:
        """Returns the median number of things side by side in the newest slices of some spots.

        Of a slice each detector counts the spots that it saw at least half as often as the one it
        saw most. Only spots seen three times in their slice count, or as often as a slow detector
        sees any.
        """
        counts = self.counts[rows]
        is_often = counts >= min(_FEWEST_BESIDE, int(counts.max()))
        rows, counts = rows[is_often], counts[is_often]
        spots = self.spots[rows]
        by = Groups.of(distinct_rows([*spots[:, : Spot.LABEL + 1].T])[1])
        most = np.repeat(by.ends(counts)[1], by.sizes)
        beside = np.add.reduceat((2 * counts[by.order] >= most).astype(np.int64), by.begins)
        numbers = np.minimum(beside, by.ends(spots[:, Spot.TOGETHER])[1])
        # The median, so that no single slice with a false detection counts.
        newest = np.sort(numbers[-_NEWEST_BESIDE:])[::-1]
        return max(1, int(newest[len(newest) // 2]))

    def missing(
        self, instance: Instance, stay: PlacedStay, window: Span | None = None
    ) -> tuple[int, Ns | None]:
        """Returns how many messages missed a thing after one of its stays, or in a window before.

        See `count_misses`. A detection of its label without a place, by a topic that saw the thing,
        may be the thing: only looks after the last such detection show that it is not there.
        """
        evidence = self.evidence[instance.key, instance.epoch, stay.place]
        seen_to = stay.last if window is None else MAX_NS
        start, stop = window or (stay.last + 1, MAX_NS)
        unplaced = self.unplaced_of[instance.key]
        may_be_it = np.isin(unplaced[:, Unplaced.TOPIC], self.spots[stay.spots, Spot.TOPIC])
        may_be_it &= unplaced[:, Unplaced.FIRST] < stop
        start = max(start, int(unplaced[may_be_it, Unplaced.LAST].max(initial=MIN_NS)) + 1)
        return count_misses(self.looks, evidence, stay.stay, seen_to, (start, stop))

    def stay_with(self, foreign: Ints) -> tuple[Instance, PlacedStay] | None:
        """Returns the thing, and its stay, that has the first of the spots in any stay, or None.

        `foreign` are rows of `Sights.spots` (mm, ns) of another estimate, from the same bags.
        """
        alike = [Spot.N, Spot.X, Spot.Y, Spot.LAST]
        firsts = self.spots[:, Spot.FIRST]
        for spot in foreign:
            rows = np.flatnonzero(firsts == spot[Spot.FIRST])
            rows = rows[(self.spots[rows][:, alike] == spot[alike]).all(axis=1)]
            numbers = self.stay_of[rows]
            numbers = numbers[numbers >= 0]
            if len(numbers):
                return self.stays[int(numbers.min())]
        return None


def count_labels(sights: JoinedSights | Estimate, counts: Ints, rows: Ints) -> Counter[str]:
    """Returns how often spots were seen under each label, as detectors write it."""
    often = np.bincount(sights.spots[rows, Spot.LABEL], counts[rows])
    return Counter(
        {sights.labels[label]: int(often[label]) for label in np.flatnonzero(often).tolist()}
    )


def count_names(
    label_counts: Mapping[str, int], labels: Labels, names: Mapping[str, str]
) -> dict[str, int]:
    """Returns how often each name was seen, the commonest name first.

    `names` has the name to show of each key.
    """
    counts: Counter[str] = Counter()
    for label, n in label_counts.items():
        counts[names[labels.key(label)]] += n
    return {name: counts[name] for name in sorted(counts, key=lambda name: (-counts[name], name))}


def most_at_once(spots: Ints) -> int:
    """Returns how many things of one label were seen at once.

    `spots` are rows of `Sights.spots` with that label, at least one. Of spots in a region, a slice
    counts no more than it has there. One message in a hundred may have a false detection.
    """
    slices = np.unique(spots[:, Spot.SLICE], return_inverse=True)[1]
    together = np.sort(np.minimum(spots[:, Spot.TOGETHER], np.bincount(slices)[slices]))
    return max(1, int(together[-max(1, len(together) // 100)]))


def count_misses(
    looks: Looks, evidence: Evidence, stay: Stay, seen_to: Ns, window: Span
) -> tuple[int, Ns | None]:
    """Returns how many messages of a window [start, stop) could have had a thing, and have not.

    And when (ns) the chance that all of them missed it fell below 1 %; None if it never did.

    Only looks from cells that saw the thing during its stay count. Those are the looks up to
    `seen_to`, and later ones with a hit. A cell's rate is known as well as its messages tell (a
    uniform prior). `evidence` has the looks at one place; see `Evidence.at_place`.
    """
    numbers, is_hit = evidence.looks, evidence.hits > 0
    slices, first, last = looks.slice[numbers], looks.first[numbers], looks.last[numbers]
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

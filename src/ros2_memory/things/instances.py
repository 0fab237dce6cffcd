"""Instances: stays at places, linked into things with a history.

A label that is a small share of another's detections at a place, and is never in one message with
it there, is that other thing under a wrong name. The stays that are left are linked into as few
things as explain them: a stay that was seen to have ended may go on elsewhere. A label of people or
pets, or one whose stays are many and short, moves by itself: it has a track, and no places.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import chain, groupby
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import (
    SCORE_BINS,
    STOREY_MM,
    Beside,
    Floats,
    Hit,
    Score,
    Spot,
    Unplaced,
)
from ros2_memory.core.arrays import (
    Columns,
    Flags,
    Groups,
    Ints,
    begins_of,
    distinct_rows,
    in_ranges,
    narrowed,
    numbered,
    rows_by,
)
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.things.labels import Labels, moves_by_itself
from ros2_memory.things.places import (
    GATE_MM,
    MIDDLE,
    Sightings,
    places_of,
    poorly_localised,
    stays_in,
    with_synonyms,
)
from ros2_memory.things.presence import (
    Cells,
    Evidence,
    Looks,
    Stay,
    evidence_at,
    fields_of_view,
    looks_without,
    stays_at,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.model import TimeWindow, Vector3


_PLACE: Final = (Spot.X, Spot.Y, Spot.Z)
_FEWEST: Final = 3
"""Fewer detections are no thing: a detector sees what is not there."""
_FEWEST_OF_MOVERS: Final = 10
_LOWEST_RATE: Final = 0.15
"""Seen less often than this when looked at, it is a false detection that repeats."""
_SAME_PLACE_MM: Final = 450.0
_HALO_MM: Final = 950.0
_SMALL_SHARE: Final = 1 / 3
_HALO_SHARE: Final = 0.2
_TINY_SHARE: Final = 0.1
_BESIDE_SHARE: Final = 0.2
_SEVERAL_SHARE: Final = 0.1
"""Where so many slices have several of a label at one place, it is no single thing that moves."""
_FEWEST_IN_PART: Final = 10
_SEVERAL_IN_PART: Final = 0.5
"""Nor where so many have several in that part of time in which most of these slices are."""
_FEWEST_BESIDE: Final = 3
_NEWEST_BESIDE: Final = 9
"""So many slices say how many there are now: of more, some may have been taken away since."""
_STAYS_AT_ONCE: Final = 64
"""So many are compared with all at once."""
_SPOTS_AT_ONCE: Final = 16_384
"""About so many spots of labels are looked at together."""
_RESTLESS_MOVES: Final = 6
_RESTLESS_SHARE: Final = 0.2


@dataclass(slots=True)
class PlacedStay:
    """A stay of a label at a place, with what was seen in it.

    Attributes:
        x, y, z: the mean of its detections (mm); `dev_mm` their root mean square distance.
        first, last: of its detections (ns); `firm_first` and `firm_last` of those that are beyond
            doubt.
        left: the time by which it was seen to be gone; None if it was not.
        count: of its detections.
        spots: rows of `Sights.spots`, in order of time.
        place: its number.
        stay: when it was there, by slices.
        weak: whether it was seen too rarely to be a thing.
        also: how often it was seen under the labels of other things.
    """

    x: float
    y: float
    z: float
    dev_mm: float
    first: Ns
    last: Ns
    firm_first: Ns
    firm_last: Ns
    left: Ns | None
    count: int
    spots: Ints
    place: int
    stay: Stay
    weak: bool
    also: Counter[str] = field(default_factory=Counter)

    @property
    def at(self) -> Vector3:
        """The mean of its detections (m)."""
        return self.x / 1000, self.y / 1000, self.z / 1000


@dataclass(slots=True)
class Instance:
    """One thing: its stays in order of time, at least one. `key` is its canonical label's."""

    key: str
    epoch: int
    stays: list[PlacedStay]
    looks: int = 0
    """Detector messages from where it would have been, as of `Estimate.missing`."""
    missed_by: Ns | None = None
    """When the chance that all of these missed it fell below 1 %; None where it did not."""
    labels: Mapping[str, int] = field(default_factory=dict)
    """How often it was seen under each name, the commonest first."""

    @property
    def label(self) -> str:
        """The name to show."""
        return next(iter(self.labels), self.key)


@dataclass(slots=True)
class Mover:
    """A label of things that move by themselves: all its spots, in order of time."""

    key: str
    epoch: int
    spots: Ints


class Tally(NamedTuple):
    """How often spots have something, by spot: were seen in a look, have a score in a bin.

    Attributes:
        starts: where the rows of each spot begin, and where the last ones end.
        what: the look, the bin, or the label beside it.
        n: how often.
    """

    starts: Ints
    what: Ints
    n: Ints

    @classmethod
    def of(cls, spots: int, spot: Ints, what: Ints, n: Ints) -> Tally:
        """Returns rows of so many spots: which of these, in order, what, and how often."""
        return cls(*map(narrowed, (begins_of(spot, spots), what, n)))

    def rows_of(self, spots: Ints) -> tuple[Ints, Ints, Ints]:
        """Returns how many rows each of some spots has, and what and how often in these."""
        begin, end = (self.starts[spots + nth].astype(np.int64) for nth in (0, 1))
        rows = in_ranges(begin, end - begin)
        return end - begin, self.what[rows].astype(np.int64), self.n[rows].astype(np.int64)


@dataclass(slots=True)
class Estimate:
    """The things in sights, sorted by label and place, and the columns of sights for answers.

    Attributes:
        topics: of the detectors.
        labels: as detectors write them.
        spots: one row for each slice, label and place; see `Spot` for its columns.
        unplaced: the detections without a place.
        scores: of each spot, how many detections that count have a score in each bin.
        hits: of each spot, how often it was seen in each of `looks`.
        looks: of the detectors.
        instances: the things that stay where they are for a while.
        movers: those that do not.
    """

    topics: tuple[str, ...]
    labels: tuple[str, ...]
    spots: Columns
    unplaced: Columns
    scores: Tally
    hits: Tally
    looks: Looks
    instances: list[Instance]
    movers: list[Mover]
    counts: Ints
    """How many detections of each spot count."""
    poor: Flags
    """Which spots were seen while localisation was poor."""
    names: dict[str, str]
    """The name to show of each key."""
    evidence: dict[tuple[str, int, int], Evidence]
    """By key, epoch and place: the evidence for the places of things."""
    unplaced_of: dict[str, Ints]
    """The rows of `unplaced` of each key."""
    stays: list[tuple[Instance, PlacedStay]] = field(init=False)
    stay_of: Ints = field(init=False)
    """Of each spot, the first of `stays` that has it; -1 where none has."""

    def __post_init__(self) -> None:
        self.stays = [(instance, stay) for instance in self.instances for stay in instance.stays]
        self.stay_of = np.full(len(self.spots), -1, np.int32)
        for number, (_, stay) in reversed([*enumerate(self.stays)]):
            self.stay_of[stay.spots] = number

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        tables: list[Columns | Ints | Flags] = [self.spots, self.unplaced, self.counts, self.poor]
        tables += chain((self.stay_of,), self.scores, self.hits, self.looks)
        tables += chain(self.unplaced_of.values(), *self.evidence.values())
        tables += chain((stay.spots for _, stay in self.stays))
        return sum(table.nbytes for table in tables)

    def seen_in(self, rows: Ints, window: TimeWindow, before: Ns = MAX_NS) -> Ints:
        """Returns which of some spots are of slices that reach into a window and end before a time.

        Slices count as a whole; a spot without detections that count is left out.
        """
        first, last = (self.spots[rows, column] for column in (Spot.FIRST, Spot.LAST))
        inside = (first < window.stop) & (last >= window.start) & (last < before)
        return rows[inside & (self.counts[rows] > 0)]

    def is_vague(self, rows: Ints) -> bool:
        """Whether the newest of some spots was seen while localisation was poor."""
        return bool(self.poor[rows[self.spots[rows, Spot.LAST].argmax()]])

    def place_of(self, stay: PlacedStay, rows: Ints) -> Vector3:
        """Returns the mean place (m) of some spots of a stay; of all of it if these are poor."""
        rows = rows[~self.poor[rows]]
        if not len(rows):
            return stay.at
        spots = self.spots[rows][:, [Spot.X, Spot.Y, Spot.Z]]
        x, y, z = (np.average(spots, axis=0, weights=self.counts[rows]) / 1000).tolist()
        return x, y, z

    def seen_from(self, spots: Ints) -> Vector3 | None:
        """Returns the pose (m, rad) from which most messages saw some spots; None if unknown.

        That is the mean pose in one cell; of two with equal numbers, in the one that saw it later.
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
        # Headings from that of the first on: 0 and 359.9 degrees are side by side.
        poses[2] = poses[2, 0] + (poses[2] - poses[2, 0] + 1800) % 3600 - 1800
        x, y, yaw = np.average(poses, axis=1, weights=n).tolist()
        return x / 1000, y / 1000, math.radians((yaw / 10 + 180) % 360 - 180)

    def side_by_side(self, rows: Ints) -> int:
        """Returns how many of a label are at one place, by its spots: what messages have at once.

        Places are no finer than the noise of far detections, but two of one message are never one.
        A slice counts where each was seen at least half as often as the one seen most, three times
        or as often as a slow detector sees them.
        """
        counts = self.counts[rows]
        is_often = counts >= min(_FEWEST_BESIDE, int(counts.max()))
        rows, counts = rows[is_often], counts[is_often]
        slices, together = (self.spots[rows, name] for name in (Spot.SLICE, Spot.TOGETHER))
        by = Groups.of(np.unique(slices, return_inverse=True)[1])
        most = np.repeat(by.ends(counts)[1], by.sizes)
        beside = np.add.reduceat((2 * counts[by.order] >= most).astype(np.int64), by.begins)
        numbers = np.minimum(beside, by.ends(together)[1])
        # What most slices have, so that no single one with a false detection counts.
        newest = np.sort(numbers[-_NEWEST_BESIDE:])[::-1]
        return max(1, int(newest[len(newest) // 2]))

    def missing(
        self, instance: Instance, stay: PlacedStay, window: Span | None = None
    ) -> tuple[int, Ns | None]:
        """Returns `looks_without` a thing after one of its stays, or in a window before it.

        What those who saw it detected of its label without a place may be the thing: only what
        follows shows that it is not there.
        """
        evidence = self.evidence[instance.key, instance.epoch, stay.place]
        seen_to = stay.last if window is None else MAX_NS
        start, stop = window or (stay.last + 1, MAX_NS)
        unplaced = self.unplaced_of[instance.key]
        may_be_it = np.isin(unplaced[:, Unplaced.TOPIC], self.spots[stay.spots, Spot.TOPIC])
        may_be_it &= unplaced[:, Unplaced.FIRST] < stop
        start = max(start, int(unplaced[may_be_it, Unplaced.LAST].max(initial=MIN_NS)) + 1)
        return looks_without(self.looks, evidence, stay.stay, seen_to, (start, stop))

    def stay_with(self, foreign: Ints) -> tuple[Instance, PlacedStay] | None:
        """Returns the thing, and its stay, that has the first of some spots that any thing has.

        `foreign` are rows of `Sights.spots` of another estimate (mm, ns), of some of the same bags.
        Returns None where no thing has any of them.
        """
        alike = [Spot.N, Spot.X, Spot.Y, Spot.LAST]
        firsts = self.spots[:, Spot.FIRST]
        for spot in foreign:
            rows = np.flatnonzero(firsts == spot[Spot.FIRST])
            rows = rows[(self.spots[rows][:, alike] == spot[alike]).all(axis=1)]
            stays = self.stay_of[rows]
            if (stays >= 0).any():
                return self.stays[int(stays[stays >= 0].min())]
        return None


@dataclass(slots=True)
class _Group:
    """The places of one label in one epoch, each with its spots.

    `unplaced` are its rows of `Sights.unplaced`, of all epochs.
    """

    key: str
    epoch: int
    rows: Ints
    unplaced: Ints
    places: list[Ints] = field(default_factory=list)
    stays: list[PlacedStay] = field(default_factory=list)
    evidence: Evidence = field(init=False)


def estimate(
    sights: JoinedSights,
    labels: Labels,
    min_score: float = 0.0,
    go_on: Callable[[], None] = lambda: None,
) -> Estimate:
    """Returns the things in sights.

    Detections whose score lies below `min_score`, to 0.05, do not count. `go_on` is called again
    and again; what it raises ends the estimate.
    """
    observed = _Observations(sights, min_score, go_on)
    names = _names(sights, labels)
    keys = with_synonyms(sights, observed.counts, labels, go_on)
    groups = _groups(observed, keys)
    _find_places(groups, observed)
    spots_before = np.cumsum([0, *(len(group.rows) for group in groups)]) // _SPOTS_AT_ONCE
    for _, some in groupby(zip(spots_before.tolist(), groups, strict=False), itemgetter(0)):
        _find_stays([group for _, group in some], observed)
    _remove_false_stays(groups, observed, keys)
    instances: list[Instance] = []
    movers: list[Mover] = []
    evidence: dict[tuple[str, int, int], Evidence] = {}
    for group in groups:
        linked = _link(group, observed)
        _add_poorly_localised(group, linked, observed)
        moves = len(group.stays) - len(linked)
        is_restless = moves >= _RESTLESS_MOVES and moves > _RESTLESS_SHARE * len(group.rows)
        if not is_restless and not moves_by_itself(group.key):
            instances += linked
            # Of most places the evidence is of false detections, and not needed.
            for place in {stay.place for thing in linked for stay in thing.stays}:
                evidence[group.key, group.epoch, place] = group.evidence.at(place)
        else:
            n = observed.counts[group.rows]
            if n[n >= _FEWEST].sum() >= _FEWEST_OF_MOVERS:
                movers.append(Mover(group.key, group.epoch, group.rows))
    for instance in instances:
        rows = np.concatenate([stay.spots for stay in instance.stays])
        instance.labels = named(spellings(sights, observed.counts, rows), labels, names)
    instances.sort(key=lambda thing: (thing.label, thing.stays[0].first, thing.stays[0].x))
    counting = np.flatnonzero(sights.scores[:, Score.BIN] >= _lowest_bin(min_score))
    scores = (sights.scores[counting, name] for name in Score)
    result = Estimate(
        topics=sights.topics,
        labels=sights.labels,
        spots=sights.spots,
        unplaced=sights.unplaced,
        scores=Tally.of(len(sights.spots), *scores),
        hits=observed.hits,
        looks=observed.cells.looks,
        instances=instances,
        movers=movers,
        counts=observed.counts,
        poor=observed.poor,
        names=names,
        evidence=evidence,
        unplaced_of={group.key: group.unplaced for group in groups},
    )
    for instance in instances:
        instance.looks, instance.missed_by = result.missing(instance, instance.stays[-1])
    return result


def spellings(sights: JoinedSights | Estimate, counts: Ints, rows: Ints) -> Counter[str]:
    """Returns how often some spots were seen under each label, as detectors write it."""
    often = np.bincount(sights.spots[rows, Spot.LABEL], counts[rows])
    return Counter(
        {sights.labels[label]: int(often[label]) for label in np.flatnonzero(often).tolist()}
    )


def named(seen: Mapping[str, int], labels: Labels, names: Mapping[str, str]) -> dict[str, int]:
    """Returns how often each name was seen, the commonest first; `names` has that of each key."""
    counts: Counter[str] = Counter()
    for spelling, n in seen.items():
        counts[names[labels.key(spelling)]] += n
    return {name: counts[name] for name in sorted(counts, key=lambda name: (-counts[name], name))}


class _Observations:
    """The sights of an estimate, and what is computed once for all labels.

    Attributes:
        counts: how many detections of each spot count.
        poor: which spots were seen while localisation was poor: these move nothing.
        hits: the looks of detections that count, by spot; -1 where localisation was poor.
        groups: of each spot a number; those of one slice, topic and label have the same.
        fields: the field of view of each topic, as of `fields_of_view`.
        side: of each spot, the mean of the unit vectors to it from where it was seen; 0 where that
            is not known.
        go_on: as of `estimate`.
    """

    def __init__(self, sights: JoinedSights, min_score: float, go_on: Callable[[], None]) -> None:
        spots, self.sights, self.go_on = sights.spots, sights, go_on
        # How many have no score that is too low.
        self.counts = spots[:, Spot.N]
        low = np.flatnonzero(sights.scores[:, Score.BIN] < _lowest_bin(min_score))
        spot, n = (sights.scores[low, name] for name in (Score.SPOT, Score.N))
        self.counts -= np.bincount(spot, n, len(spots)).astype(np.int64)
        self.poor, poor_looks = poorly_localised(sights)
        # Those of detections that count: in proportion, rounded up.
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
        """Returns the spots that were seen while localisation was good; all if too few were."""
        good: Ints = rows[~self.poor[rows]]
        return good if self.counts[good].sum() >= _FEWEST else rows

    def sightings(self, rows: Ints) -> Sightings:
        """Returns some spots as sightings."""
        names = (Spot.X, Spot.Y, Spot.DEV, Spot.FIRST, Spot.LAST)
        x, y, dev, *times = (self.sights.spots[rows, name] for name in names)
        place = np.stack((x, y), axis=1, dtype=np.float64)
        return Sightings(place, self.counts[rows], dev, self.side[rows], *times)


def _lowest_bin(min_score: float) -> int:
    """Returns the lowest bin of scores that count."""
    return min(round(min_score * 1000) * SCORE_BINS // 1000, SCORE_BINS - 1)


def _groups(observed: _Observations, keys: Sequence[str]) -> list[_Group]:
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
        groups.append(_Group(distinct[key], group_epoch, counting[rows], unplaced[lost[key]]))
    return groups


def _find_places(groups: Sequence[_Group], observed: _Observations) -> None:
    """Finds the places of labels, each with one for every time that it was moved a little."""
    single: list[tuple[_Group, Ints]] = []
    for group in groups:
        if not moves_by_itself(group.key):
            observed.go_on()
            single += [(group, rows) for rows in _add_shared_places(group, observed)]
    if not single:
        return
    thing = np.repeat(np.arange(len(single)), [len(rows) for _, rows in single])
    steps = stays_in(observed.sightings(np.concatenate([rows for _, rows in single])), thing)
    for (group, rows), step in zip(single, steps, strict=True):
        group.places += [rows[step == number] for number in range(int(step.max()) + 1)]


def _add_shared_places(group: _Group, observed: _Observations) -> Iterator[Ints]:
    """Adds the places of several things that stand together; yields the spots of the others."""
    rows = observed.firm(group.rows)
    names = (Spot.X, Spot.Y, Spot.Z, Spot.SLICE)
    x, y, z, slices = (observed.sights.spots[rows, name] for name in names)
    place = np.full(len(rows), -1, np.int64)
    # Heights that are next to each other on one floor are not far apart.
    by_height = np.argsort(z, kind="stable")
    floors = np.split(by_height, np.flatnonzero(np.diff(z[by_height]) > STOREY_MM) + 1)
    for floor in floors:
        on_floor = places_of(x[floor], y[floor], observed.counts[rows[floor]], slices[floor])
        place[floor] = np.where(on_floor < 0, -1, on_floor + place.max(initial=-1) + 1)
    rows, place = rows[place >= 0], place[place >= 0]
    # Where slices have several spots of the label, these are things that stand together.
    pairs, pair_of = distinct_rows((place, observed.groups[rows]))
    several = _stand_together(pairs[:, 0], np.bincount(pair_of))
    counts = np.bincount(place, observed.counts[rows])
    ends = np.cumsum(np.bincount(place))
    by_place = np.split(rows[np.argsort(place, kind="stable")], ends[:-1])
    for number, rows_there in enumerate(by_place):
        if several[number]:
            group.places.append(rows_there)
        elif counts[number] >= _FEWEST:
            yield rows_there


def _stand_together(place: Ints, spots: Ints) -> Flags:
    """Returns of which places slices have several spots: in all of time, or in one part of it.

    `spots` are those in each slice of a place, in order of time; places are in order.
    """
    sizes = np.bincount(place)
    together: Flags = np.bincount(place, spots - 1) > _SEVERAL_SHARE * sizes
    begins = np.cumsum(sizes) - sizes
    often = np.bincount(place, spots > 1) >= _FEWEST_IN_PART
    for number in np.flatnonzero(often & ~together).tolist():
        several = np.flatnonzero(spots[begins[number] :][: sizes[number]] > 1)
        begin, end = np.percentile(several, MIDDLE)
        inside = np.count_nonzero((several >= begin) & (several <= end))
        together[number] = inside > _SEVERAL_IN_PART * (end - begin)
    return together


def _find_stays(groups: Sequence[_Group], observed: _Observations) -> None:
    """Finds when labels were at their places, which are numbered in the order of the groups."""
    there = [place for group in groups for place in group.places]
    if not there:
        return
    spots, rows = observed.sights.spots, np.concatenate(there)
    place = np.repeat(np.arange(len(there)), [len(spots_there) for spots_there in there])
    group_of = np.repeat(np.arange(len(groups)), [len(group.places) for group in groups])
    n = observed.counts[rows]
    sums = [np.bincount(place, n * spots[rows, column]) for column in (Spot.X, Spot.Y)]
    centres = np.stack(sums, axis=1) / np.bincount(place, n)[:, None]
    sizes, look, n_of_look = observed.hits.rows_of(rows)
    hits = np.stack((np.repeat(spots[rows, Spot.SLICE], sizes), look, n_of_look), axis=1)
    place_of_hit = np.repeat(place, sizes)
    evidence = evidence_at(
        observed.cells,
        observed.fields,
        centres,
        hits,
        place_of_hit,
        unplaced=[group.unplaced for group in groups],
        label=group_of,
    )
    observed.go_on()
    stays = [*stays_at(observed.cells, evidence)]
    # Rows of a place are in the order of their slices.
    width = len(observed.sights.epochs)
    slices, number = place * width + spots[rows, Spot.SLICE], [number for number, _ in stays]
    ends = np.array([(stay.first_slice, stay.last_slice + 1) for _, stay in stays], np.int64)
    ends = ends.reshape(-1, 2) + np.array(number, np.int64)[:, None] * width
    begin, end = np.searchsorted(slices, ends).T
    for group in groups:
        group.evidence = evidence
    for stay in _placed(observed, stays, rows[in_ranges(begin, end - begin)], end - begin):
        groups[group_of[stay.place]].stays.append(stay)


def _placed(
    observed: _Observations, stays: Sequence[tuple[int, Stay]], rows: Ints, sizes: Ints
) -> list[PlacedStay]:
    """Returns stays at places, which are numbered, with so many spots each, one at least."""
    if not stays:
        return []
    spots, n = observed.sights.spots[rows], observed.counts[rows]
    begins, stay_of = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(stays)), sizes)
    total = np.add.reduceat(n, begins)
    x, y, z = (np.add.reduceat(n * spots[:, axis], begins) / total for axis in _PLACE)
    off = (spots[:, Spot.X] - x[stay_of]) ** 2 + (spots[:, Spot.Y] - y[stay_of]) ** 2
    squares = np.add.reduceat(n * (spots[:, Spot.DEV] ** 2 + off), begins)
    slices, first, last = spots[:, Spot.SLICE], spots[:, Spot.FIRST], spots[:, Spot.LAST]
    firm = np.array([(stay.firm_first, stay.firm_last) for _, stay in stays]).T
    is_firm = (slices >= firm[0][stay_of]) & (slices <= firm[1][stay_of])
    is_firm |= ~(np.maximum.reduceat(is_firm, begins) & (firm[0] >= 0))[stay_of]
    columns = (
        *(x, y, z, np.sqrt(squares / total)),
        np.minimum.reduceat(first, begins),
        np.maximum.reduceat(last, begins),
        np.minimum.reduceat(np.where(is_firm, first, MAX_NS), begins),
        np.maximum.reduceat(np.where(is_firm, last, -MAX_NS), begins),
    )
    looked_in = observed.cells.looked_in
    others = (
        [None if stay.left is None else looked_in(stay.left) for _, stay in stays],
        total.tolist(),
        np.split(rows, begins[1:]),
        *zip(*stays, strict=True),
        [
            stay.clear_hits < _FEWEST or stay.hits < _LOWEST_RATE * stay.messages
            for _, stay in stays
        ],
    )
    numbers = (column.tolist() for column in columns)
    return [PlacedStay(*row) for row in zip(*numbers, *others, strict=True)]


def _remove_false_stays(
    groups: Sequence[_Group], observed: _Observations, keys: Sequence[str]
) -> None:
    """Removes stays that are other things under a wrong name, noise around one, or too rare.

    What a thing was called wrongly is counted in `PlacedStay.also`.
    """
    stays = [(group, stay) for group in groups for stay in group.stays]
    hosts = dict(_hosts(stays, observed, keys))
    taken: set[int] = set()
    for number in sorted(hosts, key=lambda number: (stays[number][1].count, number)):
        host = next((host for host in hosts[number] if host not in taken), None)
        if host is not None:
            taken.add(number)
            (group, stay), (host_group, hosting) = stays[number], stays[host]
            if host_group is not group:
                hosting.also += spellings(observed.sights, observed.counts, stay.spots)
    for group in groups:
        group.stays = []
    for number, (group, stay) in enumerate(stays):
        if number not in taken and not stay.weak:
            group.stays.append(stay)


def _hosts(
    stays: Sequence[tuple[_Group, PlacedStay]], observed: _Observations, keys: Sequence[str]
) -> Iterator[tuple[int, list[int]]]:
    """Yields which stays may be a wrong name of others, or noise around them, with these.

    The likeliest of these first.
    """
    beside_spots = (observed.sights.beside[:, name] for name in Beside)
    table, beside = _StayTable.of(stays), Tally.of(len(observed.counts), *beside_spots)
    names, key_of_label = numbered(keys)
    key = np.array([names.index(group.key) for group, _ in stays], np.int64)
    # The spots of all stays, as numbers in order, and how often these and those before count.
    sizes = [len(stay.spots) for _, stay in stays]
    number = np.repeat(np.arange(len(stays)), sizes)
    rows = np.concatenate([np.zeros(0, np.int64), *(stay.spots for _, stay in stays)])
    spots, width = observed.sights.spots[rows], len(observed.sights.epochs) + 1
    seen = number * width + spots[:, Spot.SLICE]
    times = np.append(0, np.cumsum(observed.counts[rows]))
    are_several = 2 * np.bincount(number, spots[:, Spot.TOGETHER] > 1, len(stays)) >= sizes
    for begin in range(0, len(stays), _STAYS_AT_ONCE):
        observed.go_on()
        numbers = np.arange(begin, min(begin + _STAYS_AT_ONCE, len(stays)))
        one, other, away_mm = table.near(numbers)
        slices = (table.first_slice, table.last_slice + 1)
        start, end = (np.searchsorted(seen, other * width + at[one]) for at in slices)
        count, hosted = table.n[one], times[end] - times[start]
        is_same = key[one] == key[other]
        is_tiny = (count <= hosted) & (count <= _TINY_SHARE * table.n[other])
        # Where most messages that have one have both of them, this one is no noise.
        is_tiny &= ~(are_several[one] & is_same) | (2 * count <= hosted)
        is_part = is_tiny | (count <= hosted * np.where(is_same, _HALO_SHARE, _SMALL_SHARE))
        is_part &= (is_same | (away_mm <= _SAME_PLACE_MM)) & (hosted > 0)
        order = np.lexsort((other, -hosted, one))
        order = order[is_part[order]]
        pairs = zip(one[order].tolist(), other[order].tolist(), strict=True)
        # How often detections of each of these stays had labels of each key beside them.
        of_these = slice(*np.searchsorted(number, (begin, begin + _STAYS_AT_ONCE)))
        per_spot, label, n = beside.rows_of(rows[of_these])
        nth_of = np.repeat(number[of_these] - begin, per_spot)
        cells = nth_of * len(names) + key_of_label[label]
        often = np.bincount(cells, n, len(numbers) * len(names)).reshape(len(numbers), -1)
        is_apart = often >= _BESIDE_SHARE * table.n[numbers, None]
        is_apart[numbers - begin, key[numbers]] = False
        for nth, hosts in groupby(pairs, itemgetter(0)):
            yield nth, [host for _, host in hosts if not is_apart[nth - begin, key[host]]]


class _StayTable(NamedTuple):
    """Columns of stays: see `_Group`, `PlacedStay` and `Stay`. `by_x` is their order."""

    epoch: Ints
    n: Ints
    first: Ints
    last: Ints
    weak: Ints
    first_slice: Ints
    last_slice: Ints
    places: Floats
    by_x: Ints

    @classmethod
    def of(cls, stays: Sequence[tuple[_Group, PlacedStay]]) -> _StayTable:
        names = attrgetter("count", "first", "last", "weak", "stay.first_slice", "stay.last_slice")
        rows = [(group.epoch, *names(stay)) for group, stay in stays]
        places = np.array([(stay.x, stay.y, stay.z) for _, stay in stays], np.float64)
        places = places.reshape(-1, 3).T
        by_x = np.argsort(places[0], kind="stable")
        return cls._make((*np.array(rows, np.int64).reshape(-1, 7).T, places, by_x))

    def near(self, numbers: Ints) -> tuple[Ints, Ints, Floats]:
        """Returns some stays and others near each at that time, as pairs, and how far (mm)."""
        x, y, z = self.places
        ends = (x[numbers] - _HALO_MM, x[numbers] + _HALO_MM)
        start, stop = (np.searchsorted(x[self.by_x], end) for end in ends)
        one, other = np.repeat(numbers, stop - start), self.by_x[in_ranges(start, stop - start)]
        away = np.hypot(x[other] - x[one], y[other] - y[one])
        is_near = (away <= _HALO_MM) & (np.abs(z[other] - z[one]) <= STOREY_MM) & (other != one)
        is_near &= (self.first[other] <= self.last[one]) & (self.last[other] >= self.first[one])
        is_near &= (self.epoch[other] == self.epoch[one]) & (self.weak[other] == 0)
        return one[is_near], other[is_near], away[is_near]


def _link(group: _Group, observed: _Observations) -> list[Instance]:
    """Links stays into as few things as explain them.

    A stay goes on where one had ended, that is, where its place was seen without it. Of a label
    that is known to be moved, a place that was not looked at may have been left, too.
    """
    instances = _chained(group, group.stays, proven=True)
    if any(_is_far(thing.stays[0], stay) for thing in instances for stay in thing.stays):
        unproven = _chained(group, group.stays, proven=False)
        parts = _split_around_others(group.stays, observed)
        instances = min(instances, unproven, _chained(group, parts, proven=False), key=len)
    for instance in instances:
        instance.stays = _without_overlap(instance.stays, observed)
    return instances


def _chained(group: _Group, stays: Sequence[PlacedStay], *, proven: bool) -> list[Instance]:
    """Returns things whose stays go on one after another, at the same place if they can.

    Args:
        group: has the label.
        stays: of it.
        proven: whether a stay goes on only where one is known to have ended.
    """
    instances: list[Instance] = []
    for stay in sorted(stays, key=lambda stay: stay.firm_first):
        ended = [
            instance
            for instance in instances
            if instance.stays[-1].firm_last <= stay.firm_first
            and (not proven or _has_ended(instance.stays[-1], stay))
        ]
        if ended:
            lasts = [instance.stays[-1] for instance in ended]
            preferred = [(last.place == stay.place, last.last) for last in lasts]
            ended[preferred.index(max(preferred))].stays.append(stay)
        else:
            instances.append(Instance(group.key, group.epoch, [stay]))
    return instances


def _has_ended(last: PlacedStay, stay: PlacedStay) -> bool:
    """Whether a stay was seen to end, or the next is so near that two would be seen together."""
    return last.left is not None or (last.last <= stay.first and not _is_far(last, stay))


def _is_far(one: PlacedStay, other: PlacedStay) -> bool:
    is_above = abs(one.z - other.z) > STOREY_MM
    return is_above or math.hypot(one.x - other.x, one.y - other.y) > GATE_MM


def _split_around_others(stays: Sequence[PlacedStay], observed: _Observations) -> list[PlacedStay]:
    """Splits stays that have another one of the same label between two sightings."""
    spots, parts = observed.sights.spots, []
    for stay in stays:
        observed.go_on()
        rows = stay.spots[np.argsort(spots[stay.spots, Spot.FIRST], kind="stable")]
        first, last = spots[rows, Spot.FIRST], spots[rows, Spot.LAST]
        cuts = set()
        for other in stays:
            is_inside = stay.firm_first < other.firm_first and other.firm_last < stay.firm_last
            if other.place != stay.place and is_inside:
                before, after = last < other.firm_first, first > other.firm_last
                # Nothing of the stay was seen during the other one.
                if (before | after).all() and before.any() and after.any():
                    cuts.add(int(after.argmax()))
        whole = stay.stay._replace(firm_first=-1, firm_last=-1)
        sizes = np.diff([0, *sorted(cuts), len(rows)])
        split = [(stay.place, whole)] * len(sizes)
        placed = _placed(observed, split, rows, sizes) if cuts else [stay]
        placed[0].also = stay.also
        parts += placed
    return parts


def _without_overlap(stays: Sequence[PlacedStay], observed: _Observations) -> list[PlacedStay]:
    """Returns stays without single sightings at places that the thing has left: they are false."""
    spots = observed.sights.spots
    kept: list[PlacedStay] = []
    for number, stay in enumerate(stays):
        rows = stay.spots
        if number + 1 < len(stays):
            end = max(stays[number + 1].firm_first, stay.firm_last)
            rows = rows[spots[rows, Spot.LAST] <= end]
        if number:
            begin = min(stays[number - 1].firm_last, stay.firm_first)
            rows = rows[spots[rows, Spot.FIRST] >= begin]
        if len(rows) == len(stay.spots):
            kept.append(stay)
        else:
            [trimmed] = _placed(observed, [(stay.place, stay.stay)], rows, np.array([len(rows)]))
            kept.append(replace(trimmed, also=stay.also, left=stay.left))
    return kept


def _add_poorly_localised(
    group: _Group, instances: Sequence[Instance], observed: _Observations
) -> None:
    """Adds what was seen while localisation was poor to the things that it may have been."""
    is_left_out = observed.poor[group.rows] & (len(observed.firm(group.rows)) < len(group.rows))
    for row in group.rows[is_left_out].tolist():
        [spot] = observed.sights.spots[np.array([row])]
        begun = [
            [stay for stay in instance.stays if stay.first <= spot[Spot.LAST]]
            for instance in instances
        ]
        newest = [stays[-1] for stays in begun if stays]
        newest = [stay for stay in newest if abs(stay.z - spot[Spot.Z]) <= STOREY_MM]
        away_mm = [math.hypot(stay.x - spot[Spot.X], stay.y - spot[Spot.Y]) for stay in newest]
        if away_mm and min(away_mm) <= GATE_MM:
            stay = newest[away_mm.index(min(away_mm))]
            stay.spots = np.sort(np.append(stay.spots, row))
            stay.last = max(stay.last, int(spot[Spot.LAST]))
            stay.count += int(observed.counts[row])


def most_at_once(spots: Ints) -> int:
    """Returns how many of a label were seen at once; one message in a hundred may have a false one.

    `spots` are its rows of `Sights.spots`, at least one: of those in a region, no more than there
    are in a slice.
    """
    slices = np.unique(spots[:, Spot.SLICE], return_inverse=True)[1]
    together = np.sort(np.minimum(spots[:, Spot.TOGETHER], np.bincount(slices)[slices]))
    return max(1, int(together[-max(1, len(together) // 100)]))


def _names(sights: JoinedSights, labels: Labels) -> dict[str, str]:
    """Returns the name to show of each key, by how often each of its labels was detected."""
    tables = sights.spots, sights.unplaced  # a label and a number are the same columns of both
    code, often = (
        np.concatenate([table[:, at] for table in tables]) for at in (Spot.LABEL, Spot.N)
    )
    detections = np.bincount(code, often, len(sights.labels)).astype(np.int64)
    counts: dict[str, dict[str, int]] = {}
    for label, n in zip(sights.labels, detections.tolist(), strict=True):
        if n:
            counts.setdefault(labels.key(label), {})[label] = n
    return {key: labels.name(key, by_label) for key, by_label in counts.items()}

"""Instances: stays at places, linked into things with a history.

A label that is a small share of another's detections at a place, and is never in one message with
it there, is that other thing under a wrong name. The stays that are left are linked into as few
things as explain them: a stay that was seen to have ended may go on elsewhere. A label of people or
pets, or one whose stays are many and short, moves by itself: it has a track, and no places.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import (
    SCORE_BINS,
    Flags,
    Floats,
    Hit,
    Ints,
    Score,
    Sights,
    Spot,
    Unplaced,
)
from ros2_memory.core.arrays import distinct_rows
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.things.labels import Labels, moves_by_itself
from ros2_memory.things.localisation import poorly_localised
from ros2_memory.things.moves import Sightings, stays_in
from ros2_memory.things.places import GATE_MM, places_of
from ros2_memory.things.presence import (
    Cells,
    Evidence,
    Stay,
    evidence_at,
    field_of_view,
    in_ranges,
    looks_without,
    stays_at,
)
from ros2_memory.things.synonyms import with_synonyms

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ros2_memory.core.model import TimeWindow


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
    def at(self) -> tuple[float, float, float]:
        """The mean of its detections (m)."""
        return self.x / 1000, self.y / 1000, self.z / 1000


@dataclass(slots=True)
class Instance:
    """One thing: its stays in order of time, at least one. `key` is its canonical label's."""

    key: str
    epoch: int
    stays: list[PlacedStay]
    looks: int = 0
    """Detector messages since it was last seen, from where it would have been."""
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


@dataclass(slots=True)
class Estimate:
    """The things in sights, sorted by label and place."""

    sights: Sights
    """Without what is in `cells` and `hits`, what only an estimate needs, and too low scores."""
    instances: list[Instance]
    movers: list[Mover]
    counts: Ints
    """How many detections of each spot count."""
    poor: Flags
    """Which spots were seen while localisation was poor."""
    hits: Ints
    """The hits of these, by spot; `hit_starts` is where each spot's begin."""
    hit_starts: Ints
    names: dict[str, str]
    """The name to show of each key."""
    cells: Cells
    evidence: dict[tuple[str, int, int], Evidence]
    """By key, epoch and place: the evidence for the places of things."""
    stays: list[tuple[Instance, PlacedStay]] = field(init=False)
    stay_of: Ints = field(init=False)
    """Of each spot, the first of `stays` that has it; -1 where none has."""

    def __post_init__(self) -> None:
        self.stays = [(each, stay) for each in self.instances for stay in each.stays]
        self.stay_of = np.full(len(self.sights.spots), -1, np.int64)
        for nth, (_, stay) in reversed([*enumerate(self.stays)]):
            self.stay_of[stay.spots] = nth

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        tables = sum(table.nbytes for table in (*self.sights.tables, self.hits))
        looks = len(self.cells.slice) + sum(len(each.looks) for each in self.evidence.values())
        return tables + 100 * looks

    def seen_in(self, rows: Ints, window: TimeWindow, before: Ns = MAX_NS) -> Ints:
        """Returns which of some spots are of slices that reach into a window and end before a time.

        Slices count as a whole; a spot without detections that count is left out.
        """
        first, last = self.sights.spots[rows][:, [Spot.FIRST, Spot.LAST]].T
        inside = (first < window.stop) & (last >= window.start) & (last < before)
        found: Ints = rows[inside & (self.counts[rows] > 0)]
        return found

    def is_vague(self, rows: Ints) -> bool:
        """Whether the newest of some spots was seen while localisation was poor."""
        return bool(self.poor[rows[self.sights.spots[rows, Spot.LAST].argmax()]])

    def place_of(self, stay: PlacedStay, rows: Ints) -> tuple[float, float, float]:
        """Returns the mean place (m) of some spots of a stay; of all of it if these are poor."""
        rows = rows[~self.poor[rows]]
        if not len(rows):
            return stay.at
        spots = self.sights.spots[rows][:, [Spot.X, Spot.Y, Spot.Z]]
        x, y, z = (np.average(spots, axis=0, weights=self.counts[rows]) / 1000).tolist()
        return x, y, z

    def seen_from(self, spots: Ints) -> tuple[float, float, float] | None:
        """Returns the pose (m, rad) from which most messages saw some spots; None if unknown.

        That is the mean pose in one cell; of two with equal numbers, in the one that saw it later.
        """
        hits = _rows_of(spots, self.hits, self.hit_starts)
        hits = hits[hits[:, Hit.LOOK] >= 0]
        if not len(hits):
            return None
        looks, n = hits[:, Hit.LOOK], hits[:, Hit.N]
        cells, of = np.unique(self.cells.cell[looks], return_inverse=True)
        seen, last = np.bincount(of, n), np.zeros(len(cells), np.int64)
        np.maximum.at(last, of, self.cells.last[looks])
        mine = of == np.lexsort((last, seen))[-1]
        looks, n = looks[mine], n[mine]
        x, y, yaw = (
            float((column[looks] * n).sum() / n.sum())
            for column in (self.cells.x, self.cells.y, self.cells.yaw)
        )
        return x / 1000, y / 1000, math.radians((yaw + 180) % 360 - 180)

    def missing(
        self, instance: Instance, stay: PlacedStay, window: tuple[Ns, Ns] | None = None
    ) -> tuple[int, Ns | None]:
        """Returns `looks_without` a thing after one of its stays, or in a window before it."""
        evidence = self.evidence[instance.key, instance.epoch, stay.place]
        seen_to = stay.last if window is None else MAX_NS
        window = window or (stay.last + 1, MAX_NS)
        return looks_without(self.cells, evidence, stay.stay, seen_to, window)

    def stay_with(self, seen: Ints) -> tuple[Instance, PlacedStay] | None:
        """Returns the thing, and its stay, that has the first of some spots that any thing has.

        `seen` are rows of `Sights.spots` of another estimate (mm, ns), of some of the same bags.
        Returns None where no thing has any of them.
        """
        alike = [Spot.N, Spot.X, Spot.Y, Spot.LAST]
        spots = self.sights.spots
        for spot in seen:
            rows = np.flatnonzero(spots[:, Spot.FIRST] == spot[Spot.FIRST])
            rows = rows[(spots[rows][:, alike] == spot[alike]).all(axis=1)]
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
    evidence: Evidence | None = None


def estimate(
    sights: Sights,
    labels: Labels,
    epochs: Sequence[int] | Ints | None = None,
    min_score: float = 0.0,
    go_on: Callable[[], None] = lambda: None,
) -> Estimate:
    """Returns the things in the sights of slices that are in order of time.

    `epochs` has the coordinate system of each slice: slices of different ones are separate.
    Detections whose score lies below `min_score`, to 0.05, do not count. `go_on` is called again
    and again; what it raises ends the estimate.
    """
    epoch = np.zeros(sights.slices, np.int64) if epochs is None else np.asarray(epochs, np.int64)
    seen = _Seen(sights, epoch, min_score)
    names = _names(sights, labels)
    epoch_of = epoch[sights.spots[:, Spot.SLICE]]
    keys = with_synonyms(sights, seen.counts, epoch_of, labels, go_on)
    groups = _groups(seen, epoch, keys)
    _find_places(groups, seen, go_on)
    for group in groups:
        _find_stays(group, seen, go_on)
    _fold(groups, seen, keys, go_on)
    instances: list[Instance] = []
    movers: list[Mover] = []
    evidence: dict[tuple[str, int, int], Evidence] = {}
    for group in groups:
        linked = _link(group, seen, go_on)
        _add_poor(group, linked, seen)
        if not _moves_by_itself(group, linked):
            instances += linked
            if group.evidence is not None:
                # Most places are of false detections.
                for place in {stay.place for each in linked for stay in each.stays}:
                    evidence[group.key, group.epoch, place] = group.evidence.at(place)
        elif _is_seen(group, seen):
            movers.append(Mover(group.key, group.epoch, group.rows))
    for each in instances:
        rows = np.concatenate([stay.spots for stay in each.stays])
        each.labels = named(spellings(sights, seen.counts, rows), labels, names)
    instances.sort(key=lambda each: (each.label, each.stays[0].first, each.stays[0].x))
    found = Estimate(
        sights=sights.only(Spot, Score, Unplaced).with_scores_from(_lowest_bin(min_score)),
        instances=instances,
        movers=movers,
        counts=seen.counts,
        poor=seen.poor,
        hits=seen.hits,
        hit_starts=seen.starts,
        names=names,
        cells=seen.cells,
        evidence=evidence,
    )
    for each in instances:
        each.looks, each.missed_by = found.missing(each, each.stays[-1])
    return found


def spellings(sights: Sights, counts: Ints, rows: Ints) -> Counter[str]:
    """Returns how often some spots were seen under each label, as detectors write it."""
    often = np.bincount(sights.spots[rows, Spot.LABEL], counts[rows])
    return Counter(
        {sights.labels[label]: int(often[label]) for label in np.flatnonzero(often).tolist()}
    )


def named(found: Mapping[str, int], labels: Labels, names: Mapping[str, str]) -> dict[str, int]:
    """Returns how often each name was seen, the commonest first; `names` has that of each key."""
    counts: Counter[str] = Counter()
    for spelling, n in found.items():
        counts[names[labels.key(spelling)]] += n
    return dict(sorted(counts.items(), key=lambda each: (-each[1], each[0])))


class _Seen:
    """The sights of an estimate, and what is computed once for all labels.

    Attributes:
        counts: how many detections of each spot count.
        poor: which spots were seen while localisation was poor: these move nothing.
        hits: the hits of these, by spot; `starts` is where each spot's begin.
        groups: of each spot a number; those of one slice, topic and label have the same.
        view: by topic the field of view that its detections show.
        side: of each spot, the mean of the unit vectors to it from where it was seen.
    """

    def __init__(self, sights: Sights, epoch: Ints, min_score: float) -> None:
        self.sights = sights
        self.counts = sights.spots[:, Spot.N].copy()
        low = sights.scores[sights.scores[:, Score.BIN] < _lowest_bin(min_score)]
        np.subtract.at(self.counts, low[:, Score.SPOT], low[:, Score.N])
        self.poor, poor = poorly_localised(sights)
        # The hits of detections that count: in proportion, rounded up.
        every, spot = sights.hits.copy(), sights.hits[:, Hit.SPOT]
        every[:, Hit.N] = -(-every[:, Hit.N] * self.counts[spot] // sights.spots[spot, Spot.N])
        self.hits, self.starts = _by_spot(every[every[:, Hit.N] > 0], sights)
        self.hits[np.append(poor, [False])[self.hits[:, Hit.LOOK]], Hit.LOOK] = -1
        by = (Spot.SLICE, Spot.TOPIC, Spot.LABEL)
        self.groups = distinct_rows([sights.spots[:, column] for column in by])[1]
        self.cells = Cells(sights, epoch, poor)
        hits = self.hits[self.hits[:, Hit.LOOK] >= 0]
        away, bearing = self.cells.seen_at(
            hits[:, Hit.LOOK], *(sights.spots[hits[:, Hit.SPOT]][:, [Spot.X, Spot.Y]].T)
        )
        topics = sights.spots[hits[:, Hit.SPOT], Spot.TOPIC]
        self.view = {
            topic: field_of_view(away[of], bearing[of], hits[of, Hit.N])
            for topic in np.unique(topics).tolist()
            for of in (topics == topic,)
        }
        ahead = self.cells.yaw + self.cells.pan
        heading = np.radians(bearing + ahead[hits[:, Hit.LOOK]])
        spot, n, size = hits[:, Hit.SPOT], hits[:, Hit.N], len(sights.spots)
        sums = [np.bincount(spot, n * of(heading), size) for of in (np.cos, np.sin)]
        self.side: Floats = (
            np.stack(sums, axis=1) / np.maximum(np.bincount(spot, n, size), 1)[:, None]
        )

    def firm(self, rows: Ints) -> Ints:
        """Returns the spots that were seen while localisation was good, all if none was."""
        good: Ints = rows[~self.poor[rows]]
        return good if self.counts[good].sum() >= _FEWEST else rows

    def sightings(self, rows: Ints) -> Sightings:
        """Returns some spots as sightings of one thing."""
        spots = self.sights.spots[rows]
        place = spots[:, [Spot.X, Spot.Y]].astype(np.float64)
        times = spots[:, Spot.FIRST], spots[:, Spot.LAST]
        return Sightings(place, self.counts[rows], spots[:, Spot.DEV], self.side[rows], *times)


def _by_spot(table: Ints, sights: Sights) -> tuple[Ints, Ints]:
    """Returns rows ordered by spot, their column 0, and where those of each spot begin."""
    ordered = table[np.argsort(table[:, 0], kind="stable")]
    return ordered, np.searchsorted(ordered[:, 0], np.arange(len(sights.spots) + 1))


def _rows_of(spots: Ints, table: Ints, starts: Ints) -> Ints:
    """Returns the rows of some spots in a table that is ordered by spot."""
    rows: Ints = table[in_ranges(starts[spots], starts[spots + 1] - starts[spots])]
    return rows


def _lowest_bin(min_score: float) -> int:
    """Returns the lowest bin of scores that count."""
    return min(round(min_score * 1000) * SCORE_BINS // 1000, SCORE_BINS - 1)


def _groups(seen: _Seen, epoch: Ints, keys: Sequence[str]) -> list[_Group]:
    """Returns the labels in each epoch that have detections that count."""
    shown = [*dict.fromkeys(keys)]
    number = np.array([shown.index(key) for key in keys], np.int64)
    spots = seen.sights.spots
    of = epoch[spots[:, Spot.SLICE]] * (len(shown) + 1) + number[spots[:, Spot.LABEL]]
    of[seen.counts == 0] = -1
    groups = []
    for each in np.unique(of[of >= 0]).tolist():
        nth, key = divmod(each, len(shown) + 1)
        unplaced = seen.sights.unplaced
        unplaced = unplaced[number[unplaced[:, Unplaced.LABEL]] == key]
        groups.append(_Group(shown[key], nth, np.flatnonzero(of == each), unplaced))
    return groups


def _find_places(groups: Sequence[_Group], seen: _Seen, go_on: Callable[[], None]) -> None:
    """Finds the places of labels, each with one for every time that it was moved a little."""
    spots = seen.sights.spots
    single: list[tuple[_Group, Ints]] = []
    for group in groups:
        if moves_by_itself(group.key):
            continue
        go_on()
        rows = seen.firm(group.rows)
        place = places_of(
            spots[rows, Spot.X], spots[rows, Spot.Y], seen.counts[rows], spots[rows, Spot.SLICE]
        )
        rows, place = rows[place >= 0], place[place >= 0]
        several, counts = (
            _are_several(place, seen.groups[rows]),
            np.bincount(place, seen.counts[rows]),
        )
        order = np.argsort(place, kind="stable")
        ends = np.cumsum(np.bincount(place))
        for nth, mine in enumerate(np.split(rows[order], ends[:-1])):
            if several[nth]:
                group.places.append(mine)
            elif counts[nth] >= _FEWEST:
                single.append((group, mine))
    steps = stays_in([seen.sightings(rows) for _, rows in single])
    for (group, rows), step in zip(single, steps, strict=True):
        group.places += [rows[step == each] for each in range(int(step.max()) + 1)]


def _are_several(place: Ints, groups: Ints) -> Flags:
    """Returns at which places slices have several spots of a label: things that stand together."""
    width = int(groups.max(initial=0)) + 1
    distinct = np.bincount(np.unique(place * width + groups) // width)
    several: Flags = np.bincount(place) - distinct > _SEVERAL_SHARE * distinct
    return several


def _find_stays(group: _Group, seen: _Seen, go_on: Callable[[], None]) -> None:
    """Finds when a label was at its places."""
    every = seen.sights.spots
    if not group.places:
        return
    mine = np.concatenate(group.places)
    of = np.repeat(np.arange(len(group.places)), [len(rows) for rows in group.places])
    n = seen.counts[mine]
    sums = [np.bincount(of, n * every[mine, column]) for column in (Spot.X, Spot.Y)]
    places = np.stack(sums, axis=1) / np.bincount(of, n)[:, None]
    rows = _rows_of(mine, seen.hits, seen.starts)
    rows[:, Hit.SPOT] = every[rows[:, Hit.SPOT], Spot.SLICE]
    of = np.repeat(of, seen.starts[mine + 1] - seen.starts[mine])
    group.evidence = evidence_at(seen.cells, seen.view, places, rows, of, unplaced=group.unplaced)
    for place, stay in stays_at(seen.cells, group.evidence):
        go_on()
        spots = group.places[place]
        own = every[spots, Spot.SLICE]
        inside = spots[(own >= stay.first_slice) & (own <= stay.last_slice)]
        group.stays.append(_placed(seen, place, stay, inside))


def _placed(seen: _Seen, place: int, stay: Stay, rows: Ints) -> PlacedStay:
    spots, n = seen.sights.spots[rows], seen.counts[rows]
    total = int(n.sum())
    x, y, z = (n @ spots[:, [Spot.X, Spot.Y, Spot.Z]] / total).tolist()
    squares = spots[:, Spot.DEV] ** 2 + (spots[:, Spot.X] - x) ** 2 + (spots[:, Spot.Y] - y) ** 2
    firm = spots[:, Spot.SLICE]
    firm = spots[(firm >= stay.firm_first) & (firm <= stay.firm_last)]
    firm = firm if len(firm) and stay.firm_first >= 0 else spots
    return PlacedStay(
        x=x,
        y=y,
        z=z,
        dev_mm=math.sqrt(n @ squares / total),
        first=int(spots[:, Spot.FIRST].min()),
        last=int(spots[:, Spot.LAST].max()),
        firm_first=int(firm[:, Spot.FIRST].min()),
        firm_last=int(firm[:, Spot.LAST].max()),
        left=None if stay.left is None else seen.cells.looked_in(stay.left),
        count=total,
        spots=rows,
        place=place,
        stay=stay,
        weak=stay.hits < max(_FEWEST, _LOWEST_RATE * stay.messages),
    )


def _fold(
    groups: Sequence[_Group], seen: _Seen, keys: Sequence[str], go_on: Callable[[], None]
) -> None:
    """Removes stays that are other things under a wrong name, noise around one, or too rare."""
    every = [(group, stay) for group in groups for stay in group.stays]
    hosts = _Hosts(every, seen, keys)
    gone: set[int] = set()
    for nth in sorted(range(len(every)), key=lambda each: every[each][1].count):
        go_on()
        group, stay = every[nth]
        best, most = None, 0
        for other, hosted in hosts.of(nth):
            host_group, host = every[other]
            share = _HALO_SHARE if host_group is group else _SMALL_SHARE
            few = stay.count <= hosted and stay.count <= _TINY_SHARE * host.count
            few &= not (host_group is group and _is_beside(stay, hosted, seen))
            if other not in gone and (few or stay.count <= hosted * share) and hosted > most:
                best, most = other, hosted
        if best is not None:
            gone.add(nth)
            host_group, host = every[best]
            if host_group is not group:
                host.also += spellings(seen.sights, seen.counts, stay.spots)
    for group in groups:
        group.stays = []
    for nth, (group, stay) in enumerate(every):
        if nth not in gone and not stay.weak:
            group.stays.append(stay)


def _is_beside(stay: PlacedStay, hosted: int, seen: _Seen) -> bool:
    """Whether most messages that have one of a label also have this one, which is no noise then."""
    together = seen.sights.spots[stay.spots, Spot.TOGETHER]
    return 2 * stay.count > hosted and bool(np.median(together) > 1)


class _Hosts:
    """Finds the stays that one may be a wrong name of, or the noise around."""

    def __init__(
        self, every: Sequence[tuple[_Group, PlacedStay]], seen: _Seen, keys: Sequence[str]
    ) -> None:
        self._every, self._seen, self._keys = every, seen, keys
        self._beside = _by_spot(seen.sights.beside, seen.sights)
        columns = [
            (stay.x, stay.y, stay.first, stay.last, group.epoch, stay.weak) for group, stay in every
        ]
        table = np.array(columns, np.float64).reshape(-1, 6)
        self._order = np.argsort(table[:, 0], kind="stable")
        self._columns = table[self._order].T

    def of(self, nth: int) -> Iterator[tuple[int, int]]:
        """Yields their numbers, in order, and how often each was seen in the slices of the stay."""
        group, stay = self._every[nth]
        start, stop = np.searchsorted(self._columns[0], (stay.x - _HALO_MM, stay.x + _HALO_MM))
        x, y, first, last, epoch, weak = self._columns[:, start:stop]
        away = np.hypot(x - stay.x, y - stay.y)
        near = (away <= _HALO_MM) & (first <= stay.last) & (last >= stay.first)
        near &= (epoch == group.epoch) & (weak == 0)
        beside: Counter[str] | None = None
        found = zip(self._order[start:stop][near].tolist(), away[near].tolist(), strict=True)
        for other, away_mm in sorted(found):
            host_group, host = self._every[other]
            if other == nth:
                continue
            if host_group is not group:
                if away_mm > _SAME_PLACE_MM:
                    continue
                beside = self._beside_of(stay) if beside is None else beside
                if beside[host_group.key] >= _BESIDE_SHARE * stay.count:
                    continue
            rows = host.spots
            slices = self._seen.sights.spots[rows, Spot.SLICE]
            ends = stay.stay.first_slice, stay.stay.last_slice + 1
            during = slice(*np.searchsorted(slices, ends))
            yield other, int(self._seen.counts[rows[during]].sum())

    def _beside_of(self, stay: PlacedStay) -> Counter[str]:
        """Returns how often its detections had other labels beside them, by the key of these."""
        counts: Counter[str] = Counter()
        for _, label, n in _rows_of(stay.spots, *self._beside).tolist():
            counts[self._keys[label]] += n
        return counts


def _link(group: _Group, seen: _Seen, go_on: Callable[[], None]) -> list[Instance]:
    """Links stays into as few things as explain them.

    A stay goes on where one had ended, that is, where its place was seen without it. Of a label
    that is known to be moved, a place that was not looked at may have been left, too.
    """
    instances = _chained(group, group.stays, proven=True)
    if any(_is_far(each.stays[0], stay) for each in instances for stay in each.stays):
        unproven = _chained(group, group.stays, proven=False)
        split = _chained(group, _split(group.stays, seen, go_on), proven=False)
        instances = min(instances, unproven, split, key=len)
    for each in instances:
        each.stays = _without_overlap(each.stays, seen)
    return instances


def _chained(group: _Group, stays: Sequence[PlacedStay], *, proven: bool) -> list[Instance]:
    instances: list[Instance] = []
    for stay in sorted(stays, key=lambda each: each.firm_first):
        ended = [
            (last.place == stay.place, is_left, last.last, -nth)
            for nth, each in enumerate(instances)
            for last in (each.stays[-1],)
            for is_left in (last.left is not None or _was_moved_a_little(last, stay),)
            if (is_left or not proven) and last.firm_last <= stay.firm_first
        ]
        if ended:
            instances[-max(ended)[-1]].stays.append(stay)
        else:
            instances.append(Instance(group.key, group.epoch, [stay]))
    return instances


def _is_far(one: PlacedStay, other: PlacedStay) -> bool:
    return math.hypot(one.x - other.x, one.y - other.y) > GATE_MM


def _was_moved_a_little(last: PlacedStay, stay: PlacedStay) -> bool:
    """Whether one stay follows another so near that two things would have been seen together."""
    return last.last <= stay.first and not _is_far(last, stay)


def _split(stays: Sequence[PlacedStay], seen: _Seen, go_on: Callable[[], None]) -> list[PlacedStay]:
    """Splits stays that have another one of the same label between two sightings."""
    spots, found = seen.sights.spots, []
    for stay in stays:
        go_on()
        order = stay.spots[np.argsort(spots[stay.spots, Spot.FIRST], kind="stable")]
        first, last = spots[order, Spot.FIRST], spots[order, Spot.LAST]
        cuts = set()
        for each in stays:
            inside = stay.firm_first < each.firm_first and each.firm_last < stay.firm_last
            if each.place != stay.place and inside:
                before, after = last < each.firm_first, first > each.firm_last
                # Nothing of the stay was seen during the other one.
                if (before | after).all() and before.any() and after.any():
                    cuts.add(int(after.argmax()))
        whole = stay.stay._replace(firm_first=-1, firm_last=-1)
        parts = np.split(order, sorted(cuts)) if cuts else ()
        found += [_placed(seen, stay.place, whole, part) for part in parts] or [stay]
    return found


def _without_overlap(stays: list[PlacedStay], seen: _Seen) -> list[PlacedStay]:
    """Removes single sightings at places that a thing has left: they are false."""
    spots, found = seen.sights.spots, []
    for nth, stay in enumerate(stays):
        rows = stay.spots
        if nth + 1 < len(stays):
            rows = rows[spots[rows, Spot.LAST] <= max(stays[nth + 1].firm_first, stay.firm_last)]
        if nth:
            rows = rows[spots[rows, Spot.FIRST] >= min(stays[nth - 1].firm_last, stay.firm_first)]
        if len(rows) == len(stay.spots):
            found.append(stay)
        else:
            trimmed = _placed(seen, stay.place, stay.stay, rows)
            trimmed.also, trimmed.left = stay.also, stay.left
            found.append(trimmed)
    return found


def _add_poor(group: _Group, instances: Sequence[Instance], seen: _Seen) -> None:
    """Adds what was seen while localisation was poor to the things that it may have been."""
    for row in np.setdiff1d(group.rows, seen.firm(group.rows)).tolist():
        spot = seen.sights.spots[row]
        # Of each thing the last stay that had begun by then.
        begun = [
            stay
            for each in instances
            for stay in [stay for stay in each.stays if stay.first <= spot[Spot.LAST]][-1:]
        ]
        away_mm = [math.hypot(stay.x - spot[Spot.X], stay.y - spot[Spot.Y]) for stay in begun]
        if away_mm and min(away_mm) <= GATE_MM:
            stay = begun[away_mm.index(min(away_mm))]
            stay.spots = np.sort(np.append(stay.spots, row))
            stay.last = max(stay.last, int(spot[Spot.LAST]))
            stay.count += int(seen.counts[row])


def most_at_once(spots: Ints) -> int:
    """Returns how many of a label were seen at once; one message in a hundred may have a false one.

    `spots` are its rows of `Sights.spots`, at least one: of those in a region, no more than there
    are in a slice.
    """
    nth = np.unique(spots[:, Spot.SLICE], return_inverse=True)[1]
    together = np.sort(np.minimum(spots[:, Spot.TOGETHER], np.bincount(nth)[nth]))
    return max(1, int(together[-max(1, len(together) // 100)]))


def _moves_by_itself(group: _Group, linked: Sequence[Instance]) -> bool:
    moves = len(group.stays) - len(linked)
    is_restless = moves >= _RESTLESS_MOVES and moves > _RESTLESS_SHARE * len(group.rows)
    return is_restless or moves_by_itself(group.key)


def _is_seen(group: _Group, seen: _Seen) -> bool:
    """Whether a mover has more detections than false ones would give."""
    n = seen.counts[group.rows]
    return int(n[n >= _FEWEST].sum()) >= _FEWEST_OF_MOVERS


def _names(sights: Sights, labels: Labels) -> dict[str, str]:
    counts: dict[str, dict[str, int]] = {}
    of_label = np.zeros(len(sights.labels), np.int64)
    for table in (
        sights.spots[:, [Spot.LABEL, Spot.N]],
        sights.unplaced[:, [Unplaced.LABEL, Unplaced.N]],
    ):
        np.add.at(of_label, table[:, 0], table[:, 1])
    for name, n in zip(sights.labels, of_label.tolist(), strict=True):
        if n:
            counts.setdefault(labels.key(name), {})[name] = n
    return {key: labels.name(key, each) for key, each in counts.items()}

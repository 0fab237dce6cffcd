"""Instances: stays at places, linked into things with a history.

A label that is a small share of another's detections at a place, and is never in one message with
it there, is that other thing under a wrong name. The stays that are left are linked into as few
things as explain them: a stay that was seen to have ended may go on elsewhere. A label whose stays
are many and short is of something that moves by itself: it has a track, and no places.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import SCORE_BINS, Beside, Hit, Score, Spot
from ros2_memory.things.places import places_of
from ros2_memory.things.presence import (
    Cells,
    Stay,
    chance_of_missing,
    evidence_at,
    field_of_view,
    in_ranges,
    stays_at,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.sights import Ints, Sights
    from ros2_memory.core.timebase import Ns
    from ros2_memory.things.labels import Labels
    from ros2_memory.things.presence import Evidence, FieldOfView

    Floats = NDArray[np.float64]

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
_MOVES_BY_ITSELF: Final = frozenset(
    (
        "person",
        "human",
        "pedestrian",
        "man",
        "woman",
        "child",
        "boy",
        "girl",
        "baby",
        "dog",
        "cat",
        "pet",
    )
)
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
        spots: rows of `Sights.spots`, in order of time.
        spellings: how often it was seen under each label.
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
    spellings: dict[str, int]
    place: int
    stay: Stay
    weak: bool
    also: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class Instance:
    """One thing: its stays in order of time, at least one. `key` is its canonical label's."""

    key: str
    epoch: int
    stays: list[PlacedStay]
    chance: float = 1.0
    """How likely it is that it is still there, and was missed since; 1 without a look."""
    looks: int = 0
    """Detector messages since it was last seen, from where it would have been."""
    missed_by: Ns | None = None
    """When that chance fell below 1 %; None where it did not."""

    @property
    def count(self) -> int:
        """Returns how often it was seen."""
        return sum(each.count for each in self.stays)


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
    instances: list[Instance]
    movers: list[Mover]
    counts: Ints
    """How many detections of each spot count."""
    hits: Ints
    """The hits of these, by spot; `hit_starts` is where each spot's begin."""
    hit_starts: Ints
    names: dict[str, str]
    """The name to show of each key."""
    cells: Cells
    evidence: dict[tuple[str, int], dict[int, Evidence]]
    """By key and epoch: the evidence for each place."""

    def seen_from(self, spots: Ints) -> tuple[float, float, float] | None:
        """Returns the pose (mm, degrees) from which most messages saw some spots; None if unknown.

        That is the mean pose in one cell; of two with equal numbers, in the one that saw it later.
        """
        starts = self.hit_starts[spots]
        hits = self.hits[in_ranges(starts, self.hit_starts[spots + 1] - starts)]
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
        return x, y, yaw

    def missing(self, instance: Instance, stay: PlacedStay) -> tuple[float, int, Ns | None]:
        """Returns `chance_of_missing` a thing after one of its stays."""
        place = self.evidence[instance.key, instance.epoch][stay.place]
        return chance_of_missing(self.cells, place, stay.stay, stay.last)


@dataclass(slots=True)
class _Group:
    """The places of one label in one epoch."""

    key: str
    epoch: int
    rows: Ints
    stays: list[PlacedStay] = field(default_factory=list)
    evidence: dict[int, Evidence] = field(default_factory=dict)


def estimate(
    sights: Sights,
    labels: Labels,
    epochs: Sequence[int] | None = None,
    min_score: float = 0.0,
    go_on: Callable[[], None] = lambda: None,
) -> Estimate:
    """Returns the things in the sights of bags that are in order of time.

    `epochs` has the coordinate system of each bag: bags of different ones are separate.
    Detections whose score lies below `min_score`, to 0.05, do not count. `go_on` is called again
    and again; what it raises ends the estimate.
    """
    spots = sights.spots
    epoch = np.zeros(sights.bags, np.int64) if epochs is None else np.array(epochs, np.int64)
    seen = _Seen(sights, epoch, min_score)
    keys = [labels.key(each) for each in sights.labels]
    shown = [*dict.fromkeys(keys)]
    key_of = np.array([shown.index(key) for key in keys], np.int64)
    group_of = epoch[spots[:, Spot.BAG]] * (len(shown) + 1) + key_of[spots[:, Spot.LABEL]]
    group_of[seen.counts == 0] = -1
    groups = []
    for number in np.unique(group_of[group_of >= 0]).tolist():
        nth, key = divmod(number, len(shown) + 1)
        key_name = shown[key]
        group = _Group(key_name, nth, np.flatnonzero(group_of == number))
        if not _is_named_mover(key_name):
            _find_stays(group, seen, go_on)
        groups.append(group)
    _fold(groups, seen, keys, go_on)
    instances: list[Instance] = []
    movers: list[Mover] = []
    for group in groups:
        linked = _link(group, seen, go_on)
        if _moves_by_itself(group, linked):
            if not _is_seen(group, seen):
                continue
            movers.append(Mover(group.key, group.epoch, group.rows))
            continue
        for each in linked:
            last = each.stays[-1]
            each.chance, each.looks, each.missed_by = chance_of_missing(
                seen.cells, group.evidence[last.place], last.stay, last.last
            )
        instances += linked
    instances.sort(key=lambda each: (each.key, each.stays[0].first, each.stays[0].x))
    return Estimate(
        sights,
        instances,
        movers,
        seen.counts,
        seen.hits,
        seen.starts,
        _names(sights, labels),
        seen.cells,
        {(each.key, each.epoch): each.evidence for each in groups},
    )


class _Seen:
    """The sights of an estimate, and what is computed once for all labels.

    Attributes:
        counts: how many detections of each spot count.
        hits: the hits of these, by spot; `starts` is where each spot's begin.
    """

    def __init__(self, sights: Sights, epoch: Ints, min_score: float) -> None:
        self.sights = sights
        self.counts = _counts(sights, min_score)
        hits = _hits(sights, self.counts)
        self.hits = hits[np.argsort(hits[:, Hit.SPOT], kind="stable")]
        self.starts = np.searchsorted(self.hits[:, Hit.SPOT], np.arange(len(sights.spots) + 1))
        self.cells = Cells(sights, epoch)
        self.view = _fields_of_view(sights, self.cells, self.hits)

    def hits_of(self, spots: Ints) -> Ints:
        """Returns the hits of some spots."""
        starts = self.starts[spots]
        return self.hits[in_ranges(starts, self.starts[spots + 1] - starts)]


def _counts(sights: Sights, min_score: float) -> Ints:
    """Returns how many detections of each spot have a score that counts."""
    counts = sights.spots[:, Spot.N].copy()
    lowest = min(round(min_score * 1000) * SCORE_BINS // 1000, SCORE_BINS - 1)
    if lowest > 0:
        low = sights.scores[sights.scores[:, Score.BIN] < lowest]
        np.subtract.at(counts, low[:, Score.SPOT], low[:, Score.N])
    return counts


def _hits(sights: Sights, counts: Ints) -> Ints:
    """Returns the hits of detections that count: in proportion, rounded up."""
    hits = sights.hits.copy()
    spot = hits[:, Hit.SPOT]
    hits[:, Hit.N] = -(-hits[:, Hit.N] * counts[spot] // sights.spots[spot, Spot.N])
    return hits[hits[:, Hit.N] > 0]


def _fields_of_view(sights: Sights, cells: Cells, hits: Ints) -> dict[int, FieldOfView]:
    """Returns by topic the field of view that its detections show."""
    hits = hits[hits[:, Hit.LOOK] >= 0]
    spots = sights.spots[hits[:, Hit.SPOT]]
    looks = hits[:, Hit.LOOK]
    dx = spots[:, Spot.X] - cells.x[looks]
    dy = spots[:, Spot.Y] - cells.y[looks]
    away = np.hypot(dx, dy)
    bearing = (np.degrees(np.arctan2(dy, dx)) - cells.yaw[looks] + 180.0) % 360.0 - 180.0
    found = {}
    for topic in np.unique(spots[:, Spot.TOPIC]).tolist():
        of = spots[:, Spot.TOPIC] == topic
        found[topic] = field_of_view(away[of], bearing[of], hits[of, Hit.N])
    return found


def _find_stays(group: _Group, seen: _Seen, go_on: Callable[[], None]) -> None:
    """Finds the places of a label, and when it was there."""
    every, counts = seen.sights.spots, seen.counts
    spots = every[group.rows]
    place, where = places_of(spots[:, Spot.X], spots[:, Spot.Y], counts[group.rows])
    for nth, (x, y) in enumerate(where.tolist()):
        go_on()
        mine = group.rows[place == nth]
        if not len(mine) or counts[mine].sum() < _FEWEST:
            continue
        rows = seen.hits_of(mine)
        rows[:, Hit.SPOT] = every[rows[:, Hit.SPOT], Spot.BAG]
        evidence = evidence_at(seen.cells, seen.view, x, y, rows)
        group.evidence[nth] = evidence
        bag = every[mine, Spot.BAG]
        for stay in stays_at(seen.cells, evidence):
            inside = mine[(bag >= stay.first_bag) & (bag <= stay.last_bag)]
            group.stays.append(_placed(seen, nth, stay, inside))


def _placed(seen: _Seen, place: int, stay: Stay, rows: Ints) -> PlacedStay:
    sights, cells = seen.sights, seen.cells
    spots, n = sights.spots[rows], seen.counts[rows]
    total = int(n.sum())
    x, y, z = (float((spots[:, each] * n).sum() / total) for each in (Spot.X, Spot.Y, Spot.Z))
    squares = spots[:, Spot.DEV] ** 2 + (spots[:, Spot.X] - x) ** 2 + (spots[:, Spot.Y] - y) ** 2
    spellings: dict[str, int] = {}
    for label, count in zip(spots[:, Spot.LABEL].tolist(), n.tolist(), strict=True):
        name = sights.labels[label]
        spellings[name] = spellings.get(name, 0) + count
    left = None
    if stay.left is not None:
        of = cells.bag == stay.left
        left = int(cells.last[of].min()) if of.any() else None
    firm = np.ones(len(rows), bool)
    if stay.firm_first >= 0:
        bag = spots[:, Spot.BAG]
        firm = (bag >= stay.firm_first) & (bag <= stay.firm_last)
        firm = firm if firm.any() else np.ones(len(rows), bool)
    return PlacedStay(
        x=x,
        y=y,
        z=z,
        dev_mm=float(np.sqrt((squares * n).sum() / total)),
        first=int(spots[:, Spot.FIRST].min()),
        last=int(spots[:, Spot.LAST].max()),
        firm_first=int(spots[firm, Spot.FIRST].min()),
        firm_last=int(spots[firm, Spot.LAST].max()),
        left=left,
        count=total,
        spots=rows,
        spellings=spellings,
        place=place,
        stay=stay,
        weak=stay.hits < max(_FEWEST, _LOWEST_RATE * stay.messages),
    )


def _fold(
    groups: list[_Group], seen: _Seen, keys: Sequence[str], go_on: Callable[[], None]
) -> None:
    """Removes stays that are other things under a wrong name, or the noise around one."""
    every = [(group, stay) for group in groups for stay in group.stays]
    hosts = _Hosts(every, seen, keys)
    gone: set[int] = set()
    for nth in sorted(range(len(every)), key=lambda each: every[each][1].count):
        go_on()
        group, stay = every[nth]
        best, most = None, 0
        for other, hosted in hosts.of(nth, gone):
            host_group, host = every[other]
            share = _HALO_SHARE if host_group is group else _SMALL_SHARE
            few = stay.count <= hosted and stay.count <= _TINY_SHARE * host.count
            if (few or stay.count <= hosted * share) and hosted > most:
                best, most = other, hosted
        if best is not None:
            gone.add(nth)
            host_group, host = every[best]
            if host_group is not group:
                for name, count in stay.spellings.items():
                    host.also[name] = host.also.get(name, 0) + count
    for group in groups:
        kept = {id(stay) for nth, (_, stay) in enumerate(every) if nth not in gone}
        group.stays = [each for each in group.stays if id(each) in kept and not each.weak]


class _Hosts:
    """Finds the stays that one may be a wrong name of, or the noise around."""

    def __init__(
        self, every: Sequence[tuple[_Group, PlacedStay]], seen: _Seen, keys: Sequence[str]
    ) -> None:
        self._every = every
        self._near = _NearStays([stay for _, stay in every])
        self._often = [_SeenDuring(seen, stay) for _, stay in every]
        self._beside = _BesideCounts(seen.sights, keys)

    def of(self, nth: int, gone: Container[int]) -> Iterator[tuple[int, int]]:
        """Yields their numbers, in order, and how often each was seen in the bags of the stay."""
        group, stay = self._every[nth]
        beside: dict[str, int] | None = None
        for other, away in self._near.of(stay):
            host_group, host = self._every[other]
            if other == nth or other in gone or host.weak or host_group.epoch != group.epoch:
                continue
            if host_group is not group:
                if away > _SAME_PLACE_MM:
                    continue
                beside = self._beside.of(stay) if beside is None else beside
                if beside.get(host_group.key, 0) >= _BESIDE_SHARE * stay.count:
                    continue
            yield other, self._often[other].during(stay.stay)


class _NearStays:
    """Finds stays near others, in squares as wide as what is near."""

    def __init__(self, stays: Sequence[PlacedStay]) -> None:
        self._x = np.array([stay.x for stay in stays])
        self._y = np.array([stay.y for stay in stays])
        self._first = np.array([stay.first for stay in stays])
        self._last = np.array([stay.last for stay in stays])
        squares: dict[tuple[int, int], list[int]] = {}
        for nth, stay in enumerate(stays):
            squares.setdefault(self._square(stay), []).append(nth)
        self._squares = {square: np.array(inside) for square, inside in squares.items()}

    def _square(self, stay: PlacedStay) -> tuple[int, int]:
        return math.floor(stay.x / _HALO_MM), math.floor(stay.y / _HALO_MM)

    def of(self, stay: PlacedStay) -> Iterator[tuple[int, float]]:
        """Yields which stays are near one while it lasts, in order, and how far (mm)."""
        column, row = self._square(stay)
        around = [(column + dx, row + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        parts = [self._squares[each] for each in around if each in self._squares]
        some = np.sort(np.concatenate(parts))
        some = some[(self._first[some] <= stay.last) & (self._last[some] >= stay.first)]
        away = np.hypot(self._x[some] - stay.x, self._y[some] - stay.y)
        near = away <= _HALO_MM
        yield from zip(some[near].tolist(), away[near].tolist(), strict=True)


class _BesideCounts:
    """How often a stay's detections had other labels beside them in the same message."""

    def __init__(self, sights: Sights, keys: Sequence[str]) -> None:
        table = sights.beside
        self._rows = table[np.argsort(table[:, Beside.SPOT], kind="stable")]
        self._starts = np.searchsorted(self._rows[:, Beside.SPOT], np.arange(len(sights.spots) + 1))
        self._keys = keys

    def of(self, stay: PlacedStay) -> dict[str, int]:
        """Returns how often, by the key of the label."""
        starts = self._starts[stay.spots]
        rows = self._rows[in_ranges(starts, self._starts[stay.spots + 1] - starts)]
        counts: dict[str, int] = {}
        for _, label, n in rows.tolist():
            key = self._keys[label]
            counts[key] = counts.get(key, 0) + n
        return counts


class _SeenDuring:
    """How often a stay was seen in some bags."""

    def __init__(self, seen: _Seen, stay: PlacedStay) -> None:
        bags = seen.sights.spots[stay.spots, Spot.BAG]
        order = np.argsort(bags, kind="stable")
        self._bags: list[int] = bags[order].tolist()
        self._counts: list[int] = [0, *np.cumsum(seen.counts[stay.spots][order]).tolist()]

    def during(self, stay: Stay) -> int:
        """Returns how often in the bags of another one."""
        begin = bisect_left(self._bags, stay.first_bag)
        end = bisect_right(self._bags, stay.last_bag)
        return self._counts[end] - self._counts[begin]


def _link(group: _Group, seen: _Seen, go_on: Callable[[], None]) -> list[Instance]:
    """Links stays into as few things as explain them.

    A stay goes on where one had ended, that is, where its place was seen without it. Of a label
    that is known to be moved, a place that was not looked at may have been left, too.
    """
    instances = _chained(group, group.stays, proven=True)
    if any(_is_moved(each) for each in instances):
        unproven = _chained(group, group.stays, proven=False)
        split = _chained(group, _split(group.stays, seen, go_on), proven=False)
        instances = min(instances, unproven, split, key=len)
    for each in instances:
        each.stays = _without_overlap(each.stays, seen)
    return instances


def _chained(group: _Group, stays: Sequence[PlacedStay], *, proven: bool) -> list[Instance]:
    instances: list[Instance] = []
    for stay in sorted(stays, key=lambda each: each.firm_first):
        candidates = [
            each
            for each in instances
            if (each.stays[-1].left is not None or not proven)
            and each.stays[-1].firm_last <= stay.firm_first
        ]
        best = max(
            candidates,
            key=lambda each: (
                each.stays[-1].place == stay.place,
                each.stays[-1].left is not None,
                each.stays[-1].last,
            ),
            default=None,
        )
        if best is None:
            instances.append(Instance(group.key, group.epoch, [stay]))
        else:
            best.stays.append(stay)
    return instances


def _is_moved(instance: Instance) -> bool:
    return len({each.place for each in instance.stays}) > 1


def _split(stays: Sequence[PlacedStay], seen: _Seen, go_on: Callable[[], None]) -> list[PlacedStay]:
    """Splits stays that have another one of the same label between two sightings."""
    found = []
    for stay in stays:
        go_on()
        others = [
            (each.firm_first, each.firm_last)
            for each in stays
            if each.place != stay.place
            and stay.firm_first < each.firm_first
            and each.firm_last < stay.firm_last
        ]
        found += _split_at(stay, others, seen)
    return found


def _split_at(stay: PlacedStay, others: Sequence[tuple[Ns, Ns]], seen: _Seen) -> list[PlacedStay]:
    spots = seen.sights.spots
    order = stay.spots[np.argsort(spots[stay.spots, Spot.FIRST], kind="stable")]
    first, last = spots[order, Spot.FIRST], spots[order, Spot.LAST]
    cuts = set()
    for start, stop in others:
        before, after = last < start, first > stop
        # Nothing of the stay was seen during the other one.
        if (before | after).all() and before.any() and after.any():
            cuts.add(int(after.argmax()))
    if not cuts:
        return [stay]
    return [
        _placed(seen, stay.place, stay.stay._replace(firm_first=-1, firm_last=-1), part)
        for part in np.split(order, sorted(cuts))
    ]


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


def most_at_once(spots: Ints) -> int:
    """Returns how many of a label were seen at once; one message in a hundred may have a false one.

    `spots` are its rows of `Sights.spots`, at least one.
    """
    together = np.sort(spots[:, Spot.TOGETHER])
    return max(1, int(together[-max(1, len(together) // 100)]))


def _is_named_mover(key: str) -> bool:
    return key.rpartition(" ")[2] in _MOVES_BY_ITSELF


def _moves_by_itself(group: _Group, linked: Sequence[Instance]) -> bool:
    if _is_named_mover(group.key):
        return True
    moves = len(group.stays) - len(linked)
    bags = len(group.rows)
    return moves >= _RESTLESS_MOVES and moves > _RESTLESS_SHARE * bags


def _is_seen(group: _Group, seen: _Seen) -> bool:
    """Whether a mover has more detections than false ones would give."""
    n = seen.counts[group.rows]
    return int(n[n >= _FEWEST].sum()) >= _FEWEST_OF_MOVERS


def _names(sights: Sights, labels: Labels) -> dict[str, str]:
    counts: dict[str, dict[str, int]] = {}
    spots = sights.spots
    of_label = np.bincount(spots[:, Spot.LABEL], spots[:, Spot.N], len(sights.labels))
    for name, n in zip(sights.labels, of_label.tolist(), strict=True):
        if n:
            counts.setdefault(labels.key(name), {})[name] = int(n)
    return {key: labels.name(key, each) for key, each in counts.items()}

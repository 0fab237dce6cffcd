"""What became of things from one window to a later one.

A thing that was seen in both is compared by where it was seen last in each. One that was seen in
the later alone *appeared* only where its place was looked at in the earlier one, from where it is
seen, so often that missing it by chance is below 1 %. One that was seen in the earlier alone is
reported as not seen where expected by the same rule, and else as not looked at. One of each kind,
with one label, in odometry that began again between them may be one thing: it was seen in both, and
its places cannot be compared. What moves by itself has no place: it is compared by whether it was
seen, how many at once, and where last.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.sights import Spot
from ros2_memory.core.regions import Place, places_at
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.results import ComparedMover, ComparedThing, ComparedThings, MoverSeen, ThingStay
from ros2_memory.things.instances import Instance, Mover, PlacedStay, most_at_once
from ros2_memory.things.moves import LEAST_MM

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.places.where import Where
    from ros2_memory.things.known import KnownThings

_SAME_MOVER_M: Final = 1.0
"""What moves by itself, and was last seen so near to where it was before, is where it was."""


class _StayInWindow(NamedTuple):
    """A thing's last stay in a window, and that part of the stay; how many there were at once."""

    stay: PlacedStay
    part: ThingStay
    at_once: int

    def is_elsewhere(self, other: _StayInWindow) -> bool:
        """Whether a thing was moved between this and another: to and fro is no move."""
        away_m = math.dist(self.part.place[:2], other.part.place[:2])
        return self.stay.place != other.stay.place and away_m >= LEAST_MM / 1000


@dataclass(frozen=True, slots=True)
class ThingsBetween:
    """Compares the things of two windows. Slices (10 s) count whole, a shared one in the later.

    Attributes:
        earlier, later: the windows.
        where: what was there in either window counts; None for all.
        places: the named ones.
    """

    known: KnownThings
    earlier: TimeWindow
    later: TimeWindow
    where: Where | None
    places: Sequence[Place]

    def compared(self) -> ComparedThings:
        """Returns what differs, each list with those seen last first."""
        kinds: dict[str, list[tuple[Instance, ComparedThing]]] = defaultdict(list)
        for instance in self.known.estimate.instances:
            before = self._stay_in(instance, self.earlier, self.later.start)
            after = self._stay_in(instance, self.later)
            shared = self._stay_in(instance, self.earlier)
            if before is None and after and shared and shared.is_elsewhere(after):
                before = shared  # in slices of both windows, but elsewhere
            if not self._is_there(instance, before, after):
                continue
            kind, thing = self._difference(instance, before, after)
            kinds[kind].append((instance, thing))
        same = len(kinds.pop("same", ()))
        alone, both = _paired(kinds.pop("not_looked_at", ()))
        lists = {kind: [thing for _, thing in things] for kind, things in kinds.items()}
        lists |= {"not_looked_at": alone, "not_comparable": both}
        ordered = {kind: tuple(sorted(things, key=_newest_first)) for kind, things in lists.items()}
        movers = tuple(sorted(self._movers(), key=_newest_first))
        return ComparedThings(**ordered, same=same, movers=movers)

    def _is_there(
        self, instance: Instance, before: _StayInWindow | None, after: _StayInWindow | None
    ) -> bool:
        """Whether a thing was seen there in either window."""
        frame = self.known.frames[instance.epoch]
        places = [stay.part.place for stay in (before, after) if stay is not None]
        return any(self.where is None or self.where.contains(frame, x, y) for x, y, _ in places)

    def _difference(
        self, instance: Instance, before: _StayInWindow | None, after: _StayInWindow | None
    ) -> tuple[str, ComparedThing]:
        """Returns what became of a thing: kind and description."""
        thing = ComparedThing(
            label=instance.label,
            before=None if before is None else before.part,
            after=None if after is None else after.part,
        )
        estimate = self.known.estimate
        if before is None and after is not None:
            window = self.earlier.start, min(self.earlier.stop, self.later.start)
            _, crossed = estimate.missing(instance, after.stay, window)
            return "not_looked_at" if crossed is None else "appeared", thing
        if before is not None and after is None:
            looks, crossed = estimate.missing(instance, self._last_there(instance, before))
            if crossed is None or crossed >= self.later.stop:
                return "not_looked_at", thing
            return "not_seen_where_expected", replace(thing, missed=crossed, looks=looks)
        if before is None or after is None or before.is_elsewhere(after):
            return "moved", thing
        if before.at_once == after.at_once:
            return "same", thing
        numbers = (replace(stay.part, at_once=stay.at_once) for stay in (before, after))
        was, now = numbers
        return "more_or_fewer", replace(thing, before=was, after=now)

    def _last_there(self, instance: Instance, before: _StayInWindow) -> PlacedStay:
        """Returns a thing's last stay at its place of the earlier window, before the later one."""
        return [
            stay
            for stay in instance.stays
            if stay.place == before.stay.place and stay.first < self.later.start
        ][-1]

    def _stay_in(
        self, instance: Instance, window: TimeWindow, before: Ns = MAX_NS
    ) -> _StayInWindow | None:
        estimate, frame = self.known.estimate, self.known.frames[instance.epoch]
        for stay in reversed(instance.stays):
            rows = estimate.seen_in(stay.spots, window, before)
            if len(rows):
                place = estimate.place_of(stay, rows)
                part = self.known.stay(rows, place, frame, self.places)
                return _StayInWindow(stay, part, estimate.side_by_side(rows))
        return None

    def _movers(self) -> Iterator[ComparedMover]:
        """Yields what moves by itself and was not seen alike in both windows."""
        by_label: dict[str, tuple[list[MoverSeen], list[MoverSeen]]] = {}
        for mover in self.known.estimate.movers:
            label = self.known.estimate.names[mover.key]
            before = self._mover_in(mover, self.earlier, self.later.start)
            after = self._mover_in(mover, self.later)
            if before is not None and after is not None:
                away_m = math.dist(before.place[:2], after.place[:2])
                if before.at_once != after.at_once or away_m > _SAME_MOVER_M:
                    yield ComparedMover(label, before, after)
                continue
            befores, afters = by_label.setdefault(label, ([], []))
            befores += [before] if before is not None else []
            afters += [after] if after is not None else []
        for label, (befores, afters) in by_label.items():
            # In each run of odometry it is another mover: one of each window is one row.
            for before, after in zip_longest(befores, afters):
                yield ComparedMover(label, before, after)

    def _mover_in(self, mover: Mover, window: TimeWindow, before: Ns = MAX_NS) -> MoverSeen | None:
        estimate, frame = self.known.estimate, self.known.frames[mover.epoch]
        rows = self.known.seen_there(mover, window, self.where, before)
        if not len(rows):
            return None
        spots = estimate.sights.spots[rows]
        newest = spots[spots[:, Spot.LAST].argmax()]
        x, y, z, last = newest[[Spot.X, Spot.Y, Spot.Z, Spot.LAST]].tolist()
        place = x / 1000, y / 1000, z / 1000
        return MoverSeen(
            at_once=most_at_once(spots),
            count=int(estimate.counts[rows].sum()),
            place=place,
            inside=places_at(self.places, frame, *place[:2]),
            last=last,
        )


def _paired(
    things: Sequence[tuple[Instance, ComparedThing]],
) -> tuple[list[ComparedThing], list[ComparedThing]]:
    """Returns the things that were seen in one window alone, and those that were seen in both.

    A thing of the earlier window and one of the later with its label, in another odometry, are
    taken as one.
    """
    later: dict[str, list[tuple[int, ComparedThing]]] = {}
    for instance, thing in things:
        if thing.before is None:
            later.setdefault(instance.key, []).append((instance.epoch, thing))
    alone: list[ComparedThing] = []
    both: list[ComparedThing] = []
    for instance, thing in things:
        if thing.before is None:
            continue
        candidates = later.get(instance.key, [])
        for position, (epoch, candidate) in enumerate(candidates):
            if epoch != instance.epoch:
                del candidates[position]
                both.append(replace(thing, after=candidate.after))
                break
        else:
            alone.append(thing)
    return alone + [thing for rest in later.values() for _, thing in rest], both


def _newest_first(thing: ComparedThing | ComparedMover) -> tuple[int, str]:
    seen = thing.after or thing.before
    if seen is None:
        return 0, thing.label
    return -(seen.end if isinstance(seen, ThingStay) else seen.last), thing.label

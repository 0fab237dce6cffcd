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
from dataclasses import replace
from itertools import zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import Spot
from ros2_memory.core.regions import places_at
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.results import ComparedMover, ComparedThing, ComparedThings, MoverSeen, ThingStay
from ros2_memory.things.instances import most_at_once
from ros2_memory.things.presence import missed_in

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.sights import Ints
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.regions import Place
    from ros2_memory.core.timebase import Ns
    from ros2_memory.places.where import Where
    from ros2_memory.things.instances import Instance, Mover, PlacedStay
    from ros2_memory.things.known import KnownThings

_MM: Final = 1000.0
_SAME_MOVER_M: Final = 1.0
"""What moves by itself, and was last seen so near to where it was before, is where it was."""


class _Seen(NamedTuple):
    """The last stay of a thing that was seen in a window, and its spots there."""

    stay: PlacedStay
    spots: Ints


class ThingsBetween:
    """Compares the things of two windows. Bags count as a whole, a shared one in the later."""

    def __init__(
        self,
        known: KnownThings,
        windows: tuple[TimeWindow, TimeWindow],
        where: Where | None,
        places: Sequence[Place],
    ) -> None:
        self._known = known
        self._earlier, self._later = windows
        self._where = where
        self._places = places

    def compared(self) -> ComparedThings:
        """Returns what differs, each list with those seen last first."""
        lists: dict[str, list[ComparedThing]] = {}
        unknown: list[tuple[Instance, ComparedThing]] = []
        same = 0
        for instance in self._known.estimate.instances:
            found = self._compared(instance)
            if found is None:
                continue
            kind, thing = found
            if thing is None:
                same += 1
            elif kind == "unknown":
                unknown.append((instance, thing))
            else:
                lists.setdefault(kind, []).append(thing)
        lists["unknown"], lists["both"] = _in_both(unknown)
        for each in lists.values():
            each.sort(key=_by_time)
        return ComparedThings(
            moved=tuple(lists.get("moved", ())),
            appeared=tuple(lists.get("appeared", ())),
            missed=tuple(lists.get("missed", ())),
            not_looked_at=tuple(lists.get("unknown", ())),
            same=same,
            movers=tuple(sorted(self._movers(), key=_mover_order)),
            not_comparable=tuple(lists["both"]),
        )

    def _movers(self) -> Iterator[ComparedMover]:
        """Yields what moves by itself and was not seen alike in both windows."""
        alone: dict[str, list[ComparedMover]] = {}
        for mover in self._known.estimate.movers:
            before = self._mover_in(mover, self._earlier, self._later.start)
            after = self._mover_in(mover, self._later)
            if before is None and after is None:
                continue
            if before is not None and after is not None:
                away = math.dist(before.place[:2], after.place[:2])
                if before.at_once == after.at_once and away <= _SAME_MOVER_M:
                    continue
            found = ComparedMover(self._known.estimate.names[mover.key], before, after)
            if before is None or after is None:
                alone.setdefault(found.label, []).append(found)
            else:
                yield found
        for label, some in alone.items():
            # In each run of odometry it is another mover: one of each window is one row.
            before_ = [each.before for each in some if each.before is not None]
            after_ = [each.after for each in some if each.after is not None]
            for was, seen in zip_longest(before_, after_):
                yield ComparedMover(label, was, seen)

    def _mover_in(self, mover: Mover, window: TimeWindow, before: Ns = MAX_NS) -> MoverSeen | None:
        estimate, frame = self._known.estimate, self._known.frames[mover.epoch]
        rows = self._inside(mover.spots, window, before)
        spots = estimate.sights.spots
        rows = rows[[self._is_in(frame, x, y) for x, y in _places(spots[rows])]]
        if not len(rows):
            return None
        seen = spots[rows]
        x, y, z, last = seen[
            int(seen[:, Spot.LAST].argmax()), [Spot.X, Spot.Y, Spot.Z, Spot.LAST]
        ].tolist()
        return MoverSeen(
            at_once=most_at_once(seen),
            count=int(estimate.counts[rows].sum()),
            place=(x / _MM, y / _MM, z / _MM),
            inside=places_at(self._places, frame, x / _MM, y / _MM),
            last=last,
        )

    def _compared(self, instance: Instance) -> tuple[str, ComparedThing | None] | None:
        """Returns what became of a thing: kind and description; None for what does not matter.

        Without a description it is where it was.
        """
        before = self._seen(instance, self._earlier, self._later.start)
        after = self._seen(instance, self._later)
        if before is None:
            return None if after is None else self._fresh(instance, after)
        if not any(each and self._is_there(instance, each) for each in (before, after)):
            return None
        if after is not None:
            if before.stay.place == after.stay.place:
                return "same", None
            return "moved", self._thing(instance, before, after)
        last = self._last_to(instance, self._later)
        _, looks, crossed = self._known.estimate.missing(instance, last.stay)
        if crossed is not None and crossed < self._later.stop:
            return "missed", self._thing(instance, last, None, missed=crossed, looks=looks)
        return "unknown", self._thing(instance, last, None)

    def _fresh(self, instance: Instance, after: _Seen) -> tuple[str, ComparedThing | None] | None:
        """Returns the state of a thing that was seen only in the later window."""
        stays = [each for each in instance.stays if each.first < self._earlier.stop]
        if not self._is_there(instance, after) or after.stay.place in {e.place for e in stays}:
            return None
        estimate = self._known.estimate
        evidence = estimate.evidence[instance.key, instance.epoch][after.stay.place]
        end = min(self._earlier.stop, self._later.start)
        looked = missed_in(estimate.cells, evidence, after.stay.stay, (self._earlier.start, end))
        if not looked:
            return "unknown", self._thing(instance, None, after)
        if not stays:
            return "appeared", self._thing(instance, None, after)
        return "moved", self._thing(instance, self._last_to(instance, self._earlier), after)

    def _seen(self, instance: Instance, window: TimeWindow, before: Ns = MAX_NS) -> _Seen | None:
        for stay in reversed(instance.stays):
            rows = self._inside(stay.spots, window, before)
            if len(rows):
                return _Seen(stay, rows)
        return None

    def _inside(self, rows: Ints, window: TimeWindow, before: Ns) -> Ints:
        """Returns the spots that count, of bags that reach into a window and end before a time."""
        spots = self._known.estimate.sights.spots
        first, last = spots[rows, Spot.FIRST], spots[rows, Spot.LAST]
        inside = (first < window.stop) & (last >= window.start) & (last < before)
        return np.asarray(rows[inside & (self._known.estimate.counts[rows] > 0)])

    def _last_to(self, instance: Instance, window: TimeWindow) -> _Seen:
        """Returns where a thing was last seen before a window's end, as it was known then."""
        stay = [each for each in instance.stays if each.first < window.stop][-1]
        spots = self._known.estimate.sights.spots
        return _Seen(stay, stay.spots[spots[stay.spots, Spot.FIRST] < window.stop])

    def _is_there(self, instance: Instance, seen: _Seen) -> bool:
        return self._is_in(self._known.frames[instance.epoch], seen.stay.x, seen.stay.y)

    def _is_in(self, frame: str, x_mm: float, y_mm: float) -> bool:
        where = self._where
        if where is None:
            return True
        if where.frame_id not in {None, frame}:
            return False
        return where.region.contains(x_mm / _MM, y_mm / _MM)

    def _thing(
        self,
        instance: Instance,
        before: _Seen | None,
        after: _Seen | None,
        *,
        missed: Ns | None = None,
        looks: int = 0,
    ) -> ComparedThing:
        return ComparedThing(
            label=self._known.estimate.names[instance.key],
            before=None if before is None else self._stay(instance, before),
            after=None if after is None else self._stay(instance, after),
            missed=missed,
            looks=looks,
        )

    def _stay(self, instance: Instance, seen: _Seen) -> ThingStay:
        stay, estimate = seen.stay, self._known.estimate
        spots = estimate.sights.spots[seen.spots]
        frame = self._known.frames[instance.epoch]
        return ThingStay(
            start=int(spots[:, Spot.FIRST].min()),
            end=int(spots[:, Spot.LAST].max()),
            place=(stay.x / _MM, stay.y / _MM, stay.z / _MM),
            count=int(np.sum(estimate.counts[seen.spots])),
            inside=places_at(self._places, frame, stay.x / _MM, stay.y / _MM),
        )


def _in_both(
    unknown: Sequence[tuple[Instance, ComparedThing]],
) -> tuple[list[ComparedThing], list[ComparedThing]]:
    """Returns the things that were seen in one window alone, and those that were seen in both.

    A thing of the earlier window and one of the later with its label, in another odometry, are
    taken as one.
    """
    waiting: dict[str, list[tuple[Instance, ComparedThing]]] = {}
    for instance, thing in unknown:
        if thing.before is None:
            waiting.setdefault(instance.key, []).append((instance, thing))
    alone: list[ComparedThing] = []
    both: list[ComparedThing] = []
    for instance, thing in unknown:
        if thing.before is None:
            continue
        others = waiting.get(instance.key, [])
        match = next((each for each in others if each[0].epoch != instance.epoch), None)
        if match is None:
            alone.append(thing)
        else:
            others.remove(match)
            both.append(replace(thing, after=match[1].after))
    return alone + [thing for some in waiting.values() for _, thing in some], both


def _by_time(thing: ComparedThing) -> tuple[int, str]:
    stay = thing.after or thing.before
    return (0 if stay is None else -stay.end, thing.label)


def _places(spots: Ints) -> list[list[int]]:
    found: list[list[int]] = spots[:, [Spot.X, Spot.Y]].tolist()
    return found


def _mover_order(mover: ComparedMover) -> tuple[int, str]:
    seen = mover.after or mover.before
    return (0 if seen is None else -seen.last, mover.label)

"""Answers which things there are, where, since when, and where they were before."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import SCORE_BINS, Spot, bin_of
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, places_at
from ros2_memory.core.text import abbreviate
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns
from ros2_memory.history.coverage import describe_misdated, note_unread
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.view import TimeRange, clamped, open_search
from ros2_memory.places.where import Where, parse_where, places_asked
from ros2_memory.results import StillThere, Thing, Things, UsualPlace
from ros2_memory.things.instances import (
    Instance,
    Mover,
    PlacedStay,
    most_at_once,
    named,
    spellings,
)
from ros2_memory.things.known import KnownThings, known_things, note_other_frames
from ros2_memory.things.routine import usual_places
from ros2_memory.things.unseen import Asked, describe_hung, note_undecoded, notes_on

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.history.context import Call, Memory, QuerySettings

LIMIT: Final = 12
_MOST_NAMES: Final = 5
_NEAR_M: Final = 1.0
_JUST_NOW_NS: Final = 2 * NS_PER_S
"""Detectors publish at their own times."""
_MM: Final = 1000.0


def find_things(
    memory: Memory,
    call: Call,
    labels: Sequence[str] = (),
    *,
    where: JsonValue = None,
    near: JsonValue = None,
    start_s: float | None = None,
    end_s: float | None = None,
    min_score: float | None = None,
    limit: int = LIMIT,
) -> Things:
    """Returns the things of some labels, or all, that were seen in a window, those seen last first.

    A thing counts where it was at the window's end. `where` takes those that are in a region then;
    of what moves by itself, what was seen in it. Slices (10 s) count as a whole. `near` takes those
    near a point, or near another thing of a label.

    Raises:
        InvalidArgumentsError: the bounds make no window, `where` or `near` is no region, or
            `min_score` is above 1.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    limits = memory.limits
    region = None if where is None else parse_where(limits, where)
    beside = None if near is None else parse_near(limits, near)
    span = TimeRange(start_s, end_s)
    view, now, whole = open_search(memory, call, span)
    asked_for = whole
    if end_s is None and whole.asked()[0] < (ahead := view.snapshot.dating.ahead_from):
        asked_for = TimeWindow(whole.start, ahead)
    require_recorded(view, asked_for)
    window = clamped(view, asked_for)
    lowest = limits.min_score if min_score is None else min_score
    if lowest > 1:
        raise InvalidArgumentsError(
            f"min_score was {lowest:g}; scores of things are counted from 0 to 1"
        )
    note_robots_on(view, [view.pose_topic] if view.has_poses else view.moving_topics, window)
    undecoded = note_undecoded(view, window)
    view.notes.add(*describe_hung(view, window))
    known = known_things(view, lowest, window)
    view.notes.retract_outside(whole)
    note_other_frames(view, known, region)
    asked = {known.labels.key(label): label for label in labels}
    places = places_asked(limits, region, known.frames)
    looked = known.estimate.looks.last
    latest_look = int(looked[looked < window.stop].max(initial=0))
    finder = _Finder(known, window, region, places, now, latest_look)
    found = sorted(finder.find(asked), key=lambda row: (-row.last, row.label, row.place))
    if beside is not None:
        anywhere = replace(finder, where=None)
        key = known.labels.key(beside.label)
        others = [*anywhere.find({key})] if beside.label else []
        found = [*beside.those_near(found, others)]
        view.notes.add(*beside.lack(found, others))
        asked |= {key: beside.label} if beside.label and not others else {}
    note_unread(view, whole, nothing=not found, gaps=not found)
    if not found and asked_for != whole:
        view.notes.add(describe_misdated(view.snapshot.misdated))
    shown = tuple(map(finder.described, found[:limit]))
    totals: Counter[str] = Counter()
    for thing in found:
        totals[thing.label] += thing.at_once or 1
    bounds = ["window"] * (start_s is not None or end_s is not None)
    bounds += ["region"] * (region is not None or beside is not None)
    question = Asked(
        labels=asked,
        found=frozenset(key for row in found for key in row.keys),
        vague=frozenset(row.label for row in found if known.estimate.is_vague(row.rows)),
        window=window,
        inside=f" in this {' and '.join(bounds)}" if bounds else "",
        min_score=f"min_score {lowest:g}" + " (data.min_score)" * (min_score is None),
        undecoded=undecoded,
    )
    return Things(
        frame_id=_frame_of(known, shown),
        things=shown,
        total=totals.total(),
        labels=tuple(sorted(totals.items())),
        now=now,
        all_counted=known.reaches_back(window),
        notes=(*view.notes.sentences(), *notes_on(view, known.by_all, question)),
    )


def _frame_of(known: KnownThings, shown: Sequence[Thing]) -> str:
    if shown:
        return shown[0].frame_id
    # Without a map, the frame of the newest odometry; nothing where no detector published.
    return known.frames[0] if known.has_map else "".join(known.frames[1:][-1:])


class _FoundThing(NamedTuple):
    """A thing of a question, which is described where it is shown: there may be thousands.

    Attributes:
        label: to show; `keys` are those of all its names.
        last: when it was seen last in the window.
        place: where it was then (m, in the frame of its epoch).
        at_once: how many are there; None where one is.
        rows: its spots in the window; `newest` are those of its place.
        also_at: of people and pets, the places (m) of the others in the newest slice.
        near_m: how far it is from what it was to be near.
    """

    thing: Instance | Mover
    label: str
    keys: Collection[str]
    last: Ns
    place: Vector3
    at_once: int | None
    rows: Ints
    newest: Ints
    also_at: tuple[Vector3, ...] = ()
    near_m: float | None = None


class Near(NamedTuple):
    """What things are to be near: the middle of a circle or, of a label, other things.

    Of a label only the circle's radius counts.
    """

    circle: Circle
    label: str

    def those_near(
        self, found: Iterable[_FoundThing], others: Sequence[_FoundThing]
    ) -> Iterator[_FoundThing]:
        """Yields those near the circle's middle, or one of the others, each with its distance."""
        for thing in found:
            points = [(self.circle.x, self.circle.y)]
            if self.label:
                points = [
                    place[:2]
                    for other in others
                    if other.thing is not thing.thing and other.thing.epoch == thing.thing.epoch
                    for place in (other.place, *other.also_at)
                ]
            near = [
                (away_m, place)
                for place in (thing.place, *thing.also_at)
                for away_m in [min((math.dist(place[:2], at) for at in points), default=math.inf)]
                if away_m <= self.circle.radius_m
            ]
            if near:
                near_m, place = min(near)
                at_once = min(thing.at_once or 1, len(near)) if thing.also_at else thing.at_once
                yield thing._replace(near_m=near_m, place=place, at_once=at_once)

    def lack(self, found: Sequence[_FoundThing], others: Sequence[_FoundThing]) -> Iterator[str]:
        """Yields why nothing was found near it."""
        if self.label and not others:
            yield f"near: there is no thing {abbreviate(self.label)} in this window"
        elif not found:
            within = f"within {self.circle.radius_m:g} m"
            yield f"near: nothing is {within} of it; for more give a larger radius_m"


def parse_near(limits: QuerySettings, value: JsonValue) -> Near:
    """Returns what a value of the argument `near` means: a label, or a point with a radius.

    Raises:
        InvalidArgumentsError: it is neither.
    """
    at: JsonValue = {"label": value} if isinstance(value, str) else value
    label: JsonValue = ""
    if isinstance(at, dict) and at.keys() <= {"label", "radius_m"}:
        label = at.get("label") or None
        at = {"x": 0, "y": 0, "radius_m": at.get("radius_m", _NEAR_M)}
    with suppress(InvalidArgumentsError):
        region = parse_where(limits, at, _NEAR_M).region
        if isinstance(region, Circle) and isinstance(label, str):
            return Near(region, label)
    raise InvalidArgumentsError(
        f'near was {abbreviate(value)}; give {{"label": "table", "radius_m": 1.0}}, or '
        '{"x": 1.0, "y": 2.0, "radius_m": 0.5} (m)'
    )


@dataclass(frozen=True, slots=True)
class _Finder:
    """Selects the things of a question, and describes them.

    Attributes:
        where: the region they are to be in; None for all.
        places: the named ones.
        now: the time of the call (ns).
        latest_look: when the last of the looks that end before the window does ended (ns).
    """

    known: KnownThings
    window: TimeWindow
    where: Where | None
    places: tuple[Place, ...]
    now: Ns
    latest_look: Ns

    def find(self, keys: Collection[str]) -> Iterator[_FoundThing]:
        """Yields the things of these keys, or all where there are none."""
        estimate, labels = self.known.estimate, self.known.labels
        things: list[Instance | Mover] = [*estimate.instances, *estimate.movers]
        for thing in things:
            names = thing.labels if isinstance(thing, Instance) else self._labels(thing.spots)
            own_keys = {labels.key(name) for name in names}
            if keys and own_keys.isdisjoint(keys):
                continue
            if isinstance(thing, Instance):
                yield from self._found_instance(thing, own_keys)
            else:
                yield from self._found_mover(thing, own_keys)

    def _parts(self, instance: Instance) -> list[tuple[PlacedStay, Ints]]:
        """Returns the stays of a thing in the window, each with its spots."""
        return [
            (stay, rows)
            for stay in instance.stays
            if len(rows := self.known.estimate.seen_in(stay.spots, self.window))
        ]

    def _found_instance(self, instance: Instance, keys: Collection[str]) -> Iterator[_FoundThing]:
        """Yields a thing if it was seen in the window, and was inside the region at its end."""
        estimate, parts = self.known.estimate, self._parts(instance)
        if not parts:
            return
        stay, newest = parts[-1]
        frame = self.known.frames[instance.epoch]
        if self.where is not None and not self.where.contains(frame, *stay.at[:2]):
            return
        rows = np.concatenate([rows for _, rows in parts])
        number = estimate.side_by_side(newest)
        at_once = number if number > 1 else None
        last = int(estimate.spots[rows, Spot.LAST].max())
        yield _FoundThing(instance, instance.label, keys, last, stay.at, at_once, rows, newest)

    def _found_mover(self, mover: Mover, keys: Collection[str]) -> Iterator[_FoundThing]:
        """Yields a mover: where it was last seen, inside the region if one is given."""
        estimate = self.known.estimate
        rows = self.known.seen_there(mover, self.window, self.where)
        if not len(rows):
            return
        spots = estimate.spots[rows]
        newest = int(spots[:, Spot.LAST].argmax())
        places = [(x, y, z) for x, y, z in (spots[:, [Spot.X, Spot.Y, Spot.Z]] / _MM).tolist()]
        in_slice = np.flatnonzero(spots[:, Spot.SLICE] == spots[newest, Spot.SLICE]).tolist()
        yield _FoundThing(
            mover,
            estimate.names[mover.key],
            keys,
            int(spots[newest, Spot.LAST]),
            places[newest],
            most_at_once(spots),
            rows,
            rows[[newest]],
            also_at=tuple(places[number] for number in in_slice if number != newest),
        )

    def described(self, found: _FoundThing) -> Thing:
        """Returns a thing as it is shown."""
        estimate, thing, rows = self.known.estimate, found.thing, found.rows
        frame, spots = self.known.frames[thing.epoch], estimate.spots[rows]
        best, median = self._scores(rows)
        shown = Thing(
            label=found.label,
            also_seen_as=(),
            place=found.place,
            spread_m=int(estimate.spots[found.newest[0], Spot.DEV]) / _MM,
            frame_id=frame,
            inside=places_at(self.places, frame, *found.place[:2]),
            first=int(spots[:, Spot.FIRST].min()),
            last=found.last,
            count=int(estimate.counts[rows].sum()),
            best=best,
            median=median,
            robot=estimate.seen_from(found.newest),
            still_there=None,
            at_once=found.at_once,
            near_m=found.near_m,
        )
        if isinstance(thing, Mover):
            return replace(shown, moves=True, usually=self._usually(frame, rows))
        parts = self._parts(thing)
        last, newest = parts[-1]
        # The stays at one place in a row, as one.
        stays = [
            self.known.stay(
                np.concatenate([rows for _, rows in group]), group[-1][0].at, frame, self.places
            )
            for group in _by_place(parts)
        ]
        labels = self._labels(rows)
        rows_of_all = np.concatenate([stay.spots for stay in thing.stays])
        written = spellings(estimate, estimate.counts, rows_of_all)
        misread = Counter[str]()
        for stay in thing.stays:
            misread.update(stay.also)
        return replace(
            shown,
            labels=tuple(labels.items()) if len(labels) > 1 else (),
            also_seen_as=_commonest(written, thing.labels),
            misread_as=_commonest(misread, thing.labels),
            spread_m=last.dev_mm / _MM,
            still_there=self._still_there(thing, last, newest),
            moved=tuple(stays) if len(stays) > 1 else (),
            usually=self._usually(frame, rows) if len(stays) > 1 else None,
        )

    def _labels(self, rows: Ints) -> dict[str, int]:
        """Returns how often each label has these spots, the commonest first."""
        estimate = self.known.estimate
        written = spellings(estimate, estimate.counts, rows)
        return named(written, self.known.labels, estimate.names)

    def _usually(self, frame: str, rows: Ints) -> tuple[UsualPlace, ...] | None:
        """Returns where a thing usually is, by its spots."""
        spots = self.known.estimate.spots[rows]
        spots = spots[np.argsort(spots[:, Spot.LAST], kind="stable")]
        now = min(self.now, self.window.stop)
        usual = usual_places(spots[:, Spot.LAST], spots[:, [Spot.X, Spot.Y]], now)
        if usual is None:
            return None
        return tuple(
            replace(place, inside=places_at(self.places, frame, *place.place[:2]))
            for place in usual
        )

    def _scores(self, rows: Ints) -> tuple[float | None, float | None]:
        """Returns the best score of some spots, and their median to 0.05, the width of a bin.

        Of detections that count; None where none of them has a score. The median is the best score
        in its bin, where that is known: of spots with none in a higher one.
        """
        best = self.known.estimate.spots[rows, Spot.BEST]
        _, bins, n = self.known.estimate.scores.rows_of(rows)
        if not len(bins):
            return None, None
        counts = np.bincount(bins, n, SCORE_BINS)
        middle = int(np.searchsorted(np.cumsum(counts), counts.sum() / 2))
        in_bin = best[bin_of(best) == middle]
        median = int(in_bin.max()) if len(in_bin) else (middle + 0.5) * 1000 / SCORE_BINS
        return int(best.max()) / 1000, min(median, int(best.max())) / 1000

    def _still_there(self, instance: Instance, stay: PlacedStay, rows: Ints) -> StillThere | None:
        """Returns the state of a thing since it was last seen in the window, by all sightings."""
        spots = self.known.estimate.spots[rows]
        last, by_all = int(spots[:, Spot.LAST].max()), self.known.by_all
        if by_all is not self.known:
            newest_first = np.argsort(-spots[:, Spot.LAST], kind="stable")
            same = by_all.estimate.stay_with(spots[newest_first])
            if same is None:
                return None
            instance, stay = same
        if stay.last > last:
            return StillThere("seen_since", stay.last)
        if stay is instance.stays[-1]:
            looks, missed = instance.looks, instance.missed_by
        else:
            looks, missed = by_all.estimate.missing(instance, stay)
        if missed is not None:
            return StillThere("not_seen_where_expected", missed, looks)
        if last + _JUST_NOW_NS >= self.latest_look:
            return StillThere("in_view", last)
        # Of a later look nothing is known where the estimate ends.
        return StillThere("not_looked_at_since", last) if by_all.until == MAX_NS else None


def _commonest(names: Counter[str], without: Collection[str]) -> tuple[str, ...]:
    others = [name for name in names if name not in without]
    return tuple(sorted(others, key=lambda name: (-names[name], name))[:_MOST_NAMES])


def _by_place(
    parts: Sequence[tuple[PlacedStay, Ints]],
) -> list[list[tuple[PlacedStay, Ints]]]:
    """Returns the stays in groups of those that follow each other at one place.

    One after whose end the place was seen without the thing ends a group: it was taken away, and
    brought back.
    """
    groups: list[list[tuple[PlacedStay, Ints]]] = []
    last: PlacedStay | None = None
    for part in parts:
        if last is None or last.place != part[0].place or last.left is not None:
            groups.append([])
        groups[-1].append(part)
        last = part[0]
    return groups

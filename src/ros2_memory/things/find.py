"""Answers which things there are, where, since when, and where they were before."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import SCORE_BINS, Spot, apart_m, bin_of
from ros2_memory.core.arrays import stable_order
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, places_at
from ros2_memory.core.text import abbreviate
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns
from ros2_memory.history.coverage import describe_misdated, note_unread
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.view import ANY_TIME, TimeRange, clamped, open_search
from ros2_memory.places.pose_frames import origin_notes
from ros2_memory.places.where import Where, parse_where, places_asked
from ros2_memory.results import StillThere, Thing, Things, UsualPlace
from ros2_memory.things.instances import (
    Instance,
    Move,
    Mover,
    PlacedStay,
    count_labels,
    count_names,
    most_at_once,
)
from ros2_memory.things.known import KnownThings, known_things, note_other_frames
from ros2_memory.things.routine import usual_places
from ros2_memory.things.unseen import (
    ThingsQuestion,
    describe_hung,
    lone_notes,
    look_alike_notes,
    note_undecoded,
    notes_on,
    renamed_notes,
    scatter_notes,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.history.context import Call, Memory, QuerySettings
    from ros2_memory.history.view import View

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
    span: TimeRange = ANY_TIME,
    min_score: float | None = None,
    limit: int = LIMIT,
) -> Things:
    """Returns the things of some labels, or all, that were seen in a window, those seen last first.

    A thing counts where it was at the window's end. `where` selects the things inside a region
    then; people and pets count if they were seen in it. `near` selects the things near a point, or
    near another thing with a label. Slices (10 s) count as a whole.

    Raises:
        InvalidArgumentsError: the bounds make no window, `where` or `near` is no region, or
            `min_score` is above 1.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    limits = memory.limits
    region = None if where is None else parse_where(limits, where)
    nearness = None if near is None else parse_near(limits, near)
    lowest = limits.min_score if min_score is None else min_score
    view, now, asked_window = open_search(memory, call, span)
    searched = asked_window if span.end_s is not None else _rightly_dated(view, asked_window)
    require_recorded(view, searched)
    window = clamped(view, searched)
    if lowest > 1:
        raise InvalidArgumentsError(
            f"min_score was {lowest:g}; scores of things are counted from 0 to 1"
        )
    topics = [view.pose_topic] if view.has_poses else view.moving_topics
    note_robots_on(view, topics, window, places=True)
    undecoded = note_undecoded(view, window)
    view.notes.add(*describe_hung(view, window))
    known = known_things(view, lowest, window)
    if known.has_map:
        view.notes.add(*origin_notes(view, view.pose_topic, [window]))
    view.notes.retract_outside(asked_window)
    note_other_frames(view, known, region)
    finder = _Finder(known, window, region, places_asked(limits, region, known.frames), now)
    wanted = {known.labels.key(label): label for label in labels}
    found = sorted(finder.find(wanted), key=lambda thing: (-thing.last, thing.label, thing.place))
    if nearness is not None:
        landmarks = nearness.landmarks(finder)
        found = [*nearness.select(found, landmarks)]
        view.notes.add(*nearness.describe_lack(memory.limits, found, landmarks))
        if nearness.label and not landmarks:
            # What was sought near it may well be a thing: nothing was looked for.
            wanted = {known.labels.key(nearness.label): nearness.label}
    note_unread(view, asked_window, nothing=not found, gaps=not found)
    misdated = view.snapshot.misdated
    if not found and searched != asked_window and misdated:
        view.notes.add(describe_misdated(misdated))
    question = ThingsQuestion(
        labels=wanted,
        found=frozenset(key for thing in found for key in thing.keys),
        vague=frozenset(thing.label for thing in found if known.estimate.is_vague(thing.rows)),
        window=window,
        is_bounded=span != ANY_TIME,
        has_region=region is not None or nearness is not None,
        min_score=f"min_score {lowest:g}{' (data.min_score)' if min_score is None else ''}",
        undecoded=undecoded,
    )
    return _described(view, finder, question, found, limit)


def _described(
    view: View,
    finder: _Finder,
    question: ThingsQuestion,
    found: Sequence[_FoundThing],
    limit: int,
) -> Things:
    """Returns the answer to a question, with at most `limit` of the things that were found."""
    known, totals = finder.known, _totals(found)
    shown = tuple(map(finder.describe, found[:limit]))
    last_stays = _last_stays(found[:limit])
    view.notes.add(*look_alike_notes(known, finder.moves(found[:limit])))
    view.notes.add(*renamed_notes(known, (instance for instance, _ in last_stays)))
    view.notes.add(*lone_notes(known, _movers(found)))
    return Things(
        frame_id=_frame_of(known, shown),
        things=shown,
        total=totals.total(),
        labels=tuple(sorted(totals.items())),
        now=finder.now,
        all_counted=known.reaches_back(finder.window),
        notes=(
            *view.notes.sentences(),
            *notes_on(view, known.by_all, question),
            *scatter_notes(last_stays),
        ),
    )


def _movers(found: Iterable[_FoundThing]) -> list[tuple[Mover, Ints]]:
    """Returns people and the like, each with its spots in the window."""
    return [
        (found_thing.thing, found_thing.rows)
        for found_thing in found
        if isinstance(found_thing.thing, Mover)
    ]


def _last_stays(found: Iterable[_FoundThing]) -> list[tuple[Instance, PlacedStay]]:
    """Returns the things that stay somewhere, each with its last stay in the window."""
    return [
        (found_thing.thing, found_thing.stays[-1][-1].stay)
        for found_thing in found
        if isinstance(found_thing.thing, Instance)
    ]


def _totals(found: Iterable[_FoundThing]) -> Counter[str]:
    """Returns by label how many things there are; of a place with several, how many were seen."""
    totals: Counter[str] = Counter()
    for thing in found:
        totals[thing.label] += thing.at_once or 1
    return totals


def _rightly_dated(view: View, window: TimeWindow) -> TimeWindow:
    """Returns a window up to what a wrong clock dated, unless that is all that it has."""
    begin, _ = window.asked()
    ahead_from = view.snapshot.dating.ahead_from
    return TimeWindow(window.start, ahead_from) if begin < ahead_from else window


def _frame_of(known: KnownThings, shown: Sequence[Thing]) -> str:
    """Returns the frame of the first thing; without one, the frame that things would be in."""
    if shown:
        return shown[0].frame_id
    if known.has_map:
        return known.frames[0]
    # The newest odometry, if any detector published.
    odometry = known.frames[1:]
    return odometry[-1] if odometry else ""


class _StayInWindow(NamedTuple):
    """A stay of a thing, and the spots of it that were seen in the window."""

    stay: PlacedStay
    rows: Ints


class _FoundThing(NamedTuple):
    """A thing that a question selects. It is described only if it is shown.

    Attributes:
        label: the name to show; `keys` are the keys of all its names.
        last: when it was last seen in the window.
        place: where it was then (m, in the frame of its epoch).
        at_once: how many were seen there at once; None for one that stays somewhere.
        rows: its spots in the window; `newest` are its spots at `place`.
        stays: its stays in the window, in groups of consecutive stays at one place; none of people
            and pets.
        also_at: for people and pets, the places (m) of the others in the newest slice.
        near_m: its distance from the point or the thing that `near` names.
    """

    thing: Instance | Mover
    label: str
    keys: Collection[str]
    last: Ns
    place: Vector3
    at_once: int | None
    rows: Ints
    newest: Ints
    stays: Sequence[Sequence[_StayInWindow]] = ()
    also_at: tuple[Vector3, ...] = ()
    near_m: float | None = None

    @property
    def places(self) -> tuple[Vector3, ...]:
        """Every place (m) at its newest sighting."""
        return (self.place, *self.also_at)


class Near(NamedTuple):
    """The argument `near`: a circle or, with a label, the radius around each thing of that label.

    The things of the label are called landmarks.
    """

    circle: Circle
    label: str

    def landmarks(self, finder: _Finder) -> list[_FoundThing]:
        """Returns the things of the label anywhere in the window; none for a point."""
        if not self.label:
            return []
        key = finder.known.labels.key(self.label)
        return [*replace(finder, where=None).find({key})]

    def select(
        self, things: Iterable[_FoundThing], landmarks: Sequence[_FoundThing]
    ) -> Iterator[_FoundThing]:
        """Yields the things near the circle's middle, or near a landmark, with their distances."""
        for thing in things:
            near: list[tuple[float, Vector3]] = []
            for place in thing.places:
                points = self._points_for(thing, place, landmarks)
                away_m = min((apart_m(place, point) for point in points), default=math.inf)
                if away_m <= self.circle.radius_m:
                    near.append((away_m, place))
            if not near:
                continue
            near_m, place = min(near)
            at_once = thing.at_once
            if thing.also_at:
                at_once = min(at_once or 1, len(near))
            yield thing._replace(near_m=near_m, place=place, at_once=at_once)

    def _points_for(
        self, thing: _FoundThing, place: Vector3, landmarks: Sequence[_FoundThing]
    ) -> list[Vector3]:
        """Returns the points (m) that a thing at a place may be near; no thing is near itself."""
        if not self.label:
            return [(self.circle.x, self.circle.y, place[2])]
        return [
            point
            for landmark in landmarks
            if landmark.thing is not thing.thing and landmark.thing.epoch == thing.thing.epoch
            for point in landmark.places
        ]

    def describe_lack(
        self,
        limits: QuerySettings,
        found: Sequence[_FoundThing],
        landmarks: Sequence[_FoundThing],
    ) -> Iterator[str]:
        """Yields why nothing was found near the point or the landmarks."""
        if self.label and not landmarks:
            yield f"near: there is no thing {abbreviate(self.label)} in this window"
            with suppress(InvalidArgumentsError):
                parse_where(limits, self.label)
                yield f"{abbreviate(self.label)} is a place: ask with it as where"
        elif not found:
            within = f"within {self.circle.radius_m:g} m"
            yield f"near: nothing is {within} of it; for more give a larger radius_m"


def parse_near(limits: QuerySettings, value: JsonValue) -> Near:
    """Returns the argument `near` parsed: a label, or a point with a radius.

    Raises:
        InvalidArgumentsError: the value is neither.
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
        where: the region that the things must be in; None for anywhere.
        places: the named places.
        now: the time of the call (ns).
    """

    known: KnownThings
    window: TimeWindow
    where: Where | None
    places: tuple[Place, ...]
    now: Ns

    def find(self, keys: Collection[str]) -> Iterator[_FoundThing]:
        """Yields the things with one of the keys; without keys, all things."""
        estimate = self.known.estimate
        for instance in estimate.instances:
            own_keys = self._keys_of((*instance.labels, instance.id))
            if not keys or not own_keys.isdisjoint(keys):
                yield from self._locate_instance(instance, own_keys)
        for mover in estimate.movers:
            own_keys = self._keys_of(self._count_names(mover.spots))
            if not keys or not own_keys.isdisjoint(keys):
                yield from self._locate_mover(mover, own_keys)

    def _keys_of(self, names: Iterable[str]) -> set[str]:
        return {self.known.labels.key(name) for name in names}

    def _stays_in_window(self, instance: Instance) -> list[list[_StayInWindow]]:
        """Returns the stays that the window has seen, in groups at one place.

        A stay that was seen to end also ends its group: the thing was taken away and brought back.
        """
        groups: list[list[_StayInWindow]] = []
        last: PlacedStay | None = None
        for stay in instance.stays:
            rows = self.known.estimate.seen_in(stay.spots, self.window)
            if not len(rows):
                continue
            if last is None or last.place != stay.place or last.left is not None:
                groups.append([])
            groups[-1].append(_StayInWindow(stay, rows))
            last = stay
        return groups

    def _locate_instance(self, instance: Instance, keys: Collection[str]) -> Iterator[_FoundThing]:
        """Yields a thing if the window has seen it, and it was inside the region at the end."""
        estimate, stays = self.known.estimate, self._stays_in_window(instance)
        if not stays:
            return
        stay, newest = stays[-1][-1]
        frame = self.known.frames[instance.epoch]
        if self.where is not None and not self.where.contains(frame, stay.at):
            return
        rows = np.concatenate([part.rows for part in chain(*stays)])
        count = estimate.side_by_side(newest)
        yield _FoundThing(
            instance,
            instance.label,
            keys,
            last=int(estimate.spots[rows, Spot.LAST].max()),
            place=stay.at,
            at_once=count if count > 1 else None,
            rows=rows,
            newest=newest,
            stays=stays,
        )

    def _locate_mover(self, mover: Mover, keys: Collection[str]) -> Iterator[_FoundThing]:
        """Yields a mover where it was last seen, if the window has seen it inside the region."""
        estimate = self.known.estimate
        rows = self.known.seen_inside(mover, self.window, self.where)
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
            last=int(spots[newest, Spot.LAST]),
            place=places[newest],
            at_once=most_at_once(spots),
            rows=rows,
            newest=rows[[newest]],
            also_at=tuple(places[number] for number in in_slice if number != newest),
        )

    def describe(self, found: _FoundThing) -> Thing:
        """Returns a thing as replies show it."""
        estimate, thing, rows = self.known.estimate, found.thing, found.rows
        frame = self.known.frames[thing.epoch]
        seen = self.known.describe_stay(rows, found.place, frame, self.places)
        best, median = self._scores(rows)
        shown = Thing(
            label=found.label,
            place=found.place,
            spread_m=int(estimate.spots[found.newest[0], Spot.DEV]) / _MM,
            frame_id=frame,
            inside=seen.inside,
            first=seen.start,
            last=found.last,
            count=seen.count,
            best=best,
            median=median,
            robot=estimate.seen_from(found.newest),
            still_there=None,
            at_once=found.at_once,
            near_m=found.near_m,
        )
        if isinstance(thing, Mover):
            return replace(shown, moves=True, usually=self._usual_places(frame, rows))
        return self._with_history(shown, thing, found)

    def moves(self, things: Iterable[_FoundThing]) -> Iterator[Move]:
        """Yields the moves of things from place to place in the window."""
        for found in things:
            if isinstance(found.thing, Instance):
                for before, after in pairwise(found.stays):
                    yield Move(found.thing, before[-1].stay, after[0].stay)

    def _with_history(self, shown: Thing, instance: Instance, found: _FoundThing) -> Thing:
        """Returns a described thing with its names, its stays, and whether it is still there."""
        newest = found.stays[-1][-1]
        moved = []
        for group in found.stays:
            rows_there = np.concatenate([part.rows for part in group])
            place = group[-1].stay.at
            moved.append(self.known.describe_stay(rows_there, place, shown.frame_id, self.places))
        has_moved = len(moved) > 1
        labels = self._count_names(found.rows)
        misread = Counter[str]()
        for stay in instance.stays:
            misread.update(stay.misread_as)
        return replace(
            shown,
            id=instance.id,
            labels=tuple(labels.items()) if len(labels) > 1 else (),
            misread_as=_commonest(misread, instance.labels),
            spread_m=newest.stay.dev_mm / _MM,
            still_there=self._still_there(instance, newest),
            moved=tuple(moved) if has_moved else (),
            usually=self._usual_places(shown.frame_id, found.rows) if has_moved else None,
        )

    def _count_names(self, rows: Ints) -> dict[str, int]:
        """Returns how often each name was seen in spots, the commonest name first."""
        estimate = self.known.estimate
        labels = count_labels(estimate, estimate.counts, rows)
        return count_names(labels, self.known.labels, estimate.names)

    def _usual_places(self, frame: str, rows: Ints) -> tuple[UsualPlace, ...] | None:
        """Returns where a thing usually is, by its spots, with the named places there."""
        spots = self.known.estimate.spots[rows]
        spots = spots[stable_order(spots[:, Spot.LAST])]
        now = min(self.now, self.window.stop)
        usual = usual_places(spots[:, Spot.LAST], spots[:, [Spot.X, Spot.Y, Spot.Z]], now)
        if usual is None:
            return None
        return tuple(
            replace(place, inside=places_at(self.places, {frame: place.place})) for place in usual
        )

    def _scores(self, rows: Ints) -> tuple[float | None, float | None]:
        """Returns the best and the median score of the detections that count; None without scores.

        The median is known to 0.05, the width of a bin: it is the highest best score of a spot in
        that bin, or the middle of the bin.
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

    def _still_there(self, instance: Instance, newest: _StayInWindow) -> StillThere | None:
        """Returns what all sightings say of a thing since it was last seen in the window."""
        spots = self.known.estimate.spots[newest.rows]
        last, by_all, stay = int(spots[:, Spot.LAST].max()), self.known.by_all, newest.stay
        if by_all is not self.known:
            newest_first = stable_order(-spots[:, Spot.LAST])
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
        looked = self.known.estimate.looks.last
        if last + _JUST_NOW_NS >= looked[looked < self.window.stop].max(initial=0):
            return StillThere("in_view", last)
        # The estimate may end before the thing was looked at again.
        return StillThere("not_looked_at_since", last) if by_all.until == MAX_NS else None


def _commonest(counts: Counter[str], without: Collection[str]) -> tuple[str, ...]:
    others = [name for name in counts if name not in without]
    return tuple(sorted(others, key=lambda name: (-counts[name], name))[:_MOST_NAMES])

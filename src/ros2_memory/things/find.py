"""Answers which things there are, where, since when, and where they were before."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import SCORE_BINS, Look, Score, Spot, Unplaced
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.regions import places_at
from ros2_memory.core.text import abbreviate, counted, listed
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.coverage import being_written, describe_held
from ros2_memory.history.no_data import require_recorded
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import TimeRange, View, clamped, open_view, search_window
from ros2_memory.insights.silences import describe_silences
from ros2_memory.places.where import parse_where
from ros2_memory.results import StillThere, Thing, Things, ThingStay
from ros2_memory.things.instances import most_at_once
from ros2_memory.things.known import KnownThings, known_things

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.sights import Ints
    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.core.regions import Place
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.places.where import Where
    from ros2_memory.things.instances import Instance, Mover, PlacedStay

LIMIT: Final = 12
_FEWEST_BESIDE: Final = 3
_MOST_NAMES: Final = 5
_JUST_NOW_NS: Final = 2 * NS_PER_S
"""Detectors publish at their own times."""
_MM: Final = 1000.0


def find_things(
    memory: Memory,
    call: Call,
    labels: Sequence[str] = (),
    *,
    where: JsonValue = None,
    start_s: float | None = None,
    end_s: float | None = None,
    min_score: float | None = None,
    limit: int = LIMIT,
) -> Things:
    """Returns the things of some labels, or all, that were seen in a window, those seen last first.

    A thing counts where it was at the window's end. `where` takes those that are in a region then;
    of what moves by itself, what was seen in it. Bags count as a whole.

    Raises:
        InvalidArgumentsError: the bounds make no window, `where` is no region, or `min_score` is
            above 1.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    limits = memory.limits
    region = None if where is None else parse_where(limits, where)
    span = TimeRange(start_s, end_s)
    wall = memory.clock.now()
    view = open_view(memory, call, min(search_window(span, wall).stop, wall))
    now = memory.now(wall, view.snapshot.latest)
    asked_for = search_window(span, now)
    require_recorded(view, asked_for)
    window = clamped(view, asked_for)
    lowest = limits.min_score if min_score is None else min_score
    if lowest > 1:
        raise InvalidArgumentsError(
            f"min_score was {lowest:g}; scores of things are counted from 0 to 1"
        )
    note_robots(view, view.pose_topic, window)
    known = known_things(view, lowest, limits.labels)
    asked = {known.labels.key(each): each for each in labels}
    finder = _Finder(known, window, region, limits.places)
    found = sorted(finder.find(asked), key=lambda each: (-each.last, each.label, each.place))
    things = tuple(each.described() for each in found[:limit])
    totals: dict[str, int] = {}
    for each in found:
        totals[each.label] = totals.get(each.label, 0) + (each.at_once or 1)
    held = describe_held(being_written(view.snapshot, asked_for))
    notes = [*view.notes.sentences(), *held]
    if not found:
        notes += [*_unseen(view, known, window)]
    is_bounded = start_s is not None or end_s is not None
    bounds = [*["window"] * is_bounded, *([] if region is None else ["region"])]
    inside = f" in this {' and '.join(bounds)}" if bounds else ""
    notes += _notes(known)
    keys_found = {known.labels.key(each.label) for each in found}
    for key, label in asked.items():
        of_label = _label_notes(known, label, key, window, inside, found=key in keys_found)
        notes += [note if len(asked) == 1 else f"{abbreviate(label)}: {note}" for note in of_label]
    return Things(
        frame_id=_frame_of(known, things),
        things=things,
        total=sum(totals.values()),
        labels=tuple(sorted(totals.items())),
        now=now,
        all_counted=known.since is None,
        notes=tuple(notes),
    )


def _frame_of(known: KnownThings, shown: Sequence[Thing]) -> str:
    if shown:
        return shown[0].frame_id
    # Without a map, the frame of the newest odometry; nothing where no detector published.
    return known.frames[0] if known.has_map else "".join(known.frames[1:][-1:])


def _unseen(view: View, known: KnownThings, window: TimeWindow) -> Iterator[str]:
    """Yields why no thing may be known of a window: its detectors published nothing in it."""
    sights = known.estimate.sights
    times = (
        (sights.looks, Look.FIRST, Look.LAST),
        (sights.spots, Spot.FIRST, Spot.LAST),
        (sights.unplaced, Unplaced.FIRST, Unplaced.LAST),
    )
    published = any(
        bool(((table[:, first] < window.stop) & (table[:, last] >= window.start)).any())
        for table, first, last in times
    )
    if sights.topics and not published:
        yield (
            f"{listed(sights.topics)} published nothing in this window: whether things were there "
            "is not known"
        )
    yield from describe_silences(view, sights.topics, window)


class _Found(NamedTuple):
    """A thing of a question, which is described where it is shown: there may be thousands."""

    label: str
    last: Ns
    place: tuple[float, float, float]
    at_once: int | None
    described: Callable[[], Thing]


@dataclass(frozen=True, slots=True)
class _Finder:
    """Selects the things of a question, and describes them."""

    known: KnownThings
    window: TimeWindow
    where: Where | None
    places: tuple[Place, ...]

    def find(self, keys: Collection[str]) -> Iterator[_Found]:
        """Yields the things of these keys, or all where there are none."""
        result = self.known.estimate
        for instance in result.instances:
            if not keys or instance.key in keys:
                thing = self._instance(instance)
                if thing is not None:
                    yield thing
        for mover in result.movers:
            if not keys or mover.key in keys:
                thing = self._mover(mover)
                if thing is not None:
                    yield thing

    def _instance(self, instance: Instance) -> _Found | None:
        seen = ((stay, self._seen(stay.spots)) for stay in instance.stays)
        parts = [(stay, rows) for stay, rows in seen if len(rows)]
        if not parts:
            return None
        last, newest = parts[-1]
        if not self._is_there(self.known.frames[instance.epoch], last.x, last.y):
            return None
        spots = self.known.estimate.sights.spots
        at_once = self._side_by_side(newest)
        return _Found(
            self.known.estimate.names[instance.key],
            max(int(spots[rows, Spot.LAST].max()) for _, rows in parts),
            _place(last.x, last.y, last.z),
            at_once,
            partial(self._described, instance, parts, at_once),
        )

    def _described(
        self, instance: Instance, parts: Sequence[tuple[PlacedStay, Ints]], at_once: int | None
    ) -> Thing:
        last, newest = parts[-1]
        frame = self.known.frames[instance.epoch]
        every = np.concatenate([rows for _, rows in parts])
        stays = [self._stay(frame, group) for group in _by_place(parts)]
        best, median = self._scores(every)
        spots = self.known.estimate.sights.spots[every]
        return Thing(
            label=self.known.estimate.names[instance.key],
            also_seen_as=self._names(instance, [stay.spellings for stay in instance.stays]),
            misread_as=self._names(instance, [stay.also for stay in instance.stays]),
            place=_place(last.x, last.y, last.z),
            spread_m=last.dev_mm / _MM,
            frame_id=frame,
            inside=places_at(self.places, frame, last.x / _MM, last.y / _MM),
            first=int(spots[:, Spot.FIRST].min()),
            last=int(spots[:, Spot.LAST].max()),
            count=int(self.known.estimate.counts[every].sum()),
            best=best,
            median=median,
            robot=self._robot(newest),
            still_there=self._still_there(instance, last, newest),
            moved=tuple(stays) if len(stays) > 1 else (),
            at_once=at_once,
        )

    def _side_by_side(self, rows: Ints) -> int | None:
        """Returns how many of a label are at one place, where messages have several at once.

        Places are no finer than the noise of far detections, but two of one message are never one.
        A bag counts where each was seen at least half as often as the one seen most.
        """
        spots, counts = self.known.estimate.sights.spots[rows], self.known.estimate.counts[rows]
        many = counts >= _FEWEST_BESIDE
        of = spots[many]
        order = np.argsort(of[:, Spot.BAG], kind="stable")
        bags, together, often = of[order, Spot.BAG], of[order, Spot.TOGETHER], counts[many][order]
        begins = np.flatnonzero(np.diff(bags, prepend=-1))
        numbers: list[int] = []
        if len(begins):
            sizes = np.diff(begins, append=len(bags))
            most = np.repeat(np.maximum.reduceat(often, begins), sizes)
            beside = np.add.reduceat((2 * often >= most).astype(np.int64), begins)
            at_once = np.maximum.reduceat(together, begins)
            numbers = np.minimum(beside, at_once).tolist()
        # What most bags have, so that no single one with a false detection counts.
        number = sorted(numbers, reverse=True)[len(numbers) // 2] if numbers else 1
        return number if number > 1 else None

    def _mover(self, mover: Mover) -> _Found | None:
        """Returns a mover: where it was last seen, inside the region if one is given."""
        rows = self._seen(mover.spots)
        result, frame = self.known.estimate, self.known.frames[mover.epoch]
        if self.where is not None:
            places = result.sights.spots[rows][:, [Spot.X, Spot.Y]].tolist()
            rows = rows[[self._is_there(frame, x, y) for x, y in places]]
        if not len(rows):
            return None
        spots = result.sights.spots[rows]
        newest = int(spots[:, Spot.LAST].argmax())
        x, y, z, dev = spots[newest, [Spot.X, Spot.Y, Spot.Z, Spot.DEV]].tolist()
        best, median = self._scores(rows)
        thing = Thing(
            label=result.names[mover.key],
            also_seen_as=(),
            place=_place(x, y, z),
            spread_m=dev / _MM,
            frame_id=frame,
            inside=places_at(self.places, frame, x / _MM, y / _MM),
            first=int(spots[:, Spot.FIRST].min()),
            last=int(spots[newest, Spot.LAST]),
            count=int(result.counts[rows].sum()),
            best=best,
            median=median,
            robot=self._robot(rows[[newest]]),
            still_there=None,
            at_once=most_at_once(spots),
            moves=True,
        )
        return _Found(thing.label, thing.last, thing.place, thing.at_once, lambda: thing)

    def _is_there(self, frame: str, x_mm: float, y_mm: float) -> bool:
        where = self.where
        if where is None:
            return True
        if where.frame_id not in {None, frame}:
            return False
        return where.region.contains(x_mm / _MM, y_mm / _MM)

    def _seen(self, rows: Ints) -> Ints:
        """Returns the spots of bags that reach into the window."""
        spots = self.known.estimate.sights.spots[rows]
        inside = (spots[:, Spot.FIRST] < self.window.stop) & (
            spots[:, Spot.LAST] >= self.window.start
        )
        return rows[inside & (self.known.estimate.counts[rows] > 0)]

    def _stay(self, frame: str, parts: Sequence[tuple[PlacedStay, Ints]]) -> ThingStay:
        """Returns the stays at one place in a row, as one."""
        last, _ = parts[-1]
        rows = np.concatenate([rows for _, rows in parts])
        spots = self.known.estimate.sights.spots[rows]
        return ThingStay(
            start=int(spots[:, Spot.FIRST].min()),
            end=int(spots[:, Spot.LAST].max()),
            place=_place(last.x, last.y, last.z),
            count=int(self.known.estimate.counts[rows].sum()),
            inside=places_at(self.places, frame, last.x / _MM, last.y / _MM),
        )

    def _scores(self, rows: Ints) -> tuple[float | None, float | None]:
        """Returns the best score of some spots, and their median to 0.05, the width of a bin.

        That is the best score in its bin, where that is known: of spots with none in a higher one.
        """
        sights = self.known.estimate.sights
        best = int(sights.spots[rows, Spot.BEST].max())
        if best < 0:
            return None, None
        mine = np.zeros(len(sights.spots), bool)
        mine[rows] = True
        of = mine[sights.scores[:, Score.SPOT]]
        counts = np.bincount(sights.scores[of, Score.BIN], sights.scores[of, Score.N], SCORE_BINS)
        middle = int(np.searchsorted(np.cumsum(counts), counts.sum() / 2))
        highest = np.full(len(sights.spots), -1, np.int64)
        np.maximum.at(highest, sights.scores[of, Score.SPOT], sights.scores[of, Score.BIN])
        known = sights.spots[highest == middle, Spot.BEST]
        median = int(known.max()) / 1000 if len(known) else (middle + 0.5) / SCORE_BINS
        return best / 1000, min(median, best / 1000)

    def _robot(self, spots: Ints) -> tuple[float, float, float] | None:
        """Returns the pose (m, rad) from which most messages saw some spots."""
        pose = self.known.estimate.seen_from(spots)
        if pose is None:
            return None
        x, y, yaw = pose
        return x / _MM, y / _MM, math.radians((yaw + 180) % 360 - 180)

    def _names(self, instance: Instance, seen: Iterable[Mapping[str, int]]) -> tuple[str, ...]:
        """Returns the commonest of these names, other than the thing's own."""
        counts: Counter[str] = Counter()
        for each in seen:
            counts.update(each)
        counts.pop(self.known.estimate.names[instance.key], None)
        return tuple(sorted(counts, key=lambda each: (-counts[each], each))[:_MOST_NAMES])

    def _still_there(self, instance: Instance, stay: PlacedStay, rows: Ints) -> StillThere:
        """Returns the state of a thing since it was last seen in the window."""
        spots = self.known.estimate.sights.spots
        last = int(spots[rows, Spot.LAST].max())
        if stay.last > last:
            return StillThere("seen_since", stay.last)
        if stay is instance.stays[-1]:
            looks, missed = instance.looks, instance.missed_by
        else:
            _, looks, missed = self.known.estimate.missing(instance, stay)
        if missed is not None:
            return StillThere("not_seen_where_expected", missed, looks)
        looked = self.known.estimate.sights.looks[:, Look.LAST]
        if last + _JUST_NOW_NS >= looked[looked < self.window.stop].max(initial=0):
            return StillThere("in_view", last)
        return StillThere("not_looked_at_since", last)


def _place(x_mm: float, y_mm: float, z_mm: float) -> tuple[float, float, float]:
    return x_mm / _MM, y_mm / _MM, z_mm / _MM


def _by_place(
    parts: Sequence[tuple[PlacedStay, Ints]],
) -> list[list[tuple[PlacedStay, Ints]]]:
    """Returns the stays in groups of those that follow each other at one place.

    One after whose end the place was seen without the thing ends a group: it was taken away, and
    brought back.
    """
    groups: list[list[tuple[PlacedStay, Ints]]] = []
    for part in parts:
        before = groups[-1][-1][0] if groups else None
        if before is not None and before.place == part[0].place and before.left is None:
            groups[-1].append(part)
        else:
            groups.append([part])
    return groups


def _notes(known: KnownThings) -> Iterator[str]:
    """Yields notes on resets of odometry, and on missing detectors."""
    sights = known.estimate.sights
    if len(known.frames) > 1 + bool(known.frames[0]):
        yield (
            "without a map, each run of odometry has its own coordinates: a thing may be listed "
            "once for each run"
        )
    if not sights.topics and known.since is None:
        yield (
            "no things are known: there is no message of a detector "
            "(a type such as vision_msgs/msg/Detection3DArray); find_matches searches text"
        )


def _label_notes(
    known: KnownThings, label: str, asked: str, window: TimeWindow, inside: str, *, found: bool
) -> Iterator[str]:
    """Yields notes on a label; `inside` says how it was asked about."""
    sights = known.estimate.sights
    mine = np.array([known.labels.key(each) == asked for each in sights.labels], bool)
    unplaced = sights.unplaced[mine[sights.unplaced[:, Unplaced.LABEL]], Unplaced.N].sum()
    if unplaced:
        yield f"{counted(int(unplaced), 'detection')} of it could not be placed, and are left out"
    if found:
        return
    spots = sights.spots[mine[sights.spots[:, Spot.LABEL]]]
    during = (spots[:, Spot.FIRST] < window.stop) & (spots[:, Spot.LAST] >= window.start)
    every, seen = int(spots[:, Spot.N].sum()), int(spots[during, Spot.N].sum())
    names = sorted(set(known.estimate.names.values()))
    if seen:
        yield (
            f"it was detected {counted(seen, 'time')} in this time, but does not count as a thing"
            f"{inside}: find_matches lists single detections"
        )
    elif every:
        yield f"it was detected {counted(every, 'time')} in all, and not once in this window"
    elif names:
        close = [each for each in names if asked in each or each in asked]
        close += difflib.get_close_matches(asked, names, 3)
        shown = [*dict.fromkeys(close)] or names
        meant = f"; did you mean {close[0]}?" if close else ""
        yield f"no detector reported {abbreviate(label)}; there are: {listed(shown)}{meant}"

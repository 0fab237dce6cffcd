"""The things of a memory: estimated from the sights of all its bags, once for each timeline.

For a window that ended in the past, things are estimated from the sightings until its end. So an
answer about it never changes: a thing that was moved since is where it was then.

If gathering sights takes too long, an estimate begins later, and says so. It also begins later if
there are too many sightings: a detector that sees things everywhere has thousands in an hour.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property
from operator import itemgetter
from typing import TYPE_CHECKING, Final, TypeAlias, TypeVar

from ros2_memory.analysis.sights import Spot
from ros2_memory.columns.sights import join_sights
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.regions import Place, places_at
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.context import READING_S
from ros2_memory.history.coverage import unix_text
from ros2_memory.results import ThingStay
from ros2_memory.things.estimation import estimate
from ros2_memory.things.labels import Labels
from ros2_memory.things.seen import SIGHTS_NS, SeenStretch, SightReader, spots_in

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import TimeWindow, Vector3
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Where
    from ros2_memory.things.instances import Estimate, Mover

T = TypeVar("T", bound="Hashable")
_Part: TypeAlias = "list[SeenStretch[Session]]"
_Odometry: TypeAlias = "tuple[str, Session | None]"
"""A frame, and the session in which its coordinates hold; None for the map: they always hold."""

_MOST_SPOTS: Final = 150_000
"""Spots that one estimate compares: a home robot has 50,000 in a week, one that looks around once
a second day and night 34,000 in a day."""
_ESTIMATING_S: Final = 6.0
_FEWER: Final = 4
"""After an estimate that takes longer, the next ones compare a fourth as many spots."""
_QUICK: Final = 4
"""After an estimate that takes less than a fourth of that, the next compares twice as many."""
_KEPT_BYTES: Final = 500
"""About how much memory a cached number takes."""


@dataclass(frozen=True, slots=True)
class KnownThings:
    """The estimate of a memory's things.

    Attributes:
        labels: maps labels to keys.
        frames: the frame of each epoch's places; epoch 0 is the map.
        has_map: whether any sights are in the map.
        since: where the estimate begins, if there was no time to read older bags, or if there are
            too many sightings; None if it has all.
        crowded: whether it begins there because of too many sightings.
        until: where the estimate ends: later sightings do not count.
        later: the things by all sightings, if this estimate ends before the last one.
        most: how many spots could be compared in time, as far as was known.
    """

    estimate: Estimate
    labels: Labels
    frames: tuple[str, ...]
    since: Ns | None
    has_map: bool
    crowded: bool
    until: Ns
    later: KnownThings | None = None
    most: int = _MOST_SPOTS

    @property
    def by_all(self) -> KnownThings:
        """The things by all sightings; this estimate if there are too many to compare."""
        return self.later or self

    @property
    def reach(self) -> str:
        """The time of the estimate as the end of a sentence; empty for all of history."""
        since = "" if self.since is None else unix_text(self.since)
        if self.until == MAX_NS:
            return f" since {since}" if since else ""
        return f"{f' from {since}' if since else ''} until {unix_text(self.until)}"

    def reaches_back(self, window: TimeWindow) -> bool:
        """Returns whether the things of a whole window are known."""
        return self.since is None or self.since <= window.start

    def seen_inside(
        self, mover: Mover, window: TimeWindow, where: Where | None, before: Ns = MAX_NS
    ) -> Ints:
        """Returns the spots of a mover in a region and a window; see `Estimate.seen_in`."""
        rows = self.estimate.seen_in(mover.spots, window, before)
        if where is None:
            return rows
        frame = self.frames[mover.epoch]
        places = (self.estimate.spots[rows][:, [Spot.X, Spot.Y, Spot.Z]] / 1000).tolist()
        return rows[[where.contains(frame, (x, y, z)) for x, y, z in places]]

    def describe_stay(
        self, rows: Ints, place: Vector3, frame: str, places: Sequence[Place]
    ) -> ThingStay:
        """Returns spots as a stay at a place (m) in a frame, as replies show it."""
        spots = self.estimate.spots[rows]
        return ThingStay(
            start=int(spots[:, Spot.FIRST].min()),
            end=int(spots[:, Spot.LAST].max()),
            place=place,
            count=int(self.estimate.counts[rows].sum()),
            inside=places_at(places, {frame: place}),
        )


def known_things(view: View, min_score: float, window: TimeWindow) -> KnownThings:
    """Returns the things known at a window's end. Notes say what could not be read.

    Raises:
        QueryTimeoutError: the call's time is over before any bag was read.
    """
    latest = view.snapshot.latest
    until = -(-window.stop // SIGHTS_NS) * SIGHTS_NS
    ahead = view.snapshot.dating.ahead_from
    by_all = _Loader(view, min_score, ahead if window.stop <= ahead else MAX_NS)
    known = by_all.load() if by_all.reaches(window.start) else None
    is_past = latest is None or until <= latest
    is_out_of_time = known is not None and known.since is not None and not known.crowded
    if is_past and not is_out_of_time:
        # What was known then answers; what is known by all says whether a thing is still there.
        then = _Loader(view, min_score, MAX_NS, until).load()
        if known is not None and known.reaches_back(window):
            return replace(then, later=known) if then.reaches_back(window) else known
        known = then
    elif known is None:
        known = by_all.load()
    if known.crowded or known.until < MAX_NS:
        view.notes.complete &= known.reaches_back(window)
        others = "other" if known.until < MAX_NS else "older"
        view.notes.add(
            f"things are known{known.reach} only: there are too many sightings to compare {others} "
            "ones, which find_matches finds"
        )
    return known


def note_other_frames(view: View, known: KnownThings, region: Where | None) -> None:
    """Notes the places of a region whose frames have no known things."""
    frames = dict.fromkeys(known.frames if known.has_map else known.frames[1:])
    if region is None or not frames:
        return
    for place in region.each:
        if place.frame_id is not None and place.frame_id not in frames:
            view.notes.add(
                f"{place.title} is in {place.frame_id}, and things are known in "
                f"{' and '.join(frames)}: nothing is found there"
            )


class _TakesTooLongError(Exception):
    """An estimate takes longer than an answer may."""


class _Loader:
    """Gathers the sights of all bags of a view, the newest first, and estimates things by them.

    For each timeline the cache has two results: one by all sightings, and one of a past time.

    Args:
        view: has the bags.
        min_score: detections with a lower score do not count.
        ahead: sightings that are dated later are left out, since a wrong clock dated them.
        until: the end of an estimate of a past time.
    """

    def __init__(self, view: View, min_score: float, ahead: Ns, until: Ns = MAX_NS) -> None:
        labels = view.limits.labels
        labels_key = tuple(sorted((name, tuple(others)) for name, others in labels.items()))
        key = (min_score, labels_key, view.limits.map_frame, view.pose_topic, ahead)
        self._view = view
        self._cache = view.memory.scanner.caches.things
        self._min_score = min_score
        self._labels = Labels(labels)
        self._ahead = ahead
        self._until = until
        self._things_key = ("things", until == MAX_NS, *key)
        self._most_key = ("most spots", *key)
        self._read_from: Ns | None = None
        self._notes_before = view.notes.added

    def reaches(self, moment: Ns) -> bool:
        """Returns whether the sightings after a moment are few enough to compare.

        Raises:
            QueryTimeoutError: as in `load`.
        """
        cached = self._cached
        if cached is not None:
            return isinstance(cached, KnownThings) or cached <= moment
        parts, crowded = self._gathered
        since = _begin(parts[0]) if crowded else moment
        if since > moment:
            self._put(since)
        return since <= moment

    def load(self) -> KnownThings:
        """Returns the things in all sights that could be read, and compared, in time.

        Raises:
            QueryTimeoutError: the call's time is over before any bag was read.
        """
        cached = self._cached
        if (
            isinstance(cached, KnownThings)
            and cached.until == self._until
            # The machine may have been slow for a while.
            and (not cached.crowded or cached.most >= self._most_spots)
        ):
            return cached
        known = self._estimated_in_time()
        if known.since is None or known.crowded:
            self._put(known)
        return known

    @property
    def _cached(self) -> KnownThings | Ns | None:
        """The cached things, or the time (ns) after which there are too many sightings, or None."""
        timeline, known = self._cache.get(self._things_key) or (None, None)
        if timeline is not self._view.timeline:
            return None
        return known if isinstance(known, KnownThings | int) else None

    def _put(self, known: KnownThings | Ns) -> None:
        """Caches a result, unless an open bag or a failure took part in it."""
        if not self._view.call.used_active and self._view.notes.added == self._notes_before:
            size = _KEPT_BYTES if isinstance(known, int) else known.estimate.memory_bytes
            self._cache.put(self._things_key, (self._view.timeline, known), size)

    def _estimated_in_time(self) -> KnownThings:
        """Returns the things by the newest sightings, as many as can be compared in time."""
        parts, crowded = self._gathered
        most = self._most_spots
        if self._read_from is not None:
            self._view.notes.add_lack(
                f"things are known since {unix_text(self._read_from)} only: reading older bags "
                f"takes too long; {self._view.bags.filling_progress()}ask again"
            )
        while True:
            begun_s = time.thread_time()  # a busy machine makes no estimate longer
            try:
                known = self._things_in(parts, crowded=crowded)
            except _TakesTooLongError:
                most = max(sum(map(spots_in, parts)) // _FEWER, 1)
                self._put_most(most)
                parts, crowded = _newest_within(parts, most), True
            else:
                # Try more the next time.
                if most < _MOST_SPOTS and time.thread_time() - begun_s < _ESTIMATING_S / _QUICK:
                    self._put_most(min(2 * most, _MOST_SPOTS))
                return replace(known, most=most)

    @property
    def _most_spots(self) -> int:
        """How many spots can be compared in time, by the estimates before."""
        _, most = self._cache.get(self._most_key) or (None, None)
        return most if isinstance(most, int) else _MOST_SPOTS

    def _put_most(self, most: int) -> None:
        self._cache.put(self._most_key, (self._view.timeline, most), _KEPT_BYTES)

    @cached_property
    def _gathered(self) -> tuple[list[_Part], bool]:
        """The newest stretches, in order of time, and whether there are too many spots to add more.

        If there is no time to read older stretches, `_read_from` is where the oldest one begins.
        """
        most = self._most_spots
        parts: list[_Part] = []
        reading = self._view.call.partial_after(READING_S)
        spots = 0
        try:
            for part in SightReader(self._view).newest_first(min(self._ahead, self._until), most):
                if spots >= most:
                    return parts[::-1], True
                if parts and reading.expired():
                    self._read_from = _begin(parts[-1])
                    break
                parts.append(part)
                spots += spots_in(part)
        except QueryTimeoutError:
            if not parts:
                raise
            self._read_from = _begin(parts[-1])
        return parts[::-1], False

    def _things_in(self, parts: Sequence[_Part], *, crowded: bool) -> KnownThings:
        """Returns the things in stretches. `crowded`: too many sightings are before these.

        Raises:
            _TakesTooLongError: an answer may not take so long, and fewer stretches would do.
        """
        stretches = _detector_stretches([stretch for part in parts for stretch in part])
        epoch_of, frames = self._epochs(stretches)
        session_of = _numbered_in_time(
            pair for part in stretches for pair in zip(part.starts, part.sessions, strict=True)
        )
        packed, epochs, sessions = [], [], []
        for stretch in stretches:
            for sights_of_topic in stretch.sights:
                packed.append(sights_of_topic.packed)
                for session in stretch.sessions:
                    epochs.append(epoch_of[self._odometry(session, stretch.frame_id)])
                    sessions.append(session_of[session])
        estimating = self._view.call.partial_after(_ESTIMATING_S)

        def go_on() -> None:
            if self._read_from is None:  # else the call's time is over, and this is its answer
                self._view.bags.check_deadline()
            if len(parts) > 1 and estimating.expired():
                raise _TakesTooLongError

        self._view.memory.large.acquire()
        sights = join_sights(packed, epochs, sessions)
        things = estimate(sights, self._labels, self._min_score, go_on)
        since = self._read_from
        if crowded:
            since = max(_begin(parts[0]), MIN_NS if since is None else since)
        has_map = bool(sights.topics) and 0 in epochs
        return KnownThings(
            things, self._labels, frames, since, has_map, crowded=crowded, until=self._until
        )

    def _epochs(self, stretches: _Part) -> tuple[dict[_Odometry, int], tuple[str, ...]]:
        """Returns the number of each epoch, and the frames by number.

        Everything in the map is in epoch 0. Odometry begins again in each session.
        """
        placed: list[tuple[Ns, _Odometry]] = [(MIN_NS, (self._view.limits.map_frame or "", None))]
        for stretch in stretches:
            for start, session in zip(stretch.starts, stretch.sessions, strict=True):
                placed.append((start, self._odometry(session, stretch.frame_id)))
        numbers = _numbered_in_time(placed)
        return numbers, tuple(frame for frame, _ in numbers)

    def _odometry(self, session: Session, frame: str) -> _Odometry:
        return frame, None if frame == self._view.limits.map_frame else session


def _numbered_in_time(timed: Iterable[tuple[Ns, T]]) -> dict[T, int]:
    """Returns a number for each distinct value, in the order of the values' times."""
    in_time = dict.fromkeys(value for _, value in sorted(timed, key=itemgetter(0)))
    return {value: number for number, value in enumerate(in_time)}


def _begin(part: _Part) -> Ns:
    """Returns the start (ns) of the oldest ten minutes of a part."""
    return min(stretch.starts[0] for stretch in part)


def _detector_stretches(stretches: _Part) -> _Part:
    """Returns the stretches with the sights of detectors alone: topics that detect in any of them.

    Sights without a topic stay: they have the fixes.
    """
    detectors = set[str]()
    for stretch in stretches:
        for sights in stretch.sights:
            if sights.detects:
                detectors.update(sights.topics)
    of_detectors = []
    for stretch in stretches:
        every = tuple(sights for sights in stretch.sights if detectors.issuperset(sights.topics))
        if any(sights.topics for sights in every):
            of_detectors.append(stretch._replace(sights=every))
    return of_detectors


def _newest_within(parts: Sequence[_Part], most: int) -> list[_Part]:
    """Returns the newest parts with at most `most` spots in all, and the newest in any case."""
    newest = [parts[-1]]
    spots = spots_in(parts[-1])
    for part in reversed(parts[:-1]):
        spots += spots_in(part)
        if spots > most:
            break
        newest.append(part)
    return newest[::-1]

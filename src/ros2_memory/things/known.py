"""The things of a memory: estimated from the sights of all its bags, once for each timeline.

Sights come from the catalogue, joined once for each segment of bags; of bags without a valid entry
they are made from the bags, as the catalogue would have them. So the estimate is the same with the
catalogue and without; where reading takes too long it begins later, and says so. So it does where
there are too many sightings: a detector that sees things everywhere has thousands in an hour.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import accumulate
from threading import Lock
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

from ros2_memory.catalogue.detector_sights import DetectorSights
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import BagState
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history.context import READING_S
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.transforms import sessions_of
from ros2_memory.places.map_digests import MapDigests
from ros2_memory.storage.cache import ByteLru
from ros2_memory.things.instances import Estimate, estimate
from ros2_memory.things.labels import Labels
from ros2_memory.things.sights import (
    Sights,
    decode_joined,
    decode_sights,
    joined,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Deadline, Ns
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline

_MADE_BYTES: Final = 4 << 20
_ENTRY_BYTES: Final = 1_000
_ESTIMATES: Final = 4
_MOST_SPOTS: Final = 300_000
"""Places of a label in a bag that are looked at together: a home robot has 50,000 in a week."""
_ESTIMATING_S: Final = 6.0
_FEWER: Final = 4
"""Where that takes longer, so many times fewer are looked at, from then on."""
_QUICK: Final = 8
"""Where it takes less than this part of it, twice as many are looked at the next time."""


@dataclass(frozen=True, slots=True)
class KnownThings:
    """The estimate of a memory.

    Attributes:
        labels: maps labels to keys.
        frames: by epoch, the frame of its places; epoch 0 is the map.
        has_map: whether any sights are in the map.
        since: how far back it reaches, where not all bags could be read in time; else None.
        crowded: whether it begins there because there are too many sightings before.
    """

    estimate: Estimate
    labels: Labels
    frames: tuple[str, ...]
    since: Ns | None = None
    has_map: bool = True
    crowded: bool = False


@dataclass(frozen=True, slots=True)
class _Part:
    """The sights of some bags in order of time; with the frame and the folder of each bag."""

    sights: Sights
    frames: tuple[str, ...]
    bags: tuple[BagFile, ...]


class _Made:
    """The sights that were made from bags last, and the estimates. Thread-safe."""

    def __init__(self) -> None:
        self.sights = ByteLru[bytes](_MADE_BYTES)
        self.most_spots = ByteLru[int](_ESTIMATES)
        self._estimates: WeakKeyDictionary[Timeline, ByteLru[KnownThings]] = WeakKeyDictionary()
        self._lock = Lock()

    def estimates(self, timeline: Timeline) -> ByteLru[KnownThings]:
        with self._lock:
            return self._estimates.setdefault(timeline, ByteLru(_ESTIMATES))


_CACHE: Final = _Made()


def known_things(
    view: View, min_score: float, spellings: Mapping[str, Sequence[str]]
) -> KnownThings:
    """Returns the things of all bags of a view; of what could not be read a note says so.

    Raises:
        QueryTimeoutError: the call's time is over before any bag was read.
    """
    timeline = view.snapshot.timeline
    described = tuple(sorted((name, tuple(each)) for name, each in spellings.items()))
    key = (min_score, described, view.memory.limits.map_frame, id(view.memory.reader))
    estimates = _CACHE.estimates(timeline)
    known = estimates.get(key)
    if known is None:
        before = view.notes.added
        known = _Loader(view).load(min_score, Labels(spellings), (id(view.memory.index), *key))
        active = any(bag.state is BagState.ACTIVE for bag in view.snapshot.bags)
        is_read = known.since is None or known.crowded
        if is_read and not active and view.notes.added == before:
            estimates.put(key, known, 1)
    if known.crowded and known.since is not None:
        view.notes.complete = False
        view.notes.add(
            f"things are known since {unix_text(known.since)} only: there are too many sightings "
            "to compare older ones, which find_matches finds"
        )
    return known


class _TakesTooLongError(Exception):
    """An estimate takes longer than an answer may."""


class _Loader:
    """Gathers the sights of all bags of a view, the newest segment first."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._maps = MapDigests(view)
        self._reading: Deadline | None = None
        self._since: Ns | None = None

    def load(self, min_score: float, labels: Labels, key: tuple[object, ...]) -> KnownThings:
        """Returns the things in all that could be read, and compared in time."""
        most = _CACHE.most_spots.get(key) or _MOST_SPOTS
        parts, crowded = self._newest(most)
        if self._since is not None:
            self._view.notes.complete = False
            self._view.notes.add(
                f"things are known since {unix_text(self._since)} only: reading older bags takes "
                f"too long; {self._view.bags.backfill_progress()}ask again"
            )
        while True:
            begun_s = time.monotonic()
            try:
                found = self._known(parts, min_score, labels, crowded=crowded)
            except _TakesTooLongError:
                most = max(sum(len(part.sights.spots) for part in parts) // _FEWER, 1)
                _CACHE.most_spots.put(key, most, 1)
                parts, crowded = _within(parts, most), True
            else:
                # It may have been the machine that was slow for a while.
                if most < _MOST_SPOTS and time.monotonic() - begun_s < _ESTIMATING_S / _QUICK:
                    _CACHE.most_spots.put(key, min(2 * most, _MOST_SPOTS), 1)
                return found

    def _newest(self, most: int) -> tuple[list[_Part], bool]:
        """Returns the newest bags, in order, and whether they have so many spots already."""
        parts: list[_Part] = []
        spots = 0
        for segment in reversed(self._view.snapshot.timeline.segments):
            if spots >= most:
                return parts[::-1], True
            self._view.bags.check_deadline()
            parts.append(self._part(segment))
            spots += len(parts[-1].sights.spots)
            if self._since is not None:
                break
        return parts[::-1], False

    def _known(
        self, parts: Sequence[_Part], min_score: float, labels: Labels, *, crowded: bool
    ) -> KnownThings:
        """Returns the things in some bags.

        Raises:
            _TakesTooLongError: that takes longer than an answer may, and fewer would do.
        """
        frames = [frame for part in parts for frame in part.frames]
        bags = [bag for part in parts for bag in part.bags]
        epochs, names = self._epochs(frames, bags)
        until = self._view.call.partial_after(_ESTIMATING_S)

        def go_on() -> None:
            if self._since is None:  # else the call's time may be over, and this is its answer
                self._view.bags.check_deadline()
            if len(parts) > 1 and until.expired():
                raise _TakesTooLongError

        sights = joined(part.sights for part in parts)
        found = estimate(sights, labels, epochs, min_score, go_on)
        since = self._since
        if crowded:
            since = max(bags[0].start, MIN_NS if since is None else since)
        return KnownThings(
            found, labels, names, since, bool(sights.topics) and 0 in epochs, crowded
        )

    def _part(self, segment: Segment) -> _Part:
        digests = self._view.bags.digests_of(segment)
        valid = {} if digests is None else self._maps.valid_in(digests, segment)
        if digests is not None and len(valid) == len(segment.bags):
            keys = digests.map_keys()
            state = hash(tuple(keys[number] for number in valid.values()))
            known = digests
            return digests.derived(f"things {state}", lambda: self._stored(known, segment, valid))
        stored = {} if digests is None else digests.catalogue.sights([*valid.values()])
        return self._read(segment, valid, {each: packed for each, (_, packed) in stored.items()})

    def _stored(self, digests: SegmentDigests, segment: Segment, valid: Mapping[str, int]) -> _Part:
        stored = digests.catalogue.sights([*valid.values()])
        packed = {number: blob for number, (_, blob) in stored.items()}
        return self._read(segment, valid, packed)

    def _read(
        self, segment: Segment, valid: Mapping[str, int], stored: Mapping[int, bytes]
    ) -> _Part:
        """Returns the sights of a segment's bags: stored ones decoded, others made."""
        found: list[tuple[BagFile, bytes]] = []
        for bag in sorted(segment.bags, key=lambda each: (each.start, each.file), reverse=True):
            packed = stored.get(valid.get(bag.file, -1))
            if packed is None:
                packed = self._made(bag)
            if packed is None:
                self._since = found[-1][0].start if found else bag.end
                break
            found.append((bag, packed))
        found.reverse()
        try:
            sights, which, frames = decode_joined([packed for _, packed in found])
        except ValueError:  # a damaged entry
            sound = {number: packed for number, packed in stored.items() if _is_sound(packed)}
            if len(sound) == len(stored):
                raise
            return self._read(segment, valid, sound)
        # Bags in which no detector published add nothing, and a week has thousands.
        return _Part(sights, tuple(frames), tuple(found[nth][0] for nth in which))

    def _made(self, bag: BagFile) -> bytes | None:
        """Returns the sights of a bag without an entry; None where there is no time to read it."""
        memory = self._view.memory
        stat = (bag.file, bag.size, bag.mtime_ns, bag.sidecar_ns, bag.end)
        key = (*stat, self._maps.statics.of(bag).key, memory.limits.map_frame, id(memory.reader))
        known = _CACHE.sights.get(key)
        if known is not None:
            return known
        if self._reading is None:
            self._reading = self._view.call.partial_after(READING_S)
        if self._reading.expired():
            return None
        before = self._view.notes.added
        try:
            digest = self._maps.made(bag, DetectorSights(memory.reader, memory.extractor))
        except QueryTimeoutError:
            return None
        if bag.state is not BagState.ACTIVE and self._view.notes.added == before:
            _CACHE.sights.put(key, digest.sights, len(digest.sights) + _ENTRY_BYTES)
        return digest.sights

    def _epochs(
        self, frames: Sequence[str], bags: Sequence[BagFile]
    ) -> tuple[list[int], tuple[str, ...]]:
        """Returns the epoch of each bag, and the frame of each epoch.

        All bags in the map are of epoch 0. Odometry starts again in each session.
        """
        in_map = self._view.memory.limits.map_frame
        sessions = sessions_of(self._view)
        known: dict[object, int] = {in_map: 0}
        names = [in_map or ""]
        epochs = []
        for frame, bag in zip(frames, bags, strict=True):
            key: object = frame if frame == in_map else (frame, sessions.of(bag.recording))
            if key not in known:
                known[key] = len(known)
                names.append(frame)
            epochs.append(known[key])
        return epochs, tuple(names)


def _within(parts: Sequence[_Part], most: int) -> list[_Part]:
    """Returns the newest parts that have at most so many spots, at least one."""
    spots = accumulate(len(part.sights.spots) for part in reversed(parts))
    return [*parts[-max(sum(each <= most for each in spots), 1) :]]


def _is_sound(packed: bytes) -> bool:
    """Returns whether stored bytes are sights."""
    try:
        decode_sights(packed)
    except ValueError:
        return False
    return True

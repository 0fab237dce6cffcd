"""The static transforms in force for each bag: those of its session, at the bag's end.

A robot may publish them in every split, so they are gathered once for each segment of bags, and of
a recording only those that differ from the one before are stored.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, TypeAlias
from weakref import WeakKeyDictionary

from ros2_memory.catalogue.map_digest import NO_STATICS, Statics, statics_of
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, MIN_NS, Ns
from ros2_memory.history.transforms import sessions_of, static_at, static_changes

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import BagFile, StampedTransform, Transform
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline

Topics: TypeAlias = "tuple[str, ...]"


@dataclass(slots=True)
class _Gathered:
    """Static transforms of some bags, in log-time order: by folder, and carried ones."""

    by_folder: dict[str, list[StampedTransform]] = field(default_factory=dict)
    carried: list[tuple[StoredMessage, tuple[StampedTransform, ...]]] = field(default_factory=list)


@dataclass(slots=True)
class _SessionStatics:
    """The static transforms of a session in log-time order, and when one of them changed."""

    transforms: list[StampedTransform]
    changes: list[Ns]
    periods: dict[int, Statics] = field(default_factory=dict)

    def at(self, time: Ns) -> Statics:
        """Returns those in force at a moment."""
        number = bisect_right(self.changes, time + AT_OR_BEFORE_SLACK_NS)
        if number not in self.periods:
            since = self.changes[number - 1] if number else MIN_NS
            self.periods[number] = statics_of(static_at(self.transforms, since))
        return self.periods[number]


_OF_SEGMENTS: Final[WeakKeyDictionary[Segment, dict[Topics, _Gathered]]] = WeakKeyDictionary()


@dataclass(slots=True)
class _OfTimeline:
    """What is known of a timeline: a new bag makes a new one."""

    gathered: _Gathered | None = None
    valid: WeakKeyDictionary[SegmentDigests, dict[str, int]] = field(
        default_factory=WeakKeyDictionary
    )
    sessions: dict[Session, _SessionStatics] = field(default_factory=dict)


_OF_TIMELINES: Final[WeakKeyDictionary[Timeline, dict[Topics, _OfTimeline]]] = WeakKeyDictionary()


class BagStatics:
    """The static transforms in force for each bag of a view, at the bag's end."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._topics = view.memory.limits.tf_static_topics
        of_timeline = _OF_TIMELINES.setdefault(view.snapshot.timeline, {})
        self._known = of_timeline.setdefault(self._topics, _OfTimeline())
        self._complete: dict[Path, _SessionStatics] = {}

    def of(self, bag: BagFile) -> Statics:
        """Returns the static transforms of a bag's session at its end."""
        known = self._complete.get(bag.recording)
        if known is not None:
            return known.at(bag.end)
        sessions = sessions_of(self._view)
        own = sessions.of(bag.recording)
        if sessions.has_all_kinds(own):
            self._complete[bag.recording] = known = self._statics(own)
            return known.at(bag.end)
        session = sessions.lending_to(bag.recording, bag.end)
        return self._statics(session).at(bag.end) if session else NO_STATICS

    def remembered(
        self, digests: SegmentDigests, compute: Callable[[], dict[str, int]]
    ) -> dict[str, int]:
        """Returns what follows from digests and these static transforms, computed once."""
        known = self._known.valid.get(digests)
        if known is None:
            known = self._known.valid[digests] = compute()
        return known

    def _statics(self, session: Session) -> _SessionStatics:
        known = self._known.sessions.get(session)
        if known is None:
            gathered = self._gathered()
            sessions = sessions_of(self._view)
            static = [each for name in session for each in gathered.by_folder.get(name, ())]
            for found, transforms in gathered.carried:
                if sessions.has(session, found):
                    static += transforms
            static.sort(key=lambda each: each.log_time)
            known = _SessionStatics(static, static_changes(static))
            self._known.sessions[session] = known
        return known

    def _gathered(self) -> _Gathered:
        """Returns the static transforms of all bags."""
        known = self._known.gathered
        if known is None:
            known = _Gathered()
            for segment in self._view.snapshot.timeline.segments:
                part = self._gathered_in(segment)
                for name, transforms in part.by_folder.items():
                    known.by_folder.setdefault(name, []).extend(transforms)
                known.carried += part.carried
            self._known.gathered = known
        return known

    def _gathered_in(self, segment: Segment) -> _Gathered:
        cache = _OF_SEGMENTS.setdefault(segment, {})
        known = cache.get(self._topics)
        if known is None:
            before = self._view.notes.keys()
            known = _gather(self._view, segment, self._topics)
            if self._view.notes.keys() == before:
                cache[self._topics] = known
        return known


def _gather(view: View, segment: Segment, topics: Topics) -> _Gathered:
    sessions = sessions_of(view)
    gathered = _Gathered()
    latest: dict[tuple[str, str], StampedTransform] = {}
    decoded: dict[tuple[str, str, bytes], tuple[StampedTransform, ...]] = {}
    for topic in topics:
        if topic not in segment.spans:
            continue
        by_folder: dict[str, list[StampedTransform]] = defaultdict(list)
        for bag, messages in view.bags.all_of(segment, topic):
            folder, is_carried = sessions.folder(bag.recording), sessions.is_carried(bag)
            if is_carried:
                gathered.carried += [(found, _transforms(view, found)) for found in messages]
                continue
            for found in messages:
                channel = found.record.channel
                key = (channel.type, channel.encoding, found.record.payload)
                known = decoded.get(key)
                # The same bytes again, and nothing else in between, as in nearly every split.
                if known is not None and all(
                    latest.get((folder, each.child)) is each for each in known
                ):
                    continue
                # Another recording has the same ones at another time.
                decoded[key] = made = (
                    _transforms(view, found)
                    if known is None
                    else tuple([replace(each, log_time=found.time) for each in known])
                )
                for each in made:
                    before = latest.get((folder, each.child))
                    latest[folder, each.child] = each
                    if before is None or _place(before) != _place(each):
                        by_folder[folder].append(each)
        for name, transforms in by_folder.items():
            gathered.by_folder.setdefault(name, []).extend(transforms)
    return gathered


def _place(each: StampedTransform) -> tuple[str, Transform]:
    return each.parent, each.transform


def _transforms(view: View, found: StoredMessage) -> tuple[StampedTransform, ...]:
    try:
        message = view.memory.reader.decode(found.record)
    except UndecodableError:
        return ()
    return view.memory.extractor.transforms(message, found.time, static=True)

"""The static transforms in force for each bag: those of its session, at the bag's end.

A robot may publish them in every split, so they are gathered once for each folder in each segment
of bags, and only those that differ from the one before are stored. Bags without an entry in the
catalogue are read for the sessions that are asked about alone.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Final, TypeAlias
from weakref import WeakKeyDictionary

from ros2_memory.analysis.frames import static_at, static_changes
from ros2_memory.catalogue.map_digest import Statics, statics_of
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import StampedTransform, TimeWindow
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, MIN_NS, Ns
from ros2_memory.history.transforms import sessions_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import BagFile, Transform
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline

Topics: TypeAlias = "tuple[str, ...]"
_Key: TypeAlias = "tuple[Topics, str | None]"
"""The topics of static transforms, and that of poses where it is not the configured one."""
_MOST_DECODED: Final = 1_024
"""Messages whose transforms stay in memory while guessing; mostly all have the same bytes."""


@dataclass(slots=True)
class _Gathered:
    """Static transforms of one folder's bags, in log-time order: its own, and carried ones."""

    own: list[StampedTransform] = field(default_factory=list)
    carried: list[tuple[StoredMessage, tuple[StampedTransform, ...]]] = field(default_factory=list)


@dataclass(slots=True)
class _SessionStatics:
    """The static transforms of a session in log-time order, and when one of them changed."""

    transforms: list[StampedTransform]
    changes: list[Ns]
    poses: str | None
    periods: dict[int, Statics] = field(default_factory=dict)

    def at(self, time: Ns) -> Statics:
        """Returns those in force at a moment."""
        number = bisect_right(self.changes, time + AT_OR_BEFORE_SLACK_NS)
        if number not in self.periods:
            since = self.changes[number - 1] if number else MIN_NS
            self.periods[number] = statics_of(static_at(self.transforms, since), self.poses)
        return self.periods[number]


_OF_SEGMENTS: Final[WeakKeyDictionary[Segment, dict[Topics, dict[str, _Gathered]]]] = (
    WeakKeyDictionary()
)


@dataclass(slots=True)
class _OfTimeline:
    """The static transforms of a timeline: a new bag makes a new one.

    Attributes:
        folders: the segments with static transforms of each folder.
        carried: the folders of carried messages.
        valid: what follows from digests.
        sessions: the static transforms of each session.
    """

    folders: dict[str, list[Segment]] | None = None
    carried: set[str] = field(default_factory=set)
    valid: WeakKeyDictionary[SegmentDigests, dict[str, int]] = field(
        default_factory=WeakKeyDictionary
    )
    sessions: dict[Session, _SessionStatics] = field(default_factory=dict)


_OF_TIMELINES: Final[WeakKeyDictionary[Timeline, dict[_Key, _OfTimeline]]] = WeakKeyDictionary()


class BagStatics:
    """The static transforms in force for each bag of a view, at the bag's end.

    Attributes:
        timeline: has the bags.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self.timeline = view.snapshot.timeline
        limits = view.memory.limits
        self._topics = limits.tf_static_topics
        self._poses = None if view.pose_topic == limits.pose_topic else view.pose_topic
        of_timeline = _OF_TIMELINES.setdefault(self.timeline, {})
        self._known = of_timeline.setdefault((self._topics, self._poses), _OfTimeline())
        self._complete: dict[str, _SessionStatics] = {}
        self._first: dict[tuple[Session, Path], list[StampedTransform]] = {}
        self._reader = _StaticReader(view)

    def of(self, bag: BagFile) -> Statics:
        """Returns the static transforms of a bag's session at its end."""
        folder = bag.file.rpartition("/")[0]  # a path for each bag takes longer than all else
        known = self._complete.get(folder)
        if known is not None:
            return known.at(bag.end)
        session = self._session_of(bag)
        if session is None:
            return statics_of((), self._poses)
        known = self._statics(session)
        if session == sessions_of(self._view).of(bag.recording):
            self._complete[folder] = known
        return known.at(bag.end)

    def guessed(self, bag: BagFile) -> Statics:
        """Returns what `of` would most likely return, without reading all bags of the session.

        That follows from the first messages of the session and of the bag's recording, from what
        was carried, and from the bag itself: nearly always they are all that there is.
        """
        session = self._session_of(bag)
        if session is None:
            return statics_of((), self._poses)
        known = self._known.sessions.get(session)
        if known is None:
            static = [*self._first_of(session, bag.recording), *self._read(bag)]
            static.sort(key=lambda each: each.log_time)
            known = _SessionStatics(static, static_changes(static), self._poses)
        return known.at(bag.end)

    def _session_of(self, bag: BagFile) -> Session | None:
        """Returns the session whose static transforms hold in a bag; None where none has any."""
        sessions = sessions_of(self._view)
        own = sessions.of(bag.recording)
        if sessions.has_all_kinds(own):
            return own
        return sessions.lending_to(bag.recording, bag.end) or None

    def _first_of(self, session: Session, recording: Path) -> Sequence[StampedTransform]:
        """Returns the static transforms that a session begins with, one of its recordings too.

        And those that were carried for it.
        """
        key = session, recording
        if key not in self._first:
            sessions = sessions_of(self._view)
            recordings = sessions.recordings_of(session, self._topics)
            recorded = {
                path: span[0]
                for path, span in recordings.items()
                if not sessions.holds_carried(path)
            }
            begins = {min(recorded, key=lambda path: recorded[path])} if recorded else set()
            begins |= {recording} & recorded.keys()
            bags = [bag for path in begins for bag in self._bags_at(path, recorded[path])]
            self._first[key] = [each for bag in bags for each in self._read(bag)]
            self._first[key] += self._carried_for(session)
        return self._first[key]

    def _bags_at(self, recording: Path, at: Ns) -> set[BagFile]:
        """Returns the bags of a recording with static transforms around a moment."""
        window = TimeWindow(at, at + 1)
        every = chain.from_iterable(self.timeline.extents(topic, window) for topic in self._topics)
        return {each.bag for each in every if each.bag.recording == recording}

    def _read(self, bag: BagFile) -> list[StampedTransform]:
        """Returns the static transforms in one bag."""
        topics = [topic for topic in self._topics if topic in bag.summary.schema.positions]
        found = self._view.bags.read(bag, topics, TimeWindow.everything()) if topics else ()
        return [each for message in found for each in self._reader.transforms(message)]

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
            folders = self._folders()
            static = [
                each
                for name in session
                for segment in folders.get(name, ())
                for each in self._gathered_in(segment, name).own
            ]
            static += self._carried_for(session)
            static.sort(key=lambda each: each.log_time)
            known = _SessionStatics(static, static_changes(static), self._poses)
            self._known.sessions[session] = known
        return known

    def _carried_for(self, session: Session) -> list[StampedTransform]:
        """Returns the static transforms that were carried of deleted bags of a session."""
        folders, sessions = self._folders(), sessions_of(self._view)
        return [
            each
            for name in self._known.carried
            for segment in folders[name]
            for found, transforms in self._gathered_in(segment, name).carried
            if sessions.has(session, found)
            for each in transforms
        ]

    def _folders(self) -> dict[str, list[Segment]]:
        """Returns the segments that hold static transforms of each folder."""
        if self._known.folders is None:
            sessions = sessions_of(self._view)
            found: dict[str, dict[Segment, None]] = {}
            for segment in self.timeline.segments:
                held = [topic for topic in self._topics if topic in segment.spans]
                bags = [bag for topic in held for bag in segment.bags_with(topic)]
                # By text: a path for each bag takes longer than all else.
                for bag in {bag.file.rpartition("/")[0]: bag for bag in bags}.values():
                    name = sessions.folder(bag.recording)
                    found.setdefault(name, {})[segment] = None
                    if sessions.is_carried(bag):
                        self._known.carried.add(name)
            self._known.folders = {name: [*segments] for name, segments in found.items()}
        return self._known.folders

    def _gathered_in(self, segment: Segment, folder: str) -> _Gathered:
        cache = _OF_SEGMENTS.setdefault(segment, {}).setdefault(self._topics, {})
        known = cache.get(folder)
        if known is None:
            before = self._view.notes.added
            found = _gather(self._view, segment, self._topics, folder, cache.keys())
            known = found.get(folder, _Gathered())
            if self._view.notes.added == before:
                cache.update(found)
        return known


def _gather(
    view: View, segment: Segment, topics: Topics, wanted: str, known: Collection[str]
) -> dict[str, _Gathered]:
    """Returns the static transforms of a folder, and of all others that need no reading."""
    sessions = sessions_of(view)
    gathered: dict[str, _Gathered] = {}
    unread = {*known}
    static = _StaticReader(view)
    folders: dict[str, tuple[str, bool]] = {}
    for topic in topics:
        for bag in segment.bags_with(topic) if topic in segment.spans else ():
            path = bag.file.rpartition("/")[0]
            if path not in folders:
                folders[path] = sessions.folder(bag.recording), sessions.is_carried(bag)
            folder, is_carried = folders[path]
            if folder != wanted:
                unread.add(folder)
            if folder in unread:
                continue
            messages = view.bags.read(bag, (topic,), TimeWindow.everything())
            of_folder = gathered.get(folder)
            if of_folder is None:
                of_folder = gathered[folder] = _Gathered()
            if is_carried:
                of_folder.carried += [(found, static.decoded(found)) for found in messages]
            else:
                of_folder.own += static.changed(folder, messages)
    return {name: each for name, each in gathered.items() if name not in unread}


class _StaticReader:
    """Reads the static transforms of messages, which are mostly the same bytes again."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._latest: dict[tuple[str, str], StampedTransform] = {}
        self._known: dict[tuple[str, str, bytes], tuple[StampedTransform, ...]] = {}

    def changed(self, folder: str, messages: Iterable[StoredMessage]) -> Iterator[StampedTransform]:
        """Yields the transforms of messages that differ from the latest ones of their folder."""
        for found in messages:
            channel = found.record.channel
            key = (channel.type, channel.encoding, found.record.payload)
            known = self._known.get(key)
            # The same bytes again, and nothing else in between, as in nearly every split.
            if known is not None and all(
                self._latest.get((folder, each.child)) is each for each in known
            ):
                continue
            # Another recording has the same ones at another time.
            self._known[key] = made = (
                self.decoded(found)
                if known is None
                else tuple([_at(each, found.time) for each in known])
            )
            for each in made:
                before = self._latest.get((folder, each.child))
                self._latest[folder, each.child] = each
                if before is None or _place(before) != _place(each):
                    yield each

    def transforms(self, found: StoredMessage) -> list[StampedTransform]:
        """Returns the transforms of a message; the same bytes are decoded once."""
        channel = found.record.channel
        key = (channel.type, channel.encoding, found.record.payload)
        known = self._known.get(key)
        if known is None:
            if len(self._known) >= _MOST_DECODED:
                self._known.clear()
            known = self._known[key] = self.decoded(found)
        return [_at(each, found.time) for each in known]

    def decoded(self, found: StoredMessage) -> tuple[StampedTransform, ...]:
        """Returns the transforms of a message; none where it cannot be decoded."""
        try:
            message = self._view.memory.reader.decode(found.record)
        except UndecodableError:
            return ()
        return self._view.memory.extractor.transforms(message, found.time, static=True)


def _at(each: StampedTransform, time: Ns) -> StampedTransform:
    # As `dataclasses.replace`, which takes ten times as long.
    return StampedTransform(each.parent, each.child, each.stamp, time, each.transform, each.static)


def _place(each: StampedTransform) -> tuple[str, Transform]:
    return each.parent, each.transform

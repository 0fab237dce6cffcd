"""Sessions: which recordings are of one robot in one run, so that their transforms belong together.

A transform holds in the session in which it was published: another robot, or the same one after a
restart, has its own. A session is a recording and those that it is joined with by handovers, and
what was carried of these when their bags were deleted.

Recordings of one time may be of one robot, for which two recorders were started. So a session with
moving transforms alone borrows the static ones of other frames from one that has these alone, and
one without any borrows from the one session beside it that has some. Nothing is lent where two
recordings hold poses at that time: these are two robots. Only a handover proves that two recordings
are of one robot, so a reply that uses borrowed transforms has to note it.
"""

from __future__ import annotations

from itertools import chain, combinations
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias
from weakref import proxy

from ros2_memory.bag_dir.layout import CARRY_FOLDER
from ros2_memory.bag_dir.moment_file import HardLinks
from ros2_memory.core.memo import Key
from ros2_memory.core.model import FrameEdge, StampedTransform, TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.retention.latched_carry import origin_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

Session: TypeAlias = frozenset[str]
"""The folders of its recordings, as they were named when they were recorded."""

_AROUND_NS: Final[Ns] = 10 * NS_PER_S
"""A recording covers a moment if one of its bags is this near: the length of tf2's cache."""


class _TransformSpans(NamedTuple):
    """What sessions follow from: folders, with the log times of their first and last messages.

    Attributes:
        kinds: those of moving and of static transforms.
        poses: those of the robot's own poses.
        joined: by folder, all that are joined with it by handovers.
    """

    kinds: tuple[Mapping[str, tuple[Ns, Ns]], Mapping[str, tuple[Ns, Ns]]]
    poses: Sequence[tuple[str, tuple[Ns, Ns]]]
    joined: Mapping[str, Session]


_RECORDED: Final[Key[_TransformSpans]] = Key()
"""Of a timeline: sidecars are read for it."""
_RECORDINGS: Final[Key[dict[tuple[str, ...], dict[str, dict[Path, tuple[Ns, Ns]]]]]] = Key()
"""Of a timeline: by topics, then by where they were recorded, the recordings that hold them."""
_LINKED: Final[Key[set[tuple[tuple[str, str], Session | None]]]] = Key()
"""Of a timeline: what one call found, the next need not look for."""


class Sessions:
    """The sessions of a view that hold transforms.

    Args:
        view: one call's view of the memory. Two sessions that hold the topic of the robot's own
            poses (`View.pose_topic`) at once are two robots.
        children: returns the child frames of all transforms of a session.

    Attributes:
        chosen: for a session with one that may lend to it and two frames, whose transforms hold.
        statics: the static transforms of sessions, as far as they are known.
        linked: frames that are known to be connected in a session, or in some.
        edges: every parent and child pair of all, once that is asked.
    """

    def __init__(self, view: View, children: Callable[[View, Session], set[str]]) -> None:
        # A view holds its sessions: so the arrays of a call are freed as it ends.
        self._view: View = proxy(view)
        self._children = children
        self._names = HardLinks(view.bag_dir)
        self._root = str(view.bag_dir).rstrip("/")
        self._carried = f"{self._root}/{CARRY_FOLDER}"
        self._spans = view.timeline.memo.of(_RECORDED, self._find_spans)
        self.chosen: dict[tuple[Session, Session, tuple[str, str]], Session] = {}
        self.statics: dict[Session, Sequence[StampedTransform]] = {}
        self.linked = view.timeline.memo.of(_LINKED, set)
        self.edges: tuple[FrameEdge, ...] | None = None
        self._parts: dict[Session, tuple[Session, Session]] = {}
        self._lending: dict[tuple[str, Ns], Session] = {}
        self._recordings = view.timeline.memo.of(_RECORDINGS, dict)

    def folder(self, recording: Path) -> str:
        """Returns where a recording was recorded; a saved moment keeps it elsewhere."""
        return self._names.recorded_as(str(recording))

    def recordings_of(
        self, session: Session, topics: tuple[str, ...]
    ) -> Mapping[Path, tuple[Ns, Ns]]:
        """Returns the recordings of a session that hold some topics.

        With the log times of the first and the last message of these.
        """
        if topics not in self._recordings:
            self._recordings[topics] = self._recordings_with(topics)
        by_folder = self._recordings[topics]
        held = (by_folder.get(folder, {}) for folder in sorted(session))
        return {path: span for recordings in held for path, span in recordings.items()}

    def _recordings_with(self, topics: Iterable[str]) -> dict[str, dict[Path, tuple[Ns, Ns]]]:
        """Returns the recordings that hold some topics, by where they were recorded."""
        by_folder: dict[str, dict[Path, tuple[Ns, Ns]]] = {}
        for topic in topics:
            for path, span in self._view.timeline.recordings(topic).items():
                there = by_folder.setdefault(self.folder(path), {})
                there[path] = enclosing((span, there.get(path, span)))
        return by_folder

    def has(self, session: Session, stored: StoredMessage) -> bool:
        """Whether a message is of a session; a carried one that names no recording is of each."""
        folder = self.folder(stored.bag.recording)
        if folder != self._carried:
            return folder in session
        origin = origin_of(stored.record.channel)
        if origin is None or session == {self._carried}:
            return True
        return any(f"{self._root}/{name}" in session for name in origin.recordings)

    def has_all_kinds(self, session: Session) -> bool:
        """Whether a session holds moving and static transforms: then it borrows none."""
        return len(self._kinds(session)) == len(self._spans.kinds)

    def holds_carried(self, recording: Path) -> bool:
        """Whether a recording is of carried messages."""
        return self.folder(recording) == self._carried

    def may_hold(self, session: Session, recording: Path) -> bool:
        """Whether messages of a recording may be of a session."""
        return self.holds_carried(recording) or self.folder(recording) in session

    def of(self, recording: Path) -> Session:
        """Returns the session of a recording."""
        return self._session_of(self.folder(recording))

    def are_joined(self, first: Path, other: Path) -> bool:
        """Whether two recordings are of one session."""
        if self.of(first) == self.of(other):
            return True
        joined_with = self._view.memory.index.joined_with
        return other.name in joined_with(first) or first.name in joined_with(other)

    def lending_to(self, recording: Path, at: Ns) -> Session:
        """Returns the session whose transforms hold for a message of a recording.

        That is more than the recording's own session where another one lends; empty where none has
        any.
        """
        folder = self.folder(recording)
        key = (folder, at // _AROUND_NS)
        if key not in self._lending:
            self._lending[key] = self._with_lender(self._session_of(folder), at)
        return self._lending[key]

    def recorded_at(self, moment: Ns) -> list[Session] | None:
        """Returns the sessions whose transforms hold at a moment; None if none was recorded."""
        around = self._around(moment)
        if not around:
            return None
        with_transforms = (session for session in around if self._kinds(session))
        return [*dict.fromkeys(self._with_lender(session, moment) for session in with_transforms)]

    def names(self, session: Session, at: Ns) -> str:
        """Returns the names of a session's recordings at a moment; of all if none went on."""
        recordings = sorted(session - {self._carried})
        around = [
            folder for folder in recordings if folder in self._folders_around(at)
        ] or recordings
        return " and ".join(folder.rpartition("/")[2] for folder in around) or "deleted recordings"

    def parts_of(self, session: Session) -> tuple[Session, ...]:
        """Returns the two sessions that were joined by lending into this one; none if it is one."""
        return self._parts.get(session, ())

    def nearest_to(self, moment: Ns) -> list[Session]:
        """Returns all sessions that hold transforms, the nearest in time first."""
        near = sorted(
            (_distance(span, moment), folder)
            for by_folder in self._spans.kinds
            for folder, span in by_folder.items()
        )
        return [*dict.fromkeys(self._session_of(folder) for _, folder in near)]

    def _with_lender(self, session: Session, at: Ns) -> Session:
        """Returns a session with the one that lends to it; empty where it has no transforms."""
        kinds = self._kinds(session)
        if self.has_all_kinds(session) or self._are_two_robots(at):
            return session if kinds else frozenset()
        beside = [other for other in self._around(at) if other != session and self._kinds(other)]
        if kinds:
            partners = [other for other in beside if self._are_complementary(session, other)]
        else:
            partners = [*dict.fromkeys(self._with_lender(other, at) for other in beside)]
        if len(partners) == 1:
            completed = session | partners[0]
            self._parts[completed] = session, partners[0]
            return completed
        return session if kinds else frozenset()

    def _are_two_robots(self, at: Ns) -> bool:
        """Whether two sessions near a moment hold poses of the same time."""
        poses = self._spans.poses
        near = [(folder, span) for folder, span in poses if _distance(span, at) <= _AROUND_NS]
        return any(
            max(first, begin) <= min(last, end)
            and self._session_of(first_folder) != self._session_of(other)
            for (first_folder, (first, last)), (other, (begin, end)) in combinations(near, 2)
        )

    def _are_complementary(self, first: Session, other: Session) -> bool:
        """Whether one has moving transforms alone, the other static ones alone, of other frames."""
        if self._kinds(first) & self._kinds(other):
            return False
        return self._children(self._view, first).isdisjoint(self._children(self._view, other))

    def _kinds(self, session: Session) -> frozenset[int]:
        """Returns which kinds of transforms a session holds; carried ones count as its own."""
        kinds = enumerate(self._spans.kinds)
        return frozenset(kind for kind, spans in kinds if session & spans.keys())

    def _around(self, moment: Ns) -> list[Session]:
        """Returns the sessions that were being recorded at a moment."""
        return [*dict.fromkeys(map(self._session_of, sorted(self._folders_around(moment))))]

    def _folders_around(self, moment: Ns) -> set[str]:
        """Returns the folders of the recordings that went on at a moment."""
        bags = self._view.timeline.overlapping(TimeWindow.around(moment, _AROUND_NS))
        return {self.folder(bag.recording) for bag in bags} - {self._carried}

    def _session_of(self, folder: str) -> Session:
        if folder == self._carried:
            return frozenset({folder})
        return self._spans.joined.get(folder) or frozenset({folder, self._carried})

    def _spans_of(self, topics: Iterable[str]) -> dict[str, tuple[Ns, Ns]]:
        """Returns the log times of the first and the last message of some topics, by folder."""
        by_folder = self._recordings_with(topics)
        return {folder: enclosing(spans.values()) for folder, spans in by_folder.items()}

    def _find_spans(self) -> _TransformSpans:
        limits, pose_topic = self._view.limits, self._view.pose_topic
        topics = (*limits.tf_topics, *limits.tf_static_topics, pose_topic)
        recordings = map(self._view.timeline.recordings, topics)
        paths = {self.folder(path): path for path in chain.from_iterable(recordings)}
        chains = components(
            (folder, f"{folder.rpartition('/')[0]}/{name}")
            for folder, path in (paths.items() if len(paths) > 1 else ())
            for name in self._view.memory.index.joined_with(path)
        )
        return _TransformSpans(
            (self._spans_of(limits.tf_topics), self._spans_of(limits.tf_static_topics)),
            [*self._spans_of((pose_topic,)).items()],
            {folder: frozenset(linked | {self._carried}) for folder, linked in chains.items()},
        )


def components(pairs: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """Returns, by node of an undirected graph, all that are connected with it, itself included."""
    component: dict[str, set[str]] = {}
    for first, other in pairs:
        ends = [component.setdefault(node, {node}) for node in (first, other)]
        small, large = sorted(ends, key=len)
        if small is not large:
            large |= small
            component.update(dict.fromkeys(small, large))
    return component


def enclosing(spans: Iterable[tuple[Ns, Ns]]) -> tuple[Ns, Ns]:
    """Returns the earliest begin and the latest end of spans, of which there is one at least."""
    firsts, lasts = zip(*spans, strict=True)
    return min(firsts), max(lasts)


def _distance(span: tuple[Ns, Ns], moment: Ns) -> Ns:
    """Returns how far a moment is from a span of time."""
    first, last = span
    return max(first - moment, moment - last, 0)

"""Sessions: which recordings are of one robot in one run, and the transforms that they hold.

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

from collections import defaultdict
from functools import cached_property
from itertools import chain, combinations
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias
from weakref import proxy

import numpy as np

from ros2_memory.analysis.frames import is_edge
from ros2_memory.bag_dir.layout import CARRY_FOLDER
from ros2_memory.bag_dir.moment_file import HardLinks
from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.store import relative
from ros2_memory.columns.transforms import STATICS, Pair, Statics, pairs_in, static_times
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.memo import Key
from ros2_memory.core.model import FrameEdge, StampedTransform, TimeWindow
from ros2_memory.core.spans import enclosing
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, NS_PER_S, Ns, Span
from ros2_memory.history.context import READING_S, Note
from ros2_memory.history.scan import (
    joined_back,
    messages_of,
    of_columns,
    open_scan,
    remembered,
    scan,
)
from ros2_memory.index.segment import TopicExtent, wider
from ros2_memory.retention.latched_carry import origin_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.columns.scan import Scan, Stretch
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View

Session: TypeAlias = frozenset[str]
"""The folders of its recordings, as they were named when they were recorded."""

_AROUND_NS: Final = 10 * NS_PER_S
"""A recording covers a moment if one of its bags is this near: the length of tf2's cache."""
_FEW_SESSIONS: Final = 4
"""Sessions of which static transforms are looked up one by one."""
_UNDECODED: Final = Reason("could not be decoded", "topic", of="messages of ")


class _TransformSpans(NamedTuple):
    """What sessions follow from: folders, with the log times of their first and last messages.

    Attributes:
        kinds: those of moving and of static transforms.
        poses: those of the robot's own poses.
        joined: by folder, all that are joined with it by handovers.
    """

    kinds: tuple[Mapping[str, Span], Mapping[str, Span]]
    poses: Sequence[tuple[str, Span]]
    joined: Mapping[str, Session]


_RECORDED: Final[Key[_TransformSpans]] = Key()
"""Of a timeline: sidecars are read for it."""
_RECORDINGS: Final[Key[dict[tuple[str, ...], dict[str, dict[Path, Span]]]]] = Key()
"""Of a timeline: by topics, then by where they were recorded, the recordings that hold them."""
_LINKED: Final[Key[set[tuple[tuple[str, str], Session | None]]]] = Key()
"""Of a timeline: what one call found, the next need not look for."""


class Sessions:
    """The sessions of a view that hold transforms, and these.

    Args:
        view: one call's view of the memory. Two sessions that hold the topic of the robot's own
            poses (`View.pose_topic`) at once are two robots.

    Attributes:
        chosen: for a session with one that may lend to it and two frames, whose transforms hold.
        linked: frames that are known to be connected in a session, or in some.
        parts: by a session that is joined by lending, the two that it is of.
    """

    def __init__(self, view: View) -> None:
        # A view holds its sessions: so the arrays of a call are freed as it ends.
        self._view: View = proxy(view)
        self._names = HardLinks(view.bag_dir)
        self._root = str(view.bag_dir).rstrip("/")
        self._carried = f"{self._root}/{CARRY_FOLDER}"
        self._recordings = view.timeline.memo.of(_RECORDINGS, dict)
        self._spans = view.timeline.memo.of(_RECORDED, self._find_spans)
        self._static: dict[Session, Sequence[StampedTransform]] = {}
        self._lending: dict[tuple[str, Ns], Session] = {}
        self.chosen: dict[tuple[Session, Session, tuple[str, str]], Session] = {}
        self.linked = view.timeline.memo.of(_LINKED, set)
        self.parts: dict[Session, tuple[Session, Session]] = {}

    def folder(self, recording: Path) -> str:
        """Returns where a recording was recorded; a saved moment keeps it elsewhere."""
        return self._names.recorded_as(str(recording))

    def recordings_of(self, session: Session, topics: tuple[str, ...]) -> Mapping[Path, Span]:
        """Returns the recordings of a session that hold some topics.

        With the log times of the first and the last message of these.
        """
        if topics not in self._recordings:
            self._recordings[topics] = self._recordings_with(topics)
        by_folder = self._recordings[topics]
        held = (by_folder.get(folder, {}) for folder in sorted(session))
        return {path: span for recordings in held for path, span in recordings.items()}

    def _recordings_with(self, topics: Iterable[str]) -> dict[str, dict[Path, Span]]:
        """Returns the recordings that hold some topics, by where they were recorded."""
        by_folder: dict[str, dict[Path, Span]] = {}
        for topic in topics:
            for path, span in self._view.timeline.recordings(topic).items():
                there = by_folder.setdefault(self.folder(path), {})
                there[path] = wider(there.get(path), span)
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
        if (folder, at) not in self._lending:
            self._lending[folder, at] = self._with_lender(self._session_of(folder), at)
        return self._lending[folder, at]

    def recorded_at(self, moment: Ns) -> list[list[Session]] | None:
        """Returns the sessions whose transforms hold at a moment; None if none was recorded.

        In groups, of which those of the first count that has an answer: the sessions that went on
        then; those that had ended or not begun yet, by `_AROUND_NS` at most. What had ended comes
        before what had not begun, and what is nearer before what is farther.
        """
        around = self._around(moment)
        if not around:
            return None
        apart = {each: _apart(span, moment) for each, span in around.items() if self._kinds(each)}
        nearest = sorted(apart, key=lambda session: apart[session])
        then = dict.fromkeys(self._with_lender(s, moment) for s in nearest if not any(apart[s]))
        beside = dict.fromkeys(self._with_lender(s, moment) for s in nearest if any(apart[s]))
        groups = [*then], [each for each in beside if each not in then]
        return [group for group in groups if group]

    def names(self, session: Session, at: Ns) -> str:
        """Returns the names of a session's recordings at a moment; of all if none went on."""
        recordings = sorted(session - {self._carried})
        around = [
            folder for folder in recordings if folder in self._folders_around(at)
        ] or recordings
        return " and ".join(folder.rpartition("/")[2] for folder in around) or "deleted recordings"

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
            self.parts[completed] = session, partners[0]
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
        topics = (*self._view.moving_topics, *self._view.static_topics)
        frames, others = (
            {child for _, child in self.pairs(topics, session)} for session in (first, other)
        )
        return frames.isdisjoint(others)

    def _kinds(self, session: Session) -> frozenset[int]:
        """Returns which kinds of transforms a session holds; carried ones count as its own."""
        kinds = enumerate(self._spans.kinds)
        return frozenset(kind for kind, spans in kinds if session & spans.keys())

    def _around(self, moment: Ns) -> dict[Session, Span]:
        """Returns the sessions that were being recorded around a moment.

        With the log times of the first and the last message of their bags that are near.
        """
        around: dict[Session, Span] = {}
        for folder, span in sorted(self._folders_around(moment).items()):
            session = self._session_of(folder)
            around[session] = wider(around.get(session), span)
        return around

    def _folders_around(self, moment: Ns) -> dict[str, Span]:
        """Returns the folders of the recordings that went on around a moment; see `_around`."""
        spans: dict[str, Span] = {}
        for bag in self._view.timeline.overlapping(TimeWindow.around(moment, _AROUND_NS)):
            folder = self.folder(bag.recording)
            spans[folder] = wider(spans.get(folder), (bag.start, bag.end))
        spans.pop(self._carried, None)
        return spans

    def _session_of(self, folder: str) -> Session:
        if folder == self._carried:
            return frozenset({folder})
        return self._spans.joined.get(folder) or frozenset({folder, self._carried})

    def _spans_of(self, topics: Iterable[str]) -> dict[str, Span]:
        """Returns the log times of the first and the last message of some topics, by folder."""
        by_folder = self._recordings_with(topics)
        return {folder: enclosing(spans.values()) for folder, spans in by_folder.items()}

    def _find_spans(self) -> _TransformSpans:
        view = self._view
        topics = (*view.moving_topics, *view.static_topics, view.pose_topic)
        recordings = map(view.timeline.recordings, topics)
        paths = {self.folder(path): path for path in chain.from_iterable(recordings)}
        chains = components(
            (folder, f"{folder.rpartition('/')[0]}/{name}")
            for folder, path in (paths.items() if len(paths) > 1 else ())
            if str(path) in view.timeline.handed_over
            for name in view.memory.index.joined_with(path)
        )
        return _TransformSpans(
            (self._spans_of(view.moving_topics), self._spans_of(view.static_topics)),
            [*self._spans_of((view.pose_topic,)).items()],
            {folder: frozenset(linked | {self._carried}) for folder, linked in chains.items()},
        )

    def bags_of(
        self, session: Session, topics: tuple[str, ...], window: TimeWindow
    ) -> list[TopicExtent]:
        """Returns the bags of a session that hold messages of some topics in a window."""
        # A session is mostly some minutes of a week, whose bags are many.
        part = window.intersect(self._span_of(session, topics))
        chosen = self.recordings_of(session, topics)
        bags = self._view.stream.overlapping_bags(topics, part)
        return [span for span in bags if span.bag.recording in chosen]

    def newest(self, topic: str, window: TimeWindow, recording: Path) -> StoredMessage | None:
        """Returns the newest message of a topic in a window, from the session of a recording.

        From any session where that one has no message of the topic at all.
        """
        newest, session = self._view.stream.newest(topic, window), self.of(recording)
        if not self.recordings_of(session, (topic,)):
            return newest
        bags = self.bags_of(session, (topic,), window)
        if newest is not None and newest.bag in {span.bag for span in bags}:
            return newest
        merged = self._view.stream.merged(bags, [topic], window, newest_first=True)
        return next(self._view.bags.track_sources(merged), None)

    def moving(self, session: Session, window: TimeWindow) -> list[StampedTransform]:
        """Returns the moving transforms that a session received in a window, in log-time order."""
        stream, topics = self._view.stream, self._view.moving_topics
        bags = self.bags_of(session, topics, window)
        merged = stream.merged(bags, topics, window)
        tracked = self._view.bags.track_sources(merged)
        of_session = (stored for stored in tracked if self.has(session, stored))
        return [*decoded_transforms(self._view, of_session)]

    def received(self, session: Session | None, rows: Rows) -> Iterator[StampedTransform]:
        """Yields the transforms in some rows that are of a session; None: of any."""
        messages = messages_of(self._view, rows)
        if session is not None:
            messages = (stored for stored in messages if self.has(session, stored))
        return decoded_transforms(self._view, messages)

    def static(self, session: Session) -> Sequence[StampedTransform]:
        """Returns the static transforms of a session, in log-time order.

        One that is equal to the one before of its child is left out: each split may have all again.
        So few messages of a part are read: those by whose columns something is new.

        Raises:
            QueryTimeoutError: the call's time is over.
        """
        view, caches = self._view, self._view.memory.scanner.caches
        if session not in self._static:
            timeline, known = caches.statics.get(view.static_topics) or (None, {})
            if timeline is not view.timeline:
                known = {}
            self._static |= known
            if session not in known:
                self._static |= self._with_static(session, known)
        return self._static[session]

    def _with_static(
        self, session: Session, known: Mapping[Session, Sequence[StampedTransform]]
    ) -> Mapping[Session, Sequence[StampedTransform]]:
        """Returns the static transforms of one more session; for many, of all."""
        view, before = self._view, self._view.notes.added
        if len(self._static) == _FEW_SESSIONS and not view.call.stored:
            # Who has asked for so many asks for more, also where nothing of it is remembered.
            known = {**self._all_static(), **known}
            self._static.update(known)
        if session not in known:
            received = (self._static_received(topic, session) for topic in view.static_topics)
            known = {**known, session: _without_repeats(chain.from_iterable(received))}
        # What was noted must be noted in each answer.
        if view.notes.added == before and not view.call.used_active:
            size = 300 * len(known) + 500 * sum(map(len, known.values()))
            view.memory.scanner.caches.statics.put(view.static_topics, (view.timeline, known), size)
        return known

    def _all_static(self) -> dict[Session, Sequence[StampedTransform]]:
        """Returns those of all sessions that are stored, unless some are carried."""
        view = self._view
        coverage = view.memory.scanner.coverage(view.timeline)
        recordings = chain.from_iterable(map(view.timeline.recordings, view.static_topics))
        if coverage is None or any(map(self.holds_carried, recordings)):
            return {}
        received: dict[Session, list[StampedTransform]] = defaultdict(list)
        for statics in self.static_back(TimeWindow.everything()):
            received[self.of(view.bag_dir / statics.recording)] += statics.transforms
        for recording in {bag.recording for bag in coverage.missing}:
            received.pop(self.of(recording), None)
        return {session: _without_repeats(found) for session, found in received.items()}

    def static_back(self, window: TimeWindow) -> Iterator[Statics]:
        """Yields the static transforms of the parts in a window, of bags that are stored."""
        for topic in self._view.static_topics:
            opened = open_scan(self._view, topic, window, copies=True, stored=True)

            def make(stretch: Stretch, opened: Scan = opened) -> Iterator[tuple[Ns, Statics]]:
                for rows in opened.rows(newest_first=True, among=stretch.window):
                    if stretch.window.contains(max(rows.first, window.start)):
                        yield rows.first, self._static_changes(rows)

            for _, statics in joined_back(self._view, opened, STATICS, make):
                yield statics

    def _static_received(self, topic: str, session: Session) -> Iterator[StampedTransform]:
        """Yields static transforms of a topic; of equal ones that follow in a part the first."""
        for rows in scan(self._view, topic, self._span_of(session, (topic,)), copies=True):
            if self.holds_carried(rows.recording):
                yield from self.received(session, rows)
            elif self.folder(rows.recording) in session:
                yield from self._static_changes(rows).transforms

    def _static_changes(self, rows: Rows) -> Statics:
        """Returns the static transforms in some rows that differ from those before, as received."""

        def make() -> Statics:
            times = static_times(rows.table, rows.times, rows.index)
            new = rows if times is None else rows.some(np.flatnonzero(np.isin(rows.times, times)))
            changes = _without_repeats(self.received(None, new))
            return Statics(relative(str(rows.recording), str(self._view.bag_dir)), tuple(changes))

        key = None if rows.part is None else FragmentKey(rows.first, "", (rows.part,))
        return remembered(self._view, STATICS, key, make)

    def _span_of(self, session: Session, topics: tuple[str, ...]) -> TimeWindow:
        """Returns when a session has some topics: mostly some hours of a week."""
        spans = self.recordings_of(session, topics).values()
        if not spans:
            return TimeWindow(0, 0)
        first, last = enclosing(spans)
        return TimeWindow(first, last + 1)

    @cached_property
    def edges(self) -> tuple[FrameEdge, ...]:
        """Every parent and child pair that was recorded, sorted; `static` where published so.

        A pair that was published in both directions appears once, as moving. A pair with an unnamed
        frame is invalid in tf2, and is left out with a note; so are those that only bags have for
        which there was no time.
        """
        view = self._view
        reading = view.call.partial_after(READING_S)
        pairs = dict.fromkeys(self.pairs(view.static_topics), True)
        for topic in view.moving_topics:
            for found in self.pairs_back(topic, None):
                pairs |= dict.fromkeys(found, False)
                if reading.expired():
                    view.notes.add_lack("out of time: frames that only older bags have are missing")
                    break
        edges = [
            FrameEdge(*pair, is_static)
            for pair, is_static in sorted(pairs.items())
            if is_edge(pair)
        ]
        if len(edges) < len(pairs):
            view.notes.add(f"pairs left out, since a frame has no name: {len(pairs) - len(edges)}")
        return tuple(edges)

    def pairs(self, topics: Iterable[str], session: Session | None = None) -> set[Pair]:
        """Returns the pairs of these topics; with a `session` those that it received."""
        pair_sets = (self.pairs_back(topic, session) for topic in topics)
        return set[Pair]().union(*chain.from_iterable(pair_sets))

    def pairs_back(
        self, topic: str, session: Session | None, window: TimeWindow | None = None
    ) -> Iterator[frozenset[Pair]]:
        """Yields the pairs of a topic (in a window), table by table, those of the newest first."""
        window = TimeWindow.everything() if window is None else window
        if session is not None:
            window = window.intersect(self._span_of(session, (topic,)))
        for rows in scan(
            self._view, topic, window, newest_first=True, copies=True, may_be_empty=True
        ):
            if session is None or self.may_hold(session, rows.recording):
                yield self._pairs_in(rows, session if self.holds_carried(rows.recording) else None)

    def _pairs_in(self, rows: Rows, session: Session | None) -> frozenset[Pair]:
        """Returns the pairs in some rows; with a `session` those that are of it."""
        view, known_pairs = self._view, self._view.memory.scanner.caches.pairs
        part = rows.part if session is None else None
        pairs = None if part is None else known_pairs.get(part)
        if pairs is not None:
            return pairs
        before, by_columns = view.notes.added, None
        if session is None:
            by_columns = of_columns(view, rows, lambda some: pairs_in(some.table, some.index))
        if by_columns is None:
            received = self.received(session, rows)
            pairs = frozenset((transform.parent, transform.child) for transform in received)
        else:
            pairs = frozenset[Pair]().union(*by_columns)
        if part is not None and view.notes.added == before:
            known_pairs.put(part, pairs, 200 + 200 * len(pairs))
        return pairs


def decoded_transforms(view: View, messages: Iterable[StoredMessage]) -> Iterator[StampedTransform]:
    """Yields the transforms of messages; a note names the topics that cannot be decoded."""
    for stored in messages:
        is_static = stored.topic in view.limits.tf_static_topics
        with view.call.stages.timed("extract"):
            try:
                message = view.memory.reader.decode(stored.record)
                transforms = view.extractor.transforms(message, stored.time, static=is_static)
            except UndecodableError as error:
                view.notes.add_lack(Note(_UNDECODED, error.topic, error.reason))
                continue
        yield from transforms


def _without_repeats(static: Iterable[StampedTransform]) -> list[StampedTransform]:
    """Returns transforms by log time without those equal to the one before of their child."""
    latest: dict[str, StampedTransform] = {}
    changes: list[StampedTransform] = []
    for transform in sorted(static, key=lambda transform: transform.log_time):
        child = transform.child.lstrip("/")
        last = latest.get(child)
        if last is None or (last.parent, last.transform) != (transform.parent, transform.transform):
            latest[child] = transform
            changes.append(transform)
    return changes


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


def _apart(span: Span, moment: Ns) -> Span:
    """Returns how long a moment is before the begin of a span of time, and after its end."""
    first, last = span
    before, after = first - moment, moment - last
    return max(before - AT_OR_BEFORE_SLACK_NS, 0), max(after - AT_OR_BEFORE_SLACK_NS, 0)


def _distance(span: Span, moment: Ns) -> Ns:
    """Returns how far a moment is from a span of time."""
    first, last = span
    return max(first - moment, moment - last, 0)

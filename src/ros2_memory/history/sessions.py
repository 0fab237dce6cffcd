"""Sessions: which recordings are of one robot in one run, and the transforms that they hold.

A transform holds in its own session: another robot, or the same one after a restart, publishes its
own. A session is a recording, the recordings that handovers join with it, and what was carried of
these when their bags were deleted.

Two recorders may record one robot at the same time. So a session with only moving transforms
borrows the static ones of a session with only static ones, of other frames; and a session without
transforms borrows from the one session at its time that has some. Nothing is lent if two recordings
hold poses at that time: these are two robots. Only a handover proves that two recordings are of one
robot, so a reply that uses borrowed transforms notes it.
"""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property
from itertools import chain, combinations
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias
from weakref import proxy

from ros2_memory.analysis.frames import TF_CACHE_NS, is_edge, without_repeats
from ros2_memory.bag_dir.layout import CARRY_FOLDER, is_thinned, recorded_as
from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.store import relative
from ros2_memory.columns.transforms import (
    PAIRS,
    STATICS,
    Pair,
    Pairs,
    Statics,
    changing_rows,
    pairs_in,
)
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.memo import Key
from ros2_memory.core.model import FrameEdge, StampedTransform, TimeWindow
from ros2_memory.core.spans import enclosing
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, NS_PER_S, Ns, Span
from ros2_memory.history.context import READING_S, UNDECODED, Note
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

    from ros2_memory.columns.scan import Scan, Stretch
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View

Session: TypeAlias = frozenset[str]
"""The folders of its recordings, by their names when they were recorded."""

_MessageKey: TypeAlias = tuple[str, Ns, Ns, int]
"""Topic, log time and identity of a message."""
_BETWEEN_THINNED_NS: Final[Ns] = NS_PER_S
_MOST_DECODED: Final = 500
"""After so many messages with moving transforms, those of the newest lookup alone are kept."""
_FEW_SESSIONS: Final = 4
"""After this many sessions, the static transforms of all are looked up at once."""


class _TransformSpans(NamedTuple):
    """What sessions follow from. A span has the log times of the first and last message.

    Attributes:
        kinds: by folder, the span of its moving transforms; the same of its static ones.
        poses: by folder, the span of the robot's own poses.
        joined: by folder, the folders that handovers join with it.
    """

    kinds: tuple[Mapping[str, Span], Mapping[str, Span]]
    poses: Mapping[str, Span]
    joined: Mapping[str, Session]


_RECORDED: Final[Key[_TransformSpans]] = Key()
"""Of a timeline: sidecar files are read for it."""
_RECORDINGS: Final[Key[dict[tuple[str, ...], dict[str, dict[Path, Span]]]]] = Key()
"""Of a timeline: by topics, then by folder, the recordings that hold them, with their spans."""
_LINKED: Final[Key[set[tuple[tuple[str, str], Session | None]]]] = Key()
"""Of a timeline: `Sessions.linked`, so that the next call need not search again."""


class Sessions:
    """The sessions of a view, and their transforms.

    Args:
        view: one call's view of the memory. Two sessions that hold the topic of the robot's own
            poses (`View.pose_topic`) at once are two robots.

    Attributes:
        chosen: by session with lender, own session and two frames, the one whose transforms hold.
        linked: pairs of frames that are connected in a session; with None, in any session.
        parts: by session with its lender, the two sessions.
    """

    def __init__(self, view: View) -> None:
        # The view refers to its sessions: without a circle, its arrays are freed as the call ends.
        self._view: View = proxy(view)
        self._root = str(view.bag_dir).rstrip("/")
        self._carried = f"{self._root}/{CARRY_FOLDER}"
        self._recordings = view.timeline.memo.of(_RECORDINGS, dict)
        self._spans = view.timeline.memo.of(_RECORDED, self._find_spans)
        self._static: dict[Session, Sequence[StampedTransform]] = {}
        # Of the newest lookups: the next one is often at nearly the same time.
        self._moving: dict[_MessageKey, Sequence[StampedTransform]] = {}
        self._looked_up = 0  # sessions whose static transforms were not cached
        self._lending: dict[tuple[str, Ns], Session] = {}
        self.chosen: dict[tuple[Session, Session, tuple[str, str]], Session] = {}
        self.linked = view.timeline.memo.of(_LINKED, set)
        self.parts: dict[Session, tuple[Session, Session]] = {}

    def folder(self, recording: Path) -> str:
        """Returns the folder in which a recording was made; a saved moment keeps it elsewhere."""
        return recorded_as(self._view.bag_dir, str(recording))

    def recordings_of(self, session: Session, topics: tuple[str, ...]) -> Mapping[Path, Span]:
        """Returns the recordings of a session that hold some topics.

        With the log times of the first and last message of these topics.
        """
        by_folder = self._recordings_with(topics)
        recordings: dict[Path, Span] = {}
        for folder in sorted(session):
            recordings |= by_folder.get(folder, {})
        return recordings

    def _recordings_with(self, topics: tuple[str, ...]) -> Mapping[str, Mapping[Path, Span]]:
        """Returns by folder the recordings that hold some topics, as `recordings_of`."""
        if topics not in self._recordings:
            by_folder: dict[str, dict[Path, Span]] = {}
            for topic in topics:
                for path, span in self._view.timeline.recordings(topic).items():
                    in_folder = by_folder.setdefault(self.folder(path), {})
                    in_folder[path] = wider(in_folder.get(path), span)
            self._recordings[topics] = by_folder
        return self._recordings[topics]

    def has(self, session: Session, stored: StoredMessage) -> bool:
        """Whether a message is of a session. A carried one without an origin is of each."""
        folder = self.folder(stored.recording)
        if folder != self._carried:
            return folder in session
        origin = origin_of(stored.record.channel)
        if origin is None or session == {self._carried}:
            return True
        return any(f"{self._root}/{name}" in session for name in origin.recordings)

    def has_all_kinds(self, session: Session) -> bool:
        """Whether a session holds moving and static transforms, and so borrows none."""
        return len(self._kinds(session)) == len(self._spans.kinds)

    def holds_carried(self, recording: Path) -> bool:
        """Whether a recording consists of carried messages."""
        return self.folder(recording) == self._carried

    def may_hold(self, session: Session, recording: Path) -> bool:
        """Whether messages of a recording may be of a session."""
        return self.holds_carried(recording) or self.folder(recording) in session

    def session_of(self, recording: Path) -> Session:
        """Returns the session of a recording."""
        return self._session_of_folder(self.folder(recording))

    def are_joined(self, first: Path, other: Path) -> bool:
        """Whether two recordings are of one session."""
        return self.session_of(first) == self.session_of(other)

    def lending_to(self, recording: Path, at: Ns) -> Session:
        """Returns the session whose transforms hold for messages of a recording at a moment.

        With another session, if that lends to the recording's own one. Empty without transforms.
        """
        folder = self.folder(recording)
        if (folder, at) not in self._lending:
            self._lending[folder, at] = self._with_lender(self._session_of_folder(folder), at)
        return self._lending[folder, at]

    def recorded_at(self, moment: Ns) -> list[list[Session]] | None:
        """Returns the sessions whose transforms hold at a moment; None if nothing was recorded.

        In two groups, of which the first that has an answer counts: the sessions that went on then,
        and those that ended or began within `TF_CACHE_NS` of it. In the latter, ended sessions come
        before those that had not begun, and the nearest come first.
        """
        around = self._around(moment)
        if not around:
            return None
        apart = {
            session: _time_before_and_after(span, moment)
            for session, span in around.items()
            if self._kinds(session)
        }
        then: list[Session] = []
        beside: list[Session] = []
        for session in sorted(apart, key=apart.__getitem__):
            group = beside if any(apart[session]) else then
            holding = self._with_lender(session, moment)
            if holding not in then and holding not in beside:
                group.append(holding)
        return [group for group in (then, beside) if group]

    def names(self, session: Session, at: Ns) -> str:
        """Returns the names of a session's recordings around a moment; of all if none is there."""
        folders = sorted(session - {self._carried})
        folders = [folder for folder in folders if folder in self._folders_around(at)] or folders
        return " and ".join(folder.rpartition("/")[2] for folder in folders) or "deleted recordings"

    def nearest_to(self, moment: Ns) -> list[Session]:
        """Returns all sessions with transforms, the nearest in time first."""
        near = sorted(
            (_distance(span, moment), folder)
            for by_folder in self._spans.kinds
            for folder, span in by_folder.items()
        )
        return [*dict.fromkeys(self._session_of_folder(folder) for _, folder in near)]

    def _with_lender(self, session: Session, at: Ns) -> Session:
        """Returns a session joined with its only lender, if it has one.

        Else the session itself; empty if it has no transforms.
        """
        kinds = self._kinds(session)
        lenders: list[Session] = []
        if not self.has_all_kinds(session) and not self._are_two_robots(at):
            beside = [other for other in self._around(at) if other != session]
            beside = [other for other in beside if self._kinds(other)]
            if kinds:
                lenders = [other for other in beside if self._are_complementary(session, other)]
            else:
                lenders = [*dict.fromkeys(self._with_lender(other, at) for other in beside)]
        if len(lenders) == 1:
            joined = session | lenders[0]
            self.parts[joined] = session, lenders[0]
            return joined
        return session if kinds else frozenset()

    def _are_two_robots(self, at: Ns) -> bool:
        """Whether two sessions hold poses at the same time, near a moment."""
        near = [
            (folder, span)
            for folder, span in self._spans.poses.items()
            if _distance(span, at) <= TF_CACHE_NS
        ]
        for (folder, (first, last)), (other, (begin, end)) in combinations(near, 2):
            overlap = max(first, begin) <= min(last, end)
            if overlap and self._session_of_folder(folder) != self._session_of_folder(other):
                return True
        return False

    def _are_complementary(self, first: Session, other: Session) -> bool:
        """Whether one session has only moving transforms, the other only static ones.

        And of other frames.
        """
        if self._kinds(first) & self._kinds(other):
            return False
        return self._children(first).isdisjoint(self._children(other))

    def _children(self, session: Session) -> set[str]:
        """Returns the frames that transforms of a session place."""
        children: set[str] = set()
        for topic in (*self._view.moving_topics, *self._view.static_topics):
            for _, pairs in self.pairs_back(topic, session):
                children.update(child for _, child in pairs)
        return children

    def _kinds(self, session: Session) -> frozenset[int]:
        """Returns the positions in `_TransformSpans.kinds` of the kinds that a session has."""
        kinds = enumerate(self._spans.kinds)
        return frozenset(kind for kind, spans in kinds if session & spans.keys())

    def _around(self, moment: Ns) -> dict[Session, Span]:
        """Returns the sessions that were recorded around a moment, with the span of their bags."""
        around: dict[Session, Span] = {}
        for folder, span in sorted(self._folders_around(moment).items()):
            session = self._session_of_folder(folder)
            around[session] = wider(around.get(session), span)
        return around

    def _folders_around(self, moment: Ns) -> dict[str, Span]:
        """Returns the recordings with bags within `TF_CACHE_NS` of a moment, by folder.

        With the first and last log time in these bags.
        """
        spans: dict[str, Span] = {}
        for bag in self._view.timeline.overlapping(TimeWindow.around(moment, TF_CACHE_NS)):
            folder = self.folder(bag.recording)
            spans[folder] = wider(spans.get(folder), (bag.start, bag.end))
        spans.pop(self._carried, None)
        return spans

    def _session_of_folder(self, folder: str) -> Session:
        if folder == self._carried:
            return frozenset({folder})
        return self._spans.joined.get(folder) or frozenset({folder, self._carried})

    def _spans_of(self, topics: tuple[str, ...]) -> dict[str, Span]:
        """Returns by folder the first and last log time of some topics."""
        by_folder = self._recordings_with(topics)
        return {folder: enclosing(spans.values()) for folder, spans in by_folder.items()}

    def _find_spans(self) -> _TransformSpans:
        view = self._view
        handovers: list[tuple[str, str]] = []
        for path in map(Path, view.timeline.handed_over):
            folder = self.folder(path)
            parent, _, _ = folder.rpartition("/")
            names = view.memory.index.joined_with(path)
            handovers += [(folder, f"{parent}/{name}") for name in names]
        chains = components(handovers)
        return _TransformSpans(
            (self._spans_of(view.moving_topics), self._spans_of(view.static_topics)),
            self._spans_of((view.pose_topic,)),
            {folder: frozenset(linked | {self._carried}) for folder, linked in chains.items()},
        )

    def bags_of(
        self, session: Session, topics: tuple[str, ...], window: TimeWindow
    ) -> list[TopicExtent]:
        """Returns the bags of a session that hold messages of some topics in a window."""
        # A week has many bags, and a session mostly lasts some hours.
        part = window.intersect(self._window_of(session, topics))
        recordings = self.recordings_of(session, topics)
        extents = self._view.stream.overlapping_bags(topics, part)
        return [extent for extent in extents if extent.bag.recording in recordings]

    def newest(self, topic: str, window: TimeWindow, recording: Path) -> StoredMessage | None:
        """Returns the newest message of a topic in a window from the session of a recording.

        From any session, if that one has no message of the topic at all. A thinned day stands for
        deleted bags of the session: its message counts where the session's own is older by more
        than a second, which is how often a day has one.
        """
        newest, session = self._view.stream.newest(topic, window), self.session_of(recording)
        if not self.recordings_of(session, (topic,)):
            return newest
        extents = self.bags_of(session, (topic,), window)
        if newest is not None and any(extent.bag == newest.bag for extent in extents):
            return newest
        merged = self._view.stream.merged(extents, [topic], window, newest_first=True)
        own = next(self._view.bags.track_sources(merged), None)
        if newest is None or not is_thinned(newest.bag.file):
            return own
        is_old = own is None or own.time < newest.time - _BETWEEN_THINNED_NS
        return newest if is_old else own

    def moving(self, session: Session, window: TimeWindow) -> list[StampedTransform]:
        """Returns the moving transforms of a session in a window, in log-time order."""
        topics = self._view.moving_topics
        extents = self.bags_of(session, topics, window)
        merged = self._view.stream.merged(extents, topics, window)
        tracked = self._view.bags.track_sources(merged)
        decoded: dict[_MessageKey, Sequence[StampedTransform]] = {}
        found: list[StampedTransform] = []
        for stored in tracked:
            if self.has(session, stored):
                key = (stored.topic, stored.time, *stored.identity)
                transforms = self._moving.get(key)
                if transforms is None:
                    transforms = tuple(decoded_transforms(self._view, [stored]))
                found += transforms
                if transforms:  # else a note may have to say why, once more
                    decoded[key] = transforms
        self._moving = decoded if len(self._moving) > _MOST_DECODED else self._moving | decoded
        return found

    def received(self, session: Session | None, rows: Rows) -> Iterator[StampedTransform]:
        """Yields the transforms of a session, or with None of all, in the messages of rows."""
        messages = messages_of(self._view, rows)
        if session is not None:
            messages = (stored for stored in messages if self.has(session, stored))
        return decoded_transforms(self._view, messages)

    def static(self, session: Session) -> Sequence[StampedTransform]:
        """Returns the static transforms of a session, in log-time order.

        A transform that repeats the one before of its child is left out: each split may have all
        again. So only the messages are read whose columns show something new.
        """
        view, cache = self._view, self._view.memory.scanner.caches.statics
        if session in self._static:
            return self._static[session]
        timeline, cached = cache.get(view.static_topics) or (None, {})
        known = dict(cached) if timeline is view.timeline else {}
        if session not in known:
            with view.bags.watched() as reading:
                if self._looked_up == _FEW_SESSIONS and not view.call.stored:
                    # A call that asks for so many asks for more.
                    known = {**self._all_static(), **known}
                self._looked_up += 1
                if session not in known:
                    received = (self._static_received(each, session) for each in view.static_topics)
                    known[session] = without_repeats(chain.from_iterable(received))
            if reading.is_final:  # else a note has to be in each answer
                size = 300 * len(known) + 500 * sum(map(len, known.values()))
                cache.put(view.static_topics, (view.timeline, known), size)
        self._static |= known
        return self._static[session]

    def _all_static(self) -> dict[Session, Sequence[StampedTransform]]:
        """Returns the static transforms of all stored sessions; empty if some are carried."""
        view = self._view
        coverage = view.memory.scanner.coverage(view.timeline)
        recordings = chain.from_iterable(map(view.timeline.recordings, view.static_topics))
        if coverage is None or any(map(self.holds_carried, recordings)):
            return {}
        received: dict[Session, list[StampedTransform]] = defaultdict(list)
        for statics in self.static_back(TimeWindow.everything()):
            received[self.session_of(view.bag_dir / statics.recording)] += statics.transforms
        for recording in {bag.recording for bag in coverage.missing}:
            received.pop(self.session_of(recording), None)
        return {session: without_repeats(statics) for session, statics in received.items()}

    def static_back(self, window: TimeWindow) -> Iterator[Statics]:
        """Yields the static transforms of stored parts that begin in a window."""
        for topic in self._view.static_topics:
            opened = open_scan(self._view, topic, window, copies=True, stored=True)

            def make(stretch: Stretch, opened: Scan = opened) -> Iterator[tuple[Ns, Statics]]:
                for rows in opened.rows(newest_first=True, among=stretch.window):
                    if stretch.window.contains(max(rows.first, window.start)):
                        yield rows.first, self._static_changes(rows)

            for _, statics in joined_back(self._view, opened, STATICS, make):
                yield statics

    def _static_received(self, topic: str, session: Session) -> Iterator[StampedTransform]:
        """Yields the static transforms of a topic, mostly without repeats within a part."""
        for rows in scan(self._view, topic, self._window_of(session, (topic,)), copies=True):
            if self.holds_carried(rows.recording):
                yield from self.received(session, rows)
            elif self.folder(rows.recording) in session:
                yield from self._static_changes(rows).transforms

    def _static_changes(self, rows: Rows) -> Statics:
        """Returns the static transforms in rows, without repeats, and remembers those of a part."""

        def make() -> Statics:
            changes = without_repeats(self.received(None, changing_rows(rows)))
            return Statics(relative(str(rows.recording), str(self._view.bag_dir)), tuple(changes))

        key = None if rows.part is None else FragmentKey(rows.first, "", (rows.part,))
        return remembered(self._view, STATICS, key, make)

    def _window_of(self, session: Session, topics: tuple[str, ...]) -> TimeWindow:
        """Returns the window in which a session has some topics; empty if it has none."""
        spans = self.recordings_of(session, topics).values()
        if not spans:
            return TimeWindow(0, 0)
        first, last = enclosing(spans)
        return TimeWindow(first, last + 1)

    def edges(self, session: Session | None = None) -> list[FrameEdge]:
        """Returns the recorded pairs of parent and child, sorted.

        Those of a session; of all without one, or if the pairs of the session were not read. A pair
        that was published both as static and as moving is moving.
        """
        by_folder = self._pairs_by_folder
        own = by_folder.keys() & (session or ())
        pairs: dict[Pair, bool] = {}
        for folder in own if own - {self._carried} else by_folder:
            for pair, is_static in by_folder[folder].items():
                pairs[pair] = is_static and pairs.get(pair, True)
        return [
            FrameEdge(*pair, is_static)
            for pair, is_static in sorted(pairs.items())
            if is_edge(pair)
        ]

    @cached_property
    def _pairs_by_folder(self) -> Mapping[str, Mapping[Pair, bool]]:
        """By folder its pairs, and whether each was published as static alone.

        Pairs with an unnamed frame are invalid in tf2: a note counts them. Another note says if
        there was no time for older bags.
        """
        view = self._view
        reading = view.call.partial_after(READING_S)
        by_folder: dict[str, dict[Pair, bool]] = defaultdict(dict)
        for topic in (*view.static_topics, *view.moving_topics):
            is_static = topic not in view.moving_topics
            for recording, pairs in self.pairs_back(topic):
                by_folder[self.folder(recording)] |= dict.fromkeys(pairs, is_static)
                if not is_static and reading.expired():
                    view.notes.add_lack("out of time: frames that only older bags have are missing")
                    break
        unnamed = {pair for pairs in by_folder.values() for pair in pairs if not is_edge(pair)}
        if unnamed:
            view.notes.add(f"pairs left out, since a frame has no name: {len(unnamed)}")
        return by_folder

    def pairs_back(
        self, topic: str, session: Session | None = None, window: TimeWindow | None = None
    ) -> Iterator[tuple[Path, Iterable[Pair]]]:
        """Yields the pairs of a topic (in a window), of a session or of all, the newest first.

        Each set is of one table, and comes with the recording of that.
        """
        window = TimeWindow.everything() if window is None else window
        if session is not None:
            window = window.intersect(self._window_of(session, (topic,)))
        for rows in scan(
            self._view, topic, window, newest_first=True, copies=True, may_be_empty=True
        ):
            if session is None or self.may_hold(session, rows.recording):
                carried_of = session if self.holds_carried(rows.recording) else None
                yield rows.recording, self._pairs_in(rows, carried_of, window.start)

    def _pairs_in(self, rows: Rows, session: Session | None, start: Ns) -> Iterable[Pair]:
        """Returns the pairs in rows, of a session or of all; remembers those of a part.

        With a part, those of earlier ones are read back to `start`.
        """

        def make() -> Pairs:
            by_columns = of_columns(self._view, rows, pairs_in) if session is None else None
            if by_columns is None:
                received = self.received(session, rows)
                by_columns = [frozenset((found.parent, found.child) for found in received)]
            return Pairs(tuple(sorted(frozenset[Pair]().union(*by_columns))))

        part = rows.part if session is None else None
        key = None if part is None else FragmentKey(rows.first, "", (part,))
        return remembered(self._view, PAIRS, key, make, also_before=rows.first - start).pairs


def decoded_transforms(view: View, messages: Iterable[StoredMessage]) -> Iterator[StampedTransform]:
    """Yields the transforms of messages; a note names the topics that cannot be decoded."""
    for stored in messages:
        is_static = stored.topic in view.limits.tf_static_topics
        with view.call.stages.timed("extract"):
            try:
                message = view.memory.reader.decode(stored.record)
                transforms = view.extractor.transforms(message, stored.time, static=is_static)
            except UndecodableError as error:
                view.notes.add_lack(Note(UNDECODED, error.topic, error.reason))
                continue
        yield from transforms


def components(pairs: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """Returns for each node of an undirected graph all nodes that are connected with it.

    A node is connected with itself.
    """
    component_of: dict[str, set[str]] = {}
    for first, other in pairs:
        ends = [component_of.setdefault(node, {node}) for node in (first, other)]
        small, large = sorted(ends, key=len)
        if small is not large:
            large |= small
            component_of.update(dict.fromkeys(small, large))
    return component_of


def _time_before_and_after(span: Span, moment: Ns) -> tuple[Ns, Ns]:
    """Returns how long a moment is before a span, and after it; 0 within the slack of floats."""
    first, last = span
    before, after = first - moment, moment - last
    return max(before - AT_OR_BEFORE_SLACK_NS, 0), max(after - AT_OR_BEFORE_SLACK_NS, 0)


def _distance(span: Span, moment: Ns) -> Ns:
    """Returns how far a moment is from a span."""
    first, last = span
    return max(first - moment, moment - last, 0)

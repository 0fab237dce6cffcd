"""Transforms between two frames, gathered from the history.

Windows are in log time. A moving transform is looked for close to the moment first, then further
away, up to the length of tf2's cache (10 s); a static one however far back it was recorded.
"""

from __future__ import annotations

from collections import deque
from itertools import zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import (
    TF_CACHE_NS,
    Edges,
    FrameTree,
    TfClock,
    connected_with,
    edges_of,
    is_edge,
    joined_edges,
    static_at,
    static_in,
)
from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.store import relative
from ros2_memory.columns.transforms import (
    STATICS,
    Pair,
    Statics,
    edges_in,
    pairs_in,
    stamped_between,
    static_times,
)
from ros2_memory.core.arrays import rows_of
from ros2_memory.core.errors import (
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.geometry import alike
from ros2_memory.core.model import FrameEdge, StampedTransform, TimeWindow, Transform
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    NS_PER_MS,
    NS_PER_S,
    Ns,
)
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import seconds, unix_text
from ros2_memory.history.no_data import (
    between,
    beyond,
    no_data_at,
    not_recorded,
)
from ros2_memory.history.scan import (
    joined_back,
    messages_of,
    of_columns,
    open_scan,
    remembered,
    scan,
)
from ros2_memory.history.sessions import Session, Sessions, enclosing

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.scan import Stretch
    from ros2_memory.columns.units import Rows
    from ros2_memory.columns.values import Mask
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.view import View

_HALF_WIDTHS: Final[tuple[Ns, ...]] = (500 * NS_PER_MS, 2_000 * NS_PER_MS, TF_CACHE_NS)
"""How far around the moment moving transforms are read; the last is the length of tf2's cache."""


_LONGER_NS: Final[Ns] = 3600 * NS_PER_S
"""How far around the moment frames are looked for that are unknown then."""

_FEW_SESSIONS: Final = 4
"""Sessions of which static transforms are looked up one by one."""
_BORROWED: Final = Reason(
    "is placed by transforms of another recording of the same time; no handover proves that both "
    "are of one robot",
    "recording",
    many="are placed by transforms of others of the same time; no handovers prove that they are of "
    "one robot",
)
_UNDECODED: Final = Reason("could not be decoded", "topic", of="messages of ")

_OF_ALL_TIMES: Final = frozenset({NoDataReason.FRAME_UNKNOWN, NoDataReason.FRAMES_NOT_CONNECTED})


_STAMPS: Final = "transforms.header.stamp"


class FoundTransform(NamedTuple):
    """A transform, the clock in which the moment was meant, and how far around it was read."""

    transform: Transform
    clock: TfClock
    reach: Ns = TF_CACHE_NS


def transform_at(
    view: View,
    parent: str,
    child: str,
    at: Ns,
    recording: Path | None = None,
    *,
    explains: bool = True,
) -> FoundTransform:
    """Returns the pose of `child` in `parent` at a moment, by tf2's rules.

    With the `recording` of a message the transforms of that recording's session are used; else
    those of the session that was recorded then. Where several were, and differ, a note reports it.
    The reason why there is none takes far longer to find: `explains=False` leaves it out.

    Raises:
        NoDataError: no transform is recorded, a frame is unknown, the frames are not connected,
            or no transform brackets the moment on one of the edges between them.
    """
    limits = view.limits
    if not _recorded_topics(view, (*limits.tf_topics, *limits.tf_static_topics)):
        raise not_recorded(view, limits.tf_topics[0] if limits.tf_topics else "/tf")
    frames, sessions = (parent, child), sessions_of(view)
    if recording is not None:
        session = lending_to(view, recording, frames, at)
        return _transform_of_session(view, session, frames, at, explains=explains)
    recorded = sessions.recorded_at(at)
    answers: list[tuple[Session, FoundTransform]] = []
    failures: list[NoDataError] = []
    for session in (sessions.nearest_to(at) if recorded is None else recorded) or [frozenset()]:
        try:
            answer = _transform_of_session(view, session, frames, at, explains=explains)
            answers.append((session, answer))
        except NoDataError as error:
            failures.append(error)
        if recorded is None and answers:
            break
    if not answers:
        raise failures[0]
    _note_sessions(view, frames, at, answers)
    _, answer = answers[0]
    return answer


def _note_sessions(
    view: View, frames: tuple[str, str], at: Ns, answers: Sequence[tuple[Session, FoundTransform]]
) -> None:
    """Notes where sessions differ in a transform, of which the first counts, or are combined."""
    sessions, (session, counting) = sessions_of(view), answers[0]
    if not all(alike(counting.transform, answer.transform) for _, answer in answers):
        view.notes.add(
            f"{len(answers)} sessions recorded at that time have different transforms; "
            f"this is that of {sessions.names(session, at)}"
        )
    parts = sessions.parts_of(session)
    if parts and not any(connects_in_time(view, frames, session=part) for part in parts):
        view.notes.add(
            f"transforms of {sessions.names(session, at)} are combined, as of one robot: they "
            "were recorded at the same time, but no handover proves that they are of one"
        )


def lending_to(view: View, recording: Path, frames: tuple[str, str], at: Ns) -> Session:
    """Returns the session whose transforms place a message of a recording; a note if borrowed.

    They are borrowed where those of the recording's own session do not lead from one frame to the
    other, and those of the one other session that lends do.
    """
    sessions = sessions_of(view)
    session, own_session = sessions.lending_to(recording, at), sessions.of(recording)
    if not session or session == own_session:
        return session
    key = (session, own_session, frames)
    if key not in sessions.chosen:
        borrows = not connects_in_time(view, frames, session=own_session) and connects_in_time(
            view, frames, session=session
        )
        sessions.chosen[key] = session if borrows else own_session
        if borrows:
            lender = sessions.names(session - own_session, at)
            view.notes.add(Note(_BORROWED, sessions.names(own_session, at), f"those of {lender}"))
    return sessions.chosen[key]


def _transform_of_session(
    view: View, session: Session, frames: tuple[str, str], at: Ns, *, explains: bool
) -> FoundTransform:
    """Returns the pose of a child in its parent by one session; raises as `transform_at`."""
    limits, (parent, child) = view.limits, frames
    static = static_at(static_transforms(view, session), at)

    def look_up(moving: Sequence[StampedTransform]) -> FoundTransform:
        tree = frames_of(view, static, moving, parent)
        return FoundTransform(tree.lookup(child, at), tree.clock)

    for half_width in _HALF_WIDTHS:
        window = TimeWindow.around(at, half_width)
        moving = moving_in(view, window, session)
        try:
            return look_up(moving)._replace(reach=half_width)
        except NoDataError as error:
            failure = error
    if limits.tf_clock == "stamp":
        moving = list(_stamped_near(view, at, session))
        try:
            return look_up(moving)
        except NoDataError as error:
            raise _stamp_failure(error, at, nothing_near=not moving) from error
    if not explains:
        raise failure
    raise _explain_failure(view, failure, frames, at, session, nothing_near=not moving) from failure


def moving_in(view: View, window: TimeWindow, session: Session) -> list[StampedTransform]:
    """Returns the moving transforms that a session received in a window, in log-time order."""
    sessions, topics = sessions_of(view), _recorded_topics(view, view.limits.tf_topics)
    bags = _bags_of_session(view, topics, window, session)
    merged = view.stream.merged(bags, topics, window, newest_first=False)
    tracked = view.bags.track_sources(merged)
    of_session = (stored for stored in tracked if sessions.has(session, stored))
    return [*decoded_transforms(view, of_session)]


def frames_of(
    view: View,
    static: Sequence[StampedTransform],
    moving: Iterable[StampedTransform],
    target: str,
) -> FrameTree:
    """Returns frames in a target frame by some transforms, of which none holds on."""
    clock = view.limits.tf_clock
    return FrameTree(static, edges_of(moving), target, clock, AT_OR_BEFORE_SLACK_NS)


def static_transforms(view: View, session: Session) -> Sequence[StampedTransform]:
    """Returns the static transforms of a session, in log-time order.

    One that is equal to the one before of its child is left out: each split may have all again.
    So few messages of a part are read: those by whose columns something is new.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    sessions, timeline, scanner = sessions_of(view), view.timeline, view.memory.columns
    if session in sessions.statics:
        return sessions.statics[session]
    topics = _recorded_topics(view, view.limits.tf_static_topics)
    key = (session, topics)
    cached_timeline, cached = scanner.caches.statics.get(key) or (None, ())
    if cached_timeline is timeline:
        sessions.statics[session] = cached
        return cached
    if len(sessions.statics) == _FEW_SESSIONS:
        # Who has asked for so many asks for more.
        _find_all_statics(view, topics)
        if session in sessions.statics:
            return sessions.statics[session]
    before = view.notes.added
    received = [
        transform for topic in topics for transform in _static_received(view, topic, session)
    ]
    received.sort(key=lambda transform: transform.log_time)
    static = _without_repeats(received)
    sessions.statics[session] = static
    # What was noted must be noted in each answer.
    if view.notes.added == before and not view.call.used_active:
        scanner.caches.statics.put(key, (timeline, static), 1000 + 600 * len(static))
    return static


def _find_all_statics(view: View, topics: Sequence[str]) -> None:
    """Finds the static transforms of all sessions that are stored, unless some are carried."""
    sessions, root = sessions_of(view), view.bag_dir
    coverage = view.memory.columns.coverage(view.timeline)
    recordings = [path for topic in topics for path in view.timeline.recordings(topic)]
    if coverage is None or any(map(sessions.holds_carried, recordings)):
        return
    by_session: dict[Session, list[StampedTransform]] = {}
    for topic in topics:
        for statics in _statics_back(view, topic, TimeWindow.everything()):
            by_session.setdefault(sessions.of(root / statics.recording), []).extend(
                statics.transforms
            )
    for session in {sessions.of(bag.recording) for bag in coverage.missing}:
        by_session.pop(session, None)
    for session, received in by_session.items():
        received.sort(key=lambda transform: transform.log_time)
        sessions.statics[session] = _without_repeats(received)


def make_statics(view: View, window: TimeWindow) -> None:
    """Makes the static transforms of the parts in a window."""
    for topic in _recorded_topics(view, view.limits.tf_static_topics):
        deque(_statics_back(view, topic, window), maxlen=0)


def _statics_back(view: View, topic: str, window: TimeWindow) -> Iterator[Statics]:
    """Yields the static transforms of a topic in a window, of bags that are stored."""
    opened = open_scan(view, topic, window, copies=True, stored=True)

    def make(stretch: Stretch) -> Iterator[tuple[Ns, Statics]]:
        for rows in opened.rows(newest_first=True, among=stretch.window):
            if stretch.window.contains(max(rows.first, window.start)):
                yield rows.first, _static_changes(view, rows)

    for _, statics in joined_back(view, opened, STATICS, make):
        yield statics


def _static_received(view: View, topic: str, session: Session) -> Iterator[StampedTransform]:
    """Yields the static transforms of a topic; of equal ones that follow in a part the first."""
    sessions = sessions_of(view)
    for rows in scan(view, topic, _span_of_session(view, topic, session), copies=True):
        if sessions.holds_carried(rows.recording):
            yield from decoded_transforms(view, _messages_in(view, rows, session))
        elif sessions.folder(rows.recording) in session:
            yield from _static_changes(view, rows).transforms


def _span_of_session(view: View, topic: str, session: Session) -> TimeWindow:
    """Returns when a session has a topic: mostly some hours of a week."""
    spans = sessions_of(view).recordings_of(session, (topic,)).values()
    if not spans:
        return TimeWindow(0, 0)
    first, last = enclosing(spans)
    return TimeWindow(first, last + 1)


def _static_changes(view: View, rows: Rows) -> Statics:
    """Returns the static transforms in some rows that differ from those before, as received."""

    def make() -> Statics:
        times = static_times(rows.table, rows.times, rows.index)
        new_rows = rows if times is None else rows.some(np.flatnonzero(np.isin(rows.times, times)))
        received = sorted(
            decoded_transforms(view, messages_of(view, new_rows)),
            key=lambda transform: transform.log_time,
        )
        return Statics(
            relative(str(rows.recording), str(view.bag_dir)), tuple(_without_repeats(received))
        )

    part = rows.part
    key = None if part is None else FragmentKey(rows.first, "", (part,))
    return remembered(view, STATICS, key, make)


def _without_repeats(static: Iterable[StampedTransform]) -> list[StampedTransform]:
    """Returns transforms in log-time order without those equal to the one before of their child."""
    latest: dict[str, StampedTransform] = {}
    changes: list[StampedTransform] = []
    for transform in static:
        child = transform.child.lstrip("/")
        last = latest.get(child)
        if last is None or (last.parent, last.transform) != (transform.parent, transform.transform):
            latest[child] = transform
            changes.append(transform)
    return changes


def sessions_of(view: View) -> Sessions:
    """Returns the sessions of a view, made once."""
    if view.sessions is None:
        view.sessions = Sessions(view, _children_in)
    return view.sessions


def _children_in(view: View, session: Session) -> set[str]:
    """Returns the child frames of all transforms of a session."""
    limits = view.limits
    topics = (*limits.tf_topics, *limits.tf_static_topics)
    return {child for _, child in _all_pairs(view, topics, session=session)}


def newest_in_session(
    view: View, topic: str, window: TimeWindow, recording: Path
) -> StoredMessage | None:
    """Returns the newest message of a topic in a window, from the session of a recording.

    From any session where that one has no message of the topic at all.
    """
    newest = view.stream.newest(topic, window)
    sessions = sessions_of(view)
    own_session = sessions.of(recording)
    if not any(sessions.folder(path) in own_session for path in view.timeline.recordings(topic)):
        return newest
    bags = _bags_of_session(view, (topic,), window, own_session)
    if newest is not None and newest.bag in {span.bag for span in bags}:
        return newest
    return view.stream.first((topic,), window, newest_first=True, among=bags)


def edges(view: View) -> tuple[FrameEdge, ...]:
    """Returns every parent and child pair that was recorded, sorted; `static` where published so.

    A pair that was published in both directions appears once, as moving. A pair with an unnamed
    frame is invalid in tf2, and is left out with a note.
    """
    limits, sessions = view.limits, sessions_of(view)
    if sessions.edges is not None:
        return sessions.edges
    pairs = dict.fromkeys(_all_pairs(view, limits.tf_static_topics), True)
    pairs |= dict.fromkeys(_all_pairs(view, limits.tf_topics), False)
    named = [(pair, is_static) for pair, is_static in sorted(pairs.items()) if is_edge(pair)]
    if len(named) < len(pairs):
        view.notes.add(f"pairs left out, since a frame has no name: {len(pairs) - len(named)}")
    sessions.edges = tuple(FrameEdge(*pair, is_static) for pair, is_static in named)
    return sessions.edges


def _all_pairs(view: View, topics: Iterable[str], session: Session | None = None) -> set[Pair]:
    """Returns the pairs of these topics; with a `session` those that it received."""
    everything = TimeWindow.everything()
    pair_sets = (
        pairs
        for topic in _recorded_topics(view, topics)
        for pairs in _pairs_by_table(view, topic, everything, session)
    )
    return set[Pair]().union(*pair_sets)


def _pairs_by_table(
    view: View, topic: str, window: TimeWindow, session: Session | None
) -> Iterator[frozenset[Pair]]:
    """Yields the pairs of a topic in a window, table by table, those of the newest first."""
    scanner = view.memory.columns
    if session is not None:
        window = window.intersect(_span_of_session(view, topic, session))
    for rows in scan(view, topic, window, newest_first=True, copies=True, may_be_empty=True):
        if session is not None and sessions_of(view).holds_carried(rows.recording):
            yield _pairs_of_messages(view, _messages_in(view, rows, session))
        elif session is None or sessions_of(view).folder(rows.recording) in session:
            part = rows.part
            pairs = None if part is None else scanner.caches.pairs.get(part)
            if pairs is None:
                before = view.notes.added
                pair_sets = of_columns(
                    view, rows, lambda part_rows: pairs_in(part_rows.table, part_rows.index)
                )
                pairs = (
                    _pairs_of_messages(view, messages_of(view, rows))
                    if pair_sets is None
                    else frozenset[Pair]().union(*pair_sets)
                )
                if part is not None and view.notes.added == before:
                    scanner.caches.pairs.put(part, pairs, 200 + 200 * len(pairs))
            yield pairs


def _pairs_of_messages(view: View, messages: Iterable[StoredMessage]) -> frozenset[Pair]:
    return frozenset(
        (transform.parent, transform.child) for transform in decoded_transforms(view, messages)
    )


def _explain_failure(
    view: View,
    failure: NoDataError,
    frames: tuple[str, str],
    at: Ns,
    session: Session,
    *,
    nothing_near: bool,
) -> NoDataError:
    """Returns the failure of a lookup near a moment in terms of the whole memory.

    A frame that is unknown near the moment, and known within `_LONGER_NS` of it, is a gap.
    """
    topics = _recorded_topics(view, view.limits.tf_topics)
    near = TimeWindow.around(at, TF_CACHE_NS)
    if topics and nothing_near:
        return no_data_at(view, topics, at, None, around=TF_CACHE_NS)
    if failure.reason in _OF_ALL_TIMES:
        then = _near_failure(failure, at)
        unknown = failure.reason is NoDataReason.FRAME_UNKNOWN
        if not unknown or not connects_in_time(
            view, frames, TimeWindow.around(at, _LONGER_NS), session
        ):
            return then
        advice = f"within {seconds(_LONGER_NS)} the two were connected: ask about then"
        return NoDataError(between(view, near), f"{then.detail}; {advice}")
    if failure.reason not in {NoDataReason.OUTSIDE_RANGE, NoDataReason.GAP}:
        return failure
    inside = (
        topics
        and view.stream.first(topics, TimeWindow.until(at), newest_first=True)
        and view.stream.first(topics, TimeWindow(at + 1, MAX_NS))
    )
    return NoDataError(between(view, near) if inside else beyond(view, at), failure.detail)


def connects_in_time(
    view: View,
    frames: tuple[str, str],
    window: TimeWindow | None = None,
    session: Session | None = None,
) -> bool:
    """Whether transforms recorded in a window, and static ones, lead from one frame to the other.

    False, too, where the time for the answer is over before that is known.
    """
    try:
        return connects(view, frames, window, session)
    except QueryTimeoutError:
        return False


def connects(
    view: View,
    frames: tuple[str, str],
    window: TimeWindow | None = None,
    session: Session | None = None,
) -> bool:
    """Whether transforms lead from one frame to the other; the newest are looked at first.

    Raises:
        QueryTimeoutError: the call's time is over before that is known.
    """
    limits, linked = view.limits, sessions_of(view).linked
    if (frames, session) in linked:
        return True
    pairs: set[Pair] = set()
    everything = TimeWindow.everything()
    by_topic = [
        _pairs_by_table(view, topic, within or everything, session)
        for topics, within in ((limits.tf_static_topics, None), (limits.tf_topics, window))
        for topic in _recorded_topics(view, topics)
    ]
    # Of all topics in turn: mostly the newest table of each is enough.
    for newest_pairs in zip_longest(*by_topic, fillvalue=frozenset[Pair]()):
        fresh = frozenset[Pair]().union(*newest_pairs)
        if not fresh <= pairs:
            pairs |= fresh
            if _are_linked(pairs, frames):
                if window is None:
                    linked.add((frames, session))
                return True
    return False


def _are_linked(pairs: Iterable[tuple[str, str]], frames: tuple[str, str]) -> bool:
    """Whether pairs of a parent and a child lead from one frame to the other."""
    origin, target = (name.lstrip("/") for name in frames)
    linked = [(parent.lstrip("/"), child.lstrip("/")) for parent, child in filter(is_edge, pairs)]
    return target in connected_with(origin, linked)


def _stamp_failure(failure: NoDataError, at: Ns, *, nothing_near: bool) -> NoDataError:
    """Returns why a lookup by header stamps failed; the log times may be anywhere."""
    if nothing_near:
        return NoDataError(
            NoDataReason.OUTSIDE_RANGE,
            f"no moving transform has a header stamp within {seconds(TF_CACHE_NS)} of "
            f"{unix_text(at)}; data.tf_clock selects transforms by header stamp, not by log time",
        )
    return _near_failure(failure, at) if failure.reason in _OF_ALL_TIMES else failure


def _near_failure(failure: NoDataError, at: Ns) -> NoDataError:
    """Returns a failure that sounds as if it were about all times with the time it is about."""
    return NoDataError(
        failure.reason,
        f"within {seconds(TF_CACHE_NS)} of {unix_text(at)}: {failure.detail}; "
        "list_frames names the frames of all times",
    )


def _stamped_near(view: View, at: Ns, session: Session) -> Iterator[StampedTransform]:
    """Yields the moving transforms stamped around a moment, wherever in log time they are."""
    sessions = sessions_of(view)
    earliest, latest = at - TF_CACHE_NS, at + TF_CACHE_NS

    def may_match(parts: PartZones) -> Mask:
        zones = parts.zone(_STAMPS)
        return zones.reaches(earliest - 1, above=True) & zones.reaches(latest + 1, above=False)

    def near(rows: Rows) -> Rows | None:
        stamped = stamped_between(rows.table, rows.index, earliest, latest)
        return None if stamped is None else rows.some(stamped)

    for topic in _recorded_topics(view, view.limits.tf_topics):
        everything = TimeWindow.everything()
        for rows in scan(view, topic, everything, copies=True, may_match=may_match):
            if sessions.may_hold(session, rows.recording):
                for near_rows in of_columns(view, rows, near) or [rows]:
                    yield from decoded_transforms(view, _messages_in(view, near_rows, session))


def _recorded_topics(view: View, topics: Iterable[str]) -> tuple[str, ...]:
    recorded = set(view.timeline.topics())
    return tuple(topic for topic in topics if topic in recorded)


def _bags_of_session(
    view: View, topics: Sequence[str], window: TimeWindow, session: Session
) -> list[BagSpan]:
    chosen = sessions_of(view).recordings_of(session, tuple(topics))
    if not chosen:
        return []
    first, last = enclosing(chosen.values())
    # A session is mostly some minutes of a week, whose bags are many.
    bags = view.stream.overlapping_bags(topics, window.intersect(TimeWindow(first, last + 1)))
    return [span for span in bags if span.bag.recording in chosen]


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


def _messages_in(view: View, rows: Rows, session: Session) -> Iterator[StoredMessage]:
    """Returns the messages of some rows that are of a session."""
    has = sessions_of(view).has
    return (stored for stored in messages_of(view, rows) if has(session, stored))


def edges_of_rows(view: View, rows: Rows, session: Session) -> Edges:
    """Returns the transforms of a session in some rows, by their columns, else by their messages.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    sessions = sessions_of(view)
    if not sessions.may_hold(session, rows.recording):
        return {}
    if sessions.holds_carried(rows.recording):
        return edges_of(decoded_transforms(view, _messages_in(view, rows, session)))
    tables = of_columns(view, rows, lambda part: edges_in(part.table, part.times, part.index))
    if tables is not None and len(tables) == 1:
        return tables[0]
    if tables is not None:
        # As those of bags come in the order of their log times.
        return {
            pair: rows_of(edge, np.argsort(edge.log_times, kind="stable"))
            for pair, edge in joined_edges(tables).items()
        }
    return edges_of(decoded_transforms(view, messages_of(view, rows)))


def frames_over(view: View, session: Session, window: TimeWindow, target: str) -> FrameTree:
    """Returns the frames of a session in a window, looked up in a target frame.

    They are the same however the history is cut: moving transforms are read from so far around the
    window that others change nothing in it, and static ones hold from when they were received.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    limits = view.limits
    around = window.widened(TF_CACHE_NS)
    moving = [
        edges_of_rows(view, rows, session)
        for topic in limits.tf_topics
        for rows in scan(view, topic, around, copies=True)
    ]
    static = static_in(static_transforms(view, session), window)
    return FrameTree(static, joined_edges(moving), target, limits.tf_clock)

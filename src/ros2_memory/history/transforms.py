"""Transforms between two frames, gathered from the history.

Windows are in log time. A moving transform is looked for close to the moment first, then further
away, up to the length of tf2's cache (10 s); a static one however far back it was recorded.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate, islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

from ros2_memory.analysis.transform_tree import (
    TF_CACHE_NS,
    FrameEdge,
    FrameGraph,
    TfClock,
    agreeing_clock,
)
from ros2_memory.core.errors import (
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.geometry import alike
from ros2_memory.core.model import StampedTransform, TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_MS,
    NS_PER_S,
    Ns,
)
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.no_data import (
    between,
    beyond,
    no_data_at,
    not_recorded,
    seconds,
)
from ros2_memory.history.sessions import Sessions, components

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile, Transform
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import Schema

_HALF_WIDTHS: Final[tuple[Ns, ...]] = (500 * NS_PER_MS, 2_000 * NS_PER_MS, TF_CACHE_NS)
"""How far around the moment moving transforms are read; the last is the length of tf2's cache."""


_LONGER_NS: Final[Ns] = 3600 * NS_PER_S
"""How far around the moment frames are looked for that are unknown then."""

_BORROWED: Final = Reason(
    "is placed by transforms of another recording of the same time; no handover proves that both "
    "are of one robot",
    "recording",
    many="are placed by transforms of others of the same time; no handovers prove that they are of "
    "one robot",
)

_OF_ALL_TIMES: Final = frozenset({NoDataReason.FRAME_UNKNOWN, NoDataReason.FRAMES_NOT_CONNECTED})


_Connection: TypeAlias = "tuple[tuple[str, str], tuple[str, ...], tuple[str, ...], Session | None]"
_CONNECTED: Final[WeakKeyDictionary[Timeline, set[_Connection]]] = WeakKeyDictionary()
_STATIC: Final[
    WeakKeyDictionary[Timeline, dict[tuple[Session, tuple[str, ...]], Sequence[StampedTransform]]]
] = WeakKeyDictionary()
"""Frames that are connected by what some topics recorded, static ones first, in a session."""


class _StaticRead(NamedTuple):
    """Static transforms as far as they were read: in so many bags, or in all."""

    found: tuple[StampedTransform, ...] = ()
    bags: int = 0
    is_whole: bool = False


_NOTHING_READ: Final = _StaticRead()
_StaticKey: TypeAlias = "tuple[tuple[str, ...], frozenset[str], Session | None, tuple[Ns, Ns, str]]"
_STATIC_READ: Final[WeakKeyDictionary[Segment | Timeline, dict[_StaticKey, _StaticRead]]] = (
    WeakKeyDictionary()
)
_MOST_KEPT: Final = 64
"""Sessions of a segment whose static transforms stay in memory; most segments have one."""
_BAGS_AT_ONCE: Final = 16
"""Bags of which all static transforms are read before any are kept."""


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
    limits = view.memory.limits
    if not _recorded(view, (*limits.tf_topics, *limits.tf_static_topics)):
        raise not_recorded(view, limits.tf_topics[0] if limits.tf_topics else "/tf")
    frames, sessions = (parent, child), sessions_of(view)
    if recording is not None:
        session = lending_to(view, recording, frames, at)
        return _transform_in(view, session, frames, at, explains=explains)
    recorded = sessions.recorded_at(at)
    answers: list[tuple[Session, FoundTransform]] = []
    failures: list[NoDataError] = []
    for session in (sessions.nearest_to(at) if recorded is None else recorded) or [frozenset()]:
        try:
            found = _transform_in(view, session, frames, at, explains=explains)
            answers.append((session, found))
        except NoDataError as error:
            failures.append(error)
        if recorded is None and answers:
            break
    if not answers:
        raise failures[0]
    session, found = answers[0]
    if not all(alike(found.transform, each.transform) for _, each in answers):
        view.notes.add(
            f"{len(answers)} sessions recorded at that time have different transforms; "
            f"this is that of {sessions.names(session, at)}"
        )
    parts = sessions.parts_of(session)
    if parts and not any(connected(view, frames, among=each) for each in parts):
        view.notes.add(
            f"transforms of {sessions.names(session, at)} are combined, as of one robot: they "
            "were recorded at the same time, but no handover proves that they are of one"
        )
    return found


def lending_to(view: View, recording: Path, frames: tuple[str, str], at: Ns) -> Session:
    """Returns the session whose transforms place a message of a recording; a note if borrowed.

    They are borrowed where those of the recording's own session do not lead from one frame to the
    other, and those of the one other session that lends do.
    """
    sessions = sessions_of(view)
    session, own = sessions.lending_to(recording, at), sessions.of(recording)
    if not session or session == own:
        return session
    key = (session, own, frames)
    if key not in sessions.chosen:
        borrows = not connected(view, frames, among=own) and connected(view, frames, among=session)
        sessions.chosen[key] = session if borrows else own
        if borrows:
            lender = sessions.names(session - own, at)
            view.notes.add(Note(_BORROWED, sessions.names(own, at), f"those of {lender}"))
    return sessions.chosen[key]


def _transform_in(
    view: View, among: Session, frames: tuple[str, str], at: Ns, *, explains: bool
) -> FoundTransform:
    """Does as `transform_at`, by the transforms of one session."""
    limits = view.memory.limits
    static = static_at(static_transforms(view, among), at)

    def look_up(moving: Sequence[StampedTransform]) -> FoundTransform:
        graph = graph_of(view, static, moving)
        return FoundTransform(graph.lookup(*frames, at), _clock(view, moving))

    for half_width in _HALF_WIDTHS:
        window = TimeWindow.around(at, half_width)
        moving = list(_transforms(view, limits.tf_topics, window, among))
        try:
            return look_up(moving)._replace(reach=half_width)
        except NoDataError as error:
            failure = error
    if limits.tf_clock == "stamp":
        moving = list(_stamped_near(view, at, among))
        try:
            return look_up(moving)
        except NoDataError as error:
            raise _stamp_failure(error, at, nothing_near=not moving) from error
    if not explains:
        raise failure
    raise _explained(view, failure, frames, at, among, nothing_near=not moving) from failure


def moving_in(view: View, window: TimeWindow, among: Session) -> list[StampedTransform]:
    """Returns the moving transforms of a session that a lookup at any moment of a window needs."""
    topics = view.memory.limits.tf_topics
    return list(_transforms(view, topics, window.widened(TF_CACHE_NS), among))


def graph_of(
    view: View, static: Sequence[StampedTransform], moving: Sequence[StampedTransform]
) -> FrameGraph:
    """Returns the transforms as a graph, in the clock of `data.tf_clock`."""
    return FrameGraph([*static, *moving], _clock(view, moving))


def _clock(view: View, moving: Sequence[StampedTransform]) -> TfClock:
    configured = view.memory.limits.tf_clock
    return agreeing_clock(moving) if configured == "auto" else configured


def static_transforms(view: View, among: Session) -> Sequence[StampedTransform]:
    """Returns the static transforms of a session, in log-time order.

    One that is equal to the one before of its child is left out: each split may have all again.

    Raises:
        QueryTimeoutError: the call's time is over; what was read is kept for the next call.
    """
    topics = _recorded(view, view.memory.limits.tf_static_topics)
    known = _STATIC.setdefault(view.snapshot.timeline, {})
    if (among, topics) in known:
        return known[among, topics]
    before = view.notes.added
    chosen = {str(path): path for path in sessions_of(view).recordings_of(among, topics)}
    found: list[StampedTransform] = []
    for run in _runs_with(view, topics):
        found += _static_in(view, topics, among, chosen, run)
    found = _changes(found)
    # What was noted must be noted in each answer.
    if view.notes.added == before and not view.call.used_active:
        known[among, topics] = found
    return found


def _changes(static: Iterable[StampedTransform]) -> list[StampedTransform]:
    """Returns transforms in log-time order without those equal to the one before of their child."""
    latest: dict[str, StampedTransform] = {}
    found: list[StampedTransform] = []
    for each in static:
        child = each.child.lstrip("/")
        last = latest.get(child)
        if last is None or (last.parent, last.transform) != (each.parent, each.transform):
            latest[child] = each
            found.append(each)
    return found


def _runs_with(view: View, topics: Sequence[str]) -> Iterator[Sequence[Segment]]:
    """Yields the segments that hold topics, in order; those together whose messages interleave."""
    held = [
        (segment, [segment.spans[topic] for topic in topics if topic in segment.spans])
        for segment in view.snapshot.timeline.segments
    ]
    held = [(segment, spans) for segment, spans in held if spans]
    reaches = [*accumulate((max(last for _, last in spans) for _, spans in held), max)]
    firsts = [min(spans)[0] for _, spans in reversed(held)]
    earliest_from = [*accumulate(firsts, min)][::-1]
    run: list[Segment] = []
    for nth, (segment, _) in enumerate(held):
        if run and earliest_from[nth] > reaches[nth - 1]:
            yield run
            run = []
        run.append(segment)
    if run:
        yield run


def _static_in(
    view: View,
    topics: tuple[str, ...],
    among: Session,
    chosen: Mapping[str, Path],
    run: Sequence[Segment],
) -> Sequence[StampedTransform]:
    """Returns the static transforms of a session in some segments, as `static_transforms` does.

    Kept as far as they are read, while the segments stay: without a catalogue, those of a week take
    longer to read than a call may. `chosen` are the session's recordings by folder.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    folders = chosen.keys() & frozenset[str]().union(*(each.folders for each in run))
    if not folders:
        return ()
    carries = any(sessions_of(view).holds_carried(chosen[each]) for each in folders)
    kept = _STATIC_READ.setdefault(run[0] if len(run) == 1 else view.snapshot.timeline, {})
    key = (topics, frozenset(folders), among if carries else None, run[0].first)
    read = kept.get(key, _NOTHING_READ)
    if read.is_whole:
        return read.found
    spans = [each.spans[topic] for each in run for topic in topics if topic in each.spans]
    window = TimeWindow(min(first for first, _ in spans), max(last for _, last in spans) + 1)
    bags = _bags_of(view, topics, window, among)
    is_sure = True
    for stop in _cuts(bags, read.bags):
        part = bags[read.bags : stop]
        before = view.notes.added
        with view.notes.isolated():
            try:
                found = _once_decoded(view, _merged(view, topics, part, window, among))
            except QueryTimeoutError as error:
                how_far = f"static transforms are read up to {unix_text(part[0].first)} so far"
                raise QueryTimeoutError(
                    f"{error}; {how_far}, and kept: ask again to go on from there"
                ) from error
            is_sure &= view.notes.complete and view.notes.added == before
        read = _StaticRead((*read.found, *_changes(found)), stop, is_whole=stop == len(bags))
        if is_sure and not view.call.used_active:
            if key not in kept and len(kept) >= _MOST_KEPT:
                kept.clear()
            kept[key] = read
    return read.found


def _cuts(bags: Sequence[BagSpan], begin: int) -> Iterator[int]:
    """Yields where bags are cut, from one on: after some each, where no message interleaves."""
    reach, last = MIN_NS, begin
    for nth in range(begin, len(bags)):
        if nth - last >= _BAGS_AT_ONCE and bags[nth].first > reach:
            yield nth
            last = nth
        reach = max(reach, bags[nth].last)
    yield len(bags)


def _once_decoded(view: View, messages: Iterable[StoredMessage]) -> list[StampedTransform]:
    """Returns the transforms of messages but for repetitions; the same bytes are decoded once."""
    decoded: dict[tuple[Schema, str, bytes], tuple[StampedTransform, ...]] = {}
    latest: dict[str, StampedTransform] = {}
    found: list[StampedTransform] = []
    for message in messages:
        channel = message.record.channel
        key = (channel.schema, channel.encoding, message.record.payload)
        if key not in decoded:
            decoded[key] = _decoded(view, message)
        for each in decoded[key]:
            child = each.child.lstrip("/")
            if latest.get(child) is not each:
                latest[child] = each
                found.append(replace(each, log_time=message.time))
    return found


def static_at(static: Iterable[StampedTransform], at: Ns) -> list[StampedTransform]:
    """Returns, of static transforms in log-time order, the newest of each child at a moment.

    A static transform holds at all times of its session. So where all of a child were received
    later, the first of them holds.
    """
    newest: dict[str, StampedTransform] = {}
    for each in static:
        child = each.child.lstrip("/")
        if child not in newest or each.log_time <= at + AT_OR_BEFORE_SLACK_NS:
            newest[child] = each
    return list(newest.values())


def static_changes(static: Sequence[StampedTransform]) -> list[Ns]:
    """Returns the log times at which a child's static transform differs from the one before."""
    changes: dict[Ns, None] = {}
    latest: dict[str, StampedTransform] = {}
    for each in static:
        child = each.child.lstrip("/")
        before = latest.get(child)
        if before is not None and not (
            before.parent.lstrip("/") == each.parent.lstrip("/")
            and alike(before.transform, each.transform)
        ):
            changes[each.log_time] = None
        latest[child] = each
    return [*changes]


def sessions_of(view: View) -> Sessions:
    """Returns the sessions of a view, made once."""
    if view.sessions is None:
        limits = view.memory.limits
        topics = (*limits.tf_topics, *limits.tf_static_topics)
        view.sessions = Sessions(
            view, lambda among: {child for _, child in _pairs(view, topics, among=among)}
        )
    return view.sessions


def newest_in_session(
    view: View, topic: str, window: TimeWindow, recording: Path
) -> StoredMessage | None:
    """Returns the newest message of a topic in a window, from the session of a recording.

    From any session where that one has no message of the topic at all.
    """
    newest = view.stream.newest(topic, window)
    sessions = sessions_of(view)
    own = sessions.of(recording)
    if not any(sessions.folder(each) in own for each in view.snapshot.timeline.recordings(topic)):
        return newest
    bags = _bags_of(view, (topic,), window, own)
    if newest is not None and newest.bag in {each.bag for each in bags}:
        return newest
    return view.stream.first((topic,), window, newest_first=True, among=bags)


def children_moving(view: View, among: Session) -> set[str]:
    """Returns the child frames of a session's moving transforms."""
    pairs = _pairs(view, view.memory.limits.tf_topics, among=among)
    return {child.lstrip("/") for _, child in pairs}


def edges(view: View) -> tuple[FrameEdge, ...]:
    """Returns every parent and child pair that was recorded, sorted; `static` where published so.

    A pair that was published in both directions appears once, as moving. A pair with an unnamed
    frame is invalid in tf2, and is left out with a note.
    """
    limits = view.memory.limits
    pairs = dict.fromkeys(_pairs(view, limits.tf_static_topics), True)
    pairs |= dict.fromkeys(_pairs(view, limits.tf_topics), False)
    named = [each for each in sorted(pairs.items()) if _is_edge(each[0])]
    if len(named) < len(pairs):
        view.notes.add(f"pairs left out, since a frame has no name: {len(pairs) - len(named)}")
    return tuple(FrameEdge(parent, child, is_static) for (parent, child), is_static in named)


def _pairs(
    view: View,
    topics: Iterable[str],
    window: TimeWindow | None = None,
    among: Session | None = None,
) -> set[tuple[str, str]]:
    """Returns the pairs of these topics: from the catalogue, or from bags that it has none of.

    With a window, those of the bags that have something of a topic in it; with `among`, those of a
    session's bags.
    """
    recorded = _recorded(view, topics)
    pairs, unknown = _known_pairs(view, recorded, window, among)
    for span in united(unknown):
        for each in _transforms(view, recorded, TimeWindow(*span), among):
            pairs.add((each.parent, each.child))
    return pairs


def _known_pairs(
    view: View, recorded: Iterable[str], window: TimeWindow | None, among: Session | None
) -> tuple[set[tuple[str, str]], list[tuple[Ns, Ns]]]:
    """Returns the pairs that the catalogue has, and the times of the bags that it has none of."""
    pairs: set[tuple[str, str]] = set()
    unknown: list[tuple[Ns, Ns]] = []
    for topic in recorded:
        for segment in view.snapshot.timeline.segments:
            known, spans = _stored_pairs(
                view, segment, topic, window or TimeWindow.everything(), among
            )
            pairs |= known
            unknown += spans
    return pairs, unknown


def _is_edge(pair: tuple[str, str]) -> bool:
    """Whether tf2 takes a parent and a child for an edge of the tree."""
    parent, child = (name.lstrip("/") for name in pair)
    return bool(parent and child) and parent != child


def _stored_pairs(
    view: View, segment: Segment, topic: str, window: TimeWindow, among: Session | None
) -> tuple[set[tuple[str, str]], list[tuple[Ns, Ns]]]:
    """Returns the pairs that the catalogue has of a segment, and the times of bags it lacks."""
    notes = view.bags.digests_of(segment) if topic in segment.spans else None
    if notes is not None and among is None and window.covers(*segment.spans[topic]):
        every = notes.pairs(topic)
        if every is not None:
            return set(every), []
    numbers = {} if notes is None else notes.numbers
    edges = {} if notes is None else notes.edges(topic)
    known: set[tuple[str, str]] = set()
    rest: list[tuple[Ns, Ns]] = []
    for bag, first, last in segment.extents(topic):
        is_of_session = among is None or sessions_of(view).folder(bag.recording) in among
        if is_of_session and window.overlaps(first, last):
            edge = edges.get(numbers.get(bag.file, 0))
            mixed = among is not None and sessions_of(view).is_carried(bag)
            if edge is None or mixed:
                rest.append((first, last + 1))
            else:
                known.update(edge.pairs)
    return known, rest


def _explained(
    view: View,
    failure: NoDataError,
    frames: tuple[str, str],
    at: Ns,
    among: Session,
    *,
    nothing_near: bool,
) -> NoDataError:
    """Returns the failure of a lookup near a moment in terms of the whole memory.

    A frame that is unknown near the moment, and known within `_LONGER_NS` of it, is a gap.
    """
    topics = _recorded(view, view.memory.limits.tf_topics)
    near = TimeWindow.around(at, TF_CACHE_NS)
    if topics and nothing_near:
        return no_data_at(view, topics, at, None, around=TF_CACHE_NS)
    if failure.reason in _OF_ALL_TIMES:
        then = _near_failure(failure, at)
        unknown = failure.reason is NoDataReason.FRAME_UNKNOWN
        if not unknown or not connected(view, frames, TimeWindow.around(at, _LONGER_NS), among):
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


def connected(
    view: View,
    frames: tuple[str, str],
    window: TimeWindow | None = None,
    among: Session | None = None,
) -> bool:
    """Whether transforms recorded in a window, and static ones, lead from one frame to the other.

    False, too, where the time for the answer is over before that is known.
    """
    try:
        return connects(view, frames, window, among)
    except QueryTimeoutError:
        return False


def connects(
    view: View,
    frames: tuple[str, str],
    window: TimeWindow | None = None,
    among: Session | None = None,
) -> bool:
    """Does as `connected`; reads the newest bags without a digest first, until they do.

    Raises:
        QueryTimeoutError: the call's time is over before that is known.
    """
    limits = view.memory.limits
    known_to = _CONNECTED.setdefault(view.snapshot.timeline, set())
    asked = (frames, limits.tf_static_topics, limits.tf_topics, among)
    if asked in known_to:
        return True
    pairs: set[tuple[str, str]] = set()
    unread: list[tuple[Ns, Ns, tuple[str, ...]]] = []
    asked_of = [
        (recorded, topic, within or TimeWindow.everything())
        for topics, within in ((limits.tf_static_topics, None), (limits.tf_topics, window))
        for recorded in (_recorded(view, topics),)
        for topic in recorded
    ]
    for segment in view.snapshot.timeline.segments:
        before = len(pairs)
        for recorded, topic, within in asked_of:
            known, unknown = _stored_pairs(view, segment, topic, within, among)
            pairs |= known
            unread += [(stop, start, recorded) for start, stop in unknown]
        # One segment is mostly enough, and a week has dozens.
        if len(pairs) > before and _link(pairs, frames):
            if window is None:
                known_to.add(asked)
            return True
    for stop, start, recorded in sorted({*unread}, reverse=True):
        view.bags.check_deadline()
        read = _transforms(view, recorded, TimeWindow(start, stop), among)
        found = {(each.parent, each.child) for each in read}
        if not found <= pairs:
            pairs |= found
            if _link(pairs, frames):
                return True
    return False


def connected_by_statics(view: View, frames: tuple[str, str]) -> bool:
    """Whether static transforms alone lead from one frame to the other, in some recording."""
    pairs = _pairs(view, view.memory.limits.tf_static_topics)
    return _link(pairs, frames)


def _link(pairs: Iterable[tuple[str, str]], frames: tuple[str, str]) -> bool:
    """Whether pairs of a parent and a child lead from one frame to the other."""
    origin, target = (name.lstrip("/") for name in frames)
    linked = ((parent.lstrip("/"), child.lstrip("/")) for parent, child in filter(_is_edge, pairs))
    return target in components(linked).get(origin, ())


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


def _stamped_near(view: View, at: Ns, among: Session) -> Iterator[StampedTransform]:
    """Yields the moving transforms stamped around a moment, wherever in log time they are.

    A bag is read only where the stamps of its first and last message reach as far as the moment.
    """
    topics = _recorded(view, view.memory.limits.tf_topics)
    everything = TimeWindow.everything()
    for span in _bags_of(view, topics, everything, among):
        ends = _stamps_at_ends(view, span.bag, topics)
        if ends and min(ends) - TF_CACHE_NS <= at <= max(ends) + TF_CACHE_NS:
            for found in view.bags.track_sources(view.bags.read(span.bag, topics, everything)):
                yield from _decoded(view, found)


def _stamps_at_ends(view: View, bag: BagFile, topics: Sequence[str]) -> list[Ns]:
    """Returns the stamps in a bag's first and last message, in any order."""
    entry = view.bags.entry(bag) if len(topics) == 1 else None
    edges = None if entry is None else entry[0].edges(topics[0]).get(entry[1])
    if edges is not None:
        return [each for each in (edges.first_stamp, edges.last_stamp) if each is not None]
    everything = TimeWindow.everything()
    return [
        transform.stamp
        for newest_first in (False, True)
        for found in view.bags.track_sources(
            islice(view.bags.read(bag, topics, everything, newest_first=newest_first), 1)
        )
        for transform in _decoded(view, found)
    ]


def _recorded(view: View, topics: Iterable[str]) -> tuple[str, ...]:
    known = set(view.snapshot.timeline.topics())
    return tuple(topic for topic in topics if topic in known)


def _transforms(
    view: View, topics: Iterable[str], window: TimeWindow, among: Session | None
) -> Iterator[StampedTransform]:
    """Yields the transforms in a window, in order; with duplicates, where it is of one session."""
    for each in _messages(view, topics, window, among):
        yield from _decoded(view, each)


def _messages(
    view: View, topics: Iterable[str], window: TimeWindow, among: Session | None
) -> Iterator[StoredMessage]:
    recorded = _recorded(view, topics)
    if not recorded:
        return iter(())
    if among is None:
        return view.stream.messages(recorded, window)
    # A message that was relatched belongs to the recording that received it, too.
    return _merged(view, recorded, _bags_of(view, recorded, window, among), window, among)


def _merged(
    view: View,
    topics: Sequence[str],
    bags: Sequence[BagSpan],
    window: TimeWindow,
    among: Session,
) -> Iterator[StoredMessage]:
    """Yields the messages of topics in some bags that are of a session."""
    sessions = sessions_of(view)
    merged = view.stream.merged(bags, topics, window, newest_first=False)
    several = any(sessions.is_carried(span.bag) for span in bags)
    tracked = view.bags.track_sources(merged)
    return (each for each in tracked if not several or sessions.has(among, each))


def _bags_of(
    view: View, topics: Sequence[str], window: TimeWindow, among: Session
) -> list[BagSpan]:
    chosen = sessions_of(view).recordings_of(among, tuple(topics))
    if not chosen:
        return []
    first, last = min(span[0] for span in chosen.values()), max(span[1] for span in chosen.values())
    # A session is mostly some minutes of a week, whose bags are many.
    bags = view.stream.overlapping_bags(topics, window.intersect(TimeWindow(first, last + 1)))
    return [each for each in bags if each.bag.recording in chosen]


def _decoded(view: View, found: StoredMessage) -> tuple[StampedTransform, ...]:
    is_static = found.record.channel.topic in view.memory.limits.tf_static_topics
    with view.call.stages.timed("extract"):
        try:
            message = view.memory.reader.decode(found.record)
            return view.memory.extractor.transforms(message, found.time, static=is_static)
        except UndecodableError as error:
            view.notes.complete = False
            view.notes.add(f"messages of {error.topic} could not be decoded: {error.reason}")
            return ()

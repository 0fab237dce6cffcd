"""The transforms that a question about frames needs, gathered from the history.

Windows are in log time. A dynamic transform is looked for close to the moment first, then further
away, up to tf2's cache length; a static one however far back it was recorded.
"""

from __future__ import annotations

import time
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

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
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_MS,
    NS_PER_S,
    Ns,
)
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.duplicates import united
from ros2_memory.history.no_data import (
    between,
    beyond,
    no_data_at,
    not_recorded,
    seconds,
)
from ros2_memory.history.notes import Note
from ros2_memory.history.sessions import Sessions

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile, Transform
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment

_HALF_WIDTHS: Final[tuple[Ns, ...]] = (500 * NS_PER_MS, 2_000 * NS_PER_MS, TF_CACHE_NS)
"""How far around the moment dynamic transforms are read; the last is as far as tf2 remembers."""


_LONGER_NS: Final[Ns] = 3600 * NS_PER_S
"""How far around the moment it is looked for frames that were not known then."""

_BORROWED: Final = Reason(
    "is placed by transforms of another recording of the same time; no handover says that both are "
    "of one robot",
    "recording",
    many="are placed by transforms of others of the same time; no handovers say that they are of "
    "one robot",
)

_OF_ALL_TIMES: Final = frozenset({NoDataReason.FRAME_UNKNOWN, NoDataReason.FRAMES_NOT_CONNECTED})


class FoundTransform(NamedTuple):
    """A transform, the clock in which the moment was meant, and how far around it was read."""

    transform: Transform
    clock: TfClock
    reach: Ns = TF_CACHE_NS


def transform_at(
    view: View, parent: str, child: str, at: Ns, recording: Path | None = None
) -> FoundTransform:
    """The pose of `child` in `parent` at a moment, by tf2's rules.

    Of a message of a `recording` it is told by the transforms of that recording's session; else by
    those of the session that was recorded then. Where several were, and differ, a note says so.

    Raises:
        NoDataError: no transform is recorded, a frame is unknown, the frames are not connected,
            or nothing brackets the moment on one of the edges between them.
    """
    limits = view.memory.limits
    if not _recorded(view, (*limits.tf_topics, *limits.tf_static_topics)):
        raise not_recorded(view, limits.tf_topics[0] if limits.tf_topics else "/tf")
    sessions = sessions_of(view)
    if recording is not None:
        among = lending_to(view, recording, (parent, child), at)
        return _transform_in(view, among, (parent, child), at)
    holding = sessions.recorded_at(at)
    answers: list[tuple[Session, FoundTransform]] = []
    failure: NoDataError | None = None
    for session in (sessions.nearest_to(at) if holding is None else holding) or [frozenset()]:
        try:
            answers.append((session, _transform_in(view, session, (parent, child), at)))
        except NoDataError as error:
            failure = failure or error
        if holding is None and answers:
            break
    if not answers and failure is not None:
        raise failure
    session, found = answers[0]
    if not all(_alike(found, other) for _, other in answers):
        view.notes.add(
            f"{len(answers)} sessions that were recorded then hold different transforms; "
            f"this is that of {sessions.names(session, at)}"
        )
    parts = sessions.parts_of(session)
    if parts and not any(connected(view, (parent, child), among=each) for each in parts):
        view.notes.add(
            f"transforms of {sessions.names(session, at)} are joined, as of one robot: they were "
            "recorded at the same time, and no handover says whether they are of one"
        )
    return found


def lending_to(view: View, recording: Path, frames: tuple[str, str], at: Ns) -> Session:
    """Whose transforms place a message of a recording; a note says where these are borrowed.

    They are where the recording's own do not lead from one frame to the other, and those of the
    one other session that lends do.
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


def _alike(one: FoundTransform, other: FoundTransform) -> bool:
    return alike(one.transform, other.transform)


def _transform_in(view: View, among: Session, frames: tuple[str, str], at: Ns) -> FoundTransform:
    """As `transform_at`, by the transforms of one session."""
    limits = view.memory.limits
    static = _static_at(view, at, among)
    for half_width in _HALF_WIDTHS:
        window = TimeWindow.around(at, half_width)
        dynamic = list(_transforms(view, limits.tf_topics, window, among, static=False))
        try:
            found = _lookup(static, dynamic, limits.tf_clock, frames, at)
            return found._replace(reach=half_width)
        except NoDataError as error:
            failure = error
    if limits.tf_clock == "stamp":
        dynamic = list(_stamped_near(view, at, among))
        try:
            return _lookup(static, dynamic, "stamp", frames, at)
        except NoDataError as error:
            raise _of_stamps(error, at, nothing_near=not dynamic) from error
    raise _explained(view, failure, frames, at, among, nothing_near=not dynamic) from failure


def moving_in(view: View, window: TimeWindow, among: Session) -> list[StampedTransform]:
    """The moving transforms of a session with which any moment of a window can be looked up."""
    wider = TimeWindow(
        max(window.start - TF_CACHE_NS, MIN_NS), min(window.stop + TF_CACHE_NS, MAX_NS)
    )
    return list(_transforms(view, view.memory.limits.tf_topics, wider, among, static=False))


def graph_of(
    view: View, static: Sequence[StampedTransform], moving: Sequence[StampedTransform]
) -> FrameGraph:
    """The transforms as a graph, in the clock that is configured."""
    clock: TfClock = "log" if view.memory.limits.tf_clock == "log" else "stamp"
    if view.memory.limits.tf_clock == "auto":
        clock = agreeing_clock(moving)
    return FrameGraph([*static, *moving], clock)


def statics(view: View, among: Session) -> list[StampedTransform]:
    """Every static transform of a session, in order."""
    topics = view.memory.limits.tf_static_topics
    return list(_transforms(view, topics, TimeWindow.everything(), among, static=True))


def holding_at(static: Iterable[StampedTransform], at: Ns) -> list[StampedTransform]:
    """For each child frame its newest static transform at a moment, of these in order.

    A static transform holds at all times of its session, so one that was only received later holds
    too, the first of them.
    """
    holding: dict[str, StampedTransform] = {}
    for each in static:
        child = each.child.lstrip("/")
        if child not in holding or each.log_time <= at + AT_OR_BEFORE_SLACK_NS:
            holding[child] = each
    return list(holding.values())


def sessions_of(view: View) -> Sessions:
    """The sessions of a view, worked out once."""
    if view.sessions is None:
        limits = view.memory.limits
        view.sessions = Sessions(
            view,
            limits.tf_topics,
            limits.tf_static_topics,
            limits.pose_topic,
            lambda topics, among: {
                child for _, child in _pairs(view, topics, static=True, among=among)
            },
        )
    return view.sessions


def own_holdings(
    view: View, topic: str, window: TimeWindow, recording: Path
) -> list[BagSpan] | None:
    """What the session of a recording holds of a topic in a window; None where it never has any."""
    sessions = sessions_of(view)
    own = sessions.of(recording)
    if not any(sessions.folder(each) in own for each in view.snapshot.recordings(topic)):
        return None
    return _holdings(view, (topic,), window, own)


def children_moving(view: View, among: Session) -> set[str]:
    """The child frames of a session's moving transforms."""
    pairs = _pairs(view, view.memory.limits.tf_topics, static=False, among=among)
    return {child.lstrip("/") for _, child in pairs}


def edges(view: View) -> tuple[FrameEdge, ...]:
    """Every parent and child pair that was recorded, sorted; `static` where it was so published.

    A pair that was published both ways stands once, as dynamic. One in which a frame has no name
    is none to tf2, and left out with a note.
    """
    limits = view.memory.limits
    pairs: dict[tuple[str, str], bool] = {}
    for topics, static in ((limits.tf_static_topics, True), (limits.tf_topics, False)):
        pairs.update((pair, static) for pair in _pairs(view, topics, static=static))
    refused = [pair for pair in pairs if not _is_edge(pair)]
    for pair in refused:
        del pairs[pair]
    if refused:
        view.notes.add(f"pairs left out, since a frame has no name: {len(refused)}")
    return tuple(
        FrameEdge(parent, child, static) for (parent, child), static in sorted(pairs.items())
    )


def _pairs(
    view: View,
    topics: Iterable[str],
    *,
    static: bool,
    window: TimeWindow | None = None,
    among: Session | None = None,
) -> set[tuple[str, str]]:
    """The pairs of these topics: of which the catalogue says none, their bags are read.

    With a window, those of the bags that have something of a topic in it; `among` a session, of its
    bags.
    """
    pairs: set[tuple[str, str]] = set()
    recorded = _recorded(view, topics)
    unknown: list[tuple[Ns, Ns]] = []
    for topic in recorded:
        for run in view.snapshot.segments:
            known, spans = _known_pairs(view, run, topic, window or TimeWindow.everything(), among)
            pairs |= known
            unknown += spans
    for span in united(unknown):
        for each in _transforms(view, recorded, TimeWindow(*span), among, static=static):
            pairs.add((each.parent, each.child))
    return pairs


def _is_edge(pair: tuple[str, str]) -> bool:
    """Whether tf2 takes a parent and a child for an edge of the tree."""
    parent, child = (name.lstrip("/") for name in pair)
    return bool(parent and child) and parent != child


def _known_pairs(
    view: View, run: Segment, topic: str, window: TimeWindow, among: Session | None
) -> tuple[set[tuple[str, str]], list[tuple[Ns, Ns]]]:
    """The pairs that the catalogue has of a run of bags, and the time of bags it has none of."""
    notes = view.bags.digests_of(run) if topic in run.spans else None
    if notes is not None and among is None and window.covers(*run.spans[topic]):
        every = notes.pairs(topic)
        if every is not None:
            return set(every), []
    numbers = {} if notes is None else notes.numbers
    edges = {} if notes is None else notes.edges(topic)
    known: set[tuple[str, str]] = set()
    rest: list[tuple[Ns, Ns]] = []
    for bag, first, last in run.extents(topic):
        if window.overlaps(first, last) and _is_among(view, bag, among):
            edge = edges.get(numbers.get(bag.file, 0))
            mixed = among is not None and sessions_of(view).is_carried(bag)
            if edge is None or mixed:
                rest.append((first, last + 1))
            else:
                known.update(edge.pairs)
    return known, rest


def _lookup(
    static: Sequence[StampedTransform],
    dynamic: Sequence[StampedTransform],
    mode: str,
    frames: tuple[str, str],
    at: Ns,
) -> FoundTransform:
    clock: TfClock = "log" if mode == "log" else "stamp"
    if mode == "auto":
        clock = agreeing_clock(dynamic)
    graph = FrameGraph([*static, *dynamic], clock)
    return FoundTransform(graph.lookup(*frames, at), clock)


def _explained(
    view: View,
    failure: NoDataError,
    frames: tuple[str, str],
    at: Ns,
    among: Session,
    *,
    nothing_near: bool,
) -> NoDataError:
    """The failure of a lookup in its neighbourhood, said of the whole memory.

    A frame that is not known there is a gap where it is within `_LONGER_NS`.
    """
    topics = _recorded(view, view.memory.limits.tf_topics)
    if topics and nothing_near:
        return no_data_at(view, topics, at, None, around=TF_CACHE_NS)
    if failure.reason in _OF_ALL_TIMES:
        then = _of_then(failure, at)
        unknown = failure.reason is NoDataReason.FRAME_UNKNOWN
        if not (unknown and connected(view, frames, TimeWindow.around(at, _LONGER_NS), among)):
            return then
        told = f"{then.detail}; within {seconds(_LONGER_NS)} the two were connected: ask about then"
        return NoDataError(between(view, TimeWindow.around(at, TF_CACHE_NS)), told)
    if failure.reason not in {NoDataReason.OUTSIDE_RANGE, NoDataReason.GAP}:
        return failure
    inside = topics and all(
        view.stream.first(topics, side, newest_first=newest_first)
        for side, newest_first in (
            (TimeWindow.until(at), True),
            (TimeWindow(at + 1, MAX_NS), False),
        )
    )
    reason = between(view, TimeWindow.around(at, TF_CACHE_NS)) if inside else beyond(view, at)
    return NoDataError(reason, failure.detail)


def connected(
    view: View,
    frames: tuple[str, str],
    window: TimeWindow | None = None,
    among: Session | None = None,
) -> bool:
    """Whether transforms recorded in a window, and static ones, lead from one frame to the other.

    Not known where the time for the answer is over before.
    """
    limits = view.memory.limits
    try:
        pairs = _pairs(view, limits.tf_topics, static=False, window=window, among=among)
        pairs |= _pairs(view, limits.tf_static_topics, static=True, among=among)
    except QueryTimeoutError:
        return False
    origin, target = (name.lstrip("/") for name in frames)
    pairs = {(pair[0].lstrip("/"), pair[1].lstrip("/")) for pair in pairs if _is_edge(pair)}
    reached, waiting = {origin}, [origin]
    while waiting:
        here = waiting.pop()
        beside = {b if a == here else a for a, b in pairs if here in {a, b}} - reached
        reached |= beside
        waiting += beside
    return target in reached and len(reached) > 1


def _of_stamps(failure: NoDataError, at: Ns, *, nothing_near: bool) -> NoDataError:
    """The failure of a lookup by header stamps, wherever in log time they were recorded."""
    if nothing_near:
        return NoDataError(
            NoDataReason.OUTSIDE_RANGE,
            f"no moving transform has a header stamp within {seconds(TF_CACHE_NS)} of "
            f"{unix_text(at)}; data.tf_clock has them looked up by header stamp, not by log time",
        )
    return _of_then(failure, at) if failure.reason in _OF_ALL_TIMES else failure


def _of_then(failure: NoDataError, at: Ns) -> NoDataError:
    """A failure that sounds as if it held for all times, said of the time that was looked at."""
    return NoDataError(
        failure.reason,
        f"within {seconds(TF_CACHE_NS)} of {unix_text(at)}: {failure.detail}; "
        "list_frames names the frames of all times",
    )


def _static_at(view: View, at: Ns, among: Session) -> list[StampedTransform]:
    """The static transforms of a session that hold at a moment."""
    return holding_at(statics(view, among), at)


def _stamped_near(view: View, at: Ns, among: Session) -> Iterator[StampedTransform]:
    """The dynamic transforms stamped around a moment, wherever in log time they were recorded.

    A bag is read where the stamps of its first and last message reach as far as the moment.
    """
    topics = _recorded(view, view.memory.limits.tf_topics)
    everything = TimeWindow.everything()
    for held in _holdings(view, topics, everything, among):
        ends = _stamps_at_ends(view, held.bag, topics)
        if ends and min(ends) - TF_CACHE_NS <= at <= max(ends) + TF_CACHE_NS:
            for found in view.bags.track_sources(view.bags.read(held.bag, topics, everything)):
                yield from _decoded(view, found, static=False)


def _stamps_at_ends(view: View, bag: BagFile, topics: Sequence[str]) -> list[Ns]:
    """The stamps in the bag's first and last message; of several topics in any order."""
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
        for transform in _decoded(view, found, static=False)
    ]


def _recorded(view: View, topics: Iterable[str]) -> tuple[str, ...]:
    known = set(view.snapshot.topics())
    return tuple(topic for topic in topics if topic in known)


def _transforms(
    view: View, topics: Iterable[str], window: TimeWindow, among: Session | None, *, static: bool
) -> Iterator[StampedTransform]:
    """The transforms in a window, in order; of a session the copies in its recordings too."""
    recorded = _recorded(view, topics)
    if not recorded:
        return
    if among is None:
        found = view.stream.messages(recorded, window)
    else:
        # A latched message that was received again counts in the recording that received it, too.
        holdings = _holdings(view, recorded, window, among)
        sessions = sessions_of(view)
        merged = view.stream.merged(holdings, recorded, window, newest_first=False)
        several = any(sessions.is_carried(held.bag) for held in holdings)
        tracked = view.bags.track_sources(merged)
        found = (each for each in tracked if not several or sessions.has(among, each))
    for each in found:
        yield from _decoded(view, each, static=static)


def _holdings(
    view: View, topics: Sequence[str], window: TimeWindow, among: Session
) -> list[BagSpan]:
    held = view.stream.overlapping_bags(topics, window)
    sessions = sessions_of(view)
    recordings = {each.bag.recording for each in held}
    chosen = {each for each in recordings if sessions.folder(each) in among}
    return [each for each in held if each.bag.recording in chosen]


def _is_among(view: View, bag: BagFile, among: Session | None) -> bool:
    return among is None or sessions_of(view).folder(bag.recording) in among


def _decoded(view: View, found: StoredMessage, *, static: bool) -> tuple[StampedTransform, ...]:
    begin = time.perf_counter_ns()
    try:
        message = view.memory.reader.decode(found.record)
        return view.memory.extractor.transforms(message, found.time, static=static)
    except UndecodableError as error:
        view.notes.complete = False
        view.notes.add(f"messages of {error.topic} could not be decoded: {error.reason}")
        return ()
    finally:
        view.call.stages.add("extract", time.perf_counter_ns() - begin)

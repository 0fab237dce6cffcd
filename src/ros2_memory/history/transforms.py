"""Transforms between two frames, gathered from the history.

Windows are in log time. A moving transform is looked for close to the moment first, then further
away, up to the length of tf2's cache (10 s); a static one however far back it was recorded.
"""

from __future__ import annotations

from contextlib import suppress
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
from ros2_memory.columns.transforms import Pair, edges_in, stamped_between
from ros2_memory.core.arrays import rows_of
from ros2_memory.core.errors import NoDataError, NoDataReason, QueryTimeoutError
from ros2_memory.core.geometry import alike
from ros2_memory.core.model import StampedTransform, TimeWindow, Transform
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, MAX_NS, NS_PER_MS, NS_PER_S, Ns
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import seconds, unix_text
from ros2_memory.history.no_data import no_data_at, not_recorded, reason_between, reason_beyond
from ros2_memory.history.scan import of_columns, scan

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.units import Rows
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import Mask

_HALF_WIDTHS: Final[tuple[Ns, ...]] = (500 * NS_PER_MS, 2_000 * NS_PER_MS, TF_CACHE_NS)
"""How far around the moment moving transforms are read; the last is the length of tf2's cache."""

_LONGER_NS: Final = 3600 * NS_PER_S
"""How far around the moment frames are looked for that are unknown then."""
_BORROWED: Final = Reason(
    "is placed by transforms of another recording of the same time; no handover proves that both "
    "are of one robot",
    "recording",
    many="are placed by transforms of others of the same time; no handovers prove that they are of "
    "one robot",
)
_OF_ALL_TIMES: Final = frozenset({NoDataReason.FRAME_UNKNOWN, NoDataReason.FRAMES_NOT_CONNECTED})
_STAMPS: Final = "transforms.header.stamp"


class FoundTransform(NamedTuple):
    """A transform, the clock in which the moment was meant, and how far around it was read."""

    transform: Transform
    clock: TfClock
    reach: Ns


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
    those of the session that was recorded then; of one that was within 10 s, if that has none.
    Where several were, and differ, a note reports it.
    The reason why there is none takes far longer to find: `explains=False` leaves it out.

    Raises:
        NoDataError: no transform is recorded, a frame is unknown, the frames are not connected,
            or no transform brackets the moment on one of the edges between them.
    """
    limits = view.limits
    if not view.moving_topics and not view.static_topics:
        raise not_recorded(view, limits.tf_topics[0] if limits.tf_topics else "/tf")
    frames, sessions = (parent, child), view.sessions
    if recording is not None:
        session = lending_to(view, recording, frames, at)
        return _transform_of_session(view, session, frames, at, explains=explains)
    groups = sessions.recorded_at(at)
    if groups is None:
        groups = [[session] for session in sessions.nearest_to(at)]
    answers: list[tuple[Session, FoundTransform]] = []
    failures: list[NoDataError] = []
    for group in groups or [[frozenset[str]()]]:
        for session in group:
            try:
                answer = _transform_of_session(view, session, frames, at, explains=explains)
                answers.append((session, answer))
            except NoDataError as error:
                # A traceback has this frame, which has the failures: they would stay for long.
                failures.append(error.with_traceback(None))
        if answers:
            break
    if not answers:
        raise failures.pop(0)
    _note_sessions(view, frames, at, answers)
    _, answer = answers[0]
    return answer


def _note_sessions(
    view: View, frames: tuple[str, str], at: Ns, answers: Sequence[tuple[Session, FoundTransform]]
) -> None:
    """Notes where sessions differ in a transform, of which the first counts, or are combined."""
    sessions, (session, counting) = view.sessions, answers[0]
    if not all(alike(counting.transform, answer.transform) for _, answer in answers):
        view.notes.add(
            f"{len(answers)} sessions recorded around that time have different transforms; "
            f"this is that of {sessions.names(session, at)}"
        )
    parts = sessions.parts.get(session, ())
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
    sessions = view.sessions
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
    static = static_at(view.sessions.static(session), at)

    def look_up(moving: Sequence[StampedTransform], reach: Ns = TF_CACHE_NS) -> FoundTransform:
        tree = frames_of(view, static, moving, parent)
        return FoundTransform(tree.lookup(child, at), tree.clock, reach)

    *shorter, longest = _HALF_WIDTHS
    for half_width in shorter:
        moving = view.sessions.moving(session, TimeWindow.around(at, half_width))
        with suppress(NoDataError):
            return look_up(moving, half_width)
    moving = view.sessions.moving(session, TimeWindow.around(at, longest))
    # Here, too, no variable has an error.
    try:
        return look_up(moving, longest)
    except NoDataError as error:
        if limits.tf_clock == "stamp":
            stamped = [*_stamped_near(view, at, session)]
            try:
                return look_up(stamped)
            except NoDataError as failure:
                raise _stamp_failure(failure, at, nothing_near=not stamped) from failure
        if not explains:
            raise
        raise _explain_failure(view, error, frames, at, session, nothing_near=not moving) from error


def frames_of(
    view: View,
    static: Sequence[StampedTransform],
    moving: Iterable[StampedTransform],
    target: str,
) -> FrameTree:
    """Returns frames in a target frame by some transforms, of which none holds on."""
    clock = view.limits.tf_clock
    return FrameTree(static, edges_of(moving), target, clock, AT_OR_BEFORE_SLACK_NS)


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
    topics = view.moving_topics
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
        return NoDataError(reason_between(view, near), f"{then.detail}; {advice}")
    inside = (
        topics
        and view.stream.first(topics, TimeWindow.until(at), newest_first=True)
        and view.stream.first(topics, TimeWindow(at + 1, MAX_NS))
    )
    reason = reason_between(view, near) if inside else reason_beyond(view, at)
    return NoDataError(reason, failure.detail)


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
    sessions, linked = view.sessions, view.sessions.linked
    origin, target = (name.lstrip("/") for name in frames)
    if (frames, session) in linked:
        return True
    pairs: set[Pair] = set()
    by_topic = [
        *(sessions.pairs_back(topic, session) for topic in view.static_topics),
        *(sessions.pairs_back(topic, session, window) for topic in view.moving_topics),
    ]
    # Of all topics in turn: mostly the newest table of each is enough.
    for newest_pairs in zip_longest(*by_topic, fillvalue=frozenset[Pair]()):
        fresh = frozenset[Pair]().union(*newest_pairs)
        if not fresh <= pairs:
            pairs |= fresh
            named = ((parent.lstrip("/"), child.lstrip("/")) for parent, child in pairs)
            if target in connected_with(origin, filter(is_edge, named)):
                if window is None:
                    linked.add((frames, session))
                return True
    return False


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
    sessions = view.sessions
    earliest, latest = at - TF_CACHE_NS, at + TF_CACHE_NS

    def may_match(parts: PartZones) -> Mask:
        zones = parts.zone(_STAMPS)
        return zones.reaches(earliest - 1, above=True) & zones.reaches(latest + 1, above=False)

    def near(rows: Rows) -> Rows | None:
        stamped = stamped_between(rows.table, rows.index, earliest, latest)
        return None if stamped is None else rows.some(stamped)

    everything = TimeWindow.everything()
    for topic in view.moving_topics:
        for rows in scan(view, topic, everything, copies=True, may_match=may_match):
            if sessions.may_hold(session, rows.recording):
                for near_rows in of_columns(view, rows, near) or [rows]:
                    yield from sessions.received(session, near_rows)


def edges_of_rows(view: View, rows: Rows, session: Session) -> Edges:
    """Returns the transforms of a session in some rows, by their columns, else by their messages.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    sessions = view.sessions
    if not sessions.may_hold(session, rows.recording):
        return {}
    tables = None
    if not sessions.holds_carried(rows.recording):
        tables = of_columns(view, rows, lambda part: edges_in(part.table, part.times, part.index))
    if tables is None:
        return edges_of(sessions.received(session, rows))
    joined = joined_edges(tables)
    if len(tables) == 1:
        return joined
    # As those of bags come in the order of their log times.
    return {
        pair: rows_of(edge, np.argsort(edge.log_times, kind="stable"))
        for pair, edge in joined.items()
    }


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
    static = static_in(view.sessions.static(session), window)
    return FrameTree(static, joined_edges(moving), target, limits.tf_clock)

"""Transforms between two frames, gathered from the history.

Windows are in log time. Moving transforms are read close to the moment first, then further away, up
to the length of tf2's cache (10 s). A static transform holds however long ago it was recorded.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
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
from ros2_memory.core.text import Reason, listed
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    NS_PER_HOUR,
    NS_PER_MS,
    NS_PER_S,
    Ns,
)
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import seconds, unix_text
from ros2_memory.history.no_data import no_data_at, not_recorded, reason_between, reason_beyond
from ros2_memory.history.scan import of_columns, scan

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.stored import PartZones
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import Mask

_HALF_WIDTHS: Final[tuple[Ns, ...]] = (500 * NS_PER_MS, 2_000 * NS_PER_MS, TF_CACHE_NS)
"""How far around the moment moving transforms are read, until they lead to the frame."""

_BORROWED: Final = Reason(
    "is placed by transforms of another recording of the same time; no handover proves that both "
    "are of one robot",
    "recording",
    many="are placed by transforms of others of the same time; no handovers prove that they are of "
    "one robot",
)
_TIMELESS: Final = frozenset({NoDataReason.FRAME_UNKNOWN, NoDataReason.FRAMES_NOT_CONNECTED})
"""Reasons that read as if no time had the frames."""
_STAMPS: Final = "transforms.header.stamp"


class FoundTransform(NamedTuple):
    """A transform that was looked up at a moment.

    Attributes:
        transform: the transform.
        clock: the clock in which the moment was meant.
        around: how far around the moment (ns) transforms were read.
        late: how long after their stamps (ns) transforms were logged.
    """

    transform: Transform
    clock: TfClock
    around: Ns
    late: Ns


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

    A note reports if several sessions of that time have different transforms.

    Args:
        view: of the call.
        parent: the frame that the pose is in.
        child: the frame that is placed.
        at: the moment.
        recording: of a message: only transforms of its session count. Otherwise those of the
            session that was recorded then; if it has none, of a session within 10 s.
        explains: whether an error gives the reason by the whole memory, which takes far longer.

    Raises:
        NoDataError: no transform is recorded, a frame is unknown, the frames are not connected,
            or no transform brackets the moment on one of the edges between them.
    """
    limits = view.limits
    if not view.moving_topics and not view.static_topics:
        raise not_recorded(view, limits.tf_topics[0] if limits.tf_topics else "/tf")
    frames, sessions = (parent, child), view.sessions
    if recording is not None:
        session = session_placing(view, recording, frames, at)
        return _transform_of_session(view, session, frames, at, explains=explains)
    groups = sessions.recorded_at(at)
    if groups is None:
        groups = [[session] for session in sessions.nearest_to(at)]
    answers: list[tuple[Session, FoundTransform]] = []
    failures: list[NoDataError] = []
    # Without any session, the empty one gives the reason.
    for group in groups or [[frozenset[str]()]]:
        for session in group:
            try:
                answer = _transform_of_session(view, session, frames, at, explains=explains)
                answers.append((session, answer))
            except NoDataError as error:
                failures.append(error.detached())
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
    """Notes if sessions differ in a transform, or if two were combined; the first answer counts."""
    sessions, (session, first) = view.sessions, answers[0]
    if not all(alike(first.transform, answer.transform) for _, answer in answers):
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


def session_placing(view: View, recording: Path, frames: tuple[str, str], at: Ns) -> Session:
    """Returns the session whose transforms place a message of a recording.

    That is the recording's own session, or, with a note, the session joined with its lender, if
    only the latter leads from one frame to the other.
    """
    sessions = view.sessions
    joined, own = sessions.lending_to(recording, at), sessions.session_of(recording)
    if not joined or joined == own:
        return joined
    key = (joined, own, frames)
    if key not in sessions.chosen:
        sessions.chosen[key] = own
        leads_alone = connects_in_time(view, frames, session=own)
        if not leads_alone and connects_in_time(view, frames, session=joined):
            sessions.chosen[key] = joined
            lender = sessions.names(joined - own, at)
            view.notes.add(Note(_BORROWED, sessions.names(own, at), f"those of {lender}"))
    return sessions.chosen[key]


def _transform_of_session(
    view: View, session: Session, frames: tuple[str, str], at: Ns, *, explains: bool
) -> FoundTransform:
    """Returns the pose of a child in a parent by one session; raises as `transform_at`."""
    limits, (parent, child) = view.limits, frames
    static = static_at(view.sessions.static(session), at)

    def look_up(moving: Sequence[StampedTransform], reach: Ns = TF_CACHE_NS) -> FoundTransform:
        tree = frames_of(view, static, moving, parent)
        return FoundTransform(tree.lookup(child, at), tree.clock, reach, tree.late_ns)

    *shorter, longest = _HALF_WIDTHS
    for half_width in shorter:
        moving = view.sessions.moving(session, TimeWindow.around(at, half_width))
        with suppress(NoDataError):
            return look_up(moving, half_width)
    moving = view.sessions.moving(session, TimeWindow.around(at, longest))
    # No local variable may refer to an error: its traceback refers to this frame.
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
    """Returns the frame tree of some transforms, looked up in a target frame."""
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
    """Explains the failure of a lookup near a moment by the whole memory.

    A frame that is unknown near the moment, but known within an hour of it, is a gap.
    """
    topics, near = view.moving_topics, TimeWindow.around(at, TF_CACHE_NS)
    if topics and nothing_near:
        return no_data_at(view, topics, at, None, around=TF_CACHE_NS)
    if failure.reason in _TIMELESS:
        near_failure = _near_failure(failure, at)
        is_unknown = failure.reason is NoDataReason.FRAME_UNKNOWN
        connected = _nearest_connection(view, frames, at, session) if is_unknown else None
        if connected is None:
            return NoDataError(near_failure.reason, near_failure.detail + other_transforms(view))
        away = f"{seconds(abs(connected - at))} {'earlier' if connected < at else 'later'}"
        advice = f"the two were connected {away}: ask about {unix_text(connected)}"
        return NoDataError(reason_between(view, near), f"{near_failure.detail}; {advice}")
    before = view.stream.first(topics, TimeWindow.until(at), newest_first=True)
    is_between = before and view.stream.first(topics, TimeWindow(at + 1, MAX_NS))
    reason = reason_between(view, near) if is_between else reason_beyond(view, at)
    return NoDataError(reason, failure.detail)


def other_transforms(view: View) -> str:
    """Returns a clause that names recorded topics of transforms that are not read; "" without."""
    limits = view.limits
    others = [
        topic
        for topic, types in view.timeline.types.items()
        if topic not in {*limits.tf_topics, *limits.tf_static_topics}
        and any(name.endswith("/TFMessage") for name in types)
    ]
    if not others:
        return ""
    moving = "data.tf_topics, what is latched to data.tf_static_topics"
    return f"; transforms are recorded on {listed(others)}, too: add them to {moving}"


def _nearest_connection(view: View, frames: tuple[str, str], at: Ns, session: Session) -> Ns | None:
    """Returns when transforms next to a moment lead from one frame to the other, to 0.1 s.

    None if there are none within an hour.
    """

    def leads_until(other: Ns) -> bool:
        window = TimeWindow(min(at, other), max(at, other))
        return connects_in_time(view, frames, window, session)

    moments: list[Ns] = []
    for direction in (-1, 1):
        if not leads_until(at + direction * NS_PER_HOUR):
            continue
        near, far = 0, NS_PER_HOUR
        while far - near > NS_PER_S // 10:
            middle = (near + far) // 2
            near, far = (near, middle) if leads_until(at + direction * middle) else (middle, far)
        moments.append(at + direction * far)
    return min(moments, key=lambda moment: abs(moment - at), default=None)


def connects_in_time(
    view: View,
    frames: tuple[str, str],
    window: TimeWindow | None = None,
    session: Session | None = None,
) -> bool:
    """Does `connects`; returns False if the call's time is over before that is known."""
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
    """Whether transforms of a session, or of any, lead from one frame to the other.

    Moving transforms count only in the window; the newest are read first.

    Raises:
        QueryTimeoutError: the call's time is over before that is known.
    """
    sessions, linked = view.sessions, view.sessions.linked
    origin, target = (name.lstrip("/") for name in frames)
    if window is None and (frames, session) in linked:
        return True
    pairs: set[Pair] = set()
    by_topic = [
        *(sessions.pairs_back(topic, session) for topic in view.static_topics),
        *(sessions.pairs_back(topic, session, window) for topic in view.moving_topics),
    ]
    # One table of each topic at a time: mostly the newest of each is enough.
    for tables in zip_longest(*by_topic):
        more = frozenset[Pair]().union(*(table for _, table in filter(None, tables)))
        if more <= pairs:
            continue
        pairs |= more
        named = ((parent.lstrip("/"), child.lstrip("/")) for parent, child in pairs)
        if target in connected_with(origin, filter(is_edge, named)):
            if window is None:
                linked.add((frames, session))
            return True
    return False


def _stamp_failure(failure: NoDataError, at: Ns, *, nothing_near: bool) -> NoDataError:
    """Explains the failure of a lookup by header stamps: log times do not matter."""
    if nothing_near:
        return NoDataError(
            NoDataReason.OUTSIDE_RANGE,
            f"no moving transform has a header stamp within {seconds(TF_CACHE_NS)} of "
            f"{unix_text(at)}; data.tf_clock selects transforms by header stamp, not by log time",
        )
    return _near_failure(failure, at) if failure.reason in _TIMELESS else failure


def _near_failure(failure: NoDataError, at: Ns) -> NoDataError:
    """Returns a failure with the time that it is about."""
    return NoDataError(
        failure.reason,
        f"within {seconds(TF_CACHE_NS)} of {unix_text(at)}: {failure.detail}; "
        "list_frames names the frames of all times",
    )


def _stamped_near(view: View, at: Ns, session: Session) -> Iterator[StampedTransform]:
    """Yields the moving transforms of a session that are stamped around a moment.

    They may be anywhere in log time.
    """
    sessions = view.sessions
    earliest, latest = at - TF_CACHE_NS, at + TF_CACHE_NS

    def may_match(parts: PartZones) -> Mask:
        zones = parts.zone(_STAMPS)
        return zones.reaches(earliest - 1, above=True) & zones.reaches(latest + 1, above=False)

    select_near = partial(stamped_between, earliest=earliest, latest=latest)
    everything = TimeWindow.everything()
    for topic in view.moving_topics:
        for rows in scan(view, topic, everything, copies=True, may_match=may_match):
            if not sessions.may_hold(session, rows.recording):
                continue
            for near_rows in of_columns(view, rows, select_near) or [rows]:
                yield from sessions.received(session, near_rows)


def edges_of_rows(view: View, rows: Rows, session: Session) -> Edges:
    """Returns the transforms of a session in rows, from their columns, else from their messages."""
    sessions = view.sessions
    if not sessions.may_hold(session, rows.recording):
        return {}
    tables = None
    if not sessions.holds_carried(rows.recording):
        tables = of_columns(view, rows, edges_in)
    if tables is None:
        return edges_of(sessions.received(session, rows))
    joined = joined_edges(tables)
    if len(tables) == 1:
        return joined
    # Several bags were decoded, not in the order of time.
    return {
        pair: rows_of(edge, np.argsort(edge.log_times, kind="stable"))
        for pair, edge in joined.items()
    }


def frames_over(view: View, session: Session, window: TimeWindow, target: str) -> FrameTree:
    """Returns the frame tree of a session in a window, looked up in a target frame.

    It does not depend on how the history is cut into windows: moving transforms are also read
    around the window, and static ones hold from when they were received.
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

"""The driven path in a window, by the poses of a topic or by transforms."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from itertools import chain, islice
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

import numpy as np

from ros2_memory.analysis.frames import is_odometry, joined_edges
from ros2_memory.analysis.motion.odometry import Leg, MotionTotals, NearbyMotion, TimedPosition
from ros2_memory.analysis.motion.path_length import Creep, End
from ros2_memory.analysis.motion.trajectory import (
    SLICE_NS,
    Line,
    PathSlice,
    joined_slices,
    path_slice,
)
from ros2_memory.analysis.poses import (
    NO_POSES,
    FrameCodes,
    Poses,
    joined_poses,
    placed_body,
    positions_apart,
)
from ros2_memory.columns.fragments import FragmentKey, FragmentKind, Sized
from ros2_memory.columns.pack import METRES
from ros2_memory.columns.poses import rounded
from ros2_memory.columns.scan import STRETCH_NS, Stretch
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    UndecodableError,
    to_report,
)
from ros2_memory.core.memo import Key
from ros2_memory.core.model import Pose, TimeWindow
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import MIN_NS, NS_PER_HOUR, Ns
from ros2_memory.history.context import READING_S
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.no_data import (
    describe_earlier_poses,
    describe_lack,
    no_data_between,
    resolve_pose_topic,
    resolve_topic,
    undecodable,
    with_notes,
)
from ros2_memory.history.poses import PoseReader, PoseRows
from ros2_memory.history.robots import ParallelRecordings, parallel_or_twice
from ros2_memory.history.scan import (
    blocks,
    joined_back,
    open_scan,
    read_until_late,
    remembered,
    scan,
)
from ros2_memory.history.sessions import Session, decoded_transforms
from ros2_memory.history.transforms import (
    connects_in_time,
    edges_of_rows,
    frames_of,
    frames_over,
    transform_at,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import FrameEdge
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View

T = TypeVar("T", bound="Sized")

_MOTION: Final = (PathSlice, Line, MotionTotals, Leg, TimedPosition, NearbyMotion, End, Creep)
PATHS: Final[FragmentKind[PathSlice]] = FragmentKind("path", (*_MOTION, Poses, FrameCodes))
"""The path of the poses of a topic in a slice of the clock."""
_MOST_TRIED: Final = 1000
"""How many of the newest messages are tried until one can be decoded, or places the robot."""
_BODIES: Final = ("base_footprint", "base_link", "base", "body")
"""Names of the frame of the robot's body, the likelier first."""
_LONGEST_H: Final = 64
"""In a bag that spans more hours a clock was set: decades may lie between two messages."""
_POSE_FRAMES: Final[Key[dict[str, str]]] = Key()
"""Of a view: by topic of poses, the frame of its newest pose."""
_OLDEST_FRAMES: Final[Key[dict[str, str]]] = Key()
"""Of a view: by topic of poses, the frame of its oldest pose; empty if that cannot be read."""


def driven_path(view: View, topic: str, window: TimeWindow) -> tuple[PathSlice | None, Ns | None]:
    """Returns `path_by_poses`; a note says how far back the path is known if time ran out."""
    path, since = path_by_poses(view, topic, window)
    if since is not None:
        view.notes.add_lack(
            f"the path is known back to {unix_text(since)}: out of time before older bags were read"
        )
    return path, since


def path_by_poses(view: View, topic: str, window: TimeWindow) -> tuple[PathSlice | None, Ns | None]:
    """Returns the path in a window by the poses of a topic, and since when it is known.

    The path is None without a message. The log time (ns) is None if all bags were read in time.
    Messages that cannot be decoded are left out, with a note.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
        NoDataError: no message can be decoded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    failures: list[UndecodableError] = []
    slices = slices_of_path(view, topic, window, failures)
    driven = ((at, part) for at, part in slices if part.poses or part.invalid)
    newest_first, since = read_until_late(view, driven, READING_S)
    if failures and not newest_first:
        failure = to_report(failures)
        raise with_notes(view, window, undecodable(failure)) from failure
    if failures:
        why = f"{len(failures)} ({to_report(failures).reason})"
        view.notes.add_lack(f"poses left out, since they cannot be decoded: {why}")
    fastest = view.limits.max_plausible_speed_mps
    return joined_slices(newest_first[::-1], fastest) if newest_first else None, since


def slices_of_path(
    view: View,
    topic: str,
    window: TimeWindow,
    failures: list[UndecodableError] | None = None,
) -> Iterator[tuple[Ns, PathSlice]]:
    """Yields the path in a window in slices, the newest first; see `slices_by_poses`."""
    fastest = view.limits.max_plausible_speed_mps
    return slices_by_poses(
        view,
        topic,
        window,
        PATHS,
        lambda pose_slice: path_slice(pose_slice.poses, fastest),
        failures=failures,
        settings=str(fastest),
    )


def slices_by_poses(
    view: View,
    topic: str,
    window: TimeWindow,
    kind: FragmentKind[T],
    make: Callable[[PoseSlice], T],
    *,
    failures: list[UndecodableError] | None = None,
    beside: Ns = 0,
    settings: str = "",
) -> Iterator[tuple[Ns, T]]:
    """Makes something of each slice of the robot's poses, and yields it, the newest slice first.

    With each comes the log time (ns) at which its slice begins, or its stretch, if what was made of
    a whole stretch is stored. If two recordings have different poses for one time, or one recording
    has the time twice, the poses of the first count.

    Args:
        view: of the call.
        topic: of the poses; a topic of transforms stands for the poses of the robot's body.
        window: of log time.
        kind: the kind of what is made, for the store.
        make: makes it.
        failures: messages that cannot be decoded are added to it.
        beside: how far before and after a slice (ns) `make` sees poses, too.
        settings: what the result depends on besides the poses.

    Raises:
        InvalidArgumentsError: while it is iterated, messages carry no position.
    """
    if topic in view.limits.tf_topics:
        for pose_slice in pose_slices(rows_of_body(view, window), beside):
            yield pose_slice.start, make(pose_slice)
        return
    parallel = () if view.call.stored else parallel_or_twice(view, topic, window)
    # Stored results are of whole parts, including the parts that the window cuts.
    reach = window.widened(2 * PART_NS) if view.call.stored else window
    opened = open_scan(view, topic, reach, stored=view.call.stored)
    reader = PoseReader(view, parallel, failures)

    def make_slices(stretch: Stretch) -> Iterator[tuple[Ns, T]]:
        rows = opened.rows(newest_first=True, among=stretch.window.widened(beside))
        read = map(reader.block, blocks(rows, newest_first=True))
        wanted = stretch.window if stretch.parts else stretch.window.intersect(window)
        needs_all = stretch.parts is not None or not view.call.stored
        for pose_slice in pose_slices(read, beside):
            inside = TimeWindow(pose_slice.start, pose_slice.stop)
            if wanted.intersect(inside).empty:
                continue
            key = pose_slice.key(settings)
            if needs_all or (key and opened.is_stored(inside.widened(beside))):
                # Earlier slices of the stretch are wanted next.
                before = min(max(pose_slice.start - stretch.window.start, 0), STRETCH_NS)
                made = remembered(view, kind, key, partial(make, pose_slice), also_before=before)
                yield pose_slice.start, made

    def key_of(stretch: Stretch) -> FragmentKey | None:
        return stretch.key(settings + _digest(parallel, stretch.window.widened(beside)))

    yield from joined_back(view, opened, kind, make_slices, key_of, beside=beside)


def _digest(parallel: Iterable[ParallelRecordings], window: TimeWindow) -> str:
    """Returns what tells apart which poses of a window do not count; empty if all do."""
    # The span is cut: it grows with each bag, and poses outside change nothing here.
    near = [
        (str(pair.other), pair.span.intersect(window), sorted(pair.bags))
        for pair in parallel
        if window.overlaps(pair.span.start, pair.span.stop - 1)
    ]
    return f" {sha256(repr(near).encode()).hexdigest()}" if near else ""


@dataclass(frozen=True, slots=True)
class PoseSlice:
    """The poses in a slice of the clock, and some poses beside it.

    Attributes:
        start: log time (ns) at which the slice begins.
        stop: log time at which it ends.
        beside: how far (ns) before and after it poses are included.
        blocks: the blocks that may have these poses, in order.
    """

    start: Ns
    stop: Ns
    beside: Ns
    blocks: Sequence[PoseRows]

    @property
    def poses(self) -> Poses:
        """The poses in the slice and beside it, in order; raises as `PoseRows.poses`."""
        start, stop = self.start - self.beside, self.stop + self.beside
        return joined_poses([block.poses.between(start, stop) for block in self.blocks])

    def key(self, settings: str) -> FragmentKey | None:
        """Returns the key for a fragment made of the poses; None if they are not of whole parts."""
        span = self.start - self.beside, self.stop + self.beside
        parts: list[int] = []
        for block in self.blocks:
            of_block = block.parts_between(*span)
            if of_block is None:
                return None
            parts += of_block
        return FragmentKey(self.start, settings, tuple(parts))


def pose_slices(newest_first: Iterable[PoseRows], beside: Ns) -> Iterator[PoseSlice]:
    """Yields the slices of the clock that may have poses, the newest first.

    Args:
        newest_first: blocks of poses.
        beside: how far (ns) before and after a slice poses are included.
    """
    recent: list[PoseRows] = []  # blocks that a waiting slice may need, the newest first
    waiting: set[int] = set()  # numbers of slices whose older poses have not been seen yet
    for block in chain(newest_first, [None]):
        if block is not None:
            newest = max(waiting, default=block.last // SLICE_NS)
            needed_until = (newest + 1) * SLICE_NS + beside
            recent = [newer for newer in recent if newer.first < needed_until]
            recent.append(block)
            waiting.update(block.slices(SLICE_NS))
        seen_back_to = MIN_NS if block is None else block.first
        for number in sorted(waiting, reverse=True):
            start, stop = number * SLICE_NS, (number + 1) * SLICE_NS
            first, last = start - beside, stop + beside
            if first < seen_back_to:
                break
            waiting.discard(number)
            near = [rows for rows in reversed(recent) if rows.last >= first and rows.first < last]
            yield PoseSlice(start, stop, beside, near)


def note_left_out(view: View, error: UndecodableError) -> None:
    """Notes that poses cannot be decoded, and why."""
    view.notes.add_lack(
        f"poses of {error.topic} left out, since they cannot be decoded: {error.reason}"
    )


def frame_of_newest_pose(view: View, topic: str) -> str:
    """Returns the frame of the newest pose that can be decoded; empty without a pose.

    A topic of transforms has the frame of odometry. Remembers the frame for the call.

    Raises:
        InvalidArgumentsError: the topic's messages carry no position.
        UndecodableError: no message among the newest can be decoded.
    """
    frames = view.memo.of(_POSE_FRAMES, dict)
    if topic not in frames:
        body = body_of(view, topic)
        frames[topic] = _frame_of_newest(view, topic) if body is None else body.odometry
    return frames[topic]


def frame_of_oldest_pose(view: View, topic: str) -> str:
    """Returns the frame of a topic's oldest pose, which a robot may have had before an update.

    Empty if it cannot be read; no note says so. Remembers the frame for the call.
    """
    frames = view.memo.of(_OLDEST_FRAMES, dict)
    if topic not in frames:
        noted_before = view.notes.so_far()
        oldest = view.stream.first([topic], TimeWindow.everything())
        message = view.bags.decode(oldest)
        pose = None if oldest is None else view.extractor.pose(message, oldest.type)
        frames[topic] = "" if pose is None else pose.frame_id.lstrip("/")
        view.notes.retract_outside(keep=noted_before)
    return frames[topic]


def _frame_of_newest(view: View, topic: str) -> str:
    failures: list[UndecodableError] = []
    newest = view.stream.messages([topic], TimeWindow.everything(), newest_first=True)
    for stored, message in view.bags.decoded(islice(newest, _MOST_TRIED), failures):
        pose = view.extractor.pose(message, stored.type)
        if pose is None:
            raise InvalidArgumentsError(describe_lack(view, "position", stored))
        if failures:
            note_left_out(view, failures[0])
        return pose.frame_id.lstrip("/")
    if failures:
        raise failures[0]
    return ""


class Body(NamedTuple):
    """The robot's body among the frames that move.

    Attributes:
        parent: the map, or the root of its frames.
        child: the frame of the body.
        above: the frames above it, the nearest first.
        odometry: the frame in which its path is measured: a correction of the map is not driven.
            `parent` if there is none of odometry.
        beside: frames that are the bodies of other robots, by their names.
    """

    parent: str
    child: str
    above: tuple[str, ...]
    odometry: str
    beside: tuple[str, ...]


_ROBOT_BODIES: Final[Key[dict[Session | None, Body | None]]] = Key()
"""Of a view: by session its `robot_body`, and by None the newest one."""


def robot_body(view: View, session: Session | None = None) -> Body | None:
    """Returns the robot's body by its transforms; None if none of them moves it.

    The same frame is its body in all sessions. What is above it is asked of a session, without one
    of the newest that moves it: another run may have other parents.
    """
    bodies = view.memo.of(_ROBOT_BODIES, dict)
    if session not in bodies:
        newest = _newest_body(view) if session is None else robot_body(view)
        if session is not None and newest is not None:
            bodies[session] = _body_of_edges(view, view.sessions.edges(session), newest.child)
        else:
            bodies[session] = newest
    return bodies[session]


def _newest_body(view: View) -> Body | None:
    """Returns the body by the transforms of the newest session that moves it."""
    body = _body_of_edges(view, view.sessions.edges())
    if body is None:
        return None
    recordings = chain.from_iterable(
        view.timeline.recordings(topic).items() for topic in view.moving_topics
    )
    for path, _ in sorted(recordings, key=lambda recording: recording[1][1], reverse=True):
        edges = view.sessions.edges(view.sessions.session_of(path))
        newest = _body_of_edges(view, edges, body.child)
        if newest is not None:
            return newest._replace(beside=body.beside)
    return body


def _body_of_edges(view: View, edges: Sequence[FrameEdge], child: str | None = None) -> Body | None:
    """Returns the body with a frame by some pairs of frames; None if they do not move it.

    Without a `child` it is found by its name (`_BODIES`), else it is the moving frame that is
    nearest to the root.
    """
    # If a frame is static in one parent and moves in another, the latter counts.
    static_first = sorted(edges, key=attrgetter("static"), reverse=True)
    parents = {edge.child: edge.parent for edge in static_first}
    above = {edge.child: _ancestors(edge.child, parents) for edge in edges if not edge.static}
    if not above or child not in (None, *above):
        return None
    map_frame = view.limits.map_frame
    body = child or min(
        above, key=lambda name: (_body_rank(name, map_frame), len(above[name]), name)
    )
    root = map_frame if map_frame in above[body] else above[body][-1]
    odometry = next(filter(is_odometry, above[body]), root)
    beside = tuple(
        other
        for other in sorted(above)
        if _body_rank(other, map_frame) < len(_BODIES)
        and other not in (body, *above[body])
        and body not in above[other]
    )
    return Body(root, body, tuple(above[body]), odometry, beside)


def body_at(view: View, at: Ns) -> Body | None:
    """Returns the body by the transforms of the session that was recorded last before a moment."""
    stored = view.stream.first(view.moving_topics, TimeWindow.until(at), newest_first=True)
    if stored is None:
        return robot_body(view)
    session = view.sessions.lending_to(stored.recording, stored.time)
    return robot_body(view, session) or robot_body(view)


def root_above(view: View, frame: str) -> str | None:
    """Returns the frame that all frames above a frame lead to; None if there is none above it."""
    above = _ancestors(frame, {edge.child: edge.parent for edge in view.sessions.edges()})
    return above[-1] if above else None


def _ancestors(frame: str, parents: Mapping[str, str]) -> list[str]:
    """Returns the frames above a frame, the nearest first; stops at a loop."""
    frames: list[str] = []
    while frame in parents and parents[frame] not in frames:
        frame = parents[frame]
        frames.append(frame)
    return frames


def _body_rank(frame: str, map_frame: str | None) -> int:
    """Returns how unlikely a frame is the body: named bodies first, frames of the world last."""
    name = frame.rpartition("/")[2]
    if name == map_frame or is_odometry(frame):
        return len(_BODIES) + 1  # it moves only as the map is corrected
    return _BODIES.index(name) if name in _BODIES else len(_BODIES)


def body_of(view: View, topic: str) -> Body | None:
    """Returns the robot's body if the topic is one of transforms, else None."""
    return robot_body(view) if topic in view.limits.tf_topics else None


def body_by_transforms(view: View) -> Body | None:
    """Returns the robot's body if transforms place it; None if a topic of poses does.

    Transforms place it if no topic has its poses, or if the topic of poses that the question or
    `data.pose_topic` names is one of transforms.
    """
    body = body_of(view, view.followed or view.pose_topic)
    if body is None and view.followed is None and not view.has_poses:
        return robot_body(view)
    return body


def resolve_path_topic(view: View, name: str | None = None, *, degrees: bool = False) -> str:
    """Returns the topic that places the robot: a topic of poses, or, with a note, of transforms.

    With `degrees`, the topic of a satellite receiver if there is nothing else.

    Raises:
        NoDataError: as for `resolve_pose_topic`.
    """
    topics = view.moving_topics
    name = name or view.followed
    if name is None and view.pose_topic in topics:
        name = view.pose_topic
    body, why = None, ""
    if name is None:
        body, why = body_by_transforms(view), ": no topic has the robot's poses"
    elif name in topics:
        body = robot_body(view)
    if body is None:
        return resolve_pose_topic(view, name, degrees=degrees)
    view.notes.add(f"by transforms, of {body.child}{why}")
    if body.beside:
        view.notes.add(f"not of {listed(body.beside)}, as of other robots")
    return name or topics[0]


def follow(view: View, topic: str | None) -> str:
    """Returns the topic of the path, and makes the places of this call those of its poses.

    Args:
        view: of this call.
        topic: the topic that the question names; None for the robot's own.

    Raises:
        NoDataError: as for `resolve_pose_topic`.
    """
    if topic is not None:
        view.followed = resolve_topic(view, topic)
    return resolve_path_topic(view)


def newest_of_body(
    view: View,
    window: TimeWindow,
    frame_id: str | None = None,
    recording: Path | None = None,
) -> tuple[StoredMessage, Pose] | None:
    """Returns the newest transform in a window that places the robot's body, and its pose.

    The pose is in `frame_id`, by default in the `parent` of the body then. Only transforms of the
    session of a `recording` count, if it has any. None if the newest thousand place nothing.
    """
    topics, sessions = view.moving_topics, view.sessions
    messages = view.stream.messages(topics, window, newest_first=True)
    own_session = None if recording is None else sessions.session_of(recording)
    if own_session and sessions.recordings_of(own_session, topics):
        messages = (stored for stored in messages if sessions.has(own_session, stored))
    leads: dict[Session, bool] = {}
    for stored in islice(messages, _MOST_TRIED):
        recorded_in = stored.recording
        session = sessions.lending_to(recorded_in, stored.time)
        body = robot_body(view, session)
        if body is None or not leads.get(session, True):
            continue
        parent = frame_id or body.parent
        for transform in decoded_transforms(view, [stored]):
            if transform.child.lstrip("/") != body.child:
                continue
            clock = frames_of(view, (), [transform], parent).clock
            moment = transform.stamp if clock == "stamp" else transform.log_time
            # If no transforms lead to the parent now, they may have at an older moment.
            with suppress(NoDataError):
                placed = transform_at(
                    view, parent, body.child, moment, recorded_in, explains=False
                ).transform
                return stored, Pose(placed.translation, placed.rotation, parent)
            if session not in leads:
                leads[session] = connects_in_time(view, (parent, body.child), session=session)
    return None


def no_path(view: View, topic: str, window: TimeWindow) -> NoDataError:
    """Returns the error for a window without a pose that counts for a path.

    In a file in which the clock was set back, no pose of a time that it has twice counts.
    """
    twice = [pair for pair in parallel_or_twice(view, topic, window) if pair.is_twice]
    if twice:
        return NoDataError(
            NoDataReason.MIXED,
            f"{twice[0].describe_by_clock(topic)}: which poses belong to one path is not known; "
            "get_topic_in_range has the messages",
        )
    is_body = topic in view.limits.tf_topics
    topics = view.moving_topics if is_body else (topic,)
    newest = view.stream.first(topics, window, newest_first=True)
    body = body_at(view, newest.time) if newest is not None and is_body else None
    if newest is None or (is_body and body is None):
        error = no_data_between(view, (topic,), window)
        detail = error.detail + describe_earlier_poses(view, topic, window.stop)
        return NoDataError(error.reason, detail, error.notes)
    lack = "has a valid position"
    if body is not None:
        lack = f"places {body.child}"
        try:
            transform_at(view, body.odometry, body.child, newest.time, newest.recording)
        except NoDataError as error:
            if error.reason is NoDataReason.FRAME_UNKNOWN:
                return with_notes(view, window, error)
    start, end = map(unix_text, window.asked())
    detail = f"no message of {topic} between {start} and {end} {lack}"
    return with_notes(view, window, NoDataError(NoDataReason.GAP, detail))


def rows_of_body(view: View, window: TimeWindow) -> Iterator[PoseRows]:
    """Yields the poses of the robot's body by transforms, the newest first; none without a body.

    They are in the frame of its odometry, at most twenty a second. Each block is an hour, and is
    read when its poses are asked for.

    Raises:
        QueryTimeoutError: while it is iterated or a block is read, the call's time is over.
    """
    if robot_body(view) is None:
        return
    hours = set(chain.from_iterable(_hours_of(view, topic, window) for topic in view.moving_topics))
    for hour in sorted(hours, reverse=True):
        piece = TimeWindow(hour * NS_PER_HOUR, (hour + 1) * NS_PER_HOUR).intersect(window)
        if not piece.empty:
            yield PoseRows(piece.start, piece.stop - 1, partial(_poses_of_body, view, piece))


def _hours_of(view: View, topic: str, window: TimeWindow) -> set[int]:
    """Returns the hours of a window, counted from the epoch, that may have messages of a topic."""
    hours: set[int] = set()
    firsts, lasts = (times // NS_PER_HOUR for times in view.bounds(topic, window))
    is_short = lasts - firsts <= _LONGEST_H
    for first, last in zip(firsts[is_short].tolist(), lasts[is_short].tolist(), strict=True):
        hours.update(range(first, last + 1))
    if is_short.all():
        return hours
    for extent in view.timeline.extents(topic, window):
        if extent.last // NS_PER_HOUR - extent.first // NS_PER_HOUR > _LONGEST_H:
            for table in view.bags.tables(extent.bag, topic, window, columns=False):
                hours.update(np.unique(table.log_times // NS_PER_HOUR).tolist())
    return hours


def _poses_of_body(view: View, window: TimeWindow) -> Poses:
    """Returns the poses of the body in a window, by the transforms of all sessions.

    A note names sessions that have transforms then, and none that places it.
    """
    bags = view.stream.overlapping_bags(view.moving_topics, window)
    sessions = dict.fromkeys(view.sessions.session_of(span.bag.recording) for span in bags)
    of_sessions = {session: poses_by_session(view, window, session) for session in sessions}
    poses = joined_poses([*of_sessions.values()])
    for session in sessions:
        if robot_body(view, session) is None:
            names = view.sessions.names(session, window.start)
            view.notes.add(
                f"transforms of {names} are left out: none of them moves the robot's body"
            )
    return poses.rows(positions_apart(poses.times))


def poses_by_session(view: View, window: TimeWindow, session: Session) -> Poses:
    """Returns the poses of the body in a window by the transforms of a session, in order of time.

    They are in the frame of its odometry; none if no transforms lead there.
    """
    body = robot_body(view, session)
    if body is None:
        return NO_POSES
    scanned = chain.from_iterable(scan(view, topic, window) for topic in view.moving_topics)
    edges = joined_edges([edges_of_rows(view, rows, session) for rows in scanned])
    poses = placed_body(
        edges, body.child, frames_over(view, session, window, body.odometry), window
    )
    return replace(poses, positions=rounded(poses.positions, METRES))

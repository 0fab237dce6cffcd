"""The driven path in a window, by the poses of a topic, or by transforms."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from itertools import chain, islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

import numpy as np

from ros2_memory.analysis.frames import Edges, FrameTree, joined_edges
from ros2_memory.analysis.motion.trajectory import (
    SLICE_NS,
    PathSlice,
    Trajectory,
    joined_slices,
    path_slice,
)
from ros2_memory.analysis.poses import NO_POSES, FrameCodes, Poses, joined_poses
from ros2_memory.columns.fragments import FragmentKey, FragmentKind, Sized
from ros2_memory.columns.kinds import PATHS
from ros2_memory.columns.poses import rounded
from ros2_memory.columns.scan import STRETCH_NS, Stretch
from ros2_memory.columns.steps import METRES
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    UndecodableError,
)
from ros2_memory.core.memo import Key
from ros2_memory.core.model import Pose, TimeWindow
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns
from ros2_memory.history.context import READING_S
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.no_data import (
    describe_lack,
    resolve_pose_topic,
    undecodable,
    with_notes,
)
from ros2_memory.history.poses import PoseReader, PoseRows
from ros2_memory.history.robots import parallel_or_twice
from ros2_memory.history.scan import blocks, in_time, joined_back, open_scan, remembered, scan
from ros2_memory.history.sessions import Session, decoded_transforms
from ros2_memory.history.transforms import (
    edges_of_rows,
    frames_of,
    frames_over,
    transform_at,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray

T = TypeVar("T", bound="Sized")

_MOST_TRIED: Final = 1000
"""How many of the newest poses are tried until one can be decoded."""
_BODIES: Final = ("base_footprint", "base_link")
_READ_NS: Final = 3600 * NS_PER_S
"""Transforms are read an hour (log time) at once."""
_LONGEST_H: Final = 64
"""Where a bag spans more hours a clock was set in it: decades may lie between two messages."""
_STEP_NS: Final = NS_PER_S // 20
"""Poses by transforms are no closer than this."""
_POSE_FRAMES: Final[Key[dict[str, str]]] = Key()
"""Of a call: the frames of topics of poses."""


def driven_path(view: View, topic: str, window: TimeWindow) -> tuple[PathSlice | None, Ns | None]:
    """Does as `path_by_poses`; a note says how far back the path is known if not all was read."""
    path, since = path_by_poses(view, topic, window)
    if since is not None:
        view.notes.add_lack(
            f"the path is known back to {unix_text(since)}: out of time before older bags were read"
        )
    return path, since


def path_by_poses(view: View, topic: str, window: TimeWindow) -> tuple[PathSlice | None, Ns | None]:
    """Returns the path in a window by the poses of one topic; None where there is no message.

    And from which log time (ns) on it is known, where older bags were not read. Messages that
    cannot be decoded are left out, with a note.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
        NoDataError: no message can be decoded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    failures: list[UndecodableError] = []
    timed = slices_of_path(view, topic, window, failures)
    drawn = ((at, part) for at, part in timed if part.poses or part.invalid)
    slices, since = in_time(view, drawn, READING_S)
    if failures and not slices:
        raise with_notes(view, window, undecodable(failures[0])) from failures[0]
    if failures:
        why = f"{len(failures)} ({failures[0].reason})"
        view.notes.add_lack(f"poses left out, since they cannot be decoded: {why}")
    fastest = view.limits.max_plausible_speed_mps
    return joined_slices(slices[::-1], fastest) if slices else None, since


def slices_of_path(
    view: View,
    topic: str,
    window: TimeWindow,
    failures: list[UndecodableError],
) -> Iterator[tuple[Ns, PathSlice]]:
    """Yields the path in a window in slices, the newest first; see `slices_by_poses`."""
    fastest = view.limits.max_plausible_speed_mps
    return slices_by_poses(
        view,
        topic,
        window,
        PATHS,
        lambda piece: path_slice(piece.poses, fastest),
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
    failures: list[UndecodableError],
    beside: Ns = 0,
    settings: str = "",
) -> Iterator[tuple[Ns, T]]:
    """Yields what `make` returns of the robot's poses, slice by slice of the clock, newest first.

    Each with a time (log time, ns) that no pose of it is earlier than. Of a topic of transforms
    they are the poses of the robot's body. Where two recordings have poses of their own, or one has
    a time twice, they are those that come first.

    Args:
        view: of the call.
        topic: of the poses.
        window: of log time.
        kind: what is made; it is stored, and joined by stretches of the clock.
        make: makes it.
        failures: as for `pose_rows`.
        beside: poses so far before and after a slice (ns) are with it, too.
        settings: what it depends on besides the poses.

    Raises:
        InvalidArgumentsError: while it is iterated, messages carry no position.
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    if topic in view.limits.tf_topics:
        for pose_slice in pose_slices(rows_of_body(view, window), beside):
            yield pose_slice.start, make(pose_slice)
        return
    twice = () if view.call.stored else parallel_or_twice(view, topic, window)
    # What is stored follows from whole parts: also from those that the window cuts.
    reach = window.widened(2 * PART_NS) if view.call.stored else window
    opened = open_scan(view, topic, reach, stored=view.call.stored)
    reader = PoseReader(view, failures, twice)

    def made_in(stretch: Stretch) -> Iterator[tuple[Ns, T]]:
        around = stretch.window.widened(beside)
        rows = opened.rows(newest_first=True, among=around)
        read = map(reader.block, blocks(rows, newest_first=True))
        wanted = stretch.window if stretch.parts else stretch.window.intersect(window)
        needs_all = stretch.parts is not None or not view.call.stored
        for pose_slice in pose_slices(read, beside):
            inside = TimeWindow(pose_slice.start, pose_slice.stop)
            key = pose_slice.key(settings)
            may_be_made = needs_all or (key and opened.is_stored(inside.widened(beside)))
            if may_be_made and not wanted.intersect(inside).empty:
                # Those before it in the stretch are wanted next.
                before = min(max(pose_slice.start - stretch.window.start, 0), STRETCH_NS)
                yield (
                    pose_slice.start,
                    remembered(view, kind, key, partial(make, pose_slice), also_before=before),
                )

    def key_of(stretch: Stretch) -> FragmentKey | None:
        around = stretch.window.widened(beside)
        # Not the whole span: it grows with each bag, and poses beyond change nothing here.
        near = [
            (str(pair.other), pair.span.intersect(around), sorted(pair.bags))
            for pair in twice
            if around.overlaps(pair.span.start, pair.span.stop - 1)
        ]
        left_out = sha256(repr(near).encode()).hexdigest()
        return stretch.key(f"{settings} {left_out}" if near else settings)

    yield from joined_back(view, opened, kind, made_in, key_of, beside=beside)


@dataclass(frozen=True, slots=True)
class PoseSlice:
    """The poses in a slice of the clock, and those beside it.

    Attributes:
        start: log time (ns) where it begins.
        stop: where it ends.
        beside: how far before and after it (ns) poses are with it.
        blocks: of the poses.
    """

    start: Ns
    stop: Ns
    beside: Ns
    blocks: Sequence[PoseRows]

    @property
    def poses(self) -> Poses:
        """Those in the slice and beside it, in order; raises as `PoseRows.poses`."""
        start, stop = self.start - self.beside, self.stop + self.beside
        return joined_poses([block.poses.between(start, stop) for block in self.blocks])

    def key(self, settings: str) -> FragmentKey | None:
        """Returns the key of the poses in memory; None where not all of these parts are here."""
        span = self.start - self.beside, self.stop + self.beside
        parts: list[int] = []
        for block in self.blocks:
            of_block = block.parts_between(*span)
            if of_block is None:
                return None
            parts += of_block
        return FragmentKey(self.start, settings, tuple(parts))


def pose_slices(newest_first: Iterable[PoseRows], beside: Ns) -> Iterator[PoseSlice]:
    """Yields the slices of the clock in which there may be poses, the newest first.

    Args:
        newest_first: the poses.
        beside: poses so far before and after a slice (ns) are with it, too.
    """
    held: list[PoseRows] = []
    waiting: set[int] = set()
    for block in chain(newest_first, [None]):
        if block is not None:
            newest = max(waiting, default=block.last // SLICE_NS)
            held = [older for older in held if older.first < (newest + 1) * SLICE_NS + beside]
            held.append(block)
            waiting.update(block.slices(SLICE_NS))
        oldest = MIN_NS if block is None else block.first
        for number in sorted(waiting, reverse=True):
            start, stop = number * SLICE_NS, (number + 1) * SLICE_NS
            first, last = start - beside, stop + beside
            if first < oldest:
                break
            waiting.discard(number)
            near = [rows for rows in reversed(held) if rows.last >= first and rows.first < last]
            yield PoseSlice(start, stop, beside, near)


def length_notes(path: Trajectory) -> Iterator[str]:
    """Yields what is left out of the length of a path, and why it is not the sum of all steps."""
    totals = path.totals
    if path.invalid:
        poses = counted(path.invalid, "pose")
        yield f"{poses} left out: their coordinates are not valid (NaN or out of range)"
    if path.is_noisy:
        # Without the number, which the reply has, the note of several windows is one.
        yield (
            "the positions are noisy: distance_m leaves out what noise adds to the sum of all steps"
        )
    if path.avg_speed is None and path.poses:
        within = "" if path.poses == 1 else f" within {totals.duration_s:.3f} s"
        yield f"{counted(path.poses, 'pose')}{within}: too short to say how fast"
    if totals.is_uncertain:
        yield (
            "the positions are more than 0.25 s apart, and noise or sharp turns are a large part "
            "of the steps: distance_m may be too long, because noise cannot be removed"
        )
    if totals.gaps:
        without = "without a valid pose" if path.invalid else "without a pose"
        yield (
            f"{counted(totals.gaps, 'gap')} {without}, {totals.gap_m:.2f} m across in straight "
            "lines (gap_m): left out of distance_m"
        )
    if totals.jumps:
        yield (
            f"{counted(totals.jumps, 'jump')} of {totals.jumped_m:.2f} m in all, faster than is "
            "plausible, left out of distance and speed"
        )
    if totals.resets:
        yield (
            f"odometry restarted {counted(len(totals.resets), 'time')}: "
            "the jumps back to its origin are left out of distance and speed"
        )


def note_left_out(view: View, error: UndecodableError) -> None:
    """Notes that there are poses which cannot be decoded, and why."""
    view.notes.add_lack(
        f"poses of {error.topic} left out, since they cannot be decoded: {error.reason}"
    )


def frame_of_newest_pose(view: View, topic: str) -> str:
    """Returns the frame of the newest pose that can be decoded; empty without a pose.

    Raises:
        InvalidArgumentsError: the topic's messages carry no position.
        UndecodableError: none of the newest ones can be decoded.
    """
    frames = view.memo.of(_POSE_FRAMES, dict)
    if topic in frames:
        return frames[topic]
    body, failures = body_of(view, topic), list[UndecodableError]()
    frame = "" if body is None else body.odometry
    newest = view.stream.messages([topic], TimeWindow.everything(), newest_first=True)
    for stored in islice(newest, _MOST_TRIED if body is None else 0):
        message = view.bags.decode(stored, failures)
        if message is None:
            continue
        pose = view.extractor.pose(message, stored.type)
        if pose is None:
            raise InvalidArgumentsError(describe_lack(view, "position", stored))
        if failures:
            note_left_out(view, failures[0])
        frame = pose.frame_id.lstrip("/")
        break
    else:
        if failures:
            raise failures[0]
    frames[topic] = frame
    return frame


class Body(NamedTuple):
    """The robot's body among the frames that move: `child` in `parent`, and the other frames.

    `above`: the frames above it, the nearest first. `odometry`: in which its path is measured, as
    no correction of the map is driven: that of odometry, else `parent`. `beside`: the bodies of
    other robots, by their names.
    """

    parent: str
    child: str
    others: tuple[str, ...]
    above: tuple[str, ...]
    odometry: str
    beside: tuple[str, ...]


def robot_body(view: View) -> Body | None:
    """Returns the robot's body by its transforms; None where none of them moves.

    By its name (`base_footprint`, `base_link`), else what moves in the root itself; in the map, or
    in the root of its frames.
    """
    known_edges = view.sessions.edges
    parents = {edge.child: edge.parent for edge in known_edges}
    moving = [edge.child for edge in known_edges if not edge.static]
    if not moving:
        return None
    above = {child: _ancestors(child, parents) for child in moving}
    map_frame = view.limits.map_frame
    body = min(moving, key=lambda child: (_body_rank(child, map_frame), len(above[child]), child))
    root = map_frame if map_frame in above[body] else above[body][-1]
    odometry = next(filter(_is_odometry, above[body]), root)
    others = sorted({child for child in moving if child != body})
    named = (child for child in others if _body_rank(child, map_frame) < len(_BODIES))
    beside = (child for child in named if child not in above[body] and body not in above[child])
    return Body(root, body, tuple(others), tuple(above[body]), odometry, tuple(beside))


def _ancestors(frame: str, parents: Mapping[str, str]) -> list[str]:
    """Returns the frames above a frame, the nearest first; a loop ends it."""
    frames: list[str] = []
    while frame in parents and parents[frame] not in frames:
        frame = parents[frame]
        frames.append(frame)
    return frames


def _is_odometry(frame: str) -> bool:
    return frame.rpartition("/")[2].startswith("odom")


def _body_rank(frame: str, map_frame: str | None) -> int:
    """Returns how unlikely a frame is the body: named bodies first, frames of the world last."""
    name = frame.rpartition("/")[2]
    if name == map_frame or _is_odometry(frame):
        return len(_BODIES) + 1  # of the world: it moves as the map is corrected
    return _BODIES.index(name) if name in _BODIES else len(_BODIES)


def body_of(view: View, topic: str) -> Body | None:
    """Returns the robot's body where a topic is of transforms."""
    return robot_body(view) if topic in view.limits.tf_topics else None


def body_by_transforms(view: View) -> Body | None:
    """Returns the robot's body where transforms place it; None where a topic of poses does.

    They do where no topic has its poses, or where `data.pose_topic` is one of transforms.
    """
    return body_of(view, view.pose_topic) or (None if view.has_poses else robot_body(view))


def resolve_path_topic(view: View, name: str | None = None, *, degrees: bool = False) -> str:
    """Returns the topic of the robot's places: that of its poses, else with a note of transforms.

    With `degrees` that of a satellite receiver, where there is nothing else.

    Raises:
        NoDataError: as for `resolve_pose_topic`.
    """
    topics = view.moving_topics
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


def newest_of_body(
    view: View,
    body: Body,
    window: TimeWindow,
    frame_id: str | None = None,
    recording: Path | None = None,
) -> tuple[StoredMessage, Pose] | None:
    """Returns the newest transform in a window that places the robot's body, with its pose.

    In the map or the root of its frames, or in `frame_id`. Where the session of a `recording` has
    transforms, it is one of these.
    """
    parent, topics, sessions = frame_id or body.parent, view.moving_topics, view.sessions
    own_session = None if recording is None else sessions.of(recording)
    if own_session and not sessions.recordings_of(own_session, topics):
        own_session = None
    for stored in view.stream.messages(topics, window, newest_first=True):
        if own_session and not sessions.has(own_session, stored):
            continue
        recorded_in = stored.bag.recording
        for transform in decoded_transforms(view, [stored]):
            if transform.child.lstrip("/") != body.child:
                continue
            clock = frames_of(view, (), [transform], parent).clock
            moment = transform.stamp if clock == "stamp" else transform.log_time
            with suppress(NoDataError):  # no other transforms lead there: an older one may
                there = transform_at(
                    view, parent, body.child, moment, recorded_in, explains=False
                ).transform
                return stored, Pose(there.translation, there.rotation, parent)
    return None


def rows_of_body(view: View, window: TimeWindow) -> Iterator[PoseRows]:
    """Yields the poses of the robot's body by transforms, the newest first; none without a body.

    In the frame of its odometry, at most twenty a second. They are read as they are asked for, an
    hour at a time, and each may then raise QueryTimeoutError, as may the first step.
    """
    body = robot_body(view)
    hours: set[int] = set()
    for topic in () if body is None else view.moving_topics:
        firsts, lasts = (times // _READ_NS for times in view.bounds(topic, window))
        is_short = lasts - firsts <= _LONGEST_H
        for first, last in zip(firsts[is_short].tolist(), lasts[is_short].tolist(), strict=True):
            hours.update(range(first, last + 1))
        for bag, start, end in () if is_short.all() else view.timeline.extents(topic, window):
            if end // _READ_NS - start // _READ_NS > _LONGEST_H:
                for table in view.bags.tables(bag, topic, window, columns=False):
                    hours.update(np.unique(table.log_times // _READ_NS).tolist())
    for hour in sorted(hours, reverse=True):
        piece = TimeWindow(hour * _READ_NS, (hour + 1) * _READ_NS).intersect(window)
        if body is not None and not piece.empty:
            read = partial(_poses_of_body, view, piece, body)
            yield PoseRows(piece.start, piece.stop - 1, read)


def _poses_of_body(view: View, window: TimeWindow, body: Body) -> Poses:
    """Returns the poses of the body in a window, by the transforms of all sessions."""
    bags = view.stream.overlapping_bags(view.moving_topics, window)
    sessions = dict.fromkeys(view.sessions.of(span.bag.recording) for span in bags)
    poses = joined_poses([poses_by_session(view, window, each, body) for each in sessions])
    return poses.rows(_apart(poses.times))


def poses_by_session(view: View, window: TimeWindow, session: Session, body: Body) -> Poses:
    """Returns the poses of the body in a window, by the transforms of a session, in order of time.

    In the frame of its odometry; none where no transforms lead there.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    scanned = chain.from_iterable(scan(view, topic, window) for topic in view.moving_topics)
    edges = joined_edges([edges_of_rows(view, rows, session) for rows in scanned])
    poses = placed_body(
        edges, body.child, frames_over(view, session, window, body.odometry), window
    )
    return replace(poses, positions=rounded(poses.positions, METRES))


def placed_body(edges: Edges, child: str, frames: FrameTree, window: TimeWindow) -> Poses:
    """Returns where a body was in the target of frames whenever its transform was received.

    Where no transform leads to the target there is none, as before the first one of the map, or in
    a gap of these.
    """
    of_body = [edge for (_, name), edge in edges.items() if name == child]
    if not of_body:
        return NO_POSES
    times = np.concatenate([edge.log_times for edge in of_body])
    stamps = np.concatenate([edge.stamps for edge in of_body])
    order = np.argsort(times, kind="stable")
    first, end = np.searchsorted(times[order], (window.start, window.stop)).tolist()
    order = order[first:end]
    placed = frames.poses(child, (stamps if frames.clock == "stamp" else times)[order])
    if placed is None:
        return NO_POSES
    poses = Poses(
        times[order],
        np.stack(placed.translation, axis=1),
        np.stack(placed.rotation, axis=1),
        FrameCodes(np.zeros(order.size, np.uint32), (frames.target,)),
        np.full(order.size, np.nan),
    )
    return poses.rows(np.flatnonzero(placed.valid))


def _apart(times: IntArray) -> IntArray:
    """Returns the positions of ascending times (ns), each `_STEP_NS` or more after the last."""
    last, positions = MIN_NS, list[int]()
    for position, time in enumerate(times.tolist()):
        if time - last >= _STEP_NS:
            last = time
            positions.append(position)
    return np.array(positions, np.int64)

"""Where the robot was in one frame over many bags.

Transforms place the poses of each table in the frame, which gives a `PartialTrack`.
`joined_tracks` joins these. The track of a whole part of the store is stored beside the part, so a
second question about a week takes a tenth of a second.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import (
    TF_CACHE_NS,
    Floats,
    FrameTree,
    static_in,
)
from ros2_memory.analysis.intervals import SILENCE_NS, pieces_of
from ros2_memory.analysis.motion.robot_track import (
    TRACK_SLICE_NS,
    PartialTrack,
    RobotTrack,
    joined_tracks,
    partial_track,
    settled_tracks,
    track_by,
)
from ros2_memory.analysis.poses import Poses, headings, placed_body
from ros2_memory.columns.fragments import FragmentKey, FragmentKind
from ros2_memory.columns.pack import QUATERNION
from ros2_memory.columns.store import relative
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.arrays import Flags, Ints, stable_order
from ros2_memory.core.errors import QueryTimeoutError, to_report
from ros2_memory.core.geometry import multiply
from ros2_memory.core.memo import Key
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.context import Note
from ros2_memory.history.driven_path import (
    body_by_transforms,
    frame_of_newest_pose,
    frame_of_oldest_pose,
    note_left_out,
)
from ros2_memory.history.poses import PoseReader
from ros2_memory.history.robots import recordings_apart, times_recorded_twice
from ros2_memory.history.scan import (
    joined_back,
    open_scan,
    positions_in,
    read_until_late,
    remembered,
    scan,
)
from ros2_memory.history.transforms import edges_of_rows, frames_over, session_placing
from ros2_memory.places.stays import KnownTrack

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.scan import Scan, Stretch
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View

TRACKS: Final = FragmentKind("track", (PartialTrack,), settled_tracks)
"""Where the poses of a part have the robot in a frame; joined, those of a recording."""
_NOT_PLACED: Final = Reason(
    "has no transforms that place its poses: they are left out",
    "recording",
    many="have no transforms that place their poses: they are left out",
)
_READING_S: Final = 10.0
"""How long a call reads and places poses before it answers with those that it has."""


_KNOWN: Final[Key[dict[tuple[str, TimeWindow], KnownTrack]]] = Key()
"""Remembered for a call: its tracks, by frame and window."""


class TrackReader:
    """Reads the track of the robot in one frame.

    It follows from the robot's poses or, if no topic has poses, from the transforms of its body.
    """

    def __init__(self, view: View, frame_id: str) -> None:
        self._view = view
        self._frame_id = frame_id
        body = body_by_transforms(view)
        topic = view.followed or view.pose_topic
        self._body = None if body is None else body.child
        self._topics = (topic,) if body is None else view.limits.tf_topics
        self._own_frame = frame_of_newest_pose(view, topic) if body is None else body.child
        # Before an update the robot may have published its poses in another frame.
        self._is_own = (
            body is None
            and self._own_frame == frame_id
            and frame_of_oldest_pose(view, topic) == frame_id
        )
        # Of a time that files have twice, those from before count, as for the path.
        everything = TimeWindow.everything()
        self._twice = [*times_recorded_twice(view, everything, within_bags=False)]
        self._reader = PoseReader(view, self._twice)

    def track_in(self, window: TimeWindow) -> KnownTrack:
        """Returns the track in a window, and a little beyond it.

        Raises:
            InvalidArgumentsError: messages of the pose topic carry no position.
            QueryTimeoutError: the call's time runs out before any result.
        """
        view, key = self._view, (self._frame_id, window)
        known = view.memo.of(_KNOWN, dict)
        if key in known:
            return known[key]
        # Poses up to `SILENCE_NS` outside decide whether the track goes on at the window's ends.
        # Whole slices are read, so that no vertex depends on the window.
        around = window.widened(SILENCE_NS).aligned(TRACK_SLICE_NS)
        try:
            tracks, since = read_until_late(view, self._tracks_back(around), _READING_S)
        except QueryTimeoutError as error:
            raise QueryTimeoutError(
                f"the question needs more time; {view.bags.filling_progress()}"
                "ask about a shorter window"
            ) from error
        if self._reader.failures:
            note_left_out(view, to_report(self._reader.failures))
        left_out = sum(track.left_out for track in tracks)
        track, others = self._tracks_of_robots(tracks, around)
        known[key] = KnownTrack(track, since, left_out, others)
        return known[key]

    def _tracks_of_robots(
        self, tracks: Sequence[PartialTrack], window: TimeWindow
    ) -> tuple[RobotTrack, tuple[RobotTrack, ...]]:
        """Returns `KnownTrack.track` and `KnownTrack.others`, of tracks given newest first."""
        apart = recordings_apart(self._view, self._topics, window)
        root = str(self._view.bag_dir)
        names = None if apart is None else {relative(str(path), root) for path in apart}
        whole, recordings, is_beside = _joined_recordings(tracks, names)
        fastest_mps = self._view.limits.max_plausible_speed_mps

        def robot_track(vertices: Flags) -> RobotTrack:
            index = np.flatnonzero(vertices)
            return track_by(whole.vertices(index), recordings[index], fastest_mps)

        numbers = np.unique(recordings[is_beside])
        others = (robot_track(is_beside & (recordings == number)) for number in numbers)
        return robot_track(~is_beside), tuple(others)

    def make_tracks(self, window: TimeWindow) -> Iterator[Ns]:
        """Makes and stores the tracks of parts in a window and beside it, newest first.

        Yields a log time (ns) of each.

        Raises:
            InvalidArgumentsError: messages of the pose topic carry no position.
            QueryTimeoutError: the call's time runs out.
        """
        return (at for at, _ in self._tracks_back(window.widened(2 * PART_NS)))

    def _tracks_back(self, window: TimeWindow) -> Iterator[tuple[Ns, PartialTrack]]:
        """Yields partial tracks, newest first, each with a log time at or before its first pose."""
        # The tracks of parts that the window cuts may be stored, so these are scanned whole.
        whole = window.aligned(PART_NS)
        around = whole.widened(TF_CACHE_NS).aligned(PART_NS)
        topics = () if self._is_own else self._view.moving_topics
        moving = [open_scan(self._view, topic, around, copies=True) for topic in topics]
        pose_scans = [
            open_scan(self._view, topic, whole, stored=self._view.call.stored)
            for topic in self._topics
        ]
        yield from _merged_back(
            joined_back(
                self._view,
                pose_scan,
                TRACKS,
                partial(self._tracks_in, pose_scan, moving, window),
                partial(self._stretch_key, pose_scan, moving, window),
            )
            for pose_scan in pose_scans
        )

    def _tracks_in(
        self,
        pose_scan: Scan,
        moving: Sequence[Scan],
        window: TimeWindow,
        stretch: Stretch,
    ) -> Iterator[tuple[Ns, PartialTrack]]:
        """Yields the track of each table that begins in a stretch, newest first.

        Each comes with the log time of the table's first row.
        """
        begin = stretch.window.start
        is_oldest = begin <= pose_scan.window.start
        for rows in pose_scan.rows(newest_first=True, among=stretch.window.intersect(window)):
            # What began before the stretch belongs to an older one, if there is one.
            if rows.first < begin and not is_oldest:
                continue
            lent_spans = self._lent_spans(rows, TimeWindow.everything())
            key = self._rows_key(rows, lent_spans, moving)
            if key is None and stretch.parts is None and self._view.call.stored:
                continue
            if window.covers(rows.first, rows.last):
                yield rows.first, self._track_by(rows, key, lent_spans)
                continue
            stored = None if key is None else self._view.memory.scanner.fragments(TRACKS).get(key)
            inside = positions_in(rows.times, window)
            if stored is not None and not stored.left_out:
                yield rows.first, stored.vertices(positions_in(stored.times, window))
            elif inside.size:
                lent_spans = self._lent_spans(rows, window)
                yield rows.first, self._track_by(rows.some(inside), None, lent_spans)

    def _stretch_key(
        self, pose_scan: Scan, moving: Sequence[Scan], window: TimeWindow, stretch: Stretch
    ) -> FragmentKey | None:
        """Returns the key under which a stretch's track is stored; None if it may still change."""
        start, last = stretch.window.start, stretch.last
        # The oldest stretch of a scan also has what reaches into it from before.
        is_oldest = start == pose_scan.window.start
        if is_oldest or stretch.parts is None or not window.covers(start, last):
            return None
        if any(pair.span.overlaps(start, last) for pair in self._twice):
            return None
        span = TimeWindow(start, last + 1)
        recording_of_part = self._moving_parts(moving, span)
        if recording_of_part is None:
            return None
        recordings = [] if self._is_own else [*map(pose_scan.recording_of, stretch.parts)]
        settings = self._stretch_settings(recordings, recording_of_part.values(), span)
        if settings is None:
            return None
        others = (part for part in recording_of_part if part not in stretch.parts)
        return FragmentKey(start, settings, (*stretch.parts, *others))

    def _stretch_settings(
        self, recordings: Sequence[Path], moving: Collection[Path], span: TimeWindow
    ) -> str | None:
        """Returns the hash of the transforms that place a span's poses; None if they may change.

        Args:
            recordings: the recordings of the poses.
            moving: the recordings of the moving transforms.
            span: the time of the poses.
        """
        sessions = self._view.sessions
        numbers: dict[Session, int] = {}
        placed_by: list[object] = []
        for recording in recordings:
            session = sessions.session_of(recording)
            # A session that lacks a kind borrows transforms of another one, perhaps of a later one.
            if not sessions.has_all_kinds(session):
                return None
            if session not in numbers:
                placed_by.append(static_in(sessions.static(session), span))
            placed_by.append(numbers.setdefault(session, len(numbers)))
        placed_by += [numbers.get(sessions.session_of(recording)) for recording in moving]
        return self._settings_hash(placed_by)

    def _moving_parts(self, moving: Sequence[Scan], span: TimeWindow) -> dict[int, Path] | None:
        """Returns the parts that have all moving transforms around a span, with their recordings.

        None if some transforms are in no whole part, or a part has those of several recordings.
        """
        recording_of_part: dict[int, Path] = {}
        for moving_scan in moving:
            parts = moving_scan.whole_parts(span.widened(TF_CACHE_NS))
            if parts is None:
                return None
            recording_of_part |= {part: moving_scan.recording_of(part) for part in parts}
        is_mixed = any(map(self._view.sessions.holds_carried, recording_of_part.values()))
        return None if is_mixed else recording_of_part

    def _settings_hash(self, placed_by: Sequence[object]) -> str:
        """Returns a hash of the settings and the transforms (`placed_by`) that make a track."""
        clock = self._view.limits.tf_clock
        settings = repr((self._frame_id, self._topics, self._body, clock, placed_by))
        return hashlib.sha256(settings.encode()).hexdigest()

    def _track_by(
        self,
        rows: Rows,
        key: FragmentKey | None,
        lent_spans: Sequence[_LentSpan],
    ) -> PartialTrack:
        """Returns the track of rows: the one that is stored under the key, or else a new one."""

        def make() -> PartialTrack:
            placed = self._poses_of(rows, lent_spans)
            recording = relative(str(rows.recording), str(self._view.bag_dir))
            track = partial_track(*placed[:5])
            return track._replace(left_out=placed.left_out, recording=recording)

        return remembered(self._view, TRACKS, key, make)

    def _rows_key(
        self, rows: Rows, lent_spans: Sequence[_LentSpan], moving: Sequence[Scan]
    ) -> FragmentKey | None:
        """Returns the key under which the track of rows is stored; None if it may still change."""
        if rows.part is None or self._reader.overruling(rows):
            return None
        sessions = self._view.sessions
        parts, placed_by = [rows.part], []
        for since, span, session in lent_spans:
            recording_of_part = self._moving_parts(moving, span)
            if recording_of_part is None:
                return None
            used = [
                part
                for part, recording in recording_of_part.items()
                if sessions.folder(recording) in session
            ]
            parts += [part for part in used if part not in parts]
            static = static_in(sessions.static(session), span)
            # Positions in place of the parts' numbers: all parts of a recording have one hash.
            placed_by.append((since, tuple(static), [parts.index(part) for part in used]))
        return FragmentKey(rows.first, self._settings_hash(placed_by), tuple(parts))

    def _lent_spans(self, rows: Rows, window: TimeWindow) -> list[_LentSpan]:
        """Returns which session's transforms place the poses of rows in a window, span by span.

        Empty if the poses are in the frame already.
        """
        if self._is_own:
            return []
        lenders = self._lenders(rows)
        ends = [since for since, _ in lenders[1:]] + [MAX_NS]
        whole = TimeWindow(rows.first, rows.last + 1).intersect(window)
        lent_spans = [
            _LentSpan(since, whole.intersect(TimeWindow(since, end)), session)
            for (since, session), end in zip(lenders, ends, strict=True)
        ]
        return [lent for lent in lent_spans if not lent.span.empty]

    def _lenders(self, rows: Rows) -> list[tuple[Ns, Session]]:
        """Returns the sessions whose transforms place the poses of rows, each with its begin."""
        sessions, recording = self._view.sessions, rows.recording
        session = sessions.session_of(recording)
        if sessions.has_all_kinds(session):
            return [(MIN_NS, session)]
        first, last = (self._lender_at(recording, at) for at in (rows.first, rows.last))
        if first == last:
            return [(MIN_NS, first)]
        lenders: list[tuple[Ns, Session]] = []
        for at in (np.unique(rows.times // TRACK_SLICE_NS) * TRACK_SLICE_NS).tolist():
            lender = self._lender_at(recording, at)
            if not lenders or lenders[-1][1] != lender:
                lenders.append((at, lender))
        return lenders

    def poses(self, window: TimeWindow) -> Placed:
        """Returns all poses in a short window, in order of log time.

        Raises:
            QueryTimeoutError: the call's time is over.
        """
        scanned = chain.from_iterable(scan(self._view, topic, window) for topic in self._topics)
        placed = [self._poses_of(rows, self._lent_spans(rows, window)) for rows in scanned]
        return _in_time_order([NOWHERE, *placed])

    def _lender_at(self, recording: Path, at: Ns) -> Session:
        """Returns the session whose transforms place a recording's poses at a log time.

        A note says if it is not the recording's own, or if there is none.
        """
        session = session_placing(self._view, recording, (self._frame_id, self._own_frame), at)
        if not session and self._own_frame != self._frame_id:
            self._view.notes.add(Note(_NOT_PLACED, recording.name))
        return session

    def _poses_of(self, rows: Rows, lent_spans: Sequence[_LentSpan]) -> Placed:
        """Returns the poses of rows in the frame; without lent spans, only those already in it."""
        if self._body is None:
            poses = self._reader.poses(rows)
        if not lent_spans:
            return _placed_poses(poses, None, self._frame_id)
        placed: list[Placed] = []
        for _, span, session in lent_spans:
            frames = frames_over(self._view, session, span, self._frame_id)
            if self._body is None:
                span_poses = poses.between(span.start, span.stop)
                placed.append(_placed_poses(span_poses, frames, self._frame_id))
            else:
                edges = edges_of_rows(self._view, rows, session)
                body_poses = placed_body(edges, self._body, frames, span)
                x, y, z = body_poses.positions.T
                placed.append(Placed(body_poses.times, x, y, z, headings(body_poses.turns), 0))
        return _in_time_order(placed)


class _LentSpan(NamedTuple):
    """A span of log time in which the transforms of one session place poses.

    `since` is the log time at which the session began to lend them; `span` may begin later.
    """

    since: Ns
    span: TimeWindow
    session: Session


class Placed(NamedTuple):
    """Poses of the robot in a frame.

    Attributes:
        times: log times (ns), ascending.
        x: metres.
        y: metres.
        z: metres.
        heading: radians; NaN for a pose without a heading.
        left_out: how many other poses no transform places.
    """

    times: Ints
    x: Floats
    y: Floats
    z: Floats
    heading: Floats
    left_out: int


NOWHERE: Final = Placed(np.zeros(0, np.int64), *(np.zeros(0),) * 4, 0)


def _in_time_order(parts: Sequence[Placed]) -> Placed:
    """Returns the poses of one or more tables, in order of log time."""
    columns = [*map(np.concatenate, zip(*(part[:5] for part in parts), strict=True))]
    order = stable_order(columns[0])
    times, x, y, z, heading = (column[order] for column in columns)
    return Placed(times, x, y, z, heading, sum(part.left_out for part in parts))


def _placed_poses(poses: Poses, frames: FrameTree | None, target: str) -> Placed:
    """Returns poses in the target frame; those that no transform places are left out."""
    turns = QUATERNION.nearest(poses.turns)
    x, y, z = (column.copy() for column in poses.positions.T)
    valid = np.zeros(len(poses), np.bool_)
    for code, name in enumerate(poses.frames.words):
        here = np.flatnonzero(poses.frames.codes == code)
        if name.lstrip("/") == target.lstrip("/"):
            valid[here] = True
        elif here.size and frames is not None:
            in_target = frames.poses(name, poses.times[here])
            if in_target is None:
                continue
            x[here], y[here], z[here] = in_target.points((x[here], y[here], z[here]))
            qx, qy, qz, qw = turns[here].T
            turns[here] = np.stack(multiply(in_target.rotation, (qx, qy, qz, qw)), axis=1)
            valid[here] = in_target.valid
    kept = np.flatnonzero(valid)
    left_out = len(poses) - len(kept)
    heading = headings(turns[kept])
    return Placed(poses.times[kept], x[kept], y[kept], z[kept], heading, left_out)


class _JoinedRecordings(NamedTuple):
    """The tracks of all recordings.

    Attributes:
        whole: the vertices, recording by recording.
        recordings: for each vertex, the number of its recording.
        is_beside: for each vertex, whether an earlier recording has another robot then.
    """

    whole: PartialTrack
    recordings: Ints
    is_beside: Flags


def _joined_recordings(
    tracks: Sequence[PartialTrack], apart: Collection[str] | None
) -> _JoinedRecordings:
    """Joins the tracks of recordings. Where two overlap, the one that began first counts.

    If both began at the same time, the first by name counts. The overlap of the other one is left
    out as a repetition, unless both are among the recordings `apart`, which are of several robots
    (None: any may be).
    """
    by_recording: dict[str, list[PartialTrack]] = defaultdict(list)
    for track in tracks[::-1]:
        if len(track.times):
            by_recording[track.recording].append(track)
    recordings = sorted(
        by_recording.values(),
        key=lambda own: (min(int(track.times[0]) for track in own), own[0].recording),
    )
    whole, numbers = joined_tracks(recordings)
    ends = np.searchsorted(numbers, np.arange(len(recordings) + 1))
    firsts, lasts = whole.times[ends[:-1]], whole.times[ends[1:] - 1]
    is_beside, is_repeated = np.zeros((2, len(whole.times)), np.bool_)
    for later in np.flatnonzero(firsts[1:] <= np.maximum.accumulate(lasts)[:-1]) + 1:
        vertices = slice(*ends[later : later + 2])
        times = whole.times[vertices]
        for earlier in np.flatnonzero(lasts[:later] >= firsts[later]):
            placed = whole.times[slice(*ends[earlier : earlier + 2])]
            starts, stops = pieces_of(placed, placed)
            piece = np.searchsorted(starts, times, side="right") - 1
            is_overlapping = (piece >= 0) & (times <= stops[piece])
            pair = {recordings[later][0].recording, recordings[earlier][0].recording}
            if apart is None or pair.issubset(apart):
                is_beside[vertices] |= is_overlapping
            else:
                is_repeated[vertices] |= is_overlapping
    own = np.flatnonzero(~is_repeated)
    return _JoinedRecordings(whole.vertices(own), numbers[own], is_beside[own])


def _merged_back(
    sources: Iterable[Iterator[tuple[Ns, PartialTrack]]],
) -> Iterator[tuple[Ns, PartialTrack]]:
    """Yields the tracks of all sources, newest first, each with a log time all have reached.

    The source that is least far back is asked for its next track.
    """
    reached = dict.fromkeys(sources, MAX_NS)
    waiting: list[PartialTrack] = []
    while reached:
        newest = max(reached, key=reached.__getitem__)
        timed_track = next(newest, None)
        if timed_track is None:
            del reached[newest]
        else:
            reached[newest], track = timed_track
            waiting.append(track)
        since = max(reached.values(), default=MIN_NS)
        if since < MAX_NS:
            yield from ((since, track) for track in waiting)
            waiting.clear()

"""Where the robot was in one frame over many bags, and when it was inside of a region.

Each table of poses, placed by the transforms around it, gives a `PartialTrack`; `joined_tracks`
makes one of all. What follows from parts of the store alone is stored beside these, so a week is
asked again in a tenth of a second.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import (
    TF_CACHE_NS,
    Floats,
    FrameTree,
    Mask,
    Times,
    static_in,
)
from ros2_memory.analysis.intervals import FLICKER_NS, SILENCE_NS, pieces_of
from ros2_memory.analysis.motion.robot_track import (
    TRACK_SLICE_NS,
    PartialTrack,
    RobotTrack,
    joined_tracks,
    jumps,
    partial_track,
    track_by,
)
from ros2_memory.analysis.poses import Poses, headings
from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.kinds import TRACKS
from ros2_memory.columns.steps import QUATERNION
from ros2_memory.columns.store import relative
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.errors import QueryTimeoutError, UndecodableError
from ros2_memory.core.geometry import multiply
from ros2_memory.core.memo import Key
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import ClippedSteps, Region, Steps, clipped
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.context import Note
from ros2_memory.history.driven_path import (
    body_by_transforms,
    frame_of_newest_pose,
    note_left_out,
    placed_body,
)
from ros2_memory.history.poses import PoseReader
from ros2_memory.history.robots import recordings_apart
from ros2_memory.history.scan import (
    in_time,
    joined_back,
    open_scan,
    positions_in,
    remembered,
    scan,
)
from ros2_memory.history.transforms import (
    edges_of_rows,
    frames_over,
    lending_to,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.columns.scan import Scan, Stretch
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View

_NOT_PLACED: Final = Reason(
    "has no transforms that place its poses: they are left out",
    "recording",
    many="have no transforms that place their poses: they are left out",
)
_READING_S: Final = 10.0
"""How long a call places poses that it does not remember, before its answer is partial."""


class Stay(NamedTuple):
    """A time in which the robot was inside of a region; both ends are inclusive.

    `entered` and `left`: whether it was seen outside just before, and just after.
    """

    start: Ns
    stop: Ns
    entered: bool
    left: bool

    def within(self, window: TimeWindow) -> Stay:
        """Returns the part of it in a window that it reaches into."""
        return Stay(
            max(self.start, window.start),
            min(self.stop, window.stop - 1),
            entered=self.entered and self.start >= window.start,
            left=self.left and self.stop < window.stop,
        )


@dataclass(frozen=True, slots=True)
class KnownTrack:
    """The track of the robot in a window.

    Attributes:
        track: of all recordings.
        since: how far back it reaches, where the time was over before all was placed; else None.
        left_out: how many poses could not be placed.
        others: where recordings place a robot at one time, as of several robots, the tracks of
            those that are not in `track`, as far as they are not.
    """

    track: RobotTrack
    since: Ns | None
    left_out: int
    others: tuple[RobotTrack, ...]

    @property
    def tracks(self) -> tuple[RobotTrack, ...]:
        """Those of all robots."""
        return self.track, *self.others

    def reaches(self, window: TimeWindow) -> bool:
        """Whether it is known at any time of a window where a robot was."""
        pieces = (zip(*each.pieces, strict=True) for each in self.tracks)
        return any(window.overlaps(start, stop) for start, stop in chain(*pieces))

    def inside(self, region: Region, window: TimeWindow) -> list[Stay]:
        """Returns when any robot was inside of a region, in order; times of several may overlap."""
        return sorted(chain(*(stays_within(track, region, window) for track in self.tracks)))


_MOST_SETTINGS: Final = 256
_SETTINGS: Final[Key[dict[tuple[object, ...], str]]] = Key()
"""Of a timeline: what places the poses of a stretch, as a hash, by the parts that they are of."""
_KNOWN: Final[Key[dict[tuple[str, TimeWindow], KnownTrack]]] = Key()
"""Of a call: its tracks, by frame and window."""


class TrackReader:
    """Places the robot in one frame.

    By its poses; where no topic has these, by the transforms of its body.
    """

    def __init__(self, view: View, frame_id: str) -> None:
        self._view = view
        self._frame_id = frame_id
        self._body = body = body_by_transforms(view)
        self._topics = (view.pose_topic,) if body is None else view.limits.tf_topics
        self._own_frame = (
            frame_of_newest_pose(view, view.pose_topic) if body is None else body.child
        )
        self._is_own = body is None and self._own_frame == frame_id
        self._failures: list[UndecodableError] = []
        self._reader = PoseReader(view, self._failures)

    def over(self, window: TimeWindow) -> KnownTrack:
        """Returns the track in a window, and a little beyond.

        Raises:
            InvalidArgumentsError: messages of the topic of poses carry no position.
            QueryTimeoutError: the call's time runs out before any result.
        """
        view, key = self._view, (self._frame_id, window)
        known = view.memo.of(_KNOWN, dict)
        if key in known:
            return known[key]
        # Whole slices, so that no vertex depends on the window; and what may reach into it.
        around = window.widened(SILENCE_NS).aligned(TRACK_SLICE_NS)
        try:
            tracks, since = in_time(view, self._tracks_back(around), _READING_S)
        except QueryTimeoutError as error:
            raise QueryTimeoutError(
                f"the question needs more time; {view.bags.filling_progress()}"
                "ask about a shorter window"
            ) from error
        if self._failures:
            note_left_out(view, self._failures[0])
        left_out = sum(track.left_out for track in tracks)
        track, others = self._joined(tracks, around)
        known[key] = KnownTrack(track, since, left_out, others)
        return known[key]

    def _joined(
        self, tracks: Sequence[PartialTrack], window: TimeWindow
    ) -> tuple[RobotTrack, tuple[RobotTrack, ...]]:
        """Returns the track of all recordings, and what those of other robots have beside it."""
        apart = recordings_apart(self._view, self._topics, window)
        root = str(self._view.bag_dir)
        names = None if apart is None else {relative(str(path), root) for path in apart}
        whole, numbers, is_beside = _tracks_by_robot(tracks, names)
        fastest = self._view.limits.max_plausible_speed_mps

        def track_at(index: NDArray[np.intp]) -> RobotTrack:
            return track_by(whole.some(index), numbers[index], fastest)

        others = np.unique(numbers[is_beside])
        beside = (track_at(np.flatnonzero(is_beside & (numbers == number))) for number in others)
        return track_at(np.flatnonzero(~is_beside)), tuple(beside)

    def made(self, window: TimeWindow) -> Iterator[Ns]:
        """Makes the tracks of parts in a window and beside it, the newest first.

        Yields a log time (ns) of each.

        Raises:
            InvalidArgumentsError: messages of the topic of poses carry no position.
            QueryTimeoutError: the call's time runs out.
        """
        return (at for at, _ in self._tracks_back(window.widened(2 * PART_NS)))

    def _tracks_back(self, window: TimeWindow) -> Iterator[tuple[Ns, PartialTrack]]:
        """Yields partial tracks, the newest first, each with a time that it is not earlier than."""
        # Whole parts, also those that the window cuts: their tracks are stored.
        whole = window.aligned(PART_NS)
        around = whole.widened(TF_CACHE_NS).aligned(PART_NS)
        topics = () if self._is_own else self._view.moving_topics
        moving = [open_scan(self._view, topic, around, copies=True) for topic in topics]
        scans = [
            open_scan(self._view, topic, whole, stored=self._view.call.stored)
            for topic in self._topics
        ]
        yield from _together(
            joined_back(
                self._view,
                opened,
                TRACKS,
                partial(self._tracks_in, opened, moving, window),
                partial(self._stretch_key, opened, moving, window),
            )
            for opened in scans
        )

    def _tracks_in(
        self,
        opened: Scan,
        scans: Sequence[Scan],
        window: TimeWindow,
        stretch: Stretch,
    ) -> Iterator[tuple[Ns, PartialTrack]]:
        """Yields the track table by table, of those that begin in a stretch, the newest first."""
        searched = stretch.window.intersect(window)
        for rows in opened.rows(newest_first=True, among=searched):
            if rows.first < stretch.window.start and stretch.window.start > opened.window.start:
                continue
            lent_spans = self._lent_spans(rows, TimeWindow.everything())
            key = self._rows_key(rows, lent_spans, scans)
            if key is None and stretch.parts is None and self._view.call.stored:
                continue
            if window.covers(rows.first, rows.last):
                yield rows.first, self._track_by(rows, key, lent_spans)
                continue
            stored = None if key is None else self._view.memory.scanner.fragments(TRACKS).get(key)
            if stored is not None and not stored.left_out:
                yield rows.first, stored.some(positions_in(stored.times, window))
            elif (inside := positions_in(rows.times, window)).size:
                lent_spans = self._lent_spans(rows, window)
                yield rows.first, self._track_by(rows.some(inside), None, lent_spans)

    def _stretch_key(
        self, opened: Scan, scans: Sequence[Scan], window: TimeWindow, stretch: Stretch
    ) -> FragmentKey | None:
        """Returns the key of a stretch's track; None where what it follows from may change."""
        start, last = stretch.window.start, stretch.last
        # Where the scan begins with it, what reaches into it from before is part of it.
        if start == opened.window.start or stretch.parts is None or not window.covers(start, last):
            return None
        span = TimeWindow(start, last + 1)
        moving = self._moving_parts(scans, span)
        if moving is None:
            return None
        known = self._view.timeline.memo.of(_SETTINGS, dict)
        asked, noted = (self._settings_hash(()), stretch.parts, *moving), self._view.notes.added
        settings = known.get(asked)
        if settings is None:
            recordings = [] if self._is_own else [*map(opened.recording_of, stretch.parts)]
            settings = self._stretch_settings(recordings, moving.values(), span)
            if settings is None:
                return None
            if self._view.notes.added == noted and not self._view.call.used_active:
                if len(known) >= _MOST_SETTINGS:
                    known.clear()
                known[asked] = settings
        others = (part for part in moving if part not in stretch.parts)
        return FragmentKey(start, settings, (*stretch.parts, *others))

    def _stretch_settings(
        self, recordings: Sequence[Path], moving: Collection[Path], span: TimeWindow
    ) -> str | None:
        """Returns the hash of all transforms that place poses; None while these may change.

        `recordings`: of the poses. `moving`: of the transforms around that time.
        """
        sessions = self._view.sessions
        numbers: dict[Session, int] = {}
        placed_by: list[object] = []
        for recording in recordings:
            session = sessions.of(recording)
            if not sessions.has_all_kinds(session):
                return None
            if session not in numbers:
                placed_by.append(static_in(sessions.static(session), span))
            placed_by.append(numbers.setdefault(session, len(numbers)))
        placed_by += [numbers.get(sessions.of(recording)) for recording in moving]
        return self._settings_hash(placed_by)

    def _moving_parts(self, scans: Sequence[Scan], span: TimeWindow) -> dict[int, Path] | None:
        """Returns the whole parts that all moving transforms around a time are of.

        Each with its recording. None where there are others, or some are of several recordings.
        """
        paths: dict[int, Path] = {}
        for scan_ in scans:
            parts = scan_.whole_parts(span.widened(TF_CACHE_NS))
            if parts is None:
                return None
            paths |= {part: scan_.recording_of(part) for part in parts}
        is_mixed = any(map(self._view.sessions.holds_carried, paths.values()))
        return None if is_mixed else paths

    def _settings_hash(self, placed_by: Sequence[object]) -> str:
        """Returns a hash of the settings and transforms that a track depends on, but for parts."""
        clock = self._view.limits.tf_clock
        settings = repr((self._frame_id, self._topics, self._body, clock, placed_by))
        return hashlib.sha256(settings.encode()).hexdigest()

    def _track_by(
        self,
        rows: Rows,
        key: FragmentKey | None,
        lent_spans: Sequence[_LentSpan],
    ) -> PartialTrack:
        """Returns the track by some rows: what is stored of it, else made now."""

        def make() -> PartialTrack:
            placed = self._poses_of(rows, lent_spans)
            recording = relative(str(rows.recording), str(self._view.bag_dir))
            return partial_track(*placed)._replace(recording=recording)

        return remembered(self._view, TRACKS, key, make)

    def _rows_key(
        self, rows: Rows, lent_spans: Sequence[_LentSpan], scans: Sequence[Scan]
    ) -> FragmentKey | None:
        """Returns the key of the track by some rows; None where what it follows from may change."""
        if rows.part is None:
            return None
        parts, placed_by = [rows.part], []
        for lent in lent_spans:
            moving = self._moving_parts(scans, lent.span)
            if moving is None:
                return None
            sessions, session = self._view.sessions, lent.session
            used = [part for part, path in moving.items() if sessions.folder(path) in session]
            parts += [part for part in used if part not in parts]
            static = static_in(self._view.sessions.static(session), lent.span)
            # By their places among the parts: those of one recording have one text.
            placed_by.append((lent.since, tuple(static), [parts.index(part) for part in used]))
        return FragmentKey(rows.first, self._settings_hash(placed_by), tuple(parts))

    def _lent_spans(self, rows: Rows, window: TimeWindow) -> list[_LentSpan]:
        """Returns by what the poses of some rows in a window are placed; none: by nothing."""
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
        """Returns which sessions' transforms place the poses of some rows, each since when."""
        sessions, recording = self._view.sessions, rows.recording
        session = sessions.of(recording)
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
        """Returns all poses in a short window, in order.

        Raises:
            QueryTimeoutError: the call's time is over.
        """
        scanned = chain.from_iterable(scan(self._view, topic, window) for topic in self._topics)
        placed = [self._poses_of(rows, self._lent_spans(rows, window)) for rows in scanned]
        return _in_time_order([NOWHERE, *placed])

    def _lender_at(self, recording: Path, at: Ns) -> Session:
        """Returns the session that places a recording's poses; a note says if none, or another."""
        session = lending_to(self._view, recording, (self._frame_id, self._own_frame), at)
        if not session:
            self._view.notes.add(Note(_NOT_PLACED, recording.name))
        return session

    def _poses_of(self, rows: Rows, lent_spans: Sequence[_LentSpan]) -> Placed:
        """Returns the poses of some rows in the frame; without lent spans as they are."""
        if self._body is None:
            poses = self._reader.poses(rows)
        if not lent_spans:
            return _placed_poses(poses, None, self._frame_id)
        placed: list[Placed] = []
        for lent in lent_spans:
            frames = frames_over(self._view, lent.session, lent.span, self._frame_id)
            if self._body is None:
                of_span = poses.between(lent.span.start, lent.span.stop)
                placed.append(_placed_poses(of_span, frames, self._frame_id))
            else:
                edges = edges_of_rows(self._view, rows, lent.session)
                of_body = placed_body(edges, self._body.child, frames, lent.span)
                x, y, _ = of_body.positions.T
                placed.append(Placed(of_body.times, x, y, headings(of_body.turns), 0))
        return _in_time_order(placed)


class _LentSpan(NamedTuple):
    """By what poses of a span of log time are placed: the transforms of one session.

    `since`: from when on it lends them.
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
        heading: radians; NaN where it is not known.
        left_out: how many no transform placed.
    """

    times: Times
    x: Floats
    y: Floats
    heading: Floats
    left_out: int


NOWHERE: Final = Placed(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0), 0)


def _in_time_order(parts: Sequence[Placed]) -> Placed:
    """Returns the poses of several tables, in order of time."""
    columns = zip(*(part[:4] for part in parts), strict=True)
    times, x, y, heading = map(np.concatenate, columns)
    order = np.argsort(times, kind="stable")
    left_out = sum(part.left_out for part in parts)
    return Placed(times[order], x[order], y[order], heading[order], left_out)


def _placed_poses(poses: Poses, frames: FrameTree | None, target: str) -> Placed:
    """Returns poses in a frame; those that no transform places are left out."""
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
            x[here], y[here], _ = in_target.points((x[here], y[here], z[here]))
            qx, qy, qz, qw = turns[here].T
            turns[here] = np.stack(multiply(in_target.rotation, (qx, qy, qz, qw)), axis=1)
            valid[here] = in_target.valid
    kept = np.flatnonzero(valid)
    left_out = len(poses) - len(kept)
    return Placed(poses.times[kept], x[kept], y[kept], headings(turns[kept]), left_out)


def _tracks_by_robot(
    tracks: Sequence[PartialTrack], apart: Collection[str] | None
) -> tuple[PartialTrack, Times, Mask]:
    """Returns the tracks of all recordings, whose each vertex is, and which lie beside the track.

    Where several recordings place a robot at a time, that which began first is in the track; of
    those that began at one time the first by name. What the other one has then is left out, unless
    both are among those that are `apart`, as of several robots (None: all may be).
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
    is_beside, repeats = np.zeros((2, len(whole.times)), np.bool_)
    for nth in np.flatnonzero(firsts[1:] <= np.maximum.accumulate(lasts)[:-1]) + 1:
        here = slice(*ends[nth : nth + 2])
        for other in np.flatnonzero(lasts[:nth] >= firsts[nth]):
            placed = whole.times[slice(*ends[other : other + 2])]
            starts, stops = pieces_of(placed, placed)
            piece = np.searchsorted(starts, whole.times[here], side="right") - 1
            pair = {recordings[nth][0].recording, recordings[other][0].recording}
            beside = is_beside if apart is None or pair.issubset(apart) else repeats
            beside[here] |= (piece >= 0) & (whole.times[here] <= stops[piece])
    own = np.flatnonzero(~repeats)
    return whole.some(own), numbers[own], is_beside[own]


def _together(
    sources: Iterable[Iterator[tuple[Ns, PartialTrack]]],
) -> Iterator[tuple[Ns, PartialTrack]]:
    """Yields what all of several yield, the newest first, each with a time that all have reached.

    The one that is behind goes on.
    """
    reached, held = dict.fromkeys(sources, MAX_NS), list[PartialTrack]()
    while reached:
        behind = max(reached, key=reached.__getitem__)
        found = next(behind, None)
        if found is None:
            del reached[behind]
        else:
            reached[behind], track = found
            held.append(track)
        since = max(reached.values(), default=MIN_NS)
        if since < MAX_NS:
            yield from ((since, each) for each in held)
            held.clear()


def _without_jumps(parts: ClippedSteps, are_jumps: Mask) -> ClippedSteps:
    """Returns the parts of steps inside of a region; of a jump only those of its ends inside.

    Nobody drives where a robot jumps: its odometry started again, or its map was corrected.
    """
    jumped = are_jumps[parts.step]
    begins, ends = parts.start <= 0, parts.stop >= 1
    start = np.where(jumped & ~begins, 1.0, parts.start)
    stop = np.where(jumped & ~ends, 0.0, parts.stop)
    kept = ~jumped | begins | ends
    return ClippedSteps(parts.step[kept], start[kept], stop[kept])


def stays_within(track: RobotTrack, region: Region, window: TimeWindow) -> list[Stay]:
    """Returns when the robot was inside of a region in a window, in order; see `stays`."""
    return [
        stay.within(window)
        for stay in stays(track, region)
        if window.overlaps(stay.start, stay.stop)
    ]


def stays(track: RobotTrack, region: Region) -> list[Stay]:
    """Returns when the robot was inside of a region, in order, by its track.

    A robot that was outside for less than `FLICKER_NS` did not leave. What it did in a silence
    longer than `SILENCE_NS` is not known: it ends the time, and begins another.
    """
    count = len(track.times)
    # A piece of a single vertex is a step of no length.
    after = np.arange(count) + ~track.ends
    steps = Steps(track.x, track.y, track.x[after], track.y[after])
    parts = _without_jumps(clipped(region, steps), jumps(track)) if count else None
    if parts is None or not len(parts.step):
        return []
    begin = track.times[parts.step]
    lasted = track.times[after[parts.step]] - begin
    starts = begin + np.rint(lasted * parts.start).astype(np.int64)
    stops = begin + np.rint(lasted * parts.stop).astype(np.int64)
    piece = np.cumsum(track.begins)[parts.step] - 1
    # Where the piece began, or ended, inside, it is not known.
    opened, closed = (ends[piece] for ends in track.pieces)
    apart = (starts[1:] - stops[:-1] >= FLICKER_NS) | (piece[1:] != piece[:-1])
    first = np.append([True], apart)
    last = np.append(apart, [True])
    columns = starts[first], stops[last], (starts > opened)[first], (stops < closed)[last]
    return [*map(Stay, *(column.tolist() for column in columns))]

"""The frame that answers give positions in: one rule for all tools, and the place they are in.

Tools beyond the specification answer in `data.map_frame` where transforms lead there from the
pose's own frame at the time in question, else in that frame; the specification's tools in the
pose's own frame. `frame_id` asks for another. Places are in the map where transforms of some
recording lead there, and else in the poses' own frame: odometry, which begins at its origin
whenever the robot is started.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import merge
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.frames import HOLD_NS
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.motion.robot_track import RobotTrack, empty_track, jumps, place_at
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.geometry import multiply, transform_point, yaw
from ros2_memory.core.model import Pose, TimeWindow
from ros2_memory.core.regions import Place, names_by_size, places_at
from ros2_memory.core.spans import Spans, without
from ros2_memory.core.text import abbreviate, counted
from ros2_memory.core.timebase import MIN_NS, Ns
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.driven_path import (
    body_by_transforms,
    body_of,
    frame_of_newest_pose,
    newest_of_body,
    resolve_path_topic,
)
from ros2_memory.history.robots import recordings_apart
from ros2_memory.history.transforms import (
    connects,
    connects_in_time,
    transform_at,
)
from ros2_memory.places.robot_tracks import KnownTrack, TrackReader

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.analysis.motion.trajectory import Waypoint
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import Mask

WHEREABOUTS: Final = "where the robot was"
"""What is not known without poses, for sentences."""
NEWEST_POSE_NS: Final = SILENCE_NS
"""The robot may have moved since an older pose."""


def pose_in(view: View, pose: Pose, frame_id: str, time: Ns, recording: Path) -> Pose | None:
    """Returns a pose of a recording in another frame at a time; None where no transform leads."""
    if frame_id.lstrip("/") == pose.frame_id.lstrip("/"):
        return pose
    if not pose.frame_id:
        return None
    try:
        transform = transform_at(view, frame_id, pose.frame_id, time, recording, explains=False)
    except NoDataError:
        return None
    lookup, turn = transform.transform, pose.orientation
    return Pose(
        transform_point(lookup, pose.position),
        None if turn is None else multiply(lookup.rotation, turn),
        frame_id,
    )


def newest_pose(
    view: View, topic: str, window: TimeWindow, recording: Path | None = None
) -> tuple[StoredMessage, Pose | None] | None:
    """Returns the newest message of the topic that places the robot in a window, with its pose.

    Where the session of a `recording` has the topic, it is one of its messages. None where there is
    no message, or it cannot be decoded.
    """
    body = body_of(view, topic)
    if body is not None:
        return newest_of_body(view, body, window, recording=recording)
    if recording is None:
        stored = view.stream.newest(topic, window)
    else:
        stored = view.sessions.newest(topic, window, recording)
    message = None if stored is None else view.bags.decode(stored)
    if stored is None or message is None:
        return None
    return stored, view.extractor.pose(message, stored.type)


def recording_at(view: View, topic: str, at: Ns, own: Path | None = None) -> Path | None:
    """Returns a recording that has a topic before and after a time: `own` if it does.

    Else the shortest of them, as one that began with an unset clock spans years; or `own`. By whole
    recordings: which of their bags reaches over a time depends on how they were split.
    """
    spans = view.timeline.recordings(topic)
    around = {path: last - first for path, (first, last) in spans.items() if first <= at <= last}
    if own in around or not around:
        return own
    return min(around, key=lambda path: (around[path], path))


def robot_at(view: View, at: Ns, recording: Path, frame_id: str | None) -> Pose | None:
    """Returns the robot's newest pose at or before a moment; None where it is not known.

    In the map where transforms lead there, or in `frame_id`. Where the session of this recording
    has poses, it is one of these.
    """
    window = TimeWindow.before(at, NEWEST_POSE_NS)
    topic = view.pose_topic if body_by_transforms(view) is None else resolve_path_topic(view)
    stored, pose = newest_pose(view, topic, window, recording) or (None, None)
    if stored is None or pose is None or not all(map(math.isfinite, pose.position)):
        return None
    there = placed(view, pose, stored.time, stored.bag.recording, frame_id)
    view.notes.add(*axes_of(there.frame_id))
    return with_place(view, there, stored.time, stored.bag.recording)


def placed(view: View, pose: Pose, time: Ns, recording: Path, frame_id: str | None = None) -> Pose:
    """Returns a pose in the map where transforms lead there, else as it is; or in `frame_id`.

    Raises:
        InvalidArgumentsError: no transform leads to `frame_id`, which was asked for.
    """
    target = frame_id or view.limits.map_frame
    there = None if not target else pose_in(view, pose, target, time, recording)
    if there is None and frame_id is not None:
        raise InvalidArgumentsError(_unreachable(frame_id, pose.frame_id))
    return pose if there is None else there


def placed_waypoints(
    view: View, topic: str, waypoints: Sequence[Waypoint], own_frame: str, frame_id: str
) -> tuple[Waypoint, ...]:
    """Returns waypoints of a topic's poses in another frame, each by the transforms of its time.

    At both ends of a recording its first and last transforms hold for 2 s more, as for tracks.
    Waypoints that no transform places are left out, with a note. No drawn way leads across a jump
    of the frame.

    Raises:
        InvalidArgumentsError: no transform places any of them.
        QueryTimeoutError: the call's time is over before it is known whether any leads there.
    """
    moved: list[Waypoint] = []
    known_to_lead = False
    for waypoint in waypoints:
        recording = recording_at(view, topic, waypoint.time)
        half = math.nan if waypoint.yaw_rad is None else waypoint.yaw_rad / 2
        pose = Pose(waypoint.position, (0.0, 0.0, math.sin(half), math.cos(half)), own_frame)
        # By the transforms of its time, or of the nearest one up to `HOLD_NS` off.
        tried = (
            pose_in(view, pose, frame_id, waypoint.time + off, recording)
            for off in (0, HOLD_NS // 2, -HOLD_NS // 2, HOLD_NS, -HOLD_NS)
            if recording is not None
        )
        there = next(filter(None, tried), None)
        if there is None or there.orientation is None:
            # Asked once: to look for a frame that nothing leads to at each time takes long.
            if not (moved or known_to_lead) and not connects(view, (frame_id, own_frame)):
                break
            known_to_lead = True
            continue
        turn = None if waypoint.yaw_rad is None else yaw(there.orientation)
        moved.append(replace(waypoint, position=there.position, yaw_rad=turn))
    if waypoints and not moved:
        raise InvalidArgumentsError(_unreachable(frame_id, own_frame))
    if len(moved) < len(waypoints):
        left_out = counted(len(waypoints) - len(moved), "waypoint")
        view.notes.add(f"{left_out} left out: no transform leads to {frame_id} at that time")
    if not moved or own_frame == frame_id or topic != resolve_path_topic(view):
        return tuple(moved)
    return _with_jumps(view, moved, frame_id)


def _with_jumps(view: View, waypoints: Sequence[Waypoint], frame_id: str) -> tuple[Waypoint, ...]:
    """Returns waypoints of the robot's path with `jump` at the first after each jump of a frame."""
    window = TimeWindow(waypoints[0].time, waypoints[-1].time + 1)
    try:
        known = TrackReader(view, frame_id).over(window)
    except QueryTimeoutError:
        view.notes.add_lack(f"there was no time to look where {frame_id} jumped")
        return tuple(waypoints)
    if known.since is not None:
        view.notes.add_lack(
            f"where {frame_id} jumped is known back to {unix_text(known.since)}: out of time "
            "before older poses were placed"
        )
    track = known.track
    jumped = track.times[1:][jumps(track)[:-1]]
    reached = np.searchsorted(jumped, [waypoint.time for waypoint in waypoints], side="right")
    is_after = np.diff(reached, prepend=reached[0]) > 0
    if is_after.any():
        across = counted(int(is_after.sum()), "waypoint")
        view.notes.add(f"{frame_id} jumped before {across}: the line to there was not driven")
    return tuple(
        replace(waypoint, jump=waypoint.jump or after)
        for waypoint, after in zip(waypoints, is_after.tolist(), strict=True)
    )


def _unreachable(frame_id: str, own_frame: str) -> str:
    return (
        f"frame_id was {abbreviate(frame_id)}; no transform leads there from "
        f"{own_frame or 'a pose without a frame'} at that time"
    )


def with_place(view: View, pose: Pose, time: Ns, recording: Path) -> Pose:
    """Returns a pose with the names of the places that it is in, in whatever frames these are."""
    places = view.limits.places
    frames = {place.frame_id for place in places}
    there = {frame: pose_in(view, pose, frame, time, recording) for frame in frames}
    inside = (
        place
        for place in places
        if (placed := there[place.frame_id]) is not None
        and place.region.contains(*placed.position[:2])
    )
    return replace(pose, places=names_by_size(inside))


@dataclass(frozen=True, slots=True)
class MapPlacement:
    """Which frames the robot's places are in.

    Attributes:
        frame_id: of the places.
        pose_frame: of the poses.
        is_map: whether the coordinates of places keep their meaning when odometry is reset.
        above: where transforms alone place the robot, the frames above its body.
    """

    frame_id: str
    pose_frame: str
    is_map: bool
    above: tuple[str, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames that positions are known in."""
        return tuple(dict.fromkeys((self.frame_id, self.pose_frame, *self.above)))


def map_placement(view: View, topic: str, frame_id: str | None = None) -> MapPlacement:
    """Returns how the poses of a topic are placed; in `frame_id` where one is given.

    Raises:
        InvalidArgumentsError: places are in another frame than `frame_id`, or it is of no poses.
        QueryTimeoutError: the time is over before it is known whether they are in `frame_id`.
        UndecodableError: no pose can be decoded.
    """
    target, frame = view.limits.map_frame, frame_of_newest_pose(view, topic)
    body = body_of(view, topic)
    above = () if body is None else body.above
    if frame_id in (frame, *above):
        return MapPlacement(frame_id, frame, frame_id == target, above)
    # No answer is better than one that denies a frame which is asked for, since the time is over.
    leads = connects_in_time if frame_id is None else connects
    places_frame = frame
    if target and target != frame and leads(view, (target, frame)):
        recordings = view.timeline.recordings(topic).items()
        lending = {view.sessions.lending_to(path, first) for path, (first, _) in recordings}
        if any(leads(view, (target, frame), session=session) for session in lending):
            places_frame = target
    placement = MapPlacement(places_frame, frame, places_frame == target, above)
    if frame_id not in (None, places_frame):
        known_frames = " or ".join(placement.frames)
        raise InvalidArgumentsError(
            f"frame_id was {abbreviate(frame_id)} (as asked, or of a place), and where the robot "
            f"was is known in {known_frames} only: ask in that frame, or make it the `frame` of "
            "the place"
        )
    return placement


def known_placement(view: View) -> MapPlacement | None:
    """Returns how the robot's poses are placed; None where no topic of them is recorded."""
    try:
        return map_placement(view, resolve_path_topic(view))
    except (InvalidArgumentsError, NoDataError, UndecodableError):
        return None


def is_one_run(view: View, topic: str, windows: Iterable[TimeWindow]) -> bool:
    """Returns whether all poses in some windows are of one session, whose odometry goes on.

    Or of several that repeat each other where they overlap, as a copy does.
    """
    sessions, asked = view.sessions, tuple(windows)
    spans = sorted(
        (*span, recording)
        for recording, span in view.timeline.recordings(topic).items()
        if any(window.overlaps(*span) for window in asked)
    )
    joined: set[Session] = set()
    reach = MIN_NS
    for first, last, recording in spans:
        session = sessions.of(recording)
        if joined and session not in joined:
            both = TimeWindow(first, max(min(reach, last) + 1, first))
            bags = view.stream.overlapping_bags([topic], both)
            # One that a wrong clock dated spans years, without bags.
            has_overlap = len({span.bag.recording for span in bags}) > 1
            if not has_overlap or recordings_apart(view, [topic], both) != frozenset():
                return False
        joined.add(session)
        reach = max(reach, last)
    return True


def changing_origin(frame_id: str) -> str:
    """Returns why coordinates of several runs cannot be compared, for sentences."""
    return f"the origin of {frame_id or 'their frame'} changes with every start"


def note_runs(view: View, topic: str, frame_id: str, window: TimeWindow) -> None:
    """Notes that positions in a frame which is not the map are of several runs of odometry."""
    if frame_id != view.limits.map_frame and not is_one_run(view, topic, [window]):
        view.notes.add(
            f"{changing_origin(frame_id)}, and these are several runs of odometry: the same "
            "coordinates may be another place in each"
        )


def axes_of(frame_id: str) -> tuple[str, ...]:
    """Returns the note on a frame that is north-east-down, not REP 103's, by its name."""
    if not frame_id.casefold().endswith("ned"):
        return ()
    axes = f"in {frame_id} x is north, y east and z down"
    return (f"{axes}: yaw is clockwise from north, seen from above",)


def known_track(view: View, frame_id: str, window: TimeWindow) -> KnownTrack:
    """Returns the robot's track in a window; a note says how far back it reaches, if not all.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    joined = TrackReader(view, frame_id).over(window)
    note_runs(view, resolve_path_topic(view), frame_id, window)
    if joined.since is not None:
        view.notes.add_lack(
            f"visits are known back to {unix_text(joined.since)}: out of time before older "
            "poses were placed"
        )
    if joined.left_out:
        view.notes.add(f"poses that no transform places in {frame_id} are left out")
    return joined


def placed_times(track: RobotTrack, mixed: Spans) -> Spans:
    """Returns when it is known where the robot was: not at `mixed` times, which several have."""
    starts, stops = track.pieces
    return without(zip(starts.tolist(), (stops + 1).tolist(), strict=True), mixed)


def make_tracks(view: View, window: TimeWindow) -> Iterator[Ns]:
    """Makes the robot's tracks by the parts in a window, in the frames of places; they are stored.

    Yields a log time (ns) of each, the newest first.
    """
    with suppress(InvalidArgumentsError, NoDataError, UndecodableError):
        topic = resolve_path_topic(view)
        frames = map_placement(view, topic).frames
        yield from merge(*(TrackReader(view, frame).made(window) for frame in frames), reverse=True)


def places_in(
    view: View, places: Sequence[Place], placement: MapPlacement, window: TimeWindow
) -> list[tuple[Place, KnownTrack]]:
    """Returns the places of the map and of the poses' own frame, each with the track in its frame.

    Notes name the others.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    tracks: list[tuple[Place, KnownTrack]] = []
    for place in places:
        if place.frame_id in placement.frames:
            tracks.append((place, known_track(view, place.frame_id, window)))
        else:
            view.notes.add(
                f"{place.name} is left out: it is in {place.frame_id}, and where the robot was is "
                f"known in {' and '.join(placement.frames)}"
            )
    return tracks


@dataclass
class RobotPlaces:
    """Looks the robot up in a window, by its track: as exact as that, some 5 cm.

    Attributes:
        frame_id: that positions are given in: the map where transforms lead there, or the one asked
            for.
        pose_frame: of the poses themselves.
        map_frame: the former, whatever was asked for; named places are looked up in it.
    """

    view: View
    window: TimeWindow
    frame_id: str
    pose_frame: str
    map_frame: str

    def at(self, time: Ns) -> tuple[float, float] | None:
        """Returns where the robot was (m) in `frame_id`; None outside the track."""
        if self.frame_id != self.map_frame:
            return None
        return place_at(self._track, time, SILENCE_NS)

    def within(self, start: Ns, end: Ns) -> Ns:
        """Returns a time for where the robot stood: the middle; the start, if the map jumps."""
        first, last = np.searchsorted(self._track.times, (start, end)).tolist()
        return start if self._jumps[max(first - 1, 0) : last].any() else (start + end) // 2

    def names_at(self, time: Ns) -> tuple[str, ...]:
        """Returns the named places that the robot was in, if that is known; the smallest first."""
        places = self.view.limits.places
        if not any(place.frame_id == self.map_frame for place in places):
            return ()
        point = place_at(self._track, time, SILENCE_NS)
        return () if point is None else places_at(places, self.map_frame, *point)

    @cached_property
    def _jumps(self) -> Mask:
        return jumps(self._track)

    @cached_property
    def _track(self) -> RobotTrack:
        try:
            joined = TrackReader(self.view, self.map_frame).over(self.window)
            note_runs(self.view, resolve_path_topic(self.view), self.map_frame, self.window)
        except QueryTimeoutError:
            self.view.bags.check_deadline()
            self._note_reach("not known")
            return empty_track()
        if joined.since is not None:
            self._note_reach(f"known back to {unix_text(joined.since)} alone")
        return joined.track

    def _note_reach(self, reach: str) -> None:
        self.view.notes.add(
            f"where the robot was in {self.map_frame} is {reach}: reading the bags that are not "
            "stored takes too long"
        )


def robot_places(view: View, window: TimeWindow, frame_id: str | None = None) -> RobotPlaces | None:
    """Returns where the robot was in a window; None where no topic of its poses is recorded.

    Raises:
        InvalidArgumentsError: no position is given in `frame_id`.
    """
    usual = known_placement(view)
    if usual is None:
        return None
    asked = usual if frame_id is None else map_placement(view, resolve_path_topic(view), frame_id)
    return RobotPlaces(view, window, asked.frame_id, usual.pose_frame, usual.frame_id)

"""Which frame positions are given in, by one rule for all tools, and which places they lie in.

The tools of the specification answer in the frame of the poses. Other tools answer in
`data.map_frame` if transforms lead there at the time in question, else in the frame of the poses.
The argument `frame_id` asks for another frame. Places are in the map if transforms of some
recording lead there, else in the frame of the poses: odometry, whose origin changes with each
start of the robot.
"""

from __future__ import annotations

import math
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from heapq import merge
from itertools import chain, islice
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.frames import HOLD_NS, is_odometry
from ros2_memory.analysis.intervals import FLICKER_NS, SILENCE_NS
from ros2_memory.analysis.motion.robot_track import RobotTrack, empty_track, jumps, place_at
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.geometry import multiply, transform_point, yaw
from ros2_memory.core.memo import Key
from ros2_memory.core.model import Pose, TimeWindow
from ros2_memory.core.regions import Place, places_at
from ros2_memory.core.spans import Spans, spans_of, without
from ros2_memory.core.text import Reason, abbreviate, counted, listed
from ros2_memory.core.timebase import MIN_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.driven_path import (
    body_by_transforms,
    body_of,
    frame_of_newest_pose,
    newest_of_body,
    resolve_path_topic,
    robot_body,
    root_above,
)
from ros2_memory.history.no_data import topics_of_robot
from ros2_memory.history.robots import recordings_apart
from ros2_memory.history.transforms import (
    connects,
    connects_in_time,
    other_transforms,
    transform_at,
)
from ros2_memory.places.robot_tracks import TrackReader

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.analysis.motion.trajectory import PathSlice, Trajectory, Waypoint
    from ros2_memory.core.arrays import Flags
    from ros2_memory.core.model import Vector3
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.places.stays import KnownTrack

WHEREABOUTS: Final = "where the robot was"
"""What notes say is not known without poses."""
_NEAR_NS: Final = 60 * NS_PER_S
"""Transforms that lead to a place so long before or after make it unknown, and not nowhere."""
NEWEST_POSE_NS: Final = SILENCE_NS
"""After so long without a pose the robot may have moved."""
_FIXED_FRAMES: Final = frozenset({"earth", "utm"})
"""Frames of REP 105 and of robot_localization that are at rest on earth."""
_SAME_ORIGIN_M: Final = 0.5
_ORIGINS: Final[Key[dict[tuple[str, tuple[TimeWindow, ...]], list[str]]]] = Key()
"""Of a view: by topic of poses and windows, the notes on a map that was laid out anew."""
_ON_EARTH: Final[Key[dict[str | None, list[str]]]] = Key()
"""Of a timeline: by frame of the map, the fixed frames to which transforms lead."""
_MOST_ORIGINS: Final = 12
"""At most this many recordings, evenly spaced, are asked where their map lay."""
_OLD_NS: Final = NS_PER_S
_OLD_PERIODS: Final = 3
"""A pose is old after so long, and so many times the time since the one before it."""
_OLD: Final = Reason(
    "the newest pose was old, and the robot may have been elsewhere", "time", of="at "
)


def pose_in(view: View, pose: Pose, frame_id: str, time: Ns, recording: Path) -> Pose | None:
    """Returns a pose of a recording in another frame; None if no transform leads there then."""
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
    """Returns the newest message of a topic in a window that places the robot, with its pose.

    With a `recording` it is a message of its session, if that has the topic. None if there is no
    message, or if it cannot be decoded.
    """
    if body_of(view, topic) is not None:
        return newest_of_body(view, window, recording=recording)
    if recording is None:
        stored = view.stream.newest(topic, window)
    else:
        stored = view.sessions.newest(topic, window, recording)
    message = view.bags.decode(stored)
    if stored is None or message is None:
        return None
    return stored, view.extractor.pose(message, stored.type)


def recording_at(view: View, topic: str, at: Ns, own: Path | None = None) -> Path | None:
    """Returns the recording of a topic around a log time; `own` if it is one, or if there is none.

    Where the topic is silent, since what it said before holds, a recording of the robot's poses
    takes its place. The shortest one is chosen: a recording that began with an unset clock spans
    years. Whole recordings are compared, since their bags depend on how they were split.
    """
    for spoken in (topic, _topic_of_robot(view)):
        spans = view.timeline.recordings(spoken).items()
        around = {path: last - first for path, (first, last) in spans if first <= at <= last}
        if own in around:
            return own
        if around:
            return min(around, key=lambda path: (around[path], path))
    return own


def _topic_of_robot(view: View) -> str:
    """Returns the topic that places the robot."""
    return view.pose_topic if body_by_transforms(view) is None else resolve_path_topic(view)


def unknown_path(view: View) -> Iterator[str]:
    """Yields why nothing places the robot, if nothing does."""
    try:
        resolve_path_topic(view)
    except (InvalidArgumentsError, NoDataError) as error:
        yield f"{WHEREABOUTS} is not known: {error}"


def robot_at(view: View, at: Ns, recording: Path, frame_id: str | None) -> Pose | None:
    """Returns the robot's newest pose at or before a log time, with the names of its places.

    It is in `frame_id`, or else in the map if transforms lead there, or else in its own frame. It
    is a pose of the recording's session, if that has poses. None if there is no recent pose; a note
    names topics of poses of which one is to be chosen.

    Raises:
        InvalidArgumentsError: no transform leads to `frame_id` at any time.
    """
    topic, window = _topic_of_robot(view), TimeWindow.before(at, NEWEST_POSE_NS)
    if topic not in view.timeline.topics() and topics_of_robot(view, "position"):
        view.notes.add(*unknown_path(view))
    stored, pose = newest_pose(view, topic, window, recording) or (None, None)
    if stored is None or pose is None or not all(map(math.isfinite, pose.position)):
        return None
    in_frame = pose_if_placed(view, pose, stored.time, stored.recording, frame_id)
    if in_frame is None:
        return None
    _note_old(view, at, stored)
    view.notes.add(*axes_of(in_frame.frame_id))
    return with_place(view, in_frame, stored.time, stored.recording)


def _note_old(view: View, at: Ns, newest: StoredMessage) -> None:
    """Notes if the newest pose is old: it is not known how far the robot was from there."""
    age = at - newest.time
    if age <= _OLD_NS:
        return
    before = view.stream.last(newest.topic, newest.time)
    if before is not None and age > _OLD_PERIODS * (newest.time - before.time):
        view.notes.add(Note(_OLD, unix_text(at), f"{unix_from_ns(age):.1f} s"))


def pose_in_map(
    view: View, pose: Pose, time: Ns, recording: Path, frame_id: str | None = None
) -> Pose:
    """Returns a pose in `frame_id`; without one, in the map if transforms lead there, else as is.

    Raises:
        InvalidArgumentsError: no transform leads to `frame_id` at any time.
        NoDataError: none leads there at that time.
    """
    target = frame_id or view.limits.map_frame
    in_target = None if not target else pose_in(view, pose, target, time, recording)
    if in_target is None and frame_id is not None:
        _require_connected(view, frame_id, pose.frame_id)
        _require_transform(view, frame_id, pose.frame_id, time, recording)
    return pose if in_target is None else in_target


def pose_if_placed(
    view: View, pose: Pose, time: Ns, recording: Path, frame_id: str | None
) -> Pose | None:
    """Returns a pose as `pose_in_map`; None, with a note, if none leads to `frame_id` then.

    Raises:
        InvalidArgumentsError: no transform leads to `frame_id` at any time.
    """
    try:
        return pose_in_map(view, pose, time, recording, frame_id)
    except NoDataError:
        view.notes.add(f"{WHEREABOUTS} is left out where no transform leads to {frame_id} then")
        return None


def _require_connected(view: View, frame_id: str, own_frame: str) -> None:
    """Checks that transforms lead from one frame to another at some time.

    Raises:
        InvalidArgumentsError: they never do.
    """
    if not (own_frame and connects(view, (frame_id, own_frame))):
        raise InvalidArgumentsError(
            f"frame_id was {abbreviate(frame_id)}; no transform leads there from "
            f"{own_frame or 'a pose without a frame'}"
            f"{other_transforms(view) or _body_there(view, frame_id, own_frame)}"
        )


def _body_there(view: View, frame_id: str, own_frame: str) -> str:
    """Returns a clause if transforms place the robot's body in a frame, but not its poses."""
    body = robot_body(view)
    if body is None or own_frame == body.child or connects(view, (own_frame, body.child)):
        return ""
    if not connects(view, (frame_id, body.child)):
        return ""
    topic = view.moving_topics[0]
    return f"; transforms place {body.child} there: data.pose_topic={topic} answers by them"


def placed_waypoints(
    view: View, topic: str, waypoints: Sequence[Waypoint], own_frame: str, frame_id: str
) -> tuple[Waypoint, ...]:
    """Returns waypoints of a topic's poses in another frame, each by the transforms of its time.

    At both ends of a recording its first and last transforms hold for 2 s more, as for tracks.
    Waypoints that no transform places are left out, with a note.

    Raises:
        InvalidArgumentsError: no transform leads to `frame_id` at any time.
        NoDataError: none leads there at the time of any of them.
        QueryTimeoutError: the call's time is over before it is known whether any leads there.
    """
    placed_ones: list[Waypoint] = []
    for waypoint in waypoints:
        in_frame = _placed_waypoint(view, topic, waypoint, own_frame, frame_id)
        if in_frame is not None:
            placed_ones.append(in_frame)
        elif not placed_ones:
            # Looking for a frame that no transform leads to takes long.
            _require_connected(view, frame_id, own_frame)
    if waypoints and not placed_ones:
        at = waypoints[0].time
        _require_transform(view, frame_id, own_frame, at, recording_at(view, topic, at))
    if len(placed_ones) < len(waypoints):
        left_out = counted(len(waypoints) - len(placed_ones), "waypoint")
        view.notes.add(f"{left_out} left out: no transform leads to {frame_id} at that time")
    return tuple(placed_ones)


def _placed_waypoint(
    view: View, topic: str, waypoint: Waypoint, own_frame: str, frame_id: str
) -> Waypoint | None:
    """Returns a waypoint in another frame by `_pose_held_in`; None if no transform leads there."""
    recording = recording_at(view, topic, waypoint.time)
    if recording is None:
        return None
    # A quaternion of the yaw about z; of NaN without one, so that the transform places the rest.
    half = math.nan if waypoint.yaw_rad is None else waypoint.yaw_rad / 2
    pose = Pose(waypoint.position, (0.0, 0.0, math.sin(half), math.cos(half)), own_frame)
    in_frame = _pose_held_in(view, pose, frame_id, waypoint.time, recording)
    if in_frame is None or in_frame.orientation is None:
        return None
    turn = None if waypoint.yaw_rad is None else yaw(in_frame.orientation)
    return replace(waypoint, position=in_frame.position, yaw_rad=turn)


def _pose_held_in(view: View, pose: Pose, frame_id: str, time: Ns, recording: Path) -> Pose | None:
    """Returns `pose_in` by the transforms of a time, or up to `HOLD_NS` off, as for tracks."""
    offs = (0, HOLD_NS // 2, -HOLD_NS // 2, HOLD_NS, -HOLD_NS)
    tried = (pose_in(view, pose, frame_id, time + off, recording) for off in offs)
    return next((in_frame for in_frame in tried if in_frame is not None), None)


def _require_transform(
    view: View, frame_id: str, own_frame: str, time: Ns, recording: Path | None
) -> None:
    """Checks that transforms lead from one frame to another at a time.

    Raises:
        NoDataError: they do not; it says when they are known.
    """
    try:
        transform_at(view, frame_id, own_frame, time, recording)
    except NoDataError as error:
        why = f"no transform leads to {frame_id} from {own_frame} then: {error.detail}"
        raise NoDataError(error.reason, why, error.notes) from error


def with_place(view: View, pose: Pose, time: Ns, recording: Path) -> Pose:
    """Returns a pose with the names of the places that it is in, whatever their frames.

    A note names a frame of places that transforms lead to within a minute, but not then.
    """
    points: dict[str, Vector3] = {}
    near = TimeWindow.around(time, _NEAR_NS)
    for frame in dict.fromkeys(place.frame_id for place in view.limits.places):
        in_frame = pose_in(view, pose, frame, time, recording)
        frames = frame, pose.frame_id
        if in_frame is None and pose.frame_id and connects_in_time(view, frames, near):
            in_frame = _pose_held_in(view, pose, frame, time, recording)
            if in_frame is None:
                view.notes.add(f"in which place is not known: no transform leads to {frame} then")
        if in_frame is not None:
            points[frame] = in_frame.position
    return replace(pose, places=places_at(view.limits.places, points))


@dataclass(frozen=True, slots=True)
class MapPlacement:
    """The frames in which it is known where the robot was.

    Attributes:
        frame_id: the frame of places.
        pose_frame: the frame of the poses.
        is_map: whether `frame_id` is the map, in which coordinates outlive a reset of odometry.
        above: the frames above the robot's body, if only transforms place it.
    """

    frame_id: str
    pose_frame: str
    is_map: bool
    above: tuple[str, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames in which positions are known."""
        return tuple(dict.fromkeys((self.frame_id, self.pose_frame, *self.above)))


def map_placement(view: View, topic: str, frame_id: str | None = None) -> MapPlacement:
    """Returns the frames of a topic's poses and of places; places are in `frame_id` if given.

    Raises:
        InvalidArgumentsError: positions are not known in `frame_id`.
        QueryTimeoutError: time runs out before it is clear whether they are known in `frame_id`.
        UndecodableError: no pose can be decoded.
    """
    target, frame = view.limits.map_frame, frame_of_newest_pose(view, topic)
    body = body_of(view, topic)
    above = () if body is None else body.above
    if frame_id in (frame, *above):
        return MapPlacement(frame_id, frame, frame_id == target, above)
    # If time runs out, a `frame_id` must not be denied: then there is no answer. Without one,
    # places are taken to be in the frame of the poses.
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
            f"the place{_body_there(view, frame_id, frame)}"
        )
    return placement


def known_placement(view: View) -> MapPlacement | None:
    """Returns the frames of the robot's poses and of places; None if no poses are recorded."""
    try:
        return map_placement(view, resolve_path_topic(view))
    except (InvalidArgumentsError, NoDataError, UndecodableError):
        return None


def is_one_run(view: View, topic: str, windows: Iterable[TimeWindow]) -> bool:
    """Returns whether all poses in some windows are of one run of odometry.

    Poses of one session are. So are poses of several sessions, if each overlaps the sessions before
    it and repeats them, as a copy does.
    """
    asked = tuple(windows)
    spans = sorted(
        (*span, recording)
        for recording, span in view.timeline.recordings(topic).items()
        if any(window.overlaps(*span) for window in asked)
    )
    seen: set[Session] = set()
    reach = MIN_NS
    for first, last, recording in spans:
        session = view.sessions.session_of(recording)
        if seen and session not in seen:
            overlap = TimeWindow(first, max(min(reach, last) + 1, first))
            bags = view.stream.overlapping_bags([topic], overlap)
            # A recording that a wrong clock dated may span years in which it has no bags.
            are_bags_overlapping = len({span.bag.recording for span in bags}) > 1
            if not are_bags_overlapping or recordings_apart(view, [topic], overlap) != frozenset():
                return False
        seen.add(session)
        reach = max(reach, last)
    return True


def changing_origin(frame_id: str) -> str:
    """Returns the reason, for notes, why coordinates of several runs cannot be compared."""
    if not frame_id or is_odometry(frame_id):
        return f"the origin of {frame_id or 'their frame'} changes with every start"
    return f"the origin of {frame_id} may change with every start, unless data.map_frame names it"


def note_runs(view: View, topic: str, frame_id: str, window: TimeWindow) -> None:
    """Notes if positions are of several runs of odometry, or in a map that was laid out anew."""
    if frame_id == view.limits.map_frame:
        view.notes.add(*origin_notes(view, topic, [window]))
    elif not is_one_run(view, topic, [window]):
        root = root_above(view, frame_id)
        is_map = root is not None and root == view.limits.map_frame
        leads = f"; ask with frame_id={root}" if is_map else map_to_choose(view, frame_id)
        view.notes.add(
            f"{changing_origin(frame_id)}, and these are several: the same coordinates may be "
            f"another place in each{leads}"
        )


def origin_notes(view: View, topic: str, windows: Iterable[TimeWindow]) -> Sequence[str]:
    """Returns a sentence if the map lay elsewhere on earth in some recording of windows."""
    known = view.memo.of(_ORIGINS, dict)
    key = (topic, tuple(windows))
    if key not in known:
        known[key] = []
        with suppress(QueryTimeoutError):
            for frame in _frames_on_earth(view):
                known[key] += islice(_moves_of_map(view, frame, *key), 1)
    return known[key]


def _frames_on_earth(view: View) -> Sequence[str]:
    """Returns the frames at rest on earth to which transforms lead from the map."""
    known = view.timeline.memo.of(_ON_EARTH, dict)
    map_frame = view.limits.map_frame
    if map_frame is not None and map_frame not in known:
        others = sorted(_FIXED_FRAMES - {map_frame})
        known[map_frame] = [frame for frame in others if connects(view, (map_frame, frame))]
    return known.get(map_frame, [])


def _moves_of_map(
    view: View, frame: str, topic: str, windows: Sequence[TimeWindow]
) -> Iterator[str]:
    """Yields a sentence for each recording whose map lay elsewhere than the first one's."""
    ends = sorted(
        (min(last, window.stop - 1), max(first, window.start), recording)
        for window in windows
        for recording, (first, last) in view.timeline.recordings(topic).items()
        if window.overlaps(first, last)
    )
    map_frame, origin = view.limits.map_frame or "", None
    for at, since, recording in ends[:: -(-len(ends) // _MOST_ORIGINS) or 1]:
        with suppress(NoDataError):
            found = transform_at(view, map_frame, frame, at, recording, explains=False)
            place = found.transform.translation
            origin = place if origin is None else origin
            if (away_m := math.dist(place, origin)) > _SAME_ORIGIN_M:
                yield (
                    f"{frame} is {away_m:.2f} m elsewhere in {map_frame} than before "
                    f"{unix_text(since)}, as of a map that was laid out anew: its coordinates name "
                    f"other places than before; data.map_frame={frame} makes them comparable"
                )


def map_to_choose(view: View, frame_id: str) -> str:
    """Returns how to choose the frame above others as the map, to end a note; empty if none is."""
    root = root_above(view, frame_id)
    if root is None or root == view.limits.map_frame:
        return ""
    return f"; if {root}, which it leads to, is a map, set data.map_frame={root}"


def with_runs(view: View, topic: str, path: PathSlice, trajectory: Trajectory) -> Trajectory:
    """Returns the trajectory of a path; what lies across its gaps is unknown between two runs."""
    window = TimeWindow(path.first, path.last + 1)
    is_in_map = set(path.frames) == {view.limits.map_frame}
    if not trajectory.totals.gaps or is_in_map or is_one_run(view, topic, [window]):
        return trajectory
    return replace(trajectory, are_gaps_between_runs=True)


def axes_of(frame_id: str) -> tuple[str, ...]:
    """Returns the note that a frame's axes are not those of REP 103, if its name ends in "ned"."""
    if not frame_id.casefold().endswith("ned"):
        return ()
    axes = f"in {frame_id} x is north, y east and z down"
    return (f"{axes}: yaw is clockwise from north, seen from above",)


def known_track(view: View, frame_id: str, window: TimeWindow) -> KnownTrack:
    """Returns the robot's track in a window; notes say what it lacks.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    known = TrackReader(view, frame_id).track_in(window)
    note_runs(view, resolve_path_topic(view), frame_id, window)
    if known.since is not None:
        view.notes.add_lack(
            f"where the robot was is known back to {unix_text(known.since)}: out of time before "
            "older poses were placed"
        )
    if known.left_out:
        view.notes.add(f"poses that no transform places in {frame_id} are left out")
    return known


def placed_times(track: RobotTrack, mixed: Spans) -> Spans:
    """Returns when it is known where the robot was.

    Not in the spans `mixed`, in which several robots were recorded.
    """
    starts, stops = track.pieces
    return without(spans_of(starts, stops + 1), mixed)


def make_tracks(view: View, window: TimeWindow) -> Iterator[Ns]:
    """Makes and stores the tracks of the parts in a window, in all frames of `MapPlacement`.

    Yields a log time (ns) of each, newest first.
    """
    with suppress(InvalidArgumentsError, NoDataError, UndecodableError):
        topic = resolve_path_topic(view)
        frames = map_placement(view, topic).frames
        made = (TrackReader(view, frame).make_tracks(window) for frame in frames)
        yield from merge(*made, reverse=True)


def places_in(
    view: View, places: Sequence[Place], placement: MapPlacement, window: TimeWindow
) -> list[tuple[Place, KnownTrack]]:
    """Returns the places in the frames of a placement, each with the track in its frame.

    Notes name the places in other frames.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    elsewhere = defaultdict[str, list[str]](list)
    for place in places:
        if place.frame_id not in placement.frames:
            elsewhere[place.frame_id].append(place.name)
    for frame_id, names in elsewhere.items():
        view.notes.add(
            f"left out, as in {frame_id}: {listed(names)}; where the robot was is known in "
            f"{' and '.join(placement.frames)}{_body_there(view, frame_id, placement.pose_frame)}"
        )
    return [
        (place, known_track(view, place.frame_id, window))
        for place in places
        if place.frame_id in placement.frames
    ]


def note_overlaps(view: View, spans_of_places: Iterable[Spans]) -> None:
    """Notes that places overlap, if a robot was in two of them at once.

    For `FLICKER_NS` it is in two that only touch: where it passes the edge and comes back.

    Args:
        view: the view of this call.
        spans_of_places: for each place, when the robot was there.
    """
    latest = MIN_NS
    for start, stop in sorted(chain.from_iterable(spans_of_places)):
        if min(latest, stop) - start > FLICKER_NS:
            view.notes.add("places overlap: what is in two of them counts to both")
            return
        latest = max(latest, stop)


@dataclass
class RobotPlaces:
    """Looks up by its track where the robot was in a window, within some 5 cm.

    Attributes:
        view: the view of this call.
        window: the window.
        frame_id: the frame of positions: the one that was asked for, or else that of places.
        placement: the frames of the poses and of places.
    """

    view: View
    window: TimeWindow
    frame_id: str
    placement: MapPlacement
    _tracks: dict[str, RobotTrack] = field(default_factory=dict)

    def at(self, time: Ns) -> tuple[float, float] | None:
        """Returns where the robot was (x, y in m) in the frame of places.

        None if the track does not reach the time, or if positions are asked for in another frame.
        """
        if self.frame_id != self.placement.frame_id:
            return None
        point = place_at(self._track_in(self.frame_id), time, SILENCE_NS)
        return None if point is None else point[:2]

    def standstill_time(self, start: Ns, end: Ns) -> Ns:
        """Returns the time that shows where the robot stood.

        The middle of the standstill, or its start if the map jumps meanwhile; both of the part
        since the robot was localised, if it was not before.
        """
        track = self._track_in(self.placement.frame_id)
        first, last = np.searchsorted(track.times, (start, end)).tolist()
        if first < last and place_at(track, start, SILENCE_NS) is None:
            start = int(track.times[first])
        return start if self._jumps[max(first - 1, 0) : last].any() else (start + end) // 2

    def names_at(self, time: Ns) -> tuple[str, ...]:
        """Returns the names of the places that the robot was in, the smallest place first."""
        places = self.view.limits.places
        frames = dict.fromkeys(place.frame_id for place in places)
        points = {
            frame: place_at(self._track_in(frame), time, SILENCE_NS)
            for frame in frames
            if frame in self.placement.frames
        }
        return places_at(places, points)

    @cached_property
    def _jumps(self) -> Flags:
        return jumps(self._track_in(self.placement.frame_id))

    def _track_in(self, frame_id: str) -> RobotTrack:
        if frame_id not in self._tracks:
            self._tracks[frame_id] = self._read_track(frame_id)
        return self._tracks[frame_id]

    def _read_track(self, frame_id: str) -> RobotTrack:
        try:
            known = TrackReader(self.view, frame_id).track_in(self.window)
            note_runs(self.view, resolve_path_topic(self.view), frame_id, self.window)
        except QueryTimeoutError:
            # If the whole call is out of time, not reading alone, it fails here.
            self.view.bags.check_deadline()
            self._note_reach(frame_id, "not known")
            return empty_track()
        if known.since is not None:
            self._note_reach(frame_id, f"known back to {unix_text(known.since)} alone")
        return known.track

    def _note_reach(self, frame_id: str, reach: str) -> None:
        self.view.notes.add(
            f"where the robot was in {frame_id} is {reach}: reading the bags that are not "
            "stored takes too long"
        )


def robot_places(view: View, window: TimeWindow, frame_id: str | None = None) -> RobotPlaces | None:
    """Returns a lookup of the robot's places in a window; None if no poses are recorded.

    Raises:
        InvalidArgumentsError: positions are not known in `frame_id`.
    """
    usual = known_placement(view)
    if usual is None:
        return None
    asked = usual if frame_id is None else map_placement(view, resolve_path_topic(view), frame_id)
    return RobotPlaces(view, window, asked.frame_id, usual)

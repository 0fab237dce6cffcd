"""Places what detectors saw in the rows of one session in the map, as sights.

A topic is a detector's if a message of it has a detection, or if the name of its type says so. Its
other messages are looks that saw nothing. Any topic that may have detections gets looks, since
another part of the history may show that it is a detector's.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import FramePoses, FrameTree, Rotations
from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.poses import NO_POSES, Poses, headings, joined_poses
from ros2_memory.analysis.sights import (
    AHEAD_MM,
    SLICE_NS,
    DetectorMessages,
    Floats,
    Sights,
    fixes_of,
    sights_of,
)
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.geometry import multiply
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns
from ros2_memory.history.detections import Detected, DetectionRows, joined_detected
from ros2_memory.history.driven_path import Body, body_by_transforms, poses_by_session
from ros2_memory.history.poses import pose_rows
from ros2_memory.history.scan import messages_of, scan
from ros2_memory.history.transforms import frames_over

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.columns.units import Rows
    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import BagFile
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View


LOCALISER: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
NEAR_NS: Final[Ns] = NS_PER_S
"""Farther from a pose in time, the robot's place is unknown."""
_FIX_NS: Final[Ns] = 2 * NS_PER_S
"""The time between fixes of odometry in the map."""
_AHEAD_NS: Final[Ns] = 3 * _FIX_NS
"""Fixes go on after the last detection: a jump soon after it shows that localisation was off."""
_MOST_FIXES: Final = 2_000
_SAID_NS: Final[Ns] = NS_PER_S // 2
"""One message of a localiser is read in each half of a second."""
_SAME_M: Final = 0.1
"""Fixes with smaller changes are left out."""
_COVARIANCE: Final = 36
"""Numbers in the covariance of a pose: 6 x 6, of x, y, z and the turns about them."""
_VARIANCES: Final = (0, 7, 35)
"""Where the variances of x, y and yaw are among them."""


_OF_DETECTORS: Final = re.compile("(detection|recognizedobject)[^/]*$", re.IGNORECASE)
AROUND_NS: Final[Ns] = 12 * NS_PER_S
"""How far around a stretch poses and transforms are read."""


class PlacedSights(NamedTuple):
    """The sights of a session.

    Attributes:
        frame_id: of all places and poses: the map, or the frame of the robot's poses if no
            transforms lead to the map from there, nor from what was seen.
        sights: the sights of each topic; sights without a topic have the fixes.
        detectors: the topics that surely have a detector.
    """

    frame_id: str
    sights: list[Sights]
    detectors: set[str]


class Placer:
    """Makes sights of rows.

    Args:
        view: has the bags.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._sessions = view.sessions
        self.rows = DetectionRows(view)

    @cached_property
    def body(self) -> Body | None:
        """The robot's body if transforms place it; None if a topic of poses does."""
        return body_by_transforms(self._view)

    def place(
        self,
        window: TimeWindow,
        session: Session,
        lender: Session,
        units: Iterable[Rows],
    ) -> PlacedSights | None:
        """Returns the sights in rows of a session; None if there are no messages.

        Args:
            window: the time of the sights.
            session: the session of the rows.
            lender: the session whose transforms hold for it; empty if none do.
            units: the rows of the topics. Rows before the window show which messages repeat them.

        Raises:
            QueryTimeoutError: the deadline has passed.
        """
        messages_of_topics, detectors = self._new_messages(units, window.start)
        if not messages_of_topics:
            return None
        poses = self._poses(session, lender, window)
        seen_in = _frames_of(messages_of_topics[topic] for topic in detectors)
        target, frames = self._frames(lender, window, poses, seen_in)
        sights = [
            _sights_of(topic, messages, frames, _robot_at(poses, messages, frames))
            for topic, messages in messages_of_topics.items()
        ]
        if target == self._view.limits.map_frame and len(poses):
            times = np.concatenate([messages.log_times for messages in messages_of_topics.values()])
            sights.append(self._fixes(session, poses, frames, times))
        return PlacedSights(target, sights, detectors)

    def sights_by_bag(
        self,
        window: TimeWindow,
        session: Session,
        lender: Session,
        units_of_bags: Mapping[BagFile, Sequence[Rows]],
    ) -> Iterator[tuple[BagFile, str, Sights]]:
        """Yields each bag with the frame and the sights of each topic that detected something.

        See `place` for the arguments. These sights do not have the robot's poses.
        """
        by_bag: dict[BagFile, dict[str, Detected]] = {}
        seen_in: set[str] = set()
        for bag, units in units_of_bags.items():
            by_bag[bag], detectors = self._new_messages(units, window.start)
            seen_in |= _frames_of(by_bag[bag][topic] for topic in detectors)
        poses = self._poses(session, lender, window)
        target, frames = self._frames(lender, window, poses, seen_in)
        for bag, messages_of_topics in by_bag.items():
            for topic, messages in messages_of_topics.items():
                if messages.found.rows.size:
                    nowhere = np.full((len(messages.log_times), 8), math.nan)
                    yield bag, target, _sights_of(topic, messages, frames, nowhere)

    def _new_messages(
        self, units: Iterable[Rows], since: Ns
    ) -> tuple[dict[str, Detected], set[str]]:
        """Returns the new messages of each topic since a time, and the topics of sure detectors.

        Messages that only repeat the one before are left out.
        """
        units_of_topics: dict[str, list[Rows]] = defaultdict(list)
        # Sorted, so that sights do not depend on how rows are stored.
        for rows in sorted(units, key=lambda rows: (rows.first, rows.last, str(rows.recording))):
            units_of_topics[rows.table.channel.topic].append(rows)
        messages_of_topics: dict[str, Detected] = {}
        detectors: set[str] = set()
        for topic, units_of_topic in units_of_topics.items():
            messages = joined_detected([self.rows.read(rows) for rows in units_of_topic])
            messages = messages.new_since(since)
            if not messages.log_times.size:
                continue
            messages_of_topics[topic] = messages
            named = [
                rows for rows in units_of_topic if _OF_DETECTORS.search(rows.table.channel.type)
            ]
            if messages.found.rows.size or any(
                self.rows.columns.has_labels(rows.table) for rows in named
            ):
                detectors.add(topic)
        return messages_of_topics, detectors

    def _poses(self, session: Session, lender: Session, window: TimeWindow) -> Poses:
        """Returns the robot's poses in the frame that most of them are in."""
        around = window.widened(AROUND_NS)
        if self.body is None:
            poses = self._recorded_poses(session, around)
        else:
            poses = poses_by_session(self._view, around, lender)
        if not len(poses):
            return poses
        # Poses of one topic nearly always have one frame: those in other frames are left out.
        frame = int(np.bincount(poses.frames.codes).argmax())
        is_place = are_places(poses.positions)
        poses = poses.rows(np.flatnonzero((poses.frames.codes == frame) & is_place))
        codes, words = poses.frames.codes * 0, poses.frames.words[frame : frame + 1]
        return replace(poses, frames=poses.frames._replace(codes=codes, words=words))

    def _recorded_poses(self, session: Session, window: TimeWindow) -> Poses:
        """Returns the poses of the robot's topic in a session and a window."""
        units = pose_rows(
            self._view,
            self._view.pose_topic,
            window,
            among=lambda recording: self._sessions.session_of(recording) == session,
        )
        try:
            return joined_poses([unit.poses for unit in units])
        except InvalidArgumentsError:  # the topic is of no poses
            return NO_POSES

    def _frames(
        self, lender: Session, window: TimeWindow, poses: Poses, seen_in: set[str]
    ) -> tuple[str, FrameTree]:
        """Returns the frame for sights, and the frames in it.

        It is the map if transforms lead there from the robot's poses, or from what was seen alone.
        `seen_in` has the frames of that.
        """
        pose_frame = poses.frames.words[0] if len(poses) else ""
        target = self._view.limits.map_frame or pose_frame
        if not lender:
            target = pose_frame if len(poses) else target
            return target, FrameTree((), {}, target)
        frames = frames_over(self._view, lender, window, target)
        is_map_reached = pose_frame and (pose_frame == target or frames.reaches(pose_frame))
        if not len(poses) or is_map_reached:
            return target, frames
        by_poses = frames_over(self._view, lender, window, pose_frame)
        is_by_poses = pose_frame in seen_in or any(map(by_poses.reaches, seen_in))
        if any(map(frames.reaches, seen_in)) and not is_by_poses:
            return target, frames
        return pose_frame, by_poses

    def _fixes(self, session: Session, poses: Poses, frames: FrameTree, detected: Ints) -> Sights:
        """Returns how well it was known where the robot was around detections.

        `detected` has the log times (ns) of the detections.
        """
        begin, end = int(detected.min()), int(detected.max())
        around = TimeWindow(begin, end).widened(AROUND_NS)
        said_at, said = self._localiser_sigmas(session, around)
        times, step = _fix_times(begin, end + _AHEAD_NS)
        jumps = np.zeros(len(times))
        odometry = poses.frames.words[0]
        placed = frames.poses(odometry, times) if odometry != frames.target else None
        if placed is not None:
            times = times[placed.valid]
            jumps = _jumps_ahead(placed, poses, times)
        elif not len(said):
            return fixes_of(times[:0], jumps[:0], said)
        sigma = np.append(said, [math.nan])[np.searchsorted(said_at, times, side="right") - 1]
        is_changed = jumps[1:] > _SAME_M
        is_changed |= np.abs(np.diff(np.nan_to_num(sigma, nan=-1.0))) > _SAME_M
        # The fixes on both sides of a change, and in any case one in each slice of the clock.
        is_needed = times // SLICE_NS != (times - step) // SLICE_NS
        is_needed[1:] |= is_changed
        is_needed[:-1] |= is_changed
        is_needed &= (times >= begin - step) & (times <= end + _AHEAD_NS)
        return fixes_of(times[is_needed], jumps[is_needed], sigma[is_needed])

    def _localiser_sigmas(self, session: Session, window: TimeWindow) -> tuple[Ints, Floats]:
        """Returns when localisers gave their covariance (ns), and its standard deviation (m).

        Messages are read, since covariances have no columns. See `_sigma_ahead`.
        """
        said: list[tuple[Ns, float]] = []
        messages = self._localiser_messages(session, window)
        for message, decoded in self._view.bags.decoded(messages):
            frame = self._view.extractor.frame(decoded).lstrip("/")
            pose = getattr(decoded, "pose", None)
            sigma = _sigma_ahead(getattr(pose, "covariance", None))
            if sigma is not None and frame == self._view.limits.map_frame:
                said.append((message.time, sigma))
        said.sort()
        times = np.array([time for time, _ in said], np.int64)
        return times, np.array([sigma for _, sigma in said], np.float64)

    def _localiser_messages(self, session: Session, window: TimeWindow) -> Iterator[StoredMessage]:
        """Yields what each localiser said last in each `_SAID_NS` of the clock, up to its end.

        Fixes lie at such ends, so it does not matter to them where scans cut the time in between.
        """
        timeline = self._view.timeline
        for topic in timeline.topics():
            if LOCALISER not in timeline.types_of(topic):
                continue
            for rows in scan(self._view, topic, window):
                if self._sessions.session_of(rows.recording) == session:
                    ends = -(-rows.times // _SAID_NS)
                    lasts = np.flatnonzero(np.diff(ends, append=MAX_NS))
                    yield from messages_of(self._view, rows.some(lasts))


def _frames_of(detected: Iterable[Detected]) -> set[str]:
    """Returns the frames of messages and of the detections in them."""
    words: set[str] = set()
    for messages in detected:
        words.update(messages.frames.words, messages.found.frames.words)
    return {word.lstrip("/") for word in words} - {""}


def _fix_times(first: Ns, last: Ns) -> tuple[Ints, Ns]:
    """Returns the times of fixes around two moments (ns), and the step between them.

    They are multiples of the step, so that they do not depend on the moments.
    """
    step = max(1, (last - first) // (_MOST_FIXES * _FIX_NS)) * _FIX_NS
    most = MAX_NS // step
    begin, end = max(first // step - 1, -most), min(last // step + 2, most)
    return np.arange(begin, end) * step, step


def _jumps_ahead(placed: FramePoses, poses: Poses, times: Ints) -> Floats:
    """Returns how far (m) the map moved a point `AHEAD_MM` before the robot since the time before.

    What the robot drove does not count: the point is where odometry had it at the earlier time.

    Args:
        placed: odometry's frame in the map.
        poses: the robot's poses in odometry's frame.
        times: those of `placed` at which it is valid (ns).
    """
    jumps = np.zeros(len(times))
    if len(times) < 2:
        return jumps
    yaw = _yaw(placed.rotation)[placed.valid]
    origin_x, origin_y = (axis[placed.valid] for axis in placed.translation[:2])
    turn = np.remainder(np.diff(yaw) + np.pi, 2 * np.pi) - np.pi
    x, y = (np.interp(times[:-1], poses.times, poses.positions[:, axis]) for axis in (0, 1))
    cos, sin = np.diff(np.cos(yaw)), np.diff(np.sin(yaw))
    moved_x = np.diff(origin_x) + cos * x - sin * y
    moved_y = np.diff(origin_y) + sin * x + cos * y
    jumps[1:] = np.hypot(moved_x, moved_y) + AHEAD_MM / 1000 * np.abs(turn)
    return jumps


def _sights_of(topic: str, messages: Detected, frames: FrameTree, robot: Floats) -> Sights:
    """Returns the sights of a topic's messages. `robot` is as in `DetectorMessages`."""
    found = messages.found
    seen = DetectorMessages(
        times=messages.log_times,
        robot=robot,
        rows=found.rows,
        labels=found.labels.codes.astype(np.int64),
        names=found.labels.words,
        places=_places_in_target(messages, frames),
        scores=found.scores,
        ids=found.ids.codes.astype(np.int64),
        id_names=found.ids.words,
    )
    return sights_of(topic, seen)


def _places_in_target(detected: Detected, frames: FrameTree) -> Floats:
    """Returns the places of detections in the target (N x 3, m); NaN without a transform."""
    detections = detected.found
    places = np.full(detections.places.shape, math.nan)
    has_place = ~np.isnan(detections.places).any(axis=1)
    for code, frame in enumerate(detections.frames.words):
        rows = np.flatnonzero(has_place & (detections.frames.codes == code))
        if not frame or not len(rows):
            continue
        poses = frames.poses(frame, detected.times[detections.rows[rows]])
        if poses is not None:
            x, y, z = detections.places[rows].T
            placed = np.stack(poses.points((x, y, z)), axis=1)
            places[rows] = np.where(poses.valid[:, None], placed, math.nan)
    return places


def _robot_at(poses: Poses, detected: Detected, frames: FrameTree) -> Floats:
    """Returns the robot's pose at each message, and how its detector is turned and leans.

    Its columns are those of `DetectorMessages.robot`.

    It follows from the transforms of the frames that carry the detector, which are looked up by
    stamps as its detections are; without them, from the poses, which have log times. A message
    without a frame is taken to be in the frame of most detections.
    """
    times, pose_frame = detected.times, poses.frames.words[0] if len(poses) else ""
    ahead_and_upright = np.tile((0.0, 0.0, 0.0, 1.0), (len(times), 1))
    robot = np.column_stack((_pose_at(poses, times, frames), ahead_and_upright))
    of_detections = detected.found.frames
    usual = ""
    if len(of_detections):
        usual = of_detections.words[np.bincount(of_detections.codes).argmax()]
    for code, frame in enumerate(detected.frames.words):
        carriers = frames.carriers(frame or usual, pose_frame)
        if carriers is None:
            continue
        rows = np.flatnonzero(detected.frames.codes == code)
        head, body = (frames.poses(carrier, times[rows]) for carrier in carriers)
        if head is None or body is None:
            continue
        yaw = _yaw(body.rotation)
        by_body = np.stack((*body.translation, yaw), axis=1)
        by_body = np.where(body.valid[:, None], by_body, math.nan)
        robot[rows, :4] = np.where(np.isnan(by_body), robot[rows, :4], by_body)
        robot[rows, 5:] = np.where(head.valid[:, None], _up(head.rotation), robot[rows, 5:])
        head_frame, body_frame = carriers
        if head_frame != body_frame:
            is_known = head.valid & body.valid
            robot[rows, 2] += np.where(is_known, head.translation[2] - body.translation[2], 0.0)
            robot[rows, 4] = np.where(is_known, _yaw(head.rotation) - yaw, math.nan)
    return robot


def _pose_at(poses: Poses, times: Ints, frames: FrameTree) -> Floats:
    """Returns x, y, z (m) and yaw (rad) of the robot at each time, interpolated between poses.

    NaN farther than 1 s from a pose, or if no transform leads from the frame of the poses.
    """
    robot = np.full((len(times), 4), math.nan)
    placed = frames.poses(poses.frames.words[0], times) if len(poses) else None
    if placed is None:
        return robot
    last = len(poses) - 1
    after = np.searchsorted(poses.times, times, side="right")
    before, after = np.clip(after - 1, 0, last), np.clip(after, 0, last)
    start, stop = poses.times[before], poses.times[after]
    ratio = np.clip((times - start) / np.maximum(stop - start, 1), 0.0, 1.0)
    is_known = np.minimum(np.abs(times - start), np.abs(stop - times)) <= NEAR_NS
    is_known &= (stop - start <= 2 * NEAR_NS) & placed.valid
    begin, end = poses.positions[before], poses.positions[after]
    x, y, z = (begin + (end - begin) * ratio[:, None]).T
    heading = headings(poses.turns)
    turn = np.remainder(heading[after] - heading[before] + np.pi, 2 * np.pi) - np.pi
    half = (heading[before] + turn * ratio) / 2
    level = np.zeros(len(times))
    yaw = _yaw(multiply(placed.rotation, (level, level, np.sin(half), np.cos(half))))
    pose = np.stack((*placed.points((x, y, z)), yaw), axis=1)
    return np.where(is_known[:, None], pose, math.nan)


def _yaw(rotation: Rotations) -> Floats:
    x, y, z, w = rotation
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _up(rotation: Rotations) -> Floats:
    """Returns the direction of up in each rotated frame (N x 3)."""
    x, y, z, w = rotation
    up = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return np.stack(up, axis=1)


def _sigma_ahead(covariance: object) -> float | None:
    """Returns the standard deviation (m) of a point `AHEAD_MM` before a pose; None if unknown."""
    if not isinstance(covariance, Sequence | np.ndarray) or len(covariance) != _COVARIANCE:
        return None
    x, y, yaw = (float(covariance[index]) for index in _VARIANCES)
    variance = max(x, y) + yaw * (AHEAD_MM / 1000) ** 2
    return math.sqrt(variance) if variance >= 0 and math.isfinite(variance) else None

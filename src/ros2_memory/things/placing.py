"""What detectors saw in some rows of one session: placed in the map, as sights.

Which topics are of detectors shows in their messages: at some time they hold detections, or their
type is named for them. Other messages of such a topic count as looks that saw nothing. So there are
looks of all topics that may have detections; `detectors` are those that show it in these rows.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.frames import FrameTree, Rotations
from ros2_memory.analysis.motion.odometry import FARTHEST_M
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
from ros2_memory.core.arrays import Ints, run_starts
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
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
    from ros2_memory.core.model import BagFile
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View


LOCALISER: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
_NEAR_NS: Final[Ns] = NS_PER_S
"""Farther from a pose, where the robot was is not known."""
_FIX_NS: Final[Ns] = 2 * NS_PER_S
"""How far apart it is looked where odometry is in the map."""
_AHEAD_NS: Final[Ns] = 3 * _FIX_NS
"""How far beyond the last detection: a jump soon after it shows that localisation was off."""
_MOST_FIXES: Final = 2_000
_SAID_NS: Final[Ns] = NS_PER_S // 2
"""What a localiser says more often than that is not read."""
_SAME_M: Final = 0.1
"""What changes less from one look to the next is left out."""
_COVARIANCE: Final = 36


_OF_DETECTORS: Final = re.compile("(detection|recognizedobject)[^/]*$", re.IGNORECASE)
AROUND_NS: Final[Ns] = 12 * NS_PER_S
"""How far around a stretch poses and transforms are read."""


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
        """The robot's body where transforms place it; None where a topic of poses does."""
        return body_by_transforms(self._view)

    def placed(
        self,
        window: TimeWindow,
        session: Session,
        lender: Session,
        units: Iterable[Rows],
    ) -> tuple[str, list[Sights], set[str]] | None:
        """Returns the sights of some rows of a session; None where there are no messages.

        First the frame of all places and poses: the map, or that of the robot's poses where no
        transforms lead to the map. Then the sights of each topic; those without a topic have the
        fixes. Last the topics that are surely of detectors.

        Args:
            window: the rows are of this time.
            session: the rows are of it.
            lender: the one whose transforms hold for it; empty where none do.
            units: the rows, of some topics; those before the window show what repeats them.

        Raises:
            QueryTimeoutError: the deadline has passed.
        """
        detected, detectors = self._detected(units, window.start)
        if not detected:
            return None
        poses = self._poses(session, lender, window)
        target, frames = self._frames(lender, window, poses)
        sights = [
            _sights_of(topic, messages, frames, _robot_at(poses, messages, frames))
            for topic, messages in detected.items()
        ]
        if target == self._view.limits.map_frame and len(poses):
            times = np.concatenate([messages.log_times for messages in detected.values()])
            sights.append(self._fixes(session, poses.frames.words[0], frames, times))
        return target, sights, detectors

    def sights_by_bag(
        self,
        window: TimeWindow,
        session: Session,
        lender: Session,
        units_of_bags: Mapping[BagFile, Sequence[Rows]],
    ) -> Iterator[tuple[BagFile, str, Sights]]:
        """Yields the sights of each topic in each bag, with the frame that their places are in.

        Takes what `placed` takes. Where the robot was is not in them.
        """
        target, frames = self._frames(lender, window, self._poses(session, lender, window))
        for bag, units in units_of_bags.items():
            for topic, messages in self._detected(units, window.start)[0].items():
                if messages.found.rows.size:
                    nowhere = np.full((len(messages.log_times), 5), math.nan)
                    yield bag, target, _sights_of(topic, messages, frames, nowhere)

    def _detected(self, units: Iterable[Rows], since: Ns) -> tuple[dict[str, Detected], set[str]]:
        """Returns the messages since a time by topic, and which topics are surely of detectors.

        Those that only repeat the one before are no messages.
        """
        by_topic: dict[str, list[Rows]] = defaultdict(list)
        # However they are stored.
        for rows in sorted(units, key=lambda rows: (rows.first, rows.last, str(rows.recording))):
            by_topic[rows.table.channel.topic].append(rows)
        detected: dict[str, Detected] = {}
        detectors: set[str] = set()
        for topic, of_topic in by_topic.items():
            messages = joined_detected([self.rows.of(rows) for rows in of_topic]).new_since(since)
            named = [rows for rows in of_topic if _OF_DETECTORS.search(rows.table.channel.type)]
            is_named = any(map(self.rows.have_labels, named))
            if messages.log_times.size:
                detected[topic] = messages
                detectors |= {topic} if is_named or messages.found.rows.size else set()
        return detected, detectors

    def _poses(self, session: Session, lender: Session, window: TimeWindow) -> Poses:
        """Returns the robot's poses in the frame that most of them are in."""
        around = window.widened(2 * _NEAR_NS)
        if self.body is None:
            poses = self._recorded_poses(session, around)
        else:
            poses = poses_by_session(self._view, around, lender, self.body)
        if not len(poses):
            return poses
        # Poses of one topic nearly always have one frame: those of others are left out.
        frame = int(np.bincount(poses.frames.codes).argmax())
        is_place = (np.abs(poses.positions) < FARTHEST_M).all(axis=1)
        poses = poses.rows(np.flatnonzero((poses.frames.codes == frame) & is_place))
        codes, words = poses.frames.codes * 0, poses.frames.words[frame : frame + 1]
        return replace(poses, frames=poses.frames._replace(codes=codes, words=words))

    def _recorded_poses(self, session: Session, window: TimeWindow) -> Poses:
        """Returns the poses of the robot's topic that a session has in a window."""
        failures: list[UndecodableError] = []
        units = pose_rows(
            self._view,
            self._view.pose_topic,
            window,
            failures,
            among=lambda recording: self._sessions.of(recording) == session,
        )
        try:
            return joined_poses([unit.poses for unit in units])
        except InvalidArgumentsError:  # the topic is of no poses
            return NO_POSES

    def _frames(self, lender: Session, window: TimeWindow, poses: Poses) -> tuple[str, FrameTree]:
        """Returns the frame to place all in (the map if transforms lead there), and the frames."""
        pose_frame = poses.frames.words[0] if len(poses) else ""
        target = self._view.limits.map_frame or pose_frame
        if not lender:
            target = pose_frame if len(poses) else target
            return target, FrameTree((), {}, target)
        frames = frames_over(self._view, lender, window, target)
        is_map_reached = pose_frame and (pose_frame == target or frames.reaches(pose_frame))
        if not len(poses) or is_map_reached:
            return target, frames
        return pose_frame, frames_over(self._view, lender, window, pose_frame)

    def _fixes(self, session: Session, odometry: str, frames: FrameTree, detected: Ints) -> Sights:
        """Returns where odometry was in the map around detections, where that changes."""
        first, last = int(detected.min()), int(detected.max()) + _AHEAD_NS
        step = max(1, (last - first) // (_MOST_FIXES * _FIX_NS)) * _FIX_NS
        most = MAX_NS // step
        begin, end = max(first // step - 1, -most), min(last // step + 2, most)
        times = np.arange(begin, end) * step
        around = TimeWindow(first, int(detected.max())).widened(AROUND_NS)
        said_at, said = self._localised(session, around)
        poses = frames.poses(odometry, times) if odometry != frames.target else None
        pose = np.zeros((len(times), 3))
        if poses is not None:
            x, y, _ = poses.translation
            pose = np.stack((x, y, _yaw(poses.rotation)), axis=1)[poses.valid]
            times = times[poses.valid]
        elif not len(said):
            return fixes_of(times[:0], pose[:0], said)
        sigma = np.append(said, [math.nan])[np.searchsorted(said_at, times, side="right") - 1]
        is_changed = np.abs(np.diff(pose, axis=0)).max(axis=1, initial=0.0) > _SAME_M
        is_changed |= np.abs(np.diff(np.nan_to_num(sigma, nan=-1.0))) > _SAME_M
        # One in each slice of the clock besides, however little changes.
        is_kept = times // SLICE_NS != (times - step) // SLICE_NS
        is_kept[1:] |= is_changed
        is_kept[:-1] |= is_changed
        is_kept &= (times >= first - step) & (times <= last)
        return fixes_of(times[is_kept], pose[is_kept], sigma[is_kept])

    def _localised(self, session: Session, window: TimeWindow) -> tuple[Ints, Floats]:
        """Returns what localisers said, once in `_SAID_NS`: when, and the standard deviation (m).

        From the messages: covariances have no columns.
        """
        view, said = self._view, []
        for topic in view.timeline.topics():
            if LOCALISER not in view.timeline.types_of(topic):
                continue
            for rows in scan(view, topic, window):
                if self._sessions.of(rows.recording) != session:
                    continue
                slices = rows.times // _SAID_NS
                firsts = run_starts(slices)
                for stored in messages_of(view, rows.some(firsts)):
                    message = view.bags.decode(stored)
                    if message is None:
                        continue
                    frame = view.extractor.frame(message).lstrip("/")
                    pose = getattr(message, "pose", None)
                    sigma = _sigma_ahead(getattr(pose, "covariance", None))
                    if sigma is not None and frame == view.limits.map_frame:
                        said.append((stored.time, sigma))
        said.sort()
        times = np.array([time for time, _ in said], np.int64)
        return times, np.array([sigma for _, sigma in said], np.float64)


def _sights_of(topic: str, messages: Detected, frames: FrameTree, robot: Floats) -> Sights:
    found = messages.found
    seen = DetectorMessages(
        times=messages.log_times,
        robot=robot,
        rows=found.rows,
        labels=found.labels.codes.astype(np.int64),
        names=found.labels.words,
        places=_places_in_target(messages, frames),
        scores=found.scores,
    )
    return sights_of(topic, seen)


def _places_in_target(detected: Detected, frames: FrameTree) -> Floats:
    """Returns the places (N x 3, m) of detections in the target; NaN where no transform leads."""
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
    """Returns the robot's pose at each message, and the yaw of its detector relative to it (rad).

    As in `DetectorMessages.robot`. Where there is no pose, transforms of the frames that carry the
    detector are used. A message without a frame is in the frame of most detections.
    """
    times, pose_frame = detected.times, poses.frames.words[0] if len(poses) else ""
    robot = np.column_stack((_posed_at(poses, times, frames), np.zeros(len(times))))
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
        pose = np.stack((*body.translation, yaw, 0 * yaw), axis=1)
        posed = np.where(body.valid[:, None], pose, math.nan)
        robot[rows] = np.where(np.isnan(robot[rows]), posed, robot[rows])
        head_frame, body_frame = carriers
        if head_frame != body_frame:
            is_known = head.valid & body.valid
            robot[rows, 4] = np.where(is_known, _yaw(head.rotation) - yaw, math.nan)
    return robot


def _posed_at(poses: Poses, times: Ints, frames: FrameTree) -> Floats:
    """Returns x, y, z (m) and heading (rad) of the robot at some times; NaN where not known.

    That is farther than 1 s from a pose, or where no transform leads from its frame.
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
    is_known = np.minimum(np.abs(times - start), np.abs(stop - times)) <= _NEAR_NS
    is_known &= (stop - start <= 2 * _NEAR_NS) & placed.valid
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


def _sigma_ahead(covariance: object) -> float | None:
    """Returns the standard deviation (m) of a point `AHEAD_MM` before a pose; None if unknown."""
    if not isinstance(covariance, Sequence | np.ndarray) or len(covariance) != _COVARIANCE:
        return None
    x, y, yaw = (float(covariance[index]) for index in (0, 7, 35))
    variance = max(x, y) + yaw * (AHEAD_MM / 1000) ** 2
    return math.sqrt(variance) if variance >= 0 and math.isfinite(variance) else None

"""What detectors saw in some rows of one session: placed in the map, as sights.

Which topics are of detectors shows in their messages: at some time they hold detections, or their
type is named for them. Other messages of such a topic count as looks that saw nothing. So there are
looks of all topics that may have detections; `detectors` are those that show it in these rows.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import FrameTree, Rotations
from ros2_memory.analysis.motion.odometry import FARTHEST_M
from ros2_memory.analysis.poses import NO_POSES, Poses, headings, joined_poses
from ros2_memory.analysis.sights import (
    AHEAD_MM,
    SLICE_NS,
    DetectorMessages,
    Floats,
    Ints,
    Sights,
    fixes_of,
    sights_of,
)
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.geometry import multiply
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns
from ros2_memory.history.detections import Detected, DetectionRows, joined_detected
from ros2_memory.history.poses import pose_rows
from ros2_memory.history.scan import messages_of, scan
from ros2_memory.history.transforms import frames_over, sessions_of

if TYPE_CHECKING:
    from ros2_memory.columns.units import Rows
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


_OF_DETECTORS: Final = ("detection", "recognizedobject")
AROUND_NS: Final[Ns] = 12 * NS_PER_S
"""How far around a stretch poses and transforms are read."""


class SessionSights(NamedTuple):
    """What the detectors of one session saw.

    Attributes:
        frame_id: of all places and poses: the map, or that of the robot's poses where no transforms
            lead to the map.
        sights: of each topic; those without a topic have the fixes.
        detectors: topics that are surely of detectors.
    """

    frame_id: str
    sights: tuple[Sights, ...]
    detectors: frozenset[str]


class Placer:
    """Makes sights of rows.

    Args:
        view: has the bags.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._sessions = sessions_of(view)
        self.rows = DetectionRows(view)

    def placed(
        self, window: TimeWindow, own: Session, among: Session, found: Sequence[tuple[str, Rows]]
    ) -> SessionSights | None:
        """Returns the sights of some rows of a session; None where there are no messages.

        Args:
            window: the rows are of this time.
            own: the session.
            among: the one whose transforms hold for it; empty where none do.
            found: rows with their topics.

        Raises:
            QueryTimeoutError: the deadline has passed.
        """
        by_topic: dict[str, list[Rows]] = defaultdict(list)
        # However they are stored.
        order = sorted(
            found, key=lambda each: (each[1].first, each[1].last, str(each[1].recording))
        )
        for topic, rows in order:
            by_topic[topic].append(rows)
        detected: dict[str, Detected] = {}
        detectors: set[str] = set()
        for topic, some in by_topic.items():
            all_of = joined_detected([self.rows.of(rows) for rows in some])
            named = any(is_named_for_detections(rows.table.channel.type) for rows in some)
            if all_of.log_times.size:
                detected[topic] = all_of
                detectors |= {topic} if named or all_of.found.rows.size else set()
        if not detected:
            return None
        poses = self._poses(own, window)
        target, frames = self._frames(among, window, poses)
        sights = [sights_of(topic, _seen(each, poses, frames)) for topic, each in detected.items()]
        if target == self._view.limits.map_frame and len(poses):
            times = np.concatenate([each.log_times for each in detected.values()])
            fixes = self._fixes(own, poses.frames.words[0], frames, times)
            sights.append(replace(sights[0].only().with_fixes(fixes), topics=(), labels=()))
        return SessionSights(target, tuple(sights), frozenset(detectors))

    def _poses(self, own: Session, window: TimeWindow) -> Poses:
        """Returns the robot's poses in the frame that most of them are in."""
        failures: list[UndecodableError] = []
        found = pose_rows(
            self._view,
            self._view.pose_topic,
            window.widened(2 * _NEAR_NS),
            failures,
            among=lambda recording: self._sessions.of(recording) == own,
        )
        try:
            poses = joined_poses([each.poses for each in found])
        except InvalidArgumentsError:  # the topic is of no poses
            return NO_POSES
        if not len(poses):
            return poses
        # Poses of one topic nearly always have one frame: those of others are left out.
        frame = int(np.bincount(poses.frames.codes).argmax())
        is_place = (np.abs(poses.positions) < FARTHEST_M).all(axis=1)
        is_one = (poses.frames.codes == frame) & is_place
        poses = poses.rows(np.flatnonzero(is_one))
        words = poses.frames.words[frame : frame + 1]
        return replace(
            poses, frames=poses.frames._replace(codes=poses.frames.codes * 0, words=words)
        )

    def _frames(self, among: Session, window: TimeWindow, poses: Poses) -> tuple[str, FrameTree]:
        """Returns the frame to place all in (the map if transforms lead there), and the frames."""
        own = poses.frames.words[0] if len(poses) else ""
        target = self._view.limits.map_frame or own
        if not among:
            target = own if len(poses) else target
            return target, FrameTree((), {}, target)
        frames = frames_over(self._view, among, window, target)
        if not len(poses) or (own and (own == target or frames.reaches(own))):
            return target, frames
        return own, frames_over(self._view, among, window, own)

    def _fixes(self, own: Session, frame: str, frames: FrameTree, seen: Ints) -> Ints:
        """Returns where odometry was in the map around detections, where that changes."""
        first, last = int(seen.min()), int(seen.max()) + _AHEAD_NS
        step = max(1, (last - first) // (_MOST_FIXES * _FIX_NS)) * _FIX_NS
        most = MAX_NS // step
        begin, end = max(first // step - 1, -most), min(last // step + 2, most)
        times = np.arange(begin, end) * step
        around = TimeWindow(int(seen.min()), int(seen.max())).widened(AROUND_NS)
        said, sigma = self._localised(own, around)
        found = frames.poses(frame, times) if frame != frames.target else None
        pose = np.zeros((len(times), 3))
        if found is not None:
            x, y, _ = found.translation
            pose = np.stack((x, y, _yaw(found.rotation)), axis=1)[found.valid]
            times = times[found.valid]
        elif not len(said):
            return fixes_of(times[:0], pose[:0], sigma[:0])
        known = np.append(sigma, [math.nan])[np.searchsorted(said, times, side="right") - 1]
        changed = np.abs(np.diff(pose, axis=0)).max(axis=1, initial=0.0) > _SAME_M
        changed |= np.abs(np.diff(np.nan_to_num(known, nan=-1.0))) > _SAME_M
        # One in each slice of the clock besides, however little changes.
        kept = times // SLICE_NS != (times - step) // SLICE_NS
        kept[1:] |= changed
        kept[:-1] |= changed
        kept &= (times >= first - step) & (times <= last)
        return fixes_of(times[kept], pose[kept], known[kept])

    def _localised(self, own: Session, window: TimeWindow) -> tuple[Ints, Floats]:
        """Returns what the localiser said: when, and its standard deviation (m)."""
        timeline = self._view.timeline
        topics = [topic for topic in timeline.topics() if LOCALISER in timeline.types_of(topic)]
        found = sorted(each for topic in topics for each in self._deviations(topic, own, window))
        times = np.array([time for time, _ in found], np.int64)
        return times, np.array([sigma for _, sigma in found], np.float64)

    def _deviations(
        self, topic: str, own: Session, window: TimeWindow
    ) -> Iterator[tuple[Ns, float]]:
        """Yields a localiser's standard deviation (m) with its log time, once in `_SAID_NS`.

        From the messages: covariances have no columns.
        """
        memory = self._view.memory
        for rows in scan(self._view, topic, window):
            if self._sessions.of(rows.recording) != own:
                continue
            slices = rows.times // _SAID_NS
            firsts = np.flatnonzero(np.diff(slices, prepend=slices[:1] - 1))
            for found in messages_of(self._view, rows.some(firsts)):
                message = self._view.bags.decode(found)
                if message is None:
                    continue
                frame = memory.extractor.frame(message).lstrip("/")
                sigma = _sigma_ahead(getattr(getattr(message, "pose", None), "covariance", None))
                if sigma is not None and frame == memory.limits.map_frame:
                    yield found.time, sigma


def is_named_for_detections(type_name: str) -> bool:
    """Returns whether a type is one of a detector by its name."""
    name = type_name.rpartition("/")[2].casefold()
    return any(word in name for word in _OF_DETECTORS)


def _seen(detected: Detected, poses: Poses, frames: FrameTree) -> DetectorMessages:
    """Returns messages with the robot's poses and the detections placed in the target frame."""
    found = detected.found
    places = np.full(found.places.shape, math.nan)
    has_place = ~np.isnan(found.places).any(axis=1)
    for code, frame in enumerate(found.frames.words):
        some = np.flatnonzero(has_place & (found.frames.codes == code))
        known = (
            frames.poses(frame, detected.times[found.rows[some]]) if frame and len(some) else None
        )
        if known is not None:
            x, y, z = found.places[some].T
            placed = np.stack(known.points((x, y, z)), axis=1)
            places[some] = np.where(known.valid[:, None], placed, math.nan)
    robot = _robot_at(poses, detected, frames)
    labels = found.labels.codes.astype(np.int64), found.labels.words
    return DetectorMessages(detected.log_times, robot, found.rows, *labels, places, found.scores)


def _robot_at(poses: Poses, detected: Detected, frames: FrameTree) -> Floats:
    """Returns the pose of the robot at each message, and how far its detector was turned from it.

    As `DetectorMessages.robot` has them. Where the poses do not say it, transforms of what carries
    the detector may. What does not name the frame of its message is taken to be in that of the
    others.
    """
    times, pose_frame = detected.times, poses.frames.words[0] if len(poses) else ""
    robot = np.column_stack((_posed_at(poses, times, frames), np.zeros(len(times))))
    codes, words = detected.frames.codes, detected.frames.words
    seen_in = detected.found.frames
    usual = seen_in.words[np.bincount(seen_in.codes).argmax()] if len(seen_in) else ""
    for code, name in enumerate(words):
        carriers = frames.carriers(name or usual, pose_frame)
        rows = np.flatnonzero(codes == code)
        if carriers is None:
            continue
        turned, body = (frames.poses(carrier, times[rows]) for carrier in carriers)
        if turned is None or body is None:
            continue
        x, y, _ = body.translation
        yaw = _yaw(body.rotation)
        posed = np.where(body.valid[:, None], np.stack((x, y, yaw, 0 * x), axis=1), math.nan)
        robot[rows] = np.where(np.isnan(robot[rows]), posed, robot[rows])
        if carriers[0] != carriers[1]:
            is_known = turned.valid & body.valid
            robot[rows, 3] = np.where(is_known, _yaw(turned.rotation) - yaw, math.nan)
    return robot


def _posed_at(poses: Poses, times: Ints, frames: FrameTree) -> Floats:
    """Returns x, y (m) and heading (rad) of the robot at some times; NaN where not known.

    That is farther than 1 s from a pose, or where no transform leads from its frame.
    """
    robot = np.full((len(times), 3), math.nan)
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
    a, b = poses.positions[before], poses.positions[after]
    x, y, z = (a + (b - a) * ratio[:, None]).T
    heading = headings(poses.turns)
    turn = np.remainder(heading[after] - heading[before] + np.pi, 2 * np.pi) - np.pi
    half = (heading[before] + turn * ratio) / 2
    level = np.zeros(len(times))
    x, y, _ = placed.points((x, y, z))
    yaw = _yaw(multiply(placed.rotation, (level, level, np.sin(half), np.cos(half))))
    return np.where(is_known[:, None], np.stack((x, y, yaw), axis=1), math.nan)


def _yaw(rotation: Rotations) -> Floats:
    x, y, z, w = rotation
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _sigma_ahead(covariance: object) -> float | None:
    """Returns the standard deviation (m) of a point `AHEAD_MM` before a pose; None if unknown."""
    if not isinstance(covariance, Sequence | np.ndarray) or len(covariance) != _COVARIANCE:
        return None
    x, y, yaw = (float(covariance[nth]) for nth in (0, 7, 35))
    variance = max(x, y) + yaw * (AHEAD_MM / 1000) ** 2
    return math.sqrt(variance) if variance >= 0 and math.isfinite(variance) else None

"""Collects what the detectors of one bag saw, for `MapDigest.sights`.

Which topics are of detectors shows in their messages: they hold detections, or their type is named
for them. Other messages of such a topic count as looks that saw nothing.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import AHEAD_MM, PlacedDetection, SlicedSights, encode_sights
from ros2_memory.analysis.transform_tree import AGREEMENT_NS
from ros2_memory.core.errors import UndecodableError
from ros2_memory.messages.detections import Detection, detections_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.analysis.frames import Frames, Times
    from ros2_memory.catalogue.map_digest import PlacedPoses
    from ros2_memory.core.model import Vector3
    from ros2_memory.core.timebase import Ns
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, Record

_NO_DETECTIONS: Final = frozenset(
    {
        "action_msgs",
        "actionlib_msgs",
        "builtin_interfaces",
        "diagnostic_msgs",
        "geometry_msgs",
        "map_msgs",
        "nav_msgs",
        "px4_msgs",
        "rcl_interfaces",
        "rosgraph_msgs",
        "sensor_msgs",
        "shape_msgs",
        "stereo_msgs",
        "tf2_msgs",
        "trajectory_msgs",
    }
)
"""Packages whose messages hold no detections, so that nothing is looked for in them."""
_TEXTS: Final = frozenset({"std_msgs/msg/String"})
_OF_DETECTORS: Final = ("detection", "recognizedobject")
_TRIED: Final = 16
"""After so many messages without a detection, a topic of any other type is of no detector."""
_LOCALISER: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
_FIX_NS: Final = 2_000_000_000
"""How far apart it is looked where odometry is in the map."""
_MOST_FIXES: Final = 8_192
"""Looks in one bag; in one that lasts longer than 4.5 h they are farther apart."""
_COVARIANCE: Final = 36
_SAME_M: Final = 0.1
"""What changes less from one look to the next is left out."""
_HEADER: Final = struct.Struct("<iII")
_ENCAPSULATION: Final = 4
_NS_PER_S: Final = 1_000_000_000
_MAX_DETECTIONS: Final = 1_000_000


@dataclass(slots=True)
class _Topic:
    """The detections of one topic of the bag.

    Attributes:
        is_detector: whether its type is named for detections, or a message has held one.
        begins_with_header: whether the bytes of a message begin with its header; None until tried.
    """

    is_detector: bool
    times: list[Ns] = field(default_factory=list)
    log_times: list[Ns] = field(default_factory=list)
    detections: list[tuple[Detection, ...]] = field(default_factory=list)
    begins_with_header: bool | None = None


class DetectorSights:
    """A `SightsSource` of `map_digest`.

    Args:
        reader: decodes messages whose detections are not given.
        extractor: gives their values and the frames of all.
    """

    def __init__(self, reader: BagReader, extractor: SchemaExtractor) -> None:
        self._reader = reader
        self._extractor = extractor
        self._topics: dict[str, _Topic | None] = {}
        self._left = _MAX_DETECTIONS
        self._localised: dict[str, list[tuple[Ns, str, float]]] = {}

    def wants(self, topic: str, type_name: str) -> bool:
        """Returns whether messages of a type may hold detections, or say how exact poses are."""
        if type_name == _LOCALISER:
            return True
        package, _, name = type_name.partition("/")
        if type_name not in _TEXTS and (package in _NO_DETECTIONS or package == "std_msgs"):
            return False
        if topic not in self._topics:
            named = any(each in name.casefold() for each in _OF_DETECTORS)
            self._topics[topic] = _Topic(named)
        return True

    def add(self, record: Record, detections: tuple[Detection, ...] | None) -> None:
        """Takes the next message of a topic."""
        if record.channel.type == _LOCALISER:
            self._add_covariance(record)
            return
        of_topic = self._topics.get(record.channel.topic)
        if of_topic is None:
            return
        try:
            frame, stamp, detections = self._read(record, detections, of_topic)
        except UndecodableError:
            return
        found = tuple(
            [
                each if each.frame_id else Detection(each.label, each.place, frame, each.score)
                for each in detections
            ]
        )
        self._left -= len(found)
        if self._left < 0:
            return
        of_topic.is_detector |= bool(found)
        log_time = record.log_time
        # A stamp of another clock cannot be compared with those of transforms.
        agrees = stamp is not None and abs(stamp - log_time) <= AGREEMENT_NS
        of_topic.times.append(stamp if stamp is not None and agrees else log_time)
        of_topic.log_times.append(log_time)
        of_topic.detections.append(found)
        if not of_topic.is_detector and len(of_topic.times) >= _TRIED:
            self._topics[record.channel.topic] = None

    def _add_covariance(self, record: Record) -> None:
        """Takes what a localiser says; from one that says it often, now and then."""
        said = self._localised.setdefault(record.channel.topic, [])
        if said and record.log_time < said[-1][0] + _FIX_NS // 4:
            return
        try:
            message = self._reader.decode(record)
            frame = self._extractor.frame(message)
        except UndecodableError:
            return
        covariance = getattr(getattr(message, "pose", None), "covariance", None)
        sigma = _sigma_ahead(covariance)
        if sigma is not None:
            said.append((record.log_time, frame.lstrip("/"), sigma))

    def _read(
        self, record: Record, detections: tuple[Detection, ...] | None, of_topic: _Topic
    ) -> tuple[str, Ns | None, tuple[Detection, ...]]:
        """Returns the frame, the stamp and the detections of a message.

        Raises:
            UndecodableError: it cannot be decoded.
        """
        if detections is not None and of_topic.begins_with_header:
            front = _front_header(record.payload)
            if front is not None:
                return *front, detections
        message = self._reader.decode(record)
        frame, stamp = self._extractor.frame(message), _stamp_of(message)
        if of_topic.begins_with_header is None:
            of_topic.begins_with_header = _front_header(record.payload) == (frame, stamp)
        if detections is None:
            detections = detections_of(self._extractor.exact(message, record.channel.type))
        return frame, stamp, detections

    def digest(self, robot: PlacedPoses) -> bytes:
        """Returns the encoded sights."""
        of_detectors = {
            topic: found
            for topic, found in self._topics.items()
            if found is not None and found.is_detector
        }
        every = [time for found in of_detectors.values() for time in found.log_times]
        at = [time for said in self._localised.values() for time, _, _ in said]
        moments = every or [*at, *robot.times[:1].tolist(), *robot.times[-1:].tolist()]
        if not moments:
            return b""
        span = min(moments), max(moments)
        fixes = [*self._fixes(robot, span)]
        # Where no detector published, only what says more than that odometry went on.
        if not every and not at and len(fixes) <= 2:
            return b""
        sliced = SlicedSights(span)
        for topic, of_topic in of_detectors.items():
            times = np.array(of_topic.times, np.int64)
            places = _places(of_topic, times, robot.frames)
            poses = robot.at(times)
            known = poses.valid & np.isfinite(poses.x + poses.y + poses.heading)
            columns = (poses.x.tolist(), poses.y.tolist(), poses.heading.tolist(), known.tolist())
            for log_time, found, placed, x, y, yaw, valid in zip(
                of_topic.log_times, of_topic.detections, places, *columns, strict=True
            ):
                seen = [
                    PlacedDetection(each.label, place, each.score)
                    for each, place in zip(found, placed, strict=True)
                ]
                pose = (x, y, yaw) if valid else None
                sliced.at(log_time).add(topic, log_time, pose, seen)
        for time, pose, sigma in fixes:
            sliced.at(time).add_fix(time, pose, sigma)
        return encode_sights(sliced.sights(robot.frames.target))

    def _fixes(
        self, robot: PlacedPoses, span: tuple[Ns, Ns]
    ) -> Iterator[tuple[Ns, tuple[float, float, float], float | None]]:
        """Yields where odometry was in the map, where that changes, and how exactly it is known."""
        # A bag of odd times may span centuries.
        step = max(_FIX_NS, (span[1] - span[0]) // _MOST_FIXES)
        times = np.append(np.arange(*span, step), span[1])
        pose = np.zeros((len(times), 3))
        target = robot.frames.target
        found = robot.frames.poses(robot.own, times) if robot.own else None
        if found is not None:
            x, y, _ = found.translation
            qx, qy, qz, qw = found.rotation
            yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
            pose, times = np.stack((x, y, yaw), axis=1)[found.valid], times[found.valid]
        said = sorted(
            (at, sigma)
            for of_topic in self._localised.values()
            for at, frame, sigma in of_topic
            if frame == target
        )
        if not len(times) or (robot.own in {"", target} and not said):
            return
        at = np.array([time for time, _ in said], np.int64)
        sigma = np.append([sigma for _, sigma in said], [-1.0])
        known = sigma[np.searchsorted(at, times, side="right") - 1]
        changed = np.abs(np.diff(pose, axis=0)).max(axis=1) > _SAME_M
        changed |= np.abs(np.diff(known)) > _SAME_M
        kept = np.ones(len(times), np.bool_)
        kept[1:-1] = changed[1:] | changed[:-1]
        for time, (px, py, turn), exact in zip(
            times[kept].tolist(), pose[kept].tolist(), known[kept].tolist(), strict=True
        ):
            yield time, (px, py, turn), exact if exact >= 0 else None


def _sigma_ahead(covariance: object) -> float | None:
    """Returns the standard deviation (m) of a point `AHEAD_MM` before a pose; None if unknown."""
    if not isinstance(covariance, Sequence | np.ndarray) or len(covariance) != _COVARIANCE:
        return None
    x, y, yaw = (float(covariance[nth]) for nth in (0, 7, 35))
    variance = max(x, y) + yaw * (AHEAD_MM / 1000) ** 2
    return math.sqrt(variance) if variance >= 0 and math.isfinite(variance) else None


def _places(of_topic: _Topic, times: Times, frames: Frames) -> list[list[Vector3 | None]]:
    """Returns the places of all detections in the target frame; None where that is not known."""
    places: list[list[Vector3 | None]] = [[None] * len(each) for each in of_topic.detections]
    by_frame: dict[str, list[tuple[int, int, Vector3]]] = {}
    for nth, found in enumerate(of_topic.detections):
        for which, each in enumerate(found):
            if each.place is not None and each.frame_id:
                by_frame.setdefault(each.frame_id, []).append((nth, which, each.place))
    for frame, points in by_frame.items():
        numbers = np.array([nth for nth, _, _ in points], np.int64)
        poses = frames.poses(frame, times[numbers])
        if poses is None:
            continue
        x, y, z = np.array([place for _, _, place in points], np.float64).T
        placed = (each.tolist() for each in poses.points((x, y, z)))
        for (nth, which, _), valid, *place in zip(
            points, poses.valid.tolist(), *placed, strict=True
        ):
            if valid:
                px, py, pz = place
                places[nth][which] = (px, py, pz)
    return places


def _front_header(payload: bytes) -> tuple[str, Ns] | None:
    """Returns frame and stamp of a std_msgs/Header at the front of a message, if it may be one."""
    if len(payload) < _ENCAPSULATION + _HEADER.size or payload[1] != 1:
        return None
    seconds, nanoseconds, size = _HEADER.unpack_from(payload, _ENCAPSULATION)
    start = _ENCAPSULATION + _HEADER.size
    text = bytes(payload[start : start + size])
    if not size or len(text) < size:
        return None
    return text[:-1].decode("utf-8", "replace"), seconds * _NS_PER_S + nanoseconds


def _stamp_of(message: object) -> Ns | None:
    """Returns the stamp in a message's header; None where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    seconds, nanoseconds = getattr(stamp, "sec", None), getattr(stamp, "nanosec", None)
    if isinstance(seconds, int) and isinstance(nanoseconds, int):
        return seconds * _NS_PER_S + nanoseconds
    return None

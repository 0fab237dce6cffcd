"""The digest of one bag in the map: where the robot was, and what it saw there.

Made from the bag's own messages and from the static transforms of its session, which are its
context: an entry made under others is of no use, so a hash of them is stored with it.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Protocol, TypeAlias

import numpy as np

from ros2_memory.analysis.frames import (
    Edge,
    Frames,
    edges_of,
    joined_edges,
    multiply,
    unit_quaternions,
)
from ros2_memory.analysis.motion.odometry import is_place

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.frames import Edges, Floats, Mask, Rotations, Times
    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.core.model import Pose, StampedTransform
    from ros2_memory.core.timebase import Ns
    from ros2_memory.messages.detections import Detection
    from ros2_memory.storage.base import Record

ClockOfTransforms: TypeAlias = Literal["auto", "stamp", "log"]

_NEAR_NS: Final[Ns] = 1_000_000_000
"""Between two poses that are farther apart, where the robot was is not known."""
_FLAT: Final = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class MapSettings:
    """The part of the configuration that map digests depend on; as in `QuerySettings`."""

    pose_topic: str = "/odom"
    map_frame: str | None = "map"
    tf_topics: tuple[str, ...] = ("/tf",)
    tf_clock: ClockOfTransforms = "auto"


class Statics(NamedTuple):
    """The static transforms in force for a bag, and a hash of them that entries are stored with.

    `poses`: the topic of the robot's poses where it is not the configured one, which the hash has.
    """

    transforms: tuple[StampedTransform, ...]
    key: int
    poses: str | None = None


def statics_of(transforms: Iterable[StampedTransform], poses: str | None = None) -> Statics:
    """Returns static transforms, one for each child, with their hash; see `Statics`."""
    ordered = tuple(sorted(transforms, key=lambda each: (each.child, each.parent)))
    described = json.dumps(
        [
            (each.parent, each.child, each.transform.translation, each.transform.rotation)
            for each in ordered
        ]
    )
    described += "" if poses is None else poses
    digest = hashlib.sha256(described.encode("utf-8", "surrogatepass")).digest()
    return Statics(ordered, int.from_bytes(digest[:8], "big", signed=True), poses)


NO_STATICS: Final = statics_of(())


@dataclass(frozen=True, slots=True)
class MapDigest:
    """What is stored of a bag about the map.

    Attributes:
        statics: the hash of the static transforms that it was made with.
        sights: what `SightsSource.digest` returned; empty without a builder.
    """

    statics: int
    sights: bytes = b""


class RobotPoses(NamedTuple):
    """The robot at some times, in the target frame; only meaningful where `valid`."""

    x: Floats
    y: Floats
    heading: Floats
    valid: Mask


@dataclass(frozen=True, slots=True)
class PlacedPoses:
    """All poses of the robot in one bag that could be placed, in log-time order.

    Attributes:
        frames: looks up any frame of the bag.
        own: the frame of the poses themselves.
    """

    frames: Frames
    own: str
    times: Times
    x: Floats
    y: Floats
    heading: Floats

    def at(self, times: Times) -> RobotPoses:
        """Returns where the robot was at some log times; not valid farther than 1 s from a pose."""
        if not len(self.times):
            none = np.full(len(times), np.nan)
            return RobotPoses(none, none, none, np.zeros(len(times), np.bool_))
        last = len(self.times) - 1
        after = np.searchsorted(self.times, times, side="right")
        before, after = np.clip(after - 1, 0, last), np.clip(after, 0, last)
        start, stop = self.times[before], self.times[after]
        ratio = np.clip((times - start) / np.maximum(stop - start, 1), 0.0, 1.0)
        near = np.minimum(np.abs(times - start), np.abs(stop - times)) <= _NEAR_NS
        turn = np.remainder(self.heading[after] - self.heading[before] + np.pi, 2 * np.pi) - np.pi
        return RobotPoses(
            self.x[before] + (self.x[after] - self.x[before]) * ratio,
            self.y[before] + (self.y[after] - self.y[before]) * ratio,
            self.heading[before] + turn * ratio,
            near & (stop - start <= 2 * _NEAR_NS),
        )


class SightsSource(Protocol):
    """Collects what detectors saw in one bag, and digests it as bytes that only it can read."""

    def wants(self, topic: str, type_name: str) -> bool:
        """Returns whether messages of a topic are to be added."""

    def add(self, record: Record, detections: tuple[Detection, ...] | None) -> None:
        """Takes the next message of a topic, in log-time order by topic.

        `detections` are those in it, without the message's own frame; None where many messages
        were decoded at once and this one was not: it is decoded where that is needed.
        """

    def digest(self, robot: PlacedPoses) -> bytes:
        """Returns the digest; `robot.frames` places any frame, `robot.at` the robot itself."""


class TransformColumns:
    """Collects moving transforms as columns, by parent and child."""

    def __init__(self) -> None:
        self._blocks: list[Edges] = []
        self._single: list[StampedTransform] = []

    def add(self, each: StampedTransform) -> None:
        """Takes one transform; invalid ones are left out."""
        self._single.append(each)

    def add_rows(
        self, edge: tuple[str, str], stamps: Times, log_times: Times, numbers: Floats
    ) -> None:
        """Takes transforms of one parent and child: rows of x, y, z, and qx, qy, qz, qw."""
        # tf2 refuses what is not finite, and rotations that are not unit quaternions.
        fine = np.isfinite(numbers).all(axis=1) & (np.abs(numbers[:, 3:]).max(axis=1) > 0)
        rotation = unit_quaternions(numbers[fine, 3:])
        parent, child = (name.lstrip("/") for name in edge)
        if parent and child and parent != child:
            made = Edge(stamps[fine], log_times[fine], numbers[fine, :3], rotation)
            self._blocks.append({(parent, child): made})

    def edges(self) -> Edges:
        """Returns the valid transforms by parent and child."""
        return joined_edges([*self._blocks, edges_of(self._single)])


class MapCollector:
    """Collects the poses and moving transforms of one bag, and makes its `MapDigest`.

    Args:
        settings: which topics, and which frame is the map.
        sights: collects what detectors saw; None where that is not wanted.
    """

    def __init__(self, settings: MapSettings, sights: SightsSource | None = None) -> None:
        self._settings = settings
        self.sights = sights
        self._moving = TransformColumns()
        self._times: list[Ns] = []
        self._poses: list[Pose] = []
        self._frames: dict[str, int] = {}

    def has_poses(self, topic: str) -> bool:
        """Returns whether poses of a topic are the robot's."""
        return topic == self._settings.pose_topic

    def has_transforms(self, topic: str) -> bool:
        """Returns whether a topic is one of moving transforms."""
        return topic in self._settings.tf_topics

    def add_pose(self, time: Ns, pose: Pose) -> None:
        """Takes the robot's next pose."""
        self._times.append(time)
        self._poses.append(pose)
        self._frames[pose.frame_id] = self._frames.get(pose.frame_id, 0) + 1

    def add_transforms(self, transforms: Iterable[StampedTransform]) -> None:
        """Takes the moving transforms of a message."""
        for each in transforms:
            self._moving.add(each)

    def add_rows(self, template: PayloadTemplate, records: Sequence[Record], rows: Bytes) -> None:
        """Takes the moving transforms of many messages of one template."""
        log_times = np.array([each.log_time for each in records], np.int64)
        for each in template.transforms:
            numbers = np.stack([template.column(rows, offset) for offset in each.numbers], axis=1)
            stamps = template.nanoseconds(rows, each.stamp)
            self._moving.add_rows((each.parent, each.child), stamps, log_times, numbers)

    def digest(self, statics: Statics) -> MapDigest:
        """Returns the digest of all that was added."""
        sights = b"" if self.sights is None else self.sights.digest(self._placed(statics))
        return MapDigest(statics.key, sights)

    def _placed(self, statics: Statics) -> PlacedPoses:
        """Returns the poses in the map, or in their own frame."""
        # Poses of one topic nearly always have one frame: those of others are left out.
        own = max(self._frames, key=lambda each: self._frames[each], default="")
        clock = self._settings.tf_clock
        target = self._settings.map_frame or own

        def frames_to(frame: str) -> Frames:
            chosen = None if clock == "auto" else clock
            return Frames(statics.transforms, self._moving.edges(), frame, chosen)

        frames = frames_to(target)
        leads = own and (own == target or frames.reaches(own))
        # Without poses the frames may still lead from a camera to the map.
        if not leads and self._poses:
            target, frames = own, frames_to(own)
        pairs = [
            (time, pose)
            for time, pose in zip(self._times, self._poses, strict=True)
            if pose.frame_id == own and is_place(pose.position)
        ]
        times = np.array([time for time, _ in pairs], np.int64)
        numbers = np.array(
            [(*pose.position, *(pose.orientation or _FLAT)) for _, pose in pairs], np.float64
        ).reshape(-1, 7)
        x, y, z, qx, qy, qz, qw = numbers.T
        poses = frames.poses(own, times)
        turned = np.array([pose.orientation is not None for _, pose in pairs], np.bool_)
        if poses is None:
            return PlacedPoses(frames, own, times[:0], x[:0], y[:0], x[:0])
        px, py, _ = poses.points((x, y, z))
        heading = _heading(multiply(poses.rotation, (qx, qy, qz, qw)), turned)
        valid = poses.valid
        return PlacedPoses(frames, own, times[valid], px[valid], py[valid], heading[valid])


def _heading(rotations: Rotations, known: Mask) -> Floats:
    """Returns headings (rad) about z; NaN where an orientation is not known."""
    x, y, z, w = rotations
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.where(known, heading, np.nan)

"""The digest of one bag in the map: where the robot was.

Made from the bag's own messages and from the static transforms of its session, which are its
context: an entry made under others is of no use, so a hash of them is stored with it.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

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
from ros2_memory.analysis.motion.robot_track import (
    RobotTrack,
    decode_tracks,
    encode_track,
    track_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.frames import Edges, Floats, Mask, Rotations, Times
    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.core.model import Pose, StampedTransform
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Record

ClockOfTransforms: TypeAlias = Literal["auto", "stamp", "log"]

_NEAR_NS: Final[Ns] = 1_000_000_000
"""Between two poses that are farther apart, where the robot was is not known."""
_FLAT: Final = (0.0, 0.0, 0.0, 1.0)
_HEAD: Final = struct.Struct("<IHI")


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
        frame_id: of the track: the map, or the poses' own frame where transforms
            of the bag lead to no map; empty without a pose.
        statics: the hash of the static transforms that it was made with.
        track: of the robot.
        left_out: how many poses could not be placed.
        own: the same in the poses' own frame; None where `frame_id` is that.
    """

    frame_id: str
    statics: int
    track: RobotTrack
    left_out: int = 0
    own: MapDigest | None = None


@dataclass(frozen=True, slots=True)
class PlacedPoses:
    """All poses of the robot in one bag that could be placed, in log-time order."""

    times: Times
    x: Floats
    y: Floats
    heading: Floats


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
    """

    def __init__(self, settings: MapSettings) -> None:
        self._settings = settings
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
        placed, frame_id, own = self._placed(statics)
        track = track_of(placed.times, placed.x, placed.y, placed.heading)
        return MapDigest(
            frame_id,
            statics.key,
            track,
            len(self._times) - len(placed.times),
            own,
        )

    def _placed(self, statics: Statics) -> tuple[PlacedPoses, str, MapDigest | None]:
        """Returns the poses in the map, or in their own frame; and the name of that frame.

        With them, where they are in the map, the digest of them in their own frame.
        """
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
        in_own: MapDigest | None = None
        if self._poses and target != own:
            track = track_of(times, x, y, _heading((qx, qy, qz, qw), turned))
            in_own = MapDigest(own, statics.key, track, len(self._times) - len(times))
        if poses is None:
            return PlacedPoses(times[:0], x[:0], y[:0], x[:0]), target, in_own
        px, py, _ = poses.points((x, y, z))
        heading = _heading(multiply(poses.rotation, (qx, qy, qz, qw)), turned)
        valid = poses.valid
        placed = PlacedPoses(times[valid], px[valid], py[valid], heading[valid])
        return placed, target, in_own


def _heading(rotations: Rotations, known: Mask) -> Floats:
    """Returns headings (rad) about z; NaN where an orientation is not known."""
    x, y, z, w = rotations
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.where(known, heading, np.nan)


def encode_map_track(digest: MapDigest) -> bytes:
    """Encodes the tracks of a map digest, with their frames; all else has columns of its own.

    The one in the poses' own frame follows: mostly its times are those of the other, so together
    they are packed into little more than one of them.
    """
    frame = digest.frame_id.encode("utf-8", "surrogatepass")
    track = encode_track(digest.track)
    own = b"" if digest.own is None else encode_map_track(digest.own)
    return b"".join((_HEAD.pack(digest.left_out, len(frame), len(track)), frame, track, own))


def decode_map_tracks(stored: Sequence[tuple[bytes, int]], *, own: bool = False) -> list[MapDigest]:
    """Decodes map digests, with nothing but their tracks; with `own` in the poses' own frame.

    Each comes with the hash of its statics.

    Raises:
        ValueError: some of the bytes are not valid.
    """
    heads, frames, packed = [], [], []
    for each, _ in stored:
        head, frame, track, rest = _split(each)
        if own and rest:
            head, frame, track, _ = _split(rest)
        heads.append(head)
        frames.append(frame.decode("utf-8", "surrogatepass"))
        packed.append(track)
    rows = zip(frames, stored, decode_tracks(packed), heads, strict=True)
    return [MapDigest(frame, statics, track, left) for frame, (_, statics), track, left in rows]


def _split(packed: bytes) -> tuple[int, bytes, bytes, bytes]:
    """Returns how many poses could not be placed, the frame, the track and what follows.

    Raises:
        ValueError: the bytes are no map digest.
    """
    try:
        left_out, frame_size, track_size = _HEAD.unpack_from(packed)
    except struct.error as error:
        raise ValueError(f"not a map digest: {error}") from error
    begin = _HEAD.size + frame_size
    end = begin + track_size
    return left_out, packed[_HEAD.size : begin], packed[begin:end], packed[end:]

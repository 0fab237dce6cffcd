"""The messages of the benchmark's robot as serialized bytes, many at a time.

A message of fixed length is serialized once by rosbags with a mark in every field that moves; the
marks' places are then filled for all messages at once.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import TYPE_CHECKING, Final, Protocol, cast

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray
    from rosbags.typesys.store import Typestore

    from benchmarks.motion import Motion
    from ros2_memory.core.arrays import Floats

DETECTIONS: Final = "ros2_vision_interfaces/msg/VisionDetectionArray"
DETECTIONS_3D: Final = "vision_msgs/msg/Detection3DArray"
ODOM_TO_BASE: Final = ("odom", "base_link")

_DEFINITIONS: Final = {
    "ros2_vision_interfaces/msg/VisionDetection": (
        "string label\nfloat32 score\ngeometry_msgs/Point point\nint32[4] bbox\n"
    ),
    DETECTIONS: "std_msgs/Header header\nstring skill\nVisionDetection[] detections\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\n"
        "BoundingBox3D bbox\nstring id\n"
    ),
    DETECTIONS_3D: "std_msgs/Header header\nDetection3D[] detections\n",
}
# What stands for a field until it is filled: no other bytes of a message equal these.
_MARKS: Final = {
    "x": 1.1e101,
    "y": 1.2e102,
    "qz": 1.3e103,
    "qw": 1.4e104,
    "vx": 1.5e105,
    "wz": 1.6e106,
}
_SEC_MARK: Final = 0x5A5A1234
_NANOSEC_MARK: Final = 0x3A5A4321
_STAMP_MARK: Final = _SEC_MARK * 1_000_000_000 + _NANOSEC_MARK


class _Build(Protocol):
    """A message class of the typestore; its fields are known at run time only."""

    def __call__(self, **fields: object) -> object: ...


@cache
def typestore() -> Typestore:
    """Jazzy's standard types and the vision messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def odometry_of(
    moved: Motion, stamps: NDArray[np.int64], frames: tuple[str, str] = ODOM_TO_BASE
) -> list[bytes]:
    """One `nav_msgs/msg/Odometry` for each pose and speed: of the second frame in the first."""
    half = moved.yaw / 2.0
    return _filled(
        _odometry(*frames),
        stamps,
        {
            "x": moved.x,
            "y": moved.y,
            "qz": np.sin(half),
            "qw": np.cos(half),
            "vx": moved.speed,
            "wz": moved.turning,
        },
    )


def frames_of(
    at: tuple[Floats, Floats, Floats], stamps: NDArray[np.int64], frames: tuple[str, str]
) -> list[bytes]:
    """One `tf2_msgs/msg/TFMessage` for each pose (x, y, yaw) of the second frame in the first."""
    x, y, yaw = at
    columns = {"x": x, "y": y, "qz": np.sin(yaw / 2.0), "qw": np.cos(yaw / 2.0)}
    return _filled(_moving_frame(*frames), stamps, columns)


def command_of(speed: Floats, turning: Floats) -> list[bytes]:
    """One `geometry_msgs/msg/Twist` for each pair of m/s and rad/s."""
    columns = {"vx": np.round(speed, 2), "wz": np.round(turning, 2)}
    return _filled(_command(), np.zeros(len(speed), np.int64), columns)


def make(type_name: str, **fields: object) -> object:
    """A message object of a type."""
    return cast("_Build", typestore().types[type_name])(**fields)


def serialized(type_name: str, **fields: object) -> bytes:
    """A message in CDR."""
    return bytes(typestore().serialize_cdr(make(type_name, **fields), type_name))


def header(stamp: int, frame_id: str) -> object:
    """A `std_msgs/msg/Header`; the stamp is in nanoseconds."""
    return make("std_msgs/msg/Header", stamp=time(stamp), frame_id=frame_id)


def time(stamp: int) -> object:
    """A `builtin_interfaces/msg/Time` of nanoseconds."""
    sec, nanosec = divmod(stamp, 1_000_000_000)
    return make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def vector3(x: float, y: float, z: float) -> object:
    """A `geometry_msgs/msg/Vector3`."""
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _twist(vx: float, wz: float) -> object:
    return make(
        "geometry_msgs/msg/Twist", linear=vector3(vx, 0.0, 0.0), angular=vector3(0.0, 0.0, wz)
    )


def transform(parent: str, child: str, stamp: int, placed: Sequence[float]) -> object:
    """A `geometry_msgs/msg/TransformStamped` of x, y, z (m) and a turn in the plane (qz, qw)."""
    x, y, z, qz, qw = placed
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=vector3(x, y, z),
            rotation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=qz, w=qw),
        ),
    )


@cache
def _odometry(parent: str, child: str) -> bytes:
    covariance = np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-2]).ravel()
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=_MARKS["x"], y=_MARKS["y"], z=0.0),
        orientation=make(
            "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=_MARKS["qz"], w=_MARKS["qw"]
        ),
    )
    return serialized(
        "nav_msgs/msg/Odometry",
        header=header(_STAMP_MARK, parent),
        child_frame_id=child,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_twist(_MARKS["vx"], _MARKS["wz"]),
            covariance=covariance,
        ),
    )


@cache
def _moving_frame(parent: str, child: str) -> bytes:
    placed = (_MARKS["x"], _MARKS["y"], 0.0, _MARKS["qz"], _MARKS["qw"])
    return serialized(
        "tf2_msgs/msg/TFMessage", transforms=[transform(parent, child, _STAMP_MARK, placed)]
    )


@cache
def _command() -> bytes:
    linear, angular = vector3(_MARKS["vx"], 0.0, 0.0), vector3(0.0, 0.0, _MARKS["wz"])
    return serialized("geometry_msgs/msg/Twist", linear=linear, angular=angular)


def _filled(marked: bytes, stamps: NDArray[np.int64], columns: Mapping[str, Floats]) -> list[bytes]:
    """Copies of a marked message, one for each row of the columns."""
    count = len(stamps)
    table = np.tile(np.frombuffer(marked, np.uint8), (count, 1))

    def fill(mark: bytes, values: NDArray[np.uint8]) -> None:
        at = marked.find(mark)
        if at >= 0:
            table[:, at : at + len(mark)] = values.reshape(count, len(mark))

    for name, column in columns.items():
        fill(struct.pack("<d", _MARKS[name]), column.astype("<f8").view(np.uint8))
    sec, nanosec = np.divmod(stamps, 1_000_000_000)
    fill(struct.pack("<i", _SEC_MARK), sec.astype("<i4").view(np.uint8))
    fill(struct.pack("<I", _NANOSEC_MARK), nanosec.astype("<u4").view(np.uint8))
    return [row.tobytes() for row in table]

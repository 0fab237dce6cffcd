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

from benchmarks.motion import Motion, motion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray
    from rosbags.typesys.store import Typestore

    from benchmarks.motion import Floats

DETECTIONS: Final = "ros2_vision_interfaces/msg/VisionDetectionArray"
NEVER_SEEN: Final = "unicorn"
"""A label that no detection carries."""

_DEFINITIONS: Final = {
    "ros2_vision_interfaces/msg/VisionDetection": (
        "string label\nfloat32 score\ngeometry_msgs/Point point\nint32[4] bbox\n"
    ),
    DETECTIONS: "std_msgs/Header header\nstring skill\nVisionDetection[] detections\n",
}
_LABELS: Final = (
    *("person", "chair", "table", "cup", "bottle", "scissors", "book", "laptop", "plant", "lamp"),
    *("door", "window", "shelf", "box", "crate", "pallet", "trolley", "forklift", "cone", "bin"),
    *("ladder", "bucket", "broom", "sign", "clock", "phone", "keyboard", "mouse", "backpack"),
    *("helmet", "vest", "glove", "hammer", "wrench", "cable", "tape", "carton", "barrel", "fan"),
)
_CONFIDENCE: Final = 0.97
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


def odometry(t: Floats, stamps: NDArray[np.int64], seed: int) -> list[bytes]:
    """One `nav_msgs/msg/Odometry` for each moment: pose in odom, with a wheel encoder's noise."""
    moved = _measured(t, seed)
    half = moved.yaw / 2.0
    return _filled(
        _odometry(),
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


def moving_frame(t: Floats, stamps: NDArray[np.int64], seed: int) -> list[bytes]:
    """One `tf2_msgs/msg/TFMessage` for each moment: base_link in odom."""
    moved = _measured(t, seed)
    half = moved.yaw / 2.0
    columns = {"x": moved.x, "y": moved.y, "qz": np.sin(half), "qw": np.cos(half)}
    return _filled(_moving_frame(), stamps, columns)


def command(t: Floats) -> list[bytes]:
    """One `geometry_msgs/msg/Twist` for each moment, to the centimetre as planners command."""
    moved = motion(t)
    columns = {"vx": np.round(moved.speed, 2), "wz": np.round(moved.turning, 2)}
    return _filled(_command(), np.zeros(len(t), np.int64), columns)


@cache
def fixed_frames() -> bytes:
    """The one message of `/tf_static`: laser and camera on base_link."""
    frames = [
        _transform("base_link", child, 1_000_000_000, (x, 0.0, z, 0.0, 1.0))
        for child, x, z in (("laser", 0.10, 0.20), ("camera", 0.15, 0.30))
    ]
    return _serialized("tf2_msgs/msg/TFMessage", transforms=frames)


def detections(stamp: int, skill: str, count: int, chance: np.random.Generator) -> bytes:
    """One detection array in the camera's frame with `count` things in it."""
    drawn = chance.random((count, 4))
    corners = chance.integers(0, 480, (count, 4))
    return _serialized(
        DETECTIONS,
        header=_header(stamp, "camera"),
        skill=skill,
        detections=[
            _make(
                "ros2_vision_interfaces/msg/VisionDetection",
                label=_LABELS[int(label * len(_LABELS))],
                score=_CONFIDENCE * score,
                point=_make("geometry_msgs/msg/Point", x=3.0 * x, y=2.0 * y - 1.0, z=0.4),
                bbox=box.astype(np.int32),
            )
            for (label, score, x, y), box in zip(drawn.tolist(), corners, strict=True)
        ],
    )


def _measured(t: Floats, seed: int) -> Motion:
    """What the wheels tell of the motion; odometry and the moving frame tell the same."""
    moved = motion(t)
    drawn = np.random.default_rng(seed).normal(size=(3, len(t)))
    noisy = (
        moved.x + 1e-4 * drawn[0],
        moved.y + 1e-4 * drawn[1],
        moved.yaw + 1e-4 * drawn[2],
        np.round(moved.speed, 3),
        np.round(moved.turning, 3),
    )
    # A wheel controller reckons in single precision.
    return Motion(*(value.astype(np.float32).astype(np.float64) for value in noisy))


def _make(type_name: str, **fields: object) -> object:
    return cast("_Build", typestore().types[type_name])(**fields)


def _serialized(type_name: str, **fields: object) -> bytes:
    return bytes(typestore().serialize_cdr(_make(type_name, **fields), type_name))


def _header(stamp: int, frame_id: str) -> object:
    sec, nanosec = divmod(stamp, 1_000_000_000)
    time = _make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return _make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def _vector3(x: float, y: float, z: float) -> object:
    return _make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _twist(vx: float, wz: float) -> object:
    return _make(
        "geometry_msgs/msg/Twist", linear=_vector3(vx, 0.0, 0.0), angular=_vector3(0.0, 0.0, wz)
    )


def _transform(parent: str, child: str, stamp: int, placed: Sequence[float]) -> object:
    x, y, z, qz, qw = placed
    return _make(
        "geometry_msgs/msg/TransformStamped",
        header=_header(stamp, parent),
        child_frame_id=child,
        transform=_make(
            "geometry_msgs/msg/Transform",
            translation=_vector3(x, y, z),
            rotation=_make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=qz, w=qw),
        ),
    )


@cache
def _odometry() -> bytes:
    covariance = np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-2]).ravel()
    pose = _make(
        "geometry_msgs/msg/Pose",
        position=_make("geometry_msgs/msg/Point", x=_MARKS["x"], y=_MARKS["y"], z=0.0),
        orientation=_make(
            "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=_MARKS["qz"], w=_MARKS["qw"]
        ),
    )
    return _serialized(
        "nav_msgs/msg/Odometry",
        header=_header(_STAMP_MARK, "odom"),
        child_frame_id="base_link",
        pose=_make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=_make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_twist(_MARKS["vx"], _MARKS["wz"]),
            covariance=covariance,
        ),
    )


@cache
def _moving_frame() -> bytes:
    placed = (_MARKS["x"], _MARKS["y"], 0.0, _MARKS["qz"], _MARKS["qw"])
    return _serialized(
        "tf2_msgs/msg/TFMessage", transforms=[_transform("odom", "base_link", _STAMP_MARK, placed)]
    )


@cache
def _command() -> bytes:
    linear, angular = _vector3(_MARKS["vx"], 0.0, 0.0), _vector3(0.0, 0.0, _MARKS["wz"])
    return _serialized("geometry_msgs/msg/Twist", linear=linear, angular=angular)


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

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
ODOM_TO_BASE: Final = ("odom", "base_link")

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
_LOG: Final = (
    "Passing new path to controller.",
    "Received a goal, begin computing control effort.",
    "Reached the goal!",
    "Control loop missed its desired rate of 20.0000 Hz",
)
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
    return odometry_of(_measured(t, seed), stamps)


def odometry_of(moved: Motion, stamps: NDArray[np.int64]) -> list[bytes]:
    """One `nav_msgs/msg/Odometry` for each pose and speed."""
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
    return frames_of((moved.x, moved.y, moved.yaw), stamps, ODOM_TO_BASE)


def frames_of(
    at: tuple[Floats, Floats, Floats], stamps: NDArray[np.int64], frames: tuple[str, str]
) -> list[bytes]:
    """One `tf2_msgs/msg/TFMessage` for each pose (x, y, yaw) of the second frame in the first."""
    x, y, yaw = at
    columns = {"x": x, "y": y, "qz": np.sin(yaw / 2.0), "qw": np.cos(yaw / 2.0)}
    return _filled(_moving_frame(*frames), stamps, columns)


def command(t: Floats) -> list[bytes]:
    """One `geometry_msgs/msg/Twist` for each moment, to the centimetre as planners command."""
    moved = motion(t)
    return command_of(moved.speed, moved.turning)


def command_of(speed: Floats, turning: Floats) -> list[bytes]:
    """One `geometry_msgs/msg/Twist` for each pair of m/s and rad/s."""
    columns = {"vx": np.round(speed, 2), "wz": np.round(turning, 2)}
    return _filled(_command(), np.zeros(len(speed), np.int64), columns)


def corrected_frames(t: Floats, stamps: NDArray[np.int64], seed: int) -> list[bytes]:
    """As `moving_frame`; each sixth has odom in map instead, as a localiser corrects it."""
    frames = moving_frame(t, stamps, seed)
    late, drift = t[5::6], np.sin(t[5::6] / 700.0)
    at = (0.4 * drift + 0.01 * np.sin(late / 3.0), 0.3 * np.cos(late / 900.0), 0.02 * drift)
    frames[5::6] = frames_of(at, stamps[5::6], ("map", "odom"))
    return frames


def battery(t: Floats, stamps: NDArray[np.int64]) -> list[bytes]:
    """One `sensor_msgs/msg/BatteryState` for each moment: 0.25 to 0.95, in turns of two hours."""
    charge = np.round(0.6 + 0.35 * np.cos(2.0 * np.pi * t / 7_200.0), 3)
    return [
        serialized(
            "sensor_msgs/msg/BatteryState",
            header=header(stamp, ""),
            **dict.fromkeys(("temperature", "current", "charge", "capacity"), float("nan")),
            voltage=12.0 + 3.0 * share,
            design_capacity=4.0,
            percentage=share,
            power_supply_status=2,
            power_supply_health=1,
            power_supply_technology=2,
            present=True,
            cell_voltage=np.zeros(0, np.float32),
            cell_temperature=np.zeros(0, np.float32),
            location="",
            serial_number="",
        )
        for share, stamp in zip(charge.tolist(), stamps.tolist(), strict=True)
    ]


def states(t: Floats) -> list[bytes]:
    """One `std_msgs/msg/String` for each moment: what the robot does."""
    names = ("driving", "waiting", "looking", "docked")
    return [_text(names[int(moment // 45.0) % 4]) for moment in t.tolist()]


def logged(stamps: NDArray[np.int64], chance: np.random.Generator) -> list[bytes]:
    """One `rcl_interfaces/msg/Log` for each moment; a hundredth are warnings."""
    drawn = chance.random((len(stamps), 2)).tolist()
    return [
        serialized(
            "rcl_interfaces/msg/Log",
            stamp=time(stamp),
            level=30 if warned < 0.01 else 20,
            name="controller_server",
            msg=f"{_LOG[int(which * len(_LOG))]} (control cost {which:.6f})",
            file="controller.cpp",
            function="computeControl",
            line=421,
        )
        for (which, warned), stamp in zip(drawn, stamps.tolist(), strict=True)
    ]


@cache
def _text(words: str) -> bytes:
    return serialized("std_msgs/msg/String", data=words)


@cache
def fixed_frames() -> bytes:
    """The one message of `/tf_static`: laser and camera on base_link."""
    frames = [
        _transform("base_link", child, 1_000_000_000, (x, 0.0, z, 0.0, 1.0))
        for child, x, z in (("laser", 0.10, 0.20), ("camera", 0.15, 0.30))
    ]
    return serialized("tf2_msgs/msg/TFMessage", transforms=frames)


def detections(stamp: int, skill: str, count: int, chance: np.random.Generator) -> bytes:
    """One detection array in the camera's frame with `count` things in it."""
    drawn = chance.random((count, 4))
    corners = chance.integers(0, 480, (count, 4))
    return serialized(
        DETECTIONS,
        header=header(stamp, "camera"),
        skill=skill,
        detections=[
            make(
                "ros2_vision_interfaces/msg/VisionDetection",
                label=_LABELS[int(label * len(_LABELS))],
                score=_CONFIDENCE * score,
                point=make("geometry_msgs/msg/Point", x=3.0 * x, y=2.0 * y - 1.0, z=0.4),
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


def _transform(parent: str, child: str, stamp: int, placed: Sequence[float]) -> object:
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
def _odometry() -> bytes:
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
        header=header(_STAMP_MARK, "odom"),
        child_frame_id="base_link",
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
        "tf2_msgs/msg/TFMessage", transforms=[_transform(parent, child, _STAMP_MARK, placed)]
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

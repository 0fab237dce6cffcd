"""Serializes the simulated robot's state as ROS 2 messages, and has the types' definitions.

Types are Jazzy's standard ones and `ros2_vision_interfaces`, whose definitions are below.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Final, Protocol, cast

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.demo import published_topics, robot

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rosbags.typesys.store import Typestore

    from ros2_memory.core.model import Vector3
    from ros2_memory.demo.published_topics import Message
    from ros2_memory.demo.robot import Planar, SimulatedThing

VISION_DEFINITIONS: Final = {
    "ros2_vision_interfaces/msg/VisionDetection": (
        "string label\nfloat32 score\ngeometry_msgs/Point point\nint32[4] bbox\n"
    ),
    "ros2_vision_interfaces/msg/VisionDetectionArray": (
        "std_msgs/Header header\nstring skill\nVisionDetection[] detections\n"
    ),
    "ros2_vision_interfaces/msg/StampedString": "std_msgs/Header header\nstring data\n",
}


class _Build(Protocol):
    """A message class, called with its fields by name."""

    def __call__(self, **fields: object) -> object: ...


_FOCAL_PX: Final = 320.0
_PICTURE_PX: Final = (640, 480)
_CENTRE_PX: Final = (320.0, 240.0)
_THING_M: Final = 0.15
_UNKNOWN: Final = math.nan


def payload(message: Message) -> bytes:
    """Returns the message in CDR, as it is published."""
    body = _BODIES[message.stream.topic](message)
    return bytes(_typestore().serialize_cdr(body, message.stream.type))


@cache
def definition(type_name: str) -> str:
    """Returns the type's ros2msg text with all nested definitions, as bags contain it."""
    return _typestore().generate_msgdef(type_name, ros_version=2)[0]


def description(t: float) -> str:
    """Returns the robot's description of what it sees: "In the hall I see shoes and umbrella."."""
    labels = [thing.label for thing in robot.seen(t)]
    return f"In the {robot.place(t)} I see {listed_in_words(labels)}."


def listed_in_words(names: Sequence[str]) -> str:
    """Returns names for a sentence: `shoes, plant and umbrella`."""
    if not names:
        return "nothing"
    return " and ".join([", ".join(names[:-1]), names[-1]] if names[1:] else names)


@cache
def _typestore() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in VISION_DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _make(type_name: str, **fields: object) -> object:
    return cast("_Build", _typestore().types[type_name])(**fields)


def _header(message: Message, frame_id: str) -> object:
    seconds, nanoseconds = divmod(message.publish_time, NS_PER_S)
    stamp = _make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _point(xyz: Vector3) -> object:
    return _make("geometry_msgs/msg/Point", x=xyz[0], y=xyz[1], z=xyz[2])


def _vector(x: float, y: float = 0.0, z: float = 0.0) -> object:
    return _make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(yaw: float) -> object:
    return _make(
        "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)
    )


def _twist(t: float) -> object:
    forward, turning = robot.twist(t)
    return _make(
        "geometry_msgs/msg/Twist", linear=_vector(forward), angular=_vector(0.0, 0.0, turning)
    )


def _odometry(message: Message) -> object:
    at = robot.pose(message.t)
    pose = _make(
        "geometry_msgs/msg/Pose",
        position=_point((at.x, at.y, 0.0)),
        orientation=_quaternion(at.yaw),
    )
    covariance = np.zeros(36)
    return _make(
        "nav_msgs/msg/Odometry",
        header=_header(message, "odom"),
        child_frame_id="base_link",
        pose=_make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=_make(
            "geometry_msgs/msg/TwistWithCovariance", twist=_twist(message.t), covariance=covariance
        ),
    )


def _transform(message: Message, parent: str, child: str, at: Planar, z: float = 0.0) -> object:
    return _make(
        "geometry_msgs/msg/TransformStamped",
        header=_header(message, parent),
        child_frame_id=child,
        transform=_make(
            "geometry_msgs/msg/Transform",
            translation=_vector(at.x, at.y, z),
            rotation=_quaternion(at.yaw),
        ),
    )


def _moving_frames(message: Message) -> object:
    moving = _transform(message, "odom", "base_link", robot.pose(message.t))
    return _make("tf2_msgs/msg/TFMessage", transforms=[moving])


def _fixed_frames(message: Message) -> object:
    fixed = [_transform(message, "map", "odom", robot.MAP_TO_ODOM)]
    for child, (x, y, z) in (("camera", robot.CAMERA), ("laser", robot.LASER)):
        fixed.append(_transform(message, "base_link", child, robot.Planar(x, y, 0.0), z))
    return _make("tf2_msgs/msg/TFMessage", transforms=fixed)


def _scan(message: Message) -> object:
    return _make(
        "sensor_msgs/msg/LaserScan",
        header=_header(message, "laser"),
        angle_min=robot.SCAN_START,
        angle_max=robot.SCAN_START + (robot.SCAN_BEAMS - 1) * robot.SCAN_STEP,
        angle_increment=robot.SCAN_STEP,
        time_increment=0.0,
        scan_time=0.2,
        range_min=0.05,
        range_max=20.0,
        ranges=robot.scan(message.t).astype(np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


def _battery(message: Message) -> object:
    return _make(
        "sensor_msgs/msg/BatteryState",
        header=_header(message, "base_link"),
        voltage=25.2,
        temperature=_UNKNOWN,
        current=_UNKNOWN,
        charge=_UNKNOWN,
        capacity=_UNKNOWN,
        design_capacity=_UNKNOWN,
        percentage=robot.battery(message.t),
        power_supply_status=0,
        power_supply_health=0,
        power_supply_technology=0,
        present=True,
        cell_voltage=np.zeros(0, dtype=np.float32),
        cell_temperature=np.zeros(0, dtype=np.float32),
        location="",
        serial_number="",
    )


def _bounding_box(thing: SimulatedThing) -> list[int]:
    """Returns the pixels (left, top, right, bottom) in a pinhole camera, clipped to the image."""
    depth = max(thing.point[0] - robot.CAMERA[0], _THING_M)
    across = _CENTRE_PX[0] - _FOCAL_PX * thing.point[1] / depth
    down = _CENTRE_PX[1] - _FOCAL_PX * (thing.point[2] - robot.CAMERA[2]) / depth
    half = _FOCAL_PX * _THING_M / depth
    corners = ((across - half, down - half), (across + half, down + half))
    return [
        min(max(round(edge), 0), size)
        for corner in corners
        for edge, size in zip(corner, _PICTURE_PX, strict=True)
    ]


def _detections(message: Message, skill: str, things: Sequence[SimulatedThing]) -> object:
    detections = [
        _make(
            "ros2_vision_interfaces/msg/VisionDetection",
            label=thing.label,
            score=thing.score,
            point=_point(thing.point),
            bbox=np.array(_bounding_box(thing), dtype=np.int32),
        )
        for thing in things
    ]
    return _make(
        "ros2_vision_interfaces/msg/VisionDetectionArray",
        header=_header(message, "base_link"),
        skill=skill,
        detections=detections,
    )


def _found(message: Message) -> object:
    wanted = [thing for thing in robot.seen(message.t) if thing.label == "scissors"]
    return _detections(message, "find_object", wanted)


def _described(message: Message) -> object:
    return _make(
        "ros2_vision_interfaces/msg/StampedString",
        header=_header(message, "camera"),
        data=description(message.t),
    )


_BODIES: Final[Mapping[str, Callable[[Message], object]]] = {
    published_topics.ODOM: _odometry,
    published_topics.TF: _moving_frames,
    published_topics.TF_STATIC: _fixed_frames,
    published_topics.CMD_VEL: lambda message: _twist(message.t),
    published_topics.SCAN: _scan,
    published_topics.PATH_CLEAR: lambda message: _make(
        "std_msgs/msg/Bool", data=robot.path_clear(message.t)
    ),
    published_topics.BATTERY: _battery,
    published_topics.SCENE_OBJECTS: lambda message: _detections(
        message, "scene", robot.seen(message.t)
    ),
    published_topics.FOUND: _found,
    published_topics.SCENE_DESCRIPTION: _described,
}

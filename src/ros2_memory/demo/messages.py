"""Serializes the simulated robot's state as ROS 2 messages, and has the types' definitions.

Types are Jazzy's standard ones and `ros2_vision_interfaces`, whose definitions are below.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Final, TypeAlias, cast

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.demo import published_topics as topics
from ros2_memory.demo import robot

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rosbags.interfaces.typing import FieldDesc
    from rosbags.typesys.store import Typestore

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
_FOCAL_PX: Final = 320.0
_PICTURE_PX: Final = (640, 480)
_CENTRE_PX: Final = (320.0, 240.0)
_THING_M: Final = 0.15

Body: TypeAlias = "dict[str, object]"
"""Fields of a message by name; others are zero or empty."""


def payload(message: Message) -> bytes:
    """Returns the message in CDR, as it is published."""
    name = message.stream.type
    return bytes(_typestore().serialize_cdr(_ros_message(name, _body(message)), name))


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


def _ros_message(type_name: str, body: Mapping[str, object]) -> object:
    store = _typestore()
    fields = store.fielddefs[type_name][1]
    build = cast("Callable[[*tuple[object, ...]], object]", store.types[type_name])
    return build(*(_field(form, body.get(name)) for name, form in fields))


def _field(form: FieldDesc, value: object) -> object:
    """Returns a field of a message; zero or empty where there is no value."""
    kind, detail = form
    if kind is Nodetype.NAME:
        return _ros_message(str(detail), cast("Body", value or {}))
    if kind is Nodetype.BASE:
        return value or ("" if detail[0] == "string" else 0)
    inner, size = cast("tuple[FieldDesc, int]", detail)
    if inner[0] is Nodetype.NAME:
        return [_field(inner, item) for item in cast("list[Body]", value)]
    return np.zeros(size, inner[1][0]) if value is None else np.array(value, inner[1][0])


def _body(message: Message) -> Body:  # noqa: C901 - a case for each topic
    """Returns what the robot publishes in a message."""
    t = message.t
    body: Body = {}
    match message.stream.topic:
        case topics.CMD_VEL:
            body = _twist(t)
        case topics.PATH_CLEAR:
            body = {"data": robot.path_clear(t)}
        case topics.TF:
            body = {"transforms": [_transform(message, "odom", "base_link", robot.pose(t))]}
        case topics.TF_STATIC:
            fixed = [_transform(message, "map", "odom", robot.MAP_TO_ODOM)]
            for child, (x, y, z) in (("camera", robot.CAMERA), ("laser", robot.LASER)):
                fixed.append(_transform(message, "base_link", child, robot.Planar(x, y, 0.0), z))
            body = {"transforms": fixed}
        case topics.ODOM:
            at = robot.pose(t)
            pose = {"position": _xyz(at.x, at.y), "orientation": _rotation(at.yaw)}
            moving = {"pose": {"pose": pose}, "twist": {"twist": _twist(t)}}
            body = {**_headed(message, "odom"), "child_frame_id": "base_link", **moving}
        case topics.SCAN:
            body = {
                **_headed(message, "laser"),
                "angle_min": robot.SCAN_START,
                "angle_max": robot.SCAN_START + (robot.SCAN_BEAMS - 1) * robot.SCAN_STEP,
                "angle_increment": robot.SCAN_STEP,
                "scan_time": 0.2,
                "range_min": 0.05,
                "range_max": 20.0,
                "ranges": robot.scan(t),
            }
        case topics.BATTERY:
            unknown = ("temperature", "current", "charge", "capacity", "design_capacity")
            measured = {"voltage": 25.2, "percentage": robot.battery(t), "present": True}
            body = {**_headed(message, "base_link"), **dict.fromkeys(unknown, math.nan), **measured}
        case topics.SCENE_DESCRIPTION:
            body = {**_headed(message, "camera"), "data": description(t)}
        case topics.SCENE_OBJECTS:
            body = _detections(message, "scene", robot.seen(t))
        case topics.FOUND:
            wanted = [thing for thing in robot.seen(t) if thing.label == "scissors"]
            body = _detections(message, "find_object", wanted)
    return body


def _detections(message: Message, skill: str, things: Sequence[SimulatedThing]) -> Body:
    detections = [
        {
            "label": thing.label,
            "score": thing.score,
            "point": _xyz(*thing.point),
            "bbox": _bounding_box(thing),
        }
        for thing in things
    ]
    return {**_headed(message, "base_link"), "skill": skill, "detections": detections}


def _headed(message: Message, frame_id: str) -> Body:
    seconds, nanoseconds = divmod(message.publish_time, NS_PER_S)
    stamp = {"sec": seconds, "nanosec": nanoseconds}
    return {"header": {"stamp": stamp, "frame_id": frame_id}}


def _xyz(x: float, y: float, z: float = 0.0) -> Body:
    return {"x": x, "y": y, "z": z}


def _rotation(yaw: float) -> Body:
    return {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _twist(t: float) -> Body:
    forward, turning = robot.twist(t)
    return {"linear": {"x": forward}, "angular": {"z": turning}}


def _transform(message: Message, parent: str, child: str, at: Planar, z: float = 0.0) -> Body:
    moved = {"translation": _xyz(at.x, at.y, z), "rotation": _rotation(at.yaw)}
    return {**_headed(message, parent), "child_frame_id": child, "transform": moved}


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

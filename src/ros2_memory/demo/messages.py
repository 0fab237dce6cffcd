"""What the simulated robot publishes: its topics, when each has a message, and what is in it.

Message k of a stream is published, and stamped, at `t0 + k * period`, and reaches the recorder a
fraction of a millisecond later, its own fraction for each message. Both times are closed forms, so
the message that answers a question is known without looking into a bag.

Types are Jazzy's standard ones and `ros2_vision_interfaces`, whose definitions are below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from heapq import merge
from itertools import count
from typing import TYPE_CHECKING, Final, TypeAlias, cast

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Ns
from ros2_memory.demo import robot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rosbags.interfaces.typing import FieldDesc
    from rosbags.typesys.store import Typestore

    from ros2_memory.demo.robot import Planar

ODOM: Final = "/odom"
BATTERY: Final = "/battery_state"
PATH_CLEAR: Final = "/path_clear"
SCENE_OBJECTS: Final = "/vision/scene/scene_objects"


Body: TypeAlias = "dict[str, object]"
"""The fields of a message by name; a missing field is zero or empty."""


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic: its type, the time between two messages, and what makes the fields of one.

    A latched one is published once.
    """

    topic: str
    type: str
    period: Ns
    body: Callable[[Message], Body]
    latched: bool = False


@dataclass(frozen=True, slots=True)
class Message:
    """A message of a stream; `t` is the robot's time (s since its start) that it describes."""

    stream: Stream
    log_time: Ns
    publish_time: Ns
    t: float


VISION_DEFINITIONS: Final = {
    "ros2_vision_interfaces/msg/VisionDetection": (
        "string label\nfloat32 score\ngeometry_msgs/Point point\n"
    ),
    "ros2_vision_interfaces/msg/VisionDetectionArray": (
        "std_msgs/Header header\nstring skill\nVisionDetection[] detections\n"
    ),
}


def payload(message: Message) -> bytes:
    """Returns the message in CDR, as it is published."""
    name = message.stream.type
    body = message.stream.body(message)
    return bytes(_typestore().serialize_cdr(_ros_message(name, body), name))


@cache
def definition(type_name: str) -> str:
    """Returns the type's ros2msg text with all nested definitions, as bags contain it."""
    return _typestore().generate_msgdef(type_name, ros_version=2)[0]


@cache
def _typestore() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in VISION_DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _ros_message(type_name: str, body: Mapping[str, object]) -> object:
    """Returns a message object of rosbags with these fields."""
    store = _typestore()
    fields = store.fielddefs[type_name][1]
    build = cast("Callable[[*tuple[object, ...]], object]", store.types[type_name])
    return build(*(_field(form, body.get(name)) for name, form in fields))


def _field(form: FieldDesc, value: object) -> object:
    """Returns a field of a message object; None becomes zero or empty."""
    kind, detail = form
    if kind is Nodetype.NAME:
        return _ros_message(str(detail), cast("Body", value or {}))
    if kind is Nodetype.BASE:
        return value or ("" if detail[0] == "string" else 0)
    (item_kind, item_detail), size = cast("tuple[FieldDesc, int]", detail)
    if item_kind is Nodetype.NAME:
        items = cast("list[Body]", value)
        return [_ros_message(str(item_detail), item) for item in items]
    dtype = item_detail[0]
    return np.zeros(size, dtype) if value is None else np.array(value, dtype)


def _detections(message: Message) -> Body:
    detections = [
        {"label": thing.label, "score": thing.score, "point": _xyz(*thing.point)}
        for thing in robot.seen(message.t)
    ]
    return {**_header(message, "base_link"), "skill": "scene", "detections": detections}


def _header(message: Message, frame_id: str) -> Body:
    seconds, nanoseconds = divmod(message.publish_time, NS_PER_S)
    stamp = {"sec": seconds, "nanosec": nanoseconds}
    return {"header": {"stamp": stamp, "frame_id": frame_id}}


def _xyz(x: float, y: float, z: float = 0.0) -> Body:
    return {"x": x, "y": y, "z": z}


def _rotation(yaw: float) -> Body:
    return {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _twist(message: Message) -> Body:
    forward, turning = robot.twist(message.t)
    return {"linear": {"x": forward}, "angular": {"z": turning}}


def _transform(message: Message, parent: str, child: str, at: Planar, z: float = 0.0) -> Body:
    moved = {"translation": _xyz(at.x, at.y, z), "rotation": _rotation(at.yaw)}
    return {**_header(message, parent), "child_frame_id": child, "transform": moved}


def _static_transforms(message: Message) -> Body:
    transforms = [_transform(message, "map", "odom", robot.MAP_TO_ODOM)]
    for child, (x, y, z) in (("camera", robot.CAMERA), ("laser", robot.LASER)):
        transforms.append(_transform(message, "base_link", child, robot.Planar(x, y, 0.0), z))
    return {"transforms": transforms}


def _robot_transform(message: Message) -> Body:
    return {"transforms": [_transform(message, "odom", "base_link", robot.pose(message.t))]}


def _odometry(message: Message) -> Body:
    x, y, yaw = robot.pose(message.t)
    return {
        **_header(message, "odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": {"position": _xyz(x, y), "orientation": _rotation(yaw)}},
        "twist": {"twist": _twist(message)},
    }


def _battery(message: Message) -> Body:
    unknown = ("temperature", "current", "charge", "capacity", "design_capacity")
    return {
        **_header(message, "base_link"),
        **dict.fromkeys(unknown, math.nan),
        "voltage": 25.2,
        "percentage": robot.battery(message.t),
        "present": True,
    }


def _path_clear(message: Message) -> Body:
    return {"data": robot.path_clear(message.t)}


STREAMS: Final = (
    Stream("/tf_static", "tf2_msgs/msg/TFMessage", NS_PER_S, _static_transforms, latched=True),
    Stream(ODOM, "nav_msgs/msg/Odometry", 50 * NS_PER_MS, _odometry),
    Stream("/tf", "tf2_msgs/msg/TFMessage", 50 * NS_PER_MS, _robot_transform),
    Stream("/cmd_vel", "geometry_msgs/msg/Twist", 100 * NS_PER_MS, _twist),
    Stream(PATH_CLEAR, "std_msgs/msg/Bool", 500 * NS_PER_MS, _path_clear),
    Stream(
        SCENE_OBJECTS,
        "ros2_vision_interfaces/msg/VisionDetectionArray",
        500 * NS_PER_MS,
        _detections,
    ),
    Stream(BATTERY, "sensor_msgs/msg/BatteryState", NS_PER_S, _battery),
)


@dataclass(frozen=True, slots=True)
class MessageSchedule:
    """The messages of a robot that started at `t0`, as a recorder receives them from `start` on.

    A latched message was published at `t0` and reaches the recorder at `start`.
    """

    t0: Ns
    start: Ns

    def messages(self, stream: Stream) -> Iterator[Message]:
        """Yields the stream's messages from the start on, without end; one if it is latched."""
        first = 0 if stream.latched else -((self.t0 - self.start) // stream.period)
        for k in count(first):
            published = self.t0 + k * stream.period
            received = max(published, self.start) + _delay(stream, k)
            yield Message(stream, received, published, (published - self.t0) / NS_PER_S)
            if stream.latched:
                break

    def everything(self) -> Iterator[Message]:
        """Yields all streams' messages in the order in which they are received, without end."""
        return merge(*map(self.messages, STREAMS), key=lambda message: message.log_time)


def _delay(stream: Stream, k: int) -> Ns:
    """Returns the time from publication to the recorder: 0.06 to 0.46 ms, in a fixed pattern."""
    return (60 + 19 * STREAMS.index(stream) + (k * 7919) % 211) * NS_PER_US

"""A robot's publishers: real rclpy and DDS, values in closed form of the time t since its start.

With T0 the clock's time (whole milliseconds) at the start and tick k at t = k / hz:

- It drives a circle of radius 2 m at 0.5 m/s from (0, 0), facing +x, turning left: `pose(t)`.
- `/odom` (nav_msgs/Odometry, odom -> base_link) and `/tf` (tf2_msgs/TFMessage, the same) each tick;
  header stamps are T0 + t exactly.
- `/tf_static` once, latched: laser and camera in base_link.
- `/cmd_vel` (geometry_msgs/Twist) every second tick.
- `/bumper` (std_msgs/Bool) twice a second, true while 25 <= t < 26; told by SIGUSR1, for the
  second that begins with its next message instead.
- `/battery_state` (sensor_msgs/BatteryState) once a second: percentage 0.8 - 0.001 t.
- `/vision/scene/scene_objects` (ros2_vision_interfaces/VisionDetectionArray) once a second:
  "table" always, "cup" for 5 <= t < 30, "scissors" for 12 <= t < 18.

- `/clock` (rosgraph_msgs/Clock) each tick, t itself; only where it is asked for.
- `/px4/position` (px4_msgs/VehicleLocalPosition) each tick, of a type that no recorder here knows;
  only where it is asked for.

Below 2 Hz every topic comes with every tick. Run as a program, it first waits for its subscribers,
then writes T0 to the truth file, and at the end how many messages were published on each topic.
While it drives it adds when the number of subscribers that its first topic reaches has changed: one
that says it has subscribed may be reached some seconds later. It also tells how late it was at
worst, in seconds, in having published a tick.
"""

import argparse
import ctypes
import json
import math
import signal
import time
from collections import Counter
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Path as Lender
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from tests.support.bags import (
    Msg,
    battery,
    boolean,
    command,
    detections,
    header,
    make,
    odom,
    stamp,
    text,
    tf,
    tf_of,
    transform,
    typestore,
)
from tests.support.closed_form import RADIUS, TURN_RATE, position

_SERIALIZER = b"rosidl_typesupport_fastrtps_c"
# What describes the fields. Jazzy's middleware refuses a type without it; of a type that has no
# wheel it is told the lender's fields, which nobody reads.
_DESCRIBER = b"rosidl_typesupport_introspection_c"
# Newer ones look for it too, go on without it, and leave an error set, which the next one would be
# printed with.
_reset_error = ctypes.CDLL("librcutils.so").rcutils_reset_error
_KEPT: list[object] = []  # the middleware keeps pointers to these for ever


class _TypeSupport(ctypes.Structure):
    _fields_ = (
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("handle_for", ctypes.c_void_p),
        ("type_hash", ctypes.c_void_p),
        ("type_description", ctypes.c_void_p),
        ("type_sources", ctypes.c_void_p),
    )


class _Callbacks(ctypes.Structure):
    _fields_ = (
        ("message_namespace", ctypes.c_char_p),
        ("message_name", ctypes.c_char_p),
        ("cdr_serialize", ctypes.c_void_p),
        ("cdr_deserialize", ctypes.c_void_p),
        ("get_serialized_size", ctypes.c_void_p),
        ("max_serialized_size", ctypes.c_void_p),
        ("key_callbacks", ctypes.c_void_p),
    )


class _TypeHash(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * 32))


_HandleFor = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
_GetHash = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_pointer_in = ctypes.pythonapi.PyCapsule_GetPointer
_pointer_in.restype, _pointer_in.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
_capsule = ctypes.pythonapi.PyCapsule_New
_capsule.restype = ctypes.py_object
_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]


def publisher(node: Any, topic: str, kind: tuple[str, str], qos: Any) -> Any:
    """An rclpy publisher of bytes; `kind` is as for `message_class`."""
    made = node.create_publisher(message_class(*kind), topic, qos)
    _reset_error()
    return made


@cache
def message_class(type_name: str, type_hash: str) -> Any:
    """The class that rclpy takes for `type_name`, such as `tf2_msgs/msg/TFMessage`.

    Where no wheel has the type, the class is good for serialized messages only, and its node
    describes the type wrongly to whoever asks.

    Args:
        type_name: package/msg/Name.
        type_hash: the type's hash (REP-2016), `RIHS01_` and 64 hexadecimal digits.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ImportError:
        support = _renamed(package, name, bytes.fromhex(type_hash.removeprefix("RIHS01_")))
    # rclpy checks that these are set; they are for messages as objects.
    unused = dict.fromkeys(
        ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE"),
        object(),
    )
    return type(f"Metaclass_{name}", (type,), {"_TYPE_SUPPORT": support, **unused})(name, (), {})


def _lent(kind: bytes) -> int | None:
    """The address of a struct of this kind, of a type without a bound on its size."""
    meta = type(Lender)
    if meta._TYPE_SUPPORT is None:
        meta.__import_type_support__()
    whole = _TypeSupport.from_address(_pointer_in(meta._TYPE_SUPPORT, None))
    address: int | None = _HandleFor(whole.handle_for)(ctypes.addressof(whole), kind)
    return address


def _renamed(package: str, name: str, type_hash: bytes) -> object:
    serializer = _lent(_SERIALIZER)
    assert serializer is not None
    lent, describer = _TypeSupport.from_address(serializer), _lent(_DESCRIBER)

    def handle(asked: int, kind: bytes) -> int | None:
        return {_SERIALIZER: asked, _DESCRIBER: describer}.get(kind)

    callbacks = _Callbacks.from_buffer_copy(_Callbacks.from_address(lent.data))
    callbacks.message_namespace = f"{package}::msg".encode()
    callbacks.message_name = name.encode()
    own_hash = _TypeHash(1, (ctypes.c_uint8 * 32)(*type_hash))
    handle_for = _HandleFor(handle)
    get_hash = _GetHash(lambda handle: ctypes.addressof(own_hash))
    support = _TypeSupport.from_buffer_copy(lent)
    support.data = ctypes.addressof(callbacks)
    support.handle_for = ctypes.cast(handle_for, ctypes.c_void_p).value
    support.type_hash = ctypes.cast(get_hash, ctypes.c_void_p).value
    _KEPT.extend((callbacks, own_hash, handle_for, get_hash, support))
    return _capsule(ctypes.addressof(support), None, None)


SEEN = {"table": (0.0, math.inf), "cup": (5.0, 30.0), "scissors": (12.0, 18.0)}
TYPES = {
    "/clock": "rosgraph_msgs/msg/Clock",
    "/px4/position": "px4_msgs/msg/VehicleLocalPosition",
    "/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/bumper": "std_msgs/msg/Bool",
    "/battery_state": "sensor_msgs/msg/BatteryState",
    "/vision/scene/scene_objects": "ros2_vision_interfaces/msg/VisionDetectionArray",
    "/camera/image_raw": "sensor_msgs/msg/Image",
    "/speech": "std_msgs/msg/String",
}
UNASKED = {"/clock", "/px4/position", "/camera/image_raw", "/speech"}
"""Topics that it publishes only where they are named."""
# What a subscriber on a busy machine has not taken yet: seconds of the quickest topic.
DEPTH = 1000
_PER_SECOND = {"/bumper": 2.0, "/battery_state": 1.0, "/vision/scene/scene_objects": 1.0}
WORTH_TELLING_S = 0.05
ACKED_WITHIN_S = 60  # of a subscriber that lives; one that was killed is given up before
_SENSORS = {"laser": (0.10, 0.0, 0.20), "camera": (0.15, 0.0, 0.30)}


def pose(t: float) -> tuple[float, float, float]:
    """x and y (m) and yaw (rad, not wrapped) in odom, t seconds after T0."""
    return *position(t), TURN_RATE * t


def seen(t: float) -> list[str]:
    """What the camera sees t seconds after T0."""
    return [name for name, (begin, end) in SEEN.items() if begin <= t < end]


def is_due(topic: str, tick: int, hz: float) -> bool:
    """Whether a message of this topic is published at this tick."""
    if topic == "/tf_static":
        return tick == 0
    period = 2.0 if topic == "/cmd_vel" else hz / _PER_SECOND.get(topic, hz)
    return tick % max(1, round(period if hz >= 2.0 else 1.0)) == 0


class Messages:
    """The messages of one robot, serialized."""

    def __init__(self, t0: int, bumps_s: float = math.inf) -> None:
        self._t0 = t0
        self.bumps_s = bumps_s

    def payload(self, topic: str, t: float) -> bytes:
        """The message published on `topic` t seconds after T0, as CDR."""
        at, (x, y, yaw) = self._t0 + round(t * 1e9), pose(t)
        made: dict[str, Callable[[], Msg]] = {
            "/odom": lambda: odom(at, x, y, yaw, vx=RADIUS * TURN_RATE, wz=TURN_RATE),
            "/tf": lambda: tf_of(at, "odom", "base_link", (x, y, 0.0), yaw),
            "/tf_static": lambda: tf(
                at, *(transform(at, "base_link", name, place) for name, place in _SENSORS.items())
            ),
            "/cmd_vel": lambda: command(at, RADIUS * TURN_RATE, TURN_RATE),
            "/bumper": lambda: boolean(at, 0.0 <= t - self.bumps_s < 1.0),
            "/battery_state": lambda: battery(at, 0.8 - 0.001 * t),
            "/vision/scene/scene_objects": lambda: detections(at, seen(t)),
            "/speech": lambda: text(at, f"what people say at {t:.0f} s"),
        }
        if topic in made:
            return made[topic]().payload
        bodies: dict[str, dict[str, object]] = {
            "/clock": {"clock": stamp(round(t * 1e9))},
            "/px4/position": {
                "timestamp": round(t * 1e6),
                "xy_valid": True,
                "x": x,
                "y": y,
                "z": 0.0,
                "heading": yaw,
            },
            "/camera/image_raw": {
                "header": header(at, "camera"),
                "height": 48,
                "width": 64,
                "step": 64,
                "encoding": "mono8",
                "is_bigendian": 0,
                "data": np.zeros(48 * 64, np.uint8),
            },
        }
        return Msg(topic, TYPES[topic], at, make(TYPES[topic], **bodies[topic])).payload


class Robot:
    """The node with its publishers."""

    def __init__(self, topics: list[str], truth: Path) -> None:
        self._node = rclpy.create_node("robot", enable_rosout=False, start_parameter_services=False)
        self._truth = truth
        self._stop = False
        self._bump = False
        self._matched = [(0, 0)]
        self._late_s = 0.0
        self._publishers = {}
        for topic in topics:
            durability = (
                DurabilityPolicy.TRANSIENT_LOCAL
                if topic == "/tf_static"
                else DurabilityPolicy.VOLATILE
            )
            profile = QoSProfile(depth=DEPTH, durability=durability)
            kind = (TYPES[topic], typestore().hash_rihs01(TYPES[topic]))
            self._publishers[topic] = publisher(self._node, topic, kind, profile)

    def stop(self, *_: object) -> None:
        self._stop = True

    def bump(self, *_: object) -> None:
        self._bump = True

    def await_subscribers(self, count: int) -> None:
        """Returns when every topic but the latched one has so many, or at a signal."""
        waiting = [p for topic, p in self._publishers.items() if topic != "/tf_static"]
        while not self._stop and any(p.get_subscription_count() < count for p in waiting):
            time.sleep(0.02)

    def drive(self, hz: float, bumps_s: float) -> None:
        """Publishes until a signal, and leaves."""
        for topic in self._publishers:
            # The first of its type is slow to make.
            Messages(0).payload(topic, 0.0)
        t0 = time.time_ns() // 10**6 * 10**6
        begin = time.monotonic()
        messages, published = Messages(t0, bumps_s), Counter[str]()
        self._tell(t0, published, 0)
        tick = 0
        first = next(iter(self._publishers.values()))
        while not self._stop:
            time.sleep(max(0.0, begin + tick / hz - time.monotonic()))
            if first.get_subscription_count() != self._matched[-1][1]:
                self._matched.append((time.time_ns(), first.get_subscription_count()))
                self._tell(t0, published, tick)
            if self._bump:
                self._bump = False
                messages.bumps_s = math.ceil(tick / hz * 2) / 2
            for topic, out in self._publishers.items():
                if is_due(topic, tick, hz):
                    out.publish(messages.payload(topic, tick / hz))
                    published[topic] += 1
            self._note(time.monotonic() - begin - tick / hz, t0, published, tick)
            tick += 1
        for out in self._publishers.values():
            out.wait_for_all_acked(Duration(seconds=ACKED_WITHIN_S))
        self._tell(t0, published, tick)
        self._node.destroy_node()

    def _note(self, late_s: float, t0: int, published: Counter[str], ticks: int) -> None:
        """Whoever kills it is to know how late it was."""
        told_s, self._late_s = self._late_s, max(late_s, self._late_s)
        if self._late_s > max(1.2 * told_s, WORTH_TELLING_S):
            self._tell(t0, published, ticks)

    def _tell(self, t0: int, published: Counter[str], ticks: int) -> None:
        fresh = self._truth.with_suffix(".new")
        told = {"t0_ns": t0, "ticks": ticks, "published": published, "matched": self._matched}
        told["late_s"] = self._late_s
        fresh.write_text(json.dumps(told))
        fresh.replace(self._truth)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bump", type=float, default=25.0, help="when it does untold; s")
    parser.add_argument("--hz", type=float, default=20.0, help="ticks a second")
    default = [topic for topic in TYPES if topic not in UNASKED]
    parser.add_argument("--topics", nargs="+", default=default, choices=list(TYPES))
    parser.add_argument("--subscribers", type=int, default=0, help="to wait for, on each topic")
    parser.add_argument("--truth", type=Path, required=True, help="JSON file to write")
    given = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    robot = Robot(given.topics, given.truth)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, robot.stop)
    signal.signal(signal.SIGUSR1, robot.bump)
    robot.await_subscribers(given.subscribers)
    robot.drive(given.hz, given.bump)
    rclpy.shutdown()


if __name__ == "__main__":
    main()

"""The messages of a recording, as serialized bytes with their times."""

from collections.abc import Iterator, Sequence
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from benchmarks import payloads
from benchmarks.motion import Motion
from numpy.typing import NDArray

from ros2_memory.core.arrays import Floats
from tests.home import camera, days
from tests.home.camera import Detected
from tests.home.drift import AHEAD_S
from tests.home.world import VISION, Beats, Recording, Stream, World

OPTICAL = "camera_optical_frame"
"""The frame of the detections: z ahead, x right, y down."""
TF_STATIC = "/tf_static"
GOALS = "/navigate_to_pose/_action/status"
POSE_NOISE_M = 0.002
POSE_NOISE_RAD = 0.002

ODOM = Stream("/odom", 0.4, 0.1)
LOCALISED = Stream("/tf", 1.0, 0.5)
COMMAND = Stream("/cmd_vel", 0.4, 0.1)
DOCKED = Stream("/is_docked", 2.0, 0.5)
BUMPER = Stream("/bumper", 1.0, 0.5)
BATTERY = Stream("/battery_state", 10.0, 2.0)
DIAGNOSTICS = Stream("/diagnostics", 2.0, 2.0)

TYPES = {
    "/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
    "/cmd_vel": "geometry_msgs/msg/Twist",
    VISION.topic: payloads.DETECTIONS,
    "/is_docked": "std_msgs/msg/Bool",
    "/bumper": "std_msgs/msg/Bool",
    "/battery_state": "sensor_msgs/msg/BatteryState",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    GOALS: "action_msgs/msg/GoalStatusArray",
    "/rosout": "rcl_interfaces/msg/Log",
}
"""Every topic with its type."""
TRANSIENT_LOCAL = frozenset({TF_STATIC, GOALS, "/rosout"})

_NAN = float("nan")
_OPTICAL_TURN = (-0.5, 0.5, -0.5, 0.5)
_STRAIGHT = (0.0, 0.0, 0.0, 1.0)


class Record(NamedTuple):
    """One message: nanoseconds, topic, CDR."""

    log_time: int
    publish_time: int
    topic: str
    payload: bytes


def records(world: World, recording: Recording) -> list[Record]:
    """Returns all messages of a recording in the order of their log times, `/tf_static` apart."""
    parts: Sequence[Iterator[Record]] = (
        _moving(world, recording),
        _localised(world, recording),
        _commands(world, recording),
        _detections(world, recording),
        _switches(world, recording),
        _battery(world, recording),
        _diagnostics(world, recording),
        _goals(world, recording),
        _rosout(world, recording),
    )
    return sorted((each for part in parts for each in part), key=lambda each: each.log_time)


@cache
def fixed_frames(stamp: int) -> bytes:
    """Returns the message of `/tf_static`: the camera on the robot, and its optical axes."""
    x, y, z = camera.CAMERA
    return payloads.serialized(
        "tf2_msgs/msg/TFMessage",
        transforms=[
            _transform("base_link", "camera_link", stamp, (x, y, z), _STRAIGHT),
            _transform("camera_link", OPTICAL, stamp, (0.0, 0.0, 0.0), _OPTICAL_TURN),
            _transform("base_link", "laser", stamp, (0.1, 0.0, 0.2), _STRAIGHT),
        ],
    )


def _transform(
    parent: str,
    child: str,
    stamp: int,
    at: tuple[float, float, float],
    turn: tuple[float, float, float, float],
) -> object:
    x, y, z, w = turn
    return payloads.make(
        "geometry_msgs/msg/TransformStamped",
        header=payloads.header(stamp, parent),
        child_frame_id=child,
        transform=payloads.make(
            "geometry_msgs/msg/Transform",
            translation=payloads.vector3(*at),
            rotation=payloads.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )


def _records(world: World, topic: str, beats: Beats, bodies: Sequence[bytes]) -> Iterator[Record]:
    logged = world.clock_ns(beats.log)
    # Published when the middleware took it; a detector publishes when it is done.
    slow = beats.log - beats.stamp > 0.01
    published = world.clock_ns(np.where(slow, beats.log - 0.0002, beats.stamp))
    return map(Record, logged.tolist(), published.tolist(), (topic,) * len(bodies), bodies)


def _moving(world: World, recording: Recording) -> Iterator[Record]:
    """Yields `/odom` and the same poses in `/tf`."""
    beats = world.beats(ODOM, recording)
    chance = world.scale.chance(6, recording.number)
    noise = chance.normal(size=(5, len(beats.stamp)))
    pose = world.odom(beats.stamp)
    speed, turning = world.life.path.rates(beats.stamp)
    # A wheel controller reckons in single precision.
    x, y, yaw, vx, wz = (
        value.astype(np.float32).astype(np.float64)
        for value in (
            pose.x + POSE_NOISE_M * noise[0],
            pose.y + POSE_NOISE_M * noise[1],
            pose.yaw + POSE_NOISE_RAD * noise[2],
            np.where(speed != 0.0, np.round(speed + 0.01 * noise[3], 3), 0.0),
            np.where(turning != 0.0, np.round(turning + 0.01 * noise[4], 3), 0.0),
        )
    )
    stamps = world.clock_ns(beats.stamp)
    yield from _records(
        world, "/odom", beats, payloads.odometry_of(Motion(x, y, yaw, vx, wz), stamps)
    )
    frames = payloads.frames_of((x, y, yaw), stamps, payloads.ODOM_TO_BASE)
    yield from _records(world, "/tf", beats, frames)


def _localised(world: World, recording: Recording) -> Iterator[Record]:
    beats = world.beats(LOCALISED, recording)
    at = world.drift.at(beats.stamp, believed=True)
    stamps = world.clock_ns(beats.stamp) + round(AHEAD_S * 1e9)
    frames = payloads.frames_of((at.x, at.y, at.yaw), stamps, ("map", "odom"))
    return _records(world, "/tf", beats, frames)


def _commands(world: World, recording: Recording) -> Iterator[Record]:
    beats = world.beats(COMMAND, recording)
    out = ~world.docked(beats.stamp)
    beats = Beats(beats.stamp[out], beats.log[out])
    speed, turning = world.life.path.rates(beats.stamp)
    return _records(world, "/cmd_vel", beats, payloads.command_of(speed, turning))


def _detections(world: World, recording: Recording) -> Iterator[Record]:
    beats, sights = world.sights(recording)
    found: list[list[object]] = [[] for _ in beats.stamp]
    for each in sights.detected:
        found[each.message].append(_detection(each))
    bodies = [
        payloads.serialized(
            payloads.DETECTIONS,
            header=payloads.header(stamp, OPTICAL),
            skill="scene",
            detections=seen,
        )
        for stamp, seen in zip(world.clock_ns(beats.stamp).tolist(), found, strict=True)
    ]
    return _records(world, VISION.topic, beats, bodies)


def _detection(seen: Detected) -> object:
    ahead, left, up = seen.point
    # A pinhole camera of 640 by 480 pixels.
    across, down, half = (round(320.0 * part / max(ahead, 0.2)) for part in (-left, -up, 0.15))
    edges = (320 + across - half, 240 + down - half, 320 + across + half, 240 + down + half)
    return payloads.make(
        "ros2_vision_interfaces/msg/VisionDetection",
        label=seen.label,
        score=seen.score,
        point=payloads.make("geometry_msgs/msg/Point", x=-left, y=-up, z=ahead),
        bbox=np.clip(np.array(edges, dtype=np.int32), 0, 640),
    )


@cache
def _bool(*, value: bool) -> bytes:
    return payloads.serialized("std_msgs/msg/Bool", data=value)


def _bools(values: NDArray[np.bool_]) -> list[bytes]:
    return [_bool(value=value) for value in values.tolist()]


def _switches(world: World, recording: Recording) -> Iterator[Record]:
    beats = world.beats(DOCKED, recording)
    yield from _records(world, DOCKED.topic, beats, _bools(world.docked(beats.stamp)))
    beats = world.beats(BUMPER, recording)
    edges = [edge for bump in world.life.bumps for edge in (bump, bump + days.BUMP_S)]
    extra = _within(np.array(edges), recording)
    stamps = np.sort(np.concatenate([beats.stamp, extra]))
    pressed = np.zeros(len(stamps), dtype=np.bool_)
    for bump in world.life.bumps:
        pressed |= (stamps >= bump) & (stamps < bump + days.BUMP_S)
    both = Beats(stamps, stamps + 0.0002)
    inside = both.log < recording.stop
    yield from _records(
        world, BUMPER.topic, Beats(stamps[inside], both.log[inside]), _bools(pressed[inside])
    )


def _battery(world: World, recording: Recording) -> Iterator[Record]:
    beats = world.beats(BATTERY, recording)
    charge, docked = world.battery(beats.stamp), world.docked(beats.stamp)
    build = partial(
        payloads.serialized,
        "sensor_msgs/msg/BatteryState",
        temperature=_NAN,
        charge=_NAN,
        capacity=_NAN,
        design_capacity=_NAN,
        power_supply_health=0,
        power_supply_technology=0,
        present=True,
        cell_voltage=np.zeros(0, dtype=np.float32),
        cell_temperature=np.zeros(0, dtype=np.float32),
        location="",
        serial_number="",
    )
    bodies = [
        build(
            header=payloads.header(stamp, "base_link"),
            voltage=22.0 + 3.2 * level,
            current=-1.2 if not home else 0.0 if level >= 1.0 else 2.0,
            percentage=level,
            power_supply_status=2 if not home else 4 if level >= 1.0 else 1,
        )
        for stamp, level, home in zip(
            world.clock_ns(beats.stamp).tolist(), charge.tolist(), docked.tolist(), strict=True
        )
    ]
    return _records(world, BATTERY.topic, beats, bodies)


def _diagnostics(world: World, recording: Recording) -> Iterator[Record]:
    beats = world.beats(DIAGNOSTICS, recording)
    life = world.life
    low = world.battery(beats.stamp) < days.LOW_BATTERY
    bodies = []
    for t, stamp, is_low in zip(
        beats.stamp.tolist(), world.clock_ns(beats.stamp).tolist(), low.tolist(), strict=True
    ):
        blind = life.blind[0] <= t < life.blind[1]
        hot = any(start <= t < stop for start, stop in life.hot)
        status = [
            _status("camera", 2 if blind else 0, "no frames" if blind else "30 frames/s"),
            _status("wheel motors", 1 if hot else 0, "overheated" if hot else "ok"),
            _status("battery", 1 if is_low else 0, "low" if is_low else "ok"),
        ]
        bodies.append(
            payloads.serialized(
                TYPES[DIAGNOSTICS.topic], header=payloads.header(stamp, ""), status=status
            )
        )
    return _records(world, DIAGNOSTICS.topic, beats, bodies)


def _status(name: str, level: int, text: str) -> object:
    return payloads.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=name,
        message=text,
        hardware_id="robot",
        values=[],
    )


def _goals(world: World, recording: Recording) -> Iterator[Record]:
    status: dict[int, int] = {}
    begun: dict[int, float] = {}
    times, bodies = [], []
    for change in world.life.goals:
        status[change.goal] = change.status
        begun.setdefault(change.goal, change.t)
        if not recording.start <= change.t < recording.stop - 0.001:
            continue
        times.append(change.t)
        listed = [
            payloads.make(
                "action_msgs/msg/GoalStatus",
                goal_info=payloads.make(
                    "action_msgs/msg/GoalInfo",
                    goal_id=payloads.make(
                        "unique_identifier_msgs/msg/UUID",
                        uuid=np.frombuffer(goal.to_bytes(16, "big"), np.uint8),
                    ),
                    stamp=payloads.time(int(world.clock_ns(np.array([begun[goal]]))[0])),
                ),
                status=status[goal],
            )
            for goal in list(status)[-3:]
        ]
        bodies.append(payloads.serialized(TYPES[GOALS], status_list=listed))
    stamps = np.array(times)
    return _records(world, GOALS, Beats(stamps, stamps + 0.0003), bodies)


def _rosout(world: World, recording: Recording) -> Iterator[Record]:
    if not world.scale.rosout:
        return iter(())
    lines = [each for each in world.life.logs if recording.start <= each.t < recording.stop - 0.001]
    stamps = np.array([each.t for each in lines])
    bodies = [
        payloads.serialized(
            TYPES["/rosout"],
            stamp=payloads.time(stamp),
            level=each.level,
            name=each.node,
            msg=each.text,
            file="",
            function="",
            line=0,
        )
        for each, stamp in zip(lines, world.clock_ns(stamps).tolist(), strict=True)
    ]
    return _records(world, "/rosout", Beats(stamps, stamps + 0.0004), bodies)


def _within(t: Floats, recording: Recording) -> Floats:
    return t[(t >= recording.start) & (t < recording.stop - 0.001)]

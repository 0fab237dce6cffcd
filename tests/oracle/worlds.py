"""Histories that are odd in the ways of real robots, each with what is true of it.

All are written with the `mcap` and `rosbags` libraries alone. A world is a folder of recordings;
each recording is a folder of splits.
"""

from __future__ import annotations

import math
import sqlite3
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path
    from random import Random

    from rosbags.typesys.store import Typestore

S: Final = 10**9
START: Final = 1_795_000_000 * S
STATUS: Final = "px4_msgs/msg/VehicleStatus"
FLAGS: Final = tuple(f"flag_{number:02}" for number in range(24))
LABELS: Final = ("cup", "scissors", "red chair", "Person 2", "straße")
TRANSIENT: Final = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: transient_local\n"
_DRIVE_S: Final = 60
VOLATILE: Final = "- history: 1\n  depth: 10\n  reliability: 1\n  durability: volatile\n"


@dataclass(frozen=True)
class Out:
    """One message to write: log time and stamp in ns."""

    topic: str
    type: str
    at: int
    body: Any


@dataclass(frozen=True)
class World:
    """A folder of bags, and what the robot really did.

    Attributes:
        moved: true path length (m) between two times (ns), where the world knows it.
        stood: how long (s) the robot stood between two times (ns), where the world knows it.
        tf: whether transforms may be asked: `(topic, is it static)`.
        odometry: the topics that carry the robot's pose.
        track_tolerance: how far (m) `visits` may be off, where the map moves: there it uses tracks.
    """

    folder: Path
    storage: str = "mcap"
    moved: Callable[[int, int], float] | None = None
    stood: Callable[[int, int], float] | None = None
    path_tolerance: float = 0.0
    track_tolerance: float = 0.0
    tf: Sequence[tuple[str, bool]] = ()
    odometry: Sequence[str] = ("/odom",)
    settings: Sequence[str] = ()


def drifting_map(folder: Path, draw: Random) -> World:
    """A robot with 5 mm of pose noise, a moving map, and /tf_static repeated in every split."""
    messages: list[Out] = []
    legs = _legs(draw, _DRIVE_S)
    for tick in range(_DRIVE_S * 50):
        at = START + tick * S // 50
        x, y, yaw, speed = _along(legs, tick / 50)
        noise = [draw.gauss(0, 0.005), draw.gauss(0, 0.005)]
        messages.append(odometry(at, x + noise[0], y + noise[1], yaw, speed))
        messages.append(tf(at, [("odom", "base_link", (x, y, 0.0), yaw)]))
        if tick % 25 == 0:
            drift = 0.02 * math.sin(tick / 300)
            messages.append(tf(at, [("map", "odom", (1.0 + drift, -2.0, 0.0), drift)]))
        if tick % 500 == 0:
            mount = ("base_link", "camera", (0.2, 0.0, 0.5), 0.3)
            messages.append(tf(at, [mount], topic="/tf_static"))
        if tick % 10 == 0 and 12 < tick / 50 < 31:
            messages.append(seen(at, draw.sample(LABELS, 2)))
    write(folder / "rec_a", messages, split_s=10)
    return World(
        folder,
        moved=lambda start, end: _length(legs, (start - START) / S, (end - START) / S),
        stood=lambda start, end: _standing(legs, (start - START) / S, (end - START) / S),
        path_tolerance=0.03,
        track_tolerance=0.05,
        tf=(("/tf", False), ("/tf_static", True)),
    )


def two_robots(folder: Path, draw: Random) -> World:
    """A boat whose map moves, and beside it somebody's Nav2 bag with a static map -> odom."""
    boat: list[Out] = []
    for tick in range(40 * 20):
        at = START + tick * S // 20
        boat.append(odometry(at, 0.05 * tick, 0.0, 0.0, 1.0, topic="/boat/odom", frame="boat_odom"))
        boat.append(tf(at, [("map", "boat_odom", (0.01 * tick, 3.0, 0.0), 0.0)]))
        boat.append(tf(at, [("boat_odom", "boat", (0.05 * tick, 0.0, 0.0), 0.0)]))
    write(folder / "boat", boat, split_s=10)
    later = START + 3600 * S
    cart = [tf(later, [("map", "cart_odom", (5.0, 5.0, 0.0), 0.5)], topic="/tf_static")]
    for tick in range(20 * 30):
        at = later + tick * S // 30
        cart.append(odometry(at, 0.01 * tick, 0.5, 0.1, 0.3, topic="/cart/odom", frame="cart_odom"))
        cart.append(tf(at, [("cart_odom", "cart", (0.01 * tick, 0.5, 0.0), 0.1)]))
        if tick % 40 == 0:
            cart.append(status(at, draw))
    write(folder / "cart", cart, split_s=7)
    return World(
        folder,
        tf=(("/tf", False), ("/tf_static", True)),
        odometry=("/boat/odom", "/cart/odom"),
        settings=("data.pose_topic=/boat/odom",),
    )


def clock_from_zero(folder: Path, draw: Random) -> World:
    """Stamps and log times from 0 on, written out of order, in chunks that overlap."""
    messages: list[Out] = []
    for tick in range(30 * 25):
        at = tick * S // 25
        messages.append(odometry(at, math.sin(tick / 40), math.cos(tick / 40), 0.0, 0.6))
        if tick % 5 == 0:
            messages.append(boolean(at, "/bumper", value=draw.random() < 0.1))
        if tick % 50 == 0:
            messages.append(status(at, draw))
            messages.append(text(at, "/notes", draw.choice(("docked", "level 20", "Ünder way"))))
    for first in range(0, len(messages) - 8, 8):
        part = messages[first : first + 8]
        draw.shuffle(part)
        messages[first : first + 8] = part
    write(folder / "zero", messages, split_s=12, chunk=2048)
    return World(folder)


def resets_and_gaps(folder: Path, draw: Random) -> World:
    """Three runs with pauses between, each of which begins at the origin again; sqlite3 files."""
    for run in range(3):
        messages: list[Out] = []
        begin = START + run * 400 * S
        for tick in range(25 * 20):
            at = begin + tick * S // 20
            x = 0.02 * tick
            messages.append(odometry(at, x, 0.5 * run, 0.0, 0.4))
            if tick % 7 == 0:
                messages.append(boolean(at, "/bumper", value=draw.random() < 0.2))
            if tick % 30 == 0:
                messages.append(number(at, "/battery", 0.9 - 0.01 * run - 0.0005 * tick))
        write_db3(folder / f"run_{run}" / f"run_{run}_0.db3", messages)
    return World(folder, storage="rosbag2", moved=_runs_of(3, 400, 25, 0.4), path_tolerance=0.004)


def fast_latched(folder: Path, draw: Random) -> World:
    """PX4's way: telemetry at 50 Hz that is transient local, a map published once, /rosout."""
    messages: list[Out] = [text(START, "/map_name", "kitchen")]
    latched = {"/map_name", "/fmu/out/speed", "/fmu/out/vehicle_status", "/rosout"}
    for tick in range(30 * 50):
        at = START + tick * S // 50
        if tick < 900:
            messages.append(number(at, "/fmu/out/speed", math.sin(tick / 100)))
        if tick % 50 == 0:
            messages.append(status(at, draw, topic="/fmu/out/vehicle_status"))
            messages.append(odometry(at, tick / 500, 0.0, 0.0, 0.1))
    write(folder / "px4", messages, split_s=10, latched=latched)
    return World(folder, moved=None)


WORLDS: Final[Mapping[str, Callable[[Path, Random], World]]] = {
    "drifting_map": drifting_map,
    "two_robots": two_robots,
    "clock_from_zero": clock_from_zero,
    "resets_and_gaps": resets_and_gaps,
    "fast_latched": fast_latched,
}


# -- the robot's way ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Leg:
    """Straight ahead at one speed (m/s, 0 to stand) for some seconds."""

    begin: float
    end: float
    x: float
    y: float
    yaw: float
    speed: float


def _legs(draw: Random, length_s: int) -> list[_Leg]:
    legs: list[_Leg] = []
    at = x = y = yaw = 0.0
    while at < length_s:
        lasts = draw.uniform(4, 12)
        speed = 0.0 if len(legs) % 3 == 1 else draw.uniform(0.2, 1.5)
        legs.append(_Leg(at, at + lasts, x, y, yaw, speed))
        x += speed * lasts * math.cos(yaw)
        y += speed * lasts * math.sin(yaw)
        at += lasts
        yaw += draw.uniform(-1.5, 1.5)
    return legs


def _along(legs: Sequence[_Leg], at: float) -> tuple[float, float, float, float]:
    leg = next(each for each in legs if each.begin <= at < each.end)
    gone = leg.speed * (at - leg.begin)
    return leg.x + gone * math.cos(leg.yaw), leg.y + gone * math.sin(leg.yaw), leg.yaw, leg.speed


def _length(legs: Sequence[_Leg], start: float, end: float) -> float:
    return sum(
        leg.speed * max(min(leg.end, end) - max(leg.begin, start), 0.0)
        for leg in legs
    )  # fmt: skip


def _standing(legs: Sequence[_Leg], start: float, end: float) -> float:
    """Seconds in stops of 3 s and more; the recording ends after `_DRIVE_S`."""
    stops = [(leg.begin, min(leg.end, _DRIVE_S)) for leg in legs if leg.speed == 0]
    return sum(
        max(min(last, end) - max(first, start), 0.0) for first, last in stops if last - first >= 3
    )


def _runs_of(runs: int, apart_s: int, length_s: int, speed: float) -> Callable[[int, int], float]:
    def moved(start: int, end: int) -> float:
        total = 0.0
        for run in range(runs):
            begin = START + run * apart_s * S
            last = begin + length_s * S - S // 20
            total += speed * max(min(end, last) - max(start, begin), 0) / S
        return total

    return moved


# -- messages ----------------------------------------------------------------------------------


@cache
def types() -> Typestore:
    """Jazzy's standard types, PX4's way of a status, and detections."""
    store = get_typestore(Stores.ROS2_JAZZY)
    flags = "".join(f"bool {name}\n" for name in FLAGS)
    store.register(get_types_from_msg(f"uint64 timestamp\nuint8 nav_state\n{flags}", STATUS))
    return store


def make(kind: str, **values: Any) -> Any:
    """A message object."""
    return types().types[kind](**values)


def _header(at: int, frame: str) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=at // S, nanosec=at % S)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _turned(yaw: float) -> Any:
    kind = "geometry_msgs/msg/Quaternion"
    return make(kind, x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def _vector(x: float, y: float = 0.0, z: float = 0.0) -> Any:
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def odometry(
    at: int,
    x: float,
    y: float,
    yaw: float,
    speed: float,
    *,
    topic: str = "/odom",
    frame: str = "odom",
) -> Out:
    """The robot's pose (m, rad) and speed (m/s)."""
    place = make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
    pose = make("geometry_msgs/msg/Pose", position=place, orientation=_turned(yaw))
    twist = make("geometry_msgs/msg/Twist", linear=_vector(speed), angular=_vector(0.0))
    blank = np.zeros(36)
    body = make(
        "nav_msgs/msg/Odometry",
        header=_header(at, frame),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=blank),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=blank),
    )
    return Out(topic, "nav_msgs/msg/Odometry", at, body)


def tf(
    at: int,
    moves: Iterable[tuple[str, str, tuple[float, float, float], float]],
    *,
    topic: str = "/tf",
) -> Out:
    """Transforms `(parent, child, (x, y, z), yaw)`, stamped and logged at one time."""
    made = [
        make(
            "geometry_msgs/msg/TransformStamped",
            header=_header(at, parent),
            child_frame_id=child,
            transform=make(
                "geometry_msgs/msg/Transform", translation=_vector(*shift), rotation=_turned(yaw)
            ),
        )
        for parent, child, shift, yaw in moves
    ]
    return Out(topic, "tf2_msgs/msg/TFMessage", at, make("tf2_msgs/msg/TFMessage", transforms=made))


def text(at: int, topic: str, data: str) -> Out:
    """A string."""
    return Out(topic, "std_msgs/msg/String", at, make("std_msgs/msg/String", data=data))


def boolean(at: int, topic: str, *, value: bool) -> Out:
    """A boolean."""
    return Out(topic, "std_msgs/msg/Bool", at, make("std_msgs/msg/Bool", data=value))


def number(at: int, topic: str, value: float) -> Out:
    """A float64."""
    return Out(topic, "std_msgs/msg/Float64", at, make("std_msgs/msg/Float64", data=value))


def seen(at: int, labels: Sequence[str]) -> Out:
    """What a detector saw, as text."""
    return text(at, "/vision/scene/scene_objects", ", ".join(labels))


def status(at: int, draw: Random, *, topic: str = "/status") -> Out:
    """A status of 24 booleans."""
    flags = {name: draw.random() < 0.3 for name in FLAGS}
    body = make(STATUS, timestamp=at // 1000, nav_state=draw.randrange(20), **flags)
    return Out(topic, STATUS, at, body)


# -- files -------------------------------------------------------------------------------------


def write(
    folder: Path,
    messages: Sequence[Out],
    *,
    split_s: int,
    chunk: int = 64 * 1024,
    latched: Iterable[str] = ("/tf_static",),
) -> None:
    """Writes one recording as MCAP splits of some seconds each."""
    folder.mkdir(parents=True)
    lasting = {*latched}
    first = min(each.at for each in messages)
    parts: dict[int, list[Out]] = {}
    for each in messages:
        parts.setdefault((each.at - first) // (split_s * S), []).append(each)
    for number_, part in enumerate(parts[key] for key in sorted(parts)):
        with (folder / f"{folder.name}_{number_}.mcap").open("wb") as stream:
            writer = Writer(stream, chunk_size=chunk, compression=CompressionType.ZSTD)
            writer.start(profile="ros2", library="odd worlds")
            channels: dict[str, int] = {}
            for each in part:
                if each.topic not in channels:
                    text_ = types().generate_msgdef(each.type, ros_version=2)[0]
                    schema = writer.register_schema(each.type, "ros2msg", text_.encode())
                    qos = TRANSIENT if each.topic in lasting else VOLATILE
                    channels[each.topic] = writer.register_channel(
                        each.topic, "cdr", schema, {"offered_qos_profiles": qos}
                    )
                payload = bytes(types().serialize_cdr(each.body, each.type))
                writer.add_message(channels[each.topic], each.at, payload, each.at)
            writer.finish()


def write_db3(path: Path, messages: Sequence[Out]) -> None:
    """Writes one sqlite3 split, as rosbag2 lays it out since Iron."""
    path.parent.mkdir(parents=True)
    base = sqlite3.connect(path)
    base.executescript(
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
        "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL,"
        " metadata TEXT NOT NULL);"
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,"
        " type_description_hash TEXT NOT NULL);"
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,"
        " encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,"
        " type_description_hash TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
        " timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
        "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        "INSERT INTO schema VALUES (4, 'jazzy');"
    )
    known: dict[str, int] = {}
    for each in messages:
        if each.topic not in known:
            known[each.topic] = len(known) + 1
            base.execute(
                "INSERT INTO topics VALUES (?,?,?,'cdr',?,'')",
                (known[each.topic], each.topic, each.type, VOLATILE),
            )
            definition = types().generate_msgdef(each.type, ros_version=2)[0]
            base.execute(
                "INSERT INTO message_definitions(topic_type,encoding,encoded_message_definition,"
                "type_description_hash) VALUES (?,'ros2msg',?,'')",
                (each.type, definition),
            )
        payload = bytes(types().serialize_cdr(each.body, each.type))
        base.execute(
            "INSERT INTO messages(topic_id,timestamp,data) VALUES (?,?,?)",
            (known[each.topic], each.at, payload),
        )
    base.commit()
    base.close()

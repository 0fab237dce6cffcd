"""Bags written by the test that reads them: MCAP and sqlite3, as rosbag2 lays them out."""

import math
import os
import sqlite3
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

VISION_DEFINITIONS = {
    "ros2_vision_interfaces/msg/VisionDetection": (
        "string label\nfloat32 score\ngeometry_msgs/Point point\nint32[4] bbox\n"
    ),
    "ros2_vision_interfaces/msg/VisionDetectionArray": (
        "std_msgs/Header header\nstring skill\nVisionDetection[] detections\n"
    ),
    "ros2_vision_interfaces/msg/StampedString": "std_msgs/Header header\nstring data\n",
}
STATUS_FLAGS = tuple(f"flag_{nth:02}" for nth in range(40))
_QOS = (
    "- history: unknown\n  depth: 0\n  reliability: reliable\n  durability: {durability}\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: automatic\n"
    "  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
TRANSIENT_LOCAL = _QOS.format(durability="transient_local")
VOLATILE = _QOS.format(durability="volatile")


OTHER_ROBOTS = {
    "turtlesim/msg/Pose": (
        "float32 x\nfloat32 y\nfloat32 theta\nfloat32 linear_velocity\nfloat32 angular_velocity\n"
    ),
    "px4_msgs/msg/VehicleOdometry": (
        "uint64 timestamp\nuint64 timestamp_sample\nuint8 pose_frame\nfloat32[3] position\n"
        "float32[4] q\nuint8 velocity_frame\nfloat32[3] velocity\nfloat32[3] angular_velocity\n"
        "float32[3] position_variance\nfloat32[3] orientation_variance\n"
        "float32[3] velocity_variance\nuint8 reset_counter\nint8 quality\n"
    ),
    "px4_msgs/msg/VehicleLocalPosition": (
        "uint64 timestamp\nbool xy_valid\nfloat32 x\nfloat32 y\nfloat32 z\nfloat32 heading\n"
    ),
    "px4_msgs/msg/VehicleGlobalPosition": (
        "uint64 timestamp\nfloat64 lat\nfloat64 lon\nfloat32 alt\n"
    ),
    "geographic_msgs/msg/GeoPoint": "float64 latitude\nfloat64 longitude\nfloat64 altitude\n",
    "geographic_msgs/msg/GeoPose": "GeoPoint position\ngeometry_msgs/Quaternion orientation\n",
    "geographic_msgs/msg/GeoPoseStamped": "std_msgs/Header header\nGeoPose pose\n",
    "winch_msgs/msg/Winch": (
        "int8 STATE_IDLE=0\nint8 STATE_HAULING=2\nfloat32 CABLE_LONGEST=1.5\n"
        "int8 state\nfloat32 cable\nstring note\n"
    ),
    "px4_msgs/msg/VehicleStatus": (
        "uint64 timestamp\nuint8 arming_state\n"
        + "".join(f"bool {name}\n" for name in STATUS_FLAGS)
        + "uint8 gcs_connection_lost_counter\n"
    ),
    "apriltag_msgs/msg/AprilTagDetection": "string family\nint32 id\nfloat32 decision_margin\n",
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\nAprilTagDetection[] detections\n"
    ),
    "darknet_ros_msgs/msg/BoundingBox": "string Class\nfloat64 probability\nint64 xmin\n",
    "darknet_ros_msgs/msg/BoundingBoxes": (
        "std_msgs/Header header\nBoundingBox[] bounding_boxes\n"
    ),
    "yolo_msgs/msg/Detection": "string class_name\nfloat64 score\nstring id\n",
    "yolo_msgs/msg/DetectionArray": "std_msgs/Header header\nDetection[] detections\n",
    "own_msgs/msg/NamedTwice": "string label\nstring class_name\nfloat32 score\n",
    "own_msgs/msg/NamedTwiceArray": "NamedTwice[] detections\n",
    "aruco_opencv_msgs/msg/MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose\n",
    "aruco_opencv_msgs/msg/ArucoDetection": "std_msgs/Header header\nMarkerPose[] markers\n",
    "radar_msgs/msg/RadarReturn": "float32 range\nfloat32 azimuth\nfloat32 amplitude\n",
    "radar_msgs/msg/RadarScan": "std_msgs/Header header\nRadarReturn[] returns\n",
    "autoware_perception_msgs/msg/ObjectClassification": (
        "uint8 UNKNOWN = 0\nuint8 CAR = 1\nuint8 TRUCK = 2\nuint8 PEDESTRIAN = 7\n"
        "uint8 label\nfloat32 probability\n"
    ),
    "autoware_perception_msgs/msg/TrackedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\n"
    ),
    "autoware_perception_msgs/msg/TrackedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
        "ObjectClassification[] classification\nTrackedObjectKinematics kinematics\n"
    ),
    "autoware_perception_msgs/msg/TrackedObjects": (
        "std_msgs/Header header\nTrackedObject[] objects\n"
    ),
    "mavros_msgs/msg/StatusText": "uint8 WARNING = 4\nuint8 severity\nstring text\n",
    "nav2_msgs/msg/BehaviorTreeStatusChange": (
        "builtin_interfaces/Time timestamp\nstring node_name\nuint16 uid\n"
        "string previous_status\nstring current_status\n"
    ),
    "nav2_msgs/msg/BehaviorTreeLog": (
        "builtin_interfaces/Time timestamp\nBehaviorTreeStatusChange[] event_log\n"
    ),
    "unitree_go/msg/IMUState": "float32[4] quaternion\n",
    "unitree_go/msg/SportModeState": (
        "uint32 error_code\nIMUState imu_state\nuint8 mode\nuint8 gait_type\nfloat32[3] position\n"
        "float32 body_height\nfloat32[3] velocity\nfloat32 yaw_speed\n"
        "float32[4] range_obstacle\nint16[4] foot_force\n"
    ),
    "px4_msgs/msg/SensorGps": (
        "uint64 timestamp\nfloat64 latitude_deg\nfloat64 longitude_deg\nfloat64 altitude_msl_m\n"
        "uint8 fix_type\n"
    ),
    "px4_msgs/msg/VehicleLandDetected": (
        "uint64 timestamp\nbool ground_contact\nbool maybe_landed\nbool landed\nbool in_air\n"
    ),
    "px4_msgs/msg/ManyFlags": "".join(f"bool flag_{nth:03}\n" for nth in range(600)),
}
"""Types that carry a pose in ways of their own, many booleans, or detections without a label."""


@cache
def typestore() -> Typestore:
    """Jazzy's standard types, `ros2_vision_interfaces`, and `OTHER_ROBOTS`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in {**VISION_DEFINITIONS, **OTHER_ROBOTS}.items():
        store.register(get_types_from_msg(text, name))
    return store


@dataclass(frozen=True)
class Msg:
    """One message to write. `body` is a message object of `type`, or raw payload bytes."""

    topic: str
    type: str
    log_time: int
    body: object
    publish_time: int | None = None

    @property
    def published(self) -> int:
        return self.log_time if self.publish_time is None else self.publish_time

    @property
    def payload(self) -> bytes:
        if isinstance(self.body, bytes):
            return self.body
        return bytes(typestore().serialize_cdr(self.body, self.type))


def in_order(messages: Iterable[Msg]) -> list[Msg]:
    """The messages in the order in which a recorder writes them."""
    return sorted(messages, key=lambda message: message.log_time)


@dataclass(frozen=True)
class McapLayout:
    """The legal layouts of an MCAP file that differ for a reader."""

    chunk_size: int | None = 768 * 1024  # None: no chunks (the fastwrite preset)
    compression: CompressionType = CompressionType.NONE
    index_types: IndexType = IndexType.ALL
    repeat_channels: bool = True
    use_summary_offsets: bool = True
    use_statistics: bool = True
    profile: str = "ros2"
    finish: bool = True  # False: no footer, as a killed recorder leaves it
    definitions: bool = True  # False: empty schemas, as when the recorder finds no definition
    latched: frozenset[str] = field(default_factory=lambda: frozenset({"/tf_static"}))


def write_mcap(
    path: Path,
    messages: Iterable[Msg],
    layout: McapLayout | None = None,
    *,
    declared: Collection[tuple[str, str]] = (),
) -> Path:
    """Writes one MCAP split in the order given; `declared` adds (topic, type) without messages."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(mcap_content(messages, layout, declared=declared))
    return path


def mcap_content(
    messages: Iterable[Msg],
    layout: McapLayout | None = None,
    *,
    declared: Collection[tuple[str, str]] = (),
) -> bytes:
    """The content of such a split."""
    how, stream = layout or McapLayout(), BytesIO()
    writer = Writer(
        stream,
        chunk_size=how.chunk_size or 1024,
        compression=how.compression,
        index_types=how.index_types,
        repeat_channels=how.repeat_channels,
        use_chunking=how.chunk_size is not None,
        use_statistics=how.use_statistics,
        use_summary_offsets=how.use_summary_offsets,
    )
    writer.start(profile=how.profile, library="test")
    channels: dict[tuple[str, str], int] = {}
    schemas: dict[str, int] = {}

    def channel(topic: str, type_name: str) -> int:
        if (topic, type_name) not in channels:
            if type_name not in schemas:
                text = definition(type_name) if how.definitions else ""
                encoding = "ros2msg" if text else ""
                schemas[type_name] = writer.register_schema(type_name, encoding, text.encode())
            qos = TRANSIENT_LOCAL if topic in how.latched else VOLATILE
            channels[topic, type_name] = writer.register_channel(
                topic, "cdr", schemas[type_name], {"offered_qos_profiles": qos}
            )
        return channels[topic, type_name]

    for topic, type_name in declared:
        channel(topic, type_name)
    for sequence, message in enumerate(messages):
        writer.add_message(
            channel(message.topic, message.type),
            message.log_time,
            message.payload,
            message.published,
            sequence,
        )
    if how.finish:
        writer.finish()
    return stream.getvalue()


def write_splits(
    bag_dir: Path,
    messages: Iterable[Msg],
    split_s: float = 10.0,
    name: str = "rec",
    layout: McapLayout | None = None,
    *,
    dated: bool = False,
) -> None:
    """Writes a recording in splits of so many seconds; `dated`: each file as its last message."""
    for number, some in splits_of(messages, split_s).items():
        path = write_mcap(bag_dir / name / f"{name}_{number}.mcap", some, layout)
        if dated:
            set_mtime(path, some[-1].log_time)


def set_mtime(path: Path, ns: int) -> None:
    os.utime(path, ns=(ns, ns))


def splits_of(messages: Iterable[Msg], split_s: float) -> dict[int, list[Msg]]:
    """The messages of each split, in order, numbered from 1,784,000,000 s on."""
    splits: dict[int, list[Msg]] = {}
    for each in in_order(messages):
        number = int((each.log_time / 1e9 - 1_784_000_000) // split_s)
        splits.setdefault(number, []).append(each)
    return splits


def write_db3(
    path: Path,
    messages: Iterable[Msg],
    *,
    definitions: bool = True,
) -> Path:
    """Writes one sqlite3 split with rosbag2's schema version 4."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    base = sqlite3.connect(path)
    base.execute("PRAGMA synchronous=OFF")
    base.executescript(
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY,ros_distro TEXT NOT NULL);"
        "CREATE TABLE metadata(id INTEGER PRIMARY KEY,metadata_version INTEGER NOT NULL,"
        "metadata TEXT NOT NULL);"
        "CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,"
        "serialization_format TEXT NOT NULL,offered_qos_profiles TEXT NOT NULL,"
        "type_description_hash TEXT NOT NULL);"
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY,topic_type TEXT NOT NULL,"
        "encoding TEXT NOT NULL,encoded_message_definition TEXT NOT NULL,"
        "type_description_hash TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,"
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
        "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        "INSERT INTO schema VALUES (4, 'jazzy');"
    )
    topics: dict[tuple[str, str], int] = {}
    types: set[str] = set()
    for message in messages:
        key = (message.topic, message.type)
        if key not in topics:
            topics[key] = len(topics) + 1
            qos = TRANSIENT_LOCAL if message.topic == "/tf_static" else VOLATILE
            base.execute(
                "INSERT INTO topics VALUES (?,?,?,?,?,?)", (topics[key], *key, "cdr", qos, "")
            )
            if definitions and message.type not in types:
                types.add(message.type)
                base.execute(
                    "INSERT INTO message_definitions VALUES (?,?,?,?,?)",
                    (len(types), message.type, "ros2msg", definition(message.type), ""),
                )
        base.execute(
            "INSERT INTO messages(topic_id,timestamp,data) VALUES (?,?,?)",
            (topics[key], message.log_time, message.payload),
        )
    base.commit()
    base.close()
    return path


@cache
def definition(type_name: str) -> str:
    """The full ros2msg definition text, nested definitions included."""
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def make(type_name: str, **fields: object) -> object:
    """A message object; every field must be given."""
    build: Callable[..., object] = typestore().types[type_name]
    return build(**fields)


def stamp(ns: int) -> object:
    return make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)


def header(ns: int, frame_id: str) -> object:
    return make("std_msgs/msg/Header", stamp=stamp(ns), frame_id=frame_id)


def point(x: float, y: float, z: float = 0.0) -> object:
    return make("geometry_msgs/msg/Point", x=x, y=y, z=z)


def vector3(x: float, y: float = 0.0, z: float = 0.0) -> object:
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def quaternion(yaw: float) -> object:
    return make(
        "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)
    )


def twist(vx: float, wz: float) -> object:
    return make("geometry_msgs/msg/Twist", linear=vector3(vx), angular=vector3(0.0, 0.0, wz))


def odom(
    ns: int,
    x: float = 0.0,
    y: float = 0.0,
    yaw: float = 0.0,
    *,
    z: float = 0.0,
    vx: float = 0.0,
    wz: float = 0.0,
    topic: str = "/odom",
    log_time: int | None = None,
) -> Msg:
    """An Odometry message (odom -> base_link) stamped and, by default, logged at `ns`."""
    covariance = np.zeros(36)
    pose = make("geometry_msgs/msg/Pose", position=point(x, y, z), orientation=quaternion(yaw))
    body = make(
        "nav_msgs/msg/Odometry",
        header=header(ns, "odom"),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance", twist=twist(vx, wz), covariance=covariance
        ),
    )
    return Msg(topic, "nav_msgs/msg/Odometry", ns if log_time is None else log_time, body, ns)


def along_x(begin: int, seconds: float, *, mps: float = 0.0, hz: int = 1) -> list[Msg]:
    """The odometry of a robot that drives along x from 0 at a speed (m/s); 0 where it stands."""
    return [odom(begin + n * 10**9 // hz, n / hz * mps) for n in range(round(seconds * hz))]


def transform(
    ns: int, parent: str, child: str, xyz: tuple[float, float, float], yaw: float = 0.0
) -> object:
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(ns, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform", translation=vector3(*xyz), rotation=quaternion(yaw)
        ),
    )


def tf(ns: int, *transforms: object, topic: str = "/tf", log_time: int | None = None) -> Msg:
    body = make("tf2_msgs/msg/TFMessage", transforms=list(transforms))
    return Msg(topic, "tf2_msgs/msg/TFMessage", ns if log_time is None else log_time, body, ns)


def tf_of(
    ns: int,
    parent: str,
    child: str,
    xyz: tuple[float, float, float],
    yaw: float = 0.0,
    *,
    topic: str = "/tf",
    log_time: int | None = None,
) -> Msg:
    """A message of one transform."""
    return tf(ns, transform(ns, parent, child, xyz, yaw), topic=topic, log_time=log_time)


def text(ns: int, data: str, topic: str = "/chatter") -> Msg:
    return Msg(topic, "std_msgs/msg/String", ns, make("std_msgs/msg/String", data=data))


def boolean(ns: int, data: bool, topic: str = "/bumper") -> Msg:
    return Msg(topic, "std_msgs/msg/Bool", ns, make("std_msgs/msg/Bool", data=data))


def octets(ns: int, held: Iterable[int], topic: str = "/octets") -> Msg:
    """Bytes, which from 51 on are only summarised."""
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    data = np.array([*held], np.uint8)
    body = make("std_msgs/msg/UInt8MultiArray", layout=layout, data=data)
    return Msg(topic, "std_msgs/msg/UInt8MultiArray", ns, body)


def fix(
    ns: int, latitude: float = 48.0, longitude: float = 11.0, altitude: float = 0.0, status: int = 0
) -> Msg:
    """What a receiver of satellites says: in degrees and metres; the status -1 is no fix."""
    body = make(
        "sensor_msgs/msg/NavSatFix",
        header=header(ns, "gps"),
        status=make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )
    return Msg("/fix", "sensor_msgs/msg/NavSatFix", ns, body)


def log_entry(ns: int, level: int, name: str, message: str) -> Msg:
    """An entry of /rosout: 20 INFO, 30 WARN, 40 ERROR."""
    body = make(
        "rcl_interfaces/msg/Log",
        stamp=stamp(ns),
        level=level,
        name=name,
        msg=message,
        file="",
        function="",
        line=0,
    )
    return Msg("/rosout", "rcl_interfaces/msg/Log", ns, body)


def diagnostics(ns: int, **levels: tuple[int, str]) -> Msg:
    """A DiagnosticArray with a level and a message for each name."""
    statuses = [
        make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=name,
            message=message,
            hardware_id="",
            values=[],
        )
        for name, (level, message) in levels.items()
    ]
    body = make("diagnostic_msgs/msg/DiagnosticArray", header=header(ns, ""), status=statuses)
    return Msg("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", ns, body)


def tracked(ns: int, objects: Sequence[tuple[Mapping[int, float], float, float]]) -> Msg:
    """TrackedObjects of Autoware: the probability of each class, x and y of each object."""
    package = "autoware_perception_msgs/msg"
    point = partial(make, "geometry_msgs/msg/Point", z=0.0)
    turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    body = make(
        f"{package}/TrackedObjects",
        header=header(ns, "map"),
        objects=[
            make(
                f"{package}/TrackedObject",
                object_id=make("unique_identifier_msgs/msg/UUID", uuid=np.zeros(16, np.uint8)),
                existence_probability=0.9,
                classification=[
                    make(f"{package}/ObjectClassification", label=label, probability=probability)
                    for label, probability in classes.items()
                ],
                kinematics=make(
                    f"{package}/TrackedObjectKinematics",
                    pose_with_covariance=make(
                        "geometry_msgs/msg/PoseWithCovariance",
                        pose=make(
                            "geometry_msgs/msg/Pose", position=point(x=x, y=y), orientation=turn
                        ),
                        covariance=np.zeros(36),
                    ),
                ),
            )
            for classes, x, y in objects
        ],
    )
    return Msg("/perception/objects", f"{package}/TrackedObjects", ns, body)


def goals(ns: int, statuses: Mapping[int, int]) -> Msg:
    """A GoalStatusArray with the status of each goal: 2 executing, 4 succeeded, 6 aborted."""
    listed = []
    for number, status in statuses.items():
        uuid = np.array([0] * 15 + [number], dtype=np.uint8)
        goal_id = make("unique_identifier_msgs/msg/UUID", uuid=uuid)
        info = make("action_msgs/msg/GoalInfo", goal_id=goal_id, stamp=stamp(ns))
        listed.append(make("action_msgs/msg/GoalStatus", goal_info=info, status=status))
    body = make("action_msgs/msg/GoalStatusArray", status_list=listed)
    return Msg("/drive/_action/status", "action_msgs/msg/GoalStatusArray", ns, body)


def battery(ns: int, percentage: float, log_time: int | None = None, *, location: str = "") -> Msg:
    """A BatteryState that discharges; `percentage` is a fraction, as the message has it."""
    body = make(
        "sensor_msgs/msg/BatteryState",
        header=header(ns, ""),
        voltage=12.0,
        temperature=math.nan,
        current=-1.0,
        charge=math.nan,
        capacity=math.nan,
        design_capacity=math.nan,
        percentage=percentage,
        power_supply_status=2,
        power_supply_health=0,
        power_supply_technology=0,
        present=True,
        cell_voltage=np.array([], dtype=np.float32),
        cell_temperature=np.array([], dtype=np.float32),
        location=location,
        serial_number="",
    )
    logged = ns if log_time is None else log_time
    return Msg("/battery_state", "sensor_msgs/msg/BatteryState", logged, body)


def command(ns: int, vx: float, wz: float = 0.0, topic: str = "/cmd_vel") -> Msg:
    """A commanded velocity."""
    return Msg(topic, "geometry_msgs/msg/Twist", ns, twist(vx, wz))


def detections(
    ns: int,
    labels: Iterable[str],
    *,
    topic: str = "/vision/scene/scene_objects",
    at: tuple[float, float, float] = (1.0, 0.0, 0.0),
    score: float = 0.9,
) -> Msg:
    """A VisionDetectionArray in base_link with one detection for each label."""
    return detected(ns, [(label, score, at) for label in labels], topic=topic)


def detected(
    ns: int,
    things: Iterable[tuple[str, float, tuple[float, float, float]]],
    *,
    topic: str = "/vision/scene/scene_objects",
    frame: str = "base_link",
) -> Msg:
    """A VisionDetectionArray with a label, a score and a place for each detection."""
    kind = "ros2_vision_interfaces/msg/VisionDetection"
    bbox = np.array([10, 20, 100, 120], dtype=np.int32)
    found = [
        make(kind, label=label, score=score, point=point(*at), bbox=bbox)
        for label, score, at in things
    ]
    body = make(f"{kind}Array", header=header(ns, frame), skill="scene", detections=found)
    return Msg(topic, f"{kind}Array", ns, body)

"""Messages drawn at random as tables, and conditions drawn from what the messages say."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from random import Random
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ros2_memory.analysis.conditions import (
    Beyond,
    Condition,
    Contains,
    Equals,
    NearPosition,
    at_field,
    leaves,
    positions,
)
from ros2_memory.columns.decode import Group, _Kind, _Undecoded
from ros2_memory.columns.pack import pack
from ros2_memory.columns.plan import plan_of
from ros2_memory.columns.stored import Layout, StoredTable, columns_in, lazy_columns
from ros2_memory.columns.table import Column, Table, Texts
from ros2_memory.core.model import JsonValue
from ros2_memory.core.text import looks_like_json
from ros2_memory.storage.base import Batch, Channel, Record, Schema, batched
from ros2_memory.storage.cache import ByteLru
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import OTHER_ROBOTS, VISION_DEFINITIONS

VISION_MSGS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\n"
        "BoundingBox2D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nDetection2D[] detections\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\n"
        "BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}
UNMAPPED = {
    "own_msgs/msg/Seen": "string label\nstring class_name\nfloat32 confidence\nstring attributes\n",
    "own_msgs/msg/Guess": "string label\nfloat64 score\nint8 probability\n",
    "own_msgs/msg/Nested": "Seen seen\nGuess[] results\nSeen[] others\ngeometry_msgs/Point at\n",
    "own_msgs/msg/Axis": "string label\nuint32 size\nuint32 stride\nfloat32 score\n",
    "own_msgs/msg/Everything": (
        "bool flag\nbyte octet\nchar letter\nint64 big\nuint64 huge\nfloat32 single\nfloat64 real\n"
        "string text\nstring[] texts\nstring[2] pair\nbool[] flags\nbool[3] three\nuint8[4] bytes\n"
        "uint8[] data\nfloat64[] numbers\nfloat32[12] long\nint64[] bigs\nuint8[60] many\n"
        "builtin_interfaces/Time stamp\nbuiltin_interfaces/Duration[] lasted\n"
        "geometry_msgs/Quaternion turn\ngeometry_msgs/Quaternion[] turns\n"
        "geometry_msgs/Point[] points\ngeometry_msgs/Pose2D flat\ngeometry_msgs/Pose[] poses\n"
        "Nested[] nested\nAxis[] axes\nSeen seen\nstd_msgs/Empty empty\nstring class\n"
    ),
    "own_msgs/msg/Label": "string label\nfloat32 score\nfloat64 x\nfloat64 y\nfloat64 z\n",
    "own_msgs/msg/Posed": (
        "int32 class_id\nstring id\nfloat32 score\ngeometry_msgs/PoseStamped pose\nbool missing\n"
    ),
    "own_msgs/msg/PosedArray": "std_msgs/Header header\nPosed[] objects\n",
    # As in autoware_perception_msgs.
    "own_msgs/msg/Class": (
        "uint8 UNKNOWN=0\nuint8 CAR=1\nuint8 HAZARD=2\nuint8 label\nfloat32 probability\n"
    ),
    "own_msgs/msg/Motion": "geometry_msgs/PoseWithCovariance pose_with_covariance\n",
    "own_msgs/msg/Tracked": "Class[] classification\nMotion kinematics\n",
    "own_msgs/msg/TrackedArray": "std_msgs/Header header\nTracked[] objects\n",
}
MAPPED = (
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/TransformStamped",
    "geometry_msgs/msg/TwistStamped",
    "tf2_msgs/msg/TFMessage",
    "turtlesim/msg/Pose",
    "px4_msgs/msg/VehicleOdometry",
    "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/NavSatFix",
    "sensor_msgs/msg/JointState",
    "ros2_vision_interfaces/msg/VisionDetectionArray",
    "ros2_vision_interfaces/msg/StampedString",
    "vision_msgs/msg/Detection2DArray",
    "vision_msgs/msg/Detection3DArray",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rcl_interfaces/msg/Log",
    "std_msgs/msg/String",
    "std_msgs/msg/Bool",
    "std_msgs/msg/Int64",
    "std_msgs/msg/Float32",
)
OTHERS = (
    "own_msgs/msg/Everything",
    "own_msgs/msg/Nested",
    "own_msgs/msg/Label",
    "own_msgs/msg/PosedArray",
    "own_msgs/msg/TrackedArray",
    "aruco_opencv_msgs/msg/ArucoDetection",
    "sensor_msgs/msg/MagneticField",
    "nav_msgs/msg/OccupancyGrid",
    "visualization_msgs/msg/MarkerArray",
    "std_msgs/msg/Float64MultiArray",
    "sensor_msgs/msg/CompressedImage",
)
ROWS = 6

_WORDS = (
    *(
        "",
        " ",
        "cup",
        "Cup",
        "red cup",
        "STRASSE",
        "straße",
        "a\nb",
        "1",
        "0.5",
        "true",
        "null",
        "[",
    ),
    *("rgb8", "8UC4", "yuv422", "map", "[]", "{}"),
    '[{"label": "cup", "score": 0.2}, {"label": "fork", "score": 0.9}]',
    '{"detections": [{"class": "cup", "confidence": 0.5}], "text": "fork"}',
    '{"label": "gr\\u00f6\\u00dfer", "text": "say \\"hi\\""}',
    '{"label": "cup", "score": 0.3, "point": {"x": 1, "y": 2, "z": 0}}',
)
_REALS = (0.0, -0.0, 1.0, -1.0, 0.5, 0.3, 0.1, 0.7071067811865476, 2.5, 1e9, 1e-300, 1e200)
_ODD = (math.nan, math.inf, -math.inf)
_EXTENT = {"int8": 7, "byte": 7, "int16": 15, "int32": 31, "int64": 63}
_EXTENT_UNSIGNED = {"uint8": 8, "char": 8, "uint16": 16, "uint32": 32, "uint64": 64}


@cache
def store() -> Typestore:
    """The standard types, and those above."""
    found = get_typestore(Stores.ROS2_JAZZY)
    for name, text in {**VISION_DEFINITIONS, **OTHER_ROBOTS, **VISION_MSGS, **UNMAPPED}.items():
        found.register(get_types_from_msg(text, name))
    return found


@cache
def _channel(type_name: str) -> Channel:
    text = store().generate_msgdef(type_name, ros_version=2)[0]
    return Channel("/drawn", "cdr", Schema(type_name, "ros2msg", text.encode()))


@dataclass(frozen=True)
class Drawn:
    """A table, and its messages as any reader decodes them."""

    table: Table
    messages: list[object]

    @property
    def type(self) -> str:
        return self.table.channel.type


def table_of(records: Sequence[Record], reader: McapReader) -> Drawn:
    """Messages of one channel in the order of time, as a table."""
    definition = reader.definition(records[0].channel)
    assert definition is not None
    kind = _Kind(records[0].channel, definition, plan_of(definition), "", is_hashed=False)
    found: Iterator[Batch] = batched(enumerate(records))
    group = Group(reader)
    for batch in found:
        group.add(_Undecoded(kind, batch, 0))
    [table] = group.tables()
    return Drawn(table, [reader.decode(record) for record in records])


_READER = McapReader()


@dataclass(frozen=True, slots=True, eq=False)
class Stored(StoredTable):
    """A table as it comes out of the store, and the columns that were unpacked of it."""

    unpacked: set[str] = field(kw_only=True)


def stored(table: Table, step: float) -> Stored:
    """The table with floats rounded to a multiple of `step`; 0 for no rounding."""
    columns = dict(columns_in(table))
    packed = {path: pack(column) for path, column in columns.items()}
    unpacked: set[str] = set()
    for path, column in columns.items() if step else ():
        if not isinstance(column, Texts) and column.dtype.kind == "f":
            near = rounded(column, step)
            is_finite = np.isfinite(near)
            off = np.abs(near[is_finite] - column[is_finite].astype(np.float64))
            columns[path] = near
            packed[path] = replace(packed[path], error=float(off.max(initial=0.0)))

    def load(path: str) -> Column:
        if not path.endswith("#"):
            unpacked.add(path)
        return columns[path]

    made = {each.name: getattr(table, each.name) for each in fields(Table)}
    made["columns"], made["elements"] = lazy_columns(Layout.of(table), load, ())
    return Stored(**made, packed=packed.get, unpacked=unpacked, memory=ByteLru(0))


def rounded(numbers: Any, step: float) -> Any:
    """Finite numbers as multiples of a step, if it is not 0; others as they are."""
    numbers = numbers.astype(np.float64)
    with np.errstate(all="ignore"):
        near = np.round(numbers / step) * step if step else numbers
    return np.where(np.isfinite(near), near, numbers)


@st.composite
def drawn_tables(draw: DrawFn, types: Sequence[str] = (*MAPPED, *OTHERS)) -> Drawn:
    """Some messages of a type as a table."""
    type_name = draw(st.sampled_from(types))
    random = draw(st.randoms(use_true_random=False))
    is_odd = draw(st.booleans())
    count = draw(st.integers(1, ROWS))
    messages = [message(type_name, random, is_odd=is_odd) for _ in range(count)]
    return drawn_of(type_name, messages)


def drawn_of(type_name: str, messages: Sequence[object]) -> Drawn:
    """These messages, one each nanosecond, as a table."""
    payloads = [bytes(store().serialize_cdr(each, type_name)) for each in messages]
    records = [Record(_channel(type_name), at, at, payload) for at, payload in enumerate(payloads)]
    return table_of(records, _READER)


def message(type_name: str, random: Random, *, is_odd: bool = True) -> object:
    """A message with values that tests look for; `is_odd`: NaN and infinities among them."""
    return message_in(store(), type_name, random, is_odd=is_odd)


def message_in(
    types: Typestore,
    type_name: str,
    random: Random,
    *,
    is_odd: bool = True,
    longest: int | None = None,
) -> object:
    """As `message`, of a type in a store, with sequences that have so many elements at most."""

    def value(drawn: Any) -> object:
        node, about = drawn
        if node == Nodetype.BASE:
            return _scalar(about[0], random, is_odd)
        if node == Nodetype.NAME:
            if about == "geometry_msgs/msg/Quaternion":
                return _quaternion(random)
            return message_in(types, about, random, is_odd=is_odd, longest=longest)
        element, size = about
        is_named = element[0] == Nodetype.NAME
        if node == Nodetype.SEQUENCE:
            most = longest if longest is not None else 3 if is_named else 10
            size = min(random.choice([0, 1, 1, 2, 3, 10]), size or 10, most)
        values = [value(element) for _ in range(size)]
        if is_named or element[1][0] in {"string", "wstring"}:
            return values
        kind = {"byte": "int8", "char": "uint8"}.get(element[1][0], element[1][0])
        return np.array(values, dtype=kind)

    build: Any = types.types[type_name]
    return build(*(value(each) for _, each in types.fielddefs[type_name][1]))


def _scalar(kind: str, random: Random, is_odd: bool) -> object:
    if kind == "bool":
        return random.random() < 0.5
    if kind in {"string", "wstring"}:
        return random.choice(_WORDS)
    if kind in {"float32", "float64"}:
        reals = _REALS + _ODD if is_odd else _REALS
        number = random.choice(reals) if random.random() < 0.7 else random.gauss(0, 2)
        if kind == "float32":
            with np.errstate(over="ignore"):
                return float(np.float32(number))
        return number
    bits = _EXTENT.get(kind) or _EXTENT_UNSIGNED[kind]
    least = -(2**bits) if kind in _EXTENT else 0
    pool = [0, 1, 2, 3, 2**53 + 1, 2**bits - 1, least, least + 1]
    return random.choice([number for number in pool if least <= number < 2**bits])


def _quaternion(random: Random) -> object:
    half = math.sqrt(0.5)
    parts = random.choice(
        [
            (0.0, 0.0, 0.0, 1.0),
            (0.0, 0.0, 0.0, 0.0),
            (0.0, half, 0.0, half),  # gimbal lock
            (0.0, 0.0, 1.0, 0.0),
            (math.nan, 0.0, 0.0, 1.0),
            (1e200, 0.0, 0.0, 1e200),
            # Longer than what stored parts are rounded by: else it has no angles any more.
            *[tuple(random.choice((-1, 1)) * random.uniform(0.1, 1) for _ in range(4))] * 4,
            (0.0, 0.0, math.sin(0.4), math.cos(0.4)),
        ]
    )
    build: Any = store().types["geometry_msgs/msg/Quaternion"]
    return build(*parts)


def paths_of(value: JsonValue, path: str = "") -> Iterator[str]:
    """The dot-paths of a value, through lists with and without a place, or a selected element."""
    if isinstance(value, dict):
        for name, inner in value.items():
            below = f"{path}.{name}" if path else name
            yield below
            yield from paths_of(inner, below)
    elif isinstance(value, list) and value:
        yield from paths_of(value[0], path)
        for place in (0, len(value) - 1, -1):
            if path:
                yield f"{path}.{place}"
                yield from paths_of(value[place], f"{path}.{place}")
        for name, own in value[-1].items() if path and isinstance(value[-1], dict) else ():
            shown = json.dumps(own) if isinstance(own, int) else own
            if isinstance(shown, str) and "]" not in shown and not looks_like_json(shown):
                yield f"{path}[{name}={shown}]"
                yield from paths_of(value[-1], f"{path}[{name}={shown}]")


def condition_on(values: Sequence[JsonValue], random: Random) -> Condition:
    """A condition that some of the values meet, or nearly."""
    value = random.choice(values)
    paths = [*dict.fromkeys(paths_of(value))]
    selecting = [path for path in paths if "=" in path]
    paths = selecting if selecting and random.random() < 0.3 else paths
    field = random.choice(paths) if paths and random.random() < 0.75 else None
    if field is not None and random.random() < 0.05:
        field += random.choice([".nothing", ".1", ".-3"])
    targets = [value] if field is None else at_field(value, field)
    min_score = random.choice([0.0, 0.0, 0.2, 0.3, 0.5, 0.9])
    if random.random() < 0.2:
        return Condition(_near(targets, random), field, min_score)
    found = [leaf for target in targets for leaf in leaves(target)]
    default: list[JsonValue] = [1.5, "cup", True, 0]
    leaf = random.choice(found or default)
    return Condition(_test(leaf, random), field, min_score)


def _near(targets: Sequence[JsonValue], random: Random) -> NearPosition:
    found = [place for target in targets for place in positions(target)]
    place = random.choice(found) if found else (0.0, 0.0, 0.0)
    x, y, z = (axis if math.isfinite(axis) else 0.0 for axis in place)
    off = random.choice([0.0, 0.0, 0.1, 1.0])
    tolerance = random.choice([0.0, off, 0.5, 1.0, 10.0, math.inf])
    return NearPosition(x + off, y, random.choice([None, z]), tolerance)


def _part_of(text: str, random: Random) -> str:
    begin = random.randrange(max(len(text), 1))
    return text[begin : begin + random.randint(1, 8)] or "x"


def _test(leaf: Any, random: Random) -> Contains | Equals | Beyond:
    if leaf is None or (isinstance(leaf, float) and math.isnan(leaf)):
        leaf = 0
    needles: list[Any]
    if isinstance(leaf, str):
        part = _part_of(leaf, random)
        needles = [leaf, leaf.upper(), part, f"{part}q"]
    elif isinstance(leaf, bool):
        needles = [leaf, str(leaf), int(leaf)]
    else:
        near = [leaf, leaf + 1, leaf * (1 + 1e-12), leaf / 2, str(leaf)]
        needles = [leaf, float(leaf), *near, 10**400]
    needle = random.choice(needles)
    kind = random.choice(["contains", "equals", "above", "below"])
    if kind in {"above", "below"}:
        return Beyond(0.5 if isinstance(needle, str | bool) else needle, kind == "above")
    if kind == "equals":
        return Equals(needle)
    if not isinstance(needle, str) or random.random() < 0.5:
        return Contains(needle if str(needle).strip() else "cup")
    held, other = needle.strip() or "cup", random.choice(["cup", "x", _part_of(str(leaf), random)])
    return Contains(random.choice([held, held, f"{held} -{other}"]), whole=True)

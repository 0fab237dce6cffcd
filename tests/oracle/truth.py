"""What a folder of bags holds, read whole and without an index.

Nothing here imports the package: `mcap` walks the records of a file in their order with every CRC
checked, `sqlite3` reads the table of messages row by row, `rosbags` decodes, numpy and scipy
calculate. Times are nanoseconds since the Unix epoch, lengths metres.
"""

import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation, Slerp  # type: ignore[import-untyped]

SLACK_NS: Final = 1_000
"""A time in float seconds lies up to half a microsecond beside its nanoseconds."""
EARLY_NS: Final = 2 * SLACK_NS
"""A message may lie so far before the start of a window that has it.

Replies round the time of a message up to whole microseconds. A window from that time on has this
message, which is up to a microsecond older, as well as what the float of seconds adds.
"""

STATIC: Final = ("/tf_static",)
SELDOM_NS: Final = 5 * 10**9
TIMES: Final = ("builtin_interfaces/msg/Duration", "builtin_interfaces/msg/Time")
QUATERNION: Final = "geometry_msgs/msg/Quaternion"
ANGLES: Final = ("roll_deg", "pitch_deg", "yaw_deg")
"""As which replies show a quaternion: rotations about the fixed axes x, y and z, one by one."""
ADDED: Final = ("__msgtype__", "structure_needs_at_least_one_member")
"""What rosbags and the generator of empty messages add."""


@dataclass(frozen=True)
class Row:
    """One recorded message."""

    topic: str
    type: str
    log_ns: int
    body: Any


@dataclass
class Topic:
    """The messages of one topic by log time; rows of one time keep the order of their file."""

    name: str
    rows: list[Row]
    transient_local: bool = False

    @property
    def latched(self) -> bool:
        """Whether its newest message holds at any age: what is published seldom, for latecomers."""
        if self.name in STATIC:
            return True
        if not self.transient_local or self.rows[0].type == "rcl_interfaces/msg/Log":
            return False
        span = int(self.times[-1] - self.times[0])
        return len(self.rows) == 1 or span / (len(self.rows) - 1) >= SELDOM_NS

    @cached_property
    def times(self) -> NDArray[np.int64]:
        """The log times (ns), ascending."""
        return np.array([row.log_ns for row in self.rows], dtype=np.int64)

    def newest(self, at: int, tolerance: int) -> list[Row]:
        """The newest message at or before `at`, no older than `tolerance`, with all of its time."""
        last = int(np.searchsorted(self.times, at, side="right")) - 1
        if last < 0 or self.times[last] < at - tolerance:
            return []
        return [row for row in self.rows if row.log_ns == self.times[last]]

    def within(self, start: int, end: int) -> list[Row]:
        """The messages of `[start, end]`."""
        first, after = np.searchsorted(self.times, [start, end + 1])
        return self.rows[int(first) : int(after)]

    def bounds(self, start: int, end: int) -> tuple[list[Row], list[Row]]:
        """The messages that every answer about `[start, end]` has, and those that it may have."""
        surely = self.within(start + SLACK_NS, end - SLACK_NS)
        # A float of seconds in 2026 is exact to 0.25 us.
        return surely, self.within(start - EARLY_NS, end + SLACK_NS + 250)


@dataclass
class Edge:
    """The transforms of one frame in its parent, by stamp."""

    parent: str
    child: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    values: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=list)

    def at(self, stamp: int) -> tuple[NDArray[np.float64], Rotation] | None:
        """Translation and rotation: linear and spherical interpolation, as tf2's; None outside."""
        order = np.argsort(np.array(self.stamps), kind="stable")
        stamps = np.array(self.stamps, dtype=np.int64)[order]
        if self.static:
            shift, turn = self.values[int(order[-1])]
            return shift, Rotation.from_quat(turn)
        if not len(stamps) or stamp < stamps[0] or stamp > stamps[-1]:
            return None
        after = int(np.searchsorted(stamps, stamp))
        if stamps[after] == stamp:
            shift, turn = self.values[int(order[after])]
            return shift, Rotation.from_quat(turn)
        (a, qa), (b, qb) = (self.values[int(order[each])] for each in (after - 1, after))
        part = (stamp - int(stamps[after - 1])) / int(stamps[after] - stamps[after - 1])
        turned = Slerp([0.0, 1.0], Rotation.from_quat([qa, qb]))([part])[0]
        return a + part * (b - a), turned

    def neighbours_apart(self, stamp: int) -> float:
        """How far apart (s) the transforms around a stamp are; 0 where it needs only one."""
        if self.static:
            return 0.0
        stamps = np.sort(np.array(self.stamps, dtype=np.int64))
        after = int(np.searchsorted(stamps, stamp))
        if after in {0, len(stamps)} or stamps[after] == stamp:
            return 0.0
        return float(stamps[after] - stamps[after - 1]) / 1e9


class History:
    """Every decodable message below a folder."""

    def __init__(self, folder: Path) -> None:
        rows: dict[str, list[Row]] = {}
        self.transient_local: set[str] = set()
        self.undecodable: set[str] = set()
        self.counts: dict[str, int] = {}
        for path in sorted(folder.rglob("*")):
            if path.suffix == ".mcap":
                found = self._mcap(path)
            elif path.suffix == ".db3":
                found = self._db3(path)
            else:
                continue
            for row in found:
                rows.setdefault(row.topic, []).append(row)
        self.topics = {
            name: Topic(
                name, sorted(each, key=lambda row: row.log_ns), name in self.transient_local
            )
            for name, each in rows.items()
        }

    @property
    def start(self) -> int:
        """The earliest log time."""
        return min(int(each.times[0]) for each in self.topics.values())

    @property
    def end(self) -> int:
        """The latest log time."""
        return max(int(each.times[-1]) for each in self.topics.values())

    def _mcap(self, path: Path) -> Iterator[Row]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        stores: dict[int, Typestore | None] = {}
        with path.open("rb") as stream:
            records = StreamReader(stream, validate_crcs=True).records
            while True:
                try:
                    record = next(records)
                except (StopIteration, McapError):
                    return
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                    if "durability: transient_local" in str(record.metadata) or (
                        "durability: 1" in str(record.metadata)
                    ):
                        self.transient_local.add(record.topic)
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    schema = schemas[channel.schema_id]
                    if schema.id not in stores:
                        stores[schema.id] = _store(schema.name, schema.data.decode())
                    store = stores[schema.id]
                    row = self._row(store, channel.topic, schema.name, record.log_time, record.data)
                    if row is not None:
                        yield row

    def _db3(self, path: Path) -> Iterator[Row]:
        base = sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)
        try:
            texts = dict(
                base.execute(
                    "SELECT topic_type, encoded_message_definition FROM message_definitions"
                )
            )
            topics = {
                number: (name, kind, qos)
                for number, name, kind, qos in base.execute(
                    "SELECT id, name, type, offered_qos_profiles FROM topics"
                )
            }
            stores = {kind: _store(kind, texts.get(kind, "")) for _, kind, _ in topics.values()}
            self.transient_local |= {
                name for name, _, qos in topics.values() if "durability: transient_local" in qos
            }
            for number, at, data in base.execute(
                "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY rowid"
            ):
                name, kind, _ = topics[number]
                row = self._row(stores[kind], name, kind, at, data)
                if row is not None:
                    yield row
        finally:
            base.close()

    def _row(
        self, store: Typestore | None, topic: str, kind: str, at: int, data: bytes
    ) -> Row | None:
        self.counts[topic] = self.counts.get(topic, 0) + 1
        if store is None:
            self.undecodable.add(topic)
            return None
        return Row(topic, kind, at, store.deserialize_cdr(data, kind))

    # -- what questions need ------------------------------------------------------------------

    def scalars(self, topic: str, *, as_shown: bool = False) -> dict[str, type]:
        """The paths of a topic's booleans, numbers and texts that are not inside a list.

        `as_shown`: as replies convert them, a time to seconds and a quaternion to angles.
        """
        found: dict[str, type] = {}
        _walk(self.topics[topic].rows[0].body, "", found, as_shown=as_shown)
        return found

    def edges(self, topics: Sequence[tuple[str, bool]]) -> dict[str, Edge]:
        """By child frame, its transforms on `(topic, is it static)`."""
        found: dict[str, Edge] = {}
        for name, static in topics:
            for row in self.topics[name].rows if name in self.topics else ():
                for each in row.body.transforms:
                    child = each.child_frame_id
                    edge = found.setdefault(child, Edge(each.header.frame_id, child, static))
                    stamp = each.header.stamp
                    move, turn = each.transform.translation, each.transform.rotation
                    edge.stamps.append(stamp.sec * 10**9 + stamp.nanosec)
                    edge.values.append(
                        (
                            np.array([move.x, move.y, move.z]),
                            np.array([turn.x, turn.y, turn.z, turn.w]),
                        )
                    )
        return found


def path_of(body: Any, path: str) -> Any:
    """The part of a decoded message at a dot-path of `History.scalars`."""
    for name in path.split("."):
        body = _angle(body, name) if name in ANGLES else getattr(body, name)
    return _seconds(body) if getattr(body, "__msgtype__", None) in TIMES else body


def _angle(turn: Any, name: str) -> float:
    """One of the angles (degrees) whose rotations about fixed x, y and z make up a quaternion.

    NaN where it is none, as of a message that nobody filled in.
    """
    length = math.hypot(turn.x, turn.y, turn.z, turn.w)
    if not 0 < length < math.inf:
        return math.nan
    x, y, z, w = turn.x / length, turn.y / length, turn.z / length, turn.w / length
    if name == "roll_deg":
        return math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    if name == "pitch_deg":
        return math.degrees(math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0)))
    return math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _seconds(time: Any) -> float:
    return float(time.sec + time.nanosec / 1e9)


def planar(rows: Sequence[Row]) -> NDArray[np.float64]:
    """x and y (m) of Odometry messages, one row each."""
    where = [row.body.pose.pose.position for row in rows]
    return np.array([[each.x, each.y] for each in where]).reshape(-1, 2)


def _walk(body: Any, path: str, found: dict[str, type], *, as_shown: bool) -> None:
    kind = getattr(body, "__msgtype__", None)
    if as_shown and kind == QUATERNION:
        found.update((f"{path}{angle}", float) for angle in ANGLES)
        return
    if as_shown and kind in TIMES:
        found[path.removesuffix(".")] = float
        return
    for each in fields(body):
        if each.name.isupper() or each.name in ADDED:
            continue  # a constant, or nothing of the message's own
        name, value = f"{path}{each.name}", getattr(body, each.name)
        if is_dataclass(value):
            _walk(value, f"{name}.", found, as_shown=as_shown)
        elif isinstance(value, bool | int | float | str):
            found[name] = type(value)


def _store(kind: str, text: str) -> Typestore | None:
    """The types of one definition text; the standard ones where there is none; None: unknown."""
    store = get_typestore(Stores.ROS2_JAZZY)
    if text:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(text, kind))
    return store if kind in store.types else None

"""Messages into plain values, by a map of dot-paths for each message type.

The schema map (`config/message_schemas.yaml`) names, for a type, the fields that a reply shows
and the path at which each stands in the message. Some names have a meaning. A pose is read from
`position` and `orientation`, from `translation` and `rotation`, or from `x`, `y`, `z` and a heading
in radians (`theta`, `yaw` or `heading`); a twist from `linear_velocity` and `angular_velocity`; a
place on the Earth in degrees from `latitude`, `longitude` and `altitude`; `pose_frame` and
`velocity_frame` are PX4's numbers of frames. Types that are not in the map are shown with all
their fields.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import ConfigError, InvalidArgumentsError
from ros2_memory.core.model import (
    Geodetic,
    JsonValue,
    Pose,
    StampedTransform,
    Transform,
    Twist,
)
from ros2_memory.messages.conversions import (
    Metric,
    ValueKind,
    euler,
    kind_of,
    nanoseconds,
    rotation,
    unit,
    view,
    xyz,
    xyzw,
)
from ros2_memory.messages.fields import (
    ABSENT,
    Route,
    Segments,
    descend,
    names_of,
    parse_path,
)
from ros2_memory.messages.to_json import MAX_SQUEEZE, ExactJson, Rendering, ReplyJson

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.model import Quaternion, Vector3
    from ros2_memory.core.timebase import Ns

MAX_SHOWN_CHARS: Final = 20_000
"""A shown value longer than this would fill a reply alone, and is thinned harder."""

_LISTED_NAMES: Final = 40
_NOWHERE: Final = Route("")


@dataclass(frozen=True, slots=True)
class Extracted:
    """A value as it leaves, and sentences on what was left out of it."""

    value: JsonValue
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Point:
    """A pose as a point and a rotation; `arrays`: they may be arrays, as PX4 writes them."""

    position: Route
    orientation: Route
    arrays: bool = False

    def of(self, message: object) -> tuple[Vector3, Quaternion | None] | None:
        node = self.position.of(message)
        where = xyz(node)
        if where is None and self.arrays:
            where = _triple(node)
        if where is None:
            return None
        turned = self.orientation.of(message)
        turn = rotation(turned)
        return where, _px4_rotation(turned) if turn is None and self.arrays else turn


@dataclass(frozen=True, slots=True)
class _Planar:
    """A pose as x, y, perhaps z (m; 0 without one) and a heading (rad) in fields of their own."""

    x: Route
    y: Route
    z: Route
    heading: Route

    def of(self, message: object) -> tuple[Vector3, Quaternion | None] | None:
        x, y = _number(self.x.of(message)), _number(self.y.of(message))
        if x is None or y is None:
            return None
        z, heading = _number(self.z.of(message)), _number(self.heading.of(message))
        if heading is None or not math.isfinite(heading):
            return (x, y, z or 0.0), None
        return (x, y, z or 0.0), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


@dataclass(frozen=True, slots=True)
class _Plan:
    """What the schema map says of one type, compiled. Poses and twists are tried in order."""

    fields: tuple[tuple[str, Segments], ...]
    poses: tuple[_Point | _Planar, ...]
    twists: tuple[tuple[Route, Route], ...]
    geodetic: tuple[Route, Route, Route] | None = None
    pose_frame: Route | None = None
    velocity_frame: Route | None = None

    def path(self, name: str) -> Segments | None:
        """The path of a field."""
        return next((path for field, path in self.fields if field == name), None)


def _pair(*segments: str, of: tuple[str, str]) -> tuple[Route, Route]:
    return Route(*segments, of[0]), Route(*segments, of[1])


_HEADINGS: Final = ("theta", "yaw", "heading")
_UNMAPPED: Final = _Plan(
    fields=(),
    poses=tuple(
        _Point(*_pair(*prefix, of=("position", "orientation")))
        for prefix in (("pose", "pose"), ("pose",), ())
    ),
    twists=tuple(
        _pair(*prefix, of=("linear", "angular")) for prefix in (("twist", "twist"), ("twist",))
    ),
)
_FRAME: Final = Route("header", "frame_id")
_CHILD_FRAME: Final = Route("child_frame_id")
_STAMP: Final = Route("header", "stamp")
_TRANSFORMS: Final = Route("transforms")
_TRANSLATION: Final = Route("transform", "translation")
_ROTATION: Final = Route("transform", "rotation")
_POINTS: Final = frozenset({"position", "linear_velocity", "angular_velocity"})
_POSE_FRAMES: Final = {1: "NED", 2: "FRD"}
_VELOCITY_FRAMES: Final = {**_POSE_FRAMES, 3: "body FRD"}
"""The constants of px4_msgs/msg/VehicleOdometry."""


class SchemaExtractor:
    """Reads decoded messages: ROS messages by the schema map, JSON as what it says.

    Args:
        schemas: for each message type, the name of each field and its dot-path.
        max_array_length: the most elements of any array, and bytes of any byte array, in a value
            that is shown.
        max_chars: how long one shown value may be, as JSON text, before it is thinned harder.

    Raises:
        ConfigError: a field's name or path is malformed, or a limit is below 1.
    """

    def __init__(
        self,
        schemas: Mapping[str, Mapping[str, str]],
        max_array_length: int,
        *,
        max_chars: int = MAX_SHOWN_CHARS,
    ) -> None:
        if max_array_length < 1:
            raise ConfigError(f"max_array_length is {max_array_length}; it must be at least 1")
        self._limit = max_array_length
        self._max_chars = max_chars
        self._plans = {name: _compile(name, fields) for name, fields in schemas.items()}

    def exact(self, message: object, type_name: str) -> JsonValue:
        """The whole extracted value, neither thinned nor rounded: what conditions are tested on.

        NaN and infinities stay; angles are in degrees, times in seconds. Byte arrays longer than
        the limit, and the data of images, point clouds and maps, are summaries here too, and what
        lies deeper than 24 levels (JSON alone can) is null.
        """
        return self._whole(ExactJson(self._limit), message, type_name)

    def exact_at(self, message: object, type_name: str, path: str) -> JsonValue:
        """What `shown` means by one of its `fields`, exactly; null where this message has none."""
        found = self._sought(message, type_name, path)
        return None if found is ABSENT else ExactJson(self._limit).value(found, path)

    def shown(self, message: object, type_name: str, fields: Sequence[str] = ()) -> Extracted:
        """The value as it leaves in a reply: strict JSON, thinned and rounded, with notes.

        Args:
            message: the decoded message.
            type_name: its type.
            fields: dot-paths that narrow the value; it is then an object keyed by them. A path
                means the extracted value's own field, or else the full path in the message.

        Raises:
            InvalidArgumentsError: a path of `fields` leads nowhere; says what there is.
        """
        nodes = {path: self._find(message, type_name, path) for path in fields}
        limit, squeeze = self._limit, 1
        while True:
            rendering = ReplyJson(limit, squeeze)
            value: JsonValue = (
                {path: rendering.value(node, path) for path, node in nodes.items()}
                if nodes
                else self._whole(rendering, message, type_name)
            )
            fits = len(json.dumps(value, separators=(",", ":"))) <= self._max_chars
            if fits or (limit == 1 and squeeze >= MAX_SQUEEZE):
                return Extracted(value, rendering.notes)
            limit, squeeze = max(limit // 2, 1), squeeze * 2

    def pose(self, message: object, type_name: str) -> Pose | None:
        """The pose that a message carries, in its header's frame; None where it carries none.

        By the schema map's names; for a type that is not in the map, by a point at
        `pose.pose.position`, `pose.position` or `position`, or by `x`, `y` and a heading.
        Coordinates are as they stand, NaN included.
        """
        plan = self._plan(type_name)
        for route in plan.poses:
            found = route.of(message)
            if found is not None:
                frame = _text(_FRAME.of(message)) or _frame(plan.pose_frame, message, _POSE_FRAMES)
                return Pose(*found, frame)
        return _headed(message) if plan is _UNMAPPED else None

    def geodetic(self, message: object, type_name: str) -> Geodetic | None:
        """The place on the Earth that a message carries; None where it carries none."""
        routes = self._plan(type_name).geodetic
        if routes is None:
            return None
        latitude, longitude, altitude = (_number(route.of(message)) for route in routes)
        if latitude is None or longitude is None:
            return None
        above = math.nan if altitude is None else altitude
        return Geodetic(latitude, longitude, above, _text(_FRAME.of(message)))

    def kinds_of(self, type_name: str) -> frozenset[str]:
        """What messages of a mapped type carry: `position`, `velocity`, `geodetic`."""
        plan = self._plan(type_name)
        if plan is _UNMAPPED:
            return frozenset()
        has = {
            "position": any(not _is_bare(route) for route in plan.poses),
            "velocity": bool(plan.twists),
            "geodetic": plan.geodetic is not None,
        }
        return frozenset(kind for kind, carried in has.items() if carried)

    def twist(self, message: object, type_name: str) -> Twist | None:
        """The velocity that a message carries; None where it carries none.

        By the schema map's `linear_velocity` and `angular_velocity`; for a type that is not in the
        map, by vectors at `twist.twist` or `twist`. It is expressed in the child frame where the
        message names one (nav_msgs/Odometry), otherwise in the header's frame.
        """
        plan = self._plan(type_name)
        for linear, angular in plan.twists:
            ahead, turning = linear.of(message), angular.of(message)
            along, about = xyz(ahead), xyz(turning)
            if along is None and plan is not _UNMAPPED:
                along, about = _velocity(ahead, 0), _velocity(turning, 2)
            if along is not None and about is not None:
                frame = _text(_CHILD_FRAME.of(message)) or _text(_FRAME.of(message))
                numbered = _frame(plan.velocity_frame, message, _VELOCITY_FRAMES)
                return Twist(along, about, frame or numbered)
        return None

    def frame(self, message: object) -> str:
        """The frame in a message's header; empty where it has none."""
        return _text(_FRAME.of(message))

    def stamp(self, message: object) -> Ns | None:
        """The time in a message's header; None where it has none."""
        return nanoseconds(_STAMP.of(message))

    def transforms(
        self, message: object, log_time: Ns, *, static: bool
    ) -> tuple[StampedTransform, ...]:
        """The edges of a tf2_msgs/TFMessage, rotations normalised, frames without leading slash.

        Left out, as tf2's buffer refuses them: an edge without a frame name or from a frame to
        itself, and one whose numbers are not finite or whose quaternion is zero.
        """
        listed = _TRANSFORMS.of(message)
        if not isinstance(listed, list):
            return ()
        edges = (_edge(one, log_time, static=static) for one in listed)
        return tuple(edge for edge in edges if edge is not None)

    def _plan(self, type_name: str) -> _Plan:
        plan = self._plans.get(type_name)
        if plan is None and type_name.count("/") == 1:  # as recorders before 2019 wrote it
            plan = self._plans.get(type_name.replace("/", "/msg/"))
        return _UNMAPPED if plan is None else plan

    def _whole(self, rendering: Rendering, message: object, type_name: str) -> JsonValue:
        plan = self._plan(type_name)
        nodes = [(name, _meant(name, _at(message, path))) for name, path in plan.fields]
        absent = [name for name, node in nodes if node is ABSENT]
        for name in absent:
            rendering.say("absent", name, f"{name}: this message has no such field")
        if len(absent) == len(nodes):
            return rendering.value(message, "")
        return {name: rendering.value(node, name) for name, node in nodes}

    def _find(self, message: object, type_name: str, path: str) -> object:
        found = self._sought(message, type_name, path)
        if found is ABSENT:
            plan = self._plan(type_name)
            raise InvalidArgumentsError(_no_such_field(type_name, path, plan, message))
        return found

    def _sought(self, message: object, type_name: str, path: str) -> object:
        """What stands at one of `fields` in a message, or `ABSENT`."""
        plan = self._plan(type_name)
        segments = tuple(path.split("."))
        mapped = plan.path(segments[0])
        if mapped is not None:
            found = descend(_meant(segments[0], _at(message, mapped)), segments[1:], view)
        else:
            found = ABSENT if plan.fields else descend(message, segments, view)
        return _plain(_at(message, segments)) if found is ABSENT else found


def _compile(type_name: str, fields: Mapping[str, str]) -> _Plan:
    paths: dict[str, Segments] = {}
    for name, path in fields.items():
        segments = parse_path(path)
        if segments is None or not name or "." in name:
            raise ConfigError(
                f"message schema {type_name}: {name}: {path!r} is not a dot-path of a message; "
                "give field names joined by dots, such as pose.pose.position"
            )
        paths[name] = segments
    return _Plan(
        fields=tuple(paths.items()),
        poses=_poses(paths),
        twists=((_route(paths, "linear_velocity"), _route(paths, "angular_velocity")),)
        if paths.keys() >= {"linear_velocity", "angular_velocity"}
        else (),
        geodetic=(
            _route(paths, "latitude"),
            _route(paths, "longitude"),
            _route(paths, "altitude"),
        )
        if paths.keys() >= {"latitude", "longitude"}
        else None,
        pose_frame=_route(paths, "pose_frame") if "pose_frame" in paths else None,
        velocity_frame=_route(paths, "velocity_frame") if "velocity_frame" in paths else None,
    )


def _poses(paths: Mapping[str, Segments]) -> tuple[_Point | _Planar, ...]:
    if "position" in paths:
        return (_Point(_route(paths, "position"), _route(paths, "orientation"), arrays=True),)
    if paths.keys() >= {"translation", "rotation"}:
        return (_Point(_route(paths, "translation"), _route(paths, "rotation")),)
    if paths.keys() >= {"x", "y"}:
        heading = next((name for name in _HEADINGS if name in paths), "heading")
        return (_Planar(*(_route(paths, name) for name in ("x", "y", "z", heading))),)
    return ()


def _route(paths: Mapping[str, Segments], name: str) -> Route:
    return Route(*paths[name]) if name in paths else _NOWHERE


def _is_bare(route: _Point | _Planar) -> bool:
    """Whether it leads to a point without an orientation, such as one that somebody clicked."""
    return isinstance(route, _Point) and route.orientation is _NOWHERE


def _headed(message: object) -> Pose | None:
    """The pose of a message that has x, y and a heading in radians as fields of its own."""
    names = names_of(message) if not isinstance(message, list) else ()
    heading = next((name for name in _HEADINGS if name in names), None)
    if heading is None:
        return None
    found = _Planar(Route("x"), Route("y"), Route("z"), Route(heading)).of(message)
    return None if found is None else Pose(*found, _text(_FRAME.of(message)))


def _number(node: object) -> float | None:
    if isinstance(node, bool) or not isinstance(node, int | float | np.number):
        return None
    try:
        return float(node)
    except (OverflowError, TypeError):
        return None


def _numbers(node: object, count: int) -> list[float] | None:
    """The numbers of an array of so many."""
    if not isinstance(node, list | np.ndarray) or len(node) != count:
        return None
    numbers = [_number(part) for part in node]
    return [part for part in numbers if part is not None] if None not in numbers else None


def _triple(node: object) -> Vector3 | None:
    numbers = _numbers(node, 3)
    return None if numbers is None else (numbers[0], numbers[1], numbers[2])


def _px4_rotation(node: object) -> Quaternion | None:
    """The unit quaternion of an array in PX4's order: w, x, y, z."""
    numbers = _numbers(node, 4)
    return None if numbers is None else unit((numbers[1], numbers[2], numbers[3], numbers[0]))


def _velocity(node: object, axis: int) -> Vector3 | None:
    """A velocity as an array, or as one number: along or about this axis."""
    one = _number(node)
    if one is None:
        return _triple(node)
    return (one, 0.0, 0.0) if axis == 0 else (0.0, 0.0, one)


def _frame(route: Route | None, message: object, named: Mapping[int, str]) -> str:
    number = None if route is None else _number(route.of(message))
    return "" if number is None else named.get(int(number), "")


def _meant(name: str, node: object) -> object:
    """What stands under a name of the schema map: an array as the point or rotation that it is."""
    if not isinstance(node, np.ndarray):
        return node
    if name in _POINTS:
        point = _triple(node)
        return node if point is None else dict(zip("xyz", map(Metric, point), strict=True))
    if name == "orientation" and len(node) == 4:
        turn = _px4_rotation(node)
        return None if turn is None else euler(dict(zip("xyzw", turn, strict=True)))
    return node


def _at(message: object, path: Segments) -> object:
    found = descend(message, path, view)
    return descend(message, path) if found is ABSENT else found


def _plain(node: object) -> object:
    """A node that was named by its full path: a quaternion so named is wanted as x, y, z, w."""
    if isinstance(node, list):
        return [_plain(one) for one in node]
    numbers = xyzw(node) if kind_of(node) is ValueKind.QUATERNION else None
    return node if numbers is None else dict(zip("xyzw", numbers, strict=True))


def _no_such_field(type_name: str, path: str, plan: _Plan, message: object) -> str:
    standing = names_of(message)
    more = len(standing) - _LISTED_NAMES
    listed = ", ".join(standing[:_LISTED_NAMES]) + (f" and {more} more" if more > 0 else "")
    if not plan.fields:
        there = f"its fields are: {listed}" if listed else "it has no fields"
        return f"{type_name} has no field {path!r}; {there}"
    shown = ", ".join(name for name, _ in plan.fields)
    return (
        f"{type_name} has no field {path!r}; its fields are: {shown}; "
        f"or give a full path in the message, which begins with one of: {listed}"
    )


def _text(node: object) -> str:
    return node if isinstance(node, str) else ""


def _edge(node: object, log_time: Ns, *, static: bool) -> StampedTransform | None:
    parent = _text(_FRAME.of(node)).removeprefix("/")
    child = _text(_CHILD_FRAME.of(node)).removeprefix("/")
    stamp = nanoseconds(_STAMP.of(node))
    translation, turn = xyz(_TRANSLATION.of(node)), rotation(_ROTATION.of(node))
    if not child or parent == child or stamp is None:
        return None
    if translation is None or turn is None or not _finite(translation):
        return None
    return StampedTransform(parent, child, stamp, log_time, Transform(translation, turn), static)


def _finite(vector: Vector3) -> bool:
    return all(part - part == 0 for part in vector)

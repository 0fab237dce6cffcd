"""Extracts plain values from messages, by a map of dot-paths for each message type.

The schema map (`config/message_schemas.yaml`) names, for a type, the fields that a reply shows
and the path of each in the message. Some names have a meaning. A pose is read from `position` and
`orientation`, from `translation` and `rotation`, or from `x`, `y`, `z` and a heading in radians
(`theta`, `yaw` or `heading`); a twist from `linear_velocity` and `angular_velocity`; a position on
the Earth in degrees from `latitude`, `longitude` and `altitude`; `pose_frame` and `velocity_frame`
are PX4's numbers of frames. Types that are not in the map are shown with all their fields.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import ConfigError, InvalidArgumentsError
from ros2_memory.core.model import (
    Geodetic,
    JsonValue,
    Pose,
    Quaternion,
    StampedTransform,
    Transform,
    Twist,
    Vector3,
)
from ros2_memory.core.text import listed
from ros2_memory.messages.conversions import (
    ABSENT,
    ANGLES,
    Metric,
    Route,
    Segments,
    ValueKind,
    descend,
    euler,
    field_table_of_class,
    kind_of,
    names_beside,
    names_of,
    nanoseconds,
    number,
    parse_path,
    quadruple,
    rotation,
    summaries_of,
    triple,
    unit,
    view,
    xyz,
    xyzw,
)
from ros2_memory.messages.to_json import MAX_SQUEEZE, ExactJson, ReplyJson

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from ros2_memory.core.timebase import Ns

MAX_SHOWN_CHARS: Final = 20_000
"""A longer value would fill a reply alone, and is thinned harder."""

_LISTED_NAMES: Final = 40
_TURNS: Final = ("orientation", "rotation")
"""Fields in which a quaternion is shown as angles."""
_AS_JSON: Final = json.JSONEncoder(separators=(",", ":")).encode


@dataclass(frozen=True, slots=True)
class Extracted:
    """A value for a reply, sentences on what was left out of it, and its JSON in ASCII."""

    value: JsonValue
    notes: tuple[str, ...]
    text: str


@dataclass(frozen=True, slots=True)
class PointPose:
    """Reads a pose from a point and a rotation; PX4 writes them as arrays, if `arrays`."""

    position: Route
    orientation: Route
    arrays: bool = False

    def of(self, message: object) -> tuple[Vector3, Quaternion | None] | None:
        """Returns position and rotation in a message; None where it has no position."""
        place, turned = self.position.of(message), self.orientation.of(message)
        position, turn = xyz(place), rotation(turned)
        if self.arrays:
            position = triple(place) if position is None else position
            turn = _px4_rotation(turned) if turn is None else turn
        return None if position is None else (position, turn)


@dataclass(frozen=True, slots=True)
class PlanarPose:
    """Reads a pose from x, y, perhaps z (m; 0 without one) and a heading (rad).

    Where the heading `is_needed`, a message that has no such field has no pose.
    """

    x: Route
    y: Route
    z: Route
    heading: Route
    is_needed: bool = False

    def of(self, message: object) -> tuple[Vector3, Quaternion | None] | None:
        """Returns position and rotation in a message; None where it has no position."""
        x, y = number(self.x.of(message)), number(self.y.of(message))
        if x is None or y is None:
            return None
        turned = self.heading.of(message)
        if turned is ABSENT and self.is_needed:
            return None
        z, heading = number(self.z.of(message)), number(turned)
        if heading is None or not math.isfinite(heading):
            return (x, y, z or 0.0), None
        return (x, y, z or 0.0), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


@dataclass(frozen=True, slots=True)
class Plan:
    """The compiled schema map of one type. Poses, twists and latitudes are tried in order."""

    fields: Mapping[str, Segments]
    poses: tuple[PointPose | PlanarPose, ...]
    twists: tuple[tuple[Route, Route], ...]
    geodetic: tuple[tuple[Route, ...], ...] = ()
    pose_frame: Route | None = None
    velocity_frame: Route | None = None


_NOWHERE: Final = Route("")
_HEADINGS: Final = ("theta", "yaw", "heading")
UNMAPPED: Final = Plan(
    fields={},
    poses=(
        *(
            PointPose(Route(*prefix, "position"), Route(*prefix, "orientation"))
            for prefix in (("pose", "pose"), ("pose",), ())
        ),
        *(PlanarPose(Route("x"), Route("y"), Route("z"), Route(name), True) for name in _HEADINGS),
    ),
    twists=tuple(
        (Route(*prefix, "linear"), Route(*prefix, "angular"))
        for prefix in (("twist", "twist"), ("twist",))
    ),
    geodetic=tuple(
        (*(Route(*prefix, name) for name in names), Route("status", "status"))
        for prefix in ((), ("position",), ("pose", "position"))
        for names in (("latitude", "longitude", "altitude"), ("lat", "lon", "alt"))
    ),
)
"""For a type that is not in the schema map."""
FRAME: Final = Route("header", "frame_id")
_CHILD_FRAME: Final = Route("child_frame_id")
_STAMP: Final = Route("header", "stamp")
_TRANSFORMS: Final = Route("transforms")
_STRAIGHT: Final[dict[tuple[type, Segments], Callable[[object], object] | None]] = {}
_MAX_STRAIGHT: Final = 4096
"""Getters of `_straight` by class and path."""
_TRANSLATION: Final = Route("transform", "translation")
_ROTATION: Final = Route("transform", "rotation")
POINTS: Final = frozenset({"position", "linear_velocity", "angular_velocity"})
"""Names of the schema map under which an array of three numbers is shown as x, y and z."""
POSE_FRAMES: Final = {1: "NED", 2: "FRD"}
_VELOCITY_FRAMES: Final = {**POSE_FRAMES, 3: "body FRD"}
"""The constants of px4_msgs/msg/VehicleOdometry."""


class SchemaExtractor:
    """Extracts values from decoded messages: ROS messages by the schema map, JSON by its own names.

    Args:
        schemas: for each message type, the name of each field and its dot-path.
        max_array_length: the most elements of any array, and bytes of any byte array, in a value
            that is shown.
        max_chars: how long one shown value may be, as JSON text, before it is thinned harder.

    Attributes:
        limit: see `max_array_length`.
        schemas: as given.

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
        self.limit = max_array_length
        self.schemas = schemas
        self._max_chars = max_chars
        self._plans = {name: _compile(name, fields) for name, fields in schemas.items()}

    def exact(self, message: object, type_name: str) -> JsonValue:
        """Returns the whole extracted value, neither thinned nor rounded, for conditions.

        NaN and infinities stay; angles are in degrees, times in seconds. Byte arrays longer than
        the limit, and the data of images, point clouds and maps, are summaries here too, and what
        lies deeper than 24 levels (JSON alone can) is null.
        """
        return self._whole(ExactJson(self.limit), message, type_name)

    def exact_at(self, message: object, type_name: str, path: str) -> JsonValue:
        """Returns one of the `fields` of `shown`, exactly; null where this message has none."""
        node = self._find(message, type_name, path)
        return None if node is ABSENT else ExactJson(self.limit).value(node, path)

    def shown(self, message: object, type_name: str, fields: Sequence[str] = ()) -> Extracted:
        """Returns the value for a reply: strict JSON, thinned and rounded, with notes.

        Args:
            message: the decoded message.
            type_name: its type.
            fields: dot-paths that narrow the value; it is then an object keyed by them. A path
                means the extracted value's own field, or else the full path in the message.

        Raises:
            InvalidArgumentsError: there is no such field; the sentence lists those there are.
        """
        nodes = {path: self._find(message, type_name, path) for path in fields}
        for path, node in nodes.items():
            if node is ABSENT:
                plan = self.plan(type_name)
                raise InvalidArgumentsError(_no_such_field(type_name, path, plan, message))
        limit, squeeze = self.limit, 1
        while True:
            rendering = ReplyJson(limit, squeeze)
            value: JsonValue = (
                {path: rendering.value(node, path) for path, node in nodes.items()}
                if nodes
                else self._whole(rendering, message, type_name)
            )
            text = _AS_JSON(value)
            if len(text) <= self._max_chars or (limit == 1 and squeeze >= MAX_SQUEEZE):
                return Extracted(value, rendering.notes, text)
            limit, squeeze = max(limit // 2, 1), squeeze * 2

    def pose(self, message: object, type_name: str) -> Pose | None:
        """Returns the pose of a message, in its header's frame; None where it has none.

        By the schema map's names; for a type that is not in the map, by a point at
        `pose.pose.position`, `pose.position` or `position`, or by `x`, `y` and a heading.
        Coordinates are those of the message, NaN included.
        """
        plan = self.plan(type_name)
        for route in plan.poses:
            pose = route.of(message)
            if pose is not None:
                px4_frame = _px4_frame(plan.pose_frame, message, POSE_FRAMES)
                return Pose(*pose, _text(FRAME.of(message)) or px4_frame)
        return None

    def geodetic(self, message: object, type_name: str) -> Geodetic | None:
        """Returns the position on the Earth of a message; None where it has none.

        By the schema map's names; for a type that is not in the map, by `latitude` and `longitude`,
        or `lat` and `lon`, in the message, its `position` or `pose.position`, unless these numbers
        cannot be degrees.
        """
        plan = self.plan(type_name)
        for routes in plan.geodetic:
            latitude, longitude, altitude, status = (number(route.of(message)) for route in routes)
            if latitude is None or longitude is None:
                continue
            if plan is UNMAPPED and (abs(latitude) > 90 or abs(longitude) > 360):
                continue
            above = math.nan if altitude is None else altitude
            has_fix = status is None or status >= 0
            return Geodetic(latitude, longitude, above, _text(FRAME.of(message)), has_fix)
        return None

    def own_path(self, path: str, type_name: str) -> str:
        """Returns a full path in a message as one in its extracted value.

        Such as `position.x` for `pose.pose.position.x` of an odometry. A path that no mapped field
        leads to is returned as it is, and so is one that begins with the name of another one.
        """
        fields, segments = self.plan(type_name).fields, tuple(path.split("."))
        leading = [
            (len(mapped), name)
            for name, mapped in fields.items()
            if segments[: len(mapped)] == mapped
            and (name == segments[0] or segments[0] not in fields)
        ]
        if not leading:
            return path
        length, name = max(leading)
        return ".".join((name, *segments[length:]))

    def fields_of(self, type_name: str) -> Mapping[str, Segments]:
        """Returns the fields that the schema map names, with their paths; none if it has none."""
        return self.plan(type_name).fields

    def is_mapped(self, type_name: str) -> bool:
        """Returns whether the schema map lists a type; what any other carries its messages show."""
        return self.plan(type_name) is not UNMAPPED

    def kinds_of(self, type_name: str) -> frozenset[str]:
        """Returns what messages of a mapped type have: `position`, `velocity`, `geodetic`."""
        plan = self.plan(type_name)
        if plan is UNMAPPED:
            return frozenset()
        has = {
            # Not a point without an orientation, such as one that somebody clicked.
            "position": any(
                isinstance(route, PlanarPose) or route.orientation is not _NOWHERE
                for route in plan.poses
            ),
            "velocity": bool(plan.twists),
            "geodetic": bool(plan.geodetic),
        }
        return frozenset(kind for kind, is_there in has.items() if is_there)

    def twist(self, message: object, type_name: str) -> Twist | None:
        """Returns the velocity of a message; None where it has none.

        By the schema map's `linear_velocity` and `angular_velocity`; for a type that is not in the
        map, by vectors at `twist.twist` or `twist`. It is expressed in the child frame where the
        message names one (nav_msgs/Odometry), otherwise in the header's frame.
        """
        plan = self.plan(type_name)
        for linear, angular in plan.twists:
            moving, turning = linear.of(message), angular.of(message)
            along, about = xyz(moving), xyz(turning)
            if along is None and plan is not UNMAPPED:
                along, about = _velocity(moving, 0), _velocity(turning, 2)
            if along is not None and about is not None:
                frame = _text(_CHILD_FRAME.of(message)) or _text(FRAME.of(message))
                px4_frame = _px4_frame(plan.velocity_frame, message, _VELOCITY_FRAMES)
                return Twist(along, about, frame or px4_frame)
        return None

    def frame(self, message: object) -> str:
        """Returns the frame in a message's header; empty where it has none."""
        return _text(FRAME.of(message))

    def stamp(self, message: object) -> Ns | None:
        """Returns the stamp (ns) in a message's header; None where it has none."""
        return nanoseconds(_STAMP.of(message))

    def transforms(
        self, message: object, log_time: Ns, *, static: bool
    ) -> tuple[StampedTransform, ...]:
        """Returns the edges of a TFMessage, rotations normalised, frames without leading slash.

        Left out, as tf2's buffer refuses them: an edge without a frame name or from a frame to
        itself, and one whose numbers are not finite or whose quaternion is zero.
        """
        listed = _TRANSFORMS.of(message)
        if not isinstance(listed, list):
            return ()
        edges = (_edge(transform, log_time, static=static) for transform in listed)
        return tuple(edge for edge in edges if edge is not None)

    def plan(self, type_name: str) -> Plan:
        """Returns the compiled schema map of a type; `UNMAPPED` where it is not in the map."""
        plan = self._plans.get(type_name)
        if plan is None and type_name.count("/") == 1:  # as recorders before 2019 wrote it
            plan = self._plans.get(type_name.replace("/", "/msg/"))
        return UNMAPPED if plan is None else plan

    def _whole(self, rendering: ExactJson, message: object, type_name: str) -> JsonValue:
        plan = self.plan(type_name)
        nodes = [(name, _converted(name, _at(message, path))) for name, path in plan.fields.items()]
        absent = [name for name, node in nodes if node is ABSENT]
        for name in absent:
            rendering.note("absent", name, f"{name}: this message has no such field")
        if len(absent) == len(nodes):
            return rendering.value(message, "")
        return {name: rendering.value(node, name) for name, node in nodes}

    def _find(self, message: object, type_name: str, path: str) -> object:
        """Returns what is at a path in a message, or `ABSENT`.

        By the name that the schema map has for it; in a type that it does not map, as the message
        is shown; else by the path of the message's own fields.
        """
        plan = self.plan(type_name)
        segments = tuple(path.split("."))
        mapped, node = plan.fields.get(segments[0]), ABSENT
        if mapped is not None:
            node = descend(_converted(segments[0], _at(message, mapped)), segments[1:], view)
        elif not plan.fields:
            node = descend(message, segments, view)
        if node is ABSENT:
            node = _plain(_at(message, segments))
        return self._named(message, type_name, path) if node is ABSENT else node

    def _named(self, message: object, type_name: str, path: str) -> object:
        """Returns what an array has for a name in the list beside it, as `positions.elbow`.

        Null where the list has other names, `ABSENT` where there is none.
        """
        head, _, name = path.partition(".")
        value = self._whole(ExactJson(self.limit), message, type_name)
        names = names_beside(value, path)
        array = value.get(head) if isinstance(value, dict) and names else None
        if not isinstance(array, list):
            return ABSENT
        at = names.index(name) if name in names else len(array)
        return array[at] if at < len(array) else None


def _compile(type_name: str, fields: Mapping[str, str]) -> Plan:
    paths: dict[str, Segments] = {}
    for name, path in fields.items():
        segments = parse_path(path)
        if segments is None or not name or "." in name:
            raise ConfigError(
                f"message schema {type_name}: {name}: {path!r} is not a dot-path of a message; "
                "give field names joined by dots, such as pose.pose.position"
            )
        paths[name] = segments

    def route(name: str) -> Route:
        return Route(*paths[name]) if name in paths else _NOWHERE

    has_twist = paths.keys() >= {"linear_velocity", "angular_velocity"}
    has_geodetic = paths.keys() >= {"latitude", "longitude"}
    return Plan(
        fields=paths,
        poses=_poses(paths.keys(), route),
        twists=((route("linear_velocity"), route("angular_velocity")),) if has_twist else (),
        geodetic=(tuple(map(route, ("latitude", "longitude", "altitude", "fix_status"))),)
        if has_geodetic
        else (),
        pose_frame=route("pose_frame") if "pose_frame" in paths else None,
        velocity_frame=route("velocity_frame") if "velocity_frame" in paths else None,
    )


def _poses(
    names: Collection[str], route: Callable[[str], Route]
) -> tuple[PointPose | PlanarPose, ...]:
    if "position" in names:
        return (PointPose(route("position"), route("orientation"), arrays=True),)
    if "translation" in names and "rotation" in names:
        return (PointPose(route("translation"), route("rotation")),)
    if "x" in names and "y" in names:
        heading = next((name for name in _HEADINGS if name in names), "heading")
        return (PlanarPose(route("x"), route("y"), route("z"), route(heading)),)
    return ()


def _px4_rotation(node: object) -> Quaternion | None:
    """Returns the unit quaternion of an array in PX4's order: w, x, y, z."""
    numbers = quadruple(node)
    return None if numbers is None else unit((*numbers[1:], numbers[0]))


def _velocity(node: object, axis: int) -> Vector3 | None:
    """Returns a velocity that is an array, or one number: along or about this axis."""
    component = number(node)
    if component is None:
        return triple(node)
    return (component, 0.0, 0.0) if axis == 0 else (0.0, 0.0, component)


def _px4_frame(route: Route | None, message: object, named: Mapping[int, str]) -> str:
    frame = None if route is None else number(route.of(message))
    return "" if frame is None or not math.isfinite(frame) else named.get(int(frame), "")


def _converted(name: str, node: object) -> object:
    """Returns the value of a name of the schema map: an array as the point or rotation it is."""
    if not isinstance(node, np.ndarray):
        return node
    if name in POINTS:
        point = triple(node)
        return node if point is None else dict(zip("xyz", map(Metric, point), strict=True))
    if name == "orientation" and len(node) == 4:
        turn = _px4_rotation(node)
        return None if turn is None else euler(dict(zip("xyzw", turn, strict=True)))
    return node


def _at(message: object, path: Segments) -> object:
    key = (type(message), path)
    if key not in _STRAIGHT:
        if len(_STRAIGHT) >= _MAX_STRAIGHT:
            _STRAIGHT.clear()
        _STRAIGHT[key] = _straight(message, path)
    straight = _STRAIGHT[key]
    if straight is not None:
        return straight(message)
    node = descend(message, path, view)
    return descend(message, path) if node is ABSENT else node


def _straight(message: object, path: Segments) -> Callable[[object], object] | None:
    """Returns a quick getter of a path in messages of this class; None where fields are converted.

    A definition fixes the classes of all fields, so what holds for one message holds for all.
    """
    attributes, node = [], message
    for name in path:
        cls: type = type(node)
        table = field_table_of_class(cls)
        is_plain = table is not None and kind_of(node) is ValueKind.PLAIN
        if table is None or not is_plain or name in summaries_of(table):
            return None
        attribute = table.attributes.get(name)
        if attribute is None:
            return None
        attributes.append(attribute)
        node = getattr(node, attribute)
    return attrgetter(".".join(attributes))


def _plain(node: object) -> object:
    """Returns a node that was asked for by its full path: a quaternion then stays x, y, z, w."""
    if isinstance(node, list):
        return [_plain(element) for element in node]
    numbers = xyzw(node) if kind_of(node) is ValueKind.QUATERNION else None
    return node if numbers is None else dict(zip("xyzw", numbers, strict=True))


def _no_such_field(type_name: str, path: str, plan: Plan, message: object) -> str:
    names = names_of(message)
    fields = listed(names, at_most=_LISTED_NAMES)
    if not plan.fields:
        what_it_has = f"its fields are: {fields}" if names else "it has no fields"
        return f"{type_name} has no field {path!r}; {what_it_has}"
    turned = [f"{name}.{path}" for name in plan.fields if path in ANGLES and name in _TURNS]
    meant = f" (did you mean {turned[0]}?)" if turned else ""
    return (
        f"{type_name} has no field {path!r}{meant}; its fields are: {', '.join(plan.fields)}; "
        f"or give a full path in the message, which begins with one of: {fields}"
    )


def _text(node: object) -> str:
    return node if isinstance(node, str) else ""


def _edge(node: object, log_time: Ns, *, static: bool) -> StampedTransform | None:
    parent = _text(FRAME.of(node)).removeprefix("/")
    child = _text(_CHILD_FRAME.of(node)).removeprefix("/")
    stamp = nanoseconds(_STAMP.of(node))
    translation, turn = xyz(_TRANSLATION.of(node)), rotation(_ROTATION.of(node))
    if not child or parent == child or stamp is None:
        return None
    if translation is None or turn is None or not all(map(math.isfinite, translation)):
        return None
    return StampedTransform(parent, child, stamp, log_time, Transform(translation, turn), static)

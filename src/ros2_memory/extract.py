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
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

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
from ros2_memory.core.text import listed, looks_like_json
from ros2_memory.messages.conversions import (
    ABSENT,
    ANGLES,
    Metric,
    Route,
    Segments,
    ValueKind,
    descend,
    euler_of,
    layout_of,
    layout_of_class,
    names_beside,
    names_of,
    nanoseconds,
    number,
    own_path,
    parse_path,
    quadruple,
    rotation,
    segments_of,
    triple,
    unit,
    view,
    xyz,
    xyzw,
)
from ros2_memory.messages.detections import parsed_json
from ros2_memory.messages.to_json import MAX_SQUEEZE, ExactJson, ReplyJson

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from ros2_memory.core.timebase import Ns

MAX_SHOWN_CHARS: Final = 20_000
"""A longer value would fill a reply alone, and is thinned harder."""

NOWHERE: Final[Vector3] = (math.nan,) * 3
"""The position (m) of a null pose."""
AT_ORIGIN_M: Final = 0.000_05
"""A coordinate up to this is 0 in the store."""

_LISTED_NAMES: Final = 40
_TURNS: Final = ("orientation", "rotation")
"""Fields in which a quaternion is shown as angles."""
_AS_JSON: Final = json.JSONEncoder(separators=(",", ":")).encode


class TextAbove(NamedTuple):
    """A text into which a dot-path leads, and the rest of the path."""

    text: str
    below: list[str]

    @property
    def is_json(self) -> bool:
        """Whether it may be JSON."""
        return looks_like_json(self.text)


@dataclass(frozen=True, slots=True)
class Extracted:
    """A value for a reply.

    Attributes:
        value: the value.
        notes: sentences on what was left out of it.
        text: the value as JSON in ASCII.
    """

    value: JsonValue
    notes: tuple[str, ...]
    text: str


@dataclass(frozen=True, slots=True)
class PointPose:
    """Reads a pose from a point and a rotation.

    Attributes:
        position: where the point is.
        orientation: where the rotation is.
        arrays: whether both may be arrays, as PX4 writes them.
    """

    position: Route
    orientation: Route
    arrays: bool = False

    def of(self, message: object) -> tuple[Vector3, Quaternion | None] | None:
        """Returns position (m) and rotation in a message; None if it has no position.

        A null pose, as of a camera's odometry that lost track, is at `NOWHERE`.
        """
        point_node, turn_node = self.position.of(message), self.orientation.of(message)
        position, turn = xyz(point_node), rotation(turn_node)
        if self.arrays:
            position = triple(point_node) if position is None else position
            turn = _px4_rotation(turn_node) if turn is None else turn
        if position is None:
            return None
        return (
            (NOWHERE, None) if turn is None and _is_null(position, turn_node) else (position, turn)
        )


@dataclass(frozen=True, slots=True)
class PlanarPose:
    """Reads a pose from x, y, perhaps z (m; 0 without one) and a heading (rad).

    Attributes:
        x: where x is; likewise y and z.
        heading: where the heading is.
        is_needed: whether a message without a field for the heading has no pose.
    """

    x: Route
    y: Route
    z: Route
    heading: Route
    is_needed: bool = False

    def of(self, message: object) -> tuple[Vector3, Quaternion | None] | None:
        """Returns position (m) and rotation in a message; None if it has no position."""
        x, y = number(self.x.of(message)), number(self.y.of(message))
        if x is None or y is None:
            return None
        heading_node = self.heading.of(message)
        if heading_node is ABSENT and self.is_needed:
            return None
        z, heading = number(self.z.of(message)), number(heading_node)
        if heading is None or not math.isfinite(heading):
            return (x, y, z or 0.0), None
        return (x, y, z or 0.0), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


@dataclass(frozen=True, slots=True)
class GeodeticPosition:
    """Reads a position on the Earth.

    Attributes:
        latitude: where the latitude is (degrees); likewise longitude and altitude (m).
        status: where the status of the fix is; a lower one than `least` is none.
        orientation: where the rotation from east, north and up is.
    """

    latitude: Route
    longitude: Route
    altitude: Route
    status: Route
    orientation: Route
    least: int = field(default=0, kw_only=True)


@dataclass(frozen=True, slots=True)
class Plan:
    """The compiled schema map of one type.

    Attributes:
        fields: the path of each field that is shown.
        poses: ways to read a pose, the first choice first.
        twists: the paths of linear and angular velocities, the first choice first.
        geodetic: ways to read a position on the Earth, the first choice first.
        pose_frame: the path of PX4's number of the pose's frame.
        velocity_frame: the path of PX4's number of the velocity's frame.
    """

    fields: Mapping[str, Segments]
    poses: tuple[PointPose | PlanarPose, ...]
    twists: tuple[tuple[Route, Route], ...]
    geodetic: tuple[GeodeticPosition, ...] = ()
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
    geodetic=(
        *(
            GeodeticPosition(
                Route(*prefix, latitude),
                Route(*prefix, longitude),
                Route(*prefix, altitude),
                Route("status", "status"),
                Route(*prefix[:-1], "orientation"),
            )
            for prefix in ((), ("position",), ("pose", "position"))
            for latitude, longitude, altitude in (
                ("latitude", "longitude", "altitude"),
                ("lat", "lon", "alt"),
            )
        ),
        GeodeticPosition(  # as PX4's SensorGps has them; 0 and 1 are no fix
            *map(
                Route,
                ("latitude_deg", "longitude_deg", "altitude_msl_m", "fix_type", "orientation"),
            ),
            least=2,
        ),
    ),
)
"""For a type that is not in the schema map."""
FRAME: Final = Route("header", "frame_id")
_CHILD_FRAME: Final = Route("child_frame_id")
_STAMP: Final = Route("header", "stamp")
_TRANSFORMS: Final = Route("transforms")
_MOST_GETTERS: Final = 4096
_TRANSLATION: Final = Route("transform", "translation")
_ROTATION: Final = Route("transform", "rotation")
POINTS: Final = frozenset({"position", "linear_velocity", "angular_velocity"})
"""Names of the schema map under which an array of three numbers is shown as x, y and z."""
POSE_FRAMES: Final = {1: "NED", 2: "FRD"}
_VELOCITY_FRAMES: Final = {**POSE_FRAMES, 3: "body FRD"}
"""The constants of px4_msgs/msg/VehicleOdometry."""
FRAMES_OF_TYPES: Final = {"px4_msgs/msg/VehicleLocalPosition": "NED"}
"""The frames of poses that a type's definition gives, while its messages name none."""


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
        # By class and path.
        self._getters: dict[tuple[type, Segments], Callable[[object], object] | None] = {}

    def exact(self, message: object, type_name: str) -> JsonValue:
        """Returns the whole extracted value, neither thinned nor rounded, for conditions.

        NaN and infinities stay; angles are in degrees, times in seconds. Byte arrays longer than
        the limit, and the data of images, point clouds and maps, are summaries here too, and what
        lies deeper than 24 levels (JSON alone can) is null.
        """
        return self._whole(ExactJson(self.limit), message, type_name)

    def exact_at(self, message: object, type_name: str, path: str) -> JsonValue:
        """Returns a field, found as by `shown`, neither thinned nor rounded; null if absent."""
        node = self._find(message, type_name, path)
        return None if node is ABSENT else ExactJson(self.limit).value(node, path)

    def shown(self, message: object, type_name: str, fields: Sequence[str] = ()) -> Extracted:
        """Returns the value for a reply: strict JSON, thinned and rounded, with notes.

        Args:
            message: the decoded message.
            type_name: its type.
            fields: dot-paths that narrow the value; it is then an object keyed by them. A path
                means the extracted value's own field, or else the full path in the message, and
                may go on into a text of JSON: null, with a note, if this text lacks the key.

        Raises:
            InvalidArgumentsError: there is no such field; the sentence lists those there are.
        """
        nodes = {path: self._find(message, type_name, path) for path in fields}
        absent = [path for path, node in nodes.items() if node is ABSENT]
        for path in absent:
            if not self.text_above(message, type_name, path).is_json:
                self.require(message, type_name, path)
        limit, squeeze = self.limit, 1
        while True:
            rendering = ReplyJson(limit, squeeze)
            _note_absent(rendering, absent)
            value: JsonValue = (
                {path: rendering.value(node, path) for path, node in nodes.items()}
                if nodes
                else self._whole(rendering, message, type_name)
            )
            text = _AS_JSON(value)
            if len(text) <= self._max_chars or (limit == 1 and squeeze >= MAX_SQUEEZE):
                return Extracted(value, rendering.notes, text)
            limit, squeeze = max(limit // 2, 1), squeeze * 2

    def require(self, message: object, type_name: str, path: str) -> None:
        """Checks that a message, or a text of JSON in it, has a field.

        Raises:
            InvalidArgumentsError: it has not; the sentence lists the fields that there are.
        """
        if self._find(message, type_name, path) is ABSENT:
            plan = self.plan(type_name)
            raise InvalidArgumentsError(_no_such_field(type_name, path, plan, message))

    def text_above(self, message: object, type_name: str, path: str) -> TextAbove:
        """Returns the text, such as one of JSON, into which a path leads; "" without one."""
        segments = segments_of(path)
        for nth in range(1, len(segments)):
            text = self._member(message, type_name, ".".join(segments[:nth]))
            if isinstance(text, str):
                return TextAbove(text, segments[nth:])
        return TextAbove("", [])

    def pose(self, message: object, type_name: str) -> Pose | None:
        """Returns the pose of a message (m), in its header's frame; None if it has none.

        It is read by the schema map's names; for a type that is not in the map, from a point at
        `pose.pose.position`, `pose.position` or `position`, or from `x`, `y` and a heading.
        Coordinates are those of the message, NaN included.
        """
        plan = self.plan(type_name)
        for route in plan.poses:
            pose = route.of(message)
            if pose is not None:
                px4_frame = _px4_frame(plan.pose_frame, message, POSE_FRAMES)
                frame = px4_frame or FRAMES_OF_TYPES.get(type_name, "")
                return Pose(*pose, self.frame(message) or frame)
        return None

    def geodetic(self, message: object, type_name: str) -> Geodetic | None:
        """Returns the position of a message on the Earth (degrees, m); None if it has none.

        It is read by the schema map's names; for a type that is not in the map, from `latitude` and
        `longitude`, or `lat` and `lon`, in the message, its `position` or `pose.position`, or from
        `latitude_deg` and `longitude_deg`, unless these numbers cannot be degrees.
        """
        plan = self.plan(type_name)
        for place in plan.geodetic:
            routes = (place.latitude, place.longitude, place.altitude, place.status)
            latitude, longitude, altitude, status = (number(route.of(message)) for route in routes)
            if latitude is None or longitude is None:
                continue
            if plan is UNMAPPED and (abs(latitude) > 90 or abs(longitude) > 360):
                continue
            altitude_m = math.nan if altitude is None else altitude
            has_fix = status is None or status >= place.least
            turn = rotation(place.orientation.of(message))
            return Geodetic(latitude, longitude, altitude_m, self.frame(message), has_fix, turn)
        return None

    def own_path(self, path: str, type_name: str) -> str:
        """Returns a full path in a message as a path in its extracted value; see `own_path`."""
        return own_path(path, self.plan(type_name).fields)

    def fields_of(self, type_name: str) -> Mapping[str, Segments]:
        """Returns the fields that the schema map has for a type, with their paths."""
        return self.plan(type_name).fields

    def is_mapped(self, type_name: str) -> bool:
        """Returns whether the schema map has a type."""
        return self.plan(type_name) is not UNMAPPED

    def kinds_of(self, type_name: str) -> frozenset[str]:
        """Returns what messages of a mapped type have: `position`, `velocity`, `geodetic`."""
        plan = self.plan(type_name)
        if plan is UNMAPPED:
            return frozenset()
        kinds: set[str] = set()
        for route in plan.poses:
            # Not a point without an orientation, such as one that somebody clicked.
            if isinstance(route, PlanarPose) or route.orientation is not _NOWHERE:
                kinds.add("position")
        if plan.twists:
            kinds.add("velocity")
        if plan.geodetic:
            kinds.add("geodetic")
        return frozenset(kinds)

    def twist(self, message: object, type_name: str) -> Twist | None:
        """Returns the velocity of a message (m/s, rad/s); None if it has none.

        It is read by the schema map's `linear_velocity` and `angular_velocity`; for a type that is
        not in the map, from vectors at `twist.twist` or `twist`. It is expressed in the child frame
        if the message names one (nav_msgs/Odometry), otherwise in the header's frame.
        """
        plan = self.plan(type_name)
        for linear_route, angular_route in plan.twists:
            linear_node, angular_node = linear_route.of(message), angular_route.of(message)
            linear, angular = xyz(linear_node), xyz(angular_node)
            if linear is None and plan is not UNMAPPED:
                linear, angular = _velocity(linear_node, 0), _velocity(angular_node, 2)
            if linear is not None and angular is not None:
                frame = _text(_CHILD_FRAME.of(message)) or self.frame(message)
                px4_frame = _px4_frame(plan.velocity_frame, message, _VELOCITY_FRAMES)
                return Twist(linear, angular, frame or px4_frame)
        return None

    def frame(self, message: object) -> str:
        """Returns the frame in a message's header; "" if it has none."""
        return _text(FRAME.of(message))

    def stamp(self, message: object) -> Ns | None:
        """Returns the stamp (ns) in a message's header; None if it has none."""
        return nanoseconds(_STAMP.of(message))

    def transforms(
        self, message: object, log_time: Ns, *, static: bool
    ) -> tuple[StampedTransform, ...]:
        """Returns the edges of a TFMessage, rotations normalised, frames without leading slash.

        It leaves out what tf2's buffer refuses: an edge without a frame name or from a frame to
        itself, and one whose numbers are not finite or whose quaternion is zero.

        Args:
            message: the decoded message.
            log_time: of the message (ns).
            static: whether it is of a topic of static transforms.
        """
        nodes = _TRANSFORMS.of(message)
        if not isinstance(nodes, list):
            return ()
        edges = (_edge(node, log_time, static=static) for node in nodes)
        return tuple(edge for edge in edges if edge is not None)

    def plan(self, type_name: str) -> Plan:
        """Returns the compiled schema map of a type; `UNMAPPED` if it is not in the map."""
        plan = self._plans.get(type_name)
        if plan is None and type_name.count("/") == 1:  # as recorders before 2019 wrote it
            plan = self._plans.get(type_name.replace("/", "/msg/"))
        return UNMAPPED if plan is None else plan

    def _whole(self, rendering: ExactJson, message: object, type_name: str) -> JsonValue:
        nodes = {
            name: _convert(name, self._at(message, path))
            for name, path in self.plan(type_name).fields.items()
        }
        absent = [name for name, node in nodes.items() if node is ABSENT]
        _note_absent(rendering, absent)
        if len(absent) == len(nodes):
            return rendering.value(message, "")
        return {name: rendering.value(node, name) for name, node in nodes.items()}

    def _find(self, message: object, type_name: str, path: str) -> object:
        """Returns what is at a path in a message or in a text of JSON there, or `ABSENT`."""
        node = self._member(message, type_name, path)
        if node is ABSENT:
            text = self.text_above(message, type_name, path)
            return descend(parsed_json(text.text), text.below) if text.is_json else ABSENT
        return node

    def _member(self, message: object, type_name: str, path: str) -> object:
        """Returns what is at a path in a message, or `ABSENT`.

        The path begins with a name of the schema map, or with a field of a type that is not mapped;
        or else it is the full path in the message, or that of a named element of an array.
        """
        plan = self.plan(type_name)
        segments = tuple(segments_of(path))
        mapped, node = plan.fields.get(segments[0]), ABSENT
        if mapped is not None:
            node = descend(_convert(segments[0], self._at(message, mapped)), segments[1:], view)
        elif not plan.fields:
            node = descend(message, segments, view)
        if node is ABSENT:
            node = _plain(self._at(message, segments))
        if node is ABSENT:
            return self._named_element(message, type_name, self.own_path(path, type_name))
        return node

    def _named_element(self, message: object, type_name: str, path: str) -> object:
        """Returns the element of an array that has a name in the list beside it.

        For the path `positions.elbow` it returns the position of the joint named elbow; null if the
        list does not have the name, `ABSENT` if there is no such list.
        """
        head, _, name = path.partition(".")
        value = self._whole(ExactJson(self.limit), message, type_name)
        names = names_beside(value, path)
        array = value.get(head) if isinstance(value, dict) and names else None
        if not isinstance(array, list):
            return ABSENT
        at = names.index(name) if name in names else len(array)
        return array[at] if at < len(array) else None

    def _at(self, message: object, path: Segments) -> object:
        """Returns what is at a path of the message's own fields, or `ABSENT`."""
        key = (type(message), path)
        try:
            getter = self._getters[key]
        except KeyError:
            if len(self._getters) >= _MOST_GETTERS:
                self._getters.clear()
            getter = self._getters[key] = _getter(message, path)
        if getter is not None:
            return getter(message)
        node = descend(message, path, view)
        return descend(message, path) if node is ABSENT else node


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

    twist = (route("linear_velocity"), route("angular_velocity"))
    of_geodetic = ("latitude", "longitude", "altitude", "fix_status", "orientation")
    geodetic = GeodeticPosition(*map(route, of_geodetic))
    return Plan(
        fields=paths,
        poses=_poses(paths.keys(), route),
        twists=() if _NOWHERE in twist else (twist,),
        geodetic=() if _NOWHERE in (geodetic.latitude, geodetic.longitude) else (geodetic,),
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


def _is_null(position: Vector3, turn_node: object) -> bool:
    """Returns whether a pose without a rotation is null: all its numbers are zero."""
    turn = xyzw(turn_node) or quadruple(turn_node)
    return turn is not None and not any(turn) and all(abs(axis) <= AT_ORIGIN_M for axis in position)


def _px4_rotation(node: object) -> Quaternion | None:
    """Returns the unit quaternion of an array in PX4's order: w, x, y, z."""
    numbers = quadruple(node)
    return None if numbers is None else unit((*numbers[1:], numbers[0]))


def _velocity(node: object, axis: int) -> Vector3 | None:
    """Returns a velocity that is an array, or a number: the component of one axis."""
    component = number(node)
    if component is None:
        return triple(node)
    return (component, 0.0, 0.0) if axis == 0 else (0.0, 0.0, component)


def _px4_frame(route: Route | None, message: object, names: Mapping[int, str]) -> str:
    """Returns the name of the frame whose number is at a path; "" if there is none."""
    frame = None if route is None else number(route.of(message))
    return "" if frame is None or not math.isfinite(frame) else names.get(int(frame), "")


def _convert(name: str, node: object) -> object:
    """Returns the value of a name of the schema map: an array becomes a point or a rotation."""
    if not isinstance(node, np.ndarray):
        return node
    if name in POINTS:
        point = triple(node)
        return node if point is None else dict(zip("xyz", map(Metric, point), strict=True))
    if name == "orientation" and len(node) == 4:
        turn = _px4_rotation(node)
        return None if turn is None else euler_of(turn)
    return node


def _getter(message: object, path: Segments) -> Callable[[object], object] | None:
    """Returns a fast getter of a path in messages of this class; None if fields are converted.

    A definition fixes the classes of all fields, so what holds for one message holds for all.
    """
    attributes, node = [], message
    for name in path:
        cls: type = type(node)
        layout = layout_of_class(cls)
        if layout is None or layout.kind is not ValueKind.PLAIN or name not in layout.fields:
            return None
        attribute, convert = layout.fields[name]
        if convert is not None:
            return None
        attributes.append(attribute)
        node = getattr(node, attribute)
    return attrgetter(".".join(attributes))


def _plain(node: object) -> object:
    """Returns a node for a full path in the message: a quaternion stays x, y, z, w."""
    if isinstance(node, list):
        return [_plain(element) for element in node]
    layout = layout_of(node)
    is_turn = layout is not None and layout.kind is ValueKind.QUATERNION
    numbers = xyzw(node) if is_turn else None
    return node if numbers is None else dict(zip("xyzw", numbers, strict=True))


def _note_absent(rendering: ExactJson, paths: Iterable[str]) -> None:
    for path in paths:
        rendering.note("absent", path, f"{path}: this message has no such field")


def _no_such_field(type_name: str, path: str, plan: Plan, message: object) -> str:
    names = names_of(message)
    fields = listed(names, at_most=_LISTED_NAMES)
    if not plan.fields:
        what_it_has = f"its fields are: {fields}" if names else "it has no fields"
        return f"{type_name} has no field {path!r}; {what_it_has}"
    angles = [f"{name}.{path}" for name in plan.fields if path in ANGLES and name in _TURNS]
    meant = f" (did you mean {angles[0]}?)" if angles else ""
    in_text = ""
    for name in names:
        text = _text(getattr(message, name, None))
        if looks_like_json(text):
            keys = listed(names_of(parsed_json(text)), at_most=_LISTED_NAMES)
            in_text = f"; in {name}, a text of JSON, {name}.KEY is one of: {keys}"
    return (
        f"{type_name} has no field {path!r}{meant}; its fields are: {', '.join(plan.fields)}; "
        f"or give a full path in the message, which begins with one of: {fields}{in_text}"
    )


def _text(node: object) -> str:
    return node if isinstance(node, str) else ""


def _edge(node: object, log_time: Ns, *, static: bool) -> StampedTransform | None:
    """Returns an edge of a TFMessage; None if it is left out."""
    parent = _text(FRAME.of(node)).removeprefix("/")
    child = _text(_CHILD_FRAME.of(node)).removeprefix("/")
    stamp = nanoseconds(_STAMP.of(node))
    translation, turn = xyz(_TRANSLATION.of(node)), rotation(_ROTATION.of(node))
    if not child or parent == child or stamp is None:
        return None
    if translation is None or turn is None or not all(map(math.isfinite, translation)):
        return None
    return StampedTransform(parent, child, stamp, log_time, Transform(translation, turn), static)

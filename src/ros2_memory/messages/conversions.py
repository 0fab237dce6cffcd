"""Converts parts of messages: rotations, points, times, images.

Replies and conditions see the extracted view of a message: a quaternion as `roll_deg`, `pitch_deg`
and `yaw_deg`, a time as one number, and the data of images, point clouds and maps as summaries.
`view` steps through it; a `Layout` says what differs from the message.
"""

from __future__ import annotations

import dataclasses
import keyword
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import suppress
from enum import Enum, auto
from functools import lru_cache, partial
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.core import geometry
from ros2_memory.core.text import LABELS, dotted
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue, Quaternion, Vector3

Array: TypeAlias = "np.ndarray[tuple[int, ...], np.dtype[np.generic[object]]]"

T = TypeVar("T")
V = TypeVar("V")

ABSENT: Final = object()
"""Stands for a field that a message does not have."""
_ELEMENT_NAMES: Final = ("names", "name", "joint_names")
"""Keys of a list that names the elements of the arrays beside it, as in joint states."""
INDEX: Final = re.compile(r"-?\d{1,9}", re.ASCII)
"""The place of an element in a path; a negative one counts from the end."""

_INDEX_IN_BRACKETS: Final = re.compile(r"\[(-?\d{1,9})\]")
_BETWEEN_SEGMENTS: Final = re.compile(r"\.(?![^\[\]]*\])|(?<=[^.])(?=\[\w+=)")
"""A dot that is not in brackets, or where a selector begins."""
_SELECTOR: Final = re.compile(r"""\[(\w+)=(["']?)([^\]]*)\2\]""")

Segments: TypeAlias = tuple[str, ...]

_PATH: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.([A-Za-z][A-Za-z0-9_]*|[0-9]+))*")


class ValueKind(Enum):
    """How the extracted view shows a message."""

    PLAIN = auto()  # field by field
    VECTOR = auto()  # field by field, each a `Metric`
    QUATERNION = auto()  # as Euler angles
    TIME = auto()  # as one number of seconds


class MessageField(NamedTuple):
    """A field of the messages of a class.

    Attributes:
        attribute: of the message object.
        convert: a function of the message and the field's value; None if it is shown as it is.
    """

    attribute: str
    convert: Callable[[object, object], object] | None = None


class Layout(NamedTuple):
    """How the extracted view shows the messages of a class.

    Attributes:
        fields: by their names in the definition.
        kind: how the view shows them.
    """

    fields: Mapping[str, MessageField]
    kind: ValueKind = ValueKind.PLAIN


def layout_of(node: object) -> Layout | None:
    """Returns the layout of a message; None for a number, a list, a mapping and the like."""
    cls: type = type(node)
    layout = layout_of_class(cls)
    if layout is not None or cls.__module__ in {"builtins", "numpy"}:
        return layout
    names = [name for name in getattr(node, "__dict__", {}) if not name.startswith("_")]
    return Layout({name: MessageField(name) for name in names}) if names else None


@lru_cache(maxsize=4096)
def layout_of_class(cls: type) -> Layout | None:
    """Returns the layout of the messages of a dataclass; None for any other class."""
    if not dataclasses.is_dataclass(cls):
        return None
    type_name = str(getattr(cls, "__msgtype__", ""))
    summaries = _SUMMARIES.get(type_name, {})
    fields: dict[str, MessageField] = {}
    constants: list[tuple[str, int]] = []
    for field in dataclasses.fields(cls):
        # rosbags imports ClassVar for type checkers only, so that dataclasses takes the constants
        # of a definition for fields; the annotation's text still distinguishes them.
        is_constant = isinstance(field.type, str) and field.type.startswith("ClassVar")
        if is_constant:
            if type(field.default) is int:
                constants.append((field.name, field.default))
        elif field.name != "structure_needs_at_least_one_member":
            bare = field.name.removesuffix("_")  # which rosbags appends to Python's keywords
            name = bare if keyword.iskeyword(bare) else field.name
            fields[name] = MessageField(field.name, summaries.get(name))
    for name, names in label_names(fields, constants).items():
        fields[name] = fields[name]._replace(convert=partial(_with_name, names))
    return Layout(fields, kind_of_type(type_name, [*fields]))


def field_of(node: object, name: str) -> object:
    """Returns a field of a message or an entry of a JSON object, unconverted.

    ABSENT if there is none.
    """
    if isinstance(node, dict):
        return node.get(name, ABSENT)
    layout = layout_of(node)
    if layout is None or name not in layout.fields:
        return ABSENT
    return getattr(node, layout.fields[name].attribute, ABSENT)


def names_of(node: object) -> tuple[str, ...]:
    """Returns the field names of a message or JSON object; for a list, of its first element."""
    while isinstance(node, list | tuple):
        node = node[0] if node else None
    if isinstance(node, dict):
        return tuple(str(name) for name in node)
    layout = layout_of(node)
    return () if layout is None else tuple(layout.fields)


def with_dots(path: str) -> str:
    """Returns a dot-path with the indices of lists as planners also write them: `data[3]`."""
    return _INDEX_IN_BRACKETS.sub(r".\1", path)


def segments_of(path: str) -> list[str]:
    """Returns the segments of a dot-path; `status[name=left]` are two."""
    return _BETWEEN_SEGMENTS.split(path)


def without_selectors(path: str) -> str:
    """Returns a dot-path that leads to all elements of lists in place of selected ones."""
    return ".".join(part for part in segments_of(path) if Selector.of(part) is None)


class Selector(NamedTuple):
    """Which elements of a list a segment of a path selects: `[name=left]`, by a field of theirs."""

    field: str
    wanted: str

    @classmethod
    def of(cls, segment: str) -> Selector | None:
        """Returns the selector that a segment is; None for any other segment."""
        # Nearly all segments are names: they are not matched.
        found = _SELECTOR.fullmatch(segment) if segment.startswith("[") else None
        return None if found is None else cls(found[1], found[3])

    def accepts(self, value: object) -> bool:
        """Returns whether a value is the wanted text, number or boolean, or has its name."""
        if isinstance(value, NamedNumber) and value.name == self.wanted:
            return True
        if isinstance(value, bool | np.bool_):
            return self.wanted.lower() == str(value).lower()
        if isinstance(value, str):
            return value == self.wanted
        for kind in (int, float):  # ids may have more digits than a float
            with suppress(ValueError):
                return bool(value == kind(self.wanted))
        return False


def parse_path(path: str) -> Segments | None:
    """Returns the segments of a dot-path (`pose.pose.position`, `poses.0`); None if malformed."""
    return tuple(path.split(".")) if _PATH.fullmatch(path) else None


def descend(
    node: object, segments: Sequence[str], step: Callable[[object, str], object] = field_of
) -> object:
    """Returns what is at a path: None below a null or past the ends of a list, else ABSENT.

    A name after a list is looked up in each element: the result is a list with None for elements
    that lack it, and ABSENT if all of them do. A selector leads to the element itself, to None or
    to a list if none or several are selected.

    Args:
        node: a message, a JSON value or a part of one.
        segments: of the path; a whole number is an index (`INDEX`), `[name=left]` a `Selector`.
        step: returns the field of a node, or ABSENT.
    """
    for at, segment in enumerate(segments):
        if node is None or node is ABSENT:
            return node
        if not isinstance(node, list | tuple | np.ndarray):
            node = step(node, segment)
        elif INDEX.fullmatch(segment):
            index = int(segment)
            node = node[index] if -len(node) <= index < len(node) else None
        elif selector := Selector.of(segment):
            chosen = [part for part in node if selector.accepts(step(part, selector.field))]
            node = chosen[0] if len(chosen) == 1 else chosen or None
        else:
            return _descend_each(node, segments[at:], step)
    return node


def names_beside(value: object, dot_path: str) -> list[object]:
    """Returns the names of the elements of an array, as in joint states.

    Empty unless the path has the name of an element (`position.wheel_left_joint`) where an index
    would be, and a list beside the array names its elements.
    """
    head, _, name = dot_path.partition(".")
    if not isinstance(value, dict) or not name or INDEX.fullmatch(name):
        return []
    array = value.get(head)
    if not isinstance(array, list) or (array and isinstance(array[0], dict)):
        return []
    for key in _ELEMENT_NAMES:
        names = value.get(key)
        if key != head and isinstance(names, list):
            return names
    return []


def names_others(value: object, dot_path: str) -> bool:
    """Returns whether a value names elements (joints), but not the one that a path asks for."""
    names, (_, _, name) = names_beside(value, dot_path), dot_path.partition(".")
    return bool(names) and name not in names


def own_path(path: str, fields: Mapping[str, Sequence[str]]) -> str:
    """Returns a full path in a message as a path in its extracted value.

    For an odometry it returns `position.x` for `pose.pose.position.x`. A path that no mapped field
    leads to is returned as it is, and so is one that begins with the name of another field.
    """
    segments = tuple(segments_of(path))
    longest, own_name = 0, ""
    for name, mapped in fields.items():
        is_other = segments[0] in fields and name != segments[0]
        leads_there = segments[: len(mapped)] == tuple(mapped) and not is_other
        if leads_there and (len(mapped), name) > (longest, own_name):
            longest, own_name = len(mapped), name
    return ".".join((own_name, *segments[longest:])) if own_name else path


def _descend_each(
    nodes: Sequence[object] | Array,
    segments: Sequence[str],
    step: Callable[[object, str], object],
) -> object:
    """Returns the rest of a path in each element of a list, as `descend` says."""
    if isinstance(nodes, np.ndarray):
        return ABSENT if nodes.size else []  # numbers have no fields
    values = [descend(node, segments, step) for node in nodes]
    if values and all(node is ABSENT for node in values):
        return ABSENT
    return [None if node is ABSENT else node for node in values]


class Route:
    """A path without lists in it, compiled to an `attrgetter`, which is fast for messages.

    Attributes:
        segments: the names of the fields.
    """

    __slots__ = ("_fast", "segments")

    def __init__(self, *segments: str) -> None:
        self._fast = attrgetter(".".join(segments))
        self.segments = segments

    def of(self, message: object) -> object:
        """Returns what is at the path; ABSENT or None if there is nothing."""
        try:
            value: object = self._fast(message)
        # JSON objects, and attributes that rosbags renamed.
        except AttributeError:
            value = descend(message, self.segments)
        return value


ANGLES: Final = ("roll_deg", "pitch_deg", "yaw_deg")


class Metric(float):
    """A component of a point or vector of geometry_msgs: metres, m/s, rad/s and the like."""

    __slots__ = ()


class Degrees(float):
    """An angle in degrees that was computed from a quaternion."""

    __slots__ = ()


def kind_of_type(name: str, fields: Sequence[str]) -> ValueKind:
    """Returns how the extracted view shows messages of a type with these fields."""
    kind, names = _KINDS.get(name, (ValueKind.PLAIN, ""))
    # A bag may have a definition of its own under the name of a standard type.
    return kind if names.split() == fields else ValueKind.PLAIN


def view(node: object, name: str) -> object:
    """Returns a field of the extracted view of a message; ABSENT if it has no such field."""
    fields, kind = layout_of(node) or Layout({})
    if kind is ValueKind.TIME:
        return ABSENT
    if kind is ValueKind.QUATERNION:
        if name not in ANGLES:
            return ABSENT
        angles = euler(node)
        return None if angles is None else angles[name]
    value = field_of(node, name)
    if kind is ValueKind.VECTOR:
        return Metric(value) if isinstance(value, float) else value
    convert = fields[name].convert if name in fields else None
    return value if convert is None or value is ABSENT else convert(node, value)


class NamedNumber(int):
    """A whole number that is a label, and whose type has a constant for it.

    Attributes:
        name: of the constant.
    """

    name: str

    @classmethod
    def of(cls, number: int, name: str) -> NamedNumber:
        """Returns a number with its name."""
        named = cls(number)
        named.name = name
        return named


def label_names(
    fields: Iterable[str], constants: Sequence[tuple[str, int]]
) -> Mapping[str, Mapping[int, str]]:
    """Returns the names of the numbers of each field that has a label, by the type's constants.

    Where constants begin with the name of the field (`LABEL_CAR`), that is no part of the name. A
    number of several constants has no name.
    """
    names = [*fields]
    named: dict[str, Mapping[int, str]] = {}
    for field in LABELS:
        own = constants_of_field(field, names, constants) if field in names else []
        if own:
            counts = Counter(number for _, number in own)
            prefix = _prefix(field)
            named[field] = {n: name.removeprefix(prefix) for name, n in own if counts[n] == 1}
    return named


def constants_of_field(
    field: str, fields: Iterable[str], constants: Sequence[tuple[str, T]]
) -> list[tuple[str, T]]:
    """Returns the constants of a type that may be values of one of its fields.

    They begin with the name of the field (`LABEL_CAR`), else with that of no field.
    """
    own = [constant for constant in constants if constant[0].startswith(_prefix(field))]
    of_others = tuple(map(_prefix, fields))
    return own or [constant for constant in constants if not constant[0].startswith(of_others)]


def _prefix(field: str) -> str:
    return f"{field.upper()}_"


def _with_name(names: Mapping[int, str], _message: object, value: object) -> object:
    """Returns a whole number with its name, if it has one."""
    if not isinstance(value, int) or value not in names:
        return value
    return NamedNumber.of(value, names[value])


class Summary(dict[str, V]):
    """Stands for a large array: its size and shape without its content."""

    __slots__ = ()


def single_values(value: JsonValue, path: str = "") -> Iterator[tuple[str, str | float | bool]]:
    """Yields the numbers, texts and booleans of nested objects by dot-path, but not of headers."""
    if isinstance(value, str | int | float):
        yield path, value
    elif isinstance(value, dict) and not isinstance(value, Summary):
        for name, inner in value.items():
            if name != "header":
                yield from single_values(inner, dotted(path, name))


_NUMBERS: Final = (int, float, np.number)  # as a tuple: a union is made anew with each call
_XYZ: Final = attrgetter("x", "y", "z")
_XYZW: Final = attrgetter("x", "y", "z", "w")


def xyz(node: object) -> Vector3 | None:
    """Returns the numbers of a message or JSON object with x, y and z; None for any other."""
    try:
        numbers: object = _XYZ(node)
    except AttributeError:
        numbers = tuple(field_of(node, name) for name in "xyz")
    return triple(numbers)


def xyzw(node: object) -> Quaternion | None:
    """Returns the numbers of a message or JSON object with x, y, z and w, not normalised."""
    try:
        numbers: object = _XYZW(node)
    except AttributeError:
        numbers = tuple(field_of(node, name) for name in "xyzw")
    return quadruple(numbers)


def number(node: object) -> float | None:
    """Returns a number as a float; None for anything else, and for an integer past all floats."""
    if type(node) is float:
        return node
    if isinstance(node, bool) or not isinstance(node, _NUMBERS):
        return None
    try:
        return float(node)
    except (OverflowError, TypeError):
        return None


def triple(node: object) -> Vector3 | None:
    """Returns three numbers in an array or tuple; None for anything else."""
    return cast("Vector3 | None", _numbers(node, 3))


def quadruple(node: object) -> Quaternion | None:
    """Returns four numbers in an array or tuple; None for anything else."""
    return cast("Quaternion | None", _numbers(node, 4))


def _numbers(node: object, count: int) -> tuple[float | None, ...] | None:
    """Returns the numbers of an array or tuple; None if it has another length or other elements."""
    if not isinstance(node, list | tuple | np.ndarray) or len(node) != count:
        return None
    numbers = tuple(map(number, node))
    return None if None in numbers else numbers


def rotation(node: object) -> Quaternion | None:
    """Returns the unit quaternion of a node; None if it is zero, not finite or no numbers."""
    numbers = xyzw(node)
    return None if numbers is None else unit(numbers)


def unit(numbers: Quaternion) -> Quaternion | None:
    """Returns the unit quaternion of four numbers; None if they are zero or not finite."""
    x, y, z, w = numbers
    # Called for each pose, and nearly every quaternion of a robot is of unit length already.
    if abs(x * x + y * y + z * z + w * w - 1) < 1e-12:
        return numbers
    return geometry.normalised(numbers)


def euler(node: object) -> dict[str, Degrees] | None:
    """Returns roll, pitch and yaw (REP-103, degrees) of a quaternion; None if it is no rotation."""
    numbers = xyzw(node)
    return None if numbers is None else euler_of(numbers)


def euler_of(numbers: Quaternion) -> dict[str, Degrees] | None:
    """Returns roll, pitch and yaw (degrees) of x, y, z, w; None if these are no rotation."""
    turn = unit(numbers)
    if turn is None:
        return None
    roll, pitch, yaw = geometry.rpy(turn)
    return {
        "roll_deg": Degrees(math.degrees(roll)),
        "pitch_deg": Degrees(math.degrees(pitch)),
        "yaw_deg": Degrees(math.degrees(yaw)),
    }


def nanoseconds(node: object) -> Ns | None:
    """Returns the nanoseconds of a Time or Duration, also as JSON; None for anything else."""
    for sec_name, nanosec_name in (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs")):
        sec, nanosec = field_of(node, sec_name), field_of(node, nanosec_name)
        if isinstance(sec, int) and isinstance(nanosec, int):
            time = sec * NS_PER_S + nanosec
            return time if MIN_NS <= time <= MAX_NS else None
    return None


_CHANNELS: Final = {"mono": 1, "bayer": 1, "rgba": 4, "bgra": 4, "rgb": 3, "bgr": 3}
"""The channels of image encodings by how these begin; the longer prefix comes first."""


def _image(message: object, data: object) -> object:
    encoding = field_of(message, "encoding")
    channels = channels_of(str(encoding))
    shape = _shape(message) + ([] if channels is None else [channels])
    return _summary(data, encoding=encoding, shape=shape)


def _shape(message: object, *path: str) -> list[int]:
    """Returns height and width, as far as the message has them."""
    size = [descend(message, (*path, name)) for name in ("height", "width")]
    return [length for length in size if isinstance(length, int)]


def channels_of(encoding: str) -> int | None:
    """Returns the channels of an encoding of sensor_msgs/image_encodings.hpp; None for yuv."""
    typed = re.fullmatch(r"\d+[USF]C(\d{1,3})", encoding)
    if typed:
        return int(typed[1])
    for prefix, channels in _CHANNELS.items():
        if encoding.startswith(prefix):
            return channels
    return None


def _point_cloud(message: object, data: object) -> object:
    shape = _shape(message)
    return _summary(data, points=math.prod(shape), shape=shape)


def _magnetic_field(_message: object, field: object) -> object:
    """Returns plain floats: rounded as metres, the Earth's field in tesla would be zero."""
    numbers = xyz(field)
    return field if numbers is None else dict(zip("xyz", numbers, strict=True))


def _summary(data: object, **fields: object) -> Summary[object]:
    fields = {name: None if field is ABSENT else field for name, field in fields.items()}
    return Summary({"bytes": len(data) if isinstance(data, Sized) else 0, **fields})


_KINDS: Final[Mapping[str, tuple[ValueKind, str]]] = {
    "geometry_msgs/msg/Point": (ValueKind.VECTOR, "x y z"),
    "geometry_msgs/msg/Point32": (ValueKind.VECTOR, "x y z"),
    "geometry_msgs/msg/Vector3": (ValueKind.VECTOR, "x y z"),
    "geometry_msgs/msg/Quaternion": (ValueKind.QUATERNION, "x y z w"),
    "builtin_interfaces/msg/Time": (ValueKind.TIME, "sec nanosec"),
    "builtin_interfaces/msg/Duration": (ValueKind.TIME, "sec nanosec"),
}
_SUMMARIES: Final[Mapping[str, Mapping[str, Callable[[object, object], object]]]] = {
    "sensor_msgs/msg/Image": {"data": _image},
    "sensor_msgs/msg/CompressedImage": {
        "data": lambda message, data: _summary(data, encoding=field_of(message, "format"))
    },
    "sensor_msgs/msg/PointCloud2": {"data": _point_cloud},
    "nav_msgs/msg/OccupancyGrid": {
        "data": lambda message, data: _summary(data, shape=_shape(message, "info"))
    },
    "sensor_msgs/msg/MagneticField": {"magnetic_field": _magnetic_field},
}

SUMMARIZED: Final[Mapping[str, str]] = {
    name: field for name, fields in _SUMMARIES.items() for field in fields
}
"""The field that is summarized, by message type."""

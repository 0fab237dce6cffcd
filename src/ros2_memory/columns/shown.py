"""The extracted value of a type's messages as a tree over its columns, without any message.

`SchemaExtractor.exact` turns one decoded message into a value; here the same is said of all
messages of a type at once, from the definition and the schema map alone: which leaves the value
has, under which names, and the column that each is read or computed from. What is stored is not
looked at, so one tree serves all tables of a type.

A node is what may stand in the value: a `Leaf` (a number, boolean or text of each row or element),
an object (`Message`, `Group`), a list (`Listing` over the elements of a level, `Items` of a short
fixed array), or null (`NOTHING`). `Narrowed` and `Choice` say for which rows a node stands there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np

from ros2_memory.columns.table import MAX_NUMBERS, Table
from ros2_memory.columns.values import ROWS, Conversion, Kind, Leaf, Level, Values
from ros2_memory.extract import POINTS, SchemaExtractor
from ros2_memory.messages.conversions import ANGLES, SUMMARIZED, ValueKind, kind_of_type
from ros2_memory.messages.to_json import MAX_DEPTH, MAX_EXACT_NUMBERS
from ros2_memory.storage.base import SEQUENCE, Definition

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ros2_memory.columns.values import Ints, Mask
    from ros2_memory.columns.zones import PartZones

T = TypeVar("T")

MAX_LEAVES: Final = 20_000
"""Of one value: nested definitions of some lines can spell out more than memory holds."""

_FILLER: Final = "structure_needs_at_least_one_member"
_INDEX: Final = re.compile(r"-?\d{1,9}", re.ASCII)
_BYTES: Final = frozenset({"uint8", "char"})
"""What rosbags decodes to uint8, whose long arrays are shown as their length."""


class UnknownShapeError(Exception):
    """What the value looks like differs from message to message: the messages decide."""


class TruthValues(NamedTuple):
    """Of some rows or elements: where something surely stands, and where it may stand."""

    surely: Mask
    perhaps: Mask

    @property
    def unsure(self) -> Mask:
        """Where it may stand or not."""
        return self.perhaps & ~self.surely

    @property
    def is_none(self) -> bool:
        """Whether it stands nowhere."""
        return not self.perhaps.any()


def nowhere(size: int) -> TruthValues:
    """Returns the column of a field that none of so many rows or elements has."""
    return TruthValues(np.zeros(size, np.bool_), np.zeros(size, np.bool_))


def unknown(size: int) -> TruthValues:
    """Returns that nothing is known of so many rows or elements."""
    return TruthValues(np.zeros(size, np.bool_), np.ones(size, np.bool_))


class Limit(Protocol):
    """For which rows or elements of a level something stands in the value."""

    @property
    def level(self) -> Level:
        """The level that it is about."""

    def kept(self, values: Values, positions: Ints) -> TruthValues:
        """Returns where it stands, for some rows or elements of the level."""


@dataclass(frozen=True, slots=True, eq=False)
class Pick:
    """The element at this place of each list alone; negative from the end."""

    level: Level
    place: int

    def kept(self, values: Values, positions: Ints) -> TruthValues:
        """Returns where the elements stand at the place."""
        places = values.places(self.level, positions, from_end=self.place < 0)
        if places is None:
            return unknown(len(positions))
        is_kept = places == self.place
        return TruthValues(is_kept, is_kept)


@dataclass(frozen=True, slots=True, eq=False)
class LongerThan:
    """Where a sequence of numbers has more elements than this; else where it has no more."""

    level: Level
    sequence: str
    count: int
    is_longer: bool

    def kept(self, values: Values, positions: Ints) -> TruthValues:
        """Returns where the sequence is that long."""
        lengths = values.numeric(self.level, f"{self.sequence}.length")
        if lengths is None:
            return unknown(len(positions))
        is_kept = (lengths[positions] > self.count) == self.is_longer
        return TruthValues(is_kept, is_kept)


class Place(NamedTuple):
    """A part of the message: a field, or the element of a list; `depth` of the value around it."""

    level: Level
    path: str
    kind: str | Definition
    length: int | None
    depth: int


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A message that is shown field by field; `plain`: as its definition has them."""

    shape: Shape
    level: Level
    path: str
    definition: Definition
    depth: int
    plain: bool = False

    def names(self) -> list[str]:
        """Returns the names of its fields."""
        return [field.name for field in self.definition.fields if field.name != _FILLER]

    def child(self, name: str) -> Node | None:
        """Returns what stands under a name; None where no field has it."""
        for field in self.definition.fields:
            if field.name == name != _FILLER:
                path = f"{self.path}.{name}" if self.path else name
                place = Place(self.level, path, field.kind, field.length, self.depth + 1)
                if self.plain:
                    return self.shape.plain(place)
                if name == SUMMARIZED.get(self.definition.type):
                    return self.shape.summary(self, place)
                return self.shape.shown(place)
        return None


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """An object that the conversions make.

    Attributes:
        fields: its parts.
        turned: the message, of a quaternion.
        is_summary: whether it is a `messages.conversions.Summary`.
    """

    fields: Mapping[str, Node]
    turned: Message | None = None
    is_summary: bool = False

    def names(self) -> list[str]:
        """Returns the names of its fields."""
        return [*self.fields]

    def child(self, name: str) -> Node | None:
        """Returns what stands under a name; None where no field has it."""
        return self.fields.get(name)


@dataclass(frozen=True, slots=True, eq=False)
class Listing:
    """A list of the elements of a level."""

    level: Level
    element: Node


@dataclass(frozen=True, slots=True, eq=False)
class Items:
    """A list of so many for all rows."""

    items: tuple[Node, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Narrowed:
    """A node that stands in the value of some rows or elements alone, and null in the others."""

    limit: Limit
    node: Node


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """An array of numbers (`array`), which is shown as one of these, whichever holds for a row."""

    cases: tuple[Node, ...]
    array: Node


@dataclass(frozen=True, slots=True, eq=False)
class Nothing:
    """Null."""


NOTHING: Final = Nothing()

Node: TypeAlias = Leaf | Message | Group | Listing | Items | Narrowed | Choice | Nothing
Limits: TypeAlias = tuple["Limit", ...]


class Spot(NamedTuple):
    """A node, and the limits on what stands there."""

    node: Node
    limits: Limits = ()


def placed(
    values: Values, level: Level, positions: Ints, limits: Limits, *, surely: bool
) -> tuple[Ints, Ints]:
    """Returns which of some rows or elements stand in the value, and the row of each.

    Args:
        values: of the table.
        level: of the rows or elements.
        positions: their positions.
        limits: on what stands there.
        surely: whether those that may or may not stand there are left out.
    """
    current, kept, owners = level, positions, positions
    while True:
        for limit in limits:
            if limit.level == current and len(kept):
                mask = limit.kept(values, owners)[0 if surely else 1]
                kept, owners = kept[mask], owners[mask]
        elements = values.elements(current)
        if current.parent is None or elements is None:
            return kept, owners
        owners, current = elements.owners[owners], current.parent


class Shape:
    """The value that `extractor` shows of messages of a type.

    Args:
        definition: the type's fields.
        type_name: the type as the channel names it.
        extractor: has the schema map.

    Attributes:
        type: as the channel names it.
        definition: its fields.
    """

    def __init__(self, definition: Definition, type_name: str, extractor: SchemaExtractor) -> None:
        self.type = type_name
        self.definition = definition
        self._fields = extractor.fields_of(type_name)
        self._limit = extractor.limit

    @cached_property
    def value(self) -> Node:
        """The whole value, as `SchemaExtractor.exact` returns it.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        nodes = {name: self._at(path) for name, path in self._fields.items()}
        if all(node is None for node in nodes.values()):
            return self._message()
        return Group(
            {
                name: NOTHING if node is None else self._converted(name, node)
                for name, node in nodes.items()
            }
        )

    def find(self, path: str) -> Node | None:
        """Returns what `SchemaExtractor.exact_at` returns for a path; None where nothing is.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        segments = tuple(path.split("."))
        mapped = self._fields.get(segments[0])
        node: Node | None = None
        if mapped is not None:
            whole = self._at(mapped)
            if whole is not None:
                node = descend(self._converted(segments[0], whole), segments[1:])
        elif not self._fields:
            node = descend(self._message(), segments)
        if node is not None:
            return node
        plain = self._at(segments)
        return None if plain is None else _with_changed_leaves(plain, _quaternion_as_xyzw)

    def shown(self, place: Place) -> Node:
        """Returns a part of the message as the value shows it."""
        if place.length is None and isinstance(place.kind, str):
            return Leaf(place.level, (place.path,), _kind(place.kind))
        if place.depth >= MAX_DEPTH:
            raise UnknownShapeError(f"{place.path} lies {place.depth} levels deep")
        if place.length is None and isinstance(place.kind, Definition):
            return self._shown_message(place, place.kind)
        return self._array(place)

    def _shown_message(self, place: Place, definition: Definition) -> Node:
        level, path = place.level, place.path
        message = Message(self, level, path, definition, place.depth)
        kind = kind_of_type(definition.type, [field.name for field in definition.fields])
        if kind is ValueKind.TIME:
            return Leaf(level, (path,), Kind.REAL, Conversion.SECONDS)
        are_numbers = all(_is_number(field.kind, field.length) for field in definition.fields)
        sources = [f"{path}.{field.name}" if path else field.name for field in definition.fields]
        if kind is ValueKind.VECTOR and are_numbers:
            return _vector(level, sources)
        if kind is ValueKind.QUATERNION:
            return _angles_of(level, sources, message) if are_numbers else NOTHING
        return message

    def plain(self, place: Place) -> Node:
        """Returns a part of the message as its definition has it, to be walked further."""
        level, path, kind, length, depth = place
        if isinstance(kind, str):
            return self.shown(place)
        if length is not None:
            inner = Level(level, path)
            return Listing(inner, self.plain(Place(inner, "", kind, None, depth + 1)))
        return Message(self, level, path, kind, depth, plain=True)

    def summary(self, message: Message, place: Place) -> Node:
        """Returns what the conversions make of the data of an image, a map or a magnet.

        Raises:
            UnknownShapeError: it is a plain image or a cloud, or the definition is not the standard
                one.
        """
        kind = message.definition.type.rpartition("/")[2]
        if kind == "MagneticField":
            node = self.shown(place)
            if isinstance(node, Group) and node.turned is None:
                return node
        if not isinstance(place.kind, str) or place.length != SEQUENCE:
            raise UnknownShapeError(f"{place.path} is no sequence of bytes")

        def leaf(kind: Kind, *path: str) -> Leaf:
            child = descend(message, path)
            if isinstance(child, Leaf) and child.kind is kind:
                return child
            raise UnknownShapeError(f"{'.'.join(path)} is not as in the standard definition")

        count = Leaf(place.level, (f"{place.path}.length",), Kind.INTEGER)
        if kind == "CompressedImage":  # as markers have them
            parts = {"bytes": count, "encoding": leaf(Kind.TEXT, "format")}
            return Group(parts, is_summary=True)
        if kind != "OccupancyGrid":
            raise UnknownShapeError("images and clouds are no columns")
        shape = tuple(leaf(Kind.INTEGER, "info", name) for name in ("height", "width"))
        return Group({"bytes": count, "shape": Items(shape)}, is_summary=True)

    def _message(self) -> Node:
        return self.shown(Place(ROWS, "", self.definition, None, 0))

    def _at(self, path: Sequence[str]) -> Node | None:
        node = descend(self._message(), path)
        if node is not None:
            return node
        plain = descend(self.plain(Place(ROWS, "", self.definition, None, 0)), path)
        return None if plain is None else _with_changed_leaves(plain, self._as_shown)

    def _as_shown(self, node: Node) -> Node:
        """Returns the end of a walk through definitions as the value shows it."""
        if not isinstance(node, Message):
            return node
        return self.shown(Place(node.level, node.path, node.definition, None, node.depth))

    def _array(self, place: Place) -> Node:
        level, path, kind, length, depth = place
        inner = Level(level, path)
        element = self.shown(Place(inner, "", kind, None, depth + 1))
        listing = Listing(inner, element)
        if not isinstance(kind, str) or _kind(kind) is Kind.TEXT:
            return listing
        count, key = (self._limit, "bytes") if kind in _BYTES else (MAX_EXACT_NUMBERS, "numbers")
        if length == SEQUENCE:
            counted = Leaf(level, (f"{path}.length",), Kind.INTEGER)
            longer = LongerThan(level, path, count, is_longer=True)
            shorter = LongerThan(level, path, count, is_longer=False)
            summary = Group({key: counted}, is_summary=True)
            cases = (Narrowed(longer, summary), Narrowed(shorter, listing))
            return Choice(cases, listing)
        size = length or 0
        array: Node = listing
        if size <= MAX_NUMBERS:
            array = Items(
                tuple(Leaf(level, (f"{path}.{nth}",), _kind(kind)) for nth in range(size))
            )
        if size <= count:
            return array
        constant = Leaf(level, (), Kind.INTEGER, Conversion.CONSTANT, size)
        return Choice((Group({key: constant}, is_summary=True),), array)

    def _converted(self, name: str, node: Node) -> Node:
        """Returns the value of a name of the schema map: an array as the point or turn it is."""
        if isinstance(node, Narrowed):
            return Narrowed(node.limit, self._converted(name, node.node))
        if name not in POINTS and name != "orientation":
            return node
        if isinstance(node, Choice):
            if isinstance(node.array, Listing) and len(node.cases) > 1:
                raise UnknownShapeError(f"{name} has another length in each message")
            array = node.array
        else:
            array = node
        if not isinstance(array, Items):
            return node
        leaves = [item for item in array.items if isinstance(item, Leaf)]
        is_numeric = all(leaf.kind in {Kind.INTEGER, Kind.REAL} for leaf in leaves)
        sources = [leaf.sources[0] for leaf in leaves]
        if name in POINTS:
            return _vector(leaves[0].level, sources) if is_numeric and len(leaves) == 3 else node
        if len(leaves) != 4:
            return node
        # PX4 writes w first.
        return (
            _angles_of(leaves[0].level, [*sources[1:], sources[0]], None) if is_numeric else NOTHING
        )


def shape_of(table_or_parts: Table | PartZones, extractor: SchemaExtractor) -> Shape | None:
    """Returns the shape of a table's type, or of some parts'; None where the messages decide."""
    if table_or_parts.definition is None or "" in table_or_parts.left_out:
        return None
    return Shape(table_or_parts.definition, table_or_parts.channel.type, extractor)


class ByType(Generic[T]):
    """What is made of the shape of each type, once.

    Args:
        extractor: has the schema map.
        make: returns it; raises `UnknownShapeError` where it depends on the message.
    """

    def __init__(self, extractor: SchemaExtractor, make: Callable[[Shape], T]) -> None:
        self._extractor = extractor
        self._make = make
        self._known: dict[tuple[Definition, str], T | None] = {}

    def of(self, table_or_parts: Table | PartZones) -> T | None:
        """Returns that of a table's type, or of some parts'; None where the messages decide."""
        shape = shape_of(table_or_parts, self._extractor)
        if shape is None:
            return None
        key = (shape.definition, shape.type)
        if key not in self._known:
            try:
                self._known[key] = self._make(shape)
            except UnknownShapeError:
                self._known[key] = None
        return self._known[key]


def descend(node: Node, path: Sequence[str]) -> Node | None:
    """Returns what is at a path of the schema map, as `messages.fields.descend` finds it.

    None where no field is.
    """
    for nth, segment in enumerate(path):
        if isinstance(node, Choice):
            node = node.array
        if isinstance(node, Nothing):
            return node
        if isinstance(node, Narrowed):
            inner = descend(node.node, path[nth:])
            return None if inner is None else Narrowed(node.limit, inner)
        if isinstance(node, Listing | Items) and segment.isascii() and segment.isdecimal():
            node = _element_at(node, int(segment[:10]))
        elif isinstance(node, Listing):
            inner = descend(node.element, path[nth:])
            return None if inner is None else Listing(node.level, inner)
        elif isinstance(node, Message | Group):
            child = node.child(segment)
            if child is None:
                return None
            node = child
        else:
            return None
    return node


def at_field(root: Node, dot_path: str) -> list[Spot]:
    """Returns what is at a dot-path in the value, as `analysis.conditions.at_field` finds it.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    spots = [Spot(root)]
    for segment in dot_path.split("."):
        spots = [target for spot in spots for target in _step(spot, segment)]
    return spots


def opened(spot: Spot) -> Iterator[Spot]:
    """Yields a spot without `Narrowed` and `Choice`: their limits are the spot's own."""
    node, limits = spot
    if isinstance(node, Narrowed):
        yield from opened(Spot(node.node, (*limits, node.limit)))
    elif isinstance(node, Choice):
        for case in node.cases:
            yield from opened(Spot(case, limits))
    else:
        yield spot


def leaves_below(root: Spot) -> Iterator[tuple[str, Leaf, Limits]]:
    """Yields the leaves at or below a spot, with their dot-paths in the value.

    Below a summary these are its texts, as in `analysis.conditions.leaves`.

    Raises:
        UnknownShapeError: there are more than `MAX_LEAVES`, or it depends on the message.
    """
    waiting = [("", root)]
    count = 0
    while waiting:
        path, spot = waiting.pop()
        count += 1
        if count > MAX_LEAVES:
            raise UnknownShapeError(f"the value has more than {MAX_LEAVES} parts")
        for node, limits in opened(spot):
            if isinstance(node, Leaf):
                yield path, node, limits
            elif isinstance(node, Listing):
                waiting.append((path, Spot(node.element, limits)))
            elif isinstance(node, Items):
                waiting.extend((path, Spot(item, limits)) for item in reversed(node.items))
            elif isinstance(node, Message | Group):
                is_summary = isinstance(node, Group) and node.is_summary
                waiting.extend(
                    (f"{path}.{key}" if path else key, Spot(child, limits))
                    for key, child in reversed(children(node))
                    if not is_summary or (isinstance(child, Leaf) and child.kind is Kind.TEXT)
                )


def children(node: Message | Group) -> list[tuple[str, Node]]:
    """Returns the fields of an object in their order."""
    named = [(name, node.child(name)) for name in node.names()]
    return [(name, child) for name, child in named if child is not None]


def _step(spot: Spot, segment: str) -> Iterator[Spot]:
    for node, limits in opened(spot):
        if isinstance(node, Message | Group):
            child = node.child(segment)
            if child is not None:
                yield Spot(child, limits)
        elif isinstance(node, Listing | Items) and _INDEX.fullmatch(segment):
            yield Spot(_element_at(node, int(segment)), limits)
        elif isinstance(node, Listing):
            yield from _step(Spot(node.element, limits), segment)


def _element_at(node: Listing | Items, index: int) -> Node:
    if isinstance(node, Listing):
        return Narrowed(Pick(node.level, index), node.element)
    return node.items[index] if -len(node.items) <= index < len(node.items) else NOTHING


def _with_changed_leaves(node: Node, change: Callable[[Node], Node]) -> Node:
    """Returns a node with each value in it changed: of a list, its elements."""
    if isinstance(node, Listing):
        return Listing(node.level, _with_changed_leaves(node.element, change))
    if isinstance(node, Narrowed):
        return Narrowed(node.limit, _with_changed_leaves(node.node, change))
    return change(node)


def _quaternion_as_xyzw(node: Node) -> Node:
    """Returns a rotation as the x, y, z, w of its message, and not as angles; others unchanged."""
    if not isinstance(node, Group) or node.turned is None:
        return node
    message = node.turned
    path = f"{message.path}." if message.path else ""
    return Group({name: _real(message.level, f"{path}{name}") for name in "xyzw"})


def _real(level: Level, source: str) -> Leaf:
    return Leaf(level, (source,), Kind.REAL, Conversion.REAL)


def _vector(level: Level, sources: Sequence[str]) -> Group:
    return Group({axis: _real(level, source) for axis, source in zip("xyz", sources, strict=True)})


def _angles_of(level: Level, sources: Sequence[str], message: Message | None) -> Group:
    angles = (Conversion.ROLL, Conversion.PITCH, Conversion.YAW)
    return Group(
        {
            name: Leaf(level, tuple(sources), Kind.REAL, angle)
            for name, angle in zip(ANGLES, angles, strict=True)
        },
        message,
    )


def _kind(primitive: str) -> Kind:
    if primitive == "bool":
        return Kind.BOOLEAN
    if primitive in {"string", "wstring"}:
        return Kind.TEXT
    return Kind.REAL if primitive.startswith("float") else Kind.INTEGER


def _is_number(kind: str | Definition, length: int | None) -> bool:
    return isinstance(kind, str) and length is None and _kind(kind) in {Kind.INTEGER, Kind.REAL}

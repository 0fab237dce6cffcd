"""The extracted value of a type's messages as a tree over its columns, without any message.

`SchemaExtractor.exact` turns one decoded message into a value; here the same is said of all
messages of a type at once, from the definition and the schema map alone: which leaves the value
has, under which names, and the column that each is read or computed from. What is stored is not
looked at, so one tree serves all tables of a type.

A node is what may stand in the value: a `Leaf` (a number, boolean or text of each row or element),
an `Object`, a list (`Listing` over the elements of a level, `Items` of a short fixed array), or
null (`NOTHING`). `Narrowed` and `Choice` say for which rows a node stands there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeAlias, TypeGuard, TypeVar

import numpy as np

from ros2_memory.analysis.conditions import ELEMENT_NAMES
from ros2_memory.columns.stored import Lazily
from ros2_memory.columns.table import MAX_NUMBERS, Table
from ros2_memory.columns.values import (
    NUMBERS,
    ROWS,
    Conversion,
    Kind,
    Leaf,
    Level,
    UnknownShapeError,
    Values,
)
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


class TruthValues(NamedTuple):
    """Of some rows or elements: where something surely stands, and where it may stand."""

    surely: Mask
    perhaps: Mask

    @classmethod
    def known(cls, stands: Mask) -> TruthValues:
        """Returns that it stands there and nowhere else."""
        return cls(stands, stands)

    @property
    def unsure(self) -> Mask:
        """Where it may stand or not."""
        return self.perhaps & ~self.surely

    @property
    def is_settled(self) -> bool:
        """Whether it is known everywhere."""
        return not self.unsure.any()

    @property
    def is_none(self) -> bool:
        """Whether it stands nowhere."""
        return not self.perhaps.any()


def nowhere(size: int) -> TruthValues:
    """Returns that so many rows or elements do not have a value."""
    return TruthValues(np.zeros(size, np.bool_), np.zeros(size, np.bool_))


def unknown(size: int) -> TruthValues:
    """Returns that nothing is known of so many rows or elements."""
    return TruthValues(np.zeros(size, np.bool_), np.ones(size, np.bool_))


class Limit(NamedTuple):
    """For which rows or elements of a level something stands in the value.

    Attributes:
        level: the level that it is about.
        find: returns where it stands, for some rows or elements of the level; may raise
            `UnknownShapeError`.
        is_of_scores: whether detections of a low score are left out by it.
    """

    level: Level
    find: Callable[[Values, Ints], TruthValues]
    is_of_scores: bool = False

    def kept(self, values: Values, positions: Ints) -> TruthValues:
        """Returns where it stands, for some rows or elements of the level."""
        try:
            return self.find(values, positions)
        except UnknownShapeError:
            return unknown(len(positions))


def _at_place(level: Level, place: int) -> Limit:
    """Returns the limit to the element at this place of each list; negative from the end."""

    def find(values: Values, positions: Ints) -> TruthValues:
        return TruthValues.known(values.places(level, positions, from_end=place < 0) == place)

    return Limit(level, find)


def _at_name(level: Level, names: Leaf, name: str, nth: int | None = None) -> Limit:
    """Returns the limit to the element that has this name in the list of names beside it.

    Of an array of fixed length, whose elements are columns of their own: to rows where it is `nth`.
    """

    def find(values: Values, positions: Ints) -> TruthValues:
        texts, owners = values.texts(names), values.elements(names.level).owners
        has_name = np.array([word == name for word in texts.words], np.bool_)[texts.codes]
        found = np.flatnonzero(has_name)[::-1]  # the first of a row is written last
        places = np.full(values.rows, -1)
        places[owners[found]] = values.places(names.level, found, from_end=False)
        if nth is not None:
            return TruthValues.known(places[positions] == nth)
        at = values.places(level, positions, from_end=False)
        return TruthValues.known(at == places[values.elements(level).owners[positions]])

    return Limit(level, find)


def _where_longer(level: Level, sequence: str, count: int, *, is_longer: bool) -> Limit:
    """Returns the limit to sequences of more numbers than this, or else of no more."""

    def find(values: Values, positions: Ints) -> TruthValues:
        lengths = values.numeric(level, f"{sequence}.length")
        if lengths is None:
            return unknown(len(positions))
        return TruthValues.known((lengths[positions] > count) == is_longer)

    return Limit(level, find)


class Place(NamedTuple):
    """A part of the message: a field, or the element of a list; `depth` of the value around it."""

    level: Level
    path: str
    kind: str | Definition
    length: int | None
    depth: int

    def fields(self, definition: Definition) -> dict[str, Place]:
        """Returns the fields of the message that lies here."""
        level, path, _, _, depth = self
        return {
            field.name: Place(level, _below(path, field.name), field.kind, field.length, depth + 1)
            for field in definition.fields
            if field.name != _FILLER
        }

    def element(self) -> Place:
        """Returns the elements of the list that lies here."""
        return Place(Level(self.level, self.path), "", self.kind, None, self.depth + 1)


class Object(NamedTuple):
    """A message that is shown field by field, or an object that the conversions make.

    Attributes:
        fields: what stands under each name; of a message it is made when it is asked for, which may
            raise `UnknownShapeError`.
        place: of a message.
        xyzw: the rotation as its message has it, of angles that a message was converted to.
        is_summary: whether it is a `messages.conversions.Summary`.
    """

    fields: Mapping[str, Node]
    place: Place | None = None
    xyzw: Object | None = None
    is_summary: bool = False


class Listing(NamedTuple):
    """A list of the elements of a level."""

    level: Level
    element: Node


class Items(NamedTuple):
    """A list of so many for all rows."""

    items: tuple[Leaf, ...]


class Narrowed(NamedTuple):
    """A node that stands in the value of some rows or elements alone, and null in the others."""

    limit: Limit
    node: Node


class Choice(NamedTuple):
    """An array of numbers (`array`), which is shown as one of these, whichever holds for a row."""

    cases: tuple[Node, ...]
    array: Node


@dataclass(frozen=True, slots=True, eq=False)
class Nothing:
    """Null."""


NOTHING: Final = Nothing()

Node: TypeAlias = Leaf | Object | Listing | Items | Narrowed | Choice | Nothing
Limits: TypeAlias = tuple[Limit, ...]


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
        if current.parent is None:
            return kept, owners
        owners, current = values.elements(current).owners[owners], current.parent


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
            return self.shown(self._root)
        return Object(
            {
                name: NOTHING if node is None else _converted(name, node)
                for name, node in nodes.items()
            }
        )

    def find(self, path: str) -> Node | None:
        """Returns what `SchemaExtractor.exact_at` returns for a path; None where nothing is.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        name, *inner = path.split(".")
        node: Node | None = None
        if name in self._fields:
            whole = self._at(self._fields[name])
            node = None if whole is None else descend(_converted(name, whole), inner)
        elif not self._fields:
            node = descend(self.shown(self._root), [name, *inner])
        if node is None:
            plain = self._at([name, *inner])
            node = None if plain is None else _with_changed_leaves(plain, _quaternion_as_xyzw)
        return node

    def shown(self, place: Place) -> Node:
        """Returns a part of the message as the value shows it."""
        level, path, kind, length, depth = place
        if length is None and isinstance(kind, str):
            return Leaf(level, (path,), _kind(kind))
        if depth >= MAX_DEPTH:
            raise UnknownShapeError(f"{path} lies {depth} levels deep")
        if length is not None or isinstance(kind, str):
            return self._array(place)
        return self._message(place, kind)

    def _message(self, place: Place, definition: Definition) -> Node:
        level, path, *_ = place
        kind = kind_of_type(definition.type, [field.name for field in definition.fields])
        if kind is ValueKind.TIME:
            return Leaf(level, (path,), Kind.REAL, Conversion.SECONDS)
        fields = place.fields(definition)
        sources = [field.path for field in fields.values()]
        are_numbers = all(
            field.length is None and isinstance(field.kind, str) and _kind(field.kind) in NUMBERS
            for field in fields.values()
        )
        if kind is ValueKind.VECTOR and are_numbers:
            return _vector(level, sources)
        if kind is ValueKind.QUATERNION:
            xyzw = Object({name: _real(level, _below(path, name)) for name in "xyzw"})
            return _angles_of(level, sources, xyzw) if are_numbers else NOTHING
        summarized = SUMMARIZED.get(definition.type)

        def shown(name: str) -> Node:
            make = partial(self._summary, message) if name == summarized else self.shown
            return make(fields[name])

        message = Object(Lazily(fields, shown), place)
        return message

    def _plain(self, place: Place) -> Node:
        """Returns a part of the message as its definition has it, to be walked further."""
        kind = place.kind
        if isinstance(kind, str):
            return self.shown(place)
        if place.length is not None:
            element = place.element()
            return Listing(element.level, self._plain(element))
        fields = place.fields(kind)
        return Object(Lazily(fields, lambda name: self._plain(fields[name])), place)

    def _summary(self, message: Object, place: Place) -> Node:
        """Returns what the conversions make of the data of an image, a map or a magnet.

        Raises:
            UnknownShapeError: it is a plain image or a cloud, or the definition is not the standard
                one.
        """
        around = message.place.kind if message.place else ""
        kind = around.type.rpartition("/")[2] if isinstance(around, Definition) else ""
        if kind == "MagneticField":
            node = self.shown(place)
            if is_object(node) and node.place is None:
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
            return Object(parts, is_summary=True)
        if kind != "OccupancyGrid":
            raise UnknownShapeError("images and clouds are no columns")
        shape = tuple(leaf(Kind.INTEGER, "info", name) for name in ("height", "width"))
        return Object({"bytes": count, "shape": Items(shape)}, is_summary=True)

    @cached_property
    def _root(self) -> Place:
        return Place(ROWS, "", self.definition, None, 0)

    def _at(self, path: Sequence[str]) -> Node | None:
        node = descend(self.shown(self._root), path)
        if node is not None:
            return node
        plain = descend(self._plain(self._root), path)
        return None if plain is None else _with_changed_leaves(plain, self._as_shown)

    def _as_shown(self, node: Node) -> Node:
        """Returns the end of a walk through definitions as the value shows it."""
        if isinstance(node, Object) and node.place is not None:
            return self.shown(node.place)
        return node

    def _array(self, place: Place) -> Node:
        level, path, kind, length, _ = place
        element = place.element()
        listing = Listing(element.level, self.shown(element))
        if not isinstance(kind, str) or _kind(kind) is Kind.TEXT:
            return listing
        count, key = (self._limit, "bytes") if kind in _BYTES else (MAX_EXACT_NUMBERS, "numbers")
        counted = Leaf(level, (f"{path}.length",), Kind.INTEGER)
        summary = Object({key: counted}, is_summary=True)
        if length == SEQUENCE:
            longer = _where_longer(level, path, count, is_longer=True)
            shorter = _where_longer(level, path, count, is_longer=False)
            return Choice((Narrowed(longer, summary), Narrowed(shorter, listing)), listing)
        size = length or 0
        array: Node = listing
        if size <= MAX_NUMBERS:
            array = Items(
                tuple(Leaf(level, (f"{path}.{nth}",), _kind(kind)) for nth in range(size))
            )
        return array if size <= count else Choice((summary,), array)


def _converted(name: str, node: Node) -> Node:
    """Returns the value of a name of the schema map: an array as the point or turn it is."""
    if isinstance(node, Narrowed):
        return Narrowed(node.limit, _converted(name, node.node))
    count = 3 if name in POINTS else 4 if name == "orientation" else 0
    array = node.array if isinstance(node, Choice) else node
    if count and isinstance(node, Choice) and isinstance(array, Listing) and len(node.cases) > 1:
        raise UnknownShapeError(f"{name} has another length in each message")
    if not count or not isinstance(array, Items) or len(array.items) != count:
        return node
    is_numeric = all(leaf.is_number for leaf in array.items)
    level, first, *others = array.items[0].level, *(leaf.sources[0] for leaf in array.items)
    if name in POINTS:
        return _vector(level, [first, *others]) if is_numeric else node
    # PX4 writes w first.
    return _angles_of(level, [*others, first]) if is_numeric else NOTHING


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
        elif isinstance(node, Object) and segment in node.fields:
            node = node.fields[segment]
        else:
            return None
    return node


def at_field(root: Node, dot_path: str) -> Sequence[Spot]:
    """Returns what is at a dot-path in the value, as `analysis.conditions.at_field` finds it.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    head, _, name = dot_path.partition(".")
    fields = root.fields if isinstance(root, Object) else {}
    lists = (fields[key] for key in ELEMENT_NAMES if key in fields and key != head)
    names = next((node.element for node in lists if isinstance(node, Listing)), None)
    if name and head in fields and isinstance(names, Leaf) and not _INDEX.fullmatch(name):
        found = list[Spot]()
        for array, limits in opened(Spot(fields[head])):
            if isinstance(array, Listing) and isinstance(array.element, Leaf):
                element = Narrowed(_at_name(array.level, names, name), array.element)
                found.append(Spot(element, limits))
            elif isinstance(array, Items):
                for nth, leaf in enumerate(array.items):
                    element = Narrowed(_at_name(leaf.level, names, name, nth), leaf)
                    found.append(Spot(element, limits))
            else:  # such as the summary of a long one
                found += _along([Spot(array, limits)], name)
        return found
    return _along([Spot(root)], dot_path)


def _along(spots: Sequence[Spot], dot_path: str) -> Sequence[Spot]:
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
                yield from ((path, item, limits) for item in node.items)
            elif isinstance(node, Object):
                waiting.extend(
                    (_below(path, key), Spot(child, limits))
                    for key, child in reversed([*node.fields.items()])
                    if not node.is_summary or (isinstance(child, Leaf) and child.kind is Kind.TEXT)
                )


def is_object(node: Node | None) -> TypeGuard[Object]:
    """Returns whether a node is an object that may be a detection, or have some in it."""
    return isinstance(node, Object) and node.xyzw is None


def _step(spot: Spot, segment: str) -> Iterator[Spot]:
    for node, limits in opened(spot):
        if isinstance(node, Object):
            if segment in node.fields:
                yield Spot(node.fields[segment], limits)
        elif isinstance(node, Listing | Items) and _INDEX.fullmatch(segment):
            yield Spot(_element_at(node, int(segment)), limits)
        elif isinstance(node, Listing):
            yield from _step(Spot(node.element, limits), segment)


def _element_at(node: Listing | Items, index: int) -> Node:
    if isinstance(node, Listing):
        return Narrowed(_at_place(node.level, index), node.element)
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
    return node.xyzw if isinstance(node, Object) and node.xyzw is not None else node


def _below(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _real(level: Level, source: str) -> Leaf:
    return Leaf(level, (source,), Kind.REAL)


def _vector(level: Level, sources: Sequence[str]) -> Object:
    return Object({axis: _real(level, source) for axis, source in zip("xyz", sources, strict=True)})


def _angles_of(level: Level, sources: Sequence[str], xyzw: Object | None = None) -> Object:
    angles = (Conversion.ROLL, Conversion.PITCH, Conversion.YAW)
    leaves = [Leaf(level, tuple(sources), Kind.REAL, angle) for angle in angles]
    return Object(dict(zip(ANGLES, leaves, strict=True)), xyzw=xyzw)


def _kind(primitive: str) -> Kind:
    if primitive == "bool":
        return Kind.BOOLEAN
    if primitive in {"string", "wstring"}:
        return Kind.TEXT
    return Kind.REAL if primitive.startswith("float") else Kind.INTEGER

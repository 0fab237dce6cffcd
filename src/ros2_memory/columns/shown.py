"""The extracted value of a type's messages as a tree over its columns.

`SchemaExtractor.exact` turns one decoded message into a value. A `Shape` describes the values of
all messages of a type, from the definition and the schema map alone: which leaves a value has,
under which names, and which column each is read or computed from. One tree serves all tables of a
type.

A tree is built of dicts and lists, as the value is, so that the same functions go through both. A
`Listing` stands for a list with any number of elements, a plain list for a short array of fixed
length. In place of a number, boolean or text a tree has a `Leaf`, whose limits say which rows have
it, and `NOTHING` in place of null. `numbers` and `words_of` read a field in all rows of a table.
"""

from __future__ import annotations

import json
from enum import Enum, auto
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from ros2_memory.analysis import conditions
from ros2_memory.columns.plan import FILLER
from ros2_memory.columns.table import MAX_NUMBERS, Table, Texts
from ros2_memory.columns.values import (
    NUMBERS,
    ROWS,
    Conversion,
    Kind,
    Leaf,
    Level,
    Limit,
    UnknownShapeError,
    Values,
    at_name,
    at_place,
    where_longer,
    where_selected,
    within_limits,
)
from ros2_memory.core.arrays import stable_order
from ros2_memory.core.text import dotted
from ros2_memory.extract import POINTS, SchemaExtractor
from ros2_memory.messages.conversions import (
    ANGLES,
    INDEX,
    SUMMARIZED,
    Selector,
    Summary,
    ValueKind,
    kind_of_type,
    label_names,
    names_beside,
    own_path,
    segments_of,
)
from ros2_memory.messages.to_json import MAX_DEPTH, MAX_EXACT_NUMBERS
from ros2_memory.storage.base import SEQUENCE, Definition

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.columns.stored import Topic
    from ros2_memory.core.arrays import Floats
    from ros2_memory.storage.base import IntArray


T = TypeVar("T")

_LARGEST_INT64: Final = 2**63 - 1
_MAX_PARTS: Final = 5_000
"""Of one value: nested definitions of some lines can spell out more than memory holds."""

_BYTES: Final = frozenset({"uint8", "char"})
"""What rosbags decodes to uint8, whose long arrays are shown as their length."""
_TURNS: Final = (Conversion.ROLL, Conversion.PITCH, Conversion.YAW)


class Constant(Enum):
    """A node that no column is read for."""

    NOTHING = auto()  # null
    UNKNOWN = auto()  # depends on the message: the messages decide


NOTHING: Final = Constant.NOTHING
UNKNOWN: Final = Constant.UNKNOWN

Node: TypeAlias = "Leaf | dict[str, Node] | list[Node] | Constant"


class Listing(list["Node"]):
    """A list of the elements of a level.

    An array of numbers also has the `Summary` that is shown in place of a long one.
    """

    def __init__(self, level: Level, *parts: Node) -> None:
        super().__init__(parts)
        self.level = level

    @property
    def element(self) -> Node:
        """What each element is."""
        return self[0]


class Place(NamedTuple):
    """Where a part of the message lies: a field, or the elements of a list.

    Attributes:
        level: the rows or elements that have it.
        path: its dot-path in the level.
        kind: its type, or that of its elements.
        length: of an array or sequence, as of a `Field`; None if it is neither.
        depth: how many objects and lists are around it.
    """

    level: Level
    path: str
    kind: str | Definition
    length: int | None
    depth: int

    def fields(self, definition: Definition) -> dict[str, Place]:
        """Returns the fields of the message that lies here."""
        level, path, _, _, depth = self
        return {
            field.name: Place(level, dotted(path, field.name), field.kind, field.length, depth + 1)
            for field in definition.fields
            if field.name != FILLER
        }

    def element(self) -> Place:
        """Returns the elements of the list that lies here."""
        return Place(Level(self.level, self.path), "", self.kind, None, self.depth + 1)


class Shape:
    """The value that an extractor returns for messages of a type.

    Args:
        definition: the type's fields.
        type_name: the type as the channel names it.
        extractor: has the schema map.

    Attributes:
        type: as the channel names it.
    """

    def __init__(self, definition: Definition, type_name: str, extractor: SchemaExtractor) -> None:
        self.type = type_name
        self._definition = definition
        self._fields = extractor.fields_of(type_name)
        self._limit = extractor.limit
        self._parts = 0

    @cached_property
    def value(self) -> Node:
        """The whole value, as `SchemaExtractor.exact` returns it.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        nodes = {name: self.at(path) for name, path in self._fields.items()}
        if all(node is None for node in nodes.values()):
            return self._whole
        return {
            name: NOTHING if node is None else _convert(name, node) for name, node in nodes.items()
        }

    def find(self, path: str) -> Node | None:
        """Returns what `SchemaExtractor.exact_at` returns for a path; None if no field is there.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        name, *inner = segments = segments_of(path)
        node: Node | None = None
        if name in self._fields:
            mapped = self.at(self._fields[name])
            node = None if mapped is None else _descend(_convert(name, mapped), inner)
        elif not self._fields:
            node = _descend(self._whole, segments)
        if node is not None:
            return node
        node = self.at(segments)
        if node is None:
            own = own_path(path, self._fields)
            return at_field(self.value, own) if names_beside(self.value, own) else None
        if any(leaf.conversion in _TURNS for leaf in leaves_of(node)):
            raise UnknownShapeError(f"{path} is a rotation, or has one")  # shown as x, y, z, w
        return node

    @cached_property
    def _whole(self) -> Node:
        return self._node(Place(ROWS, "", self._definition, None, 0))

    def at(self, path: Sequence[str]) -> Node | None:
        """Returns what the value has for a path in the message; None if no field is there.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        return _descend(self._whole, path, parts=True)

    def _node(self, place: Place) -> Node:
        """Returns what the value has for a part of the message."""
        level, path, kind, length, depth = place
        self._parts += 1
        if self._parts > _MAX_PARTS:
            return UNKNOWN
        if length is None and isinstance(kind, str):
            return Leaf(level, (path,), _kind(kind))
        if depth >= MAX_DEPTH:
            return UNKNOWN
        if length is not None or isinstance(kind, str):
            return self._array_node(place)
        return self._message_node(place, kind)

    def _message_node(self, place: Place, definition: Definition) -> Node:
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
            return _angles_of(level, sources) if are_numbers else NOTHING
        nodes = {name: self._node(field) for name, field in fields.items()}
        for name, names in label_names(nodes, definition.constants).items():
            leaf = nodes[name]
            if isinstance(leaf, Leaf) and leaf.kind is Kind.INTEGER:
                nodes[name] = leaf._replace(names=tuple(names.items()))
        summarized = SUMMARIZED.get(definition.type)
        if summarized in fields:
            nodes[summarized] = _summary(definition.type, nodes, fields[summarized])
        return nodes

    def _array_node(self, place: Place) -> Node:
        level, path, kind, length, _ = place
        element = place.element()
        leaf = self._node(element)
        if not isinstance(kind, str) or not isinstance(leaf, Leaf) or leaf.kind is Kind.TEXT:
            return Listing(element.level, leaf)
        most, key = (self._limit, "bytes") if kind in _BYTES else (MAX_EXACT_NUMBERS, "numbers")
        summary = Summary({key: _size(place)})
        if length == SEQUENCE:
            longer = where_longer(level, path, most, is_longer=True)
            shorter = where_longer(level, path, most, is_longer=False)
            return Listing(element.level, with_limit(leaf, shorter), with_limit(summary, longer))
        size = length or 0
        if size > most:
            return summary
        if size > MAX_NUMBERS:
            return Listing(element.level, leaf)
        return [Leaf(level, (f"{path}.{nth}",), leaf.kind) for nth in range(size)]


def _size(place: Place) -> Node:
    """Returns the length of a sequence for its summary: in a list, where conditions do not look."""
    return [Leaf(place.level, (f"{place.path}.length",), Kind.INTEGER)]


def _summary(type_name: str, fields: dict[str, Node], place: Place) -> Node:
    """Returns what conversions make of the data of a compressed image, a map or a magnet.

    Returns `UNKNOWN` for other types, and if the definition is not the standard one.
    """
    kind = type_name.rpartition("/")[2]
    if kind == "MagneticField":
        field = fields[place.path.rpartition(".")[2]]
        return field if isinstance(field, dict) and [*field] == [*"xyz"] else UNKNOWN
    if not isinstance(place.kind, str) or place.length != SEQUENCE:
        return UNKNOWN
    encoding, info = fields.get("format"), fields.get("info")
    if kind == "CompressedImage" and isinstance(encoding, Leaf) and encoding.kind is Kind.TEXT:
        return Summary({"bytes": _size(place), "encoding": encoding})  # as markers have them
    if kind == "OccupancyGrid" and isinstance(info, dict):
        shape = [info.get(name, UNKNOWN) for name in ("height", "width")]
        if all(isinstance(length, Leaf) and length.kind is Kind.INTEGER for length in shape):
            return Summary({"bytes": _size(place), "shape": shape})
    return UNKNOWN


def _convert(name: str, node: Node) -> Node:
    """Returns the value of a name of the schema map: an array becomes a point or a rotation."""
    count = 0
    if name in POINTS:
        count = 3
    elif name == "orientation":
        count = 4
    if count and isinstance(node, Listing) and len(node) > 1:
        raise UnknownShapeError(f"{name} has another length in each message")
    if not isinstance(node, list) or isinstance(node, Listing) or len(node) != count:
        return node
    leaves = leaves_of(node)
    level, sources = leaves[0].level, [leaf.sources[0] for leaf in leaves]
    is_numeric = all(leaf.is_number for leaf in leaves)
    if name in POINTS:
        return _vector(level, sources) if is_numeric else node
    # PX4 writes w first.
    return _angles_of(level, [*sources[1:], sources[0]]) if is_numeric else NOTHING


@lru_cache(maxsize=128)
def _shape(definition: Definition, type_name: str, extractor: SchemaExtractor) -> Shape:
    return Shape(definition, type_name, extractor)


def shape_of(rows: Table | Topic, extractor: SchemaExtractor) -> Shape | None:
    """Returns the shape of the type of a table or of parts; None if their messages decide."""
    if rows.definition is None or "" in rows.left_out:
        return None
    return _shape(rows.definition, rows.channel.type, extractor)


class ByType(Generic[T]):
    """Remembers what is made of the shape of each type.

    Args:
        extractor: has the schema map.
        make: makes it; raises `UnknownShapeError` if it depends on the message.
    """

    def __init__(self, extractor: SchemaExtractor, make: Callable[[Shape], T]) -> None:
        self._extractor = extractor
        self._make = make
        self._known: dict[Shape, T | None] = {}

    def of(self, rows: Table | Topic) -> T | None:
        """Returns what is made for the type of a table or of parts; None if messages decide."""
        shape = shape_of(rows, self._extractor)
        if shape is None:
            return None
        if shape not in self._known:
            try:
                self._known[shape] = self._make(shape)
            except UnknownShapeError:
                self._known[shape] = None
        return self._known[shape]


def _descend(node: Node, path: Sequence[str], *, parts: bool = False) -> Node | None:
    """Returns what is at a path, as `messages.conversions.descend` does; None if no field is there.

    Args:
        node: where to begin.
        path: of the schema map.
        parts: whether the path may lead to x, y, z or w of a rotation, which is shown as angles.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    for nth, segment in enumerate(path):
        if isinstance(node, Listing) and len(node) > 1:
            # A path leads into a long array, too, though the value only has a summary of it.
            leaf = _map_leaves(node.element, lambda leaf: leaf._replace(limits=()))
            node = Listing(node.level, leaf)
        if node is NOTHING:
            return node
        if Selector.of(segment) is not None:
            raise UnknownShapeError(f"which elements {segment} selects depends on the message")
        if isinstance(node, list) and INDEX.fullmatch(segment):
            node = next(iter(_picked(node, segment) or ()), NOTHING)
            continue
        if isinstance(node, Listing):
            inner = _descend(node.element, path[nth:], parts=parts)
            return None if inner is None else Listing(node.level, inner)
        field = _field(node, segment, parts=parts)
        if field is None:
            return None
        node = field
    return node


def _field(node: Node, name: str, *, parts: bool) -> Node | None:
    """Returns a field of a node; see `_descend`."""
    if isinstance(node, dict) and name in node:
        return node[name]
    is_time = isinstance(node, Leaf) and node.conversion is Conversion.SECONDS
    is_text = isinstance(node, Leaf) and node.kind is Kind.TEXT  # which may be JSON
    if node is UNKNOWN or isinstance(node, Summary) or is_time or is_text:
        raise UnknownShapeError(f"{name} is in a part that is not shown as it is")
    xyzw = xyzw_of(node) if parts and isinstance(node, dict) else []
    return dict(zip("xyzw", xyzw, strict=False)).get(name)


def xyzw_of(angles: dict[str, Node]) -> list[Leaf]:
    """Returns the parts of the quaternion that is shown as angles; nothing for any other object."""
    leaf = angles.get(ANGLES[0])
    if not isinstance(leaf, Leaf) or leaf.conversion not in _TURNS:
        return []
    return [Leaf(leaf.level, (part,), Kind.REAL, limits=leaf.limits) for part in leaf.sources]


def at_field(root: Node, dot_path: str) -> list[Node]:
    """Returns what is at a dot-path in the value, as `analysis.conditions.at_field` does.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    names = names_beside(root, dot_path)
    head, _, name = dot_path.partition(".")
    array = root.get(head) if isinstance(root, dict) else None
    leaf = names.element if isinstance(names, Listing) else None
    if isinstance(leaf, Leaf) and leaf.kind is Kind.TEXT and isinstance(array, list):
        return _named_elements(array, leaf, name)
    by_segment = conditions.along(root, segments_of(dot_path), _picked)
    if any(UNKNOWN in nodes for nodes in by_segment):
        raise UnknownShapeError(f"{dot_path} leads to a part that is not known")
    return by_segment[-1]


def texts_above(root: Node, dot_path: str) -> Iterator[tuple[Leaf, str]]:
    """Yields the texts on a dot-path, which may be JSON, each with the rest of the path."""
    path = segments_of(dot_path)
    for nth, nodes in enumerate(conditions.along(root, path, _picked)[1:-1], 1):
        # An index or a selector picks elements of a list, which are the next nodes.
        is_pick = conditions.picked([], path[nth]) is not None
        for node in nodes:
            if is_pick and isinstance(node, list):
                continue
            for leaf in conditions.leaves(node, in_objects=False):
                if isinstance(leaf, Leaf) and leaf.kind is Kind.TEXT:
                    yield leaf, ".".join(path[nth:])


def _named_elements(array: list[Node], names: Leaf, name: str) -> list[Node]:
    """Returns the elements of an array that may have a name in the list of names beside it."""
    if names.level.parent != ROWS or names.limits:
        raise UnknownShapeError(f"{name} is looked for in several lists of names")
    if not isinstance(array, Listing):
        return [
            with_limit(element, at_name(ROWS, names, name, nth))
            for nth, element in enumerate(array)
        ]
    sizes = [part[name] for part in array if isinstance(part, Summary) and name in part]
    return [with_limit(array.element, at_name(array.level, names, name)), *sizes]


def _picked(nodes: list[Node], segment: str) -> list[Node] | None:
    """Returns the elements of a list that a segment may pick, as `conditions.picked`.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    selector = Selector.of(segment)
    if not isinstance(nodes, Listing):
        if selector is None:
            return conditions.picked(nodes, segment)
        raise UnknownShapeError(f"elements that {segment} selects have columns of their own")
    if INDEX.fullmatch(segment):
        return [with_limit(nodes.element, at_place(nodes.level, int(segment)))]
    if selector is None:
        return None
    leaf = nodes.element.get(selector.field) if isinstance(nodes.element, dict) else None
    if not isinstance(leaf, Leaf) or leaf.level != nodes.level:
        raise UnknownShapeError(f"{selector.field} is no field of the elements themselves")
    return [with_limit(nodes.element, where_selected(leaf, selector))]


def leaves_of(node: Node, *, in_objects: bool = True) -> list[Leaf]:
    """Returns the leaves of a node, as `analysis.conditions.leaves`, in their order.

    Raises:
        UnknownShapeError: they depend on the message.
    """
    nodes = [*conditions.leaves(node, in_objects=in_objects)]
    if UNKNOWN in nodes:
        raise UnknownShapeError("it depends on the message")
    # The last one comes first there.
    return [leaf for leaf in reversed(nodes) if isinstance(leaf, Leaf)]


def with_limit(node: Node, limit: Limit) -> Node:
    """Returns a node with a limit to the rows or elements that have it."""
    return _map_leaves(node, lambda leaf: leaf._replace(limits=(*leaf.limits, limit)))


def _map_leaves(node: Node, change: Callable[[Leaf], Leaf]) -> Node:
    """Returns a node in which each leaf is replaced by what `change` returns for it."""
    if isinstance(node, Leaf):
        return change(node)
    if isinstance(node, Listing):
        return Listing(node.level, *(_map_leaves(part, change) for part in node))
    if isinstance(node, list):
        return [_map_leaves(part, change) for part in node]
    if isinstance(node, dict):
        return type(node)({name: _map_leaves(part, change) for name, part in node.items()})
    return node


def _vector(level: Level, sources: Sequence[str]) -> Node:
    return {
        axis: Leaf(level, (source,), Kind.REAL) for axis, source in zip("xyz", sources, strict=True)
    }


def _angles_of(level: Level, sources: Sequence[str]) -> Node:
    leaves = [Leaf(level, tuple(sources), Kind.REAL, turn) for turn in _TURNS]
    return dict(zip(ANGLES, leaves, strict=True))


def _kind(primitive: str) -> Kind:
    if primitive == "bool":
        return Kind.BOOLEAN
    if primitive in {"string", "wstring"}:
        return Kind.TEXT
    return Kind.REAL if primitive.startswith("float") else Kind.INTEGER


class FieldNumbers(NamedTuple):
    """The numbers of a field in the rows of a table.

    Attributes:
        rows: the row of each number, ascending; a row may have none, or several.
        numbers: finite; int64 if all are integers that fit, else float64.
        errors: the most by which each of them is off. Angles of exact quaternions may differ in
            their last digits.
        exactly: returns the exact numbers at some ascending positions; None if only the bag has
            them, and for a field with several numbers in a message.
    """

    rows: IntArray
    numbers: IntArray | Floats
    errors: Floats
    exactly: Callable[[IntArray], Floats] | None = None

    @property
    def are_exact(self) -> bool:
        """Whether none of them is off."""
        return not self.errors.any()


def numbers(table: Table, field: str, extractor: SchemaExtractor) -> FieldNumbers | None:
    """Returns the numbers of a field; None if the table lacks some: then the bag has to be read.

    They are the numbers in what `SchemaExtractor.exact_at` returns, without the sizes in the
    summary of an array. Booleans are no numbers.

    Args:
        table: the messages.
        field: dot-path in the extracted value, or else in the message.
        extractor: has the schema map.
    """
    try:
        parts = [_numbers_of(Values(table), leaf) for leaf in _leaves(table, field, extractor)]
    except UnknownShapeError:
        return None
    if not parts:
        return FieldNumbers(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
    return parts[0] if len(parts) == 1 else _joined(parts)


def column_of(table: Table, field: str, extractor: SchemaExtractor) -> str | None:
    """Returns the path of the column that has all numbers of a field; None if there is none."""
    try:
        [leaf] = _leaves(table, field, extractor)
    except (UnknownShapeError, ValueError):  # none, or several
        return None
    is_stored = leaf.level is ROWS and leaf.conversion is Conversion.STORED
    return leaf.sources[0] if is_stored and not leaf.limits else None


def words_of(table: Table, field: str | None, extractor: SchemaExtractor) -> Texts | None:
    """Returns a field of each row as JSON text; None if the messages have to be read for it.

    They have to be read if the field is more than one text, boolean or whole number, or if the
    table has no column with its exact values.
    """
    try:
        node = _node(table, field, extractor)
        if isinstance(node, dict):
            [node] = node.values()
        if (
            not isinstance(node, Leaf)
            or node.level is not ROWS
            or node.conversion is not Conversion.STORED
            or node.kind is Kind.REAL
            or node.limits
        ):
            return None
        if node.kind is Kind.TEXT:
            texts = Values(table).texts(node)
            return Texts(texts.codes, tuple(map(json.dumps, texts.words)))
        distinct, codes = np.unique(Values(table).numbers(node).values, return_inverse=True)
        return Texts(codes.astype(np.uint32), tuple(map(json.dumps, distinct.tolist())))
    except (UnknownShapeError, ValueError):  # more than one part
        return None


def _joined(parts: Sequence[FieldNumbers]) -> FieldNumbers:
    rows = np.concatenate([part.rows for part in parts])
    joined = np.concatenate([part.numbers for part in parts])
    errors = np.concatenate([part.errors for part in parts])
    order = stable_order(rows)
    return FieldNumbers(rows[order], joined[order], errors[order])


def _node(table: Table, field: str | None, extractor: SchemaExtractor) -> Node | None:
    """Returns a field of the value, or the whole value; None if there is no such field.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    shape = shape_of(table, extractor)
    if shape is None:
        raise UnknownShapeError("there are no columns")
    return shape.value if field is None else shape.find(field)


def _leaves(table: Table, field: str, extractor: SchemaExtractor) -> list[Leaf]:
    """Returns the numbers of a field, without those of a summary."""
    node = _node(table, field, extractor)
    return [] if node is None else [leaf for leaf in leaves_of(node) if leaf.is_number]


def _numbers_of(values: Values, leaf: Leaf) -> FieldNumbers:
    column, errors, exactly = values.numbers(leaf)
    everything = np.arange(len(column))
    positions, rows = within_limits(values, leaf.level, everything, leaf.limits, surely=True)
    possible, _ = within_limits(values, leaf.level, everything, leaf.limits, surely=False)
    if len(positions) < len(possible) or not values.holds_all(leaf):
        raise UnknownShapeError("some numbers have no column, or may not be in the value")
    if len(positions) < len(column):
        column = column[positions]
    is_finite = np.isfinite(column)
    if not is_finite.all():
        column, rows, positions = column[is_finite], rows[is_finite], positions[is_finite]
    if column.dtype.kind != "u" or not (column > _LARGEST_INT64).any():
        is_whole = column.dtype.kind in "iu"
        column = column.astype(np.int64 if is_whole else np.float64, copy=False)
    return FieldNumbers(
        rows,
        column,
        errors[positions],
        None if exactly is None else lambda at: exactly(positions[at]),
    )

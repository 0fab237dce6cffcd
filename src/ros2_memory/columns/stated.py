"""What the messages of a table state, from its columns alone.

The same as `state_of(extractor.exact(message))` for each message. Where the columns do not settle
it (a shape that differs from message to message, a number that was rounded across a limit, the id
of a goal, which has no columns) the messages are named that have to be read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.state_changes import (
    BATTERY,
    CHARGE,
    COMMAND,
    DIAGNOSTICS,
    GOALS,
    MAX_LEVELS,
    VELOCITIES,
    charge_levels,
    is_still,
)
from ros2_memory.analysis.stated import NOTHING, Facts, Stated, joined_facts
from ros2_memory.analysis.topic_events import (
    MAX_FLAGS,
    MAX_LABELS,
    has_errors,
    has_events,
    state_of,
)
from ros2_memory.columns.scores import hypotheses, is_object, scored
from ros2_memory.columns.shown import (
    Items,
    Listing,
    Narrowed,
    Shape,
    Spot,
    UnknownShapeError,
    children,
    leaves_below,
    placed,
)
from ros2_memory.columns.table import Texts
from ros2_memory.columns.values import ROWS, Kind, Leaf, Made, Values
from ros2_memory.messages.detections import LISTS, MAX_DEPTH, detections_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.stated import Word
    from ros2_memory.columns.scores import Scored
    from ros2_memory.columns.shown import Node
    from ros2_memory.columns.table import Table
    from ros2_memory.columns.values import Floats, Ints
    from ros2_memory.core.model import JsonValue
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import Definition


class FromColumns(NamedTuple):
    """What the rows of a table state, without their log times, and but for some messages.

    Attributes:
        stated: what is known.
        unsure: the rows of the messages that have to be read besides, ascending.
        alike: by row, equal numbers for consecutive messages that state the same, so that one of
            them has to be read; None where only those that are `unsure` have to be.
    """

    stated: Stated
    unsure: Ints
    alike: Ints | None = None

    def to_read(self, index: Ints | None) -> Ints:
        """Returns the positions, among some rows (None: all), of the messages to be read."""
        if self.alike is not None:
            alike = self.alike if index is None else self.alike[index]
            return np.flatnonzero(np.diff(alike, prepend=-1))
        return self.unsure if index is None else np.flatnonzero(np.isin(index, self.unsure))


class StatedColumns:
    """Reads what messages state from tables; remembers what it looks for in each type.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._extractor = extractor
        self._known: dict[tuple[Definition, str], _Plan | None] = {}

    def of(self, table: Table) -> FromColumns | None:
        """Returns what the messages of a table state; None where they all have to be read."""
        if table.definition is None or "" in table.left_out:
            return None
        key = (table.definition, table.channel.type)
        if key not in self._known:
            try:
                shape = Shape(table.definition, table.channel.type, self._extractor)
                self._known[key] = _Plan.of(shape.value, table.channel.type)
            except UnknownShapeError:
                self._known[key] = None
        plan = self._known[key]
        try:
            return None if plan is None else plan.read(table)
        except UnknownShapeError:
            return None


@dataclass(frozen=True, slots=True)
class _Labels:
    """Objects that may be detections: what names them, and what else there is where nothing does.

    `is_best`: they are named by the best of several hypotheses, which is what is scored.
    """

    scored: Scored
    otherwise: tuple[_Source, ...]
    is_best: bool = False


@dataclass(frozen=True, slots=True)
class _Words:
    """A list of labels."""

    leaf: Leaf


@dataclass(frozen=True, slots=True)
class _Json:
    """A text that may be JSON, and how deep detections are looked for in it."""

    leaf: Leaf
    depth: int


_CHARGE: Final = ((CHARGE, ""),)
_COMMAND: Final = ((COMMAND, ""),)
_Source: TypeAlias = "_Labels | _Words | _Json"


class _Plan(NamedTuple):
    """What is looked for in the messages of a type."""

    type: str
    labels: tuple[_Source, ...] = ()
    flags: tuple[tuple[str, Leaf], ...] = ()
    entry: tuple[Leaf, ...] = ()
    numbers: tuple[Leaf, ...] = ()

    @classmethod
    def of(cls, value: Node, type_name: str) -> _Plan:
        """Returns what is looked for in a value.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        if type_name == GOALS:
            return cls(type_name, numbers=tuple(_of_goals(value)))
        if has_errors(type_name):
            return cls(type_name, entry=_entry(value, type_name))
        numbers: tuple[Leaf, ...] = ()
        if type_name in VELOCITIES:
            numbers = tuple(_numbers_in(value))
        elif type_name == BATTERY:
            numbers = tuple(_charge(value))
        if not has_events(type_name):
            return cls(type_name, numbers=numbers)
        flags = tuple(_flags(value, ""))
        if len(flags) > MAX_FLAGS:
            raise UnknownShapeError("more booleans than are tracked")
        return cls(type_name, tuple(_sources(value, MAX_DEPTH)), flags, numbers=numbers)

    def read(self, table: Table) -> FromColumns:
        """Returns what the messages of a table state.

        Raises:
            UnknownShapeError: they have to be read.
        """
        values = Values(table)
        stated, to_read = Stated(table.log_times), np.empty(0, np.int64)
        if self.type == GOALS:
            return FromColumns(stated, to_read, _alike(values, self.numbers))
        if self.entry:
            return FromColumns(_entries(values, self.entry, self.type, stated), to_read)
        labels = joined_facts([found for each in self.labels for found in _read(values, each)])
        if labels.rows.size and np.bincount(labels.rows).max() > MAX_LABELS:
            raise UnknownShapeError("more labels than are tracked")
        flags = joined_facts([_booleans(values, path, leaf) for path, leaf in self.flags])
        levels = NOTHING
        if self.numbers:
            of = _charges if self.type == BATTERY else _commands
            levels, to_read = of(values, self.numbers)
        return FromColumns(stated._replace(labels=labels, flags=flags, levels=levels), to_read)


# What a type has


def _sources(node: Node, depth: int) -> Iterator[_Source]:
    """Yields where detections may be in a value; it goes where `detections_of` goes."""
    if depth == 0:
        return
    if isinstance(node, Narrowed):
        raise UnknownShapeError("an element of a list stands alone")
    if isinstance(node, Leaf):
        if node.kind is Kind.TEXT:
            yield _Json(node, depth)
    elif isinstance(node, Listing | Items):
        for element in [node.element] if isinstance(node, Listing) else node.items:
            if is_object(element) or isinstance(element, Narrowed):
                yield from _sources(element, depth - 1)
    elif is_object(node):
        yield from _in_object(dict(children(node)), depth)


def _in_object(fields: dict[str, Node], depth: int) -> Iterator[_Source]:
    named, several = scored(fields), hypotheses(fields)
    if named is not None:
        yield _Labels(named, tuple(_in_fields(fields, depth)))
    elif several is not None:
        yield _Labels(several, tuple(_in_fields(fields, depth)), is_best=True)
    else:
        yield from _in_fields(fields, depth)


def _in_fields(fields: dict[str, Node], depth: int) -> Iterator[_Source]:
    for name, node in fields.items():
        element = node.element if isinstance(node, Listing) else None
        if name in LISTS and isinstance(element, Leaf) and element.kind is Kind.TEXT:
            yield _Words(element)
        yield from _sources(node, depth - 1)


def _flags(node: Node, path: str) -> Iterator[tuple[str, Leaf]]:
    """Yields the booleans of objects; none of lists."""
    if isinstance(node, Narrowed):
        raise UnknownShapeError("an element of a list stands alone")
    if isinstance(node, Leaf) and node.kind is Kind.BOOLEAN:
        yield path, node
    elif is_object(node):
        for name, inner in children(node):
            yield from _flags(inner, f"{path}.{name}" if path else name)


def _entry(value: Node, type_name: str) -> tuple[Leaf, ...]:
    """Returns level, name and text of a log entry, or of the elements of a list of diagnostics."""
    node: Node | None = value
    if type_name == DIAGNOSTICS:
        listed = _child(value, "status")
        node = listed.element if isinstance(listed, Listing) else None
    text = "message" if type_name == DIAGNOSTICS else "msg"
    found = [] if node is None else [_child(node, name) for name in ("level", "name", text)]
    leaves = tuple(leaf for leaf in found if isinstance(leaf, Leaf))
    kinds = [leaf.kind for leaf in leaves]
    if kinds != [Kind.INTEGER, Kind.TEXT, Kind.TEXT]:
        raise UnknownShapeError("the definition is not the standard one")
    return leaves


def _child(node: Node, name: str) -> Node | None:
    return dict(children(node)).get(name) if is_object(node) else None


def _charge(value: Node) -> Iterator[Leaf]:
    leaf = _child(value, "percentage")
    if isinstance(leaf, Leaf) and leaf.kind is Kind.REAL:
        yield leaf


def _numbers_in(value: Node) -> Iterator[Leaf]:
    """Yields the floats of a command."""
    for _, leaf, limits in leaves_below(Spot(value)):
        if limits or leaf.level != ROWS:
            raise UnknownShapeError("a command has a list")
        if leaf.kind is Kind.REAL:
            yield leaf


def _of_goals(value: Node) -> Iterator[Leaf]:
    """Yields what tells the goals of a status apart, but for their ids, and their statuses."""
    listed = _child(value, "status_list")
    if not isinstance(listed, Listing):
        raise UnknownShapeError("the definition is not the standard one")
    for _, leaf, _ in leaves_below(Spot(listed.element)):
        if leaf.level == listed.level and leaf.made in {Made.STORED, Made.SECONDS}:
            yield leaf
    for end in ("least", "greatest"):
        yield Leaf(listed.level, (f"goal_info.goal_id.uuid.{end}",), Kind.REAL)


# What a table holds


def _read(values: Values, source: _Source) -> Iterator[Facts]:
    """Yields the labels at one place of the messages."""
    if isinstance(source, _Json):
        yield _json(values, source)
        return
    if isinstance(source, _Words):
        texts = _texts(values, source.leaf)
        has = np.array([bool(word) for word in texts.words], np.bool_)
        among = np.flatnonzero(has[texts.codes]) if texts.words else np.empty(0, np.int64)
        yield _labelled(values, source.leaf, texts, among, np.full(len(texts), math.nan))
        return
    scored = source.scored
    name, score, error = _named(values, scored)
    among, size = np.arange(len(name)), len(name)
    if source.is_best:
        elements, parent = values.elements(scored.level), scored.level.parent
        if elements is None or parent is None:
            raise UnknownShapeError("hypotheses are not held")
        among, size = _best(name, score, error, elements.owners), values.size(parent) or 0
    is_named = np.array([bool(word.strip()) for word in name.words], np.bool_)
    among = among[is_named[name.codes[among]]] if name.words else among[:0]
    if among.size < size and any(
        facts.rows.size for inner in source.otherwise for facts in _read(values, inner)
    ):
        raise UnknownShapeError("some objects are detections, and some have such in them")
    yield _labelled(values, scored.labels[0], name, among, score)


def _labelled(values: Values, leaf: Leaf, name: Texts, among: Ints, scores: Floats) -> Facts:
    """Returns labels at some places of a level, by their rows."""
    _, rows = placed(values, leaf.level, among, (), surely=True)
    words = [(word, "") for word in name.words]
    return Facts(rows, name.codes[among].astype(np.int64), scores[among], words)


def _json(values: Values, source: _Json) -> Facts:
    """Returns the labels in texts that are JSON, each of which is parsed once."""
    zone = values.zone(source.leaf)
    if zone is not None and not zone.may_be_json:
        return NOTHING
    texts = _texts(values, source.leaf)
    known: dict[int, list[tuple[str, float]]] = {}
    for code, word in enumerate(texts.words):
        if word[:1] in {"[", "{"}:
            value: JsonValue = word
            for _ in range(MAX_DEPTH - source.depth):
                value = {"": value}
            seen = detections_of(value)
            known[code] = [(e.label, math.nan if e.score is None else e.score) for e in seen]
    among = np.flatnonzero(np.isin(texts.codes, [code for code, seen in known.items() if seen]))
    _, rows = placed(values, source.leaf.level, among, (), surely=True)
    return Facts.of(
        [
            (row, (label, ""), score)
            for row, code in zip(rows.tolist(), texts.codes[among].tolist(), strict=True)
            for label, score in known[code]
        ]
    )


def _booleans(values: Values, path: str, leaf: Leaf) -> Facts:
    zone, rows = values.zone(leaf), np.arange(values.rows)
    if zone is not None and zone.least is not None and zone.least == zone.greatest:
        flags = np.full(rows.size, float(zone.least))
    else:
        found = values.numbers(leaf)
        if found is None:
            raise UnknownShapeError(f"{path} is not held")
        flags = found.values.astype(np.float64)
    return Facts(rows, np.zeros(rows.size, np.int64), flags, [(path, "")])


def _entries(values: Values, entry: tuple[Leaf, ...], type_name: str, stated: Stated) -> Stated:
    """Returns what log entries or diagnostics state: each that is alike is looked at once."""
    zone = values.zone(entry[0])
    if zone is not None and (
        zone.greatest is None or state_of(_value(int(zone.greatest), type_name), type_name).is_empty
    ):
        return stated
    level, (name, text) = values.numbers(entry[0]), [_texts(values, leaf) for leaf in entry[1:]]
    if level is None:
        raise UnknownShapeError("levels are not held")
    numbers = level.values.astype(np.int64)
    telling = [
        number
        for number in np.unique(numbers).tolist()
        if not state_of(_value(number, type_name), type_name).is_empty
    ]
    among = np.flatnonzero(np.isin(numbers, telling))
    _, rows = placed(values, entry[0].level, among, (), surely=True)
    if rows.size and np.bincount(rows).max() > MAX_LEVELS:
        raise UnknownShapeError("more levels than are tracked")
    keys = np.stack([numbers[among], name.codes[among], text.codes[among]])
    alike, codes = np.unique(keys, axis=1, return_inverse=True)
    states = [
        state_of(_value(number, type_name, name.words[who], text.words[what]), type_name)
        for number, who, what in alike.T.tolist()
    ]
    codes = codes.reshape(-1)
    levels = [[((each.name, each.text), each.value) for each in s.levels] for s in states]
    errors = [[((each, ""), math.nan) for each in s.errors] for s in states]
    reports = [[((each, ""), math.nan) for each in s.reports] for s in states]
    return stated._replace(
        levels=_repeated(rows, codes, levels),
        errors=_repeated(rows, codes, errors),
        reports=_repeated(rows, codes, reports),
    )


def _value(level: int, type_name: str, name: str = "", text: str = "") -> JsonValue:
    """Returns a log entry, or diagnostics, of one entry as the extractor shows it."""
    if type_name != DIAGNOSTICS:
        return {"level": level, "name": name, "msg": text}
    return {"status": [{"level": level, "name": name, "message": text}]}


def _repeated(rows: Ints, codes: Ints, states: Sequence[Sequence[tuple[Word, float]]]) -> Facts:
    """Returns the facts of rows, each of which tells what its code does: one fact, or none."""
    once = Facts.of([(nth, *fact) for nth, facts in enumerate(states) for fact in facts])
    if not once.rows.size:
        return NOTHING
    place = np.full(len(states), -1)
    place[once.rows] = np.arange(once.rows.size)
    nth = place[codes]
    kept = nth >= 0
    nth = nth[kept]
    return Facts(rows[kept], once.codes[nth], once.values[nth], once.words)


def _charges(values: Values, leaves: Sequence[Leaf]) -> tuple[Facts, Ints]:
    """Returns how low a battery is, and the rows in which rounding may have changed that."""
    found = values.numbers(leaves[0])
    if found is None or not isinstance(found.error, float):
        raise UnknownShapeError("the charge is not held")
    charges = found.values.astype(np.float64)
    low, levels, high = (charge_levels(charges + off) for off in (-found.error, 0, found.error))
    known = np.flatnonzero((levels >= 0) & (low == high))
    charge = Facts(known, np.zeros(known.size, np.int64), levels[known].astype(np.float64), _CHARGE)
    return charge, np.flatnonzero(low != high)


def _commands(values: Values, leaves: Sequence[Leaf]) -> tuple[Facts, Ints]:
    """Returns whether a velocity is commanded, and the rows in which rounding may hide that."""
    surely, perhaps = np.ones(values.rows, np.bool_), np.ones(values.rows, np.bool_)
    for leaf in leaves:
        found = values.numbers(leaf)
        if found is None or not isinstance(found.error, float):
            raise UnknownShapeError("the command is not held")
        numbers = found.values.astype(np.float64)
        surely &= is_still(numbers, found.error)
        perhaps &= is_still(numbers, -found.error)
    known = np.flatnonzero(surely == perhaps)
    moves = (~surely[known]).astype(np.float64)
    return Facts(known, np.zeros(known.size, np.int64), moves, _COMMAND), np.flatnonzero(
        surely != perhaps
    )


def _alike(values: Values, leaves: Sequence[Leaf]) -> Ints:
    """Numbers the rows by what they list, as far as columns tell: as the one before, or another.

    An action server lists a goal with the time at which it accepted it, so one goal does not take
    the place of another without a trace.
    """
    columns = [values.numbers(leaf) for leaf in leaves]
    found = [column.values for column in columns if column is not None]
    elements = values.elements(leaves[0].level) if leaves else None
    if len(found) < len(columns) or elements is None:
        raise UnknownShapeError("goals are not held")
    first = np.searchsorted(elements.owners, np.arange(values.rows + 1))
    counts = np.diff(first)
    is_new = np.diff(counts, prepend=-1) != 0
    # Each element is compared with the one that has its place in the row before.
    nth = np.arange(elements.owners.size) - first[elements.owners]
    before = np.maximum(first[np.maximum(elements.owners - 1, 0)] + nth, 0)
    before = np.minimum(before, max(elements.owners.size - 1, 0))
    differs = np.zeros(elements.owners.size, np.bool_)
    for column in found:
        differs |= column != column[before]
    is_new[elements.owners[differs]] = True
    return np.cumsum(is_new)


def _named(values: Values, scored: Scored) -> tuple[Texts, Floats, float]:
    """Returns the name of each of some objects, blank where it has none, its score, and the error.

    Raises:
        UnknownShapeError: names or scores are not held.
    """
    columns, score = [_texts(values, leaf) for leaf in scored.labels], scored.score(values)
    if score is None:
        raise UnknownShapeError("scores are not held")
    name = columns[0]
    for other in columns[1:]:
        is_blank = np.array([not word.strip() for word in name.words], np.bool_)
        codes = np.where(is_blank[name.codes], other.codes + len(name.words), name.codes)
        name = Texts(codes.astype(np.uint32), (*name.words, *other.words))
    return name, *score


def _best(name: Texts, score: Floats, error: float, owners: Ints) -> Ints:
    """Returns the first of the hypotheses of the highest score, for each detection.

    Raises:
        UnknownShapeError: they were rounded, so that another may be the best.
    """
    rank = np.where(np.isnan(score), -np.inf, score)
    order = np.lexsort((-rank, owners))
    begins = np.diff(owners[order], prepend=-1) != 0
    best: Ints = order[begins]
    if error:
        follows = np.flatnonzero(begins[:-1] & ~begins[1:])
        one, two = order[follows], order[follows + 1]
        with np.errstate(invalid="ignore"):  # infinity less infinity
            is_close = rank[one] - rank[two] <= 2 * error
        if (is_close & (name.codes[one] != name.codes[two])).any():
            raise UnknownShapeError("another hypothesis may be the best")
    return best


def _texts(values: Values, leaf: Leaf) -> Texts:
    texts = values.texts(leaf)
    if texts is None:
        raise UnknownShapeError(f"{leaf.sources[0]} is not held")
    return texts

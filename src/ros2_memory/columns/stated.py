"""Reads what messages state from the columns of a table, without the messages.

It returns what `state_of(extractor.exact(message))` returns for each message. Columns do not settle
it where the shape of the value differs from message to message, where a number was rounded across a
limit, and for the ids of goals, which have no columns. Those messages have to be read.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.facts import (
    BATTERY,
    CHARGE,
    COMMAND,
    DIAGNOSTICS,
    FLAG,
    GOALS,
    LABEL,
    MOST,
    NOTHING,
    STATUS,
    VELOCITIES,
    Fact,
    Facts,
    Stated,
    Word,
    charge_levels,
    has_errors,
    has_events,
    is_still,
    joined_facts,
    source_of,
    state_of,
)
from ros2_memory.columns.detections import Source, detections_in, sources_in
from ros2_memory.columns.shown import UNKNOWN, ByType, Node, Shape, at_field, leaves_of
from ros2_memory.columns.values import ROWS, Kind, Leaf, UnknownShapeError, Values, within_limits
from ros2_memory.core.arrays import distinct_rows, entries_of_codes
from ros2_memory.core.text import dotted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.columns.table import Table
    from ros2_memory.core.arrays import Floats
    from ros2_memory.core.model import JsonValue
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import IntArray, Mask


_NO_ROWS: Final = np.empty(0, np.int64)


class FromColumns(NamedTuple):
    """What the messages of a table state.

    Attributes:
        stated: what the columns say.
        unsure: the rows, ascending, of which only the messages say the rest.
    """

    stated: Stated
    unsure: IntArray

    def to_read(self, index: IntArray | None) -> IntArray:
        """Returns the places in `index` of the messages that have to be read.

        Args:
            index: rows of the table; None for all of them.
        """
        return self.unsure if index is None else np.flatnonzero(np.isin(index, self.unsure))


class StatedColumns:
    """Reads what messages state from tables; remembers which columns of a type say it.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._readers = ByType(extractor, _reader_of)

    def of(self, table: Table) -> FromColumns | None:
        """Returns what the messages of a table state; None if all of them have to be read."""
        read = self._readers.of(table)
        if read is None:
            return None
        try:
            facts, unsure = read(Values(table))
        except UnknownShapeError:
            return None
        return FromColumns(Stated(table.log_times, facts), unsure)


class Nodes:
    """Numbers the sources that share a topic, as `facts.source_of` names them.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._leaves = ByType(extractor, _source_leaves)
        self._numbers = {"": 0}

    def of(self, table: Table) -> IntArray | None:
        """Returns the number of each row's source, 0 without one; None if no column has it."""
        nodes = np.zeros(len(table), np.int64)
        if table.channel.type not in {DIAGNOSTICS, BATTERY}:
            return nodes
        leaves, values = self._leaves.of(table), Values(table)
        if not leaves:
            return None if leaves is None else nodes
        [leaf] = leaves
        try:
            names, owners = values.texts(leaf), np.arange(len(table))
            if leaf.level != ROWS:
                owners = values.elements(leaf.level).owners
        except UnknownShapeError:
            return None
        numbers = [self._numbers.setdefault(name, len(self._numbers)) for name in names.words]
        has_any, firsts = np.unique(owners, return_index=True)
        nodes[has_any] = np.array(numbers, np.int64)[names.codes[firsts]]
        return nodes


Reader: TypeAlias = "Callable[[Values], tuple[Facts, IntArray]]"
"""Reads the facts in the messages of a table, and the rows that its columns do not settle."""


class _Entry(NamedTuple):
    """Where a log entry, or an entry of diagnostics, has its level, name and text."""

    level: Leaf
    name: Leaf
    text: Leaf


def _reader_of(shape: Shape) -> Reader:
    """Returns what reads the facts in messages of a type, and the rows that columns do not settle.

    Raises:
        UnknownShapeError: the columns that say it depend on the message.
    """
    value, type_name = shape.value, shape.type
    if type_name == GOALS:  # all messages have to be read: the ids of goals have no columns
        return lambda values: (NOTHING, np.arange(values.rows))
    if has_errors(type_name):
        entry = _entry_leaves(value, type_name)
        return lambda values: (_entry_facts(values, entry, type_name), _NO_ROWS)
    numbers: Reader | None = None
    commands = [*_command_leaves(value)] if type_name in VELOCITIES else []
    charges = _leaves_at(value, "percentage") if type_name == BATTERY else []
    if commands:
        numbers = partial(_command_facts, commands)
    elif [charge.kind for charge in charges] == [Kind.REAL]:
        numbers = partial(_charge_facts, charges[0], _source_leaves(shape))
    flags = [*_flag_leaves(value, "")] if has_events(type_name) else []
    if len(flags) > MOST[FLAG]:
        raise UnknownShapeError("more booleans than are tracked")
    sources = sources_in(value) if has_events(type_name) else []
    return partial(_state_facts, sources, flags, numbers)


# Where a type has what it states


def _source_leaves(shape: Shape) -> list[Leaf]:
    """Returns where messages of diagnostics, or of a battery, name their source, if anywhere."""
    if shape.type == BATTERY:
        locations = _leaves_at(shape.value, "location")
        return [leaf for leaf in locations if leaf.kind is Kind.TEXT and leaf.level == ROWS]
    name = _entry_leaves(shape.value, shape.type).name
    if name.level.parent is not ROWS:
        raise UnknownShapeError("the definition is not the standard one")
    return [name]


def _flag_leaves(node: Node, path: str) -> Iterator[tuple[str, Leaf]]:
    """Yields the booleans in an object, with their paths; none in lists."""
    if node is UNKNOWN or (isinstance(node, Leaf) and node.limits):
        raise UnknownShapeError("it depends on the message")
    if isinstance(node, Leaf) and node.kind is Kind.BOOLEAN:
        yield path, node
    elif isinstance(node, dict):
        for name, inner in node.items():
            yield from _flag_leaves(inner, dotted(path, name))


def _entry_leaves(value: Node, type_name: str) -> _Entry:
    """Returns where the entries are: the message itself, or the elements of diagnostics."""
    paths = ["level", "name", "msg"]
    if type_name == DIAGNOSTICS:
        paths = ["status.level", "status.name", "status.message"]
    leaves = [leaf for path in paths for leaf in _leaves_at(value, path)]
    if [leaf.kind for leaf in leaves] != [Kind.INTEGER, Kind.TEXT, Kind.TEXT]:
        raise UnknownShapeError("the definition is not the standard one")
    return _Entry(*leaves)


def _leaves_at(value: Node, path: str) -> list[Leaf]:
    return [node for node in at_field(value, path) if isinstance(node, Leaf)]


def _command_leaves(value: Node) -> Iterator[Leaf]:
    """Yields the floats of a commanded velocity."""
    for leaf in leaves_of(value):
        if leaf.limits or leaf.level != ROWS:
            raise UnknownShapeError("a command has a list")
        if leaf.kind is Kind.REAL:
            yield leaf


# What a table states


def _state_facts(
    sources: Sequence[Source],
    flags: Sequence[tuple[str, Leaf]],
    numbers: Reader | None,
    values: Values,
) -> tuple[Facts, IntArray]:
    """Returns what messages state by their labels, booleans and numbers, as a `Reader`."""
    labels: list[Facts] = []
    for source in sources:
        for detections in detections_in(values, source, places=False):
            codes = detections.labels.codes.astype(np.int64)
            words = [Word(LABEL, label) for label in detections.labels.words]
            labels.append(Facts(detections.rows, codes, detections.scores, words))
    label_facts = joined_facts(labels)
    if label_facts.rows.size and np.bincount(label_facts.rows).max() > MOST[LABEL]:
        raise UnknownShapeError("more labels than are tracked")
    rows = np.arange(values.rows)
    flag_facts = [_facts_of(FLAG, rows, values.numbers(leaf).values, path) for path, leaf in flags]
    number_facts, unsure = numbers(values) if numbers else (NOTHING, _NO_ROWS)
    return joined_facts([label_facts, *flag_facts, number_facts]), unsure


def _entry_facts(values: Values, entry: _Entry, type_name: str) -> Facts:
    """Returns what log entries or diagnostics state; each distinct entry is read once."""
    zone = values.zone(entry.level)
    if zone is not None and (
        zone.greatest is None or not _facts_of_entry(int(zone.greatest), type_name)
    ):
        return NOTHING
    levels = values.numbers(entry.level).values.astype(np.int64)
    name, text = values.texts(entry.name), values.texts(entry.text)
    telling = [level for level in np.unique(levels).tolist() if _facts_of_entry(level, type_name)]
    positions = np.flatnonzero(np.isin(levels, telling))
    _, rows = within_limits(values, entry.level.level, positions, (), surely=True)
    if rows.size and np.bincount(rows).max() > MOST[STATUS]:
        raise UnknownShapeError("more levels than are tracked")
    distinct, codes = distinct_rows(
        [column[positions] for column in (levels, name.codes, text.codes)]
    )
    facts = Facts.of(
        [
            (code, fact)
            for code, (level, who, what) in enumerate(distinct.tolist())
            for fact in _facts_of_entry(level, type_name, name.words[who], text.words[what])
        ]
    )
    counts, taken = entries_of_codes(facts.rows, codes)
    return Facts(np.repeat(rows, counts), facts.codes[taken], facts.values[taken], facts.words)


def _facts_of_entry(level: int, type_name: str, name: str = "", text: str = "") -> tuple[Fact, ...]:
    """Returns the facts of a log entry, or of diagnostics of one entry."""
    value: JsonValue = {"level": level, "name": name, "msg": text}
    if type_name == DIAGNOSTICS:
        value = {"status": [{"level": level, "name": name, "message": text}]}
    return state_of(value, type_name).facts


def _charge_facts(leaf: Leaf, locations: Sequence[Leaf], values: Values) -> tuple[Facts, IntArray]:
    """Returns how low batteries are, and the rows in which rounding may have changed that."""
    charges, error = values.floats(leaf)
    levels = charge_levels(charges)
    low, high = charge_levels(charges - error), charge_levels(charges + error)
    settled = np.flatnonzero((levels >= 0) & (low == high))
    charge = _facts_of(CHARGE, settled, levels[settled])
    for location in locations:
        texts = values.texts(location)
        words = [Word(CHARGE, source_of({"location": word}, BATTERY)) for word in texts.words]
        charge = charge._replace(codes=texts.codes[settled].astype(np.int64), words=words)
    return charge, np.flatnonzero(low != high)


def _command_facts(leaves: Sequence[Leaf], values: Values) -> tuple[Facts, IntArray]:
    """Returns whether a velocity is commanded, and the rows in which rounding may hide that."""
    surely_still, maybe_still = np.ones(values.rows, np.bool_), np.ones(values.rows, np.bool_)
    for leaf in leaves:
        numbers, error = values.floats(leaf)
        surely_still &= is_still(numbers, error)
        maybe_still &= is_still(numbers, -error)
    settled = np.flatnonzero(surely_still == maybe_still)
    facts = _facts_of(COMMAND, settled, ~surely_still[settled])
    return facts, np.flatnonzero(surely_still != maybe_still)


def _facts_of(
    kind: str, rows: IntArray, numbers: IntArray | Mask | Floats, name: str = ""
) -> Facts:
    """Returns one fact of a kind for each row."""
    codes = np.zeros(rows.size, np.int64)
    return Facts(rows, codes, numbers.astype(np.float64), [Word(kind, name)])

"""What a field is in all rows of a table: its numbers, or its value as JSON text."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.limits import placed
from ros2_memory.columns.shown import Node, leaves_of, shape_of
from ros2_memory.columns.table import Table, Texts
from ros2_memory.columns.values import ROWS, Conversion, Kind, Leaf, UnknownShapeError, Values

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.core.arrays import Floats
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import IntArray

_LARGEST_INT64: Final = 2**63 - 1


class FieldNumbers(NamedTuple):
    """The numbers of a field in the rows of a table.

    Attributes:
        rows: the row of each number, ascending; a row may have none, or several.
        numbers: finite; int64 where all are integers that it holds, else float64.
        error: the most by which one of them is off; 0 where they are exact. Angles that are
            computed of exact quaternions may differ by their last digits.
        errors: the most by which each of them is off, where that differs.
        exactly: returns the exact numbers at some positions, ascending; None where only the bag
            has them, and of several numbers of a message.
    """

    rows: IntArray
    numbers: IntArray | Floats
    error: float
    errors: Floats | None = None
    exactly: Callable[[IntArray], Floats] | None = None


def numbers(table: Table, field: str, extractor: SchemaExtractor) -> FieldNumbers | None:
    """Returns the numbers of a field: those in what `SchemaExtractor.exact_at` returns.

    Booleans are none, nor are the sizes in the summary of an array.

    Args:
        table: the messages.
        field: dot-path in the extracted value, or else in the message.
        extractor: has the schema map.

    Returns:
        None where the columns do not hold them all: then the bag has to be read.
    """
    try:
        parts = [_numbers_of(Values(table), leaf) for leaf in _leaves(table, field, extractor)]
    except UnknownShapeError:
        return None
    if not parts:
        return FieldNumbers(np.empty(0, np.int64), np.empty(0, np.int64), 0.0)
    return parts[0] if len(parts) == 1 else _joined(parts)


def column_of(table: Table, field: str, extractor: SchemaExtractor) -> str | None:
    """Returns the path of the column that has all numbers of a field as they are; None: none."""
    try:
        [leaf] = _leaves(table, field, extractor)
    except (UnknownShapeError, ValueError):  # none, or several
        return None
    is_stored = leaf.level is ROWS and leaf.conversion is Conversion.STORED
    return leaf.sources[0] if is_stored and not leaf.limits else None


def words_of(table: Table, field: str | None, extractor: SchemaExtractor) -> Texts | None:
    """Returns a field of each row as JSON text, as `history.held_values.HeldValues` has it.

    None where the columns do not hold it as it is, or it is more than a text, a boolean or a whole
    number: then the messages have to be read.
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
    order = np.argsort(rows, kind="stable")
    errors = np.concatenate(
        [
            np.full(part.rows.size, part.error) if part.errors is None else part.errors
            for part in parts
        ]
    )
    error = max(part.error for part in parts)
    return FieldNumbers(rows[order], joined[order], error, errors[order] if error else None)


def _node(table: Table, field: str | None, extractor: SchemaExtractor) -> Node | None:
    """Returns a field of the value of a table's messages, or all of it; None where nothing is."""
    shape = shape_of(table, extractor)
    if shape is None:
        raise UnknownShapeError("there are no columns")
    return shape.value if field is None else shape.find(field)


def _leaves(table: Table, field: str, extractor: SchemaExtractor) -> list[Leaf]:
    """Returns the numbers of a field; not those of a summary."""
    node = _node(table, field, extractor)
    return [] if node is None else [leaf for leaf in leaves_of(node) if leaf.is_number]


def _numbers_of(values: Values, leaf: Leaf) -> FieldNumbers:
    column, error, exactly = values.numbers(leaf)
    everything = np.arange(len(column))
    kept, rows = placed(values, leaf.level, everything, leaf.limits, surely=True)
    possible, _ = placed(values, leaf.level, everything, leaf.limits, surely=False)
    if len(kept) < len(possible) or not values.holds_all(leaf):
        raise UnknownShapeError("some numbers are not held, or may not stand there")
    if len(kept) < len(column):
        column = column[kept]
    is_finite = np.isfinite(column)
    if not is_finite.all():
        column, rows, kept = column[is_finite], rows[is_finite], kept[is_finite]
    if column.dtype.kind != "u" or not (column > _LARGEST_INT64).any():
        is_whole = column.dtype.kind in "iu"
        column = column.astype(np.int64 if is_whole else np.float64, copy=False)

    return FieldNumbers(
        rows,
        column,
        float(np.max(error, initial=0.0)),
        error[kept] if isinstance(error, np.ndarray) else None,
        None if exactly is None else lambda positions: exactly(kept[positions]),
    )

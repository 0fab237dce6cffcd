"""The numbers of a field in all rows of a table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.shown import (
    Limits,
    Node,
    Spot,
    UnknownShapeError,
    leaves_below,
    opened,
    placed,
    shape_of,
)
from ros2_memory.columns.values import ROWS, Conversion, Kind, Leaf, Values

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.columns.table import Table
    from ros2_memory.columns.values import Floats, Ints
    from ros2_memory.extract import SchemaExtractor

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
            has them.
    """

    rows: Ints
    numbers: Ints | Floats
    error: float
    errors: Floats | None = None
    exactly: Callable[[Ints], Floats] | None = None


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
    shape, values = shape_of(table, extractor), Values(table)
    if shape is None:
        return None
    parts: list[FieldNumbers] = []
    try:
        for leaf, limits in _leaves(shape.find(field)):
            part = _numbers_of(values, leaf, limits)
            if part is None:
                return None
            parts.append(part)
    except UnknownShapeError:
        return None
    if not parts:
        return FieldNumbers(np.empty(0, np.int64), np.empty(0, np.int64), 0.0)
    return parts[0] if len(parts) == 1 else _joined(parts)


def column_of(table: Table, field: str, extractor: SchemaExtractor) -> str | None:
    """Returns the path of the column that has all numbers of a field as they are; None: none."""
    shape = shape_of(table, extractor)
    try:
        leaves = [] if shape is None else [*_leaves(shape.find(field))]
    except UnknownShapeError:
        return None
    if len(leaves) != 1 or leaves[0][0].level is not ROWS or leaves[0][1]:
        return None
    leaf, _ = leaves[0]
    return leaf.sources[0] if leaf.conversion in {Conversion.STORED, Conversion.REAL} else None


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
    ends = np.cumsum([part.rows.size for part in parts])

    def exactly(positions: Ints) -> Floats:
        exact = joined[order[positions]].astype(np.float64)
        for part, end in zip(parts, ends.tolist(), strict=True):
            places = order[positions] - (end - part.rows.size)
            of_part = np.flatnonzero((places >= 0) & (places < part.rows.size))
            if part.exactly is not None and of_part.size:
                exact[of_part] = part.exactly(places[of_part])
        return exact

    is_settled = all(part.exactly is not None or part.error == 0 for part in parts)
    error = max(part.error for part in parts)
    return FieldNumbers(
        rows[order],
        joined[order],
        error,
        errors[order] if error else None,
        exactly if is_settled else None,
    )


def _leaves(value: Node | None) -> Iterator[tuple[Leaf, Limits]]:
    """Yields the numbers of a field; not those of a summary."""
    for spot in () if value is None else opened(Spot(value)):
        for _, leaf, limits in leaves_below(spot):
            if leaf.kind in {Kind.INTEGER, Kind.REAL}:
                yield leaf, limits


def _numbers_of(values: Values, leaf: Leaf, limits: Limits) -> FieldNumbers | None:
    numbers = values.numbers(leaf)
    if numbers is None or not values.holds_all(leaf):
        return None
    everything = np.arange(len(numbers.values))
    kept, rows = placed(values, leaf.level, everything, limits, surely=True)
    if len(kept) < len(placed(values, leaf.level, everything, limits, surely=False)[0]):
        return None
    is_all = len(kept) == len(numbers.values)
    column = numbers.values if is_all else numbers.values[kept]
    is_finite = np.isfinite(column)
    if not is_finite.all():
        column, rows, kept = column[is_finite], rows[is_finite], kept[is_finite]
    if column.dtype.kind != "u" or not (column > _LARGEST_INT64).any():
        is_whole = column.dtype.kind in "iu"
        column = column.astype(np.int64 if is_whole else np.float64, copy=False)
    of_field = FieldNumbers(
        rows,
        column,
        float(np.max(numbers.error, initial=0.0)),
    )
    if isinstance(numbers.error, np.ndarray):
        of_field = of_field._replace(errors=numbers.error[kept])
    if numbers.exactly is not None:
        exactly = numbers.exactly
        of_field = of_field._replace(exactly=lambda positions: exactly(kept[positions]))
    return of_field

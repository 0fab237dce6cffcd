"""The value of each row of a table as JSON text, so that rows can be told apart by it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.columns.scores import is_object
from ros2_memory.columns.shown import UnknownShapeError, children, shape_of
from ros2_memory.columns.table import Table, Texts
from ros2_memory.columns.values import ROWS, Conversion, Kind, Leaf, Values

if TYPE_CHECKING:
    from ros2_memory.extract import SchemaExtractor


def words_of(table: Table, field: str | None, extractor: SchemaExtractor) -> Texts | None:
    """Returns a field of each row as JSON text, as `history.held_values.HeldValues` has it.

    None where the columns do not hold it as it is, or it is more than a text, a boolean or a whole
    number: then the messages have to be read.
    """
    shape = shape_of(table, extractor)
    if shape is None:
        return None
    try:
        node = shape.value if field is None else shape.find(field)
        if node is not None and is_object(node):
            [(_, node)] = children(node)
    except (UnknownShapeError, ValueError):  # more than one part
        return None
    if (
        not isinstance(node, Leaf)
        or node.level is not ROWS
        or node.conversion is not Conversion.STORED
    ):
        return None
    values = Values(table)
    if node.kind is Kind.TEXT:
        texts = values.texts(node)
    elif node.kind in {Kind.BOOLEAN, Kind.INTEGER} and (column := values.numbers(node)) is not None:
        distinct, codes = np.unique(column.values, return_inverse=True)
        return Texts(codes.astype(np.uint32), tuple(map(json.dumps, distinct.tolist())))
    else:
        texts = None
    if texts is None:
        return None
    return Texts(texts.codes, tuple(map(json.dumps, texts.words)))

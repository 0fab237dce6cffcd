"""Makes the same columns of messages that were decoded one by one."""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.columns.plan import Array, Number, NumberSequence, Plan, Run, Sequence, Text, Time
from ros2_memory.columns.table import MAX_RANGED_BYTES, Elements, Numbers, Texts
from ros2_memory.columns.walk import LevelColumns, add_array, add_sequence
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence as Values


def level_of(plan: Plan, messages: Values[object]) -> LevelColumns:
    """Returns the columns of decoded messages of the type of a plan."""
    level = LevelColumns(left_out=dict(plan.left_out))
    for step in plan.steps:
        if isinstance(step, Run):
            for entry in step.fields:
                _add_fixed(level, entry, messages)
        elif isinstance(step, Text):
            level.columns[step.path] = Texts.of(list(map(str, _values(messages, step.attribute))))
        elif isinstance(step, NumberSequence):
            _add_numbers(level, step, messages)
        else:
            _add_elements(level, step, messages)
    return level


def _values(messages: Values[object], attribute: str) -> Values[object]:
    """Returns a field of all messages; "" stands for the value itself."""
    return list(map(attrgetter(attribute), messages)) if attribute else messages


def _add_fixed(level: LevelColumns, entry: Number | Time | Array, messages: Values[object]) -> None:
    values = _values(messages, entry.attribute)
    if isinstance(entry, Time):
        seconds = np.array(_values(values, "sec"), np.int64)
        level.columns[entry.path] = seconds * NS_PER_S + np.array(
            _values(values, "nanosec"), np.int64
        )
    elif isinstance(entry, Array):
        arrays = np.array([_numbers(value) for value in values]) if entry.is_ranged else None
        add_array(level.columns, entry, len(values), arrays)
    else:
        if entry.nth is not None:
            values = [_numbers(value)[entry.nth] for value in values]
        dtype = np.dtype(np.bool_) if entry.is_bool else entry.dtype
        level.columns[entry.path] = np.array(values, dtype)


def _add_numbers(level: LevelColumns, step: NumberSequence, messages: Values[object]) -> None:
    arrays = [_numbers(value) for value in _values(messages, step.attribute)]
    counts = np.array([array.size for array in arrays], np.int64)
    looked_at = [array for array in arrays if array.size * step.size <= MAX_RANGED_BYTES]
    empty = np.zeros(0, step.dtype)
    values = np.concatenate([empty, *looked_at]).astype(step.dtype)
    add_sequence(level, step.path, counts, values, is_bool=step.is_bool)


def _add_elements(level: LevelColumns, step: Sequence, messages: Values[object]) -> None:
    lists = [
        value if isinstance(value, list) else [] for value in _values(messages, step.attribute)
    ]
    owners = np.repeat(np.arange(len(lists)), [len(entries) for entries in lists])
    inner = level_of(step.plan, [entry for entries in lists for entry in entries])
    level.elements[step.path] = Elements(owners, inner.columns, inner.elements)
    level.left_out |= {f"{step.path}.{path}": why for path, why in inner.left_out.items()}


def _numbers(value: object) -> Numbers:
    return value if isinstance(value, np.ndarray) else np.array(value)

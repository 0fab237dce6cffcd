"""Rounds the numbers of a decoded message as far as columns do, so that they compress.

A coordinate keeps a sixteenth of a millimetre, other numbers a millionth of themselves (see
`columns.steps`). The steps are powers of two: the last bits of a float are then zeros.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from math import ceil, log2
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.columns.steps import step_of

if TYPE_CHECKING:
    from ros2_memory.columns.steps import Step
    from ros2_memory.storage.base import Definition

_RELATIVE_BITS: Final = 20
"""2 to the minus 20 is a millionth."""


def rounded(message: object, definition: Definition | None, path: str = "") -> object:
    """Returns a decoded message with rounded numbers; integers, texts and times are as they were.

    Args:
        message: the message, or what is at `path` in one.
        definition: of the whole message.
        path: as `pose.pose.position`.
    """
    if isinstance(message, float):
        return float(_rounded(np.array(message), step_of(path, definition)))
    if isinstance(message, np.ndarray) and message.dtype.kind == "f":
        return _rounded(message, step_of(path, definition)).astype(message.dtype)
    if isinstance(message, list):
        return [rounded(one, definition, path) for one in message]
    if not is_dataclass(message) or isinstance(message, type):
        return message
    values = {
        one.name: rounded(getattr(message, one.name), definition, f"{path}.{one.name}".lstrip("."))
        for one in fields(message)
        if not one.name.startswith("__")
    }
    return replace(message, **values)


def _rounded(
    numbers: np.ndarray[tuple[int, ...], np.dtype[np.float64]], step: Step
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    with np.errstate(invalid="ignore", over="ignore"):
        if step.per_unit:
            units = 2.0 ** ceil(log2(step.per_unit))
            return np.rint(numbers * units) / units
        if step.relative:
            parts, exponents = np.frexp(numbers)
            whole = np.rint(parts * 2.0**_RELATIVE_BITS)
            return np.asarray(np.ldexp(whole, exponents - _RELATIVE_BITS))
    return numbers

"""How numbers leave in a reply: short, finite, and rounded by what they measure.

An integral float leaves as an int (so that -0.0 is 0), NaN and infinities leave as null.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue

METRIC_DECIMALS: Final = 4
DEGREE_DECIMALS: Final = 2
SIGNIFICANT_DIGITS: Final = 11
"""Of a number of unknown unit: 1e-8 of a degree, also at a longitude of three digits."""

LEAST_DECIMALS: Final = 6
"""Of the same: a time in Unix seconds keeps its microseconds."""

_LARGEST_WHOLE: Final = 10**15
_LARGEST_SINGLE: Final = float(np.finfo(np.float32).max)


def metric(number: float) -> JsonValue:
    """Metres, m/s, rad/s and their kin, to 1e-4."""
    return short(round(number, METRIC_DECIMALS))


def degrees(number: float) -> JsonValue:
    """An angle in degrees, to 1e-2."""
    return short(round(number, DEGREE_DECIMALS))


def single(number: np.float32) -> JsonValue:
    """A float32 as the shortest decimal that is read back as the same float32."""
    return short(float(str(number)))


def real(number: float) -> JsonValue:
    """A float of unknown unit.

    A scalar that was a float32 no longer says so once it is decoded. Its value does: it is exactly
    a float32 and yet needs more digits than these, which befalls a measured float64 once in 2**29.
    It leaves as `single` has it.
    """
    if not math.isfinite(number) or number == int(number):
        return short(number)
    exponent = math.floor(math.log10(abs(number)))
    decimal = round(number, max(SIGNIFICANT_DIGITS - 1 - exponent, LEAST_DECIMALS))
    if decimal != number and abs(number) <= _LARGEST_SINGLE:
        nearest = np.float32(number)
        if float(nearest) == number:
            return single(nearest)
    return short(decimal)


def integer(number: int) -> JsonValue:
    """An int of at most 64 bits as it is; a longer one, which only JSON brings, as a float."""
    if number.bit_length() <= 64:
        return number
    try:
        return float(number)
    except OverflowError:
        return None


def short(number: float) -> JsonValue:
    """The number itself, as an int where it is integral; null where it is not finite."""
    if not math.isfinite(number):
        return None
    whole = int(number)
    return whole if whole == number and abs(whole) < _LARGEST_WHOLE else float(number)

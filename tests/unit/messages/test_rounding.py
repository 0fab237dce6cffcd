from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.messages.to_json import (
    round_integer,
    round_real,
    round_single,
)


@pytest.mark.parametrize(
    ("number", "leaves_as"),
    [
        (0.0, 0),
        (-0.0, 0),
        (3.0, 3),
        (0.1 + 0.2, 0.3),
        (1 / 3, 0.33333333333),
        (52.12345678, 52.12345678),
        (-122.41941234, -122.41941234),
        (1752500000.123456, 1752500000.123456),
        (1e300, 1e300),
        (5e-324, 5e-324),
        (math.nan, None),
        (math.inf, None),
        (-math.inf, None),
    ],
)
def test_a_number_of_unknown_unit_leaves_short(number: float, leaves_as: object) -> None:
    left = round_real(number)
    assert left == leaves_as
    assert type(left) is type(leaves_as)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_float32_is_read_back_from_what_leaves(number: float) -> None:
    for left in (round_real(number), round_single(np.float32(number))):
        assert isinstance(left, int | float)
        assert np.float32(left) == np.float32(number)


@given(st.integers(1, 99_999), st.integers(2, 6))
def test_a_float32_leaves_as_the_decimal_that_was_written(digits: int, decimals: int) -> None:
    written = digits / 10**decimals
    assert round_real(float(np.float32(written))) == written


@given(st.floats(-360, 360, allow_nan=False))
def test_an_angle_on_the_globe_keeps_a_hundred_millionth_of_a_degree(degrees: float) -> None:
    left = round_real(degrees)
    assert isinstance(left, int | float)
    half_a_float32 = abs(degrees) * 2**-24 if float(np.float32(degrees)) == degrees else 0.0
    assert abs(left - degrees) <= max(1e-8, half_a_float32)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_any_finite_number_keeps_ten_digits_and_a_microsecond(number: float) -> None:
    left = round_real(number)
    assert isinstance(left, int | float)
    if float(np.float32(max(min(number, 1e38), -1e38))) != number:
        assert abs(left - number) <= max(abs(number) * 1e-10, 5e-324)
        assert abs(left - number) <= 5.1e-7


def test_ints_of_64_bits_leave_as_they_are_and_longer_ones_as_floats() -> None:
    assert round_integer(2**64 - 1) == 2**64 - 1
    assert round_integer(-(2**63)) == -(2**63)
    assert round_integer(10**30) == 1e30
    assert round_integer(10**5000) is None

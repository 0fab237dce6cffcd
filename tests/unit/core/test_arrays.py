"""Arrays that are gathered out of bytes."""

from __future__ import annotations

import struct
from random import Random

import numpy as np
import pytest

from ros2_memory.core.arrays import gathered

PAIR = np.dtype([("number", "<u2"), ("value", "<f8")])


def test_structures_are_gathered_wherever_they_lie() -> None:
    draw = Random(3)
    data = draw.randbytes(500)
    places = [draw.randrange(len(data) - PAIR.itemsize + 1) for _ in range(100)]
    found = gathered(data, PAIR, np.array(places))
    expected = [struct.unpack_from("<Hd", data, at) for at in places]
    assert found["number"].tolist() == [number for number, _ in expected]
    assert np.array_equal(found["value"], [value for _, value in expected], equal_nan=True)


def test_nothing_is_gathered_behind_the_end() -> None:
    last = np.array([2])
    assert gathered(b"abcd", np.dtype("<u2"), last).tolist() == [struct.unpack("<H", b"cd")[0]]
    with pytest.raises(IndexError):
        gathered(b"abcd", np.dtype("<u2"), last + 1)
    with pytest.raises(IndexError):
        gathered(b"a", np.dtype("<u4"), np.array([0]))
    assert gathered(b"", PAIR, np.empty(0, np.int64)).size == 0

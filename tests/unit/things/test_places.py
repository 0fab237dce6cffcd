"""Places of one label on a grid: rows of cells are numbered in order."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.arrays import distinct_rows

_NUMBERS = st.integers(-5, 5) | st.integers(-(2**40), 2**40)


@given(st.lists(st.tuples(_NUMBERS, _NUMBERS), max_size=12))
def test_distinct_rows_are_those_of_numpy(rows: list[tuple[int, int]]) -> None:
    table = np.array(rows, np.int64).reshape(-1, 2)
    found, number = distinct_rows((table[:, 0], table[:, 1]))
    assert found.tolist() == [[*each] for each in sorted({*rows})]
    assert found[number].tolist() == table.tolist()

"""Rows of arrays, and arrays gathered out of bytes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.arrays import Columns, distinct_rows, gathered, numbered, renumbered


def test_nothing_is_gathered_behind_the_end() -> None:
    number = np.dtype("<u2")
    assert gathered(b"ab\2\1", number, np.array([2])).tolist() == [0x0102]
    for data, at in ((b"abcd", 3), (b"a", 0)):
        with pytest.raises(IndexError):
            gathered(data, number, np.array([at]))
    assert gathered(b"", number, np.empty(0, np.int64)).size == 0


@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-9, 300))))
def test_columns_have_the_rows_of_their_table_in_fewer_bytes(rows: list[tuple[int, int]]) -> None:
    table = np.array(rows, np.int64).reshape(-1, 2)
    columns = Columns(table.T)
    which = np.arange(len(rows))[::-2]
    assert len(columns) == len(rows)
    for place in (which, (slice(None), 0), (which, 1)):
        assert columns[place].tolist() == table[place].tolist()
    assert columns.nbytes <= 10 * len(rows)


@given(
    st.lists(st.tuples(st.integers(-3, 3), st.integers(0, 4)), min_size=1),
    st.sampled_from([1, 10**6, 10**12]),
)
def test_distinct_rows_are_those_in_order_however_many_there_may_be(
    rows: list[tuple[int, int]], width: int
) -> None:
    """Few that there may be are looked up, many are sorted."""
    table = np.array(rows, np.int64) * width
    found, number = distinct_rows([*table.T])

    assert found.tolist() == sorted(map(list, {*map(tuple, table.tolist())}))
    assert found[number].tolist() == table.tolist()


@given(st.lists(st.integers(0, 9), max_size=40), st.integers(10, 400))
def test_codes_are_numbered_in_order_of_first_appearance(codes: list[int], count: int) -> None:
    used, indexes = renumbered(np.array(codes, np.uint32), count)
    expected, expected_indexes = numbered(codes)
    assert (tuple(used.tolist()), indexes.tolist()) == (expected, expected_indexes.tolist())

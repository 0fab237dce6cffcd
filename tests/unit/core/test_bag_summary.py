"""What a bag holds, as numbers and a shape; rows of arrays, and arrays gathered out of bytes."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.arrays import Columns, distinct_rows, gathered
from ros2_memory.core.bag_summary import BagSummary, TopicSummary, numbers_of
from ros2_memory.core.timebase import MAX_NS, MIN_NS

moments = st.integers(MIN_NS, MAX_NS)

topics = st.builds(
    lambda name, kind, count, ends, latched: TopicSummary(
        name, kind, "cdr", count, min(ends), max(ends), latched
    ),
    st.sampled_from(["/a", "/b", "/c"]),
    st.sampled_from(["std_msgs/msg/Bool", "std_msgs/msg/String"]),
    st.integers(1, 2**40),
    st.tuples(moments, moments),
    st.booleans(),
)

several = st.lists(topics, max_size=6, unique_by=lambda each: (each.topic, each.type)).map(tuple)

near = st.integers(0, 2**41)


@given(several, moments, st.lists(near, min_size=24, max_size=24))
def test_a_summary_says_what_its_topics_do(
    given_topics: tuple[TopicSummary, ...], start: int, offsets: list[int]
) -> None:
    ends = zip(offsets[::2], offsets[1::2], strict=True)
    start = min(start, MAX_NS - 2**41)
    alike = tuple(
        replace(each, first=start + min(end), last=start + max(end))
        for each, end in zip(given_topics, ends, strict=False)
    )
    for topics_of in (given_topics, alike):
        summary = BagSummary(topics_of)
        assert summary == BagSummary(topics_of)
        assert summary.topics == topics_of
        assert [summary.at(number) for number in range(len(topics_of))] == list(topics_of)
        assert summary.count == sum(each.count for each in topics_of)
        some = range(len(topics_of))[::-2]
        if topics_of:
            assert summary.start == min(each.first for each in topics_of)
            assert summary.end == max(each.last for each in topics_of)
            assert numbers_of(summary.schema, 2 * summary.data, 2, some).tolist() == [
                [[topics_of[at].count, topics_of[at].first, topics_of[at].last]] * 2 for at in some
            ]
        for name in ("/a", "/b", "/c"):
            of_name = tuple(each for each in topics_of if each.topic == name)
            assert tuple(summary.of(name)) == of_name
            if of_name:
                first, last = summary.span_of([name, "/nowhere"])
                assert first == min(each.first for each in of_name)
                assert last == max(each.last for each in of_name)


PAIR = np.dtype([("number", "<u2"), ("value", "<f8")])


def test_nothing_is_gathered_behind_the_end() -> None:
    last = np.array([2])
    assert gathered(b"abcd", np.dtype("<u2"), last).tolist() == [struct.unpack("<H", b"cd")[0]]
    with pytest.raises(IndexError):
        gathered(b"abcd", np.dtype("<u2"), last + 1)
    with pytest.raises(IndexError):
        gathered(b"a", np.dtype("<u4"), np.array([0]))
    assert gathered(b"", PAIR, np.empty(0, np.int64)).size == 0


@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-9, 300))))
def test_columns_have_the_rows_of_their_table_in_fewer_bytes(rows: list[tuple[int, int]]) -> None:
    table = np.array(rows, np.int64).reshape(-1, 2)
    columns = Columns(table.T)
    which = np.arange(len(rows))[::-2]

    assert len(columns) == len(rows)
    assert columns[which].tolist() == table[which].tolist()
    assert columns[:, 0].tolist() == table[:, 0].tolist()
    assert columns[which, 1].tolist() == table[which, 1].tolist()
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

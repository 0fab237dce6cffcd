"""What a bag holds, as numbers and a shape; rows of arrays, and arrays gathered out of bytes."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.arrays import gathered
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

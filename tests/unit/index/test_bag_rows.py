"""Bags in columns."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.index.bag_rows import BagRows, Bags

times = st.integers(MIN_NS, MAX_NS)
names = st.text(st.characters(exclude_characters="/\0"), min_size=1) | st.from_regex(
    r"[._a]?[0-9]{0,21}(\.mcap|\.db3)?(\.zstd)?", fullmatch=True
).filter(bool)
topics = st.builds(
    TopicSummary, st.sampled_from(["/a", "/b"]), st.just("T"), st.just("cdr"), times, times, times
)
summaries = st.builds(
    BagSummary,
    st.lists(topics, max_size=2, unique_by=lambda topic: topic.topic),
    notes=st.sampled_from([(), ("odd",)]),
)
bags = st.builds(
    BagFile,
    st.builds("{}{}".format, st.sampled_from(["/", "/bags/", "/bags/rec/", "/bägs/"]), names),
    st.integers(0, 2**62),
    times,
    st.sampled_from(BagState),
    summaries,
    times,
    times,
    times,
)


@given(st.lists(st.lists(bags, min_size=1, max_size=20), max_size=3))
def test_bags_in_columns_are_those_that_were_given(parts: list[list[BagFile]]) -> None:
    rows = [BagRows(part) for part in parts]
    everything = [bag for part in parts for bag in part]
    in_parts = Bags(rows)
    assert [*in_parts] == [*reversed([*reversed(in_parts)])] == in_parts[:] == everything
    assert [in_parts[at] for at in range(-len(in_parts), len(in_parts))] == 2 * everything
    recordings = [in_parts.recording(at) for at in range(len(in_parts))]
    assert recordings == [bag.recording for bag in everything]
    for part, columns in zip(parts, rows, strict=True):
        assert columns.files() == [bag.file for bag in part]
        assert columns.starts.tolist() == [bag.start for bag in part]
        odd = columns.with_schema(lambda schema: schema.notes)
        assert [*columns.at(odd)] == [bag for bag in part if bag.summary.notes]
        some = columns.some(odd)
        assert [*(some or ())] == [bag for bag in part if bag.summary.notes]
        assert (some is columns) == all(bag.summary.notes for bag in part)

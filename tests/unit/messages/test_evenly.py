from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.messages.to_json import evenly

counts = st.integers(0, 5000)
limits = st.integers(1, 600)


@given(counts, st.integers(2, 600))
def test_the_first_and_the_last_are_kept(count: int, at_most: int) -> None:
    kept = evenly(count, at_most)
    if count:
        assert (kept[0], kept[-1]) == (0, count - 1)


@given(counts, limits)
def test_indices_rise_by_steps_that_differ_by_at_most_one(count: int, at_most: int) -> None:
    kept = evenly(count, at_most)
    steps = [later - earlier for earlier, later in pairwise(kept)]
    assert all(step >= 1 for step in steps)
    assert not steps or max(steps) - min(steps) <= 1


@given(st.integers(1, 5000))
def test_a_single_place_goes_to_the_newest(count: int) -> None:
    assert evenly(count, 1) == [count - 1]

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.messages.to_json import evenly


@given(st.integers(0, 5000), st.integers(1, 600))
def test_the_first_and_the_last_are_kept_and_steps_differ_by_one(count: int, at_most: int) -> None:
    kept = evenly(count, at_most)
    steps = [later - earlier for earlier, later in pairwise(kept)]
    assert all(step >= 1 for step in steps)
    assert not steps or max(steps) - min(steps) <= 1
    # A single place goes to the newest.
    assert not count or (kept[0], kept[-1]) == (0 if at_most > 1 else count - 1, count - 1)

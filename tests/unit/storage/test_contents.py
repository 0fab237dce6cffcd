"""What the messages of a file amount to, however it is read."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.storage.contents import Tally

TENTH = NS_PER_S // 10


@given(st.lists(st.integers(0, 400), min_size=1), st.integers(1, 12), st.integers(1, 50))
@example([0, 100, 91, 82, 73, 64, 110], 7, 7)
@example([0, 100, 91, 82, 73, 64, 110], 1, 7)
def test_a_clock_that_goes_back_does_so_as_far_however_the_file_is_cut(
    tenths: list[int], chunk_size: int, at_once: int
) -> None:
    """As far as a message lies before any earlier one."""
    times = np.array(tenths, np.int64) * TENTH
    chunks = np.arange(times.size) // chunk_size
    tally = Tally()
    for begin in range(0, times.size, at_once):
        part = times[begin : begin + at_once]
        tally.add(np.zeros_like(part), part, chunks[begin : begin + at_once])
    by, at = tally.contents().set_back
    assert by == max(np.maximum.accumulate(times) - times)
    assert by == 0 or at in times

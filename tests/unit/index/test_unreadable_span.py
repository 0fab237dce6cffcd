"""When the messages of a file that cannot be read may have been recorded."""

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.layout import named_start
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.index.snapshot import (
    unreadable_bounds,
    unreadable_span,
)
from ros2_memory.index.split_order import Neighbours
from ros2_memory.index.timeline import MAX_FILE_NS

S = 10**9
NOW = 1_790_000_000 * S
HOUR = 3600 * S
OWN = "rec_20260921T130000Z"
"""Begun 4400 s before NOW."""


def test_a_recording_tells_when_it_began_only_in_the_names_that_the_recorder_gives() -> None:
    assert named_start(OWN) == 1_789_995_600 * S
    assert named_start(f"{OWN}_2") == 1_789_995_600 * S
    assert named_start("rec_20269921T130000Z") is None
    assert named_start("rosbag2_2025_09_10-13_03_56") is None


MOMENTS = st.integers(MIN_NS, MAX_NS)


@given(
    st.sampled_from([OWN, "someones"]),
    st.none() | MOMENTS,
    st.none() | MOMENTS,
    st.none() | MOMENTS,
    MOMENTS,
    st.booleans(),
)
def test_a_window_that_is_found_holds_the_neighbouring_ends_and_fits_64_bits(
    recording: str,
    before: int | None,
    after: int | None,
    written: int | None,
    now: int,
    growing: bool,
) -> None:
    found = unreadable_span(recording, Neighbours(before, after), written, now, growing=growing)
    if found is None:
        assert before is after is None
        return
    assert MIN_NS <= found.start <= found.stop <= MAX_NS
    if before is not None and after is not None:
        assert found.start == min(before, after)
        assert found.stop == min(max(before, after) + 1, MAX_NS)
    elif not growing:
        assert found.stop - found.start <= MAX_FILE_NS + 1 or recording == OWN


def test_a_copy_of_yesterday_may_hold_anything_from_before_it_was_made() -> None:
    assert unreadable_bounds("someones", Neighbours(), NOW - HOUR, NOW) == TimeWindow(
        MIN_NS, NOW - HOUR + 60 * S
    )
    assert unreadable_bounds("someones", Neighbours(), None, NOW) is None
    assert unreadable_bounds("someones", Neighbours(), 5 * S, NOW) is None


def test_times_that_contradict_each_other_bound_nothing() -> None:
    assert unreadable_bounds("rec", Neighbours(200 * S, 100 * S), NOW, NOW) is None
    assert unreadable_bounds("rec", Neighbours(NOW), NOW - HOUR, NOW) is None


@given(
    st.sampled_from([OWN, "someones"]),
    st.none() | MOMENTS,
    st.none() | MOMENTS,
    st.none() | MOMENTS,
    MOMENTS,
)
def test_what_may_be_there_includes_all_that_is_likely_up_to_the_last_write(
    recording: str, before: int | None, after: int | None, written: int | None, now: int
) -> None:
    near = Neighbours(before, after)
    likely = unreadable_span(recording, near, written, now)
    possible = unreadable_bounds(recording, near, written, now)
    if possible is not None:
        assert likely is not None
        assert MIN_NS <= possible.start <= likely.start
        assert likely.stop <= possible.stop <= MAX_NS

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    ns_from_unix,
    unix_from_ns,
    unix_rounded_up,
)
from tests.support.strategies import moments

small = st.integers(-20, 20)
windows = st.builds(TimeWindow, small, small)


@given(moments, st.integers(0, 10**15))
def test_a_window_of_two_timestamps_holds_both_of_their_messages(first: int, span: int) -> None:
    last = first + span
    window = TimeWindow.from_unix(unix_rounded_up(first), unix_rounded_up(last))
    assert window.contains(first)
    assert window.contains(last)


def test_a_timestamp_that_was_rounded_up_by_almost_a_microsecond_is_still_a_start() -> None:
    message = 1_784_023_200_123_001_001
    assert unix_rounded_up(message) == 1784023200.123002
    assert ns_from_unix(unix_rounded_up(message)) > message + AT_OR_BEFORE_SLACK_NS
    assert TimeWindow.from_unix(unix_rounded_up(message), 2e9).contains(message)


@pytest.mark.parametrize("start_s", [1795219200.0, 1795219200.1, 1795219200.000001, 0.0])
def test_what_was_asked_is_echoed_to_the_microsecond(start_s: float) -> None:
    start, end = TimeWindow.from_unix(start_s, start_s + 0.3).asked()
    assert unix_rounded_up(start) == start_s
    assert unix_rounded_up(end) == round(start_s + 0.3, 6)


@given(moments, st.integers(0, 10**15))
def test_both_ends_of_a_question_are_inclusive_with_the_slack_of_a_float(
    first: int, span: int
) -> None:
    start_s, end_s = unix_from_ns(first), unix_from_ns(first + span)
    window = TimeWindow.from_unix(start_s, end_s)
    start, end = ns_from_unix(start_s), ns_from_unix(end_s)
    assert window.contains(end)
    assert window.contains(start - 2 * AT_OR_BEFORE_SLACK_NS)
    assert not window.contains(start - 2 * AT_OR_BEFORE_SLACK_NS - 1)
    assert window.contains(end + AT_OR_BEFORE_SLACK_NS)
    assert not window.contains(end + AT_OR_BEFORE_SLACK_NS + 1)
    assert not window.contains(window.start - 1)


def test_a_window_saturates_at_64_bits() -> None:
    assert TimeWindow.from_unix(-1e300, 1e300) == TimeWindow(MIN_NS, MAX_NS)


def test_a_window_whose_start_is_after_its_end_is_refused_with_both_bounds() -> None:
    with pytest.raises(InvalidArgumentsError, match=r"start \(2.0\) is after end \(1.0\)"):
        TimeWindow.from_unix(2.0, 1.0)


@pytest.mark.parametrize("bounds", [(math.nan, 1.0), (1.0, math.nan), (-math.inf, 1.0)])
def test_a_bound_that_is_no_number_is_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(InvalidArgumentsError, match="Unix seconds"):
        TimeWindow.from_unix(*bounds)


def test_until_includes_its_end_and_nothing_after() -> None:
    window = TimeWindow.until(10)
    assert window.contains(10)
    assert not window.contains(11)
    assert TimeWindow.until(MAX_NS).stop == MAX_NS


@given(windows, small)
def test_a_window_contains_what_lies_from_its_start_up_to_before_its_stop(
    window: TimeWindow, moment: int
) -> None:
    assert window.contains(moment) == (moment in range(window.start, window.stop))


@given(windows, windows, small)
def test_an_intersection_contains_what_both_contain(
    a: TimeWindow, b: TimeWindow, moment: int
) -> None:
    assert a.intersect(b).contains(moment) == (a.contains(moment) and b.contains(moment))


@given(windows, small, st.integers(0, 10))
def test_overlapping_and_covering_count_the_moments_of_a_span(
    window: TimeWindow, first: int, length: int
) -> None:
    inside = [window.contains(moment) for moment in range(first, first + length + 1)]
    if not window.empty:
        assert window.overlaps(first, first + length) == any(inside)
    assert window.covers(first, first + length) == all(inside)


@given(windows)
def test_a_window_is_empty_when_no_moment_lies_inside(window: TimeWindow) -> None:
    assert window.empty == (not any(window.contains(moment) for moment in range(-20, 20)))


def test_a_bag_file_belongs_to_the_recording_in_whose_directory_it_lies() -> None:
    path = Path("bags") / "rec_1" / "rec_1_0.mcap"
    bag = BagFile(str(path), 1, 2, BagState.CLOSED, BagSummary(()), 0, 0)
    assert bag.recording == Path("bags") / "rec_1"

from __future__ import annotations

import math
from datetime import datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    NS_PER_US,
    Deadline,
    WallClock,
    iso_local,
    ms_from_ns,
    ns_from_unix,
    unix_from_ns,
    unix_rounded_up,
)
from tests.support.clocks import FixedClock
from tests.support.strategies import moments


@given(moments)
def test_a_moment_survives_a_float_of_seconds_to_within_its_resolution(moment: int) -> None:
    seconds = unix_from_ns(moment)
    assert abs(ns_from_unix(seconds) - moment) <= math.ulp(seconds) / 2 * NS_PER_S + 1


@given(moments)
def test_a_timestamp_fed_back_finds_its_own_message(moment: int) -> None:
    fed_back = ns_from_unix(unix_rounded_up(moment))
    assert moment <= fed_back + AT_OR_BEFORE_SLACK_NS
    # No more than that: a message 2 us later is not taken for it.
    assert fed_back + AT_OR_BEFORE_SLACK_NS < moment + 3 * NS_PER_US


@given(moments, st.integers(0, 10**12))
def test_order_survives_a_float_of_seconds(moment: int, later: int) -> None:
    assert unix_rounded_up(moment) <= unix_rounded_up(moment + later)
    assert ns_from_unix(unix_from_ns(moment)) <= ns_from_unix(unix_from_ns(moment + later))


@given(st.integers(0, 10**9))
def test_whole_seconds_are_exact(seconds: int) -> None:
    assert ns_from_unix(float(seconds)) == seconds * NS_PER_S


def test_a_timestamp_leaves_rounded_up_to_whole_microseconds() -> None:
    assert unix_rounded_up(1_500_000_001) == 1.500001
    assert unix_rounded_up(1_500_001_000) == 1.500001
    assert unix_rounded_up(0) == 0.0


def test_a_moment_before_the_epoch_rounds_up_too() -> None:
    assert unix_rounded_up(-1_500) == -1e-06
    assert ns_from_unix(-0.25) == -250_000_000


@pytest.mark.parametrize(("seconds", "moment"), [(1e300, MAX_NS), (-1e300, MIN_NS)])
def test_seconds_beyond_64_bits_saturate(seconds: float, moment: int) -> None:
    assert ns_from_unix(seconds) == moment


@pytest.mark.parametrize("seconds", [math.nan, math.inf, -math.inf])
def test_seconds_that_are_no_number_are_refused_by_name(seconds: float) -> None:
    with pytest.raises(ValueError, match=f"{seconds} is not a finite number"):
        ns_from_unix(seconds)


def test_milliseconds_are_for_log_events() -> None:
    assert ms_from_ns(1_500_000) == 1.5


@given(moments)
def test_a_local_time_names_the_same_second_with_its_offset(moment: int) -> None:
    text = iso_local(moment)
    assert text is not None
    local = datetime.fromisoformat(text)
    assert local.tzinfo is not None
    assert local.timestamp() == moment // NS_PER_S


@pytest.mark.parametrize("seconds", [10**15, -(10**15)])
def test_a_moment_that_the_calendar_does_not_reach_has_no_local_time(seconds: int) -> None:
    assert iso_local(seconds * NS_PER_S) is None


def test_a_fixed_clock_stands_still() -> None:
    clock = FixedClock(42)
    assert (clock.now(), clock.now()) == (42, 42)


def test_the_wall_clock_counts_from_the_epoch_in_nanoseconds() -> None:
    year = datetime.fromisoformat(iso_local(WallClock().now()) or "").year
    assert 2024 <= year < 2262


def test_a_deadline_passes_once_its_budget_is_spent() -> None:
    monotonic = iter([100.0, 100.0, 124.9, 125.0]).__next__
    deadline = Deadline.after(25.0, monotonic)
    assert [deadline.expired() for _ in range(3)] == [False, False, True]
    assert deadline.budget_s == 25.0


def test_no_deadline_never_passes() -> None:
    assert not Deadline.never().expired()

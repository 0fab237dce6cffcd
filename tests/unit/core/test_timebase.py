"""Times: as floats of seconds, as local times, as texts, and windows of them."""

import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    NS_PER_S,
    NS_PER_US,
    hours_from_text,
    iso_local,
    local_text,
    ns_from_unix,
    rest_of_text_s,
    rounded_off_s,
    unix_from_ns,
    unix_from_text,
    unix_rounded_up,
)
from tests.support.clocks import in_zone
from tests.support.strategies import moments

ZONES = ["UTC", "CET-1CEST,M3.5.0,M10.5.0/3", "EST5EDT,M3.2.0,M11.1.0", "<+0545>-5:45"]

"""Written out, so that they do not depend on the machine's time zone files."""

OFFSETS = st.integers(-14 * 60, 14 * 60).map(lambda minutes: timezone(timedelta(minutes=minutes)))


@pytest.fixture(params=ZONES)
def zone(request: pytest.FixtureRequest) -> Iterator[None]:
    with in_zone(request.param):
        yield


@given(moments)
def test_a_moment_survives_a_float_of_seconds_to_within_its_resolution(moment: int) -> None:
    seconds = unix_from_ns(moment)
    assert abs(ns_from_unix(seconds) - moment) <= math.ulp(seconds) / 2 * NS_PER_S + 1


@pytest.mark.parametrize("seconds", [math.nan, math.inf, -math.inf])
def test_seconds_that_are_no_number_are_refused_by_name(seconds: float) -> None:
    with pytest.raises(ValueError, match=f"{seconds} is not a finite number"):
        ns_from_unix(seconds)


@given(moments)
def test_a_local_time_names_the_same_microsecond_with_its_offset(moment: int) -> None:
    text = iso_local(moment)
    assert text is not None
    local = datetime.fromisoformat(text)
    assert local.tzinfo is not None
    assert local.timestamp() == pytest.approx(unix_rounded_up(moment), abs=1e-6)


@pytest.mark.parametrize("seconds", [10**15, -(10**15)])
def test_a_moment_that_the_calendar_does_not_reach_has_no_local_time(seconds: int) -> None:
    assert iso_local(seconds * NS_PER_S) is None


@given(moments, OFFSETS)
def test_a_time_with_an_offset_is_read_as_it_was_written(moment: int, zone: timezone) -> None:
    microseconds = moment // NS_PER_US
    written = (datetime.fromtimestamp(0, tz=UTC) + timedelta(microseconds=microseconds)).astimezone(
        zone
    )
    assert unix_from_text(written.isoformat()) == pytest.approx(microseconds / 1e6, abs=1e-6)
    assert unix_from_text(written.isoformat(sep=" ")) == unix_from_text(written.isoformat())


@pytest.mark.usefixtures("zone")
@given(moments)
def test_local_times_of_replies_are_read_as_they_were_written(moment: int) -> None:
    whole = moment // NS_PER_S
    microsecond = unix_from_text(iso_local(moment) or "")
    assert microsecond == pytest.approx(unix_rounded_up(moment), abs=1e-6)
    again = unix_from_text(local_text(moment) or "")
    assert whole == again
    assert local_text(ns_from_unix(again)) == local_text(moment)


@pytest.mark.parametrize(
    ("text", "rest_s"),
    [
        ("2026-11-20T14:05:03.745", 0.001),
        ("2026-11-20 14:05:03,7+01:00", 0.1),
        ("14:05:03.745616", 0.0),
        ("2026-11-20T14:05:03.745616001", 0.0),
        ("2026-11-20T14:05:03", 1.0),
        ("Tue 2026-11-17 14:05:03", 1.0),
        ("Tue 2026-11-17 14:05", 0.0),
        ("2026-11-20", 0.0),
        ("1784023200.745", 0.0),
        ("now", 0.0),
    ],
)
def test_the_last_decimal_of_a_text_is_all_part_of_it(text: str, rest_s: float) -> None:
    assert rest_of_text_s(text) == pytest.approx(rest_s, abs=2e-6)
    was_rounded = text.startswith("Tue")
    assert rounded_off_s(text) == pytest.approx(rest_s if was_rounded else 0.0, abs=2e-6)


def test_unix_seconds_in_quotes_are_read_where_they_can_be_no_date() -> None:
    assert unix_from_text("1795161600.25") == 1_795_161_600.25
    assert unix_from_text("20261120T080000Z") == 1_795_161_600.0
    with pytest.raises(ValueError, match="not a valid time"):
        unix_from_text("20261120")


@given(st.text(max_size=80))
def test_any_text_is_a_finite_time_or_refused(text: str) -> None:
    try:
        seconds = unix_from_text(text)
    except ValueError:
        return
    assert math.isfinite(seconds)


@pytest.mark.parametrize(
    ("text", "first", "last"),
    [
        ("19:00-22:00", (19, 0), (22, 0)),
        (" 07:05 to 24:00 ", (7, 5), (0, 0)),
        ("2330, 01:00", (23, 30), (1, 0)),
        ("00:00 and 24:00:00", (0, 0), (0, 0)),
        ("0:00-23:59", (0, 0), (23, 59)),
        ("7:05 to 9", (7, 5), (9, 0)),
    ],
)
def test_hours_are_read_as_people_write_them(
    text: str, first: tuple[int, int], last: tuple[int, int]
) -> None:
    read = hours_from_text(text)
    assert [(each.hour, each.minute) for each in read] == [first, last]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "two times of day"),
        ("19:00", "two times of day"),
        ("19:00-22:00-23:00", "two times of day"),
        ("19:00-25:00", "two times of day"),
        (" " * 1_000_000, "two times of day"),
        ("19:00Z-22:00Z", "offset from UTC"),
    ],
)
def test_what_is_not_two_hours_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        hours_from_text(text)


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


def test_a_window_whose_start_is_after_its_end_is_refused_with_both_bounds() -> None:
    with pytest.raises(InvalidArgumentsError, match=r"start \(2.0\) is after end \(1.0\)"):
        TimeWindow.from_unix(2.0, 1.0)


@pytest.mark.parametrize("bounds", [(math.nan, 1.0), (1.0, math.nan), (-math.inf, 1.0)])
def test_a_bound_that_is_no_number_is_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(InvalidArgumentsError, match="Unix seconds"):
        TimeWindow.from_unix(*bounds)

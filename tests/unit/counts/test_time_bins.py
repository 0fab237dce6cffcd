from datetime import datetime
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.counts.bins import (
    MOST_BINS,
    MOST_DAYS,
    ClockBin,
    Offset,
    TimeBins,
    time_bins,
)

S = 10**9
H = 3600
EPOCH = 719163
ZONES = ("UTC", "Europe/Berlin", "Australia/Lord_Howe", "America/Havana", "Asia/Kathmandu")


def zone(name: str) -> Offset:
    def offset(at_s: int) -> int:
        ahead = datetime.fromtimestamp(at_s, ZoneInfo(name)).utcoffset()
        assert ahead is not None
        return int(ahead.total_seconds())

    return offset


def at(text: str, zone_name: str = "UTC") -> int:
    return int(datetime.fromisoformat(text).replace(tzinfo=ZoneInfo(zone_name)).timestamp()) * S


def hours(bins: TimeBins) -> dict[str, float]:
    found = bins.lengths([bins.edges[0]], [bins.edges[-1]]) @ bins.member
    return {name: int(length) / S / H for name, length in zip(bins.names, found, strict=True)}


windows = st.builds(
    lambda start, length: TimeWindow(start, start + length),
    st.integers(1_700_000_000 * S, 1_800_000_000 * S),
    st.integers(1, 50 * 86_400 * S),
)


@given(windows, st.sampled_from(["day", "hour", "weekday"]), st.sampled_from(ZONES), st.data())
def test_every_time_is_in_the_bin_of_its_local_time(
    window: TimeWindow, by: ClockBin, name: str, data: st.DataObject
) -> None:
    bins = time_bins(window, by, zone(name))
    when = data.draw(st.integers(window.start, window.stop - 1))
    local = datetime.fromtimestamp(when // S, ZoneInfo(name))
    expected = {
        "day": local.date().isoformat(),
        "weekday": local.strftime("%A"),
        "hour": f"{local.hour:02d}:00",
    }[by]
    assert bins.names[int(bins.member[bins.pieces([when])[0]].argmax())] == expected
    assert bins.day_of is not None
    assert bins.day_of[bins.pieces([when])[0]] == local.date().toordinal() - EPOCH


@given(windows, st.sampled_from(["day", "hour", "weekday"]), st.sampled_from(ZONES), st.data())
def test_spans_are_shared_out_without_loss(
    window: TimeWindow, by: ClockBin, name: str, data: st.DataObject
) -> None:
    bins = time_bins(window, by, zone(name))
    moments = st.integers(window.start - 10**15, window.stop + 10**15)
    spans = [sorted(each) for each in data.draw(st.lists(st.tuples(moments, moments)))]
    starts, stops = [each[0] for each in spans], [each[1] for each in spans]
    inside = sum(
        max(min(stop, window.stop) - max(start, window.start), 0)
        for start, stop in zip(starts, stops, strict=True)
    )
    assert bins.lengths(starts, stops).sum() == inside


def test_a_day_has_23_or_25_hours_where_clocks_are_changed() -> None:
    berlin = zone("Europe/Berlin")
    spring = TimeWindow(at("2026-03-28", "Europe/Berlin"), at("2026-03-31", "Europe/Berlin"))
    assert hours(time_bins(spring, "day", berlin)) == {
        "2026-03-28": 24,
        "2026-03-29": 23,
        "2026-03-30": 24,
    }
    autumn = TimeWindow(at("2026-10-25", "Europe/Berlin"), at("2026-10-26", "Europe/Berlin"))
    assert hours(time_bins(autumn, "day", berlin)) == {"2026-10-25": 25}
    by_hour = hours(time_bins(autumn, "hour", berlin))
    assert by_hour["02:00"] == 2
    assert sum(by_hour.values()) == 25
    skipped = TimeWindow(at("2026-03-29", "Europe/Berlin"), at("2026-03-30", "Europe/Berlin"))
    assert "02:00" not in hours(time_bins(skipped, "hour", berlin))


def test_more_bins_than_a_reply_has_room_for_are_refused() -> None:
    begin, day = at("2026-03-02"), 86_400 * S
    assert (
        len(time_bins(TimeWindow(begin + S, begin + MOST_BINS * day), "day", zone("UTC")).names)
        == MOST_BINS
    )
    with pytest.raises(InvalidArgumentsError, match=r"by day takes at most 62 days.*by weekday"):
        time_bins(TimeWindow(begin, begin + (MOST_BINS + 2) * day), "day", zone("UTC"))
    with pytest.raises(InvalidArgumentsError, match="by hour takes at most 1000 days"):
        time_bins(TimeWindow(begin, begin + (MOST_DAYS + 1) * day), "hour", zone("UTC"))

from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.counts.bins import (
    MOST_BINS,
    MOST_DAYS,
    ClockBin,
    Offset,
    TimeBins,
    time_bins,
)
from ros2_memory.history.context import QuerySettings
from tests.support.bags import boolean, odom, write_mcap
from tests.support.memories import asked, memory_of
from tests.support.moving_map import BEGIN as MAP_BEGIN
from tests.support.moving_map import write_moving_map
from tests.support.tables import table

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


def test_times_in_which_nothing_was_recorded_have_no_rows(tmp_path: Path) -> None:
    noon = round(datetime(2026, 3, 2, 12, 30).astimezone().timestamp())
    for begin in (noon, noon + 5 * 3600, noon + 3 * 86_400):
        at = begin * S
        write_mcap(tmp_path / f"{begin}.mcap", [odom(at + n * S, n, 0.0) for n in range(20)])
    memory = memory_of(tmp_path)

    def rows(by: str) -> tuple[list[str], list[str]]:
        span = {"start": noon, "end": noon + 3 * 86_400 + 60}
        reply = asked(memory, "trajectory_summary", by=by, **span)
        notes = [each for each in reply.get("notes", ()) if each.startswith("no rows")]
        return [each[0] for each in reply["rows"]], notes

    start = "no rows for times in which nothing was recorded: "
    hours, notes = rows("hour")
    assert hours == ["12:00", "17:00"]
    assert notes == [f"{start}00:00 to 11:00, 13:00 to 16:00, 18:00 to 23:00"]
    days, notes = rows("day")
    assert days == ["2026-03-02", "2026-03-05"]
    assert notes == [f"{start}2026-03-03 to 2026-03-04"]
    weekdays, notes = rows("weekday")
    assert weekdays == ["Monday", "Thursday"]
    assert notes == [f"{start}Tuesday to Wednesday"]


NESTED = (
    Place("west", "map", Rectangle(-3.0, 2.0, -3.0, 6.0)),
    Place("east", "map", Rectangle(2.0, 8.0, -3.0, 6.0)),
    Place("start", "map", Circle(0.0, 0.0, 0.6)),
)


def test_a_place_in_another_one_counts_to_both_and_a_note_says_so(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 1, seconds=300)
    memory = memory_of(tmp_path, limits=QuerySettings(places=NESTED), recalls=True)
    span = {"start": MAP_BEGIN / S, "end": MAP_BEGIN / S + 300}
    reply = asked(memory, "get_topic_in_range", topic="/odom", by="place", **span)
    rows = table(reply)
    assert sum(row["count"] for name, row in rows.items() if name != "all") > 1500
    assert rows["all"]["count"] == 1500
    assert "places overlap: what is in two of them counts to both" in reply["notes"]


def test_the_first_of_a_day_is_not_known_where_the_window_begins_after_others(
    tmp_path: Path,
) -> None:
    midnight = round(datetime(2026, 3, 2).astimezone().timestamp())
    for day, hour in ((0, 8), (0, 17), (1, 9), (2, 8)):
        begin = midnight + day * 86_400 + hour * 3600
        messages = [boolean((begin + at) * S, at >= 10, topic="/is_driving") for at in range(20)]
        write_mcap(tmp_path / f"{begin}.mcap", messages)
    memory = memory_of(tmp_path)
    asks = {"topic": "/is_driving", "condition_type": "equals", "value": True, "by": "day"}

    def usual_first(start_h: float) -> tuple[str, str, int]:
        span = {"start": midnight + start_h * 3600, "end": midnight + 3 * 86_400}
        usual = asked(memory, "find_matches", **asks, **span)["usual_first"]
        return usual["earliest"], usual["latest"], usual["days"]

    assert usual_first(0) == usual_first(7) == usual_first(8) == ("08:00:10", "09:00:10", 3)
    assert usual_first(15) == ("08:00:10", "09:00:10", 2)

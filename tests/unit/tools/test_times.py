"""Times in replies: local beside Unix time over days, and as text that finds its message again."""

from __future__ import annotations

import json
import re
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory import cli
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import boolean, odom, text, tf, transform, write_mcap
from tests.support.memories import asked, memory_of
from tests.support.rooms import BEGIN, SEEN, asked_of, draw, write

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.history.context import Memory

DAY_S = 86_400
TIMES = ("timestamp", "first_seen", "arrived")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bags = tmp_path_factory.mktemp("days")
    for day in range(2):
        write(draw(3, 120), bags / f"day_{day}", begin=BEGIN + day * DAY_S)
    return bags


@pytest.fixture(scope="module")
def memory(folder: Path) -> Memory:
    return asked_of(folder, stored=False)


def rows_of(value: Any) -> Iterator[dict[str, Any]]:
    """The objects with a Unix time."""
    if isinstance(value, list):
        for each in value:
            yield from rows_of(each)
    elif isinstance(value, dict):
        if not value.keys().isdisjoint(TIMES):
            yield value
        for each in value.values():
            yield from rows_of(each)


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("get_topic_in_range", {"topic": "/chatter"}),
        ("trajectory_summary", {}),
        ("find_matches", {"topic": SEEN, "condition_type": "contains", "value": "cup"}),
        ("visits", {"where": "kitchen"}),
    ],
)
def test_local_time_stands_beside_unix_time_where_days_must_be_told_apart(
    memory: Memory, folder: Path, tool: str, given: dict[str, Any]
) -> None:
    both = asked(memory, folder, tool, start=BEGIN, end=BEGIN + 2 * DAY_S, **given)
    rows = [*rows_of(both)]
    assert rows
    for row in rows:
        assert row.get("local"), row
        key = next(key for key in TIMES if key in row)
        if row[key] is not None:
            local = datetime.fromtimestamp(row[key], UTC).astimezone()
            assert row["local"].startswith(f"{local:%a %Y-%m-%d}")


def days_said(reply: Any) -> list[str]:
    return [row["local"] for row in _objects(reply) if "local" in row]


def _objects(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, list):
        for part in value:
            yield from _objects(part)
    elif isinstance(value, dict):
        yield value
        for part in value.values():
            yield from _objects(part)


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("find_things", {}),
        ("visits", {}),
        ("compare", {"with_start": BEGIN, "with_end": BEGIN + DAY_S - 1, "start": BEGIN + DAY_S}),
    ],
)
def test_rows_of_things_and_places_say_each_day_once(
    memory: Memory, folder: Path, tool: str, given: dict[str, Any]
) -> None:
    span = {"start": BEGIN, "end": BEGIN + 2 * DAY_S, **given}
    reply = asked(memory, folder, tool, **span)
    said = days_said(reply)
    days = [
        f"{datetime.fromtimestamp(BEGIN + day * DAY_S, UTC).astimezone():%a %Y-%m-%d}"
        for day in range(2)
    ]
    assert said
    assert [sum(day in text for text in said) for day in days] == [1, 1]


def test_a_window_that_ends_with_a_date_includes_that_day_and_before_a_date_does_not(
    tmp_path: Path,
) -> None:
    day = round(datetime.fromisoformat("2026-11-18").timestamp()) * NS_PER_S
    hours = [day + hour * 3600 * NS_PER_S for hour in (-30, -1, 1, 23)]
    write_mcap(tmp_path / "bag.mcap", [text(at, "here") for at in hours])
    memory = memory_of(tmp_path)
    window = {"topic": "/chatter", "start": "2026-11-16", "end": "2026-11-18"}
    assert asked(memory, tmp_path, "get_topic_in_range", **window)["total"] == 4
    window["end"] = "2026-11-18T00:00"
    assert asked(memory, tmp_path, "get_topic_in_range", **window)["total"] == 2
    wanted = {"topic": "/chatter", "condition_type": "contains", "value": "here"}
    found = asked(memory, tmp_path, "find_last_match", before="2026-11-18", **wanted)
    assert found["timestamp"] == hours[1] / NS_PER_S


def test_a_date_without_dashes_is_refused_where_seconds_are_meant(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag.mcap", [text(BEGIN * NS_PER_S, "here", "/chatter")])
    memory = memory_of(tmp_path)
    for given in ({"start": 20261121}, {"end": 20261121.0}, {"around": 20261121}):
        reply = asked(memory, tmp_path, "recap", **given)
        assert reply["error"] == "invalid_arguments"
        assert "as Unix seconds is in 1970; the date is 2026-11-21" in reply["detail"]
    reply = asked(memory, tmp_path, "get_topic_at_time", topic="/chatter", timestamps=[20261121])
    assert "the date is 2026-11-21" in reply["detail"]
    assert "error" not in asked(memory, tmp_path, "recap", start=20269999, end=BEGIN)


S = 10**9
T0 = 1_795_144_010
"""Of messages at 10 Hz, each 45,892,003 ns after a tenth of a second, along x at 1 m/s."""
OFFSET = 45_892_003
AUTUMN = int(datetime(2026, 10, 25, 1, 29, tzinfo=UTC).timestamp())
"""In Berlin the second 02:29 of that day."""


def write_drive(folder: Path, begin_s: int) -> None:
    """Writes twenty seconds, in which a flag is set for one second in four."""
    messages = []
    for tenth in range(200):
        at = begin_s * S + tenth * S // 10 + OFFSET
        messages.append(odom(at, tenth / 10, 0.0, vx=1.0))
        messages.append(tf(at, transform(at, "odom", "base", (tenth / 10, 0.0, 0.0))))
        if tenth % 10 == 0:
            messages.append(boolean(at, tenth % 40 == 0, topic="/flag"))
    write_mcap(folder / "rec" / "rec_0.mcap", messages)


@pytest.fixture
def drive(tmp_path: Path) -> Memory:
    write_drive(tmp_path, T0)
    return memory_of(tmp_path)


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


def utc(seconds: int, decimals: str = "") -> str:
    """The second so many seconds after `T0`."""
    return f"{datetime.fromtimestamp(T0 + seconds, UTC):%Y-%m-%dT%H:%M:%S}{decimals}Z"


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("find_matches", {"topic": "/flag", "condition_type": "equals", "value": True}),
        ("get_topic_in_range", {"topic": "/odom", "fields": ["position.x"]}),
        ("visits", {"x": 5.0, "y": 0.0, "radius_m": 2.0}),
    ],
)
def test_times_of_a_row_by_hour_find_messages_of_their_second_and_in_unix_seconds_their_own(
    drive: Memory, tmp_path: Path, tool: str, given: dict[str, Any]
) -> None:
    table = asked(drive, tmp_path, tool, start=T0, end=T0 + 30, by="hour", **given)
    row = dict(zip(table["columns"], table["rows"][0], strict=True))
    times = [name for name in row if f"{name}_unix" in row]
    assert times
    for name in times:
        unix = row[f"{name}_unix"]
        found = asked(drive, tmp_path, "get_position_at", timestamp=row[name])
        assert int(found["timestamp"]) == int(unix), name
        found = asked(drive, tmp_path, "get_position_at", timestamp=unix)
        assert found["timestamp"] == unix, name


def test_at_a_text_is_up_to_the_end_of_its_last_decimal(drive: Memory, tmp_path: Path) -> None:
    def x_at(timestamp: object, **given: object) -> object:
        return asked(drive, tmp_path, "get_position_at", timestamp=timestamp, **given).get("x")

    assert [x_at(utc(5)), x_at(utc(5, ".0")), x_at(utc(5, ".0458"))] == [5.9, 5.0, 5.0]
    assert [x_at(utc(5, ".045890")), x_at(T0 + 5), x_at(str(T0 + 5))] == [4.9, 4.9, 4.9]
    several = asked(drive, tmp_path, "get_position_at", timestamps=[utc(5), T0 + 5])
    assert [each["x"] for each in several["results"]] == [5.9, 4.9]
    # The tolerance counts from the begin of the text.
    assert x_at(utc(20), tolerance_s=0.06) == 19.9
    assert x_at(utc(20), tolerance_s=0.05) is None
    assert "tolerance_s of at least 0.055" in str(
        asked(drive, tmp_path, "get_position_at", timestamp=utc(20), tolerance_s=0.05)
    )


@pytest.mark.parametrize("decimals", ["", ".0", ".000000"])
def test_what_is_interpolated_and_where_windows_end_is_exact(
    drive: Memory, tmp_path: Path, decimals: str
) -> None:
    frames = {"parent": "odom", "child": "base"}
    assert asked(
        drive, tmp_path, "get_transform_at", timestamp=utc(5, decimals), **frames
    ) == asked(drive, tmp_path, "get_transform_at", timestamp=T0 + 5, **frames)
    for tool, given in (
        ("trajectory_summary", {}),
        ("get_topic_in_range", {"topic": "/odom"}),
        ("recap", {}),
        ("compare", {"with_start": utc(10, decimals), "with_end": utc(15, decimals)}),
    ):
        reply = asked(drive, tmp_path, tool, start=utc(5, decimals), end=utc(10, decimals), **given)
        numbers = {key: T0 + 10 + 5 * (key == "with_end") for key in given if key != "topic"}
        exact = asked(drive, tmp_path, tool, start=T0 + 5, end=T0 + 10, **({**given, **numbers}))
        assert reply == exact, tool


@pytest.mark.usefixtures("berlin")
def test_in_the_hour_that_clocks_repeat_printed_times_have_their_offset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_drive(tmp_path, AUTUMN)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path))
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "replay")
    monkeypatch.setenv("COLUMNS", "200")

    def printed(*words: str) -> str:
        assert cli.main([*words]) == 0
        return capsys.readouterr().out

    by = ("topic=/odom", "fields=position.x", "by=hour", f"start={AUTUMN}", f"end={AUTUMN + 30}")
    for words in (
        ("info",),
        ("cat", "/odom"),
        ("ask", "get_position_seconds_ago", "seconds_ago=3"),
        ("ask", "get_topic_in_range", *by),
    ):
        times = re.findall(r"2026-10-25[T ]02:29:[0-9.]{9}\S*", printed(*words))
        assert times, words
        for each in {times[0], times[-1]}:
            assert each.endswith("+01:00"), words
            reply = printed("ask", "get_position_at", f"timestamp={each}", "--json")
            assert json.loads(reply)["timestamp"] >= AUTUMN
    assert (
        printed("cat", "/odom", "--end", times[0]).splitlines()[-1].startswith("2026-10-25T02:29")
    )

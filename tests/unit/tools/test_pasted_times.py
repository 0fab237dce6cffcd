"""Times as text that a reply or a command printed find their message when they are asked for."""

from __future__ import annotations

import json
import re
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory import cli
from tests.support.bags import boolean, odom, tf, transform, write_mcap
from tests.support.memories import asked, memory_of

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.history.context import Memory

S = 10**9
T0 = 1_795_144_010
"""Of messages at 10 Hz, each 45,892,003 ns after a tenth of a second, along x at 1 m/s."""
OFFSET = 45_892_003
AUTUMN = int(datetime(2026, 10, 25, 1, 29, tzinfo=UTC).timestamp())
"""In Berlin the second 02:29 of that day."""


def write(folder: Path, begin_s: int) -> None:
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
def memory(tmp_path: Path) -> Memory:
    write(tmp_path, T0)
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
    memory: Memory, tmp_path: Path, tool: str, given: dict[str, Any]
) -> None:
    table = asked(memory, tmp_path, tool, start=T0, end=T0 + 30, by="hour", **given)
    row = dict(zip(table["columns"], table["rows"][0], strict=True))
    times = [name for name in row if f"{name}_unix" in row]
    assert times
    for name in times:
        unix = row[f"{name}_unix"]
        found = asked(memory, tmp_path, "get_position_at", timestamp=row[name])
        assert int(found["timestamp"]) == int(unix), name
        found = asked(memory, tmp_path, "get_position_at", timestamp=unix)
        assert found["timestamp"] == unix, name


def test_at_a_text_is_up_to_the_end_of_its_last_decimal(memory: Memory, tmp_path: Path) -> None:
    def x_at(timestamp: object, **given: object) -> object:
        return asked(memory, tmp_path, "get_position_at", timestamp=timestamp, **given).get("x")

    assert [x_at(utc(5)), x_at(utc(5, ".0")), x_at(utc(5, ".0458"))] == [5.9, 5.0, 5.0]
    assert [x_at(utc(5, ".045890")), x_at(T0 + 5), x_at(str(T0 + 5))] == [4.9, 4.9, 4.9]
    several = asked(memory, tmp_path, "get_position_at", timestamps=[utc(5), T0 + 5])
    assert [each["x"] for each in several["results"]] == [5.9, 4.9]
    # The tolerance counts from the begin of the text.
    assert x_at(utc(20), tolerance_s=0.06) == 19.9
    assert x_at(utc(20), tolerance_s=0.05) is None
    assert "tolerance_s of at least 0.055" in str(
        asked(memory, tmp_path, "get_position_at", timestamp=utc(20), tolerance_s=0.05)
    )


@pytest.mark.parametrize("decimals", ["", ".0", ".000000"])
def test_what_is_interpolated_and_where_windows_end_is_exact(
    memory: Memory, tmp_path: Path, decimals: str
) -> None:
    frames = {"parent": "odom", "child": "base"}
    assert asked(
        memory, tmp_path, "get_transform_at", timestamp=utc(5, decimals), **frames
    ) == asked(memory, tmp_path, "get_transform_at", timestamp=T0 + 5, **frames)
    for tool, given in (
        ("trajectory_summary", {}),
        ("get_topic_in_range", {"topic": "/odom"}),
        ("recap", {}),
        ("compare", {"with_start": utc(10, decimals), "with_end": utc(15, decimals)}),
    ):
        reply = asked(
            memory, tmp_path, tool, start=utc(5, decimals), end=utc(10, decimals), **given
        )
        numbers = {key: T0 + 10 + 5 * (key == "with_end") for key in given if key != "topic"}
        exact = asked(memory, tmp_path, tool, start=T0 + 5, end=T0 + 10, **({**given, **numbers}))
        assert reply == exact, tool


@pytest.mark.usefixtures("berlin")
def test_in_the_hour_that_clocks_repeat_printed_times_have_their_offset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, AUTUMN)
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

"""Times in replies: local beside Unix time over days, and as text that finds its message again."""

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.history.context import Memory
from tests.support.bags import boolean, odom, text, tf_of, write_mcap
from tests.support.clocks import SettableClock, in_zone
from tests.support.memories import asked, clause, memory_of, remembered
from tests.support.program import Program, exits

__all__ = ["exits"]

S = NS_PER_S


def test_a_window_that_ends_with_a_date_includes_that_day_and_before_a_date_does_not(
    tmp_path: Path,
) -> None:
    day = round(datetime.fromisoformat("2026-11-18").timestamp()) * NS_PER_S
    hours = [day + hour * 3600 * NS_PER_S for hour in (-30, -1, 1, 23)]
    memory = remembered(tmp_path, [text(at, "here") for at in hours])
    window = {"topic": "/chatter", "start": "2026-11-16", "end": "2026-11-18"}
    assert asked(memory, "get_topic_in_range", **window)["total"] == 4
    for midnight in ("2026-11-18T00:00", "2026-11-18T00", "2026-11-18 00"):
        window["end"] = midnight
        assert asked(memory, "get_topic_in_range", **window)["total"] == 2
    wanted = clause("/chatter", "contains", "here")
    found = asked(memory, "find_last_match", before="2026-11-18", **wanted)
    assert found["timestamp"] == hours[1] / NS_PER_S


def test_a_call_reads_the_clock_once(tmp_path: Path) -> None:
    class Counted(SettableClock):
        read = 0

        def now(self) -> Ns:
            self.read += 1
            return self.at

    memory = remembered(tmp_path, [text(S, "here"), text(9 * S, "there")])
    for tool, given in (
        ("get_topic_seconds_ago", {"topic": "/chatter", "seconds_ago": 500}),
        ("get_topic_in_range", {"topic": "/chatter", "start": 3, "end": 90}),
        ("find_last_match", clause("/chatter", "equals", "no")),
        ("recap", {"start": 3, "end": 90}),
        ("memory_status", {}),
    ):
        clock = Counted(20 * S)
        asked(replace(memory, clock=clock), tool, **given)
        assert clock.read == 1, tool


@pytest.mark.parametrize(
    ("written", "total"),
    [
        ("20261118T044103Z", 4),
        ("20261118T044103.2+0000", 1),
        ("20261118T044103+00:00", 4),
        ("2026-11-18T04:41:03Z", 4),
        ("20261118T0441Z", 240),
        ("20261118T04+00:00", 0),
    ],
)
def test_a_second_or_a_minute_is_as_long_however_it_is_written(
    tmp_path: Path, written: str, total: int
) -> None:
    begin = round(datetime(2026, 11, 18, 4, 41, tzinfo=UTC).timestamp()) * NS_PER_S
    times = range(begin + 2 * NS_PER_S // 10, begin + 120 * NS_PER_S, NS_PER_S // 4)
    window = {"topic": "/chatter", "start": written, "end": written}
    assert (
        asked(
            remembered(tmp_path, [text(at, "here") for at in times]), "get_topic_in_range", **window
        ).get("total", 0)
        == total
    )


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
        messages.append(tf_of(at, "odom", "base", (tenth / 10, 0.0, 0.0)))
        if tenth % 10 == 0:
            messages.append(boolean(at, tenth % 40 == 0, topic="/flag"))
    write_mcap(folder / "rec" / "rec_0.mcap", messages)


@pytest.fixture
def drive(tmp_path: Path) -> Memory:
    write_drive(tmp_path, T0)
    return memory_of(tmp_path)


@pytest.fixture
def berlin() -> Iterator[None]:
    with in_zone("Europe/Berlin"):
        yield


def utc(seconds: int) -> str:
    """The second so many seconds after `T0`."""
    return f"{datetime.fromtimestamp(T0 + seconds, UTC):%Y-%m-%dT%H:%M:%SZ}"


def test_a_window_ends_where_its_end_begins_unless_it_starts_there(
    drive: Memory, tmp_path: Path
) -> None:
    def count(start: str, end: str) -> object:
        return asked(drive, "get_topic_in_range", topic="/odom", start=start, end=end)["total"]

    minute, weekday = utc(10)[:-4] + "Z", f"{datetime.fromtimestamp(T0 + 5, UTC):%a} "
    assert [count(utc(0), utc(5)), count(utc(0), minute)] == [50, 100]
    assert [count(utc(5), utc(5)), count(minute, minute)] == [10, 100]
    for start in (utc(0), utc(5)):
        assert count(start, weekday + utc(5)) == count(start, utc(6))


@pytest.mark.usefixtures("berlin")
def test_in_the_hour_that_clocks_repeat_printed_times_have_their_offset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exits: Program
) -> None:
    write_drive(tmp_path, AUTUMN)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path))
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "replay")
    monkeypatch.setenv("COLUMNS", "200")
    by = f"topic=/odom fields=position.x by=hour start={AUTUMN} end={AUTUMN + 30}"
    for line in (
        "info",
        "cat /odom",
        "ask get_position_seconds_ago seconds_ago=3",
        f"ask get_topic_in_range {by}",
    ):
        times = re.findall(r"2026-10-25[T ]02:29:[0-9.]{9}[^\s,]*", exits(0, line).out)
        assert times, line
        for each in {times[0], times[-1]}:
            assert each.endswith("+01:00"), line
            reply = exits(0, "ask get_position_at --json", f"timestamp={each}").json
            assert reply["timestamp"] >= AUTUMN
    last = exits(0, "cat /odom --end", times[0]).out.splitlines()[-1]
    assert last.startswith("2026-10-25T02:29")

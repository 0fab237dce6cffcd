"""Rows of a reply over more than half a day have local time beside Unix time; others do not."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import text, write_mcap
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
        (
            "compare",
            {"with_start": BEGIN, "with_end": BEGIN + DAY_S - 1, "start": BEGIN + DAY_S},
        ),
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

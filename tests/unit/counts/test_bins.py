from __future__ import annotations

from datetime import datetime
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING

import pytest

from ros2_memory.counts.matches import count_matches
from ros2_memory.history.context import Call, Memory, QuerySettings
from tests.support.bags import Msg, boolean, detections, odom, write_mcap
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.results import Bins

S = 10**9
BEGIN = 1_784_059_400 * S
EVERY = 30 * S
HOURS = 8
LATEST = QuerySettings(now="latest", split_duration_s=3600.0)


def way(number: int) -> float:
    """How far along its way the robot is at a pose: away from the dock, and back again."""
    out = number % 375 - 250
    return 0.4 * min(out, 125 - out) if out > 0 else 0.0


def driven() -> Iterator[Msg]:
    """An evening and a night: a robot leaves its dock twice, drives, and sees a cup on its way."""
    for number in range(HOURS * 3600 * S // EVERY):
        at = BEGIN + number * EVERY
        yield odom(at, way(number), 0.0)
        yield boolean(at + 1, number % 375 < 250, topic="/is_docked")
        if number % 25 == 0:
            for second in range(8):
                yield detections(at + 2 + second * S, ["cup"] if second % 4 else ["fork", "Cup"])


def cut(folder: Path, messages: Sequence[Msg], draw: Random) -> None:
    """Writes messages as splits of several recordings, of any length."""
    ordered = sorted(messages, key=lambda each: each.log_time)
    number, recording = 0, 0
    while ordered:
        size = draw.randint(60, 400)
        some, ordered = ordered[:size], ordered[size:]
        write_mcap(folder / f"rec_{recording}" / f"rec_{recording}_{number}.mcap", some)
        number += 1
        if draw.random() < 0.3:
            recording, number = recording + 1, 0


def whole(answer: Bins, name: str) -> float | None:
    return answer.all[[each[0] for each in answer.columns].index(name)]


@pytest.fixture(scope="module")
def memories(tmp_path_factory: pytest.TempPathFactory) -> list[Memory]:
    """The same hours in differently cut bags, with no store, some of one and all of it."""
    messages = list(driven())
    found = []
    for seed in range(2):
        folder = tmp_path_factory.mktemp(f"cut{seed}")
        cut(folder, messages, Random(seed))
        memory = memory_of(folder, limits=LATEST)
        found += [memory, with_store(memory, folder, part=(0.6, 1.0)[seed])]
    return found


def test_times_in_which_nothing_was_recorded_have_no_rows(tmp_path: Path) -> None:
    noon = round(datetime(2026, 3, 2, 12, 30).astimezone().timestamp())
    for begin in (noon, noon + 5 * 3600, noon + 3 * 86_400):
        at = begin * S
        write_mcap(tmp_path / f"{begin}.mcap", [odom(at + n * S, n, 0.0) for n in range(20)])
    memory = memory_of(tmp_path)

    def rows(by: str) -> tuple[list[str], list[str]]:
        span = {"start": noon, "end": noon + 3 * 86_400 + 60}
        reply = asked(memory, tmp_path, "trajectory_summary", by=by, **span)
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


def test_where_nothing_was_recorded_a_boolean_does_not_last(tmp_path: Path) -> None:
    for name, begin in (("one", 0), ("two", 20_000)):
        messages = [
            boolean(BEGIN + (begin + at) * S, at >= 50, topic="/is_docked") for at in range(100)
        ]
        # The last message before the time without any is all that its bag has.
        for number, split in enumerate((messages[:-1], messages[-1:])):
            write_mcap(tmp_path / name / f"{name}_{number}.mcap", split)
    memory = memory_of(tmp_path, limits=QuerySettings(now="latest"))
    for each in (memory, with_store(memory, tmp_path)):
        docked = count_matches(each, Call(), "/is_docked", "equals", True, by="day")
        assert (whole(docked, "count"), whole(docked, "seconds")) == (2, 2 * 49 * S)
        off = count_matches(each, Call(), "/is_docked", "equals", "false", by="day")
        # Twice it was off the dock from the beginning on: nobody saw it leave.
        assert (whole(off, "count"), whole(off, "seconds")) == (0, 2 * 50 * S)
        assert whole(off, "recorded_s") == 2 * 99 * S
        assert off.usual is None


def test_by_refuses_what_it_does_not_take_and_ignores_how_much_is_shown(
    memories: list[Memory],
) -> None:
    question: dict[str, object] = {
        "topic": "/is_docked",
        "condition_type": "equals",
        "value": True,
        "by": "day",
    }
    refused = asked(memories[0], Path(), "find_matches", **question, fields=["data"])
    assert refused["error"] == "invalid_arguments"
    assert "fields" in refused["detail"]
    shown = asked(memories[0], Path(), "find_matches", **question, limit=1, oldest_first=True)
    assert shown == asked(memories[0], Path(), "find_matches", **question)

from __future__ import annotations

import math
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.timebase import Deadline
from ros2_memory.counts.matches import count_matches
from ros2_memory.counts.numbers import count_range
from ros2_memory.counts.robot import count_path
from ros2_memory.history import driven_path
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import TimeRange
from ros2_memory.queries import trajectory_summary
from tests.support.bags import Msg, boolean, detections, odom, write_mcap
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.results import Bins

S = 10**9
BEGIN = 1_784_059_400 * S
EVERY = 30 * S
HOURS = 8
OBJECTS = "/vision/scene/scene_objects"
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


def local(at: float, by: str) -> str:
    when = datetime.fromtimestamp(at // S).astimezone()
    if by == "day":
        return when.date().isoformat()
    return when.strftime("%A") if by == "weekday" else f"{when.hour:02d}:00"


def column(answer: Bins, name: str) -> dict[str, float | None]:
    at = [each[0] for each in answer.columns].index(name)
    return {row: values[at] for row, values in answer.rows}


def whole(answer: Bins, name: str) -> float | None:
    return answer.all[[each[0] for each in answer.columns].index(name)]


def everything() -> TimeRange:
    return TimeRange(BEGIN / S, BEGIN / S + HOURS * 3600)


BYS = ("day", "hour", "weekday")


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


@pytest.mark.parametrize("by", BYS)
def test_a_boolean_is_counted_where_it_toggles_and_lasts_in_every_bin(
    memories: list[Memory], by: str
) -> None:
    starts = [BEGIN + 250 * EVERY + 1, BEGIN + 625 * EVERY + 1]
    stops = [BEGIN + 375 * EVERY + 1, BEGIN + 750 * EVERY + 1]
    for memory in memories:
        answer = count_matches(memory, Call(), "/is_docked", "equals", False, by=by)  # type: ignore[arg-type]
        counts, held = column(answer, "count"), column(answer, "seconds")
        for name in counts:
            assert counts[name] == sum(local(each, by) == name for each in starts)
        assert sum(each or 0 for each in held.values()) == whole(answer, "seconds")
        assert whole(answer, "seconds") == sum(stops) - sum(starts)
        first = {local(each, by): each for each in reversed(starts)}
        assert {name: at for name, at in column(answer, "first").items() if at} == first
        assert answer.usual is not None
        assert whole(answer, "recorded_s") == (HOURS * 3600 - 30) * S + 1


@pytest.mark.parametrize("by", BYS)
def test_the_metres_of_all_bins_are_those_of_the_way(memories: list[Memory], by: str) -> None:
    for memory in memories:
        answer = count_path(memory, Call(), everything(), by)  # type: ignore[arg-type]
        path = trajectory_summary(memory, Call(), everything()).trajectory
        metres = column(answer, "metres")
        assert math.fsum(each or 0 for each in metres.values()) == pytest.approx(
            whole(answer, "metres")
        )
        assert whole(answer, "metres") == pytest.approx(path.totals.distance_m, rel=1e-3)
        for name, each in metres.items():
            steps = [
                abs(way(number) - way(number - 1))
                for number in range(1, HOURS * 120)
                if local(BEGIN + number * EVERY, by) == name
            ]
            # A bag in which a bin ends is shared out by its drawn path.
            assert each == pytest.approx(math.fsum(steps), abs=0.5)


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


def test_a_boolean_that_toggles_in_the_last_message_before_a_gap_counts(tmp_path: Path) -> None:
    for begin in (0, 20_000):
        messages = [boolean(BEGIN + (begin + at) * S, at == 9) for at in range(10)]
        write_mcap(tmp_path / "rec" / f"rec_{begin}.mcap", messages)
    memory = memory_of(tmp_path, limits=QuerySettings(now="latest"))
    for each in (memory, with_store(memory, tmp_path)):
        docked = count_matches(each, Call(), "/bumper", "equals", True, by="day")
        assert (whole(docked, "count"), whole(docked, "seconds")) == (2, 0)


def test_bags_without_a_digest_are_read_for_seconds_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(4):
        messages = [odom(BEGIN + (number * 400 + at) * S, at, 0.0) for at in range(10)]
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", messages)
    memory = memory_of(tmp_path, limits=QuerySettings(now="latest"))
    span = TimeRange(BEGIN / S, BEGIN / S + 1600)
    monkeypatch.setattr(driven_path, "READING_S", -1.0)
    answer = count_path(memory, Call(Deadline.after(600)), span, "day")
    assert whole(answer, "metres") == 9.0
    assert f"only what is after {BEGIN // S + 1000}" in answer.notes[0]
    assert whole(count_path(memory, Call(), span, "day"), "metres") == 36.0


@pytest.mark.parametrize("copied", [False, True])
def test_recordings_that_follow_each_other_at_a_full_hour_count_a_copy_once(
    tmp_path: Path, copied: bool
) -> None:
    edge = BEGIN // S // 3600 * 3600 + 3600
    moves = [odom((edge + at) * S, float(at), 0.0) for at in range(-20, 20)]
    copy = replace(moves[19], log_time=edge * S - S // 2, publish_time=moves[19].published)
    write_mcap(tmp_path / "rec_0" / "rec_0_0.mcap", moves[:20])
    write_mcap(tmp_path / "rec_1" / "rec_1_0.mcap", [copy] * copied + moves[20:])
    plain = memory_of(tmp_path, limits=LATEST)
    known = with_store(plain, tmp_path)

    def ask(memory: Memory, *fields: str, by: str = "hour") -> Bins:
        return count_range(memory, Call(), "/odom", everything(), by, fields=fields)  # type: ignore[arg-type]

    counts, numbers = ask(plain), ask(plain, "position.x")
    of_day = ask(plain, "position.x", by="day")
    assert [each for each in column(counts, "count").values() if each] == [20, 20]
    assert whole(numbers, "position.x.mean") == -0.5
    assert ask(known) == counts
    assert ask(known, "position.x") == numbers
    assert ask(known, "position.x", by="day") == of_day
    assert ask(known, "pose.pose.position.x").rows == numbers.rows


def test_a_least_score_counts_only_what_reaches_it(tmp_path: Path) -> None:
    seen = [(0, 0.9), (1, 0.3), (30, 0.3), (31, 0.3), (60, 0.9)]
    messages = [detections(BEGIN + at * S, ["cup"], score=score) for at, score in seen]
    write_mcap(tmp_path / "rec_0.mcap", messages)
    memory = with_store(memory_of(tmp_path, limits=LATEST), tmp_path)

    def count(**more: object) -> object:
        question: dict[str, object] = {
            "topic": OBJECTS,
            "condition_type": "contains",
            "value": "cup",
            "by": "day",
        }
        reply = asked(memory, tmp_path, "find_matches", **question, **more)
        return dict(zip(reply["columns"][1:], reply["all"], strict=True))["count"]

    assert [count(), count(min_score=0.5), count(min_score=0.95)] == [3, 2, 0]


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

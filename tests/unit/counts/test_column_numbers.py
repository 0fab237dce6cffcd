"""Numbers of fields by stored columns: as exact as by the bags, whatever is stored."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.columns.fill import Filling, StoreLimits
from ros2_memory.columns.scan import Scanner
from ros2_memory.columns.store import ColumnStore
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.counts.matches import count_matches
from ros2_memory.counts.numbers import count_range
from ros2_memory.history.bag_access import BagAccess
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.view import TimeRange
from ros2_memory.queries import list_recorded_topics, topic_range
from tests.support.bags import Msg, battery, odom, write_mcap
from tests.support.examples import examples
from tests.support.memories import asked, memory_of
from tests.support.random_histories import write_history

if TYPE_CHECKING:
    from ros2_memory.history.context import Memory
    from ros2_memory.results import Bins

S = 10**9
BEGIN = 1_783_998_000 * S
HOUR = 3600
LATEST = QuerySettings(now="latest")
FIELDS = ("position.x", "position.y", "orientation.yaw_deg")


def storing(memory: Memory, folder: Path, draw: Random, *, part: float = 1.0) -> Memory:
    """The memory with a store that has some of the bags, in any order."""
    store = ColumnStore([folder / ".columns" / "columns.sqlite"], memory.reader.definition)
    scanner = Scanner(store, folder)
    filling = Filling(scanner, memory.reader, folder, memory.clock, StoreLimits(max_share=10.0))
    timeline = memory.index.snapshot().timeline
    bags = filling.waiting(timeline)
    draw.shuffle(bags)
    for bag in bags[: round(part * len(bags))]:
        filling.fill(bag, timeline)
    filling.merge(timeline)
    return replace(memory, columns=scanner)


def noisy(draw: Random, count: int = 900, every: int = 10 * S) -> list[Msg]:
    """A robot that drives about and stands still, by odometry that no step of a column fits."""
    messages, x, yaw = [], 0.0, 3.0
    for number in range(count):
        if number % 90 < 60:
            x += draw.gauss(0.0, 0.3)
            yaw += draw.gauss(0.0, 0.2)
        messages.append(odom(BEGIN + number * every, x + draw.gauss(0, 1e-6), -x, yaw))
    return messages


def write(folder: Path, messages: list[Msg], split: int = 20) -> None:
    for number in range(0, len(messages), split):
        name = f"rec_{number // split}.mcap"
        write_mcap(folder / "rec" / name, messages[number : number + split])


def span(hours: float = 3) -> TimeRange:
    return TimeRange(BEGIN / S, BEGIN / S + hours * HOUR)


def cells(answer: Bins, name: str) -> list[float | None]:
    at = [column[0] for column in answer.columns].index(name)
    return [*(values[at] for _, values in answer.rows), answer.all[at]]


def exact(answer: Bins) -> Bins:
    """An answer without its means: those of stored numbers are as exact as these."""
    kept = [not name.endswith(".mean") for name, _ in answer.columns]

    def of(values: tuple[float | None, ...]) -> tuple[float | None, ...]:
        return tuple(value for value, keep in zip(values, kept, strict=True) if keep)

    rows = tuple((name, of(tuple(values))) for name, values in answer.rows)
    columns = tuple(c for c, keep in zip(answer.columns, kept, strict=True) if keep)
    return replace(answer, rows=rows, columns=columns, all=of(tuple(answer.all)))


@settings(max_examples=examples(6), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32), part=st.sampled_from([0.5, 1.0]))
def test_extremes_of_bins_are_exact_whatever_is_stored(seed: int, part: float) -> None:
    with TemporaryDirectory() as name:
        folder, draw = Path(name), Random(seed)
        write(folder, noisy(draw, draw.randint(30, 600)))
        plain = memory_of(folder, limits=LATEST)
        stored = storing(plain, folder, draw, part=part)
        for by in ("hour", "day"):
            expected = count_range(plain, Call(), "/odom", span(), by, fields=FIELDS)
            answer = count_range(stored, Call(), "/odom", span(), by, fields=FIELDS)
            assert exact(answer) == exact(expected)
            for field in FIELDS:
                means = cells(answer, f"{field}.mean")
                assert means == pytest.approx(cells(expected, f"{field}.mean"), abs=0.02)
        shown = topic_range(stored, Call(), "/odom", span(), max_samples=3, fields=FIELDS)
        assert shown == topic_range(plain, Call(), "/odom", span(), max_samples=3, fields=FIELDS)


@settings(max_examples=examples(12), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32), part=st.sampled_from([0.5, 1.0]))
def test_messages_of_odd_histories_count_the_same_whatever_is_stored(
    seed: int, part: float
) -> None:
    with TemporaryDirectory() as name:
        folder, draw = Path(name), Random(seed)
        written = write_history(folder, draw)
        plain = memory_of(folder)
        stored = storing(plain, folder, draw, part=part)
        assert list_recorded_topics(stored, Call()) == list_recorded_topics(plain, Call())
        ends = {"start": min(written.moments) / S - 1, "end": max(written.moments) / S + 1}
        for topic in ("/odom", "/battery_state", "/bumper", "/tf_static", "/dock"):
            for more in ({}, {"by": "hour"}, {"by": "hour", "fields": ["percentage"]}):
                question = {"topic": topic, **ends, **more}
                expected = asked(plain, folder, "get_topic_in_range", **question)
                answer = asked(stored, folder, "get_topic_in_range", **question)
                for reply in (expected, answer):
                    # Which damaged bags are read at all depends on what is stored.
                    reply.pop("notes", None)
                assert answer == expected, question


def test_only_bags_that_may_hold_an_extreme_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, noisy(Random(7)))
    stored = storing(memory_of(tmp_path, limits=LATEST), tmp_path, Random(7))
    read: list[str] = []
    tables = BagAccess.tables

    def counted(self: BagAccess, bag: object, *args: object, **more: object) -> object:
        read.append(str(bag))
        return tables(self, bag, *args, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(BagAccess, "tables", counted)
    answer = count_range(stored, Call(), "/odom", span(), "hour", fields=["position.x"])
    assert len(answer.rows) == 3
    # Of 45 bags: two extremes of each of three hours.
    assert len(read) <= 8


def test_what_there_is_no_time_to_count_is_no_number_and_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = [battery(BEGIN + n * 10 * S, 0.5 + n / 10_000) for n in range(1080)]
    write(tmp_path, messages, split=60)
    memory = memory_of(tmp_path, limits=LATEST)
    whole = count_range(memory, Call(), "/battery_state", span(), "hour", fields=["percentage"])
    looks = iter([False] * 3)

    class Hurried(Deadline):
        def expired(self) -> bool:
            return next(looks, True)

    monkeypatch.setattr(Call, "partial_after", lambda *_: Hurried(0.0, math.inf))
    part = count_range(memory, Call(), "/battery_state", span(), "hour", fields=["percentage"])
    assert len(whole.rows) == 3
    assert [name for name, _ in part.rows] == [whole.rows[-1][0]]
    assert cells(part, "count") == [180, 180]
    assert cells(part, "first") == [messages[900].log_time] * 2
    assert cells(part, "percentage.min_at") == cells(part, "first")
    assert cells(part, "percentage.max") == cells(whole, "percentage.max")[-2:]
    assert cells(part, "recorded_s") == [1790 * S + 9 * S + 999_999_999] * 2
    assert part.notes[0].startswith(f"only what is after {messages[899].log_time / S:.0f}.")
    assert not any(note.startswith("no rows") for note in part.notes)


def test_the_error_of_a_column_is_that_of_a_mean(tmp_path: Path) -> None:
    write(tmp_path, noisy(Random(3)))
    plain = memory_of(tmp_path, limits=LATEST)
    stored = storing(plain, tmp_path, Random(3))
    answers = [
        count_range(memory, Call(), "/odom", span(), "day", fields=["position.x"])
        for memory in (plain, stored)
    ]
    first, again = (cells(answer, "position.x.mean")[-1] for answer in answers)
    assert again == pytest.approx(first, abs=1e-4)


class Limited(Deadline):
    """A deadline that is over after so many looks at it."""

    def __init__(self, looks: int) -> None:
        super().__init__(600.0, 600.0)
        object.__setattr__(self, "looks", iter([False] * looks))

    def expired(self) -> bool:
        return next(self.looks, True)  # type: ignore[attr-defined]


def test_a_condition_that_runs_out_of_time_has_no_rows_for_what_was_not_searched(
    tmp_path: Path,
) -> None:
    messages = [battery(BEGIN + n * 10 * S, 0.9 if n % 90 < 5 else 0.1) for n in range(1080)]
    write(tmp_path, messages, split=60)
    memory = memory_of(tmp_path, limits=LATEST)

    def count(call: Call) -> Bins:
        return count_matches(
            memory, call, "/battery_state", "above", 0.5, by="hour", field="percentage"
        )

    whole = count(Call())
    partial = []
    for looks in range(1, 60):
        with suppress(QueryTimeoutError):
            answer = count(Call(deadline=Limited(looks)))
            if any(note.startswith("only what is after") for note in answer.notes):
                partial.append(answer)
    assert partial
    for answer in partial:
        names = [name for name, _ in answer.rows]
        assert names == [name for name, _ in whole.rows][-len(names) :]
        assert cells(answer, "recorded_s")[-1] <= cells(whole, "recorded_s")[-1]  # type: ignore[operator]
        assert all(cells(answer, "count"))
    assert min(len(answer.rows) for answer in partial) < len(whole.rows)

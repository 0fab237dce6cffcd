"""Numbers of fields: as exact as by the bags, whatever is stored."""

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.counts.numbers import count_range
from ros2_memory.counts.robot import count_visits
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import TimeRange
from ros2_memory.results import Bins
from tests.support.bags import (
    Msg,
    battery,
    fix,
    make,
    octets,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.clocks import in_zone
from tests.support.memories import Remember, asked, memory_of, with_store
from tests.support.tables import table

S = 10**9
BEGIN = 1_783_998_000 * S
HOUR = 3600
LATEST = QuerySettings(now="latest")


def write(folder: Path, messages: list[Msg], split: int = 20) -> None:
    for number in range(0, len(messages), split):
        name = f"rec_{number // split}.mcap"
        write_mcap(folder / "rec" / name, messages[number : number + split])


def charges(memory: Memory, call: Call) -> Bins:
    """What the battery stated in three hours."""
    span = TimeRange(BEGIN / S, BEGIN / S + 3 * HOUR)
    return count_range(memory, call, "/battery_state", span, "hour", fields=["percentage"])


def cells(answer: Bins, name: str) -> list[float | None]:
    at = [column[0] for column in answer.columns].index(name)
    return [*(values[at] for _, values in answer.rows), answer.all[at]]


@in_zone("UTC")
def test_what_there_is_no_time_to_count_is_no_number_and_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = [battery(BEGIN + n * 10 * S, 0.5 + n / 10_000) for n in range(1080)]
    write(tmp_path, messages, split=60)
    memory = memory_of(tmp_path, limits=LATEST)
    whole = charges(memory, Call())
    looks = iter([False] * 3)

    class Hurried(Deadline):
        def expired(self) -> bool:
            return next(looks, True)

    monkeypatch.setattr(Call, "partial_after", lambda *_: Hurried(0.0, math.inf))
    part = charges(memory, Call())
    assert len(whole.rows) == 3
    assert [name for name, _ in part.rows] == [whole.rows[-1][0]]
    assert cells(part, "count") == [180, 180]
    assert cells(part, "first") == [messages[900].log_time] * 2
    assert cells(part, "percentage.min_at") == cells(part, "first")
    assert cells(part, "percentage.max") == cells(whole, "percentage.max")[-2:]
    assert cells(part, "recorded_s") == [1790 * S + 9 * S + 999_999_999] * 2
    assert part.notes[0].startswith(f"only what is after {messages[899].log_time / S:.0f}.")
    assert not any(note.startswith("no rows") for note in part.notes)


@dataclass(frozen=True, slots=True)
class Limited(Deadline):
    """A deadline that is over after so many looks at it, also at what is made of it."""

    looks: list[bool] = field(default_factory=list)

    def expired(self) -> bool:
        return self.looks.pop() if self.looks else True

    def left_s(self) -> float:
        return 600.0 if self.looks else 0.0


def limited(looks: int) -> Deadline:
    return Limited(600.0, 600.0, looks=[False] * looks)


CHARGES = [battery(BEGIN + n * 10 * S, 0.5 + n / 10_000) for n in range(600)]


def sizes_counted(memory: Memory, looks: Iterable[int]) -> set[int]:
    """How many of the charges were counted, by calls whose time is over after so many looks."""
    sizes = set()
    for most in looks:
        with suppress(QueryTimeoutError):
            answer = charges(memory, Call(deadline=limited(most)))
            size = int(cells(answer, "count")[-1] or 0)
            assert cells(answer, "percentage.min_at")[-1] == CHARGES[-size].log_time
            mean = pytest.approx(0.5 + (1199 - size) / 20_000, abs=1e-6)
            assert cells(answer, "percentage.mean")[-1] == mean
            sizes.add(size)
    return sizes


def test_no_number_is_lost_where_time_runs_out_after_all_are_counted(tmp_path: Path) -> None:
    write(tmp_path, CHARGES[:20], split=10)
    memory = memory_of(tmp_path, limits=LATEST)
    counted = [0]
    for looks in range(1, 30):
        with suppress(QueryTimeoutError):
            answer = charges(memory, Call(deadline=limited(looks)))
            counted.append(int(cells(answer, "count")[-1] or 0))
            continue
        assert counted[-1] == 0, looks
    assert counted == sorted(counted)
    assert counted[-1] == 20


def test_no_number_is_lost_where_time_runs_out_while_a_table_is_counted(tmp_path: Path) -> None:
    """The columns lack the field, so that bags are read as each table is counted."""
    write(tmp_path, CHARGES[::2], split=60)
    for begin, end in ((0, 95), (95, 250), (250, 300)):
        write_mcap(tmp_path / "other" / f"other_{begin}.mcap", CHARGES[1::2][begin:end])
    memory = with_store(memory_of(tmp_path, limits=LATEST), tmp_path, share=0.0)
    assert len(sizes_counted(memory, range(1, 40, 3))) > 1


def test_heights_of_a_receiver_are_counted_as_far_as_there_is_time(tmp_path: Path) -> None:
    """The search for messages without a fix leaves the time to the numbers."""
    write(tmp_path, [fix(BEGIN + n * 10 * S, altitude=float(n)) for n in range(200)])
    span = TimeRange(BEGIN / S, BEGIN / S + HOUR)
    least = set()
    for looks in range(1, 33):
        memory, call = memory_of(tmp_path, limits=LATEST), Call(deadline=limited(looks))
        with suppress(QueryTimeoutError):
            answer = count_range(memory, call, "/fix", span, "hour", fields=["altitude"])
            least.add(cells(answer, "altitude.min")[-1])
    assert least == {float(n) for n in range(0, 200, 20)}


@in_zone("UTC")
def test_visits_that_run_out_of_time_have_no_rows_for_hours_without_poses_yet(
    tmp_path: Path,
) -> None:
    poses = [odom(BEGIN + n * 10 * S, n % 36 * 0.1, 0.0) for n in range(1080)]
    write(tmp_path, poses, split=60)
    memory = memory_of(tmp_path, limits=LATEST)
    rows = set()
    for looks in range(1, 60, 3):
        with suppress(QueryTimeoutError):
            call = Call(deadline=limited(looks))
            answer = count_visits(memory, call, 0.0, 0.0, by="hour", radius_m=1.0)
            rows.add(len(answer.rows))
            assert not any("only what is after" in note for note in answer.notes) or (
                len(answer.rows) < 4 and all(cells(answer, "placed_s"))
            )
    assert len(rows) > 1


T0 = 1_790_000_000


def write_numbers(bag_dir: Path, *values: tuple[str, float]) -> None:
    """A message of /number each second; of each the type and the number."""
    messages = []
    for second, (name, number) in enumerate(values):
        kind = f"std_msgs/msg/{name}"
        # Its writer takes a byte for signed.
        is_byte = name == "Byte"
        body = bytes([0, 1, 0, 0, int(number)]) if is_byte else make(kind, data=number)
        messages.append(Msg("/number", kind, (T0 + second) * S, body))
    write_splits(bag_dir, messages)


@pytest.mark.parametrize(
    ("kind", "numbers"),
    [
        ("Int64", [2**53 + 1, 2**53 + 3, 2**53 + 2]),
        ("UInt64", [2**63 + 1, 2**64 - 3, 2**64 - 1, 2**64 - 2]),
        ("UInt64", [2**64 - 1] * 3),
        ("Int64", [-(2**63)] * 3),
        ("Byte", [3, 200, 100]),
    ],
)
def test_the_least_and_greatest_of_whole_numbers_are_exact(
    tmp_path: Path, remember: Remember, kind: str, numbers: list[int]
) -> None:
    write_numbers(tmp_path, *((kind, number) for number in numbers))
    memory = remember()
    given = {"topic": "/number", "start": T0, "end": T0 + 9, "fields": ["value"]}
    extremes = asked(memory, "get_topic_in_range", **given)["extremes"]["value"]
    assert (extremes["min"], extremes["max"]) == (min(numbers), max(numbers))
    assert extremes["max_at"] == T0 + numbers.index(max(numbers))
    row = table(asked(memory, "get_topic_in_range", **given, by="hour"))["all"]
    assert (row["value.min"], row["value.max"]) == (min(numbers), max(numbers))
    assert row["value.max_at_unix"] == extremes["max_at"]
    del given["fields"]  # no other number could be meant
    bare = table(asked(memory, "get_topic_in_range", **given, by="hour"))["all"]
    assert (bare == row) == (kind != "Byte")


def test_a_field_that_a_topic_has_no_more_is_that_of_its_window(tmp_path: Path) -> None:
    said = [replace(text(BEGIN + HOUR * S, "full"), topic="/battery_state")]
    write(tmp_path, [battery(BEGIN, math.nan), *said], split=1)
    span = TimeRange(BEGIN / S, BEGIN / S + 60)
    fields = {"fields": ["percentage"]}
    answer = count_range(memory_of(tmp_path), Call(), "/battery_state", span, "hour", **fields)
    assert "percentage holds no number in the window" in answer.notes


def test_tiny_numbers_keep_their_digits_and_noise_beside_others_does_not(tmp_path: Path) -> None:
    """Tesla, and squares of metres; beside 2.5, 1e-17 is nothing."""
    write_numbers(tmp_path, ("Float64", 2.3456789e-5), ("Float64", -1.23456e-7))
    given = {"topic": "/number", "start": T0, "end": T0 + 9, "fields": ["value"]}
    memory = memory_of(tmp_path)
    extremes = asked(memory, "get_topic_in_range", **given)["extremes"]["value"]
    assert (extremes["min"], extremes["max"]) == (-1.23e-7, 2.3457e-5)
    row = table(asked(memory, "get_topic_in_range", **given, by="hour"))["all"]
    assert (row["value.min"], row["value.max"]) == (-1.23e-7, 2.3457e-5)
    assert row["value.mean"] == pytest.approx(1.1667e-5)
    write_numbers(tmp_path, ("Float64", 2.5), ("Float64", 1e-17))
    assert asked(memory, "get_topic_in_range", **given)["extremes"]["value"]["min"] == 0.0


@in_zone("UTC")
def test_what_was_used_in_an_hour_is_its_first_number_less_its_last(
    tmp_path: Path, remember: Remember
) -> None:
    """Messages without a number are none of them; a list has neither."""
    levels = [0.9 - n / 1000 if n % 60 else math.nan for n in range(180)]
    messages = [battery(BEGIN + n * 60 * S, level) for n, level in enumerate(levels)]
    write(tmp_path, [*messages, octets(BEGIN + 10_790 * S, [1, 2, 3])])
    memory = remember()
    span = {"start": BEGIN // S, "end": BEGIN // S + 3 * HOUR, "by": "hour"}
    given = {"topic": "/battery_state", "fields": ["percentage"], **span}
    hours = table(asked(memory, "get_topic_in_range", **given))
    firsts = [*levels[1::60], levels[1]]
    assert [row["percentage.first"] for row in hours.values()] == pytest.approx(firsts, abs=1e-6)
    lasts = [*levels[59::60], levels[-1]]
    assert [row["percentage.last"] for row in hours.values()] == pytest.approx(lasts, abs=1e-6)
    given = {"topic": "/octets", "fields": ["data"], **span}
    row = table(asked(memory, "get_topic_in_range", **given))["all"]
    assert (row["data.first"], row["data.last"], row["data.min"]) == (None, None, 1)


def test_numbers_in_an_object_have_extremes_one_by_one(remember: Remember) -> None:
    driven = [odom(BEGIN + n * S, x=float(n), y=-2.0 * n, yaw=0.1 * n) for n in range(5)]
    memory = remember(driven)
    window = {"start": BEGIN // S, "end": BEGIN // S + 10}
    given = {"topic": "/odom", **window, "fields": ["position", "orientation"]}
    extremes = asked(memory, "get_topic_in_range", **given)["extremes"]
    parts = [f"position.{axis}" for axis in "xyz"]
    parts += [f"orientation.{turn}_deg" for turn in ("roll", "pitch", "yaw")]
    assert [*extremes] == parts
    assert [(extremes[part]["min"], extremes[part]["max"]) for part in parts[:3]] == [
        (0.0, 4.0),
        (-8.0, 0.0),
        (0.0, 0.0),
    ]
    columns = asked(memory, "get_topic_in_range", **given, by="day")
    [row] = (dict(zip(columns["columns"], row, strict=True)) for row in columns["rows"])
    assert (row["position.x.mean"], row["position.y.min"]) == (2.0, -8.0)


def test_extremes_of_a_day_have_local_times_beside_a_single_sample(tmp_path: Path) -> None:
    """So "how low was it, and when?" takes one call."""
    levels = [1.0, 0.5, 0.13, 0.9]
    write(tmp_path, [battery(BEGIN + n * 6 * HOUR * S, level) for n, level in enumerate(levels)])
    given = {"start": BEGIN // S, "end": BEGIN // S + 24 * HOUR, "fields": ["percentage"]}
    with in_zone("UTC"):
        reply = asked(
            memory_of(tmp_path),
            "get_topic_in_range",
            topic="/battery_state",
            max_samples=1,
            **given,
        )
    [percentage] = reply["extremes"].values()
    assert (percentage["min_at"], percentage["min_local"]) == (
        BEGIN // S + 12 * HOUR,
        "Tue 2026-07-14 15:00:00",
    )
    assert (len(reply["rows"]), reply["fields"][-1]) == (1, "local")

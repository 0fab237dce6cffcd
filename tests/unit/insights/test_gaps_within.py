"""Gaps within bags: a recorder that stalled, and what only looks like it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.serving.health import Health
from tests.support.bags import McapLayout, Msg, boolean, odom, text, write_db3, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.history.context import Memory

S = 10**9
BEGIN = 1_795_161_600
LENGTH = 30
STALLS = ((8.0, 11.0), (16.0, 16.7))
FLAG = {"topic": "/chatter", "condition_type": "contains", "value": "zzz"}


def at_rates(
    length: float, stalls: Sequence[tuple[float, float]], slow: Sequence[tuple[float, float]] = ()
) -> list[Msg]:
    """Odometry at 200 Hz, a flag at 50 Hz, both off in `stalls` and `slow`; a text at 10 Hz."""

    def is_on(t: float, off: Sequence[tuple[float, float]]) -> bool:
        return not any(start <= t < stop for start, stop in off)

    def at(t: float) -> int:
        return BEGIN * S + round(t * S)

    fast = [*stalls, *slow]
    messages = [
        odom(at(n / 200), n / 200, 0.0) for n in range(int(200 * length)) if is_on(n / 200, fast)
    ]
    flags = [n / 50 + 0.001 for n in range(int(50 * length))]
    messages += [boolean(at(t), data=True) for t in flags if is_on(t, fast)]
    texts = [n / 10 + 0.001 for n in range(int(10 * length))]
    messages += [text(at(t), "here") for t in texts if is_on(t, stalls)]
    return sorted(messages, key=lambda message: message.log_time)


def memory_with(
    folder: Path, messages: Sequence[Msg], splits: int = 1, kind: str = "mcap"
) -> Memory:
    length = -(-len(messages) // splits)
    for number in range(splits):
        some = messages[number * length : (number + 1) * length]
        if kind == "db3":
            write_db3(folder / "rec" / f"rec_{number}.db3", some)
        else:
            write_mcap(folder / "rec" / f"rec_{number}.mcap", some, McapLayout(chunk_size=1 << 14))
    clock = SettableClock((BEGIN + LENGTH + 60) * S)
    return memory_of(folder, clock=clock, storage="mcap" if kind == "mcap" else "sqlite3")


@pytest.fixture(params=["mcap", "db3", "stored", "cut into splits"], scope="module")
def stalled(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Memory:
    tmp_path = tmp_path_factory.mktemp("stalled")
    messages = at_rates(LENGTH, STALLS, slow=((22, 24),))
    splits = 7 if request.param == "cut into splits" else 1
    kind = "db3" if request.param == "db3" else "mcap"
    memory = memory_with(tmp_path / "bags", messages, splits, kind)
    return with_store(memory, tmp_path) if request.param == "stored" else memory


@pytest.fixture(scope="module")
def once_stalled(tmp_path_factory: pytest.TempPathFactory) -> Memory:
    return memory_with(tmp_path_factory.mktemp("once"), at_rates(20, STALLS[:1]))


def ask(memory: Memory, tool: str, **arguments: Any) -> dict[str, Any]:
    found: dict[str, Any] = asked(memory, memory.index.bag_dir, tool, **arguments)
    return found


def gaps(memory: Memory) -> list[tuple[float, float]]:
    found = ask(memory, "data_time_range")["gaps"]
    return [(round(gap["start"] - BEGIN, 3), round(gap["end"] - BEGIN, 3)) for gap in found]


def test_gaps_within_bags_are_listed_wherever_gaps_are(stalled: Memory) -> None:
    assert gaps(stalled) == [(7.995, 11.0), (15.995, 16.7)]
    status = ask(stalled, "memory_status")
    assert [gap["duration_s"] for gap in status["gaps"]] == pytest.approx([0.705, 3.005], abs=0.001)
    assert status["doubts"] == "while the recorder ran, nothing was recorded 2 times (3.71 s)"


@pytest.mark.parametrize(("splits", "kind"), [(1, "mcap"), (4, "mcap"), (1, "db3")])
def test_frequent_topics_that_fall_silent_while_slow_ones_go_on_leave_no_gap(
    tmp_path: Path, splits: int, kind: str
) -> None:
    messages = [each for each in at_rates(40, ((8.005, 30.0),)) if each.topic != "/chatter"]
    for topic, period, begin in (("/a", 1.0, 0.3), ("/b", 2.0, 0.7), ("/c", 1.0, 0.35)):
        messages += [
            text(round((BEGIN + begin + n * period) * S), "here", topic)
            for n in range(int(40 / period))
        ]
    messages.sort(key=lambda message: message.log_time)
    assert gaps(memory_with(tmp_path / "slow", messages, splits, kind)) == []
    stalled = [each for each in messages if not 15 <= each.log_time / S - BEGIN < 22]
    assert gaps(memory_with(tmp_path / "stalled", stalled, splits, kind)) == [(14.7, 22.3)]


def test_a_moment_in_a_gap_within_a_bag_has_no_data(stalled: Memory) -> None:
    for at, reason in ((9.5, "gap"), (16.35, "gap")):
        reply = ask(stalled, "get_position_at", timestamp=BEGIN + at, tolerance_s=0.1)
        assert (reply["error"], reply["reason"]) == ("no_data", reason)


def test_a_window_in_a_gap_within_a_bag_was_not_recorded(stalled: Memory) -> None:
    reply = ask(stalled, "find_matches", **FLAG, start=BEGIN + 8.5, end=BEGIN + 10.5)
    assert (reply["error"], reply["reason"]) == ("no_data", "gap")


@pytest.mark.parametrize(
    ("tool", "more"),
    [
        ("find_matches", FLAG),
        ("recap", {}),
        ("get_topic_in_range", {"topic": "/chatter", "max_samples": 10}),
        ("trajectory_summary", {}),
        ("visits", {"x": 0.0, "y": 0.0}),
    ],
)
def test_a_reply_whose_window_touches_a_gap_names_it(
    once_stalled: Memory, tool: str, more: dict[str, Any]
) -> None:
    named = f"nothing was recorded from {BEGIN + 7.995:.6f} to {BEGIN + 11:.6f} (3 s)"
    reply = ask(once_stalled, tool, start=BEGIN + 6, end=BEGIN + 13, **more)
    assert named in reply["notes"]
    later = ask(once_stalled, tool, start=BEGIN + 12, end=BEGIN + 19, **more)
    assert not [note for note in later.get("notes", []) if "nothing was recorded" in note]


def test_a_gap_is_not_named_where_all_messages_are_returned(once_stalled: Memory) -> None:
    window = {"start": BEGIN + 6, "end": BEGIN + 13}
    for more in ({}, {"fields": ["data"]}):
        reply = ask(once_stalled, "get_topic_in_range", topic="/chatter", **window, **more)
        assert not [note for note in reply.get("notes", []) if "nothing was recorded" in note]


def test_a_gap_through_which_a_text_holds_is_named(tmp_path: Path) -> None:
    memory = memory_with(tmp_path, at_rates(20, STALLS[:1]))
    window = {"start": BEGIN + 6, "end": BEGIN + 13}
    reply = ask(memory, "get_topic_in_range", topic="/chatter", **window, changes=True)
    assert [note for note in reply["notes"] if "nothing was recorded" in note]


def test_a_step_of_the_clock_within_a_bag_is_no_gap(tmp_path: Path) -> None:
    messages = [
        odom((BEGIN + 8 * (n >= 100)) * S + n * S // 20, n / 40, 0.0, 0.0) for n in range(300)
    ]
    messages += [
        replace(boolean(each.log_time, data=True), log_time=each.log_time + 1) for each in messages
    ]
    memory = memory_with(tmp_path, sorted(messages, key=lambda each: each.log_time))
    reply = ask(memory, "data_time_range")
    assert reply["gaps"] == []
    assert [step["step_s"] for step in reply["clock_steps"]] == pytest.approx([8.0], abs=0.1)
    assert "gaps" not in ask(memory, "memory_status")["doubts"]
    way = ask(memory, "trajectory_summary", start=BEGIN, end=BEGIN + 30)
    assert not [note for note in way["notes"] if "nothing was recorded" in note]


def test_what_another_recording_has_is_no_gap(tmp_path: Path) -> None:
    write_mcap(tmp_path / "one" / "one_0.mcap", at_rates(20, ((5, 9), (15, 17))))
    beside = [each for each in at_rates(20, ()) if 6 <= each.log_time / S - BEGIN < 10]
    write_mcap(tmp_path / "other" / "other_0.mcap", beside)
    memory = memory_of(tmp_path, clock=SettableClock((BEGIN + 60) * S))
    assert gaps(memory) == [(4.995, 6.0), (14.995, 17.0)]


def test_a_gap_that_several_copies_show_is_one(tmp_path: Path) -> None:
    for name in ("one", "copy"):
        write_mcap(tmp_path / name / f"{name}_0.mcap", at_rates(20, ((5, 9),)))
    memory = memory_of(tmp_path, clock=SettableClock((BEGIN + 60) * S))
    assert gaps(memory) == [(4.995, 9.0)]
    way = ask(memory, "trajectory_summary", start=BEGIN, end=BEGIN + 20, by="hour")
    assert way["all"][0] == pytest.approx(16.0, abs=0.1)


@pytest.mark.anyio
async def test_health_counts_the_gaps_of_the_last_hour(tmp_path: Path) -> None:
    memory = memory_with(tmp_path, at_rates(LENGTH, STALLS))
    health = Health(memory, "1")
    shown = await health()
    health.stop()
    assert shown["gaps_last_hour"] == {"count": 2, "seconds": pytest.approx(3.71, abs=0.01)}
    late = replace(memory, clock=SettableClock((BEGIN + 3600 + 12) * S))
    health = Health(late, "1")
    shown = await health()
    health.stop()
    assert shown["gaps_last_hour"] == {"count": 1, "seconds": pytest.approx(0.705, abs=0.01)}

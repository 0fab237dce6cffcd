"""Gaps within bags: a recorder that stalled, and what only looks like it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.history.context import Memory
from tests.support.bags import McapLayout, Msg, boolean, odom, text, write_db3, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of, with_store

S = 10**9
BEGIN = 1_795_161_600
LENGTH = 30
STALLS = ((8.0, 11.0), (16.0, 16.7))


def at_rates(slow: Sequence[tuple[float, float]] = ()) -> list[Msg]:
    """Odometry at 200 Hz, a flag at 50 Hz, both off in `STALLS` and `slow`; a text at 10 Hz."""

    def is_on(t: float, off: Sequence[tuple[float, float]]) -> bool:
        return not any(start <= t < stop for start, stop in off)

    def at(t: float) -> int:
        return BEGIN * S + round(t * S)

    fast = [*STALLS, *slow]
    messages = [odom(at(n / 200), n / 200) for n in range(200 * LENGTH) if is_on(n / 200, fast)]
    flags = [n / 50 + 0.001 for n in range(50 * LENGTH)]
    messages += [boolean(at(t), data=True) for t in flags if is_on(t, fast)]
    texts = [n / 10 + 0.001 for n in range(10 * LENGTH)]
    messages += [text(at(t), "here") for t in texts if is_on(t, STALLS)]
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
    messages = at_rates(slow=((22, 24),))
    splits = 7 if request.param == "cut into splits" else 1
    kind = "db3" if request.param == "db3" else "mcap"
    memory = memory_with(tmp_path / "bags", messages, splits, kind)
    return with_store(memory, tmp_path) if request.param == "stored" else memory


def ask(memory: Memory, tool: str, **arguments: Any) -> dict[str, Any]:
    found: dict[str, Any] = asked(memory, tool, **arguments)
    return found


def gaps(memory: Memory) -> list[tuple[float, float]]:
    found = ask(memory, "data_time_range")["gaps"]
    return [(round(gap["start"] - BEGIN, 3), round(gap["end"] - BEGIN, 3)) for gap in found]


def test_gaps_within_bags_are_listed_wherever_gaps_are(stalled: Memory) -> None:
    assert gaps(stalled) == [(7.995, 11.0), (15.995, 16.7)]
    status = ask(stalled, "memory_status")
    assert [gap["duration_s"] for gap in status["gaps"]] == pytest.approx([0.705, 3.005], abs=0.001)
    assert status["doubts"] == "while the recorder ran, nothing was recorded 2 times (3.71 s)"
    window = {"start": BEGIN + 8.5, "end": BEGIN + 10.5}
    reply = ask(stalled, "get_topic_in_range", topic="/chatter", **window)
    assert (reply["error"], reply["reason"]) == ("no_data", "gap")


def test_a_recorder_did_not_stall_where_another_recording_lies_within_its_pause(
    tmp_path: Path,
) -> None:
    bag, moved = at_rates(), 1000 * S
    ahead = [replace(message, log_time=message.log_time + moved) for message in bag]
    between = [replace(message, log_time=message.log_time + moved // 2) for message in bag]
    write_mcap(tmp_path / "older" / "older_0.mcap", between)
    memory = memory_with(tmp_path, [*bag, *ahead])
    assert len(gaps(memory)) == 3 * len(STALLS) + 2
    doubts = ask(memory, "memory_status")["doubts"]
    assert doubts.endswith("while the recorder ran, nothing was recorded 6 times (11.13 s)")

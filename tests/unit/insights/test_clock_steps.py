"""A clock that was set while the robot drove, and what only looks like it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, boolean, odom, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of, recalling

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.context import Memory

S = 10**9
BEGIN = 1_784_000_000
SPLITS, SPLIT, HZ = 20, 10, 10
SPEED = 0.5


def recorded(
    folder: Path,
    *,
    shown: Callable[[float], float] = lambda t: t,
    driven: Callable[[float], float] = lambda t: t,
    is_on: Callable[[float], bool] = lambda t: True,
) -> Memory:
    """A robot whose clock shows `shown` seconds, that has driven for `driven` at a time."""
    for number in range(SPLITS):
        messages: list[Msg] = []
        for beat in range(number * SPLIT * HZ, (number + 1) * SPLIT * HZ):
            t = beat / HZ
            if not is_on(t):
                continue
            at = BEGIN * S + round(shown(t) * S)
            messages.append(odom(at, SPEED * driven(t), 0.0, 0.0))
            if beat % HZ == 0:
                messages.append(boolean(at + 1, data=False))
        write_mcap(folder / "rec" / f"rec_{number}.mcap", messages)
    return memory_of(folder, clock=SettableClock((BEGIN + 1000) * S))


@pytest.fixture(params=[False, True], ids=["without catalogue", "with catalogue"])
def known(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[Memory], Memory]:
    return lambda memory: recalling(memory, tmp_path) if request.param else memory


@pytest.mark.parametrize("when", [54.95, 59.95], ids=["in a split", "between two"])
def test_a_clock_that_was_set_forward_is_reported_wherever_it_is_asked(
    tmp_path: Path, known: Callable[[Memory], Memory], when: float
) -> None:
    memory = known(recorded(tmp_path, shown=lambda t: t + 8.0 * (t > when)))
    at = BEGIN + round(when - 0.05, 1)
    expected = [{"at": pytest.approx(at, abs=1e-5), "step_s": pytest.approx(8.0, abs=0.01)}]
    assert asked(memory, tmp_path, "data_time_range")["clock_steps"] == expected
    assert asked(memory, tmp_path, "memory_status")["clock_steps"] == expected
    reply = asked(memory, tmp_path, "recap", start=BEGIN, end=BEGIN + 100)
    [event] = [each for each in reply["events"] if "clock" in each["text"]]
    assert event["text"] == "the clock was set forward by 8 s"
    assert reply["counts"]["clock steps"] == 1
    later = asked(memory, tmp_path, "recap", start=BEGIN + 100, end=BEGIN + 150)
    assert "clock steps" not in later["counts"]


def test_a_suspected_hole_is_read_once(tmp_path: Path) -> None:
    memory = recalling(recorded(tmp_path, shown=lambda t: t + 8.0 * (t > 55)), tmp_path)
    first = steps(memory, tmp_path)
    stored = replace(memory, reader=Unreadable())
    assert steps(stored, tmp_path) == first != []


class Unreadable(McapReader):
    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[int]:
        raise AssertionError(path)


def steps(memory: Memory, folder: Path) -> list[Any]:
    found: list[Any] = asked(memory, folder, "data_time_range")["clock_steps"]
    return found


def test_a_recorder_that_stalled_while_the_robot_drove_on_is_no_step(tmp_path: Path) -> None:
    memory = recorded(tmp_path, is_on=lambda t: not 52 < t < 57)
    assert len(memory.index.snapshot().suspected_holes) == 1
    assert steps(memory, tmp_path) == []


def test_where_the_robot_stood_a_step_and_a_pause_are_alike(tmp_path: Path) -> None:
    memory = recorded(
        tmp_path, shown=lambda t: t + 8.0 * (t > 55), driven=lambda t: t if t < 50 else 50.0
    )
    assert len(memory.index.snapshot().suspected_holes) == 1
    assert steps(memory, tmp_path) == []


def test_a_second_is_no_step(tmp_path: Path) -> None:
    memory = recorded(tmp_path, shown=lambda t: t + 1.0 * (t > 55))
    assert memory.index.snapshot().suspected_holes == ()
    assert steps(memory, tmp_path) == []


def test_a_clock_that_was_set_back_is_listed_with_a_negative_step(tmp_path: Path) -> None:
    memory = recorded(tmp_path, shown=lambda t: t - 30.0 * (t >= 100))
    [step] = steps(memory, tmp_path)
    assert step == {"at": BEGIN + 70, "step_s": pytest.approx(-29.9, abs=0.01)}


def test_one_topic_that_pauses_is_no_hole(tmp_path: Path) -> None:
    for number in range(SPLITS):
        begin = (BEGIN + number * SPLIT) * S
        messages = [
            odom(begin + at * S // HZ, 0.0, 0.0, 0.0)
            for at in range(SPLIT * HZ)
            if number != 5 or not 30 < at < 70
        ]
        messages += [boolean(begin + at * S + 1, data=False) for at in range(SPLIT)]
        messages.sort(key=lambda each: each.log_time)
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", messages)
    memory = memory_of(tmp_path, clock=SettableClock((BEGIN + 1000) * S))
    assert memory.index.snapshot().suspected_holes == ()


def test_a_robot_that_publishes_little_has_no_holes_to_look_at(tmp_path: Path) -> None:
    for number in range(SPLITS):
        begin = (BEGIN + number * SPLIT) * S
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", [odom(begin, 0.0, 0.0, 0.0)])
    memory = memory_of(tmp_path, clock=SettableClock((BEGIN + 1000) * S))
    assert memory.index.snapshot().suspected_holes == ()

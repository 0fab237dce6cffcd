"""A window in which nothing was recorded has no answer: "never" and "none" would be false."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.history.context import Memory, QuerySettings
from tests.support.bags import boolean, detections, log_entry, odom, write_mcap
from tests.support.clocks import FixedClock
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from pathlib import Path


S = 10**9
T0_S = 1_795_161_600
T0 = T0_S * S
TRUE = {"topic": "/bumper", "condition_type": "equals", "value": True}
WINDOWED: dict[str, dict[str, Any]] = {
    "find_matches": TRUE,
    "find_things": {},
    "visits": {"x": 1, "y": 0},
    "trajectory_summary": {},
    "get_topic_in_range": {"topic": "/odom"},
}
BEFORE: dict[str, dict[str, Any]] = {
    "find_last_match": TRUE,
    "get_value_when": {
        "value_topic": "/odom",
        "condition_topic": "/bumper",
        "condition_type": "equals",
        "value": True,
    },
}
NOTHING = [((-50, -20), "outside_range"), ((70, 90), "gap"), ((160, 190), "outside_range")]
"""Seconds after the begin; recorded are 0 to 39 and 140 to 149."""


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gap")
    for name, seconds in (("a", range(40)), ("b", range(140, 150))):
        messages = [odom(T0 + at * S, 0.1 * at, 0.0) for at in seconds]
        begin = T0 + seconds[0] * S
        messages += [boolean(begin, True), detections(begin, ["cup"])]
        messages.append(log_entry(begin, 40, "motor", "too hot"))
        write_mcap(folder / name / f"{name}_0.mcap", messages)
    return folder


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "catalogue"])
def memory(bag_dir: Path, request: pytest.FixtureRequest) -> Memory:
    found = memory_of(bag_dir, clock=FixedClock(T0 + 200 * S), limits=QuerySettings())
    return with_store(found, bag_dir) if request.param else found


@pytest.mark.parametrize(("window", "reason"), NOTHING)
@pytest.mark.parametrize("tool", WINDOWED)
def test_a_window_without_recording_is_not_answered_as_never(
    memory: Memory, bag_dir: Path, tool: str, window: tuple[int, int], reason: str
) -> None:
    start, end = (T0_S + each for each in window)
    told = asked(memory, bag_dir, tool, **WINDOWED[tool], start=start, end=end)
    assert (told["error"], told["reason"]) == ("no_data", reason)
    assert "the memory covers" in told["detail"]


@pytest.mark.parametrize("tool", BEFORE)
def test_never_before_the_memory_began_is_no_data(memory: Memory, bag_dir: Path, tool: str) -> None:
    told = asked(memory, bag_dir, tool, **BEFORE[tool], before=T0_S - 1)
    assert (told["error"], told["reason"]) == ("no_data", "outside_range")
    found = asked(memory, bag_dir, tool, **BEFORE[tool], before=T0_S + 90)
    assert found["timestamp"] == T0_S
    never = BEFORE[tool] | {"value": False}
    assert asked(memory, bag_dir, tool, **never) is None


@pytest.mark.parametrize("tool", WINDOWED)
def test_a_window_that_is_recorded_in_part_says_how_much(
    memory: Memory, bag_dir: Path, tool: str
) -> None:
    told = asked(memory, bag_dir, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 149)
    window = f"between {T0_S}.000000 and {T0_S + 149}.000000"
    assert f"recorded only 48 of 149 s {window}" in told["notes"]
    whole = asked(memory, bag_dir, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 39)
    assert not any("recorded" in note for note in whole.get("notes", ()))


@pytest.mark.parametrize("window", [each for each, _ in NOTHING])
def test_recap_and_compare_say_first_that_nothing_was_recorded(
    memory: Memory, bag_dir: Path, window: tuple[int, int]
) -> None:
    start, end = (T0_S + each for each in window)
    note = f"nothing was recorded between {start}.000000 and {end}.000000"
    assert asked(memory, bag_dir, "recap", start=start, end=end)["notes"][0] == note
    other = {"with_start": T0_S, "with_end": T0_S + 30}
    reply = asked(memory, bag_dir, "compare", start=start, end=end, **other)
    assert reply["notes"][0] == note
    assert "things are not compared: there is nothing to compare them with" in reply["notes"]
    assert (reply["things"], reply["things_unchanged"]) == ({}, 0)
    [error] = reply["errors"].values()
    assert (error["this"], error["with"]) == (None, 1)

"""What an answer says must hold: of which time it speaks, how far off, and what would help.

A window in which nothing was recorded has no answer: "never" and "none" would be false.
"""

import re
from pathlib import Path
from typing import Any

import pytest

from ros2_memory import queries
from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import AtTime, TimeRange
from tests.support.bags import boolean, detections, log_entry, odom, text, tf, transform, write_mcap
from tests.support.clocks import FixedClock
from tests.support.memories import asked, memory_of, with_store

S = 10**9
T0_S = 1_784_023_200
T0 = T0_S * S


def after(seconds_later: float) -> AtTime:
    return AtTime(at_s=T0_S + seconds_later)


def frames_that_part(bag_dir: Path) -> None:
    """`map` is known for ten seconds, `odom` for a minute."""
    messages = [
        tf(T0 + tick * S // 2, transform(T0 + tick * S // 2, *pair, (tick, 0.0, 0.0)))
        for tick in range(120)
        for pair in [("map", "odom"), ("odom", "base_link")]
        if tick <= 20 or pair[0] == "odom"
    ]
    write_mcap(bag_dir / "run" / "run_0.mcap", messages)


@pytest.mark.parametrize(
    ("parent", "child", "later", "reason"),
    [
        ("map", "nobody", 50, NoDataReason.FRAME_UNKNOWN),
        ("/map", "base_link", 50, NoDataReason.GAP),
        ("map", "base_link", 3 * 3600 + 50, NoDataReason.FRAME_UNKNOWN),
    ],
)
def test_a_frame_that_is_reported_within_an_hour_is_not_unknown_but_silent(
    tmp_path: Path, parent: str, child: str, later: float, reason: NoDataReason
) -> None:
    frames_that_part(tmp_path)
    at = T0 + 3 * 3600 * S + 50 * S
    moved = [tf(at, transform(at, "odom", "base_link", (0.0, 0.0, 0.0)))]
    write_mcap(tmp_path / "late" / "late_0.mcap", moved)
    plain = memory_of(tmp_path)
    for memory in (plain, with_store(plain, tmp_path)):
        with pytest.raises(NoDataError) as caught:
            queries.transform(memory, Call(), parent, child, after(later))
        assert caught.value.reason is reason


@pytest.mark.parametrize("older_s", [12.631, 59.891])
def test_the_tolerance_that_is_advised_finds_the_message(tmp_path: Path, older_s: float) -> None:
    messages = [boolean(T0, True), text(T0 + round(older_s * S), "late")]
    write_mcap(tmp_path / "run" / "run_0.mcap", messages)
    memory = memory_of(tmp_path)
    with pytest.raises(NoDataError) as caught:
        queries.topic_value(memory, Call(), "/bumper", after(older_s))
    advised = re.search(r"tolerance_s of at least ([\d.]+)", caught.value.detail)
    assert advised
    reply = queries.topic_value(
        memory, Call(), "/bumper", after(older_s), tolerance_s=float(advised[1])
    )
    assert reply.sample.time == T0


@pytest.mark.parametrize("loose", [False, True])
def test_of_several_robots_in_one_folder_the_nearest_message_is_not_another_robots(
    tmp_path: Path, loose: bool
) -> None:
    """Years apart: what the recording of that time has is named, and where to look in it."""
    names = ("robin", "wren") if loose else ("robin/robin_0", "wren/wren_0")
    year = 365 * 86_400
    own = [odom(T0 + n * S, 0.0, 0.0, topic="/base/odometry") for n in range(10)]
    write_mcap(tmp_path / f"{names[0]}.mcap", [*own, text(T0, "one")])
    write_mcap(tmp_path / f"{names[1]}.mcap", [odom(T0 + year * S, 0.0, 0.0)])
    memory = memory_of(tmp_path)
    with pytest.raises(NoDataError) as caught:
        queries.position(memory, Call(), after(5))
    detail = caught.value.detail
    assert "robin" in detail
    assert "has no such topic; similar there: /base/odometry; give topic" in detail
    assert "nearest" not in detail
    with pytest.raises(NoDataError, match="similar there: /base/odometry"):
        queries.topic_range(memory, Call(), "/odom", TimeRange(T0_S + 1, T0_S + 3))
    # Between the two there is nothing to tell them apart by.
    with pytest.raises(NoDataError, match="nearest newer one is 364 days after"):
        queries.position(memory, Call(), after(86_400))


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
    for name, driven in (("a", range(40)), ("b", range(140, 150))):
        messages = [odom(T0 + at * S, 0.1 * at, 0.0) for at in driven]
        begin = T0 + driven[0] * S
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
    almost = asked(memory, bag_dir, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 39.01)
    assert not any("recorded only" in note for note in almost.get("notes", ()))

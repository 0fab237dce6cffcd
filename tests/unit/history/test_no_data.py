"""What an answer says must hold: of which time it speaks, how far off, and what would help.

A window in which nothing was recorded has no answer: "never" and "none" would be false. What was
excluded was recorded, an interruption explains what it cost and no more, and time 0 is a moment
like any other."""

import json
import random
import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pytest

from ros2_memory.bag_dir.state_files import (
    EVERY_TOPIC,
    SCREENED,
    Excluded,
    Loss,
    ScreenState,
    append_losses,
)
from ros2_memory.core.errors import NoDataReason
from ros2_memory.history.context import Memory, QuerySettings
from tests.support.bags import (
    McapLayout,
    boolean,
    detections,
    log_entry,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.clocks import FixedClock, SettableClock
from tests.support.memories import asked, memory_of, replied, with_store
from tests.unit.history.test_any_cut import questions

S = 10**9

T0_S = 1_784_023_200

T0 = T0_S * S


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
    """`map` is known for ten seconds, `odom` for a minute, and again three hours later."""
    for name, start, stop, pair in (
        ("run/run_0", 0, 11, ("map", "odom")),
        ("run/run_1", 0, 60, ("odom", "base_link")),
        ("late/late_0", 10_850, 10_851, ("odom", "base_link")),
    ):
        ticks = range(T0 + start * S, T0 + stop * S, S // 2)
        moved = [tf(at, transform(at, *pair, (0.0, 0.0, 0.0))) for at in ticks]
        write_mcap(tmp_path / f"{name}.mcap", moved)
    plain = memory_of(tmp_path)
    asks = {"parent": parent, "child": child, "timestamp": T0_S + later}
    for memory in (plain, with_store(plain, tmp_path)):
        assert asked(memory, "get_transform_at", **asks)["reason"] == reason


@pytest.mark.parametrize("older_s", [12.631, 59.891])
def test_the_tolerance_that_is_advised_finds_the_message(tmp_path: Path, older_s: float) -> None:
    messages = [boolean(T0, True), text(T0 + round(older_s * S), "late")]
    write_mcap(tmp_path / "run" / "run_0.mcap", messages)
    ask = partial(asked, memory_of(tmp_path), "get_topic_at_time", topic="/bumper")
    detail = ask(timestamp=T0_S + older_s)["detail"]
    advised = re.search(r"tolerance_s of at least ([\d.]+)", detail)
    assert advised
    assert ask(timestamp=T0_S + older_s, tolerance_s=float(advised[1]))["timestamp"] == T0_S


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
        messages = [odom(T0 + at * S, 0.1 * at) for at in driven]
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
    memory: Memory, tool: str, window: tuple[int, int], reason: str
) -> None:
    start, end = (T0_S + each for each in window)
    told = asked(memory, tool, **WINDOWED[tool], start=start, end=end)
    assert (told["error"], told["reason"]) == ("no_data", reason)
    assert "the memory covers" in told["detail"]


@pytest.mark.parametrize("tool", BEFORE)
def test_never_before_the_memory_began_is_no_data(memory: Memory, tool: str) -> None:
    told = asked(memory, tool, **BEFORE[tool], before=T0_S - 1)
    assert (told["error"], told["reason"]) == ("no_data", "outside_range")
    found = asked(memory, tool, **BEFORE[tool], before=T0_S + 90)
    assert found["timestamp"] == T0_S
    never = BEFORE[tool] | {"value": False}
    assert asked(memory, tool, **never) is None


@pytest.mark.parametrize("tool", WINDOWED)
def test_a_window_that_is_recorded_in_part_says_how_much(memory: Memory, tool: str) -> None:
    told = asked(memory, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 149)
    window = f"between {T0_S}.000000 and {T0_S + 149}.000000"
    assert f"recorded only 48 of 149 s {window}" in told["notes"]
    whole = asked(memory, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 39)
    assert "recorded" not in str(whole.get("notes"))
    almost = asked(memory, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 39.01)
    assert "recorded only" not in str(almost.get("notes"))


BEGIN = 1_784_000_000
MODE = "/privacy_mode"
DIED = "because ros2 bag record died"
UNCLEAN = "because the recorder ended without a shutdown"


@pytest.fixture
def apart(tmp_path: Path) -> Path:
    """Two recordings, with 80 s between them; a mode holds from the begin of each."""
    layout = McapLayout(latched=frozenset({MODE}))
    for name, start, stop in (("a", 0, 21), ("b", 100, 120)):
        messages = [odom((BEGIN + second) * S, 1.0, 2.0) for second in range(start, stop)]
        messages.append(boolean((BEGIN + start) * S, False, MODE))
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages, layout)
    return tmp_path


def interrupted(apart: Path, start: int, stop: int, by: Any = "died") -> None:
    append_losses(apart, [Loss(EVERY_TOPIC, (BEGIN + start) * S, (BEGIN + stop) * S, 0, by)])


def exclude(apart: Path, start: int, stop: int) -> None:
    excluded = Excluded((BEGIN + start) * S + 1, (BEGIN + stop) * S)
    SCREENED.write(apart, ScreenState(excluded=[excluded]))


def ask(apart: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(apart), tool, **given)


def causes(apart: Path) -> list[str]:
    found = ask(apart, "trajectory_summary", start=BEGIN + 10, end=BEGIN + 110)["notes"]
    told = [note for note in found if note.startswith("nothing ")]
    return [note.replace(str(BEGIN // 1000), "") for note in told]


def test_a_cause_is_said_of_the_interruption_and_not_of_the_whole_gap(apart: Path) -> None:
    interrupted(apart, 22, 30)
    assert causes(apart) == [
        f"nothing was recorded from 020.000000 to 040.000000 (20 s), {DIED}",
        "nothing was recorded from 040.000000 to 100.000000 (60 s)",
    ]
    doubts = ask(apart, "memory_status")["doubts"]
    assert "(20 s), because ros2 bag record died" in doubts
    assert "60 s" not in doubts


def test_what_was_excluded_was_recorded(apart: Path) -> None:
    exclude(apart, 20, 100)
    interrupted(apart, 98, 102, "unclean")
    assert causes(apart) == []
    exclude(apart, 20, 90)
    assert f"nothing was recorded from 090.000000 to 100.000000 (10 s), {UNCLEAN}" in causes(apart)


@pytest.mark.parametrize("stop", [90, 100])
def test_what_was_excluded_is_no_gap_and_no_event_and_has_no_value_not_even_an_older_one(
    apart: Path, stop: int
) -> None:
    exclude(apart, 20, stop)
    for tool in ("data_time_range", "memory_status"):
        gaps = [(gap["start"] - BEGIN, gap["end"] - BEGIN) for gap in ask(apart, tool)["gaps"]]
        assert gaps == [(90, 100)] * (stop == 90)
    recap = ask(apart, "recap", start=BEGIN, end=BEGIN + 120)
    told = [event["text"] for event in recap["events"]]
    assert [each for each in told if "recorded" in each or "silent" in each] == [
        "nothing was recorded"
    ] * (stop == 90)
    assert "excluded by the rules" in str(recap["notes"])
    at = {"timestamp": BEGIN + 60}
    for tool, given in (
        ("get_position_at", at),
        ("get_topic_in_range", {"topic": "/odom", "start": BEGIN + 40, "end": BEGIN + 60}),
        ("get_topic_at_time", {"topic": MODE, **at}),
    ):
        reply = ask(apart, tool, **given)
        assert reply["reason"] == "deleted"
        assert "excluded by the rules" in str(reply["notes"])


def test_what_may_be_in_a_file_that_cannot_be_read_is_not_said_to_be_unrecorded(
    apart: Path,
) -> None:
    interrupted(apart, 22, 30)
    (apart / "a" / "a_1.mcap").write_bytes(b"no bag at all" * 100)
    assert causes(apart) == [
        f"nothing was recorded from 022.000000 to 030.000000 (8 s), {DIED}",
        "nothing could be read from 030.000000 to 100.000000 (70 s)",
    ]


Now = Literal["wall", "latest"]

SEARCH = {"condition_type": "equals", "value": True}

NEVER = {"condition_type": "contains", "value": "never recorded"}

PLACE = {"condition_type": "near_position", "value": {"x": 0.0, "y": 0.0}}

each_pair = pytest.mark.parametrize(("recalls", "now"), [(False, "wall"), (True, "latest")])


def zero_questions(topics: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    yield from questions(random.Random(7), topics, [0, 1000, S, 5 * S, 9 * S], most=60)
    yield "list_frames", {}
    for timestamp in (-5.0, 0.0, 1e-6):
        for more in ({}, {"tolerance_s": 1e12}):
            yield "get_topic_at_time", {"topic": "/odom", "timestamp": timestamp, **more}
    for ago in (0.0, 1.0, 1e12):
        yield "get_topic_seconds_ago", {"topic": "/odom", "seconds_ago": ago}
    for start, end in ((-1e300, 1e-6), (-5.0, -1.0), (-10.0, 1e9), (0.0, 0.0)):
        window = {"start": start, "end": end}
        yield "trajectory_summary", window
        yield "recap", window
        for condition in (SEARCH, NEVER, PLACE):
            yield "find_matches", {"topic": "/*", **condition, **window}
    for seconds in (1e-6, 1e12, 1e300):
        yield "recap", {"last_s": seconds}
        yield "find_matches", {"topic": "/*", **SEARCH, "seconds": seconds}
    for condition in (SEARCH, NEVER, PLACE):
        yield "find_last_match", {"topic": "/*", **condition, "before": -1.0}


def times(value: Any) -> Iterator[float]:
    """All numbers of a reply."""
    if isinstance(value, dict):
        value = [*value.values()]
    if isinstance(value, list):
        for each in value:
            yield from times(each)
    elif isinstance(value, int | float):
        yield value


@pytest.fixture
def from_zero(tmp_path: Path) -> Path:
    for split in range(2):
        messages = [odom((split * 5 + n) * S, n * 0.1) for n in range(5)]
        messages.append(boolean(split * 5 * S, True))
        messages.append(detections(split * 5 * S, ["cup"]))
        write_mcap(tmp_path / "rec" / f"rec_{split}.mcap", messages)
    return tmp_path


@each_pair
def test_no_reply_about_a_memory_from_time_zero_holds_a_bound_of_the_clock(
    from_zero: Path, recalls: bool, now: Now
) -> None:
    """Asks much, and finds neither a refusal nor the least or greatest 64-bit time."""
    memory = memory_of(
        from_zero, clock=SettableClock(9 * S), limits=QuerySettings(now=now), recalls=recalls
    )
    for name, given in zero_questions(memory.index.snapshot().timeline.topics()):
        reply = replied(memory, name, given)
        told = f"{name}({given}): {reply.text[:2000]}"
        assert "92233720" not in reply.text, told
        value = json.loads(reply.text)
        if reply.is_error:
            assert "carries no" in reply.text or "no position" in reply.text, told
        assert all(abs(each) < 9e9 or each == 1e300 for each in times(value)), told

"""Time 0 is a moment like any other, and what stands for no bound reaches no reply."""

import json
import random
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import pytest

from ros2_memory.history.context import QuerySettings
from tests.support.bags import boolean, detections, odom, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of, replied
from tests.unit.history.test_any_cut import questions

S = 10**9
Now = Literal["wall", "latest"]
SEARCH = {"condition_type": "equals", "value": True}
NEVER = {"condition_type": "contains", "value": "never recorded"}
PLACE = {"condition_type": "near_position", "value": {"x": 0.0, "y": 0.0}}

each_pair = pytest.mark.parametrize(("recalls", "now"), [(False, "wall"), (True, "latest")])


def asking(topics: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
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
def bag_dir(tmp_path: Path) -> Path:
    for split in range(2):
        messages = [odom((split * 5 + n) * S, n * 0.1, 0.0) for n in range(5)]
        messages.append(boolean(split * 5 * S, True))
        messages.append(detections(split * 5 * S, ["cup"]))
        write_mcap(tmp_path / "rec" / f"rec_{split}.mcap", messages)
    return tmp_path


@each_pair
def test_no_reply_about_a_memory_from_time_zero_holds_a_bound_of_the_clock(
    bag_dir: Path, recalls: bool, now: Now
) -> None:
    """Asks much, and finds neither a refusal nor the least or greatest 64-bit time."""
    memory = memory_of(
        bag_dir, clock=SettableClock(9 * S), limits=QuerySettings(now=now), recalls=recalls
    )
    for name, given in asking(memory.index.snapshot().timeline.topics()):
        reply = replied(memory, bag_dir, name, given)
        told = f"{name}({given}): {reply.text[:2000]}"
        assert "92233720" not in reply.text, told
        value = json.loads(reply.text)
        if reply.is_error:
            assert "carries no" in reply.text or "no position" in reply.text, told
        assert all(abs(each) < 9e9 or each == 1e300 for each in times(value)), told


@pytest.mark.parametrize("begin_s", [0, 1_784_000_000])
@pytest.mark.parametrize(("start", "end"), [(-1e300, -1e-6), (-5, -5), (-1, 0)])
def test_a_window_below_zero_is_clamped_at_both_ends(
    tmp_path: Path, begin_s: int, start: float, end: float
) -> None:
    messages = [odom((begin_s + 1 + n) * S, n * 0.1, 0.0) for n in range(5)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*messages, boolean((begin_s + 1) * S, True)])
    memory = memory_of(tmp_path, clock=SettableClock((begin_s + 9) * S))
    window = {"start": start, "end": end}
    told = asked(memory, tmp_path, "recap", **window)
    assert (told["start"], told["end"], told["events"]) == (0.0, 0.0, [])
    told = asked(memory, tmp_path, "find_matches", topic="/bumper", **SEARCH, **window)
    assert (told["error"], told["reason"]) == ("no_data", "outside_range")
    for tool in ("get_topic_in_range", "trajectory_summary"):
        told = asked(memory, tmp_path, tool, topic="/odom", **window)
        assert "no message of /odom between 0.000000 and 0.000000" in told["detail"]


@pytest.mark.parametrize(("start", "end"), [(1.0, 2.0), (1e9, 1e9), (1.9e9, 2e9), (0.0, 2e9)])
def test_no_span_that_was_searched_ends_before_it_begins(
    tmp_path: Path, start: float, end: float
) -> None:
    begin = 1_784_000_000 * S
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [boolean(begin + n * S, True) for n in range(5)])
    memory = memory_of(tmp_path)
    window = {"start": start, "end": end}
    told = asked(memory, tmp_path, "find_matches", topic="/bumper", **SEARCH, **window)
    if not end > begin / S > start:
        assert (told["error"], told["reason"]) == ("no_data", "outside_range")
        return
    assert start <= told["searched_from"] <= told["searched_to"] <= end
    assert told["total"] > 0

"""What was excluded was recorded: it is no gap, no silence and no event of the recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.bags import Msg, odom, text
from tests.support.memories import asked, memory_of
from tests.support.screened_bags import T0, S, ScreenedBags, mode, words

T0_S = T0 // S


def drive(start: int, stop: int) -> list[Msg]:
    return [*words(start, stop), *(odom(T0 + n * S, 1.0, 2.0) for n in range(start, stop))]


def record(bags: ScreenedBags, start: int, stop: int, latched: Sequence[Msg] = ()) -> None:
    name = bags.begin(start)
    for begin in range(start, stop, 10):
        own = [each for each in latched if T0 + begin * S <= each.log_time < T0 + (begin + 10) * S]
        bags.split(name, [*drive(begin, begin + 10), *own])
    bags.end()


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    """Of a minute 20 to 40 s are excluded but for a map; the next recording begins 40 s later."""
    bags = ScreenedBags(tmp_path)
    modes = [mode(1, value=False), mode(21, value=True), mode(39, value=False)]
    area = text(T0 + 30 * S, "floor", "/map")
    received_again = Msg(area.topic, area.type, area.log_time, area.body, T0 + 2 * S)
    record(bags, 0, 60, [*modes, received_again])
    record(bags, 100, 120, [mode(100, value=False)])
    assert bags.seconds("/map") == [30]
    return tmp_path


def ask(bag_dir: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(bag_dir), bag_dir, tool, **given)


def test_what_was_excluded_is_no_gap_and_no_event(bag_dir: Path) -> None:
    for tool in ("data_time_range", "memory_status"):
        gaps = ask(bag_dir, tool)["gaps"]
        assert [(gap["start"] - T0_S, gap["end"] - T0_S) for gap in gaps] == [(59.5, 100)]
    recap = ask(bag_dir, "recap", start=T0_S, end=T0_S + 120)
    told = [event["text"] for event in recap["events"]]
    assert [each for each in told if "recorded" in each or "silent" in each] == [
        "nothing was recorded"
    ]
    assert "excluded by the rules" in str(recap["notes"])


def test_a_moment_that_was_excluded_has_no_value_not_even_an_older_one(bag_dir: Path) -> None:
    def reason(tool: str, **given: object) -> Any:
        reply = ask(bag_dir, tool, **given)
        assert "excluded by the rules" in str(reply.get("notes"))
        return reply.get("reason", reply.get("value"))

    assert reason("get_position_at", timestamp=T0_S + 30) == "deleted"
    assert reason("get_topic_in_range", topic="/odom", start=T0_S + 25, end=T0_S + 35) == "deleted"
    # The robot was private then, and the message that said so is not served.
    at = {"topic": "/privacy_mode", "timestamp": T0_S + 30}
    assert reason("get_topic_at_time", **at) == "deleted"

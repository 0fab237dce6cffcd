"""What the demo prints, which fits a terminal and leaves nothing unsaid; and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ros2_memory.core.errors import ConfigError
from ros2_memory.demo.questions import QUESTIONS, Exchange
from ros2_memory.demo.run import format_exchange, run_demo

REPLY = json.dumps(
    {"samples": [{"timestamp": 1_800_000_000.25 + k, "value": "in the hall"} for k in range(40)]},
    separators=(",", ":"),
)


def test_the_call_is_shown_as_it_was_made() -> None:
    question = next(one for one in QUESTIONS if one.tool == "get_position_seconds_ago")
    lines = format_exchange(
        3, Exchange(question, '{"x":1,"y":2}', "There.", right=True)
    ).splitlines()
    assert lines == [
        " 3. Where was I 10 s ago?",
        "    get_position_seconds_ago(seconds_ago=10)",
        "    => There.",
        '    {"x":1,"y":2}',
    ]


def test_a_long_reply_is_cut_and_says_so() -> None:
    last = format_exchange(1, Exchange(QUESTIONS[0], REPLY, "Yes.", right=True)).splitlines()[-1]
    assert f"{len(REPLY):,} characters in all" in last


@pytest.mark.parametrize("duration_s", [89.9, 86_401.0, float("nan")])
def test_a_history_too_short_for_a_lap_or_endless_is_refused(duration_s: float) -> None:
    with pytest.raises(ConfigError, match="--duration"):
        run_demo(print, duration_s=duration_s)


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs.mcap").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"--bag-dir .* not an empty folder"):
        run_demo(print, bag_dir=tmp_path)

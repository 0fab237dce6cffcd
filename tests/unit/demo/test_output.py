"""What the demo prints fits a terminal and leaves nothing of an answer unsaid."""

from __future__ import annotations

import json

import pytest

from ros2_memory.demo.questions import QUESTIONS, Exchange, Question
from ros2_memory.demo.run import format_exchange

REPLY = json.dumps(
    {"samples": [{"timestamp": 1_800_000_000.25 + k, "value": "in the hall"} for k in range(40)]},
    separators=(",", ":"),
)


@pytest.mark.parametrize("question", QUESTIONS, ids=lambda question: question.words)
def test_every_line_fits_a_hundred_columns(question: Question) -> None:
    exchange = Exchange(question, REPLY, "It was in the hall. " * 12, right=True)
    assert all(len(line) <= 100 for line in format_exchange(12, exchange).splitlines())


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

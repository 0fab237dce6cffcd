"""The demo's judges: right answers pass, and whatever is off by more than rounding does not."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, unix_rounded_up
from ros2_memory.demo import judges, robot
from ros2_memory.demo.judges import (
    CallContext,
)
from ros2_memory.demo.published_topics import (
    ODOM,
    PATH_CLEAR,
    SCENE_OBJECTS,
    STREAMS,
    MessageSchedule,
)
from ros2_memory.demo.questions import QUESTIONS, Question, judge_reply

T0 = 1_800_000_000 * NS_PER_S
START = T0 + 22 * NS_PER_S
NOW = START + 122 * NS_PER_S + 10 * NS_PER_MS
TIMELINE = MessageSchedule(T0, START)
BY_TOPIC = {stream.topic: stream for stream in STREAMS}
ASKED = CallContext(TIMELINE, NOW, NOW + 5 * NS_PER_MS, (NOW - 7 * NS_PER_S, NOW - 2 * NS_PER_S))


def position_reply(**changes: JsonValue) -> JsonValue:
    message = TIMELINE.newest(BY_TOPIC[ODOM], NOW - 10 * NS_PER_S)
    assert message is not None
    truth = robot.pose(message.t)
    reply: dict[str, JsonValue] = {
        "x": round(truth.x, 4),
        "y": round(truth.y, 4),
        "z": 0,
        "yaw_deg": round(math.degrees(truth.yaw), 2),
        "timestamp": unix_rounded_up(message.log_time),
        "frame_id": "odom",
    }
    return {**reply, **changes}


def test_a_right_position_becomes_a_sentence() -> None:
    answer = judges.position(10)(position_reply(), ASKED)
    assert answer == "In the kitchen, at x 1.00 m, y -7.36 m in odom, facing 90 degrees."


def test_an_error_where_an_answer_was_due_is_wrong() -> None:
    question = Question("Where?", "get_position_seconds_ago", {}, judges.position(10))
    reply = json.dumps(position_reply())
    assert judge_reply(question, reply, ASKED).right
    assert not judge_reply(question, reply, ASKED, is_error=True).right
    refusal = judge_reply(question, '{"error":"no_data","reason":"gap","detail":"..."}', ASKED)
    assert not refusal.right
    assert "timestamp" in refusal.sentence


@pytest.mark.parametrize("reply", ["", "null", "[]", "{", '{"x": NaN}', "3"])
def test_a_reply_of_another_shape_is_wrong_to_every_question(reply: str) -> None:
    assert not any(judge_reply(question, reply, ASKED).right for question in QUESTIONS)


def test_a_message_may_be_of_any_moment_between_the_two_readings_of_the_clock() -> None:
    late = replace(ASKED, after=NOW + 120 * NS_PER_MS)
    ks = [message.k for message in late.ago(BY_TOPIC[ODOM], 10)]
    exact = replace(ASKED, after=NOW)
    (newest,) = [message.k for message in exact.ago(BY_TOPIC[ODOM], 10)]
    assert ks == [newest + 2, newest + 1, newest]


def test_the_newest_known_message_is_that_of_one_of_the_possible_ends() -> None:
    ends = [message.log_time for message in ASKED.newest_known(BY_TOPIC[PATH_CLEAR])]
    assert [end <= known for end, known in zip(ends, ASKED.known, strict=True)] == [True, True]
    assert [known - end < 501 * NS_PER_MS for end, known in zip(ends, ASKED.known, strict=True)]


def test_the_last_time_is_searched_backwards_from_the_end() -> None:
    def sees_scissors(t: float) -> bool:
        return any(thing.label == "scissors" for thing in robot.seen(t))

    for message in ASKED.last_where(BY_TOPIC[SCENE_OBJECTS], sees_scissors):
        assert sees_scissors(message.t)
        assert not any(sees_scissors(message.t + k / 2) for k in range(1, 20))

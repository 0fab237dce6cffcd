"""The demo's questions, asked of a memory over the demo's own bags: right, and able to be wrong."""

import json
from dataclasses import dataclass

import pytest

from ros2_memory.core.errors import NoDataError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_S, Deadline, WallClock
from ros2_memory.demo.messages import MessageSchedule
from ros2_memory.demo.questions import QUESTIONS, CallContext, judge_reply
from ros2_memory.demo.recording import DemoRecorder
from ros2_memory.history.context import Call
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.replies import Replies
from tests.support.bags import set_mtime
from tests.support.clocks import FixedClock
from tests.support.memories import memory_of

BY_WORDS = {question.words: question for question in QUESTIONS}
PATHS_THAT_COUNT = {
    "How far back do you remember?": "gaps",
    "Where was I 10 s ago?": "x",
    "And how fast?": "linear.x",
    "What objects did you see at the front door?": "value.detections.0.label",
    "When was the path last clear?": "value.value",
    "How far have I driven in the last minute?": "distance_m",
    "When did you last see scissors?": "value.detections.0.label",
    "And where were you then?": "value.position.x",
    "When were you last at the kitchen counter?": "value.position.y",
    "Where in the flat was the camera 10 s ago?": "translation.y",
    "How full was the battery half a minute ago?": "value.percentage",
    "What did the camera's pictures show?": "reason",
}


@dataclass(frozen=True)
class Replied:
    """What the memory answers to every question, and the circumstances."""

    texts: dict[str, str]
    asked: CallContext


@pytest.fixture(scope="module")
def replied(tmp_path_factory: pytest.TempPathFactory) -> Replied:
    """Every reply at one moment, 123 s into a recording whose last split is open."""
    folder = tmp_path_factory.mktemp("bags")
    now = WallClock().now()
    timeline = MessageSchedule(now - 145 * NS_PER_S, now - 123 * NS_PER_S)
    recorder = DemoRecorder(folder / "flat", timeline, clock=FixedClock(now))
    for path in folder.rglob("*.mcap"):
        set_mtime(path, now)  # however long it took to write them
    memory = memory_of(folder, clock=FixedClock(now))
    tools = {tool.name: tool for tool in build_tools(memory.limits)}
    replies = Replies(folder, 24_000)
    texts = {}
    for question in QUESTIONS:
        ask = tools[question.tool].question(dict(question.arguments))
        try:
            texts[question.words] = replies.answer(ask(memory, Call(Deadline.never()))).text
        except NoDataError as error:
            texts[question.words] = replies.error(error).text
    recorder.stop()
    return Replied(texts, CallContext(timeline.t0, now, now))


@pytest.mark.parametrize("words", BY_WORDS)
def test_an_answer_of_a_real_memory_is_right_and_wrong_where_it_differs_in_a_place_that_counts(
    replied: Replied, words: str
) -> None:
    question, text = BY_WORDS[words], replied.texts[words]
    exchange = judge_reply(question, text, replied.asked)
    assert exchange.right, exchange.sentence
    falsified = json.dumps(_changed(json.loads(text), PATHS_THAT_COUNT[words].split(".")))
    assert not judge_reply(question, falsified, replied.asked).right


def _changed(reply: JsonValue, path: list[str]) -> JsonValue:
    """The reply with another value at the path, off by little where it is a number."""
    if path:
        step, *rest = path
        if isinstance(reply, list):
            nth = int(step)
            return [*reply[:nth], _changed(reply[nth], rest), *reply[nth + 1 :]]
        assert isinstance(reply, dict)
        return reply | {step: _changed(reply[step], rest)}
    if isinstance(reply, bool):
        return not reply
    if isinstance(reply, int | float):
        return reply + (1 if isinstance(reply, int) else 0.25)
    return f"{reply}x"

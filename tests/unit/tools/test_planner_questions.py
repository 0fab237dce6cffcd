"""A planner that has the list of tools alone, and what it asks about the demo's robot."""

from __future__ import annotations

import asyncio
import copy
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest
from mcp import Client
from mcp.types import TextContent

from ros2_memory.bootstrap import build_server, query_settings_of
from ros2_memory.config import load_settings
from ros2_memory.demo.judges import CallContext, WrongAnswerError
from ros2_memory.tools.reply_size import to_json_text
from tests.support.clocks import FixedClock
from tests.support.memories import memory_of, with_store
from tests.support.planner_questions import QUESTIONS, Planned
from tests.support.planner_world import World, recorded

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.model import JsonValue

BY_WORDS = {question.words: question for question in QUESTIONS}
MOST_CALLS_FOR_FORTY = 45
MOST_CHARS_FOR_FORTY = 40_000
MOST_CHARS_OF_TOOLS = 20_000
OFF_BY = 4
OF_NOTHING = {
    "Which moments were you told to keep?",
    "Did anything go wrong between these two times?",
}
THAT_COUNT = {
    "How many odometry messages do you have?": {"0.count"},
    "Where in the flat were you 25 s ago?": {"translation.x", "translation.y", "yaw_deg"},
    "How fast were you at most in the last half minute, and how long did you stand?": {
        "distance_m",
        "max_speed",
        "stood_s",
    },
    "How long have you been standing here?": {
        f"events.5.{name}" for name in ("timestamp", "ago_s", "duration_s", "text", "goes_on")
    },
    "How far did you drive between your last two stops?": {"distance_m"},
    "Where is the cup?": {
        f"sightings.0.{path}"
        for path in (
            "first_seen",
            "last_seen",
            "duration_s",
            "ago_s",
            "count",
            "robot.x",
            "robot.y",
            "robot.frame_id",
            "place.x",
            "place.y",
            "place.z",
            "place.frame_id",
        )
    },
    "How often have you seen the sofa?": {"total"},
    "Have you ever seen a dog?": {"total"},
    "How often was the path blocked in the last two minutes?": {"total"},
    "How full was the battery when you last saw the table?": {"timestamp", "value.percentage"},
    "When were you last at the kitchen counter, how often, and for how long?": {
        "frame_id",
        "there_now",
        "total",
        "visits.0.arrived",
        "visits.0.departed",
        "visits.0.duration_s",
        "visits.0.closest_m",
        "visits.0.ago_s",
    },
    "Are you on the dock, and since when?": {"there_now", "total", "visits.0.arrived"},
    "How low was the battery in the last minute, and when?": {
        "extremes.percentage.min",
        "extremes.percentage.min_at",
    },
    "How near was the nearest wall in the last 20 s?": {"extremes.ranges.min"},
    "Can I trust what you remember just now?": {"doubts", "newest_age_s", "damaged"},
    "What did you last say you saw?": {"samples.0.timestamp", "samples.0.value.value"},
}
"""Of some questions the values of the last reply that are the answer."""


@dataclass(frozen=True)
class Asking:
    """What the planner was answered to each question, and what it had to read before any."""

    replies: dict[str, list[str]]
    tools: str
    asked: CallContext


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with recorded(tmp_path_factory.mktemp("bags")) as world:
        yield world


@pytest.fixture(scope="module", params=["plain", "catalogue"])
def asking(world: World, request: pytest.FixtureRequest) -> Asking:
    """Every question asked through a client, with and without a catalogue."""
    settings = load_settings((), {"MEMORY_BAG_DIR": str(world.folder)})
    clock = FixedClock(world.asked.after)
    memory = memory_of(world.folder, clock=clock, limits=query_settings_of(settings))
    if request.param == "catalogue":
        memory = with_store(memory, world.folder)
    server = build_server(settings, memory)

    async def ask() -> Asking:
        async with Client(server) as client:
            listed = await client.list_tools()
            tools = listed.model_dump_json(by_alias=True, exclude_none=True)
            replies = {question.words: await put(client, question) for question in QUESTIONS}
        return Asking(replies, tools, world.asked)

    return asyncio.run(ask())


async def put(client: Client, question: Planned) -> list[str]:
    """What each call of a question is answered, as the planner reads it."""
    texts: list[str] = []
    for step in question.steps:
        given = dict(step.arguments([json.loads(text) for text in texts]))
        result = await client.call_tool(step.tool, given)
        [block] = result.content
        assert isinstance(block, TextContent)
        assert not result.is_error, block.text
        texts.append(block.text)
    return texts


@pytest.mark.parametrize("words", BY_WORDS)
def test_every_answer_is_right(asking: Asking, words: str) -> None:
    BY_WORDS[words].judge([json.loads(text) for text in asking.replies[words]], asking.asked)


def test_forty_questions_take_few_calls_and_few_characters(asking: Asking) -> None:
    forty = len(QUESTIONS) / 40
    chars = {words: sum(map(len, texts)) for words, texts in asking.replies.items()}
    calls = sum(map(len, asking.replies.values()))
    longest = sorted(chars.items(), key=lambda each: -each[1])
    text = f"{len(QUESTIONS)} questions, {calls} calls, {sum(chars.values())} characters: {longest}"
    assert len(QUESTIONS) >= 40
    assert calls <= MOST_CALLS_FOR_FORTY * forty, text
    assert sum(chars.values()) <= MOST_CHARS_FOR_FORTY * forty, text


def test_the_forty_longest_alone_pass_the_bar(asking: Asking) -> None:
    """The bar is of forty questions, and those that were added may be the cheaper ones."""
    by_cost = sorted(asking.replies.values(), key=lambda texts: -sum(map(len, texts)))[:40]
    calls, chars = sum(map(len, by_cost)), sum(len(text) for texts in by_cost for text in texts)
    assert (calls <= MOST_CALLS_FOR_FORTY, chars <= MOST_CHARS_FOR_FORTY) == (True, True), (
        f"the forty longest: {calls} calls, {chars} characters"
    )


def test_what_is_listed_of_all_tools_is_short(asking: Asking) -> None:
    assert len(to_json_text(json.loads(asking.tools))) < MOST_CHARS_OF_TOOLS


def test_what_a_planner_reads_of_the_writing_tool_is_short_too(world: World) -> None:
    settings = load_settings(("server.write_tools=true",), {"MEMORY_BAG_DIR": str(world.folder)})
    server = build_server(settings, memory_of(world.folder))
    listed = server._listed
    shown: JsonValue = [
        tool.model_dump(mode="json", by_alias=True, exclude_none=True) for tool in listed
    ]
    assert len(to_json_text(shown)) < MOST_CHARS_OF_TOOLS


def leaves(value: JsonValue, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """The paths of all that a reply says."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from leaves(inner, (*path, name))
    elif isinstance(value, list):
        for place, inner in enumerate(value):
            yield from leaves(inner, (*path, place))
    elif value is not None:
        yield path


def falsified(value: JsonValue, path: tuple[str | int, ...]) -> JsonValue:
    """The reply with another value at a path."""
    whole = copy.deepcopy(value)
    here: JsonValue = whole
    for step in path[:-1]:
        here = here[step]  # type: ignore[index]
    old = here[path[-1]]  # type: ignore[index]
    new: JsonValue = f"{old}x" if isinstance(old, str) else not old
    if isinstance(old, int | float) and not isinstance(old, bool):
        new = old + OFF_BY
    here[path[-1]] = new  # type: ignore[index]
    return whole


def is_right(question: Planned, replies: list[JsonValue], asked: CallContext) -> bool:
    try:
        question.judge(replies, asked)
    except (WrongAnswerError, ValueError):
        return False
    return True


@pytest.mark.parametrize("asking", ["plain"], indirect=True)
@pytest.mark.parametrize("words", BY_WORDS)
def test_each_judge_finds_out_a_reply_that_says_something_else(asking: Asking, words: str) -> None:
    replies: list[JsonValue] = [json.loads(text) for text in asking.replies[words]]
    wrong = {
        ".".join(map(str, path))
        for path in leaves(replies[-1])
        if not is_right(
            BY_WORDS[words], [*replies[:-1], falsified(replies[-1], path)], asking.asked
        )
    }
    expected = THAT_COUNT.get(words, set())
    assert wrong or words in OF_NOTHING
    assert expected <= wrong


@pytest.mark.parametrize("asking", ["plain"], indirect=True)
@pytest.mark.parametrize("words", sorted(OF_NOTHING))
def test_that_there_is_nothing_is_wrong_where_there_is_something(
    asking: Asking, words: str
) -> None:
    something: dict[str, JsonValue] = {
        "moments": [{}],
        "events": [{"text": "error: motor: too hot"}],
    }
    [reply] = [json.loads(text) for text in asking.replies[words]]
    made_up: JsonValue = {name: something.get(name, value) for name, value in reply.items()}
    assert made_up != reply
    assert not is_right(BY_WORDS[words], [made_up], asking.asked)

"""A planner that has the list of tools alone, and what it asks about the demo's robot."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest
from mcp import Client
from mcp.types import TextContent

from ros2_memory.bootstrap import build_server, query_settings_of
from ros2_memory.config import load_settings
from ros2_memory.demo.judges import CallContext
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

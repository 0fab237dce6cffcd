"""Whatever a client sends as arguments is answered: with an answer, or with what is wrong."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
from hypothesis import HealthCheck, given, settings

from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.declaration import Signature
from ros2_memory.tools.replies import Replies, Reply
from tests.support.examples import LONG, examples
from tests.support.hostile_arguments import DEEP, NUMBERS, OTHERS, TEXTS, calls, nested
from tests.support.memories import memory_of
from tests.support.robot_run import ANSWERED, write_run

LONGEST_REPLY = 24_000
LONGEST_DETAIL = 2_000
TOOLS: dict[str, Any] = {
    tool.name: tool.schema for tool in build_tools(memory_of(Path("bags")).limits, writing=True)
}
CODES = {"invalid_arguments", "no_data", "timeout", "refused"}


@pytest.fixture(scope="module")
def dispatcher(tmp_path_factory: pytest.TempPathFactory) -> Dispatcher:
    bag_dir = tmp_path_factory.mktemp("hostile")
    write_run(bag_dir)
    memory = memory_of(bag_dir)
    tools = build_tools(memory.limits, writing=True)
    return Dispatcher(memory, tools, Replies(bag_dir, LONGEST_REPLY), call_timeout_s=25)


def asked(dispatcher: Dispatcher, name: str, arguments: dict[str, Any]) -> Reply:
    async def ask() -> Reply:
        return await dispatcher.answer(name, arguments)

    return anyio.run(ask)


def held(reply: Reply) -> Any:
    """The reply as JSON, held to what every reply promises."""
    assert len(reply.text) <= LONGEST_REPLY
    reply.text.encode()
    shown = json.loads(reply.text, parse_constant=pytest.fail)
    if isinstance(shown, dict) and "error" in shown:
        assert shown["error"] in CODES, shown
        assert 0 < len(shown["detail"]) <= LONGEST_DETAIL
    return shown


@settings(
    max_examples=examples(300),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(call=calls(TOOLS))
def test_any_arguments_are_answered_or_told_what_is_wrong(
    dispatcher: Dispatcher, call: tuple[str, dict[str, Any]]
) -> None:
    held(asked(dispatcher, *call))


EVERY = [(name, argument) for name, schema in TOOLS.items() for argument in schema["properties"]]


@pytest.mark.parametrize(("name", "argument"), EVERY)
def test_every_argument_stands_every_hostile_value(
    dispatcher: Dispatcher, name: str, argument: str
) -> None:
    good = next((given for tool, given, _ in ANSWERED if tool == name), {"label": "here"})
    values = (*NUMBERS, *TEXTS, *OTHERS)
    # What one argument does not stand in a short run, others do.
    for value in values if LONG else values[EVERY.index((name, argument)) % 6 :: 6]:
        shown = held(asked(dispatcher, name, {**good, argument: value}))
        if isinstance(shown, dict) and shown.get("error") == "invalid_arguments":
            assert argument in shown["detail"] or "start" in shown["detail"], (value, shown)


@pytest.mark.parametrize(
    "given_",
    [
        lambda: {f"x{n}": n for n in range(1_000_000)},
        lambda: {"topic": [0] * 1_000_000},
        lambda: {"topic": {"a": [[[0] * 4000] * 4]}},
        lambda: {"topic": nested(DEEP)},
    ],
    ids=["names", "numbers", "lists", "levels"],
)
def test_too_many_arguments_are_told_before_any_is_looked_at(
    dispatcher: Dispatcher, given_: Callable[[], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Signature, "parse", lambda *_: pytest.fail("it was looked at"))
    shown = held(asked(dispatcher, "find_last_match", given_()))
    assert shown["error"] == "invalid_arguments"
    assert re.search(r"^(topic|more than) .*(values|levels|arguments)", shown["detail"])

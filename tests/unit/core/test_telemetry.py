"""What observers receive for each call."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest

from ros2_memory import results
from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.model import Sample
from ros2_memory.core.telemetry import UNKNOWN_TOOL, Answered, Observer, Telemetry
from ros2_memory.history.context import Memory
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.tools.declaration import Tool
from ros2_memory.tools.replies import Replies


class Heard(Observer):
    def __init__(self) -> None:
        self.calls: list[Answered] = []

    def answered(self, call: Answered) -> None:
        self.calls.append(call)


class Failing(Observer):
    def answered(self, call: Answered) -> None:
        raise RuntimeError("the observer's own fault")


def good(_memory: Any, call: Any) -> Any:
    with call.stages.timed("read"):
        return results.TopicValue("/a", "a/msg/A", Sample(0, 7))


def empty(_memory: Any, _call: Any) -> Any:
    raise NoDataError(NoDataReason.GAP, "a hole")


def broken(_memory: Any, _call: Any) -> Any:
    raise ZeroDivisionError


def asking(question: Any, _given: Any) -> Any:
    return question


def dispatcher(*observers: Observer) -> Dispatcher:
    schema: dict[str, Any] = {"type": "object", "properties": {}}
    questions: dict[str, Any] = {"good": good, "empty": empty, "broken": broken}
    tools = [
        Tool(
            name,
            name,
            lambda: ("Asks.", schema),
            blocking=False,
            question=partial(asking, question),
        )
        for name, question in questions.items()
    ]
    replies = Replies(Path("bags"), 1000)
    telemetry = Telemetry(observers)
    nobody = cast("Memory", SimpleNamespace(large=LargeReads()))
    return Dispatcher(nobody, tools, replies, call_timeout_s=5, telemetry=telemetry)


@pytest.mark.parametrize(
    ("asked", "tool", "code", "reason"),
    [
        ("good", "good", "ok", ""),
        ("empty", "empty", "no_data", "gap"),
        ("broken", "broken", "internal", ""),
        ("none such", UNKNOWN_TOOL, "invalid_arguments", ""),
        ("x" * 100_000, UNKNOWN_TOOL, "invalid_arguments", ""),
    ],
)
async def test_observers_hear_of_a_call_by_tool_and_outcome(
    asked: str, tool: str, code: str, reason: str
) -> None:
    first, second = Heard(), Heard()
    reply = await dispatcher(first, second).answer(asked, {})
    [call] = first.calls
    assert second.calls == [call]
    assert (call.tool, call.code, call.reason) == (tool, code, reason)
    assert call.chars == len(reply.text)
    assert call.duration_s > 0
    assert set(call.stages_ms) == ({"read"} if asked == "good" else set())


async def test_a_call_that_its_client_left_is_told_as_cancelled() -> None:
    heard = Heard()
    with anyio.CancelScope() as scope:
        scope.cancel()
        await dispatcher(heard).answer("good", {})
    assert [call.outcome for call in heard.calls] == ["cancelled"]


async def test_an_observer_that_fails_costs_no_answer() -> None:
    reply = await dispatcher(Failing()).answer("good", {})
    assert not reply.is_error

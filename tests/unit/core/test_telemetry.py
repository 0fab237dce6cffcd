"""What observers receive for each call."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import anyio

from ros2_memory import results
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.model import Sample
from ros2_memory.core.telemetry import Answered, Observer, Telemetry
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


def dispatcher(*observers: Observer) -> Dispatcher:
    schema: dict[str, Any] = {"type": "object", "properties": {}}
    tools = [Tool("good", "good", lambda: ("Asks.", schema), False, lambda _given: good)]
    replies = Replies(Path("bags"), 1000)
    telemetry = Telemetry(observers)
    nobody = cast("Memory", SimpleNamespace(large=LargeReads()))
    return Dispatcher(nobody, tools, replies, call_timeout_s=5, telemetry=telemetry)


async def test_a_call_that_its_client_left_is_told_as_cancelled() -> None:
    heard = Heard()
    with anyio.CancelScope() as scope:
        scope.cancel()
        await dispatcher(heard).answer("good", {})
    assert [call.outcome for call in heard.calls] == ["cancelled"]


async def test_an_observer_that_fails_costs_no_answer() -> None:
    reply = await dispatcher(Failing()).answer("good", {})
    assert not reply.is_error

"""Calls are dispatched: each has its turn, its time, its reply and its log event."""

import asyncio
import itertools
import json
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import anyio
import pytest
import structlog
from mcp import Client
from mcp.types import CallToolResult, TextContent
from structlog.testing import LogCapture

from ros2_memory import results
from ros2_memory.columns.units import GoneError
from ros2_memory.core.errors import (
    EpisodicError,
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
)
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.model import Sample
from ros2_memory.core.reply import JsonObject
from ros2_memory.history.context import Call, Memory
from ros2_memory.results import Answer
from ros2_memory.serving.dispatch import BLOCKING_AT_ONCE, QUICK_AT_ONCE, Dispatcher
from ros2_memory.serving.fair_queue import MOST_WAITING, FairQueue
from ros2_memory.serving.mcp_server import EpisodicServer
from ros2_memory.tools.declaration import Described, Tool
from ros2_memory.tools.replies import Replies, Reply

NOBODY = cast("Memory", SimpleNamespace(large=LargeReads()))
"""The tools of these tests ask nothing of a memory."""


def tool(name: str, ask: Callable[[Call], Answer], *, blocking: bool = False) -> Tool:
    def question(given: Mapping[str, object]) -> Callable[[Memory, Call], Answer]:
        if "bad" in given:
            raise InvalidArgumentsError("bad was given")
        return lambda _memory, call: ask(call)

    described = Described(f"What {name} does.", {}, ())
    return Tool(name, name.title(), lambda: described, blocking, question)


def value(shown: Any) -> results.TopicValue:
    return results.TopicValue("/a", "a/msg/A", Sample(0, shown))


def served(
    *tools: Tool,
    timeout_s: float = 25.0,
    **options: Any,
) -> EpisodicServer:
    replies = Replies(Path("bags"), 24_000)
    dispatcher = Dispatcher(NOBODY, tools, replies, call_timeout_s=timeout_s, **options)
    about = {"name": "episodic", "version": "1.2.3", "instructions": "Ask away."}
    return EpisodicServer(dispatcher, **about, progress=None)


def sent(result: CallToolResult) -> Any:
    """The reply, held to be one text block and nothing else."""
    [block] = result.content
    assert isinstance(block, TextContent)
    assert result.structured_content is None
    return json.loads(block.text)


def raising(error: BaseException) -> Callable[[Call], Answer]:
    def ask(_call: Call) -> Answer:
        raise error

    return ask


def until_given_up(call: Call) -> Answer:
    """A query as the rooms below write it: it looks at its deadline between two bags."""
    while not call.deadline.expired():
        threading.Event().wait(0.001)
    raise QueryTimeoutError(f"the question needs more than {call.deadline.budget_s:g} s")


@pytest.fixture
def log() -> Iterator[LogCapture]:
    capture = LogCapture()
    structlog.configure(processors=[structlog.contextvars.merge_contextvars, capture])
    yield capture
    structlog.reset_defaults()


@pytest.mark.parametrize("error", [KeyError("secret"), RecursionError(), MemoryError()])
async def test_a_fault_is_logged_and_told_without_its_inside(
    error: Exception, log: LogCapture
) -> None:
    async with Client(served(tool("ask", raising(error)))) as client:
        result = await client.call_tool("ask", {})
        again = await client.call_tool("ask", {"bad": 1})
    assert result.is_error
    assert sent(result)["error"] == "internal"
    assert "secret" not in sent(result)["detail"]
    assert sent(again)["error"] == "invalid_arguments"
    failed, called, _ = log.entries
    assert failed["event"] == "tool_failed"
    assert failed["exc_info"] is True
    assert failed["correlation_id"] == called["correlation_id"]
    assert failed["correlation_id"] in sent(result)["detail"]


@pytest.mark.parametrize(("losses", "answer"), [(1, "value"), (2, "error")])
async def test_a_question_whose_columns_were_deleted_meanwhile_is_asked_again(
    losses: int, answer: str
) -> None:
    asked = itertools.count()

    def ask(_call: Call) -> Answer:
        if next(asked) < losses:
            raise GoneError
        return value(1)

    async with Client(served(tool("ask", ask))) as client:
        reply = sent(await client.call_tool("ask", {}))
    assert answer in reply
    assert reply.get("error") in {None, "busy"}


async def test_the_page_looks_again_where_columns_were_deleted_meanwhile() -> None:
    looks = itertools.count()

    def look(_call: Call) -> JsonObject:
        if next(looks) == 0:
            raise GoneError
        return {"value": 1}

    dispatcher = Dispatcher(NOBODY, [], Replies(Path("bags"), 24_000), call_timeout_s=5)
    assert json.loads((await dispatcher.look(look)).text) == {"value": 1}
    dispatcher.stop()


@pytest.mark.parametrize(
    ("reported_s", "waited"), [(60.0, ""), (0.0, r"it waited \d\.\d s of its")]
)
@pytest.mark.parametrize(
    ("looks_at_its_deadline", "timeout_s", "why"),
    [
        (True, 0.5, "the question needs more than 0.45 s"),
        (False, 0.05, "late needs more than 0.05"),
    ],
)
async def test_a_query_that_takes_too_long_gives_up_or_is_left_behind_and_says_that_it_waited(
    monkeypatch: pytest.MonkeyPatch,
    looks_at_its_deadline: bool,
    timeout_s: float,
    why: str,
    reported_s: float,
    waited: str,
) -> None:
    monkeypatch.setattr("ros2_memory.serving.dispatch._REPORTED_WAIT_S", reported_s)
    held = Held()
    ask = until_given_up if looks_at_its_deadline else held.ask
    async with Client(served(tool("late", ask), timeout_s=timeout_s)) as client:
        result = await client.call_tool("late", {})
        held.released.set()
    told = sent(result)
    assert (result.is_error, told["error"]) == (True, "timeout")
    assert told["detail"].startswith(why)
    assert re.search(waited, told["detail"])
    assert ("waited" in told["detail"]) == bool(waited)


async def test_a_quick_question_waits_for_no_blocking_one_and_the_list_of_tools_for_none() -> None:
    held = Held()
    slow, quick = tool("slow", held.ask, blocking=True), tool("quick", lambda _call: value(2))
    async with (
        Client(served(slow, quick, tool("stuck", held.ask))) as client,
        anyio.create_task_group() as tasks,
    ):
        for _ in range(BLOCKING_AT_ONCE + QUICK_AT_ONCE):
            tasks.start_soon(client.call_tool, "slow", {})
        await anyio.wait_all_tasks_blocked()
        assert sent(await client.call_tool("quick", {}))["value"] == 2
        for _ in range(2 * QUICK_AT_ONCE):
            tasks.start_soon(client.call_tool, "stuck", {})
        await anyio.wait_all_tasks_blocked()
        assert len((await client.list_tools()).tools) == 3
        held.released.set()


BOUND_S = 20


class Held:
    """A slow question that lasts until the test lets it end; it counts how often it was begun."""

    def __init__(self) -> None:
        self.released = threading.Event()
        self.begun = 0

    def wait(self) -> int:
        self.begun += 1
        number = self.begun
        assert self.released.wait(BOUND_S)
        return number

    def ask(self, _call: Call) -> Answer:
        return value(self.wait())


async def test_one_client_that_floods_the_server_does_not_starve_another() -> None:
    may_end = threading.Semaphore(0)

    def long(_call: Call) -> Answer:
        assert may_end.acquire(timeout=20)
        return value("long")

    slow = tool("slow", long, blocking=True)
    search = tool("search", lambda _call: value("found"), blocking=True)
    dispatcher = served(slow, search).dispatcher
    async with anyio.create_task_group() as tasks:
        for _ in range(64):
            tasks.start_soon(dispatcher.answer, "slow", {}, "flood")
        await anyio.wait_all_tasks_blocked()
        assert dispatcher.blocking.waiting == 64 - BLOCKING_AT_ONCE
        may_end.release()  # one of them; whatever else is begun of the flood lasts
        reply = await dispatcher.answer("search", {}, "other")
        assert json.loads(reply.text)["value"] == "found"
        may_end.release(63)


async def test_a_call_that_waits_for_all_of_its_time_is_told_that_the_server_is_busy(
    log: LogCapture,
) -> None:
    held = Held()
    dispatcher = served(tool("slow", held.ask, blocking=True), timeout_s=0.05).dispatcher
    replies: list[str] = []

    async def call() -> None:
        replies.append((await dispatcher.answer("slow", {})).text)

    async with anyio.create_task_group() as tasks:
        for _ in range(BLOCKING_AT_ONCE + 2):
            tasks.start_soon(call)
    held.released.set()
    sent = [json.loads(text) for text in replies]
    assert sorted(each["error"] for each in sent) == ["busy", "busy", "timeout", "timeout"]
    [detail] = {each["detail"] for each in sent if each["error"] == "busy"}
    assert detail == (
        "slow waited 0.05 s behind other calls and was not started; ask again, with fewer at once"
    )
    assert held.begun == BLOCKING_AT_ONCE
    assert dispatcher.blocking.waiting == 0


@patch("ros2_memory.serving.fair_queue._HANGING_WAIT_S", 0.05)
async def test_a_question_behind_a_hanging_disk_is_told_so_soon_and_answered_when_it_is_back() -> (
    None
):
    held = Held()
    dispatcher = served(tool("read", held.ask), timeout_s=0.2).dispatcher
    async with anyio.create_task_group() as tasks:
        for _ in range(2 * QUICK_AT_ONCE):
            tasks.start_soon(dispatcher.answer, "read", {})
    refused = json.loads((await dispatcher.answer("read", {})).text)
    assert (refused["error"], "as when a disk hangs" in refused["detail"]) == ("busy", True)
    held.released.set()
    await until(lambda: dispatcher.quick.running == 0)
    assert json.loads((await dispatcher.answer("read", {})).text)["value"] == QUICK_AT_ONCE + 1


async def test_more_calls_than_may_wait_are_told_so() -> None:
    held = Held()
    dispatcher = served(tool("slow", held.ask, blocking=True)).dispatcher
    sent: list[Any] = []

    async def call() -> None:
        sent.append(json.loads((await dispatcher.answer("slow", {}, "flood")).text))

    async with anyio.create_task_group() as tasks:
        for _ in range(MOST_WAITING + BLOCKING_AT_ONCE + 5):
            tasks.start_soon(call)
        await anyio.wait_all_tasks_blocked()
        assert [each["error"] for each in sent] == ["busy"] * 5
        held.released.set()
    assert len(sent) == MOST_WAITING + BLOCKING_AT_ONCE + 5


async def test_stopping_has_running_queries_give_up() -> None:
    started = threading.Event()

    def ask(call: Call) -> Answer:
        started.set()
        return until_given_up(call)

    server = served(tool("slow", ask))
    results: list[CallToolResult] = []

    async def call(client: Client) -> None:
        results.append(await client.call_tool("slow", {}))

    async with Client(server) as client, anyio.create_task_group() as tasks:
        tasks.start_soon(call, client)
        await anyio.to_thread.run_sync(started.wait)
        server.dispatcher.stop()
    told = sent(results[0])
    assert (told["error"], "the server is stopping" in told["detail"]) == ("busy", True)


async def test_arguments_are_left_out_of_the_log_where_they_are_not_wanted(log: LogCapture) -> None:
    silent = served(tool("ask", lambda _: value(1)), log_arguments=False).dispatcher
    await silent.answer("ask", {"s3cret": "s3cret"})
    await silent.answer("s3cret", {"s3cret": "s3cret"})
    assert [(each["event"], each["tool"]) for each in log.entries] == [
        ("tool_call", "ask"),
        ("tool_call", "unknown"),
    ]
    assert "s3cret" not in str(log.entries)


async def until(what: Callable[[], bool]) -> None:
    """Lets everything else go on until it is so."""
    async with asyncio.timeout(BOUND_S):
        while not what():
            await asyncio.sleep(0.001)


@pytest.mark.parametrize("has_turn", [True, False])
async def test_a_turn_that_comes_as_its_caller_leaves_goes_to_the_next(has_turn: bool) -> None:
    queue, held = FairQueue("test", 1), Held()
    first, leaving, last = (asyncio.create_task(queue.run("a", held.wait)) for _ in range(3))
    await until(lambda: queue.waiting == 2 and held.begun == 1)
    held.released.set()
    queue._threads.submit(int).result(BOUND_S)  # so the first is done, which the loop learns next
    if has_turn:
        asyncio.get_running_loop().call_soon(leaving.cancel)
    else:
        leaving.cancel()
    assert [await first, await last] == [1, 2]
    assert leaving.cancelled()
    await until(lambda: (queue.running, queue.waiting) == (0, 0))


async def test_a_thread_that_is_left_behind_keeps_its_place_until_it_is_done() -> None:
    queue, held = FairQueue("test", 1), Held()
    stuck, following = (asyncio.create_task(queue.run("a", held.wait)) for _ in range(2))
    await until(lambda: held.begun == 1)
    stuck.cancel()
    await until(stuck.done)
    assert (queue.running, queue.waiting) == (1, 1)
    held.released.set()
    assert await following == 2
    await until(lambda: queue.running == 0)


class BrokenReplies(Replies):
    def error(self, error: EpisodicError) -> Reply:
        raise KeyError("secret")


@pytest.mark.parametrize("given", [{}, {"bad": 1}])
async def test_a_fault_in_telling_an_error_is_told_as_any_other(
    given: dict[str, Any], log: LogCapture
) -> None:
    tools = [tool("none", raising(NoDataError(NoDataReason.GAP, "a hole")))]
    replies = BrokenReplies(Path("bags"), 24_000)
    reply = await Dispatcher(NOBODY, tools, replies, call_timeout_s=25).answer("none", given)
    assert reply.is_error
    assert json.loads(reply.text)["error"] == "internal"
    assert "secret" not in reply.text
    assert [entry["event"] for entry in log.entries] == ["tool_failed", "tool_call"]

"""Clients that leave in mid-call: the query that nobody waits for ends, and its place is free."""

import asyncio
import json
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.history.context import Call
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.serving.web_app import web_app
from tests.soak.clients import modern, opening
from tests.soak.wire import call, connected, head, posted
from tests.support.processes import BOUND_S, listening
from tests.unit.serving.test_dispatch import served, tool


class Endless:
    """A query that looks at its deadline, as all do, and otherwise never ends."""

    def __init__(self) -> None:
        self.begun = threading.Event()
        self.ended = threading.Event()

    def ask(self, call: Call) -> Any:
        self.begun.set()
        while not call.deadline.expired():
            threading.Event().wait(0.001)
        self.ended.set()
        raise QueryTimeoutError("too long")


@asynccontextmanager
async def serving(query: Endless) -> AsyncIterator[tuple[int, Dispatcher]]:
    server = served(tool("endless", query.ask, blocking=True), timeout_s=3600)

    async def health() -> Any:
        return {"status": "ok"}

    app = web_app(server, host="127.0.0.1", health=health, background=anyio.sleep_forever)
    async with listening(app, lifespan="on") as running:
        yield running.servers[0].sockets[0].getsockname()[1], server.dispatcher


async def set_in_time(event: threading.Event) -> None:
    assert await asyncio.to_thread(event.wait, BOUND_S)


async def none_left(dispatcher: Dispatcher) -> None:
    async with asyncio.timeout(BOUND_S):
        while dispatcher.blocking.running or dispatcher.blocking.waiting:
            await asyncio.sleep(0.001)


async def began(stream: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
    """Begins an event stream; returns the path to post its messages to."""
    writer.write(head("GET", "/sse"))
    async with asyncio.timeout(BOUND_S):
        await stream.readuntil(b"session_id=")
        session = (await stream.readuntil(b"\r\n")).strip().decode()
    return f"/messages/?session_id={session}"


@pytest.mark.parametrize("is_modern", [False, True])
async def test_leaving_a_request_ends_its_query(is_modern: bool) -> None:
    query = Endless()
    body, more = call("endless", "{}"), ""
    if is_modern:
        body, more = modern(body)
    async with serving(query) as (port, dispatcher):
        async with connected(port) as (_, writer):
            writer.write(head("POST", "/mcp", len(body), more) + body)
            await set_in_time(query.begun)
            assert not query.ended.is_set()
        await set_in_time(query.ended)
        await none_left(dispatcher)


async def test_a_client_that_cancels_a_call_ends_its_query_and_stays() -> None:
    query = Endless()
    async with serving(query) as (port, dispatcher), connected(port) as (stream, writer):
        to = await began(stream, writer)
        cancelled = {
            "jsonrpc": "2.0",
            "method": "notifications/cancelled",
            "params": {"requestId": 7, "reason": "the person asked something else"},
        }
        for body in (*opening(), call("endless", "{}", 7)):
            assert (await posted(port, body, to))[0] == 202
        await set_in_time(query.begun)
        assert not query.ended.is_set()
        assert (await posted(port, json.dumps(cancelled).encode(), to))[0] == 202
        await set_in_time(query.ended)
        await none_left(dispatcher)


async def test_leaving_an_event_stream_ends_its_queries_and_those_that_wait() -> None:
    query = Endless()
    async with serving(query) as (port, dispatcher):
        async with connected(port) as (stream, writer):
            to = await began(stream, writer)
            calls = [call("endless", "{}", number) for number in range(1, 11)]
            for body in (*opening(), *calls):
                assert (await posted(port, body, to))[0] == 202
            await set_in_time(query.begun)
            async with asyncio.timeout(BOUND_S):
                while dispatcher.blocking.running + dispatcher.blocking.waiting < len(calls):
                    await asyncio.sleep(0.001)
            assert not query.ended.is_set()
        await set_in_time(query.ended)
        await none_left(dispatcher)

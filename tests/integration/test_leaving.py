"""Clients that leave in mid-call: the query that nobody waits for ends, and its place is free."""

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Hashable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import pytest
from mcp import Client
from mcp.client.sse import sse_client

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.history.context import Call, Memory
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.serving.mcp_server import EpisodicServer
from ros2_memory.serving.web_app import web_app
from ros2_memory.tools.replies import Replies, Reply
from tests.soak.clients import modern, opening
from tests.soak.wire import call, connected, head, posted
from tests.support.processes import PATIENCE_S, listening
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
async def serving(server: EpisodicServer) -> AsyncIterator[int]:
    """The port of a server."""

    async def health() -> Any:
        return {"status": "ok"}

    app = web_app(server, host="127.0.0.1", health=health)
    async with listening(app, lifespan="on") as running:
        yield running.servers[0].sockets[0].getsockname()[1]


@asynccontextmanager
async def asked_for(query: Endless) -> AsyncIterator[tuple[int, Dispatcher]]:
    server = served(tool("endless", query.ask, blocking=True), timeout_s=3600)
    async with serving(server) as port:
        yield port, server.dispatcher


async def set_in_time(event: threading.Event) -> None:
    assert await asyncio.to_thread(event.wait, PATIENCE_S)


async def none_left(dispatcher: Dispatcher) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while dispatcher.blocking.running or dispatcher.blocking.waiting:
            await asyncio.sleep(0.001)


async def began(stream: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
    """Begins an event stream; returns the path to post its messages to."""
    writer.write(head("GET", "/sse"))
    async with asyncio.timeout(PATIENCE_S):
        await stream.readuntil(b"session_id=")
        session = (await stream.readuntil(b"\r\n")).strip().decode()
    return f"/messages/?session_id={session}"


@pytest.mark.parametrize("is_modern", [False, True])
async def test_leaving_a_request_ends_its_query(is_modern: bool) -> None:
    query = Endless()
    body, more = call("endless", "{}"), ""
    if is_modern:
        body, more = modern(body)
    async with asked_for(query) as (port, dispatcher):
        async with connected(port) as (_, writer):
            writer.write(head("POST", "/mcp", len(body), more) + body)
            await set_in_time(query.begun)
            assert not query.ended.is_set()
        await set_in_time(query.ended)
        await none_left(dispatcher)


async def test_a_client_that_cancels_a_call_ends_its_query_and_stays() -> None:
    query = Endless()
    async with asked_for(query) as (port, dispatcher), connected(port) as (stream, writer):
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
    async with asked_for(query) as (port, dispatcher):
        async with connected(port) as (stream, writer):
            to = await began(stream, writer)
            calls = [call("endless", "{}", number) for number in range(1, 11)]
            for body in (*opening(), *calls):
                assert (await posted(port, body, to))[0] == 202
            await set_in_time(query.begun)
            async with asyncio.timeout(PATIENCE_S):
                while dispatcher.blocking.running + dispatcher.blocking.waiting < len(calls):
                    await asyncio.sleep(0.001)
            assert not query.ended.is_set()
        await set_in_time(query.ended)
        await none_left(dispatcher)


class Listening(Dispatcher):
    """Notes who asked."""

    def __init__(self) -> None:
        super().__init__(cast("Memory", None), [], Replies(Path("bags"), 1000), call_timeout_s=5)
        self.asked: list[Hashable] = []

    async def answer(
        self,
        name: str,
        given: Mapping[str, object],
        client: Hashable = None,
        **_: Any,
    ) -> Reply:
        self.asked.append(client)
        return Reply("{}")


def listened_to() -> tuple[EpisodicServer, Listening]:
    dispatcher = Listening()
    return EpisodicServer(dispatcher, name="x", version="1", instructions=""), dispatcher


async def test_each_event_stream_is_a_client_of_its_own() -> None:
    server, dispatcher = listened_to()
    async with serving(server) as port:
        url = f"http://127.0.0.1:{port}/sse"
        async with (
            Client(sse_client(url, timeout=PATIENCE_S)) as one,
            Client(sse_client(url, timeout=PATIENCE_S)) as two,
        ):
            for client in (one, two, one):
                await client.call_tool("any", {})
    first, second, third = dispatcher.asked
    assert first == third
    assert first != second


async def test_a_client_that_is_in_memory_or_on_stdio_is_the_only_one() -> None:
    server, dispatcher = listened_to()
    async with Client(server) as client:
        await client.call_tool("any", {})
    assert dispatcher.asked == [None]


@pytest.mark.parametrize("header", ["mcp-session-id", "user-agent"])
async def test_requests_are_told_apart_by_session_and_program_not_by_connection(
    header: str,
) -> None:
    server, dispatcher = listened_to()
    async with serving(server) as port:
        for name in ("one", "two", "one"):
            await posted(port, call("any", "{}"), more=f"{header}: {name}\r\n")
    first, second, third = dispatcher.asked
    assert first == third
    assert first != second


async def test_a_session_in_the_address_of_a_request_makes_no_other_client_of_it() -> None:
    server, dispatcher = listened_to()
    async with serving(server) as port:
        paths = [f"/mcp?session_id={number}" for number in range(3)]
        await asyncio.gather(*(posted(port, call("any", "{}"), path) for path in paths))
    assert len(set(dispatcher.asked)) == 1

"""Whom the server takes for one client, over each way to ask: those are whom it gives turns to."""

import asyncio
from collections.abc import AsyncIterator, Hashable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import anyio
import pytest
from mcp import Client
from mcp.client.sse import sse_client

from ros2_memory.history.context import Memory
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.serving.mcp_server import EpisodicServer
from ros2_memory.serving.web_app import web_app
from ros2_memory.tools.replies import Replies, Reply
from tests.soak.wire import call, posted
from tests.support.processes import PATIENCE_S, listening


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
        *,
        for_resource: bool = False,
        for_page: bool = False,
        robots: frozenset[str] | None = None,
        part: object = None,
    ) -> Reply:
        self.asked.append(client)
        return Reply("{}")


@asynccontextmanager
async def serving() -> AsyncIterator[tuple[str, int, Listening]]:
    dispatcher = Listening()
    server = EpisodicServer(dispatcher, name="x", version="1", instructions="")

    async def health() -> Any:
        return {"status": "ok"}

    app = web_app(server, host="127.0.0.1", health=health, background=anyio.sleep_forever)
    async with listening(app, lifespan="on") as running:
        port = running.servers[0].sockets[0].getsockname()[1]
        yield f"http://127.0.0.1:{port}", port, dispatcher


async def test_each_event_stream_is_a_client_of_its_own() -> None:
    async with (
        serving() as (url, _, dispatcher),
        Client(sse_client(f"{url}/sse", timeout=PATIENCE_S)) as one,
        Client(sse_client(f"{url}/sse", timeout=PATIENCE_S)) as two,
    ):
        for client in (one, two, one):
            await client.call_tool("any", {})
    first, second, third = dispatcher.asked
    assert first == third
    assert first != second


async def test_a_client_that_is_in_memory_or_on_stdio_is_the_only_one() -> None:
    dispatcher = Listening()
    server = EpisodicServer(dispatcher, name="x", version="1", instructions="")
    async with Client(server) as client:
        await client.call_tool("any", {})
    assert dispatcher.asked == [None]


@pytest.mark.parametrize("header", ["mcp-session-id", "user-agent"])
async def test_requests_are_told_apart_by_session_and_program_not_by_connection(
    header: str,
) -> None:
    async with serving() as (_, port, dispatcher):
        for name in ("one", "two", "one"):
            await posted(port, call("any", "{}"), more=f"{header}: {name}\r\n")
    first, second, third = dispatcher.asked
    assert first == third
    assert first != second


async def test_a_session_in_the_address_of_a_request_makes_no_other_client_of_it() -> None:
    async with serving() as (_, port, dispatcher):
        paths = [f"/mcp?session_id={number}" for number in range(3)]
        await asyncio.gather(*(posted(port, call("any", "{}"), path) for path in paths))
    assert len(set(dispatcher.asked)) == 1

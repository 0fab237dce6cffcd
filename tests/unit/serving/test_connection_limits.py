"""Clients that keep the server waiting, on real sockets; and how much of a request is read."""

import asyncio
import socket
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from typing import Any
from unittest.mock import Mock, patch

import anyio
import anyio.lowlevel
import pytest
import uvicorn
from starlette.responses import PlainTextResponse
from structlog.testing import capture_logs

from ros2_memory.core.logging_setup import LogThrottle
from ros2_memory.serving import connection_limits
from ros2_memory.serving.auth import Access, admit
from ros2_memory.serving.connection_limits import MAX_BODY_BYTES, RequestLimits
from ros2_memory.serving.dispatch import MAX_DEPTH, excess_in_arguments
from tests.support.processes import PATIENCE_S, listening
from tests.unit.serving.test_web_app import (
    MCP_HEADERS,
    app,
    client,
    running,
)

GET = b"GET / HTTP/1.1\r\nhost: a\r\n\r\n"
HALF = b"GET / HTTP/1.1\r\nhost: a\r\nx: "
POST = b"POST / HTTP/1.1\r\nhost: a\r\ncontent-length: 10\r\n\r\n"


class App:
    """Reads bodies and answers; `/flood` never stops sending, `/early` answers before it reads."""

    def __init__(self) -> None:
        self.under_way = 0
        self.left = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.under_way += 1
        try:
            await self._answer(scope, receive, send)
        finally:
            self.under_way -= 1

    async def _answer(self, scope: Any, receive: Any, send: Any) -> None:
        admit(scope, Access())
        more = scope["method"] == "POST" and scope["path"] != "/early"
        while more:
            message = await receive()
            if message["type"] == "http.disconnect":
                self.left += 1
                return
            more = message["more_body"]
        length = [] if scope["path"] == "/flood" else [(b"content-length", b"2")]
        await send({"type": "http.response.start", "status": 200, "headers": length})
        while scope["path"] == "/flood" and self.under_way:
            await send({"type": "http.response.body", "body": b"x" * 65536, "more_body": True})
            await asyncio.sleep(0)  # sending to a client that is gone waits for nothing
        await send({"type": "http.response.body", "body": b"ok"})


class Served:
    def __init__(self, server: uvicorn.Server, app: App, port: int) -> None:
        self.server = server
        self.app = app
        self.port = port

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.port)

    async def reply(self, *sent: bytes) -> bytes:
        """Everything until the server ends the connection."""
        reader, writer = await self.connect()
        for part in sent:
            writer.write(part)
            await writer.drain()
        async with asyncio.timeout(PATIENCE_S):
            shown = await reader.read()
        writer.close()
        return shown

    async def gone(self) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while self.server.server_state.connections:
                await asyncio.sleep(0.001)


async def answered(reader: asyncio.StreamReader) -> None:
    """Reads a whole reply of the application."""
    async with asyncio.timeout(PATIENCE_S):
        assert b" 200 " in await reader.readuntil(b"ok")


@asynccontextmanager
async def serving() -> AsyncIterator[Served]:
    app = App()
    async with listening(app) as server:
        yield Served(server, app, server.servers[0].sockets[0].getsockname()[1])


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HEAD_S", "BODY_S", "UNREAD_S"):
        monkeypatch.setattr(connection_limits, name, 0.1)


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize(
    "sent",
    [
        [],
        [b"G"],
        [HALF],
        [HALF, b"y"],
        [POST],
        [POST, b"12345"],
        [b"POST / HTTP/1.1\r\nhost: a\r\ntransfer-encoding: chunked\r\n\r\n", b"5\r\nab"],
    ],
)
async def test_headers_and_bodies_that_do_not_come_to_their_end_are_answered_with_timeout(
    sent: list[bytes],
) -> None:
    async with serving() as served:
        shown = await served.reply(*sent)
        assert shown.startswith(b"HTTP/1.1 408 Request Timeout\r\n")
        assert shown.endswith(b"did not come to its end in time.\n")
        await served.gone()
        is_body = bool(sent) and sent[0].startswith(b"POST")
        assert (served.app.under_way, served.app.left) == (0, is_body)


@pytest.mark.usefixtures("hurried")
async def test_what_is_left_of_a_body_that_was_answered_early_is_not_waited_for() -> None:
    async with serving() as served:
        shown = await served.reply(b"POST /early HTTP/1.1\r\ncontent-length: 99\r\nhost: a\r\n\r\n")
        assert shown.count(b"HTTP/1.1 ") == 1
        assert shown.startswith(b"HTTP/1.1 200")
        await served.gone()


@pytest.mark.usefixtures("hurried")
async def test_a_reply_that_is_not_read_ends_the_connection_and_the_call() -> None:
    async with serving() as served:
        # Not asyncio's: that one reads by itself.
        with socket.create_connection(("127.0.0.1", served.port)) as client:
            client.sendall(b"GET /flood HTTP/1.1\r\nhost: a\r\n\r\n")
            async with asyncio.timeout(PATIENCE_S):
                while not served.app.under_way:
                    await asyncio.sleep(0.001)
                await served.gone()
                served.app.under_way = 0


@patch.object(connection_limits, "MAX_CONNECTIONS", 3)
async def test_a_connection_too_many_is_told_so_and_the_others_are_served() -> None:
    async with serving() as served:
        open_ones = [await served.connect() for _ in range(3)]
        for reader, writer in open_ones:
            writer.write(GET)
            await answered(reader)
        shown = await served.reply()
        assert shown.startswith(b"HTTP/1.1 503 Service Unavailable\r\n")
        assert shown.endswith(b"Too many connections; close some.\n")
        for reader, writer in open_ones:
            writer.write(GET)
            await answered(reader)
            writer.close()
        await served.gone()
        assert b" 200 " in await served.reply(
            GET.replace(b"\r\n\r\n", b"\r\nconnection: close\r\n\r\n")
        )


@pytest.mark.parametrize(
    "head",
    [
        b"GET / HTTP/1.1\r\nhost: a\r\nx: " + b"y" * 70_000,
        b"GET /" + b"y" * 70_000,
        b"GET / HTTP/1.1\r\n" + b"x: y\r\n" * 20_000,
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"\x00" * 70_000,
    ],
    ids=["header", "path", "headers", "tls", "zeros"],
)
async def test_headers_without_end_and_what_is_no_http_are_refused(head: bytes) -> None:
    async with serving() as served:
        shown = await served.reply(head)
        assert shown == b"" or shown.startswith(b"HTTP/1.1 4")  # may be cut by what was left unread
        await served.gone()


@patch.object(connection_limits, "MAX_UNKNOWN", 3)
async def test_the_oldest_stranger_makes_room_and_whoever_was_admitted_stays() -> None:
    async with serving() as served:
        known, to_known = await served.connect()
        to_known.write(GET)
        await answered(known)
        with ExitStack() as stack:
            strangers = []
            for _ in range(6):
                place = ("127.0.0.1", served.port)
                strangers.append(stack.enter_context(socket.create_connection(place, PATIENCE_S)))
                strangers[-1].sendall(b"G")
                async with asyncio.timeout(PATIENCE_S):
                    while len(served.server.server_state.connections) < min(len(strangers), 3) + 1:
                        await asyncio.sleep(0.001)
            for each in strangers[:3]:
                with suppress(ConnectionResetError):
                    assert await asyncio.to_thread(each.recv, 1) == b""
            for each in strangers[3:]:
                each.sendall(GET[1:])
                assert b" 200 " in await asyncio.to_thread(each.recv, 1000)
        to_known.write(GET)
        await answered(known)
        to_known.close()


@patch.object(connection_limits, "MAX_UNKNOWN", 8)
async def test_a_flood_of_one_address_does_not_drop_who_speaks_late_from_another() -> None:
    async with serving() as served:
        reader, writer = await served.connect()
        with ExitStack() as stack:
            for _ in range(40):
                each = stack.enter_context(socket.socket())
                each.bind(("127.0.0.2", 0))
                each.connect(("127.0.0.1", served.port))
                await asyncio.sleep(0.01)  # it is accepted meanwhile
            writer.write(GET)
            await answered(reader)
        writer.close()


@pytest.mark.parametrize("most_known", [3, 0])
async def test_refused_connections_that_linger_take_no_place_of_admitted_ones(
    monkeypatch: pytest.MonkeyPatch, most_known: int
) -> None:
    for name, most in (("MAX_UNKNOWN", 4), ("MAX_CONNECTIONS", most_known), ("LINGER_S", 3600.0)):
        monkeypatch.setattr(connection_limits, name, most)
    async with serving() as served:
        with ExitStack() as stack:
            for _ in range(20):
                refused = stack.enter_context(socket.socket())
                refused.bind(("127.0.0.2", 0))
                refused.connect(("127.0.0.1", served.port))
                refused.sendall(b"\x16\x03\x01\r\n\r\n")
                with suppress(ConnectionResetError):
                    assert b"HTTP/1.1 " in await asyncio.to_thread(refused.recv, 1000)
            assert len(served.server.server_state.connections) <= 4
            if most_known:
                reader, writer = await served.connect()
                writer.write(GET)
                await answered(reader)
                writer.close()


CHUNKED = b"POST %b HTTP/1.1\r\nhost: a\r\ntransfer-encoding: chunked\r\n\r\n"


@pytest.mark.parametrize("path", [b"/", b"/early"])
async def test_a_body_in_tiny_chunks_ends_the_connection_soon(path: bytes) -> None:
    async with serving() as served:
        with suppress(ConnectionError):  # an early answer is not followed by another
            shown = await served.reply(CHUNKED % path, b"1\r\nx\r\n" * 5000)
            assert path == b"/early" or b" 400 " in shown
        await served.gone()


@pytest.mark.parametrize("size", [1, 64])
async def test_a_body_in_chunks_that_are_few_or_large_enough_is_taken(size: int) -> None:
    chunks = 250 if size == 1 else 4000
    async with serving() as served:
        body = (b"%x\r\n" % size + b"x" * size + b"\r\n") * chunks + b"0\r\n\r\n"
        reader, writer = await served.connect()
        for _ in range(2):
            writer.write(CHUNKED % b"/" + body)
            await answered(reader)
        writer.close()


@pytest.mark.usefixtures("hurried")
async def test_peers_that_are_gone_fill_no_log(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_limits.BoundedConnection, "_refusals", LogThrottle(lambda: 0.0))
    garbage = (b"", b"P", HALF, b"\x16\x03\x01", POST, GET + b"\x00" * 99, b"GET / HTTP/9\r\n\r\n")
    chunked = b"POST /early HTTP/1.1\r\nhost: a\r\ntransfer-encoding: chunked\r\n\r\nzz\r\n"
    with capture_logs() as logged:
        async with serving() as served:
            for sent in (*garbage, chunked) * 2:
                with socket.create_connection(("127.0.0.1", served.port)) as client:
                    # Closing then resets, so nothing can be sent any more.
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    client.sendall(sent)
                    await asyncio.sleep(0)
            await served.gone()
            for sent in (*garbage, chunked) * 2:
                await served.reply(sent)
            await served.gone()
    assert {each["event"] for each in logged} == {"connection_refused"}
    assert len(logged) == len({each["reason"] for each in logged})
    tracebacks = [each for each in caplog.records if each.exc_info]
    assert tracebacks == []


async def test_the_system_keeps_little_and_gives_up_a_peer_that_vanished() -> None:
    async with serving() as served:
        _, writer = await served.connect()
        async with asyncio.timeout(PATIENCE_S):
            while not served.server.server_state.connections:
                await asyncio.sleep(0.001)
        [connection] = served.server.server_state.connections
        connected = connection.transport.get_extra_info("socket")
        waits = connected.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
        assert waits == connection_limits.UNREAD_S * 1000
        # Linux doubles what it is told, for its own bookkeeping.
        kept = connected.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
        assert kept <= 2 * connection_limits.SEND_BUFFER_BYTES
        writer.close()


@pytest.mark.parametrize("error", [None, anyio.BrokenResourceError, anyio.ClosedResourceError])
async def test_what_an_application_does_after_its_answer_is_not_cut_off_and_may_fail(
    error: type[Exception] | None,
) -> None:
    """A message is accepted first and handed over then; its session may end in between."""
    done: list[str] = []

    async def accepting(scope: Any, receive: Any, send: Any) -> None:
        await PlainTextResponse("Accepted", 202)(scope, receive, send)
        for _ in range(10):
            await anyio.lowlevel.checkpoint()
        done.append("handed over")
        if error is not None:
            raise error

    async with client(RequestLimits(accepting)) as http:
        assert (await http.post("/messages/", content=b"{}")).status_code == 202
    assert done == ["handed over"]


@pytest.mark.parametrize("is_whole", [True, False])
async def test_of_two_responses_to_a_request_the_first_is_sent_to_its_end(is_whole: bool) -> None:
    """The MCP library answers a HEAD twice, and an event stream again when the server stops."""
    sent = list[Any]()

    async def twice(_scope: Any, _receive: Any, send: Any) -> None:
        for _ in range(2):
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b"x", "more_body": not is_whole})

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "HEAD", "path": "/sse", "headers": []}
    await RequestLimits(twice)(scope, Mock(), send)
    assert sent[0]["type"] == "http.response.start"
    ends = [not message.get("more_body") for message in sent[1:]]
    assert ends == ([True] if is_whole else [False, True])


async def test_a_fault_of_the_application_is_not_hidden() -> None:
    async def broken(_scope: Any, _receive: Any, _send: Any) -> None:
        raise anyio.BrokenResourceError

    with pytest.RaisesGroup(anyio.BrokenResourceError):
        await client(RequestLimits(broken)).post("/messages/", content=b"{}")


@pytest.mark.parametrize("wrap", [lambda inner: [inner], lambda inner: {"x": inner}])
def test_depth_is_counted_exactly(wrap: Callable[[Any], Any]) -> None:
    value: Any = 1
    for _ in range(MAX_DEPTH - 1):
        value = wrap(value)

    assert excess_in_arguments({"a": value}) is None
    assert excess_in_arguments({"a": wrap(value)}) is not None


@pytest.mark.parametrize(("states_it", "taken"), [(True, 0), (False, 2)])
async def test_a_body_too_large_is_refused_by_its_stated_length_or_by_what_is_counted(
    states_it: bool, taken: int
) -> None:
    web, parts = app(), iter([b"x" * MAX_BODY_BYTES] * 1000)

    async def body() -> AsyncIterator[bytes]:
        for part in parts:
            yield part

    length = {"content-length": str(MAX_BODY_BYTES + 1)} if states_it else {}
    async with running(web), client(web) as http:
        refused = await http.post("/mcp", content=body(), headers=MCP_HEADERS | length)
    assert refused.status_code == 413
    assert refused.text == f"The request is larger than {MAX_BODY_BYTES} bytes.\n"
    assert 1000 - len([*parts]) == taken


async def test_a_client_that_leaves_before_its_body_is_whole_reaches_no_application() -> None:
    async def never(_scope: Any, _receive: Any, _send: Any) -> None:
        pytest.fail("there is no whole request")

    half = {"type": "http.request", "body": b"half", "more_body": True}
    came, sent = iter([half, {"type": "http.disconnect"}]), list[Any]()

    async def receive() -> Any:
        return next(came)

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": "/mcp", "headers": []}
    await RequestLimits(never)(scope, receive, send)
    assert sent == []

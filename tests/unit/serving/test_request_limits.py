from __future__ import annotations

from typing import TYPE_CHECKING, Any
from uuid import UUID

import anyio
import pytest

from ros2_memory.serving import request_limits
from ros2_memory.serving.request_limits import MAX_BODY_BYTES, MAX_UNREAD, RequestLimits

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

SESSION = "0123456789abcdef0123456789abcdef"
MIB = 1 << 20


class Client:
    """One request: its messages are sent as the application receives, its answer is kept."""

    def __init__(
        self,
        *body: bytes,
        method: str = "POST",
        path: str = "/mcp",
        query: str = "",
        **headers: str,
    ) -> None:
        named = [(name.replace("_", "-").encode(), text.encode()) for name, text in headers.items()]
        self.scope: Any = {
            "type": "http",
            "method": method,
            "path": path,
            "query_string": query.encode(),
            "headers": named,
        }
        self.sent: list[Any] = []
        self.taken = 0
        self.leaves = anyio.Event()
        self.reads = anyio.Event()
        self.reads.set()
        self._messages = [
            {"type": "http.request", "body": part, "more_body": n < len(body) - 1}
            for n, part in enumerate(body)
        ]

    async def receive(self) -> Any:
        if self._messages:
            self.taken += 1
            return self._messages.pop(0)
        await self.leaves.wait()
        return {"type": "http.disconnect"}

    async def send(self, message: Any) -> None:
        self.sent.append(message)
        if message["type"] == "http.response.body" and not message.get("more_body", False):
            self.leaves.set()  # as the server says that the answer is complete
        await self.reads.wait()

    @property
    def status(self) -> int:
        return int(self.sent[0]["status"])

    @property
    def reply(self) -> str:
        return b"".join(each.get("body", b"") for each in self.sent).decode()


async def echo(_scope: Any, receive: Any, send: Any) -> None:
    """Answers with the length of the body."""
    message = await receive()
    assert not message["more_body"]
    await respond(send, str(len(message["body"])))


async def respond(send: Callable[[Any], Awaitable[None]], text: str, status: int = 200) -> None:
    await send({"type": "http.response.start", "status": status, "headers": []})
    await send({"type": "http.response.body", "body": text.encode()})


async def asked(app: Any, client: Client) -> Client:
    with anyio.fail_after(20):
        await app(client.scope, client.receive, client.send)
    return client


@pytest.mark.parametrize(
    "parts", [[b""], [b"12345"], [b"12", b"", b"345"], [b"x" * (MIB // 4)] * 4]
)
async def test_a_body_is_passed_on_whole(parts: list[bytes]) -> None:
    client = await asked(RequestLimits(echo), Client(*parts))
    assert (client.status, client.reply) == (200, str(sum(map(len, parts))))


async def test_a_body_too_large_is_refused_by_what_is_counted() -> None:
    client = await asked(RequestLimits(echo), Client(*[b"x" * MIB] * 1000, content_length="5"))
    assert client.status == 413
    assert client.reply == f"The request is larger than {MAX_BODY_BYTES} bytes.\n"
    assert client.taken == MAX_BODY_BYTES // MIB + 1


@pytest.mark.parametrize("length", [str(MAX_BODY_BYTES + 1), "9" * 5000])
async def test_a_body_too_large_is_refused_by_its_stated_length_before_it_is_read(
    length: str,
) -> None:
    client = await asked(RequestLimits(echo), Client(b"x", content_length=length))
    assert (client.status, client.taken) == (413, 0)


async def test_all_bodies_together_are_bounded_and_given_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(request_limits, "MAX_BUFFERED_BYTES", 3 * MIB // 2)
    answering = anyio.Event()

    async def slow(scope: Any, receive: Any, send: Any) -> None:
        await answering.wait()
        await echo(scope, receive, send)

    app = RequestLimits(slow)
    first = Client(b"x" * MIB)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(asked, app, first)
        await anyio.wait_all_tasks_blocked()
        second = await asked(app, Client(b"x" * MIB))
        assert second.status == 503
        assert (b"retry-after", b"1") in second.sent[0]["headers"]
        answering.set()
    assert first.status == 200
    assert (await asked(app, Client(b"x" * MIB))).status == 200


async def test_a_call_whose_client_leaves_is_ended() -> None:
    ended = anyio.Event()

    async def stuck(_scope: Any, receive: Any, _send: Any) -> None:
        await receive()
        try:
            await anyio.sleep_forever()
        finally:
            ended.set()

    client = Client(b"{}")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(asked, RequestLimits(stuck), client)
        await anyio.wait_all_tasks_blocked()
        assert not ended.is_set()
        client.leaves.set()
    assert ended.is_set()
    assert client.sent == []


async def test_a_client_that_leaves_before_its_body_is_whole_reaches_no_application() -> None:
    async def never(_scope: Any, _receive: Any, _send: Any) -> None:
        pytest.fail("there is no whole request")

    client = Client(b"half", b"rest")
    client._messages.pop()
    client.leaves.set()
    await asked(RequestLimits(never), client)
    assert client.sent == []


async def test_what_an_application_does_after_its_answer_is_not_cut_off() -> None:
    done: list[str] = []

    async def accepting(_scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await respond(send, "Accepted", 202)
        for _ in range(10):
            await anyio.lowlevel.checkpoint()
        done.append("handed over")

    client = await asked(RequestLimits(accepting), Client(b"{}"))
    assert (client.status, done) == (202, ["handed over"])


@pytest.mark.parametrize("error", [anyio.BrokenResourceError, anyio.ClosedResourceError])
async def test_a_session_that_ends_before_an_accepted_message_is_handed_over_is_no_fault(
    error: type[Exception],
) -> None:
    async def accepting(_scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await respond(send, "Accepted", 202)
        raise error

    assert (await asked(RequestLimits(accepting), Client(b"{}"))).status == 202


async def test_a_fault_of_the_application_is_not_hidden() -> None:
    async def broken(_scope: Any, _receive: Any, _send: Any) -> None:
        raise anyio.BrokenResourceError

    with pytest.RaisesGroup(anyio.BrokenResourceError):
        await asked(RequestLimits(broken), Client(b"{}"))


def stream_and_messages() -> tuple[RequestLimits, anyio.abc.ObjectSendStream[bytes]]:
    """An application of one event stream, which is sent what the test puts in."""
    events, to_send = anyio.create_memory_object_stream[bytes](100)

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["method"] == "POST":
            await receive()
            await respond(send, "Accepted", 202)
            return
        await send({"type": "http.response.start", "status": 200, "headers": []})
        hello = f"event: endpoint\r\ndata: /messages/?session_id={SESSION}\r\n\r\n".encode()
        await send({"type": "http.response.body", "body": hello, "more_body": True})
        async with to_send:
            async for event in to_send:
                await send({"type": "http.response.body", "body": event, "more_body": True})
        await send({"type": "http.response.body", "body": b""})

    return RequestLimits(app), events


def message(query: str = f"session_id={SESSION}") -> Client:
    return Client(b"{}", path="/messages/", query=query)


async def test_messages_are_taken_without_bound_while_the_stream_is_read() -> None:
    app, events = stream_and_messages()
    stream = Client(method="GET", path="/sse")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(asked, app, stream)
        await anyio.wait_all_tasks_blocked()
        for _ in range(3 * MAX_UNREAD):
            assert (await asked(app, message())).status == 202
        await events.aclose()


async def test_few_messages_are_taken_from_a_client_that_does_not_read_its_stream() -> None:
    app, events = stream_and_messages()
    stream = Client(method="GET", path="/sse")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(asked, app, stream)
        await anyio.wait_all_tasks_blocked()
        stream.reads = anyio.Event()
        await events.send(b"unread")
        await anyio.wait_all_tasks_blocked()
        statuses = [(await asked(app, message())).status for _ in range(MAX_UNREAD + 3)]
        assert statuses == [202] * MAX_UNREAD + [429] * 3
        other = Client(b"{}", path="/messages/", query="session_id=" + "f" * 32)
        assert (await asked(app, other)).status == 202
        stream.reads.set()
        await anyio.wait_all_tasks_blocked()
        assert (await asked(app, message())).status == 202
        await events.aclose()
    assert app._streams == {}


@pytest.mark.parametrize(
    "query",
    [
        f"session_id={SESSION.upper()}",
        f"session_id={UUID(SESSION)}",
        f"session_id=urn:uuid:{UUID(SESSION)}",
        f"session_id=%7B{SESSION}%7D",
        f"session_id={'f' * 32}&session_id={SESSION}",
        f"pad={'x' * 300}&session_id={SESSION}",
    ],
)
async def test_messages_are_bounded_however_their_session_is_spelt(query: str) -> None:
    app, events = stream_and_messages()
    stream = Client(method="GET", path="/sse")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(asked, app, stream)
        await anyio.wait_all_tasks_blocked()
        stream.reads = anyio.Event()
        await events.send(b"unread")
        await anyio.wait_all_tasks_blocked()
        statuses = [(await asked(app, message(query))).status for _ in range(MAX_UNREAD + 1)]
        assert statuses == [202] * MAX_UNREAD + [429]
        stream.reads.set()
        await events.aclose()


async def test_a_message_for_what_is_no_session_is_left_to_the_application() -> None:
    for query in ("", "session_id=", "session_id=none"):
        assert (await asked(RequestLimits(echo), message(query))).reply == "2"


async def test_other_scopes_and_requests_without_a_body_are_left_alone() -> None:
    seen: list[str] = []

    async def inner(scope: Any, _receive: Any, _send: Any) -> None:
        seen.append(scope["type"])

    nothing: Any = None
    await RequestLimits(inner)({"type": "lifespan"}, nothing, nothing)
    await asked(RequestLimits(inner), Client(method="GET", path="/health"))
    assert seen == ["lifespan", "http"]

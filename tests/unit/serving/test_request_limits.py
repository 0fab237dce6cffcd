"""How much of a request is read, and how long one runs for a client that left."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.serving.dispatch import MAX_DEPTH, MAX_VALUES, excess_in_arguments
from ros2_memory.serving.request_limits import MAX_BODY_BYTES, RequestLimits
from tests.unit.serving.test_web_app import MCP_HEADERS, app, client, running

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


class Client:
    """One request: its messages are sent as the application receives, its answer is kept."""

    def __init__(self, *body: bytes, **headers: str) -> None:
        named = [(name.replace("_", "-").encode(), text.encode()) for name, text in headers.items()]
        self.scope: Any = {"type": "http", "method": "POST", "path": "/mcp", "headers": named}
        self.sent: list[Any] = []
        self.taken = 0
        self.leaves = anyio.Event()
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

    @property
    def reply(self) -> tuple[int, str]:
        text = b"".join(each.get("body", b"") for each in self.sent).decode()
        return int(self.sent[0]["status"]), text

    async def asks(self, app: Callable[..., Awaitable[None]]) -> Client:
        with anyio.fail_after(20):
            await RequestLimits(app)(self.scope, self.receive, self.send)
        return self


async def respond(send: Callable[[Any], Awaitable[None]], text: str, status: int = 200) -> None:
    await send({"type": "http.response.start", "status": status, "headers": []})
    await send({"type": "http.response.body", "body": text.encode()})


async def echo(_scope: Any, receive: Any, send: Any) -> None:
    """Answers with the length of the body."""
    message = await receive()
    assert not message["more_body"]
    await respond(send, str(len(message["body"])))


@pytest.mark.parametrize(
    "parts", [[b""], [b"12345"], [b"12", b"", b"345"], [b"x" * (MAX_BODY_BYTES // 4)] * 4]
)
async def test_a_body_is_passed_on_whole(parts: list[bytes]) -> None:
    assert (await Client(*parts).asks(echo)).reply == (200, str(sum(map(len, parts))))


@pytest.mark.parametrize(("length", "taken"), [("5", 2), (str(MAX_BODY_BYTES + 1), 0)])
async def test_a_body_too_large_is_refused_by_its_stated_length_or_by_what_is_counted(
    length: str, taken: int
) -> None:
    refused = await Client(*[b"x" * MAX_BODY_BYTES] * 1000, content_length=length).asks(echo)
    assert refused.reply == (413, f"The request is larger than {MAX_BODY_BYTES} bytes.\n")
    assert refused.taken == taken


async def test_a_call_whose_client_leaves_is_ended() -> None:
    ended = anyio.Event()

    async def stuck(_scope: Any, receive: Any, _send: Any) -> None:
        await receive()
        try:
            await anyio.sleep_forever()
        finally:
            ended.set()

    leaving = Client(b"{}")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(leaving.asks, stuck)
        await anyio.wait_all_tasks_blocked()
        assert not ended.is_set()
        leaving.leaves.set()
    assert ended.is_set()
    assert leaving.sent == []


async def test_a_client_that_leaves_before_its_body_is_whole_reaches_no_application() -> None:
    async def never(_scope: Any, _receive: Any, _send: Any) -> None:
        pytest.fail("there is no whole request")

    leaving = Client(b"half", b"rest")
    leaving._messages.pop()
    leaving.leaves.set()
    assert (await leaving.asks(never)).sent == []


@pytest.mark.parametrize("error", [None, anyio.BrokenResourceError, anyio.ClosedResourceError])
async def test_what_an_application_does_after_its_answer_is_not_cut_off_and_may_fail(
    error: type[Exception] | None,
) -> None:
    """A message is accepted first and handed over then; its session may end in between."""
    done: list[str] = []

    async def accepting(_scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await respond(send, "Accepted", 202)
        for _ in range(10):
            await anyio.lowlevel.checkpoint()
        done.append("handed over")
        if error is not None:
            raise error

    assert (await Client(b"{}").asks(accepting)).reply == (202, "Accepted")
    assert done == ["handed over"]


async def test_a_fault_of_the_application_is_not_hidden() -> None:
    async def broken(_scope: Any, _receive: Any, _send: Any) -> None:
        raise anyio.BrokenResourceError

    with pytest.RaisesGroup(anyio.BrokenResourceError):
        await Client(b"{}").asks(broken)


@given(JSON)
def test_what_a_call_may_hold_is_never_refused(value: Any) -> None:
    assert excess_in_arguments({"a": value}) is None


@pytest.mark.parametrize("depth", [MAX_DEPTH - 1, MAX_DEPTH])
@pytest.mark.parametrize("wrap", [lambda inner: [inner], lambda inner: {"x": inner}])
def test_depth_is_counted_exactly(depth: int, wrap: Callable[[Any], Any]) -> None:
    value: Any = 1
    for _ in range(depth):
        value = wrap(value)
    assert (excess_in_arguments({"a": value}) is None) == (depth < MAX_DEPTH)


@pytest.mark.parametrize(
    "value",
    [b"[" * 60_000 + b"]" * 60_000, b"[" + b"0," * 60_000 + b"0]", b"[" * 60_000, b"\xff\xfe\0"],
    ids=["deep", "list", "open", "utf-16"],
)
async def test_a_call_that_holds_too_much_is_refused_and_no_other_is(value: bytes) -> None:
    web = app()
    call = b'{"jsonrpc":"2.0","id":1,"method":"tools/call","params":{"name":"ask","arguments":'
    headers = MCP_HEADERS | {"content-type": "application/json"}
    async with running(web), client(web) as http:
        refused = await http.post("/mcp", content=call + b'{"a":%b}}}' % value, headers=headers)
        fields = b'{"fields":[' + b'"x",' * (MAX_VALUES // 2) + b'"x"]}}}'
        taken = await http.post("/mcp", content=call + fields, headers=headers)
    assert refused.status_code == 400 or "more than 10000 values" in refused.text
    assert (taken.status_code, "invalid_arguments" in taken.text) == (200, False)

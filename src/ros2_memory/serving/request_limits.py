"""What of a request is taken in, and for how long its answer is worth the work.

Bodies are read whole, and bounded one by one and all together, in size, number of values and depth,
before anything looks at them. A
call whose client leaves is ended, and so is taking in more questions from a client that does not
read the answers it has.
"""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from uuid import UUID

import anyio
from starlette.datastructures import Headers, QueryParams
from starlette.responses import PlainTextResponse

from ros2_memory.serving.call_size import too_much_in

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BODY_BYTES: Final = 1 << 20
MOST_HELD_BYTES: Final = 32 << 20
"""Of all bodies at once."""
MOST_UNREAD: Final = 64
"""Messages taken from the client of an event stream while it leaves one on it unread."""

_WITH_BODY: Final = frozenset({"POST", "PUT", "PATCH"})
_SESSION: Final = re.compile(rb"session_id=([0-9a-f]{32})")

_TOO_LARGE: Final = f"The request is larger than {MOST_BODY_BYTES} bytes.\n"
_TOO_MUCH: Final = "The server is taking in too much at once; ask again.\n"
_UNREAD: Final = "Replies to this session are not being read; read them, then ask again.\n"


class RequestLimits:
    """Reads requests for an application, and cancels it where nobody waits for its answer."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._held = 0
        self._streams: dict[str, _Stream] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["method"] in _WITH_BODY:
            with self._holding() as held:
                await self._post(_Exchange(scope, receive, send), held)
        else:
            stream = _Stream(send)
            try:
                await self._app(scope, receive, self._followed(stream))
            finally:
                self._streams.pop(stream.session, None)

    @contextmanager
    def _holding(self) -> Iterator[_Held]:
        """What one request holds of the whole; given back in the end."""
        held = _Held()
        try:
            yield held
        finally:
            self._held -= held.size

    async def _post(self, exchange: _Exchange, held: _Held) -> None:
        refusal = self._unread(exchange.scope) or await self._read(exchange, held)
        if refusal is not None:
            # The server throws away what is left of the body: a client may read only afterwards.
            await refusal(exchange.scope, exchange.receive, exchange.send)
        elif not exchange.left:
            await exchange.run(self._app)

    async def _read(self, exchange: _Exchange, held: _Held) -> PlainTextResponse | None:
        """Reads the body; the refusal, where it is too large."""
        declared = Headers(scope=exchange.scope).get("content-length", "")
        if declared.isdecimal() and (len(declared) > 12 or int(declared) > MOST_BODY_BYTES):
            return PlainTextResponse(_TOO_LARGE, status_code=413)
        async for chunk in exchange.chunks():
            held.size += len(chunk)
            self._held += len(chunk)
            if held.size > MOST_BODY_BYTES:
                return PlainTextResponse(_TOO_LARGE, status_code=413)
            if self._held > MOST_HELD_BYTES:
                return PlainTextResponse(_TOO_MUCH, status_code=503, headers={"retry-after": "1"})
        reason = too_much_in(exchange.body)
        return None if reason is None else PlainTextResponse(reason, status_code=413)

    def _unread(self, scope: Scope) -> PlainTextResponse | None:
        """The refusal of a message whose sender has not read what it was sent."""
        stream = self._streams.get(_session(scope))
        if stream is None or not stream.is_blocked:
            return None
        stream.taken += 1
        if stream.taken <= MOST_UNREAD:
            return None
        return PlainTextResponse(_UNREAD, status_code=429, headers={"retry-after": "1"})

    def _followed(self, stream: _Stream) -> Send:
        """Sends on a stream, and notes its session from the first event, which names it."""

        async def send(message: Message) -> None:
            if not stream.session and (found := _SESSION.search(message.get("body", b""))):
                stream.session = found[1].decode()
                self._streams[stream.session] = stream
            stream.is_blocked = True
            await stream.send(message)
            stream.is_blocked, stream.taken = False, 0

        return send


def _session(scope: Scope) -> str:
    """The session that a message is for, as the MCP library reads it, which takes any spelling."""
    given = QueryParams(scope["query_string"]).get("session_id", "")
    try:
        return UUID(hex=given).hex
    except ValueError:
        return ""


@dataclass(slots=True)
class _Held:
    """Bytes of one request's body."""

    size: int = 0


@dataclass(slots=True)
class _Stream:
    """One response to a request without a body, which may be an event stream."""

    send: Send
    session: str = ""
    is_blocked: bool = False
    taken: int = 0


class _Exchange:
    """One request with a body, and its response."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.scope = scope
        self.left = False
        self._from_client = receive
        self._to_client = send
        self._body: bytes | None = None
        self._answered = False

    async def chunks(self) -> AsyncIterator[bytes]:
        """The body as it comes; ends early where the client leaves."""
        body = bytearray()
        more = True
        while more:
            message = await self._from_client()
            if message["type"] == "http.disconnect":
                self.left = True
                return
            body += message.get("body", b"")
            more = message.get("more_body", False)
            yield message.get("body", b"")
        self._body = bytes(body)

    @property
    def body(self) -> bytes:
        """What was read; empty where the client left before its end."""
        return self._body or b""

    async def run(self, app: ASGIApp) -> None:
        """Runs the application, for as long as the client waits for its answer.

        After the answer it may go on: a message to an event stream's session is accepted first and
        handed over then. The session may end in between.
        """
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._watch, tasks.cancel_scope)
            try:
                await app(self.scope, self.receive, self.send)
            except (anyio.BrokenResourceError, anyio.ClosedResourceError):
                if not self._answered:
                    raise
            tasks.cancel_scope.cancel()

    async def _watch(self, running: anyio.CancelScope) -> None:
        """The server tells of the end of the answer in the same way as of a client that left."""
        while (await self._from_client())["type"] != "http.disconnect":
            pass
        if not self._answered:
            self.left = True
            running.cancel()

    async def receive(self) -> Message:
        """The body once, then nothing: leaving ends the application."""
        if self._body is None:
            await anyio.sleep_forever()
        body, self._body = self._body, None
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(self, message: Message) -> None:
        """Passes a part of the answer on."""
        if message["type"] == "http.response.body" and not message.get("more_body", False):
            self._answered = True
        await self._to_client(message)

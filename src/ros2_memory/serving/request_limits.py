"""Bounds on requests: how much of them is read, and how long a call runs for a client that left.

A body is read whole, before anything parses it. Its size, its number of values and its depth are
bounded, and so is the size of all bodies together. A call is cancelled when its client leaves. A
client that does not read the replies it has may not ask more.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from uuid import UUID

import anyio
from starlette.datastructures import Headers, QueryParams
from starlette.responses import PlainTextResponse

from ros2_memory.serving.call_size import excess_in_json

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES: Final = 1 << 20
MAX_BUFFERED_BYTES: Final = 32 << 20
"""Of all bodies at once."""
MAX_UNREAD: Final = 64
"""Messages that a client may send while it leaves one on its event stream unread."""

_MAX_LENGTH_DIGITS: Final = 12
_WITH_BODY: Final = frozenset({"POST", "PUT", "PATCH"})
_SESSION: Final = re.compile(rb"session_id=([0-9a-f]{32})")

_TOO_LARGE: Final = f"The request is larger than {MAX_BODY_BYTES} bytes.\n"
_TOO_MUCH: Final = "The server is taking in too much at once; ask again.\n"
_UNREAD: Final = "Replies to this session are not being read; read them, then ask again.\n"


class RequestLimits:
    """Reads requests for an application, and cancels it where nobody waits for its reply."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._buffered_bytes = 0
        self._streams: dict[str, _Stream] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["method"] in _WITH_BODY:
            request = _BodyRequest(scope, receive, send)
            try:
                await self._handle(request)
            finally:
                self._buffered_bytes -= request.size
        else:
            stream = _Stream(send)
            try:
                await self._app(scope, receive, self._sending_on(stream))
            finally:
                self._streams.pop(stream.session, None)

    async def _handle(self, request: _BodyRequest) -> None:
        refusal = self._refusal_unread(request.scope) or await self._read(request)
        if refusal is not None:
            # Uvicorn discards the rest of the body, since a client may read only afterwards.
            await refusal(request.scope, request.receive, request.send)
        elif not request.has_left:
            await request.run(self._app)

    async def _read(self, request: _BodyRequest) -> PlainTextResponse | None:
        """Reads the body; returns a refusal if it is too large."""
        declared = Headers(scope=request.scope).get("content-length", "")
        if declared.isdecimal() and (
            len(declared) > _MAX_LENGTH_DIGITS or int(declared) > MAX_BODY_BYTES
        ):
            return PlainTextResponse(_TOO_LARGE, status_code=413)
        async for chunk in request.chunks():
            request.size += len(chunk)
            self._buffered_bytes += len(chunk)
            if request.size > MAX_BODY_BYTES:
                return PlainTextResponse(_TOO_LARGE, status_code=413)
            if self._buffered_bytes > MAX_BUFFERED_BYTES:
                return PlainTextResponse(_TOO_MUCH, status_code=503, headers={"retry-after": "1"})
        excess = excess_in_json(request.body)
        return None if excess is None else PlainTextResponse(excess, status_code=413)

    def _refusal_unread(self, scope: Scope) -> PlainTextResponse | None:
        """Returns a refusal if the sender has not read what was sent to it."""
        stream = self._streams.get(_session(scope))
        if stream is None or not stream.is_blocked:
            return None
        stream.unread += 1
        if stream.unread <= MAX_UNREAD:
            return None
        return PlainTextResponse(_UNREAD, status_code=429, headers={"retry-after": "1"})

    def _sending_on(self, stream: _Stream) -> Send:
        """Returns a `send` that learns the stream's session from its first event."""

        async def send(message: Message) -> None:
            if not stream.session and (found := _SESSION.search(message.get("body", b""))):
                stream.session = found[1].decode()
                self._streams[stream.session] = stream
            stream.is_blocked = True
            await stream.send(message)
            stream.is_blocked, stream.unread = False, 0

        return send


def _session(scope: Scope) -> str:
    """Returns the session of a message; like the MCP library, accepts any spelling of its UUID."""
    given = QueryParams(scope["query_string"]).get("session_id", "")
    try:
        return UUID(hex=given).hex
    except ValueError:
        return ""


@dataclass(slots=True)
class _Stream:
    """One response to a request without a body, which may be an event stream."""

    send: Send
    session: str = ""
    is_blocked: bool = False
    unread: int = 0


@dataclass
class _BodyRequest:
    """One request with a body, and its response.

    Attributes:
        size: bytes of the body that were read so far.
        has_left: whether the client disconnected before its response was complete.
    """

    scope: Scope
    _receive: Receive
    _send: Send
    size: int = 0
    has_left: bool = False
    _body: bytes | None = None
    _is_complete: bool = False

    async def chunks(self) -> AsyncIterator[bytes]:
        """Yields the body as it comes; ends early where the client leaves."""
        body = bytearray()
        more = True
        while more:
            message = await self._receive()
            if message["type"] == "http.disconnect":
                self.has_left = True
                return
            body += message.get("body", b"")
            more = message.get("more_body", False)
            yield message.get("body", b"")
        self._body = bytes(body)

    @property
    def body(self) -> bytes:
        """Returns the body; empty where the client left before its end."""
        return self._body or b""

    async def run(self, app: ASGIApp) -> None:
        """Runs the application, for as long as the client waits for its response.

        The application may go on after the response: a message to an event stream's session is
        accepted first, and delivered then. The session may end in between.
        """
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._cancel_on_disconnect, tasks.cancel_scope)
            try:
                await app(self.scope, self.receive, self.send)
            except (anyio.BrokenResourceError, anyio.ClosedResourceError):
                if not self._is_complete:
                    raise
            tasks.cancel_scope.cancel()

    async def _cancel_on_disconnect(self, running: anyio.CancelScope) -> None:
        # Uvicorn sends this message also when the response is complete.
        while (await self._receive())["type"] != "http.disconnect":
            pass
        if not self._is_complete:
            self.has_left = True
            running.cancel()

    async def receive(self) -> Message:
        """Returns the body once, then waits: `run` cancels the application on a disconnect."""
        if self._body is None:
            await anyio.sleep_forever()
        body, self._body = self._body, None
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(self, message: Message) -> None:
        """Passes a part of the response on."""
        if message["type"] == "http.response.body" and not message.get("more_body", False):
            self._is_complete = True
        await self._send(message)

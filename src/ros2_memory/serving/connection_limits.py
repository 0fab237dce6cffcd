"""Bounds on HTTP connections and requests: how many there are, how much, and for how long.

Uvicorn waits without limit for the rest of a request, and for a client to read its reply. A few
hundred clients that do neither would use up all file descriptors.

A connection is unknown until a request on it is admitted: it showed the token, or passed the
`ForgeryGuard` where there is no token. Unknown connections have a small pool of their own, in which
a new one replaces the oldest of the address that has most: a flood from one machine replaces its
own. However many there are, a client that shows the token is served.

A body is read whole before anything parses it, and is so small that parsing it holds up nobody. A
call is cancelled when its client leaves.
"""

from __future__ import annotations

import socket
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import anyio
import h11
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

from ros2_memory.core.logging_setup import LogThrottle, get_logger
from ros2_memory.serving.auth import access_of

if TYPE_CHECKING:
    import asyncio

    import uvicorn
    from starlette.types import ASGIApp, Message, Receive, Scope, Send
    from uvicorn.server import ServerState

HEAD_S: Final = 10.0
"""From the connection, or the previous reply, to the last byte of a request's headers."""
BODY_S: Final = 30.0
"""From its headers to the last byte of the request."""
UNREAD_S: Final = 30.0
"""How long a client may leave sent bytes unread, or a vanished one unacknowledged."""
SEND_BUFFER_BYTES: Final = 128 << 10
"""Size of the socket's send buffer: several replies of usual length."""
LINGER_S: Final = 1.0
MAX_CONNECTIONS: Final = 256
MAX_UNKNOWN: Final = 128
MIN_CHUNKS: Final = 256
CHUNK_BYTES: Final = 64
"""A body with more than `MIN_CHUNKS` chunks must have this many bytes for each further one."""
ACCEPTED_AT_ONCE: Final = 16
"""In one turn of the event loop. A new connection is first read three turns later, so fewer are
accepted by then than there is room for, and none is replaced before its first bytes were read."""
MAX_BODY_BYTES: Final = 128 << 10
"""Several times the largest arguments. Parsing it takes some hundredths of a second, in which the
event loop serves no client; all connections together hold 32 MiB at most."""

_TOO_LARGE: Final = PlainTextResponse(
    f"The request is larger than {MAX_BODY_BYTES} bytes.\n", status_code=413
)

log = get_logger(__name__)

_Phase = Literal["head", "body", "reply"]


class _Connection(h11.Connection):
    """HTTP/1.1 of a client, where a body in too many chunks for its size is an error.

    A chunk takes as long to parse as a hundred bytes, however small it is.
    """

    _chunks = 0
    _chunk_bytes = 0

    def next_event(self) -> type[h11.NEED_DATA | h11.PAUSED] | h11.Event:
        """Returns the next event of a request.

        Raises:
            h11.RemoteProtocolError: it is no HTTP, or has too many chunks.
        """
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._chunks = self._chunk_bytes = 0
        elif isinstance(event, h11.Data):
            self._chunks += event.chunk_start
            self._chunk_bytes += len(event.data)
            if self._chunks > MIN_CHUNKS + self._chunk_bytes // CHUNK_BYTES:
                raise h11.RemoteProtocolError("too many chunks")
        return event


class BoundedConnection(H11Protocol):
    """Uvicorn's HTTP/1.1 over one connection, which is closed when the client takes too long.

    A request that is not completed is answered with 408, a connection above `MAX_CONNECTIONS` with
    503. A reply that is not read aborts the connection, and with it the call or the event stream.
    Above `MAX_UNKNOWN` a new unknown connection replaces the oldest of the address that has most,
    without a reply.
    """

    _refusals: ClassVar[LogThrottle] = LogThrottle()

    _phase: _Phase = "reply"
    _deadline: asyncio.TimerHandle | None = None
    _unread: asyncio.TimerHandle | None = None
    _is_refused = False
    _is_aborted = False
    _is_admitted = False
    _made_s = 0.0

    @property
    def is_unknown(self) -> bool:
        """Returns whether no request on it was admitted so far."""
        if self._is_admitted:  # an earlier request was
            return False
        return not self._has_begun() or access_of(self.scope) is None

    def __init__(
        self,
        config: uvicorn.Config,
        server_state: ServerState,
        app_state: dict[str, object],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self.conn = _Connection(h11.SERVER)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        """Handles a new connection."""
        super().connection_made(transport)
        # Zero makes any unsent byte pause writing, which starts the timer of unread replies.
        transport.set_write_buffer_limits(high=0)
        _limit_socket(transport)
        self._made_s = self.loop.time()
        present = [
            connection
            for connection in self.connections
            if isinstance(connection, BoundedConnection) and not connection._is_aborted
        ]
        unknown = [connection for connection in present if connection.is_unknown]
        if len(unknown) > MAX_UNKNOWN:
            by_address = Counter(connection._address for connection in unknown)

            def rank(connection: BoundedConnection) -> tuple[int, float]:
                return -by_address[connection._address], connection._made_s

            min(unknown, key=rank)._abort()
        if len(present) - len(unknown) >= MAX_CONNECTIONS:
            self._log_refused("too many connections")
            self._refuse(503, "Service Unavailable", "Too many connections; close some.\n")
            return
        self._watch()

    @property
    def _address(self) -> str:
        return self.client[0] if self.client else ""

    def _log_refused(self, reason: str) -> None:
        if refused := self._refusals.count(reason):
            log.warning("connection_refused", reason=reason, refused=refused)

    def _abort(self) -> None:
        """Closes the connection at once, without a reply."""
        self._log_refused("an unknown connection replaced by a newer one")
        self._is_aborted = True
        self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Handles the end of the connection."""
        for timer in (self._deadline, self._unread):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Handles bytes of a request, perhaps its last."""
        if not self._is_refused:
            super().data_received(data)
            self._watch()

    def on_response_complete(self) -> None:
        """Handles the end of a reply; another request may follow."""
        self._is_admitted = not self.is_unknown  # the next request has another scope
        super().on_response_complete()
        self._watch()

    def pause_writing(self) -> None:
        """Starts the timer of a client that does not read."""
        super().pause_writing()
        if self._unread is None:
            self._unread = self.loop.call_later(UNREAD_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Stops the timer of a client that has read everything."""
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _watch(self) -> None:
        """Sets the deadline of the part of a request that is awaited.

        It counts from the beginning of that part: more bytes do not extend it.
        """
        phase = self._awaited_phase()
        if phase == self._phase:
            return
        self._phase = phase
        if self._deadline is not None:
            self._deadline.cancel()
        if phase != "reply" and not self.transport.is_closing():
            within = HEAD_S if phase == "head" else BODY_S
            self._deadline = self.loop.call_later(within, self._too_late)

    def _awaited_phase(self) -> _Phase:
        if not self._has_begun():
            return "head"
        if self.cycle.more_body:
            return "body"
        return "head" if self.cycle.response_complete else "reply"

    def _has_begun(self) -> bool:
        """Returns whether a first request has come; before that uvicorn has no `cycle`."""
        cycle: object = self.cycle
        return cycle is not None

    def _too_late(self) -> None:
        if self._phase == "body" and self.cycle.response_started:
            # The request was answered before it was read, so 408 cannot be sent any more.
            self.transport.abort()
        else:
            self._log_refused("no request within its time")
            self._refuse(408, "Request Timeout", "The request did not come to its end in time.\n")

    def send_400_response(self, msg: str) -> None:
        """Handles bytes that are not HTTP."""
        self._log_refused("no HTTP")
        if self._has_begun() and self.cycle.response_started:
            self.transport.abort()
        else:
            self._refuse(400, "Bad Request", f"{msg}\n")

    def _refuse(self, status: int, reason: str, sentence: str) -> None:
        """Replies outside of the protocol's state, which may not allow a reply, and closes.

        Closing at once would reset the connection of a client that still sends, and discard what
        the client has not read. So the server reads for a moment longer, and discards it.
        """
        self._is_refused = True
        if self._has_begun():
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self.transport.write(
            f"HTTP/1.1 {status} {reason}\r\ncontent-type: text/plain; charset=utf-8\r\n"
            f"content-length: {len(sentence)}\r\nconnection: close\r\n\r\n{sentence}".encode()
        )
        # Not later: the peer may be gone by then, which raises.
        if not self.transport.get_write_buffer_size():
            with suppress(OSError):
                self.transport.write_eof()
        self.loop.call_later(LINGER_S, self.transport.abort)


def _limit_socket(transport: asyncio.Transport) -> None:
    """Limits the send buffer, and the time after which an unresponsive peer is given up.

    By default Linux buffers megabytes for each client that does not read, and waits 15 minutes for
    one that lost its power or its network.
    """
    connected = transport.get_extra_info("socket")
    if connected is None:
        return
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(UNREAD_S * 1000))


@dataclass
class RequestLimits:
    """Reads the bodies of requests, and cancels the application when a client leaves."""

    _app: ASGIApp

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        if scope["method"] not in {"POST", "PUT", "PATCH"}:
            await self._app(scope, receive, _one_response(send))
            return
        # h11 has refused a length that is no number. Uvicorn discards the rest of a body that is
        # too large, since a client may read the refusal only afterwards.
        is_small = int(Headers(scope=scope).get("content-length", "0")) <= MAX_BODY_BYTES
        body, has_more = bytearray(), is_small
        while has_more:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body += message.get("body", b"")
            is_small = len(body) <= MAX_BODY_BYTES
            has_more = is_small and message.get("more_body", False)
        if is_small:
            await self._answer(scope, bytes(body), receive, send)
        else:
            await _TOO_LARGE(scope, receive, send)

    async def _answer(self, scope: Scope, body: bytes, receive: Receive, send: Send) -> None:
        """Runs the application, for as long as the client waits for its response.

        The application may go on after the response: a message to an event stream's session is
        accepted first, and delivered then. The session may end in between.
        """
        unread: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]
        is_complete = False

        async def receive_body() -> Message:
            if not unread:
                await anyio.sleep_forever()
            return unread.pop()

        async def send_on(message: Message) -> None:
            nonlocal is_complete
            is_complete = is_complete or _is_last(message)
            await send(message)

        async def cancel_on_disconnect(running: anyio.CancelScope) -> None:
            # Uvicorn sends this message also when the response is complete.
            while (await receive())["type"] != "http.disconnect":
                pass
            if not is_complete:
                running.cancel()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(cancel_on_disconnect, tasks.cancel_scope)
            try:
                await self._app(scope, receive_body, send_on)
            except (anyio.BrokenResourceError, anyio.ClosedResourceError):
                if not is_complete:
                    raise
            tasks.cancel_scope.cancel()


def _one_response(send: Send) -> Send:
    """Returns a `send` that ends an open response where a second one begins, and drops the rest.

    When the server stops, the MCP library leaves an event stream open, and answers once more. It
    also answers twice to a HEAD.
    """
    has_begun = has_ended = False

    async def send_first(message: Message) -> None:
        nonlocal has_begun, has_ended
        if has_ended:
            return
        if has_begun and message["type"] == "http.response.start":
            message = {"type": "http.response.body"}
        has_begun, has_ended = True, _is_last(message)
        await send(message)

    return send_first


def _is_last(message: Message) -> bool:
    return message["type"] == "http.response.body" and not message.get("more_body")

"""Bounds on HTTP connections: how many there are, and how long one may keep the server waiting.

Uvicorn waits for the rest of a request for as long as the client likes, and for a client to read
its reply likewise. A few hundred clients that do neither would take all file descriptors.

A connection is a stranger's until a request on it was admitted: it showed the token, or where there
is none it passed the `Guard`. Strangers have a small pool of their own, in which the oldest makes
room for the next: however many there are, whoever shows the token is served.
"""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import TYPE_CHECKING, ClassVar, Final, Literal

from uvicorn.protocols.http.h11_impl import H11Protocol

from ros2_memory.core.logging_setup import LogThrottle, get_logger
from ros2_memory.serving.auth import is_admitted

if TYPE_CHECKING:
    import asyncio

HEAD_S: Final = 10.0
"""From a connection, or the reply before, to the last byte of a request's headers."""
BODY_S: Final = 30.0
"""From there to the last byte of the request."""
UNREAD_S: Final = 30.0
"""How long a client may leave what was sent to it unread, or a vanished one unacknowledged."""
KEPT_BYTES: Final = 128 << 10
"""Of what was sent and is not acknowledged: several replies of usual length."""
LINGER_S: Final = 1.0
MOST_CONNECTIONS: Final = 256
MOST_STRANGERS: Final = 128
ACCEPTED_AT_ONCE: Final = 16
"""In one turn of the event loop, three of which pass before a new connection is read from: so none
is put out before what it sent at once was looked at."""

log = get_logger(__name__)

_Phase = Literal["head", "body", "reply"]


class BoundedConnection(H11Protocol):
    """Uvicorn's HTTP/1.1 over one connection, which ends when the client takes too long.

    A request that does not come to its end is answered with 408, a connection too many with 503;
    a reply that is not read ends the connection, which ends the call or the event stream with it.
    The oldest stranger too many is put out without a word.
    """

    _refusals: ClassVar[LogThrottle] = LogThrottle()

    _phase: _Phase = "reply"
    _deadline: asyncio.TimerHandle | None = None
    _unread: asyncio.TimerHandle | None = None
    _is_refused = False
    _is_admitted = False
    _made_s = 0.0

    @property
    def is_stranger(self) -> bool:
        """Whether no request on it was admitted so far."""
        if not self._is_admitted and self._has_begun():
            self._is_admitted = is_admitted(self.scope)
        return not self._is_admitted

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        """A client has connected."""
        super().connection_made(transport)
        # Zero: any unsent byte counts as unread, and none is kept for long.
        transport.set_write_buffer_limits(high=0)
        _bound_the_system(transport)
        self._made_s = self.loop.time()
        strangers = self._strangers()
        if len(self.connections) - len(strangers) >= MOST_CONNECTIONS:
            self._log_refused("too many connections")
            self._refuse(503, "Service Unavailable", "Too many connections; close some.\n")
            return
        if len(strangers) > MOST_STRANGERS:
            min(strangers, key=lambda each: each._made_s)._put_out()
        self._watch()

    def _strangers(self) -> list[BoundedConnection]:
        return [
            each
            for each in self.connections
            if isinstance(each, BoundedConnection) and each.is_stranger and not each._is_refused
        ]

    def _log_refused(self, reason: str) -> None:
        if refused := self._refusals.count(reason):
            log.warning("connection_refused", reason=reason, refused=refused)

    def _put_out(self) -> None:
        """Ends it at once, without a word: it has had its time."""
        self._log_refused("a stranger made room for another")
        self._is_refused = True
        self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """It is over."""
        for timer in (self._deadline, self._unread):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Some bytes of a request, perhaps its last."""
        if not self._is_refused:
            super().data_received(data)
            self._watch()

    def on_response_complete(self) -> None:
        """The reply is on its way; another request may follow."""
        self._is_admitted = not self.is_stranger
        super().on_response_complete()
        self._watch()

    def pause_writing(self) -> None:
        """The client does not read as fast as it is written to."""
        super().pause_writing()
        if self._unread is None:
            self._unread = self.loop.call_later(UNREAD_S, self.transport.abort)

    def resume_writing(self) -> None:
        """The client has read everything."""
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _watch(self) -> None:
        """Sets the time by which the part of a request that is awaited must be there.

        Counted from the beginning of that part: more bytes of it win no more time.
        """
        phase = self._awaited()
        if phase == self._phase:
            return
        self._phase = phase
        if self._deadline is not None:
            self._deadline.cancel()
        if phase != "reply" and not self.transport.is_closing():
            within = HEAD_S if phase == "head" else BODY_S
            self._deadline = self.loop.call_later(within, self._too_late)

    def _awaited(self) -> _Phase:
        if not self._has_begun():
            return "head"
        if self.cycle.more_body:
            return "body"
        return "head" if self.cycle.response_complete else "reply"

    def _has_begun(self) -> bool:
        """Whether there was a request at all."""
        cycle: object = self.cycle
        return cycle is not None

    def _too_late(self) -> None:
        if self._phase == "body" and self.cycle.response_started:
            # Answered before it was read, and there is no answer to what is left.
            self.transport.abort()
        else:
            self._log_refused("no request within its time")
            self._refuse(408, "Request Timeout", "The request did not come to its end in time.\n")

    def send_400_response(self, msg: str) -> None:
        """What came is no HTTP."""
        self._log_refused("no HTTP")
        if self._has_begun() and self.cycle.response_started:
            self._is_refused = True
            self.transport.abort()
        else:
            self._refuse(400, "Bad Request", f"{msg}\n")

    def _refuse(self, status: int, reason: str, sentence: str) -> None:
        """Answers outside of the protocol's state, which need not allow for an answer, and ends.

        Closing at once would reset the connection of a client that still sends, and with it what
        the client has not read: so it is read for a moment longer, and thrown away.
        """
        self._is_refused = True
        if self._has_begun():
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self.transport.write(
            f"HTTP/1.1 {status} {reason}\r\ncontent-type: text/plain; charset=utf-8\r\n"
            f"content-length: {len(sentence)}\r\nconnection: close\r\n\r\n{sentence}".encode()
        )
        # Later it would be tried on a peer that may be gone by then, which raises.
        if not self.transport.get_write_buffer_size():
            with suppress(OSError):
                self.transport.write_eof()
        self.loop.call_later(LINGER_S, self.transport.abort)


def _bound_the_system(transport: asyncio.Transport) -> None:
    """Has the system keep little of what was sent, and give up a peer that acknowledges nothing.

    Unasked Linux keeps megabytes for each client that does not read, and waits 15 minutes for one
    that lost its power or its network.
    """
    connected = transport.get_extra_info("socket")
    if connected is None:
        return
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KEPT_BYTES)
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(UNREAD_S * 1000))

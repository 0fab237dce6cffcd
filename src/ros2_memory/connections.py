"""Bounds on HTTP connections: how many there are, and how long one may keep the server waiting.

Uvicorn waits for the rest of a request for as long as the client likes, and for a client to read
its reply likewise. A few hundred clients that do neither would take all file descriptors.
"""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Final, Literal

from uvicorn.protocols.http.h11_impl import H11Protocol

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

_Phase = Literal["head", "body", "reply"]


class BoundedConnection(H11Protocol):
    """Uvicorn's HTTP/1.1 over one connection, which ends when the client takes too long.

    A request that does not come to its end is answered with 408, a connection too many with 503;
    a reply that is not read ends the connection, which ends the call or the event stream with it.
    """

    _phase: _Phase = "reply"
    _deadline: asyncio.TimerHandle | None = None
    _unread: asyncio.TimerHandle | None = None
    _is_refused = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        """A client has connected."""
        super().connection_made(transport)
        # Zero: any unsent byte counts as unread, and none is kept for long.
        transport.set_write_buffer_limits(high=0)
        _bound_the_system(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            self._refuse(503, "Service Unavailable", "Too many connections; close some.\n")
            return
        self._watch()

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
            self._refuse(408, "Request Timeout", "The request did not come to its end in time.\n")

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

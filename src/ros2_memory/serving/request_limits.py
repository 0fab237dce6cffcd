"""Bounds on requests: how much of them is read, and how long a call runs for a client that left.

A body is read whole before anything parses it, and is so small that parsing it holds up nobody. A
call is cancelled when its client leaves. A client that does not read the replies it has is
disconnected after some time (`connection_limits.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import anyio
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES: Final = 128 << 10
"""Several times the largest arguments. Parsing it takes some hundredths of a second, in which the
event loop serves no client; all connections together hold 32 MiB at most."""

_TOO_LARGE: Final = PlainTextResponse(
    f"The request is larger than {MAX_BODY_BYTES} bytes.\n", status_code=413
)


@dataclass
class RequestLimits:
    """Reads requests for an application, and cancels it where nobody waits for its reply."""

    _app: ASGIApp

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        if scope["method"] not in {"POST", "PUT", "PATCH"}:
            await self._app(scope, receive, _once(send))
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
            is_last = message["type"] == "http.response.body" and not message.get("more_body")
            is_complete = is_complete or is_last
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


def _once(send: Send) -> Send:
    """Returns a `send` that takes a second response for the end of the first.

    When the server stops, the MCP library leaves an event stream open, and answers once more.
    """
    has_begun = has_ended = False

    async def send_first(message: Message) -> None:
        nonlocal has_begun, has_ended
        if has_begun and message["type"] == "http.response.start":
            has_ended = True
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        has_begun = True
        if not has_ended:
            await send(message)

    return send_first

"""Gives each conversation over streamable HTTP a name, for clients that go by one.

The transport lets a server name a session in its answer to `initialize`, and clients then send that
name along (MCP specification, streamable HTTP, session management). Nothing is kept under it here:
a call needs no earlier one, so names of before a restart, of another server, or none at all are
answered alike, and a thousand clients that never say goodbye cost nothing.
"""

from __future__ import annotations

import uuid
from typing import TYPE_CHECKING, Final

from starlette.datastructures import MutableHeaders

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PATH: Final = "/mcp"
HEADER: Final = "mcp-session-id"
_BEGINS: Final = b'"initialize"'
_OK: Final = 200


class SessionIds:
    """Adds a name to the answer where a conversation begins and the client has none yet."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        named = scope["type"] != "http" or scope["path"] != PATH or scope["method"] != "POST"
        if named or any(name == HEADER.encode() for name, _ in scope["headers"]):
            await self._app(scope, receive, send)
            return
        begins = False

        async def hear() -> Message:
            nonlocal begins
            message = await receive()
            # It is short: more than the first piece of a body never has to be looked at.
            begins = begins or _BEGINS in message.get("body", b"")
            return message

        async def say(message: Message) -> None:
            if begins and message["type"] == "http.response.start" and message["status"] == _OK:
                MutableHeaders(scope=message)[HEADER] = uuid.uuid4().hex
            await send(message)

        await self._app(scope, hear, say)

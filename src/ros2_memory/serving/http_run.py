"""Runs a built server over HTTP, until it is stopped."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio
import uvicorn

from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.sd_notify import READY, STOPPING, notify
from ros2_memory.serving.auth import MCP_PATH
from ros2_memory.serving.connection_limits import ACCEPTED_AT_ONCE, BoundedConnection
from ros2_memory.serving.listen import BACKLOG, Address, listen
from ros2_memory.serving.web_app import STREAM_PATH

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from starlette.types import ASGIApp

    from ros2_memory.serving.dispatch import Dispatcher

log = get_logger("ros2_memory.server")


def serve_http(
    app: ASGIApp,
    at: Address,
    dispatcher: Dispatcher,
    when_listening: Callable[[str], None] | None,
) -> None:
    """Serves over HTTP until a signal comes; `when_listening` is called with the site's address.

    Raises:
        CannotListenError: the address cannot be listened on.
    """
    config = uvicorn.Config(
        app,
        http=BoundedConnection,
        backlog=ACCEPTED_AT_ONCE,
        lifespan="on",
        ws="none",
        log_config=None,
        log_level="warning",
        # It would show whatever a client puts into a query string.
        access_log=False,
        timeout_graceful_shutdown=1,
    )
    anyio.run(_Listener(config, dispatcher, when_listening).serve, [listen(at)])


class _Listener(uvicorn.Server):
    """Runs uvicorn, and ends the queries when it stops; event streams end by themselves then."""

    def __init__(
        self,
        config: uvicorn.Config,
        dispatcher: Dispatcher,
        when_listening: Callable[[str], None] | None,
    ) -> None:
        super().__init__(config)
        self._dispatcher = dispatcher
        self._when_listening = when_listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listener in sockets or []:
            # More connections may wait than are accepted at once.
            listener.listen(BACKLOG)
            host, port = listener.getsockname()[:2]
            shown = f"[{host}]" if ":" in host else host
            site = f"http://{shown}:{port}"
            log.info(
                "listening",
                url=f"{site}{STREAM_PATH}",
                mcp_url=f"{site}{MCP_PATH}",
                host=host,
                port=port,
            )
            if self._when_listening is not None:
                self._when_listening(site)
        notify(READY)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        notify(STOPPING)
        self._dispatcher.stop()
        await super().shutdown(sockets)

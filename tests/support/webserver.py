"""An application behind the server's own connections, on a real socket, within a test."""

from __future__ import annotations

import asyncio
import socket
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final, Literal

import uvicorn

from ros2_memory.serving.connection_limits import (
    ACCEPTED_AT_ONCE,
    BoundedConnection,
)
from tests.support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

BOUND_S: Final = PATIENCE_S
"""No test waits longer for what it expects."""


@asynccontextmanager
async def listening(
    app: Any, lifespan: Literal["on", "off"] = "off"
) -> AsyncIterator[uvicorn.Server]:
    """The running server; the socket's port is any that is free."""
    config = uvicorn.Config(
        app,
        http=BoundedConnection,
        backlog=ACCEPTED_AT_ONCE,
        lifespan=lifespan,
        ws="none",
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as bound:
        task = asyncio.create_task(server._serve([bound]))
        async with asyncio.timeout(BOUND_S):
            while not server.started:
                await asyncio.sleep(0.001)
        try:
            yield server
        finally:
            server.should_exit = True
            server.force_exit = True
            await task

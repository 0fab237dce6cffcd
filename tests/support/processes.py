"""Waiting for something that a process is about to do: for as long as it takes, up to a bound."""

import asyncio
import socket
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Literal, TypeVar

import uvicorn

from ros2_memory.serving.connection_limits import (
    ACCEPTED_AT_ONCE,
    BoundedConnection,
)

T = TypeVar("T")

PATIENCE_S = 180.0
"""How long any condition is waited for, and any program to end, before it counts as vain.

No promise of the product: where all is well nobody waits for so long, and a machine that has more
to do than it has processors may need most of it to start one program.
"""
LONGEST_PAUSE_S = 0.05
"""Between two looks at a condition that is waited for."""


def until(
    what: Callable[[], T | None],
    name: str = "",
    *,
    timeout_s: float = PATIENCE_S,
    alive: subprocess.Popen[bytes] | None = None,
) -> T:
    """The first result of `what` that is neither None nor False.

    Args:
        what: is asked again and again.
        name: what the error calls it.
        timeout_s: how long it may take.
        alive: what must run meanwhile.

    Raises:
        AssertionError: there was none within the timeout, or before that ended.
    """
    give_up, pause_s = time.monotonic() + timeout_s, 0.01
    while True:
        found = what()
        if found is not None and found is not False:
            return found
        assert alive is None or alive.poll() is None, f"it ended before {name}"
        assert time.monotonic() < give_up, f"waited {timeout_s:g} s in vain for {name or what}"
        time.sleep(pause_s)
        # Asking takes processor time, often of the very program that is waited for.
        pause_s = min(1.2 * pause_s, LONGEST_PAUSE_S)


@contextmanager
def http_server(handler: Callable[..., BaseHTTPRequestHandler]) -> Iterator[str]:
    """Serves what a handler answers; yields the address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def service_manager(address: Path) -> Iterator[socket.socket]:
    """The socket of a service manager, from which what it is told can be received."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(address))
        manager.settimeout(PATIENCE_S)
        yield manager


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
        async with asyncio.timeout(PATIENCE_S):
            while not server.started:
                await asyncio.sleep(0.001)
        try:
            yield server
        finally:
            server.should_exit = True
            server.force_exit = True
            await task

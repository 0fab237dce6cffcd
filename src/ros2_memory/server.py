"""`ros2-memory-server`: the query server, over stdio or over HTTP.

In stdio mode stdout is the wire, so nothing else is ever written there; logs go to stderr.
"""

from __future__ import annotations

import argparse
import errno
import logging
import os
import signal
import socket
import sys
import threading
from functools import partial
from typing import TYPE_CHECKING, Final, NoReturn

import anyio
import uvicorn

from ros2_memory.bootstrap import build_filler, build_memory, build_server, package_version
from ros2_memory.config import exit_on_config_error, load_settings
from ros2_memory.filling import keep_filled
from ros2_memory.health import health, keep_fresh
from ros2_memory.http import STREAM_PATH, web_app
from ros2_memory.logs import configure_logging, get_logger
from ros2_memory.recorder.notify import READY, STOPPING, ServiceManager

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

    from ros2_memory.dispatch import EpisodicServer
    from ros2_memory.filling import Filler
    from ros2_memory.http import Background, WebApp
    from ros2_memory.memory import Memory
    from ros2_memory.settings import ServerSettings

PROGRAM: Final = "ros2-memory-server"
CANNOT_LISTEN: Final = 1

_BACKLOG: Final = 128
_THREADS_END_S: Final = 0.2

log = get_logger("ros2_memory.server")


class CannotListenError(Exception):
    """The address cannot be listened on; the sentence says why and what to do."""


def main(argv: Sequence[str] | None = None) -> int:
    """Serves until it is told to stop, and returns the exit code.

    0: stopped by SIGTERM, SIGINT or the end of stdin; 1: the address cannot be listened on; 2: the
    configuration or the command line is refused.
    """
    overrides: list[str] = _parser().parse_args(argv).overrides
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _stopped)
    with exit_on_config_error(PROGRAM):
        settings = load_settings(overrides)
        configure_logging(settings.logging.level, settings.logging.format)
        memory = build_memory(settings)
        server = build_server(settings, memory)
    filler = build_filler(settings, memory)
    background = partial(_in_background, memory, filler, settings.reader.index_refresh_s, overrides)
    log.info(
        "starting",
        version=package_version(),
        bag_dir=str(settings.recording.bag_dir.absolute()),
        transport=settings.server.transport,
    )
    code = 0
    try:
        if settings.server.transport == "stdio":
            anyio.run(_serve_stdio, server, background)
        else:
            app = web_app(
                server,
                host=settings.server.host,
                health=partial(health, memory, package_version(), filler),
                background=background,
            )
            _serve_http(server, app, settings.server)
    except CannotListenError as error:
        sys.stderr.write(f"{PROGRAM}: {error}\n")
        code = CANNOT_LISTEN
    except SystemExit:
        log.info("stopped")
    server.dispatcher.stop()
    return _left(code)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Answers questions about a robot's past, from its bags, over MCP.",
        epilog="Environment: MCP_TRANSPORT (stdio, sse), MCP_HOST, MCP_PORT, MEMORY_BAG_DIR, "
        "MEMORY_DEPLOYMENT, MEMORY_CONFIG_DIR, MEMORY_CONFIG_OVERRIDES, "
        "ROS_VISION_INTERFACES_PATH.",
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="key=value",
        help="settings that take precedence over the configuration, e.g. server.transport=sse",
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {package_version()}")
    return parser


def _stopped(_number: int, _frame: FrameType | None) -> NoReturn:
    """Stopping is what was asked for: exit code 0."""
    raise SystemExit(0)


def _left(code: int) -> int:
    """The exit code, for a program whose threads are done.

    A thread that waits for stdin, or scans a large directory, cannot be told to stop; the
    interpreter would wait for it. Nothing is lost with it: bags are only read.
    """
    others = [
        thread
        for thread in threading.enumerate()
        if thread is not threading.current_thread() and not thread.daemon
    ]
    for thread in others:
        thread.join(_THREADS_END_S / len(others))
    if any(thread.is_alive() for thread in others):
        logging.shutdown()
        sys.stderr.flush()
        os._exit(code)
    return code


async def _in_background(
    memory: Memory, filler: Filler, every_s: float, overrides: Sequence[str]
) -> None:
    """Keeps the index fresh and the catalogue full, until it is cancelled."""
    program = [sys.executable, "-m", "ros2_memory.cli", "index"]
    helper = [*program, "--for-server", str(os.getpid()), "--", *overrides]
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(keep_fresh, memory, every_s)
        tasks.start_soon(keep_filled, filler, helper, every_s)


async def _serve_stdio(server: EpisodicServer, background: Background) -> None:
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(background)
        await server.run_stdio_async()
        tasks.cancel_scope.cancel()


def _serve_http(server: EpisodicServer, app: WebApp, at: ServerSettings) -> None:
    config = uvicorn.Config(
        app,
        lifespan="on",
        ws="none",
        log_config=None,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=1,
    )
    listening = _bound(at.host, at.port)
    anyio.run(_Listener(config, server, app).serve, [listening])


class _Listener(uvicorn.Server):
    """Uvicorn, with an end to the event streams and the queries when it stops."""

    def __init__(self, config: uvicorn.Config, server: EpisodicServer, app: WebApp) -> None:
        super().__init__(config)
        self._server = server
        self._app = app

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for each in sockets or []:
            host, port = each.getsockname()[:2]
            shown = f"[{host}]" if ":" in host else host
            log.info("listening", url=f"http://{shown}:{port}{STREAM_PATH}", host=host, port=port)
        ServiceManager().tell(READY)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        ServiceManager().tell(STOPPING)
        self._server.dispatcher.stop()
        self._app.stop()
        await super().shutdown(sockets)


def _bound(host: str, port: int) -> socket.socket:
    """A socket that listens; a name that has addresses of both kinds stands for its IPv4 one.

    Raises:
        CannotListenError: the address is in use, not this machine's, or not allowed.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, *_, address = min(found, key=lambda each: each[0] is not socket.AF_INET)
        listening = socket.create_server(address[:2], family=family, backlog=_BACKLOG)
    except OSError as error:
        raise CannotListenError(_why_not(host, port, error)) from error
    # asyncio sets this on sockets of its own making only. Accepted ones inherit it; without it each
    # reply on a kept connection waits 40 ms for the client's delayed acknowledgement.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listening


def _why_not(host: str, port: int, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"port {port} on {host} is in use by another program; "
            "stop that one, or choose another port with MCP_PORT"
        )
    if error.errno == errno.EACCES:
        return f"port {port} on {host} is not allowed; choose one from 1024 up with MCP_PORT"
    return (
        f"{host} port {port} cannot be listened on ({error.strerror or error}); "
        "give an address of this machine with MCP_HOST"
    )


if __name__ == "__main__":
    sys.exit(main())

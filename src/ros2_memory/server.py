"""`ros2-memory-server`: the query server, over stdio or over HTTP.

Parses the command line, loads the configuration, builds the server and serves. Calls are dispatched
in `serving/dispatch.py`. Over stdio, stdout carries the protocol, so nothing else is ever written
there; logs go to stderr.

Importing what serves (MCP's SDK above all) takes most of a start, so the functions import what they
need, and the bags are looked at meanwhile.
"""
# ruff: noqa: PLC0415 - as the docstring says

from __future__ import annotations

import argparse
import gc
import logging
import os
import signal
import sys
import threading
from functools import cache, partial
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory import package_version
from ros2_memory.core.logging_setup import configure_logging, get_logger
from ros2_memory.core.malloc import share_one_arena
from ros2_memory.core.text import counted
from ros2_memory.serving.listen import Address, CannotListenError, resolve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from starlette.routing import Route

    from ros2_memory.config import Settings
    from ros2_memory.core.telemetry import Telemetry
    from ros2_memory.fleet.robots import Fleet, Robot
    from ros2_memory.history.context import Memory
    from ros2_memory.serving.auth import Tokens
    from ros2_memory.serving.backfill import Backfill
    from ros2_memory.serving.health import FleetHealth, Health
    from ros2_memory.serving.mcp_server import EpisodicServer
    from ros2_memory.serving.web_app import Background

PROGRAM: Final = "ros2-memory-server"
CANNOT_LISTEN: Final = 1

_THREADS_END_S: Final = 0.2
_LAKE_LOOKED_AT_S: Final = 30.0
"""Twice as often as a question would look itself."""

_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY")

log = get_logger("ros2_memory.server")


def main(argv: Sequence[str] | None = None) -> int:
    """Serves until a signal or the end of stdin, and returns the exit code.

    0: stopped by SIGTERM, SIGINT or the end of stdin; 1: the address cannot be listened on; 2: the
    configuration or the command line is refused, or a token is missing where there must be one.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(0))
    given = _parser().parse_args(argv)
    share_one_arena()
    gc.disable()  # until the server is built: imports make many objects, and no garbage
    try:
        _run(given.overrides, given.page)
    except CannotListenError as error:
        sys.stderr.write(f"{PROGRAM}: {error}\n")
        return _end_threads(CANNOT_LISTEN)
    return _end_threads(0)


def _run(overrides: Sequence[str], page: str | None = None) -> None:
    """Loads the configuration, builds the server, and serves.

    `page` tells whether to `print` the address of the page, or to `open` it, too.

    Raises:
        CannotListenError: the address cannot be listened on.
        SystemExit: the configuration is refused.
    """
    from ros2_memory.bootstrap import build_memory, build_telemetry
    from ros2_memory.bootstrap_fleet import build_fleet
    from ros2_memory.config import exit_on_config_error, load_settings

    with exit_on_config_error(PROGRAM):
        settings = load_settings(overrides)
        configure_logging(
            settings.logging.level, settings.logging.format, arguments=settings.logging.arguments
        )
        # Before anything is built, so that a refusal comes at once.
        address: Address | None = None
        tokens: Tokens = {}
        if settings.server.transport != "stdio":
            from ros2_memory.serving.auth import take_tokens

            address = resolve(settings.server.host, settings.server.port)
            tokens = take_tokens(os.environ, settings.fleet.tokens, address)
        memory = build_memory(settings)
        telemetry = build_telemetry(settings, memory)
        fleet = build_fleet(settings)
    _log_start(settings, fleet)
    if fleet is None:
        parts = _parts_of_one(settings, memory, telemetry, overrides)
    else:
        parts = _parts_of_fleet(settings, memory, fleet, telemetry, overrides)
    gc.freeze()
    gc.enable()
    try:
        if address is None:
            import anyio

            anyio.run(_serve_stdio, parts)
        else:
            _serve_http(address, tokens, parts, telemetry, page)
    except SystemExit:
        log.info("stopped")
    finally:
        parts.server.dispatcher.stop()
        parts.health.stop()
        telemetry.stop()


def _log_start(settings: Settings, fleet: Fleet | None) -> None:
    from ros2_memory.config import files_in_use, unused_config

    bag_dir = str(settings.recording.bag_dir.absolute())
    if fleet is not None:
        bag_dir = f"those of {counted(len(fleet.robots), 'robot')}"
    log.info(
        "starting",
        version=package_version(),
        bag_dir=bag_dir,
        transport=settings.server.transport,
        files=files_in_use(settings),
    )
    if unused := unused_config():
        log.warning("config_unused", reason=unused)


def _serve_http(
    address: Address, tokens: Tokens, parts: _Parts, telemetry: Telemetry, page: str | None
) -> None:
    """Serves over HTTP until a signal comes.

    Raises:
        CannotListenError: the address cannot be listened on.
    """
    from ros2_memory.serving.web_app import serve_http, web_app

    app = web_app(
        parts.server,
        host=address.host,
        health=parts.health,
        background=parts.background,
        tokens=tokens,
        metrics=telemetry.metrics,
        page=parts.page,
    )
    show_page = None if page is None or parts.page is None else partial(_show_page, page)
    serve_http(app, address, parts.server.dispatcher, show_page)


def _show_page(how: str, site: str) -> None:
    """Prints the address of the page; opens it if somebody sits at a display."""
    sys.stdout.write(f"the page of this memory: {site}/\n")
    sys.stdout.flush()
    has_display = sys.platform in {"darwin", "win32"} or any(map(os.environ.get, _DISPLAYS))
    if how == "open" and has_display and sys.stdout.isatty():
        import webbrowser

        threading.Thread(target=webbrowser.open, args=(f"{site}/",), daemon=True).start()


class _Parts(NamedTuple):
    """The parts of a server that differ between one robot and a fleet.

    Attributes:
        server: answers MCP.
        health: reports for `/health`.
        background: keep indexes fresh and stores full, until they are cancelled.
        page: the routes of the page's data; None without a page.
    """

    server: EpisodicServer
    health: Health | FleetHealth
    background: Sequence[Background]
    page: Sequence[Route] | None


def _parts_of_one(
    settings: Settings, memory: Memory, telemetry: Telemetry, overrides: Sequence[str]
) -> _Parts:
    """Returns the parts of one robot's server, and begins to scan its bags meanwhile."""
    from ros2_memory.serving.health import Health, keep_fresh, refresh_logged

    threading.Thread(target=refresh_logged, args=(memory,), name="first scan").start()
    from ros2_memory.bootstrap import build_backfill, build_server
    from ros2_memory.serving.backfill import keep_backfilled

    backfill = build_backfill(settings, memory)
    backfill.helper = _helper_command(overrides)
    server = build_server(settings, memory, telemetry, backfill.progress)
    every_s, page = settings.reader.index_refresh_s, None
    if settings.server.transport != "stdio" and settings.server.page:
        from ros2_memory.serving.page.routes import page_routes

        page = page_routes(server.dispatcher, backfill.progress)

    background = (
        partial(keep_fresh, memory, every_s),
        partial(keep_backfilled, backfill, every_s),
    )
    return _Parts(server, Health(memory, backfill), background, page)


def _parts_of_fleet(
    settings: Settings,
    memory: Memory,
    fleet: Fleet,
    telemetry: Telemetry,
    overrides: Sequence[str],
) -> _Parts:
    """Returns the parts of a fleet's server. It has no page, which shows one robot."""
    from ros2_memory.bootstrap import build_backfill, build_server
    from ros2_memory.bootstrap_fleet import hidden_topics, robot_settings
    from ros2_memory.serving.backfill import keep_all_backfilled
    from ros2_memory.serving.health import FleetHealth, Health

    @cache
    def backfill_of(name: str) -> Backfill:
        robot = fleet.robots[name]
        backfill = build_backfill(robot_settings(settings, name), robot.memory)
        # The helper reads all of the bags in a bag directory, and no lake.
        if not (robot.in_lake or hidden_topics(settings, name)):
            options = "--bag-dir", str(robot.memory.bag_dir.absolute())
            backfill.helper = _helper_command(overrides, *options)
        return backfill

    def all_backfills() -> list[Backfill]:
        return [*map(backfill_of, [*fleet.robots])]  # more robots may have joined

    reports: dict[str, Health] = {}
    for name in settings.fleet.robots:  # the others have bags in the lake alone
        robot = fleet.robots[name]
        bags = robot.own or robot.memory
        reports[name] = Health(bags, backfill_of(name))

    every_s = settings.reader.index_refresh_s
    background = (
        partial(keep_fleet_fresh, fleet, every_s),
        partial(keep_all_backfilled, all_backfills, every_s),
    )
    server = build_server(settings, memory, telemetry, fleet=fleet)
    return _Parts(server, FleetHealth(reports), background, None)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Answers questions about a robot's past, from its bags, over MCP.",
        epilog="Environment: MCP_TRANSPORT (stdio, sse), MCP_HOST, MCP_PORT, MEMORY_BAG_DIR, "
        "MEMORY_DEPLOYMENT, MEMORY_CONFIG_DIR, MEMORY_CONFIG_OVERRIDES, "
        "ROS_VISION_INTERFACES_PATH, MEMORY_API_TOKEN or MEMORY_API_TOKEN_FILE.",
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="key=value",
        help="settings that take precedence over the configuration, e.g. server.transport=sse",
    )
    parser.add_argument("--page", choices=("print", "open"), help=argparse.SUPPRESS)
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {package_version()}")
    return parser


def _end_threads(code: int) -> int:
    """Returns the exit code; ends the process with it if a thread goes on.

    A thread that waits for stdin, or scans a large directory, cannot be stopped, and the
    interpreter would wait for it. Ending it loses nothing: bags are only read.
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


def _helper_command(overrides: Sequence[str], *options: str) -> list[str]:
    """Returns the command line of the program that stores a backlog of bags as columns."""
    program = [sys.executable, "-P", "-m", "ros2_memory.cli", "index"]
    return [*program, "--for-server", str(os.getpid()), *options, "--", *overrides]


async def keep_fleet_fresh(fleet: Fleet, every_s: float, lake_s: float = _LAKE_LOOKED_AT_S) -> None:
    """Looks for new bags of each robot and, every `lake_s` seconds, for new robots in the lake.

    Runs until it is cancelled. If the disk of one robot hangs, the others are still scanned.
    """
    import anyio

    from ros2_memory.serving.health import keep_fresh

    # A thread for each scan that may hang, and one to look for new robots.
    limiter = anyio.CapacityLimiter(1)
    async with anyio.create_task_group() as tasks:
        robots: Sequence[Robot] = [*fleet.robots.values()]
        while True:
            limiter.total_tokens += 2 * len(robots)
            for robot in robots:
                in_bag_dir = robot.own if robot.in_lake else robot.memory
                if in_bag_dir is not None:
                    tasks.start_soon(keep_fresh, in_bag_dir, every_s, limiter)
                if robot.in_lake:
                    tasks.start_soon(keep_fresh, robot.memory, lake_s, limiter)
            if fleet.join is None:
                return
            await anyio.sleep(lake_s)
            robots = await anyio.to_thread.run_sync(
                _add_shipped, fleet, abandon_on_cancel=True, limiter=limiter
            )


def _add_shipped(fleet: Fleet) -> Sequence[Robot]:
    """Adds the robots that were shipped since, and returns them; logs an error of the lake."""
    from ros2_memory.core.errors import EpisodicError

    try:
        robots = fleet.add_shipped()
    except EpisodicError as error:
        log.warning("lake_not_looked_at", reason=str(error))
        return ()
    if robots:
        log.info("robots_joined", robots=[robot.name for robot in robots])
    return robots


async def _serve_stdio(parts: _Parts) -> None:
    import anyio

    async with anyio.create_task_group() as tasks:
        for keep in parts.background:
            tasks.start_soon(keep)
        await parts.server.run_stdio_async()
        tasks.cancel_scope.cancel()


if __name__ == "__main__":
    sys.exit(main())

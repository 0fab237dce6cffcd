"""The web application, and how it is run: `/sse` with `/messages/`, `/mcp`, `/health` and others.

`/health` is 200 while the server answers; `/health/recording` is 503 unless the recorder records.
"""

from __future__ import annotations

import uuid
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

import anyio
import anyio.to_thread
import uvicorn
from mcp.server.transport_security import TransportSecuritySettings
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.sd_notify import READY, STOPPING, notify
from ros2_memory.serving.auth import (
    HEALTH_PATH,
    MCP_PATH,
    RECORDING_PATH,
    ForgeryGuard,
    TokenGate,
    access_of,
)
from ros2_memory.serving.connection_limits import (
    ACCEPTED_AT_ONCE,
    BoundedConnection,
    RequestLimits,
)
from ros2_memory.serving.listen import BACKLOG, Address, listen
from ros2_memory.serving.page import Page

if TYPE_CHECKING:
    import socket
    from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence

    from mcp.server.mcpserver import MCPServer
    from mcp.server.streamable_http_manager import StreamableHTTPSessionManager
    from starlette.requests import Request
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from ros2_memory.core.reply import JsonObject
    from ros2_memory.core.telemetry import Exposition
    from ros2_memory.serving.auth import Tokens
    from ros2_memory.serving.dispatch import Dispatcher

log = get_logger("ros2_memory.server")

Background: TypeAlias = "Callable[[], Coroutine[object, object, None]]"

STREAM_PATH: Final = "/sse"
METRICS_PATH: Final = "/metrics"
THREADS: Final = 4
"""For work in the background, such as scans. anyio keeps an idle thread for a while."""

_SESSION_HEADER: Final = "mcp-session-id"
_INITIALIZE: Final = b'"initialize"'
_PROGRESS: Final = b'"progressToken"'
_EVENTS: Final = "text/event-stream"
_OK: Final = 200
_UNAVAILABLE: Final = 503


def _recording_response(report: JsonObject, *, shows_details: bool) -> JSONResponse:
    """Returns 200 if the recorder records, by the report of `/health`; else 503.

    Also 503 while a topic of `recording.required` is not recorded as required, or a rule of
    `recording.exclude_when` cannot be evaluated: then recorded data is withheld, or served against
    the rule. Other topics that are offered and not recorded are in `degraded`.
    """
    reported = report.get("recorder")
    recorder = reported if isinstance(reported, dict) else {}
    faults = {key: recorder.get(key) or [] for key in ("failing_rules", "required_missing")}
    is_live, state = recorder.get("live", False), recorder.get("state")
    recording = is_live is True and state == "recording" and not any(faults.values())
    shown: JsonObject = {"recording": recording}
    if shows_details:
        shown |= {
            "recorder": state,
            "recorder_alive": is_live,
            "waiting_for": recorder.get("waiting_for"),
            **faults,
            "degraded": recorder.get("degraded") or [],
        }
    return JSONResponse(shown, _OK if recording else _UNAVAILABLE)


def web_app(
    server: MCPServer[object],
    *,
    host: str,
    health: Callable[[], Awaitable[JsonObject]],
    background: Sequence[Background] = (),
    tokens: Tokens | None = None,
    metrics: Callable[[], Awaitable[Exposition]] | None = None,
    page: Sequence[Route] | None = (),
) -> ASGIApp:
    """Returns the application that listens on `host`.

    Args:
        server: answers `/sse`, `/messages/` and `/mcp`.
        host: the name or address that it listens on.
        health: returns the report of `/health`.
        background: run from start to end of the application, and are cancelled then.
        tokens: one is demanded of every request, if there are any. Requests without it see only
            the status of `/health`, and the page, which holds no data and asks for it.
        metrics: returns the text of `/metrics`; without it there is no such path.
        page: the routes of the page's data; None for a server without a page.
    """
    # `ForgeryGuard` checks all routes instead, and knows the addresses of a host such as 0.0.0.0.
    unguarded = TransportSecuritySettings(enable_dns_rebinding_protection=False)
    streams = server.sse_app(sse_path=STREAM_PATH, transport_security=unguarded)
    plain = _session_manager(server, unguarded, json_response=True)
    streaming = _session_manager(server, unguarded, json_response=False)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
        async with plain.run(), streaming.run(), anyio.create_task_group() as tasks:
            for keep in background:
                tasks.start_soon(keep)
            yield
            tasks.cancel_scope.cancel()

    routes = [
        *streams.routes,
        Route(MCP_PATH, McpEndpoint(plain.handle_request, streaming.handle_request)),
        *_health_routes(health),
        *(page or ()),
    ]
    if metrics is not None:
        routes.append(_metrics_route(metrics))
    app: ASGIApp = RequestLimits(Starlette(routes=routes, lifespan=lifespan))
    if tokens:
        app = TokenGate(app, tokens)
    if page is not None:
        # The page comes before the token: it holds no data, and asks for the token.
        app = Page(app)
    return ForgeryGuard(app, host, admits=not tokens)


def _health_routes(health: Callable[[], Awaitable[JsonObject]]) -> list[Route]:
    """Returns `/health` and `/health/recording`; without a token they show a status alone."""

    async def show_health(request: Request) -> JSONResponse:
        report = await health()
        # Enough for a monitor that only watches that the server is up.
        is_admitted = access_of(request.scope) is not None
        return JSONResponse(report if is_admitted else {"status": report["status"]})

    async def show_recording(request: Request) -> JSONResponse:
        return _recording_response(
            await health(), shows_details=access_of(request.scope) is not None
        )

    return [
        Route(HEALTH_PATH, show_health, methods=["GET"]),
        Route(RECORDING_PATH, show_recording, methods=["GET"]),
    ]


def _metrics_route(metrics: Callable[[], Awaitable[Exposition]]) -> Route:
    async def show_metrics(_request: Request) -> Response:
        exposition = await metrics()
        return Response(exposition.body, headers={"content-type": exposition.content_type})

    return Route(METRICS_PATH, show_metrics, methods=["GET"])


def _session_manager(
    server: MCPServer[object], security: TransportSecuritySettings, *, json_response: bool
) -> StreamableHTTPSessionManager:
    """Returns a handler of streamable HTTP that keeps no sessions."""
    server.streamable_http_app(
        stateless_http=True, json_response=json_response, transport_security=security
    )
    # The call above has made it: the library keeps the newest one alone.
    return server.session_manager


@dataclass
class McpEndpoint:
    """Answers streamable HTTP: by JSON, or by an event stream if a client wants progress.

    A reply by JSON is one message, so notifications have no place in it. `RequestLimits` has read
    the body, so the first message holds all of it.

    It names a session in its reply to `initialize`, for clients that require one; they send that
    name along then (MCP specification, streamable HTTP, session management). Nothing is stored
    under it: a call needs no earlier one, and any name or none is answered alike.
    """

    _plain: ASGIApp
    _streaming: ASGIApp

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        if scope["method"] != "POST":
            await self._plain(scope, receive, send)
            return
        headers = Headers(scope=scope)
        unread = [await receive()]
        body = unread[0].get("body", b"")
        begins_session = _SESSION_HEADER not in headers and _INITIALIZE in body

        async def receive_again() -> Message:
            return unread.pop() if unread else await receive()

        async def send_with_session(message: Message) -> None:
            is_start = message["type"] == "http.response.start"
            if begins_session and is_start and message["status"] == _OK:
                MutableHeaders(scope=message)[_SESSION_HEADER] = uuid.uuid4().hex
            await send(message)

        wants_progress = _EVENTS in headers.get("accept", "") and _PROGRESS in body
        app = self._streaming if wants_progress else self._plain
        await app(scope, receive_again, send_with_session)


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

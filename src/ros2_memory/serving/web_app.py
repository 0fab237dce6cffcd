"""The one web application: `/sse` with `/messages/`, `/mcp`, `/health` and a page, on one port."""

from __future__ import annotations

import ipaddress
import socket
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final, TypeAlias
from urllib.parse import urlsplit

import anyio
import anyio.to_thread
from mcp.server.transport_security import TransportSecuritySettings
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from ros2_memory.core.logging_setup import Refusals, get_logger
from ros2_memory.serving.auth import ADMITTED, HEALTH_PATH, TokenGate, admit
from ros2_memory.serving.page import PAGE_PATH, Page
from ros2_memory.serving.request_limits import RequestLimits
from ros2_memory.serving.session_ids import SessionIds

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine

    from mcp.server.mcpserver import MCPServer
    from starlette.requests import Request
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from ros2_memory.core.telemetry import Exposition
    from ros2_memory.tools.reply_size import JsonObject

log = get_logger(__name__)

Background: TypeAlias = "Callable[[], Coroutine[object, object, None]]"

STREAM_PATH: Final = "/sse"
METRICS_PATH: Final = "/metrics"
GRACE_S: Final = 0.4
"""How long requests under way may still take when the server stops; event streams end at once."""

THREADS: Final = 4
"""For what nobody asked, such as a look at the bags. One that was needed once stays a while."""

_LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_SAME_SITE: Final = frozenset({"same-origin", "none"})
"""Of Sec-Fetch-Site: a page of this server, or no page at all."""
_ANY_ADDRESS: Final = frozenset({"0.0.0.0", "::", ""})  # noqa: S104 - only compared with


def web_app(
    server: MCPServer[object],
    *,
    host: str,
    health: Callable[[], Awaitable[JsonObject]],
    background: Background,
    api_token: str | None = None,
    metrics: Callable[[], Awaitable[Exposition]] | None = None,
) -> WebApp:
    """The application that listens on `host`.

    `background` runs from start to end of the application, and is cancelled then. `metrics` gives
    what `/metrics` shows; without it there is no such path. `api_token` is demanded of every
    request; without it `/health` shows its status alone, and on the loopback address the page is
    shown, which asks for it.
    """
    # `Guard` stands before all routes, and knows the addresses of a host such as 0.0.0.0.
    guarded = TransportSecuritySettings(enable_dns_rebinding_protection=False)
    streams = server.sse_app(sse_path=STREAM_PATH, transport_security=guarded)
    requests = server.streamable_http_app(
        stateless_http=True, json_response=True, transport_security=guarded
    )

    async def show_health(request: Request) -> JSONResponse:
        told = await health()
        if api_token is not None and not request.scope.get(ADMITTED, False):
            # Enough for whoever only watches that the server is up.
            told = {"status": told["status"]}
        return JSONResponse(told)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
        async with server.session_manager.run(), anyio.create_task_group() as tasks:
            tasks.start_soon(background)
            yield
            tasks.cancel_scope.cancel()

    routes = [*streams.routes, *requests.routes, Route(HEALTH_PATH, show_health, methods=["GET"])]
    if metrics is not None:
        routes.append(Route(METRICS_PATH, _showing(metrics), methods=["GET"]))
    app: ASGIApp = RequestLimits(SessionIds(Starlette(routes=routes, lifespan=lifespan)))
    if host.lower() not in _LOOPBACK:
        app = Page(app)
    if api_token is not None:
        app = TokenGate(app, api_token)
    if host.lower() in _LOOPBACK:
        # It holds no data, and a browser cannot show a token before it has a page to ask for it.
        # Where others can reach the server, the token comes first nevertheless.
        app = Page(app)
    return WebApp(Guard(app, host, admits=api_token is None))


def _showing(
    metrics: Callable[[], Awaitable[Exposition]],
) -> Callable[[Request], Awaitable[Response]]:
    async def show(_request: Request) -> Response:
        shown = await metrics()
        return Response(shown.body, headers={"content-type": shown.content_type})

    return show


class WebApp:
    """Ends what is under way when the server stops, which an event stream never does by itself."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._under_way: set[_Exchange] = set()

    def stop(self) -> None:
        """Ends the event streams now, and other requests after `GRACE_S`."""
        for exchange in self._under_way:
            exchange.stop()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        exchange = _Exchange(scope, receive, send)
        self._under_way.add(exchange)
        try:
            await exchange.run(self._app)
        finally:
            self._under_way.discard(exchange)


class _Exchange:
    """One request and its response.

    An event stream is ended by telling the application that the client has left, which is the end
    that it knows how to come to; whatever it sends after that goes nowhere.
    """

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._scope = scope
        self._receive = receive
        self._send = send
        self._is_stream = scope["path"] == STREAM_PATH
        self._begun = False
        self._left = anyio.Event()
        self._limit = anyio.CancelScope()

    def stop(self) -> None:
        """Ends it: a stream at once, what else there is within `GRACE_S`."""
        if self._is_stream:
            self._left.set()
        self._limit.deadline = anyio.current_time() + GRACE_S

    async def run(self, app: ASGIApp) -> None:
        """Runs it; a response that was stopped on its way is brought to an end."""
        with self._limit:
            await app(self._scope, self.receive, self.send)
        if not self._limit.cancelled_caught and not self._left.is_set():
            return
        if self._begun:
            await self._send({"type": "http.response.body", "body": b"", "more_body": False})
        else:
            stopping = PlainTextResponse("The server is stopping.\n", status_code=503)
            await stopping(self._scope, self._receive, self._send)

    async def receive(self) -> Message:
        """The client's next message, or its leaving where the stream is to end."""
        if not self._is_stream:
            return await self._receive()
        message: Message = {"type": "http.disconnect"}

        async def hear() -> None:
            nonlocal message
            message = await self._receive()
            tasks.cancel_scope.cancel()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(hear)
            await self._left.wait()
            tasks.cancel_scope.cancel()
        return message

    async def send(self, message: Message) -> None:
        """Passes a message to the client."""
        if not self._left.is_set():
            self._begun = True
            await self._send(message)


class Guard:
    """Refuses requests that a web page could have forged: by Host, Origin and Sec-Fetch-Site.

    A page of another site reaches a server on this machine or network by having its own name
    resolve to the server's address (DNS rebinding): then Host carries that name. So Host must be a
    name that is known to be this server's, or a bare address, which cannot be rebound.

    A browser names the page that sends a request in Origin, which must be this server's own: other
    ports of this machine serve other programs' pages. Where it sends none it still says in
    Sec-Fetch-Site (W3C Fetch Metadata) whether another site is behind a request. A person may
    follow a link from anywhere to the page itself, of which the other site sees nothing.

    `admits`: whoever passes is admitted, since no token is asked for.
    """

    def __init__(self, app: ASGIApp, host: str, *, admits: bool = False) -> None:
        self._app = app
        self._admits = admits
        self._refusals = Refusals()
        self._names = _LOOPBACK | {host.lower()} - _ANY_ADDRESS
        self._reachable = host.lower() not in _LOOPBACK
        if self._reachable:
            name = socket.gethostname().lower()
            self._names |= {name, f"{name}.local", socket.getfqdn().lower()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] == "http":
            refusal = self._refusal(scope)
            if refusal is not None:
                await refusal(scope, receive, send)
                return
            if self._admits:
                admit(scope)
        await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> PlainTextResponse | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name = _host_name(f"//{host}")
        if name not in self._names and not (self._reachable and _is_address(name)):
            self._log_refused("the host name of another site")
            return PlainTextResponse(
                "Host is not a name of this server; use its address instead.\n", status_code=421
            )
        same = {f"http://{host}".lower(), f"https://{host}".lower()}
        if any(origin.lower() not in same for origin in headers.getlist("origin")):
            self._log_refused("the origin of another site")
            return PlainTextResponse("Origin is another site.\n", status_code=403)
        if not _SAME_SITE.issuperset(headers.getlist("sec-fetch-site")) and not _is_visit(
            scope, headers
        ):
            self._log_refused("a request from another site")
            return PlainTextResponse("Sec-Fetch-Site is another site.\n", status_code=403)
        return None

    def _log_refused(self, reason: str) -> None:
        if refused := self._refusals.count(reason):
            log.warning("request_refused", reason=reason, refused=refused)


def _is_visit(scope: Scope, headers: Headers) -> bool:
    """Whether a person has a browser open the page."""
    return (
        scope["method"] == "GET"
        and scope["path"] == PAGE_PATH
        and headers.getlist("sec-fetch-mode") == ["navigate"]
        and headers.getlist("sec-fetch-dest") == ["document"]
    )


def _host_name(url: str) -> str:
    try:
        return (urlsplit(url).hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True

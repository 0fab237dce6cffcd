"""The page at `/`: the memory to be looked at, for a browser.

The page itself holds no data and is served to everybody who can reach the server; it reads from
`/page/span`, `/page/moment` and `/mcp`, which demand the token if there is one. Recorded text
may be hostile: the page shows it as text alone. Should that ever fail, its Content-Security-Policy
allows no script, style or destination but this server's own, and no inline script at all.
"""

from __future__ import annotations

import hashlib
from importlib import resources
from typing import TYPE_CHECKING, Final

from starlette.datastructures import Headers
from starlette.responses import Response

if TYPE_CHECKING:
    from collections.abc import Sequence

    from starlette.types import ASGIApp, Receive, Scope, Send

PAGE_PATH: Final = "/"
SCRIPTS: Final = (
    "vendor/uPlot.iife.min.js",
    "text.js",
    "server.js",
    "map.js",
    "timeline.js",
    "signals.js",
    "topics.js",
    "panels.js",
    "ask.js",
    "main.js",
)
"""The parts of `/page/page.js`, in order: one file, so that a first look is four requests."""
STYLES: Final = ("vendor/uPlot.min.css", "page.css")
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'"
)
"""It loads its own script and style by their address, connects only to its own origin, is not
framed, and makes no markup or code of text."""

_METHODS: Final = frozenset({"GET", "HEAD"})
_HEADERS: Final = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-cache",
}


def joined(names: Sequence[str]) -> str:
    """Returns files of the page as one text."""
    folder = resources.files(__name__)
    return "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in names)


def _response(names: Sequence[str], media_type: str) -> Response:
    body = joined(names).encode()
    etag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    return Response(body, media_type=media_type, headers={**_HEADERS, "etag": etag})


class Page:
    """Answers GET of the page's three files, and passes everything else on."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._files = {
            PAGE_PATH: _response(("index.html",), "text/html"),
            "/page/page.js": _response(SCRIPTS, "text/javascript"),
            "/page/page.css": _response(STYLES, "text/css"),
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        file = self._files.get(scope["path"]) if scope["type"] == "http" else None
        if file is None or scope["method"] not in _METHODS:
            await self._app(scope, receive, send)
            return
        etag = file.headers["etag"]
        if Headers(scope=scope).get("if-none-match") == etag:
            file = Response(status_code=304, headers={**_HEADERS, "etag": etag})
        # Uvicorn leaves the body out of the response to HEAD.
        await file(scope, receive, send)

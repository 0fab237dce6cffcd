"""The page at `/`: the memory at a glance, for a browser on this machine.

The page has no data of its own and reads it through `/mcp`, so a browser without the token sees an
empty page. Recorded text may be hostile: the page shows it as text alone. Should that ever fail,
its Content-Security-Policy allows no script, style or destination but its own.
"""

from __future__ import annotations

import base64
import hashlib
import re
from importlib import resources
from typing import TYPE_CHECKING, Final

from starlette.responses import Response

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

PAGE_PATH: Final = "/"

_INLINE: Final = re.compile(rb"<(script|style)>(.*?)</\1>", re.DOTALL)
_METHODS: Final = frozenset({"GET", "HEAD"})


class Page:
    """Answers `GET /` with the page, and passes everything else on."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._html = resources.files(__name__).joinpath("index.html").read_bytes()
        self._headers = {
            "content-security-policy": policy(self._html),
            "x-content-type-options": "nosniff",
            "referrer-policy": "no-referrer",
            "cross-origin-resource-policy": "same-origin",
            "cache-control": "no-cache",
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        is_page = scope["type"] == "http" and scope["path"] == PAGE_PATH
        if not is_page or scope["method"] not in _METHODS:
            await self._app(scope, receive, send)
            return
        # Uvicorn leaves the body out of the response to HEAD.
        response = Response(self._html, media_type="text/html", headers=self._headers)
        await response(scope, receive, send)


def policy(html: bytes) -> str:
    """Returns the Content-Security-Policy of a page that loads nothing.

    Its inline scripts and styles are allowed by their hash (CSP level 3, section 2.3.1). It may
    load no other, connect only to its own origin, and not be framed.
    """
    hashes: dict[bytes, list[str]] = {b"script": [], b"style": []}
    for kind, body in _INLINE.findall(html):
        digest = base64.b64encode(hashlib.sha256(body).digest()).decode("ascii")
        hashes[kind].append(f"'sha256-{digest}'")
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src {' '.join(hashes[b'script'])}",
            f"style-src {' '.join(hashes[b'style'])}",
            "connect-src 'self'",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
            "require-trusted-types-for 'script'",
            "trusted-types 'none'",
        )
    )

"""Demands a token of everybody, before anything else of a request is looked at.

The MCP library's own way (`TokenVerifier` with `AuthSettings`) describes an OAuth resource server:
it needs the URL of an authorization server and announces it to clients, which then begin a login
that does not exist here. It also stands behind the routes, so that `/health` is outside of it and
a path that is added later would be open until somebody thinks of it.
"""

from __future__ import annotations

import hashlib
import hmac
from typing import TYPE_CHECKING, Final

from starlette.responses import PlainTextResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

HEALTH_PATH: Final = "/health"
ADMITTED: Final = "ros2_memory.admitted"
"""In the scope of a request to `/health`: whether it showed the token."""

_SCHEME: Final = b"bearer "
_MISSING: Final = "A token is needed: send it as Authorization: Bearer TOKEN.\n"
_WRONG: Final = "The token is not the one of this server.\n"


class TokenGate:
    """Passes on what shows the token as `Authorization: Bearer ...` (RFC 6750, section 2.1).

    Everything else is answered with 401 before its body is read; `/health` alone is passed on
    without a token too, marked as such. A token in a query string is none: it would stand in logs.
    Only the token's digest is kept, and digests are compared in constant time.
    """

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app = app
        self._digest = _digest(token.encode("ascii"))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        shown = [value for name, value in scope["headers"] if name == b"authorization"]
        if len(shown) == 1 and self._is_right(shown[0]):
            await self._app({**scope, ADMITTED: True}, receive, send)
        elif not shown and scope["path"] == HEALTH_PATH:
            await self._app({**scope, ADMITTED: False}, receive, send)
        else:
            await _refusal(is_wrong=bool(shown))(scope, receive, send)

    def _is_right(self, header: bytes) -> bool:
        scheme, token = header[: len(_SCHEME)].lower(), header[len(_SCHEME) :].strip(b" ")
        return hmac.compare_digest(_digest(token), self._digest) and scheme == _SCHEME


def _digest(token: bytes) -> bytes:
    return hashlib.sha256(token).digest()


def _refusal(*, is_wrong: bool) -> PlainTextResponse:
    """As RFC 6750, section 3: an error code only where a token was shown."""
    challenge = 'Bearer realm="ros2-memory"' + (', error="invalid_token"' if is_wrong else "")
    return PlainTextResponse(
        _WRONG if is_wrong else _MISSING,
        status_code=401,
        headers={"WWW-Authenticate": challenge},
    )

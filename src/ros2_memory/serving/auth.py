"""Demands a token of everybody, before anything else of a request is looked at.

The MCP library's own way (`TokenVerifier` with `AuthSettings`) describes an OAuth resource server:
it needs the URL of an authorization server and announces it to clients, which then begin a login
that does not exist here. It also stands behind the routes, so that `/health` is outside of it and
a path that is added later would be open until somebody thinks of it.
"""

from __future__ import annotations

import hashlib
import hmac
import time
from typing import TYPE_CHECKING, Final

from starlette.responses import PlainTextResponse

from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from starlette.types import ASGIApp, Receive, Scope, Send

HEALTH_PATH: Final = "/health"
ADMITTED: Final = "ros2_memory.admitted"
"""In the scope of a request to `/health`: whether it showed the token."""

_SHOWN: Final = "ros2_memory.shown"
"""In the state of a request, which its connection sees: it was admitted."""

TOLD_EVERY_S: Final = 60.0
"""Refusals are logged this often at most: whoever guesses must not fill the disk with it."""

_SCHEME: Final = b"bearer "
_MISSING: Final = "A token is needed: send it as Authorization: Bearer TOKEN.\n"
_WRONG: Final = "The token is not the one of this server.\n"


log = get_logger(__name__)


def admit(scope: Scope) -> None:
    """Notes for the connection that one of its requests was admitted."""
    scope.setdefault("state", {})[_SHOWN] = True


def is_admitted(scope: Mapping[str, object]) -> bool:
    """Whether a request was admitted."""
    state = scope.get("state")
    return isinstance(state, dict) and state.get(_SHOWN) is True


class TokenGate:
    """Passes on what shows the token as `Authorization: Bearer ...` (RFC 6750, section 2.1).

    Everything else is answered with 401 before its body is read; `/health` alone is passed on
    without a token too, marked as such. A token in a query string is none: it would stand in logs.
    Only the token's digest is kept, and digests are compared in constant time.
    """

    def __init__(
        self, app: ASGIApp, token: str, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self._app = app
        self._digest = _digest(token.encode("ascii"))
        self._monotonic = monotonic
        self._refused = 0
        self._told_until = float("-inf")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        shown = [value for name, value in scope["headers"] if name == b"authorization"]
        if len(shown) == 1 and self._is_right(shown[0]):
            admit(scope)
            await self._app({**scope, ADMITTED: True}, receive, send)
        elif not shown and scope["path"] == HEALTH_PATH:
            await self._app({**scope, ADMITTED: False}, receive, send)
        else:
            self._tell(scope, is_wrong=bool(shown))
            await _refusal(is_wrong=bool(shown))(scope, receive, send)

    def _is_right(self, header: bytes) -> bool:
        scheme, token = header[: len(_SCHEME)].lower(), header[len(_SCHEME) :].strip(b" ")
        return hmac.compare_digest(_digest(token), self._digest) and scheme == _SCHEME

    def _tell(self, scope: Scope, *, is_wrong: bool) -> None:
        """Logs who was refused, and how many since; nothing of what was sent, not even the path."""
        self._refused += 1
        now = self._monotonic()
        if now < self._told_until:
            return
        client = scope.get("client")
        log.warning(
            "refused_without_token",
            reason="another token" if is_wrong else "no token",
            client=client[0] if client else None,
            refused=self._refused,
        )
        self._refused, self._told_until = 0, now + TOLD_EVERY_S


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

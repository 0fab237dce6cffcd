"""Who may ask: requests that no web page forged, and that show the API token.

`ForgeryGuard` refuses requests by Host, Origin and Sec-Fetch-Site; `TokenGate` demands the token
of every request. Both answer before a route or a body is looked at.

The MCP library's own way (`TokenVerifier` with `AuthSettings`) describes an OAuth resource server:
it needs the URL of an authorization server and announces it to clients, which then begin a login
that does not exist here. It also runs behind the routes, so that `/health` is outside of it and a
path that is added later would be open.

The token comes from the environment, from a file, or from systemd's credentials, never from the
configuration, which is written to disk and shown in diagnostics. No message repeats any of it.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import socket
import stat
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.responses import JSONResponse, PlainTextResponse, Response

from ros2_memory.core.errors import ConfigError
from ros2_memory.core.logging_setup import LogThrottle, get_logger
from ros2_memory.serving.given_tokens import CREDENTIAL, FILE_VARIABLE, VARIABLE, given_tokens
from ros2_memory.serving.page import PAGE_PATH

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, MutableMapping, Sequence

    from starlette.types import ASGIApp, Receive, Scope, Send

    from ros2_memory.serving.listen import Address

HEALTH_PATH: Final = "/health"
MCP_PATH: Final = "/mcp"
RECORDING_PATH: Final = "/health/recording"
LOOPBACK_NAMES: Final = frozenset({"localhost", "127.0.0.1", "::1"})

SHORTEST_TOKEN: Final = 16
LONGEST_TOKEN: Final = 1024
LOG_INTERVAL_S: Final = 60.0
"""Wrong tokens are logged at most this often: guessing must not fill the disk with log events."""

_ACCESS: Final = "ros2_memory.access"
"""The key in the state of an admitted request, which its connection and `/health` can read."""
_SAME_SITE: Final = frozenset({"same-origin", "none"})
"""Values of Sec-Fetch-Site for a page of this server, or no page at all."""
_ANY_ADDRESS: Final = frozenset({"0.0.0.0", "::", ""})  # noqa: S104 - only compared with
_SCHEME: Final = b"bearer "
_REFUSED: Final = -32_001
"""The code of a JSON-RPC error that a server defines itself."""
_MISSING: Final = "A token is needed: send it as Authorization: Bearer TOKEN.\n"
_QUESTIONS: Final = frozenset({"/sse", "/messages", MCP_PATH})
"""The paths that a limited token may use, with or without a slash at their end."""
_FORBIDDEN: Final = PlainTextResponse(
    "The token is for questions about some robots alone.\n", status_code=403
)
_WRONG: Final = "The token is not the one of this server.\n"
_HOW: Final = "make one with `openssl rand -hex 32`"
# The characters of a bearer token: RFC 6750, section 2.1 (b64token).
_TOKEN: Final = re.compile(r"[A-Za-z0-9._~+/-]+=*")
# A name or an IPv4 address, or an IPv6 address in brackets; then perhaps a port (RFC 9110, 7.2).
_HOST: Final = re.compile(r"(?:([A-Za-z0-9._-]+)|\[([0-9A-Fa-f:.]+)\])(?::[0-9]*)?")

log = get_logger(__name__)


Tokens: TypeAlias = "Mapping[str, frozenset[str] | None]"
"""Tokens, each with the robots that it is for; None for everything."""


class Access(NamedTuple):
    """What a token is for: questions about some robots, or everything where `robots` is None."""

    robots: frozenset[str] | None = None


def admit(scope: Scope, access: Access) -> None:
    """Marks a request as admitted, for its connection."""
    scope.setdefault("state", {})[_ACCESS] = access


def access_of(scope: Mapping[str, object]) -> Access | None:
    """Returns what a request was admitted to; None if it was not."""
    state = scope.get("state")
    access = state.get(_ACCESS) if isinstance(state, dict) else None
    return access if isinstance(access, Access) else None


class TokenGate:
    """Passes on requests with the right `Authorization: Bearer ...` (RFC 6750, section 2.1).

    Every other request is answered with 401 before its body is read. `/health` is passed on without
    a token too, and is not admitted then. A token in a query string is not accepted, since query
    strings are logged. Only digests of tokens are kept, and they are compared in constant time.

    Args:
        app: receives the requests.
        tokens: a limited one is for the questions of MCP alone; for `/health` it counts as none.
        monotonic: seconds.
    """

    def __init__(
        self,
        app: ASGIApp,
        tokens: Tokens,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._app = app
        self._access_by_digest = {
            _digest(text.encode("ascii")): Access(robots) for text, robots in tokens.items()
        }
        self._refusals = LogThrottle(monotonic, LOG_INTERVAL_S)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        given = [value for name, value in scope["headers"] if name == b"authorization"]
        access = self._access(given[0]) if len(given) == 1 else None
        app, path = self._app, scope["path"]
        is_health = path in {HEALTH_PATH, RECORDING_PATH}
        if access is None:
            if not is_health or given:
                self._log_refused(scope, is_wrong=bool(given))
                app = _unauthorized(is_wrong=bool(given), speaks_mcp=path == MCP_PATH)
        elif access.robots is None or path.removesuffix("/") in _QUESTIONS:
            admit(scope, access)
        elif not is_health:
            app = _FORBIDDEN
        await app(scope, receive, send)

    def _access(self, header: bytes) -> Access | None:
        """Returns what the token in an Authorization header is for; None if it is not known."""
        scheme, token = header[: len(_SCHEME)].lower(), header[len(_SCHEME) :].strip(b" ")
        digest = _digest(token)
        access = None
        # All are compared, so that the time does not tell which token it was.
        for known, granted in self._access_by_digest.items():
            if hmac.compare_digest(digest, known):
                access = granted
        return access if scheme == _SCHEME else None

    def _log_refused(self, scope: Scope, *, is_wrong: bool) -> None:
        """Logs the client and the number of refusals; nothing that was sent, not even the path."""
        if refused := self._refusals.count("token"):
            client = scope.get("client")
            log.warning(
                "refused_without_token",
                reason="another token" if is_wrong else "no token",
                client=client[0] if client else None,
                refused=refused,
            )


def _digest(token: bytes) -> bytes:
    return hashlib.sha256(token).digest()


def _unauthorized(*, is_wrong: bool, speaks_mcp: bool) -> Response:
    """Returns a 401 as in RFC 6750, section 3: with an error code only where a token was sent.

    A client of MCP gets a JSON-RPC error, whose message it can show.
    """
    challenge = 'Bearer realm="ros2-memory"' + (', error="invalid_token"' if is_wrong else "")
    headers, why = {"WWW-Authenticate": challenge}, _WRONG if is_wrong else _MISSING
    if not speaks_mcp:
        return PlainTextResponse(why, status_code=401, headers=headers)
    body = {"jsonrpc": "2.0", "id": None, "error": {"code": _REFUSED, "message": why.rstrip()}}
    return JSONResponse(body, status_code=401, headers=headers)


class _Refusal(NamedTuple):
    """Why a request is refused: the reason for the log, the HTTP status and the reply."""

    reason: str
    status: int
    reply: str


class ForgeryGuard:
    """Refuses requests that a web page could have forged: by Host, Origin and Sec-Fetch-Site.

    A page of another site reaches a server on this machine or network by having its own name
    resolve to the server's address (DNS rebinding). Host carries that name then. So Host must be a
    name of this server, or a bare address, which cannot be rebound.

    A browser sends the page's site in Origin, which must be this server's own: other ports of this
    machine serve other programs' pages. Where it sends no Origin, Sec-Fetch-Site (W3C Fetch
    Metadata) says whether another site caused the request. A person may follow a link from anywhere
    to the page itself: the other site sees nothing of it.

    Args:
        app: receives the requests that pass.
        host: the name or address that the server listens on.
        admits: whether requests that pass are admitted, because there is no token to ask for.
    """

    def __init__(self, app: ASGIApp, host: str, *, admits: bool) -> None:
        self._app = app
        self._admits = admits
        self._refusals = LogThrottle()
        self._names = LOOPBACK_NAMES | {host.lower()} - _ANY_ADDRESS
        self._is_reachable = host.lower() not in LOOPBACK_NAMES
        if self._is_reachable:
            name = socket.gethostname().lower()
            self._names |= {name, f"{name}.local", socket.getfqdn().lower()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        app = self._app
        refusal = self._refusal(scope) if scope["type"] == "http" else None
        if refusal is not None:
            if refused := self._refusals.count(refusal.reason):
                log.warning("request_refused", reason=refusal.reason, refused=refused)
            app = PlainTextResponse(f"{refusal.reply}\n", refusal.status)
        elif self._admits and scope["type"] == "http":
            admit(scope, Access())
        await app(scope, receive, send)

    def _refusal(self, scope: Scope) -> _Refusal | None:
        """Returns why a request is refused; None if it passes."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name = _host_name(host)
        if name not in self._names and not (self._is_reachable and _is_address(name)):
            reply = "Host is not a name of this server; use its address instead."
            return _Refusal("the host name of another site", 421, reply)
        same = {f"http://{host}".lower(), f"https://{host}".lower()}
        if any(origin.lower() not in same for origin in headers.getlist("origin")):
            return _Refusal("the origin of another site", 403, "Origin is another site.")
        is_same_site = _SAME_SITE.issuperset(headers.getlist("sec-fetch-site"))
        if not is_same_site and not _is_visit(scope, headers):
            reply = "Sec-Fetch-Site is another site."
            return _Refusal("a request from another site", 403, reply)
        return None


def _is_visit(scope: Scope, headers: Headers) -> bool:
    """Returns whether a browser opens the page itself, as when a person follows a link."""
    return (
        scope["method"] == "GET"
        and scope["path"] == PAGE_PATH
        and headers.getlist("sec-fetch-mode") == ["navigate"]
        and headers.getlist("sec-fetch-dest") == ["document"]
    )


def _host_name(host: str) -> str:
    """Returns the name or address in a Host header, in lower case; empty if it is malformed."""
    match = _HOST.fullmatch(host)
    if match is None:
        return ""
    name, address = match.groups()
    if name:
        return str(name).lower()
    return str(address).lower() if _is_address(address) else ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def api_token(env: Mapping[str, str]) -> SecretStr | None:
    """Returns the token that clients must send; None if no token is configured.

    It is `MEMORY_API_TOKEN`, the content of the file that `MEMORY_API_TOKEN_FILE` names, or that of
    `memory_api_token` in `CREDENTIALS_DIRECTORY`, which systemd sets. An empty variable counts as
    unset, an empty file does not.

    Raises:
        ConfigError: it cannot be read, is given twice, or cannot be sent in a header.
    """
    given = given_tokens(env)
    if len(given) > 1:
        raise ConfigError(f"{' and '.join(given)} both give the API token; leave one of them")
    for source, token in given.items():
        return SecretStr(_read_token(token, source))
    return None


def take_tokens(
    env: MutableMapping[str, str], files: Mapping[Path, Sequence[str]], address: Address
) -> Tokens:
    """Returns the tokens of a server; on a loopback address it needs none.

    Removes the API token from the environment of child processes.

    Args:
        env: the environment, which names the API token.
        files: the files of limited tokens, each with the robots that its token is for.
        address: where the server listens.

    Raises:
        ConfigError: a token is missing, cannot be read or used, or is given twice.
    """
    token = api_token(env)
    env.pop(VARIABLE, None)
    if token is None and not files and not address.is_loopback:
        raise ConfigError(
            f"{VARIABLE}: missing; server.host is {address.host!r}, which other machines can "
            f"reach, so clients must send a token: {_HOW} and give it as {VARIABLE}, in a file "
            f"that {FILE_VARIABLE} names, or by LoadCredential={CREDENTIAL}:PATH in a systemd "
            "unit; or listen on 127.0.0.1, where none is needed"
        )
    tokens: dict[str, frozenset[str] | None] = {}
    if token is not None:
        tokens[token.get_secret_value()] = None
    for path, names in files.items():
        source = f"fleet.tokens: {path}"
        text = _read_token(path, source)
        if text in tokens:
            why = "another file has the same token"
            if tokens[text] is None:
                why = "it is the API token, which is for everything"
            raise ConfigError(f"{source}: {why}; {_HOW}")
        tokens[text] = frozenset(names)
    return tokens


def _read_token(given: str | Path, source: str) -> str:
    """Returns a token that is given as text or in a file.

    Raises:
        ConfigError: it cannot be read, or cannot be sent in a header. The sentence begins with
            `source`, which names where the token is given.
    """
    text = _first_line(given, source) if isinstance(given, Path) else given
    if len(text) < SHORTEST_TOKEN:
        length = f"has {len(text)} characters" if text else "is empty"
        raise ConfigError(
            f"{source}: the API token {length}, and must have at least {SHORTEST_TOKEN}; {_HOW}"
        )
    if len(text) > LONGEST_TOKEN:
        raise ConfigError(
            f"{source}: the API token is longer than {LONGEST_TOKEN} characters, too long for a "
            f"header; {_HOW}"
        )
    if not _TOKEN.fullmatch(text):
        raise ConfigError(
            f"{source}: the API token holds characters that an Authorization header cannot "
            f"hold; letters, digits and -._~+/ are allowed, with = at the end; {_HOW}"
        )
    return text


def _first_line(path: Path, source: str) -> str:
    """Returns the text of a token file without the line's end. Bytes that are no text are replaced.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        # A pipe would block.
        if not stat.S_ISREG(path.stat().st_mode):
            raise ConfigError(f"{source}: {str(path)!r} is not a regular file")
        with path.open("rb") as file:
            data = file.read(LONGEST_TOKEN + len("\r\n") + 1)
    except OSError as error:
        raise ConfigError(
            f"{source}: {str(path)!r} cannot be read: {error.strerror}; "
            "give the server's user a file that it may read"
        ) from None
    return data.decode("ascii", errors="replace").removesuffix("\n").removesuffix("\r")

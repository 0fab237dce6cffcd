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
from typing import TYPE_CHECKING, Final

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.responses import JSONResponse, PlainTextResponse, Response

from ros2_memory.core.errors import ConfigError
from ros2_memory.core.logging_setup import LogThrottle, get_logger
from ros2_memory.serving.page import PAGE_PATH

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, MutableMapping, Sequence

    from starlette.types import ASGIApp, Receive, Scope, Send

HEALTH_PATH: Final = "/health"
MCP_PATH: Final = "/mcp"
RECORDING_PATH: Final = "/health/recording"
LOOPBACK_NAMES: Final = frozenset({"localhost", "127.0.0.1", "::1"})

VARIABLE: Final = "MEMORY_API_TOKEN"
FILE_VARIABLE: Final = "MEMORY_API_TOKEN_FILE"
CREDENTIAL: Final = "memory_api_token"
"""The name under which a systemd unit passes the token: `LoadCredential=memory_api_token:PATH`."""
SHORTEST_TOKEN: Final = 16
LONGEST_TOKEN: Final = 1024
LOG_INTERVAL_S: Final = 60.0
"""Wrong tokens are logged at most this often: guessing must not fill the disk with log events."""

_ROBOTS: Final = "ros2_memory.robots"
"""The key in the scope of a request: the robots that its token is for; absent where for all."""
_ADMITTED: Final = "ros2_memory.admitted"
"""The key in the state of a request, which its connection and `/health` can read."""
_SAME_SITE: Final = frozenset({"same-origin", "none"})
"""Values of Sec-Fetch-Site for a page of this server, or no page at all."""
_ANY_ADDRESS: Final = frozenset({"0.0.0.0", "::", ""})  # noqa: S104 - only compared with
_SCHEME: Final = b"bearer "
_REFUSED: Final = -32_001
"""The code of a JSON-RPC error that a server defines itself."""
_MISSING: Final = "A token is needed: send it as Authorization: Bearer TOKEN.\n"
_QUESTIONS: Final = ("/sse", "/messages/", MCP_PATH)
"""How the paths begin that a limited token may use."""
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


def admit(scope: Scope) -> None:
    """Marks a request as admitted, for its connection."""
    scope.setdefault("state", {})[_ADMITTED] = True


def is_admitted(scope: Mapping[str, object]) -> bool:
    """Returns whether a request was admitted."""
    state = scope.get("state")
    return isinstance(state, dict) and state.get(_ADMITTED) is True


def robots_of(scope: Mapping[str, object]) -> frozenset[str] | None:
    """Returns the robots that the token of a request is for; None where it is for all."""
    robots = scope.get(_ROBOTS)
    return robots if isinstance(robots, frozenset) else None


class TokenGate:
    """Passes on requests with the right `Authorization: Bearer ...` (RFC 6750, section 2.1).

    Every other request is answered with 401 before its body is read. `/health` is passed on without
    a token too, and is not admitted then. A token in a query string is not accepted, since query
    strings are logged. Only tokens' digests are kept, and digests are compared in constant time.

    `token` is for everything. Each of `limited` is for the questions of MCP alone, about the
    robots that it has here; for `/health` it counts as none.
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str | None,
        monotonic: Callable[[], float] = time.monotonic,
        limited: Mapping[str, frozenset[str]] | None = None,
    ) -> None:
        self._app = app
        tokens: dict[str, frozenset[str] | None] = {**(limited or {})}
        if token is not None:
            tokens[token] = None
        self._digests = [(_digest(own.encode("ascii")), robots) for own, robots in tokens.items()]
        self._refusals = LogThrottle(monotonic, LOG_INTERVAL_S)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles an ASGI connection."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        shown = [value for name, value in scope["headers"] if name == b"authorization"]
        is_right, robots = self._checked(shown[0]) if len(shown) == 1 else (False, None)
        is_health = scope["path"] in {HEALTH_PATH, RECORDING_PATH}
        if is_right and robots is None:
            admit(scope)
            await self._app(scope, receive, send)
        elif is_health and (is_right or not shown):
            await self._app(scope, receive, send)
        elif is_right and not scope["path"].startswith(_QUESTIONS):
            await _FORBIDDEN(scope, receive, send)
        elif is_right:
            admit(scope)
            await self._app({**scope, _ROBOTS: robots}, receive, send)
        else:
            self._log_refused(scope, is_wrong=bool(shown))
            refusal = _unauthorized(is_wrong=bool(shown), speaks_mcp=scope["path"] == MCP_PATH)
            await refusal(scope, receive, send)

    def _checked(self, header: bytes) -> tuple[bool, frozenset[str] | None]:
        """Returns whether a header has a token of this server, and the robots that it is for."""
        scheme, token = header[: len(_SCHEME)].lower(), header[len(_SCHEME) :].strip(b" ")
        shown = _digest(token)
        right: tuple[bool, frozenset[str] | None] = (False, None)
        for digest, robots in self._digests:
            # All are compared, so that the time says nothing of which it was.
            if hmac.compare_digest(shown, digest):
                right = True, robots
        return right if scheme == _SCHEME else (False, None)

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


class ForgeryGuard:
    """Refuses requests that a web page could have forged: by Host, Origin and Sec-Fetch-Site.

    A page of another site reaches a server on this machine or network by having its own name
    resolve to the server's address (DNS rebinding). Host carries that name then. So Host must be a
    name of this server, or a bare address, which cannot be rebound.

    A browser sends the page's site in Origin, which must be this server's own: other ports of this
    machine serve other programs' pages. Where it sends no Origin, Sec-Fetch-Site (W3C Fetch
    Metadata) says whether another site caused the request. A person may follow a link from anywhere
    to the page itself, of which the other site sees nothing.

    `admits`: whether requests that pass are admitted, because there is no token to ask for.
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
        if scope["type"] == "http":
            if refusal := self._refusal(scope):
                reason, status, sentence = refusal
                if refused := self._refusals.count(reason):
                    log.warning("request_refused", reason=reason, refused=refused)
                app = PlainTextResponse(f"{sentence}\n", status)
            elif self._admits:
                admit(scope)
        await app(scope, receive, send)

    def _refusal(self, scope: Scope) -> tuple[str, int, str] | None:
        """Returns why a request is refused, for the log, with the status and the reply."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name = _host_name(host)
        if name not in self._names and not (self._is_reachable and _is_address(name)):
            reply = "Host is not a name of this server; use its address instead."
            return "the host name of another site", 421, reply
        same = {f"http://{host}".lower(), f"https://{host}".lower()}
        if any(origin.lower() not in same for origin in headers.getlist("origin")):
            return "the origin of another site", 403, "Origin is another site."
        is_same_site = _SAME_SITE.issuperset(headers.getlist("sec-fetch-site"))
        if not is_same_site and not _is_visit(scope, headers):
            return "a request from another site", 403, "Sec-Fetch-Site is another site."
        return None


def _is_visit(scope: Scope, headers: Headers) -> bool:
    """Returns whether a person has a browser open the page."""
    return (
        scope["method"] == "GET"
        and scope["path"] == PAGE_PATH
        and headers.getlist("sec-fetch-mode") == ["navigate"]
        and headers.getlist("sec-fetch-dest") == ["document"]
    )


def _host_name(host: str) -> str:
    """Returns the name or address in a Host header, in lower case; empty if that is malformed."""
    match = _HOST.fullmatch(host)
    if match is None:
        return ""
    name, address = match[1], match[2]
    return name.lower() if name else address.lower() if _is_address(address) else ""


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
    given: dict[str, str | Path] = {}
    if text := env.get(VARIABLE):
        given[VARIABLE] = text
    if file := env.get(FILE_VARIABLE):
        given[FILE_VARIABLE] = Path(file)
    credentials = env.get("CREDENTIALS_DIRECTORY")
    if credentials and (path := Path(credentials) / CREDENTIAL).exists():
        given[f"the credential {CREDENTIAL}"] = path
    if len(given) > 1:
        raise ConfigError(f"{' and '.join(given)} both give the API token; leave one of them")
    for source, token in given.items():
        return SecretStr(_usable(token, source))
    return None


def limited_tokens(robots: Mapping[Path, Sequence[str]]) -> dict[str, frozenset[str]]:
    """Returns the tokens in files, each with the robots that it is for.

    Raises:
        ConfigError: a file cannot be read, its token cannot be used, or two have the same one.
    """
    tokens: dict[str, frozenset[str]] = {}
    for path, names in robots.items():
        source = f"fleet.tokens: {path}"
        text = _usable(path, source)
        if text in tokens:
            raise ConfigError(f"{source}: another file has the same token; {_HOW}")
        tokens[text] = frozenset(names)
    return tokens


def take_token(
    env: MutableMapping[str, str], *, host: str, loopback: bool, limited: bool = False
) -> SecretStr | None:
    """Returns the token of a server on `host`; None only where no other machine can reach it.

    Where there are `limited` ones, none that is for everything is needed. Removes it from the
    environment, which child processes inherit.

    Raises:
        ConfigError: there must be a token, or the one that there is cannot be used.
    """
    token = api_token(env)
    env.pop(VARIABLE, None)
    if token is None and not loopback and not limited:
        raise ConfigError(
            f"{VARIABLE}: missing; server.host is {host!r}, which other machines can reach, so "
            f"clients must send a token: {_HOW} and give it as {VARIABLE}, in a file that "
            f"{FILE_VARIABLE} names, or by LoadCredential={CREDENTIAL}:PATH in a systemd unit; "
            "or listen on 127.0.0.1, where none is needed"
        )
    return token


def _usable(given: str | Path, source: str) -> str:
    """Returns a token, or that in a file without the line's end; opens no pipe, which would block.

    Raises:
        ConfigError: it cannot be read, or cannot be sent in a header.
    """
    if isinstance(given, Path):
        try:
            if not stat.S_ISREG(given.stat().st_mode):
                raise ConfigError(f"{source}: {str(given)!r} is not a regular file")
            with given.open("rb") as file:
                data = file.read(LONGEST_TOKEN + 3)
        except OSError as error:
            raise ConfigError(
                f"{source}: {str(given)!r} cannot be read: {error.strerror}; "
                "give the server's user a file that it may read"
            ) from None
        # Bytes that are not text are refused below, without being shown.
        text = data.decode("ascii", errors="replace").removesuffix("\n").removesuffix("\r")
    else:
        text = given
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

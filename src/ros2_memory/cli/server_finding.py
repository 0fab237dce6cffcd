"""What `ros2-memory doctor` says of the server, as its `/health` answers."""

from __future__ import annotations

import http.client
import json
import os
import time
from typing import TYPE_CHECKING, Final

from ros2_memory.cli.findings import Finding, Level
from ros2_memory.core.errors import EpisodicError
from ros2_memory.serving.auth import api_token

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.config import Settings
    from ros2_memory.core.model import JsonValue

_SERVER_PATIENCE_S: Final = 5.0
_MOST_REPLY: Final = 1 << 20
_HERE: Final[Mapping[str, str]] = {
    "0.0.0.0": "127.0.0.1",  # noqa: S104 - looked up, never bound
    "::": "::1",
    "": "127.0.0.1",
}
"""Where a server that listens everywhere is reached from its own machine."""


def of_server(settings: Settings) -> Iterator[Finding]:
    """What the server's `/health` says."""
    at, about = settings.server, "server"
    if at.transport == "stdio":
        seen = "server.transport=stdio: each client starts its own, there is none to ask"
        yield Finding(Level.OK, about, seen)
        return
    begun = time.monotonic()
    try:
        status, reply = _health(_HERE.get(at.host, at.host), at.port)
    except (OSError, http.client.HTTPException) as error:
        seen = f"nothing answers on {at.host} port {at.port}: {error}"
        do = "start it: ros2-memory-server, or systemctl start ros2-memory-server"
        yield Finding(Level.ERROR, about, seen, do)
        return
    except (ValueError, EpisodicError) as error:
        seen = f"what answers on {at.host} port {at.port} is another program: {error}"
        yield Finding(Level.ERROR, about, seen, "give the server another port: server.port")
        return
    if status == http.HTTPStatus.UNAUTHORIZED:
        seen = f"the server on {at.host} port {at.port} takes another token than MEMORY_API_TOKEN"
        do = "give doctor the token that the server was started with"
        yield Finding(Level.WARNING, about, seen, do)
        return
    took = f"in {(time.monotonic() - begun) * 1000:.0f} ms"
    if reply.get("status") == "ok":
        yield Finding(Level.OK, about, f"ok on {at.host} port {at.port}, {took}")
        return
    problems = reply.get("problems")
    named = "; ".join(map(str, problems)) if isinstance(problems, list) else ""
    seen = f"{reply.get('status', f'HTTP {status}')}: {named or 'it does not say why'}"
    yield Finding(Level.WARNING, about, seen, "the findings above and its log have the cause")


def _health(host: str, port: int) -> tuple[int, dict[str, JsonValue]]:
    """Status and reply of `/health`; no reply where it refuses the token.

    Raises:
        OSError: nothing answers; what answers in no HTTP raises an HTTPException.
        ValueError: the reply is no JSON object with a status.
        ConfigError: the token to show cannot be read.
    """
    token = api_token(os.environ)
    headers = {"Authorization": f"Bearer {token.get_secret_value()}"} if token else {}
    connection = http.client.HTTPConnection(host, port, timeout=_SERVER_PATIENCE_S)
    try:
        connection.request("GET", "/health", headers=headers)
        response = connection.getresponse()
        if response.status == http.HTTPStatus.UNAUTHORIZED and token:
            return response.status, {}
        reply: JsonValue = json.loads(response.read(_MOST_REPLY))
    finally:
        connection.close()
    if not isinstance(reply, dict) or "status" not in reply:
        raise ValueError("it gives no status")
    return response.status, reply

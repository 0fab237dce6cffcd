"""HTTP by hand, for what no well-behaved client library does."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Final

from tests.support.processes import PATIENCE_S

BOUND_S: Final = PATIENCE_S
"""No client waits longer: that is a hang."""

_HEADERS: Final = (
    "host: 127.0.0.1\r\naccept: application/json, text/event-stream\r\n"
    "content-type: application/json\r\n"
)


def head(method: str, path: str, length: int | None = None, more: str = "") -> bytes:
    """A request up to its body."""
    stated = "" if length is None else f"content-length: {length}\r\n"
    return f"{method} {path} HTTP/1.1\r\n{_HEADERS}{more}{stated}\r\n".encode()


def call(name: str, arguments: str, number: int = 1) -> bytes:
    """A tool call; `arguments` is JSON text, or what passes for it."""
    params = f'{{"name": {json.dumps(name)}, "arguments": {arguments}}}'
    return (
        f'{{"jsonrpc": "2.0", "id": {number}, "method": "tools/call", "params": {params}}}'
    ).encode("utf-8", "surrogatepass")


@asynccontextmanager
async def connected(
    port: int, window: int | None = None
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection, closed in the end whatever the server did with it.

    `window` bounds what the system takes in before anybody reads.
    """
    client = socket.socket()
    client.setblocking(False)
    if window is not None:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window)
    await asyncio.get_running_loop().sock_connect(client, ("127.0.0.1", port))
    reader, writer = await asyncio.open_connection(sock=client)
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


async def answer(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """Status and body of one response; status 0 where the server ended the connection."""
    async with asyncio.timeout(BOUND_S):
        try:
            told = await reader.readuntil(b"\r\n\r\n")
        except (asyncio.IncompleteReadError, ConnectionError):
            return 0, b""
        status = int(told.split(b" ", 2)[1])
        lengths = [
            int(line.split(b":")[1])
            for line in told.lower().split(b"\r\n")
            if line.startswith(b"content-length:")
        ]
        return status, await reader.readexactly(lengths[0]) if lengths else b""


async def posted(port: int, body: bytes, path: str = "/mcp", more: str = "") -> tuple[int, bytes]:
    """The answer to one request on a connection of its own."""
    async with connected(port) as (reader, writer):
        writer.write(head("POST", path, len(body), more) + body)
        return await answer(reader)


async def asked(port: int, name: str, arguments: str) -> Any:
    """What a tool returned: the JSON of its one text, or the JSON-RPC error."""
    status, body = await posted(port, call(name, arguments))
    reply = json.loads(body)
    if "error" in reply:
        return {"status": status, **reply}
    [block] = reply["result"]["content"]
    return json.loads(block["text"])

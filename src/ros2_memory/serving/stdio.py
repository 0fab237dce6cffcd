"""MCP over stdin and stdout, where a line that is no message is answered, too.

MCP's SDK passes over a request that its parser refuses (a lone surrogate, 200 lists in each other),
and the client would wait for ever.
"""

from __future__ import annotations

import json
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import anyio
from mcp.server.stdio import stdio_server
from mcp.shared.message import SessionMessage
from mcp.types import INVALID_REQUEST, PARSE_ERROR, ErrorData, JSONRPCError
from pydantic import ValidationError

from ros2_memory.core.text import encodable

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mcp.shared._stream_protocols import ReadStream, WriteStream


@asynccontextmanager
async def stdio_messages() -> AsyncIterator[
    tuple[ReadStream[SessionMessage | Exception], WriteStream[SessionMessage]]
]:
    """Yields the messages from stdin and a stream to stdout; answers invalid lines itself."""
    async with stdio_server() as (lines, replies), anyio.create_task_group() as tasks:
        to_server, messages = anyio.create_memory_object_stream[SessionMessage | Exception]()
        tasks.start_soon(_relay, lines, to_server, replies)
        yield messages, replies
        tasks.cancel_scope.cancel()


async def _relay(
    lines: ReadStream[SessionMessage | Exception],
    to_server: WriteStream[SessionMessage | Exception],
    replies: WriteStream[SessionMessage],
) -> None:
    """Passes the messages on, and answers the lines that are none."""
    async with to_server:
        async for line in lines:
            if not isinstance(line, Exception):
                await to_server.send(line)
            elif error := error_reply(line):
                await replies.send(SessionMessage(error))


def error_reply(error: Exception) -> JSONRPCError | None:
    """Returns the reply to a line that is no message; None if the line is blank.

    Its `id` is that of the request, or null if there is none that JSON-RPC allows.
    """
    if not isinstance(error, ValidationError):
        return _error(None, INVALID_REQUEST, str(error))
    errors = error.errors(include_url=False)
    reason, line = errors[0]["msg"], errors[0]["input"]
    if isinstance(line, str):
        return _error(_request_id(line), PARSE_ERROR, reason) if line.strip() else None
    # One error for each kind of message that the line is not; some have the whole line as input.
    for fault in errors:
        if isinstance(fault["input"], dict) and "id" in fault["input"]:
            return _error(fault["input"]["id"], INVALID_REQUEST, reason)
    return _error(None, INVALID_REQUEST, reason)


def _error(request_id: object, code: int, reason: str) -> JSONRPCError:
    number: int | str | None = None
    if type(request_id) is int or (type(request_id) is str and encodable(request_id) == request_id):
        number = request_id
    message = f"this is no JSON-RPC message: {reason}"
    return JSONRPCError(jsonrpc="2.0", id=number, error=ErrorData(code=code, message=message))


def _request_id(text: str) -> object:
    """Returns the id in a JSON-RPC request that the SDK refuses; None if there is none."""
    try:
        message: object = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return message.get("id") if isinstance(message, dict) else None

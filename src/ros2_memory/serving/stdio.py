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

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mcp.shared._stream_protocols import ReadStream, WriteStream


@asynccontextmanager
async def stdio_messages() -> AsyncIterator[
    tuple[ReadStream[SessionMessage | Exception], WriteStream[SessionMessage]]
]:
    """Serves stdin and stdout as the SDK does; what is no message is answered here."""
    async with stdio_server() as (lines, replies):
        sent, messages = anyio.create_memory_object_stream[SessionMessage | Exception]()

        async def relay() -> None:
            async with sent:
                async for line in lines:
                    if not isinstance(line, Exception):
                        await sent.send(line)
                    elif refusal := refusal_of(line):
                        await replies.send(SessionMessage(refusal))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(relay)
            yield messages, replies
            tasks.cancel_scope.cancel()


def refusal_of(error: Exception) -> JSONRPCError | None:
    """Returns the reply to a line that is no message; None where the line is blank.

    Its `id` is that of the request, or null where none is found.
    """
    if not isinstance(error, ValidationError):
        return _refusal(None, INVALID_REQUEST, str(error))
    errors = error.errors(include_url=False)
    inputs = [given["input"] for given in errors]
    reason = errors[0]["msg"]
    if isinstance(inputs[0], str):
        is_blank = not inputs[0].strip()
        return None if is_blank else _refusal(request_id(inputs[0]), PARSE_ERROR, reason)
    # The errors say of each kind of message what is missing; some have the whole line as input.
    known = (given["id"] for given in inputs if isinstance(given, dict) and "id" in given)
    number = next(known, None)
    return _refusal(number if isinstance(number, int | str) else None, INVALID_REQUEST, reason)


def _refusal(number: int | str | None, code: int, reason: str) -> JSONRPCError:
    message = f"this is no JSON-RPC message: {reason}"
    return JSONRPCError(jsonrpc="2.0", id=number, error=ErrorData(code=code, message=message))


def request_id(text: str) -> int | str | None:
    """Returns the id in a JSON-RPC request that the SDK does not take; None where none is found."""
    try:
        message: object = json.loads(text)
    except (ValueError, RecursionError):
        return None
    number = message.get("id") if isinstance(message, dict) else None
    return number if isinstance(number, int | str) else None

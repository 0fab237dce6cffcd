"""`ros2-memory ask`: any tool of the server, in process, without a server."""

import json
from collections.abc import Mapping, Sequence
from typing import Annotated, Final

import anyio
import typer

from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.cli.opening import opened
from ros2_memory.cli.output import show
from ros2_memory.cli.running import (
    NOT_SO,
    AsJson,
    BagDir,
    Sets,
    Verbose,
    busy,
    output,
    reporting,
    say,
)
from ros2_memory.cli.settling import settings_for
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Memory, QuerySettings
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.tools.replies import Reply
from ros2_memory.tools.spec_tools import build_tools

NEVER: Final = "never: no recorded message meets the condition"
"""What `null` says, the reply of tools that look for the last match."""
Schemas = Mapping[str, Mapping[str, object]]
"""By tool, the JSON schema of its arguments."""


def complete(incomplete: str) -> list[str]:
    """The tools whose names begin so, for the shell."""
    names = (tool.name for tool in build_tools(QuerySettings(), 1.0, writing=True))
    return [name for name in names if name.startswith(incomplete)]


def ask(
    tool: Annotated[
        str | None,
        typer.Argument(
            metavar="TOOL", help="Its name; none: they are listed.", autocompletion=complete
        ),
    ] = None,
    given: Annotated[
        list[str] | None,
        typer.Argument(metavar="key=value|JSON", help="What the tool is asked."),
    ] = None,
    *,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    settings: Sets = None,
    verbose: Verbose = False,
) -> None:
    """Ask any tool of the query server, without a server.

    Values are JSON where they read as such (seconds_ago=10, value=true), else text. With --json
    the reply is exactly what an MCP client receives.
    """
    with reporting("ask"):
        chosen = settings_for(bag_dir, settings)
        memory = opened(chosen, verbose=verbose)
        dispatcher = build_dispatcher(chosen, memory)
        schemas = {each.name: each.schema for each in dispatcher.tools}
        if tool is None:
            show(output(), [_row(name, schema) for name, schema in schemas.items()])
            return
        arguments = parsed(given or (), schemas.get(tool, {}))
        with busy(f"asking {tool}"):
            reply = asked(dispatcher, tool, arguments)
    answer: JsonValue = json.loads(reply.text)
    if as_json:
        say(reply.text)
    elif answer is None:
        say(NEVER)
    else:
        show(output(), answer, _now(memory))
    if tool not in schemas:
        typer.echo(f"tools: {', '.join(schemas)}", err=True)
    if reply.is_error or is_without_answer(answer):
        raise typer.Exit(NOT_SO)


def _now(memory: Memory) -> float:
    """What ages count from (Unix seconds)."""
    latest = memory.index.snapshot().dating.latest
    wall = memory.limits.now == "wall" or latest is None
    return unix_from_ns(memory.clock.now() if wall or latest is None else latest)


def asked(dispatcher: Dispatcher, tool: str, arguments: Mapping[str, object]) -> Reply:
    """The reply of one tool."""
    try:
        return anyio.run(dispatcher.answer, tool, arguments)
    finally:
        dispatcher.stop()


def is_without_answer(reply: JsonValue) -> bool:
    """Whether a reply only says why there is none."""
    return isinstance(reply, dict) and "error" in reply


def parsed(given: Sequence[str], schema: Mapping[str, object]) -> dict[str, object]:
    """The arguments of a tool: one JSON object, or `key=value` each.

    Raises:
        InvalidArgumentsError: it is neither.
    """
    if len(given) == 1 and given[0].lstrip().startswith("{"):
        value = _json(given[0])
        if not isinstance(value, dict):
            raise InvalidArgumentsError(f"{given[0]} is no JSON object")
        return {**value}
    arguments: dict[str, object] = {}
    for each in given:
        key, equals, text = each.partition("=")
        if not equals or not key:
            raise InvalidArgumentsError(
                f"{each!r} is no argument; write key=value, such as seconds_ago=10, or one JSON "
                "object"
            )
        arguments[key] = text if _is_text(schema, key) else _value(text)
    return arguments


def _value(text: str) -> JsonValue:
    value = _json(text)
    return text if value is None and text != "null" else value


def _json(text: str) -> JsonValue:
    """What a text says as JSON; None where it is none."""
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value


def _is_text(schema: Mapping[str, object], key: str) -> bool:
    """Whether a tool takes this argument as text alone, whatever it looks like."""
    properties = schema.get("properties")
    known = properties.get(key) if isinstance(properties, dict) else None
    return isinstance(known, dict) and known.get("type") == "string"


def _row(name: str, schema: Mapping[str, object]) -> dict[str, JsonValue]:
    properties, required = schema.get("properties"), schema.get("required")
    names = list(properties) if isinstance(properties, dict) else []
    needed = required if isinstance(required, list) else []
    return {
        "tool": name,
        "arguments": ", ".join(each if each in needed else f"{each}?" for each in names),
    }

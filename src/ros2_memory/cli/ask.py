"""`ros2-memory ask`: any tool of the server, in process, without a server."""

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Final

import anyio
import typer

from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.bootstrap_fleet import build_fleet
from ros2_memory.cli.options import (
    EXIT_NEGATIVE,
    AsJson,
    BagDir,
    Recording,
    Sets,
    Verbose,
    is_folder,
    load_to_look,
    open_memory,
    parse_duration,
    parse_time,
    present,
    print_line,
    spinner,
    stdout_console,
)
from ros2_memory.cli.output import print_reply
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import QuerySettings
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.tools.arguments import TIME_KINDS
from ros2_memory.tools.replies import Reply
from ros2_memory.tools.spec_tools import build_tools

_SETTING: Final = re.compile(
    r"((recording|data|reader|retention|server|fleet|logging)\.\w|(deployment|storage|recorder)=).*",
    re.DOTALL,
)
"""A word that sets a setting; no argument of a tool is named so."""
_OF_TYPE: Final = ("type", "items")
NEVER: Final = "never: no recorded message meets the condition"
"""Printed for `null`, the reply of tools that look for the last match."""


def complete(incomplete: str) -> list[str]:
    """Returns the tools whose names begin so, for the shell's completion."""
    names = (tool.name for tool in build_tools(QuerySettings(), writing=True))
    return [name for name in names if name.startswith(incomplete)]


def ask(
    tool: Annotated[
        str | None,
        typer.Argument(
            metavar="TOOL",
            help="The name of the tool. Without it, ask lists the tools.",
            autocompletion=complete,
        ),
    ] = None,
    given: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="key=value|JSON",
            help="Arguments of the tool, settings (data.now=latest), and a bag or folder.",
        ),
    ] = None,
    *,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    recording: Recording = None,
    settings: Sets = None,
    verbose: Verbose = False,
) -> None:
    """Call any tool of the query server, without a server.

    Values are read as JSON if they are JSON (seconds_ago=10, value=true), else as text. You can
    write times and durations as start=14:05 or seconds_ago=10m. --json prints exactly what an MCP
    client receives.
    """
    words = [*(given or ())]
    if tool is not None and _SETTING.fullmatch(tool):
        tool, words = None, [tool, *words]
    if tool is not None and is_folder(tool) and tool not in complete(tool):
        tool, words = None, [tool, *words]
    of_settings = [each for each in words if _SETTING.fullmatch(each) or is_folder(each)]
    loaded = load_to_look(bag_dir, [*(settings or ()), *of_settings], recording)
    fleet = build_fleet(loaded)
    memory = open_memory(loaded, verbose=verbose, scans=fleet is None)
    dispatcher = build_dispatcher(loaded, memory, fleet=fleet)
    tools = {each.name: each for each in dispatcher.tools}
    if tool is None:
        rows: list[JsonValue] = [_tool_row(each.name, each.schema) for each in dispatcher.tools]
        if as_json:
            print_line(json.dumps(rows))
        else:
            print_reply(stdout_console(), rows)
        return
    schema = tools[tool].schema if tool in tools else {}
    asked = parse_arguments([each for each in words if each not in of_settings], schema)
    arguments = with_times(asked, schema, unix_from_ns(present(memory)))
    with spinner(f"asking {tool}"):
        (reply,) = call_tools(dispatcher, {tool: arguments})
    answer: JsonValue = json.loads(reply.text)
    if as_json:
        print_line(reply.text)
    elif answer is None:
        print_line(NEVER)
    else:
        print_reply(stdout_console(), answer, unix_from_ns(present(memory)))
    if tool not in tools:
        typer.echo(f"tools: {', '.join(tools)}", err=True)
    if reply.is_error or is_error(answer):
        raise typer.Exit(EXIT_NEGATIVE)


def call_tools(dispatcher: Dispatcher, calls: Mapping[str, Mapping[str, object]]) -> list[Reply]:
    """Returns the replies of tools, by name and arguments; the dispatcher takes no further call."""

    async def replies() -> list[Reply]:
        return [await dispatcher.answer(tool, arguments) for tool, arguments in calls.items()]

    try:
        return anyio.run(replies)
    finally:
        dispatcher.stop()


def is_error(reply: JsonValue) -> bool:
    """Returns whether a reply only says why there is no answer."""
    return isinstance(reply, dict) and "error" in reply


def parse_arguments(given: Sequence[str], schema: Mapping[str, object]) -> dict[str, object]:
    """Parses the arguments of a tool: one JSON object, or `key=value` each.

    Args:
        given: the words of the command line.
        schema: the tool's JSON schema: what it takes as text is not parsed as JSON.

    Raises:
        InvalidArgumentsError: a word is neither.
    """
    if len(given) == 1 and given[0].lstrip().startswith("{"):
        value = _from_json(given[0], None)
        if not isinstance(value, dict):
            raise InvalidArgumentsError(f"{given[0]} is not a JSON object")
        return {**value}
    arguments: dict[str, object] = {}
    for word in given:
        key, equals, text = word.partition("=")
        if not equals or not key:
            raise InvalidArgumentsError(
                f"{word!r} is not an argument; write key=value, such as seconds_ago=10, or one "
                "JSON object"
            )
        arguments[key] = text if _takes_text(schema, key) else _from_json(text, text)
    return arguments


def with_times(
    arguments: Mapping[str, object], schema: Mapping[str, object], now: float
) -> dict[str, object]:
    """Returns a tool's arguments, with times and durations as people write them in seconds.

    Other text is passed on unchanged, and the tool reports its error. `now` is in Unix seconds.
    """
    properties = schema.get("properties")
    known = properties if isinstance(properties, dict) else {}
    return {key: _in_seconds(value, known.get(key), now) for key, value in arguments.items()}


def _in_seconds(value: object, schema: object, now: float) -> object:
    kind, items = (schema.get(key) if isinstance(schema, dict) else None for key in _OF_TYPE)
    if isinstance(value, list):
        return [_in_seconds(each, items, now) for each in value]
    if isinstance(value, str) and kind == "array":
        return _in_seconds(value, items, now)
    if isinstance(value, str) and kind == "number":
        return parse_duration(value) or value
    if isinstance(value, str) and kind == [*TIME_KINDS]:
        with suppress(InvalidArgumentsError):
            return parse_time(value, now)
    return value


def _from_json(text: str, otherwise: str | None) -> JsonValue:
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):
        return otherwise
    return value


def _takes_text(schema: Mapping[str, object], key: str) -> bool:
    properties = schema.get("properties")
    known = properties.get(key) if isinstance(properties, dict) else None
    return isinstance(known, dict) and known.get("type") == "string"


def _tool_row(name: str, schema: Mapping[str, object]) -> JsonValue:
    properties, required = schema.get("properties"), schema.get("required")
    names = list(properties) if isinstance(properties, dict) else []
    needed = required if isinstance(required, list) else []
    return {
        "tool": name,
        "arguments": ", ".join(each if each in needed else f"{each}?" for each in names),
    }

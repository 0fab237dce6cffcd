"""`ros2-memory ask`: any tool of the server, in process, without a server."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Final

import anyio
import typer

from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.bootstrap_fleet import build_fleet
from ros2_memory.cli.app import TOOL_HELP
from ros2_memory.cli.options import (
    AsJson,
    BagDir,
    Recording,
    Verbose,
    is_folder,
    load_to_look,
    open_memory,
    parse_duration,
    parse_time,
    present_time,
    with_date,
)
from ros2_memory.cli.output import (
    print_json,
    print_line,
    print_reply,
    spinner,
    with_plain_numbers,
)
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.reply import JsonObject
from ros2_memory.core.timebase import Deadline, unix_from_ns, unix_from_text
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.tools.arguments import TIME_KINDS
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.declaration import Tool
from ros2_memory.tools.replies import Reply

_SETTING: Final = re.compile(
    r"\+{0,2}((recording|data|reader|store|retention|memory|server|fleet|lake|logging)\.\w"
    r"|(deployment|storage|recorder|lake)=).*",
    re.DOTALL,
)
"""A word that sets a setting; no argument of a tool is named so."""
_QUERY_LAKE: Final = "query_lake"
"""Not imported: without a fleet nothing of `fleet` is."""
NEVER: Final = "never: no recorded message meets the condition"
"""Printed for `null`, the reply of tools that look for the last match."""


def complete(incomplete: str) -> list[str]:
    """Returns the tools whose names begin with `incomplete`, for the shell's completion."""
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
    verbose: Verbose = False,
    tool_help: Annotated[bool, typer.Option(TOOL_HELP, hidden=True)] = False,
) -> bool:
    """Call any tool of the query server, without a server.

    Values are read as JSON if they are JSON (seconds_ago=10, value=true), else as text. You can
    write times and durations as start=14:05 or seconds_ago=10m. --json prints exactly what an MCP
    client receives.
    """
    if tool is not None and tool_help:
        _print_help(tool)
        return False
    words = [*filter(None, [tool]), *(given or ())]
    # Where a folder has the name of a tool, the first word is the tool.
    is_tool = tool in complete(tool or "")
    looking = [
        word
        for word in words
        if _SETTING.fullmatch(word) or (is_folder(word) and not (is_tool and word == tool))
    ]
    question = [word for word in words if word not in looking]
    loaded = load_to_look(bag_dir, looking, recording)
    fleet = build_fleet(loaded)
    memory = open_memory(loaded, verbose=verbose, allows_fleet=True)
    dispatcher = build_dispatcher(loaded, memory, fleet=fleet)
    if not question:
        _print_tools(dispatcher.tools.values(), as_json=as_json)
        return False
    # A folder that does not exist may stand before the tool.
    name = next((word for word in question if word in dispatcher.tools), question[0])
    arguments = [word for word in question if word and word != name]
    with spinner(f"asking {name}"):
        if fleet is not None:
            with suppress(InvalidArgumentsError):  # the tool refuses such arguments itself
                schemas = _schemas_of(dispatcher, name)
                robot = parse_arguments(arguments, schemas).get("robot")
                call = Call(Deadline.after(loaded.server.call_timeout_s))
                memory = fleet.newest(robot, call) or memory
        reply = answer_to(dispatcher, memory, name, arguments)
    answer: JsonValue = json.loads(reply.text)
    if as_json:
        print_line(reply.text)
    elif answer is None:
        print_line(NEVER)
    else:
        print_reply(with_plain_numbers(answer, name == _QUERY_LAKE))
    return reply.is_error or (isinstance(answer, dict) and "error" in answer)


def _print_tools(tools: Iterable[Tool], *, as_json: bool) -> None:
    """Prints each tool with the first sentence of its description, and its arguments."""
    rows: list[JsonValue] = []
    for tool in tools:
        description = tool.description.removeprefix("Blocking. ")
        purpose = re.split(r"\. |;", description)[0].rstrip(".")
        arguments = ", ".join(_argument_names(tool))
        rows.append({"tool": tool.name, "purpose": purpose, "arguments": arguments})
    if as_json:
        print_json(rows)
    else:
        print_reply(rows)
        print_line("`ros2-memory ask TOOL --help` describes a tool and its arguments")


def answer_to(dispatcher: Dispatcher, memory: Memory, name: str, words: Sequence[str]) -> Reply:
    """Returns the reply of a tool, asked with words of the command line, and stops the dispatcher.

    Times and durations may be written as people write them.

    Raises:
        InvalidArgumentsError: a word is no argument, or a text is no time.
    """
    schemas = _schemas_of(dispatcher, name)
    now = unix_from_ns(present_time(memory))
    arguments = {
        key: _with_parsed_times(value, schemas.get(key), now)
        for key, value in parse_arguments(words, schemas).items()
    }
    return call_once(dispatcher, name, arguments)


def _schemas_of(dispatcher: Dispatcher, name: str) -> Mapping[str, JsonObject]:
    """Returns the JSON schemas of a tool's arguments; none of a tool that is not offered."""
    return dispatcher.tools[name].arguments if name in dispatcher.tools else {}


def call_once(dispatcher: Dispatcher, tool: str, arguments: Mapping[str, object]) -> Reply:
    """Calls a tool, returns its reply, and stops the dispatcher."""
    try:
        return anyio.run(dispatcher.answer, tool, arguments)
    finally:
        dispatcher.stop()


def parse_arguments(words: Sequence[str], schemas: Mapping[str, JsonObject]) -> dict[str, object]:
    """Parses the arguments of a tool: either one JSON object, or `key=value` words.

    `schemas` are the JSON schemas of the arguments by name. A value is read as JSON if it is JSON,
    unless its schema says that it is a string.

    Raises:
        InvalidArgumentsError: a word has neither form.
    """
    if len(words) == 1 and words[0].lstrip().startswith("{"):
        value = _json_or(words[0], None)
        if not isinstance(value, dict):
            raise InvalidArgumentsError(f"{words[0]} is not a JSON object")
        return {**value}
    arguments: dict[str, object] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals or not key:
            raise InvalidArgumentsError(
                f"{word!r} is not an argument, and there is no such file or folder; write "
                "key=value, such as seconds_ago=10, or one JSON object, or name a bag or a folder "
                "of bags"
            )
        is_text = schemas.get(key, {}).get("type") == "string"
        arguments[key] = text if is_text else _json_or(text, text)
    return arguments


def _with_parsed_times(value: object, schema: object, now: float) -> object:
    """Converts the texts of an argument that its JSON schema wants as times or durations.

    Durations become seconds, times Unix seconds; a time in ISO 8601 stays a text, since the tool
    knows how long it lasts: a day, a minute, a second. `now` (Unix s) is what "ago" counts from.
    """
    schema = schema if isinstance(schema, dict) else {}
    kind, items = schema.get("type"), schema.get("items")
    if isinstance(value, list):
        return [_with_parsed_times(inner, items, now) for inner in value]
    if not isinstance(value, str):
        return value
    if kind == "array":
        return _with_parsed_times(value, items, now)
    if kind == "number":
        seconds = parse_duration(value)
        return value if seconds is None else seconds
    if kind == [*TIME_KINDS]:
        value = with_date(value, now)
        try:
            unix_from_text(value)
        except ValueError:
            return parse_time(value, now)
    return value


def _json_or(text: str, otherwise: str | None) -> JsonValue:
    """Returns the value of a JSON text; `otherwise` if the text is not JSON."""
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):
        return otherwise
    return value


def _argument_names(tool: Tool) -> list[str]:
    """Returns the names of a tool's arguments; optional ones end in `?`."""
    required = tool.described.required
    return [name if name in required else f"{name}?" for name in tool.arguments]


def _print_help(name: str) -> None:
    """Prints what a tool does, and its arguments.

    Raises:
        InvalidArgumentsError: there is no such tool.
    """
    tools = {tool.name: tool for tool in build_tools(QuerySettings(), writing=True)}
    if name not in tools:
        raise InvalidArgumentsError(f"there is no tool {name}; the tools are: {', '.join(tools)}")
    tool = tools[name]
    print_line(f"ros2-memory ask {name} key=value ... [PATH]\n\n{tool.description}\n")
    for argument, schema in zip(_argument_names(tool), tool.arguments.values(), strict=True):
        print_line(f"  {argument:<20} {schema.get('description', '')}".rstrip())

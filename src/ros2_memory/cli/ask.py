"""`ros2-memory ask`: any tool of the server, in process, without a server."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
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
    Sets,
    Verbose,
    is_folder,
    load_to_look,
    newest_day,
    open_memory,
    parse_duration,
    parse_time,
    present_time,
    with_date,
)
from ros2_memory.cli.output import print_line, print_reply, spinner, with_shorter_lists
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
    r"\+{0,2}((recording|data|reader|retention|server|fleet|lake|logging)\.\w"
    r"|(deployment|storage|recorder|lake)=).*",
    re.DOTALL,
)
"""A word that sets a setting; no argument of a tool is named so."""
_TIMES_OF_RECAP: Final = ("last_s", "start", "end", "around")
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
    words = [word for word in (tool, *(given or ())) if word is not None]
    of_settings = [
        word
        for word in words
        if _SETTING.fullmatch(word)
        or (is_folder(word) and not (word == tool and word in complete(word)))
    ]
    asked = [word for word in words if word not in of_settings]
    loaded, _ = load_to_look(bag_dir, [*(settings or ()), *of_settings], recording)
    fleet = build_fleet(loaded)
    memory = open_memory(loaded, verbose=verbose, scans=fleet is None)
    dispatcher = build_dispatcher(loaded, memory, fleet=fleet)
    if not asked:
        rows: list[JsonValue] = []
        for tool_listed in dispatcher.tools:
            description = tool_listed.description.removeprefix("Blocking. ")
            purpose = re.split(r"\. |;", description)[0].rstrip(".")
            taken = ", ".join(argument for argument, _ in _arguments(tool_listed))
            rows.append({"tool": tool_listed.name, "purpose": purpose, "arguments": taken})
        if as_json:
            print_line(json.dumps(rows))
        else:
            print_reply(rows)
            print_line("`ros2-memory ask TOOL --help` describes a tool and its arguments")
        return False
    # A folder that is not there may stand before the tool.
    tools = {tool.name: tool.arguments for tool in dispatcher.tools}
    name = next((word for word in asked if word in tools), asked[0])
    rest = [word for word in asked if word and word != name]
    with spinner(f"asking {name}"):
        if fleet is not None:
            with suppress(InvalidArgumentsError):  # the tool refuses them
                robot = parse_arguments(rest, tools.get(name, {})).get("robot")
                call = Call(Deadline.after(loaded.server.call_timeout_s))
                memory = fleet.newest(robot, call) or memory
        reply = answer_to(dispatcher, memory, name, rest)
    answer: JsonValue = json.loads(reply.text)
    if as_json:
        print_line(reply.text)
    elif answer is None:
        print_line(NEVER)
    else:
        if isinstance(answer, dict):
            answer = with_shorter_lists(answer, ["waypoints"])
        print_reply(answer, unix_from_ns(present_time(memory)))
    return reply.is_error or (isinstance(answer, dict) and "error" in answer)


def answer_to(dispatcher: Dispatcher, memory: Memory, name: str, words: Sequence[str]) -> Reply:
    """Returns the reply of a tool to the words of the command line; `called` says what it ends.

    Times and durations may be as people write them. A `recap` without a time is that of the newest
    day.

    Raises:
        InvalidArgumentsError: a word is no argument, or a text is no time.
    """
    tool = next((tool for tool in dispatcher.tools if tool.name == name), None)
    schemas = {} if tool is None else tool.arguments
    now = unix_from_ns(present_time(memory))
    arguments = {
        key: _with_parsed_times(value, schemas.get(key), now)
        for key, value in parse_arguments(words, schemas).items()
    }
    if name == "recap" and arguments.keys().isdisjoint(_TIMES_OF_RECAP):
        first, last = newest_day(memory).asked()
        arguments |= {"start": unix_from_ns(first), "end": unix_from_ns(last)}
    return called(dispatcher, name, arguments)


def called(dispatcher: Dispatcher, tool: str, arguments: Mapping[str, object]) -> Reply:
    """Returns the reply of a tool; the dispatcher takes no further call."""
    try:
        return anyio.run(dispatcher.answer, tool, arguments)
    finally:
        dispatcher.stop()


def parse_arguments(given: Sequence[str], schemas: Mapping[str, JsonObject]) -> dict[str, object]:
    """Parses the arguments of a tool: one JSON object, or `key=value` each.

    What `schemas`, the JSON schemas of the tool's arguments, take as text is not parsed.

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
                f"{word!r} is not an argument, and there is no such file or folder; write "
                "key=value, such as seconds_ago=10, or one JSON object, or name a bag or a folder "
                "of bags"
            )
        # A list in place of one text is read from its JSON by the argument itself.
        is_text = schemas.get(key, {}).get("type") == "string"
        arguments[key] = text if is_text else _from_json(text, text)
    return arguments


def _with_parsed_times(value: object, schema: object, now: float) -> object:
    """Returns an argument with the times and durations in it parsed, as its schema has them."""
    schema = schema if isinstance(schema, dict) else {}
    kind, items = schema.get("type"), schema.get("items")
    if isinstance(value, list):
        return [_with_parsed_times(inner, items, now) for inner in value]
    if isinstance(value, str) and kind == "array":
        return _with_parsed_times(value, items, now)
    if isinstance(value, str) and kind == "number":
        seconds = parse_duration(value)
        return value if seconds is None else seconds
    if isinstance(value, str) and kind == [*TIME_KINDS]:
        value = with_date(value, now)
        try:
            unix_from_text(value)  # the tool knows how long it lasts: a day, a minute, a second
        except ValueError:
            return parse_time(value, now)
    return value


def _from_json(text: str, otherwise: str | None) -> JsonValue:
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):
        return otherwise
    return value


def _arguments(tool: Tool) -> Iterator[tuple[str, JsonObject]]:
    """Yields each argument with its schema; the name of one that may be left out ends in `?`."""
    required = tool.schema.get("required")
    needed = required if isinstance(required, list) else []
    for name, schema in tool.arguments.items():
        yield name if name in needed else f"{name}?", schema


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
    for argument, schema in _arguments(tool):
        print_line(f"  {argument:<20} {schema.get('description', '')}".rstrip())

"""The tables of docs/reference that are made of code: tools, configuration, log events.

Each stands in its page between `<!-- begin: NAME -->` and `<!-- end: NAME -->`; what people wrote
around it, and the last column of the log events, is theirs.
"""

import ast
import json
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter

from ros2_memory.cli.app import COMMANDS, COMMON_EXIT_CODES
from ros2_memory.config import DuckdbNode, Ros2BagNode, Rosbag2Node, Settings
from ros2_memory.core.errors import EpisodicError
from ros2_memory.lake.tables import KEYS, TABLES
from ros2_memory.recorder import event_log
from ros2_memory.tools.arguments import TIME_KINDS
from ros2_memory.tools.declaration import Tool
from tests.support.documented_history import CALLS
from tests.support.memories import ROOT

SOURCE = ROOT / "src" / "ros2_memory"
LEVELS = {
    "debug": "debug",
    "info": "info",
    "warning": "warning",
    "warn": "warning",
    "error": "error",
    "exception": "error",
    "fail": "error",
    "lasting": "error",
    "lasting_faults": "error",
    "lasting_if_refused": "error",
    "remark": "warning",
}
OPTIONS: Mapping[str, tuple[str, str, type]] = {
    "lake/duckdb.yaml": ("lake", "engine", DuckdbNode),
    "recorder/ros2bag.yaml": ("recorder", "", Ros2BagNode),
    "storage/rosbag2.yaml": ("storage", "", Rosbag2Node),
}
"""Options of groups that have keys of their own: the section of these, and what holds them."""
VARIES = {"used_gb", "size_gb", "growth_gb_per_day", "full_in_days", "keeps_days"}
"""Sizes depend on the compressor's version by some bytes, so they are shown and not compared."""


def section(page: str, name: str) -> str:
    """What stands between a page's marks."""
    found = re.search(rf"<!-- begin: {name} -->\n\n(.*?)\n\n<!-- end: {name} -->", page, re.DOTALL)
    assert found, f"the page has no marks of {name}"
    return found[1]


def with_section(page: str, name: str, text: str) -> str:
    """The page with `text` between its marks."""
    before, begin, rest = page.partition(f"<!-- begin: {name} -->")
    _, end, after = rest.partition(f"<!-- end: {name} -->")
    return f"{before}{begin}\n\n{text}\n\n{end}{after}"


def lake_tables() -> str:
    """The columns of each table of a lake; those that the page's head explains are passed over."""
    keys = ((name, *told) for name, told in KEYS.items())
    parts = [f"## Of all\n\n{_listed(keys)}"]
    for lake_table in TABLES.values():
        order = ", ".join(f"`{name}`" for name in lake_table.order)
        own = _listed(
            (name, *told)
            for name, told in lake_table.columns.items()
            if name not in {*KEYS, "topic", "topic_key", "time"}
        )
        parts.append(
            f"## {lake_table.name}\n\nA row for each {lake_table.row}, by {order}.\n\n{own}"
        )
    return "\n\n".join(parts)


def _listed(columns: Iterable[tuple[str, str, str]]) -> str:
    """A line for each column; such as have one type and meaning share it."""
    alike: dict[tuple[str, str], list[str]] = {}
    for name, kind, meaning in columns:
        alike.setdefault((kind, meaning), []).append(f"`{name}`")
    return "\n".join(
        f"- {', '.join(names)} ({kind}): {told.removesuffix(' (ns)')}"
        for (kind, told), names in alike.items()
    )


def codes(cls: type[EpisodicError]) -> set[str]:
    """The codes of an error and of those below it."""
    return {cls.code}.union(*(codes(each) for each in cls.__subclasses__()))


def exit_list() -> str:
    """Each command, what it is for, and what its exit codes say, but for success."""
    lines = [
        f"- `{name}`: {purpose}" + (f" (1: {_short(negative)})" if negative else "")
        for name, (_, purpose, negative) in COMMANDS.items()
    ]
    return (
        "In brackets are exit codes. 0 is success; for others stderr has the reason. Where nothing "
        f"else is said, {_short(COMMON_EXIT_CODES)}.\n\n" + "\n".join(lines)
    )


def _short(why: str) -> str:
    """What an exit code says, without that stderr says more."""
    return re.sub(r" \((see )?stderr[^)]*\)", "", why)


def tool_sections(tools: Iterable[Tool], replies: Mapping[str, str]) -> str:
    """Each tool: what it answers, its arguments, a call and the reply.

    An argument that several tools describe alike stands once, before them; required ones are bold.
    A tool that is another one up to now, or some seconds ago, is a line behind that one.
    """
    whole = {tool.name: tool for tool in tools}
    counted = Counter(
        line
        for tool in whole.values()
        if _sibling(tool) is None
        for line in _arguments(tool).values()
    )
    repeated = [line for line, number in counted.items() if number > 1]
    meanings = Counter(line.partition(":")[0] for line in repeated)
    common = [line for line in repeated if meanings[line.partition(":")[0]] == 1]
    parts = ["### Arguments of several tools", "\n".join(f"- {line}" for line in common)]
    for name, tool in whole.items():
        sibling = _sibling(tool)
        if sibling is None:
            parts.append(_tool(tool, replies[name], common))
        else:
            parts.append(_variant(tool, whole[sibling]))
    return "\n\n".join(parts)


def shown(reply: str) -> str:
    """A reply as a page shows it: whole, in lines of a readable length."""
    value = json.loads(reply)
    return f"```json\n{_laid_out(value)}\n```"


def without_sizes(text: str) -> str:
    """A page's text without the numbers that vary."""
    return re.sub(rf'"({"|".join(sorted(VARIES))})": [\d.e+-]+', r'"\1": 0', text)


def _laid_out(value: Any, indent: int = 0) -> str:
    """JSON of which whatever fits stands in one line."""
    flat = json.dumps(value, ensure_ascii=False)
    if len(flat) + indent <= 116 or not isinstance(value, dict | list) or not value:
        return flat
    inner = " " * (indent + 2)
    if isinstance(value, dict):
        items = [f"{json.dumps(k)}: {_laid_out(v, indent + 2)}" for k, v in value.items()]
    else:
        items = [_laid_out(each, indent + 2) for each in value]
    opening, closing = ("{", "}") if isinstance(value, dict) else ("[", "]")
    joined = f",\n{inner}".join(items)
    return f"{opening}\n{inner}{joined}\n{' ' * indent}{closing}"


def _sibling(tool: Tool) -> str | None:
    """The tool that this one is, but for the time that it asks about."""
    found = re.match(r"(?:Blocking\. )?As (\w+),", tool.description)
    return found[1] if found else None


def _arguments(tool: Tool) -> dict[str, str]:
    """What each argument may hold and means."""
    properties: Any = tool.schema["properties"]
    return {
        name: f"`{name}`: {_kind(each)}{_default(each)}. {each.get('description', '')}".rstrip()
        for name, each in properties.items()
    }


def _tool(tool: Tool, reply: str, common: Iterable[str]) -> str:
    what = tool.description.partition(" Example: ")[0]
    lines, also = [], []
    for name, line in _arguments(tool).items():
        if line in common:
            also.append(_marked(tool, name))
        else:
            lines.append(f"- {_marked(tool, name)}:{line.partition(':')[2]}")
    if also:
        lines.append(f"- as above: {', '.join(also)}")
    wrapped = textwrap.wrap(what, 100, break_long_words=False, break_on_hyphens=False)
    parts = [f"### `{tool.name}`", "\n".join(wrapped), "\n".join(lines) or "No arguments."]
    call = json.dumps(CALLS[tool.name], ensure_ascii=False)
    parts += [f"```json\n{call}\n```"] * (CALLS[tool.name] != {}) + [shown(reply)]
    return "\n\n".join(parts)


def _variant(tool: Tool, other: Tool) -> str:
    """The line of a tool that is another one, but for the time that it asks about."""
    when = tool.description.partition(", ")[2].rstrip(".")
    properties: Any = tool.schema["properties"]
    arguments = (
        _marked(tool, name) + ("" if name in other.arguments else f" ({_kind(schema)})")
        for name, schema in properties.items()
    )
    return f"`{tool.name}` is the same {when}: {', '.join(arguments)}."


def _marked(tool: Tool, argument: str) -> str:
    required: Any = tool.schema.get("required", [])
    return f"**`{argument}`**" if argument in required else f"`{argument}`"


def _default(schema: Mapping[str, Any]) -> str:
    return f", default `{json.dumps(schema['default'])}`" if "default" in schema else ""


def _kind(schema: Mapping[str, Any]) -> str:
    """What an argument or a key may hold."""
    if "enum" in schema:
        return ", ".join(f"`{each}`" for each in schema["enum"])
    if "$ref" in schema:
        return "mapping"
    if "anyOf" in schema:
        return "/".join(dict.fromkeys(_kind(each) for each in schema["anyOf"]))
    if schema.get("type") == [*TIME_KINDS]:
        return "time"
    if isinstance(schema.get("type"), list):
        return "/".join(_kind({**schema, "type": each}) for each in schema["type"])
    kind: str = {
        "array": "list of times" if schema.get("items") == {"type": [*TIME_KINDS]} else "list",
        "null": "`null`",
        "string": "path" if schema.get("format") == "path" else "text",
    }.get(schema.get("type", ""), schema.get("type", ""))
    bounds = [
        f"{sign}{schema[key]:g}"
        for key, sign in (
            ("exclusiveMinimum", ">"),
            ("minimum", "≥"),
            ("maximum", "≤"),
            ("exclusiveMaximum", "<"),
        )
        if key in schema and schema[key] != 10**9  # of all
    ]
    return " ".join([kind, *bounds])


def documented_settings() -> str:
    """Every key: what it may hold, its default and what its file says of it."""
    folder = ROOT / "config"
    rows = []
    for key, default, meaning in (
        *keys_of(folder / "config.yaml", ""),
        *(
            key
            for option, (group, _, _) in OPTIONS.items()
            for key in keys_of(folder / option, f"{group}.")
        ),
    ):
        schema = _schema_of(key)
        kind = "" if "enum" in schema else _kind(schema)  # its comment names the choices
        kind = kind.replace("number ", "")  # the page's head
        if default == "null":
            kind = f"or {kind.replace('/`null`', '')}"
        elif not any(word in kind for word in ("integer", ">", "≥", "null")):
            kind = ""  # the default shows it
        held = f"`{default}`" + (f" {kind}" if kind[:2] == "or" else f", {kind}" if kind else "")
        rows.append(f"- `{key}` ({held}): {meaning.replace(' | ', ', ')}")
    return "\n".join(rows)


def keys_of(path: Path, prefix: str) -> Iterator[tuple[str, str, str]]:
    """Key, default and meaning of each line that has one; links to other keys are passed over."""
    group = ""
    for line in path.read_text().splitlines():
        if found := re.fullmatch(r"(\w+):", line):
            group = f"{found[1]}."
        elif found := re.fullmatch(r"\s*(\w+): (\S.*?)\s+# (.*)", line):
            yield f"{prefix}{group}{found[1]}", found[2], found[3]


def _schema_of(key: str) -> Mapping[str, Any]:
    above, _, name = key.rpartition(".")
    for group, inner, node in OPTIONS.values():
        own: Mapping[str, Any] = TypeAdapter(node).json_schema()["properties"]
        if above == f"{group}.{inner}".rstrip(".") and name in own:
            break
    else:
        schema = _schema_of_settings()
        of_section = schema["properties"][above]["$ref"].rpartition("/")[2]
        own = schema["$defs"][of_section]["properties"]
    found: Mapping[str, Any] = own[name]
    return found


@cache
def _schema_of_settings() -> dict[str, Any]:
    return TypeAdapter(Settings).json_schema()


def configured_keys() -> set[str]:
    """Every key of the shipped files that holds a value of its own."""
    whole = yaml.safe_load((ROOT / "config" / "config.yaml").read_text())
    keys = {
        f"{group}.{name}"
        for group, members in whole.items()
        if isinstance(members, dict)
        for name in members
    }
    for file, (group, inner, _) in OPTIONS.items():
        own = yaml.safe_load((ROOT / "config" / file).read_text())
        keys |= {
            f"{group}.{inner}.{name}" if inner else f"{group}.{name}"
            for name in (own[inner] if inner else own)
            if name != "_target_"
        }
    return keys


def events() -> dict[str, set[str]]:
    """Every log event in the code, with its levels."""
    found: dict[str, set[str]] = {}
    for path in SOURCE.rglob("*.py"):
        for name, level in _events_of(ast.parse(path.read_text())):
            found.setdefault(name, set()).add(level)
    found |= {kind.value: {"info"} for kind in event_log._INFORM}
    found |= {kind.value: {"warning"} for kind in event_log._ADVICE}
    return found


def _events_of(tree: ast.AST) -> Iterator[tuple[str, str]]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not node.args:
            continue
        first = node.args[0]
        if not (isinstance(first, ast.Constant) and isinstance(first.value, str)):
            continue
        if isinstance(node.func, ast.Name) and node.func.id == "Rotation":
            is_fault = "is_fault" in {word.arg for word in node.keywords}
            yield first.value, "warning" if is_fault else "info"
        named = [each for each in ast.walk(node.func) if isinstance(each, ast.Attribute)]
        for method in named:
            if method.attr in LEVELS and _is_log(method.value):
                yield first.value, LEVELS[method.attr]


def _is_log(node: ast.AST) -> bool:
    name = node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
    is_own_method = name == "self"  # of EventLog
    return name in {"log", "_log", "events", "_events"} or is_own_method


def event_list(page: str) -> str:
    """The log events whose meaning a page says, by level: the worst that they have."""
    written = re.findall(r"^- `(\w+)`(?: \([^)]*\))?: (.+)$", page, re.MULTILINE)
    lines: dict[str, list[str]] = {"error": [], "warning": [], "info": [], "debug": []}
    levels_of = events()
    for name, meaning in sorted(written):
        levels = [level for level in lines if level in levels_of.get(name, ())]
        if levels:
            less = "".join(f" (or {level})" for level in levels[1:])
            lines[levels[0]].append(f"- `{name}`{less}: {meaning}")
    return "\n\n".join(
        part
        for level, listed in lines.items()
        for part in (f"## {level.capitalize()}", "\n".join(listed))
    )

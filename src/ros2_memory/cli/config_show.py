"""`ros2-memory config show`: the configuration as it is composed, and who set what."""

import json
import os
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Final

import typer
import yaml

from ros2_memory.cli.exits import epilog
from ros2_memory.cli.output import plain
from ros2_memory.cli.running import BagDir, Overrides, reporting, say
from ros2_memory.cli.settling import explained_for
from ros2_memory.config import AdapterNode, Settings
from ros2_memory.config_sources import GROUPS, Sources
from ros2_memory.core.model import JsonValue

MASK: Final = "********"
_SECRET: Final = ("token", "password", "secret", "credential")

config = typer.Typer(
    help="The configuration, as the programs see it.", no_args_is_help=True, rich_markup_mode=None
)


@config.command("show", epilog=epilog("config"))
def config_show(
    overrides: Overrides = None,
    bag_dir: BagDir = None,
    sources: Annotated[bool, typer.Option("--sources", help="Say of each key who set it.")] = False,
) -> None:
    """The configuration as YAML, composed of files, environment and arguments; no secrets.

    Whether there is a token for the server is told in a comment, never what it is.
    """
    with reporting("config show"):
        settings, source = explained_for(bag_dir, overrides)
    if sources:
        for line in sourced(settings, source):
            say(line)
        return
    say(yaml.safe_dump(nested(settings), sort_keys=False, allow_unicode=True).rstrip())
    for name in ("MEMORY_API_TOKEN", "MEMORY_API_TOKEN_FILE"):
        if os.environ.get(name):
            say(f"# {name} is set: {MASK}")


def sourced(settings: Settings, source: Sources) -> Iterator[str]:
    """A line for each group's choice and for each key: its name, who set it, its value.

    A group's own keys that only take over another key's value name that one.
    """
    yield f"# files are those of {source.folder}"
    rows: list[tuple[str, str, str]] = []
    for group in GROUPS:
        option, who = source.choice(group)
        rows.append((group, who, option or "null"))
    for key, value in leaves(settings):
        shown = _shown(key, value)
        rows.append((key, source(key), shown if isinstance(shown, str) else json.dumps(shown)))
    told = [(key, _briefly(who, source.folder), value) for key, who, value in rows]
    first, second = (max(len(row[column]) for row in told) for column in (0, 1))
    for key, who, value in told:
        yield f"{key:<{first}}  {who:<{second}}  {value}"


def _briefly(who: str, folder: Path) -> str:
    file, link, other = who.partition(", as ")
    return f"as {other}" if link else file.replace(f"in {folder}/", "")


def leaves(settings: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Every key with its value."""
    if not is_dataclass(settings):
        return
    for each in fields(settings):
        value: object = getattr(settings, each.name)
        name = "_target_" if isinstance(settings, AdapterNode) and each.name == "target" else ""
        key = f"{prefix}{name or each.name}"
        if is_dataclass(value):
            yield from leaves(value, f"{key}.")
        else:
            yield key, value


def nested(settings: object) -> dict[str, object]:
    """The settings as plain values, as the files have them."""
    whole: dict[str, object] = {}
    for key, value in leaves(settings):
        section, _, name = key.partition(".")
        part = whole.setdefault(section, {})
        if isinstance(part, dict):
            part[name] = _shown(key, value)
    return whole


def _shown(key: str, value: object) -> JsonValue:
    if value and any(word in key.rpartition(".")[2].lower() for word in _SECRET):
        return MASK
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, tuple | list):
        return [_shown("", each) for each in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return plain(str(value))

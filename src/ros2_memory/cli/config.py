"""`ros2-memory config show`: the configuration as it is composed, and who set each key."""

import json
import os
from collections.abc import Mapping
from typing import Annotated, Final

import typer
import yaml

from ros2_memory.cli.app import epilog
from ros2_memory.cli.options import AsJson, BagDir, Words, as_command, load_given
from ros2_memory.cli.output import leaves, print_json, print_line, print_reply
from ros2_memory.config import plain_values
from ros2_memory.config_sources import GROUPS, Sources
from ros2_memory.core.model import JsonValue

_MASK: Final = "********"

config = typer.Typer(
    help="The configuration that the programs use.", no_args_is_help=True, rich_markup_mode=None
)


@config.command("show", epilog=epilog("config"))
@as_command("config show")
def config_show(
    words: Words = None,
    bag_dir: BagDir = None,
    sources: Annotated[bool, "Show what set each key."] = False,
    as_json: AsJson = False,
) -> None:
    """Show the configuration as YAML, composed of files, environment and arguments; no secrets.

    A comment shows whether the server has a token, never the token itself.
    """
    settings, source = load_given(bag_dir, words)
    values = dict(leaves(plain_values(settings)))
    if as_json and sources:
        print_json({key: {"value": value, "set": source(key)} for key, value in values.items()})
    elif as_json:
        print_json(values)
    elif sources:
        _print_sources(values, source)
    else:
        sections: dict[str, dict[str, JsonValue]] = {}
        for key, value in values.items():
            section, _, name = key.partition(".")
            sections.setdefault(section, {})[name] = value
        print_line(yaml.safe_dump(sections, sort_keys=False, allow_unicode=True).rstrip())
        for name in ("MEMORY_API_TOKEN", "MEMORY_API_TOKEN_FILE"):
            if os.environ.get(name):
                print_line(f"# {name} is set: {_MASK}")


def _print_sources(values: Mapping[str, JsonValue], source: Sources) -> None:
    """Prints the option of each group and the value of each key, with who set it."""
    print_line(f"# files are those of {source.folder}")
    rows: list[JsonValue] = []

    def add(key: str, value: JsonValue, set_by: str) -> None:
        text = value if isinstance(value, str) else json.dumps(value)
        rows.append({"key": key, "set": set_by.replace(f"in {source.folder}/", ""), "value": text})

    for group in GROUPS:
        add(group, *source.choice(group))
    for key, value in values.items():
        add(key, value, source(key))
    print_reply(rows)

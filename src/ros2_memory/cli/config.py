"""`ros2-memory config show`: the configuration as it is composed."""

import os
from typing import Final

import typer
import yaml

from ros2_memory.cli.app import epilog
from ros2_memory.cli.options import AsJson, BagDir, Words, as_command, load_given
from ros2_memory.cli.output import filled_leaves, print_json, print_line
from ros2_memory.config import files_in_use, plain_values
from ros2_memory.serving.given_tokens import given_tokens

_MASK: Final = "********"

config = typer.Typer(
    help="The configuration that the programs use.", no_args_is_help=True, rich_markup_mode=None
)


@config.command("show", epilog=epilog("config"))
@as_command("config show")
def config_show(words: Words = None, bag_dir: BagDir = None, as_json: AsJson = False) -> None:
    """Show the configuration as YAML, composed of files, environment and arguments; no secrets.

    Comments name the files in use, and whether the server has a token, never the token itself.
    """
    settings = load_given(bag_dir, words)
    values = plain_values(settings)
    if as_json:
        print_json(filled_leaves(values))
        return
    print_line(yaml.safe_dump(values, sort_keys=False, allow_unicode=True).rstrip())
    for path in files_in_use(settings):
        print_line(f"# in use: {path}")
    for source in given_tokens(os.environ):
        print_line(f"# {source} is set: {_MASK}")

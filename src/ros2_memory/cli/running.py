"""What the commands share: options, exit codes, and how they speak.

Typer reads annotations when the program starts, so modules with commands evaluate theirs.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from ros2_memory.core.errors import EpisodicError

NOT_SO: Final = 1
"""Exit code: it ran, and the answer is no: an error reply, something left undone."""
CANNOT_RUN: Final = 2
"""Exit code: it could not run, and stderr says why."""

_WIDE: Final = 160
"""Columns where nobody's terminal says how many there are, so that a pipe gets whole lines."""

BagDir = Annotated[
    Path | None,
    typer.Option(
        "--bag-dir", metavar="DIR", help="The bags to look at, instead of recording.bag_dir."
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="key=value", help="Settings, as for ros2-memory-server."),
]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="key=value", help="A setting, as for ros2-memory-server."),
]
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Show the log on stderr, from logging.level on."),
]
AsJson = Annotated[bool, typer.Option("--json", help="JSON on stdout, for programs.")]


@contextmanager
def reporting(command: str) -> Iterator[None]:
    """Around a command: what it cannot do is one line on stderr, and exit code 2."""
    try:
        yield
    except BrokenPipeError:
        raise
    except (EpisodicError, OSError) as error:
        print(f"ros2-memory {command}: {error}", file=sys.stderr)
        raise typer.Exit(CANNOT_RUN) from None


@contextmanager
def busy(what: str) -> Iterator[None]:
    """Shows on a terminal, and nowhere else, what is being done meanwhile."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


def output() -> Console:
    """Where answers go: stdout, in lines that are not cut where no terminal shows them."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console = Console(highlight=False, markup=False, emoji=False, width=_WIDE)
    return console


def say(line: str) -> None:
    """One line on stdout, at once."""
    print(line, flush=True)

"""What the commands share: options, exit codes, and how a memory is opened for one of them.

Typer reads annotations when the program starts, so modules with commands evaluate theirs.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from ros2_memory.bootstrap import build_memory
from ros2_memory.config import load_explained, quoted
from ros2_memory.errors import EpisodicError
from ros2_memory.logs import configure_logging, withheld_warnings, withhold_warnings
from ros2_memory.memory import Memory
from ros2_memory.origins import Sources
from ros2_memory.settings import Settings
from ros2_memory.wording import counted, listed

NOT_SO: Final = 1
"""Exit code: it ran, and the answer is no: an error reply, something left undone."""
CANNOT_RUN: Final = 2
"""Exit code: it could not run, and stderr says why."""
INTERRUPTED: Final = 130

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


def settings_for(bag_dir: Path | None, overrides: Sequence[str] | None) -> Settings:
    """The configuration, as the server would have it, with the bag directory that was asked for.

    Raises:
        ConfigError: it is refused.
    """
    return explained_for(bag_dir, overrides)[0]


def explained_for(
    bag_dir: Path | None, overrides: Sequence[str] | None
) -> tuple[Settings, Sources]:
    """As `settings_for`, and what tells of a key who set it.

    Raises:
        ConfigError: it is refused.
    """
    chosen = [] if bag_dir is None else [f"recording.bag_dir={quoted(str(bag_dir.absolute()))}"]
    return load_explained([*(overrides or ()), *chosen])


def opened(settings: Settings, *, verbose: bool = False) -> Memory:
    """The memory, whose bags have been looked through once.

    Log events are shown where that is asked for; else warnings are counted, for `say_withheld`.

    Raises:
        ConfigError: it cannot be built.
    """
    configure_logging(settings.logging.level if verbose else "warning", settings.logging.format)
    if not verbose:
        withhold_warnings()
    memory = build_memory(settings)
    with busy(f"looking through {settings.recording.bag_dir}"):
        memory.index.refresh()
    return memory


@contextmanager
def busy(what: str) -> Iterator[None]:
    """Shows on a terminal, and nowhere else, what is being done meanwhile."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


def say_withheld() -> None:
    """One sentence on stderr, where warnings were not shown: how many, and how to see them."""
    events = withheld_warnings()
    if events:
        warnings = counted(events.total(), "warning")
        which = listed([each if n == 1 else f"{n} x {each}" for each, n in events.items()])
        print(
            f"ros2-memory: {warnings} logged ({which}); -v shows the log, `ros2-memory doctor` "
            "says what to do",
            file=sys.stderr,
        )


def output() -> Console:
    """Where answers go: stdout, in lines that are not cut where no terminal shows them."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console = Console(highlight=False, markup=False, emoji=False, width=_WIDE)
    return console


def say(line: str) -> None:
    """One line on stdout, at once."""
    print(line, flush=True)

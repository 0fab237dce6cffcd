"""The program `ros2-memory`: its commands, their exit codes, and how signals end them.

A command's module is imported when the command is run, so that `--help` and shell completion do not
wait for the libraries of all of them.
"""

import os
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, cast

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command, get_group

from ros2_memory import package_version

if TYPE_CHECKING:
    from typer._click import Command, Context  # Typer has no public names for these

INTERRUPTED: Final = 130
TOOL_HELP: Final = "--tool-help"
"""What `ask TOOL --help` is passed on as: help on the tool."""
_HELP: Final = ("-h", "--help")
_SIGNALS: Final = (signal.SIGTERM, signal.SIGHUP)


class CommandEntry(NamedTuple):
    """One row of the list of commands.

    `path` is where the command's function, or the Typer application of a group, is in this package.
    `negative` says what its exit code 1 means.
    """

    path: str
    purpose: str
    negative: str = ""


COMMANDS: Final[Mapping[str, CommandEntry]] = {
    "ask": CommandEntry(
        "ask.ask",
        "call any tool of the server, without a server",
        "the tool returned an error, which gives the reason",
    ),
    "topics": CommandEntry(
        "info.topics",
        "every recorded topic, with its rate",
        "nothing is recorded",
    ),
    "info": CommandEntry(
        "info.info",
        "what is recorded: size, time range, gaps, damage, budget",
        "there are no bags",
    ),
    "recordings": CommandEntry(
        "info.recordings",
        "every recording: start, length, size, storage, maker",
        "there are no recordings",
    ),
    "cat": CommandEntry(
        "cat.cat",
        "the messages of a topic, as text, CSV or JSON lines",
        "there are no messages, or some could not be read (see stderr)",
    ),
    "plot": CommandEntry(
        "plot.plot",
        "draw the path, a signal, the timeline or the recap of a day",
    ),
    "watch": CommandEntry(
        "watch.watch",
        "show live what is being recorded",
    ),
    "doctor": CommandEntry(
        "doctor.doctor",
        "find problems, and say how to fix them",
        "warnings; 2: errors",
    ),
    "export": CommandEntry(
        "export.export",
        "copy a time window to MCAP or Parquet",
        "part of it could not be read or decoded, or has no definition (stderr names it)",
    ),
    "prove": CommandEntry(
        "prove.prove",
        "write the messages that an answer rests on to MCAP",
        "its answer over the file differs, or a type that it needs has no definition (stderr "
        "names them)",
    ),
    "forget": CommandEntry(
        "maintenance.forget.forget",
        "delete a time window, after confirmation",
        "some of it stays and is named, or you answered no",
    ),
    "adopt": CommandEntry(
        "maintenance.adopt.adopt",
        "let the recorder delete bags that it did not make",
        "there are no bag files",
    ),
    "demo": CommandEntry(
        "app.demo",
        "ask a simulated robot questions with known answers",
        "an answer was wrong",
    ),
    "serve": CommandEntry(
        "serve.serve",
        "answer questions over MCP, like ros2-memory-server",
        "it cannot listen on the address",
    ),
    "up": CommandEntry(
        "up.up",
        "on a robot: propose what to record, and record and serve it",
        "the recorder or the server ended by itself, or you answered no",
    ),
    "index": CommandEntry(
        "maintenance.index.index",
        "store the columns of every bag now, so that answers take milliseconds",
    ),
    "ship": CommandEntry(
        "maintenance.ship.ship",
        "ship the bags of many robots into a lake of Iceberg tables",
        "with --once: some bags are not, or may not be, in the lake (stderr names them)",
    ),
    "sql": CommandEntry(
        "sql.sql",
        "answer a SELECT over the tables of a lake",
    ),
    "recover": CommandEntry(
        "maintenance.recover.recover",
        "repair unfinished MCAP files",
        "a file could not be repaired",
    ),
    "config": CommandEntry("config.config", "show the configuration in force"),
}
COMMON_EXIT_CODES: Final = (
    "2: the command could not run (stderr gives the reason); 130: interrupted before it finished"
)
"""Of every command, unless its own entry gives a code another meaning."""

app = typer.Typer(
    name="ros2-memory",
    help="A robot's episodic memory: ask, inspect, export and maintain its bags.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": [*_HELP]},
    rich_markup_mode=None,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line (`sys.argv` by default) and returns the exit code.

    0: done, and the answer is yes; 1: an answer was wrong or missing, or something was left undone;
    2: it could not run, and stderr says why; 130: interrupted before it finished.
    """
    # Signals end it as Ctrl-C does, so that files are closed.
    handlers = {number: signal.signal(number, signal.default_int_handler) for number in _SIGNALS}
    if isinstance(sys.stdout, TextIOWrapper):
        with suppress(OSError):  # where a pipe has taken the place of a file
            # Recorded names may have letters that the terminal's encoding lacks.
            sys.stdout.reconfigure(errors="backslashreplace")
    try:
        # An application with a callback is a group.
        group = cast("TyperGroup", get_command(app))
        for name in COMMANDS:
            group.add_command(LazyCommand(name))
        group(args=None if argv is None else [*argv], prog_name="ros2-memory")
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return 0


class LazyCommand(TyperCommand):
    """A command of `COMMANDS` whose module is imported when the command is run or completed."""

    def __init__(self, name: str) -> None:
        super().__init__(name, short_help=COMMANDS[name].purpose)
        self._name = name

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: "Context | None" = None,
        **extra: object,
    ) -> "Context":
        """Returns the context of the real command, which runs, completes and shows its help."""
        if self._name == "ask" and args and not args[0].startswith("-"):
            args = [TOOL_HELP if word in _HELP else word for word in args]
        return self._load().make_context(info_name, args, parent, **extra)

    def _load(self) -> "Command":
        module, _, attribute = COMMANDS[self._name].path.rpartition(".")
        command: object = getattr(import_module(f"{__package__}.{module}"), attribute)
        parent = typer.Typer(add_completion=False, rich_markup_mode=None)
        if isinstance(command, typer.Typer):
            parent.add_typer(command, name=self._name, epilog=epilog(self._name))
        elif callable(command):
            # Imported here, as the command is, since it imports much itself.
            from ros2_memory.cli.options import as_command  # noqa: PLC0415

            parent.command(self._name, epilog=epilog(self._name))(as_command(self._name)(command))
        return get_group(parent).commands[self._name]


def epilog(command: str) -> str:
    """Returns the last line of a command's help: its exit codes and their meanings."""
    negative = COMMANDS[command].negative
    failed = f"1: {negative}; " if negative else ""
    return f"Exit code: 0: done; {failed}{COMMON_EXIT_CODES}."


def _print_version(requested: bool) -> None:
    if requested:
        print(f"ros2-memory {package_version()}")
        raise typer.Exit


@app.callback()
def _options_of_all(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    del version  # its callback has printed it


def demo(
    once: Annotated[bool, "Exit after the answers; code 1 if one was wrong."] = False,
    *,
    port: Annotated[int, "Port on 127.0.0.1; 0 picks a free one."] = 9203,
    bag_dir: Annotated[Path | None, "DIR", "Keep the bags in this new or empty folder."] = None,
    as_json: Annotated[bool, "--json", "Print a line of JSON for each question."] = False,
) -> int:
    """Simulate a robot, record it, and ask the server questions about it.

    Every answer is checked against what the robot did. Needs no ROS and no configuration.
    """
    # Imported here, so that no other command waits for the demo's libraries.
    from ros2_memory.cli.output import print_line  # noqa: PLC0415
    from ros2_memory.demo.run import HOST, run_demo  # noqa: PLC0415

    # A proxy that the environment names would not reach the server, which is on this machine.
    os.environ["no_proxy"] = HOST
    return run_demo(print_line, once=once, port=port, bag_dir=bag_dir, as_json=as_json)

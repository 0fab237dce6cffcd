"""The program `ros2-memory`: its commands, their exit codes, and how signals end them.

A command's module is imported when the command is run, so that `--help` and shell completion do not
wait for the libraries of all of them.
"""

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, cast

import typer
from typer.core import TyperCommand
from typer.main import get_command, get_group

from ros2_memory import package_version

if TYPE_CHECKING:
    from typer._click import Command, Context  # Typer has no public names for these
    from typer.core import TyperGroup

INTERRUPTED: Final = 130


class CommandEntry(NamedTuple):
    """One row of the list of commands.

    `path` is where the command's function, or the Typer application of a group, is in this package.
    """

    path: str
    purpose: str
    exit_codes: Mapping[int, str]


COMMANDS: Final[Mapping[str, CommandEntry]] = {
    "ask": CommandEntry(
        "ask.ask",
        "ask any tool of the server, in process",
        {
            0: "there is an answer, also that it was never so (null)",
            1: "there is none: the reply is an error, which says why",
        },
    ),
    "topics": CommandEntry(
        "listing.info.topics",
        "every recorded topic, with its rate",
        {0: "there are some", 1: "nothing is recorded"},
    ),
    "info": CommandEntry(
        "listing.info.info",
        "what there is: how much, from when to when, gaps, damage, budget",
        {0: "it was shown", 1: "there are no bags"},
    ),
    "recordings": CommandEntry(
        "listing.recordings.recordings",
        "every recording: start, length, size, storage, whose",
        {0: "there are some", 1: "there are none"},
    ),
    "cat": CommandEntry(
        "listing.cat.cat",
        "the messages of a topic, as text, CSV or JSON lines",
        {
            0: "there are some, and all were printed",
            1: "there are none, or stderr says what could not be read",
        },
    ),
    "plot": CommandEntry(
        "plot.commands.plot",
        "pictures: path, signal, timeline, recap of a day",
        {0: "the picture is written", 2: "it is not, and stderr says why"},
    ),
    "watch": CommandEntry(
        "watch.watch",
        "what is being recorded just now",
        {0: "it was ended, by --count or Ctrl-C, whatever it saw"},
    ),
    "doctor": CommandEntry(
        "doctor.doctor",
        "look for what is wrong, and say what to do",
        {0: "all is in order", 1: "something wants attention", 2: "something does not work"},
    ),
    "export": CommandEntry(
        "export.export",
        "a time window as MCAP or Parquet",
        {
            0: "all of the window was copied",
            1: "what could be read of it was; stderr says what could not",
        },
    ),
    "forget": CommandEntry(
        "forget.forget",
        "delete a time window, after asking",
        {
            0: "all that lies in the window is deleted (with --dry-run: would be), or there is "
            "nothing",
            1: "something in the window stays and is named, or the question was answered with no",
        },
    ),
    "adopt": CommandEntry(
        "adopt.adopt",
        "let the recorder delete bags that it did not make",
        {0: "the bags are the recorder's own now, or were before", 1: "no bag files lie there"},
    ),
    "demo": CommandEntry(
        "app.demo",
        "a simulated robot, asked questions with known answers",
        {0: "all answers were right", 1: "one was wrong"},
    ),
    "serve": CommandEntry(
        "serve.serve",
        "answer questions over MCP, as ros2-memory-server",
        {0: "it was ended", 1: "it cannot listen on the address"},
    ),
    "index": CommandEntry(
        "index.index",
        "look into every bag once, so that answers take milliseconds",
        {0: "every bag was looked into, or was found to be one that cannot be"},
    ),
    "recover": CommandEntry(
        "recover.recover",
        "repair MCAP files that were left unfinished",
        {0: "every file is whole", 1: "a file could not be repaired"},
    ),
    "config": CommandEntry(
        "config.config", "the configuration as it is composed", {0: "it was shown"}
    ),
}
COMMON_EXIT_CODES: Final[Mapping[int, str]] = {
    2: "it could not run, and stderr says why",
    INTERRUPTED: "it was interrupted before it was done",
}
"""The exit codes of every command, unless its own entry gives a code another meaning."""

app = typer.Typer(
    name="ros2-memory",
    help="A robot's episodic memory: tools for people.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line (`sys.argv` unless given) and returns the exit code.

    0: done, and the answer is yes; 1: an answer was wrong or missing, or something was left undone;
    2: it could not run, and stderr says why; 130: interrupted before it was done.
    """
    try:
        with _as_keyboard_interrupt(signal.SIGTERM, signal.SIGHUP):
            # An application with a callback is a group.
            group = cast("TyperGroup", get_command(app))
            for name in COMMANDS:
                group.add_command(LazyCommand(name))
            group(args=None if argv is None else [*argv], prog_name="ros2-memory")
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
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
        return self._load().make_context(info_name, args, parent, **extra)

    def _load(self) -> "Command":
        module, _, attribute = COMMANDS[self._name].path.rpartition(".")
        loaded: object = getattr(import_module(f"{__package__}.{module}"), attribute)
        parent = typer.Typer(add_completion=False, rich_markup_mode=None)
        if isinstance(loaded, typer.Typer):
            parent.add_typer(loaded, name=self._name, epilog=epilog(self._name))
        elif callable(loaded):
            # Imported here, as the command is, since it imports much itself.
            from ros2_memory.cli.options import reported_errors  # noqa: PLC0415

            reporting = reported_errors(self._name)(loaded)
            parent.command(self._name, epilog=epilog(self._name))(reporting)
        return get_group(parent).commands[self._name]


def epilog(command: str) -> str:
    """Returns the last lines of a command's help: what its exit codes mean."""
    codes = {**COMMON_EXIT_CODES, **COMMANDS[command].exit_codes}
    return f"Exit code: {'; '.join(f'{code}: {codes[code]}' for code in sorted(codes))}."


@contextmanager
def _as_keyboard_interrupt(*signals: signal.Signals) -> Iterator[None]:
    """Raises KeyboardInterrupt for these signals within the block, so that files are closed."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _print_version(requested: bool) -> None:
    if requested:
        print(f"ros2-memory {package_version()}")
        raise typer.Exit


@app.callback()
def _options_of_all(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show it.")
    ] = False,
) -> None:
    del version


def demo(
    once: Annotated[
        bool, typer.Option("--once", help="Leave after the answers; exit code 1: one was wrong.")
    ] = False,
    *,
    port: Annotated[int, typer.Option(help="On 127.0.0.1; 0: any that is free.")] = 9203,
    bag_dir: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="A new or empty folder, kept (a temporary one, removed at the end)."
        ),
    ] = None,
    duration: Annotated[
        float,
        typer.Option(metavar="S", help="Seconds of history when the questions are asked."),
    ] = 120.0,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Show the server's log on stderr.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="A line of JSON for each question, for programs.")
    ] = False,
) -> None:
    """A simulated robot, its bags, the query server and a client that asks it questions.

    Every answer is held against what the robot did. Needs no ROS and no configuration.
    """
    # Imported here, so that no other command waits for the demo's libraries.
    from ros2_memory.cli.options import print_line  # noqa: PLC0415
    from ros2_memory.demo.run import DemoOptions, run_demo  # noqa: PLC0415

    options = DemoOptions(
        once=once,
        port=port,
        bag_dir=bag_dir,
        duration_s=duration,
        verbose=verbose,
        as_json=as_json,
    )
    code = run_demo(options, print_line)
    raise typer.Exit(code)

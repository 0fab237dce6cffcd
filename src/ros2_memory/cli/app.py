"""The program `ros2-memory`: which commands there are, and how it ends."""

import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Final, cast

import typer
from typer.main import get_command

from ros2_memory import package_version
from ros2_memory.cli.deferred import Deferred
from ros2_memory.core.text import counted, listed
from ros2_memory.core.withheld import withheld_warnings

if TYPE_CHECKING:
    from typer.core import TyperGroup

INTERRUPTED: Final = 130

app = typer.Typer(
    name="ros2-memory",
    help="A robot's episodic memory: tools for people.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
COMMANDS: Final[Mapping[str, tuple[str, str]]] = {
    "ask": ("ask.ask", "ask any tool of the server, in process"),
    "topics": ("info.topics", "every recorded topic, with its rate"),
    "info": ("info.info", "range, gaps, budget and how long it lasts"),
    "watch": ("watch.watch", "what is being recorded just now"),
    "doctor": ("doctor.doctor", "look for what is wrong, and say what to do"),
    "export": ("export.export", "a time window as MCAP or Parquet"),
    "forget": ("forget.forget", "delete a time window, after asking"),
    "adopt": ("adopt.adopt", "let the recorder delete bags that it did not make"),
    "demo": ("demo.demo", "a simulated robot, asked questions with known answers"),
    "index": ("fill.index", "look into every bag once, so that answers take milliseconds"),
    "recover": ("recover.recover", "repair MCAP files that were left unfinished"),
    "config": ("config_show.config", "the configuration as it is composed"),
}
"""By name: where it is in this package, imported when it is asked for, and what it is for."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line (`sys.argv` unless given) and returns the exit code.

    0: done and right; 1: an answer was wrong or missing, or something was left undone; 2: it could
    not run, and stderr says why; 130: interrupted before it was done.
    """
    try:
        with _ended_like_ctrl_c(signal.SIGTERM, signal.SIGHUP):
            # An application with a callback is a group.
            program = cast("TyperGroup", get_command(app))
            for name, (place, purpose) in COMMANDS.items():
                program.add_command(Deferred(name, f"{__package__}.{place}", purpose))
            program(args=None if argv is None else [*argv], prog_name="ros2-memory")
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    finally:
        _say_withheld()
    return 0


def _say_withheld() -> None:
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


def _version(asked: bool) -> None:
    if asked:
        print(f"ros2-memory {package_version()}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")
    ] = False,
) -> None:
    del version


@contextmanager
def _ended_like_ctrl_c(*signals: signal.Signals) -> Iterator[None]:
    """Within the block each of these signals is a KeyboardInterrupt, so that all is closed."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

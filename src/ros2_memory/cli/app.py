"""The commands of `ros2-memory`, and how the program ends."""

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from ros2_memory.bootstrap import build_filler, build_memory, package_version
from ros2_memory.cli import asking, doctor, exporting, forgetting, telling, watching
from ros2_memory.cli.running import (
    CANNOT_RUN,
    INTERRUPTED,
    NOT_SO,
    BagDir,
    Overrides,
    reporting,
    say,
    say_withheld,
    settings_for,
)
from ros2_memory.demo.run import DemoOptions, run_demo
from ros2_memory.errors import ConfigError
from ros2_memory.indexing import Bar, die_with, fill, orphaned, step_back
from ros2_memory.logs import configure_logging
from ros2_memory.recovery import recover as recover_files

app = typer.Typer(
    name="ros2-memory",
    help="A robot's episodic memory: tools for people.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command(short_help="ask any tool of the server, in process")(asking.ask)
app.command(short_help="every recorded topic, with its rate")(telling.topics)
app.command(short_help="range, gaps, budget and how long it lasts")(telling.info)
app.command(short_help="what is being recorded just now")(watching.watch)
app.command(short_help="look for what is wrong, and say what to do")(doctor.doctor)
app.command(short_help="a time window as MCAP or Parquet")(exporting.export)
app.command(short_help="delete a time window, after asking")(forgetting.forget)
app.add_typer(telling.config_app, name="config", short_help="the configuration as it is composed")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line (`sys.argv` unless given) and returns the exit code.

    0: done and right; 1: an answer was wrong or missing, or something was left undone; 2: it could
    not run, and stderr says why; 130: interrupted before it was done.
    """
    try:
        with _ended_like_ctrl_c(signal.SIGTERM, signal.SIGHUP):
            app(args=None if argv is None else [*argv], prog_name="ros2-memory")
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    finally:
        say_withheld()
    return 0


def _version(asked: bool) -> None:
    if asked:
        say(f"ros2-memory {package_version()}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")
    ] = False,
) -> None:
    del version


@app.command(short_help="a simulated robot, asked questions with known answers")
def demo(
    once: Annotated[
        bool, typer.Option("--once", help="Leave after the answers; exit code 1: one was wrong.")
    ] = False,
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
) -> None:
    """A simulated robot, its bags, the query server and a client that asks it questions.

    Every answer is held against what the robot did. Needs no ROS and no configuration.
    """
    options = DemoOptions(
        once=once, port=port, bag_dir=bag_dir, duration_s=duration, verbose=verbose
    )
    with reporting("demo"):
        code = run_demo(options, say)
    raise typer.Exit(code)


@app.command(short_help="look into every bag once, so that answers take milliseconds")
def index(
    overrides: Overrides = None,
    bag_dir: BagDir = None,
    for_server: Annotated[int | None, typer.Option(metavar="PID", hidden=True)] = None,
) -> None:
    """Look into every bag once, so that questions about a week take milliseconds.

    Fills the catalogue of the bags at once, with the settings of the server. The server does the
    same by itself, in the background; no answer depends on it.
    """
    with reporting("index"):
        settings = settings_for(bag_dir, overrides)
        serving = for_server is not None
        if for_server is not None and not die_with(for_server):
            raise typer.Exit(CANNOT_RUN)
        level = settings.logging.level if serving else "warning"
        configure_logging(level, settings.logging.format)
        memory = build_memory(settings)
        filler = build_filler(settings, memory)
        if serving:
            step_back()
        elif filler.in_memory:
            raise ConfigError(
                "no catalogue can be written, neither beside the bags nor in the cache folder: "
                "give XDG_CACHE_HOME a folder that can be"
            )
        fill(filler, None if serving else Bar(), orphaned() if serving else lambda: False)


@app.command(short_help="repair MCAP files that were left unfinished")
def recover(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="An MCAP file, or a directory of recordings.")
    ],
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Also files that changed in the last half minute; nothing must be writing them.",
        ),
    ] = False,
) -> None:
    """Repair MCAP files that a crash, a full disk or a pulled plug left unfinished.

    Rewrites each from all that can be read of it, in place: the original stays until the whole one
    has been read back and is on the disk. Files of 0 bytes are removed. The exit code is 1 if a
    file could not be repaired.
    """
    with reporting("recover"):
        outcome = recover_files(path, say, force=force)
    if outcome.failed:
        raise typer.Exit(NOT_SO)


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

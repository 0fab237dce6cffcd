"""`ros2-memory index`: fills the catalogue at once, for people and beside a server."""

from typing import Annotated

import typer

from ros2_memory.bootstrap import build_backfill, build_memory
from ros2_memory.cli.index import Bar, die_with, fill, orphaned, step_back
from ros2_memory.cli.opening import opened
from ros2_memory.cli.running import CANNOT_RUN, BagDir, Overrides, Verbose, reporting
from ros2_memory.cli.settling import settings_for
from ros2_memory.config import Settings
from ros2_memory.core.errors import ConfigError, RecorderError
from ros2_memory.core.logging_setup import configure_logging


def index(
    overrides: Overrides = None,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
    for_server: Annotated[int | None, typer.Option(metavar="PID", hidden=True)] = None,
) -> None:
    """Look into every bag once, so that questions about a week take milliseconds.

    Fills the catalogue of the bags at once, with the settings of the server. The server does the
    same by itself, in the background; no answer depends on it.
    """
    with reporting("index"):
        settings = settings_for(bag_dir, overrides)
        if for_server is None:
            _for_people(settings, verbose=verbose)
        else:
            _beside(settings, for_server)


def _for_people(settings: Settings, *, verbose: bool) -> None:
    memory = opened(settings, verbose=verbose)
    if problem := memory.index.snapshot().problem:
        raise RecorderError(problem)
    filler = build_backfill(settings, memory)
    if filler.in_memory:
        raise ConfigError(
            "no catalogue can be written, neither beside the bags nor in the cache folder: "
            "give XDG_CACHE_HOME a folder that can be"
        )
    fill(filler, Bar(), lambda: False)


def _beside(settings: Settings, server: int) -> None:
    if not die_with(server):
        raise typer.Exit(CANNOT_RUN)
    configure_logging(
        settings.logging.level, settings.logging.format, arguments=settings.logging.arguments
    )
    filler = build_backfill(settings, build_memory(settings))
    step_back()
    fill(filler, None, orphaned())

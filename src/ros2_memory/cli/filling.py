"""`ros2-memory index`: fills the catalogue at once, for people and beside a server."""

from typing import Annotated

import typer

from ros2_memory.bootstrap import build_filler, build_memory
from ros2_memory.cli.running import CANNOT_RUN, BagDir, Overrides, reporting
from ros2_memory.cli.settling import settings_for
from ros2_memory.errors import ConfigError
from ros2_memory.indexing import Bar, die_with, fill, orphaned, step_back
from ros2_memory.logs import configure_logging


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

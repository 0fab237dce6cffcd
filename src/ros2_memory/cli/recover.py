"""`ros2-memory recover`: repairs MCAP files that were left unfinished."""

from pathlib import Path
from typing import Annotated

import typer

from ros2_memory.cli.recovery import recover as recover_files
from ros2_memory.cli.running import NOT_SO, reporting, say


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
    has been read back and is on the disk. Files of 0 bytes are removed.
    """
    with reporting("recover"):
        outcome = recover_files(path, say, force=force)
    if outcome.failed:
        raise typer.Exit(NOT_SO)

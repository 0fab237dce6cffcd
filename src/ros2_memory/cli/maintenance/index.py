"""`ros2-memory index`: stores the columns of every closed bag, for people and for a server.

A server starts it as a child process (`--for-server PID`), so that storing takes no processor time
from the process that answers.
"""

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, Final, NamedTuple

import typer

from ros2_memory.bootstrap import build_backfill, build_memory, shared_parts
from ros2_memory.cli.options import (
    EXIT_CANNOT_RUN,
    AsJson,
    BagDir,
    Verbose,
    Words,
    load_given,
    open_robot,
)
from ros2_memory.cli.output import print_json, spinner
from ros2_memory.columns.fill import Progress
from ros2_memory.config import Settings
from ros2_memory.core.errors import ConfigError, RecorderError
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.malloc import keep_freed
from ros2_memory.core.text import counted
from ros2_memory.serving.backfill import Backfill

NICENESS: Final = 15
"""So low a priority that the process that answers goes first."""

_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h
_BATCH: Final = 4096
"""Bags that are tried before it looks again which bags wait: others closed meanwhile."""
_FOLLOWED: Final = 4
"""Batches that are stored before what derives from them: four hours are still in the cache."""
_CACHE_MB: Final = 32
_RARELY: Final = (50_000, 20, 100)
"""Thresholds of `gc`: columns make no cycles, and the index of a week has many objects."""


def index(
    words: Words = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
    for_server: Annotated[int | None, typer.Option(metavar="PID", hidden=True)] = None,
) -> None:
    """Store the columns of every bag now, so that questions about a week take milliseconds.

    Uses the settings of the server, which also does this in the background. What is stored changes
    only the speed of answers.
    """
    keep_freed()
    gc.set_threshold(*_RARELY)
    settings = load_given(bag_dir, words)
    # Filling reads the columns of ten minutes together: small caches do.
    cache_mb = min(_CACHE_MB, settings.store.cache_mb)
    reader = replace(settings.reader, chunk_cache_mb=cache_mb)
    settings = replace(settings, reader=reader, store=replace(settings.store, cache_mb=cache_mb))
    if for_server is not None:
        _fill_for_server(settings, for_server)
        return
    robots = settings.fleet.robots
    rows: dict[str, dict[str, int]] = {}
    problems: list[str] = []
    for name in robots or ("",):
        try:
            progress, trouble = _fill_for_people(settings, name, verbose=verbose)
        except (ConfigError, RecorderError) as error:
            if not robots:
                raise
            problems.append(f"{name}: {error}")
            continue
        if trouble is not None:
            problems.append(f"{name}: {trouble}" if robots else trouble)
        rows[name] = {
            "bags": progress.closed,
            "stored": progress.stored,
            "refused": progress.refused,
        }
        if not as_json:
            of_robot = f" of {name}" if robots else ""
            print(f"{describe_progress(progress)}{of_robot}", file=sys.stderr)
    if as_json:
        print_json(rows if robots else rows[""])
    if problems:
        raise RecorderError("; ".join(problems))


class _Filled(NamedTuple):
    """How much is stored, and what is wrong with the store, or None."""

    progress: Progress
    trouble: str | None


def _fill_for_people(settings: Settings, robot: str, *, verbose: bool) -> _Filled:
    """Fills the store of a robot of the fleet; without a fleet the name is empty.

    Raises:
        ConfigError: no columns are stored, or nowhere can they be.
        RecorderError: the bag directory cannot be read.
    """
    settings, memory = open_robot(settings, robot, verbose=verbose)
    if problem := memory.snapshot().problem:
        raise RecorderError(problem)
    backfill = build_backfill(settings, memory)
    if backfill.filling is None:
        raise ConfigError("store.enabled: false keeps no columns, so there is nothing to fill")
    if backfill.filling.store.path is None:
        raise ConfigError(
            "columns can be stored neither beside the bags nor in the cache folder: "
            "set XDG_CACHE_HOME to a writable folder"
        )
    with spinner("storing columns") as show:
        progress = _fill_and_close(backfill, lambda progress: show(describe_progress(progress)))
    trouble = backfill.filling.store.trouble
    return _Filled(progress, trouble and f"the store of columns {trouble}")


def _fill_for_server(settings: Settings, server: int) -> None:
    """Fills the store at a low priority, until it is done or the server ends."""
    if not _end_with_parent(server):
        raise typer.Exit(EXIT_CANNOT_RUN)
    logged = settings.logging
    configure_logging(logged.level, logged.format, arguments=logged.arguments)
    with suppress(OSError):  # some sandboxes forbid it
        os.nice(NICENESS)
    memory = build_memory(settings, shared_parts(settings))
    _fill_and_close(build_backfill(settings, memory))


def _fill_and_close(
    backfill: Backfill, show: Callable[[Progress], None] = lambda _: None
) -> Progress:
    """Fills the store, and closes it, so that nothing stays in its write-ahead log."""
    try:
        return fill_store(backfill, show)
    finally:
        if backfill.filling is not None:
            backfill.filling.store.close()


def fill_store(backfill: Backfill, show: Callable[[Progress], None] = lambda _: None) -> Progress:
    """Stores bags, the newest first, until none waits that can be stored; returns the progress.

    A bag that changed a few seconds ago is left for a later run.
    """
    goes_on = True
    while goes_on:
        progress = backfill.progress()
        stored = tried = 0
        for number, batch in enumerate(backfill.batches(), start=1):
            if tried >= _BATCH:
                break
            show(replace(progress, stored=min(progress.stored + stored, progress.closed)))
            tried += len(batch.bags)
            stored += backfill.store(batch)
            if number % _FOLLOWED == 0:
                backfill.follow()
        goes_on = backfill.follow() or stored > 0
    backfill.prune()
    backfill.precompute()
    return backfill.progress()


def describe_progress(progress: Progress) -> str:
    """Returns how many bags are stored, in one line."""
    bags = counted(progress.closed, "bag is", "bags are")
    refused = f", {progress.refused} cannot be" if progress.refused else ""
    return f"{progress.stored} of {bags} stored{refused}"


def _end_with_parent(parent: int) -> bool:
    """Asks the kernel to kill this process when its parent dies; False if it is dead already.

    Nothing is lost by the kill: bags are stored whole or not at all.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent

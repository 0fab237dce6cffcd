"""`ros2-memory index`: digests every closed bag into the catalogue, for people and for a server.

A server starts it as a child process (`--for-server PID`), so that digesting takes no processor
time from the process that answers.
"""

import ctypes
import gc
import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Annotated, Final

import typer

from ros2_memory.bootstrap import build_backfill, build_memory, shared_parts
from ros2_memory.bootstrap_fleet import ROBOTS_SETTING, robot_settings
from ros2_memory.cli.maintenance.second_process import (
    FreeCores,
    SecondProcess,
    Worker,
    is_second,
)
from ros2_memory.cli.options import (
    EXIT_CANNOT_RUN,
    AsJson,
    BagDir,
    Verbose,
    Words,
    load_given,
    open_memory,
    print_line,
)
from ros2_memory.cli.output import progress_bar
from ros2_memory.config import Settings
from ros2_memory.core.errors import ConfigError, RecorderError
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.model import BagFile, JsonValue
from ros2_memory.core.text import counted
from ros2_memory.serving.backfill import Backfill, Progress

NICENESS: Final = 15
"""So low a priority that the process that answers goes first."""

_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h
_BATCH: Final = 256
"""Bags digested before the program looks which others closed meanwhile, among all that wait."""
_COMPACTED: Final = 64
"""After as many new entries the catalogue is compacted."""
_CACHE_MB: Final = 8
_BAR_WIDTH: Final = 40
_RARELY: Final = (50_000, 20, 100)
"""Thresholds of `gc`: a digest makes no cycles, and the index of a week has many objects."""


def index(
    words: Words = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
    for_server: Annotated[int | None, typer.Option(metavar="PID", hidden=True)] = None,
) -> None:
    """Index every bag now, so that questions about a week take milliseconds.

    Fills the catalogue of the bags, with the settings of the server. The server also does this in
    the background; the catalogue changes only the speed of answers.
    """
    settings = load_given(bag_dir, words)
    if for_server is not None:
        _fill_for_server(settings, for_server)
    elif settings.fleet.robots:
        _fill_fleet(settings, as_json=as_json, verbose=verbose)
    else:
        progress = _fill_for_people(settings, verbose=verbose)
        if as_json:
            print_line(json.dumps(as_object(progress)))
        else:
            print(describe_progress(progress), file=sys.stderr)


def _fill_fleet(settings: Settings, *, as_json: bool, verbose: bool) -> None:
    """Fills the catalogues of a fleet's robots; names those whose bags cannot be listed."""
    done: dict[str, JsonValue] = {}
    problems: list[str] = []
    for name in settings.fleet.robots:
        try:
            progress = _fill_for_people(
                robot_settings(settings, name), verbose=verbose, setting=ROBOTS_SETTING
            )
        except RecorderError as error:
            problems.append(f"{name}: {error}")
            continue
        done[name] = as_object(progress)
        if not as_json:
            print(f"{describe_progress(progress)} of {name}", file=sys.stderr)
    if as_json:
        print_line(json.dumps(done))
    if problems:
        raise RecorderError("; ".join(problems))


def _fill_for_people(settings: Settings, *, verbose: bool, setting: str | None = None) -> Progress:
    memory = open_memory(settings, verbose=verbose, setting=setting)
    if problem := memory.index.snapshot().problem:
        raise RecorderError(problem)
    backfill = build_backfill(settings, memory)
    if backfill.catalogue.path is None:
        raise ConfigError(
            "the catalogue can be written neither beside the bags nor in the cache folder: "
            "set XDG_CACHE_HOME to a writable folder"
        )
    with progress_bar() as bar:
        task = bar.add_task("", total=None)

        def show(progress: Progress) -> None:
            known = progress.closed - progress.waiting
            bar.update(task, completed=known, total=progress.closed)

        with _second_process(settings) as second:
            return fill_catalogue(backfill, show, second)


def _fill_for_server(settings: Settings, server: int) -> None:
    if not _end_with_parent(server):
        raise typer.Exit(EXIT_CANNOT_RUN)
    configure_logging(
        settings.logging.level, settings.logging.format, arguments=settings.logging.arguments
    )
    fill_catalogue(_low_priority_backfill(settings))


def _low_priority_backfill(settings: Settings) -> Backfill:
    """Returns what fills the catalogue in a process that other programs go before."""
    with suppress(OSError):  # some sandboxes forbid it
        os.nice(NICENESS)
    # Each bag is read once: a larger cache of chunks would take most of the memory, and not help.
    cache_mb = min(_CACHE_MB, settings.reader.chunk_cache_mb)
    return build_backfill(
        settings, build_memory(settings, shared_parts(settings, cache_mb=cache_mb))
    )


@contextmanager
def _second_process(settings: Settings) -> Iterator[SecondProcess]:
    """Has a second process digest some of the bags within the block, while a core is free."""

    def start(nth: int) -> Worker:
        # Not forked: SQLite forbids that a connection is used on both sides.
        worker = multiprocessing.get_context("spawn").Process(
            target=_digest_second_share, args=(settings, os.getpid(), nth), daemon=True
        )
        worker.start()
        return worker

    second = SecondProcess(start, FreeCores())
    try:
        yield second
    finally:
        second.stop()


def _digest_second_share(settings: Settings, parent: int, nth: int) -> None:
    """Digests the second process's bags, until none of them waits."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends both
    # What cannot be digested waits for the first process, which reports it.
    configure_logging("error", settings.logging.format)
    if not _end_with_parent(parent):
        return
    backfill = _low_priority_backfill(settings)
    with _garbage_collected_rarely():
        _digest(backfill, lambda waiting: [bag for bag in waiting if is_second(bag.file, nth)])


def fill_catalogue(
    backfill: Backfill,
    show: Callable[[Progress], None] = lambda _: None,
    second: SecondProcess | None = None,
) -> Progress:
    """Digests until no bag waits, the newest first, and returns the progress at the end.

    A bag that changed a few seconds ago is left for a later run. `second` digests some of the bags
    while a core is free for it.
    """
    with _garbage_collected_rarely():
        _store(backfill, show)
        total = _digest(backfill, _every if second is None else second.share, show)
        if second is not None:
            second.stop()
        total += _digest(backfill, _every, show)
    backfill.prune()
    backfill.precompute()
    if total >= _COMPACTED:
        backfill.catalogue.compact()
    return backfill.progress()


def _store(backfill: Backfill, show: Callable[[Progress], None]) -> None:
    """Stores the columns of bags until none waits that can be stored."""
    done = True
    while done:
        waiting = backfill.not_stored()
        done = False
        for number, bag in enumerate(waiting[:_BATCH]):
            show(Progress(len(waiting), len(waiting) - number, 0))
            done |= backfill.store(bag)
        backfill.merge()


@contextmanager
def _garbage_collected_rarely() -> Iterator[None]:
    """Has Python look for unused cycles rarely in the block, and not among what there is now."""
    before = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(*_RARELY)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


def _every(waiting: Sequence[BagFile]) -> Sequence[BagFile]:
    return waiting


def _digest(
    backfill: Backfill,
    share: Callable[[Sequence[BagFile]], Sequence[BagFile]],
    show: Callable[[Progress], None] = lambda _: None,
) -> int:
    """Digests until nothing of the process's share waits; returns how many bags it digested.

    Args:
        backfill: digests the bags.
        share: returns which of the waiting bags are the process's own.
        show: takes the progress, before each bag.
    """
    done, total = 1, 0
    while done:
        progress = backfill.progress()
        waiting = share(backfill.waiting())[:_BATCH]
        left = backfill.renew(waiting)
        done = len(waiting) - len(left)
        for number, bag in enumerate(left, done):
            show(replace(progress, waiting=progress.waiting - number))
            done += backfill.digest(bag)
        total += done
    return total


def as_object(progress: Progress) -> dict[str, JsonValue]:
    """Returns how many bags are in the catalogue, for programs."""
    known = progress.closed - progress.waiting - progress.refused
    return {"bags": progress.closed, "in_catalogue": known, "refused": progress.refused}


def describe_progress(progress: Progress) -> str:
    """Returns how many bags are in the catalogue, in one line."""
    known = progress.closed - progress.waiting - progress.refused
    share = known / progress.closed if progress.closed else 1.0
    bar = "#" * int(share * _BAR_WIDTH)
    bags = counted(progress.closed, "bag is", "bags are")
    refused = f", {progress.refused} cannot be" if progress.refused else ""
    return f"[{bar:<{_BAR_WIDTH}}] {known} of {bags} in the catalogue{refused}"


def _end_with_parent(parent: int) -> bool:
    """Asks the kernel to kill this process when its parent dies; False if it is dead already.

    Nothing is lost by the kill: the catalogue's entries are written whole or not at all.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent

"""`ros2-memory index`: fills the catalogue at once, and shows how far it is."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Final, TextIO

from ros2_memory.core.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.serving.backfill import Backfill, Progress

NICENESS: Final = 15
"""So low that whoever answers meanwhile goes first."""

_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h
_ROUND: Final = 64
"""Bags that are digested before it is looked what has closed meanwhile."""
_WIDTH: Final = 40


class Bar:
    """A line that tells how far the work is: rewritten in place on a terminal, else only its end.

    Args:
        stream: where it is shown; stderr unless given.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._moves = self._stream.isatty()

    def show(self, progress: Progress) -> None:
        """Shows how far it is."""
        if self._moves:
            self._stream.write(f"\r{line(progress)}")
            self._stream.flush()

    def end(self, progress: Progress) -> None:
        """Leaves the last line standing."""
        self._stream.write(f"\r{line(progress)}\n" if self._moves else f"{line(progress)}\n")
        self._stream.flush()


def line(progress: Progress) -> str:
    """How far it is, in one line."""
    known = progress.closed - progress.waiting - progress.refused
    part = known / progress.closed if progress.closed else 1.0
    bar = "#" * int(part * _WIDTH)
    bags = counted(progress.closed, "bag is", "bags are")
    refused = f", {progress.refused} cannot be" if progress.refused else ""
    return f"[{bar:<{_WIDTH}}] {known} of {bags} in the catalogue{refused}"


def fill(filler: Backfill, bar: Bar | None, abandoned: Callable[[], bool]) -> Progress:
    """Digests until nothing waits, the newest first, and gives where that has led.

    A bag that changed a moment ago is left for later.
    """
    done = 1
    while done and not abandoned():
        done = 0
        progress = filler.progress()
        for number, bag in enumerate(filler.waiting()[:_ROUND]):
            if abandoned():
                break
            if bar is not None:
                bar.show(progress.after(number))
            done += filler.digest(bag)
    if not abandoned():
        filler.tidy()
        filler.warm()
    progress = filler.progress()
    if bar is not None:
        bar.end(progress)
    return progress


def die_with(parent: int) -> bool:
    """Has the system kill this process when its parent dies; whether that still lives.

    What is killed loses nothing: entries are written whole or not at all.

    Args:
        parent: the number of the process that started this one.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent


def orphaned() -> Callable[[], bool]:
    """Tells whether the process that started this one is gone."""
    parent = os.getppid()
    return lambda: os.getppid() != parent


def step_back() -> None:
    """Lets every other program go first, where that is allowed."""
    with suppress(OSError):
        os.nice(NICENESS)

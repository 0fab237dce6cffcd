"""Promises in real seconds, on a machine that may have more to do than it has processors.

What is recorded is on disk after 3 s, a full disk is reported within 10 s: such a promise holds
where programs run when their time has come. A drive that breaks one is driven once more. If it
is broken again, it is a failure, or a skip with the figures where programs ran late meanwhile. The
bound itself is never loosened.
"""

import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from tempfile import mkdtemp
from typing import Final, TypeVar

import pytest

T = TypeVar("T")

LATE_S: Final = 0.1
"""A program that wakes later than this did not run in time."""
TICK_S: Final = 0.05
BROKEN: Final = (AssertionError, TimeoutError, subprocess.TimeoutExpired)
"""What a broken promise raises: a judgement by the clock, a wait in vain, a program that stays."""


@dataclass
class Watch:
    """How late the machine let programs run during a drive: by program, in seconds, at worst."""

    late_s: dict[str, float] = field(default_factory=dict)

    def report(self, program: str, late_s: float) -> None:
        """Adds how late a program woke."""
        self.late_s[program] = max(late_s, self.late_s.get(program, 0.0))

    @contextmanager
    def excusing(self) -> Iterator[None]:
        """Skips, with the figures, where a promise is broken within and programs ran late."""
        try:
            yield
        except Exception as error:
            late = {name: late_s for name, late_s in self.late_s.items() if late_s > LATE_S}
            if not late or not is_broken_promise(error):
                raise
            figures = ", ".join(f"{name} by {late_s:.2f} s" for name, late_s in late.items())
            broken = str(error).partition("\n")[0]
            pytest.skip(f"programs ran late in both drives ({figures}); at last: {broken}")


@contextmanager
def watching() -> Iterator[Watch]:
    """A watch on which a thread reports how late it wakes from each of its short sleeps."""
    watch, over = Watch(), threading.Event()

    def tick() -> None:
        due = time.monotonic() + TICK_S
        while not over.wait(due - time.monotonic()):
            watch.report("the tests", time.monotonic() - due)
            due = time.monotonic() + TICK_S

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield watch
    finally:
        over.set()
        thread.join()


def driven(drive: Callable[[Watch], T], judge: Callable[[T], object]) -> T:
    """Returns what came of a drive; of a second one, where the first broke a promise.

    The second is returned whatever it is: tests judge it within `Watch.excusing`.

    Args:
        drive: drives once, and may report to the watch how late its programs were.
        judge: raises one of `BROKEN` where a promise by the clock was broken.
    """
    try:
        with watching() as watch:
            found = drive(watch)
        judge(found)
    except Exception as error:
        if not is_broken_promise(error):
            raise
    else:
        return found
    with watching() as watch, watch.excusing():
        return drive(watch)


def in_time(test: Callable[[], None]) -> None:
    """Runs what a test does by the clock, and once more where that breaks a promise."""
    driven(lambda _: test(), lambda _: None)


def each_in_time(test: Callable[..., None]) -> Callable[..., None]:
    """Decorates a test with `tmp_path`: each of its drives, by `in_time`, has a folder of its own.

    For tests of programs that find each other over DDS, which on a busy machine may not.
    """

    @wraps(test)
    def driven_in_time(**given: object) -> None:
        def once() -> None:
            folder = Path(mkdtemp(dir=str(given["tmp_path"])))
            test(**{**given, "tmp_path": folder})

        in_time(once)

    return driven_in_time


def is_broken_promise(error: Exception) -> bool:
    """Whether the error is one of `BROKEN`, or a group of nothing else."""
    if isinstance(error, ExceptionGroup):
        return error.split(BROKEN)[1] is None
    return isinstance(error, BROKEN)

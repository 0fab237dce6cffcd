"""Promises in real seconds, judged on a machine that may have more to do than it has processors.

The product promises that what was recorded 3 s ago is on disk, or that a full disk is told within
10 s. Such a promise holds where programs run when their time has come. So witnesses run beside a
drive and say how late the machine let programs run, in the tests' own session and in one of its
own, as a recorder's child is; and publishers say how late they were. The bound of a promise is
never loosened: where it is broken, and programs had to wait for the machine, the drive is repeated,
and at last skipped, with the figures. Where they had not, it is a failure.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import pytest

from tests.support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager

T = TypeVar("T")

LATE_S: Final = 0.1
"""Programs that wake later than this did not run in time."""
WAITED: Final = 0.5
"""Nor did one that was ready to run, and did not, for more than this part of a second."""
TICK_S: Final = 0.05
BROKEN: Final = (AssertionError, TimeoutError, subprocess.TimeoutExpired)
"""What a judgement by the clock raises, what waits in vain, and a program that does not end."""
DRIVES: Final = 2
"""How often a drive is driven at most: on a machine that is too busy each takes minutes."""
NAMED: Final = 3
"""Of programs that waited for a processor, how many are named: those that waited longest."""
WITNESS: Final = Path(__file__).with_name("witness.py")


@dataclass
class Watch:
    """What the machine did to the programs of a drive, complete when the drive is over.

    `late_s`: by program, how late it was at worst. `waited`: by program, the greatest part of a
    second for which it was ready and no processor took it.
    """

    late_s: dict[str, float] = field(default_factory=dict)
    waited: dict[str, float] = field(default_factory=dict)

    def tell(self, program: str, late_s: float) -> None:
        """Adds how late a program says it was."""
        self.late_s[program] = max(late_s, self.late_s.get(program, 0.0))

    @property
    def starved(self) -> str | None:
        """How the machine kept programs waiting; None where it let them run in time."""
        late = [
            f"{program} was {late_s:.2f} s late"
            for program, late_s in self.late_s.items()
            if late_s > LATE_S
        ]
        longest = sorted(self.waited.items(), key=lambda each: each[1], reverse=True)[:NAMED]
        waited = [
            f"{program} waited for a processor for {share:.0%} of a second"
            for program, share in longest
            if share > WAITED
        ]
        if not (late or waited):
            return None
        return f"the machine did not run its programs in time: {'; '.join([*late, *waited])}"

    @contextmanager
    def excusing(self) -> Iterator[None]:
        """A judgement by the clock: one that fails is skipped where programs were kept waiting."""
        try:
            yield
        except Exception as error:
            starved = self.starved
            if starved is None or not _is_broken_promise(error):
                raise
            broken = str(error).partition("\n")[0]
            pytest.skip(f"{starved}, in each of {DRIVES} drives; at last: {broken}")


@contextmanager
def watching() -> Iterator[Watch]:
    """Witnesses beside what happens within; what they saw is there after it."""
    watch = Watch()
    # Sessions share the processors; within one, its programs do.
    witnesses = {
        "a witness in a session of its own": _started(own_session=True),
        "a witness among the tests": _started(str(os.getpid()), own_session=False),
    }
    try:
        for process in witnesses.values():
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
        yield watch
        for name, process in witnesses.items():
            process.terminate()
            seen = json.loads(process.communicate(timeout=PATIENCE_S)[0])
            watch.tell(name, seen["late_s"])
            watch.waited |= seen["waited"]
    finally:
        for process in witnesses.values():
            process.kill()
            process.communicate()


def driven(
    drive: Callable[[Watch], T],
    judge: Callable[[T], object],
    watched: Callable[[], AbstractContextManager[Watch]] = watching,
) -> T:
    """What came of a drive: of the first that is good, or that the machine let run in time.

    After `DRIVES` of them it is the last one, whatever it is: the tests' judgements by the clock
    then stand within `excusing`. One that breaks off is driven again, excused and blamed likewise.

    Args:
        drive: drives once, and may tell the watch how late its programs were.
        judge: raises one of `BROKEN` where a promise by the clock was broken.
        watched: what gives a drive its watch.
    """
    left = DRIVES
    while True:
        left -= 1
        broken: Exception | None = None
        with watched() as watch:
            try:
                found = drive(watch)
            except Exception as error:
                if not _is_broken_promise(error):
                    raise
                broken = error
        last = watch.starved is None or not left
        if broken is not None and last:
            with watch.excusing():
                raise broken
        if broken is None and (last or _is_good(judge, found)):
            return found


def in_time(
    test: Callable[[], None], watched: Callable[[], AbstractContextManager[Watch]] = watching
) -> None:
    """Runs what a test does by the clock, from its first step; again where it was kept waiting."""
    driven(lambda _: test(), lambda _: None, watched)


def _is_good(judge: Callable[[T], object], found: T) -> bool:
    try:
        judge(found)
    except Exception as error:
        if not _is_broken_promise(error):
            raise
        return False
    return True


def _is_broken_promise(error: Exception) -> bool:
    """Also of several tasks of which each came to such an end."""
    if isinstance(error, ExceptionGroup):
        return error.split(BROKEN)[1] is None
    return isinstance(error, BROKEN)


def _started(*more: str, own_session: bool) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-I", "-S", str(WITNESS), str(TICK_S), *more],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        start_new_session=own_session,
    )

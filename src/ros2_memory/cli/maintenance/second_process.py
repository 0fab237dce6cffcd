"""A second process that digests its share of the bags, while a core is free for it."""

from __future__ import annotations

import os
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from ros2_memory.core.model import BagFile

_SHARED: Final = 512
"""It is started where more bags than these wait."""
_STARTED: Final = 1.75
"""Cores that other programs must leave for it to be started: the first process needs one."""
_KEPT: Final = 1.5
"""Cores that other programs must leave for it to go on."""
_AGAIN: Final = 12
"""Looks in a row at which a core must be free after the process was stopped for other programs: it
reads the summaries of all bags that wait when it starts."""
_MEASURED_NS: Final[Ns] = 5 * NS_PER_S
"""How long the processors are watched, at least, before it is started or stopped."""
_TICKS_OF_PROGRAMS: Final = (0, 1, 2, 5, 6, 7)
"""Columns of /proc/stat: user, nice, system, irq, softirq and steal, and not idle or iowait."""


class Worker(Protocol):
    """A process, as `multiprocessing` starts it."""

    @property
    def pid(self) -> int | None:
        """Its id."""
        ...

    def is_alive(self) -> bool:
        """Returns whether it goes on."""
        ...

    def terminate(self) -> None:
        """Ends it."""
        ...

    def join(self, timeout: float | None = None) -> None:
        """Waits for its end, at most `timeout` seconds."""
        ...


class SecondProcess:
    """Starts and stops the second process, between two batches of the first.

    Args:
        start: starts it for a round, whose bags `is_second` gives.
        free_cores: returns how many cores other programs than these processes leave; None where
            that was measured a moment ago.
    """

    def __init__(
        self, start: Callable[[int], Worker], free_cores: Callable[[Sequence[int]], float | None]
    ) -> None:
        self._start = start
        self._free_cores = free_cores
        self._worker: Worker | None = None
        self._round = 0
        self._looks_free = 0
        self._looks_needed = 1

    def share(self, waiting: Sequence[BagFile]) -> Sequence[BagFile]:
        """Returns the bags that the first process digests now, of all that wait.

        The second one is stopped where other programs need its core, and where it is all that is
        waited for.
        """
        worker = self._worker
        second = None if worker is None else worker.pid
        free = self._free_cores([os.getpid()] if second is None else [os.getpid(), second])
        if free is not None:
            self._looks_free = self._looks_free + 1 if free >= _STARTED else 0
        if worker is not None and not worker.is_alive():
            self.stop()
        elif worker is not None and free is not None and free < _KEPT:
            self.stop()
            self._looks_needed = _AGAIN
        elif worker is None and len(waiting) > _SHARED and self._looks_free >= self._looks_needed:
            self._round += 1
            self._worker = self._start(self._round)
        if self._worker is None:
            return waiting
        own = [bag for bag in waiting if not is_second(bag.file, self._round)]
        if not own:
            self.stop()
        return own or waiting

    def stop(self) -> None:
        """Ends the second process. What it was digesting is digested by the first one."""
        if self._worker is not None:
            self._worker.terminate()
            self._worker.join()
            self._worker = None


def is_second(file: str, nth: int) -> bool:
    """Whether a bag is the second process's in its nth round: every other one, in no order.

    Others in each round: what is left when it ends is shared again.
    """
    return bool(zlib.crc32(os.fsencode(file)) >> nth % 32 & 1)


class FreeCores:
    """Measures how many cores other programs leave.

    By what the processors did since the last look: the load average is that of a minute ago, and
    has these processes in it.

    Args:
        read: returns the text of a file below /proc.
        monotonic: a clock that never steps, in nanoseconds.
    """

    def __init__(
        self,
        read: Callable[[str], str] = lambda name: Path("/proc", name).read_text(encoding="utf-8"),
        monotonic: Callable[[], Ns] = time.monotonic_ns,
    ) -> None:
        self._read = read
        self._monotonic = monotonic
        self._cores = os.sched_getaffinity(0)
        self._hz = os.sysconf("SC_CLK_TCK")
        self._before: tuple[Ns, int, dict[int, int]] | None = None

    def __call__(self, own: Sequence[int]) -> float | None:
        """Returns the cores that are idle or used by `own` processes; None if looked at lately."""
        now, before = self._monotonic(), self._before
        if before is not None and now - before[0] < _MEASURED_NS:
            return None
        try:
            busy = busy_ticks(self._read("stat"), self._cores)
            used = {pid: used_ticks(self._read(f"{pid}/stat")) for pid in own}
        except (OSError, ValueError, LookupError):
            # Containers show other cores there than those that a process may run on.
            return 0.0
        self._before = now, busy, used
        if before is None:
            return None
        since, busy_before, used_before = before
        ours = sum(ticks - used_before.get(pid, 0) for pid, ticks in used.items())
        others = (busy - busy_before - ours) * NS_PER_S / (self._hz * (now - since))
        return len(self._cores) - others


def busy_ticks(stat: str, cores: Collection[int]) -> int:
    """Returns how long some cores ran programs, by the text of /proc/stat (proc_stat(5))."""
    rows = [line.split() for line in stat.splitlines() if line.startswith("cpu")]
    ticks = {row[0]: [int(each) for each in row[1:]] for row in rows}
    return sum(ticks[f"cpu{core}"][at] for core in cores for at in _TICKS_OF_PROGRAMS)


def used_ticks(stat: str) -> int:
    """Returns the processor time of a process, by its /proc/PID/stat (proc_pid_stat(5))."""
    # The name, in parentheses, may hold anything.
    fields = stat.rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])

"""A program that says how late the machine let programs run. Run as a script, without packages.

    python -I -S witness.py TICK_S [PID]

It wakes at a fixed rate and does a little work each time; how late the work was done is its own
lateness. Given a process number, it also looks at that process and all that came of it: for which
part of a second some thread of it was ready to run, and no processor took it. SIGTERM ends it: it
then writes what it saw at worst, as JSON: `late_s`, and `waited` by program.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

WORK = 20_000  # turns of an empty loop: about a millisecond
LOOK_S = 1.0

Waits = dict[tuple[int, int], int]


class Witness:
    """What one such program saw."""

    def __init__(self, tick_s: float, root: int | None) -> None:
        self._tick_s = tick_s
        self._root = root
        self._over = False
        self._due = time.monotonic()
        self._parent = os.getppid()
        self._late_s = 0.0
        self.waited: dict[str, float] = {}

    def end(self, *_: object) -> None:
        """Has `watch` return."""
        self._over = True

    def watch(self) -> dict[str, object]:
        """Watches until it is told to end, or nobody is there to be told; what it saw."""
        due = looked = self._due
        waits: Waits = {}
        over = False
        while not over:
            # What it slept through before counts.
            over = self._over or os.getppid() != self._parent
            due += self._tick_s
            time.sleep(max(0.0, due - time.monotonic()))
            for _ in range(WORK):
                pass
            now = time.monotonic()
            self._late_s = max(self._late_s, now - due)
            if now - looked >= LOOK_S:
                before, waits = waits, self._waits()
                self.compare(before, waits, now - looked)
                looked = now
            due = max(due, time.monotonic() - self._tick_s)
        return {"late_s": self._late_s, "waited": self.waited}

    def compare(self, before: Waits, after: Waits, seconds: float) -> None:
        """Notes which threads waited, and for how much of the time between two looks."""
        for thread, waited in after.items():
            share = (waited - before.get(thread, waited)) / 1e9 / seconds
            if share > 0.1:
                name = _name_of(thread[0])
                self.waited[name] = max(share, self.waited.get(name, 0.0))

    def _waits(self) -> Waits:
        """For how long (ns) each thread of the processes has waited for a processor so far."""
        found: Waits = {}
        for pid in () if self._root is None else _descendants(self._root):
            with suppress(OSError):
                for task in Path(f"/proc/{pid}/task").iterdir():
                    with suppress(OSError, ValueError, IndexError):
                        waited = (task / "schedstat").read_text().split()[1]
                        found[pid, int(task.name)] = int(waited)
        return found


def _descendants(root: int) -> set[int]:
    parents: dict[int, int] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            fields = (process / "stat").read_text().rpartition(")")[2].split()
            parents[int(process.name)] = int(fields[1])
    found, more = {root}, {root}
    while more:
        more = {pid for pid, parent in parents.items() if parent in more} - found
        found |= more
    return found


def _name_of(pid: int) -> str:
    """The program's name for a person, with the number of its process."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        words = []
    told = [Path(word).name for word in words if word and not word.startswith("-")]
    named = [word for word in told if not word.startswith("python")]
    return f"{' '.join(named[:1] or told[:1]) or 'a program'} ({pid})"


def main() -> None:
    """Watches, and writes what was seen."""
    witness = Witness(float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else None)
    signal.signal(signal.SIGTERM, witness.end)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    with suppress(BrokenPipeError):
        sys.stdout.write(json.dumps(witness.watch()) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()

"""Runs mutants through child processes, and adds up what became of them."""

import json
import os
import select
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tests.fuzz.classes import Job

HANG_S = 60.0
"""After so long without a word a child hangs: it asks seven questions, of 10 s each at most."""
_ROOT = Path(__file__).resolve().parents[2]
_MOST_LEFT_MB = 260


@dataclass
class Tally:
    """What became of the mutants of one class."""

    name: str
    mutants: int = 0
    held: int = 0
    questions: int = 0
    faults: list[str] = field(default_factory=list)

    def add(self, verdict: dict[str, Any]) -> None:
        """Counts one verdict in."""
        self.mutants += 1
        self.held += verdict.get("told_apart", False) and verdict["served"]
        self.questions += verdict.get("asked", 0)
        made = [str(verdict.get(key)) for key in ("number", "mutation", "good", "told")]
        self.faults += [f"{' '.join(made)}: {fault}" for fault in verdict["faults"]]


class Child:
    """One worker process in a folder of its own; a context manager."""

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.worker", str(folder)],
            cwd=_ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "TMPDIR": str(folder)},
        )
        self._kept = b""

    def close(self) -> None:
        """Ends it."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
        self.kill()

    def kill(self) -> None:
        """Has it die at once."""
        self._process.kill()
        self._process.wait()

    def try_one(self, job: Job) -> dict[str, Any]:
        """The verdict, or what the child died of."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(asdict(job)).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return self._died(job, "crash")
        line = self._line()
        if line is None:
            return self._died(job, "hang")
        if not line:
            return self._died(job, "crash")
        told: dict[str, Any] = json.loads(line)
        return told

    def _died(self, job: Job, how: str) -> dict[str, Any]:
        self.close()
        reason = f"{how}: exit code {self._process.returncode}"
        return {**asdict(job), "died": how, "faults": [reason]}

    def _line(self) -> bytes | None:
        """The next line; empty at its end, None where it says nothing for too long."""
        assert self._process.stdout is not None
        while b"\n" not in self._kept:
            ready, _, _ = select.select([self._process.stdout], [], [], HANG_S)
            if not ready:
                return None
            piece = os.read(self._process.stdout.fileno(), 1 << 16)
            if not piece:
                return b""
            self._kept += piece
        line, _, self._kept = self._kept.partition(b"\n")
        return line


def run(jobs: Iterable[Job]) -> Iterator[dict[str, Any]]:
    """The verdicts; a child that died is replaced, and its mutant tried once more alone."""
    with TemporaryDirectory(prefix="ros2-memory-fuzz-") as root:
        child, made = None, 0
        try:
            for job in jobs:
                if child is None:
                    made += 1
                    child = Child(_folder(root, made))
                verdict = child.try_one(job)
                if verdict.get("died"):
                    # Alone: whether it is this one, or what the ones before had left behind.
                    made += 1
                    child = Child(_folder(root, made))
                    again = child.try_one(job)
                    if again.get("died"):
                        child = None
                    else:
                        verdict["faults"].append("not when it is tried alone")
                elif verdict["left_mb"] > _MOST_LEFT_MB and child is not None:
                    # What one mutant leaves behind must not be counted as the next one's.
                    child.close()
                    child = None
                yield verdict
        finally:
            if child is not None:
                child.close()


def _folder(root: str, number: int) -> Path:
    folder = Path(root) / str(number)
    folder.mkdir()
    return folder


def campaign(mutants: Mapping[str, int], seed: int) -> dict[str, Tally]:
    """Tries so many mutants of each class."""
    jobs = [Job(name, number, seed) for name, count in mutants.items() for number in range(count)]
    tallies = {name: Tally(name) for name in mutants}
    for verdict in run(jobs):
        tallies[verdict["name"]].add(verdict)
    return tallies

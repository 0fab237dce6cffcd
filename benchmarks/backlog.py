"""How long point queries take while a backlog of bags is digested, against a quiet machine.

The backlog is digested as it is in use: by a child process of low priority.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from benchmarks import digests, ours
from benchmarks.bags import ODOM, History
from benchmarks.report import Figure
from benchmarks.timing import Timed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.questions import Case

_ROOT: Final = Path(__file__).resolve().parents[1]
_ASKED: Final = 1_000
_PAUSE_S: Final = 0.002
_MOST_TIMES: Final = 3.0


def figures(case: Case) -> list[Figure]:
    """The 99th percentile of point queries, quiet and during a backlog, and their ratio."""
    _points(case, _ASKED // 10)
    quiet = _points(case, _ASKED)
    history = case.history
    argv = [sys.executable, "-m", "benchmarks.backlog", str(history.folder), str(history.bags)]
    with subprocess.Popen(argv, cwd=_ROOT, stdout=subprocess.PIPE, text=True) as child:
        try:
            if child.stdout is None or not child.stdout.readline():
                raise RuntimeError("the process that digests a backlog did not begin")
            busy = _points(case, _ASKED)
        finally:
            child.terminate()
    words = f"99th percentile of {_ASKED} point queries"
    return [
        Figure("p99-quiet", f"{words}, quiet", quiet * 1e3, "ms"),
        Figure("p99-backlog", f"{words}, while a backlog is digested", busy * 1e3, "ms"),
        Figure("p99-ratio", "the second of these to the first", busy / quiet, "times", _MOST_TIMES),
    ]


def _points(case: Case, count: int) -> float:
    """The 99th percentile in seconds; asked one by one with a breath between, as a robot asks."""
    timed = Timed()
    for _ in range(count):
        ((_, moment),) = case.moments(1)
        begun = time.perf_counter()
        ours.position_at(case.memory, ODOM.name, moment / 1e9)
        timed.seconds.append(time.perf_counter() - begun)
        time.sleep(_PAUSE_S)
    return timed.quantile(0.99)


def main(argv: Sequence[str]) -> None:
    """Digests all bags again and again, until it is ended; a line says that it began."""
    folder, bags = argv
    os.nice(19)
    settings = ours.settings_for(Path(folder))
    digester = digests.digester_of(ours.memory(settings), settings)
    paths = [split.path for split in History(Path(folder), int(bags)).splits()]
    digester.digest(paths[0])
    print("begun", flush=True)
    while True:
        for path in paths:
            digester.digest(path)


if __name__ == "__main__":
    main(sys.argv[1:])

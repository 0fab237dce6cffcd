"""How long point queries take while a backlog of bags is digested, against a quiet machine.

The backlog is digested by what the server starts for it: `ros2-memory index` in a process of its
own. That process is stopped and let go on in turn, so that both are measured in the same minutes.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Final

from benchmarks import ours
from benchmarks.bags import ODOM
from benchmarks.copies import copied
from benchmarks.questions import Case
from benchmarks.report import Figure
from benchmarks.timing import Timed

if TYPE_CHECKING:
    from benchmarks.bags import History
    from ros2_memory.history.context import Memory

_ASKED: Final = 1_000
_ROUNDS: Final = 10
_PAUSE_S: Final = 0.002
_MOST_TIMES: Final = 3.0
_BEGINS_WITHIN_S: Final = 60.0


def figures(history: History) -> list[Figure]:
    """The 99th percentile of point queries, quiet and during a backlog, and their ratio.

    Raises:
        RuntimeError: the backlog was digested before all was asked, or never.
    """
    # Another name for the same bags, where no catalogue lies.
    bare = copied(history, 1).folder
    case = Case(history, ours.settings_for(bare), known=False)
    _ask(case, Timed())
    quiet, busy = Timed(), Timed()
    program = [sys.executable, "-m", "ros2_memory.cli", "index"]
    command = [*program, "--for-server", str(os.getpid()), "--"]
    with subprocess.Popen([*command, *ours.overrides(bare)], stderr=subprocess.DEVNULL) as child:
        try:
            _wait_for_entries(case.memory)
            for _ in range(_ROUNDS):
                child.send_signal(signal.SIGSTOP)
                _ask(case, quiet)
                child.send_signal(signal.SIGCONT)
                _ask(case, busy)
            ended = child.poll() is not None
        finally:
            child.send_signal(signal.SIGCONT)
            child.terminate()
    if ended:
        raise RuntimeError("the backlog was digested before all was asked: use more bags")
    quiet_s, busy_s = quiet.quantile(0.99), busy.quantile(0.99)
    words = f"99th percentile of {_ASKED} point queries"
    return [
        Figure("p99-quiet", f"{words}, quiet", quiet_s * 1e3, "ms"),
        Figure("p99-backlog", f"{words}, while a backlog is digested", busy_s * 1e3, "ms"),
        Figure("p99-ratio", "the second of these to the first", busy_s / quiet_s, "x", _MOST_TIMES),
    ]


def _ask(case: Case, timed: Timed) -> None:
    """Some points, one by one with a breath between, as a robot asks."""
    for _ in range(_ASKED // _ROUNDS):
        ((_, moment),) = case.moments(1)
        begun = time.perf_counter()
        ours.position_at(case.memory, ODOM.name, moment / 1e9)
        timed.seconds.append(time.perf_counter() - begun)
        time.sleep(_PAUSE_S)


def _wait_for_entries(memory: Memory) -> None:
    patience = time.monotonic() + _BEGINS_WITHIN_S
    while memory.recall is None or not memory.recall.catalogue.newest():
        if time.monotonic() > patience:
            raise RuntimeError("the backlog is not being digested")
        time.sleep(0.01)

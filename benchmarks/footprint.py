"""Peak memory of each side, in a process of its own that answers the questions of an hour."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import ours, plain
from benchmarks.bags import ODOM, SCENE, History
from benchmarks.motion import NOWHERE
from benchmarks.payloads import NEVER_SEEN
from benchmarks.questions import Case
from benchmarks.report import Figure
from benchmarks.timing import OURS, PLAIN

if TYPE_CHECKING:
    from collections.abc import Sequence

_ROOT = Path(__file__).resolve().parents[1]


def figures(history: History) -> list[Figure]:
    """The peak memory of each side, and of a process that answers nothing."""
    said = {
        "nothing": "peak memory of this program's imports",
        OURS: f"peak memory, ours: index of {history.bags} bags, each question once",
        PLAIN: "peak memory, plain rosbags: each question once over the hour",
    }
    return [
        Figure(f"peak-{side}", words, _peak_mb(side, history), "MB") for side, words in said.items()
    ]


def _peak_mb(side: str, history: History) -> float:
    argv = [sys.executable, "-m", "benchmarks.footprint", side, str(history.folder)]
    done = subprocess.run(
        [*argv, str(history.bags)], cwd=_ROOT, check=True, capture_output=True, text=True
    )
    return float(done.stdout)


def resident_mb(field: str, process: str = "self") -> float:
    """Resident memory of a process: `VmRSS` as it is, `VmHWM` at its peak. Linux only.

    Not from `getrusage`, whose peak a child inherits from the program that started it.
    """
    text = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith(field))
    return int(line.split()[1]) * 1024 / 1e6


def _ours(case: Case) -> None:
    start, stop = case.window
    memory = case.memory
    ours.counts(memory)
    ours.position_at(memory, ODOM.name, (stop - 1) / 1e9)
    ours.samples(memory, ODOM.name, start, stop, 100)
    ours.path_length(memory, ODOM.name, start, stop)
    ours.last_match(memory, SCENE.name, "contains", NEVER_SEEN)
    ours.last_match(memory, ODOM.name, "near_position", dict(zip("xy", NOWHERE, strict=True)))


def _plain(case: Case) -> None:
    start, stop = case.window
    plain.index([split.path for split in case.hour])
    plain.samples(case.hour, ODOM.name, start, stop, 100)
    plain.path_length(case.hour, ODOM.name, start, stop)
    plain.last_match(case.hour, SCENE.name, plain.shows(NEVER_SEEN))
    plain.last_match(case.hour, ODOM.name, plain.near(*NOWHERE, 0.5))


def main(argv: Sequence[str]) -> None:
    """Answers as one side, then prints the process's peak resident memory in MB."""
    side, folder, bags = argv
    case = Case(History(Path(folder), int(bags)), ours.settings_for(Path(folder)))
    if side == OURS:
        _ours(case)
    elif side == PLAIN:
        _plain(case)
    print(resident_mb("VmHWM"))


if __name__ == "__main__":
    main(sys.argv[1:])

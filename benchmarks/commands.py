"""The start of the CLI: the processor time of a short command, beside that of its libraries."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Final

from benchmarks import ours
from benchmarks.report import Figure

if TYPE_CHECKING:
    from benchmarks.bags import History

_RUNS: Final = 9
_MAX_RATIO: Final = 1.8
_MAX_HELP_S: Final = 0.2
_LIBRARIES: Final = "import pydantic, hydra, omegaconf, structlog, typer, numpy"


def figures(history: History) -> list[Figure]:
    """What `--help` costs, and three commands over a recording whose bags are in the catalogue."""
    with tempfile.TemporaryDirectory() as folder:
        bag_dir = Path(folder, "bags")
        recording = next(iter(history.splits())).path.parent
        shutil.copytree(recording, bag_dir / recording.name)
        words = [*ours.overrides(bag_dir), "data.now=latest"]
        settings = [f"--set={each}" for each in words]
        commands = {
            "info": ["info", *words],
            "topics": ["topics", *words],
            "ask": ["ask", "get_position_seconds_ago", "seconds_ago=1", *settings],
        }
        _run("-m", "ros2_memory.cli", "index", *words)
        runs = [_paired(commands) for _ in range(_RUNS)]
    ratios = {name: median(run[name] / run[""] for run in runs) for name in commands}
    help_s = median(_run("-m", "ros2_memory.cli", "--help") for _ in range(_RUNS))
    return [
        Figure("cli-help", "ros2-memory --help: processor time", help_s, "s", _MAX_HELP_S),
        *(
            Figure(
                f"cli-{name}",
                f"ros2-memory {name}: processor time, in that of importing its libraries alone",
                ratio,
                "times",
                _MAX_RATIO,
            )
            for name, ratio in ratios.items()
        ),
    ]


def _paired(commands: dict[str, list[str]]) -> dict[str, float]:
    """The processor time of each command, and under "" that of importing the libraries (s)."""
    taken = {"": _run("-c", _LIBRARIES)}
    return taken | {name: _run("-m", "ros2_memory.cli", *argv) for name, argv in commands.items()}


def _run(*argv: str) -> float:
    """The processor time of a Python program, user and system (s).

    Raises:
        CalledProcessError: it ended with another code than 0.
    """
    before = os.times()
    subprocess.run([sys.executable, *argv], env=_environment(), capture_output=True, check=True)
    after = os.times()
    return (after.children_user - before.children_user) + (
        after.children_system - before.children_system
    )


def _environment() -> dict[str, str]:
    """This process's, without settings of a memory, and with compiled modules."""
    return {
        name: text
        for name, text in os.environ.items()
        if not name.startswith(("MEMORY_", "MCP_")) and name != "PYTHONDONTWRITEBYTECODE"
    }

"""What was measured, as one table for people and as JSON for programs."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

_HEADS: Final = ("figure", "ours", "plain rosbags", "floor", "answer", "left out")


class Line(NamedTuple):
    """A line of the table: a figure, ours, the yardsticks', the answer, and what was left out."""

    figure: str
    ours: str
    plain: str = ""
    floor: str = ""
    answer: str = ""
    trouble: str = ""


def milliseconds(*values: float) -> str:
    """Returns times as text, the first time and again."""
    return (
        " / ".join(f"{value:,.0f}" if value >= 10 else f"{value:.2g}" for value in values) + " ms"
    )


def row(cells: Sequence[str]) -> str:
    """Returns a row of a table in Markdown."""
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def head(title: str) -> str:
    """Returns what stands above the rows: what was measured, where, of which commit."""
    return f"{title}\n\n{machine()}, {commit()}\n\n{row(_HEADS)}\n{row(['---'] * len(_HEADS))}"


def commit() -> str:
    """Returns the commit that is measured, and whether the sources are as it has them."""
    root = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str:
        program = ["git", "-C", str(root), *words]
        return subprocess.run(program, check=False, capture_output=True, text=True).stdout.strip()

    return f"{git('rev-parse', 'HEAD')[:16]}{' with changes' if git('status', '-s', 'src') else ''}"


def machine() -> str:
    """Returns the processor, how many cores there are, how busy they are, and Python's version."""
    cores, busy = os.cpu_count(), os.getloadavg()[0]
    name = _field("/proc/cpuinfo", "model name") or platform.machine()
    return f"{name}, {cores} cores (load {busy:.1f}), Python {platform.python_version()}"


def _field(path: str, name: str) -> str | None:
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), None)

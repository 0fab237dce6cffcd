"""`python -m benchmarks`: makes the bags, asks every side every question, prints what it took."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from benchmarks import digests, footprint, ours, report
from benchmarks.bags import MESSAGES_OF_A_SPLIT, made
from benchmarks.questions import QUESTIONS, Case
from benchmarks.timing import agreed, timed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.bags import History
    from benchmarks.report import Figure, Row

_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
_ENOUGH_S: Final = 20.0
"""A side that has taken so long in all is not asked in further runs."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark; the exit code is 0 whatever was measured."""
    asked = _parser().parse_args(argv)
    history = made(asked.dir, asked.bags)
    size_kb = sum(split.path.stat().st_size for split in history.splits()) / history.bags / 1e3
    about = report.machine()
    print(
        f"{history.bags} bags of {MESSAGES_OF_A_SPLIT} messages, {size_kb:.0f} kB each\n{about}\n"
        "Medians; the page cache is warm for every side. plain: rosbags, one Reader a bag. "
        "floor: open, read, decompress, decode what is returned.\n",
        flush=True,
    )
    rows = measured(history, asked.only or list(QUESTIONS), asked.runs)
    figures = [] if asked.only else _figures(history, asked.runs)
    print("\n" + report.as_table(rows, figures))
    if asked.json is not None:
        told = report.as_json(rows, figures, about) | {"bags": history.bags}
        asked.json.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    return 0


def measured(history: History, slugs: Sequence[str], runs: int) -> list[Row]:
    """Asks the questions, one after the other.

    Raises:
        DisagreementError: two sides gave different answers.
    """
    case = Case(history, ours.settings_for(history.folder))
    rows = []
    for slug in slugs:
        print(f"{slug} ...", file=sys.stderr, flush=True)
        question = QUESTIONS[slug](case)
        found = timed(question.sides, runs, at_most_s=_ENOUGH_S)
        agreed(found, silent=question.silent)
        rows.append(report.row(slug, question, found))
    return rows


def _figures(history: History, runs: int) -> list[Figure]:
    case = Case(history, ours.settings_for(history.folder))
    return [digests.cost(case, runs), *footprint.figures(history)]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--bags", type=int, default=360, help="splits of 10 s (60480: a week)")
    parser.add_argument("--runs", type=int, default=5, help="how often each side is asked")
    parser.add_argument(
        "--only", nargs="+", choices=list(QUESTIONS), metavar="QUESTION", help=", ".join(QUESTIONS)
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    parser.add_argument("--dir", type=Path, default=_DIR, help="where bags are kept between runs")
    return parser


if __name__ == "__main__":
    sys.exit(main())

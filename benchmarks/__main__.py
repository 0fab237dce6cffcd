"""`python -m benchmarks`: makes the bags, asks every side every question, prints what it took."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from benchmarks import backlog, commands, digests, footprint, ours, report, serving
from benchmarks.bags import HOUR, MESSAGES_OF_A_SPLIT, WEEK, made
from benchmarks.copies import copied
from benchmarks.questions import QUESTIONS, Case
from benchmarks.timing import agreed, timed
from benchmarks.week import RECORDINGS, WEEK_QUESTIONS, Week

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from benchmarks.bags import History
    from benchmarks.questions import Question
    from benchmarks.report import Figure, Row

T = TypeVar("T")

_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
_HOW: Final = (
    "Medians; the page cache is warm for every side. plain: rosbags, one Reader a bag. "
    "floor: open, read, decompress, decode what is returned."
)
_ENOUGH_S: Final = 20.0
"""A side that has taken so long in all is not asked in further runs."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark; the exit code is 0 whatever was measured."""
    parser = _parser()
    asked = parser.parse_args(argv)
    known = WEEK_QUESTIONS if asked.catalogue else QUESTIONS
    slugs = asked.only or list(known)
    if strange := [slug for slug in slugs if slug not in known]:
        parser.error(f"{', '.join(strange)}: the questions here are {', '.join(known)}")
    history = made(asked.dir, HOUR if asked.catalogue else asked.bags)
    about = report.machine()
    linking = (
        f"{RECORDINGS * HOUR} names in {RECORDINGS} recordings for " if asked.catalogue else ""
    )
    print(f"{linking}{_described(history)}\n{about}\n{_HOW}\n", flush=True)
    if asked.catalogue:
        rows, figures = _week(history, slugs, asked.runs, whole=not asked.only)
    else:
        rows, figures = _hour(history, slugs, asked.runs, whole=not asked.only)
    print("\n" + report.as_table(rows, figures))
    if asked.json is not None:
        bags = RECORDINGS * HOUR if asked.catalogue else history.bags
        told = report.as_json(rows, figures, about) | {"bags": bags}
        asked.json.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    return 0


def measured(questions: Mapping[str, Callable[[T], Question]], case: T, runs: int) -> list[Row]:
    """Asks the questions of a case, one after the other.

    Raises:
        DisagreementError: two sides gave different answers.
    """
    rows = []
    for slug, build in questions.items():
        print(f"{slug} ...", file=sys.stderr, flush=True)
        question = build(case)
        found = timed(question.sides, runs, at_most_s=_ENOUGH_S)
        agreed(found, silent=question.silent)
        rows.append(report.row(slug, question, found))
    return rows


def _hour(
    history: History, slugs: Sequence[str], runs: int, *, whole: bool
) -> tuple[list[Row], list[Figure]]:
    case = Case(history, ours.settings_for(history.folder))
    rows = measured({slug: QUESTIONS[slug] for slug in slugs}, case, runs)
    if not whole:
        return rows, []
    return rows, [
        digests.cost(case, runs),
        *backlog.figures(history),
        *footprint.figures(history),
        *commands.figures(history),
    ]


def _week(
    hour: History, slugs: Sequence[str], runs: int, *, whole: bool
) -> tuple[list[Row], list[Figure]]:
    copies = copied(hour, RECORDINGS)
    week = Week(copies, ours.settings_for(copies.folder))
    rows = measured({slug: WEEK_QUESTIONS[slug] for slug in slugs}, week, runs)
    return rows, serving.figures(copies.folder, copies.bags, hour.end) if whole else []


def _described(history: History) -> str:
    size_kb = sum(split.path.stat().st_size for split in history.splits()) / history.bags / 1e3
    return f"{history.bags} bags of {MESSAGES_OF_A_SPLIT} messages, {size_kb:.0f} kB each"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--bags", type=int, default=HOUR, help=f"splits of 10 s ({WEEK}: a week)")
    parser.add_argument(
        "--catalogue",
        action="store_true",
        help=f"a week of {WEEK} bags that only the catalogue knows, made of one hour's",
    )
    parser.add_argument("--runs", type=int, default=5, help="how often each side is asked")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="QUESTION",
        help=f"{', '.join(QUESTIONS)}; with --catalogue {', '.join(WEEK_QUESTIONS)}",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    parser.add_argument("--dir", type=Path, default=_DIR, help="where bags are kept between runs")
    return parser


if __name__ == "__main__":
    sys.exit(main())

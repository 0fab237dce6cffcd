"""`python -m tests.fuzz`: mutants by hand, as many as there is time for."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tests.fuzz.campaign import Tally, campaign
from tests.fuzz.classes import CLASSES, Job
from tests.fuzz.good import goods

if TYPE_CHECKING:
    from collections.abc import Sequence

_COLUMNS: Final = {
    "mutants": 8,
    "served": 7,
    "held": 6,
    "reasons": 8,
    "questions": 10,
    "crashes": 8,
    "hangs": 6,
    "faults": 7,
    "peak_mb": 8,
    "slowest_s": 10,
    "cpu_s": 7,
    "store_s": 8,
    "recover_s": 10,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs, prints a table, and gives 1 where something was found."""
    given = _parser().parse_args(argv)
    names: list[str] = given.classes or [*CLASSES]
    if given.write is not None:
        return _written(Job(names[0], given.first, given.seed), given.write)
    _say(f"{len(goods())} good bags, seed {given.seed}")
    _say(f"{'class':22}" + "".join(f"{name:>{width}}" for name, width in _COLUMNS.items()))
    tallies: list[Tally] = []

    def tell(tally: Tally) -> None:
        tallies.append(tally)
        _say(_row(tally))
        if given.json is not None:
            rows = [asdict(each) for each in tallies]
            given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")

    campaign(dict.fromkeys(names, given.mutants), given.seed, first=given.first, tell=tell)
    _say(_row(_total(tallies)))
    for tally in tallies:
        for verdict in tally.found[: given.show]:
            _say(f"\n{json.dumps({k: v for k, v in verdict.items() if k != 'faults'})}")
            for fault in verdict["faults"]:
                _say("  " + fault.replace("\n", "\n  "))
    return int(any(tally.faults for tally in tallies))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _row(tally: Tally) -> str:
    cells = []
    for name, width in _COLUMNS.items():
        value = getattr(tally, name)
        cells.append(f"{value:>{width}.2f}" if name.endswith("_s") else f"{value:>{width}.0f}")
    return f"{tally.name:22}" + "".join(cells)


def _total(tallies: Sequence[Tally]) -> Tally:
    total = Tally("all")
    for each in tallies:
        for name in _COLUMNS:
            values = getattr(total, name), getattr(each, name)
            largest = name.endswith(("_s", "_mb"))
            setattr(total, name, max(values) if largest else sum(values))
    return total


def _written(job: Job, folder: Path) -> int:
    """Leaves one mutant in a folder, to be looked at."""
    mutant, good, mutation = job.made()
    _say(f"{mutant.place(folder, job.place)}: {mutation} of {good.kind}; {mutant.told}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--mutants", type=int, default=50, help="of each class")
    parser.add_argument("--seed", type=int, default=0, help="the same seed makes the same mutants")
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant")
    parser.add_argument(
        "--class", dest="classes", action="append", choices=[*CLASSES], help="only this; repeatable"
    )
    parser.add_argument("--json", type=Path, help="file for the figures and all that was found")
    parser.add_argument("--show", type=int, default=5, help="findings shown of each class")
    parser.add_argument("--write", type=Path, help="only write the first mutant into this folder")
    return parser


if __name__ == "__main__":
    sys.exit(main())

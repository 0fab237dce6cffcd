"""`python -m tests.fuzz`: mutants by hand, as many as there is time for."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from tests.fuzz.campaign import Tally, campaign
from tests.fuzz.classes import CLASSES, Job


def main() -> int:
    """Tries mutants, prints a line for each class and what was found; gives 1 where it was."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--mutants", type=int, default=50, help="of each class")
    parser.add_argument("--seed", type=int, default=0, help="the same seed makes the same mutants")
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant")
    parser.add_argument(
        "--class", dest="names", action="append", choices=[*CLASSES], help="only this; repeatable"
    )
    parser.add_argument("--write", type=Path, help="only write the first mutant into this folder")
    given = parser.parse_args()
    names: list[str] = given.names or [*CLASSES]
    if given.write is not None:
        job = Job(names[0], given.first, given.seed)
        mutant, good, mutation = job.made()
        _say(f"{mutant.place(given.write, job.place)}: {mutation} of {good.kind}; {mutant.told}")
        return 0
    mutants = dict.fromkeys(names, given.mutants)
    tallies = campaign(mutants, given.seed, first=given.first, tell=_tell)
    return int(any(tally.found for tally in tallies))


def _tell(tally: Tally) -> None:
    _say(
        f"{tally.name:22} {tally.mutants} mutants: {tally.served} served, {tally.held} held to what"
        f" can be read, {tally.crashes} crashes, {tally.hangs} hangs, {len(tally.found)} faulty"
    )
    for verdict in tally.found:
        _say(json.dumps(verdict, indent=1))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())

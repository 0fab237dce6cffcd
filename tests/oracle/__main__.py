"""A long examination: `uv run python -m tests.oracle --questions 5000 --seed 7 [--world NAME]`."""

from __future__ import annotations

import argparse
import logging
import os
import random
import sys
import tempfile
from pathlib import Path

import structlog

from tests.oracle.exam import Server, examine
from tests.oracle.truth import History
from tests.oracle.worlds import WORLDS


def main() -> int:
    """Prints every wrong answer, and a line for each world; 1 where anything is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle", description=__doc__)
    parser.add_argument("--questions", type=int, default=1000, help="of each world")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--world", choices=WORLDS, action="append", help="default: all")
    given = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    wrong = 0
    for name in given.world or WORLDS:
        for stored in (False, True):
            with tempfile.TemporaryDirectory() as place:
                os.environ["XDG_CACHE_HOME"] = f"{place}/cache"
                draw = random.Random(given.seed)
                world = WORLDS[name](Path(place) / name, draw)
                server = Server(world.folder, world, stored=stored)
                try:
                    report = examine(world, History(world.folder), server, draw, given.questions)
                finally:
                    server.stop()
            for each in report.wrong:
                print(each)  # noqa: T201 - what it is for
            wrong += len(report.wrong)
            how = "with a store" if stored else "from the bags"
            print(f"{name}, {how}: {report.total - len(report.wrong)} of {report.total} right")  # noqa: T201
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

"""Records replies, or compares them: `python -m tests.oracle.replies record|compare`."""

from __future__ import annotations

import argparse
import sys
import time
from fnmatch import fnmatchcase

from tests.oracle.replies.comparison import Comparison
from tests.oracle.replies.fixture import Record, path_of
from tests.oracle.replies.recording import compare, record
from tests.oracle.replies.worlds import WORLDS


def main() -> int:
    """Prints a line for each world, and each difference; 1 where there is any."""
    given = _parser().parse_args()
    comparison = Comparison()
    calls = size = 0
    for name, world in WORLDS.items():
        if given.world and not any(fnmatchcase(name, glob) for glob in given.world):
            continue
        if world.long and not given.long:
            continue
        if world.absent is not None:
            print(f"{name}: left out: {world.absent}")  # noqa: T201 - what it is for
            continue
        begun, before = time.process_time(), len(comparison.differences)
        if given.what == "record":
            found = record(world, comparison)
            size += found.write()
            asked = len(found.replies)
        else:
            asked = compare(world, Record.read(name), comparison, stored=given.store)
            size += path_of(name).stat().st_size
        calls += asked
        for difference in comparison.differences[before:]:
            print(difference)  # noqa: T201
        took = time.process_time() - begun
        wrong = len(comparison.differences) - before
        print(f"{name}: {asked} calls, {wrong} differences, {took:.1f} s", flush=True)  # noqa: T201
    print(f"{calls} calls, {len(comparison.differences)} differences, {size} bytes")  # noqa: T201
    return 1 if comparison.differences and given.what == "compare" else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.oracle.replies", description=__doc__)
    parser.add_argument("what", choices=["record", "compare"])
    parser.add_argument(
        "--world", action="append", metavar="GLOB", help="only these worlds; repeatable"
    )
    parser.add_argument("--long", action="store_true", help="also worlds that take minutes to make")
    parser.add_argument(
        "--store",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="compare what is answered with a filled store; else from the bags alone",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())

"""The child process that tries mutants: jobs come in as JSON lines, verdicts go out as such.

A child of its own, so that a crash, a hang or a growth of memory is seen as what it is.
"""

import ctypes
import gc
import json
import os
import resource
import sys
import traceback
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from tests.fuzz.classes import Job
from tests.fuzz.trial import Verdict, World, resident_mb, tried

_MUCH_MB = 220
_MOST_ADDRESSES = 8 << 30
"""So that what would take all memory of the machine fails here."""
_COMBINATIONS = (("mcap", False), ("rosbag2", True), ("rosbag2", False), ("mcap", True))


def main() -> None:
    """Tries the jobs of stdin, until that ends."""
    root = Path(sys.argv[1])
    os.environ["XDG_CACHE_HOME"] = str(root / "cache")
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_ADDRESSES, _MOST_ADDRESSES))
    # Descriptor 1 is kept for verdicts alone.
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    worlds = {key: World(root, key[0], stored=key[1]) for key in _COMBINATIONS}
    for line in sys.stdin:
        job = Job(**json.loads(line))
        out.write(json.dumps(_verdict(worlds, job)) + "\n")


def _let_go(worlds: Iterable[World]) -> None:
    """Gives back what four memories keep, which are one in a server."""
    for world in worlds:
        world.renew()
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


def _verdict(worlds: dict[tuple[str, bool], World], job: Job) -> dict[str, object]:
    told: dict[str, object] = {**asdict(job)}
    try:
        mutant, good, mutation = job.made()
        turn = job.number % len(_COMBINATIONS)
        storage, stored = _COMBINATIONS[turn]
        if good.needs_rosbag2 and job.number % 16 > 1:
            storage = "rosbag2"
        told |= {"good": good.kind, "mutation": mutation, "told": mutant.told, "storage": storage}
        verdict = tried(worlds[storage, stored], job, mutant, good)
        if verdict.left_mb > _MUCH_MB:
            _let_go(worlds.values())
            verdict.left_mb = resident_mb()
    except Exception:  # noqa: BLE001  the next mutant is to be tried in any case
        verdict = Verdict(faults=[f"could not be tried: {traceback.format_exc()[-1500:]}"])
    return told | asdict(verdict)


if __name__ == "__main__":
    main()

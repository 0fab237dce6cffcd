"""Prints the processor time (s) of digesting and storing each bag of a directory, as JSON.

A program of its own, which runs on other sources of this project as well (`PYTHONPATH`): it uses
nothing that is not in all of them.
"""

from __future__ import annotations

import json
import sys
import time

from ros2_memory.bootstrap import build_backfill, build_memory
from ros2_memory.config import load_settings
from ros2_memory.core.logging_setup import configure_logging


def main(bag_dir: str) -> int:
    """Digests each bag once; the first ones, which compile decoders, are not counted."""
    configure_logging("error", "json")
    settings = load_settings([f"recording.bag_dir='{bag_dir}'", "data.now=latest"], env={})
    memory = build_memory(settings)
    memory.index.refresh()
    backfill = build_backfill(settings, memory)
    # What is in force for a bag is looked up once, not for each.
    waiting = sorted(backfill.waiting(), key=lambda bag: str(bag.path))
    spent = []
    for nth, bag in enumerate(waiting):
        begun = time.process_time()
        if not backfill.digest(bag):
            continue
        if nth >= 10:
            spent.append(time.process_time() - begun)
    print(json.dumps(spent))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

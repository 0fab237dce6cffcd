"""A housekeeper that deletes by a budget and keeps moments, all the time, until a file appears.

python -m tests.integration.rival_housekeeper BAG_DIR MAX_BYTES STOP_FILE
"""

import sys
from pathlib import Path

from ros2_memory.core.timebase import WallClock
from tests.support.housekeepers import keeper_of


def main(bag_dir: Path, max_bytes: int, stop: Path) -> None:
    house = keeper_of(bag_dir, max_bytes=max_bytes, clock=WallClock(), keeps_foreign=True)
    while not stop.exists():
        house.keep_moments()
        house.apply()
    house.keep_moments()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))

"""Handovers that an earlier run left, settled as a recorder does that starts."""

from contextlib import suppress
from pathlib import Path

from ros2_memory.core.errors import EpisodicError
from ros2_memory.recorder.handover import settle_handover, unsettled_handovers
from ros2_memory.storage.base import BagReader


def recover_handovers(bag_dir: Path, reader: BagReader) -> None:
    """Settles what can be settled while no recording is being written."""
    for old, new in unsettled_handovers(bag_dir):
        with suppress(EpisodicError, OSError):
            settle_handover(old, new, reader, ())

"""Builds what repairs and deletes bags: for the recorder daemon, and for `ros2-memory recover`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.adapters import GB, retention_limits
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.timebase import WallClock
from ros2_memory.recorder.housekeeping import Housekeeping, InBackground
from ros2_memory.recorder.time_sync import SystemTimeSync
from ros2_memory.retention.repair import Repairer
from ros2_memory.storage.mcap.embedded import custom_data
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.config import Settings
    from ros2_memory.recorder.ports import Housekeeper
    from ros2_memory.storage.base import BagReader


def moments_bytes(settings: Settings) -> int:
    """What moments may take; never more than half the budget, so that there is room for today."""
    kept = settings.retention
    return round(min(kept.max_moments_gb, kept.max_total_gb / 2) * GB)


def claim(own: OwnRecordings) -> None:
    """Puts the list of a bag directory's own recordings in order; nobody may be recording there.

    Raises:
        RecorderError: the list cannot be read, or the bag directory cannot be listed.
    """
    own.claim(custom_data)


def supposed_own(bag_dir: Path) -> OwnRecordings:
    """The recordings that a bag directory's recorder made; without a list, those it would claim.

    Raises:
        OSError: the list cannot be read, or the bag directory cannot be listed.
    """
    own = OwnRecordings(bag_dir)
    own.suppose(custom_data)
    return own


def build_housekeeper(
    settings: Settings, bag_dir: Path, reader: BagReader, own: OwnRecordings | None = None
) -> Housekeeper:
    """What repairs and deletes in the bag directory of the recorder; nobody else may delete.

    `own` is the list of the recordings that were made there.
    """
    limits = retention_limits(settings)
    return InBackground(
        Housekeeping(
            bag_dir,
            BagDirReader(reader),
            McapWriter(settings.reader.max_chunk_mb),
            WallClock(),
            limits,
            time_sync=SystemTimeSync(),
            split_duration_s=settings.recording.split_duration_s,
            own=own,
            moments_bytes=moments_bytes(settings),
            static_topics=settings.data.tf_static_topics,
            grace_s=settings.reader.index_refresh_s + settings.server.call_timeout_s,
        )
    )


def build_repairer() -> Repairer:
    """What repairs single MCAP files."""
    return Repairer(McapReader(), McapWriter())

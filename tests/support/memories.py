"""A whole memory over a folder of bags, as the composition root would build it."""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from ros2_memory.core.timebase import NS_PER_S, Clock
from ros2_memory.extract import SchemaExtractor
from ros2_memory.history.context import Memory, QuerySettings
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.clocks import SettableClock

if TYPE_CHECKING:
    from ros2_memory.storage.base import BagReader

LAST_WRITTEN = 1_800_000_000 * NS_PER_S
"""Tests date no bag later, unless that is what they test."""
ROOT = Path(__file__).resolve().parents[2]


@cache
def extractor() -> SchemaExtractor:
    """The extractor of the shipped schema map."""
    text = (ROOT / "config" / "message_schemas.yaml").read_text(encoding="utf-8")
    return SchemaExtractor(yaml.safe_load(text)["schemas"], max_array_length=50)


def memory_of(
    bag_dir: Path,
    *,
    storage: str = "mcap",
    clock: Clock | None = None,
    reader: BagReader | None = None,
    limits: QuerySettings | None = None,
    include_active: bool = False,
) -> Memory:
    """The memory over `bag_dir`, rescanned at every question.

    Unless a clock is given it is later by an hour, and than all that tests write: what is
    unfinished was left so by a crash, and nothing is dated in the future.
    """
    if reader is None:
        reader = McapReader() if storage == "mcap" else Rosbag2Reader()
    timed = clock or SettableClock(max(time.time_ns(), LAST_WRITTEN) + 3600 * NS_PER_S)
    index = IndexManager(
        bag_dir,
        reader,
        timed,
        refresh_s=0.0,
        split_duration_s=10.0,
        include_active=include_active,
    )
    return Memory(index, reader, extractor(), timed, limits or QuerySettings())

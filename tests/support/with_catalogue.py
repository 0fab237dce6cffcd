"""A memory with a catalogue in which every bag stands that may."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.lookup import DigestCache, bags_without_entry
from ros2_memory.catalogue.store import FILE, FOLDER, BagKey, Catalogue
from ros2_memory.core.errors import BagError

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.history.context import Memory


def recalling(memory: Memory, bag_dir: Path, *, part: float = 1.0) -> Memory:
    """The memory with a catalogue that knows the first `part` of the closed bags."""
    catalogue = Catalogue([bag_dir / FOLDER / FILE], "test")
    recall = DigestCache(catalogue, bag_dir)
    limit = memory.limits.max_plausible_speed_mps
    digester = Digester(memory.reader, memory.extractor, limit)
    bags = bags_without_entry(memory.index.snapshot().segments, recall)
    for bag in bags[: round(part * len(bags))]:
        with suppress(BagError):  # one that is damaged inside stays without an entry
            assert catalogue.put(BagKey.of(bag, bag_dir), digester.digest(bag.path))
    return replace(memory, recall=recall)

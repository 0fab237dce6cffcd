"""The memory of one robot over the bags that a lake has of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ros2_memory.columns.scanner import Scanner
from ros2_memory.history.context import Memory
from ros2_memory.lake.index import MOST_BAGS, LakeIndex
from ros2_memory.lake.reader import LakeReader

if TYPE_CHECKING:
    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.core.large_reads import LargeReads
    from ros2_memory.core.timebase import Clock
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.lake.files import Lake
    from ros2_memory.storage.base import BagReader


def lake_memory(
    lake: Lake,
    name: str,
    clock: Clock,
    limits: QuerySettings,
    *,
    extractor: SchemaExtractor,
    decoder: BagReader,
    large: LargeReads,
    store: ColumnStore | None = None,
    settings: str = "",
    refresh_s: float = 60.0,
    days: int = 31,
    most_bags: int = MOST_BAGS,
) -> Memory:
    """Returns what a bag directory's memory is, but for the index and what reads bags.

    Args:
        lake: the lake.
        name: of the robot there.
        clock: the wall clock.
        limits: the settings of queries.
        extractor: knows the types of messages.
        decoder: decodes messages.
        large: the turn to hold much of a bag.
        store: of the columns of its bags, which are made again from the lake; None for none.
        settings: what follows from bags depends on, as a text.
        refresh_s: how old (s) the index may be.
        days: how many days are looked at together, at least; see `LakeIndex`.
        most_bags: likewise, and of how many bags.
    """
    index = LakeIndex(lake, name, clock, refresh_s=refresh_s, days=days, most_bags=most_bags)
    return Memory(
        index,
        LakeReader(lake, name, index, decoder, large),
        extractor,
        clock,
        # Nothing is recorded here, and nothing deleted.
        replace(limits, kept=None, recording="", screened=False),
        Scanner(store, index.bag_dir, settings, large),
        large=large,
    )

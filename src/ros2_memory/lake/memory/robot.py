"""One robot of a lake: its memory, and the notes that answers from it get."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ros2_memory.columns.scanner import Scanner
from ros2_memory.history.context import Memory
from ros2_memory.lake.memory.index import MOST_BAGS, LakeIndex
from ros2_memory.lake.memory.reader import LakeReader
from ros2_memory.lake.tables import day_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.core.large_reads import LargeReads
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.lake.files import Lake
    from ros2_memory.storage.base import BagReader


class LakeRobot:
    """A robot's memory over the bags that a lake has of it.

    It is that of a bag directory, but for the index and what reads bags.

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

    Attributes:
        memory: what queries are asked of.
    """

    def __init__(
        self,
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
    ) -> None:
        self._index = LakeIndex(
            lake, name, clock, refresh_s=refresh_s, days=days, most_bags=most_bags
        )
        self.memory = Memory(
            self._index,
            LakeReader(lake, name, self._index, decoder, large),
            extractor,
            clock,
            # Nothing is recorded here, and nothing deleted.
            replace(limits, kept=None, recording="", screened=False),
            Scanner(store, self._index.bag_dir, settings, large),
            large=large,
        )

    @property
    def latest(self) -> Ns | None:
        """The log time of the newest message that was shipped; None if there is none."""
        known = self._index.published
        return None if known is None else known.latest

    def notes(self, begin: Ns | None = None) -> Iterator[str]:
        """Yields the notes for the answer that this thread has just computed.

        `begin` is from when (log time) the answer is; None for one that is of all days.
        """
        since = self._index.unseen_before()
        if since is not None and (begin is None or day_of(begin) < since):
            yield (
                f"the lake has days before {since}, which were not looked at: an end (or before, "
                "or a time) there has them looked at"
            )

"""One robot of a lake: its memory, and the notes that answers from it get."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ros2_memory.extract import SchemaExtractor
from ros2_memory.history.context import Memory
from ros2_memory.lake.memory.digests import LakeDigests
from ros2_memory.lake.memory.index import MOST_BAGS, LakeIndex
from ros2_memory.lake.memory.reader import LakeReader
from ros2_memory.lake.memory.rows_as_messages import stated_in
from ros2_memory.lake.tables import day_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.lake.files import Lake


class LakeExtractor(SchemaExtractor):
    """Takes values as they are, since those of rows were extracted when they were shipped.

    Args:
        shipped: what a type holds, as on the robot.
    """

    def __init__(self, shipped: SchemaExtractor) -> None:
        super().__init__({}, shipped.limit)
        self._shipped = shipped

    def is_mapped(self, type_name: str) -> bool:
        """Returns True: no message is read to see what its type holds."""
        del type_name
        return True

    def kinds_of(self, type_name: str) -> frozenset[str]:
        """Returns what messages of a mapped type have."""
        return self._shipped.kinds_of(type_name)


class LakeRobot:
    """A robot's memory over its rows.

    Args:
        lake: the lake.
        name: of the robot there.
        clock: the wall clock.
        limits: the settings of queries.
        extractor: knows the types of messages.
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
        extractor: SchemaExtractor,
        *,
        refresh_s: float = 60.0,
        days: int = 31,
        most_bags: int = MOST_BAGS,
    ) -> None:
        self._index = LakeIndex(
            lake,
            name,
            clock,
            pose_topic=limits.pose_topic,
            refresh_s=refresh_s,
            days=days,
            most_bags=most_bags,
        )
        self._reader = LakeReader(
            lake,
            name,
            self._index,
            map_frame=limits.map_frame,
            tf_topics=limits.tf_topics,
            static_topics=limits.tf_static_topics,
        )
        # Nothing is recorded here, and nothing deleted.
        own = replace(limits, kept=None, recording="", screened=False)
        self.memory = Memory(
            self._index,
            self._reader,
            LakeExtractor(extractor),
            clock,
            own,
            stated=stated_in,
            shipped=LakeDigests(lake, name, self._index),
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
        yield from self._reader.take_notes()

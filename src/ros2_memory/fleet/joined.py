"""The bags of a robot and those that only a lake has, as one memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.bag_dir.layout import is_derived, is_thinned
from ros2_memory.bag_dir.state_files import deleted_spans
from ros2_memory.core.memo import Key
from ros2_memory.core.model import SetAside
from ros2_memory.core.spans import lies_inside, overlaps_any, united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns, Span
    from ros2_memory.history.context import SnapshotSource
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.index.timeline import Timeline

_JOINED: Final[Key[dict[Timeline, tuple[Timeline, tuple[SetAside, ...]]]]] = Key()
_NAME_IN_USE: Final = "the lake has another bag of this name: rename its folder"


@dataclass(slots=True, eq=False)
class JoinedIndex:
    """What a lake has of a robot, and what the robot's bag directory has besides.

    A bag of both is that of the lake: what was made of it stays true when retention deletes it.
    Where the bag directory is missing, or cannot be read, what was shipped answers.

    Attributes:
        shipped: the bags in the lake, by the paths that they had in the bag directory.
        own: the bag directory.
        bag_dir: its path.
    """

    shipped: SnapshotSource
    own: SnapshotSource
    bag_dir: Path = field(init=False)

    def __post_init__(self) -> None:
        """Takes the path from the index of the bag directory."""
        self.bag_dir = self.own.bag_dir

    @property
    def published(self) -> Snapshot | None:
        """The last result, however old; None before the lake was looked into."""
        shipped, own = self.shipped.published, self.own.published
        return shipped if shipped is None or own is None else self._joined(shipped, own, MAX_NS)

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns a current snapshot; of some days up to `reach` where these are not the newest.

        Raises:
            RefusedError: the lake cannot be read.
        """
        shipped, newest = self.shipped.snapshot(reach), self.shipped.published
        is_newest = newest is None or shipped.timeline is newest.timeline
        until = MAX_NS if is_newest else shipped.timeline.latest
        return self._joined(shipped, self.own.snapshot(reach), until)

    def refresh(self) -> Snapshot:
        """Looks into the lake, and scans the bag directory, now."""
        return self._joined(self.shipped.refresh(), self.own.refresh(), MAX_NS)

    def heartbeat(self) -> Heartbeat | None:
        """Returns the last heartbeat of the bag directory's recorder."""
        return self.own.heartbeat()

    def joined_with(self, recording: Path) -> tuple[str, ...]:
        """Returns what handovers join with a recording, now or when it was shipped."""
        return self.own.joined_with(recording) or self.shipped.joined_with(recording)

    def _joined(self, shipped: Snapshot, own: Snapshot, until: Ns) -> Snapshot:
        """Returns the bags of the lake, and own ones that begin up to a time and are not there.

        Own ones of days of which those of the lake are not shown (`Snapshot.older`) are left out,
        too; one whose path is that of another bag is set aside.
        """
        if own.problem is not None:
            return shipped if shipped.timeline.segments else own
        made = shipped.timeline.memo.of(_JOINED, dict)
        known = made.get(own.timeline)
        if known is None:
            deleted = deleted_spans(self.bag_dir) if own.timeline.thinned else ()
            known = _timeline_of_both(shipped, own.timeline, until, deleted)
            made.clear()
            made[own.timeline] = known
        timeline, unnamed = known
        silent = (own.silent_topics | shipped.silent_topics).difference(timeline.topics())
        return replace(
            own,
            timeline=timeline,
            unread=(*own.unread, *unnamed),
            silent_topics=silent,
            older=shipped.older,
        )


def _timeline_of_both(
    shipped: Snapshot, own: Timeline, until: Ns, deleted: Sequence[Span]
) -> tuple[Timeline, tuple[SetAside, ...]]:
    """Returns the bags of both, and the own ones whose path another bag has in the lake.

    A bag is known by its first message, or, if that was deleted since, by its path and time. What
    stayed of a day counts unless the lake has all that was `deleted` of it.
    """
    after = MIN_NS if shipped.older is None else shipped.older
    in_lake = shipped.timeline.starts
    bags: list[BagFile] = []
    for segment in own.segments:
        starts = segment.bags.starts
        # Both are in order, so equal ones are found without a hash of them all.
        is_new = np.searchsorted(in_lake, starts) == np.searchsorted(in_lake, starts, "right")
        if segment.unthinned is not segment or segment.recorded is not segment:
            # What stayed of bags begins with a message of one of them.
            is_new |= [*map(is_derived, segment.bags.files())]
        is_own = is_new & (starts > after) & (starts <= until)
        bags += segment.bags.at(np.flatnonzero(is_own))
    if own.thinned:
        tables = [segment.bags for segment in shipped.timeline.segments]
        firsts = chain.from_iterable(table.starts.tolist() for table in tables)
        stops = chain.from_iterable((table.ends + 1).tolist() for table in tables)
        lost = without(deleted, united(zip(firsts, stops, strict=True), NS_PER_S))
        bags = [bag for bag in bags if not is_thinned(bag.file) or _is_needed(bag, deleted, lost)]
    same_name = {bag.file: bag for bag in shipped.timeline.named({bag.file for bag in bags})}
    unnamed = (
        SetAside(bag.path, _NAME_IN_USE)
        for bag in bags
        if (before := same_name.get(bag.file))
        # Messages were deleted from one that lies within it: the lake has it as it was.
        and not (before.start <= bag.start and bag.end <= before.end)
    )
    named = (bag for bag in bags if bag.file not in same_name)
    return shipped.timeline.changed((), named), tuple(unnamed)


def _is_needed(day: BagFile, deleted: Sequence[Span], lost: Sequence[Span]) -> bool:
    """Returns whether what stayed of a day may be of bags that were `lost`: deleted, not shipped.

    True also of a day before the oldest entry of `deleted`, of which this is unknown.
    """
    return not lies_inside(deleted, day.start) or overlaps_any(lost, day.start, day.end)

"""One index over a robot's own bags and those that only a lake has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import is_derived, is_thinned
from ros2_memory.bag_dir.state_files import deleted_spans
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BagFile, SetAside
from ros2_memory.core.spans import Spans, spans_of, united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.timebase import Ns, Span
    from ros2_memory.history.context import SnapshotSource
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.index.timeline import Timeline

_JOINED: Final[Key[dict[Timeline, tuple[Timeline, tuple[SetAside, ...]]]]] = Key()
_NAME_IN_USE: Final = "the lake has another bag of this name: rename its folder"


@dataclass(slots=True, eq=False)
class JoinedIndex:
    """The bags of a robot in a lake, and the bags that only its bag directory has.

    A bag in both is taken from the lake, so that it stays the same when retention deletes the file.
    If the bag directory is missing or cannot be read, the lake alone answers.

    Attributes:
        shipped: the bags in the lake, by the paths that they had in the bag directory.
        own: the bag directory.
        bag_dir: its path.
    """

    shipped: SnapshotSource
    own: SnapshotSource
    bag_dir: Path

    @property
    def published(self) -> Snapshot | None:
        """The last result, however old; None before the lake was looked into."""
        shipped, own = self.shipped.published, self.own.published
        return shipped if shipped is None or own is None else self._joined(shipped, own, MAX_NS)

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns a current snapshot; of days up to `reach` if these are not the newest ones.

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
        """Returns the recordings that handovers join with one, now or when it was shipped."""
        return self.own.joined_with(recording) or self.shipped.joined_with(recording)

    def _joined(self, shipped: Snapshot, own: Snapshot, until: Ns) -> Snapshot:
        """Returns one snapshot of the bags in the lake, and own bags that begin up to `until`.

        Own bags of days before those that the lake shows (`Snapshot.older`) are left out.
        """
        if own.problem is not None:
            return shipped if shipped.timeline.segments else own
        memo = shipped.timeline.memo.of(_JOINED, dict)
        joined = memo.get(own.timeline)
        if joined is None:
            joined = self._timeline_of_both(shipped, own.timeline, until)
            memo.clear()
            memo[own.timeline] = joined
        timeline, set_aside = joined
        silent = (own.silent_topics | shipped.silent_topics).difference(timeline.topics())
        return replace(
            own,
            timeline=timeline,
            unread=(*own.unread, *set_aside),
            silent_topics=silent,
            older=shipped.older,
        )

    def _timeline_of_both(
        self, shipped: Snapshot, own: Timeline, until: Ns
    ) -> tuple[Timeline, tuple[SetAside, ...]]:
        """Returns the bags of both, and own bags whose path another bag has in the lake."""
        bags, replaced = _bags_not_in_lake(shipped, own, until), dict[str, BagFile]()
        if own.thinned:
            deleted = deleted_spans(self.bag_dir)
            bags, replaced = _each_day_once(bags, shipped.timeline, deleted)
            # Their bags are not deleted, as that at the end of a day.
            for bag in own.bags:
                replaced.pop(bag.file, None)
        same_path = {
            bag.file: bag for bag in shipped.timeline.bags_named({bag.file for bag in bags})
        }
        named: list[BagFile] = []
        set_aside: list[SetAside] = []
        for bag in bags:
            in_lake = same_path.get(bag.file)
            if in_lake is None:
                named.append(bag)
            # A bag without its first messages, which were deleted, is the one in the lake.
            elif not (in_lake.start <= bag.start and bag.end <= in_lake.end):
                set_aside.append(SetAside(bag.path, _NAME_IN_USE))
        return shipped.timeline.changed(replaced.values(), named), tuple(set_aside)


def _bags_not_in_lake(shipped: Snapshot, own: Timeline, until: Ns) -> list[BagFile]:
    """Returns the own bags of the days that are shown with the times of no shipped bag.

    A derived bag may have the times of a recorded one, and is new all the same.
    """
    after = MIN_NS if shipped.older is None else shipped.older
    # Two runs of a simulation may begin at one moment of its clock.
    in_lake = {*spans_of(shipped.timeline.starts, shipped.timeline.ends)}
    return [
        bag
        for bag in own.bags
        if after < bag.start <= until
        and ((bag.start, bag.end) not in in_lake or is_derived(bag.file))
    ]


def _each_day_once(
    bags: Sequence[BagFile], shipped: Timeline, deleted: Sequence[Span]
) -> tuple[list[BagFile], dict[str, BagFile]]:
    """Returns own bags without thinned days of which the lake has more than it lacks.

    Also the lake's bags, by path, of the thinned days that stay: a rounded message is no copy of
    the recorded one, and both would count. Before the oldest of the `deleted` spans all is deleted.
    """
    in_lake = united(spans_of(shipped.starts, shipped.ends + 1), NS_PER_S)
    deleted = [(MIN_NS, deleted[0][0] if deleted else MAX_NS), *deleted]
    left: list[BagFile] = []
    replaced: dict[str, BagFile] = {}
    for bag in bags:
        if is_thinned(bag.file):
            day = bag.window
            lacks = without([(day.start, day.stop)], in_lake)
            lost_ns = _length(lacks) - _length(without(lacks, deleted))
            if day.stop - day.start - _length(lacks) > lost_ns:
                continue
            replaced |= {each.file: each for each in shipped.overlapping(day)}
        left.append(bag)
    return left, replaced


def _length(spans: Spans) -> Ns:
    return sum(stop - start for start, stop in spans)

"""Which bags of a timeline are stored, and under which numbers.

A week is 60,000 bags, and another one closes every ten seconds: what is known of a segment of the
timeline serves every later timeline that still has it.
"""

from __future__ import annotations

from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.arrays import concatenated, places_among, stable_order
from ros2_memory.core.model import MCAP, BagFile, BagState, TimeWindow
from ros2_memory.index.bag_rows import Bags

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.store import ColumnStore, State, StoredBags
    from ros2_memory.core.arrays import Flags
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.segment import Segment, TopicExtent
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import IntArray, Mask


class CoveredSegment(NamedTuple):
    """The bags of a segment, and how they are stored.

    Attributes:
        segment: of the timeline.
        numbers: the number of each bag in the store; -1 if it is not stored.
        hashed: whether copies of a bag's messages can be recognised.
        to_store: whether a bag is not stored but can be: it is closed, or cut short by a crash.
    """

    segment: Segment
    numbers: IntArray
    hashed: Mask
    to_store: Mask

    @property
    def is_missing(self) -> Mask:
        """Whether a bag is not stored."""
        return self.numbers < 0


class Coverage:
    """The stored and missing bags of one timeline. Immutable.

    Attributes:
        state: the state of the store.
        segments: the segments of the timeline.
    """

    def __init__(self, state: State, segments: Sequence[CoveredSegment]) -> None:
        self.state = state
        self.segments = tuple(segments)
        all_numbers = concatenated(covered.numbers for covered in segments)
        order = stable_order(all_numbers)
        self._bags = Bags(covered.segment.bags for covered in segments)
        self._order: IntArray = order[np.searchsorted(all_numbers[order], 0) :]
        self._numbers: IntArray = all_numbers[self._order]

    @property
    def stored(self) -> int:
        """How many bags are stored."""
        return self._numbers.size

    @cached_property
    def missing(self) -> Sequence[BagFile]:
        """The bags that are not stored, in order of time."""
        return self._bags_where(lambda covered: covered.is_missing)

    @cached_property
    def to_store(self) -> Sequence[BagFile]:
        """The bags that are not stored but can be, in order of time."""
        return self._bags_where(lambda covered: covered.to_store)

    def unhashed(self) -> list[BagFile]:
        """Returns the stored bags whose copied messages cannot be recognised."""
        return self._bags_where(lambda covered: ~covered.is_missing & ~covered.hashed)

    def _bags_where(self, mask_of: Callable[[CoveredSegment], Mask]) -> list[BagFile]:
        return [
            bag for covered in self.segments for bag in covered.segment.bags.at(mask_of(covered))
        ]

    def starts_to_store(self) -> list[Ns]:
        """Returns the log time (ns) of the first message of each bag in `to_store`."""
        return [
            start
            for covered in self.segments
            for start in covered.segment.bags.starts[covered.to_store]
        ]

    def missing_extents(self, topic: str, window: TimeWindow) -> Iterator[TopicExtent]:
        """Yields what `Timeline.extents` yields, of the bags that are not stored."""
        for covered in self.segments:
            bags = covered.segment.bags
            is_missing = covered.is_missing & window.overlapping(bags.starts, bags.ends)
            if is_missing.any():
                yield from covered.segment.extents(topic, window, is_missing)

    def _has_bags(self, numbers: IntArray) -> Flags:
        """Returns for each number whether the timeline has its bag."""
        return places_among(numbers, self._numbers)[1]

    def known(self, numbers: IntArray) -> IntArray:
        """Returns those of some bags that the timeline has, by their numbers."""
        return numbers[self._has_bags(numbers)]

    def counts(self, groups: Sequence[IntArray]) -> IntArray:
        """Returns how many bags of each group the timeline has; no group may be empty."""
        if not groups:
            return np.zeros(0, np.int64)
        begins = np.cumsum([0, *map(len, groups)])[:-1]
        has_bags = self._has_bags(np.concatenate(groups)).astype(np.int64)
        return np.asarray(np.add.reduceat(has_bags, begins))

    def bag(self, number: int) -> BagFile | None:
        """Returns the bag with a number; None if the timeline does not have it."""
        at = self._position(number)
        return None if at is None else self._bags[at]

    def recording(self, number: int) -> Path | None:
        """Returns the recording of the bag with a number; None if the timeline does not have it."""
        at = self._position(number)
        return None if at is None else self._bags.recording(at)

    def _position(self, number: int) -> int | None:
        at = int(self._numbers.searchsorted(number))
        has_bag = at < self._numbers.size and self._numbers[at] == number
        return int(self._order[at]) if has_bag else None


class Covering:
    """Returns which bags of a timeline are stored; remembers its segments. Thread-safe.

    Args:
        store: the store.
        bag_dir: the bag directory.
    """

    def __init__(self, store: ColumnStore, bag_dir: Path) -> None:
        self.store = store
        self._root = str(bag_dir)
        self._lock = Lock()
        self._by_id: dict[int, CoveredSegment] = {}
        self._latest: tuple[Timeline, Coverage] | None = None

    def of(self, timeline: Timeline) -> Coverage:
        """Returns the coverage of a timeline, as the store is now."""
        failures, state = self.store.failures, self.store.state()
        with self._lock:
            if self._latest is not None:
                covered_timeline, coverage = self._latest
                if covered_timeline is timeline and coverage.state == state:
                    return coverage
                if coverage.state.deletion != state.deletion:
                    numbers = self.store.numbers()
                    self._by_id = {
                        key: covered
                        for key, covered in self._by_id.items()
                        if np.isin(covered.numbers[~covered.is_missing], numbers).all()
                    }
            segments = self._covered_segments(timeline, state)
            coverage = Coverage(state, segments)
            if self.store.failures != failures:
                return coverage
            # By identity: a segment is immutable, and lives as long as its entry here.
            self._by_id = {id(covered.segment): covered for covered in segments}
            self._latest = timeline, coverage
            return coverage

    def _covered_segments(self, timeline: Timeline, state: State) -> list[CoveredSegment]:
        is_same_state = self._latest is not None and self._latest[1].state == state
        covered_of: dict[int, CoveredSegment] = {}
        unknown: list[Segment] = []
        for segment in timeline.segments:
            covered = self._by_id.get(id(segment))
            if (
                covered is not None
                and covered.segment is segment
                and (is_same_state or not covered.to_store.any())
            ):
                covered_of[id(segment)] = covered
            else:
                unknown.append(segment)
        groups = [segment.bags for segment in unknown]
        stored_bags = self.store.stored_bags(groups, self._root, state.deletion)
        for segment, stored in zip(unknown, stored_bags, strict=True):
            covered_of[id(segment)] = _covered_segment(segment, stored)
        return [covered_of[id(segment)] for segment in timeline.segments]


def _covered_segment(segment: Segment, stored: StoredBags) -> CoveredSegment:
    bags = segment.bags
    can_be_stored = bags.in_state(BagState.CLOSED)
    left_open = np.flatnonzero(bags.in_state(BagState.INCOMPLETE))
    # A database goes on in its journal, which may change while its own file does not.
    can_be_stored[left_open] = [file.endswith(MCAP) for file in bags.files(left_open)]
    is_stored: Mask = can_be_stored & (stored.numbers >= 0)
    numbers = np.where(is_stored, stored.numbers, -1)
    return CoveredSegment(segment, numbers, is_stored & stored.hashed, can_be_stored & ~is_stored)

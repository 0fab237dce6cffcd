"""Which bags of a timeline are stored, and under which numbers.

A week is 60,000 bags, and another one closes every ten seconds: what is known of a segment of the
timeline serves every later timeline that still has it.
"""

from __future__ import annotations

from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.arrays import places_among
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.index.bag_rows import Bags

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.store import ColumnStore, State
    from ros2_memory.core.arrays import Flags
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.segment import Segment, TopicExtent
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import IntArray, Mask


class CoveredSegment(NamedTuple):
    """The bags of a segment, each with its number in the store.

    Attributes:
        segment: of the timeline.
        numbers: of its bags; -1 of those that are not stored.
        hashed: of which bags copies can be recognised.
        to_store: which bags are not stored and can be: they are closed, or cut short by a crash.
    """

    segment: Segment
    numbers: IntArray
    hashed: Mask
    to_store: Mask

    @property
    def is_missing(self) -> Mask:
        """Which bags are not stored."""
        return self.numbers < 0


class Coverage:
    """The bags of one timeline, by their numbers in the store. Immutable.

    Attributes:
        state: of the store.
    """

    def __init__(self, state: State, segments: Sequence[CoveredSegment]) -> None:
        self.state = state
        self.segments = tuple(segments)
        numbers = [covered.numbers for covered in segments]
        all_numbers = np.concatenate(numbers) if numbers else np.empty(0, np.int64)
        order = np.argsort(all_numbers, kind="stable")
        self._of_parts: dict[int, IntArray] = {}
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
        return [bag for each in self.segments for bag in each.segment.bags.at(each.is_missing)]

    @cached_property
    def to_store(self) -> Sequence[BagFile]:
        """Those of them that can be stored."""
        return [bag for each in self.segments for bag in each.segment.bags.at(each.to_store)]

    def starts_to_store(self) -> list[Ns]:
        """Returns the log times (ns) of the first messages of the bags that can be stored."""
        return [
            start for each in self.segments for start in each.segment.bags.starts[each.to_store]
        ]

    def missing_extents(self, topic: str, window: TimeWindow) -> Iterator[TopicExtent]:
        """Yields the bags that are not stored as `Timeline.extents` yields all."""
        for covered in self.segments:
            bags, is_missing = covered.segment.bags, covered.is_missing
            is_missing &= (bags.starts < window.stop) & (bags.ends >= window.start)
            if is_missing.any():
                yield from covered.segment.extents(topic, window, is_missing)

    def _are_there(self, numbers: IntArray) -> Flags:
        """Returns which of some numbers are of bags of the timeline."""
        return places_among(numbers, self._numbers)[1]

    def of_part(self, part: int, numbers: IntArray) -> IntArray:
        """Returns those of the numbers of a part whose bags are bags of the timeline."""
        if part not in self._of_parts:
            are_there = self._are_there(numbers)
            self._of_parts[part] = numbers if are_there.all() else numbers[are_there]
        return self._of_parts[part]

    def counts(self, groups: Sequence[IntArray]) -> IntArray:
        """Returns of how many bags of each group, which has one at least, rows count."""
        if not groups:
            return np.zeros(0, np.int64)
        begins = np.cumsum([0, *map(len, groups)])[:-1]
        are_there = self._are_there(np.concatenate(groups)).astype(np.int64)
        return np.asarray(np.add.reduceat(are_there, begins))

    def bag(self, number: int) -> BagFile | None:
        """Returns the bag of a number; None where it is none of the timeline."""
        at = self._position(number)
        return None if at is None else self._bags[at]

    def recording(self, number: int) -> Path | None:
        """Returns the recording of the bag of a number, as `bag`."""
        at = self._position(number)
        return None if at is None else self._bags.recording(at)

    def _position(self, number: int) -> int | None:
        at = int(self._numbers.searchsorted(number))
        is_there = at < self._numbers.size and self._numbers[at] == number
        return int(self._order[at]) if is_there else None

    def unhashed(self) -> list[BagFile]:
        """Returns the stored bags of which copies cannot be recognised."""
        return [
            bag
            for covered in self.segments
            for bag in covered.segment.bags.at((covered.numbers >= 0) & ~covered.hashed)
        ]


class Covering:
    """Finds out which bags are stored. Thread-safe.

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
        is_same = self._latest is not None and self._latest[1].state == state
        remembered = {
            id(segment): covered
            for segment in timeline.segments
            if (covered := self._by_id.get(id(segment))) is not None
            and covered.segment is segment
            and (is_same or not covered.to_store.any())
        }
        unknown = [segment for segment in timeline.segments if id(segment) not in remembered]
        rows = self.store.rows_of([segment.bags for segment in unknown], self._root, state.deletion)
        for segment, of_segment in zip(unknown, rows, strict=True):
            remembered[id(segment)] = self._covered_segment(segment, of_segment)
        return [remembered[id(segment)] for segment in timeline.segments]

    def _covered_segment(self, segment: Segment, rows: IntArray) -> CoveredSegment:
        """Returns what is known of a segment, of whose bags `rows_of` returns these rows."""
        bags = segment.bags
        can_be_stored = bags.in_state(BagState.CLOSED)
        left_open = np.flatnonzero(bags.in_state(BagState.INCOMPLETE))
        # A database goes on in its journal, which may change while its own file does not.
        can_be_stored[left_open] = [file.endswith(".mcap") for file in bags.files(left_open)]
        is_stored: Mask = can_be_stored & (rows >= 0)
        numbers = np.where(is_stored, (rows >> 1) + self.store.offset, -1)
        return CoveredSegment(
            segment, numbers, is_stored & (rows & 1 > 0), can_be_stored & ~is_stored
        )

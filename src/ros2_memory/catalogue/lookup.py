"""What the catalogue holds about the bags of a snapshot, computed once for each segment of bags.

A segment never changes, and neither does an entry of the catalogue, so what is computed here is
valid for as long as the segment is in use. Only a segment with bags that have no entry yet is
looked up again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, TypeVar, cast
from weakref import WeakKeyDictionary, ref

from ros2_memory.columns.store import BagKey
from ros2_memory.core.model import BagState

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.catalogue.store import Catalogue
    from ros2_memory.core.model import BagFile
    from ros2_memory.index.segment import Segment

T = TypeVar("T")

_MAX_DERIVED: Final = 8192
"""What is computed of segments and stays in memory: a recap of a week of 10 s splits has 4,000."""
_UNKNOWN_STATE: Final = -1
"""The state of a catalogue that could not be read."""


class SegmentDigests:
    """What the catalogue holds about one segment, leaving out bags without an entry.

    Attributes:
        catalogue: where the rest of the entries is read from.
        numbers: by file, the number of its entry.
        whole: whether every bag of the segment has an entry.
        as_of: the state of the catalogue when the entries were looked up.
    """

    def __init__(self, cache: DigestCache, segment: Segment, as_of: int) -> None:
        self.catalogue = catalogue = cache.catalogue
        self._cache = cache
        failures = catalogue.failures
        closed = [bag for bag in segment.bags if bag.state is BagState.CLOSED]
        # By number is faster than by path. An entry that is gone may have been replaced.
        there = catalogue.existing([bag.entry for bag in closed if bag.entry])
        others = [bag for bag in closed if bag.entry not in there]
        found = catalogue.find([BagKey.of(bag, cache.bag_dir) for bag in others]) if others else []
        by_path = {bag.file: number for bag, number in zip(others, found, strict=True)}
        self.as_of = as_of if catalogue.failures == failures else _UNKNOWN_STATE
        self.numbers: dict[str, int] = {
            bag.file: number
            for bag in closed
            if (number := by_path.get(bag.file, bag.entry)) is not None
        }
        self.whole = len(self.numbers) == len(segment.bags)
        every = [*self.numbers.values()]
        self._with_topic: dict[str, list[int]] = {
            # Most topics are in all bags: these share one list.
            topic: every if bags is segment.bags else self._numbers_of(bags)
            for topic in segment.spans
            for bags in (segment.bags_with(topic),)
        }
        self._relatched: dict[str, dict[int, bool]] = {}
        self._derived: dict[str, object] = {}

    @property
    def is_complete(self) -> bool:
        """Whether no later state of the catalogue adds to this."""
        is_final = self.whole
        return is_final and self.catalogue.is_current(self.as_of)

    def words(self, topic: str) -> Mapping[int, str | None]:
        """Returns the words in texts of the topic, for each entry that has the topic.

        None where they are not known.
        """
        numbers = self._entries_with(topic)
        known = self.catalogue.words(topic, numbers)
        return {number: known.get(number) for number in numbers}

    def relatched(self, topic: str) -> Mapping[int, bool]:
        """Returns, for each entry that has the topic, whether it may repeat another recording's."""
        return self._cached(
            self._relatched,
            topic,
            lambda: self.catalogue.relatched(topic, self._entries_with(topic)),
        )

    def derived(self, name: str, compute: Callable[[], T]) -> T:
        """Returns a value computed once from the entries of this segment, by name.

        It lives as long as the segment is in use, but for what was asked for longest ago of very
        much. A name always has one type of value.
        """
        self._cache.mark_derived(self, name)
        # The type is the caller's: each name is used in one place.
        return self._cached(cast("dict[str, T]", self._derived), name, compute)

    def undecodable(self, topic: str, number: int) -> Mapping[str, str] | None:
        """Returns, by message type, why messages of an entry cannot be decoded.

        None where the entry is gone. Not cached: each bag is asked about once for each type.
        """
        return self.catalogue.undecodable(topic, [number]).get(number)

    def _cached(self, cache: dict[str, T], topic: str, compute: Callable[[], T]) -> T:
        """Computes a value at most once for each topic, unless the catalogue failed meanwhile."""
        known = cache.get(topic)
        if known is not None:
            return known
        failures = self.catalogue.failures
        value = compute()
        if self.catalogue.failures == failures:
            cache[topic] = value
        return value

    def release_derived(self, name: str) -> None:
        """Drops what was computed under a name."""
        self._derived.pop(name, None)

    def _numbers_of(self, bags: Sequence[BagFile]) -> list[int]:
        return [self.numbers[bag.file] for bag in bags if bag.file in self.numbers]

    def _entries_with(self, topic: str) -> list[int]:
        return self._with_topic.get(topic, [])


class DigestCache:
    """Caches the catalogue's entries, by segment. Thread-safe.

    Args:
        catalogue: what has the entries.
        bag_dir: the folder of the bags.
    """

    def __init__(self, catalogue: Catalogue, bag_dir: Path) -> None:
        self.catalogue = catalogue
        self.bag_dir = bag_dir
        self._lock = threading.Lock()
        self._derived: OrderedDict[tuple[ref[SegmentDigests], str], None] = OrderedDict()
        self._segments: WeakKeyDictionary[Segment, SegmentDigests] = WeakKeyDictionary()

    def digests_for(self, segment: Segment, as_of: int) -> SegmentDigests:
        """Returns the entries of a segment, at that state of the catalogue or a later one."""
        with self._lock:
            known = self._segments.get(segment)
        if known is None or not (known.as_of == as_of or known.is_complete):
            known = self.looked_up_again(segment, as_of)
        return known

    def looked_up_again(self, segment: Segment, as_of: int) -> SegmentDigests:
        """Returns the entries of a segment now, after another program replaced them."""
        known = SegmentDigests(self, segment, as_of)
        with self._lock:
            self._segments[segment] = known
        return known

    def complete_digests(self, segment: Segment) -> SegmentDigests | None:
        """Returns the digests of a segment all of whose bags have one; None where not yet.

        No later state of the catalogue adds to them, so its file is not read for this.
        """
        with self._lock:
            known = self._segments.get(segment)
        return known if known is not None and known.is_complete else None

    def mark_derived(self, digests: SegmentDigests, name: str) -> None:
        """Marks what is computed from a segment as used; the least recently used is dropped."""
        with self._lock:
            self._derived[ref(digests), name] = None
            self._derived.move_to_end((ref(digests), name))
            if len(self._derived) <= _MAX_DERIVED:
                return
            (oldest, old_name), _ = self._derived.popitem(last=False)
        segment = oldest()
        if segment is not None:
            segment.release_derived(old_name)

    def cached_answer(
        self, question: str, numbers: Sequence[int], parse: Callable[[str], T]
    ) -> T | None:
        """Returns what was computed from these entries before; None where nothing can be parsed."""
        answer = self.catalogue.cached_answer(question, numbers)
        try:
            return None if answer is None else parse(answer)
        # A damaged file can hold anything.
        except (ValueError, TypeError, LookupError, AttributeError):
            return None


def bags_without_entry(segments: Sequence[Segment], cache: DigestCache) -> list[BagFile]:
    """Returns the closed bags without an entry in the catalogue, in order."""
    as_of = cache.catalogue.newest()
    return [
        bag
        for segment in segments
        if not (digests := cache.digests_for(segment, as_of)).whole
        for bag in segment.bags
        if bag.state is BagState.CLOSED and bag.file not in digests.numbers
    ]

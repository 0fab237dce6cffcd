"""What the catalogue says of the bags of a snapshot, worked out once for each run of bags.

A run never changes, and no entry of the catalogue does, so what is said here of a run holds for as
long as somebody has it; only a run with bags that have no entry yet is looked at again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, TypeVar
from weakref import WeakKeyDictionary

from ros2_memory.analysis.zone_map import UNBOUNDED, Boxes, united
from ros2_memory.catalogue.store import BagKey
from ros2_memory.core.model import BagState

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.analysis.odometry import PoseDigest
    from ros2_memory.analysis.standstills import StandstillDigest
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.analysis.zone_map import ZoneMap
    from ros2_memory.catalogue.store import Catalogue
    from ros2_memory.catalogue.topic_digest import EdgeDigest
    from ros2_memory.core.model import BagFile
    from ros2_memory.index.segment import Segment
    from ros2_memory.storage.base import Record

T = TypeVar("T")

_MOST_KEPT: Final = 64
"""Runs of which the messages that the catalogue keeps are held: two days of splits."""
_IN_DOUBT: Final = -1
"""The state of a catalogue that could not be asked."""


class SegmentDigests:
    """What the catalogue says of one run. Bags without an entry are not spoken of.

    Attributes:
        numbers: by file, the number of its entry.
        whole: whether every bag of the run has one.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        run: Segment,
        bag_dir: Path,
        as_of: int,
        lately: RecordLru | None = None,
    ) -> None:
        self._catalogue = catalogue
        self._lately = RecordLru() if lately is None else lately
        before = catalogue.failures
        closed = [bag for bag in run.bags if bag.state is BagState.CLOSED]
        numbers = catalogue.find([BagKey.of(bag, bag_dir) for bag in closed])
        self.as_of = as_of if catalogue.failures == before else _IN_DOUBT
        self.numbers: dict[str, int] = {
            bag.file: number
            for bag, number in zip(closed, numbers, strict=True)
            if number is not None
        }
        self.whole = len(self.numbers) == len(run.bags)
        every = [*self.numbers.values()]
        self._holding: dict[str, list[int]] = {
            topic: every if held is run.bags else self._numbers_of(held)
            for topic in run.spans
            for held in (run.bags_with(topic),)
        }
        self._evidence: dict[str, ZoneMap] = {}
        self._boxes: dict[str, Boxes] = {}
        self._edges: dict[str, dict[int, EdgeDigest]] = {}
        self._pairs: dict[str, frozenset[tuple[str, str]] | None] = {}
        self._kept: dict[str, dict[int, tuple[Record, ...]]] = {}

    def evidence_of_all(self, topic: str) -> ZoneMap:
        """What can have stood in any message of the topic in the bags with an entry."""
        return self._kept_as(self._evidence, topic, lambda: united(self.evidence(topic).values()))

    def evidence(self, topic: str) -> Mapping[int, ZoneMap]:
        """For each entry that holds the topic what can have stood in it."""
        numbers = self._of(topic)
        known = self._catalogue.evidence(topic, numbers)
        # Where the catalogue failed since the entries were found, nothing is ruled out.
        return {number: known.get(number, UNBOUNDED) for number in numbers}

    def boxes(self, topic: str) -> Boxes:
        """The places in the evidence; kept, since they are few numbers and asked for often."""
        return self._kept_as(self._boxes, topic, lambda: Boxes(self.evidence(topic)))

    def poses(self, topic: str, among: Sequence[int]) -> Mapping[int, PoseDigest]:
        """For each of these entries that has it the digest of its poses."""
        return self._catalogue.poses(topic, among)

    def standstills(self, topic: str, among: Sequence[int]) -> Mapping[int, StandstillDigest]:
        """For each of these entries that has it where its poses stand still."""
        return self._catalogue.standstills(topic, among)

    def stories(self, topic: str, among: Sequence[int]) -> Mapping[int, TopicEvents | None]:
        """For each of these entries what the messages of the topic say, as the catalogue has it."""
        return self._catalogue.stories(topic, among)

    def edges(self, topic: str) -> Mapping[int, EdgeDigest]:
        """For each entry that has them the frame edges."""
        return self._kept_as(
            self._edges, topic, lambda: self._catalogue.edges(topic, self._of(topic))
        )

    def pairs(self, topic: str) -> frozenset[tuple[str, str]] | None:
        """The frame pairs of all the run's bags; None where those of some are not known."""
        return self._kept_as(self._pairs, topic, lambda: self._pairs_of(topic))

    def _pairs_of(self, topic: str) -> frozenset[tuple[str, str]] | None:
        edges = self.edges(topic)
        if not self.whole or len(edges) < len(self._of(topic)):
            return None
        return frozenset(pair for edge in edges.values() for pair in edge.pairs)

    def kept(self, topic: str) -> Mapping[int, tuple[Record, ...]]:
        """For each entry that keeps them all messages of the topic.

        They are many, so they are held of the runs that were asked lately.
        """
        self._lately.used(self)
        return self._kept_as(
            self._kept, topic, lambda: self._catalogue.kept(topic, self._of(topic))
        )

    def undecodable(self, topic: str, number: int) -> Mapping[str, str] | None:
        """By message type, why messages of the topic in an entry cannot be decoded.

        None where the entry does not say. Not kept: one bag is asked about for each type.
        """
        return self._catalogue.undecodable(topic, [number]).get(number)

    def _kept_as(self, known: dict[str, T], topic: str, ask: Callable[[], T]) -> T:
        """What was worked out before, or is now; kept unless the catalogue failed meanwhile."""
        there = known.get(topic)
        if there is not None:
            return there
        before = self._catalogue.failures
        found = ask()
        if self._catalogue.failures == before:
            known[topic] = found
        return found

    def release(self) -> None:
        """Lets go of the messages that are held; who has them still has them."""
        self._kept = {}

    def _numbers_of(self, bags: Sequence[BagFile]) -> list[int]:
        return [self.numbers[bag.file] for bag in bags if bag.file in self.numbers]

    def _of(self, topic: str) -> list[int]:
        return self._holding.get(topic, [])


class RecordLru:
    """The notes whose messages are held. Safe for several threads at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._notes: OrderedDict[SegmentDigests, None] = OrderedDict()

    def used(self, notes: SegmentDigests) -> None:
        """Puts notes first; those that were used longest ago let go of their messages."""
        with self._lock:
            self._notes[notes] = None
            self._notes.move_to_end(notes)
            if len(self._notes) > _MOST_KEPT:
                self._notes.popitem(last=False)[0].release()


class DigestCache:
    """Gives the notes on runs. Safe for several threads at once."""

    def __init__(self, catalogue: Catalogue, bag_dir: Path) -> None:
        self.catalogue = catalogue
        self._bag_dir = bag_dir
        self._lock = threading.Lock()
        self._lately = RecordLru()
        self._runs: WeakKeyDictionary[Segment, SegmentDigests] = WeakKeyDictionary()

    def as_of(self) -> int:
        """The state of the catalogue that one question should be answered by."""
        return self.catalogue.newest()

    def notes(self, run: Segment, as_of: int) -> SegmentDigests:
        """What is known of a run, at that state of the catalogue or a later one."""
        with self._lock:
            known = self._runs.get(run)
        if known is None or not self._holds(known, as_of):
            known = SegmentDigests(self.catalogue, run, self._bag_dir, as_of, self._lately)
            with self._lock:
                self._runs[run] = known
        return known

    def settled(self, run: Segment) -> SegmentDigests | None:
        """The notes on a run that speak of all its bags: no state of the catalogue adds to them.

        None where there are none yet. Asks nothing of the catalogue's file.
        """
        with self._lock:
            known = self._runs.get(run)
        if known is None or not known.whole or not self.catalogue.is_current(known.as_of):
            return None
        return known

    def remembered(
        self, question: str, numbers: Sequence[int], parsed: Callable[[str], T]
    ) -> T | None:
        """What was once worked out from these entries; None where nothing that can be parsed."""
        answer = self.catalogue.remembered(question, numbers)
        try:
            return None if answer is None else parsed(answer)
        # A damaged file holds anything.
        except (ValueError, TypeError, LookupError, AttributeError):
            return None

    def remember(self, question: str, numbers: Sequence[int], answer: str) -> None:
        """Keeps what was worked out from these entries, for as long as they stand."""
        self.catalogue.remember(question, numbers, answer)

    def _holds(self, known: SegmentDigests, as_of: int) -> bool:
        """Whether another look would say no more."""
        if known.as_of == as_of:
            return True
        return known.whole and self.catalogue.is_same_base(known.as_of, as_of)


def bags_without_entry(runs: Sequence[Segment], recall: DigestCache) -> list[BagFile]:
    """The closed bags of which the catalogue knows nothing, in order."""
    as_of = recall.as_of()
    return [
        bag
        for run in runs
        if not (notes := recall.notes(run, as_of)).whole
        for bag in run.bags
        if bag.state is BagState.CLOSED and bag.file not in notes.numbers
    ]

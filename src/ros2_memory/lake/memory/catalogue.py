"""The digests of one robot's bags in a lake, as its catalogue has them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.analysis.conditions import words_of
from ros2_memory.analysis.topic_events import NO_EVENTS
from ros2_memory.catalogue.digest import DIGEST_VERSION
from ros2_memory.catalogue.digest_config import DigestConfig
from ros2_memory.catalogue.store import Catalogue
from ros2_memory.columns.fragments import Fragment
from ros2_memory.lake.event_codec import decode_topic_events
from ros2_memory.lake.partitions import locations

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from datetime import date

    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.columns.fragments import Kind, Sized
    from ros2_memory.columns.store import BagKey
    from ros2_memory.core.model import BagFile
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.memory.index import LakeIndex
    from ros2_memory.lake.partitions import Days

T = TypeVar("T")
S = TypeVar("S", bound="Sized")

_PART_BYTES: Final = 1 << 20
"""Days are read together, of so many bytes in all: a home robot's day, or weeks of a rare one."""
_MOST_PARTS: Final = 64
"""Parts of one kind of digest that stay in memory."""
_PACKED: Final = (
    "SELECT bag_id, packed FROM digests WHERE kind = $kind AND topic = $topic"
    " AND version = $version AND packed IS NOT NULL"
)
_LABELS: Final = "SELECT DISTINCT bag_id, label FROM sightings WHERE topic = $topic"


class LakeCatalogue(Catalogue):
    """Looks digests up in a lake, days at a time; what a lake has no digests of is not known.

    Args:
        lake: the lake.
        robot: its name there.
        index: its bags.
    """

    def __init__(self, lake: Lake, robot: str, index: LakeIndex) -> None:
        super().__init__([], DigestConfig("lake"))
        self._lake = lake
        self._robot = robot
        self._index = index
        self._parts_lock = threading.Lock()
        self._parts: OrderedDict[tuple[object, ...], Mapping[str, object]] = OrderedDict()

    def read(self, ask: Callable[[sqlite3.Connection], T], unknown: T) -> T:
        """Returns `unknown`: there is no database."""
        del ask
        return unknown

    def write(self, write: Callable[[sqlite3.Connection], None]) -> bool:
        """Stores nothing."""
        del write
        return False

    def newest(self) -> int:
        """Returns 0: entries do not come later than their bags."""
        return 0

    def is_current(self, number: int) -> bool:
        """Returns True: no entry is ever lost."""
        del number
        return True

    def find(self, keys: Sequence[BagKey]) -> list[int | None]:
        """Returns the numbers of the bags, which all have an entry."""
        return [key.sidecar_ns for key in keys]

    def fragment(self, bag: BagFile, kind: Kind[S]) -> S | None:
        """Returns what followed from a bag when it was shipped; None if unknown."""
        number = self._index.number(bag)
        packed = self._packed(kind.name, self._index.pose_topic, [number]).get(number)
        return None if packed is None else kind.load(Fragment.from_bytes(packed))

    def topic_events(self, topic: str, numbers: Sequence[int]) -> dict[int, TopicEvents | None]:
        """Returns the events on the topic; of digests of another version nothing is known."""
        found = self._packed("events", topic, numbers)
        known = _decoded(found, decode_topic_events)
        return {
            number: known.get(number, NO_EVENTS)
            for number in numbers
            if number in known or self._index.bag(number).is_current
        }

    def words(self, topic: str, numbers: Sequence[int]) -> dict[int, str]:
        """Returns the words of labels in detections of the topic; of others nothing is known."""
        if not self._index.is_detector(topic):
            return {}
        found = self._digests("labels", topic, numbers)
        return {number: words if isinstance(words, str) else "" for number, words in found}

    def undecodable(self, topic: str, numbers: Sequence[int]) -> dict[int, dict[str, str]]:
        """Returns that all messages could be decoded: rows are made of those alone."""
        del topic
        return {number: {} for number in numbers}

    def relatched(self, topic: str, numbers: Sequence[int]) -> dict[int, bool]:
        """Returns that no message is of another recording: such were not shipped."""
        del topic
        return dict.fromkeys(numbers, False)

    def _packed(self, kind: str, topic: str, numbers: Sequence[int]) -> dict[int, bytes]:
        found = self._digests(kind, topic, numbers)
        return {number: packed for number, packed in found if isinstance(packed, bytes)}

    def _digests(
        self, kind: str, topic: str, numbers: Sequence[int]
    ) -> Iterator[tuple[int, object]]:
        """Yields bags by their numbers, with their digest of a kind, or None."""
        days = self._lake.days("sightings" if kind == "labels" else "digests", self._robot)
        of_day: dict[date, Mapping[str, object]] = {}
        for number in numbers:
            bag = self._index.bag(number)
            if bag.day not in of_day:
                of_day[bag.day] = self._of_part(kind, topic, days, days.part(bag.day, _PART_BYTES))
            yield number, of_day[bag.day].get(bag.bag_id)

    def _of_part(
        self, kind: str, topic: str, days: Days, part: tuple[date, date]
    ) -> Mapping[str, object]:
        """Returns digests of a kind by the ids of their bags."""
        # Files never change, so what was read of the same ones is still true.
        key = (kind, topic, locations(days.files(*part)))
        with self._parts_lock:
            known = self._parts.get(key)
            if known is not None:
                self._parts.move_to_end(key)
                return known
        known = self._read(kind, topic, part)
        with self._parts_lock:
            self._parts[key] = known
            if len(self._parts) > _MOST_PARTS:
                self._parts.popitem(last=False)
        return known

    def _read(self, kind: str, topic: str, days: tuple[date, date]) -> Mapping[str, object]:
        if kind == "labels":
            rows = self._lake.select(
                _LABELS, ["sightings"], {"topic": topic}, robots=[self._robot], days=days
            )
            # Labels are few, and in many bags.
            bags, labels = (
                rows[name].combine_chunks().dictionary_encode() for name in ("bag_id", "label")
            )
            words = [words_of(label.casefold()) for label in labels.dictionary.to_pylist()]
            of_bag: list[set[str]] = [set() for _ in bags.dictionary]
            pairs = zip(bags.indices.to_pylist(), labels.indices.to_pylist(), strict=True)
            for bag, label in pairs:
                of_bag[bag].update(words[label])
            return {
                bag_id: "\n".join(sorted(each))
                for bag_id, each in zip(bags.dictionary.to_pylist(), of_bag, strict=True)
            }
        asked = {"kind": kind, "topic": topic, "version": str(DIGEST_VERSION)}
        rows = self._lake.select(_PACKED, ["digests"], asked, robots=[self._robot], days=days)
        return dict(zip(rows["bag_id"].to_pylist(), rows["packed"].to_pylist(), strict=True))


def _decoded(packed: Mapping[int, bytes], decode: Callable[[bytes], T]) -> dict[int, T]:
    return {number: decode(each) for number, each in packed.items()}

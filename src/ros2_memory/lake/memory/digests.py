"""The digests of one robot's bags in a lake."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.analysis.conditions import words_of
from ros2_memory.analysis.topic_events import NO_EVENTS
from ros2_memory.columns.fragments import Fragment
from ros2_memory.lake.event_codec import decode_topic_events
from ros2_memory.lake.partitions import locations
from ros2_memory.lake.tables import ROWS_VERSION

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import date

    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.columns.fragments import Kind, Sized
    from ros2_memory.core.model import BagFile
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.memory.index import LakeIndex
    from ros2_memory.lake.partitions import Days

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


class LakeDigests:
    """Looks digests up in a lake, days at a time.

    Args:
        lake: the lake.
        robot: its name there.
        index: its bags.
    """

    def __init__(self, lake: Lake, robot: str, index: LakeIndex) -> None:
        self._lake = lake
        self._robot = robot
        self._index = index
        self._lock = threading.Lock()
        self._parts: OrderedDict[tuple[object, ...], Mapping[str, object]] = OrderedDict()

    def fragment(self, bag: BagFile, kind: Kind[S]) -> S | None:
        """Returns what followed from a bag when it was shipped; None if unknown."""
        packed = self._of(bag, kind.name, self._index.pose_topic)
        return kind.load(Fragment.from_bytes(packed)) if isinstance(packed, bytes) else None

    def events(self, bag: BagFile, topic: str) -> TopicEvents | None:
        """Returns the events on a topic in a bag; None where they are not known."""
        packed = self._of(bag, "events", topic)
        if isinstance(packed, bytes):
            return decode_topic_events(packed)
        return NO_EVENTS if self._index.bag(self._index.number(bag)).is_current else None

    def words(self, bag: BagFile, topic: str) -> str | None:
        """Returns the words of labels in detections of a topic; None where they are not known."""
        if not self._index.is_detector(topic):
            return None
        words = self._of(bag, "labels", topic)
        return words if isinstance(words, str) else ""

    def _of(self, bag: BagFile, kind: str, topic: str) -> object:
        """Returns a digest of a bag; None where there is none."""
        here = self._index.bag(self._index.number(bag))
        days = self._lake.days("sightings" if kind == "labels" else "digests", self._robot)
        part = self._of_part(kind, topic, days, days.part(here.day, _PART_BYTES))
        return part.get(here.bag_id)

    def _of_part(
        self, kind: str, topic: str, days: Days, part: tuple[date, date]
    ) -> Mapping[str, object]:
        """Returns digests of a kind, by the ids of their bags."""
        # Files never change, so what was read of the same ones is still true.
        key = (kind, topic, locations(days.files(*part)))
        with self._lock:
            known = self._parts.get(key)
            if known is not None:
                self._parts.move_to_end(key)
                return known
        known = self._read(kind, topic, part)
        with self._lock:
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
        asked = {"kind": kind, "topic": topic, "version": str(ROWS_VERSION)}
        rows = self._lake.select(_PACKED, ["digests"], asked, robots=[self._robot], days=days)
        return dict(zip(rows["bag_id"].to_pylist(), rows["packed"].to_pylist(), strict=True))

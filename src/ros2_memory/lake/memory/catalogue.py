"""The digests of one robot's bags in a lake, as its catalogue has them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.analysis.topic_events import NO_EVENTS
from ros2_memory.analysis.zone_map import UNBOUNDED, ZoneMap, joined_words, words_of
from ros2_memory.catalogue.codec import decode_poses, decode_standstills, decode_topic_events
from ros2_memory.catalogue.digest import DIGEST_VERSION
from ros2_memory.catalogue.digest_config import DigestConfig
from ros2_memory.catalogue.map_digest import NO_STATICS, decode_map_tracks
from ros2_memory.catalogue.store import BagKey, Catalogue

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Mapping, Sequence
    from datetime import date

    from ros2_memory.analysis.motion.odometry import PoseDigest
    from ros2_memory.analysis.motion.standstills import StandstillDigest
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.catalogue.map_digest import MapDigest
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.memory.index import LakeIndex
    from ros2_memory.storage.base import Record

T = TypeVar("T")

_MOST_DAYS: Final = 64
"""Days of digests of one kind that stay in memory."""
_PACKED: Final = (
    "SELECT bag_id, packed FROM digests WHERE kind = $kind AND topic = $topic"
    " AND version = $version AND packed IS NOT NULL"
)
_LABELS: Final = "SELECT DISTINCT bag_id, label FROM sightings WHERE topic = $topic"


class LakeCatalogue(Catalogue):
    """Looks digests up in a lake, a day at a time; what a lake has no digests of is not known.

    Positions are placed in the map already, so there are no static transforms here.

    Args:
        lake: the lake.
        robot: its name there.
        index: its bags.
        static_topics: those of static transforms.
    """

    def __init__(
        self, lake: Lake, robot: str, index: LakeIndex, static_topics: Sequence[str]
    ) -> None:
        super().__init__([], DigestConfig("lake"))
        self._lake = lake
        self._robot = robot
        self._index = index
        self._static_topics = static_topics
        self._days_lock = threading.Lock()
        self._days: OrderedDict[tuple[object, ...], Mapping[str, object]] = OrderedDict()

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

    def poses(self, topic: str, numbers: Sequence[int]) -> dict[int, PoseDigest]:
        """Returns the digests of the topic's poses."""
        return _decoded(self._packed("poses", topic, numbers), decode_poses)

    def standstills(self, topic: str, numbers: Sequence[int]) -> dict[int, StandstillDigest]:
        """Returns the standstills among the topic's poses."""
        return _decoded(self._packed("standstills", topic, numbers), decode_standstills)

    def topic_events(self, topic: str, numbers: Sequence[int]) -> dict[int, TopicEvents | None]:
        """Returns the events on the topic; of digests of another version nothing is known."""
        found = self._packed("events", topic, numbers)
        known = _decoded(found, decode_topic_events)
        return {
            number: known.get(number, NO_EVENTS)
            for number in numbers
            if number in known or self._index.bag(number).is_current
        }

    def maps(self, numbers: Sequence[int], *, own: bool = False) -> dict[int, MapDigest]:
        """Returns the map digests of entries, with only their track."""
        topic = self._index.pose_topic
        found = self._packed("map", topic, numbers)
        decoded = decode_map_tracks([(each, NO_STATICS.key) for each in found.values()], own=own)
        return dict(zip(found, decoded, strict=True))

    def map_keys(self, numbers: Sequence[int]) -> dict[int, int]:
        """Returns that all were made with the static transforms that are in force here: none."""
        return dict.fromkeys(numbers, NO_STATICS.key)

    def sights(self, numbers: Sequence[int]) -> dict[int, tuple[int, bytes]]:
        """Returns the bytes of the entries' sights."""
        found = self._packed("sights", "", numbers)
        return {number: (NO_STATICS.key, packed) for number, packed in found.items()}

    def zone_maps(self, topic: str, numbers: Sequence[int]) -> dict[int, ZoneMap]:
        """Returns the labels that can be in detections of the topic; of others nothing is known."""
        found: dict[int, ZoneMap] = {}
        if not self._index.is_detector(topic):
            return dict.fromkeys(numbers, UNBOUNDED)
        for number in numbers:
            bag = self._index.bag(number)
            labels = self._of_day("labels", topic, bag.day).get(bag.bag_id)
            found[number] = labels if isinstance(labels, ZoneMap) else ZoneMap()
        return found

    def undecodable(self, topic: str, numbers: Sequence[int]) -> dict[int, dict[str, str]]:
        """Returns that all messages could be decoded: rows are made of those alone."""
        del topic
        return {number: {} for number in numbers}

    def relatched(self, topic: str, numbers: Sequence[int]) -> dict[int, bool]:
        """Returns that no message is of another recording: such were not shipped."""
        del topic
        return dict.fromkeys(numbers, False)

    def messages(self, topic: str, numbers: Sequence[int]) -> dict[int, tuple[Record, ...]]:
        """Returns that there are no static transforms; of other topics nothing is known."""
        return dict.fromkeys(numbers, ()) if topic in self._static_topics else {}

    def _packed(self, kind: str, topic: str, numbers: Sequence[int]) -> dict[int, bytes]:
        found: dict[int, bytes] = {}
        for number in numbers:
            bag = self._index.bag(number)
            packed = self._of_day(kind, topic, bag.day).get(bag.bag_id)
            if isinstance(packed, bytes):
                found[number] = packed
        return found

    def _of_day(self, kind: str, topic: str, day: date) -> Mapping[str, object]:
        """Returns digests of a kind by the ids of their bags."""
        key = (self._index.version, kind, topic, day)
        with self._days_lock:
            known = self._days.get(key)
            if known is not None:
                self._days.move_to_end(key)
                return known
        known = self._read_day(kind, topic, day)
        with self._days_lock:
            self._days[key] = known
            if len(self._days) > _MOST_DAYS:
                self._days.popitem(last=False)
        return known

    def _read_day(self, kind: str, topic: str, day: date) -> Mapping[str, object]:
        if kind == "labels":
            rows = self._lake.select(
                _LABELS, ["sightings"], {"topic": topic}, robots=[self._robot], days=(day, day)
            )
            words: dict[str, set[str]] = {}
            pairs = zip(rows["bag_id"].to_pylist(), rows["label"].to_pylist(), strict=True)
            for bag_id, label in pairs:
                words.setdefault(bag_id, set()).update(words_of(label.casefold()))
            return {
                bag_id: ZoneMap(joined_words(each), texts=True) for bag_id, each in words.items()
            }
        asked = {"kind": kind, "topic": topic, "version": str(DIGEST_VERSION)}
        rows = self._lake.select(_PACKED, ["digests"], asked, robots=[self._robot], days=(day, day))
        return dict(zip(rows["bag_id"].to_pylist(), rows["packed"].to_pylist(), strict=True))


def _decoded(packed: Mapping[int, bytes], decode: Callable[[bytes], T]) -> dict[int, T]:
    return {number: decode(each) for number, each in packed.items()}

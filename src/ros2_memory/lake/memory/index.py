"""The index of one robot's bags in a lake, as queries need it."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.catalogue.digest import DIGEST_VERSION
from ros2_memory.core.bag_summary import BagSummary, TopicHeader, shared_schema
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from datetime import date

    import pyarrow as pa

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.lake.files import Lake
    from ros2_memory.retention.foreign import Foreign

FOLDER: Final = "lake"
_ENCODING: Final = "json"
_BAGS: Final = (
    "SELECT bag_id, day, size, sha256, made_of, mtime_ns, start_ns, end_ns FROM bags"
    " ORDER BY start_ns, end_ns, bag_id"
)
_TOPICS: Final = (
    "SELECT bag_id, topic, type, messages, first_ns, last_ns, version FROM digests"
    " WHERE kind = 'topic' AND messages > 0 AND bag_id IN (SELECT bag_id FROM bags)"
)
_DAYS: Final = "SELECT min(day) AS first, max(day) AS last FROM bags"


@dataclass(frozen=True, slots=True)
class LakeBag:
    """One bag of a lake.

    Attributes:
        bag_id: its id there.
        day: the day that its rows are under.
        is_current: whether its digests are of the version that is joined here.
    """

    bag_id: str
    day: date
    is_current: bool


class LakeIndex:
    """What a lake has of one robot, as of some seconds ago. Thread-safe.

    All bags are of one recording here: which messages count where recordings overlap was decided
    when they were shipped.

    Args:
        lake: the lake.
        robot: its name there.
        clock: the wall clock.
        pose_topic: the topic of the robot's track.
        refresh_s: how old (s) the index may be.
        days: how many days with data answer: the newest.

    Attributes:
        bag_dir: names no directory.
        pose_topic: the topic of the robot's track.
        version: of what was committed last, as far as it was seen.
        since: the first day that answers, where older days have data; None where all days do.
    """

    def __init__(
        self,
        lake: Lake,
        robot: str,
        clock: Clock,
        *,
        pose_topic: str,
        refresh_s: float,
        days: int,
    ) -> None:
        self.bag_dir = Path("/") / robot
        self.pose_topic = pose_topic
        self.version = -1
        self.since: date | None = None
        self._lake = lake
        self._robot = robot
        self._clock = clock
        self._refresh_ns = round(refresh_s * 1e9)
        self._days = days
        self._lock = threading.Lock()
        self._numbers: dict[tuple[str, ...], int] = {}
        self._bags: list[LakeBag] = []
        self._files_by_name: dict[str, BagFile] = {}
        self._detectors: frozenset[str] = frozenset()
        self._whole_topics: frozenset[str] = frozenset()
        self._snapshot: Snapshot | None = None

    @property
    def published(self) -> Snapshot | None:
        """The index as it is known now."""
        return self._snapshot

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns an index that is not older than it may be; what is not shipped yet is not in it.

        Raises:
            RefusedError: the lake cannot be read.
        """
        del reach
        known = self._snapshot
        if known is None or self._clock.now() - known.scanned_at > self._refresh_ns:
            return self.refresh()
        return known

    def refresh(self) -> Snapshot:
        """Looks into the lake now."""
        with self._lock:
            version = self._lake.refresh()
            known = self._snapshot
            timeline = (
                self._timeline() if known is None or version != self.version else known.timeline
            )
            self.version = version
            self._snapshot = Snapshot(timeline=timeline, scanned_at=self._clock.now())
            return self._snapshot

    def heartbeat(self) -> Heartbeat | None:
        """Returns None: what a robot's recorder does now is not in a lake."""
        return None

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """Returns None: a lake does not know of retention."""
        del snapshot
        return None

    def bag(self, number: int) -> LakeBag:
        """Returns the bag of a number."""
        return self._bags[number - 1]

    def number(self, bag: BagFile) -> int:
        """Returns the number of a bag of a snapshot; bags whose rows change get another one."""
        return bag.sidecar_ns

    def file(self, path: Path) -> BagFile:
        """Returns the bag of the current snapshot that has a path there.

        Raises:
            BagVanishedError: it is not in the lake any more.
        """
        found = self._files_by_name.get(str(path))
        if found is None:
            raise BagVanishedError(str(path), "it is not in the lake any more")
        return found

    def is_detector(self, topic: str) -> bool:
        """Returns whether all detections of a topic are rows."""
        return topic in self._detectors

    def has_messages(self, topic: str) -> bool:
        """Returns whether some bags have all messages of a topic as rows."""
        return topic in self._whole_topics

    def _timeline(self) -> Timeline:
        [span] = self._lake.select(_DAYS, ["bags"], robots=[self._robot]).to_pylist()
        if span["last"] is None:
            return Timeline()
        first = max(span["first"], span["last"] - timedelta(days=self._days - 1))
        self.since = None if first == span["first"] else first
        days = (first, span["last"])
        bags = self._lake.select(_BAGS, ["bags"], robots=[self._robot], days=days)
        topics = self._lake.select(_TOPICS, ["digests", "bags"], robots=[self._robot], days=days)
        summaries = _summaries(bags["bag_id"].to_pylist(), topics)
        versions = dict(
            zip(topics["bag_id"].to_pylist(), topics["version"].to_pylist(), strict=True)
        )
        files = [*self._files(bags.to_pylist(), summaries, versions)]
        self._files_by_name = {bag.file: bag for bag in files}
        self._detectors = self._topics_in("sightings", days)
        self._whole_topics = self._topics_in("messages", days)
        return Timeline.of(files)

    def _topics_in(self, table: str, days: tuple[date, date]) -> frozenset[str]:
        sql = f"SELECT DISTINCT topic FROM {table}"  # noqa: S608 - of a constant
        rows = self._lake.select(sql, [table], robots=[self._robot], days=days)
        return frozenset(rows["topic"].to_pylist())

    def _files(
        self,
        rows: Sequence[Mapping[str, object]],
        summaries: Mapping[int, BagSummary],
        versions: Mapping[str, str],
    ) -> Iterator[BagFile]:
        for nth, row in enumerate(rows):
            if nth not in summaries:
                continue
            key = str(row["bag_id"]), str(row["sha256"]), str(row["made_of"])
            number = self._numbers.get(key)
            if number is None:
                is_current = versions[key[0]] == str(DIGEST_VERSION)
                self._bags.append(LakeBag(key[0], _day(row["day"]), is_current))
                number = self._numbers[key] = len(self._bags)
            # Numbered in the order of time, as the splits of one recording are.
            yield BagFile(
                f"{self.bag_dir}/{FOLDER}/{FOLDER}_{nth}.mcap",
                _whole(row["size"]),
                _whole(row["mtime_ns"]),
                BagState.CLOSED,
                summaries[nth],
                _whole(row["start_ns"]),
                _whole(row["end_ns"]),
                number,
            )


def _summaries(bag_ids: Sequence[str], topics: pa.Table) -> dict[int, BagSummary]:
    """Returns the summaries of bags, by their position; rows of topics are in any order."""
    position = {bag_id: nth for nth, bag_id in enumerate(bag_ids)}
    names = [*zip(topics["topic"].to_pylist(), topics["type"].to_pylist(), strict=True)]
    codes = {name: code for code, name in enumerate(sorted(set(names)))}
    headers = [TopicHeader(topic, kind, _ENCODING, latched=False) for topic, kind in codes]
    of_bag = np.array([position[each] for each in topics["bag_id"].to_pylist()], np.int64)
    of_topic = np.array([codes[name] for name in names], np.int64)
    order = np.lexsort((of_topic, of_bag))
    columns = [topics[name].to_numpy() for name in ("messages", "first_ns", "last_ns")]
    numbers = np.stack(columns, axis=1).astype("<i8")[order] if len(order) else np.zeros((0, 3))
    bags, begins = np.unique(of_bag[order], return_index=True)
    ends = [*begins[1:].tolist(), len(order)]
    held, schemas = of_topic[order], dict[bytes, "SummarySchema"]()
    found: dict[int, BagSummary] = {}
    for bag, begin, end in zip(bags.tolist(), begins.tolist(), ends, strict=True):
        key = held[begin:end].tobytes()
        if key not in schemas:
            own = tuple(headers[code] for code in held[begin:end].tolist())
            schemas[key] = shared_schema(own, (), complete=True, notes=())
        found[bag] = BagSummary.decoded(schemas[key], numbers[begin:end].tobytes())
    return found


def _day(value: object) -> date:
    return value  # type: ignore[return-value]  # the column is of dates


def _whole(value: object) -> int:
    return value if isinstance(value, int) else 0

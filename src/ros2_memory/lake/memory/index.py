"""The index of one robot's bags in a lake, as queries need it."""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field, replace
from datetime import date, timedelta
from functools import partial
from itertools import chain, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import pyarrow.compute as pc

from ros2_memory.bag_dir.layout import COMPRESSED
from ros2_memory.core.bag_summary import BagSummary, TopicHeader, shared_schema
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from ros2_memory.lake.partitions import locations
from ros2_memory.lake.tables import ROWS_VERSION, day_of, end_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import pyarrow as pa
    from numpy.typing import NDArray

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.partitions import Days
    from ros2_memory.retention.foreign import Foreign

_FOLDER: Final = "lake"
_ENCODING: Final = "json"
_BAGS: Final = (
    "SELECT bag_id, day, file, size, sha256, made_of, mtime_ns, start_ns, end_ns FROM bags"
    " ORDER BY start_ns, end_ns, bag_id"
)
_TOPICS: Final = (
    "SELECT bag_id, topic, type, messages, first_ns, last_ns, version FROM digests"
    " WHERE kind = 'topic' AND messages > 0 AND bag_id IN (SELECT bag_id FROM bags)"
)
_TABLES: Final = ("bags", "digests", "sightings", "messages")
"""Those whose rows the index is made of."""
MOST_BAGS: Final = 45_000
"""Bags that are looked at together: a month of minutes, or some years of ten a day."""
_FEWEST_DAYS: Final = 2
"""Days that are looked at together where a time before the newest ones is asked about."""
_MOST_WINDOWS: Final = 6
"""Times before the newest days that stay in memory."""
_LOOKS: Final = 4
"""What is known of the lake serves for all robots for this part of the time that it may be old."""


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


class _Day(NamedTuple):
    """What the lake has of one day of a robot.

    Attributes:
        made_of: the files of its rows.
        bags: its bags.
        detectors: topics of which all detections are rows.
        whole_topics: topics of which some bags have all messages as rows.
    """

    made_of: tuple[str, ...]
    bags: Sequence[BagFile]
    detectors: frozenset[str]
    whole_topics: frozenset[str]


@dataclass(frozen=True)
class _Window:
    """Consecutive days of a robot, and what the lake has of them.

    Attributes:
        since: its first day, where there are older ones; None otherwise.
        older: the end of the newest day before that, as a log time.
        days: what is known of each.
        timeline: the bags of all.
        files: these by their paths.
        detectors: topics of which all detections are rows.
        whole_topics: topics of which some bags have all messages as rows.
    """

    since: date | None = None
    older: Ns | None = None
    days: Mapping[date, _Day] = field(default_factory=dict)
    timeline: Timeline = field(default_factory=Timeline)
    files: Mapping[str, BagFile] = field(default_factory=dict)
    detectors: frozenset[str] = frozenset()
    whole_topics: frozenset[str] = frozenset()


class LakeIndex:
    """What a lake has of one robot, as of some seconds ago. Thread-safe.

    It is of the newest days, and of other days where a question is about a time before these. All
    bags are of one recording here: which messages count where recordings overlap was decided when
    they were shipped.

    Args:
        lake: the lake.
        robot: its name there.
        clock: the wall clock.
        pose_topic: the topic of the robot's track.
        refresh_s: how old (s) the index may be.
        days: how many days are looked at together, at least: the newest; more of few bags.
        most_bags: so many bags at most, where that is more days.

    Attributes:
        bag_dir: names no directory.
        pose_topic: the topic of the robot's track.
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
        most_bags: int,
    ) -> None:
        self.bag_dir = Path("/") / robot
        self.pose_topic = pose_topic
        self._lake = lake
        self._robot = robot
        self._clock = clock
        self._refresh_s = refresh_s
        self._fewest_days = days
        self._most_bags = most_bags
        self._lock = threading.Lock()
        self._numbers: dict[tuple[str, ...], int] = {}
        self._bags: list[LakeBag] = []
        self._newest = _Window()
        self._older: dict[date, _Window] = {}
        self._snapshot: Snapshot | None = None
        self._asked = threading.local()

    @property
    def published(self) -> Snapshot | None:
        """The index as it is known now."""
        return self._snapshot

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns an index that is not older than it may be; what is not shipped yet is not in it.

        Where `reach` is before the newest days, it is of the days up to that time.

        Raises:
            RefusedError: the lake cannot be read.
        """
        known = self._snapshot
        if known is None or self._clock.now() - known.scanned_at > self._refresh_s * 1e9:
            known = self.refresh()
        window = self._newest
        if reach is not None and window.since is not None and day_of(reach) < window.since:
            window = self._window_before(day_of(reach))
            known = replace(known, timeline=window.timeline, older=window.older)
        self._note(window)
        return known

    def refresh(self) -> Snapshot:
        """Looks into the lake now; what was just seen there for another robot is not old."""
        with self._lock:
            self._lake.refresh(self._refresh_s / _LOOKS)
            days = self._lake.days("bags", self._robot)
            span = days.newest(date.max, self._most_bags, self._fewest_days)
            self._newest = self._window(days, span, self._newest)
            self._snapshot = Snapshot(
                self._newest.timeline, scanned_at=self._clock.now(), older=self._newest.older
            )
            return self._snapshot

    def unseen_before(self) -> date | None:
        """Returns before which day the lake has days that this thread was not shown since it asked.

        None where it was shown all.
        """
        found: date = getattr(self._asked, "since", date.min)
        self._asked.since = date.max
        return found if date.min < found < date.max else None

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
        """Returns the bag of a snapshot that has a path there.

        Raises:
            BagVanishedError: it is not in the lake any more.
        """
        for window in (self._newest, *self._older.values()):
            found = window.files.get(str(path))
            if found is not None:
                return found
        raise BagVanishedError(str(path), "it is not in the lake any more")

    def is_detector(self, topic: str) -> bool:
        """Returns whether all detections of a topic are rows."""
        return any(topic in each.detectors for each in (self._newest, *self._older.values()))

    def has_messages(self, topic: str) -> bool:
        """Returns whether some bags have all messages of a topic as rows."""
        return any(topic in each.whole_topics for each in (self._newest, *self._older.values()))

    def _note(self, window: _Window) -> None:
        known: date = getattr(self._asked, "since", date.max)
        self._asked.since = min(known, window.since or date.min)

    def _window_before(self, day: date) -> _Window:
        """Returns the days up to one, with the next, in which what lies across midnight goes on."""
        with self._lock:
            days = self._lake.days("bags", self._robot)
            span = days.newest(day + timedelta(days=1), self._most_bags, _FEWEST_DAYS)
            last = day if span is None else span[1]
            window = self._window(days, span, self._older.get(last, _Window()))
            # A new dict: other threads look for the bags of their answers in the old one.
            others = [each for each in self._older.items() if each[0] != last]
            self._older = dict([*others[1 - _MOST_WINDOWS :], (last, window)])
            return window

    def _window(self, known_days: Days, span: tuple[date, date] | None, known: _Window) -> _Window:
        """Returns what the lake has of some days; only those are read of which a file is new."""
        if span is None:
            return _Window()
        begin, end = bisect_left(known_days.known, span[0]), bisect_right(known_days.known, span[1])
        older = end_of(known_days.known[begin - 1]) if begin else None
        bounds = replace(known, since=span[0] if begin else None, older=older)
        of_robot = [self._lake.days(table, self._robot) for table in _TABLES]
        made_of = {
            day: locations(chain.from_iterable(each.files(day, day) for each in of_robot))
            for day in known_days.known[begin:end]
        }
        days = {
            day: known.days[day]
            for day, files in made_of.items()
            if day in known.days and known.days[day].made_of == files
        }
        if days.keys() == made_of.keys() == known.days.keys():
            return bounds
        for is_known, run in groupby(made_of, key=days.keys().__contains__):
            if not is_known:
                days |= self._read({day: made_of[day] for day in run}, known.files)
        files = {bag.file: bag for day in made_of for bag in days[day].bags}
        removed = [bag for file, bag in known.files.items() if file not in files]
        added = [bag for file, bag in files.items() if file not in known.files]
        return replace(
            bounds,
            days=days,
            timeline=known.timeline.changed(removed, added),
            files=files,
            detectors=frozenset[str]().union(*(each.detectors for each in days.values())),
            whole_topics=frozenset[str]().union(*(each.whole_topics for each in days.values())),
        )

    def _read(
        self, made_of: Mapping[date, tuple[str, ...]], known: Mapping[str, BagFile]
    ) -> dict[date, _Day]:
        """Returns what the lake has of days between which there is no other; known bags stay."""
        span = min(made_of), max(made_of)
        select = partial(self._lake.select, robots=[self._robot], days=span)
        bags: dict[date, list[BagFile]] = {day: [] for day in made_of}
        for day, bag in self._files(select(_BAGS, ["bags"]), select(_TOPICS, ["digests", "bags"])):
            bags.setdefault(day, []).append(known.get(bag.file, bag))
        topics: dict[tuple[str, date], set[str]] = {}
        for table in ("sightings", "messages"):
            if self._lake.days(table, self._robot).files(*span):
                # Of a table name of this module.
                found = select(f"SELECT DISTINCT day, topic FROM {table}", [table])  # noqa: S608
                for row in found.to_pylist():
                    topics.setdefault((table, _day(row["day"])), set()).add(str(row["topic"]))
        return {
            day: _Day(
                files,
                bags[day],
                frozenset(topics.get(("sightings", day), ())),
                frozenset(topics.get(("messages", day), ())),
            )
            for day, files in made_of.items()
        }

    def _files(self, bags: pa.Table, topics: pa.Table) -> Iterator[tuple[date, BagFile]]:
        """Yields bags with their days."""
        summaries = _summaries(bags, topics)
        is_old = pc.not_equal(topics["version"], str(ROWS_VERSION))
        old = frozenset(topics["bag_id"].filter(is_old).to_pylist())
        for nth, row in enumerate(bags.to_pylist()):
            if nth not in summaries:
                continue
            key = str(row["bag_id"]), str(row["sha256"]), str(row["made_of"])
            number = self._numbers.get(key)
            day = _day(row["day"])
            if number is None:
                self._bags.append(LakeBag(key[0], day, key[0] not in old))
                number = self._numbers[key] = len(self._bags)
            # Bags that are shipped later leave it as it is. Splits follow each other as on the
            # robot, but all are in one folder: in which order its recordings ran is not known.
            name = str(row["file"]).removesuffix(COMPRESSED).replace("/", ":")
            file = BagFile(
                f"{self.bag_dir}/{_FOLDER}/{name}-{number}",
                _whole(row["size"]),
                _whole(row["mtime_ns"]),
                BagState.CLOSED,
                summaries[nth],
                _whole(row["start_ns"]),
                _whole(row["end_ns"]),
                number,
            )
            yield day, file


def _summaries(bags: pa.Table, topics: pa.Table) -> dict[int, BagSummary]:
    """Returns the summaries of bags, by their position; rows of topics are in any order."""
    ids = bags["bag_id"].combine_chunks()
    of_bag = pc.index_in(topics["bag_id"], value_set=ids).to_numpy().astype(np.int64)
    names, of_topic = _ranked(topics)
    headers = [TopicHeader(topic, kind, _ENCODING, latched=False) for topic, kind in names]
    order = np.lexsort((of_topic, of_bag))
    columns = [topics[name].to_numpy() for name in ("messages", "first_ns", "last_ns")]
    numbers = np.stack(columns, axis=1).astype("<i8")[order] if len(order) else np.zeros((0, 3))
    found_bags, begins = np.unique(of_bag[order], return_index=True)
    ends = [*begins[1:].tolist(), len(order)]
    held, schemas = of_topic[order], dict[bytes, "SummarySchema"]()
    found: dict[int, BagSummary] = {}
    for bag, begin, end in zip(found_bags.tolist(), begins.tolist(), ends, strict=True):
        key = held[begin:end].tobytes()
        if key not in schemas:
            own = tuple(headers[code] for code in held[begin:end].tolist())
            schemas[key] = shared_schema(own, (), complete=True, notes=())
        found[bag] = BagSummary.decoded(schemas[key], numbers[begin:end].tobytes())
    return found


def _ranked(topics: pa.Table) -> tuple[Sequence[tuple[str, str]], NDArray[np.int64]]:
    """Returns all pairs of topic and type in order, and for each row the position of its pair."""
    columns = [topics[name].combine_chunks().dictionary_encode() for name in ("topic", "type")]
    texts = [each.dictionary.to_pylist() for each in columns]
    indices = [each.indices.to_numpy().astype(np.int64) for each in columns]
    many = max(len(texts[1]), 1)
    codes, rows = np.unique(indices[0] * many + indices[1], return_inverse=True)
    names = [(texts[0][code // many], texts[1][code % many]) for code in codes.tolist()]
    order = sorted(range(len(names)), key=names.__getitem__)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return [names[each] for each in order], rank[rows]


def _day(value: object) -> date:
    return value  # type: ignore[return-value]  # the column is of dates


def _whole(value: object) -> int:
    return value if isinstance(value, int) else 0

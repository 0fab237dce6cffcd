"""Reads what a lake has of the messages of one robot's bags."""

from __future__ import annotations

import json
import threading
from collections import Counter, OrderedDict
from functools import partial
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.state_changes import has_levels
from ros2_memory.analysis.topic_events import EMPTY_STATE, has_events
from ros2_memory.core.errors import NotShippedError, UndecodableError
from ros2_memory.lake.memory.rows_as_messages import (
    Tracks,
    channel,
    detections,
    even_times,
    is_only_stated,
    message,
    states,
)
from ros2_memory.lake.partitions import locations
from ros2_memory.lake.state_runs import EMPTY_KIND, KIND, StateRun, unpacked, unpacked_empty
from ros2_memory.lake.tables import topic_key
from ros2_memory.lake.typed_values import MAPS
from ros2_memory.storage.base import BagReader, Closing

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    import pyarrow as pa

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.model import BagFile, JsonValue, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.memory.index import LakeBag, LakeIndex
    from ros2_memory.storage.base import Channel, Record

    RowsOfDay = tuple[pa.Table, Mapping[str, int], Mapping[str, int]]

_MOST_DAYS: Final = 16
"""Days of a table of which the rows of a topic stay in memory."""
_MOST_ALONE: Final = 3
"""Bags of a day that are read alone."""
_MOST_READ: Final = 256
"""Topics of a bag that stay in memory."""
_SIGHTINGS: Final = (
    "SELECT bag_id, time_ns, message, label, score, frame_id, x, y, z FROM sightings"
    " WHERE topic_key = $key AND topic = $topic"
)
_EMPTY: Final = (
    "SELECT bag_id, kind, packed FROM digests"  # noqa: S608
    f" WHERE topic_key = $key AND topic = $topic AND kind = '{EMPTY_KIND}'"
)
_MESSAGES: Final = (
    f"SELECT type, time_ns, publish_ns, value, {', '.join(MAPS)} FROM messages"  # noqa: S608
    " WHERE topic_key = $key AND topic = $topic AND bag_id = $bag ORDER BY time_ns, message"
)
_POSES: Final = (
    "SELECT bag_id, time_ns, frame_id, x, y, heading, begins FROM poses"
    " WHERE topic_key = $key AND topic = $topic"
)
_STATES: Final = (
    "SELECT kind, packed FROM digests"
    " WHERE topic_key = $key AND topic = $topic AND kind IN ('events', $kind) AND bag_id = $bag"
)
_MOST_EMPTY: Final = 64
"""Records made for the messages of a topic in a bag that state nothing, at most."""


class LakeReader(BagReader):
    """Makes messages of rows: of detections, of the chosen topics, and of the robot's track.

    Of topics with events there is what each message states, and nothing that could be shown.

    A detection has its label, score and place alone. A message without detections has no row: where
    some are left out between two, one stands for them.

    Args:
        lake: the lake.
        robot: its name there.
        index: its bags.
        map_frame: the frame of the map.
        tf_topics: those of transforms.
        static_topics: those of static ones, of which a lake has none: positions are placed already.
    """

    def __init__(
        self,
        lake: Lake,
        robot: str,
        index: LakeIndex,
        *,
        map_frame: str | None,
        tf_topics: Sequence[str],
        static_topics: Sequence[str] = (),
    ) -> None:
        self._lake = lake
        self._robot = robot
        self._index = index
        self._map_frame = map_frame
        self._tf_topics = tf_topics
        self._static_topics = static_topics
        self._served = threading.local()
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[str, str], Sequence[Record] | Tracks] = OrderedDict()
        self._days: OrderedDict[tuple[object, ...], RowsOfDay] = OrderedDict()
        self._read_alone = Counter[tuple[object, ...]]()

    def reads(self, path: Path) -> bool:
        """Returns True: all files of the index are of the lake."""
        del path
        return True

    def closing(self, path: Path) -> Closing:
        """Returns that the bag is closed: others are not shipped."""
        del path
        return Closing.CLOSED

    def summarize(self, path: Path) -> BagSummary:
        """Returns the summary of a bag of the index."""
        return self._index.file(path).summary

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """Yields what rows have of the messages.

        Raises:
            NotShippedError: the lake has no rows of a topic that the bag holds.
        """
        bag = self._index.file(path)
        found = [
            record
            for topic in sorted(topics)
            if bag.summary.schema.positions.get(topic)
            for record in self._of_topic(bag, topic, window)
        ]
        found.sort(key=lambda each: each.log_time)
        yield from reversed(found) if newest_first else found

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """Returns the log times of what rows have of the messages.

        Of a topic without rows they are taken to be as far apart as they were on average.
        """
        try:
            found = [*self.records(path, [topic], window)]
        except NotShippedError:
            found = []
        else:
            if not any(map(is_only_stated, found)):
                return [each.log_time for each in found]
        self._served.even = True
        times = [
            time
            for each in self._index.file(path).summary.of(topic)
            for time in even_times(each.first, each.last, each.count).tolist()
        ]
        return sorted(filter(window.contains, times))

    def undecodable(self, channel: Channel) -> str | None:
        """Returns None: rows are of messages that could be decoded."""
        del channel
        return None

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels of the topics that the bag holds."""
        return [channel(*each[:2]) for each in self._index.file(path).summary.schema.topics]

    def decode(self, record: Record) -> object:
        """Returns what a row has of a message.

        Raises:
            UndecodableError: the message could not be decoded when it was shipped.
            NotShippedError: only what it states was shipped.
        """
        here = record.channel
        if not record.payload:
            raise UndecodableError(here.topic, here.type, "when it was shipped")
        if is_only_stated(record):
            raise _not_shipped(here.topic)
        return json.loads(record.payload)

    def take_notes(self) -> Iterator[str]:
        """Yields in what this thread was given something else than messages since it asked last."""
        if getattr(self._served, "thinned", False):
            yield "for parts of bags the track was used that the lake has, not every pose"
        if getattr(self._served, "even", False):
            yield "steps of the clock inside of a bag are not seen in the lake"
        self._served.thinned = self._served.even = False

    def _of_topic(self, bag: BagFile, topic: str, window: TimeWindow) -> Sequence[Record]:
        is_pose = topic == self._index.pose_topic
        if is_pose:
            self._served.thinned = True
        known = self._known_of(bag, topic)
        if isinstance(known, Tracks):
            return known.poses(topic, window) if is_pose else known.transforms(topic, window)
        return [each for each in known if window.contains(each.log_time)]

    def _known_of(self, bag: BagFile, topic: str) -> Sequence[Record] | Tracks:
        """Returns all messages of a topic in a bag, or the track that they are made of."""
        here = self._index.bag(self._index.number(bag))
        key = here.bag_id, topic
        with self._lock:
            known = self._known.get(key)
            if known is not None:
                self._known.move_to_end(key)
                return known
        known = self._read(bag, here, topic)
        with self._lock:
            self._known[key] = known
            if len(self._known) > _MOST_READ:
                self._known.popitem(last=False)
        return known

    def _read(self, bag: BagFile, here: LakeBag, topic: str) -> Sequence[Record] | Tracks:
        own = self._index.pose_topic
        # The track has the robot in the map. Messages of one of these topics alone place nothing.
        if topic == own or topic in self._tf_topics:
            rows = self._rows_of_day("poses", _POSES, "time_ns", here, own)
            return Tracks(bag, own, rows, self._map_frame)
        if self._index.has_messages(topic):
            whole = [message(topic, row) for row in self._rows(_MESSAGES, "messages", here, topic)]
            if whole:
                return whole
        if self._index.is_detector(topic):
            rows, packed = self._sightings(here, topic)
            empty = None if packed is None else unpacked_empty(packed)
            return detections(bag, topic, rows, empty)
        if topic in self._static_topics:
            return ()
        [summary, *_] = bag.summary.of(topic)
        if has_events(summary.type) or has_levels(summary.type):
            return [*states(topic, summary.type, self._runs(bag, here, topic))]
        raise _not_shipped(topic)

    def _runs(self, bag: BagFile, here: LakeBag, topic: str) -> Iterator[StateRun]:
        """Yields what messages state; they state nothing where their digest has no event.

        Raises:
            NotShippedError: it was shipped by a version that did not ship what messages state.
        """
        asked = {"key": topic_key(topic), "topic": topic, "bag": here.bag_id, "kind": KIND}
        rows = self._lake.select(
            _STATES, ["digests"], asked, robots=[self._robot], days=(here.day, here.day)
        )
        packed = dict(zip(rows["kind"].to_pylist(), rows["packed"].to_pylist(), strict=True))
        known = packed.get(KIND)
        if isinstance(known, bytes):
            yield from unpacked(known)
        elif packed:
            raise _not_shipped(topic)
        else:
            for each in bag.summary.of(topic):
                count = min(each.count, _MOST_EMPTY)
                yield StateRun(EMPTY_STATE, each.first, each.last, count)

    def _sightings(
        self, bag: LakeBag, topic: str
    ) -> tuple[Sequence[Mapping[str, JsonValue]], bytes | None]:
        """Returns the detections of a bag, and where there was none, which is packed."""
        rows = self._rows_of_day("sightings", _SIGHTINGS, "time_ns, message", bag, topic)
        empty = self._rows_of_day("digests", _EMPTY, "kind", bag, topic)
        packed: object = empty[0]["packed"] if empty else None
        return rows, packed if isinstance(packed, bytes) else None

    def _rows_of_day(
        self, table: str, sql: str, order: str, bag: LakeBag, topic: str
    ) -> Sequence[Mapping[str, JsonValue]]:
        """Returns the rows of a topic in a bag, in order.

        The first bags of a day that are asked for are read alone: the newest match is in one of
        these. Who goes on reads most of the day. Its track is short: it is read at once.
        """
        select = partial(self._lake.select, robots=[self._robot], days=(bag.day, bag.day))
        asked = {"key": topic_key(topic), "topic": topic}
        # Files never change, so what was read of the same ones is still true.
        key = table, topic, locations(self._lake.days(table, self._robot).files(bag.day, bag.day))
        with self._lock:
            known = self._days.get(key)
            self._read_alone[key] += known is None
            is_alone = table != "poses" and self._read_alone[key] <= _MOST_ALONE
        rows: Sequence[Mapping[str, JsonValue]]
        if known is None and is_alone:
            of_bag = f"{sql} AND bag_id = $bag ORDER BY {order}"
            rows = select(of_bag, [table], {**asked, "bag": bag.bag_id}).to_pylist()
            return rows
        if known is None:
            found = select(f"{sql} ORDER BY bag_id, {order}", [table], asked)
            names = found["bag_id"].to_pylist()
            known = found, {name: at for at, name in reversed([*enumerate(names)])}, Counter(names)
            with self._lock:
                self._days[key] = known
                del self._read_alone[key]
                if len(self._days) > _MOST_DAYS:
                    self._days.popitem(last=False)
        found, begins, counts = known
        rows = found.slice(begins.get(bag.bag_id, 0), counts.get(bag.bag_id, 0)).to_pylist()
        return rows

    def _rows(
        self, sql: str, table: str, bag: LakeBag, topic: str
    ) -> Sequence[Mapping[str, JsonValue]]:
        asked = {"key": topic_key(topic), "topic": topic, "bag": bag.bag_id}
        days = (bag.day, bag.day)
        rows: Sequence[Mapping[str, JsonValue]] = self._lake.select(
            sql, [table], asked, robots=[self._robot], days=days
        ).to_pylist()
        return rows


def _not_shipped(topic: str) -> NotShippedError:
    return NotShippedError(
        f"the lake has no messages of {topic}: name it in lake.messages of ros2-memory ship, or "
        "ask the robot's own memory"
    )

"""The index of one robot's bags in a lake, and what reads their messages."""

from __future__ import annotations

import heapq
import json
import threading
from bisect import bisect_right
from dataclasses import KW_ONLY, dataclass, field, replace
from datetime import date, timedelta
from itertools import chain
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple, cast
from zlib import crc32

import pyarrow.compute as pc

from ros2_memory.columns.pack import is_large
from ros2_memory.core.bag_summary import BagSummary, SummarySchema
from ros2_memory.core.errors import BagError, BagVanishedError, NotInLakeError
from ros2_memory.core.model import COMPRESSED, BagFile, BagState, TimeWindow
from ros2_memory.core.timebase import ns_from_unix, utc_day
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from ros2_memory.lake.tables import ShippedBag, end_of, unpacked_messages
from ros2_memory.storage.base import BagReader, Batch, Channel, Definition, Record, Schema
from ros2_memory.storage.cache import shared

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    import pyarrow as pa

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.large_reads import LargeReads
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.lake.engine import Lake
    from ros2_memory.lake.warehouse import Days

MOST_BAGS: Final = 45_000
"""Bags that an index shows at once: a month of minutes, or some years of ten a day."""
_MOST_WINDOWS: Final = 6
"""Windows before the newest days that stay in memory."""
_GROUP: Final = 64
"""Bags of a day whose channels are read at once."""
_NEAR_BYTES: Final = 4 << 20
"""Packed messages of so many bytes are read with a bag's, of the bags before it and after it."""
_LOOKS: Final = 4
"""The lake is looked into anew after this fraction of the time that an index may be old."""
_GONE: Final = "it is not in the lake any more"
_HEAD_BYTES: Final = 200
"""About what a channel takes in memory."""

_BAGS: Final = (*ShippedBag._fields, "summary", "counts", "joined")
_IN_ORDER: Final = [(column, "ascending") for column in ("start_ns", "end_ns", "bag_id")]
_CHANNEL: Final = ("topic", "encoding", "latched", "metadata", "type", "schema_encoding", "schema")
_HEADS: Final = ("bag_id", "channel", "has_payloads", *_CHANNEL)
_PACKED: Final = ("bag_id", "channel", "packed")


class LakeBag(NamedTuple):
    """One bag of a lake.

    Attributes:
        bag_id: its id there.
        day: the day that its rows are under.
        file: the bag, with the path that it had on the robot.
        joined: the recordings that handovers join with its own.
        group: the bags of that day that are read with it, and itself: their `sidecar_ns` by id.
    """

    bag_id: str
    day: date
    file: BagFile
    joined: tuple[str, ...]
    group: dict[str, int]


@dataclass(frozen=True)
class _Window:
    """The bags of consecutive days of a robot.

    Attributes:
        older: the last log time of the newest day before them; None if there is none.
        files: the files of the table `bags` for each day.
        timeline: the bags in order.
        bags: the bags by path.
        joined: the names of the recordings that handovers join with one, by its folder.
    """

    older: Ns | None = None
    files: Days = field(default_factory=dict)
    timeline: Timeline = field(default_factory=Timeline)
    bags: Mapping[str, LakeBag] = field(default_factory=dict)
    joined: Mapping[Path, tuple[str, ...]] = field(default_factory=dict)


def newest_days(days: Days, until: date, most_rows: int, fewest: int) -> tuple[Days, date | None]:
    """Returns the newest days with rows up to `until`, and the day with rows before them, if any.

    They span `fewest` days, or more while they have at most `most_rows` rows.
    """
    order = [*days]
    begin = end = bisect_right(order, until)
    rows = 0
    while begin:
        day = order[begin - 1]
        rows += sum(file.rows for file in days[day])
        if rows > most_rows and day <= order[end - 1] - timedelta(days=fewest):
            break
        begin -= 1
    chosen = {day: days[day] for day in order[begin:end]}
    return chosen, order[begin - 1] if begin else None


@dataclass(eq=False, repr=False)
class LakeIndex:
    """The bags of one robot in a lake, as of some seconds ago. Thread-safe.

    It has the newest days; for a question about an earlier time, the days up to that time. Bags
    have the paths that they had on the robot. Which messages count at a handover was decided when
    the bags were shipped.

    Attributes:
        lake: the lake.
        robot: the name of the robot in the lake.
        bag_dir: where the bags are on the robot; the directory need not exist here.
        clock: the wall clock.
        refresh_s: how old the index may be.
        days: how many days are shown at least.
        most_bags: up to so many bags, more days are shown.
        published: the last snapshot; None before the first.
    """

    lake: Lake
    robot: str
    bag_dir: Path
    clock: Clock
    _: KW_ONLY
    refresh_s: float = 60.0
    days: int = 31
    most_bags: int = MOST_BAGS
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)
    _windows: dict[date, _Window] = field(default_factory=dict, init=False)
    published: Snapshot | None = field(default=None, init=False)

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns the newest days as of at most `refresh_s` ago.

        If `reach` is before the newest days, it has the days up to `reach`, and the next one.

        Raises:
            RefusedError: the lake cannot be read.
        """
        current = self.published
        if current is not None:
            age = self.clock.now() - current.scanned_at
            # Below 0 the clock was set back, and the age is unknown.
            if not 0 <= age <= ns_from_unix(self.refresh_s):
                current = None
        current = current or self.refresh()
        if reach is None or current.older is None or reach >= (current.earliest or reach):
            return current
        with self._lock:
            # The last day with bags, and the next one: what lies across midnight goes on there, and
            # a gap up to it is no end of the memory.
            days = [*self.lake.days("bags").get(self.robot, {})]
            if not days:  # all was forgotten since
                return replace(current, timeline=Timeline(), older=None)
            later = bisect_right(days, utc_day(reach))
            first, until = days[max(later - 1, 0)], days[min(later, len(days) - 1)]
            window = self._window(until, (until - first).days + 1)
        return replace(current, timeline=window.timeline, older=window.older)

    def refresh(self) -> Snapshot:
        """Looks into the lake now, unless another robot's index did so a moment ago."""
        with self._lock:
            self.lake.refresh(self.refresh_s / _LOOKS)
            window = self._window(date.max, self.days)
            self.published = Snapshot(
                window.timeline,
                silent_topics=window.timeline.silent - {*window.timeline.topics()},
                scanned_at=self.clock.now(),
                older=window.older,
            )
            return self.published

    def heartbeat(self) -> Heartbeat | None:
        """Returns None: the heartbeat of a robot's recorder is not in a lake."""
        return None

    def joined_with(self, recording: Path) -> tuple[str, ...]:
        """Returns the recordings that handovers joined with one when its bags were shipped."""
        joined = (window.joined.get(recording) for window in self._windows.values())
        return next(filter(None, joined), ())

    def bag(self, path: Path) -> LakeBag | None:
        """Returns the bag with this path in a snapshot; None if there is none."""
        bags = (window.bags.get(str(path)) for window in self._windows.values())
        return next(filter(None, bags), None)

    def _window(self, until: date, fewest: int) -> _Window:
        """Returns the newest days up to `until`. Only days with new files are read."""
        before = self._windows.get(until, _Window())
        of_robot = self.lake.days("bags").get(self.robot, {})
        files, day_before = newest_days(of_robot, until, self.most_bags, fewest)
        older = None if day_before is None else end_of(day_before)
        window = replace(before, older=older)
        if files != before.files:
            new = {day: of_day for day, of_day in files.items() if before.files.get(day) != of_day}
            same = files.keys() - new.keys()
            bags = {path: bag for path, bag in before.bags.items() if bag.day in same}
            bags |= self._read_bags(new, before.bags)
            gone, added = _missing(before.bags, bags), _missing(bags, before.bags)
            timeline = before.timeline.changed(gone, added)
            joined = {bag.file.recording: bag.joined for bag in bags.values() if bag.joined}
            window = _Window(older, files, timeline, bags, joined)
        # A new dict: other threads look for the bags of their answers in the old one.
        windows = {**self._windows}
        windows.pop(until, None)  # the one that was asked for last comes last
        windows[until] = window
        dated = [day for day in windows if day != date.max]
        self._windows = {day: windows[day] for day in (date.max, *dated[-_MOST_WINDOWS:])}
        return window

    def _read_bags(self, days: Days, known: Mapping[str, LakeBag]) -> dict[str, LakeBag]:
        """Returns the bags of the days by path; known ones keep their path and their `BagFile`."""
        rows = self.lake.rows("bags", chain.from_iterable(days.values()), _BAGS).sort_by(_IN_ORDER)
        ids_by_path: dict[str, str] = {}
        for window in self._windows.values():
            ids_by_path.update((path, bag.bag_id) for path, bag in window.bags.items())
        schemas: dict[str, SummarySchema] = {}
        group, day = dict[str, int](), date.min
        bags: dict[str, LakeBag] = {}
        for row in rows.to_pylist():
            schema, counts, joined = map(row.pop, ("summary", "counts", "joined"))
            shipped = ShippedBag(**row)
            path = f"{self.bag_dir}/{shipped.file.removesuffix(COMPRESSED)}"
            # A name may have been used again for another bag.
            if ids_by_path.setdefault(path, shipped.bag_id) != shipped.bag_id:
                path = f"{path}-{shipped.bag_id}"
            if schema not in schemas:
                schemas[schema] = SummarySchema.from_json(schema)
            file = _bag_file(path, shipped, BagSummary(schemas[schema], counts))
            before = known.get(path)
            if before is not None and before.file == file:
                file = before.file  # derived data is remembered by this object
            if shipped.day != day or len(group) == _GROUP:
                group, day = {}, shipped.day
            group[shipped.bag_id] = file.sidecar_ns
            names = tuple(joined.split("/")) if joined else ()
            bags[path] = LakeBag(shipped.bag_id, day, file, names, group)
        return bags


def _bag_file(path: str, shipped: ShippedBag, summary: BagSummary) -> BagFile:
    """Returns a shipped bag as an index has it; `sidecar_ns` is another one for other messages."""
    state = crc32(f"{shipped.bag_id} {shipped.sha256} {shipped.made_of}".encode())
    span = shipped.start_ns, shipped.end_ns
    return BagFile(path, shipped.size, shipped.mtime_ns, BagState.CLOSED, summary, *span, state)


def _missing(bags: Mapping[str, LakeBag], others: Mapping[str, LakeBag]) -> list[BagFile]:
    """Returns the files of the bags that are not among the others, by path and identity."""
    missing: list[BagFile] = []
    for path, bag in bags.items():
        other = others.get(path)
        if other is None or other.file is not bag.file:
            missing.append(bag.file)
    return missing


class _Head(NamedTuple):
    """A channel of a bag: its number there, and whether the lake has its payloads."""

    number: int
    channel: Channel
    has_payloads: bool


@dataclass(eq=False, repr=False)
class LakeReader(BagReader):
    """An adapter of `BagReader` for one robot's bags in a lake; its own reader reads all others.

    Of images, clouds, scans and the like a lake has only the times: reading their payloads is
    refused.

    Attributes:
        index: the bags in the lake.
        own: reads other bags, and decodes messages.
        large: the turn to have much of a bag in memory.
    """

    index: LakeIndex
    own: BagReader
    large: LargeReads

    def reads(self, path: Path) -> bool:
        """Returns whether a path is a bag of the index, or one that the own reader reads."""
        return self.index.bag(path) is not None or self.own.reads(path)

    def is_finished(self, path: Path) -> bool:
        """Returns whether the writer has finished a bag; shipped bags are finished."""
        return bool(self.index.bag(path)) or self.own.is_finished(path)

    def summarize(self, path: Path) -> BagSummary:
        """Returns the summary of a bag."""
        bag = self.index.bag(path)
        return bag.file.summary if bag else self.own.summarize(path)

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool = False
    ) -> Iterator[Record]:
        """Yields the messages in order of log time.

        Raises:
            NotInLakeError: the lake has only the times of a topic.
        """
        bag = self.index.bag(path)
        if bag is None:
            return self.own.records(path, topics, window, newest_first=newest_first)
        return self._records(bag, topics, window, -1 if newest_first else 1)

    def batches(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, bare: Collection[str] = ()
    ) -> Iterator[Batch]:
        """Yields the messages of a channel at once.

        Raises:
            NotInLakeError: the lake has only the times of a topic that is not `bare`.
        """
        bag = self.index.bag(path)
        if bag is None:
            return self.own.batches(path, topics, window, bare=bare)
        return self._batches(bag, topics, window, bare)

    def times_alone(self, path: Path) -> Collection[str]:
        """Returns the topics whose payloads were not shipped: their messages are large."""
        if (bag := self.index.bag(path)) is None:
            return self.own.times_alone(path)
        return {head.channel.topic for head in self._heads_of(bag) if not head.has_payloads}

    def is_file(self, path: Path) -> bool:
        """Returns whether a bag is a file, not rows of the lake."""
        return self.index.bag(path) is None

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels of a bag; of a bag in the lake only those with messages."""
        if (bag := self.index.bag(path)) is None:
            return self.own.channels(path)
        return [head.channel for head in self._heads_of(bag)]

    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded; None if its type is known."""
        return self.own.undecodable(channel)

    def decode(self, record: Record) -> object:
        """Decodes a message."""
        return self.own.decode(record)

    def definition(self, channel: Channel) -> Definition | None:
        """Returns the fields of a channel's messages."""
        return self.own.definition(channel)

    def _records(
        self, bag: LakeBag, topics: Collection[str], window: TimeWindow, step: int
    ) -> Iterator[Record]:
        merged = heapq.merge(
            *(_in_order(batch, step) for batch in self._batches(bag, topics, window)),
            key=itemgetter(0, 1),
            reverse=step < 0,
        )
        yield from (record for _, _, record in merged)

    def _batches(
        self, bag: LakeBag, topics: Collection[str], window: TimeWindow, bare: Collection[str] = ()
    ) -> Iterator[Batch]:
        wanted = [head for head in self._heads_of(bag) if head.channel.topic in topics]
        names = sorted({head.channel.topic for head in wanted})
        for head in wanted:
            topic = head.channel.topic
            if not head.has_payloads and topic not in bare:
                do = "name it in lake.messages of ros2-memory ship, ask about other topics"
                why = f"the lake has only the times of {topic}, whose messages are large"
                raise NotInLakeError(f"{why}: {do}, or ask the robot's own memory")
            data = self._packed_of(bag, head.number, names)
            if data is None:
                raise BagError(bag.file.file, f"the lake has no messages of {topic} any more")
            if is_large(data):
                self.large.acquire()
            try:
                batch = unpacked_messages(data, head.channel)
            except ValueError as error:
                raise BagError(bag.file.file, f"{topic} in the lake: {error}") from error
            inside = (batch.log_times >= window.start) & (batch.log_times < window.stop)
            if inside.any():
                yield batch if inside.all() else batch.select(inside)

    def _heads_of(self, bag: LakeBag) -> Sequence[_Head]:
        """Returns the channels of a bag. The channels of its group are read and cached at once.

        Raises:
            BagVanishedError: the bag is not in the lake any more.
        """
        known = self.index.lake.channels
        heads = cast("Sequence[_Head] | None", known.get((bag.bag_id, bag.file.sidecar_ns)))
        if heads is None:
            heads_by_bag = self._read_heads(bag)
            for bag_id, of_bag in heads_by_bag.items():
                size_bytes = _HEAD_BYTES * (1 + len(of_bag))
                known.put((bag_id, bag.group[bag_id]), of_bag, size_bytes)
            heads = heads_by_bag[bag.bag_id]
        if not heads and bag.file.summary.count:
            # Deleted, or replaced under another id, since the index of this robot was read.
            raise BagVanishedError(bag.file.file, _GONE)
        return heads

    def _read_heads(self, bag: LakeBag) -> dict[str, list[_Head]]:
        """Returns the channels of the bags of a group, by their ids."""
        heads_by_bag: dict[str, list[_Head]] = {bag_id: [] for bag_id in bag.group}
        rows = self._rows(bag, [*bag.group], _HEADS).to_pylist()
        for row in sorted(rows, key=itemgetter("channel")):
            schema = Schema(row["type"], row["schema_encoding"], row["schema"])
            metadata = tuple((key, value) for key, value in json.loads(row["metadata"]))
            channel = Channel(row["topic"], row["encoding"], schema, row["latched"], metadata)
            head = _Head(row["channel"], shared(channel), row["has_payloads"])
            heads_by_bag[row["bag_id"]].append(head)
        return heads_by_bag

    def _packed_of(self, bag: LakeBag, number: int, topics: Sequence[str]) -> bytes | None:
        """Returns the packed messages of a channel; None if they are gone.

        All `topics` are read at once, since they are asked for next.
        """
        messages = self.index.lake.messages
        wanted = (bag.bag_id, bag.file.sidecar_ns, number)
        packed = messages.get(wanted)
        if packed is None:
            bag_ids = self._ids_to_read(bag, number, len(topics))
            for row in self._rows(bag, bag_ids, _PACKED, topics).to_pylist():
                key = (row["bag_id"], bag.group[row["bag_id"]], row["channel"])
                messages.put(key, row["packed"], len(row["packed"]))
                if key == wanted:
                    packed = row["packed"]
        return packed

    def _ids_to_read(self, bag: LakeBag, number: int, topics: int) -> list[str]:
        """Returns the ids of a bag and of the bags beside it whose messages fit in `_NEAR_BYTES`.

        The size is judged by the channel in bags of the group that were read before. If none was,
        the bag is read alone: the next one may not be asked for.
        """
        packed = self.index.lake.messages
        known = (packed.get((bag_id, state, number)) for bag_id, state in bag.group.items())
        largest = max(map(len, filter(None, known)), default=0)
        near = _NEAR_BYTES // (largest * topics) if largest else 0
        ids = [*bag.group]
        at = ids.index(bag.bag_id)
        return ids[max(at - near, 0) : at + near + 1]

    def _rows(
        self, bag: LakeBag, bag_ids: list[str], columns: Sequence[str], topics: Sequence[str] = ()
    ) -> pa.Table:
        """Returns the rows of bags of one day in `channels`; `topics`: of these alone."""
        first, last = min(bag_ids), max(bag_ids)
        of_day = self.index.lake.days("channels").get(self.index.robot, {}).get(bag.day, ())
        files = [file for file in of_day if file.first <= last and first <= file.last]
        bag_id = pc.field("bag_id")
        # The bounds let Arrow pass over groups of rows.
        wanted = (bag_id >= first) & (bag_id <= last) & bag_id.isin(bag_ids)
        if topics:
            wanted &= pc.field("topic").isin(topics)
        return self.index.lake.rows("channels", files, columns, wanted)


def _in_order(batch: Batch, step: int) -> Iterator[tuple[Ns, int, Record]]:
    """Yields log time, place in the file and record of each message; a step of -1 goes back."""
    times, places = batch.log_times[::step].tolist(), batch.places[::step].tolist()
    return zip(times, places, map(batch.record, range(len(times))[::step]), strict=True)

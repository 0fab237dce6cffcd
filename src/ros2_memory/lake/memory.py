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
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from ros2_memory.lake.tables import ShippedBag, day_of, end_of, unpacked_messages
from ros2_memory.storage.base import BagReader, Batch, Channel, Closing, Definition, Record, Schema
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
"""Bags that are looked at together: a month of minutes, or some years of ten a day."""
_MOST_WINDOWS: Final = 6
"""Times before the newest days that stay in memory."""
_TOGETHER: Final = 64
"""Bags of a day whose messages are read together."""
_NEAR_BYTES: Final = 4 << 20
"""Packed messages that are read with those of a bag: of the bags before it, and of those after."""
_LOOKS: Final = 4
"""What is known of the lake serves for all robots for this part of the time that it may be old."""
_GONE: Final = "it is not in the lake any more"
_HEAD_BYTES: Final = 200

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
        file: the bag, by the path that it had on the robot.
        joined: the recordings that handovers join with its own.
        together: the states by id of the bags of that day that are read together.
    """

    bag_id: str
    day: date
    file: BagFile
    joined: tuple[str, ...]
    together: dict[str, int]


@dataclass(frozen=True)
class _Window:
    """Consecutive days of a robot, and what the lake has of them.

    Attributes:
        older: the end of the newest day before them, as a log time; None where there is none.
        made_of: the files whose rows are the bags of each day.
        timeline: the bags of all.
        bags: these by their paths.
        joined: names of recordings that handovers join with one, by its folder.
    """

    older: Ns | None = None
    made_of: Days = field(default_factory=dict)
    timeline: Timeline = field(default_factory=Timeline)
    bags: Mapping[str, LakeBag] = field(default_factory=dict)
    joined: Mapping[Path, tuple[str, ...]] = field(default_factory=dict)


def newest(days: Days, until: date, rows: int, fewest: int) -> tuple[Days, date | None]:
    """Returns the newest days with rows up to one, and the one before them, if there is one.

    They are those of `fewest` days, and more while all have at most `rows` rows.
    """
    order = [*days]
    begin = end = bisect_right(order, until)
    total = 0
    while begin:
        day = order[begin - 1]
        total += sum(file.rows for file in days[day])
        if total > rows and day <= order[end - 1] - timedelta(days=fewest):
            break
        begin -= 1
    chosen = {day: days[day] for day in order[begin:end]}
    return chosen, order[begin - 1] if begin else None


@dataclass(eq=False, repr=False)
class LakeIndex:
    """What a lake has of one robot, as of some seconds ago. Thread-safe.

    It is of the newest days, and of other days where a question is about a time before these. Bags
    have the paths that they had on the robot. Which messages count at a handover was decided when
    they were shipped.

    Attributes:
        lake: the lake.
        robot: its name there.
        bag_dir: where the bags are on the robot, or a path that no directory need have.
        clock: the wall clock.
        refresh_s: how old (s) the index may be: at most one commit of a table is made meanwhile.
        days: how many days are looked at together, at least: the newest; more of few bags.
        most_bags: so many bags at most, where that is more days.
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
    _snapshot: Snapshot | None = field(default=None, init=False)

    @property
    def published(self) -> Snapshot | None:
        """The index as it is known now."""
        return self._snapshot

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns an index at most `refresh_s` old; what is not shipped yet is not in it.

        Where `reach` is before the newest days, it is of the days up to that time.

        Raises:
            RefusedError: the lake cannot be read.
        """
        current = self._snapshot
        # A clock that was set back says nothing about its age.
        if (
            current is None
            or not 0 <= self.clock.now() - current.scanned_at <= self.refresh_s * 1e9
        ):
            current = self.refresh()
        if reach is None or current.older is None or reach > current.older:
            return current
        day = day_of(reach)
        with self._lock:
            # With the next day that has bags: what lies across midnight goes on there, and a gap
            # up to it is no end of the memory.
            days = self.lake.days("bags").get(self.robot, {})
            until = next((later for later in days if later > day), day)
            window = self._window(until, (until - day).days + 1)
        return replace(current, timeline=window.timeline, older=window.older)

    def refresh(self) -> Snapshot:
        """Looks into the lake now; what was just seen there for another robot is not old."""
        with self._lock:
            self.lake.refresh(self.refresh_s / _LOOKS)
            window = self._window(date.max, self.days)
            timeline = window.timeline
            silent = {name for bag in timeline.bags for name in bag.summary.schema.silent}
            topics, now = frozenset(silent.difference(timeline.topics())), self.clock.now()
            self._snapshot = Snapshot(
                timeline, silent_topics=topics, scanned_at=now, older=window.older
            )
            return self._snapshot

    def heartbeat(self) -> Heartbeat | None:
        """Returns None: what a robot's recorder does now is not in a lake."""
        return None

    def joined_with(self, recording: Path) -> tuple[str, ...]:
        """Returns what the robot's handovers were when the bags were shipped."""
        joined = (window.joined.get(recording) for window in self._windows.values())
        return next(filter(None, joined), ())

    def bag(self, path: Path) -> LakeBag | None:
        """Returns the bag of a snapshot that has a path there; None if there is none."""
        bags = (window.bags.get(str(path)) for window in self._windows.values())
        return next(filter(None, bags), None)

    def _window(self, until: date, fewest: int) -> _Window:
        """Returns the newest days up to one; only those are read of which a file is new."""
        before = self._windows.get(until, _Window())
        of_robot = self.lake.days("bags").get(self.robot, {})
        made_of, day_before = newest(of_robot, until, self.most_bags, fewest)
        window = replace(before, older=None if day_before is None else end_of(day_before))
        if made_of != before.made_of:
            new = {day: files for day, files in made_of.items() if before.made_of.get(day) != files}
            same = made_of.keys() - new.keys()
            bags = {path: bag for path, bag in before.bags.items() if bag.day in same}
            bags |= self._read(new, before.bags)
            gone, come = _missing(before.bags, bags), _missing(bags, before.bags)
            timeline = before.timeline.changed(gone, come)
            joined = {bag.file.recording: bag.joined for bag in bags.values() if bag.joined}
            window = _Window(window.older, made_of, timeline, bags, joined)
        # A new dict: other threads look for the bags of their answers in the old one.
        windows = {**self._windows}
        windows.pop(until, None)  # the one that was asked for last comes last
        windows[until] = window
        dated = [day for day in windows if day != date.max]
        self._windows = {day: windows[day] for day in (date.max, *dated[-_MOST_WINDOWS:])}
        return window

    def _read(self, made_of: Days, known: Mapping[str, LakeBag]) -> dict[str, LakeBag]:
        """Returns the bags of some days by path; those that are known keep path and object."""
        files = chain.from_iterable(made_of.values())
        rows = self.lake.rows("bags", files, _BAGS).sort_by(_IN_ORDER)
        windows = self._windows.values()
        owners = {path: bag.bag_id for each in windows for path, bag in each.bags.items()}
        schemas: dict[str, SummarySchema] = {}
        together, day = dict[str, int](), date.min
        bags: dict[str, LakeBag] = {}
        for row in rows.to_pylist():
            schema, counts, joined = map(row.pop, ("summary", "counts", "joined"))
            bag = ShippedBag(**row)
            path = f"{self.bag_dir}/{bag.file.removesuffix(COMPRESSED)}"
            # Another bag may have it, whose name was used again.
            if owners.setdefault(path, bag.bag_id) != bag.bag_id:
                path = f"{path}-{bag.bag_id}"
            if schema not in schemas:
                schemas[schema] = SummarySchema.from_json(schema)
            summary = BagSummary.decoded(schemas[schema], counts)
            # One as large and as old may have other messages.
            state = crc32(f"{bag.bag_id} {bag.sha256} {bag.made_of}".encode())
            span = bag.start_ns, bag.end_ns
            file = BagFile(path, bag.size, bag.mtime_ns, BagState.CLOSED, summary, *span, state)
            before = known.get(path)
            if before is not None and before.file == file:
                file = before.file  # what was remembered of it stays
            if bag.day != day or len(together) == _TOGETHER:
                together, day = {}, bag.day
            together[bag.bag_id] = state
            names = tuple(joined.split("/")) if joined else ()
            bags[path] = LakeBag(bag.bag_id, bag.day, file, names, together)
        return bags


def _missing(bags: Mapping[str, LakeBag], others: Mapping[str, LakeBag]) -> list[BagFile]:
    """Returns the files of bags that are not, or not the same, among others."""
    same = {path for path, bag in others.items() if path in bags and bags[path].file is bag.file}
    return [bag.file for path, bag in bags.items() if path not in same]


class _Head(NamedTuple):
    """A channel of a bag: its number there, and whether the lake has its payloads."""

    number: int
    channel: Channel
    has_payloads: bool


@dataclass(eq=False, repr=False)
class LakeReader(BagReader):
    """An adapter of `BagReader`: the bags of one robot in a lake, and all others as its own reader.

    Of images, clouds, scans and the like a lake has the times alone: to read their payloads is
    refused.

    Attributes:
        index: the bags of the lake.
        own: reads others, and decodes.
        large: the turn to hold much of a bag.
    """

    index: LakeIndex
    own: BagReader
    large: LargeReads

    def reads(self, path: Path) -> bool:
        """Returns whether it is a bag of the index, or one that the robot's own reader reads."""
        return self.index.bag(path) is not None or self.own.reads(path)

    def closing(self, path: Path) -> Closing:
        """Returns whether the writer has finished a bag: none is shipped before."""
        return Closing.CLOSED if self.index.bag(path) else self.own.closing(path)

    def summarize(self, path: Path) -> BagSummary:
        """Returns the summary of a bag."""
        bag = self.index.bag(path)
        return bag.file.summary if bag else self.own.summarize(path)

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool = False
    ) -> Iterator[Record]:
        """Yields the messages.

        Raises:
            NotInLakeError: the lake has the times of a topic alone.
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
            NotInLakeError: the lake has the times of a topic alone, and it is not `bare`.
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
        """Returns whether a bag is a file: whether it is the robot's own."""
        return self.index.bag(path) is None

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels of a bag; of one in the lake those that have messages."""
        if (bag := self.index.bag(path)) is None:
            return self.own.channels(path)
        return [head.channel for head in self._heads_of(bag)]

    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded; None if its type is known."""
        return self.own.undecodable(channel)

    def decode(self, record: Record) -> object:
        """Decodes a message as that of a file."""
        return self.own.decode(record)

    def definition(self, channel: Channel) -> Definition | None:
        """Returns the fields of a channel's messages, as of that of a file."""
        return self.own.definition(channel)

    def _records(
        self, bag: LakeBag, topics: Collection[str], window: TimeWindow, step: int
    ) -> Iterator[Record]:
        merged = heapq.merge(
            *(_in_order(batch, step) for batch in self._batches(bag, topics, window)),
            key=itemgetter(0, 1),
            reverse=step < 0,
        )
        yield from (record for *_, record in merged)

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
                yield batch if inside.all() else batch.taken(inside)

    def _heads_of(self, bag: LakeBag) -> Sequence[_Head]:
        """Returns the channels of a bag; those of the bags beside it are read with it, and cached.

        Raises:
            BagVanishedError: it is not in the lake any more.
        """
        known = self.index.lake.channels
        heads = cast("Sequence[_Head] | None", known.get((bag.bag_id, bag.file.sidecar_ns)))
        if heads is None:
            heads_by_bag = self._read_heads(bag)
            for bag_id, read in heads_by_bag.items():
                size_bytes = _HEAD_BYTES * (1 + len(read))
                known.put((bag_id, bag.together[bag_id]), read, size_bytes)
            heads = heads_by_bag[bag.bag_id]
        if not heads and bag.file.summary.count:
            # Deleted, or replaced under another id, since the index of this robot was read.
            raise BagVanishedError(bag.file.file, _GONE)
        return heads

    def _read_heads(self, bag: LakeBag) -> dict[str, list[_Head]]:
        """Returns the channels of a bag and of those that are read with it, by the ids of bags."""
        heads_by_bag: dict[str, list[_Head]] = {bag_id: [] for bag_id in bag.together}
        rows = self._rows(bag, [*bag.together], _HEADS).to_pylist()
        for row in sorted(rows, key=itemgetter("channel")):
            schema = Schema(row["type"], row["schema_encoding"], row["schema"])
            metadata = tuple((key, value) for key, value in json.loads(row["metadata"]))
            channel = Channel(row["topic"], row["encoding"], schema, row["latched"], metadata)
            head = _Head(row["channel"], shared(channel), row["has_payloads"])
            heads_by_bag[row["bag_id"]].append(head)
        return heads_by_bag

    def _packed_of(self, bag: LakeBag, number: int, topics: Sequence[str]) -> bytes | None:
        """Returns the packed messages of a channel; None where they are gone.

        With it those of other `topics` are read, which are asked for next. Who has read one bag
        and goes on, reads those beside it, too, as many as may be in memory.
        """
        messages = self.index.lake.messages
        packed = messages.get((bag.bag_id, bag.file.sidecar_ns, number))
        if packed is None:
            beside = (messages.get((*state, number)) for state in bag.together.items())
            largest = max(map(len, filter(None, beside)), default=_NEAR_BYTES + 1)
            near, ids = _NEAR_BYTES // (largest * len(topics)), [*bag.together]
            at = ids.index(bag.bag_id)
            bags = ids[max(at - near, 0) : at + near + 1]
            for row in self._rows(bag, bags, _PACKED, topics).to_pylist():
                key = (row["bag_id"], bag.together[row["bag_id"]], row["channel"])
                messages.put(key, row["packed"], len(row["packed"]))
                if key == (bag.bag_id, bag.file.sidecar_ns, number):
                    packed = row["packed"]
        return packed

    def _rows(
        self, bag: LakeBag, bags: list[str], columns: Sequence[str], topics: Sequence[str] = ()
    ) -> pa.Table:
        """Returns the channels of some bags of a day, of some topics or of all, in no order."""
        first, last = min(bags), max(bags)
        of_day = self.index.lake.days("channels").get(self.index.robot, {}).get(bag.day, ())
        files = [file for file in of_day if file.first <= last and first <= file.last]
        bag_id = pc.field("bag_id")
        # The bounds let Arrow pass over groups of rows.
        wanted = (bag_id >= first) & (bag_id <= last) & bag_id.isin(bags)
        if topics:
            wanted &= pc.field("topic").isin(topics)
        return self.index.lake.rows("channels", files, columns, wanted)


def _in_order(batch: Batch, step: int) -> Iterator[tuple[Ns, int, Record]]:
    """Yields time, place and record of each message, with a `step` of -1 from the last one on."""
    times, places = batch.log_times[::step].tolist(), batch.places[::step].tolist()
    return zip(times, places, map(batch.record, range(len(times))[::step]), strict=True)

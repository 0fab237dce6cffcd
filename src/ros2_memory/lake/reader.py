"""Reads the messages of one robot's bags from the channels of a lake, as its memory does."""

from __future__ import annotations

import heapq
import json
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.columns.pack import is_large
from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.errors import BagError, NotInLakeError
from ros2_memory.history.context import Memory
from ros2_memory.lake.index import MOST_BAGS, LakeIndex
from ros2_memory.lake.packed_messages import unpacked_messages
from ros2_memory.storage.base import BagReader, Channel, Closing, Schema
from ros2_memory.storage.cache import ByteLru, shared

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    import pyarrow as pa

    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.large_reads import LargeReads
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Clock
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.index import LakeBag
    from ros2_memory.storage.base import Batch, Definition, Record

_HEAD_BYTES: Final = 200
_HEADS_BYTES: Final = 8 << 20
_HEADS: Final = (
    "SELECT bag_id, channel, has_payloads, metadata, type, schema_encoding, schema, topic,"
    " encoding, latched FROM channels"
    " WHERE bag_id IN $bags AND bag_id >= $first AND bag_id <= $last ORDER BY bag_id, channel"
)
_PACKED: Final = (
    "SELECT bag_id, channel, packed FROM channels WHERE topic IN $topics"
    " AND bag_id IN $bags AND bag_id >= $first AND bag_id <= $last"
)


class _Head(NamedTuple):
    """A channel of a bag: its number there, and whether the lake has its payloads."""

    number: int
    channel: Channel
    has_payloads: bool


class LakeReader(BagReader):
    """An adapter of `BagReader`: the bags of one robot in a lake.

    Messages of one time are in the order of their topics. Of images, clouds, scans and the like a
    lake has the times alone: to read their payloads is refused.

    Args:
        lake: the lake.
        robot: its name there.
        index: its bags.
        decoder: decodes messages, as it does those of files.
        large: the turn to hold much of a bag.
    """

    def __init__(
        self, lake: Lake, robot: str, index: LakeIndex, decoder: BagReader, large: LargeReads
    ) -> None:
        self._large = large
        self._lake = lake
        self._robot = robot
        self._index = index
        self._decoder = decoder
        self._heads: ByteLru[Sequence[_Head]] = ByteLru(_HEADS_BYTES)

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
        return self._index.bag(path).file.summary

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """Yields the messages.

        Raises:
            NotInLakeError: the lake has the times of a topic alone.
        """
        step = -1 if newest_first else 1
        batches = [*self.batches(path, topics, window)][::step]
        found = (map(batch.record, range(batch.log_times.size)[::step]) for batch in batches)
        yield from heapq.merge(*found, key=attrgetter("log_time"), reverse=newest_first)

    def batches(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        bare: Collection[str] = (),
    ) -> Iterator[Batch]:
        """Yields the messages of a channel at once.

        Raises:
            NotInLakeError: the lake has the times of a topic alone, and it is not `bare`.
        """
        here = self._index.bag(path)
        wanted = [head for head in self._heads_of(here) if head.channel.topic in topics]
        names = sorted({head.channel.topic for head in wanted})
        for head in wanted:
            topic = head.channel.topic
            if not head.has_payloads and topic not in bare:
                raise NotInLakeError(
                    f"the lake has only the times of {topic}, whose messages are large: name it in "
                    "lake.messages of ros2-memory ship, ask about other topics, or ask the robot's "
                    "own memory"
                )
            data = self._packed_of(here, head.number, names)
            if data is None:
                raise BagError(str(path), f"the lake has no messages of {topic} any more")
            if is_large(data):
                self._large.acquire()
            try:
                batch = unpacked_messages(data, head.channel)
            except ValueError as error:
                raise BagError(str(path), f"{topic} in the lake: {error}") from error
            inside = (batch.log_times >= window.start) & (batch.log_times < window.stop)
            if inside.any():
                yield batch if inside.all() else batch.taken(inside)

    def times_alone(self, path: Path) -> Collection[str]:
        """Returns the topics whose payloads were not shipped: their messages are large."""
        heads = self._heads_of(self._index.bag(path))
        return {head.channel.topic for head in heads if not head.has_payloads}

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels of which the bag has messages."""
        return [head.channel for head in self._heads_of(self._index.bag(path))]

    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded; None if its type is known."""
        return self._decoder.undecodable(channel)

    def decode(self, record: Record) -> object:
        """Decodes a message as that of a file."""
        return self._decoder.decode(record)

    def definition(self, channel: Channel) -> Definition | None:
        """Returns the fields of a channel's messages, as of that of a file."""
        return self._decoder.definition(channel)

    def _heads_of(self, bag: LakeBag) -> Sequence[_Head]:
        known = self._heads.get((bag.bag_id, bag.file.sidecar_ns))
        if known is not None:
            return known
        found: dict[str, list[_Head]] = {bag_id: [] for bag_id in bag.together}
        for row in self._select(_HEADS, bag, [*bag.together]).to_pylist():
            schema = Schema(row["type"], row["schema_encoding"], row["schema"])
            more = tuple((key, value) for key, value in json.loads(row["metadata"]))
            channel = Channel(row["topic"], row["encoding"], schema, row["latched"], more)
            head = _Head(row["channel"], shared(channel), row["has_payloads"])
            found[row["bag_id"]].append(head)
        for bag_id, heads in found.items():
            size = _HEAD_BYTES * (1 + len(heads))
            self._heads.put((bag_id, bag.together[bag_id]), heads, size)
        return found[bag.bag_id]

    def _packed_of(self, bag: LakeBag, number: int, topics: Sequence[str]) -> bytes | None:
        """Returns the packed messages of a channel; None where they are gone.

        With it those of other `topics` are read, which are asked for next. Who has read one bag
        and goes on, reads those beside it, too.
        """
        messages = self._lake.messages
        known = messages.get((bag.bag_id, bag.file.sidecar_ns, number))
        if known is None:
            beside = [messages.get((*state, number)) for state in bag.together.items()]
            bags = [*bag.together] if any(beside) else [bag.bag_id]
            for row in self._select(_PACKED, bag, bags, topics=topics).to_pylist():
                key = (row["bag_id"], bag.together[row["bag_id"]], row["channel"])
                messages.put(key, row["packed"], len(row["packed"]))
                if key == (bag.bag_id, bag.file.sidecar_ns, number):
                    known = row["packed"]
        return known

    def _select(self, sql: str, bag: LakeBag, bags: list[str], **more: Sequence[str]) -> pa.Table:
        """Returns the rows of a select over the channels of some bags of a day."""
        first, last = min(bags), max(bags)
        of_day = self._lake.days("channels", self._robot).get(bag.day, ())
        files = [file for file in of_day if file.first <= last and first <= file.last]
        asked = {"bags": bags, "first": first, "last": last, **more}
        return self._lake.select(sql, "channels", files, asked)


def lake_memory(
    lake: Lake,
    name: str,
    clock: Clock,
    limits: QuerySettings,
    *,
    extractor: SchemaExtractor,
    decoder: BagReader,
    large: LargeReads,
    store: ColumnStore | None = None,
    settings: str = "",
    refresh_s: float = 60.0,
    days: int = 31,
    most_bags: int = MOST_BAGS,
) -> Memory:
    """Returns what a bag directory's memory is, but for the index and what reads bags.

    Args:
        lake: the lake.
        name: of the robot there.
        clock: the wall clock.
        limits: the settings of queries.
        extractor: knows the types of messages.
        decoder: decodes messages.
        large: the turn to hold much of a bag.
        store: of the columns of its bags, which are made again from the lake; None for none.
        settings: what follows from bags depends on, as a text.
        refresh_s: how old (s) the index may be.
        days: how many days are looked at together, at least; see `LakeIndex`.
        most_bags: likewise, and of how many bags.
    """
    index = LakeIndex(lake, name, clock, refresh_s=refresh_s, days=days, most_bags=most_bags)
    return Memory(
        index,
        LakeReader(lake, name, index, decoder, large),
        extractor,
        clock,
        # Nothing is recorded here, and nothing deleted.
        replace(limits, kept=None, recording="", screened=False),
        Scanner(store, index.bag_dir, settings, large),
        large=large,
    )

"""Reads the messages of one robot's bags from the channels of a lake."""

from __future__ import annotations

import heapq
import json
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.columns.pack import is_large
from ros2_memory.core.errors import BagError, NotInLakeError
from ros2_memory.lake.packed_messages import unpacked_messages
from ros2_memory.lake.tables import topic_key
from ros2_memory.storage.base import BagReader, Channel, Closing, Schema
from ros2_memory.storage.cache import ByteLru, shared

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    import pyarrow as pa

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.large_reads import LargeReads
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.index import LakeBag, LakeIndex
    from ros2_memory.storage.base import Batch, Definition, Record

_HEAD_BYTES: Final = 200
_HEADS_BYTES: Final = 8 << 20
_HEADS: Final = (
    "SELECT bag_id, channel, has_payloads, metadata, type, schema_encoding, schema, topic,"
    " encoding, latched FROM channels"
    " WHERE bag_id IN $bags AND bag_id >= $first AND bag_id <= $last ORDER BY bag_id, channel"
)
_PACKED: Final = (
    "SELECT bag_id, channel, packed FROM channels WHERE topic_key IN $keys AND topic IN $topics"
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
        return self._index.bag(path)[1].summary

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
        here, _ = self._index.bag(path)
        wanted = [each for each in self._heads_of(here) if each.channel.topic in topics]
        names = sorted({each.channel.topic for each in wanted})
        for head in wanted:
            topic = head.channel.topic
            if not head.has_payloads and topic not in bare:
                raise NotInLakeError(
                    f"the lake has only the times of {topic}, whose messages are large: name it in "
                    "lake.messages of ros2-memory ship, ask about other topics, or ask the robot's "
                    "own memory"
                )
            data = self._packed_of(here, head, names)
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
        heads = self._heads_of(self._index.bag(path)[0])
        return {each.channel.topic for each in heads if not each.has_payloads}

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels of which the bag has messages."""
        return [each.channel for each in self._heads_of(self._index.bag(path)[0])]

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
        known = self._heads.get((bag.bag_id, bag.state))
        if known is not None:
            return known
        found: dict[str, list[_Head]] = {each: [] for each in bag.together}
        rows = self._select(_HEADS, bag, [*bag.together])
        columns = (column.to_pylist() for column in rows.columns)
        for bag_id, number, has_payloads, metadata, *schema, topic, encoding, latched in zip(
            *columns, strict=True
        ):
            more = tuple((key, value) for key, value in json.loads(metadata))
            channel = Channel(topic, encoding, Schema(*schema), latched, more)
            found[bag_id].append(_Head(number, shared(channel), has_payloads))
        for bag_id, heads in found.items():
            size = _HEAD_BYTES * (1 + len(heads))
            self._heads.put((bag_id, bag.together[bag_id]), heads, size)
        return found[bag.bag_id]

    def _packed_of(self, bag: LakeBag, head: _Head, topics: Sequence[str]) -> bytes | None:
        """Returns the packed messages of a channel; None where they are gone.

        With it those of other `topics` are read, which are asked for next.
        """
        key = (bag.bag_id, bag.state, head.number)
        known = self._lake.messages.get(key)
        if known is not None:
            return known
        # Who has read one bag and goes on, reads those beside it, too.
        is_second = any(
            self._lake.messages.get((bag_id, state, head.number)) is not None
            for bag_id, state in bag.together.items()
        )
        bags = [*bag.together] if is_second else [bag.bag_id]
        rows = self._select(_PACKED, bag, bags, topics)
        columns = (column.to_pylist() for column in rows.columns)
        for bag_id, number, packed in zip(*columns, strict=True):
            found = (bag_id, bag.together[bag_id], number)
            self._lake.messages.put(found, packed, len(packed))
            if found == key:
                known = packed
        return known

    def _select(
        self, sql: str, bag: LakeBag, bags: list[str], topics: Sequence[str] = ()
    ) -> pa.Table:
        first, last = min(bags), max(bags)
        of_day = self._lake.days("channels", self._robot).get(bag.day, ())
        files = [each for each in of_day if each.first <= last and first <= each.last]
        keys = [*map(topic_key, topics)]
        asked = {"bags": bags, "first": first, "last": last, "topics": topics, "keys": keys}
        return self._lake.select(sql, "channels", files, asked)

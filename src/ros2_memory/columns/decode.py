"""Decodes a bag as tables, all messages of a topic at once.

What the walk over bytes (`walk.py`) does not read, for whatever reason, goes through the reader's
decoder message by message (`objects.py`), into the same columns. No message is decoded in part.
"""

from __future__ import annotations

import zlib
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from ros2_memory.columns.objects import level_of
from ros2_memory.columns.plan import UnplannedError, plan_of
from ros2_memory.columns.table import Table, joined, order_of
from ros2_memory.columns.walk import NotWalkedError, walked
from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import BATCH_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.plan import Plan
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import BagReader, Batch, Channel, Schema

T = TypeVar("T")

GROUP_BYTES: Final = 64 << 20
"""Payloads, or tables made of them, that one group has at most, about."""
BULKY_BYTES: Final = 64 << 10
"""In large files, topics with larger messages have no columns."""
LARGE_FILE_BYTES: Final = 64 << 20
"""Files of this size, or that decompressed to it so far, count as large."""
BULKY_TYPES: Final = frozenset(
    {
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CompressedImage",
        "sensor_msgs/msg/PointCloud2",
        "sensor_msgs/msg/PointCloud",
        "stereo_msgs/msg/DisparityImage",
        "theora_image_transport/msg/Packet",
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "foxglove_msgs/msg/CompressedVideo",
    }
)
"""Images and clouds, which have no columns in any file."""
_BULKY: Final = "images, clouds and the like have no columns"
LARGEST_MESSAGE_BYTES: Final = LARGE_BYTES
"""A topic has no columns in a bag once a message of it is larger."""
_NOT_ASKED: Final = "only times were asked for"
_DECODED_BYTES: Final = 1 << 20
"""Payloads whose decoded messages are in memory at once."""
_EVERYTHING: Final = TimeWindow.everything()


def never(channel: Channel) -> bool:
    """Returns False: no payload is hashed."""
    del channel
    return False


def decoded(
    reader: BagReader,
    path: Path,
    window: TimeWindow = _EVERYTHING,
    *,
    topics: Collection[str] | None = None,
    hashed: Callable[[Channel], bool] = never,
    columns: bool = True,
    group_bytes: int = GROUP_BYTES,
) -> Iterator[list[Table]]:
    """Yields the messages of a bag as tables, in groups.

    In one group there is one table for each topic, type and definition with messages; a bag that
    decompresses to less than `group_bytes` is one group. Tables of later groups may overlap earlier
    ones in time, as the chunks of the file do. In memory are one group and one buffer of the
    reader. Lazy: nothing is opened before the first item is requested.

    Args:
        reader: reads the bag.
        path: the file.
        window: of log time.
        topics: those to decode; None for all.
        hashed: of which channels the payloads are hashed.
        columns: whether there are columns; else only the times of all messages, also of those that
            cannot be decoded.
        group_bytes: how much a group holds, about.

    Raises:
        BagVanishedError: the file is not there.
        BagError: as by `BagReader.batches`. The iterator continues behind it, with all that can be
            read.
    """

    def found() -> Iterator[list[Table] | BagError]:
        channels = [
            channel
            for channel in reader.channels(path)
            if topics is None or channel.topic in topics
        ]
        kinds = _Kinds(reader, hashed, columns)
        kinds.look_at(channels, path, window)
        alone = reader.times_alone(path)
        bare = {channel.topic for channel in channels}
        for channel in channels:
            kind = kinds.of(channel)
            # Copies of messages without a payload are recognised by their publish times.
            if kind.plan is not None or (kind.is_hashed and channel.topic not in alone):
                bare.discard(channel.topic)
        batches = reader.batches(path, {each.topic for each in channels}, window, bare=bare)
        group = _Group(kinds, group_bytes)
        while True:
            try:
                batch = next(batches)
            except StopIteration:
                break
            except BagError as error:
                yield error
                continue
            if group.is_full_before(batch):
                yield group.tables()
                group = _Group(kinds, group_bytes)
            group.add(batch)
            del batch  # and its buffer, before the next is read
        tables = group.tables()
        if tables:
            yield tables

    # Mapped outside of the generator: one that has raised could not go on behind lost messages.
    return map(_unless_error, found())


def with_all_messages(reader: BagReader, path: Path, table: Table, window: TimeWindow) -> Table:
    """Returns a table in which each message has a row, also one that cannot be decoded.

    Where there is such a message no row has columns: the bag has to be asked about each of them.
    What is lost of a bag has no rows, as in `decoded`, which raises that.

    Raises:
        BagError: none of the rest can be read.
    """
    if not table.undecodable:
        return table
    channel = table.channel
    rows: list[tuple[Ns, Ns, int]] = []
    found = reader.records(path, [channel.topic], window)
    while True:
        try:
            rows.extend(
                (record.log_time, record.publish_time, zlib.crc32(record.payload))
                for record in found
                if record.channel.schema == channel.schema
            )
            break
        except BagError as error:
            if error.lost is None:
                raise
    times, published, hashes = np.ascontiguousarray(np.array(rows, np.int64).reshape(-1, 3).T)
    return Table(
        channel,
        times,
        published,
        np.zeros(times.size, np.int64),
        left_out={"": f"some cannot be decoded: {table.undecodable_reason}"},
        payload_hashes=None if table.payload_hashes is None else hashes,
        definition=table.definition,
    )


def _unless_error(item: T | BagError) -> T:
    if isinstance(item, BagError):
        raise item
    return item


@dataclass(frozen=True, slots=True)
class _Kind:
    """How the messages of a channel are decoded; without a plan, `reason` says why they are not."""

    channel: Channel
    plan: Plan | None
    reason: str
    is_hashed: bool


@dataclass(slots=True)
class _Kinds:
    """The kinds of the channels of one bag, of which `read_bytes` were read so far."""

    reader: BagReader
    hashed: Callable[[Channel], bool]
    columns: bool
    read_bytes: int = 0
    # By identity, since hashing a channel hashes its definition.
    _known: dict[int, _Kind] = field(default_factory=dict)
    _bulky: set[str] = field(default_factory=set)

    def look_at(self, channels: Sequence[Channel], path: Path, window: TimeWindow) -> None:
        """Finds the topics of a large file that have large messages, by the newest of each."""
        size = 0
        if not self.columns:
            return
        with suppress(OSError):
            size = path.stat().st_size
        if size <= LARGE_FILE_BYTES:
            return
        for channel in channels:
            if self._plan(channel)[0] is None:
                continue
            with suppress(BagError):
                newest = self.reader.newest(path, channel.topic, window)
                if newest is not None and len(newest.payload) > BULKY_BYTES:
                    self._bulky.add(channel.topic)

    def of(self, channel: Channel) -> _Kind:
        """Returns the kind of a channel."""
        known = self._known.get(id(channel))
        if known is None:
            plan, reason = self._plan(channel)
            known = _Kind(channel, plan, reason, self.hashed(channel))
            self._known[id(channel)] = known
        return known

    def leave_out_large(self, batch: Batch) -> None:
        """Has no more columns made of a channel with large messages."""
        most = LARGEST_MESSAGE_BYTES if self.read_bytes <= LARGE_FILE_BYTES else BULKY_BYTES
        kind = self.of(batch.channel)
        if kind.plan is not None and batch.sizes.max() > most:
            self._known[id(batch.channel)] = replace(kind, plan=None, reason=_BULKY)

    def _plan(self, channel: Channel) -> tuple[Plan | None, str]:
        if not self.columns:
            return None, _NOT_ASKED
        if channel.type in BULKY_TYPES or channel.topic in self._bulky:
            return None, _BULKY
        definition = self.reader.definition(channel)
        if definition is None:
            reason = self.reader.undecodable(channel)
            return None, reason or f"messages encoded as {channel.encoding} have no columns"
        if definition.type in BULKY_TYPES:
            return None, _BULKY
        try:
            return plan_of(definition), ""
        except UnplannedError as error:
            return None, str(error)


@dataclass(slots=True)
class _Group:
    """The tables of some buffers, while they are read."""

    kinds: _Kinds
    limit: int
    _parts: dict[tuple[str, str, Schema], list[Table]] = field(default_factory=dict)
    _buffer: bytes = b""
    _bytes: int = 0

    def is_full_before(self, batch: Batch) -> bool:
        """Returns whether a batch belongs to the next group: only with a buffer one begins."""
        if batch.buffer is self._buffer or not self._parts:
            return False
        size = self._bytes + len(batch.buffer)
        if size <= self.limit and size > self.limit // 4:
            size = sum(part.memory_bytes for parts in self._parts.values() for part in parts)
        return size > self.limit

    def add(self, batch: Batch) -> None:
        """Decodes a batch."""
        if batch.buffer is not self._buffer:
            self._buffer = batch.buffer
            self._bytes += len(batch.buffer)
            self.kinds.read_bytes += len(batch.buffer)
        if not batch.sizes.size:
            return
        channel = batch.channel
        parts = self._parts.setdefault((channel.topic, channel.encoding, channel.schema), [])
        self.kinds.leave_out_large(batch)
        for piece in _pieces(batch):
            self._add(parts, _table(self.kinds, piece))

    def _add(self, parts: list[Table], table: Table) -> None:
        """Adds a table to those of its topic, of which all have columns or none has."""
        if "" in table.left_out and parts and "" not in parts[0].left_out:
            parts[:] = [
                replace(part, columns={}, elements={}, left_out=table.left_out) for part in parts
            ]
        elif parts and "" in parts[0].left_out:
            table = replace(table, columns={}, elements={}, left_out=parts[0].left_out)
        parts.append(table)

    def tables(self) -> list[Table]:
        """Returns the tables, each of all its parts."""
        self._buffer = b""
        found = []
        while self._parts:
            _, parts = self._parts.popitem()
            found.append(joined(parts))
        return found[::-1]


def _pieces(batch: Batch) -> Iterator[Batch]:
    """Yields a batch of a large chunk in pieces: to walk one takes some times its bytes."""
    if batch.sizes.sum() <= BATCH_BYTES:
        yield batch
        return
    numbers = np.cumsum(batch.sizes) // BATCH_BYTES
    for rows in np.split(np.arange(numbers.size), np.flatnonzero(np.diff(numbers)) + 1):
        yield batch.taken(rows)


def _table(kinds: _Kinds, batch: Batch) -> Table:
    """Returns the messages of a batch as a table."""
    kind = kinds.of(batch.channel)
    order = order_of(batch.log_times, batch.places)
    if order is not None:
        batch = batch.taken(order)
    definition = kinds.reader.definition(batch.channel)
    table = Table(
        batch.channel,
        batch.log_times,
        batch.publish_times,
        batch.places,
        definition=definition,
    )
    if kind.is_hashed:
        hashes = [zlib.crc32(batch.payload(nth)) for nth in range(len(table))]
        table = replace(table, payload_hashes=np.array(hashes, np.int64))
    if kind.plan is None:
        return replace(table, left_out={"": kind.reason})
    try:
        level = walked(kind.plan, batch)
    except NotWalkedError:
        return joined(list(_one_by_one(kinds.reader, kind.plan, batch, table)))
    return replace(table, columns=level.columns, elements=level.elements, left_out=level.left_out)


def _one_by_one(reader: BagReader, plan: Plan, batch: Batch, table: Table) -> Iterator[Table]:
    """Yields parts of a table whose messages the reader decodes."""
    begin = 0
    count = len(table)
    sizes = batch.sizes.tolist()
    while begin < count:
        messages: list[object] = []
        rows: list[int] = []
        reason = ""
        size, nth = 0, begin
        while nth < count and (nth == begin or size + sizes[nth] <= _DECODED_BYTES):
            try:
                messages.append(reader.decode(batch.record(nth)))
                rows.append(nth)
            except UndecodableError as error:
                reason = reason or error.reason
            size += sizes[nth]
            nth += 1
        level = level_of(plan, messages)
        yield replace(
            table.rows(np.array(rows, np.int64)),
            columns=level.columns,
            elements=level.elements,
            left_out=level.left_out,
            undecodable=nth - begin - len(rows),
            undecodable_reason=reason,
        )
        begin = nth

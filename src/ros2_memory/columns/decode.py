"""Decodes a bag as tables, all messages of a topic at once.

The walk over bytes (`walk.py`) reads a batch of messages whole or not at all. Batches that it does
not read go through the reader's decoder message by message (`_level_of`), into the same columns.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.plan import (
    Array,
    Number,
    NumberSequence,
    Plan,
    Run,
    Text,
    Time,
    UnplannedError,
    plan_of,
)
from ros2_memory.columns.table import (
    MAX_NUMBERS,
    MAX_RANGED_BYTES,
    UNHASHED,
    Numbers,
    Table,
    Texts,
    join_tables,
    order_of,
)
from ros2_memory.columns.walk import (
    LevelColumns,
    NotWalkedError,
    add_array,
    add_sequence,
    read_columns,
)
from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.storage.base import (
    BATCH_BYTES,
    BagReader,
    Batch,
    Channel,
    Definition,
    IntArray,
    Mask,
    Schema,
    errors_as_items,
    raise_if_error,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

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
_HELD_BYTES: Final = LARGE_BYTES
"""Bytes of buffers that wait in a group to be decoded together."""
LARGEST_MESSAGE_BYTES: Final = LARGE_BYTES
"""A topic has no columns in a bag once a message of it is larger."""
_NOT_ASKED: Final = "only times were asked for"
_UNDECODABLE: Final = "some cannot be decoded"
"""Without the error, which differs from bag to bag: parts are joined by this reason."""
_DECODED_BYTES: Final = 1 << 20
"""Payloads whose decoded messages are in memory at once."""
_EVERYTHING: Final = TimeWindow.everything()


class _Kind(NamedTuple):
    """How the messages of a channel are decoded.

    Attributes:
        first: the bag's first channel of the same topic, type and definition.
        definition: the fields of the messages; None if they are not known.
        plan: how payloads are read; None if the messages have no columns.
        reason: why they have no columns.
        is_hashed: whether payloads are hashed.
    """

    first: Channel
    definition: Definition | None
    plan: Plan | None
    reason: str
    is_hashed: bool


def undecoded(
    reader: BagReader,
    path: Path,
    window: TimeWindow = _EVERYTHING,
    *,
    topics: Collection[str] | None = None,
    hashed: Callable[[Channel], bool] = lambda _: False,
    columns: bool = True,
    skip_undecodable: bool = False,
    number: int = 0,
    most_numbers: int = MAX_NUMBERS,
) -> Iterator[Group]:
    """Yields the messages of a bag in groups, for `Group.tables`.

    A bag whose messages and tables take less than `GROUP_BYTES` is one group. A group has one table
    for each topic, type and definition. Tables of later groups may overlap earlier ones in time, as
    the chunks of the file do, but all messages of one log time are in one table.

    The iterator is lazy: it opens the file when the first group is requested, and has one group and
    one buffer of the reader in memory.

    Args:
        reader: reads the bag.
        path: the file.
        window: of log time.
        topics: the topics to decode; None for all.
        hashed: returns whether the payloads of a channel are hashed.
        columns: whether to decode messages; else tables have only the times of all messages.
        skip_undecodable: whether messages that cannot be decoded are left out. If not, one of them
            leaves its topic without columns in this group.
        number: the number of the bag in the tables.
        most_numbers: the longest sequences of numbers that have elements.

    Raises:
        BagVanishedError: the file is not there.
        BagError: as by `BagReader.batches`. The iterator continues behind the error, with all that
            can be read.
    """

    def read() -> Iterator[Group | BagError]:
        channels = reader.channels(path)
        if topics is not None:
            channels = [channel for channel in channels if channel.topic in topics]
        wanted = {channel.topic for channel in channels}
        kinds = _Kinds(reader, hashed, columns, most_numbers)
        kinds.find_bulky(channels, path, window)
        bare = wanted - kinds.topics_with_payload(channels, reader.times_alone(path))
        group = Group(reader, skip_undecodable)
        for batch in errors_as_items(reader.batches(path, wanted, window, bare=bare)):
            if isinstance(batch, BagError):
                yield batch
            elif batch.sizes.size:
                if group.is_full_before(batch):
                    full = group
                    group = full.split_off_last()
                    yield full
                    del full
                group.add(_Undecoded(kinds.of_batch(batch), batch, number))
            del batch  # and its buffer, before the next is read
        if group.has_messages:
            yield group

    # Mapped outside of the generator: one that has raised could not go on behind lost messages.
    return map(raise_if_error, read())


@dataclass(slots=True)
class _Kinds:
    """Decides how the channels of one bag are decoded, while the bag is read."""

    reader: BagReader
    hashed: Callable[[Channel], bool]
    columns: bool
    most_numbers: int
    _buffer: bytes = b""
    _read_bytes: int = 0
    _firsts: dict[tuple[Schema, str, str], Channel] = field(default_factory=dict)
    # By identity, since hashing a channel hashes its definition.
    _known: dict[int, _Kind] = field(default_factory=dict)
    _bulky: set[str] = field(default_factory=set)

    def find_bulky(self, channels: Sequence[Channel], path: Path, window: TimeWindow) -> None:
        """Finds the topics of a large file that have large messages, by their newest message."""
        try:
            is_large = self.columns and path.stat().st_size > LARGE_FILE_BYTES
        except OSError:
            return
        for channel in channels if is_large else ():
            if self._plan(channel, self.reader.definition(channel))[0] is not None:
                with suppress(BagError):
                    records = self.reader.records(path, [channel.topic], window, newest_first=True)
                    newest = next(records, None)
                    if newest is not None and len(newest.payload) > BULKY_BYTES:
                        self._bulky.add(channel.topic)

    def topics_with_payload(
        self, channels: Sequence[Channel], times_alone: Collection[str]
    ) -> set[str]:
        """Returns the topics whose payloads are needed, for columns or for hashes.

        Args:
            channels: of the bag.
            times_alone: topics of which only the publish times tell copies.
        """
        topics: set[str] = set()
        for channel in channels:
            kind = self.of(channel)
            if kind.plan is not None or (kind.is_hashed and channel.topic not in times_alone):
                topics.add(channel.topic)
        return topics

    def of(self, channel: Channel) -> _Kind:
        """Returns how the messages of a channel are decoded."""
        kind = self._known.get(id(channel))
        if kind is None:
            definition = self.reader.definition(channel)
            plan, reason = self._plan(channel, definition)
            named = (channel.schema, channel.encoding, channel.topic)
            first = self._firsts.setdefault(named, channel)
            kind = _Kind(first, definition, plan, reason, self.hashed(channel))
            self._known[id(channel)] = kind
        return kind

    def of_batch(self, batch: Batch) -> _Kind:
        """Returns how a batch is decoded.

        From the first message on that is too large, a channel has no columns.
        """
        if batch.buffer is not self._buffer:
            self._buffer = batch.buffer
            self._read_bytes += len(batch.buffer)
        most = LARGEST_MESSAGE_BYTES if self._read_bytes <= LARGE_FILE_BYTES else BULKY_BYTES
        kind = self.of(batch.channel)
        if kind.plan is not None and batch.sizes.max() > most:
            kind = self._known[id(batch.channel)] = kind._replace(plan=None, reason=_BULKY)
        return kind

    def _plan(self, channel: Channel, definition: Definition | None) -> tuple[Plan | None, str]:
        """Returns the plan of a channel, or None and the reason why it has no columns."""
        if not self.columns:
            return None, _NOT_ASKED
        if channel.type in BULKY_TYPES or channel.topic in self._bulky:
            return None, _BULKY
        if definition is None:
            reason = self.reader.undecodable(channel)
            return None, reason or f"messages encoded as {channel.encoding} have no columns"
        if definition.type in BULKY_TYPES:
            return None, _BULKY
        try:
            return plan_of(definition, self.most_numbers), ""
        except UnplannedError as error:
            return None, str(error)


_Key: TypeAlias = tuple[str, str, bool, Schema]
"""A topic, its encoding, whether it is latched, and its definition."""


class _Undecoded(NamedTuple):
    """A batch, how it is decoded, and the number of its bag."""

    kind: _Kind
    batch: Batch
    bag: int


@dataclass(slots=True)
class Group:
    """Messages of one bag or of several, of which each topic is decoded at once.

    Attributes:
        reader: of the bags.
        skip_undecodable: as for `undecoded`.
        memory_bytes: the memory of the tables that are decoded so far.
    """

    reader: BagReader
    skip_undecodable: bool = False
    memory_bytes: int = 0
    _tables: dict[_Key, list[Table]] = field(default_factory=dict)
    _waiting: list[_Undecoded] = field(default_factory=list)
    _waiting_bytes: int = 0
    _buffer: bytes = b""
    _bytes: int = 0

    @property
    def has_messages(self) -> bool:
        """Whether the group has any messages."""
        return bool(self._waiting or self._tables)

    def is_full_before(self, batch: Batch) -> bool:
        """Returns whether a batch begins the next group; only the first batch of a buffer may."""
        if batch.buffer is self._buffer or not self.has_messages:
            return False
        # Tables may take more than the payloads.
        return max(self._bytes + len(batch.buffer), self.memory_bytes) > GROUP_BYTES

    def add(self, undecoded: _Undecoded) -> None:
        """Adds a batch; decodes the waiting ones first if all would take too much memory."""
        buffer = undecoded.batch.buffer
        if buffer is not self._buffer:
            if self._waiting_bytes + len(buffer) > _HELD_BYTES:
                self._decode()
            self._buffer = buffer
            self._bytes += len(buffer)
            self._waiting_bytes += len(buffer)
        for piece in _pieces_of(undecoded.batch):
            self._waiting.append(undecoded._replace(batch=piece))
            if len(buffer) > _HELD_BYTES:
                self._decode()

    def take(self, other: Group) -> None:
        """Adds all messages of another bag."""
        # Decoded ones before those that wait: `join_tables` puts rows in order of time.
        for key, tables in other._tables.items():
            self._tables.setdefault(key, []).extend(tables)
        self.memory_bytes += other.memory_bytes
        for undecoded in other._waiting:
            self.add(undecoded)

    def split_off_last(self) -> Group:
        """Moves the messages of each topic's last log time to the next group, which it returns.

        Messages of one log time are numbered within a table, so they must not be in two. If they
        take too much memory they stay.
        """
        self._decode()
        following = Group(self.reader, self.skip_undecodable)
        room = GROUP_BYTES // 4
        for key, parts in self._tables.items():
            [table] = _join_alike(parts)  # of one bag
            begin = int(np.searchsorted(table.log_times, table.log_times[-1]))
            last = table.rows(np.arange(begin, len(table)))
            if last.memory_bytes <= room:
                room -= last.memory_bytes
                following._tables[key] = [last]
                following.memory_bytes += last.memory_bytes
                table = table.rows(np.arange(begin))
            parts[:] = [table]
        return following

    def tables(self) -> list[Table]:
        """Returns the messages as tables, and empties the group."""
        self._decode()
        self._buffer = b""
        tables: list[Table] = []
        while self._tables:
            _, parts = self._tables.popitem()
            tables += _join_alike(parts)[::-1]
        return [table for table in reversed(tables) if len(table)]

    def _decode(self) -> None:
        """Decodes the batches that wait, all messages of a topic at once."""
        waiting, self._waiting, self._waiting_bytes = self._waiting, [], 0
        buffers = {id(batch.buffer): batch.buffer for _, batch, _ in waiting}
        begins = dict(zip(buffers, accumulate(map(len, buffers.values()), initial=0), strict=False))
        buffer = b"".join(buffers.values())
        alike: dict[tuple[_Key, Plan | None, str], list[_Undecoded]] = defaultdict(list)
        for undecoded in waiting:
            first, _, plan, reason, _ = undecoded.kind
            key = (first.topic, first.encoding, first.latched, first.schema)
            alike[key, plan, reason].append(undecoded)
        for (key, _, _), of_topic in alike.items():
            for table in self._decode_alike(of_topic, buffer, begins):
                if len(table):  # else no message could be decoded
                    self.memory_bytes += table.memory_bytes
                    self._tables.setdefault(key, []).append(table)

    def _decode_alike(
        self, waiting: Sequence[_Undecoded], buffer: bytes, begins: Mapping[int, int]
    ) -> list[Table]:
        """Returns the tables of batches of one topic and plan.

        The reader decodes messages that cannot be walked.

        Args:
            waiting: the batches.
            buffer: all buffers, one after the other.
            begins: where each buffer begins in it, by the identity of the buffer.
        """
        kind = waiting[0].kind
        batch, bags, is_hashed = _as_one(waiting, buffer, begins)
        hashes = _payload_hashes(batch, is_hashed) if is_hashed.any() else None
        table = Table(
            kind.first,
            batch.log_times,
            batch.publish_times,
            batch.places,
            left_out={"": kind.reason},
            payload_hashes=hashes,
            define=lambda: kind.definition,
            bags=bags,
        )
        if kind.plan is None:
            return [table]
        try:
            return [_with_columns(table, read_columns(kind.plan, batch))]
        except NotWalkedError:
            if len(waiting) > 1:  # other batches may be walked
                tables: list[Table] = []
                for undecoded in waiting:
                    tables += self._decode_alike([undecoded], buffer, begins)
                return tables
        try:
            pieces = _one_by_one(self.reader, kind.plan, batch, table, skip=self.skip_undecodable)
            return [join_tables([*pieces])]
        except UndecodableError:
            return [table.without_columns(_UNDECODABLE)]


def _pieces_of(batch: Batch) -> Iterator[Batch]:
    """Yields a large batch in pieces: to walk a batch takes several times its bytes."""
    if batch.sizes.sum() <= BATCH_BYTES:
        yield batch
        return
    numbers = np.cumsum(batch.sizes) // BATCH_BYTES
    for rows in np.split(np.arange(numbers.size), np.flatnonzero(np.diff(numbers)) + 1):
        yield batch.select(rows)


def _as_one(
    waiting: Sequence[_Undecoded], buffer: bytes, begins: Mapping[int, int]
) -> tuple[Batch, IntArray, Mask]:
    """Returns batches as one in a common buffer, in order of log time.

    Behind it the number of each message's bag, and whether the message is hashed.
    """
    batches = [batch for _, batch, _ in waiting]
    counts = [batch.sizes.size for batch in batches]
    batch = Batch(
        batches[0].channel,
        np.concatenate([batch.log_times for batch in batches]),
        np.concatenate([batch.publish_times for batch in batches]),
        np.concatenate([batch.places for batch in batches]),
        buffer,
        np.concatenate([batch.starts + begins[id(batch.buffer)] for batch in batches]),
        np.concatenate([batch.sizes for batch in batches]),
    )
    bags = np.repeat([bag for _, _, bag in waiting], counts)
    is_hashed = np.repeat([kind.is_hashed for kind, _, _ in waiting], counts)
    order = order_of(batch.log_times, bags, batch.places)
    if order is None:
        return batch, bags, is_hashed
    return batch.select(order), bags[order], is_hashed[order]


def _payload_hashes(batch: Batch, is_hashed: Mask) -> IntArray:
    """Returns the CRC-32 of each payload that is hashed, `UNHASHED` of the others."""
    hashes = np.full(is_hashed.size, UNHASHED)
    starts, sizes = batch.starts[is_hashed], batch.sizes[is_hashed]
    spans = zip(starts.tolist(), (starts + sizes).tolist(), strict=True)
    hashes[is_hashed] = [zlib.crc32(batch.buffer[begin:end]) for begin, end in spans]
    return hashes


def _join_alike(parts: Sequence[Table]) -> list[Table]:
    """Returns tables of one topic and definition, joined where they have the same columns.

    If some rows of a bag have no columns, the others lose theirs.
    """
    if len({part.left_out.get("") for part in parts}) == 1:
        return [join_tables(parts)]
    reason_of: dict[int, str] = {}  # why a bag has no columns
    for part in parts:
        if "" in part.left_out:
            for number in np.unique(part.bag_numbers).tolist():
                reason_of.setdefault(number, part.left_out[""])
    by_reason: dict[str | None, list[Table]] = defaultdict(list)
    for part in parts:
        for number in np.unique(part.bag_numbers).tolist():
            rows = part.rows(np.flatnonzero(part.bag_numbers == number))
            reason = reason_of.get(number)
            by_reason[reason].append(rows if reason is None else rows.without_columns(reason))
    return [*map(join_tables, by_reason.values())]


def _with_columns(table: Table, level: LevelColumns) -> Table:
    return replace(table, columns=level.columns, elements=level.elements, left_out=level.left_out)


def _one_by_one(
    reader: BagReader, plan: Plan, batch: Batch, table: Table, *, skip: bool
) -> Iterator[Table]:
    """Yields pieces of a table whose messages the reader decodes.

    Raises:
        UndecodableError: a message cannot be decoded, and such messages are not skipped.
    """
    ends = np.cumsum(batch.sizes)
    begin = 0
    while begin < len(table):
        before = int(ends[begin - 1]) if begin else 0
        end = int(np.searchsorted(ends, before + _DECODED_BYTES, side="right"))
        end = max(end, begin + 1)  # a larger message is decoded alone
        messages: list[object] = []
        rows: list[int] = []
        for row in range(begin, end):
            try:
                messages.append(reader.decode(batch.record(row)))
                rows.append(row)
            except UndecodableError:
                if not skip:
                    raise
        yield _with_columns(table.rows(np.array(rows, np.int64)), _level_of(plan, messages))
        begin = end


# Messages that the reader decoded one by one


def _level_of(plan: Plan, messages: Sequence[object]) -> LevelColumns:
    """Returns the columns of decoded messages of one type, in the steps of its plan."""
    level = LevelColumns(left_out=dict(plan.left_out))
    for step in plan.steps:
        if isinstance(step, Run):
            for entry in step.fields:
                _add_fixed(level, entry, messages)
            continue
        values = _values(messages, step.attribute)
        if isinstance(step, Text):
            level.columns[step.path] = Texts.of([*map(str, values)])
        elif isinstance(step, NumberSequence):
            arrays = [*map(_numbers, values)]
            counts = np.array([array.size for array in arrays], np.int64)
            looked_at = [array for array in arrays if array.size * step.size <= MAX_RANGED_BYTES]
            numbers = np.concatenate([np.zeros(0, step.dtype), *looked_at]).astype(step.dtype)
            add_sequence(level, step, counts, numbers)
        else:
            lists = [value if isinstance(value, list) else [] for value in values]
            inner = _level_of(step.plan, [*chain.from_iterable(lists)])
            level.add_elements(step.path, np.array([*map(len, lists)], np.int64), inner)
    return level


def _values(messages: Sequence[object], attribute: str) -> Sequence[object]:
    """Returns a field of all messages; "" stands for the messages themselves."""
    return [*map(attrgetter(attribute), messages)] if attribute else messages


def _add_fixed(
    level: LevelColumns, entry: Number | Time | Array, messages: Sequence[object]
) -> None:
    values = _values(messages, entry.attribute)
    if isinstance(entry, Time):
        seconds, rest = (np.array(_values(values, name), np.int64) for name in ("sec", "nanosec"))
        level.columns[entry.path] = seconds * NS_PER_S + rest
    elif isinstance(entry, Array):
        arrays = np.array([*map(_numbers, values)]) if entry.is_ranged else None
        add_array(level.columns, entry, len(values), arrays)
    else:
        if entry.nth is not None:
            values = [_numbers(value)[entry.nth] for value in values]
        dtype = np.dtype(np.bool_) if entry.is_bool else entry.dtype
        level.columns[entry.path] = np.array(values, dtype)


def _numbers(value: object) -> Numbers:
    return value if isinstance(value, np.ndarray) else np.array(value)

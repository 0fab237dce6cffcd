"""Reads the messages of many chunks at once, with numpy, as `BagReader.batches` yields them.

A handful of array operations reads the message indexes of a group of chunks, compares them with the
records and splits them by channel. One chunk and channel at a time takes three times as long: a bag
of 10 s has some 200 indexes of a few messages each. Whatever does not fit raises `UnreadableError`;
`McapBags` then reads the same chunks one by one, and finds out which is damaged.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from ros2_memory.core.arrays import gathered, run_starts
from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.base import BATCH_BYTES, Batch, Channel, IntArray, batched
from ros2_memory.storage.errors import SizeLimit, UnreadableError, as_unreadable
from ros2_memory.storage.mcap.chunk import (
    Chunk,
    MessageTable,
    chunk_body,
    decompressed_chunk,
    index_behind,
    index_groups,
    read_indexes,
    walk_chunk,
)
from ros2_memory.storage.mcap.index import OTHER_DECLARED
from ros2_memory.storage.mcap.records import CHUNK, MESSAGE, MESSAGE_FIELDS, RECORD
from ros2_memory.storage.zstd_bag import FRAME_MAGIC, Uncompressed

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.storage.file_io import OpenFile
    from ros2_memory.storage.mcap.records import Declarations

MAX_GROUP_CHUNKS: Final = 4096
_UINT32: Final = np.dtype("<u4")
_MAGIC: Final = int.from_bytes(FRAME_MAGIC, "little")
_CHUNK_STEP: Final = 5
"""Two chunks begin at least 1 << 5 = 32 bytes apart in their file."""
_PLACE_BITS: Final = 29
"""Offsets in a decompressed chunk have at most so many bits: it has 512 MiB or less."""


def first_place(chunk: Chunk) -> int:
    """Returns the place in the file order of a message at the offset 0 in the chunk."""
    return chunk.offset >> _CHUNK_STEP << _PLACE_BITS


class ReadChunks(NamedTuple):
    """Chunks that were read together.

    Attributes:
        chunks: at least one.
        buffer: their decompressed records.
        sizes: how many bytes of the buffer each chunk has; empty if they cannot be read.
        indexes: the bytes of the message indexes behind each chunk.
    """

    chunks: Sequence[Chunk]
    buffer: bytes
    sizes: Sequence[int]
    indexes: Sequence[bytes] = ()

    @property
    def is_read(self) -> bool:
        """Whether they can be read."""
        return bool(self.sizes)


def read_groups(file: OpenFile, chunks: Sequence[Chunk], limit: SizeLimit) -> Iterator[ReadChunks]:
    """Yields chunks, decompressed in groups of up to `BATCH_BYTES`.

    A larger chunk comes alone, and so does one that cannot be read.

    Raises:
        OSError, MemoryError: the disk or the machine fails.
        EpisodicError: as `limit.take_turn` raises it; large groups call that.
    """
    begin = 0
    while begin < len(chunks):
        group = _read_group(file, chunks[begin : begin + MAX_GROUP_CHUNKS], limit)
        begin += len(group.chunks)
        yield group
        del group  # before the next is read


def _read_group(file: OpenFile, chunks: Sequence[Chunk], limit: SizeLimit) -> ReadChunks:
    """Reads the first of some chunks, up to `BATCH_BYTES` or a chunk that cannot be read."""
    parts: list[bytes] = []
    indexes: list[bytes] = []
    size = 0
    # The caller reads a chunk that fails again, which reports the reason.
    with suppress(UnreadableError), as_unreadable():
        for chunk in chunks:
            body = chunk_body(file, chunk.offset, chunk.length, limit)
            _, _, stated_size, _, _ = CHUNK.unpack_from(body)
            if parts and size + stated_size > BATCH_BYTES:
                break
            part = decompressed_chunk(body, limit)
            size += len(part)
            if size > LARGE_BYTES:
                limit.take_turn()
            parts.append(part)
            indexes.append(index_behind(file, chunk))
            if size >= BATCH_BYTES:
                break
    if not parts:
        return ReadChunks(chunks[:1], b"", ())
    buffer = parts[0] if len(parts) == 1 else b"".join(parts)
    return ReadChunks(chunks[: len(parts)], buffer, [len(part) for part in parts], indexes)


_MESSAGE: Final = int(Opcode.MESSAGE)
_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<i8"),
        ("publish_time", "<i8"),
    ],
    align=False,
)
"""The heads of message records: all but their payloads."""
_NOT_THERE: Final = "damaged: a message is not where its index says"


def message_heads(
    content: ReadChunks, messages: MessageTable
) -> tuple[IntArray, np.ndarray[tuple[int], np.dtype[np.void]]]:
    """Returns where messages begin in the buffer of decompressed chunks, and their heads.

    Compares each message with its record. Together with the number of messages, which `mcap.index`
    compares with the statistics, this proves that all messages of these channels are there:
    checksums protect the records.

    Raises:
        UnreadableError: a message is not there, has another channel or log time, ends past its
            chunk, or is there twice.
    """
    chunk_ends = np.cumsum(np.array(content.sizes))
    chunk_begins = chunk_ends - np.array(content.sizes)
    at = messages.offsets + chunk_begins[messages.chunks]
    last = len(content.buffer) - _HEAD.itemsize
    # Offsets are checked, too: their sum with the begin of the chunk may have wrapped.
    offsets = messages.offsets
    if at.size and (offsets.min() < 0 or max(offsets.max(), at.max()) > last):
        raise UnreadableError(_NOT_THERE)
    heads = gathered(content.buffer, _HEAD, at)
    longest = chunk_ends[messages.chunks] - at - RECORD.size
    if (
        (heads["opcode"] != _MESSAGE).any()
        or (heads["channel"] != messages.channels).any()
        or (heads["log_time"] != messages.times).any()
        or (heads["length"] < MESSAGE_FIELDS).any()
        or (heads["length"] > longest).any()
    ):
        raise UnreadableError(_NOT_THERE)
    ordered = np.sort(at)
    if (ordered[1:] == ordered[:-1]).any():
        raise UnreadableError("damaged: a message index holds a message twice")
    return at, heads


def require_declared(content: ReadChunks, declared: Declarations) -> None:
    """Checks that the indexes have all messages of chunks, and the summary section all channels.

    Only the bytes between messages are walked.

    Args:
        content: the chunks.
        declared: the schemas and channels of the summary section.

    Raises:
        UnreadableError: a message or a declaration is missing there.
    """
    with as_unreadable():
        at, heads = message_heads(content, read_indexes(content.chunks, content.indexes))
        chunk_ends = np.cumsum(content.sizes)
        begins = np.concatenate([[0], chunk_ends[:-1], at + RECORD.size + heads["length"]])
        ends = np.concatenate([at, chunk_ends])
        begins.sort()
        ends.sort()
        if (begins > ends).any():
            raise UnreadableError(_NOT_THERE)
        is_gap = begins < ends
        for begin, end in zip(begins[is_gap].tolist(), ends[is_gap].tolist(), strict=True):
            walked = walk_chunk(content.buffer[begin:end])
            if walked.message_count:
                raise UnreadableError("damaged: a chunk holds messages that its indexes do not")
            for opcode, body in walked.declarations:
                if not declared.agrees(opcode, body):
                    raise UnreadableError(OTHER_DECLARED)


class _Payloads(NamedTuple):
    """Publish times and payloads of messages; the fields are those of `Batch`."""

    publish_times: IntArray
    buffer: bytes
    starts: IntArray
    sizes: IntArray


def batches_of(
    content: ReadChunks,
    messages: MessageTable,
    channels: Mapping[int, Channel],
    window: TimeWindow,
    uncompressed: Uncompressed,
) -> Iterator[Batch]:
    """Returns the messages of some channels in decompressed chunks, compared with the records.

    Args:
        content: the chunks.
        messages: all messages of these channels in the chunks.
        channels: the wanted channels by their number.
        window: of log time.
        uncompressed: undoes the compression of single messages.

    Raises:
        UnreadableError: a message is not in the records, or ends past its chunk.
    """
    if not messages.times.size:
        return iter(())
    at, heads = message_heads(content, messages)
    order = _by_channel(messages, window)
    messages = messages.select(order)
    stated, logged = heads["publish_time"][order], messages.times
    # An unsigned time past the signed range has become negative. Some writers write 0 for unknown.
    published = np.where((stated <= 0) | (stated == MAX_NS), logged, stated)
    sizes = heads["length"] - MESSAGE_FIELDS  # an aligned copy: taking rows of it is faster
    payloads = _Payloads(published, content.buffer, at[order] + MESSAGE.size, sizes[order])
    batches = _batch_by_channel(messages, content.chunks, channels, payloads)
    if not _has_frames(payloads.buffer, payloads.starts, payloads.sizes):
        return batches
    return chain.from_iterable(_uncompressed(batch, uncompressed) for batch in batches)


def _batch_by_channel(
    messages: MessageTable,
    chunks: Sequence[Chunk],
    channels: Mapping[int, Channel],
    payloads: _Payloads,
) -> Iterator[Batch]:
    """Yields a batch for each channel.

    Args:
        messages: messages of the chunks, channel by channel.
        chunks: the chunks.
        channels: the channels by number.
        payloads: the payloads of the messages.
    """
    numbers, times = messages.channels, messages.times
    first_places = np.array([first_place(chunk) for chunk in chunks])
    places = messages.offsets + first_places[messages.chunks]
    for first, last in pairwise([*run_starts(numbers).tolist(), numbers.size]):
        rows = slice(first, last)
        yield Batch(
            channels[int(numbers[first])],
            times[rows],
            payloads.publish_times[rows],
            places[rows],
            payloads.buffer,
            payloads.starts[rows],
            payloads.sizes[rows],
        )


def _by_channel(messages: MessageTable, window: TimeWindow) -> IntArray:
    """Returns the rows of the messages inside a window, channel by channel."""
    order: IntArray = np.argsort(messages.channels, kind="stable")
    is_inside = window.holding(messages.times)
    return order if is_inside.all() else order[is_inside[order]]


def _uncompressed(batch: Batch, uncompressed: Uncompressed) -> Iterator[Batch]:
    """Yields a batch, or several if rosbag2 compressed its messages."""
    has_frames = _has_frames(batch.buffer, batch.starts, batch.sizes)
    if batch.channel.encoding != "cdr" or not has_frames:
        yield batch
        return
    records = map(batch.record, range(batch.sizes.size))
    plain = (
        record._replace(payload=uncompressed(batch.channel, record.payload)) for record in records
    )
    yield from batched(zip(batch.places.tolist(), plain, strict=True))


def _has_frames(buffer: bytes, starts: IntArray, sizes: IntArray) -> bool:
    """Returns whether one of the payloads begins with the magic of a zstd frame."""
    starts = starts[sizes >= len(FRAME_MAGIC)]
    return bool((gathered(buffer, _UINT32, starts) == _MAGIC).any())


def bare_batches(
    file: OpenFile, chunks: Sequence[Chunk], channels: Mapping[int, Channel], window: TimeWindow
) -> Iterator[Batch]:
    """Yields messages with empty payloads, by the message indexes alone; reads no chunk.

    Raises:
        UnreadableError: the indexes are not those that the chunk indexes name.
    """
    for group, indexes in index_groups(file, chunks):
        messages = read_indexes(group, indexes, channels)
        messages = messages.select(_by_channel(messages, window))
        zeros = np.zeros(messages.times.size, np.int64)
        payloads = _Payloads(messages.times, b"", zeros, zeros)
        yield from _batch_by_channel(messages, group, channels, payloads)

"""Reads the messages of many chunks at once, with numpy, as `BagReader.batches` yields them.

The message indexes of all chunks of a group are read, compared with the records and cut into
channels by a handful of array operations: chunk by chunk and channel by channel, a bag of 10 s has
some 200 indexes of a few messages each, and takes three times as long. Whatever does not fit raises
`UnreadableError`; `McapBags` then reads the same chunks one by one, and finds out which is damaged.
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
from ros2_memory.storage.base import BATCH_BYTES, Batch, Channel, IntArray, Mask, batched
from ros2_memory.storage.errors import SizeLimit, UnreadableError, as_unreadable
from ros2_memory.storage.mcap.chunk import (
    Chunk,
    Pairs,
    decompressed_chunk,
    index_groups,
    pairs_in,
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
_PLACE_BITS: Final = 29


def place_of(chunk: Chunk) -> int:
    """Returns what is added to offsets in a chunk, so that places are in the order of the file.

    Two chunks, or parts as such, begin 32 bytes apart or more; a chunk has at most 512 MiB.
    """
    return chunk.offset >> _CHUNK_STEP << _PLACE_BITS


class ReadChunks(NamedTuple):
    """Chunks that were read together.

    Attributes:
        chunks: at least one.
        buffer: their decompressed records; empty if one of them cannot be read.
        sizes: how many bytes of the buffer each chunk has.
        indexes: the bytes of the message indexes behind each.
    """

    chunks: Sequence[Chunk]
    buffer: bytes
    sizes: Sequence[int]
    indexes: Sequence[bytes] = ()


def read_groups(file: OpenFile, chunks: Sequence[Chunk], limit: SizeLimit) -> Iterator[ReadChunks]:
    """Yields chunks, decompressed in groups of up to `BATCH_BYTES`; a larger one comes alone.

    Raises:
        OSError, MemoryError: the disk or the machine fails.
        EpisodicError: what `limit.take_turn` raises, which groups call likewise.
    """
    begin = 0
    while begin < len(chunks):
        parts: list[bytes] = []
        indexes: list[bytes] = []
        left = BATCH_BYTES
        end = begin
        # Chunks that fail are read again one by one, which reports the reason.
        with suppress(UnreadableError), as_unreadable():
            while end < len(chunks) and left > 0 and len(parts) < MAX_GROUP_CHUNKS:
                chunk = chunks[end]
                record = file.read(chunk.offset, chunk.length + chunk.index_length)
                body = record[RECORD.size : chunk.length]
                if parts and CHUNK.unpack_from(body)[2] > left:
                    break
                end += 1
                parts.append(decompressed_chunk(body, limit))
                indexes.append(record[chunk.length :])
                left -= len(parts[-1])
                if BATCH_BYTES - left > LARGE_BYTES:
                    limit.take_turn()
            del record, body
        end = max(end, begin + 1)
        sizes = [len(part) for part in parts]
        is_whole = len(parts) == end - begin
        buffer = (parts[0] if len(parts) == 1 else b"".join(parts)) if is_whole else b""
        parts.clear()
        yield ReadChunks(chunks[begin:end], buffer, sizes, indexes if is_whole else ())
        del buffer
        begin = end


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


def compared(
    content: ReadChunks, pairs: Pairs
) -> tuple[IntArray, np.ndarray[tuple[int], np.dtype[np.void]]]:
    """Returns where messages begin in the buffer of decompressed chunks, and their heads.

    Together with the number of messages, which `mcap.index` compares with the statistics, this
    proves that all messages of these channels are there: checksums protect the records.

    Raises:
        UnreadableError: a message is not there, has another channel or log time, ends past its
            chunk, or is there twice.
    """
    buffer, sizes = content.buffer, np.array(content.sizes)
    chunk_ends = np.cumsum(sizes)
    at, last = pairs.offsets + (chunk_ends - sizes)[pairs.chunks], len(buffer) - _HEAD.itemsize
    # A sum may have wrapped.
    if at.size and (pairs.offsets.min() < 0 or max(pairs.offsets.max(), at.max()) > last):
        raise UnreadableError(_NOT_THERE)
    heads, room = gathered(buffer, _HEAD, at), chunk_ends[pairs.chunks] - at - RECORD.size
    is_other = heads["opcode"] != _MESSAGE
    is_other |= (heads["channel"] != pairs.channels) | (heads["log_time"] != pairs.times)
    is_other |= (heads["length"] < MESSAGE_FIELDS) | (heads["length"] > room)
    if is_other.any():
        raise UnreadableError(_NOT_THERE)
    ordered = np.sort(at)
    if (ordered[1:] == ordered[:-1]).any():
        raise UnreadableError("damaged: a message index holds a message twice")
    return at, heads


def require_declared(content: ReadChunks, declared: Declarations) -> None:
    """Checks that chunks have no other messages, and declare no other channels, than is known.

    Only the bytes between messages are walked.

    Args:
        content: the chunks.
        declared: what the summary section declares.

    Raises:
        UnreadableError: they do.
    """
    with as_unreadable():
        at, heads = compared(content, pairs_in(content.chunks, content.indexes))
        chunk_ends = np.cumsum(content.sizes)
        begins = np.concatenate([[0], chunk_ends[:-1], at + RECORD.size + heads["length"]])
        ends = np.concatenate([at, chunk_ends])
        begins.sort()
        ends.sort()
        if (begins > ends).any():
            raise UnreadableError(_NOT_THERE)
        has_content = begins < ends
        for begin, end in zip(
            begins[has_content].tolist(), ends[has_content].tolist(), strict=True
        ):
            walked = walk_chunk(content.buffer[begin:end])
            if walked.messages:
                raise UnreadableError("damaged: a chunk holds messages that its indexes do not")
            if not all(declared.agrees(*declaration) for declaration in walked.declarations):
                raise UnreadableError(OTHER_DECLARED)


def batches_of(
    content: ReadChunks,
    pairs: Pairs,
    channels: Mapping[int, Channel],
    window: TimeWindow,
    uncompressed: Uncompressed,
) -> Iterator[Batch]:
    """Returns the messages of some channels in decompressed chunks, compared with the records.

    Args:
        content: the chunks.
        pairs: all of their messages of these channels.
        channels: the wanted channels by their number.
        window: of log time.
        uncompressed: decompresses messages.

    Raises:
        UnreadableError: a message is not in the records, or ends past its chunk.
    """
    buffer = content.buffer
    if not pairs.times.size:
        return iter(())
    at, heads = compared(content, pairs)
    stops = at + RECORD.size + heads["length"]
    order = _in_window(pairs, window)
    stated, logged = heads["publish_time"][order], pairs.times[order]
    # An unsigned time past the signed range has become negative. Some writers write 0 for unknown.
    published = np.where((stated <= 0) | (stated == MAX_NS), logged, stated)
    starts = at[order] + MESSAGE.size
    sizes = stops[order] - starts
    batches = _by_channel(
        pairs, order, content.chunks, channels, (published, buffer, starts, sizes)
    )
    if not _are_frames(buffer, starts, sizes).any():
        return batches
    return chain.from_iterable(_decompressed(framed, uncompressed) for framed in batches)


def _by_channel(
    pairs: Pairs,
    order: IntArray,
    chunks: Sequence[Chunk],
    channels: Mapping[int, Channel],
    payloads: tuple[IntArray, bytes, IntArray, IntArray],
) -> Iterator[Batch]:
    """Returns a batch for each channel of messages.

    Args:
        pairs: the messages, and others.
        order: their positions among these, channel by channel.
        chunks: that these are in.
        channels: by their number.
        payloads: their publish times, and buffer, starts and sizes of a `Batch`.
    """
    numbers, times = pairs.channels[order], pairs.times[order]
    steps = np.array([place_of(chunk) for chunk in chunks])[pairs.chunks[order]]
    places = pairs.offsets[order] + steps
    published, buffer, starts, sizes = payloads
    for first, last in pairwise([*run_starts(numbers).tolist(), numbers.size]):
        rows = slice(first, last)
        yield Batch(
            channels[int(numbers[first])],
            times[rows],
            published[rows],
            places[rows],
            buffer,
            starts[rows],
            sizes[rows],
        )


def _in_window(pairs: Pairs, window: TimeWindow) -> IntArray:
    """Returns the positions of the messages inside a window, channel by channel."""
    order: IntArray = np.argsort(pairs.channels, kind="stable")
    is_inside = (pairs.times >= window.start) & (pairs.times < window.stop)
    return order if is_inside.all() else order[is_inside[order]]


def _decompressed(batch: Batch, uncompressed: Uncompressed) -> Iterator[Batch]:
    """Yields a batch; or several where rosbag2 compressed each message."""
    compressed = _are_frames(batch.buffer, batch.starts, batch.sizes)
    if batch.channel.encoding != "cdr" or not compressed.any():
        yield batch
        return
    records = map(batch.record, range(batch.sizes.size))
    plain = (
        record._replace(payload=uncompressed(batch.channel, record.payload)) for record in records
    )
    yield from batched(zip(batch.places.tolist(), plain, strict=True))


def _are_frames(buffer: bytes, starts: IntArray, sizes: IntArray) -> Mask:
    """Returns which payloads begin as zstd does."""
    is_long = sizes >= len(FRAME_MAGIC)
    if not is_long.all():
        starts = starts[is_long]
    are_frames = np.zeros(is_long.size, np.bool_)
    are_frames[is_long] = gathered(buffer, _UINT32, starts) == _MAGIC
    return are_frames


def bare_batches(
    file: OpenFile, chunks: Sequence[Chunk], channels: Mapping[int, Channel], window: TimeWindow
) -> Iterator[Batch]:
    """Yields messages of chunks that are not read, by their message indexes alone.

    Raises:
        UnreadableError: the indexes are not those that the chunk indexes name.
    """
    for group, indexes in index_groups(file, chunks):
        pairs = pairs_in(group, indexes, channels)
        order = _in_window(pairs, window)
        none = np.zeros(order.size, np.int64)
        payloads = pairs.times[order], b"", none, none
        yield from _by_channel(pairs, order, group, channels, payloads)

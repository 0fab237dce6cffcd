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

from ros2_memory.core.arrays import gathered
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.base import BATCH_BYTES, Batch, Channel, IntArray, Mask, batched
from ros2_memory.storage.errors import SizeLimit, UnreadableError, as_unreadable
from ros2_memory.storage.mcap.chunk import (
    NOT_THERE,
    Chunk,
    Pairs,
    chunk_head,
    declarations_of,
    decompressed_chunk,
    in_file_order,
    index_groups,
    pairs_in,
    require_indexed,
)
from ros2_memory.storage.mcap.records import CHUNK, MESSAGE, RECORD
from ros2_memory.storage.zstd_bag import FRAME_MAGIC, Uncompressed

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.storage.file_io import OpenFile
    from ros2_memory.storage.mcap.records import Declarations

MAX_GROUP_CHUNKS: Final = 4096
_UINT32: Final = np.dtype("<u4")
_MAGIC: Final = int.from_bytes(FRAME_MAGIC, "little")
_CHUNK_STEP: Final = 6
_PLACE_BITS: Final = 29
_LOOSE: Final = -(1 << 62)


def place_of(chunk: Chunk) -> int:
    """Returns what is added to offsets in a chunk, so that places are in the order of the file.

    Two chunks with messages begin more than 64 bytes apart; a chunk has at most 512 MiB.
    """
    return chunk.offset >> _CHUNK_STEP << _PLACE_BITS


def loose_place(offset: int) -> int:
    """Returns the place of a message outside chunks, which comes before all others of its time."""
    return _LOOSE + offset


class ReadChunks(NamedTuple):
    """Chunks that were read together.

    Attributes:
        chunks: at least one.
        buffer: their decompressed records; None if one of them cannot be read.
        sizes: how many bytes of the buffer each chunk has.
        indexes: the bytes of the message indexes behind each.
    """

    chunks: Sequence[Chunk]
    buffer: bytes | None
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
        buffer: bytes | None = None
        try:
            while end < len(chunks) and left > 0 and len(parts) < MAX_GROUP_CHUNKS:
                chunk = chunks[end]
                record = file.read(chunk.offset, chunk.length + chunk.index_length)
                body = record[RECORD.size : chunk.length]
                if parts and CHUNK.unpack_from(body)[2] > left:
                    break
                end += 1
                head = chunk_head(body)
                compressed = body[head.data_at : head.data_at + head.data_size]
                parts.append(decompressed_chunk(head, compressed, limit))
                indexes.append(record[chunk.length :])
                left -= len(parts[-1])
                if BATCH_BYTES - left > LARGE_BYTES:
                    limit.take_turn()
            del record, body
            buffer = parts[0] if len(parts) == 1 else b"".join(parts)
        except (OSError, MemoryError, EpisodicError):
            raise
        except Exception:  # noqa: BLE001, S110 - whoever reads them one by one finds the reason
            pass
        sizes = [len(part) for part in parts]
        parts.clear()
        yield ReadChunks(chunks[begin : max(end, begin + 1)], buffer, sizes, indexes)
        del buffer
        begin = max(end, begin + 1)


def compared(
    content: ReadChunks, pairs: Pairs
) -> tuple[IntArray, np.ndarray[tuple[int], np.dtype[np.void]]]:
    """Returns where messages begin in the buffer of decompressed chunks, and their heads.

    Raises:
        UnreadableError: a message is not in the records, ends past its chunk, or is there twice.
    """
    sizes = np.array(content.sizes)
    ends = np.cumsum(sizes)
    at = pairs.offsets + (ends - sizes)[pairs.chunks]
    if (pairs.offsets < 0).any():
        raise UnreadableError(NOT_THERE)
    heads = require_indexed(pairs, content.buffer or b"", at, ends[pairs.chunks])
    in_file_order(at)
    return at, heads


def are_declared(content: ReadChunks, declared: Declarations) -> bool:
    """Returns whether chunks have the messages that their indexes name, and no others.

    And declare channels as `declared` does. False also where one of them cannot be read.
    """
    with suppress(UnreadableError), as_unreadable():
        buffer, ends = content.buffer, np.cumsum(content.sizes)
        if buffer is not None:
            places, _ = compared(content, pairs_in(content.chunks, content.indexes))
            found = declarations_of(buffer, places, ends)
            return all(declared.agrees(*declaration) for declaration in found)
    return False


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
    buffer = content.buffer or b""
    if not pairs.times.size:
        return iter(())
    at, heads = compared(content, pairs)
    stops = at + RECORD.size + heads["length"]
    order = _in_window(pairs, window)
    at, numbers = at[order], pairs.channels[order]
    steps = np.array([place_of(chunk) for chunk in content.chunks])[pairs.chunks[order]]
    published = _published(heads["publish_time"][order], pairs.times[order])
    times, places = pairs.times[order], pairs.offsets[order] + steps
    starts = at + MESSAGE.size
    lengths = stops[order] - starts
    has_frames = bool(_are_frames(buffer, starts, lengths).any())
    bounds = np.flatnonzero(numbers[1:] != numbers[:-1]) + 1
    edges = [0, *bounds.tolist(), numbers.size] if numbers.size else []
    batches: list[Batch] = []
    for first, last in pairwise(edges):
        rows = slice(first, last)
        batch = Batch(
            channels[int(numbers[first])],
            times[rows],
            published[rows],
            places[rows],
            buffer,
            starts[rows],
            lengths[rows],
        )
        batches.append(batch)
    if not has_frames:
        return iter(batches)
    return chain.from_iterable(_decompressed(framed, uncompressed) for framed in batches)


def _in_window(pairs: Pairs, window: TimeWindow) -> IntArray:
    """Returns the positions of the messages inside a window, channel by channel."""
    order: IntArray = np.argsort(pairs.channels, kind="stable")
    is_inside = (pairs.times >= window.start) & (pairs.times < window.stop)
    return order if is_inside.all() else order[is_inside[order]]


def _published(stated: IntArray, logged: IntArray) -> IntArray:
    # An unsigned time past the signed range has become negative. Some writers write 0 for unknown.
    is_impossible = (stated <= 0) | (stated == MAX_NS)
    return np.where(is_impossible, logged, stated) if is_impossible.any() else stated


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
        steps = np.array([place_of(chunk) for chunk in group])[pairs.chunks[order]]
        numbers, times = pairs.channels[order], pairs.times[order]
        places = pairs.offsets[order] + steps
        for number in np.unique(numbers).tolist():
            is_of_channel = numbers == number
            none = np.zeros(int(is_of_channel.sum()), np.int64)
            logged = times[is_of_channel]
            yield Batch(channels[number], logged, logged, places[is_of_channel], b"", none, none)

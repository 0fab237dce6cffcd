"""Decompresses zstd: single frames, messages, and whole bag files (`.mcap.zstd`, `.db3.zstd`)."""

from __future__ import annotations

import os
import struct
import threading
from functools import partial
from typing import TYPE_CHECKING, Final, TypeAlias

import zstandard

from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.storage.errors import (
    MAX_COMPRESSION_RATIO,
    SizeLimit,
    UnreadableError,
    max_decompressed_bytes,
)
from ros2_memory.storage.file_io import EMPTY_FILE, OpenFile, open_regular

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.storage.base import Channel


# As large as a block, so that the data before a damaged block is not lost with it.
_PIECE: Final = zstandard.DECOMPRESSION_RECOMMENDED_OUTPUT_SIZE


Uncompressed: TypeAlias = "Callable[[Channel, bytes], bytes]"
"""Returns a payload as it was before rosbag2's message compression; see `uncompressed_payload`."""

FRAME_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_SKIPPABLE: Final = b"\x2a\x4d\x18"
"""The magic of a skippable frame, behind its first byte, which is 0x50 to 0x5F."""
_SKIPPABLE_HEADER: Final = struct.Struct("<II")
"""Magic and size of a skippable frame."""
_HEADER_BYTES: Final = 18
"""The longest header of a frame."""
_BLOCK_HEADER_BYTES: Final = 3
_CHECKSUM_BYTES: Final = 4
_RLE_BLOCK: Final = 1
"""The kind of a block that is one byte, repeated as often as its size says."""
_MAX_BLOCK_BYTES: Final = 128 << 10
_MIN_BLOCK_BYTES: Final = 4
_MAX_FRAMES: Final = 10_000
_MAX_BLOCKS: Final = 1_000_000
"""A file of 128 GB has as many full blocks; to go through more, small ones, takes minutes."""


def is_finished_zstd(path: Path) -> bool:
    """Returns whether the file is made of whole frames; one that is not zstd counts as finished."""
    with OpenFile(path) as file:
        return not starts_as_zstd(file) or ends_whole(file)


def unpack(path: Path, folder: Path, reserve: Callable[[int], None]) -> tuple[Path, str]:
    """Decompresses a bag file into the folder, as far as it can be read.

    Args:
        path: the compressed file.
        folder: where the bag is written, under its name without `.zstd`.
        reserve: called with a number of bytes before as many are written.

    Returns:
        The bag, and a note if the compressed file is damaged or ends early; else an empty one.

    Raises:
        UnreadableError: nothing of it can be decompressed, or it takes more space than allowed.
    """
    with OpenFile(path) as file:
        if not file.size:
            raise UnreadableError(EMPTY_FILE)
        if not starts_as_zstd(file):
            raise UnreadableError("not a zstd file: it does not begin as one")
        whole = ends_whole(file)
    target = folder / path.stem
    damage = _decompress_into(path, target, reserve)
    if not target.stat().st_size:
        raise UnreadableError(f"nothing of it can be decompressed ({damage or 'it ends early'})")
    if damage:
        return target, f"its compressed file is damaged ({damage}); what comes after is lost"
    return target, "" if whole else "its compressed file ends early"


def _decompress_into(path: Path, target: Path, reserve: Callable[[int], None]) -> str:
    """Writes what can be decompressed; returns what is wrong with the rest, or an empty text."""
    with os.fdopen(open_regular(path), "rb") as source, target.open("wb") as out:
        reader = zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
        left = max_decompressed_bytes(path.stat().st_size)
        while True:
            try:
                piece = reader.read(_PIECE)
            except zstandard.ZstdError as error:
                return str(error)
            if not piece:
                return ""
            left -= len(piece)
            if left < 0:
                raise UnreadableError(
                    f"it unpacks to more than {MAX_COMPRESSION_RATIO} times its size"
                )
            reserve(len(piece))
            out.write(piece)


class _ThreadLocal(threading.local):
    """One decompressor a thread: a shared one corrupts data, a new one costs more than a chunk."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()


_THREAD: Final = _ThreadLocal()


_TOO_MUCH: Final = "damaged: compressed data is larger than stated, or than it can be"


def decompress_zstd(compressed: bytes | memoryview, limit: SizeLimit) -> bytes:
    """Decompresses one zstd frame.

    Raises:
        UnreadableError: it decompresses to more than the limit, or states more than its blocks can
            decompress to.
    """
    stated = zstandard.frame_content_size(compressed)  # negative where the frame does not state it
    # zstandard allocates the stated size, so it must be possible: no block takes fewer bytes, or
    # decompresses to more (RFC 8878, 3.1.1.2).
    most = (len(compressed) // _MIN_BLOCK_BYTES + 1) * _MAX_BLOCK_BYTES
    if stated > min(most, limit.max_bytes):
        raise UnreadableError(_TOO_MUCH)
    if stated >= 0:
        if stated > LARGE_BYTES:
            limit.take_turn()
        return _THREAD.decompressor.decompress(compressed)
    data = decompress_front(partial(zstd_front, compressed), limit)
    if len(data) > limit.max_bytes:
        raise UnreadableError(_TOO_MUCH)
    return data


def decompress_front(front: Callable[[int], bytes], limit: SizeLimit) -> bytes:
    """Returns at most one byte more than allowed, so that the caller sees the excess.

    Args:
        front: decompresses the first bytes, at most as many as it is given. Data of more than
            `LARGE_BYTES` is decompressed twice: the second time after `limit.take_turn`.
        limit: the most that may be returned.
    """
    data = front(min(LARGE_BYTES, limit.max_bytes) + 1)
    if LARGE_BYTES < len(data) <= limit.max_bytes:
        limit.take_turn()
        data = front(limit.max_bytes + 1)
    return data


def zstd_front(compressed: bytes | memoryview, size: int) -> bytes:
    """Returns the first `size` bytes of a zstd frame that may end early, or all that it has."""
    with zstandard.ZstdDecompressor().stream_reader(compressed) as stream:
        return stream.read(size)


def uncompressed_payload(channel: Channel, payload: bytes, limit: SizeLimit) -> bytes:
    """Undoes rosbag2's message compression of a payload, if it is compressed.

    Nothing but the magic of the frame marks a compressed payload; no CDR message begins with it. A
    payload that cannot be decompressed, or not within the limit, is returned as it is: decoding
    reports it.
    """
    if channel.encoding != "cdr" or payload[:4] != FRAME_MAGIC:
        return payload
    try:
        return decompress_zstd(payload, limit)
    except (UnreadableError, zstandard.ZstdError, MemoryError):
        return payload


def starts_as_zstd(file: OpenFile) -> bool:
    """Returns whether the file begins with the magic of a frame, as far as it reaches."""
    head = file.read(0, min(file.size, len(FRAME_MAGIC)))
    return FRAME_MAGIC.startswith(head) or _is_skippable(head)


def ends_whole(file: OpenFile) -> bool:
    """Returns whether the file is made of whole frames, by block headers alone (RFC 8878, 3.1).

    Raises:
        UnreadableError: it has more frames or blocks than any writer makes.
    """
    position, frames = 0, 0
    while position < file.size:
        frames += 1
        if frames > _MAX_FRAMES:
            raise UnreadableError(f"damaged: it is made of more than {_MAX_FRAMES} frames")
        end = _frame_end(file, position)
        if end is None or end > file.size:
            return False
        position = end
    return position > 0


def _is_skippable(magic: bytes) -> bool:
    """Returns whether four bytes are the magic of a skippable frame (RFC 8878, 3.1.2)."""
    return len(magic) == 4 and magic[0] & 0xF0 == 0x50 and magic[1:] == _SKIPPABLE


def _frame_end(file: OpenFile, start: int) -> int | None:
    """Returns where the frame at `start` ends; None if the file ends before, or has none there."""
    head = file.read(start, min(_HEADER_BYTES, file.size - start))
    if _is_skippable(head[:4]):
        if len(head) < _SKIPPABLE_HEADER.size:
            return None
        _, size = _SKIPPABLE_HEADER.unpack_from(head)
        return start + _SKIPPABLE_HEADER.size + int(size)
    try:
        position = start + zstandard.frame_header_size(head)
        has_checksum = zstandard.get_frame_parameters(head).has_checksum
    except zstandard.ZstdError:
        return None
    for _ in range(_MAX_BLOCKS):
        if position + _BLOCK_HEADER_BYTES > file.size:
            return None
        header = int.from_bytes(file.read(position, _BLOCK_HEADER_BYTES), "little")
        is_last, kind, size = header & 1, header >> 1 & 3, header >> 3
        position += _BLOCK_HEADER_BYTES + (1 if kind == _RLE_BLOCK else size)
        if is_last:
            return position + (_CHECKSUM_BYTES if has_checksum else 0)
    raise UnreadableError(f"damaged: it is made of more than {_MAX_BLOCKS} blocks")

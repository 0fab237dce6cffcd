"""Bag files that rosbag2 compressed as a whole: `.mcap.zstd`, `.db3.zstd`."""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Final

import zstandard

from ros2_memory.storage.base import Closing
from ros2_memory.storage.errors import MAX_TIMES_PACKED, UnreadableError, most_unpacked, too_large
from ros2_memory.storage.file_io import EMPTY_FILE, OpenFile, open_regular

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

# As large as a block: what stands before a damaged one is not lost with it.
_PIECE: Final = zstandard.DECOMPRESSION_RECOMMENDED_OUTPUT_SIZE


def closing_of_zstd(path: Path) -> Closing:
    """Closed when the file is made of whole frames; what is not zstd at all counts as closed."""
    with OpenFile(path) as file:
        if file.size and not begins_as_zstd(file):
            return Closing.CLOSED
        return Closing.CLOSED if ends_whole(file) else Closing.OPEN


def unpack(path: Path, folder: Path, reserve: Callable[[int], None]) -> tuple[Path, str]:
    """Decompresses a bag file into the folder, as far as it can be read.

    Args:
        path: the compressed file.
        folder: where the bag is written, under its name without `.zstd`.
        reserve: called with a number of bytes before as many are written.

    Returns:
        The bag, and a note on where the compressed file ends early (empty where it does not).

    Raises:
        UnreadableError: nothing of it can be decompressed, or there is no room for it.
    """
    with OpenFile(path) as file:
        if not file.size:
            raise UnreadableError(EMPTY_FILE)
        if not begins_as_zstd(file):
            raise UnreadableError("not a zstd file: it does not begin as one")
        whole = ends_whole(file)
    target = folder / path.stem
    damage = _unpack(path, target, reserve)
    if not target.stat().st_size:
        raise UnreadableError(f"nothing of it can be decompressed ({damage or 'it ends early'})")
    if damage:
        return target, f"its compressed file is damaged ({damage}); what comes after is lost"
    return target, "" if whole else "its compressed file ends early"


def _unpack(path: Path, target: Path, reserve: Callable[[int], None]) -> str:
    """Writes what can be decompressed; what is wrong with the rest, or nothing."""
    with os.fdopen(open_regular(path), "rb") as packed, target.open("wb") as out:
        reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
        left = most_unpacked(path.stat().st_size)
        while True:
            try:
                piece = reader.read(_PIECE)
            except zstandard.ZstdError as error:
                return str(error)
            if not piece:
                return ""
            left -= len(piece)
            if left < 0:
                raise UnreadableError(f"it unpacks to more than {MAX_TIMES_PACKED} times its size")
            reserve(len(piece))
            out.write(piece)


FRAME_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_SKIPPABLE: Final = b"\x2a\x4d\x18"
_HEADER_BYTES: Final = 18
_RLE_BLOCK: Final = 1
_MAX_BLOCK_BYTES: Final = 128 << 10
_MIN_BLOCK_BYTES: Final = 4
_MAX_FRAMES: Final = 10_000
_MAX_BLOCKS: Final = 1_000_000
"""Of whole ones a file of 128 GB is made; small ones would be looked through for minutes."""


class _Own(threading.local):
    """One for each thread, since it is not safe to share, and costs more than a chunk to make."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()


_OWN: Final = _Own()


def unpacked_zstd(packed: bytes, max_bytes: int) -> bytes:
    """One zstd frame, decompressed.

    Raises:
        UnreadableError: it holds, or states to hold, more than `max_bytes`, or states more than
            its blocks can hold.
    """
    stated = zstandard.frame_content_size(packed)
    if stated > max_bytes:
        raise UnreadableError(too_large("compressed data", max_bytes))
    # What is stated is allocated: no block takes fewer bytes, or holds more (RFC 8878, 3.1.1.2).
    if stated > (len(packed) // _MIN_BLOCK_BYTES + 1) * _MAX_BLOCK_BYTES:
        raise UnreadableError("damaged: compressed data states more than it can hold")
    if stated >= 0:
        return _OWN.decompressor.decompress(packed)
    with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
        data = stream.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise UnreadableError(too_large("compressed data", max_bytes))
    return data


def plain_payload(payload: bytes, max_bytes: int) -> bytes:
    """A serialized message as it was before rosbag2's message compression.

    Nothing but the frame's magic says that a payload is compressed; no CDR message begins so. One
    that cannot be decompressed, or holds more than `max_bytes`, is given as it stands, for
    decoding to say so.
    """
    if payload[:4] != FRAME_MAGIC:
        return payload
    try:
        return unpacked_zstd(payload, max_bytes)
    except (UnreadableError, zstandard.ZstdError, MemoryError):
        return payload


def begins_as_zstd(file: OpenFile) -> bool:
    """Whether it begins with a frame's magic, or with as much of it as the file has bytes."""
    head = file.read(0, min(file.size, 4))
    return FRAME_MAGIC.startswith(head) or _is_skippable(head)


def ends_whole(file: OpenFile) -> bool:
    """Whether the file is made of whole frames, by their block headers alone (RFC 8878, 3.1).

    Raises:
        UnreadableError: it is made of more than any writer makes.
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


def _is_skippable(head: bytes) -> bool:
    return len(head) == 4 and head[0] & 0xF0 == 0x50 and head[1:] == _SKIPPABLE


def _frame_end(file: OpenFile, start: int) -> int | None:
    """Where the frame at `start` ends, None where the file ends before that shows."""
    head = file.read(start, min(_HEADER_BYTES, file.size - start))
    if _is_skippable(head[:4]):
        if len(head) < 8:
            return None
        return start + 8 + int.from_bytes(head[4:8], "little")
    try:
        position = start + zstandard.frame_header_size(head)
        checksum = 4 if zstandard.get_frame_parameters(head).has_checksum else 0
    except zstandard.ZstdError:
        return None
    blocks = 0
    while position + 3 <= file.size:
        blocks += 1
        if blocks > _MAX_BLOCKS:
            raise UnreadableError(f"damaged: it is made of more than {_MAX_BLOCKS} blocks")
        header = int.from_bytes(file.read(position, 3), "little")
        last, kind, size = header & 1, header >> 1 & 3, header >> 3
        position += 3 + (1 if kind == _RLE_BLOCK else size)
        if last:
            return position + checksum
    return None
